//! What the file promises, read back through the `gltf` crate as any importer would.

use super::anatomy::TEXTURE_TEXELS;
use super::clip::{DURATION_S, KEYS};
use super::mesh::{Mesh, Skin};
use super::{anatomy, dragon, rig::Rig, skin};
use glam::{Mat4, Quat, Vec2, Vec3, Vec4};
use gltf::animation::util::ReadOutputs;
use std::collections::{HashMap, HashSet};
use std::sync::OnceLock;

type Trs = (Vec3, Quat, Vec3);

/// One vertex as an importer sees it.
struct Vertex {
    position: Vec3,
    normal: Vec3,
    uv: Vec2,
    joints: [u16; 4],
    weights: Vec4,
}

enum Values {
    Translation(Vec<Vec3>),
    Rotation(Vec<Quat>),
    Scale(Vec<Vec3>),
}

struct Track {
    node: usize,
    times_s: Vec<f32>,
    values: Values,
}

/// The dragon as it is read back.
struct Read {
    document: gltf::Document,
    blob: Vec<u8>,
    vertices: Vec<Vertex>,
    triangles: Vec<[usize; 3]>,
    tracks: Vec<Track>,
}

fn read() -> &'static Read {
    static READ: OnceLock<Read> = OnceLock::new();
    READ.get_or_init(|| {
        let gltf::Gltf { document, blob } = gltf::Gltf::from_slice(&dragon()).unwrap();
        let blob = blob.unwrap();
        let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
        for primitive in document.meshes().next().unwrap().primitives() {
            read_primitive(&primitive, &blob, &mut vertices, &mut triangles);
        }
        let animation = document.animations().next().unwrap();
        let tracks = animation.channels().map(|channel| read_track(&channel, &blob)).collect();
        Read { document, blob, vertices, triangles, tracks }
    })
}

fn read_primitive(
    primitive: &gltf::Primitive,
    blob: &[u8],
    vertices: &mut Vec<Vertex>,
    triangles: &mut Vec<[usize; 3]>,
) {
    let first = vertices.len();
    let reader = primitive.reader(|_| Some(blob));
    let positions = reader.read_positions().unwrap();
    let mut normals = reader.read_normals().unwrap();
    let mut uvs = reader.read_tex_coords(0).unwrap().into_f32();
    let mut joints = reader.read_joints(0).unwrap().into_u16();
    let mut weights = reader.read_weights(0).unwrap().into_f32();
    vertices.extend(positions.map(|position| Vertex {
        position: position.into(),
        normal: normals.next().unwrap().into(),
        uv: uvs.next().unwrap().into(),
        joints: joints.next().unwrap(),
        weights: weights.next().unwrap().into(),
    }));
    let indices: Vec<usize> = reader.read_indices().unwrap().into_u32().map(|i| first + i as usize).collect();
    triangles.extend(indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]]));
}

/// Without the tangents before and after each.
fn values<T>(keys: impl Iterator<Item = T>) -> Vec<T> {
    keys.skip(1).step_by(3).collect()
}

fn read_track(channel: &gltf::animation::Channel, blob: &[u8]) -> Track {
    let reader = channel.reader(|_| Some(blob));
    let values = match reader.read_outputs().unwrap() {
        ReadOutputs::Translations(keys) => Values::Translation(values(keys.map(Vec3::from))),
        ReadOutputs::Rotations(keys) => Values::Rotation(values(keys.into_f32().map(Quat::from_array))),
        ReadOutputs::Scales(keys) => Values::Scale(values(keys.map(Vec3::from))),
        ReadOutputs::MorphTargetWeights(_) => panic!("the dragon has no morph targets"),
    };
    assert_eq!(channel.sampler().interpolation(), gltf::animation::Interpolation::CubicSpline);
    Track { node: channel.target().node().index(), times_s: reader.read_inputs().unwrap().collect(), values }
}

impl Read {
    fn rest(&self) -> Vec<Trs> {
        let local = |node: gltf::Node| {
            let (translation, rotation, scale) = node.transform().decomposed();
            (translation.into(), Quat::from_array(rotation), scale.into())
        };
        self.document.nodes().map(local).collect()
    }

    fn at_key(&self, key: usize) -> Vec<Trs> {
        let mut pose = self.rest();
        for track in &self.tracks {
            match &track.values {
                Values::Translation(keys) => pose[track.node].0 = keys[key],
                Values::Rotation(keys) => pose[track.node].1 = keys[key],
                Values::Scale(keys) => pose[track.node].2 = keys[key],
            }
        }
        pose
    }

    fn world_from_node(&self, pose: &[Trs]) -> Vec<Mat4> {
        let mut world: Vec<Mat4> =
            pose.iter().map(|&(t, r, s)| Mat4::from_scale_rotation_translation(s, r, t)).collect();
        for node in self.document.nodes() {
            for child in node.children() {
                assert!(child.index() > node.index(), "parents come first");
                world[child.index()] = world[node.index()] * world[child.index()];
            }
        }
        world
    }

    fn skinned(&self, pose: &[Trs]) -> Vec<Vec3> {
        let world = self.world_from_node(pose);
        let skin = self.document.skins().next().unwrap();
        let inverse_bind = skin.reader(|_| Some(&self.blob)).read_inverse_bind_matrices().unwrap();
        let palette: Vec<Mat4> = skin
            .joints()
            .zip(inverse_bind)
            .map(|(joint, bind)| world[joint.index()] * Mat4::from_cols_array_2d(&bind))
            .collect();
        let place = |vertex: &Vertex| {
            let share = |i: usize| {
                palette[vertex.joints[i] as usize].transform_point3(vertex.position) * vertex.weights[i]
            };
            (0..4).map(share).sum()
        };
        self.vertices.iter().map(place).collect()
    }

    #[track_caller]
    fn node(&self, name: &str) -> usize {
        self.document.nodes().find(|node| node.name() == Some(name)).unwrap().index()
    }

    #[track_caller]
    fn rotations(&self, name: &str) -> &[Quat] {
        let node = self.node(name);
        let keys = self.tracks.iter().find_map(|track| match &track.values {
            Values::Rotation(keys) if track.node == node => Some(keys),
            _ => None,
        });
        keys.unwrap()
    }
}

fn bounds(places: impl Iterator<Item = Vec3>) -> (Vec3, Vec3) {
    places.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)))
}

#[test]
fn two_calls_give_the_same_bytes() {
    assert!(dragon() == dragon());
}

#[test]
fn counts_are_those_of_the_papers_dragon() {
    let read = read();
    assert!((21_500..=22_500).contains(&read.vertices.len()), "{} vertices", read.vertices.len());
    assert!((37_500..=38_500).contains(&read.triangles.len()), "{} triangles", read.triangles.len());
    let skin = read.document.skins().next().unwrap();
    assert_eq!(skin.joints().count(), 136);
    let names: HashSet<&str> = skin.joints().map(|joint| joint.name().unwrap()).collect();
    assert_eq!(names.len(), 136, "joint names are unique");
}

#[test]
fn stands_two_metres_tall_above_the_origin() {
    let (low, high) = bounds(read().vertices.iter().map(|v| v.position));
    assert!(low.y.abs() < 0.002, "lowest {low}");
    assert!((high.y - 2.0).abs() < 0.005, "highest {high}");
    let centre = 0.5 * (low + high);
    assert!(centre.x.abs() < 0.002 && centre.z.abs() < 0.005, "centre {centre}");
}

#[test]
fn rest_pose_is_the_pose_of_the_skin() {
    let read = read();
    for (vertex, place) in read.vertices.iter().zip(read.skinned(&read.rest())) {
        assert!(vertex.position.distance(place) < 1e-5, "{} {place}", vertex.position);
    }
}

#[test]
fn weights_sum_to_one_over_existing_joints() {
    for vertex in &read().vertices {
        assert!((vertex.weights.element_sum() - 1.0).abs() < 1e-6, "{}", vertex.weights);
        assert!(vertex.weights.min_element() >= 0.0);
        for i in 0..4 {
            assert!(vertex.joints[i] < 136);
            assert!(vertex.weights[i] > 0.0 || vertex.joints[i] == 0);
        }
    }
}

#[test]
fn every_joint_but_the_root_moves_some_skin_or_other_joints() {
    let read = read();
    let used: HashSet<usize> = read
        .vertices
        .iter()
        .flat_map(|v| (0..4).filter(|&i| v.weights[i] > 0.0).map(|i| v.joints[i] as usize))
        .collect();
    let skin = read.document.skins().next().unwrap();
    let idle: Vec<&str> = skin
        .joints()
        .enumerate()
        .filter(|(i, _)| !used.contains(i))
        .map(|(_, joint)| joint.name().unwrap())
        .collect();
    assert_eq!(idle, ["root"]);
}

#[test]
fn keys_are_at_60_hz_over_four_seconds() {
    for track in &read().tracks {
        assert_eq!(track.times_s.len(), KEYS);
        for (key, time_s) in track.times_s.iter().enumerate() {
            assert_eq!(*time_s, key as f32 / 60.0);
        }
        assert_eq!(track.times_s[KEYS - 1], DURATION_S);
    }
}

#[test]
fn the_clip_moves_translation_rotation_and_scale() {
    let tracks = &read().tracks;
    let count = |f: fn(&Values) -> bool| tracks.iter().filter(|track| f(&track.values)).count();
    assert!(count(|values| matches!(values, Values::Translation(_))) >= 2);
    assert!(count(|values| matches!(values, Values::Rotation(_))) >= 130);
    assert!(count(|values| matches!(values, Values::Scale(_))) >= 1);
    let read = read();
    for joint in ["wing_root_l", "wing_root_r", "neck_5", "tail_12", "fore_upper_l", "hind_lower_r"] {
        let keys = read.rotations(joint);
        assert!(keys.iter().any(|key| key.angle_between(keys[0]) > 0.02), "{joint} stands still");
    }
}

#[test]
fn the_last_key_is_the_first_and_goes_on_without_a_jerk() {
    // A step of the second difference at the seam would show as a jerk.
    #[track_caller]
    fn check(keys: &[Vec4]) {
        assert_eq!(keys[0], keys[KEYS - 1]);
        let bend = |a: usize, b: usize, c: usize| (keys[a] + keys[c] - 2.0 * keys[b]).length();
        let inside = (1..KEYS - 1).map(|i| bend(i - 1, i, i + 1)).fold(0.0, f32::max);
        assert!(bend(KEYS - 2, 0, 1) <= 1.05 * inside + 1e-6);
    }
    for track in &read().tracks {
        let keys: Vec<Vec4> = match &track.values {
            Values::Translation(keys) | Values::Scale(keys) => {
                keys.iter().map(|key| key.extend(0.0)).collect()
            }
            Values::Rotation(keys) => keys.iter().map(|&key| Vec4::from(key)).collect(),
        };
        check(&keys);
    }
}

#[test]
fn rotations_are_unit_quaternions_on_the_shortest_arc() {
    let read = read();
    assert!(read.rest().iter().all(|trs| (trs.1.length() - 1.0).abs() < 1e-5));
    for track in &read.tracks {
        let Values::Rotation(keys) = &track.values else { continue };
        assert!(keys.iter().all(|key| (key.length() - 1.0).abs() < 1e-5));
        assert!(keys.windows(2).all(|pair| pair[0].dot(pair[1]) > 0.0));
    }
}

#[test]
fn wings_beat_once_a_second_by_forty_degrees_to_either_side() {
    for name in ["wing_root_l", "wing_root_r"] {
        let keys = read().rotations(name);
        // In the model's axes the root turns about the direction of flight: compare with the middle of the beat.
        let up = (keys[15] * keys[0].inverse()).to_scaled_axis().length().to_degrees();
        let across = keys[15].angle_between(keys[45]).to_degrees();
        assert!((up - 40.0).abs() < 0.05, "{name} up {up}");
        assert!((across - 80.0).abs() < 0.05, "{name} across {across}");
        assert!(keys[0].angle_between(keys[60]) < 1e-3, "{name} has a period of 1 s");
        assert!(raised_tip(name, 15) > raised_tip(name, 45) + 0.9, "{name} beats upwards first");
    }
}

/// Height of a wing's outermost joint above its root at a key, metres.
fn raised_tip(root: &str, key: usize) -> f32 {
    let read = read();
    let world = read.world_from_node(&read.at_key(key));
    let height = |name: &str| world[read.node(name)].w_axis.y;
    height(&root.replace("root", "finger_1_4")) - height(root)
}

#[test]
fn wing_tips_are_a_metre_from_the_wing_roots() {
    let read = read();
    let world = read.world_from_node(&read.rest());
    for (joint, root) in [("wing_finger_1_4_l", "wing_root_l"), ("wing_finger_1_4_r", "wing_root_r")] {
        let index = (read.node(joint) - 1) as u16;
        let root = world[read.node(root)].w_axis.truncate();
        let moved = read.vertices.iter().filter(|v| v.joints[0] == index);
        let reach = moved.map(|v| v.position.distance(root)).fold(0.0, f32::max);
        assert!((reach - 1.0).abs() < 0.01, "{joint} reaches {reach}");
    }
}

#[test]
fn the_flying_dragon_stays_above_the_floor_and_in_one_piece() {
    let read = read();
    for key in (0..KEYS).step_by(8) {
        let places = read.skinned(&read.at_key(key));
        let (low, high) = bounds(places.iter().copied());
        assert!(low.y > 0.0, "key {key}: lowest {low}");
        assert!(high.y < 2.6 && high.x < 1.5 && low.x > -1.5, "key {key}: {low} {high}");
        let stretched =
            edges(&read.triangles).map(|[a, b]| places[a].distance(places[b])).fold(0.0, f32::max);
        assert!(stretched < 0.3, "key {key}: edge of {stretched} m");
    }
}

fn edges(triangles: &[[usize; 3]]) -> impl Iterator<Item = [usize; 2]> {
    triangles.iter().flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
}

#[test]
fn triangles_are_small_and_mostly_even() {
    let read = read();
    let place = |i: usize| read.vertices[i].position;
    let mut qualities: Vec<f32> = Vec::new();
    for &[a, b, c] in &read.triangles {
        let squares =
            [place(a) - place(b), place(b) - place(c), place(c) - place(a)].map(Vec3::length_squared);
        assert!(squares.iter().all(|square| *square < 0.3 * 0.3));
        let double_area = (place(b) - place(a)).cross(place(c) - place(a)).length();
        // 1 for an equilateral triangle, 0 for a sliver.
        qualities.push(2.0 * 3.0_f32.sqrt() * double_area / squares.iter().sum::<f32>());
    }
    qualities.sort_by(f32::total_cmp);
    assert!(qualities[0] > 0.0);
    assert!(qualities[qualities.len() / 20] > 0.3, "5 % below {}", qualities[qualities.len() / 20]);
    assert!(qualities[qualities.len() / 2] > 0.8, "half below {}", qualities[qualities.len() / 2]);
}

#[test]
fn triangles_face_the_way_their_normals_point() {
    let read = read();
    let backwards = |&&[a, b, c]: &&[usize; 3]| {
        let [a, b, c] = [a, b, c].map(|i| &read.vertices[i]);
        let face = (b.position - a.position).cross(c.position - a.position);
        face.dot(a.normal + b.normal + c.normal) <= 0.0
    };
    let count = read.triangles.iter().filter(backwards).count();
    // A few hidden ones, where limbs dive into the trunk, may be folded.
    assert!(count * 500 < read.triangles.len(), "{count} of {} face inwards", read.triangles.len());
}

#[test]
fn winding_is_outwards() {
    let read = read();
    let place = |i: usize| read.vertices[i].position;
    let six_volumes: f32 =
        read.triangles.iter().map(|&[a, b, c]| place(a).dot(place(b).cross(place(c)))).sum();
    assert!(six_volumes / 6.0 > 0.1, "volume {} m3", six_volumes / 6.0);
}

#[test]
fn normals_are_unit_and_texture_coordinates_inside_the_texture() {
    for vertex in &read().vertices {
        assert!((vertex.normal.length() - 1.0).abs() < 1e-4);
        assert!(vertex.uv.min_element() >= 0.0 && vertex.uv.max_element() <= 1.0, "{}", vertex.uv);
    }
}

#[test]
fn textures_are_square_pngs() {
    let read = read();
    assert_eq!(read.document.images().count(), 3);
    for image in read.document.images() {
        let gltf::image::Source::View { view, mime_type } = image.source() else { panic!("not embedded") };
        assert_eq!(mime_type, "image/png");
        let bytes = &read.blob[view.offset()..view.offset() + view.length()];
        let mut png = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
        assert_eq!((png.info().width, png.info().height), (TEXTURE_TEXELS, TEXTURE_TEXELS));
        let mut pixels = vec![0; png.output_buffer_size().unwrap()];
        png.next_frame(&mut pixels).unwrap();
        assert!(pixels.iter().any(|byte| *byte != pixels[0]), "{} is one colour", image.name().unwrap());
    }
}

/// Parts may share a place only as copies: the other side's, or another toe, finger or horn.
#[test]
fn islands_do_not_overlap() {
    let loft = anatomy::spine();
    let mesh = skin(&Rig::new(&loft), loft);
    let parts = parts(&mesh);
    let mut owner: HashMap<(i32, i32), usize> = HashMap::new();
    for (triangle, part) in mesh.triangles.iter().zip(&parts) {
        let texels = triangle.map(|index| mesh.vertices[index as usize].texel);
        for texel in covered(texels) {
            let first = *owner.entry(texel).or_insert(*part);
            assert!(first == *part, "parts {first} and {part} overlap at {texel:?}");
        }
    }
}

/// A name for each triangle's part: copies of one part have the same.
fn parts(mesh: &Mesh) -> Vec<usize> {
    let mut root: Vec<usize> = (0..mesh.vertices.len()).collect();
    fn find(root: &mut [usize], mut i: usize) -> usize {
        while root[i] != i {
            root[i] = root[root[i]];
            i = root[i];
        }
        i
    }
    for triangle in &mesh.triangles {
        for pair in [[0, 1], [0, 2]] {
            let [a, b] = pair.map(|corner| find(&mut root, triangle[corner] as usize));
            root[a] = b;
        }
    }
    let mut bounds: HashMap<usize, (Vec2, Vec2)> = HashMap::new();
    for (i, vertex) in mesh.vertices.iter().enumerate() {
        let entry = bounds.entry(find(&mut root, i)).or_insert((vertex.texel, vertex.texel));
        *entry = (entry.0.min(vertex.texel), entry.1.max(vertex.texel));
    }
    let mut names: Vec<(Skin, Vec2)> = Vec::new();
    let mut name = |skin: Skin, (low, high): (Vec2, Vec2)| {
        // Membranes of one wing side lie next to each other as they do on the wing; other islands start at the left.
        let anchor =
            if skin == Skin::Membrane { Vec2::ZERO } else { Vec2::new(low.x, 0.5 * (low.y + high.y)) };
        let known = names.iter().position(|known| known.0 == skin && known.1.distance(anchor) < 3.0);
        known.unwrap_or_else(|| {
            names.push((skin, anchor));
            names.len() - 1
        })
    };
    let of = |triangle: &[u32; 3]| {
        let vertex = triangle[0] as usize;
        name(mesh.vertices[vertex].skin, bounds[&find(&mut root, vertex)])
    };
    mesh.triangles.iter().map(of).collect()
}

/// Texels whose centres are well inside a triangle.
fn covered([a, b, c]: [Vec2; 3]) -> Vec<(i32, i32)> {
    let area = (b - a).perp_dot(c - a);
    let (low, high) = (a.min(b).min(c).floor().as_ivec2(), a.max(b).max(c).ceil().as_ivec2());
    let mut texels = Vec::new();
    for y in low.y..high.y {
        for x in low.x..high.x {
            let offset = Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - a;
            let (v, w) = (offset.perp_dot(c - a) / area, (b - a).perp_dot(offset) / area);
            if v > 0.01 && w > 0.01 && v + w < 0.99 {
                texels.push((x, y));
            }
        }
    }
    texels
}

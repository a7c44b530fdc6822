//! The importer on small generated files, on thousands of damaged ones, and on real assets where present.

mod ascii;

use super::*;
use crate::animation::pose;
use crate::sound::{assert_sound, effort, exercise, is_sound_or_refused};
use crate::{Interpolation, LightKind, TrackValues};
use ascii::{Ascii, integer, list, moved_by, number, vector};
use glam::{Affine3A, Vec3};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use std::collections::HashMap;
use std::path::PathBuf;

const MESH: u32 = 100;
const BODY: u32 = 200;
const HIP: u32 = 210;
const STACK: u32 = 500;
const LAYER: u32 = STACK + 1;

/// A strip of two squares of 1 m, one above the other, in centimetres: points 0 to 5, two to a row.
const POINTS: [f64; 18] =
    [0., 0., 0., 100., 0., 0., 0., 100., 0., 100., 100., 0., 0., 200., 0., 100., 200., 25.];

fn strip(more: &str) -> String {
    let uv = |index: u32, name: &str, coordinates: &[f64]| {
        format!(
            "LayerElementUV: {index} {{\nVersion: 101\nName: \"{name}\"\nMappingInformationType: \"ByPolygonVertex\"\nReferenceInformationType: \"IndexToDirect\"\nUV: {}\nUVIndex: {}\n}}\n",
            list(coordinates),
            list(&[0, 1, 3, 2, 2, 3, 5, 4]),
        )
    };
    let layer = |index: u32, kinds: &[&str]| {
        let elements: String = kinds
            .iter()
            .map(|kind| format!("LayerElement:  {{\nType: \"LayerElement{kind}\"\nTypedIndex: {index}\n}}\n"))
            .collect();
        format!("Layer: {index} {{\nVersion: 100\n{elements}}}\n")
    };
    format!(
        "Vertices: {}\nPolygonVertexIndex: {}\nGeometryVersion: 124\n{}{}LayerElementMaterial: 0 {{\nVersion: 101\nName: \"\"\nMappingInformationType: \"ByPolygon\"\nReferenceInformationType: \"IndexToDirect\"\nMaterials: {}\n}}\n{}{}{more}",
        list(&POINTS),
        list(&[0, 1, 3, -3, 2, 3, 5, -5]),
        uv(0, "first", &[0., 0., 1., 0., 0., 0.5, 1., 0.5, 0., 1., 1., 1.]),
        uv(1, "second", &[0., 0., 2., 0., 0., 1., 2., 1., 0., 2., 2., 2.]),
        list(&[0, 1]),
        layer(0, &["UV", "Material"]),
        layer(1, &["UV"]),
    )
}

fn material(name: &str, properties: &str) -> String {
    let _ = name;
    format!("Version: 102\nShadingModel: \"phong\"\nMultiLayer: 0\nProperties70: {{\n{properties}}}")
}

/// One mesh of two squares with two materials.
fn plain() -> Ascii {
    let mut file = Ascii::new();
    file.object("Geometry", MESH, "Geometry::strip", "Mesh", &strip(""));
    file.model(BODY, "body", "Mesh", 0, "");
    file.connect(MESH, BODY);
    for (id, name, color) in [(600, "red", [0.5, 0.0, 0.0]), (601, "blue", [0.0, 0.0, 1.0])] {
        file.object(
            "Material",
            id,
            &format!("Material::{name}"),
            "",
            &material(name, &vector("DiffuseColor", color)),
        );
        file.connect(id, BODY);
    }
    file
}

/// Adds a skin: six bones in a chain, the first a root with a rotation order, a pre-rotation and a pivot, of which all
/// six pull at points 2 and 3, and none at points 0 and 1.
fn with_skin(mut file: Ascii) -> Ascii {
    file.object("Deformer", 300, "Deformer::skin", "Skin", "Version: 101\nLink_DeformAcuracy: 50");
    file.connect(300, MESH);
    for bone in 0..6 {
        let id = HIP + bone;
        let special = integer("RotationOrder", 4)
            + &vector("PreRotation", [10., 20., 30.])
            + &vector("RotationPivot", [0., 5., 0.]);
        let place = vector("Lcl Translation", [0.0, if bone == 0 { 50.0 } else { 20.0 }, 0.0]);
        let parent = if bone == 0 { 0 } else { id - 1 };
        let properties = place + &integer("RotationActive", 1) + if bone == 0 { &special } else { "" };
        file.model(id, &format!("bone {bone}"), "LimbNode", parent, &properties);
        let weights = [0.05, 0.1, 0.15, 0.2, 0.24, 0.26];
        let (points, weights) = match bone {
            5 => (vec![2, 3, 4, 5], vec![weights[5], weights[5], 1.0, 1.0]),
            _ => (vec![2, 3], vec![weights[bone as usize]; 2]),
        };
        let height = 50.0 + 20.0 * f64::from(bone);
        let body = format!(
            "Version: 100\nIndexes: {}\nWeights: {}\nTransform: {}\nTransformLink: {}",
            list(&points),
            list(&weights),
            moved_by([0.0, -height, 0.0]),
            moved_by([0.0, height, 0.0])
        );
        file.object("Deformer", 310 + bone, "SubDeformer::", "Cluster", &body);
        file.connect(310 + bone, 300);
        file.connect(id, 310 + bone);
    }
    file
}

/// Adds one channel of two shapes: half of the way point 4 moves by x, at the end by y.
fn with_shapes(mut file: Ascii) -> Ascii {
    file.object("Deformer", 400, "Deformer::shapes", "BlendShape", "Version: 100");
    file.connect(400, MESH);
    let channel = format!("Version: 100\nDeformPercent: 0\nFullWeights: {}", list(&[50, 100]));
    file.object("Deformer", 401, "SubDeformer::smile", "BlendShapeChannel", &channel);
    file.connect(401, 400);
    for (id, offset) in [(402, [30., 0., 0.]), (403, [0., 40., 10.])] {
        let body = format!(
            "Version: 100\nIndexes: {}\nVertices: {}\nNormals: {}",
            list(&[4]),
            list(&offset),
            list(&[0, 0, 0])
        );
        file.object("Geometry", id, "Geometry::shape", "Shape", &body);
        file.connect(id, 401);
    }
    file
}

/// Adds a stack from 1 s to 3 s that turns, shifts, stretches and blends.
fn with_animation(mut file: Ascii) -> Ascii {
    file.stack(STACK, "wave", [1.0, 3.0]);
    let turn: &[(f64, f64)] = &[(0.5, -20.0), (1.5, 70.0), (3.5, -40.0)];
    file.animate(
        510,
        (LAYER, HIP, "Lcl Rotation"),
        4,
        &[("d|X", turn), ("d|Z", &[(1.0, 0.0), (3.0, 120.0)])],
    );
    file.animate(
        520,
        (LAYER, HIP + 2, "Lcl Rotation"),
        8,
        &[("d|Y", &[(1.0, 0.0), (1.7, 90.0), (3.0, -30.0)])],
    );
    file.animate(
        530,
        (LAYER, HIP + 1, "Lcl Translation"),
        2,
        &[("d|Y", &[(1.0, 20.0), (2.0, 35.0), (2.5, 25.0)])],
    );
    file.animate(540, (LAYER, HIP + 3, "Lcl Scaling"), 4, &[("d|X", &[(1.0, 1.0), (3.0, 1.5)])]);
    file.animate(
        550,
        (LAYER, 401, "DeformPercent"),
        4,
        &[("d|DeformPercent", &[(1.0, -20.0), (2.0, 120.0), (3.0, 0.0)])],
    );
    file
}

/// All of it.
fn sample() -> Ascii {
    with_animation(with_shapes(with_skin(plain())))
}

#[track_caller]
fn load_text(file: &Ascii) -> (Model, Warnings) {
    let text = file.text();
    let loaded =
        import(text.as_bytes(), "sample", &Surroundings::default()).map_err(|fault| fault.in_file("sample"));
    let (model, warnings) = loaded.unwrap_or_else(|error| panic!("{error}\n{text}"));
    assert_sound(&model, "sample");
    exercise(&model);
    (model, warnings)
}

/// The vertices in the rest pose.
fn rest(model: &Model) -> Vec<pose::SkinnedVertex> {
    pose::skin(&model.vertices, &pose::source_palette(model, None, 0.0), Affine3A::IDENTITY)
}

#[track_caller]
fn assert_place(model: &Model, wanted: Vec3) {
    let places: Vec<Vec3> = rest(model).iter().map(|vertex| vertex.position).collect();
    assert!(places.iter().any(|place| place.distance(wanted) < 1e-5), "{wanted} is not among {places:?}");
}

/// Triangles must be counter-clockwise seen from where their normals point.
#[track_caller]
fn assert_outside_is_outside(model: &Model) {
    let vertices = rest(model);
    for triangle in model.indices.chunks_exact(3) {
        let [a, b, c] = [0, 1, 2].map(|corner| vertices[triangle[corner] as usize]);
        let geometric = (b.position - a.position).cross(c.position - a.position);
        assert!(geometric.dot(a.normal) > 0.0, "normal {} against the winding's {geometric}", a.normal);
    }
}

#[test]
fn polygons_become_triangles_by_material_in_metres() {
    let (model, warnings) = load_text(&plain());
    assert!(warnings.is_empty(), "{warnings:?}");
    let counts: Vec<u32> = model.primitives.iter().map(|primitive| primitive.index_count).collect();
    assert_eq!(counts, [6, 6]);
    let names: Vec<&str> = model.materials.iter().map(|material| material.name.as_str()).collect();
    assert_eq!(names, ["red", "blue"]);
    assert_eq!(model.materials[0].base_color, [0.5, 0.0, 0.0, 1.0]);
    assert!(
        model.vertices.iter().any(|vertex| vertex.position == Vec3::new(1.0, 2.0, 0.25)),
        "mesh space is in metres"
    );
    assert_place(&model, Vec3::new(1.0, 2.0, 0.25));
    assert_outside_is_outside(&model);
}

#[test]
fn two_sets_of_texture_coordinates_run_downwards() {
    let (model, _) = load_text(&plain());
    let at = |x: f32, y: f32| {
        model.vertices.iter().find(|v| v.position.truncate() == glam::Vec2::new(x, y)).expect("vertex")
    };
    assert_eq!((at(1.0, 0.0).uv, at(1.0, 0.0).uv1), ([1.0, 1.0], [2.0, 1.0]));
    assert_eq!((at(0.0, 2.0).uv, at(0.0, 2.0).uv1), ([0.0, 0.0], [0.0, -1.0]));
}

#[test]
fn axes_and_units_of_the_file_become_metres_with_y_up() {
    let mut file = plain();
    // Inches, z up, and the front towards -y, as 3ds Max has it.
    file.settings = number("UnitScaleFactor", 2.54)
        + &integer("UpAxis", 2)
        + &integer("UpAxisSign", 1)
        + &integer("FrontAxis", 1)
        + &integer("FrontAxisSign", -1)
        + &integer("CoordAxis", 0)
        + &integer("CoordAxisSign", 1);
    let (model, _) = load_text(&file);
    assert_place(&model, Vec3::new(2.54, 0.25 * 2.54, -2.0 * 2.54));
    assert_outside_is_outside(&model);
}

#[test]
fn left_handed_files_keep_their_outside_outside() {
    let mut file = plain();
    file.settings = file.settings.replace(
        "\"CoordAxisSign\", \"int\", \"Integer\", \"\",1",
        "\"CoordAxisSign\", \"int\", \"Integer\", \"\",-1",
    );
    assert!(file.settings.contains(",-1"));
    let (model, _) = load_text(&file);
    assert_outside_is_outside(&model);
    assert_place(&model, Vec3::new(-1.0, 2.0, 0.25));
}

#[test]
fn mirrored_node_and_geometric_transform_count() {
    let mut file = plain();
    let place = vector("Lcl Scaling", [-1., 1., 1.])
        + &vector("GeometricTranslation", [0., 0., 300.])
        + &vector("Lcl Translation", [0., 10., 0.]);
    file.objects = file
        .objects
        .replace("Version: 232\nProperties70: {\n", &format!("Version: 232\nProperties70: {{\n{place}"));
    let (model, _) = load_text(&file);
    assert_place(&model, Vec3::new(-1.0, 2.1, 3.25));
    assert_outside_is_outside(&model);
}

#[test]
fn mesh_shown_by_two_nodes_is_placed_twice() {
    let mut file = plain();
    file.model(BODY + 1, "twin", "Mesh", BODY, &vector("Lcl Translation", [0., 0., 500.]));
    file.connect(MESH, BODY + 1);
    let (model, _) = load_text(&file);
    assert_eq!((model.primitives.len(), model.palette.len()), (4, 2));
    // The twin has no materials of its own.
    assert_place(&model, Vec3::new(1.0, 2.0, 5.25));
}

#[test]
fn hidden_nodes_and_what_hangs_on_them_are_not_drawn() {
    let mut file = plain();
    file.model(BODY + 1, "twin", "Mesh", BODY, "");
    file.connect(MESH, BODY + 1);
    let hidden = |file: &Ascii, name: &str| {
        let mut file = file.clone();
        let start = format!("\"Model::{name}\", \"Mesh\" {{\nVersion: 232\nProperties70: {{\n");
        assert!(file.objects.contains(&start));
        let property = "P: \"Visibility\", \"Visibility\", \"\", \"A\",0\n";
        file.objects = file.objects.replace(&start, &format!("{start}{property}"));
        load_text(&file).0.primitives.len()
    };
    assert_eq!((hidden(&file, "twin"), hidden(&file, "body")), (2, 0));
}

#[test]
fn influences_are_reduced_to_four() {
    let (model, _) = load_text(&with_skin(plain()));
    let at = |x: f32, y: f32| {
        model.vertices.iter().find(|v| v.position.truncate() == glam::Vec2::new(x, y)).expect("vertex")
    };
    let middle = at(0.0, 1.0);
    let bones =
        middle.joints.map(|joint| model.bones[model.palette[joint as usize].bone as usize].name.clone());
    assert_eq!(bones, ["bone 5", "bone 4", "bone 3", "bone 2"]);
    for (weight, of) in middle.weights.iter().zip([0.26, 0.24, 0.2, 0.15]) {
        assert!((weight - of / 0.85).abs() < 1e-6, "{:?}", middle.weights);
    }
    let foot = at(0.0, 0.0);
    assert_eq!(model.bones[model.palette[foot.joints[0] as usize].bone as usize].name, "body");
}

#[test]
fn clip_starts_at_0_and_a_stepped_curve_stays_one() {
    let (model, _) = load_text(&sample());
    let [clip] = &model.clips[..] else { panic!("{:?}", model.clips) };
    assert_eq!((clip.name.as_str(), clip.duration_s), ("wave", 2.0));
    let bone = model.bones.iter().position(|bone| bone.name == "bone 1").expect("bone 1") as u32;
    let steps = clip.tracks.iter().find(|track| track.bone == bone).expect("its track");
    assert_eq!((steps.interpolation, &steps.times_s[..3]), (Interpolation::Step, &[0.0, 1.0, 1.5][..]));
    let TrackValues::Translation(values) = &steps.values else { panic!("{steps:?}") };
    assert!([0.2, 0.35, 0.25].iter().zip(values).all(|(y, value)| (value.y - y).abs() < 1e-6), "{values:?}");
}

#[test]
fn curves_skins_and_in_between_shapes_equal_the_library() {
    let mut file = sample();
    // Four influences at most, so that nothing is approximated: the two weakest clusters let go of points 2 and 3.
    for weight in ["0.05,0.05", "0.1,0.1"] {
        assert!(file.objects.contains(weight));
        file.objects = file.objects.replace(weight, "0,0");
    }
    let scene =
        parse(file.text().as_bytes(), &Cancel::default()).map_err(|fault| fault.problem).expect("parses");
    let (model, _) = load_text(&file);
    assert_eq!(model.morphs.len(), 2);
    let moments = (0..=100).map(|moment| f64::from(moment) * 0.02);
    // Within a step's millisecond the library is between the two.
    let moments = moments.filter(|t_s| [1.0, 1.5].iter().all(|step| (t_s - step).abs() > 2e-3));
    let worst = moments.map(|t_s| largest_skinning_error_m(&scene, &model, 0, t_s)).fold(0.0, f32::max);
    assert!(worst < 1e-4, "{worst} m");
    let at = |t_s: f64| pose::source_skin(&model, Some(0), t_s, Affine3A::IDENTITY);
    let moved = at(0.0).iter().zip(at(1.0)).map(|(a, b)| a.position.distance(b.position)).fold(0.0, f32::max);
    assert!(moved > 0.3, "{moved} m");
}

#[test]
fn layers_and_uninherited_scale_equal_the_library() {
    let mut file = sample();
    // A second, additive layer; bone 3 (which is stretched) does not hand its scale on to bone 4.
    file.object(
        "AnimationLayer",
        STACK + 2,
        "AnimLayer::more",
        "",
        "Properties70: {\nP: \"Weight\", \"Number\", \"\", \"A\",50\n}",
    );
    file.connect(STACK + 2, STACK);
    file.animate(560, (STACK + 2, HIP, "Lcl Rotation"), 4, &[("d|X", &[(1.0, 0.0), (3.0, 50.0)])]);
    let child = "\"Model::bone 4\", \"LimbNode\" {\nVersion: 232\nProperties70: {\n";
    assert!(file.objects.contains(child));
    file.objects =
        file.objects.replace(child, &format!("{child}P: \"InheritType\", \"enum\", \"\", \"\",2\n"));
    for weight in ["0.05,0.05", "0.1,0.1"] {
        file.objects = file.objects.replace(weight, "0,0");
    }
    let scene =
        parse(file.text().as_bytes(), &Cancel::default()).map_err(|fault| fault.problem).expect("parses");
    let (model, _) = load_text(&file);
    let moments = (0..=40).map(|moment| f64::from(moment) * 0.0497);
    let worst = moments.map(|t_s| largest_skinning_error_m(&scene, &model, 0, t_s)).fold(0.0, f32::max);
    assert!(worst < 1e-4, "{worst} m");
}

#[test]
fn weights_of_shapes_in_between_bend_where_one_is_fully_there() {
    let channel = morph::Channel { element_id: 0, first_morph: 0, targets: vec![0.5, 1.0] };
    for (weight, expected) in [
        (0.0, [0.0, 0.0]),
        (0.25, [0.5, 0.0]),
        (0.5, [1.0, 0.0]),
        (0.75, [0.5, 0.5]),
        (1.5, [-1.0, 2.0]),
        (-0.5, [-1.0, 0.0]),
    ] {
        assert_eq!(channel.weights(weight), expected, "{weight}");
    }
    let (model, _) = load_text(&sample());
    let [track] = &model.clips[0].morph_tracks[..] else { panic!("one track") };
    assert_eq!((track.first_morph, track.morph_count), (0, 2));
    let full = track.weights.chunks_exact(2).filter(|weights| *weights == [1.0, 0.0]).count();
    assert_eq!(full, 2, "up and down again through the first shape: {:?}", track.weights);
}

#[test]
fn shape_without_normals_turns_them_with_its_surface() {
    let (model, warnings) = load_text(&sample());
    assert!(warnings.iter().any(|warning| warning.contains("blend shapes without normals")), "{warnings:?}");
    let last = &model.morphs[1];
    assert!(
        !last.deltas.is_empty() && last.deltas.iter().all(|delta| delta.normal.length() > 0.01),
        "{last:?}"
    );
    for delta in &last.deltas {
        let normal = model.vertices[delta.vertex as usize].normal + delta.normal;
        assert!((normal.length() - 1.0).abs() < 1e-4, "{normal}");
    }
}

// ---- materials ----

fn png(width: u32, color: [u8; 3]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, width, width);
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header().expect("header");
    writer.write_image_data(&color.repeat((width * width) as usize)).expect("data");
    writer.finish().expect("end");
    out
}

fn base64(bytes: &[u8]) -> String {
    let letters = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::new();
    for three in bytes.chunks(3) {
        let word = (0..3).fold(0u32, |word, at| word << 8 | u32::from(three.get(at).copied().unwrap_or(0)));
        let letter = |at: usize| char::from(letters[(word >> (18 - 6 * at) & 63) as usize]);
        text.extend((0..4).map(|at| if at <= three.len() { letter(at) } else { '=' }));
    }
    text
}

/// Puts a texture on a property of material 600; its content is embedded where given.
fn add_texture(file: &mut Ascii, id: u32, property: &str, name: &str, more: &str, content: Option<&[u8]>) {
    let names = format!("FileName: \"C:\\somewhere\\{name}\"\nRelativeFilename: \"maps\\{name}\"");
    file.object(
        "Texture",
        id,
        &format!("Texture::{name}"),
        "",
        &format!("Type: \"TextureVideoClip\"\nVersion: 202\n{names}\n{more}"),
    );
    let content = content.map_or(String::new(), |content| format!("\nContent: , \"{}\"", base64(content)));
    file.object("Video", id + 1, "Video::v", "Clip", &format!("Type: \"Clip\"\n{names}{content}"));
    file.connect(id + 1, id);
    file.connect_to_property(id, 600, property);
}

#[test]
fn embedded_textures_take_the_place_of_colours() {
    let mut file = plain();
    let second = "Properties70: {\nP: \"UVSet\", \"KString\", \"\", \"\", \"second\"\n}";
    add_texture(&mut file, 700, "DiffuseColor", "a.png", second, Some(&png(2, [1, 2, 3])));
    add_texture(&mut file, 710, "NormalMap", "n.png", "", Some(&png(2, [128, 128, 255])));
    let (model, warnings) = load_text(&file);
    assert!(warnings.is_empty(), "{warnings:?}");
    let red = &model.materials[0];
    assert_eq!(red.base_color, [1.0; 4]);
    let (base, normal) = (red.base_color_texture.expect("base"), red.normal_texture.expect("normal"));
    assert_eq!((base.set, normal.set), (1, 0));
    assert_eq!(model.textures[base.texture as usize].rgba8[..4], [1, 2, 3, 255]);
    assert!(model.textures[base.texture as usize].srgb && !model.textures[normal.texture as usize].srgb);
    // The strip lies as a picture in glTF does: u to the right, v down.
    let first = &model.indices[..6];
    assert!(first.iter().all(|index| model.vertices[*index as usize].tangent[0] > 0.9));
}

#[test]
fn missing_textures_cost_a_warning() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut file = plain();
    add_texture(&mut file, 700, "DiffuseColor", "a.png", "", None);
    add_texture(&mut file, 710, "EmissiveColor", "gone.png", "", None);
    std::fs::create_dir(folder.path().join("maps")).expect("create");
    std::fs::write(folder.path().join("maps/a.png"), png(2, [9, 8, 7])).expect("write");
    let around = Surroundings::of(&folder.path().join("x.fbx"), &Cancel::default());
    let (model, warnings) =
        import(file.text().as_bytes(), "beside", &around).map_err(|fault| fault.problem).expect("loads");
    assert_eq!(model.textures[0].rgba8[..3], [9, 8, 7]);
    assert_eq!(model.materials[0].emissive_texture, None);
    let [warning] = &warnings.iter().collect::<Vec<_>>()[..] else { panic!("{warnings:?}") };
    assert!(warning.contains("gone.png'") && warning.contains("drawn without it"), "{warning}");
    // At its mere name too.
    std::fs::rename(folder.path().join("maps/a.png"), folder.path().join("a.png")).expect("rename");
    std::fs::write(folder.path().join("x.fbx"), file.text()).expect("write");
    assert_eq!(load(&folder.path().join("x.fbx")).expect("loads").textures.len(), 1);
    let (_, warnings) = import(file.text().as_bytes(), "memory", &Surroundings::default())
        .map_err(|fault| fault.problem)
        .expect("loads");
    assert_eq!(warnings.iter().filter(|warning| warning.contains("not in a folder")).count(), 2);
}

/// A picture that lies outside the asset's folder is not read, by whatever name; beside it is.
#[cfg(unix)]
#[test]
fn textures_outside_the_assets_folder_are_not_read() {
    let top = tempfile::tempdir().expect("a folder");
    let asset = top.path().join("asset");
    std::fs::create_dir(&asset).expect("made");
    std::fs::write(top.path().join("secret.png"), png(2, [1, 2, 3])).expect("written");
    std::os::unix::fs::symlink("../secret.png", asset.join("link.png")).expect("linked");
    let around = Surroundings::of(&asset.join("x.fbx"), &Cancel::default());
    let load_with = |name: &str| {
        let mut file = plain();
        add_texture(&mut file, 700, "DiffuseColor", "placeholder.png", "", None);
        let text = file.text().replace("placeholder.png", name).replace("maps\\", "").replace("maps/", "");
        import(text.as_bytes(), "outside", &around).map_err(|fault| fault.problem).expect("loads")
    };
    let absolute = top.path().join("secret.png").to_string_lossy().into_owned();
    for name in [&absolute, "../secret.png", "..\\secret.png", "../asset/../secret.png", "link.png"] {
        let (model, warnings) = load_with(name);
        assert_eq!(model.textures.len(), 0, "{name}");
        assert!(warnings.iter().any(|warning| warning.contains("drawn without it")), "{name}: {warnings:?}");
    }
    std::fs::copy(top.path().join("secret.png"), asset.join("secret.png")).expect("copied");
    assert_eq!(load_with("../secret.png").0.textures.len(), 1, "its mere name is beside the asset");
}

#[test]
fn roughness_and_metalness_become_one_texture() {
    let mut file = plain();
    file.creator = "Blender (stable FBX IO) - 2.93.0 - 4.22.1";
    add_texture(&mut file, 700, "ShininessExponent", "rough.png", "", Some(&png(4, [100, 100, 100])));
    add_texture(&mut file, 710, "ReflectionFactor", "metal.png", "", Some(&png(2, [200, 200, 200])));
    let (model, _) = load_text(&file);
    let red = &model.materials[0];
    let texture = &model.textures[red.metallic_roughness_texture.expect("a texture").texture as usize];
    assert_eq!((texture.extent_texels, &texture.rgba8[1..3], texture.srgb), ([4, 4], &[100, 200][..], false));
    assert_eq!((red.roughness, red.metallic), (1.0, 1.0));
}

#[test]
fn texture_transforms_are_flipped_with_their_coordinates() {
    let mut file = plain();
    let moved = "Properties70: {\nP: \"Translation\", \"Vector\", \"\", \"A\",0.25,0.5,0\nP: \"Scaling\", \"Vector\", \"\", \"A\",2,3,1\n}";
    add_texture(&mut file, 700, "DiffuseColor", "a.png", moved, Some(&png(2, [1, 2, 3])));
    let scene =
        parse(file.text().as_bytes(), &Cancel::default()).map_err(|fault| fault.problem).expect("parses");
    let (model, _) = load_text(&file);
    let [row_u, row_v] = model.materials[0].base_color_texture.expect("base").uv_transform;
    for (u, v) in [(0.0, 0.0), (1.0, 0.0), (0.3, 0.7)] {
        let up = ufbx::Vec3 { x: u, y: 1.0 - v, z: 0.0 };
        let expected = ufbx::transform_position(&scene.textures[0].uv_to_texture, up);
        let found =
            [row_u, row_v].map(|row| f64::from(row[0]) * u + f64::from(row[1]) * v + f64::from(row[2]));
        assert!(
            (found[0] - expected.x).abs() < 1e-6 && (found[1] - (1.0 - expected.y)).abs() < 1e-6,
            "{found:?}"
        );
    }
    assert_ne!(row_u, [1.0, 0.0, 0.0]);
}

// ---- lights and skeletons ----

#[test]
fn spot_light_shines_where_the_file_lets_it() {
    let mut file = plain();
    let properties = integer("LightType", 2)
        + &number("Intensity", 200.0)
        + &number("OuterAngle", 90.0)
        + &number("InnerAngle", 60.0)
        + &vector("Color", [1.0, 0.5, 0.0]);
    file.object(
        "NodeAttribute",
        800,
        "NodeAttribute::lamp",
        "Light",
        &format!("Properties70: {{\n{properties}}}"),
    );
    // FBX lights shine along -y: turned by 90 degrees about x, along -z.
    file.model(801, "lamp", "Light", 0, &vector("Lcl Rotation", [90., 0., 0.]));
    file.connect(800, 801);
    let (model, _) = load_text(&file);
    let [light] = &model.lights[..] else { panic!("one light") };
    let globals = pose::global_pose(&model, &pose::source_pose(&model, None, 0.0));
    let along = globals[light.bone as usize].transform_vector3(Vec3::NEG_Z);
    assert!(along.abs_diff_eq(Vec3::NEG_Z, 1e-5), "{along}");
    let LightKind::Spot { inner_cone_rad, outer_cone_rad } = light.light.kind else { panic!("{light:?}") };
    assert!(
        (inner_cone_rad - 30f32.to_radians()).abs() < 1e-5
            && (outer_cone_rad - 45f32.to_radians()).abs() < 1e-5
    );
    assert!(light.light.intensity.abs_diff_eq(Vec3::new(1.0, 0.5, 0.0) * std::f32::consts::TAU, 1e-5));
}

#[test]
fn skeleton_without_a_mesh_is_shown_as_its_bones() {
    let mut file = Ascii::new();
    file.model(HIP, "hip", "LimbNode", 0, "");
    file.model(HIP + 1, "knee", "LimbNode", HIP, &vector("Lcl Translation", [0., -40., 3.]));
    file.model(HIP + 2, "foot", "LimbNode", HIP + 1, &vector("Lcl Translation", [0., -50., 0.]));
    let (model, warnings) = load_text(&file);
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert_eq!(model.indices.len(), 2 * 8 * 3);
    assert_place(&model, Vec3::new(0.0, -0.9, 0.03));
    assert_outside_is_outside(&model);
}

// ---- damaged files ----

#[test]
fn faults_name_the_element_and_what_to_do() {
    let message = |bytes: &[u8]| from_slice(bytes, "bad.fbx").expect_err("a fault").to_string();
    for (bytes, expected) in [(&b""[..], "bad.fbx: FBX document: "), (b"glTF", "bad.fbx: FBX document: ")] {
        let found = message(bytes);
        assert!(found.starts_with(expected) && found.contains("export it again"), "{found}");
    }
    let mut file = plain();
    file.objects = file.objects.replacen("100,200,25", "100,200,1e60", 1);
    let found = message(file.text().as_bytes());
    assert!(
        found.contains("mesh 'strip' on node 1 'body': control point 5 is not a finite position"),
        "{found}"
    );
    let mut file = plain();
    file.objects = file.objects.replacen(
        "Properties70: {\n",
        &format!("Properties70: {{\n{}", vector("Lcl Scaling", [7., 1., 1.]).replace("7,1", "1e60,1")),
        1,
    );
    let found = message(file.text().as_bytes());
    assert!(found.contains("node 1 'body': its transform is not finite"), "{found}");
    let mut file = sample();
    file.objects =
        file.objects.replacen(&(3 * ascii::TICKS).to_string(), &(300_000 * ascii::TICKS).to_string(), 1);
    let found = message(file.text().as_bytes());
    assert!(found.contains("animation 'wave': lasts 299999 s; 0 to 86400 s are supported"), "{found}");
}

fn load_damaged(bytes: &[u8], context: &str) -> bool {
    is_sound_or_refused(from_slice(bytes, "damaged.fbx"), "damaged.fbx", context)
}

fn mutate_bytes(bytes: &[u8], count: u32, seed: u64) -> (u32, u32) {
    let (mut loaded, mut refused) = (0, 0);
    for seed in (seed..).take((count * effort()) as usize) {
        let mut rng = SmallRng::seed_from_u64(seed);
        let mut damaged = bytes.to_vec();
        for _ in 0..rng.random_range(1..=6) {
            let at = rng.random_range(0..damaged.len());
            match rng.random_range(0..4) {
                0 => damaged[at] ^= 1 << rng.random_range(0..8),
                1 => damaged[at] = rng.random(),
                2 => damaged[at] = [0, 0xff, 0x7f, 0x80, b'9', b'-', b'e'][rng.random_range(0..7)],
                _ => {
                    let word = [f64::NAN.to_bits(), f64::MAX.to_bits(), u64::MAX, 0][rng.random_range(0..4)]
                        .to_le_bytes();
                    let end = (at + rng.random_range(1..=8)).min(damaged.len());
                    damaged[at..end].copy_from_slice(&word[..end - at]);
                }
            }
        }
        if rng.random_bool(0.1) {
            damaged.truncate(rng.random_range(0..damaged.len()));
        }
        if load_damaged(&damaged, &format!("seed {seed}")) { loaded += 1 } else { refused += 1 }
    }
    (loaded, refused)
}

/// Replaces numbers of the text by others, which gets past the parser.
fn mutate_numbers(text: &str, count: u32, seed: u64) -> (u32, u32) {
    let words: Vec<&str> = text.split_inclusive([',', '\n', ' ']).collect();
    let is_number = |word: &str| word.trim_end_matches([',', '\n', ' ']).parse::<f64>().is_ok();
    let numbers: Vec<usize> = (0..words.len()).filter(|at| is_number(words[*at])).collect();
    let values = [
        "0",
        "-1",
        "1",
        "2",
        "3",
        "7",
        "65536",
        "4294967295",
        "-2147483648",
        "1e39",
        "1e308",
        "nan",
        "inf",
        "-0.5",
        "300",
        "500",
    ];
    let (mut loaded, mut refused) = (0, 0);
    for seed in (seed..).take((count * effort()) as usize) {
        let mut rng = SmallRng::seed_from_u64(seed);
        let mut changed: Vec<String> = words.iter().map(|word| (*word).to_owned()).collect();
        for _ in 0..rng.random_range(1..=3) {
            let word = &mut changed[numbers[rng.random_range(0..numbers.len())]];
            let end = word.trim_end_matches([',', '\n', ' ']).len();
            word.replace_range(..end, values[rng.random_range(0..values.len())]);
        }
        if load_damaged(changed.concat().as_bytes(), &format!("number seed {seed}")) {
            loaded += 1
        } else {
            refused += 1
        }
    }
    (loaded, refused)
}

#[test]
fn damaged_text_gives_a_sound_model_or_an_error() {
    let mut file = sample();
    add_texture(&mut file, 700, "DiffuseColor", "a.png", "", Some(&png(2, [1, 2, 3])));
    let (by_bytes, by_numbers) =
        (mutate_bytes(file.text().as_bytes(), 400, 1_000_000), mutate_numbers(&file.text(), 1200, 2_000_000));
    eprintln!("loaded and refused {by_bytes:?} by bytes, {by_numbers:?} by numbers");
    assert!(by_numbers.0 > 100 && by_numbers.1 > 5, "{by_numbers:?}");
}

#[test]
fn every_truncation_gives_a_sound_model_or_an_error() {
    let text = plain().text();
    for length in (0..text.len()).step_by(7) {
        load_damaged(&text.as_bytes()[..length], &format!("{length} bytes"));
    }
}

#[test]
fn damaged_real_assets_give_a_sound_model_or_an_error() {
    for (index, name) in REAL.iter().enumerate() {
        let Some(bytes) = real(name) else { return };
        let counts = mutate_bytes(&bytes, 60, 3_000_000 + 100_000 * index as u64);
        eprintln!("{name}: loaded and refused {counts:?}");
    }
}

// ---- real assets ----

const REAL: [&str; 2] = ["maya_human_ik_7400_binary.fbx", "maya_game_sausage_7500_binary_combined.fbx"];

/// The bytes of a real asset, where it is there.
fn real(name: &str) -> Option<Vec<u8>> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets").join(name);
    if !path.is_file() {
        eprintln!("SKIPPED: {} does not exist", path.display());
        return None;
    }
    Some(std::fs::read(path).expect("readable"))
}

#[test]
fn all_real_assets_load() {
    for name in REAL {
        let Some(bytes) = real(name) else { return };
        let (model, warnings) = import(&bytes, name, &Surroundings::default())
            .map_err(|fault| fault.in_file(name))
            .expect("loads");
        assert_sound(&model, name);
        exercise(&model);
        print_statistics(&model, &warnings);
        assert!(!model.indices.is_empty(), "{name}");
    }
}

/// A skeleton as tall as a human, upright.
#[test]
fn real_skeleton_stands_upright_at_its_size() {
    let Some(bytes) = real(REAL[0]) else { return };
    let model = from_slice(&bytes, REAL[0]).expect("loads");
    let (low, high) = pose::bounds(&model, None, 1).expect("bones");
    let extent = high - low;
    eprintln!("from {low} to {high}");
    assert!((1.2..2.2).contains(&extent.y) && extent.y > 2.0 * extent.z, "{extent} m");
}

/// The sausage has three stacks, one after the other on one time line; the human has neither meshes nor curves.
#[test]
fn real_animation_moves_a_skin_of_plausible_size_from_time_0() {
    let Some(bytes) = real(REAL[1]) else { return };
    let model = from_slice(&bytes, REAL[1]).expect("loads");
    let names: Vec<&str> = model.clips.iter().map(|clip| clip.name.as_str()).collect();
    assert_eq!(names, ["wiggle", "spin", "deform"]);
    for (index, clip) in model.clips.iter().enumerate() {
        assert!((0.79..0.84).contains(&clip.duration_s), "'{}' lasts {} s", clip.name, clip.duration_s);
        let moving =
            pose::animated_vertices(&model, Some(index)).into_iter().filter(|moving| *moving).count();
        assert!(moving * 2 > model.vertices.len(), "'{}' moves {moving} vertices", clip.name);
    }
    let (low, high) = pose::bounds(&model, None, 1).expect("vertices");
    // Modelled as 4 units of a centimetre.
    let extent = (high - low).max_element();
    assert!((0.02..0.06).contains(&extent), "{extent} m");
}

fn print_statistics(model: &Model, warnings: &Warnings) {
    for (index, clip) in model.clips.iter().enumerate() {
        let keys: usize = clip.tracks.iter().map(|track| track.times_s.len()).sum();
        let (low, high) = pose::bounds(model, Some(index), 8).expect("vertices");
        eprintln!(
            "    clip '{}' {:.3} s, {} tracks, {keys} keys, {} morph tracks, from {low:.2} to {high:.2}",
            clip.name,
            clip.duration_s,
            clip.tracks.len(),
            clip.morph_tracks.len()
        );
    }
    eprintln!(
        "{}: {} vertices, {} triangles, {} bones, {} palette entries, {} primitives, {} morphs, materials {:?}, {} lights, warnings {warnings:?}",
        model.name,
        model.vertices.len(),
        model.indices.len() / 3,
        model.bones.len(),
        model.palette.len(),
        model.primitives.len(),
        model.morphs.len(),
        model.materials,
        model.lights.len(),
    );
}

/// Largest distance in metres between the vertices of a model at a time of a clip and what the library's own evaluation
/// of the original curves, blend shapes and skins gives. Model vertices are found in the file by their place in mesh
/// space; of control points at one place the nearest counts.
#[track_caller]
fn largest_skinning_error_m(scene: &ufbx::Scene, model: &Model, clip: usize, t_s: f64) -> f32 {
    let stack = &scene.anim_stacks[clip];
    let options = ufbx::EvaluateOpts { evaluate_skinning: true, ..ufbx::EvaluateOpts::default() };
    let evaluated =
        ufbx::evaluate_scene(scene, &stack.anim, stack.anim.time_begin + t_s, options).expect("evaluates");
    let mut places: HashMap<[u32; 3], Vec<Vec3>> = HashMap::new();
    for mesh in &evaluated.meshes {
        for (rest, skinned) in mesh.vertices.iter().zip(&*mesh.skinned_position.values) {
            let node = &mesh.element.instances[0];
            let to_world = if mesh.skinned_is_local {
                affine(&node.geometry_to_world).expect("finite")
            } else {
                Affine3A::IDENTITY
            };
            let world = to_world.transform_point3(convert::vec3(*skinned));
            places.entry(convert::vec3(*rest).to_array().map(f32::to_bits)).or_default().push(world);
        }
    }
    let palette = pose::source_palette(model, Some(clip), t_s);
    let vertices = pose::morphed(model, &pose::source_morph_weights(model, Some(clip), t_s));
    let skinned = pose::skin(&vertices, &palette, Affine3A::IDENTITY);
    let error = |(vertex, skinned): (&crate::Vertex, &pose::SkinnedVertex)| {
        let candidates = &places[&vertex.position.to_array().map(f32::to_bits)];
        candidates.iter().map(|place| place.distance(skinned.position)).fold(f32::INFINITY, f32::min)
    };
    model.vertices.iter().zip(&skinned).map(error).fold(0.0, f32::max)
}

#[test]
fn skinned_vertices_are_where_the_library_itself_puts_them() {
    for name in REAL {
        let Some(bytes) = real(name) else { return };
        let (scene, model) = (
            parse(&bytes, &Cancel::default()).map_err(|f| f.problem).expect("parses"),
            from_slice(&bytes, name).expect("loads"),
        );
        for (clip, source) in model.clips.iter().enumerate() {
            let (low, high) = pose::bounds(&model, Some(clip), 8).expect("vertices");
            let extent = (high - low).max_element();
            let worst = (0..=40).map(|moment| f64::from(moment) / 40.0 * f64::from(source.duration_s));
            let worst =
                worst.map(|t_s| largest_skinning_error_m(&scene, &model, clip, t_s)).fold(0.0, f32::max);
            eprintln!("{name} '{}': {:.4} mm of {extent:.2} m", source.name, worst * 1e3);
            assert!(worst < 1e-3 * extent, "{name} '{}': {worst} m of {extent} m", source.name);
        }
    }
}

#[test]
fn an_import_ends_wherever_it_is_asked_to() {
    let text = sample().text();
    let import_until = |cancel| import(text.as_bytes(), "sample", &Surroundings { folder: None, cancel });
    let mut looks = 0;
    while let Err(fault) = import_until(Cancel::at_look(looks)) {
        assert!(matches!(fault.in_file("x"), SceneError::Cancelled(_)), "look {looks}");
        looks += 1;
    }
    assert!(looks > 5, "looked {looks} times");
}

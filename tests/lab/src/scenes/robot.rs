//! A stiff character for measurements: boxes, each bound to one joint of a skin, that walk by linear keys 24 times a second
//! with wide steps from key to key. Nothing bends and nothing is smoothed, so corners of the curves appear in every vertex.

use glam::{Mat4, Quat, Vec3, Vec4};
use serde_json::{Value, json};
use shadecast_dragon::glb::{Buffer, Target};

/// Keys per second.
const KEYS_PER_S: f32 = 24.0;
/// Keys of the clip, the last as the first: two seconds, two strides each.
const KEYS: usize = 49;
/// Strides per second.
const STRIDES_PER_S: f32 = 1.0;
const NODE_OF_MESH: usize = 0;

/// A box on a joint.
struct Part {
    name: &'static str,
    parent: Option<usize>,
    /// The joint in the rest pose, metres.
    joint: [f32; 3],
    /// The box, from corner to corner, about the joint.
    low: [f32; 3],
    high: [f32; 3],
    /// Swing about x, degrees to each side.
    swing_deg: f32,
    /// Where in the stride, in parts of it.
    phase: f32,
    color: [f32; 4],
}

/// The bytes of a GLB file: about 1.75 m tall, facing +z, standing on y = 0.
pub fn robot() -> Vec<u8> {
    let parts = parts();
    let mut buffer = Buffer::default();
    let attributes = attributes(&parts, &mut buffer);
    let indices = buffer.indices(&indices(parts.len()));
    let inverse_binds: Vec<Mat4> =
        parts.iter().map(|part| Mat4::from_translation(-Vec3::from(part.joint))).collect();
    let inverse_binds = buffer.mat4s(&inverse_binds);
    let animation = animation(&parts, &mut buffer);
    let joints: Vec<usize> = (0..parts.len()).map(node).collect();
    let mut nodes = vec![json!({"name": "robot", "mesh": 0, "skin": 0})];
    nodes.extend((0..parts.len()).map(|index| joint_node(&parts, index)));
    buffer.into_glb(json!({
        "asset": {"version": "2.0", "generator": "Shadecast"},
        "scene": 0,
        "scenes": [{"name": "robot", "nodes": [NODE_OF_MESH, node(0)]}],
        "nodes": nodes,
        "meshes": [{"name": "robot", "primitives": [
            {"attributes": attributes, "indices": indices, "material": 0}
        ]}],
        "skins": [{"name": "robot", "joints": joints, "skeleton": node(0), "inverseBindMatrices": inverse_binds}],
        "materials": [{"name": "paint", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.5}}],
        "animations": [animation],
    }))
}

/// Node 0 is the mesh; joints follow.
fn node(part: usize) -> usize {
    part + 1
}

/// Hips, body and head, then arms and legs of both sides: 22 boxes.
fn parts() -> Vec<Part> {
    const GREY: [f32; 4] = [0.5, 0.5, 0.55, 1.0];
    const RED: [f32; 4] = [0.7, 0.12, 0.08, 1.0];
    const BLUE: [f32; 4] = [0.1, 0.2, 0.6, 1.0];
    let part = |name, parent, joint, low, high, swing_deg, phase, color| Part {
        name,
        parent,
        joint,
        low,
        high,
        swing_deg,
        phase,
        color,
    };
    let mut parts = vec![
        part("hips", None, [0.0, 0.92, 0.0], [-0.16, -0.08, -0.1], [0.16, 0.08, 0.1], 6.0, 0.0, BLUE),
        part("waist", Some(0), [0.0, 1.02, 0.0], [-0.1, -0.02, -0.08], [0.1, 0.1, 0.08], 8.0, 0.3, GREY),
        part("chest", Some(1), [0.0, 1.14, 0.0], [-0.2, -0.02, -0.12], [0.2, 0.28, 0.12], 8.0, 0.5, RED),
        part("neck", Some(2), [0.0, 1.42, 0.0], [-0.05, 0.0, -0.05], [0.05, 0.08, 0.05], 12.0, 0.2, GREY),
        part("head", Some(3), [0.0, 1.5, 0.0], [-0.11, 0.0, -0.11], [0.11, 0.24, 0.12], 16.0, 0.7, RED),
        part("jaw", Some(4), [0.0, 1.54, 0.1], [-0.07, -0.03, 0.0], [0.07, 0.02, 0.06], 20.0, 0.1, GREY),
    ];
    for (side, phase) in [(-1.0f32, 0.0), (1.0, 0.5)] {
        let [hip, shoulder] = [[side * 0.1, 0.88, 0.0], [side * 0.27, 1.38, 0.0]];
        let first = parts.len();
        let opposite = phase + 0.5;
        parts.extend([
            part("thigh", Some(0), hip, [-0.07, -0.38, -0.08], [0.07, 0.02, 0.08], 40.0, phase, BLUE),
            part(
                "shin",
                Some(first),
                [hip[0], 0.48, 0.0],
                [-0.06, -0.4, -0.06],
                [0.06, 0.02, 0.06],
                35.0,
                phase + 0.25,
                GREY,
            ),
            part(
                "foot",
                Some(first + 1),
                [hip[0], 0.08, 0.0],
                [-0.06, -0.08, -0.07],
                [0.06, 0.0, 0.18],
                25.0,
                phase + 0.6,
                RED,
            ),
            part(
                "toes",
                Some(first + 2),
                [hip[0], 0.03, 0.18],
                [-0.06, -0.03, 0.0],
                [0.06, 0.02, 0.07],
                25.0,
                phase + 0.8,
                GREY,
            ),
            part(
                "shoulder",
                Some(2),
                shoulder,
                [-0.07, -0.06, -0.07],
                [0.07, 0.08, 0.07],
                25.0,
                opposite,
                GREY,
            ),
            part(
                "upper arm",
                Some(first + 4),
                [shoulder[0], 1.32, 0.0],
                [-0.05, -0.28, -0.05],
                [0.05, 0.0, 0.05],
                35.0,
                opposite,
                RED,
            ),
            part(
                "forearm",
                Some(first + 5),
                [shoulder[0], 1.03, 0.0],
                [-0.04, -0.25, -0.04],
                [0.04, 0.0, 0.04],
                45.0,
                opposite + 0.2,
                GREY,
            ),
            part(
                "hand",
                Some(first + 6),
                [shoulder[0], 0.77, 0.0],
                [-0.05, -0.14, -0.03],
                [0.05, 0.0, 0.03],
                50.0,
                opposite + 0.4,
                BLUE,
            ),
        ]);
    }
    parts
}

fn joint_node(parts: &[Part], index: usize) -> Value {
    let part = &parts[index];
    let parent = part.parent.map_or(Vec3::ZERO, |parent| Vec3::from(parts[parent].joint));
    let mut node = json!({"name": part.name, "translation": (Vec3::from(part.joint) - parent).to_array()});
    let children = (0..parts.len()).filter(|child| parts[*child].parent == Some(index));
    let children: Vec<usize> = children.map(self::node).collect();
    if !children.is_empty() {
        node["children"] = json!(children);
    }
    node
}

/// Outward normal and the four corners of each face, counter-clockwise from outside; a corner is picked by the bits of its
/// number: x, y, z.
const FACES: [(Vec3, [usize; 4]); 6] = [
    (Vec3::NEG_X, [0, 4, 6, 2]),
    (Vec3::X, [1, 3, 7, 5]),
    (Vec3::NEG_Y, [0, 1, 5, 4]),
    (Vec3::Y, [2, 6, 7, 3]),
    (Vec3::NEG_Z, [0, 2, 3, 1]),
    (Vec3::Z, [4, 5, 7, 6]),
];

fn attributes(parts: &[Part], buffer: &mut Buffer) -> Value {
    let (mut positions, mut normals, mut colors) = (Vec::new(), Vec::new(), Vec::new());
    let (mut joints, mut weights) = (Vec::new(), Vec::new());
    for (index, part) in parts.iter().enumerate() {
        let corner = |number: usize| {
            let pick = |axis: usize| if number >> axis & 1 == 1 { part.high[axis] } else { part.low[axis] };
            Vec3::from(part.joint) + Vec3::new(pick(0), pick(1), pick(2))
        };
        for (normal, corners) in FACES {
            positions.extend(corners.map(corner));
            normals.extend([normal; 4]);
            colors.extend([Vec4::from(part.color); 4]);
            joints.extend([[index as u8, 0, 0, 0]; 4]);
            weights.extend([Vec4::X; 4]);
        }
    }
    json!({
        "POSITION": buffer.positions(&positions),
        "NORMAL": buffer.vec3s(&normals, Target::Vertices),
        "COLOR_0": buffer.vec4s(&colors),
        "JOINTS_0": buffer.joints(&joints),
        "WEIGHTS_0": buffer.vec4s(&weights),
    })
}

fn indices(parts: usize) -> Vec<u16> {
    let face = |face: u16| [0, 1, 2, 0, 2, 3].map(|corner| 4 * face + corner);
    (0..parts as u16 * 6).flat_map(face).collect()
}

fn animation(parts: &[Part], buffer: &mut Buffer) -> Value {
    let times: Vec<f32> = (0..KEYS).map(|key| key as f32 / KEYS_PER_S).collect();
    let input = buffer.scalars(&times);
    let (mut channels, mut samplers) = (Vec::new(), Vec::new());
    for (index, part) in parts.iter().enumerate() {
        let turn = |time: &f32| {
            let stride = (time * STRIDES_PER_S + part.phase).fract();
            Quat::from_rotation_x((part.swing_deg * snap(stride)).to_radians())
        };
        let turns: Vec<Quat> = times.iter().map(turn).collect();
        samplers.push(json!({"input": input, "output": buffer.quats(&turns), "interpolation": "LINEAR"}));
        channels.push(
            json!({"sampler": samplers.len() - 1, "target": {"node": node(index), "path": "rotation"}}),
        );
    }
    json!({"name": "march", "channels": channels, "samplers": samplers})
}

/// From -1 to 1 and back within a stride: an eighth of it on the way, the rest at an end. The wide steps between keys are
/// the point.
fn snap(stride: f32) -> f32 {
    let ramp = |since: f32| (since * 8.0).clamp(0.0, 1.0) * 2.0 - 1.0;
    if stride < 0.5 { ramp(stride) } else { -ramp(stride - 0.5) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::load::{SceneSource, load_scene};
    use shadecast_scene::{Interpolation, TrackValues};

    #[test]
    fn robot_loads_as_a_skin_of_stiff_parts_with_wide_steps() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("robot.glb");
        std::fs::write(&path, robot()).expect("written");
        let scene = load_scene(&SceneSource::File(path)).expect("valid");
        let model = &scene.models[0];
        assert!(model.palette.len() >= 20, "{} joints", model.palette.len());
        assert!(model.vertices.iter().all(|vertex| vertex.influences() == 1), "nothing bends");
        let clip = &model.clips[scene.instances[0].clip.expect("it moves")];
        assert_eq!(clip.duration_s, 2.0);
        let mut widest_rad = 0.0f32;
        for track in &clip.tracks {
            assert_eq!(track.interpolation, Interpolation::Linear);
            let TrackValues::Rotation(keys) = &track.values else { panic!("it only turns") };
            assert!(keys[0].abs_diff_eq(keys[keys.len() - 1], 1e-4), "it goes on where it began");
            let steps = keys.windows(2).map(|pair| pair[0].angle_between(pair[1]));
            widest_rad = steps.fold(widest_rad, f32::max);
        }
        assert!(widest_rad.to_degrees() > 25.0, "{} degrees", widest_rad.to_degrees());
    }

    #[test]
    fn faces_look_outwards() {
        for (normal, corners) in FACES {
            let at = |number: usize| {
                Vec3::new((number & 1) as f32, (number >> 1 & 1) as f32, (number >> 2) as f32)
            };
            let [a, b, c, _] = corners.map(at);
            assert_eq!((b - a).cross(c - a), normal);
        }
    }
}

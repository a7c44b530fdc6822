//! The finished dragon as a glTF document.

use super::anatomy::TEXTURE_TEXELS;
use super::bake::Canvas;
use super::clip::{self, KEYS, KEYS_PER_S, Motion};
use super::mesh::{Mesh, Skin, Vertex};
use super::rig::Rig;
use crate::glb::{Buffer, Target};
use crate::picture;
use glam::{Mat4, Quat, Vec2, Vec3, Vec4};
use serde_json::{Value, json};
use std::ops::{Add, Mul, Sub};

/// Curves that stay closer than this to their first key are left out.
const STILL: f32 = 1e-6;
/// The material with a normal map.
const HIDE: usize = 0;

pub(super) fn glb(rig: &Rig, mesh: &Mesh) -> Vec<u8> {
    let mut buffer = Buffer::default();
    let primitives = primitives(mesh, &mut buffer);
    let (images, textures) = pictures(mesh, &mut buffer);
    let inverse_bind: Vec<Mat4> = rig.joints.iter().map(inverse_bind).collect();
    let inverse_bind = buffer.mat4s(&inverse_bind);
    let animation = animation(rig, &mut buffer);

    let joints: Vec<usize> = (0..rig.joints.len()).map(node).collect();
    let mut nodes = vec![json!({"name": "dragon", "mesh": 0, "skin": 0})];
    nodes.extend((0..rig.joints.len()).map(|joint| joint_node(rig, joint)));
    buffer.into_glb(json!({
        "asset": {"version": "2.0", "generator": "Shadecast"},
        "scene": 0,
        "scenes": [{"name": "dragon", "nodes": [0, node(rig.root)]}],
        "nodes": nodes,
        "meshes": [{"name": "dragon", "primitives": primitives}],
        "skins": [{
            "name": "dragon", "joints": joints, "skeleton": node(rig.root), "inverseBindMatrices": inverse_bind
        }],
        "materials": materials(),
        "textures": textures,
        "images": images,
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "animations": [animation],
    }))
}

/// Node 0 is the mesh; joints follow.
fn node(joint: usize) -> usize {
    joint + 1
}

fn joint_node(rig: &Rig, index: usize) -> Value {
    let joint = &rig.joints[index];
    let (translation, rotation, _) = local(rig, index, &Motion::NONE);
    let mut node = json!({
        "name": joint.name, "translation": translation.to_array(), "rotation": rotation.to_array()
    });
    let children: Vec<usize> = (0..rig.joints.len())
        .filter(|&child| rig.joints[child].parent == Some(index))
        .map(self::node)
        .collect();
    if !children.is_empty() {
        node["children"] = json!(children);
    }
    node
}

/// Joint from mesh, in the pose in which the skin was made.
fn inverse_bind(joint: &super::rig::Joint) -> Mat4 {
    let inverse = joint.rotation.inverse();
    let mut matrix = Mat4::from_rotation_translation(inverse, inverse * -joint.position);
    // The specification wants the last row to be exactly 0 0 0 1.
    (matrix.x_axis.w, matrix.y_axis.w, matrix.z_axis.w, matrix.w_axis.w) = (0.0, 0.0, 0.0, 1.0);
    matrix
}

/// Translation, rotation and scale of a joint against its parent.
fn local(rig: &Rig, index: usize, motion: &Motion) -> (Vec3, Quat, Vec3) {
    let joint = &rig.joints[index];
    let (parent_position, parent_rotation) = match joint.parent {
        Some(parent) => (rig.joints[parent].position, rig.joints[parent].rotation),
        None => (Vec3::ZERO, Quat::IDENTITY),
    };
    let to_parent = parent_rotation.inverse();
    let translation = to_parent * (joint.position - parent_position + motion.shift_m);
    let rotation = (to_parent * motion.turn * joint.rotation).normalize();
    (translation, rotation, motion.scale)
}

fn primitives(mesh: &Mesh, buffer: &mut Buffer) -> Vec<Value> {
    let eyes = |triangle: &&[u32; 3]| mesh.vertices[triangle[0] as usize].skin == Skin::Eye;
    let hide: Vec<[u32; 3]> = mesh.triangles.iter().filter(|t| !eyes(t)).copied().collect();
    let eyes: Vec<[u32; 3]> = mesh.triangles.iter().filter(eyes).copied().collect();
    [hide, eyes].into_iter().enumerate().map(|(material, t)| primitive(mesh, t, material, buffer)).collect()
}

/// A primitive with vertices of its own, so that importers that join primitives get none twice.
fn primitive(mesh: &Mesh, triangles: Vec<[u32; 3]>, material: usize, buffer: &mut Buffer) -> Value {
    let mut part = Mesh { vertices: mesh.vertices.clone(), triangles };
    part.drop_triangles(|_| false);
    let each = |f: &dyn Fn(&Vertex) -> Vec3| part.vertices.iter().map(f).collect::<Vec<Vec3>>();
    let (joints, weights): (Vec<[u8; 4]>, Vec<[f32; 4]>) =
        part.vertices.iter().map(|vertex| vertex.weights.strongest()).unzip();
    let weights: Vec<Vec4> = weights.into_iter().map(Vec4::from_array).collect();
    let uvs: Vec<Vec2> = part.vertices.iter().map(|v| v.texel / TEXTURE_TEXELS as f32).collect();
    let tangents: Vec<Vec4> = part.vertices.iter().map(|v| v.tangent).collect();
    let index = |&index: &u32| u16::try_from(index).expect("the dragon has fewer than 65,536 vertices");
    let indices: Vec<u16> = part.triangles.as_flattened().iter().map(index).collect();
    let mut attributes = json!({
        "POSITION": buffer.positions(&each(&|v| v.position)),
        "NORMAL": buffer.vec3s(&each(&|v| v.normal), Target::Vertices),
        "TEXCOORD_0": buffer.vec2s(&uvs),
        "JOINTS_0": buffer.joints(&joints),
        "WEIGHTS_0": buffer.vec4s(&weights),
    });
    if material == HIDE {
        attributes["TANGENT"] = json!(buffer.vec4s(&tangents));
    }
    json!({"attributes": attributes, "indices": buffer.indices(&indices), "material": material})
}

fn materials() -> Value {
    json!([
        {
            "name": "hide",
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}
            },
            "normalTexture": {"index": 2},
        },
        {
            "name": "eye",
            "pbrMetallicRoughness": {
                "baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 0.12
            },
            "emissiveTexture": {"index": 0},
            "emissiveFactor": [0.55, 0.55, 0.55],
        },
    ])
}

fn pictures(mesh: &Mesh, buffer: &mut Buffer) -> (Vec<Value>, Vec<Value>) {
    let pictures = Canvas::paint(mesh, TEXTURE_TEXELS as usize).pictures();
    let named = [
        ("base_color", pictures.base_color),
        ("metallic_roughness", pictures.metallic_roughness),
        ("normal", pictures.normal),
    ];
    let images = named.map(|(name, rgb)| {
        let view = buffer.view(&picture::png(&rgb, TEXTURE_TEXELS), Target::None);
        json!({"name": name, "bufferView": view, "mimeType": "image/png"})
    });
    let textures = (0..images.len()).map(|source| json!({"sampler": 0, "source": source})).collect();
    (images.to_vec(), textures)
}

fn animation(rig: &Rig, buffer: &mut Buffer) -> Value {
    let times: Vec<f32> = (0..KEYS).map(|key| key as f32 / KEYS_PER_S as f32).collect();
    let input = buffer.scalars(&times);
    let poses: Vec<Vec<Motion>> = (0..KEYS).map(|key| clip::pose(rig, key)).collect();
    let (mut samplers, mut channels) = (Vec::new(), Vec::new());
    let mut track = |joint: usize, path: &str, output: usize| {
        channels.push(json!({"sampler": samplers.len(), "target": {"node": node(joint), "path": path}}));
        samplers.push(json!({"input": input, "output": output, "interpolation": "CUBICSPLINE"}));
    };
    for joint in 0..rig.joints.len() {
        let keys = poses.iter().map(|pose| local(rig, joint, &pose[joint]));
        let (translations, (rotations, scales)): (Vec<Vec3>, (Vec<Quat>, Vec<Vec3>)) =
            keys.map(|(t, r, s)| (t, (r, s))).unzip();
        let rotations = on_shortest_arc(rotations);
        if translations.iter().any(|key| key.distance(translations[0]) > STILL) {
            let keys = with_tangents(&translations);
            track(joint, "translation", buffer.vec3s(&keys, Target::None));
        }
        if rotations.iter().any(|key| (*key - rotations[0]).length() > STILL) {
            track(joint, "rotation", buffer.quats(&with_tangents(&rotations)));
        }
        if scales.iter().any(|key| key.distance(scales[0]) > STILL) {
            track(joint, "scale", buffer.vec3s(&with_tangents(&scales), Target::None));
        }
    }
    json!({"name": "fly", "samplers": samplers, "channels": channels})
}

/// Each key between its tangents, as glTF's cubic splines have them: straight lines between 60 keys a second would leave
/// the tip of a wing, which moves by 2 m, a millimetre and more beside its way. A fourth-order difference; keys repeat.
fn with_tangents<T>(keys: &[T]) -> Vec<T>
where
    T: Copy + Add<Output = T> + Sub<Output = T> + Mul<f32, Output = T>,
{
    let period = keys.len() - 1;
    let at = |key: usize, step: usize| keys[(key + step) % period];
    let triple = |key: usize| {
        let near = at(key, 1) - at(key, period - 1);
        let far = at(key, 2) - at(key, period - 2);
        let tangent = (near * 8.0 - far) * (KEYS_PER_S as f32 / 12.0);
        [tangent, keys[key], tangent]
    };
    (0..keys.len()).flat_map(triple).collect()
}

/// A quaternion and its negative are one rotation; neighbours take the sign that is nearer.
fn on_shortest_arc(mut keys: Vec<Quat>) -> Vec<Quat> {
    for i in 1..keys.len() {
        if keys[i].dot(keys[i - 1]) < 0.0 {
            keys[i] = -keys[i];
        }
    }
    keys
}

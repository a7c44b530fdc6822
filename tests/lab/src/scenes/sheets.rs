//! Sheets for measurements of growth: grids of quads that stand before the head, still or bent by a row of joints.
//!
//! How many sheets there are, how fine they are, and how many joints they have enters. A model and a scene of it leave.

use glam::{Mat4, Quat, Vec3, Vec4};
use serde_json::{Value, json};
use shadecast_dragon::glb::{Buffer, Target};
use std::path::{Path, PathBuf};

/// All sheets together, metres from side to side.
const WIDTH_M: f32 = 3.0;
/// From the origin, metres.
const AHEAD_M: f32 = 2.0;
/// The middle, metres above the floor.
const HEIGHT_M: f32 = 1.6;
/// Part of its place that a sheet takes.
const FILLED: f32 = 0.9;
const KEYS_PER_S: f32 = 24.0;
const KEYS: usize = 49;
const SWING_DEGREES: f32 = 12.0;
/// The most quads along a side: indices have 16 bits.
pub const MOST_QUADS: u32 = 254;

/// What stands there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sheets {
    /// Instances of one mesh, in as many rows as columns.
    pub count: u32,
    /// Quads along a side of each.
    pub quads: u32,
    /// Joints of each; 0: it stands still.
    pub joints: u32,
}

/// Writes model and scene, whose path it gives.
///
/// # Errors
/// The folder cannot be written.
pub fn write_sheets(folder: &Path, sheets: Sheets) -> std::io::Result<PathBuf> {
    assert!(sheets.quads <= MOST_QUADS, "{} quads a side", sheets.quads);
    let side = sheets.count.isqrt().max(1);
    assert!(side * side == sheets.count, "{} are no square", sheets.count);
    std::fs::write(folder.join("sheet.glb"), glb(sheets, WIDTH_M / side as f32 * FILLED))?;
    let place = |number: u32| (number as f32 + 0.5) / side as f32 * WIDTH_M - 0.5 * WIDTH_M;
    let instance = |number: u32| {
        let (x, y) = (place(number % side), HEIGHT_M + place(number / side));
        format!("\n[[instance]]\nmodel = \"sheet\"\ntranslation = [{x:.4}, {y:.4}, {:.1}]\n", -AHEAD_M)
    };
    let instances: String = (0..sheets.count).map(instance).collect();
    let model = "[[model]]\nname = \"sheet\"\nfile = \"sheet.glb\"\n";
    let scene = folder.join("sheets.toml");
    std::fs::write(&scene, format!("{model}{instances}\n[ground]\nenabled = false\n"))?;
    Ok(scene)
}

/// One sheet, so wide and so high, about the origin.
fn glb(sheets: Sheets, side_m: f32) -> Vec<u8> {
    let joints = sheets.joints;
    let mut buffer = Buffer::default();
    let primitive = primitive(sheets, side_m, &mut buffer);
    let mut nodes = vec![json!({"mesh": 0})];
    let joint = |joint| json!({"translation": [joint_x(joint, joints, side_m), 0.0, 0.0]});
    nodes.extend((0..joints).map(joint));
    let all: Vec<usize> = (0..nodes.len()).collect();
    let mut document = json!({
        "asset": {"version": "2.0", "generator": "Shadecast"},
        "scene": 0,
        "scenes": [{"name": "sheet", "nodes": all}],
        "meshes": [{"name": "sheet", "primitives": [primitive]}],
        "materials": [{"doubleSided": true, "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.6}}],
    });
    if joints > 0 {
        let binds: Vec<Mat4> = (0..joints).map(|joint| bind(joint, joints, side_m)).collect();
        nodes[0]["skin"] = json!(0);
        document["skins"] = json!([{"joints": all[1..], "inverseBindMatrices": buffer.mat4s(&binds)}]);
        document["animations"] = json!([animation(joints, &mut buffer)]);
    }
    document["nodes"] = json!(nodes);
    buffer.into_glb(document)
}

/// Of a joint, from the middle of its sheet, metres.
fn joint_x(joint: u32, joints: u32, side_m: f32) -> f32 {
    ((joint as f32 + 0.5) / joints as f32 - 0.5) * side_m
}

fn bind(joint: u32, joints: u32, side_m: f32) -> Mat4 {
    Mat4::from_translation(Vec3::new(-joint_x(joint, joints, side_m), 0.0, 0.0))
}

/// The grid. Each vertex is bound to the joint whose stripe it lies in.
fn primitive(Sheets { quads, joints, .. }: Sheets, side_m: f32, buffer: &mut Buffer) -> Value {
    let corners = quads + 1;
    let part = |number: u32| number as f32 / quads as f32;
    let all = (0..corners).flat_map(|y| (0..corners).map(move |x| [x, y]));
    let positions: Vec<Vec3> = all
        .clone()
        .map(|[x, y]| Vec3::new((part(x) - 0.5) * side_m, (part(y) - 0.5) * side_m, 0.0))
        .collect();
    let checks = |[x, y]: [u32; 2]| {
        let is_dark = ((part(x) * 8.0) as u32 + (part(y) * 8.0) as u32).is_multiple_of(2);
        if is_dark { Vec4::new(0.2, 0.25, 0.35, 1.0) } else { Vec4::new(0.7, 0.6, 0.45, 1.0) }
    };
    let colors: Vec<Vec4> = all.clone().map(checks).collect();
    let mut attributes = json!({
        "POSITION": buffer.positions(&positions),
        "NORMAL": buffer.vec3s(&vec![Vec3::Z; positions.len()], Target::Vertices),
        "COLOR_0": buffer.vec4s(&colors),
    });
    if joints > 0 {
        let joint = |[x, _]: [u32; 2]| [((part(x) * joints as f32) as u32).min(joints - 1) as u8, 0, 0, 0];
        attributes["JOINTS_0"] = json!(buffer.joints(&all.map(joint).collect::<Vec<_>>()));
        attributes["WEIGHTS_0"] = json!(buffer.vec4s(&vec![Vec4::X; positions.len()]));
    }
    let quad = |x: u32, y: u32| {
        let first = y * corners + x;
        [0, 1, corners + 1, 0, corners + 1, corners].map(|corner| (first + corner) as u16)
    };
    let indices: Vec<u16> =
        (0..quads).flat_map(|y| (0..quads).map(move |x| (x, y))).flat_map(|(x, y)| quad(x, y)).collect();
    json!({"attributes": attributes, "indices": buffer.indices(&indices), "material": 0})
}

/// Each joint swings about the sheet's width, later than the one before.
fn animation(joints: u32, buffer: &mut Buffer) -> Value {
    let times: Vec<f32> = (0..KEYS).map(|key| key as f32 / KEYS_PER_S).collect();
    let input = buffer.scalars(&times);
    let (mut channels, mut samplers) = (Vec::new(), Vec::new());
    for joint in 0..joints {
        let phase = joint as f32 / joints as f32;
        let turn = |time: &f32| {
            let swing = (std::f32::consts::TAU * (0.5 * time + phase)).sin();
            Quat::from_rotation_x((SWING_DEGREES * swing).to_radians())
        };
        let turns: Vec<Quat> = times.iter().map(turn).collect();
        samplers.push(json!({"input": input, "output": buffer.quats(&turns), "interpolation": "LINEAR"}));
        let target = json!({"node": 1 + joint, "path": "rotation"});
        channels.push(json!({"sampler": samplers.len() - 1, "target": target}));
    }
    json!({"name": "swing", "channels": channels, "samplers": samplers})
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::load::{SceneSource, load_scene};

    #[test]
    fn sheets_have_the_triangles_joints_and_instances_asked_for() {
        for (count, quads, joints) in [(1, 8, 0), (4, 8, 0), (1, 8, 4), (9, 8, 7)] {
            let folder = tempfile::tempdir().expect("a folder");
            let path = write_sheets(folder.path(), Sheets { count, quads, joints }).expect("written");
            let scene = load_scene(&SceneSource::File(path)).expect("valid");
            let moving = scene.models.iter().map(|model| model.palette.len()).max().unwrap_or(0);
            assert_eq!(scene.instances.len() as u32, count, "{count} {quads} {joints}");
            if joints > 0 {
                assert_eq!(moving as u32, joints, "{count} {quads} {joints}");
            }
            let triangles = scene.models[0].indices.len() as u32 / 3;
            assert_eq!(triangles, 2 * quads * quads, "{count} {quads} {joints}");
        }
    }
}

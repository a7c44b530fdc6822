//! A room for measurements of cutouts: a curtain of leaves before each wall, with the wall visible between the leaves. The
//! curtains hang still, or sway about their upper edge.

use super::room::{wall, walls, write_scene};
use crate::image::ImageError;
use glam::{Quat, Vec3};
use serde_json::{Value, json};
use shadecast_dragon::glb::{Buffer, Target};
use shadecast_dragon::picture;
use shadecast_dragon::surface::Surface;
use std::f32::consts::TAU;
use std::path::{Path, PathBuf};

/// From wall to wall, metres.
const SIDE_M: f32 = 7.0;
/// Floor to ceiling, metres.
const HEIGHT_M: f32 = 3.5;
/// A curtain's side, metres, and its way from the room's middle.
const CURTAIN_M: f32 = 3.0;
const AWAY_M: f32 = 2.4;
/// Texels of the picture's side.
const TEXELS: u32 = 256;
/// Leaves across and down the picture.
const LEAVES: u32 = 6;
/// Rows that have walls and curtains as meshes and materials.
const WALL: usize = 0;
const CURTAIN: usize = 1;
/// Walls, floor and ceiling: the nodes before those of curtains.
const WALL_NODES: usize = 6;

/// Writes the room and a scene in whose middle one stands; gives the scene's path.
///
/// # Errors
/// The folder cannot be written.
pub fn write_leaves(folder: &Path, sway: bool) -> Result<PathBuf, ImageError> {
    let failed = |reason: std::io::Error| ImageError::Open { path: folder.into(), reason };
    let name = if sway { "swaying" } else { "leaves" };
    std::fs::write(folder.join("leaves.png"), picture()).map_err(failed)?;
    write_scene(folder, name, &room(sway)).map_err(failed)
}

fn room(sway: bool) -> Vec<u8> {
    let mut buffer = Buffer::default();
    let meshes = json!([
        mesh(&wall(), &mut buffer, WALL, Vec3::ZERO),
        // It hangs from the middle of its upper edge.
        mesh(&wall(), &mut buffer, CURTAIN, Vec3::new(0.0, -0.5, 0.0)),
    ]);
    let mut nodes = walls(SIDE_M, HEIGHT_M, |_| WALL);
    nodes.extend((0..4).map(curtain));
    let all: Vec<usize> = (0..nodes.len()).collect();
    let mut document = json!({
        "asset": {"version": "2.0", "generator": "Shadecast"},
        "scene": 0,
        "scenes": [{"name": "leaves", "nodes": all}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [
            {"pbrMetallicRoughness": {"baseColorFactor": [0.75, 0.3, 0.2, 1.0], "metallicFactor": 0.0}},
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0},
                "alphaMode": "MASK",
                "alphaCutoff": 0.5,
                "doubleSided": true,
            },
        ],
        "textures": [{"source": 0}],
        "images": [{"uri": "leaves.png"}],
    });
    if sway {
        document["animations"] = json!([swaying(&mut buffer)]);
    }
    buffer.into_glb(document)
}

fn turn_of(side: u8) -> Quat {
    Quat::from_rotation_y(f32::from(side) * TAU / 4.0)
}

fn curtain(side: u8) -> Value {
    let at = turn_of(side) * Vec3::new(0.0, HEIGHT_M, -AWAY_M);
    json!({
        "mesh": CURTAIN,
        "translation": at.to_array(),
        "rotation": turn_of(side).to_array(),
        "scale": [CURTAIN_M, CURTAIN_M, 1.0],
    })
}

/// To and fro by 8 degrees within two seconds.
fn swaying(buffer: &mut Buffer) -> Value {
    let times: Vec<f32> = (0..=16u8).map(|key| f32::from(key) / 8.0).collect();
    let input = buffer.scalars(&times);
    let mut samplers = Vec::new();
    for side in 0..4 {
        let turns: Vec<Quat> = times
            .iter()
            .map(|time| turn_of(side) * Quat::from_rotation_x(0.14 * (TAU * time / 2.0).sin()))
            .collect();
        samplers.push(json!({"input": input, "output": buffer.quats(&turns)}));
    }
    let channel =
        |side: usize| json!({"sampler": side, "target": {"node": WALL_NODES + side, "path": "rotation"}});
    let channels: Vec<Value> = (0..4).map(channel).collect();
    json!({"name": "sway", "samplers": samplers, "channels": channels})
}

fn mesh(surface: &Surface, buffer: &mut Buffer, material: usize, shift: Vec3) -> Value {
    let positions: Vec<Vec3> = surface.positions.iter().map(|p| *p + shift).collect();
    json!({"primitives": [{
        "attributes": {
            "POSITION": buffer.positions(&positions),
            "NORMAL": buffer.vec3s(&surface.normals, Target::Vertices),
            "TEXCOORD_0": buffer.vec2s(&surface.uvs),
        },
        "indices": buffer.indices(&surface.indices),
        "material": material,
    }]})
}

/// The bytes of a PNG file: green throughout, so that only alpha tells leaves from what is between them.
fn picture() -> Vec<u8> {
    let side = TEXELS as f32 / LEAVES as f32;
    let alpha = |x: u32, y: u32| {
        let [u, v] = [x, y].map(|at| ((at as f32 + 0.5) / side).fract() - 0.5);
        // Pointed at both ends, and slanting.
        let (along, across) = (u + v, u - v);
        if across.abs() < 0.28 * (1.0 - (along / 0.9).powi(2)) { 255 } else { 0 }
    };
    let texel = |at: u32| [50, 140, 60, alpha(at % TEXELS, at / TEXELS)];
    let rgba8: Vec<u8> = (0..TEXELS * TEXELS).flat_map(texel).collect();
    picture::png(&rgba8, TEXELS)
}

//! A room for measurements of texture filtering: large walls with paint of texel-sized detail, bricks and letters beside soft
//! colours, so too weak and too strong filters are visible. Nothing in it moves.

use super::room::{wall, walls, write_scene};
use crate::image::{ImageError, Rgb8Image};
use crate::report::typeface::Typeface;
use glam::Vec3;
use serde_json::{Value, json};
use shadecast_dragon::glb::{Buffer, Target};
use shadecast_dragon::surface::Surface;
use std::path::{Path, PathBuf};

/// From wall to wall, metres.
const SIDE_M: f32 = 7.0;
/// Floor to ceiling, metres.
const HEIGHT_M: f32 = 3.5;
/// Texels of a picture's side: 3.4 mm of a wall each, two thirds of a pixel of 1300 over 90 degrees at 3.5 m.
pub const TEXELS: u32 = 2048;
/// Bricks across and down a picture.
const BRICKS: [u32; 2] = [16, 32];
/// Pictures, a file each: of the floor, of the ceiling, of the walls.
const PAINTS: [(&str, Vec3); 3] = [
    ("floor.png", Vec3::new(0.45, 0.36, 0.28)),
    ("ceiling.png", Vec3::new(0.72, 0.72, 0.68)),
    ("wall.png", Vec3::new(0.56, 0.3, 0.24)),
];
const WORDS: &str = "What is filtered too little shimmers; what is filtered too much is grey.";

/// Writes the room, with pictures of so many texels a side, and a scene in whose middle one stands; gives the scene's path.
///
/// # Errors
/// The folder cannot be written, or pictures cannot have so many texels.
pub fn write_walls(folder: &Path, texels: u32) -> Result<PathBuf, ImageError> {
    for (seed, (file, color)) in (1..).zip(PAINTS) {
        paint(texels, seed, color)?.write_png(&folder.join(file))?;
    }
    write_scene(folder, "walls", &room()).map_err(|reason| ImageError::Open { path: folder.into(), reason })
}

/// The bytes of a GLB file whose pictures lie beside it.
fn room() -> Vec<u8> {
    let mut buffer = Buffer::default();
    let meshes: Vec<Value> = (0..PAINTS.len()).map(|paint| mesh(&wall(), &mut buffer, paint)).collect();
    let nodes = walls(SIDE_M, HEIGHT_M, |which| which.min(PAINTS.len() - 1));
    let all: Vec<usize> = (0..nodes.len()).collect();
    let material = |texture: usize| json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": texture}, "metallicFactor": 0.0, "roughnessFactor": 0.8}});
    let each = |of: &dyn Fn(usize) -> Value| (0..PAINTS.len()).map(of).collect::<Vec<_>>();
    buffer.into_glb(json!({
        "asset": {"version": "2.0", "generator": "Shadecast"},
        "scene": 0,
        "scenes": [{"name": "walls", "nodes": all}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": each(&material),
        "textures": each(&|source| json!({"source": source})),
        "images": each(&|image| json!({"uri": PAINTS[image].0})),
    }))
}

fn mesh(surface: &Surface, buffer: &mut Buffer, material: usize) -> Value {
    json!({"primitives": [{
        "attributes": {
            "POSITION": buffer.positions(&surface.positions),
            "NORMAL": buffer.vec3s(&surface.normals, Target::Vertices),
            "TEXCOORD_0": buffer.vec2s(&surface.uvs),
        },
        "indices": buffer.indices(&surface.indices),
        "material": material,
    }]})
}

/// Bricks with grain, and a notice in the middle whose lines get smaller and smaller.
fn paint(texels: u32, seed: u32, color: Vec3) -> Result<Rgb8Image, ImageError> {
    let mut picture = Rgb8Image::from_fn(texels, texels, |x, y| brick(texels, seed, color, [x, y]))?;
    let (left, top) = (texels / 4, texels / 3);
    for (x, y) in (top..texels * 2 / 3).flat_map(|y| (left..texels * 3 / 4).map(move |x| (x, y))) {
        picture.set_pixel(x, y, [235, 232, 220]);
    }
    let (typeface, mut y) = (Typeface::new(), top);
    let sizes = [48, 36, 28, 20, 16, 12, 10, 8].map(|size| size * texels / TEXELS);
    for size in sizes.into_iter().filter(|size| *size > 3) {
        for line in typeface.wrap(WORDS, size, texels / 2 - 2 * size) {
            typeface.draw(&mut picture, [left + size, y], size, [30, 34, 60], &line);
            y += size + size / 4;
        }
    }
    Ok(picture)
}

fn brick(texels: u32, seed: u32, color: Vec3, [x, y]: [u32; 2]) -> [u8; 3] {
    let [across, down] = BRICKS;
    let row = y * down / texels;
    let shifted = (x + (row % 2) * texels / (2 * across)) % texels;
    let column = shifted * across / texels;
    let (in_x, in_y) = (shifted * across % texels, y * down % texels);
    let is_mortar = in_x < texels / 24 || in_y < texels / 12;
    let of_brick = 0.75 + 0.5 * chance(seed, [column, row]);
    let coarse = 0.9 + 0.2 * chance(seed + 10, [x / 16, y / 16]);
    let grain = 0.8 + 0.4 * chance(seed + 20, [x, y]);
    let base = if is_mortar { Vec3::splat(0.7) } else { color * of_brick };
    (base * coarse * grain * 255.0).to_array().map(|channel| channel.clamp(0.0, 255.0) as u8)
}

/// A number from 0 to 1 for a place, the same at any time.
fn chance(seed: u32, [x, y]: [u32; 2]) -> f32 {
    // The finalizer of MurmurHash3 (Austin Appleby, public domain).
    let mut h = seed.wrapping_mul(0x9e37_79b9) ^ x.wrapping_mul(0x85eb_ca6b) ^ y.wrapping_mul(0xc2b2_ae35);
    h = (h ^ (h >> 16)).wrapping_mul(0x85eb_ca6b);
    h = (h ^ (h >> 13)).wrapping_mul(0xc2b2_ae35);
    (h ^ (h >> 16)) as f32 / u32::MAX as f32
}

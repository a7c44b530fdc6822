//! A room for measurements of abrupt heads: vases in rows along its four walls, so every turn reveals much new geometry.
//! Nothing in it moves.

use glam::Vec3;
use serde_json::{Value, json};
use shadecast_dragon::glb::{Buffer, Target};
use shadecast_dragon::surface::{Surface, surface};
use std::f32::consts::TAU;
use std::path::{Path, PathBuf};

/// From wall to wall, metres.
const SIDE_M: f32 = 9.0;
/// Floor to ceiling, metres.
const HEIGHT_M: f32 = 3.2;
/// Quads of a wall's side: patches of a size that the atlas likes.
const WALL_QUADS: u16 = 16;
/// Vases along each wall, and rows of them one above the other.
pub const MANY_VASES: [usize; 2] = [6, 3];
/// Points of a vase around and along its axis.
const AROUND: u16 = 48;
const ALONG: u16 = 32;

/// Writes the room with so many vases along each wall and so many rows of them, and a scene in whose middle one stands; gives
/// the scene's path.
///
/// # Errors
/// The folder cannot be written.
pub fn write_room(folder: &Path, vases: [usize; 2]) -> std::io::Result<PathBuf> {
    write_scene(folder, "room", &room(vases))
}

/// Writes a file of one model, and a scene of it without the usual ground; gives the scene's path.
pub(crate) fn write_scene(folder: &Path, name: &str, glb: &[u8]) -> std::io::Result<PathBuf> {
    std::fs::write(folder.join(format!("{name}.glb")), glb)?;
    let scene = folder.join(format!("{name}.toml"));
    let text = format!(
        "[[model]]\nname = \"{name}\"\nfile = \"{name}.glb\"\n\n[[instance]]\nmodel = \"{name}\"\n\n[ground]\nenabled = false\n"
    );
    std::fs::write(&scene, text)?;
    Ok(scene)
}

/// The bytes of a GLB file: the floor is at y = 0, its middle the origin.
pub fn room(of_vases: [usize; 2]) -> Vec<u8> {
    let mut buffer = Buffer::default();
    let meshes = json!([mesh("wall", wall(), &mut buffer, 0), mesh("vase", vase(), &mut buffer, 1)]);
    let mut nodes = walls(SIDE_M, HEIGHT_M, |_| 0);
    nodes.extend((0..4).flat_map(|side| vases(side, of_vases)));
    let all: Vec<usize> = (0..nodes.len()).collect();
    let paint = |color: [f32; 4]| json!({"pbrMetallicRoughness": {"baseColorFactor": color, "metallicFactor": 0.0, "roughnessFactor": 0.7}});
    buffer.into_glb(json!({
        "asset": {"version": "2.0", "generator": "Shadecast"},
        "scene": 0,
        "scenes": [{"name": "room", "nodes": all}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [paint([0.6, 0.58, 0.5, 1.0]), paint([0.15, 0.35, 0.5, 1.0])],
    }))
}

/// A square of side 1 in the plane of x and y that faces +z.
pub(crate) fn wall() -> Surface {
    surface(WALL_QUADS + 1, WALL_QUADS + 1, |u, v| Vec3::new(u - 0.5, v - 0.5, 0.0))
}

/// 0.7 m high, standing on y = 0, ribbed.
fn vase() -> Surface {
    surface(AROUND + 1, ALONG + 1, |u, v| {
        let radius = 0.16 + 0.09 * (TAU * (v * 0.8 + 0.05)).sin() + 0.008 * (12.0 * TAU * u).cos();
        let (sin, cos) = (TAU * u).sin_cos();
        Vec3::new(radius * sin, 0.7 * v, radius * cos)
    })
}

fn mesh(name: &str, surface: Surface, buffer: &mut Buffer, material: usize) -> Value {
    json!({"name": name, "primitives": [{
        "attributes": {
            "POSITION": buffer.positions(&surface.positions),
            "NORMAL": buffer.vec3s(&surface.normals, Target::Vertices),
        },
        "indices": buffer.indices(&surface.indices),
        "material": material,
    }]})
}

/// Floor, ceiling and four walls, facing inwards; squares of side 1 of the mesh that is named for each.
pub(crate) fn walls(side_m: f32, height_m: f32, mesh: impl Fn(usize) -> usize) -> Vec<Value> {
    let quat = |axis: Vec3, degrees: f32| {
        glam::Quat::from_axis_angle(axis, degrees.to_radians()).normalize().to_array()
    };
    let place = |which: usize, at: [f32; 3], rotation: [f32; 4], scale: [f32; 3]| json!({"mesh": mesh(which), "translation": at, "rotation": rotation, "scale": scale});
    let (half, middle) = (0.5 * side_m, 0.5 * height_m);
    let mut nodes = vec![
        place(0, [0.0; 3], quat(Vec3::X, -90.0), [side_m, side_m, 1.0]),
        place(1, [0.0, height_m, 0.0], quat(Vec3::X, 90.0), [side_m, side_m, 1.0]),
    ];
    nodes.extend((0..4u8).map(|side| {
        let turn = glam::Quat::from_rotation_y(f32::from(side) * TAU / 4.0);
        let at = turn * Vec3::new(0.0, middle, -half);
        place(2 + usize::from(side), at.to_array(), turn.to_array(), [side_m, height_m, 1.0])
    }));
    nodes
}

/// Those before one wall.
fn vases(side: u8, [columns, rows]: [usize; 2]) -> Vec<Value> {
    let turn = glam::Quat::from_rotation_y(f32::from(side) * TAU / 4.0);
    let place = |column: usize, row: usize| {
        let x = (column as f32 + 0.5) / columns as f32 - 0.5;
        let at = turn * Vec3::new(x * (SIDE_M - 1.6), 0.15 + row as f32 * 0.95, 0.6 - 0.5 * SIDE_M);
        json!({"mesh": 1, "translation": at.to_array()})
    };
    (0..rows)
        .flat_map(|row| (0..columns).map(move |column| (column, row)))
        .map(|(c, r)| place(c, r))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::load::{SceneSource, load_scene};

    #[test]
    fn there_is_much_to_see_on_every_side_and_it_faces_the_viewer() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = write_room(folder.path(), MANY_VASES).expect("written");
        let scene = load_scene(&SceneSource::File(path)).expect("valid");
        let triangles: usize = scene.models.iter().map(|model| model.indices.len() / 3).sum();
        assert!(triangles > 200_000, "{triangles} triangles");
        let inside = Vec3::new(0.0, 1.6, 0.0);
        let surface = wall();
        for (corner, node) in walls(SIDE_M, HEIGHT_M, |_| 0).iter().enumerate() {
            let of = |key: &str| -> Vec<f32> { serde_json::from_value(node[key].clone()).expect("numbers") };
            let turn = glam::Quat::from_slice(&of("rotation"));
            let normal = turn * surface.normals[0];
            let towards = inside - Vec3::from_slice(&of("translation"));
            assert!(normal.dot(towards) > 0.0, "wall {corner} looks away");
        }
    }
}

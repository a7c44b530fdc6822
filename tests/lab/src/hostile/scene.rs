//! The scene under attack: one turning cube. It costs a slow device little, so the attack dominates the measurement.

use anyhow::Context;
use glam::{Quat, Vec3};
use serde_json::json;
use shadecast_dragon::glb::Buffer;
use std::f32::consts::TAU;
use std::path::{Path, PathBuf};

/// Half a side of the cube, metres.
const HALF_M: f32 = 0.5;

/// Writes the scene into a folder, and gives its path.
pub(crate) fn write(folder: &Path) -> anyhow::Result<PathBuf> {
    let path = folder.join("turning-cube.glb");
    std::fs::write(&path, turning_cube()).with_context(|| format!("writing {}", path.display()))?;
    Ok(path)
}

fn turning_cube() -> Vec<u8> {
    let (positions, indices) = cube();
    let times = [0.0, 1.0, 2.0, 3.0, 4.0];
    let turns = times.map(|time: f32| Quat::from_rotation_y(time / 4.0 * TAU));
    let mut buffer = Buffer::default();
    let (position, index) = (buffer.positions(&positions), buffer.indices(&indices));
    let (input, output) = (buffer.scalars(&times), buffer.quats(&turns));
    buffer.into_glb(json!({
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [0.0, HALF_M, 0.0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": position}, "indices": index}]}],
        "animations": [{
            "name": "turning",
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "rotation"}}],
            "samplers": [{"input": input, "output": output}]
        }]
    }))
}

/// Six faces of four vertices and two triangles each, counter-clockwise from outside.
fn cube() -> (Vec<Vec3>, Vec<u16>) {
    let (mut positions, mut indices) = (Vec::new(), Vec::new());
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let normal = Vec3::AXES[axis] * side;
            let right = Vec3::AXES[(axis + 1) % 3];
            let up = normal.cross(right);
            let first = positions.len() as u16;
            positions.extend(
                [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
                    .map(|[x, y]| (normal + right * x + up * y) * HALF_M),
            );
            indices.extend([0, 1, 2, 0, 2, 3].map(|corner| first + corner));
        }
    }
    (positions, indices)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_faces_of_the_cube_look_outwards() {
        let (positions, indices) = cube();
        for triangle in indices.chunks(3) {
            let [a, b, c] = [0, 1, 2].map(|corner| positions[usize::from(triangle[corner])]);
            assert!((b - a).cross(c - a).dot(a + b + c) > 0.0, "{a} {b} {c}");
        }
    }

    #[test]
    fn the_scene_can_be_loaded_and_moves() {
        let folder = tempfile::tempdir().unwrap();
        let source = write(folder.path()).unwrap().display().to_string().parse().unwrap();
        let scene = shadecast_scene::load::load_scene(&source).unwrap();
        assert!(!scene.instances.is_empty());
    }
}

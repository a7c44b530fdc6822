//! Surfaces over a grid of points.

use glam::{Vec2, Vec3};

/// A mesh with smooth normals.
#[derive(Clone, Debug, Default)]
pub struct Surface {
    /// Places of the vertices.
    pub positions: Vec<Vec3>,
    /// Unit length, one for each place.
    pub normals: Vec<Vec3>,
    /// Texture coordinates: u to the right, v down, 0..1 over the grid.
    pub uvs: Vec<Vec2>,
    /// Three for each triangle.
    pub indices: Vec<u16>,
}

impl Surface {
    /// Both together, without triangles that have no area.
    pub fn append(&mut self, other: Self) {
        let first = self.positions.len() as u16;
        let place = |corner: u16| other.positions[usize::from(corner)];
        let has_area = |t: &&[u16]| {
            let [a, b, c] = [place(t[0]), place(t[1]), place(t[2])];
            (b - a).cross(c - a).length_squared() > 1e-14
        };
        let kept = other.indices.chunks_exact(3).filter(has_area);
        self.indices.extend(kept.flatten().map(|corner| first + corner));
        self.positions.extend(other.positions.iter());
        self.normals.extend(other.normals);
        self.uvs.extend(other.uvs);
    }
}

/// `across` times `along` points; triangles face the side from which u runs to the right where v runs up.
pub fn surface(across: u16, along: u16, point: impl Fn(f32, f32) -> Vec3) -> Surface {
    const STEP: f32 = 1e-3;
    let mut surface = Surface::default();
    for row in 0..along {
        for column in 0..across {
            let (u, v) = (f32::from(column) / f32::from(across - 1), f32::from(row) / f32::from(along - 1));
            let by_u = point(u + STEP, v) - point(u - STEP, v);
            let by_v = point(u, v + STEP) - point(u, v - STEP);
            surface.positions.push(point(u, v));
            surface.normals.push(by_u.cross(by_v).normalize());
            surface.uvs.push(Vec2::new(u, 1.0 - v));
        }
    }
    for (row, column) in (0..along - 1).flat_map(|row| (0..across - 1).map(move |column| (row, column))) {
        let low = row * across + column;
        surface.indices.extend([low, low + 1, low + across, low + 1, low + across + 1, low + across]);
    }
    surface
}

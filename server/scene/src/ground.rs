//! The floor under the scene: a reference for distances, in cells that fit patches.

use super::{Bone, Material, Model, PaletteEntry, Primitive, Texture, Trs, Vertex, Wrap};
use glam::{Affine3A, Vec2, Vec3};

/// Side of a cell of two triangles, metres: the longest patch edge that the atlas likes.
pub const CELL_M: f32 = 0.5;

/// Default side of the ground, metres.
pub const DEFAULT_SIZE_M: f32 = 24.0;

/// Largest side of the ground, metres: 40,000 cells.
pub const MAX_SIZE_M: f32 = 100.0;

const TEXTURE_SIDE: u32 = 512;
/// One repetition of the texture covers this many metres: 128 texels per metre, enough from eye height.
const TEXTURE_M: f32 = 4.0;

/// A square of about `size_m` metres (whole cells, at least two) around the origin, facing up, at y = 0.
pub fn ground(size_m: f32) -> Model {
    let cells = ((size_m.clamp(2.0 * CELL_M, MAX_SIZE_M) / CELL_M).round() as u32).max(2);
    let indices = grid_indices(cells);
    let index_count = indices.len() as u32;
    Model {
        name: "ground".into(),
        bones: vec![Bone { name: "ground".into(), parent: None, rest: Trs::IDENTITY }],
        palette: vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }],
        vertices: grid_vertices(cells),
        indices,
        primitives: vec![Primitive { first_index: 0, index_count, material: 0 }],
        materials: vec![material()],
        textures: vec![texture()],
        ..Model::default()
    }
}

fn grid_vertices(cells: u32) -> Vec<Vertex> {
    let half_m = cells as f32 * CELL_M * 0.5;
    let at = |column: u32, row: u32| {
        let (x, z) = (column as f32 * CELL_M - half_m, row as f32 * CELL_M - half_m);
        Vertex {
            position: Vec3::new(x, 0.0, z),
            normal: Vec3::Y,
            // u grows with x, v with z: cross(y, x) = -z is where the picture's top lies.
            tangent: [1.0, 0.0, 0.0, 1.0],
            uv: [x / TEXTURE_M, z / TEXTURE_M],
            ..Vertex::default()
        }
    };
    (0..=cells).flat_map(|row| (0..=cells).map(move |column| at(column, row))).collect()
}

fn grid_indices(cells: u32) -> Vec<u32> {
    let cell = |row: u32, column: u32| {
        let corner = row * (cells + 1) + column;
        let below = corner + cells + 1;
        [corner, below, corner + 1, corner + 1, below, below + 1]
    };
    (0..cells).flat_map(|row| (0..cells).flat_map(move |column| cell(row, column))).collect()
}

fn material() -> Material {
    Material {
        name: "ground".into(),
        roughness: 0.9,
        base_color_texture: Some(0.into()),
        ..Material::default()
    }
}

fn texture() -> Texture {
    let texel_m = TEXTURE_M / TEXTURE_SIDE as f32;
    let centre_m = |index: u32| (index as f32 + 0.5) * texel_m;
    let texel = |row: u32, column: u32| {
        let [r, g, b] = colour(Vec2::new(centre_m(column), centre_m(row))).to_array();
        [r, g, b, 1.0].map(|value| (value * 255.0 + 0.5) as u8)
    };
    let rows = (0..TEXTURE_SIDE).flat_map(|row| (0..TEXTURE_SIDE).flat_map(move |column| texel(row, column)));
    Texture {
        name: "ground".into(),
        extent_texels: [TEXTURE_SIDE; 2],
        rgba8: rows.collect(),
        srgb: true,
        wrap: [Wrap::Repeat; 2],
    }
}

/// sRGB-coded colour at a place in metres: stone tiles of one metre in a few shades, wide soft joints, slow noise.
/// Nothing is finer than some 6 cm: the picture is resampled into the atlas and coded as video, and fine grain would
/// cost bits and shimmer without being seen.
fn colour(at_m: Vec2) -> Vec3 {
    let tile = at_m.floor();
    let shade = hash(tile.x as i32, tile.y as i32, 1);
    let warm = hash(tile.x as i32, tile.y as i32, 2) - 0.5;
    let to_joint = (at_m - at_m.round()).abs().min_element();
    let joint = 1.0 - smooth_step(0.015, 0.075, to_joint);
    let cloud = 0.6 * noise(at_m, 1.0, 3) + 0.4 * noise(at_m, 0.25, 4) - 0.5;
    // A tile's own shade fades out towards the joint, so that two tiles do not meet in a hard edge.
    let own = (1.0 - joint) * (0.055 * (shade - 0.5) + 0.03 * warm * Vec3::new(1.0, 0.1, -0.9));
    let stone = Vec3::new(0.56, 0.545, 0.515) + own;
    (stone + 0.06 * cloud - 0.11 * joint).clamp(Vec3::ZERO, Vec3::ONE)
}

/// Value noise of the given wavelength, 0 to 1, periodic over the texture.
fn noise(at_m: Vec2, wavelength_m: f32, seed: u32) -> f32 {
    let place = at_m / wavelength_m;
    let cell = place.floor();
    let within = place - cell;
    let blend = within * within * (3.0 - 2.0 * within);
    let period = (TEXTURE_M / wavelength_m) as i32;
    let corner = |dx: i32, dy: i32| {
        hash((cell.x as i32 + dx).rem_euclid(period), (cell.y as i32 + dy).rem_euclid(period), seed)
    };
    let top = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * blend.x;
    let bottom = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * blend.x;
    top + (bottom - top) * blend.y
}

/// 0 to 1; the integer mix is Wellons' lowbias32.
fn hash(x: i32, y: i32, seed: u32) -> f32 {
    let mut bits = (x as u32).wrapping_mul(0x9e37_79b9) ^ (y as u32).wrapping_mul(0x85eb_ca6b) ^ (seed << 24);
    bits = (bits ^ bits >> 16).wrapping_mul(0x7feb_352d);
    bits = (bits ^ bits >> 15).wrapping_mul(0x846c_a68b);
    bits ^= bits >> 16;
    (bits >> 8) as f32 / (1 << 24) as f32
}

fn smooth_step(from: f32, to: f32, value: f32) -> f32 {
    let t = ((value - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ground_faces_up_and_its_sides_are_half_a_metre() {
        let ground = ground(DEFAULT_SIZE_M);
        assert_eq!((ground.vertices.len(), ground.indices.len()), (49 * 49, 48 * 48 * 6));
        for triangle in ground.indices.chunks_exact(3) {
            let [a, b, c] = [0, 1, 2].map(|i| ground.vertices[triangle[i] as usize].position);
            assert!((b - a).cross(c - a).y > 0.0);
            let mut sides = [a.distance(b), b.distance(c), c.distance(a)];
            sides.sort_by(f32::total_cmp);
            assert!(sides[1] <= CELL_M + 1e-4 && sides[2] < CELL_M * 1.42);
        }
    }

    #[test]
    fn texture_has_low_contrast_and_repeats_without_a_step() {
        let Texture { rgba8, .. } = texture();
        let texel = |row: u32, column: u32| i32::from(rgba8[((row * TEXTURE_SIDE + column) * 4) as usize]);
        let last = TEXTURE_SIDE - 1;
        for index in 0..TEXTURE_SIDE {
            assert!((texel(index, 0) - texel(index, last)).abs() <= 4, "left and right edge at {index}");
            assert!((texel(0, index) - texel(last, index)).abs() <= 4, "top and bottom edge at {index}");
        }
        let mut largest_step = 0;
        for row in 0..TEXTURE_SIDE {
            for column in 1..TEXTURE_SIDE {
                largest_step = largest_step.max((texel(row, column) - texel(row, column - 1)).abs());
            }
        }
        assert!(largest_step <= 8, "steps between texels of {largest_step}");
        let (low, high) =
            (0..TEXTURE_SIDE).map(|i| texel(i, i)).fold((255, 0), |(l, h), v| (l.min(v), h.max(v)));
        assert!(high - low < 70 && low > 60, "from {low} to {high}");
    }

    #[test]
    fn absurd_sizes_are_brought_into_range() {
        assert_eq!(ground(0.0).indices.len(), 2 * 2 * 6);
        assert_eq!(ground(1e9).indices.len(), 200 * 200 * 6);
    }
}

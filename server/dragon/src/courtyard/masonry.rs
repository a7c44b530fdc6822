//! Walls with arches, their roofs, and what stands on the ground.

use super::export::{self, Material, Piece};
use super::paint::{self, DRESSED_M, FLAGS_M, GRASS_M, STONE_M, TILES_M};
use super::shapes::{block, pyramid, rectangle, turned};
use super::wall::{Face, Opening};
use crate::curve::{lerp, smoothstep};
use crate::surface::Surface;
use glam::{Vec2, Vec3, vec2, vec3};

/// Inner faces of the walls, metres: left and right in x, behind the user and ahead in z.
const HALF_WIDTH_M: f32 = 5.0;
const NEAR_M: f32 = 1.2;
const FAR_M: f32 = -9.0;
const THICKNESS_M: f32 = 0.6;
const HEIGHT_M: f32 = 3.6;
const FAR_HEIGHT_M: f32 = 4.6;
/// Height of the landing at the far gate.
const LANDING_M: f32 = 0.45;
/// From the walls to the end of the grass.
const MEADOW_M: f32 = 9.0;

/// Where the tree stands, and the pedestal.
const PLANTER: Vec2 = vec2(2.9, -5.9);
const PLANTER_RADIUS_M: f32 = 0.95;
const PEDESTAL: Vec2 = vec2(-2.5, -4.6);
/// Height of its top, metres.
const PEDESTAL_M: f32 = 0.85;

/// Masonry by material.
#[derive(Default)]
struct Yard {
    stone: Surface,
    dressed: Surface,
    tiles: Surface,
    soil: Surface,
}

/// The bytes of a GLB file with everything of stone but the ground.
pub(crate) fn masonry() -> Vec<u8> {
    let mut yard = Yard::default();
    for (face, thickness_m) in [left(), far(), right(), near()].map(|face| (face, THICKNESS_M)) {
        yard.wall(&face, thickness_m);
    }
    for [x, z] in [[-1.0, 1.0], [1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]] {
        yard.tower(vec2(x, z));
    }
    yard.steps();
    yard.pedestal();
    yard.planter();
    yard.bench();
    let piece = |material, surface| Piece { material, surface };
    let pieces = vec![
        piece(Material::painted("stone", paint::stone(), 0.92), yard.stone),
        piece(Material::painted("dressed stone", paint::dressed(), 0.85), yard.dressed),
        piece(Material::painted("tiles", paint::tiles(), 0.85), yard.tiles),
        piece(Material::painted("soil", paint::grass(), 0.95), yard.soil),
    ];
    // Darker at the foot, where walls and ground hide the sky from each other.
    export::glb("masonry", pieces, None, |at| lerp(0.62, 1.0, smoothstep(-0.1, 0.8, at.y)))
}

/// The bytes of a GLB file with the flagstones and the grass around them.
pub(crate) fn paving() -> Vec<u8> {
    let (half_m, near_m, far_m) = (HALF_WIDTH_M + THICKNESS_M, NEAR_M + THICKNESS_M, FAR_M - THICKNESS_M);
    let flags = flat(vec2(-half_m, far_m), vec2(half_m, near_m), 0.0, FLAGS_M);
    let mut grass = Surface::default();
    let wide_m = half_m + MEADOW_M;
    for (low, high) in [
        (vec2(-wide_m, far_m), vec2(-half_m, near_m)),
        (vec2(half_m, far_m), vec2(wide_m, near_m)),
        (vec2(-wide_m, far_m - MEADOW_M), vec2(wide_m, far_m)),
        (vec2(-wide_m, near_m), vec2(wide_m, near_m + MEADOW_M)),
    ] {
        grass.append(flat(low, high, -0.03, GRASS_M));
    }
    let pieces = vec![
        Piece { material: Material::painted("flagstones", paint::flags(), 0.8), surface: flags },
        Piece { material: Material::painted("grass", paint::grass(), 0.95), surface: grass },
    ];
    export::glb("paving", pieces, None, open_ground)
}

/// Of the sky, at a place of the ground.
fn open_ground(at: Vec3) -> f32 {
    let place = vec2(at.x, at.z);
    let to_sides = (HALF_WIDTH_M - at.x.abs()).abs().min((at.z - FAR_M).abs()).min((at.z - NEAR_M).abs());
    let to_pedestal = (place - PEDESTAL).abs().max_element() - 0.5;
    let to_planter = place.distance(PLANTER) - PLANTER_RADIUS_M;
    lerp(0.6, 1.0, smoothstep(0.0, 0.9, to_sides))
        * lerp(0.6, 1.0, smoothstep(0.0, 0.6, to_pedestal.min(to_planter)))
}

/// Horizontal, facing up; x and z from corner to corner.
fn flat(low: Vec2, high: Vec2, y: f32, texture_m: f32) -> Surface {
    let size = high - low;
    rectangle(vec3(low.x, y, high.y), Vec3::X * size.x, Vec3::NEG_Z * size.y, texture_m)
}

fn arch(middle_m: f32, width_m: f32, sill_m: f32, spring_m: f32) -> Opening {
    Opening { middle_m, width_m, sill_m, spring_m, depth_m: THICKNESS_M, is_niche: false }
}

fn niche(middle_m: f32, width_m: f32, sill_m: f32, spring_m: f32) -> Opening {
    Opening { depth_m: 0.22, is_niche: true, ..arch(middle_m, width_m, sill_m, spring_m) }
}

/// An arcade, through which the sun comes.
fn left() -> Face {
    Face {
        corner: vec3(-HALF_WIDTH_M, 0.0, NEAR_M),
        along: Vec3::NEG_Z,
        length_m: NEAR_M - FAR_M,
        height_m: HEIGHT_M,
        openings: (0..4u8).map(|arc| arch(1.275 + 2.55 * f32::from(arc), 1.8, 0.7, 1.9)).collect(),
    }
}

/// A gate between two niches.
fn far() -> Face {
    Face {
        corner: vec3(-HALF_WIDTH_M, 0.0, FAR_M),
        along: Vec3::X,
        length_m: 2.0 * HALF_WIDTH_M,
        height_m: FAR_HEIGHT_M,
        openings: vec![niche(2.1, 1.1, 1.0, 2.3), arch(5.0, 2.3, LANDING_M, 2.3), niche(7.9, 1.1, 1.0, 2.3)],
    }
}

/// Blind arches.
fn right() -> Face {
    Face {
        corner: vec3(HALF_WIDTH_M, 0.0, FAR_M),
        along: Vec3::Z,
        length_m: NEAR_M - FAR_M,
        height_m: HEIGHT_M,
        openings: [1.9, 5.1, 8.3].map(|middle_m| niche(middle_m, 1.9, 0.0, 1.9)).to_vec(),
    }
}

/// The gate by which the user has come.
fn near() -> Face {
    Face {
        corner: vec3(HALF_WIDTH_M, 0.0, NEAR_M),
        along: Vec3::NEG_X,
        length_m: 2.0 * HALF_WIDTH_M,
        height_m: HEIGHT_M,
        openings: vec![arch(HALF_WIDTH_M, 1.8, 0.0, 1.85)],
    }
}

impl Yard {
    fn wall(&mut self, face: &Face, thickness_m: f32) {
        let back = face.back(thickness_m, 0.0);
        for side in [face, &back] {
            self.stone.append(side.plane(STONE_M));
            self.dressed.append(side.bands(DRESSED_M));
        }
        self.stone.append(face.reveals(STONE_M));
        self.roof(face, thickness_m);
    }

    /// A saddle of tiles along a wall.
    fn roof(&mut self, face: &Face, thickness_m: f32) {
        const OVER_M: f32 = 0.14;
        const RIDGE_M: f32 = 0.30;
        const EDGE_M: f32 = 0.06;
        for side in [face.clone(), face.back(thickness_m, 0.0)] {
            let right = side.along * side.length_m;
            let eaves = side.at(0.0, side.height_m, -OVER_M);
            let ridge = side.at(0.0, side.height_m + RIDGE_M, 0.5 * thickness_m);
            let edge = Vec3::Y * EDGE_M;
            self.dressed.append(rectangle(eaves, right, edge, DRESSED_M));
            self.tiles.append(rectangle(eaves + edge, right, ridge - eaves - edge, TILES_M));
            // The underside of the eaves.
            let wall = side.at(0.0, side.height_m, 0.0);
            self.dressed.append(rectangle(wall, right, eaves - wall, DRESSED_M));
        }
    }

    /// At the corner on this side in x and z.
    fn tower(&mut self, side: Vec2) {
        const HALF_M: f32 = 0.5;
        const EAVES_M: f32 = 0.66;
        let z = if side.y > 0.0 { NEAR_M + 0.5 * THICKNESS_M } else { FAR_M - 0.5 * THICKNESS_M };
        let foot = vec3(side.x * (HALF_WIDTH_M + 0.5 * THICKNESS_M), 0.0, z);
        let height_m = FAR_HEIGHT_M + 0.35;
        let half = vec3(HALF_M, 0.0, HALF_M);
        self.stone.append(block(foot - half, foot + half + Vec3::Y * height_m, STONE_M));
        let eaves = foot + Vec3::Y * height_m;
        self.tiles.append(pyramid(eaves, EAVES_M, 0.62, TILES_M));
        let corner = eaves - vec3(EAVES_M, 0.0, EAVES_M);
        let side = 2.0 * EAVES_M;
        self.dressed.append(rectangle(corner, Vec3::X * side, Vec3::Z * side, DRESSED_M));
    }

    /// Up to the far gate, and a terrace behind it.
    fn steps(&mut self) {
        for step in 0..3u8 {
            let share = f32::from(step);
            let half_m = 1.9 - 0.2 * share;
            let low = vec3(-half_m, LANDING_M / 3.0 * share, FAR_M - 0.02);
            let high = vec3(half_m, LANDING_M / 3.0 * (share + 1.0), FAR_M + 1.15 - 0.36 * share);
            self.dressed.append(block(low, high, DRESSED_M));
        }
        let behind_m = FAR_M - THICKNESS_M;
        let terrace =
            block(vec3(-1.8, -0.1, behind_m - 2.0), vec3(1.8, LANDING_M, behind_m + 0.02), DRESSED_M);
        self.dressed.append(terrace);
    }

    fn pedestal(&mut self) {
        let foot = vec3(PEDESTAL.x, 0.0, PEDESTAL.y);
        for (half_m, low_m, high_m) in [(0.56, 0.0, 0.16), (0.44, 0.16, 0.70), (0.52, 0.70, PEDESTAL_M)] {
            let half = vec3(half_m, 0.0, half_m);
            let low = foot - half + Vec3::Y * low_m;
            self.dressed.append(block(low, foot + half + Vec3::Y * high_m, DRESSED_M));
        }
        // The underside of the slab.
        let corner = foot + vec3(-0.52, 0.70, -0.52);
        self.dressed.append(rectangle(corner, Vec3::X * 1.04, Vec3::Z * 1.04, DRESSED_M));
    }

    fn planter(&mut self) {
        let foot = vec3(PLANTER.x, 0.0, PLANTER.y);
        let outer_m = PLANTER_RADIUS_M;
        let inner_m = outer_m - 0.2;
        let ring = [[outer_m, 0.0], [outer_m, 0.42], [inner_m, 0.42], [inner_m, 0.32]];
        self.dressed.append(turned(foot, &ring, 24, DRESSED_M));
        self.soil.append(turned(foot, &[[inner_m, 0.34], [0.0, 0.38]], 24, GRASS_M));
    }

    /// Before the right wall.
    fn bench(&mut self) {
        let middle = vec3(HALF_WIDTH_M - 0.32, 0.0, -2.3);
        for z in [-0.75, 0.75] {
            let foot = middle + Vec3::Z * z;
            let half = vec3(0.2, 0.0, 0.12);
            self.dressed.append(block(foot - half, foot + half + Vec3::Y * 0.40, DRESSED_M));
        }
        let (half, low) = (vec3(0.26, 0.0, 1.05), middle + Vec3::Y * 0.40);
        self.dressed.append(block(low - half, low + half + Vec3::Y * 0.09, DRESSED_M));
        self.dressed.append(rectangle(low - half, Vec3::X * 0.52, Vec3::Z * 2.1, DRESSED_M));
    }
}

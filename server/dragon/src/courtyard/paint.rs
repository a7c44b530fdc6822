//! Colours and reliefs of what the courtyard is made of, as functions of a place in metres. Colours are sRGB-coded, 0..1.
//!
//! Every pattern repeats without a seam after its texture's side. Nothing is finer than 2 cm: video codes finer grain badly.

use crate::curve::{lerp, smoothstep};
use crate::noise::{chance, tiled_noise};
use crate::picture;
use glam::{Vec2, Vec3, vec3};

/// A picture of a surface, and its normal map.
pub(super) struct Painted {
    pub color_png: Vec<u8>,
    pub normal_png: Option<Vec<u8>>,
}

/// One texel.
#[derive(Clone, Copy, Debug)]
struct Texel {
    color: Vec3,
    /// Relief, metres outwards.
    height_m: f32,
}

/// A texture's side in texels and metres.
#[derive(Clone, Copy, Debug)]
struct Size {
    texels: u32,
    side_m: f32,
}

/// Sides of the textures, metres.
pub(super) const STONE_M: f32 = 2.56;
pub(super) const FLAGS_M: f32 = 3.2;
pub(super) const DRESSED_M: f32 = 1.2;
pub(super) const TILES_M: f32 = 1.4;
pub(super) const GRASS_M: f32 = 2.0;
pub(super) const BARK_M: f32 = 0.8;

const MOSS: Vec3 = vec3(0.33, 0.36, 0.17);

/// Squared blocks in courses.
pub(super) fn stone() -> Painted {
    painted(Size { texels: 1024, side_m: STONE_M }, |at| {
        const COURSES: i32 = 8;
        const BLOCKS: i32 = 4;
        let course = (at.y / STONE_M * COURSES as f32).floor() as i32;
        let joint = |block: i32| {
            let wrapped = block.rem_euclid(BLOCKS);
            let off = 0.5 * (course % 2) as f32 + 0.34 * (chance(wrapped, course, 1) - 0.5);
            (block as f32 + off) * STONE_M / BLOCKS as f32
        };
        let block = (-1..=BLOCKS).rev().find(|block| joint(*block) <= at.x).unwrap_or(-1);
        let course_m = STONE_M / COURSES as f32;
        let from_joint = Vec2::new(
            (at.x - joint(block)).min(joint(block + 1) - at.x),
            (at.y - course as f32 * course_m).min((course + 1) as f32 * course_m - at.y),
        );
        let number = block.rem_euclid(BLOCKS);
        let cloud = clouds(at, STONE_M, 10);
        let edge_m = rounded(from_joint, 0.03) + 0.008 * (fine(at, STONE_M, 11) - 0.5);
        let face = smoothstep(0.002, 0.016, edge_m);
        let tint = lerp(0.80, 1.10, chance(number, course, 2));
        let warm = chance(number, course, 3) - 0.5;
        let block_color = vec3(0.70, 0.60, 0.46) * tint + warm * vec3(0.05, 0.0, -0.05);
        let mortar = vec3(0.52, 0.47, 0.40);
        let color = mortar.lerp(block_color, face)
            * lerp(0.78, 1.16, cloud)
            * lerp(0.92, 1.08, fine(at, STONE_M, 16));
        let moss = smoothstep(0.60, 0.80, clouds(at, STONE_M, 14) + 0.14 * (1.0 - face));
        Texel {
            color: color.lerp(MOSS * lerp(0.7, 1.2, fine(at, STONE_M, 15)), 0.75 * moss),
            height_m: 0.011 * face + 0.007 * cloud + 0.003 * fine(at, STONE_M, 16),
        }
    })
}

/// Flagstones: squares, some of them of two or four pieces.
pub(super) fn flags() -> Painted {
    painted(Size { texels: 1024, side_m: FLAGS_M }, |at| {
        const ACROSS: i32 = 4;
        let cell_m = FLAGS_M / ACROSS as f32;
        let cell = (at / cell_m).floor();
        let within = at - cell * cell_m;
        let [x, y] = cell.as_ivec2().to_array();
        let kind = chance(x, y, 20);
        let pieces = [1.0 + f32::from(kind > 0.35), 1.0 + f32::from(!(0.15..=0.7).contains(&kind))];
        let size = Vec2::new(cell_m / pieces[0], cell_m / pieces[1]);
        let piece = (within / size).floor();
        let inside = within - piece * size;
        let from_joint = inside.min(size - inside);
        let number = (2 * x + piece.x as i32, 2 * y + piece.y as i32);
        let cloud = clouds(at, FLAGS_M, 24);
        let edge_m = rounded(from_joint, 0.05) + 0.012 * (fine(at, FLAGS_M, 25) - 0.5);
        let face = smoothstep(0.004, 0.018, edge_m);
        let tint = lerp(0.78, 1.12, chance(number.0, number.1, 21));
        let warm = chance(number.0, number.1, 22) - 0.4;
        let flag = vec3(0.58, 0.52, 0.45) * tint + warm * vec3(0.07, 0.0, -0.05);
        let moss = smoothstep(0.42, 0.66, clouds(at, FLAGS_M, 26));
        let joint = vec3(0.27, 0.24, 0.19).lerp(MOSS, moss);
        let worn = lerp(0.82, 1.12, cloud);
        Texel {
            color: joint.lerp(flag * worn, face),
            height_m: 0.009 * face + 0.006 * cloud + 0.003 * chance(number.0, number.1, 23),
        }
    })
}

/// Smooth stones, each as long as half the texture.
pub(super) fn dressed() -> Painted {
    painted(Size { texels: 512, side_m: DRESSED_M }, |at| {
        let stone_m = 0.5 * DRESSED_M;
        let number = (at.x / stone_m).floor() as i32;
        let inside_m = at.x - number as f32 * stone_m;
        let face = smoothstep(0.001, 0.010, inside_m.min(stone_m - inside_m));
        let cloud = clouds(at, DRESSED_M, 30);
        let color =
            vec3(0.77, 0.70, 0.58) * lerp(0.92, 1.05, chance(number, 0, 31)) * lerp(0.80, 1.10, cloud);
        Texel { color: color * lerp(0.62, 1.0, face), height_m: 0.004 * face + 0.003 * cloud }
    })
}

/// Rows of half-round roof tiles.
pub(super) fn tiles() -> Painted {
    painted(Size { texels: 512, side_m: TILES_M }, |at| {
        const COLUMNS: i32 = 7;
        const ROWS: i32 = 4;
        let place = at / TILES_M * Vec2::new(COLUMNS as f32, ROWS as f32);
        let cell = place.floor();
        let within = place - cell;
        let across = 2.0 * within.x - 1.0;
        let round = (1.0 - (across / 0.92).powi(2)).max(0.0).sqrt();
        let lip = smoothstep(0.0, 0.10, 1.0 - within.y);
        let [column, row] = cell.as_ivec2().to_array();
        let tint = lerp(0.74, 1.12, chance(column, row, 40));
        let cloud = clouds(at, TILES_M, 41);
        let terracotta = vec3(0.68, 0.36, 0.23).lerp(vec3(0.56, 0.40, 0.30), chance(column, row, 42));
        let color = terracotta * tint * lerp(0.8, 1.15, cloud) * lerp(0.42, 1.0, round) * lerp(0.5, 1.0, lip);
        let lichen = smoothstep(0.66, 0.82, clouds(at, TILES_M, 43));
        Texel {
            color: color.lerp(vec3(0.55, 0.53, 0.38) * lerp(0.6, 1.0, round), 0.7 * lichen),
            height_m: 0.055 * round + 0.02 * within.y * lip,
        }
    })
}

/// Short grass.
pub(super) fn grass() -> Painted {
    let size = Size { texels: 512, side_m: GRASS_M };
    let made = painted(size, |at| {
        let cloud = clouds(at, GRASS_M, 50);
        let blades = fine(at, GRASS_M, 51);
        let color = vec3(0.26, 0.31, 0.12).lerp(vec3(0.46, 0.43, 0.20), cloud) * lerp(0.72, 1.2, blades);
        Texel { color, height_m: 0.0 }
    });
    Painted { normal_png: None, ..made }
}

/// Furrowed along v.
pub(super) fn bark() -> Painted {
    painted(Size { texels: 256, side_m: BARK_M }, |at| {
        let waves = (BARK_M / 0.05) as i32;
        let bent = Vec2::new(at.x * waves as f32 / BARK_M, at.y * (waves / 4) as f32 / BARK_M);
        let furrow = smoothstep(0.25, 0.7, tiled_noise(bent, waves, 60).max(0.0));
        let cloud = clouds(at, BARK_M, 61);
        let color = vec3(0.25, 0.19, 0.14).lerp(vec3(0.50, 0.42, 0.33), furrow) * lerp(0.8, 1.15, cloud);
        Texel { color, height_m: 0.012 * furrow }
    })
}

/// The leaves of a twig, on nothing.
pub(super) struct Twig {
    pub leaves: u16,
    /// Length and width of a leaf in parts of the picture's side.
    pub leaf: [f32; 2],
    /// From the darkest to the brightest.
    pub colors: [Vec3; 2],
    pub seed: i32,
}

impl Twig {
    /// An RGBA picture. What is between the leaves has their colour too, so coarse mip levels stay green.
    pub fn paint(&self) -> Painted {
        const TEXELS: u32 = 256;
        let texel = |index: u32| {
            let at = Vec2::new((index % TEXELS) as f32 + 0.5, (index / TEXELS) as f32 + 0.5) / TEXELS as f32;
            let leaf = self.color(at);
            let [r, g, b] = bytes(leaf.unwrap_or(self.colors[0].lerp(self.colors[1], 0.35)));
            [r, g, b, if leaf.is_some() { 255 } else { 0 }]
        };
        let rgba: Vec<u8> = (0..TEXELS * TEXELS).flat_map(texel).collect();
        Painted { color_png: picture::png(&rgba, TEXELS), normal_png: None }
    }

    /// Of the uppermost leaf there.
    fn color(&self, at: Vec2) -> Option<Vec3> {
        (0..self.leaves).rev().find_map(|leaf| self.leaf(leaf, at))
    }

    fn leaf(&self, leaf: u16, at: Vec2) -> Option<Vec3> {
        let of = |what: i32| chance(i32::from(leaf), what, self.seed);
        // Around the middle by the golden angle, the outer ones first: so each is beside its neighbours.
        let share = (f32::from(leaf) + 0.5) / f32::from(self.leaves);
        let (sin, cos) = (2.39996 * f32::from(leaf) + 0.7 * (of(0) - 0.5)).sin_cos();
        let reach = (0.5 - 0.55 * self.leaf[0]) * (1.0 - share).sqrt();
        let foot = Vec2::splat(0.5) + Vec2::new(cos, sin) * reach;
        let turn = Vec2::from_angle(sin.atan2(cos) + 1.4 * (of(1) - 0.5));
        let length = self.leaf[0] * lerp(0.8, 1.0, of(2));
        let off = (at - foot).rotate(Vec2::new(turn.x, -turn.y)) / length;
        let along = off.x + 0.5;
        if !(0.0..=1.0).contains(&along) {
            return None;
        }
        // Widest at a third, pointed at the end.
        let half = self.leaf[1] / self.leaf[0]
            * 0.5
            * (1.0 - along).powf(0.7)
            * (along * 3.2).min(1.0).sqrt()
            * 1.25;
        if off.y.abs() > half {
            return None;
        }
        let rib = 1.0 - smoothstep(0.0, 0.05, off.y.abs());
        let color = self.colors[0].lerp(self.colors[1], of(3));
        Some(color * lerp(0.86, 1.1, along) * (1.0 + 0.25 * rib) * lerp(0.9, 1.0, share))
    }
}

/// Distance to the rim of a rectangle with round corners, metres inwards.
fn rounded(from_side: Vec2, radius_m: f32) -> f32 {
    let off = (Vec2::splat(radius_m) - from_side).max(Vec2::ZERO);
    if off.min_element() > 0.0 { radius_m - off.length() } else { from_side.min_element() }
}

/// Three octaves from half a metre down, 0..1.
fn clouds(at: Vec2, side_m: f32, seed: i32) -> f32 {
    let octave = |wave_m: f32, seed: i32| {
        let waves = (side_m / wave_m).round().max(1.0);
        tiled_noise(at * waves / side_m, waves as i32, seed)
    };
    0.5 * octave(0.55, seed) + 0.3 * octave(0.21, seed + 100) + 0.2 * octave(0.07, seed + 200)
}

/// One octave of grain, 0..1.
fn fine(at: Vec2, side_m: f32, seed: i32) -> f32 {
    let waves = (side_m / 0.03).round();
    tiled_noise(at * waves / side_m, waves as i32, seed)
}

fn painted(size: Size, texel: impl Fn(Vec2) -> Texel) -> Painted {
    let Size { texels, side_m } = size;
    let texel_m = side_m / texels as f32;
    let place =
        |index: u32| Vec2::new((index % texels) as f32 + 0.5, (index / texels) as f32 + 0.5) * texel_m;
    let all: Vec<Texel> = (0..texels * texels).map(|index| texel(place(index))).collect();
    let color: Vec<u8> = all.iter().flat_map(|texel| bytes(texel.color)).collect();
    let height = |x: u32, y: u32| all[((y % texels) * texels + x % texels) as usize].height_m;
    let normal = |index: u32| {
        let (x, y) = (index % texels, index / texels);
        let right = height(x + 1, y) - height(x + texels - 1, y);
        let down = height(x, y + 1) - height(x, y + texels - 1);
        // x to the right, y up, z out of the picture.
        bytes(Vec3::new(-right, down, 2.0 * texel_m).normalize() * 0.5 + 0.5)
    };
    let normal: Vec<u8> = (0..texels * texels).flat_map(normal).collect();
    Painted { color_png: picture::png(&color, texels), normal_png: Some(picture::png(&normal, texels)) }
}

fn bytes(color: Vec3) -> [u8; 3] {
    color.to_array().map(|channel| (channel.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
}

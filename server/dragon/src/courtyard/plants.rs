//! Foliage of cards: small squares with the picture of a twig, cut out by its alpha.

use super::export::{self, Material, Piece};
use super::paint::{self, BARK_M, Twig};
use super::shapes::{bar, turned};
use crate::curve::{lerp, smoothstep};
use crate::noise::chance;
use crate::surface::{Surface, surface};
use glam::{Quat, Vec3, vec3};
use std::f32::consts::{PI, TAU};

/// Side of a card of the tree, metres: with its diagonal still one patch.
const CARD_M: f32 = 0.35;

const TREE_TWIG: Twig = Twig {
    leaves: 26,
    leaf: [0.30, 0.13],
    colors: [vec3(0.20, 0.29, 0.10), vec3(0.50, 0.52, 0.18)],
    seed: 70,
};
const IVY_TWIG: Twig = Twig {
    leaves: 12,
    leaf: [0.36, 0.30],
    colors: [vec3(0.13, 0.23, 0.10), vec3(0.33, 0.43, 0.17)],
    seed: 71,
};
const CYPRESS_TWIG: Twig = Twig {
    leaves: 60,
    leaf: [0.34, 0.08],
    colors: [vec3(0.10, 0.17, 0.08), vec3(0.24, 0.31, 0.14)],
    seed: 72,
};

/// Balls of leaves that the crown is made of: middle, radius.
const CROWN: [(Vec3, f32); 7] = [
    (vec3(0.0, 2.75, 0.0), 0.85),
    (vec3(0.85, 2.45, 0.2), 0.68),
    (vec3(-0.80, 2.55, 0.25), 0.70),
    (vec3(0.15, 2.50, -0.85), 0.66),
    (vec3(-0.15, 2.40, 0.85), 0.64),
    (vec3(0.35, 3.35, -0.1), 0.62),
    (vec3(-0.40, 3.20, -0.2), 0.58),
];

/// A square with a twig: its middle, the way it faces, the normal it is lit by, the turn about where it faces, its side.
fn card(middle: Vec3, facing: Vec3, lit: Vec3, turn: f32, side_m: f32) -> Surface {
    let rotation = Quat::from_rotation_arc(Vec3::Z, facing) * Quat::from_rotation_z(turn);
    let mut made = surface(2, 2, |u, v| middle + rotation * vec3(u - 0.5, v - 0.5, 0.0) * side_m);
    made.normals = vec![lit; 4];
    made
}

/// Directions that are spread evenly, a little askew.
fn directions(count: u16, seed: i32) -> impl Iterator<Item = (i32, Vec3)> {
    (0..count).map(move |index| {
        let number = i32::from(index);
        let y = 1.0 - 2.0 * (f32::from(index) + chance(number, 0, seed)) / f32::from(count);
        let angle = 2.39996 * f32::from(index) + 0.8 * chance(number, 1, seed);
        let radius = (1.0 - y * y).max(0.0).sqrt();
        (number, vec3(radius * angle.cos(), y, radius * angle.sin()))
    })
}

/// Cards over a ball.
fn ball(middle: Vec3, radius_m: f32, count: u16, card_m: f32, seed: i32) -> Surface {
    let mut made = Surface::default();
    for (number, out) in directions(count, seed) {
        let of = |what: i32| chance(number, what, seed);
        let askew = (vec3(of(2), of(3), of(4)) - 0.5) * 1.1;
        let facing = (out + askew).normalize();
        let at = middle + out * radius_m * lerp(0.62, 1.0, of(5));
        // Lit as the ball is, with some of the card's own: leaves differ, and the ball is round.
        made.append(card(at, facing, (out + 0.5 * facing).normalize(), TAU * of(6), card_m));
    }
    made
}

/// The bytes of a GLB file with a tree, 4 m tall, standing on y = 0.
pub(crate) fn tree() -> Vec<u8> {
    let mut wood = bar(
        &[
            (Vec3::ZERO, 0.20),
            (vec3(0.03, 0.25, 0.02), 0.13),
            (vec3(-0.02, 0.9, 0.05), 0.11),
            (vec3(0.05, 1.5, 0.0), 0.095),
            (vec3(0.0, 2.7, 0.0), 0.04),
        ],
        10,
        BARK_M,
    );
    for (middle, _) in &CROWN[1..] {
        let root = vec3(0.03, 1.35 + 0.1 * middle.y.fract(), 0.01);
        let bend = root.lerp(*middle, 0.5) + Vec3::Y * 0.12;
        wood.append(bar(&[(root, 0.06), (bend, 0.045), (*middle, 0.015)], 6, BARK_M));
    }
    let mut leaves = Surface::default();
    for (seed, (middle, radius_m)) in (80..).zip(CROWN) {
        leaves.append(ball(middle, radius_m, (230.0 * radius_m * radius_m) as u16, CARD_M, seed));
    }
    let pieces = vec![
        Piece { material: Material::painted("bark", paint::bark(), 0.9), surface: wood },
        Piece { material: Material::leaves("leaves", TREE_TWIG.paint()), surface: leaves },
    ];
    // Darker inside the crown and below it.
    let middle = vec3(0.0, 2.75, 0.0);
    export::glb("tree", pieces, None, move |at| {
        let off = (at - middle) / vec3(1.5, 1.1, 1.5);
        let inside = lerp(0.45, 1.0, smoothstep(0.35, 1.0, off.length()))
            * lerp(0.7, 1.0, smoothstep(-0.9, 0.3, off.y));
        if at.y < 1.6 { 1.0 } else { inside }
    })
}

/// The bytes of a GLB file with ivy that hangs at a wall: 2 m wide, from y = 0 up to 2.6 m, in front of z = 0.
pub(crate) fn ivy() -> Vec<u8> {
    const COLUMNS: u16 = 17;
    const ROWS: u16 = 20;
    const SEED: i32 = 90;
    let mut leaves = Surface::default();
    for (row, column) in (0..ROWS).flat_map(|row| (0..COLUMNS).map(move |column| (row, column))) {
        let number = i32::from(row * COLUMNS + column);
        let of = |what: i32| chance(number, what, SEED);
        let [x, y] =
            [(of(0) + f32::from(column)) / f32::from(COLUMNS), (of(1) + f32::from(row)) / f32::from(ROWS)];
        // Each strand ends at another height, those in the middle lower.
        let end =
            lerp(0.08, 0.62, (2.0 * x - 1.0).powi(2)) + 0.35 * (chance(i32::from(column / 2), 7, SEED) - 0.5);
        if y < end || of(2) > lerp(0.55, 1.0, smoothstep(end, end + 0.35, y)) {
            continue;
        }
        let facing = vec3(1.1 * (of(3) - 0.5), 0.9 * (of(4) - 0.2), 1.0).normalize();
        let at = vec3(2.0 * x - 1.0, 2.6 * y, lerp(0.07, 0.14, of(5)));
        leaves.append(card(at, facing, facing, 0.9 * (of(6) - 0.5), lerp(0.19, 0.26, of(7))));
    }
    let pieces = vec![Piece { material: Material::leaves("ivy", IVY_TWIG.paint()), surface: leaves }];
    export::glb("ivy", pieces, None, |at| lerp(0.55, 1.0, smoothstep(0.05, 0.16, at.z)))
}

/// The bytes of a GLB file with a cypress, 5 m tall, standing on y = 0.
pub(crate) fn cypress() -> Vec<u8> {
    const CARDS: u16 = 480;
    const HEIGHT_M: f32 = 5.0;
    const RADIUS_M: f32 = 0.6;
    const SEED: i32 = 100;
    let mut leaves = Surface::default();
    for index in 0..CARDS {
        let of = |what: i32| chance(i32::from(index), what, SEED);
        let share = ((f32::from(index) + of(0)) / f32::from(CARDS)).powf(1.15);
        let radius_m =
            RADIUS_M * (PI * (0.12 + 0.88 * share)).sin().max(0.0).powf(0.7) * lerp(0.85, 1.0, of(1));
        let (sin, cos) = (2.39996 * f32::from(index)).sin_cos();
        let out = vec3(cos, 0.25, sin).normalize();
        let facing = (out + (vec3(of(2), of(3), of(4)) - 0.5) * 0.8).normalize();
        let at = vec3(cos * radius_m, 0.15 + (HEIGHT_M - 0.3) * share, sin * radius_m);
        leaves.append(card(at, facing, (out + 0.4 * facing).normalize(), 0.7 * (of(5) - 0.5), CARD_M));
    }
    let pieces = vec![Piece { material: Material::leaves("cypress", CYPRESS_TWIG.paint()), surface: leaves }];
    export::glb("cypress", pieces, None, |at| {
        lerp(0.6, 1.0, smoothstep(0.1, 0.6, vec3(at.x, 0.0, at.z).length()))
    })
}

/// The bytes of a GLB file with a shrub in a pot, 1.1 m tall, standing on y = 0.
pub(crate) fn pot() -> Vec<u8> {
    let outline =
        [[0.17, 0.0], [0.25, 0.36], [0.29, 0.37], [0.29, 0.43], [0.25, 0.43], [0.24, 0.38], [0.0, 0.39]];
    let clay = turned(Vec3::ZERO, &outline, 20, 1.0);
    let mut leaves = ball(vec3(0.0, 0.74, 0.0), 0.34, 120, 0.24, 110);
    leaves.append(ball(vec3(0.05, 0.98, 0.03), 0.2, 36, 0.22, 111));
    let pieces = vec![
        Piece { material: Material::plain("clay", [0.42, 0.16, 0.08], 0.8), surface: clay },
        Piece { material: Material::leaves("leaves", TREE_TWIG.paint()), surface: leaves },
    ];
    let middle = vec3(0.0, 0.78, 0.0);
    export::glb("pot", pieces, None, move |at| {
        if at.y < 0.38 {
            lerp(0.7, 1.0, smoothstep(0.0, 0.3, at.y))
        } else {
            lerp(0.4, 1.0, smoothstep(0.12, 0.38, at.distance(middle)))
        }
    })
}

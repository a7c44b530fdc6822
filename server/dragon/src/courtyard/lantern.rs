//! A lamp on a post.

use super::export::{self, Lamp, Material, Piece};
use super::shapes::{bar, turned};
use glam::{Vec3, vec3};
use std::f32::consts::TAU;

/// Sides of the lantern.
const SIDES: u16 = 6;
/// Lower and upper end of its glass: radius and height, metres.
const GLASS: [[f32; 2]; 2] = [[0.075, 2.18], [0.12, 2.45]];

/// The bytes of a GLB file with the lamp and its light, 2.7 m tall, standing on y = 0.
pub(crate) fn lantern() -> Vec<u8> {
    let post = [
        [0.17, 0.0],
        [0.17, 0.07],
        [0.11, 0.12],
        [0.075, 0.30],
        [0.045, 0.42],
        [0.035, 2.02],
        [0.06, 2.06],
        [0.035, 2.10],
        [0.085, 2.16],
        [0.085, 2.18],
        [0.0, 2.18],
    ];
    let roof = [[0.0, 2.45], [0.15, 2.45], [0.15, 2.47], [0.05, 2.58], [0.03, 2.66], [0.0, 2.68]];
    let mut iron = turned(Vec3::ZERO, &post, 16, 1.0);
    iron.append(turned(Vec3::ZERO, &roof, 2 * SIDES, 1.0));
    for side in 0..SIDES {
        let (sin, cos) = (TAU * f32::from(side) / f32::from(SIDES)).sin_cos();
        let ends = GLASS.map(|[radius_m, up_m]| (vec3(radius_m * sin, up_m, radius_m * cos), 0.009));
        iron.append(bar(&ends, 5, 1.0));
    }
    let glass = turned(Vec3::ZERO, &GLASS, SIDES, 1.0);
    let shining = Material { glow: [3.4, 1.7, 0.5], ..Material::plain("glass", [0.5, 0.4, 0.25], 0.3) };
    let pieces = vec![
        Piece {
            material: Material { metallic: 0.6, ..Material::plain("iron", [0.06, 0.055, 0.05], 0.55) },
            surface: iron,
        },
        Piece { material: shining, surface: glass },
    ];
    let lamp = Lamp { at: vec3(0.0, 2.3, 0.0), intensity: vec3(1.0, 0.56, 0.22) * 11.0, range_m: 9.0 };
    export::glb("lantern", pieces, Some(lamp), |_| 1.0)
}

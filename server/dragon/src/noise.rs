//! Numbers that look random and are the same at every call.

use crate::curve::lerp;
use glam::{IVec3, Vec2, Vec3};

/// Smooth value noise, 0..1, one wave per unit.
pub(crate) fn noise(point: Vec3) -> f32 {
    let base = point.floor();
    let f = point - base;
    let f = f * f * (3.0 - 2.0 * f);
    let lattice = base.as_ivec3();
    let at = |x: i32, y: i32, z: i32| unit(hash(lattice + IVec3::new(x, y, z)));
    let row = |y: i32, z: i32| lerp(at(0, y, z), at(1, y, z), f.x);
    let slice = |z: i32| lerp(row(0, z), row(1, z), f.y);
    lerp(slice(0), slice(1), f.z)
}

/// Another number for each lattice point.
pub(crate) fn hash(lattice: IVec3) -> u32 {
    let [x, y, z] = lattice.to_array().map(|axis| axis as u32);
    let mut h = x.wrapping_mul(0x8DA6_B343) ^ y.wrapping_mul(0xD816_3841) ^ z.wrapping_mul(0xCB1A_B31F);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// The lowest ten bits as a share of 1.
pub(crate) fn unit(hash: u32) -> f32 {
    (hash & 1023) as f32 / 1023.0
}

/// As [`noise`] in the plane, repeated after `period` waves.
pub(crate) fn tiled_noise(point: Vec2, period: i32, seed: i32) -> f32 {
    let base = point.floor();
    let f = point - base;
    let f = f * f * (3.0 - 2.0 * f);
    let [x, y] = base.as_ivec2().to_array();
    let at = |dx: i32, dy: i32| chance((x + dx).rem_euclid(period), (y + dy).rem_euclid(period), seed);
    lerp(lerp(at(0, 0), at(1, 0), f.x), lerp(at(0, 1), at(1, 1), f.x), f.y)
}

/// 0..1 for a pair of numbers; another seed gives another one.
pub(crate) fn chance(x: i32, y: i32, seed: i32) -> f32 {
    unit(hash(IVec3::new(x, y, seed)))
}

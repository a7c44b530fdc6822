//! Colours and reliefs of the dragon's surfaces, as functions of place.
//!
//! Patterns are functions of the place in the model, not of the texture, so they have neither seams nor stretch.
//! Colours are sRGB-coded, 0..1.

use super::mesh::Skin;
use crate::curve::{lerp, smoothstep};
use crate::noise::{hash, noise, unit};
use glam::{IVec3, Vec3, Vec4, vec3};
use std::f32::consts::TAU;

/// One texel's material.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    /// sRGB-coded.
    pub color: Vec3,
    pub roughness: f32,
    pub metallic: f32,
    /// Relief, metres outwards.
    pub height_m: f32,
}

impl Sample {
    pub fn mix(&self, other: &Self, t: f32) -> Self {
        Self {
            color: self.color.lerp(other.color, t),
            roughness: lerp(self.roughness, other.roughness, t),
            metallic: lerp(self.metallic, other.metallic, t),
            height_m: lerp(self.height_m, other.height_m, t),
        }
    }
}

const BACK: Vec3 = vec3(0.055, 0.255, 0.290);
const FLANK: Vec3 = vec3(0.110, 0.490, 0.450);
const FLANK_GREEN: Vec3 = vec3(0.260, 0.610, 0.420);
const BELLY: Vec3 = vec3(0.930, 0.660, 0.330);
const BELLY_RIM: Vec3 = vec3(0.800, 0.430, 0.180);
const MOUTH: Vec3 = vec3(0.440, 0.110, 0.130);
const TONGUE: Vec3 = vec3(0.800, 0.330, 0.340);
const BONE: Vec3 = vec3(0.930, 0.870, 0.730);
const BONE_DARK: Vec3 = vec3(0.360, 0.230, 0.160);
const SKIN: Vec3 = vec3(0.900, 0.480, 0.180);
const SKIN_DEEP: Vec3 = vec3(0.640, 0.200, 0.110);
const SKIN_ABOVE: Vec3 = vec3(0.720, 0.300, 0.140);
const IRIS: Vec3 = vec3(1.000, 0.780, 0.160);
const IRIS_RIM: Vec3 = vec3(0.720, 0.260, 0.040);

/// The material at a place; `paint` as [`Skin`] says, `openness` 0 (hidden) to 1.
pub(super) fn sample(skin: Skin, place: Vec3, paint: Vec4, openness: f32) -> Sample {
    let mut sample = match skin {
        Skin::Hide => hide(place, paint),
        Skin::Membrane => membrane(place, paint),
        Skin::Horn => horn(place, paint),
        Skin::Eye => eye(paint),
    };
    sample.color *= lerp(0.55, 1.0, openness);
    sample
}

fn hide(place: Vec3, paint: Vec4) -> Sample {
    let [ventral, s_m, grain, mouth] = paint.to_array();
    let mut sample = scales(place, ventral, grain);
    let scute_share = smoothstep(0.74, 0.82, ventral) * (1.0 - smoothstep(0.5, 1.0, mouth));
    if scute_share > 0.0 {
        sample = sample.mix(&scutes(place, ventral, s_m), scute_share);
    }
    if mouth > 0.0 {
        let color = MOUTH.lerp(TONGUE, (mouth - 1.0).clamp(0.0, 1.0));
        let inside = Sample { color, roughness: 0.35, metallic: 0.0, height_m: 0.0 };
        sample = sample.mix(&inside, mouth.min(1.0));
    }
    sample
}

/// Rounded scales, darker in the furrows, in bands of dark teal over green.
fn scales(place: Vec3, ventral: f32, grain: f32) -> Sample {
    const BODY_SCALE_M: f32 = 0.036;
    const HEAD_SCALE_M: f32 = 0.021;
    let large = if grain < 1.0 { cells(place / BODY_SCALE_M) } else { Cell::default() };
    let small = if grain > 0.0 { cells(place / HEAD_SCALE_M) } else { Cell::default() };
    let ridge = lerp(large.ridge(), small.ridge(), grain);
    let tint = lerp(large.tint, small.tint, grain);
    let size_m = lerp(BODY_SCALE_M, HEAD_SCALE_M, grain);

    let cloud = noise(place * 3.5 + 7.0) * 0.65 + noise(place * 8.0) * 0.35;
    let bands = 0.5 + 0.5 * (place.z * TAU / 0.30 + 3.0 * noise(place * 4.0)).sin();
    let flank = FLANK.lerp(FLANK_GREEN, smoothstep(0.30, 0.72, ventral + 0.55 * (cloud - 0.5)));
    let dark = (1.0 - smoothstep(0.02, 0.42, ventral + 0.30 * (bands - 0.5) + 0.2 * (cloud - 0.5))) * 0.92;
    let color = flank.lerp(BACK, dark);
    Sample {
        color: color * lerp(0.72, 1.08, ridge) * lerp(0.90, 1.08, tint),
        roughness: lerp(0.72, 0.42, ridge),
        metallic: 0.0,
        height_m: 0.08 * size_m * ridge,
    }
}

/// Broad plates across the belly.
fn scutes(place: Vec3, ventral: f32, s_m: f32) -> Sample {
    const PITCH_M: f32 = 0.056;
    let along = (s_m / PITCH_M).rem_euclid(1.0);
    // Each plate rises slowly and ends in a step over the next one.
    let rise = smoothstep(0.0, 0.18, along) * (1.0 - 0.35 * along) * (1.0 - smoothstep(0.93, 1.0, along));
    let cloud = noise(place * 9.0);
    let color = BELLY_RIM.lerp(BELLY, smoothstep(0.76, 0.93, ventral + 0.1 * (cloud - 0.5)));
    Sample {
        color: color * lerp(0.60, 1.04, rise.sqrt()),
        roughness: 0.55,
        metallic: 0.0,
        height_m: 0.0045 * rise,
    }
}

/// Leathery skin, redder towards the rim and along the bones, with fine folds that run from bone to bone.
fn membrane(place: Vec3, paint: Vec4) -> Sample {
    let [bone_m, rim, above, _] = paint.to_array();
    let cloud = noise(place * 6.0) * 0.6 + noise(place * 15.0) * 0.4;
    let glow = smoothstep(0.0, 0.16, bone_m);
    let mut color = SKIN_DEEP.lerp(SKIN.lerp(SKIN_ABOVE, 0.55 * above), 0.25 + 0.75 * glow);
    color = color.lerp(SKIN_DEEP, 0.75 * smoothstep(0.62, 1.0, rim + 0.25 * (cloud - 0.5)));
    let folds = (rim * 38.0 + 6.0 * noise(place * 7.0)).sin();
    Sample {
        color: color * lerp(0.84, 1.12, cloud) * (1.0 + 0.02 * folds),
        roughness: 0.58,
        metallic: 0.0,
        height_m: 0.0007 * folds + 0.0016 * cloud,
    }
}

/// Bone, ringed near the base.
fn horn(place: Vec3, paint: Vec4) -> Sample {
    let [tip, dark_base, ..] = paint.to_array();
    let dark = dark_base * (1.0 - smoothstep(0.05, 0.75, tip));
    let rings = (tip * TAU * 11.0).sin() * (1.0 - tip);
    let color = BONE.lerp(BONE_DARK, dark) * (1.0 + 0.07 * rings) * lerp(0.92, 1.05, noise(place * 40.0));
    Sample { color, roughness: 0.38, metallic: 0.0, height_m: 0.0007 * rings }
}

/// A slit pupil in a fiery iris.
fn eye(paint: Vec4) -> Sample {
    let [off, sideways, upright, _] = paint.to_array();
    let slit = (sideways / 0.16).powi(2) + (upright / 0.62).powi(2);
    let iris = IRIS.lerp(IRIS_RIM, smoothstep(0.25, 0.85, off));
    let color = iris.lerp(vec3(0.10, 0.03, 0.01), smoothstep(0.85, 1.05, off));
    let color = vec3(0.02, 0.01, 0.01).lerp(color, smoothstep(0.75, 1.35, slit));
    Sample { color, roughness: 0.12, metallic: 0.0, height_m: 0.0 }
}

/// The scale that a place belongs to.
#[derive(Clone, Copy, Default)]
struct Cell {
    /// 0 in the furrow between two scales, growing inwards; in scale sizes.
    inside: f32,
    /// One of its kind, 0..1.
    tint: f32,
}

impl Cell {
    /// 0 in the furrow, 1 on the top.
    fn ridge(&self) -> f32 {
        smoothstep(0.0, 0.42, self.inside).sqrt()
    }
}

/// Cells around jittered lattice points (Worley 1996), the distance to the second nearest less that to the nearest.
fn cells(point: Vec3) -> Cell {
    const JITTER: f32 = 0.62;
    let (mut nearest, mut second, mut owner) = (f32::INFINITY, f32::INFINITY, 0);
    let base = (point - 0.5).floor().as_ivec3();
    // With this jitter the nearest point is among the eight around; the second nearest nearly always.
    for corner in 0..8 {
        let lattice = base + IVec3::new(corner & 1, (corner >> 1) & 1, corner >> 2);
        let hash = hash(lattice);
        let jitter = vec3(unit(hash), unit(hash >> 10), unit(hash >> 20)) - 0.5;
        let distance = (lattice.as_vec3() + 0.5 + jitter * JITTER).distance_squared(point);
        if distance < nearest {
            (nearest, second, owner) = (distance, nearest, hash);
        } else {
            second = second.min(distance);
        }
    }
    Cell { inside: second.sqrt() - nearest.sqrt(), tint: unit(owner >> 5) }
}

//! Small random curves and models for tests.

use crate::{Bone, Clip, Interpolation, Model, Track, TrackValues, Trs};
use glam::{Quat, Vec3};
use rand::{Rng, rngs::SmallRng};

/// All of them.
pub const INTERPOLATIONS: [Interpolation; 3] =
    [Interpolation::Step, Interpolation::Linear, Interpolation::CubicSpline];

/// Any rotation.
pub fn random_rotation(rng: &mut SmallRng) -> Quat {
    let mut component = || rng.random_range(-1.0f32..1.0);
    Quat::from_xyzw(component(), component(), component(), component() + 1e-3).normalize()
}

/// Each component within 2.
pub fn random_vector(rng: &mut SmallRng) -> Vec3 {
    Vec3::new(rng.random_range(-2.0..2.0), rng.random_range(-2.0..2.0), rng.random_range(-2.0..2.0))
}

/// A curve of 1 to 11 keys; `kind` 0 is a translation, 1 a rotation, 2 a scale.
pub fn random_track(rng: &mut SmallRng, bone: u32, interpolation: Interpolation, kind: usize) -> Track {
    let mut time = 0.0;
    let times_s: Vec<f32> = (0..rng.random_range(1..12))
        .map(|_| {
            time += rng.random_range(0.01f32..0.4);
            time
        })
        .collect();
    let count = times_s.len() * if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
    let values = match kind {
        0 => TrackValues::Translation((0..count).map(|_| random_vector(rng)).collect()),
        1 => TrackValues::Rotation((0..count).map(|_| random_rotation(rng)).collect()),
        _ => TrackValues::Scale((0..count).map(|_| random_vector(rng)).collect()),
    };
    Track { bone, times_s, interpolation, values }
}

/// A model of one bone without vertices, moved by one curve.
pub fn one_bone(track: Track) -> Model {
    let duration_s = track.times_s[track.times_s.len() - 1];
    let bone = Bone { name: "b".into(), parent: None, rest: Trs::IDENTITY };
    let clip = Clip { name: "c".into(), duration_s, tracks: vec![track], ..Clip::default() };
    Model { bones: vec![bone], clips: vec![clip], ..Model::default() }
}

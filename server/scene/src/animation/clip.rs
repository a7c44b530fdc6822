//! Source curves, evaluated exactly as their formats define them.

use crate::{Interpolation, Model, MorphTrack, Track, TrackValues, Trs};
use glam::{Quat, Vec3, Vec4};

/// The value of a curve.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TrackValue {
    /// Metres.
    Translation(Vec3),
    /// Unit quaternion.
    Rotation(Quat),
    /// Factors.
    Scale(Vec3),
}

/// The local transforms of all bones by the source curves, `t_s` seconds into the clip, not wrapped: before the first
/// and after the last key of a curve its end value holds. Bones without a curve, and all bones for `None`, keep rest.
pub fn source_pose(model: &Model, clip: Option<usize>, t_s: f64) -> Vec<Trs> {
    let mut pose: Vec<Trs> = model.bones.iter().map(|bone| bone.rest).collect();
    for track in clip.iter().flat_map(|clip| &model.clips[*clip].tracks) {
        apply(track, t_s, &mut pose[track.bone as usize]);
    }
    pose
}

fn apply(track: &Track, t_s: f64, bone: &mut Trs) {
    match evaluate_track(track, t_s) {
        TrackValue::Translation(value) => bone.translation = value,
        TrackValue::Rotation(value) => bone.rotation = value,
        TrackValue::Scale(value) => bone.scale = value,
    }
}

/// One bone's transform by its `tracks`, whichever bone they name; channels without a track stay at `rest`.
pub fn transform_of_tracks(tracks: &[Track], rest: Trs, t_s: f64) -> Trs {
    let mut transform = rest;
    tracks.iter().for_each(|track| apply(track, t_s, &mut transform));
    transform
}

/// The weights of all morph targets by the source curves, `t_s` seconds into the clip, as [`source_pose`].
pub fn source_morph_weights(model: &Model, clip: Option<usize>, t_s: f64) -> Vec<f32> {
    let mut weights: Vec<f32> = model.morphs.iter().map(|morph| morph.rest_weight).collect();
    for track in clip.iter().flat_map(|clip| &model.clips[*clip].morph_tracks) {
        for morph in 0..track.morph_count {
            weights[(track.first_morph + morph) as usize] = evaluate_morph_track(track, morph, t_s);
        }
    }
    weights
}

/// The weight of the track's morph number `morph` at `t_s` seconds, clamped outside its keys.
pub fn evaluate_morph_track(track: &MorphTrack, morph: u32, t_s: f64) -> f32 {
    let place = Place::find(&track.times_s, t_s);
    let weight = |value: usize| track.weights[value * track.morph_count as usize + morph as usize];
    match track.interpolation {
        Interpolation::Step => weight(place.key),
        Interpolation::Linear => {
            weight(place.key) + place.fraction * (weight(place.next) - weight(place.key))
        }
        Interpolation::CubicSpline => hermite(|value| Vec4::splat(weight(value)), &place).x,
    }
}

/// A curve at `t_s` seconds, as glTF 2.0 section 3.11 and appendix C define it, clamped outside its keys.
pub fn evaluate_track(track: &Track, t_s: f64) -> TrackValue {
    let place = Place::find(&track.times_s, t_s);
    match &track.values {
        TrackValues::Translation(keys) => TrackValue::Translation(vector(keys, track.interpolation, &place)),
        TrackValues::Scale(keys) => TrackValue::Scale(vector(keys, track.interpolation, &place)),
        TrackValues::Rotation(keys) => TrackValue::Rotation(rotation(keys, track.interpolation, &place)),
    }
}

/// Between which keys a time lies.
struct Place {
    key: usize,
    next: usize,
    /// 0 at `key`, below 1.
    fraction: f32,
    /// Seconds from `key` to `next`.
    span_s: f32,
}

impl Place {
    fn find(times_s: &[f32], t_s: f64) -> Self {
        let after = times_s.partition_point(|time| f64::from(*time) <= t_s);
        let last = times_s.len() - 1;
        if after == 0 || after > last {
            let key = if after == 0 { 0 } else { last };
            return Self { key, next: key, fraction: 0.0, span_s: 0.0 };
        }
        let (from, to) = (f64::from(times_s[after - 1]), f64::from(times_s[after]));
        Self {
            key: after - 1,
            next: after,
            fraction: ((t_s - from) / (to - from)) as f32,
            span_s: (to - from) as f32,
        }
    }
}

fn vector(keys: &[Vec3], interpolation: Interpolation, place: &Place) -> Vec3 {
    match interpolation {
        Interpolation::Step => keys[place.key],
        Interpolation::Linear => keys[place.key].lerp(keys[place.next], place.fraction),
        Interpolation::CubicSpline => hermite(|index| keys[index].extend(0.0), place).truncate(),
    }
}

fn rotation(keys: &[Quat], interpolation: Interpolation, place: &Place) -> Quat {
    match interpolation {
        Interpolation::Step => keys[place.key],
        // Takes the shorter arc.
        Interpolation::Linear => keys[place.key].slerp(keys[place.next], place.fraction).normalize(),
        Interpolation::CubicSpline => {
            let sum = hermite(|index| Vec4::from(keys[index]), place);
            sum.try_normalize().map_or(keys[3 * place.key + 1], Quat::from_vec4)
        }
    }
}

/// glTF 2.0 appendix C, "Cubic Spline Interpolation"; per key: in-tangent, value, out-tangent.
fn hermite(key: impl Fn(usize) -> Vec4, place: &Place) -> Vec4 {
    let (t, span) = (place.fraction, place.span_s);
    let (t2, t3) = (t * t, t * t * t);
    let (value, out_tangent) = (key(3 * place.key + 1), key(3 * place.key + 2));
    let (in_tangent, next) = (key(3 * place.next), key(3 * place.next + 1));
    value * (2.0 * t3 - 3.0 * t2 + 1.0)
        + out_tangent * (span * (t3 - 2.0 * t2 + t))
        + next * (3.0 * t2 - 2.0 * t3)
        + in_tangent * (span * (t3 - t2))
}

/// Whether a curve changes over time at all; many exporters write a curve for every bone and property.
pub fn track_varies(track: &Track) -> bool {
    fn differ<T: Copy>(keys: &[T], per_key: usize, distance: impl Fn(T, T) -> f32, zero: T) -> bool {
        let value = |key: usize| keys[key * per_key + per_key / 2];
        let moves = (1..keys.len() / per_key).any(|key| distance(value(0), value(key)) > 1e-6);
        // A cubic spline with equal keys still swings if it has tangents.
        let swings = |triple: &[T]| distance(triple[0], zero) > 1e-6 || distance(triple[2], zero) > 1e-6;
        moves || (per_key == 3 && keys.len() > 3 && keys.chunks_exact(3).any(swings))
    }
    let per_key = if track.interpolation == Interpolation::CubicSpline { 3 } else { 1 };
    let between = |a: Vec3, b: Vec3| (a - b).abs().max_element();
    match &track.values {
        TrackValues::Translation(keys) | TrackValues::Scale(keys) => {
            differ(keys, per_key, between, Vec3::ZERO)
        }
        TrackValues::Rotation(keys) => {
            let zero = Quat::from_vec4(Vec4::ZERO);
            // Both signs of a quaternion are the same rotation.
            let distance = |a: Quat, b: Quat| {
                let (a, b) = (Vec4::from(a), Vec4::from(b));
                (a - b).abs().max_element().min((a + b).abs().max_element())
            };
            differ(keys, per_key, distance, zero)
        }
    }
}

/// Whether any of the track's weights changes over time.
pub fn morph_track_varies(track: &MorphTrack) -> bool {
    let count = track.morph_count as usize;
    let is_cubic = track.interpolation == Interpolation::CubicSpline;
    let value = |key: usize| &track.weights[if is_cubic { 3 * key + 1 } else { key } * count..][..count];
    let moves = (1..track.times_s.len()).any(|key| value(key) != value(0));
    let tangents = |part: usize| track.weights.chunks_exact(count).skip(part).step_by(3).flatten();
    // Equal keys still swing if they have tangents.
    let swings = || tangents(0).chain(tangents(2)).any(|tangent| *tangent != 0.0);
    moves || (is_cubic && track.times_s.len() > 1 && swings())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::animation::test_models::{INTERPOLATIONS, random_track};
    use rand::{SeedableRng, rngs::SmallRng};

    /// The stored value of a key.
    fn key_value(track: &Track, key: usize) -> TrackValue {
        let index = if track.interpolation == Interpolation::CubicSpline { 3 * key + 1 } else { key };
        match &track.values {
            TrackValues::Translation(keys) => TrackValue::Translation(keys[index]),
            TrackValues::Rotation(keys) => TrackValue::Rotation(keys[index]),
            TrackValues::Scale(keys) => TrackValue::Scale(keys[index]),
        }
    }

    fn distance(a: TrackValue, b: TrackValue) -> f32 {
        match (a, b) {
            (TrackValue::Translation(a), TrackValue::Translation(b))
            | (TrackValue::Scale(a), TrackValue::Scale(b)) => a.distance(b),
            (TrackValue::Rotation(a), TrackValue::Rotation(b)) => (1.0 - a.dot(b).abs()).max(0.0).sqrt(),
            _ => f32::INFINITY,
        }
    }

    #[test]
    fn every_interpolation_hits_its_keys_and_is_clamped_outside() {
        let mut rng = SmallRng::seed_from_u64(1);
        for case in 0..300 {
            let track = random_track(&mut rng, 0, INTERPOLATIONS[case % 3], case / 3 % 3);
            for (key, time) in track.times_s.iter().enumerate() {
                let found = evaluate_track(&track, f64::from(*time));
                assert!(distance(found, key_value(&track, key)) < 1e-3, "seed 1, case {case}, key {key}");
            }
            let last = track.times_s.len() - 1;
            let (before, after) = (f64::from(track.times_s[0]) - 1.0, f64::from(track.times_s[last]) + 1.0);
            assert!(
                distance(evaluate_track(&track, before), key_value(&track, 0)) < 1e-3,
                "seed 1, case {case}"
            );
            assert!(
                distance(evaluate_track(&track, after), key_value(&track, last)) < 1e-3,
                "seed 1, case {case}"
            );
        }
    }

    #[test]
    fn step_holds_and_linear_halves() {
        let values = TrackValues::Translation(vec![Vec3::ZERO, Vec3::new(2.0, 4.0, 6.0)]);
        let mut track =
            Track { bone: 0, times_s: vec![1.0, 2.0], interpolation: Interpolation::Step, values };
        assert_eq!(evaluate_track(&track, 1.999), TrackValue::Translation(Vec3::ZERO));
        track.interpolation = Interpolation::Linear;
        assert_eq!(evaluate_track(&track, 1.5), TrackValue::Translation(Vec3::new(1.0, 2.0, 3.0)));
    }

    #[test]
    fn cubic_spline_reproduces_a_cubic() {
        // x(t) = t^3 - 2 t^2 + 3 t - 1 has x'(t) = 3 t^2 - 4 t + 3; a Hermite spline with true tangents is exact.
        let (x, slope) =
            (|t: f32| t * t * t - 2.0 * t * t + 3.0 * t - 1.0, |t: f32| 3.0 * t * t - 4.0 * t + 3.0);
        let times_s = vec![0.0, 0.7, 2.0];
        let triple = |t: &f32| [Vec3::splat(slope(*t)), Vec3::splat(x(*t)), Vec3::splat(slope(*t))];
        let values = TrackValues::Translation(times_s.iter().flat_map(triple).collect());
        let track = Track { bone: 0, times_s, interpolation: Interpolation::CubicSpline, values };
        for step in 0..=200 {
            let t = step as f32 * 0.01;
            let TrackValue::Translation(found) = evaluate_track(&track, f64::from(t)) else {
                panic!("translation")
            };
            assert!((found.x - x(t)).abs() < 1e-5, "at {t}: {} instead of {}", found.x, x(t));
        }
    }

    #[test]
    fn linear_rotation_takes_the_short_arc_whatever_the_sign() {
        let (a, b) = (Quat::from_rotation_y(0.2), Quat::from_rotation_y(1.0));
        for b in [b, -b] {
            let values = TrackValues::Rotation(vec![a, b]);
            let track =
                Track { bone: 0, times_s: vec![0.0, 1.0], interpolation: Interpolation::Linear, values };
            let TrackValue::Rotation(found) = evaluate_track(&track, 0.25) else { panic!("rotation") };
            assert!(found.angle_between(Quat::from_rotation_y(0.4)) < 1e-3, "{found}");
        }
    }

    #[test]
    fn constant_curves_do_not_vary_and_swinging_ones_do() {
        let track = |interpolation, values| Track { bone: 0, times_s: vec![0.0, 1.0], interpolation, values };
        let still = [
            track(Interpolation::Linear, TrackValues::Translation(vec![Vec3::X; 2])),
            track(Interpolation::Linear, TrackValues::Rotation(vec![Quat::IDENTITY, -Quat::IDENTITY])),
            track(
                Interpolation::CubicSpline,
                TrackValues::Scale(
                    [Vec3::ZERO, Vec3::ONE, Vec3::ZERO, Vec3::ZERO, Vec3::ONE, Vec3::ZERO].to_vec(),
                ),
            ),
        ];
        assert!(still.iter().all(|track| !track_varies(track)));
        let moving = [
            track(Interpolation::Step, TrackValues::Scale(vec![Vec3::ONE, Vec3::X])),
            track(
                Interpolation::Linear,
                TrackValues::Rotation(vec![Quat::IDENTITY, Quat::from_rotation_x(0.01)]),
            ),
            track(
                Interpolation::CubicSpline,
                TrackValues::Scale(
                    [Vec3::ZERO, Vec3::ONE, Vec3::X, Vec3::ZERO, Vec3::ONE, Vec3::ZERO].to_vec(),
                ),
            ),
        ];
        assert!(moving.iter().all(track_varies));
    }
}

//! Source curves evaluated exactly, and clips resampled at a constant interval, which is what the GPU reads.

use crate::{Interpolation, Model, MorphTrack, Repetition, Track, TrackValues, Trs};
use glam::{Quat, Vec3, Vec4};

/// Default spacing of resampled keys, seconds. Linear interpolation over an interval `h` misses the top of a sine of
/// frequency `f` by `(1 - cos(pi f h)) / 2` of its range: 2.45 % for 1 Hz at 100 ms (the paper's interval), 0.07 % at
/// 1/60 s, which is below a quarter pixel at arm's length. 1/60 s is also the interval of most authored clips, so
/// that their keys are hit. A 4 s clip of 136 bones is then 1.3 MB.
pub const DEFAULT_RESAMPLE_INTERVAL_S: f32 = 1.0 / 60.0;

/// Most transforms in one resampled clip (40 bytes each). Longer clips get a longer interval instead.
pub const MAX_RESAMPLED_TRANSFORMS: usize = 1 << 24;

/// A clip of one model at a constant interval, every bone at every sample.
#[derive(Clone, Debug)]
pub struct ResampledClip {
    /// Seconds between samples: the interval asked for, shortened so that a whole number fits the duration.
    pub interval_s: f32,
    /// Number of samples, at least 2. Sample 0 is the clip's start, sample `count - 1` its end.
    pub count: u32,
    /// Sample-major: `sample * bone_count + bone`. A bone's rotations at neighbouring samples have a dot product of
    /// at least zero, so that they can be interpolated componentwise.
    pub samples: Vec<Trs>,
    /// Length of the clip in seconds, `interval_s * (count - 1)`; 0 for a rest pose.
    pub duration_s: f32,
}

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

/// Where a clip stands: `time_s` brought into `[0, duration_s]`; 0 for a clip without duration. A loop never stands
/// at its very end, which is its start. Double precision, because a session may last for days and a phase must still
/// be right to the microsecond.
pub fn clip_phase(time_s: f64, duration_s: f32, repetition: Repetition) -> f64 {
    let duration_s = f64::from(duration_s);
    if duration_s <= 0.0 || !time_s.is_finite() {
        return 0.0;
    }
    let wrapped = |period_s: f64| {
        let phase = time_s.rem_euclid(period_s);
        // A tiny negative time rounds up to the period itself.
        if phase < period_s { phase } else { 0.0 }
    };
    match repetition {
        Repetition::Once => time_s.clamp(0.0, duration_s),
        Repetition::Loop => wrapped(duration_s),
        Repetition::PingPong => {
            let phase = wrapped(2.0 * duration_s);
            if phase <= duration_s { phase } else { 2.0 * duration_s - phase }
        }
    }
}

/// Resamples a clip of the model, or its rest pose for `None`. `interval_s` must be positive; the interval used is
/// shorter, unless the clip is so long that [`MAX_RESAMPLED_TRANSFORMS`] makes it longer.
pub fn resample(model: &Model, clip: Option<usize>, interval_s: f32) -> ResampledClip {
    assert!(interval_s > 0.0, "resampling interval {interval_s} s");
    let duration_s = model.duration_s(clip);
    if duration_s <= 0.0 {
        let pose = source_pose(model, clip, 0.0);
        return ResampledClip {
            interval_s,
            count: 2,
            samples: [pose.clone(), pose].concat(),
            duration_s: 0.0,
        };
    }
    let intervals = interval_count(duration_s, interval_s, model.bones.len());
    let step_s = f64::from(duration_s) / f64::from(intervals);
    let mut samples = Vec::with_capacity((intervals as usize + 1) * model.bones.len());
    for sample in 0..=intervals {
        // The last sample is the clip's end, not the start that looping would make of it.
        samples.extend(source_pose(model, clip, f64::from(sample) * step_s));
    }
    align_hemispheres(&mut samples, model.bones.len());
    ResampledClip { interval_s: step_s as f32, count: intervals + 1, samples, duration_s }
}

fn interval_count(duration_s: f32, interval_s: f32, bone_count: usize) -> u32 {
    // A thousandth of an interval of slack: 4 s are 240 sixtieths, not 241, whatever f32 makes of 1/60.
    let wanted = (f64::from(duration_s) / f64::from(interval_s) - 1e-3).ceil().max(1.0);
    let limit = (MAX_RESAMPLED_TRANSFORMS / bone_count.max(1)).saturating_sub(1).max(1);
    if wanted > limit as f64 {
        tracing::warn!(
            "clip of {duration_s} s is resampled at {} s instead of {interval_s} s",
            duration_s / limit as f32
        );
    }
    wanted.min(limit as f64) as u32
}

fn align_hemispheres(samples: &mut [Trs], bone_count: usize) {
    for index in bone_count..samples.len() {
        let previous = samples[index - bone_count].rotation;
        let rotation = &mut samples[index].rotation;
        if previous.dot(*rotation) < 0.0 {
            *rotation = -*rotation;
        }
    }
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
    use crate::animation::test_models::{INTERPOLATIONS, one_bone, random_track};
    use rand::{SeedableRng, rngs::SmallRng};
    use std::f64::consts::{PI, TAU};

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
    fn resampled_neighbours_lie_in_one_hemisphere() {
        let mut rng = SmallRng::seed_from_u64(2);
        for case in 0..100 {
            let model = one_bone(random_track(&mut rng, 0, INTERPOLATIONS[case % 3], 1));
            let clip = resample(&model, Some(0), 0.03);
            for pair in clip.samples.windows(2) {
                assert!(pair[0].rotation.dot(pair[1].rotation) >= 0.0, "seed 2, case {case}");
            }
        }
    }

    #[test]
    fn samples_lie_on_the_source_curve_and_the_last_is_the_clips_end() {
        let mut rng = SmallRng::seed_from_u64(3);
        for case in 0..100 {
            let model = one_bone(random_track(&mut rng, 0, INTERPOLATIONS[case % 3], 0));
            let clip = resample(&model, Some(0), 0.05);
            assert!(clip.interval_s <= 0.05 * 1.01, "seed 3, case {case}");
            let end = f64::from(clip.interval_s) * f64::from(clip.count - 1);
            assert!((end - f64::from(clip.duration_s)).abs() < 1e-4, "seed 3, case {case}: {end}");
            for (sample, trs) in clip.samples.iter().enumerate() {
                let t = f64::from(clip.duration_s) / f64::from(clip.count - 1) * sample as f64;
                assert_eq!(*trs, source_pose(&model, Some(0), t)[0], "seed 3, case {case}, sample {sample}");
            }
        }
    }

    #[test]
    fn four_seconds_are_240_sixtieths() {
        let values = TrackValues::Translation(vec![Vec3::ZERO, Vec3::X]);
        let track = Track { bone: 0, times_s: vec![0.0, 4.0], interpolation: Interpolation::Linear, values };
        let clip = resample(&one_bone(track), Some(0), DEFAULT_RESAMPLE_INTERVAL_S);
        assert_eq!((clip.count, clip.samples.len()), (241, 241));
    }

    #[test]
    fn rest_pose_and_clip_without_duration_have_two_equal_samples() {
        let values = TrackValues::Translation(vec![Vec3::X]);
        let track = Track { bone: 0, times_s: vec![0.0], interpolation: Interpolation::Step, values };
        let model = one_bone(track);
        for (clip, expected) in [(None, Vec3::ZERO), (Some(0), Vec3::X)] {
            let clip = resample(&model, clip, 0.1);
            assert_eq!((clip.count, clip.duration_s), (2, 0.0));
            assert!(clip.samples.iter().all(|trs| trs.translation == expected));
        }
    }

    #[test]
    fn very_long_clip_is_resampled_more_coarsely_instead_of_filling_memory() {
        let values = TrackValues::Translation(vec![Vec3::ZERO, Vec3::X]);
        let track =
            Track { bone: 0, times_s: vec![0.0, 86_400.0], interpolation: Interpolation::Linear, values };
        let mut model = one_bone(track);
        model.bones = vec![model.bones[0].clone(); 4096];
        let clip = resample(&model, Some(0), 1e-3);
        assert!(clip.samples.len() <= MAX_RESAMPLED_TRANSFORMS);
    }

    #[test]
    fn once_holds_its_ends_and_ping_pong_comes_back() {
        let at = |time_s, repetition| clip_phase(time_s, 4.0, repetition);
        assert_eq!([-1.0, 1.0, 9.0].map(|t| at(t, Repetition::Once)), [0.0, 1.0, 4.0]);
        assert_eq!(
            [1.0, 4.0, 5.0, 9.0, -1.0].map(|t| at(t, Repetition::PingPong)),
            [1.0, 4.0, 3.0, 1.0, 1.0]
        );
    }

    #[test]
    fn phase_wraps_and_stays_exact_after_a_week() {
        assert_eq!(clip_phase(9.0, 4.0, Repetition::Loop), 1.0);
        assert_eq!(clip_phase(-1.0, 4.0, Repetition::Loop), 3.0);
        assert_eq!(clip_phase(4.0, 4.0, Repetition::Loop), 0.0);
        assert_eq!(clip_phase(-1e-20, 4.0, Repetition::Loop), 0.0);
        assert_eq!(clip_phase(5.0, 0.0, Repetition::Loop), 0.0);
        assert_eq!(clip_phase(f64::NAN, 4.0, Repetition::Loop), 0.0);
        assert!((clip_phase(604_800.0 + 1.25, 4.0, Repetition::Loop) - 1.25).abs() < 1e-6);
    }

    /// Largest error of linear interpolation of `40 sin(2 pi t)` degrees between samples, in parts of its range.
    fn sine_error(interval_s: f32) -> f64 {
        let angle = |t: f64| 40f64.to_radians() * (TAU * t).sin();
        // Source keys 64 times denser than the samples: what they miss is 1/4096 of what is measured.
        let keys = (64.0 * 4.0 / f64::from(interval_s)).round() as u32;
        let times_s: Vec<f32> = (0..=keys).map(|key| 4.0 * key as f32 / keys as f32).collect();
        let turn = |time: &f32| Quat::from_rotation_x(angle(f64::from(*time)) as f32);
        let values = TrackValues::Rotation(times_s.iter().map(turn).collect());
        let model = one_bone(Track { bone: 0, times_s, interpolation: Interpolation::Linear, values });
        let clip = resample(&model, Some(0), interval_s);
        let error = |step: i32| {
            let t = f64::from(step) * 1e-3;
            let found = super::super::pose::local_pose(&clip, 1, t)[0].rotation;
            let found = 2.0 * f64::from(found.x).atan2(f64::from(found.w));
            (found - angle(t)).abs()
        };
        (0..4000).map(error).fold(0.0, f64::max) / 80f64.to_radians()
    }

    #[test]
    fn resampling_a_sine_errs_by_what_the_formula_says() {
        for interval_s in [0.1, 1.0 / 30.0, DEFAULT_RESAMPLE_INTERVAL_S] {
            let predicted = (1.0 - (PI * f64::from(interval_s)).cos()) / 2.0;
            let measured = sine_error(interval_s);
            eprintln!(
                "1 Hz, +-40 degrees, every {:.1} ms: {:.4} % of range measured, {:.4} % predicted",
                interval_s * 1e3,
                measured * 100.0,
                predicted * 100.0
            );
            assert!((measured / predicted - 1.0).abs() < 0.03, "{measured} instead of {predicted}");
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

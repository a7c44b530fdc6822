//! Keys of one animated number, vector or rotation: refined to be exact enough, cut to a clip's time range.

use crate::limits::MAX_DURATION_S;
use crate::{Interpolation, Track, TrackValues};
use glam::{Quat, Vec3};

/// The largest gap between two keys that is a step: the library gives steps a millisecond.
const STEP_S: f64 = 2e-3;

/// Most times that the gap between two keys is halved to follow a bent curve.
const MAX_HALVINGS: u32 = 8;

/// How values of a kind are interpolated, and when two count as one.
///
/// The project measures its own sampling against these keys to a tenth of a millimetre, so straight lines between them
/// must follow the file's curves much better than that: a metre from a joint 2e-5 radians are 0.02 mm.
pub(super) struct Law<T> {
    mix: fn(T, T, f32) -> T,
    is_near: fn(T, T) -> bool,
}

/// Metres.
pub(super) const TRANSLATION: Law<Vec3> =
    Law { mix: |a, b, share| a.lerp(b, share), is_near: |a, b| a.distance(b) <= 2e-6 + 1e-6 * a.length() };

/// Factors.
pub(super) const SCALE: Law<Vec3> =
    Law { mix: |a, b, share| a.lerp(b, share), is_near: |a, b| a.distance(b) <= 5e-6 * (1.0 + a.length()) };

/// Along the shorter arc.
pub(super) const ROTATION: Law<Quat> = Law {
    mix: |a, b, share| a.slerp(if a.dot(b) < 0.0 { -b } else { b }, share),
    // For small angles half the angle is the distance of the quaternions.
    is_near: |a, b| (a - b).length().min((a + b).length()) <= 1e-5,
};

/// Of blend shapes.
pub(super) const WEIGHT: Law<f64> =
    Law { mix: |a, b, share| a + (b - a) * f64::from(share), is_near: |a, b| (a - b).abs() <= 1e-5 };

#[derive(Clone, Copy)]
pub(super) struct Key<T> {
    /// Of the file, seconds.
    pub(super) time: f64,
    pub(super) value: T,
    pub(super) flags: ufbx::BakedKeyFlags,
}

/// Keys of a clip, times from its start.
pub(super) struct Curve<T> {
    pub(super) times_s: Vec<f32>,
    pub(super) values: Vec<T>,
    pub(super) interpolation: Interpolation,
}

impl<T> Curve<T> {
    pub(super) fn into_track(self, bone: u32, values: impl FnOnce(Vec<T>) -> TrackValues) -> Track {
        Track { bone, times_s: self.times_s, interpolation: self.interpolation, values: values(self.values) }
    }
}

/// The part of the file's time that a clip shows, seconds.
pub(super) struct Range {
    begin: f64,
    end: f64,
}

impl Range {
    /// The stack's own where it has one, otherwise from the first key to the last.
    pub(super) fn of(baked: &ufbx::BakedAnim) -> Result<Self, String> {
        let own = (baked.playback_time_begin, baked.playback_time_end);
        let (begin, end) = if own.0 < own.1 { own } else { (baked.key_time_min, baked.key_time_max) };
        let duration = end - begin;
        if !(begin.is_finite() && (0.0..=f64::from(MAX_DURATION_S)).contains(&duration)) {
            return Err(format!("lasts {duration} s; 0 to {MAX_DURATION_S} s are supported"));
        }
        Ok(Self { begin, end })
    }

    pub(super) fn duration_s(&self) -> f32 {
        (self.end - self.begin) as f32
    }

    /// The keys within the range; at its ends, where keys outside reach in, what is between them. `None` where there is
    /// nothing but `rest`.
    pub(super) fn curve<T: Copy + PartialEq>(
        &self,
        keys: &[Key<T>],
        rest: T,
        law: &Law<T>,
    ) -> Option<Curve<T>> {
        let first = keys.first()?;
        if keys.iter().all(|key| key.value == first.value) {
            let values = vec![first.value];
            let curve = Curve { times_s: vec![0.0], values, interpolation: Interpolation::Step };
            return (!(law.is_near)(first.value, rest)).then_some(curve);
        }
        let steps = is_stepped(keys);
        // Of a step the left side is not a key, it only holds the one before.
        let held = |key: &&Key<T>| !(steps && key.flags.has_any(ufbx::BakedKeyFlags::STEP_LEFT));
        let keys: Vec<Key<T>> = keys.iter().filter(held).copied().collect();
        let at = |time: f64| {
            let after = keys.partition_point(|key| key.time <= time);
            let (Some(a), b) = (keys[..after].last(), keys.get(after)) else { return keys[0].value };
            match b {
                Some(b) if !steps => {
                    (law.mix)(a.value, b.value, ((time - a.time) / (b.time - a.time)) as f32)
                }
                _ => a.value,
            }
        };
        let mut curve = Curve {
            times_s: vec![0.0],
            values: vec![at(self.begin)],
            interpolation: if steps { Interpolation::Step } else { Interpolation::Linear },
        };
        let inside = keys.iter().filter(|key| key.time > self.begin && key.time < self.end);
        let inside = inside.map(|key| (key.time, key.value)).chain([(self.end, at(self.end))]);
        for (time, value) in inside {
            let time_s = (time - self.begin) as f32;
            // Times that are one in single precision: the later key counts.
            if curve.times_s.last().is_some_and(|last| *last >= time_s) {
                let last = curve.values.len() - 1;
                curve.values[last] = value;
            } else {
                curve.times_s.push(time_s);
                curve.values.push(value);
            }
        }
        Some(curve)
    }
}

/// The keys with others between them, within the range, until straight lines between all follow what `evaluate` gives.
/// Where that gives nothing the keys stay.
pub(super) fn refined<T: Copy>(
    keys: Vec<Key<T>>,
    range: &Range,
    law: &Law<T>,
    evaluate: impl Fn(f64) -> Option<T>,
) -> Vec<Key<T>> {
    let mut all = Vec::with_capacity(keys.len());
    for (index, key) in keys.iter().enumerate() {
        all.push(*key);
        if let Some(next) = keys.get(index + 1).filter(|next| key.time < range.end && next.time > range.begin)
        {
            subdivide(key, next, MAX_HALVINGS, law, &evaluate, &mut all);
        }
    }
    all
}

/// Appends what is needed between two keys.
fn subdivide<T: Copy>(
    a: &Key<T>,
    b: &Key<T>,
    halvings: u32,
    law: &Law<T>,
    evaluate: &impl Fn(f64) -> Option<T>,
    all: &mut Vec<Key<T>>,
) {
    let gap = b.time - a.time;
    // Never into a step, which is meant to jump.
    if halvings == 0 || gap < 2.0 * STEP_S {
        return;
    }
    let middle_time = a.time + 0.5 * gap;
    let Some(middle) = evaluate(middle_time) else { return };
    let follows = |share: f64, value: T| (law.is_near)((law.mix)(a.value, b.value, share as f32), value);
    let bent = |share: f64| evaluate(a.time + share * gap).is_some_and(|value| !follows(share, value));
    if !follows(0.5, middle) || bent(0.25) || bent(0.75) {
        let middle = Key { time: middle_time, value: middle, flags: ufbx::BakedKeyFlags::NONE };
        subdivide(a, &middle, halvings - 1, law, evaluate, all);
        all.push(middle);
        subdivide(&middle, b, halvings - 1, law, evaluate, all);
    }
}

/// Whether the value changes in steps only.
fn is_stepped<T: PartialEq>(keys: &[Key<T>]) -> bool {
    keys.windows(2).all(|pair| {
        let jump =
            pair[0].flags.has_any(ufbx::BakedKeyFlags::STEP_LEFT) && pair[1].time - pair[0].time < STEP_S;
        pair[0].value == pair[1].value || jump
    })
}

/// With further keys where the value passes 0 or one of the targets.
pub(super) fn with_bends(curve: Curve<f64>, targets: &[f64]) -> Curve<f64> {
    let mut bent = Curve { times_s: Vec::new(), values: Vec::new(), interpolation: curve.interpolation };
    for (index, (time, value)) in curve.times_s.iter().zip(&curve.values).enumerate() {
        if let Some(before) = index.checked_sub(1) {
            let (from_s, from) = (curve.times_s[before], curve.values[before]);
            let share = |target: f64| (target - from) / (value - from);
            let mut shares: Vec<(f64, f64)> =
                targets.iter().chain([&0.0]).map(|at| (share(*at), *at)).collect();
            shares.retain(|(share, _)| *share > 0.0 && *share < 1.0);
            shares.sort_by(|a, b| a.0.total_cmp(&b.0));
            for (share, target) in shares {
                let time_s = from_s + (time - from_s) * share as f32;
                if time_s > *bent.times_s.last().unwrap_or(&from_s) && time_s < *time {
                    bent.times_s.push(time_s);
                    bent.values.push(target);
                }
            }
        }
        bent.times_s.push(*time);
        bent.values.push(*value);
    }
    bent
}

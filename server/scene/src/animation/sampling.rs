//! Clips for the GPU: each curve with its own keys and its own interpolation.
//!
//! Two ways produce them. *Constant* sampling evaluates every curve at one interval, as the paper does. *Error-bounded*
//! sampling keeps the fewest keys with which no skinned vertex leaves the original by more than a bound (`bounded`). The
//! evaluation does not depend on the way.

mod bounded;
pub(crate) mod curve;
mod exchange;
mod fit;
mod moving;
mod parse;
mod paths;
pub(crate) mod probe;
pub(crate) mod source;

pub use parse::SamplingError;
pub use paths::SampledPaths;
use source::Source;

use crate::{Cancel, Cancelled, Model, Scene, Trs};
use glam::{Affine3A, Quat, Vec3A, Vec4};
use serde::{Deserialize, Serialize};

/// Interval of constant sampling where none is given, seconds: the paper's.
pub const DEFAULT_INTERVAL_S: f32 = 0.1;
/// Farthest that a vertex may leave the original where no bound is given, metres.
pub const DEFAULT_BOUND_M: f32 = 1e-4;
/// Farthest that a curve may leave its original where no share is given, in parts of the curve's range. A quarter less
/// than the 0.25 % that is aimed at: the client's interpolation may enlarge what it interpolates by a quarter.
pub const DEFAULT_RANGE_SHARE: f32 = 0.002;
/// Most keys in one clip sampled at a constant interval (16 bytes each). Longer clips get a longer interval instead.
pub const MAX_CONSTANT_KEYS: usize = 3 << 24;
/// Two key values that differ by no more in any component are the same: some 8 steps of a single near 1.
const SAME: f32 = 1e-6;

/// How clips become keys.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Sampling {
    /// A key each so many seconds, linear between them.
    Constant {
        /// Seconds, positive. The interval used is shorter, so that a whole number of them fills the clip.
        interval_s: f32,
    },
    /// The fewest keys with which nothing leaves the original by more than both bounds.
    ErrorBounded {
        /// Largest distance of a skinned vertex from where the original has it, metres of model space, positive.
        bound_m: f32,
        /// Largest error of a curve in parts of its own range, positive; 1 leaves curves to the first bound alone.
        range_share: f32,
    },
}

impl Sampling {
    /// The same for a model that is drawn so many times as large as it is: distances in the world become distances in
    /// the model.
    #[must_use]
    pub fn in_model(self, world_scale: f32) -> Self {
        match self {
            Self::ErrorBounded { bound_m, range_share } if world_scale > 0.0 && world_scale.is_finite() => {
                Self::ErrorBounded { bound_m: bound_m / world_scale, range_share }
            }
            other => other,
        }
    }

    /// Error-bounded by vertices alone.
    pub fn bounded(bound_m: f32) -> Self {
        Self::ErrorBounded { bound_m, range_share: 1.0 }
    }
}

impl Default for Sampling {
    fn default() -> Self {
        Self::ErrorBounded { bound_m: DEFAULT_BOUND_M, range_share: DEFAULT_RANGE_SHARE }
    }
}

/// A clip of one model.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct SampledClip {
    /// Length in seconds; 0 for a rest pose.
    pub duration_s: f32,
    /// By bone: translation (xyz, metres), rotation (xyzw), scale (xyz).
    pub bones: Vec<[SampledTrack; 3]>,
    /// By morph target: its weight, in x.
    pub morphs: Vec<SampledTrack>,
}

/// One curve. A curve that does not change has one key.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SampledTrack {
    /// How to go from key to key.
    pub interpolation: KeyInterpolation,
    /// Positive: key `i` stands at `i * interval_s`. 0: keys stand at `times_s`.
    pub interval_s: f32,
    /// Seconds, strictly rising from 0, one per key whatever the interval.
    pub times_s: Vec<f32>,
    /// One per key: xyz, a quaternion's xyzw, or a weight in x. Neighbouring quaternions lie in one hemisphere.
    pub values: Vec<Vec4>,
    /// Change per second at each key; only for [`KeyInterpolation::Cubic`], else empty.
    pub tangents: Vec<Vec4>,
}

/// How to go from key to key. A rotation is interpolated componentwise and then made unit length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum KeyInterpolation {
    /// The earlier key holds.
    Step,
    /// A straight line.
    Linear,
    /// Hermite's cubic of both keys' values and tangents.
    Cubic,
}

impl SampledTrack {
    /// A curve that does not change.
    pub fn constant(value: Vec4) -> Self {
        Self {
            interpolation: KeyInterpolation::Step,
            interval_s: 0.0,
            times_s: vec![0.0],
            values: vec![value],
            tangents: Vec::new(),
        }
    }

    /// Whether there is but one key.
    pub fn is_constant(&self) -> bool {
        self.values.len() == 1
    }

    /// The value `t_s` seconds into the clip, held before the first and after the last key. A rotation's is not yet of
    /// unit length.
    pub fn evaluate(&self, t_s: f64) -> Vec4 {
        let (key, fraction) = self.place(t_s);
        if self.is_constant() || fraction <= 0.0 {
            return self.values[key];
        }
        let (from, to) = (self.values[key], self.values[key + 1]);
        match self.interpolation {
            KeyInterpolation::Step => from,
            KeyInterpolation::Linear => from + (to - from) * fraction,
            KeyInterpolation::Cubic => {
                let span_s = self.times_s[key + 1] - self.times_s[key];
                let [a, b, c, d] = hermite_weights(fraction, span_s);
                from * a + self.tangents[key] * b + to * c + self.tangents[key + 1] * d
            }
        }
    }

    /// The key at or before a time, and the fraction of the way to the next one: 0 at the last key and beyond.
    pub fn place(&self, t_s: f64) -> (usize, f32) {
        let last = self.values.len() - 1;
        if self.interval_s > 0.0 {
            let position = (t_s / f64::from(self.interval_s)).clamp(0.0, last as f64);
            let key = position as usize;
            return (key, (position - key as f64) as f32);
        }
        let key = self.times_s.partition_point(|time| f64::from(*time) <= t_s).saturating_sub(1);
        if key == last {
            return (last, 0.0);
        }
        let [from, to] = [self.times_s[key], self.times_s[key + 1]].map(f64::from);
        (key, ((t_s - from) / (to - from)).max(0.0) as f32)
    }

    /// Bytes on the GPU: 16 for each value and tangent, 4 for the time of each key that has no constant interval, and
    /// 16 for the curve itself.
    pub fn byte_count(&self) -> usize {
        let times = if self.interval_s > 0.0 || self.is_constant() { 0 } else { self.times_s.len() };
        16 * (1 + self.values.len() + self.tangents.len()) + 4 * times
    }
}

/// Weights of value, tangent, next value, next tangent at `f` in 0..=1 of a span in seconds.
pub(crate) fn hermite_weights(f: f32, span_s: f32) -> [f32; 4] {
    let (f2, f3) = (f * f, f * f * f);
    [2.0 * f3 - 3.0 * f2 + 1.0, span_s * (f3 - 2.0 * f2 + f), 3.0 * f2 - 2.0 * f3, span_s * (f3 - f2)]
}

impl SampledClip {
    /// The local transforms of all bones `t_s` seconds into the clip, clamped.
    pub fn local_pose(&self, t_s: f64) -> Vec<Trs> {
        self.bones.iter().map(|tracks| transform(tracks, t_s)).collect()
    }

    /// The weights of all morph targets `t_s` seconds into the clip, clamped.
    pub fn morph_weights(&self, t_s: f64) -> Vec<f32> {
        self.morphs.iter().map(|track| track.evaluate(t_s).x).collect()
    }

    /// All curves: those of the bones in their order, then the morphs'.
    pub fn tracks(&self) -> impl Iterator<Item = &SampledTrack> {
        self.bones.iter().flatten().chain(&self.morphs)
    }

    /// Keys of all curves together.
    pub fn key_count(&self) -> usize {
        self.tracks().map(|track| track.values.len()).sum()
    }

    /// Bytes on the GPU of all curves together.
    pub fn byte_count(&self) -> usize {
        self.tracks().map(SampledTrack::byte_count).sum()
    }
}

fn transform([translation, rotation, scale]: &[SampledTrack; 3], t_s: f64) -> Trs {
    Trs {
        translation: translation.evaluate(t_s).truncate(),
        rotation: unit_rotation(rotation, t_s),
        scale: scale.evaluate(t_s).truncate(),
    }
}

/// The rotation of a track, of unit length.
fn unit_rotation(track: &SampledTrack, t_s: f64) -> Quat {
    // Opposite keys half a turn apart may meet at zero.
    let unit = track.evaluate(t_s).try_normalize().unwrap_or(track.values[track.place(t_s).0]);
    Quat::from_vec4(unit)
}

/// Samples a clip of the model, or its rest pose for `None`.
pub fn sample(model: &Model, clip: Option<usize>, sampling: Sampling) -> SampledClip {
    sample_until(model, clip, sampling, &Cancel::default()).expect("nobody asks to end")
}

/// As [`sample`], until somebody asks to end.
///
/// # Errors
/// Somebody asked to end.
pub fn sample_until(
    model: &Model,
    clip: Option<usize>,
    sampling: Sampling,
    cancel: &Cancel,
) -> Result<SampledClip, Cancelled> {
    cancel.check()?;
    match sampling {
        Sampling::Constant { interval_s } => Ok(constant(model, clip, interval_s)),
        Sampling::ErrorBounded { bound_m, range_share } => {
            bounded::sample(model, clip, [bound_m, range_share], cancel)
        }
    }
}

/// The scale at which a model's largest instance is drawn; 1 for a model without instances.
pub fn world_scale(scene: &Scene, model: usize) -> f32 {
    let placed = scene.instances.iter().filter(|instance| instance.model == model);
    let largest = placed.map(|instance| longest_axis(&instance.placement)).fold(0.0, f32::max);
    if largest > 0.0 { largest } else { 1.0 }
}

/// The length of a transform's longest axis.
pub fn longest_axis(matrix: &Affine3A) -> f32 {
    let m = matrix.matrix3;
    [m.x_axis, m.y_axis, m.z_axis].map(Vec3A::length).into_iter().fold(0.0, f32::max)
}

fn constant(model: &Model, clip: Option<usize>, interval_s: f32) -> SampledClip {
    assert!(interval_s > 0.0, "sampling interval {interval_s} s");
    let duration_s = model.duration_s(clip);
    let sources = source::Sources::new(model, clip);
    let intervals = interval_count(duration_s, interval_s, sources.count());
    sources.map(duration_s, |source| constant_track(source, duration_s, intervals))
}

fn constant_track(source: &Source, duration_s: f32, intervals: u32) -> SampledTrack {
    if intervals == 0 || !source.varies() {
        return SampledTrack::constant(source.at(0.0));
    }
    let step_s = f64::from(duration_s) / f64::from(intervals);
    let mut times_s: Vec<f32> = (0..=intervals).map(|key| (f64::from(key) * step_s) as f32).collect();
    times_s[intervals as usize] = duration_s;
    let values = source.aligned(&times_s);
    if values.iter().all(|value| (*value - values[0]).abs().max_element() <= SAME) {
        return SampledTrack::constant(values[0]);
    }
    SampledTrack {
        interpolation: KeyInterpolation::Linear,
        interval_s: step_s as f32,
        times_s,
        values,
        tangents: Vec::new(),
    }
}

/// Intervals that fill the duration; 0 where there is none.
fn interval_count(duration_s: f32, interval_s: f32, track_count: usize) -> u32 {
    if duration_s <= 0.0 {
        return 0;
    }
    // A thousandth of an interval of slack: 4 s are 240 sixtieths, not 241, whatever f32 makes of 1/60.
    let wanted = (f64::from(duration_s) / f64::from(interval_s) - 1e-3).ceil().max(1.0);
    let limit = (MAX_CONSTANT_KEYS / track_count.max(1)).saturating_sub(1).max(1) as f64;
    if wanted > limit {
        let longer_s = f64::from(duration_s) / limit;
        tracing::warn!(
            "a clip of {duration_s} s is sampled every {longer_s} s instead of every {interval_s} s"
        );
    }
    wanted.min(limit) as u32
}

#[cfg(test)]
mod tests;

//! A densely evaluated source curve, and the distance of another curve from it.

use super::source::Source;
use crate::Interpolation;
use glam::Vec4;

/// Longest distance of two points of time at which a curve is looked at, seconds.
const MAX_SPACING_S: f32 = 1.0 / 30.0;
/// Most points of time that are added to a curve's own keys.
const MAX_ADDED_POINTS: f32 = 8192.0;
/// Most parts into which spans between keys are divided because of wide turns.
const MAX_PARTS: u32 = 32;
/// Points among which the largest distance of two is looked for.
const RANGE_POINTS: usize = 192;

/// A rotation that turns by no more, in radians, is still: 0.1 mm at a distance of 1 m.
pub(crate) const STILL_TURN_RAD: f32 = 1e-4;
/// A translation in metres, a scale, or a weight that changes by no more is still.
pub(crate) const STILL_CHANGE: f32 = 1e-5;

/// Values of a curve at many times.
#[derive(Clone, Debug)]
pub(crate) struct Curve {
    /// Seconds, strictly rising from 0 to the clip's end.
    pub times_s: Vec<f32>,
    /// By time. Neighbouring quaternions lie in one hemisphere.
    pub values: Vec<Vec4>,
    /// By time: change per second.
    pub slopes: Vec<Vec4>,
    /// Which of the times are the source's own keys, the clip's start or its end; ascending.
    pub own_keys: Vec<usize>,
    /// Whether values are quaternions.
    pub is_rotation: bool,
    /// Whether the source jumps from key to key.
    pub is_step: bool,
    /// Whether the source goes straight from key to key.
    pub is_straight: bool,
}

impl Curve {
    /// Samples a source over a clip of positive duration.
    pub fn new(source: &Source, duration_s: f32) -> Self {
        let is_step = source.interpolation() == Interpolation::Step;
        let is_cubic = source.interpolation() == Interpolation::CubicSpline;
        let mut parts = match source.interpolation() {
            Interpolation::Step => 1,
            Interpolation::Linear => 2,
            Interpolation::CubicSpline => 4,
        };
        let (mut times_s, mut own_keys) = dense_times(source.times_s(), duration_s, parts);
        let mut values = source.aligned(&times_s);
        while !is_step && source.is_rotation() && turns_far(&values, parts) {
            parts *= 2;
            (times_s, own_keys) = dense_times(source.times_s(), duration_s, parts);
            values = source.aligned(&times_s);
        }
        // Between the keys of a linear source there is no more to learn about its slope.
        let slopes = if is_cubic {
            parabola_slopes(&times_s, &values, &(0..times_s.len()).collect::<Vec<_>>())
        } else {
            parabola_slopes(&times_s, &values, &own_keys)
        };
        let is_straight = !is_step && !is_cubic;
        Self { times_s, values, slopes, own_keys, is_rotation: source.is_rotation(), is_step, is_straight }
    }

    /// The same looked at twice as often, for a curve that is straight between its times.
    pub fn halved(&self) -> Self {
        let empty = Self { times_s: Vec::new(), values: Vec::new(), slopes: Vec::new(), ..self.clone() };
        let mut halved = Self { own_keys: Vec::new(), ..empty };
        for index in 0..self.times_s.len() {
            if self.own_keys.binary_search(&index).is_ok() {
                halved.own_keys.push(halved.times_s.len());
            }
            halved.push(self.times_s[index], self.values[index], self.slopes[index]);
            if let Some((time_s, value, slope)) = self.between(index) {
                halved.push(time_s, value, slope);
            }
        }
        halved
    }

    /// Half way from one time to the next; `None` where there is no number between them.
    fn between(&self, index: usize) -> Option<(f32, Vec4, Vec4)> {
        let (from_s, to_s) = (self.times_s[index], *self.times_s.get(index + 1)?);
        let (from, to) = (self.values[index], self.values[index + 1]);
        let (time_s, middle) = (from_s.midpoint(to_s), (from + to) * 0.5);
        let value = if self.is_rotation { middle.try_normalize()? } else { middle };
        (from_s < time_s && time_s < to_s).then(|| (time_s, value, (to - from) / (to_s - from_s)))
    }

    fn push(&mut self, time_s: f32, value: Vec4, slope: Vec4) {
        self.times_s.push(time_s);
        self.values.push(value);
        self.slopes.push(slope);
    }

    /// How far `value` is from the curve at one of its times: a length, or an angle in radians.
    pub fn deviation(&self, value: Vec4, index: usize) -> f32 {
        let (across, along) = self.offset(value, index);
        if self.is_rotation { 2.0 * across.sqrt().atan2(along) } else { across.sqrt() }
    }

    /// Whether `value` is within a tolerance of the curve at one of its times.
    pub fn is_within(&self, value: Vec4, index: usize, tolerance: Tolerance) -> bool {
        let (across, along) = self.offset(value, index);
        if self.is_rotation {
            along > 0.0 && across <= tolerance.half_tangent_squared * along * along
        } else {
            across <= tolerance.squared
        }
    }

    /// For a rotation the parts of a quaternion of any length across (squared) and along the curve's, whose quotient is
    /// the tangent of half the angle; else the squared distance.
    fn offset(&self, value: Vec4, index: usize) -> (f32, f32) {
        let truth = self.values[index];
        if !self.is_rotation {
            return (value.distance_squared(truth), 0.0);
        }
        let along = value.dot(truth);
        ((value - truth * along).length_squared(), along)
    }

    /// The range up to which the curve counts as still: [`STILL_TURN_RAD`] or [`STILL_CHANGE`].
    pub fn still_range(&self) -> f32 {
        if self.is_rotation { STILL_TURN_RAD } else { STILL_CHANGE }
    }

    /// The largest distance of two values of the curve.
    pub fn range(&self) -> f32 {
        range(&self.values, self.is_rotation)
    }
}

/// Whether spans between keys need more parts. Spherical and componentwise interpolation agree in the middle of a turn
/// and differ before and after it, by `0.0040 a^3`. From key to key that is seen at quarters: halves will do for 4
/// microradians. From part to part it is not seen: 14 microradians.
fn turns_far(values: &[Vec4], parts: u32) -> bool {
    let allowed_rad = if parts == 2 { 0.05 } else { 0.15 };
    parts < MAX_PARTS && values.windows(2).any(|pair| angle(pair[0], pair[1]) > allowed_rad)
}

/// A tolerance in the forms that make comparisons cheap.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tolerance {
    squared: f32,
    half_tangent_squared: f32,
}

impl Tolerance {
    /// A length, or an angle in radians.
    pub fn new(value: f32) -> Self {
        let half_tangent = (0.5 * value.min(3.0)).tan();
        Self { squared: value * value, half_tangent_squared: half_tangent * half_tangent }
    }
}

/// The angle in radians between unit quaternions, precise for small ones.
pub(crate) fn angle(a: Vec4, b: Vec4) -> f32 {
    let chord = a.distance_squared(b).min((a + b).length_squared()).sqrt();
    4.0 * (chord * 0.5).min(1.0).asin()
}

/// The largest distance of two of some values: a length, or an angle in radians.
pub(crate) fn range(values: &[Vec4], is_rotation: bool) -> f32 {
    let step = values.len().div_ceil(RANGE_POINTS).max(1);
    let few: Vec<Vec4> = values.iter().step_by(step).copied().collect();
    let mut largest = 0.0f32;
    for (index, a) in few.iter().enumerate() {
        for b in &few[..index] {
            largest = largest.max(if is_rotation { angle(*a, *b) } else { a.distance(*b) });
        }
    }
    largest
}

/// The keys within the clip, its start and its end, and what divides the spans between them into at least `parts` (a
/// single part: nothing is added). Second: where the keys, the start and the end are among them.
fn dense_times(keys_s: &[f32], duration_s: f32, parts: u32) -> (Vec<f32>, Vec<usize>) {
    let spacing_s = MAX_SPACING_S.max(duration_s / MAX_ADDED_POINTS);
    let inside = keys_s.iter().copied().filter(|time| *time > 0.0 && *time < duration_s);
    let (mut times_s, mut own_keys) = (vec![0.0f32], vec![0]);
    for key_s in inside.chain([duration_s]) {
        let from_s = times_s[times_s.len() - 1];
        let count = if parts == 1 { 1 } else { parts.max(((key_s - from_s) / spacing_s).ceil() as u32) };
        for part in 1..count {
            let time_s = from_s + (key_s - from_s) * (part as f32 / count as f32);
            if time_s > times_s[times_s.len() - 1] && time_s < key_s {
                times_s.push(time_s);
            }
        }
        own_keys.push(times_s.len());
        times_s.push(key_s);
    }
    (times_s, own_keys)
}

/// At each of the `nodes` the slope of the parabola through it and its neighbours, at the ends through the next two;
/// between nodes the slope of the line.
fn parabola_slopes(times_s: &[f32], values: &[Vec4], nodes: &[usize]) -> Vec<Vec4> {
    let line = |a: usize, b: usize| (values[b] - values[a]) / (times_s[b] - times_s[a]);
    let mut slopes = vec![Vec4::ZERO; times_s.len()];
    for pair in nodes.windows(2) {
        slopes[pair[0]..=pair[1]].fill(line(pair[0], pair[1]));
    }
    let last = nodes.len() - 1;
    if last < 2 {
        return slopes;
    }
    for (index, node) in nodes.iter().enumerate() {
        let middle = index.clamp(1, last - 1);
        let [a, b, c] = [nodes[middle - 1], nodes[middle], nodes[middle + 1]];
        let (before, after) = (line(a, b), line(b, c));
        let bend = (after - before) / (times_s[c] - times_s[a]);
        // Newton's form, derived: before + bend * ((t - a) + (t - b)).
        let t = times_s[*node];
        slopes[*node] = before + bend * ((t - times_s[a]) + (t - times_s[b]));
    }
    slopes
}

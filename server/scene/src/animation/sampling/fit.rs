//! The fewest keys of one curve for a tolerance.
//!
//! Keys are chosen greedily, each as far from the previous one as the span between them allows, at the source's own keys where
//! these suffice. That is repeated with more tolerance than allowed. Then the values (and for cubics the tangents) between the
//! ends move to the least sum of squared errors: keys off the curve err to both sides of it, so fewer of them may suffice.

use super::curve::{Curve, Tolerance};
use super::{KeyInterpolation, SAME, SampledTrack, hermite_weights};
use glam::{DVec4, Vec4};

/// How much more than the tolerance keys on the curve may err, for the keys off it to be tried.
const RELAXATIONS: [f32; 4] = [2.2, 1.8, 1.45, 1.2];
/// What holds a value or tangent to where it was, against the weight 1 of each point of the curve: enough to decide
/// where there is no point.
const HOLD: f64 = 1e-5;
/// The same for values that must not move.
const FIX: f64 = 1e9;

/// The curve with the interpolation that needs fewest bytes, nowhere further from it than `tolerance` at the times at
/// which the curve was looked at. The first and the last key are the curve's ends exactly.
pub(super) fn fit(curve: &Curve, tolerance: f32) -> SampledTrack {
    if is_constant(curve, tolerance) {
        return SampledTrack::constant(curve.values[0]);
    }
    if curve.is_step {
        return step(curve, tolerance);
    }
    let linear = fewest(curve, tolerance, KeyInterpolation::Linear);
    let all = own_keys(curve, tolerance).into_iter().chain(linear).chain(cubic(curve, tolerance));
    let smallest = all.map(with_interval).min_by_key(SampledTrack::byte_count);
    smallest.expect("straight lines from point to point always do")
}

/// A cubic may leave a straight source between two points at which it meets it: there it is looked at twice as often.
fn cubic(curve: &Curve, tolerance: f32) -> Option<SampledTrack> {
    let cubic = |curve: &Curve| fewest(curve, tolerance, KeyInterpolation::Cubic);
    if curve.is_straight { cubic(&curve.halved()) } else { cubic(curve) }
}

/// All of the source's keys with straight lines between them, if that will do: at a constant interval a few keys less
/// would take more bytes.
fn own_keys(curve: &Curve, tolerance: f32) -> Option<SampledTrack> {
    let (keys, linear) = (&curve.own_keys, KeyInterpolation::Linear);
    let fits = |pair: &[usize]| span_fits(curve, pair[0], pair[1], Tolerance::new(tolerance), linear);
    keys.windows(2).all(fits).then(|| track(curve, keys, linear))
}

/// Keys that happen to stand at a constant interval need no times.
fn with_interval(mut track: SampledTrack) -> SampledTrack {
    let last = track.times_s.len() - 1;
    let interval_s = track.times_s[last] / last as f32;
    let stands =
        |(key, time_s): (usize, &f32)| (key as f32 * interval_s - time_s).abs() <= 1e-6 * track.times_s[last];
    if last > 1 && track.times_s.iter().enumerate().all(stands) {
        track.interval_s = interval_s;
    }
    track
}

/// The first value will do for all, and the clip ends where it began.
fn is_constant(curve: &Curve, tolerance: f32) -> bool {
    let first = curve.values[0];
    let last = curve.values.len() - 1;
    let closed = curve.deviation(first, last) <= SAME;
    closed && (0..=last).all(|index| curve.deviation(first, index) <= tolerance)
}

fn step(curve: &Curve, tolerance: f32) -> SampledTrack {
    let last = curve.values.len() - 1;
    let mut keys = vec![0];
    for index in 1..=last {
        let held = curve.values[keys[keys.len() - 1]];
        if curve.deviation(held, index) > tolerance || (index == last && held != curve.values[last]) {
            keys.push(index);
        }
    }
    track(curve, &keys, KeyInterpolation::Step)
}

/// Keys on the curve.
fn track(curve: &Curve, keys: &[usize], interpolation: KeyInterpolation) -> SampledTrack {
    let tangents = keys.iter().map(|key| curve.slopes[*key]);
    SampledTrack {
        interpolation,
        interval_s: 0.0,
        times_s: keys.iter().map(|key| curve.times_s[*key]).collect(),
        values: keys.iter().map(|key| curve.values[*key]).collect(),
        tangents: if interpolation == KeyInterpolation::Cubic { tangents.collect() } else { Vec::new() },
    }
}

/// `None` where the interpolation cannot follow the curve.
fn fewest(curve: &Curve, tolerance: f32, interpolation: KeyInterpolation) -> Option<SampledTrack> {
    let on_curve = greedy(curve, tolerance, interpolation)?;
    for relaxation in RELAXATIONS {
        let keys = greedy(curve, tolerance * relaxation, interpolation)?;
        if keys.len() >= on_curve.len() {
            break;
        }
        let moved = least_squares(curve, &keys, track(curve, &keys, interpolation));
        if is_aligned(curve, &moved.values) && is_within(curve, &keys, &moved, Tolerance::new(tolerance)) {
            return Some(moved);
        }
    }
    Some(track(curve, &on_curve, interpolation))
}

/// Whether neighbouring quaternions lie in one hemisphere.
fn is_aligned(curve: &Curve, values: &[Vec4]) -> bool {
    !curve.is_rotation || values.windows(2).all(|pair| pair[0].dot(pair[1]) >= 0.0)
}

// ---- keys on the curve ----

fn greedy(curve: &Curve, tolerance: f32, interpolation: KeyInterpolation) -> Option<Vec<usize>> {
    let last = curve.values.len() - 1;
    let tolerance = Tolerance::new(tolerance);
    let mut keys = vec![0];
    while keys[keys.len() - 1] < last {
        let from = keys[keys.len() - 1];
        let to = furthest(curve, from, |to| span_fits(curve, from, to, tolerance, interpolation));
        if to == from + 1 && curve.is_straight && interpolation == KeyInterpolation::Cubic {
            return None; // nothing says that it is straight in between, too
        }
        keys.push(to);
    }
    Some(keys)
}

/// The furthest time to which a span may reach: one of the source's keys if any will do.
fn furthest(curve: &Curve, from: usize, fits: impl Fn(usize) -> bool) -> usize {
    let own = &curve.own_keys[curve.own_keys.partition_point(|key| *key <= from)..];
    if let Some(index) = last_fitting(own.len(), |index| fits(own[index])) {
        return own[index];
    }
    // Between the next two points there is none to miss.
    last_fitting(own[0] - from - 1, |index| fits(from + 1 + index)).map_or(from + 1, |index| from + 1 + index)
}

/// The last of `count` that fits, if those that fit are the first ones: by steps that double, then by halving.
fn last_fitting(count: usize, fits: impl Fn(usize) -> bool) -> Option<usize> {
    if count == 0 || !fits(0) {
        return None;
    }
    let (mut good, mut bad, mut step) = (0, count, 1);
    while good + step < bad {
        if fits(good + step) {
            good += step;
            step *= 2;
        } else {
            bad = good + step;
        }
    }
    while bad - good > 1 {
        let middle = good.midpoint(bad);
        if fits(middle) {
            good = middle;
        } else {
            bad = middle;
        }
    }
    Some(good)
}

fn span_fits(
    curve: &Curve,
    from: usize,
    to: usize,
    tolerance: Tolerance,
    interpolation: KeyInterpolation,
) -> bool {
    let (a, b) = (curve.values[from], curve.values[to]);
    if !is_aligned(curve, &[a, b]) {
        return false;
    }
    let (slope_a, slope_b) = (curve.slopes[from], curve.slopes[to]);
    let span_s = curve.times_s[to] - curve.times_s[from];
    let value = |index: usize| {
        let fraction = (curve.times_s[index] - curve.times_s[from]) / span_s;
        match interpolation {
            KeyInterpolation::Cubic => {
                let [w, x, y, z] = hermite_weights(fraction, span_s);
                a * w + slope_a * x + b * y + slope_b * z
            }
            _ => a + (b - a) * fraction,
        }
    };
    // From the middle outwards, where errors are largest, so that what fails fails soon.
    let middle = from.midpoint(to);
    (middle..to).chain(from + 1..middle).all(|index| curve.is_within(value(index), index, tolerance))
}

fn is_within(curve: &Curve, keys: &[usize], track: &SampledTrack, tolerance: Tolerance) -> bool {
    let mut all = true;
    for_each_point(curve, keys, track.interpolation, |index, first, weights| {
        let value = unknowns(track, first, weights.len()).zip(weights).map(|(v, w)| v * *w).sum();
        all &= curve.is_within(value, index, tolerance);
    });
    all
}

// ---- keys off the curve ----

/// Calls with each point of the curve: its index, the number of the first unknown that it depends on, and the weights
/// of that and the following ones. Unknowns are the keys' values, for cubics value and tangent in turn.
fn for_each_point(
    curve: &Curve,
    keys: &[usize],
    interpolation: KeyInterpolation,
    mut each: impl FnMut(usize, usize, &[f32]),
) {
    let cubic = interpolation == KeyInterpolation::Cubic;
    for (number, pair) in keys.windows(2).enumerate() {
        let (from_s, span_s) = (curve.times_s[pair[0]], curve.times_s[pair[1]] - curve.times_s[pair[0]]);
        let end = if number + 2 == keys.len() { pair[1] + 1 } else { pair[1] };
        for index in pair[0]..end {
            let fraction = (curve.times_s[index] - from_s) / span_s;
            match cubic {
                true => each(index, 2 * number, &hermite_weights(fraction, span_s)),
                false => each(index, number, &[1.0 - fraction, fraction]),
            }
        }
    }
}

fn unknowns(track: &SampledTrack, first: usize, count: usize) -> impl Iterator<Item = Vec4> {
    let cubic = track.interpolation == KeyInterpolation::Cubic;
    (first..first + count).map(move |number| match (cubic, number % 2) {
        (false, _) => track.values[number],
        (true, 0) => track.values[number / 2],
        (true, _) => track.tangents[number / 2],
    })
}

fn least_squares(curve: &Curve, keys: &[usize], mut track: SampledTrack) -> SampledTrack {
    let cubic = track.interpolation == KeyInterpolation::Cubic;
    let count = if cubic { 2 * keys.len() } else { keys.len() };
    let mut system = Banded::new(count);
    for (number, start) in unknowns(&track, 0, count).enumerate() {
        let is_tangent = cubic && number % 2 == 1;
        let key = if cubic { number / 2 } else { number };
        let span_s = f64::from(span_at(&track.times_s, key));
        let at_end = !is_tangent && (key == 0 || key == keys.len() - 1);
        let strength = if at_end {
            FIX
        } else if is_tangent {
            HOLD * span_s * span_s
        } else {
            HOLD
        };
        system.add(number, &[1.0], strength, start.as_dvec4());
    }
    for_each_point(curve, keys, track.interpolation, |index, first, weights| {
        system.add(first, weights, 1.0, curve.values[index].as_dvec4());
    });
    let solved = system.solve();
    let last = keys.len() - 1;
    for key in 0..=last {
        if key > 0 && key < last {
            track.values[key] = solved[if cubic { 2 * key } else { key }].as_vec4();
        }
        if cubic {
            track.tangents[key] = solved[2 * key + 1].as_vec4();
        }
    }
    track
}

/// The shorter of the spans beside a key.
fn span_at(times_s: &[f32], key: usize) -> f32 {
    let spans = times_s[key.saturating_sub(1)..(key + 2).min(times_s.len())].windows(2);
    spans.map(|pair| pair[1] - pair[0]).fold(f32::INFINITY, f32::min)
}

/// Normal equations of which each unknown meets at most the [`BAND`] before it.
struct Banded {
    /// By row: entries of the columns `row - BAND..=row`.
    rows: Vec<[f64; BAND + 1]>,
    right: Vec<DVec4>,
}

const BAND: usize = 3;

impl Banded {
    fn new(count: usize) -> Self {
        Self { rows: vec![[0.0; BAND + 1]; count], right: vec![DVec4::ZERO; count] }
    }

    /// Wants `sum(weights * unknowns from first)` to be `value`.
    fn add(&mut self, first: usize, weights: &[f32], strength: f64, value: DVec4) {
        for (i, wi) in weights.iter().enumerate() {
            let scaled = f64::from(*wi) * strength;
            self.right[first + i] += value * scaled;
            for (j, wj) in weights[..=i].iter().enumerate() {
                self.rows[first + i][BAND + j - i] += scaled * f64::from(*wj);
            }
        }
    }

    /// Cholesky's decomposition and both substitutions.
    fn solve(mut self) -> Vec<DVec4> {
        let count = self.rows.len();
        for row in 0..count {
            for column in row.saturating_sub(BAND)..=row {
                let mut sum = self.entry(row, column);
                for k in row.saturating_sub(BAND)..column {
                    sum -= self.entry(row, k) * self.entry(column, k);
                }
                let value =
                    if column == row { sum.max(1e-30).sqrt() } else { sum / self.entry(column, column) };
                self.rows[row][BAND + column - row] = value;
            }
            for k in row.saturating_sub(BAND)..row {
                let known = self.right[k] * self.entry(row, k);
                self.right[row] -= known;
            }
            let diagonal = self.entry(row, row);
            self.right[row] /= diagonal;
        }
        for row in (0..count).rev() {
            for k in row + 1..(row + BAND + 1).min(count) {
                let known = self.right[k] * self.entry(k, row);
                self.right[row] -= known;
            }
            let diagonal = self.entry(row, row);
            self.right[row] /= diagonal;
        }
        self.right
    }

    /// Zero outside the band.
    fn entry(&self, row: usize, column: usize) -> f64 {
        if column + BAND < row { 0.0 } else { self.rows[row][BAND + column - row] }
    }
}

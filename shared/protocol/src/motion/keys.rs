//! The curves of a chunk in bits. The numbers of a curve are multiples of a power of two, its step, which is found here:
//! coarsely rounded numbers become small. Each number is coded as its difference from a prediction by the previous ones:
//!
//! - a value is predicted as the previous one, and the tangents of both by the line between them;
//! - of a rotation, one component, the same for all keys, is predicted by unit length, and its tangent by constant length.
//!
//! The coding is lossless: the prediction decides the number of bits, not the value. Writer and reader share the same code
//! (`Coder`).

use super::bits::{BitReader, BitWriter, width_of};
use super::key_times::KeyTimes;
use super::skeleton::check_finite;
use crate::limits::MAX_CHUNK_KEYS;
use crate::wire::{Reader, WireError, check_count, invalid, put_varint, unzigzag, zigzag};
use std::ops::Range;

/// A step is at least 2 to the power of this, and less than 2 to the power of its negative.
const LEAST_EXPONENT: i32 = -64;
const EXPONENT_BITS: u32 = 7;
/// Where numbers are too far apart for 32 bits, the largest is at least 2 to the power of this steps: what is finer is rounded.
const STEPS_LOG2: i32 = 30;
const KIND_BITS: u32 = 2;
/// 0, 1, 2 or 3 for one, three or four numbers a value, or a rotation.
const FORM_BITS: u32 = 2;
/// Which number of a rotation is expected from the others.
const LARGEST_BITS: u32 = 2;
/// That number is at least this: the smaller it is, the less the others say of it.
const LEAST_LARGEST: f32 = 0.25;
/// How far a rotation may be from unit length.
const NOT_UNIT: f32 = 0.01;
/// The scale of most bones.
const ONE: [f32; 4] = [1.0, 1.0, 1.0, 0.0];
const WHAT: &str = "a curve of a clip";

/// How to go from key to key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackKind {
    /// The earlier key holds.
    Step,
    /// A straight line.
    Linear,
    /// Hermite's cubic of both keys' values and tangents.
    Cubic,
}

/// One curve within a chunk. A curve that does not change there has one key. The coarser the power of two of which all values are
/// multiples, and all tangents, the fewer bytes it takes; what is finer than 2^-30 of the largest is rounded.
#[derive(Clone, Debug, PartialEq)]
pub struct ChunkTrack {
    /// How to go from key to key.
    pub kind: TrackKind,
    /// Seconds of the clip, one per key.
    pub times_s: Vec<f32>,
    /// xyz of a translation or scale, a quaternion's xyzw, or a weight in x.
    pub values: Vec<[f32; 4]>,
    /// Change per second at each key; only for [`TrackKind::Cubic`] with more than one key.
    pub tangents: Vec<[f32; 4]>,
}

/// Appends curves.
pub(super) fn put_tracks(out: &mut Vec<u8>, tracks: &[ChunkTrack]) {
    let moving = tracks.iter().filter(|track| track.values.len() > 1);
    let times = KeyTimes::of(moving.map(|track| track.times_s.as_slice()));
    times.put(out);
    let most = tracks.iter().map(|track| track.values.len() - 1).max().unwrap_or(0);
    let count_width = width_of(most as u32);
    put_varint(out, count_width);
    let mut bits = BitWriter::new(out);
    tracks.iter().for_each(|track| put_track(&mut bits, track, &times, count_width));
    bits.finish();
}

/// Reads so many curves that [`put_tracks`] wrote.
pub(super) fn take_tracks(reader: &mut Reader<'_>, count: usize) -> Result<Vec<ChunkTrack>, WireError> {
    let times = KeyTimes::take(reader)?;
    let count_width = reader.varint()?;
    check_count("the bits of a number of keys", count_width as usize, u32::BITS as usize)?;
    let (bytes, what) = (reader.rest(), reader.what);
    let mut bits = BitReader::new(WHAT, bytes);
    let (mut tracks, mut keys_left) = (Vec::new(), MAX_CHUNK_KEYS as usize);
    for _ in 0..count {
        let track = take_track(&mut bits, &times, count_width, keys_left)?;
        keys_left -= track.values.len();
        tracks.push(track);
    }
    *reader = Reader::new(what, &bytes[bits.bytes_read()..]);
    Ok(tracks)
}

fn put_track(bits: &mut BitWriter<'_>, track: &ChunkTrack, times: &KeyTimes, count_width: u32) {
    let kind = match track.kind {
        TrackKind::Step => 0,
        TrackKind::Linear => 1,
        TrackKind::Cubic => 2,
    };
    bits.put(kind, KIND_BITS);
    bits.put(u32::from(track.values == [ONE]), 1);
    if track.values == [ONE] {
        return;
    }
    bits.put(track.values.len() as u32 - 1, count_width);
    if track.values.len() > 1 {
        times.put_curve(bits, &track.times_s);
    }
    let form = Form::of(track);
    form.put(bits);
    let mut numbers = Numbers {
        exponents: [&track.values, &track.tangents].map(|numbers| exponent_of(numbers)),
        values: [const { Vec::new() }; 4],
        tangents: [const { Vec::new() }; 4],
    };
    for axis in 0..form.count() {
        let [value, tangent] = numbers.exponents;
        numbers.values[axis] = track.values.iter().map(|key| steps(key[axis], value)).collect();
        numbers.tangents[axis] = track.tangents.iter().map(|key| steps(key[axis], tangent)).collect();
    }
    numbers.exponents.iter().take(if track.tangents.is_empty() { 1 } else { 2 }).for_each(|exponent| {
        bits.put((exponent - LEAST_EXPONENT) as u32, EXPONENT_BITS);
    });
    numbers.code(bits, form, &track.times_s).expect("writing never fails");
}

fn take_track(
    bits: &mut BitReader<'_>,
    times: &KeyTimes,
    count_width: u32,
    keys_left: usize,
) -> Result<ChunkTrack, WireError> {
    let kind = match bits.take(KIND_BITS)? {
        0 => TrackKind::Step,
        1 => TrackKind::Linear,
        2 => TrackKind::Cubic,
        other => return Err(invalid(WHAT, format!("its kind {other} is none"))),
    };
    let is_one = bits.take(1)? == 1;
    let others = if is_one { 0 } else { bits.take(count_width)? as usize };
    let count = check_count("the keys of a chunk of a clip", others.saturating_add(1), keys_left)?;
    if is_one {
        return Ok(ChunkTrack { kind, times_s: vec![0.0], values: vec![ONE], tangents: Vec::new() });
    }
    let times_s = if count > 1 { times.take_curve(bits, count)? } else { vec![0.0] };
    let form = Form::take(bits)?;
    let has_tangents = kind == TrackKind::Cubic && count > 1;
    let tangent_count = if has_tangents { count } else { 0 };
    let mut exponent = || bits.take(EXPONENT_BITS).map(|biased| biased as i32 + LEAST_EXPONENT);
    let exponents = [exponent()?, if has_tangents { exponent()? } else { 0 }];
    let zeros =
        |count: usize| std::array::from_fn(|axis| vec![0; if axis < form.count() { count } else { 0 }]);
    let mut numbers = Numbers { exponents, values: zeros(count), tangents: zeros(tangent_count) };
    numbers.code(bits, form, &times_s)?;
    let read = |numbers: &[Vec<i32>; 4], exponent: i32, key: usize| -> [f32; 4] {
        std::array::from_fn(|axis| {
            numbers[axis].get(key).map_or(0.0, |number| value_of(*number, exponent) as f32)
        })
    };
    let values: Vec<_> = (0..count).map(|key| read(&numbers.values, exponents[0], key)).collect();
    let tangents: Vec<_> = (0..tangent_count).map(|key| read(&numbers.tangents, exponents[1], key)).collect();
    check_finite(WHAT, values.iter().chain(&tangents).flatten())?;
    Ok(ChunkTrack { kind, times_s, values, tangents })
}

/// What the numbers of a curve's values are.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Form {
    /// Number 0, the first three, or all four; the others are 0.
    Plain(usize),
    /// All four, of about unit length. The largest keeps its sign.
    Rotation { largest: usize, is_negative: bool },
}

impl Form {
    fn of(track: &ChunkTrack) -> Self {
        let all = || track.values.iter().chain(&track.tangents);
        let is_zero = |from: usize| all().all(|value| value[from..].iter().all(|number| *number == 0.0));
        match (is_zero(1), is_zero(3)) {
            (true, _) => Self::Plain(1),
            (_, true) => Self::Plain(3),
            _ => Self::rotation(&track.values).unwrap_or(Self::Plain(4)),
        }
    }

    fn rotation(values: &[[f32; 4]]) -> Option<Self> {
        let length = |value: &[f32; 4]| value.iter().map(|number| number * number).sum::<f32>().sqrt();
        let is_unit = values.iter().all(|value| (length(value) - 1.0).abs() < NOT_UNIT);
        let least = |axis: usize| values.iter().map(|value| value[axis].abs()).fold(f32::MAX, f32::min);
        let largest = (0..4).max_by(|a, b| least(*a).total_cmp(&least(*b)))?;
        let is_negative = values[0][largest] < 0.0;
        let keeps_sign = values.iter().all(|value| (value[largest] < 0.0) == is_negative);
        (is_unit && keeps_sign && least(largest) > LEAST_LARGEST)
            .then_some(Self::Rotation { largest, is_negative })
    }

    /// Numbers of a value that are told.
    fn count(self) -> usize {
        match self {
            Self::Plain(count) => count,
            Self::Rotation { .. } => 4,
        }
    }

    fn put(self, bits: &mut BitWriter<'_>) {
        match self {
            Self::Plain(count) => bits.put(count as u32 / 2, FORM_BITS),
            Self::Rotation { largest, is_negative } => {
                bits.put(3, FORM_BITS);
                bits.put(largest as u32, LARGEST_BITS);
                bits.put(u32::from(is_negative), 1);
            }
        }
    }

    fn take(bits: &mut BitReader<'_>) -> Result<Self, WireError> {
        Ok(match bits.take(FORM_BITS)? {
            0 => Self::Plain(1),
            1 => Self::Plain(3),
            2 => Self::Plain(4),
            _ => {
                Self::Rotation { largest: bits.take(LARGEST_BITS)? as usize, is_negative: bits.take(1)? == 1 }
            }
        })
    }
}

/// The numbers of a curve in steps.
struct Numbers {
    /// Steps of values and tangents as powers of two.
    exponents: [i32; 2],
    /// By axis, of each key.
    values: [Vec<i32>; 4],
    /// By axis, of each key; empty for a curve without.
    tangents: [Vec<i32>; 4],
}

impl Numbers {
    /// Says or hears all of them.
    fn code(&mut self, coder: &mut impl Coder, form: Form, times_s: &[f32]) -> Result<(), WireError> {
        let (largest, sign) = match form {
            Form::Plain(_) => (None, 0.0),
            Form::Rotation { largest, is_negative } => (Some(largest), if is_negative { -1.0 } else { 1.0 }),
        };
        for axis in (0..form.count()).filter(|axis| Some(*axis) != largest) {
            self.code_axis(coder, axis, times_s)?;
        }
        let Some(largest) = largest else { return Ok(()) };
        let mut values = std::mem::take(&mut self.values[largest]);
        let all = 0..values.len();
        coder.numbers(&mut values, all, |before| self.of_unit_length(before.len(), sign))?;
        self.values[largest] = values;
        let mut tangents = std::mem::take(&mut self.tangents[largest]);
        let all = 0..tangents.len();
        coder.numbers(&mut tangents, all, |before| self.along_the_sphere(before.len(), largest))?;
        self.tangents[largest] = tangents;
        Ok(())
    }

    fn code_axis(&mut self, coder: &mut impl Coder, axis: usize, times_s: &[f32]) -> Result<(), WireError> {
        let ratio = step_of(self.exponents[1] - self.exponents[0]);
        let (values, tangents) = (&mut self.values[axis], &mut self.tangents[axis]);
        let (keys, slopes) = (values.len(), tangents.len());
        coder.numbers(tangents, 0..slopes, |_| 0.0)?;
        coder.numbers(values, 0..1, |_| 0.0)?;
        // A cubic's two tangents lead to its end, but for what its bend changes.
        coder.numbers(values, 1..keys, |before| {
            let (last, key) = (f64::from(before[before.len() - 1]), before.len());
            let Some([from, to]) = tangents.get(key - 1..=key).and_then(<[i32]>::first_chunk) else {
                return last;
            };
            let span_s = f64::from(times_s[key]) - f64::from(times_s[key - 1]);
            last + 0.5 * span_s * ratio * (f64::from(*from) + f64::from(*to))
        })
    }

    /// What makes the length of a key one with the other numbers, in steps.
    fn of_unit_length(&self, key: usize, sign: f64) -> f64 {
        let others = self.values.iter().filter_map(|axis| axis.get(key));
        let square =
            |number: &i32| value_of(*number, self.exponents[0]) * value_of(*number, self.exponents[0]);
        let squares: f64 = others.map(square).sum();
        sign * (1.0 - squares).max(0.0).sqrt() / step_of(self.exponents[0])
    }

    /// What keeps the length of a key with the other numbers' tangents, in steps.
    fn along_the_sphere(&self, key: usize, largest: usize) -> f64 {
        let others = (0..4).filter(|axis| *axis != largest);
        let product = |axis: usize| f64::from(self.values[axis][key]) * f64::from(self.tangents[axis][key]);
        -others.map(product).sum::<f64>() / f64::from(self.values[largest][key])
    }
}

/// What says numbers, or hears them.
trait Coder {
    /// Some of these numbers. `expect`: about what comes after the ones before it.
    fn numbers(
        &mut self,
        numbers: &mut [i32],
        which: Range<usize>,
        expect: impl Fn(&[i32]) -> f64,
    ) -> Result<(), WireError>;
}

impl Coder for BitWriter<'_> {
    fn numbers(
        &mut self,
        numbers: &mut [i32],
        which: Range<usize>,
        expect: impl Fn(&[i32]) -> f64,
    ) -> Result<(), WireError> {
        if which.is_empty() {
            return Ok(());
        }
        let miss = |at: usize| zigzag(numbers[at].wrapping_sub(nearest(expect(&numbers[..at]))));
        let width = width_of(which.clone().map(miss).max().unwrap_or(0));
        self.put_width(width);
        which.for_each(|at| self.put(miss(at), width));
        Ok(())
    }
}

impl Coder for BitReader<'_> {
    fn numbers(
        &mut self,
        numbers: &mut [i32],
        which: Range<usize>,
        expect: impl Fn(&[i32]) -> f64,
    ) -> Result<(), WireError> {
        if which.is_empty() {
            return Ok(());
        }
        let width = self.take_width()?;
        for at in which {
            numbers[at] = unzigzag(self.take(width)?).wrapping_add(nearest(expect(&numbers[..at])));
        }
        Ok(())
    }
}

/// The whole number at or beside it, within 32 bits; 0 for none.
fn nearest(number: f64) -> i32 {
    number.round() as i32
}

/// 2 to the power of -1022..=1023, exactly.
fn step_of(exponent: i32) -> f64 {
    f64::from_bits(((1023 + exponent) as u64) << 52)
}

fn value_of(steps: i32, exponent: i32) -> f64 {
    f64::from(steps) * step_of(exponent)
}

fn steps(number: f32, exponent: i32) -> i32 {
    nearest(f64::from(number) / step_of(exponent))
}

/// The largest power of two of which all these numbers are multiples, as far as that is not too fine.
fn exponent_of(numbers: &[[f32; 4]]) -> i32 {
    let (mut of_all, mut of_largest, mut largest) = (i32::MAX, i32::MIN, 0.0f32);
    for number in numbers.iter().flatten().filter(|number| **number != 0.0 && number.is_finite()) {
        let bits = number.to_bits();
        let (exponent, fraction) = ((bits >> 23 & 0xff) as i32, bits & 0x7f_ffff);
        // The smallest numbers of all have no leading one, and one unit.
        let (mantissa, unit) =
            if exponent == 0 { (fraction, -149) } else { (fraction | 1 << 23, exponent - 150) };
        of_all = of_all.min(unit + mantissa.trailing_zeros() as i32);
        of_largest = of_largest.max(unit + mantissa.ilog2() as i32);
        largest = largest.max(number.abs());
    }
    if of_all == i32::MAX {
        return 0;
    }
    // Whatever was read can be written again: single precision may have rounded the largest number of steps up to 2^31.
    let is_fine = f64::from(largest) <= 2f64.powi(31) * step_of(of_all);
    let exponent = if is_fine { of_all } else { of_largest - STEPS_LOG2 };
    exponent.clamp(LEAST_EXPONENT, -1 - LEAST_EXPONENT)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_is_the_largest_power_of_two_that_divides_all_numbers() {
        for (numbers, expected) in [
            ([0.0; 4], 0),
            ([0.5, -0.25, 0.0, 3.0], -2),
            ([1.0f32.next_up(), 0.0, 0.0, 0.0], -23),
            ([1024.0, 1e-9, 0.0, 0.0], 10 - STEPS_LOG2),
            ([1e-40, 0.0, 0.0, 0.0], LEAST_EXPONENT),
            ([96.0, 32.0, 0.0, f32::NAN], 5),
        ] {
            assert_eq!(exponent_of(&[numbers]), expected, "{numbers:?}");
        }
        assert_eq!(step_of(-64), 2f64.powi(-64));
        assert_eq!(step_of(127), 2f64.powi(127));
    }

    #[test]
    fn the_predicted_number_of_a_rotation_is_large() {
        let turn = |angle: f32| [0.0, angle.sin(), 0.0, angle.cos()];
        let form = |angles: [f32; 2]| Form::rotation(&angles.map(turn));
        assert_eq!(form([0.1, 0.2]), Some(Form::Rotation { largest: 3, is_negative: false }));
        assert_eq!(form([3.0, 3.1]), Some(Form::Rotation { largest: 3, is_negative: true }));
        assert_eq!(form([1.5, 1.7]), Some(Form::Rotation { largest: 1, is_negative: false }));
        assert_eq!(form([0.1, 1.5]), None, "each is small at one of the keys");
        assert_eq!(Form::rotation(&[[0.5, 0.5, 0.5, 0.6]]), None, "not of unit length");
    }
}

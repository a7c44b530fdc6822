//! Times of a chunk's keys, once for all its curves. Most clips have a frame rate: there a key's time is its frame number.
//! Otherwise the times are listed, and a key's time is an index of the list. Both are lossless to the last bit, because the
//! displayed pose at a step depends on it.

use super::bits::{BitReader, BitWriter, width_of};
use crate::limits::{MAX_CHUNK_KEYS, MAX_FRAME_RATE};
use crate::wire::{Reader, WireError, check_count, invalid, put_varint};

/// Frames are numbered to here: up to it any two of them stand at different times in single precision.
const MAX_FRAME: u32 = 1 << 22;
/// Of a head in place of a rate: the times are listed.
const LISTED: u32 = 0;
const WHAT: &str = "the key times of a clip";

/// See the module.
#[derive(Debug, PartialEq)]
pub(super) struct KeyTimes {
    /// Frames a second, or [`LISTED`].
    rate: u32,
    /// Where they are listed.
    list: Vec<f32>,
    /// The first number that any curve begins at.
    first: u32,
    /// Bits of how much later curves begin.
    later_width: u32,
}

impl KeyTimes {
    /// Of curves with these times, seconds.
    pub(super) fn of<'a>(curves: impl Iterator<Item = &'a [f32]> + Clone) -> Self {
        let mut list: Vec<f32> = curves.clone().flatten().copied().collect();
        list.sort_unstable_by(f32::total_cmp);
        list.dedup_by_key(|time_s| time_s.to_bits());
        let is_rate = |rate: &u32| list.iter().all(|time_s| frame_at(*rate, *time_s).is_some());
        let rate = (1..=MAX_FRAME_RATE).find(is_rate).filter(|_| !list.is_empty()).unwrap_or(LISTED);
        if rate != LISTED {
            list.clear();
        }
        let mut times = Self { rate, list, first: 0, later_width: 0 };
        let starts = || curves.clone().filter_map(<[f32]>::first).map(|time_s| times.number(*time_s));
        let (first, last) = (starts().min().unwrap_or(0), starts().max().unwrap_or(0));
        (times.first, times.later_width) = (first, width_of(last - first));
        times
    }

    pub(super) fn put(&self, out: &mut Vec<u8>) {
        put_varint(out, self.rate);
        if self.rate == LISTED {
            put_varint(out, self.list.len() as u32);
            self.list.iter().for_each(|time_s| out.extend_from_slice(&time_s.to_le_bytes()));
        }
        put_varint(out, self.first);
        put_varint(out, self.later_width);
    }

    pub(super) fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let rate = check_count(
            "the frames per second of a clip",
            reader.varint()? as usize,
            MAX_FRAME_RATE as usize,
        )?;
        let listed = if rate == LISTED as usize { reader.count(MAX_CHUNK_KEYS as usize, 4)? } else { 0 };
        let list = (0..listed).map(|_| reader.f32()).collect::<Result<Vec<f32>, WireError>>()?;
        let is_sound = list.iter().all(|time_s| time_s.is_finite()) && list.is_sorted_by(|a, b| a < b);
        if !is_sound {
            return Err(invalid(WHAT, "they do not rise"));
        }
        let (first, later_width) = (reader.varint()?, reader.varint()?);
        check_count("the bits of a key's time", later_width as usize, u32::BITS as usize)?;
        Ok(Self { rate: rate as u32, list, first, later_width })
    }

    /// Adds the times of one curve, of at least one key.
    pub(super) fn put_curve(&self, bits: &mut BitWriter<'_>, times_s: &[f32]) {
        let first = self.number(times_s[0]);
        bits.put(first - self.first, self.later_width);
        let between = || times_s.windows(2).map(|pair| self.number(pair[1]) - self.number(pair[0]) - 1);
        let width = width_of(between().max().unwrap_or(0));
        bits.put_width(width);
        between().for_each(|frames| bits.put(frames, width));
    }

    /// The times of a curve of so many keys, at least one; they rise.
    pub(super) fn take_curve(&self, bits: &mut BitReader<'_>, count: usize) -> Result<Vec<f32>, WireError> {
        let later = bits.take(self.later_width)?;
        let mut number = self.first.checked_add(later).ok_or_else(no_such_time)?;
        let width = bits.take_width()?;
        let mut times_s = vec![self.time_s(number)?];
        for _ in 1..count {
            let between = bits.take(width)?;
            number = number
                .checked_add(between)
                .and_then(|number| number.checked_add(1))
                .ok_or_else(no_such_time)?;
            times_s.push(self.time_s(number)?);
        }
        Ok(times_s)
    }

    /// Of a time that is among those that this was made of.
    fn number(&self, time_s: f32) -> u32 {
        match self.rate {
            LISTED => self.list.partition_point(|listed| listed.total_cmp(&time_s).is_lt()) as u32,
            rate => frame_at(rate, time_s).expect("all times are frames"),
        }
    }

    fn time_s(&self, number: u32) -> Result<f32, WireError> {
        match self.rate {
            LISTED => self.list.get(number as usize).copied().ok_or_else(no_such_time),
            rate if number <= MAX_FRAME => Ok(time_of(rate, number)),
            _ => Err(no_such_time()),
        }
    }
}

fn no_such_time() -> WireError {
    invalid(WHAT, "a key stands at a time that is none of them")
}

/// Seconds.
fn time_of(rate: u32, frame: u32) -> f32 {
    (f64::from(frame) / f64::from(rate)) as f32
}

/// The frame that stands at exactly this time.
fn frame_at(rate: u32, time_s: f32) -> Option<u32> {
    let frame = (f64::from(time_s) * f64::from(rate)).round();
    let is_one = (0.0..=f64::from(MAX_FRAME)).contains(&frame);
    is_one.then_some(frame as u32).filter(|frame| time_of(rate, *frame).to_bits() == time_s.to_bits())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Dice;

    #[track_caller]
    fn assert_come_back(curves: &[Vec<f32>], expected_rate: u32) {
        let times = KeyTimes::of(curves.iter().map(Vec::as_slice));
        assert_eq!(times.rate, expected_rate);
        let mut bytes = Vec::new();
        times.put(&mut bytes);
        let head = bytes.len();
        let mut bits = BitWriter::new(&mut bytes);
        curves.iter().for_each(|curve| times.put_curve(&mut bits, curve));
        bits.finish();
        let mut reader = Reader::new("times", &bytes[..head]);
        let times = KeyTimes::take(&mut reader).unwrap();
        assert_eq!(reader.left(), 0);
        let mut bits = BitReader::new("times", &bytes[head..]);
        for curve in curves {
            let back = times.take_curve(&mut bits, curve.len()).unwrap();
            assert_eq!(back.len(), curve.len());
            assert!(
                back.iter().zip(curve).all(|(a, b)| a.to_bits() == b.to_bits()),
                "{back:?} for {curve:?}"
            );
        }
    }

    #[test]
    fn times_of_frames_come_back_to_the_last_bit() {
        for rate in [24, 25, 30, 60, 997] {
            let mut dice = Dice::new(u64::from(rate));
            let mut curve = || {
                let mut frame = dice.below(100_000) as u32;
                let mut next = || {
                    frame += 1 + dice.below(40) as u32;
                    time_of(rate, frame)
                };
                (0..9).map(|_| next()).collect::<Vec<f32>>()
            };
            assert_come_back(&(0..30).map(|_| curve()).collect::<Vec<_>>(), rate);
        }
    }

    #[test]
    fn any_other_times_come_back_to_the_last_bit() {
        assert_come_back(&[vec![0.1, 0.333, 1.0f32.next_up()], vec![-0.0, 0.1, 7e5], vec![0.333]], LISTED);
        assert_come_back(&[], LISTED);
    }

    #[test]
    fn any_two_frames_stand_at_different_times() {
        for rate in 1..=MAX_FRAME_RATE {
            for frame in [MAX_FRAME - 1, MAX_FRAME / 3, 2_000_003] {
                assert!(time_of(rate, frame) < time_of(rate, frame + 1), "{frame} at {rate} Hz");
            }
        }
    }

    #[test]
    fn times_beyond_the_last_are_errors() {
        for (rate, list) in [(LISTED, vec![0.0, 0.5]), (60, vec![])] {
            for first in [MAX_FRAME, u32::MAX] {
                let times = KeyTimes { rate, list: list.clone(), first, later_width: 4 };
                assert!(times.take_curve(&mut BitReader::new("times", &[0xff; 9]), 3).is_err());
            }
        }
    }
}

//! Clips on the wire, in chunks of time: each chunk can be evaluated by itself, and lies where the server says.

use super::skeleton::check_words;
use crate::ids::ClipId;
use crate::limits::{ARENA_ALIGNMENT_WORDS, CHUNK_S, MAX_CHUNK_KEYS, MAX_CHUNK_TRACKS, MAX_COORDINATE_M};
use crate::wire::{Reader, WireError, invalid, put_varint};

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

/// One curve within a chunk. A curve that does not change there has one key.
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

/// A clip between two times: all that its evaluation needs there. Translation, rotation and scale of each bone, then the
/// morph weights.
#[derive(Clone, Debug, PartialEq)]
pub struct ClipChunk {
    /// The clip.
    pub clip: ClipId,
    /// Which chunk: from `index * CHUNK_S` on, for `CHUNK_S`.
    pub index: u32,
    /// Where it lies in the client's arena: the first of [`Self::words`] words.
    pub first_word: u32,
    /// Its curves.
    pub tracks: Vec<ChunkTrack>,
}

/// Chunks of a clip that lasts so long, at least one.
pub fn chunk_count(duration_s: f32) -> u32 {
    (f64::from(duration_s) / CHUNK_S).ceil().clamp(1.0, f64::from(u32::MAX)) as u32
}

/// The chunk in which a phase lies.
pub fn chunk_at(phase_s: f64, duration_s: f32) -> u32 {
    ((phase_s / CHUNK_S).max(0.0) as u32).min(chunk_count(duration_s) - 1)
}

/// Words of the arena before the keys, before their times, and in all: a track is two words, a key one, key times are four
/// a word.
pub fn layout(tracks: &[ChunkTrack]) -> [u32; 3] {
    let keys = 2 * tracks.len() as u32;
    let times =
        keys + tracks.iter().map(|track| (track.values.len() + track.tangents.len()) as u32).sum::<u32>();
    let stamps: u32 = tracks.iter().map(|track| track.times_s.len() as u32).sum();
    [keys, times, (times + stamps.div_ceil(4)).next_multiple_of(ARENA_ALIGNMENT_WORDS)]
}

const CUBIC: u8 = 2;
/// The value is (1, 1, 1), the scale of most bones.
const IS_ONE: u8 = 4;
/// Values have three numbers instead of four.
const IS_VECTOR: u8 = 8;
/// Values have one number.
const IS_NUMBER: u8 = 16;

impl ClipChunk {
    /// Words of the arena that it takes.
    pub fn words(&self) -> u32 {
        layout(&self.tracks)[2]
    }

    pub(super) fn put(&self, out: &mut Vec<u8>) {
        put_varint(out, self.clip.0);
        put_varint(out, self.index);
        put_varint(out, self.first_word);
        put_varint(out, self.tracks.len() as u32);
        self.tracks.iter().for_each(|track| track.put(out));
    }

    pub(super) fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let (clip, index, first_word) = (ClipId(reader.varint()?), reader.varint()?, reader.varint()?);
        let count = reader.count(MAX_CHUNK_TRACKS as usize, 1)?;
        let mut keys_left = MAX_CHUNK_KEYS as usize;
        let tracks =
            (0..count).map(|_| ChunkTrack::take(reader, &mut keys_left)).collect::<Result<Vec<_>, _>>()?;
        let chunk = Self { clip, index, first_word, tracks };
        check_words("a chunk of a clip", first_word, chunk.words())?;
        Ok(chunk)
    }
}

impl ChunkTrack {
    fn is_one(&self) -> bool {
        self.values == [[1.0, 1.0, 1.0, 0.0]]
    }

    /// Numbers of a value that are not zero for all keys.
    fn numbers(&self) -> usize {
        let all = || self.values.iter().chain(&self.tangents);
        let is_zero = |from: usize| all().all(|value| value[from..].iter().all(|number| *number == 0.0));
        if is_zero(1) { 1 } else { 3 + usize::from(!is_zero(3)) }
    }

    fn put(&self, out: &mut Vec<u8>) {
        let numbers = self.numbers();
        let kind = match self.kind {
            TrackKind::Step => 0,
            TrackKind::Linear => 1,
            TrackKind::Cubic => CUBIC,
        };
        let length = match numbers {
            1 => IS_NUMBER,
            3 => IS_VECTOR,
            _ => 0,
        };
        out.push(kind | length | if self.is_one() { IS_ONE } else { 0 });
        if self.is_one() {
            return;
        }
        put_varint(out, self.values.len() as u32);
        if self.values.len() > 1 {
            self.times_s.iter().for_each(|time_s| out.extend_from_slice(&time_s.to_le_bytes()));
        }
        for value in self.values.iter().chain(&self.tangents) {
            value[..numbers].iter().for_each(|number| out.extend_from_slice(&number.to_le_bytes()));
        }
    }

    fn take(reader: &mut Reader<'_>, keys_left: &mut usize) -> Result<Self, WireError> {
        const WHAT: &str = "a curve of a clip";
        let flags = reader.u8()?;
        let kind = match flags & 3 {
            0 => TrackKind::Step,
            1 => TrackKind::Linear,
            CUBIC => TrackKind::Cubic,
            other => return Err(invalid(WHAT, format!("its kind {other} is none"))),
        };
        if flags & IS_ONE != 0 {
            let values = vec![[1.0, 1.0, 1.0, 0.0]];
            return Ok(Self { kind, times_s: vec![0.0], values, tangents: Vec::new() });
        }
        let numbers = match flags & (IS_VECTOR | IS_NUMBER) {
            0 => 4,
            IS_VECTOR => 3,
            IS_NUMBER => 1,
            _ => return Err(invalid(WHAT, format!("its flags {flags:#x} are none"))),
        };
        let count = reader.count(*keys_left, 4 * numbers)?;
        if count == 0 {
            return Err(invalid(WHAT, "it has no key"));
        }
        *keys_left -= count;
        let times_s = match count {
            1 => vec![0.0],
            _ => (0..count).map(|_| reader.f32()).collect::<Result<Vec<_>, _>>()?,
        };
        if !times_s.iter().all(|time_s| time_s.is_finite()) || !times_s.is_sorted_by(|a, b| a < b) {
            return Err(invalid(WHAT, "its key times do not rise"));
        }
        let mut value = || {
            let mut value = [0.0; 4];
            value[..numbers].iter_mut().try_for_each(|number| reader.f32().map(|read| *number = read))?;
            match value.iter().all(|number| number.abs() <= MAX_COORDINATE_M) {
                true => Ok(value),
                false => Err(invalid(WHAT, format!("a number in it is not within {MAX_COORDINATE_M}"))),
            }
        };
        let values = (0..count).map(|_| value()).collect::<Result<_, _>>()?;
        let has_tangents = kind == TrackKind::Cubic && count > 1;
        let tangents =
            (0..if has_tangents { count } else { 0 }).map(|_| value()).collect::<Result<_, _>>()?;
        Ok(Self { kind, times_s, values, tangents })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Dice, damaged};

    fn track(dice: &mut Dice, keys: usize, numbers: usize, kind: TrackKind) -> ChunkTrack {
        let mut value = || {
            let mut value = [0.0; 4];
            value[..numbers].iter_mut().for_each(|number| *number = 1.0 + dice.below(1000) as f32 * 0.001);
            value
        };
        let values: Vec<_> = (0..keys).map(|_| value()).collect();
        let has_tangents = kind == TrackKind::Cubic && keys > 1;
        let tangents = if has_tangents { (0..keys).map(|_| value()).collect() } else { Vec::new() };
        ChunkTrack { kind, times_s: (0..keys).map(|key| key as f32 * 0.25).collect(), values, tangents }
    }

    fn chunk(seed: u64) -> ClipChunk {
        let mut dice = Dice::new(seed);
        let kinds = [TrackKind::Step, TrackKind::Linear, TrackKind::Cubic];
        let mut tracks: Vec<_> = (0..40)
            .map(|_| {
                let (keys, numbers) = (1 + dice.below(9) as usize, [1, 3, 4][dice.below(3) as usize]);
                let kind = kinds[dice.below(3) as usize];
                track(&mut dice, keys, numbers, kind)
            })
            .collect();
        let one = [1.0, 1.0, 1.0, 0.0];
        tracks.push(ChunkTrack {
            kind: TrackKind::Step,
            times_s: vec![0.0],
            values: vec![one],
            tangents: vec![],
        });
        ClipChunk { clip: ClipId(300), index: 7, first_word: 64, tracks }
    }

    fn bytes_of(chunk: &ClipChunk) -> Vec<u8> {
        let mut bytes = Vec::new();
        chunk.put(&mut bytes);
        bytes
    }

    #[test]
    fn chunks_come_back_to_the_last_bit() {
        for seed in 0..50 {
            let chunk = chunk(seed);
            let bytes = bytes_of(&chunk);
            let mut reader = Reader::new("a chunk", &bytes);
            assert_eq!(ClipChunk::take(&mut reader), Ok(chunk), "seed {seed}");
            assert_eq!(reader.left(), 0);
        }
    }

    #[test]
    fn damaged_chunks_give_values_or_errors() {
        let bytes = bytes_of(&chunk(1));
        damaged(&bytes, 2, 5000, |bytes| drop(ClipChunk::take(&mut Reader::new("a chunk", bytes))));
        for length in 0..bytes.len() {
            assert!(ClipChunk::take(&mut Reader::new("a chunk", &bytes[..length])).is_err());
        }
    }

    #[test]
    fn a_scale_of_one_takes_a_byte() {
        let mut bytes = Vec::new();
        chunk(3).tracks.last().unwrap().put(&mut bytes);
        assert_eq!(bytes.len(), 1);
    }

    #[test]
    fn every_phase_has_a_chunk() {
        assert_eq!([0.0, 0.4, 0.5, 0.51, 4.0].map(chunk_count), [1, 1, 1, 2, 8]);
        assert_eq!([0.0, 0.49, 0.5, 3.99, 4.0].map(|phase| chunk_at(phase, 4.0)), [0, 0, 1, 7, 7]);
        assert_eq!(chunk_at(9.0, 0.0), 0);
    }
}

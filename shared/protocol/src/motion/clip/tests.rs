use super::*;
use crate::motion::keys::TrackKind;
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
    tracks.insert(20, bending(7, 20));
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
    let mut values = 0;
    damaged(&bytes, 2, 5000, |bytes| {
        let Ok(chunk) = ClipChunk::take(&mut Reader::new("a chunk", bytes)) else { return };
        let again = bytes_of(&chunk);
        values += 1;
        for track in &chunk.tracks {
            assert!(track.times_s.is_sorted_by(|a, b| a < b), "{:?}", track.times_s);
        }
        assert_eq!(ClipChunk::take(&mut Reader::new("a chunk", &again)), Ok(chunk));
    });
    assert!(values > 100, "{values} of the damaged chunks were chunks");
    for length in 0..bytes.len() {
        assert!(ClipChunk::take(&mut Reader::new("a chunk", &bytes[..length])).is_err());
    }
}

#[test]
fn a_scale_of_one_takes_three_bits() {
    let (mut chunk, few) = (chunk(3), bytes_of(&chunk(3)).len());
    let one = chunk.tracks[chunk.tracks.len() - 1].clone();
    chunk.tracks.extend(vec![one; 80]);
    assert_eq!(bytes_of(&chunk).len(), few + 80 * 3 / 8);
}

/// A joint that bends to and fro about one axis, on a raster of so many bits.
fn bending(keys: usize, bits: i32) -> ChunkTrack {
    let step = 2f32.powi(-bits);
    let rounded = |numbers: [f32; 4]| numbers.map(|number| (number / step).round() * step);
    let moments = || (0..keys).map(|key| key as f32 * 0.05);
    let half = |time_s: f32| 0.6 * (4.0 * time_s).sin();
    let slope = |time_s: f32| 2.4 * (4.0 * time_s).cos();
    let value = |time_s: f32| [0.8 * half(time_s).sin(), 0.0, 0.6 * half(time_s).sin(), half(time_s).cos()];
    let tangent = |time_s: f32| {
        let [sin, cos] = [half(time_s).sin(), half(time_s).cos()].map(|number| slope(time_s) * number);
        [0.8 * cos, 0.0, 0.6 * cos, -sin]
    };
    ChunkTrack {
        kind: TrackKind::Cubic,
        times_s: (0..keys).map(|key| (key as f64 / 20.0) as f32).collect(),
        values: moments().map(|time_s| rounded(value(time_s))).collect(),
        tangents: moments().map(|time_s| rounded(tangent(time_s))).collect(),
    }
}

#[test]
fn rotations_come_back_to_the_last_bit_and_take_a_third() {
    let tracks = vec![bending(11, 19); 20];
    let chunk = ClipChunk { clip: ClipId(3), index: 0, first_word: 0, tracks };
    let bytes = bytes_of(&chunk);
    assert_eq!(ClipChunk::take(&mut Reader::new("a chunk", &bytes)), Ok(chunk));
    assert!(bytes.len() < 20 * 11 * 36 / 3, "{} bytes", bytes.len());
}

#[test]
fn numbers_that_are_far_apart_are_rounded_by_little() {
    let mut odd = bending(5, 19);
    odd.values[2] = [1e6, -1e-30, 3.0, 0.1];
    odd.tangents[1] = [-1e6, f32::MIN_POSITIVE, 1e-7, 0.3];
    let chunk = ClipChunk { clip: ClipId(3), index: 0, first_word: 0, tracks: vec![odd.clone()] };
    let back = ClipChunk::take(&mut Reader::new("a chunk", &bytes_of(&chunk))).unwrap().tracks.remove(0);
    for (expected, found) in [(&odd.values, &back.values), (&odd.tangents, &back.tangents)] {
        let pairs = expected.as_flattened().iter().zip(found.as_flattened());
        assert!(pairs.clone().all(|(a, b)| (a - b).abs() <= 1e6 / 2f32.powi(30)), "{back:?}");
    }
}

#[test]
fn numbers_beyond_the_limits_and_kinds_that_are_none_are_errors() {
    let with = |change: &dyn Fn(&mut ChunkTrack)| {
        let mut track = bending(5, 19);
        change(&mut track);
        let chunk = ClipChunk { clip: ClipId(3), index: 0, first_word: 0, tracks: vec![track] };
        ClipChunk::take(&mut Reader::new("a chunk", &bytes_of(&chunk)))
    };
    assert!(with(&|_| {}).is_ok());
    assert!(with(&|track| track.values[1][0] = 1.5e6).is_err());
    assert!(with(&|track| track.tangents[3][2] = -1e30).is_err());
    let mut bytes = bytes_of(&with(&|_| {}).unwrap());
    // Frames a second, the first frame, and widths of starts and counts go before the first curve.
    assert_eq!(bytes[4..8], [20, 0, 0, 3]);
    bytes[8] |= 3;
    let error = ClipChunk::take(&mut Reader::new("a chunk", &bytes)).unwrap_err();
    assert_eq!(error.to_string(), "a curve of a clip is not valid: its kind 3 is none");
}

#[test]
fn a_few_bytes_say_no_more_keys_than_the_limit() {
    // One step track of 2^18 + 1 keys, a frame apart each, all zero: the bits after its count do not matter.
    let mut bytes = vec![0, 0, 0, 1, 20, 0, 0, 20];
    bytes.extend((1u32 << (18 + 3)).to_le_bytes());
    bytes.extend([0; 64]);
    let error = ClipChunk::take(&mut Reader::new("a chunk", &bytes)).unwrap_err();
    assert!(matches!(error, WireError::TooMany { value: 262_145, limit: 262_144, .. }), "{error}");
}

#[test]
fn every_phase_has_a_chunk() {
    assert_eq!([0.0, 0.4, 0.5, 0.51, 4.0].map(chunk_count), [1, 1, 1, 2, 8]);
    assert_eq!([0.0, 0.49, 0.5, 3.99, 4.0].map(|phase| chunk_at(phase, 4.0)), [0, 0, 1, 7, 7]);
    assert_eq!(chunk_at(9.0, 0.0), 0);
}

//! Clips on the wire, in chunks of time. Each chunk can be evaluated by itself, at a place chosen by the server.

use super::keys::{ChunkTrack, put_tracks, take_tracks};
use super::skeleton::check_words;
use crate::ids::ClipId;
use crate::limits::{ARENA_ALIGNMENT_WORDS, CHUNK_S, MAX_CHUNK_TRACKS};
use crate::wire::{Reader, WireError, check_count, put_varint};

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

/// Words of the arena before the keys, before their times, and in all.
pub fn layout(tracks: &[ChunkTrack]) -> [u32; 3] {
    layout_of(tracks.iter().map(|track| [track.values.len() + track.tangents.len(), track.times_s.len()]))
}

/// The same for tracks of so many values and tangents, and key times: a track is two words, a value or tangent one, key times are
/// four a word.
pub fn layout_of(tracks: impl Iterator<Item = [usize; 2]>) -> [u32; 3] {
    let add =
        |sum: [u32; 3], [keys, times]: [usize; 2]| [sum[0] + 2, sum[1] + keys as u32, sum[2] + times as u32];
    let [keys, count, stamps] = tracks.fold([0; 3], add);
    let times = keys + count;
    [keys, times, (times + stamps.div_ceil(4)).next_multiple_of(ARENA_ALIGNMENT_WORDS)]
}

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
        put_tracks(out, &self.tracks);
    }

    pub(super) fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let (clip, index, first_word) = (ClipId(reader.varint()?), reader.varint()?, reader.varint()?);
        let count =
            check_count("the curves of a clip", reader.varint()? as usize, MAX_CHUNK_TRACKS as usize)?;
        let chunk = Self { clip, index, first_word, tracks: take_tracks(reader, count)? };
        check_words("a chunk of a clip", first_word, chunk.words())?;
        Ok(chunk)
    }
}

#[cfg(test)]
mod tests;

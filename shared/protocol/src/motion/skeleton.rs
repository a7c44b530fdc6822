//! Skeletons and their instances: the one-time data of each for a client.

use super::playback::Schedule;
use crate::ids::{ClipId, InstanceId, SkeletonId};
use crate::limits::{
    ARENA_ALIGNMENT_WORDS, MAX_ARENA_WORDS, MAX_COORDINATE_M, MAX_MORPHS, MAX_POSE_PLACES, MAX_SCHEDULE,
    MAX_SKELETON_BONES, MAX_SKELETON_ENTRIES,
};
use crate::wire::{Reader, WireError, check_count, invalid, put_varint};
use serde::{Deserialize, Serialize};

/// An affine transform as rows; the last of each is the translation.
pub type Rows = [[f32; 4]; 3];

/// A skeleton. Its bones are sorted by depth, so that one level after the other can be evaluated in parallel.
#[derive(Clone, Debug, PartialEq)]
pub struct SkeletonInfo {
    /// Its name.
    pub skeleton: SkeletonId,
    /// Where it lies in the client's arena: the first of [`Self::words`] words.
    pub first_word: u32,
    /// By bone the parent, always of the level above; `None` for those of the first level.
    pub parents: Vec<Option<u16>>,
    /// First bone of each level, and the count of bones at the end.
    pub level_starts: Vec<u16>,
    /// What vertices refer to.
    pub entries: Vec<SkeletonEntry>,
    /// Morph targets of what it moves.
    pub morph_count: u32,
}

/// A bone and the transform into its space: a joint with its inverse bind matrix.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SkeletonEntry {
    /// The bone.
    pub bone: u16,
    /// The inverse bind matrix.
    pub bone_from_mesh: Rows,
}

/// A clip on the wire: its name for the whole scene, and how long it is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClipRef {
    /// The clip.
    pub clip: ClipId,
    /// Seconds; 0 for a pose that stands still.
    pub duration_s: f32,
}

/// How local transforms of a skeleton come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum PoseSource {
    /// From clips, as the schedule says.
    Clips,
    /// From poses on the time grid, kept in the arena from this word on: [`grid_words`] of them for each place of the ring.
    Grid {
        /// The first word.
        first_word: u32,
    },
}

/// An instance whose vertices are skinned by the client.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SkinnedInstance {
    /// The instance.
    pub instance: InstanceId,
    /// What moves it.
    pub skeleton: SkeletonId,
    /// Where its poses come from.
    pub source: PoseSource,
    /// Placement in the world, or on its path.
    pub placement: Rows,
    /// A clip of one bone that moves the placement.
    pub path: Option<Schedule<ClipRef>>,
    /// What it plays.
    pub schedule: Schedule<ClipRef>,
    /// First of its bones among the poses of the client.
    pub bone_base: u32,
    /// First of its palette entries and of its morph weights among them.
    pub palette_base: u32,
}

/// Words that one pose takes in the ring of a grid: three a bone (translation, rotation, scale), then morph weights, four a
/// word.
pub fn grid_words(bones: u32, morphs: u32) -> u32 {
    (3 * bones + morphs.div_ceil(4)).next_multiple_of(ARENA_ALIGNMENT_WORDS)
}

/// Words that the ring of an instance's poses takes, of as many steps as samples have.
pub fn ring_words(sample_ring: u32, bones: u32, morphs: u32) -> u32 {
    sample_ring * grid_words(bones, morphs)
}

impl SkeletonInfo {
    /// Its bones.
    pub fn bone_count(&self) -> u32 {
        self.parents.len() as u32
    }

    /// Words before the level starts, before the entries, and in all: parents and level starts are four a word, an entry is
    /// four words.
    pub fn layout(&self) -> [u32; 3] {
        let levels = self.bone_count().div_ceil(4);
        let entries =
            (levels + (self.level_starts.len() as u32).div_ceil(4)).next_multiple_of(ARENA_ALIGNMENT_WORDS);
        [levels, entries, entries + 4 * self.entries.len() as u32]
    }

    /// Words of the arena that it takes.
    pub fn words(&self) -> u32 {
        self.layout()[2]
    }

    pub(crate) fn put(&self, out: &mut Vec<u8>) {
        put_varint(out, u32::from(self.skeleton.0));
        put_varint(out, self.first_word);
        put_varint(out, self.morph_count);
        put_varint(out, self.parents.len() as u32);
        self.parents.iter().for_each(|parent| put_varint(out, parent.map_or(0, |p| u32::from(p) + 1)));
        put_varint(out, self.level_starts.len() as u32);
        self.level_starts.iter().for_each(|start| put_varint(out, u32::from(*start)));
        put_varint(out, self.entries.len() as u32);
        for entry in &self.entries {
            put_varint(out, u32::from(entry.bone));
            entry.bone_from_mesh.iter().flatten().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
        }
    }

    pub(crate) fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let skeleton = SkeletonId(take_u16(reader, "the number of a skeleton", usize::from(u16::MAX))?);
        let first_word = reader.varint()?;
        let morph_count =
            check_count("the morph targets of a skeleton", reader.varint()? as usize, MAX_MORPHS as usize)?;
        let bones = reader.count(MAX_SKELETON_BONES as usize, 1)?;
        let parent = |reader: &mut Reader<'_>| {
            let parent = take_u16(reader, "the parent of a bone", bones)?;
            Ok(parent.checked_sub(1))
        };
        let parents = (0..bones).map(|_| parent(reader)).collect::<Result<_, WireError>>()?;
        let levels = reader.count(bones + 1, 1)?;
        let level = |_| take_u16(reader, "the first bone of a level", bones);
        let level_starts = (0..levels).map(level).collect::<Result<_, _>>()?;
        let entries = reader.count(MAX_SKELETON_ENTRIES as usize, 49)?;
        let entry = |_| {
            let bone = take_u16(reader, "the bone of a palette entry", bones.saturating_sub(1))?;
            let mut bone_from_mesh = Rows::default();
            bone_from_mesh.iter_mut().flatten().try_for_each(|c| reader.f32().map(|value| *c = value))?;
            Ok(SkeletonEntry { bone, bone_from_mesh })
        };
        let entries = (0..entries).map(entry).collect::<Result<_, WireError>>()?;
        let info =
            Self { skeleton, first_word, parents, level_starts, entries, morph_count: morph_count as u32 };
        info.check()?;
        Ok(info)
    }

    /// Parents lie one level up, levels follow each other, and nothing lies outside of what an arena can be.
    fn check(&self) -> Result<(), WireError> {
        const WHAT: &str = "a skeleton";
        let starts = &self.level_starts;
        if self.parents.is_empty() {
            return Err(invalid(WHAT, "it has no bones"));
        }
        let ends = starts.first() == Some(&0) && starts.last() == Some(&(self.parents.len() as u16));
        if !ends || !starts.is_sorted() {
            return Err(invalid(WHAT, "its levels do not hold its bones"));
        }
        for (level, range) in starts.windows(2).enumerate() {
            let above = level.checked_sub(1).map(|above| starts[above]..range[0]);
            for parent in &self.parents[usize::from(range[0])..usize::from(range[1])] {
                if parent.is_some() != above.is_some()
                    || parent.zip(above.as_ref()).is_some_and(|(parent, above)| !above.contains(&parent))
                {
                    return Err(invalid(WHAT, "a bone's parent is not in the level above"));
                }
            }
        }
        check_words(WHAT, self.first_word, self.words())?;
        let numbers = self.entries.iter().flat_map(|entry| entry.bone_from_mesh.as_flattened());
        check_finite(WHAT, numbers)
    }
}

impl SkinnedInstance {
    pub(crate) fn put(&self, out: &mut Vec<u8>) {
        // Fails only for types that cannot be serialised at all, which ours are not.
        let bytes = postcard::to_stdvec(self).expect("plain messages serialise");
        put_varint(out, bytes.len() as u32);
        out.extend_from_slice(&bytes);
    }

    pub(crate) fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        const WHAT: &str = "an instance with a skeleton";
        let length = reader.varint()? as usize;
        let bytes = reader.take(length)?;
        let (instance, rest): (Self, &[u8]) =
            postcard::take_from_bytes(bytes).map_err(|error| invalid(WHAT, error.to_string()))?;
        if !rest.is_empty() {
            return Err(WireError::Trailing { what: WHAT, left: rest.len() });
        }
        instance.check()?;
        Ok(instance)
    }

    fn check(&self) -> Result<(), WireError> {
        const WHAT: &str = "an instance with a skeleton";
        check_finite(WHAT, self.placement.as_flattened().iter())?;
        if let PoseSource::Grid { first_word } = self.source {
            check_words("the poses of an instance", first_word, 0)?;
        }
        check_count("the bones of a client's poses", self.bone_base as usize, MAX_POSE_PLACES as usize)?;
        check_count(
            "the palettes of a client's poses",
            self.palette_base as usize,
            MAX_POSE_PLACES as usize,
        )?;
        self.path.iter().chain([&self.schedule]).try_for_each(check_schedule)
    }
}

/// A schedule that a client can evaluate.
pub(crate) fn check_schedule(schedule: &Schedule<ClipRef>) -> Result<(), WireError> {
    const WHAT: &str = "a schedule of clips";
    let entries = schedule.entries();
    check_count(WHAT, entries.len(), MAX_SCHEDULE)?;
    let is_good = |entry: &super::playback::Playback<ClipRef>| {
        let seconds = [entry.start_s, entry.speed, f64::from(entry.clip.duration_s)];
        seconds.iter().all(|value| value.is_finite()) && entry.clip.duration_s >= 0.0 && entry.fade_ns >= 0
    };
    if entries.is_empty() || !entries.is_sorted_by(|a, b| a.from < b.from) || !entries.iter().all(is_good) {
        return Err(invalid(WHAT, "it is empty, its times do not rise, or a number in it makes no sense"));
    }
    Ok(())
}

/// `words` from `first` on lie in what an arena can be, and are aligned.
pub(crate) fn check_words(what: &'static str, first: u32, words: u32) -> Result<(), WireError> {
    if !first.is_multiple_of(ARENA_ALIGNMENT_WORDS) {
        return Err(invalid(what, format!("its first word {first} is not aligned")));
    }
    check_count(what, first as usize + words as usize, MAX_ARENA_WORDS as usize).map(drop)
}

pub(super) fn check_finite<'a>(
    what: &'static str,
    mut numbers: impl Iterator<Item = &'a f32>,
) -> Result<(), WireError> {
    if numbers.all(|number| number.abs() <= MAX_COORDINATE_M) {
        return Ok(());
    }
    Err(invalid(what, format!("a number in it is not within {MAX_COORDINATE_M}")))
}

fn take_u16(reader: &mut Reader<'_>, what: &'static str, most: usize) -> Result<u16, WireError> {
    Ok(check_count(what, reader.varint()? as usize, most.min(usize::from(u16::MAX)))? as u16)
}

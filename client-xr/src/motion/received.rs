//! Received skeletons, clips and players, brought to their places: words of the arena, rest vertices, and the tables of
//! [`super::skinned`].

use super::Motion;
use super::arena::{ArenaSerial, WORD_BYTES};
use super::skinned::{ChunkKey, SkeletonPlace, SkinnedChange, Source};
use shadecast_protocol::delta::ReceivedDelta;
use shadecast_protocol::geometry;
use shadecast_protocol::ids::{InstanceId, UpdateId};
use shadecast_protocol::motion::clip::{ClipChunk, layout};
use shadecast_protocol::motion::keys::{ChunkTrack, TrackKind};
use shadecast_protocol::motion::message::{MotionMessage, MotionNews, NewSchedule};
use shadecast_protocol::motion::playback::Schedule;
use shadecast_protocol::motion::poses::GridPose;
use shadecast_protocol::motion::rest::PlacedRest;
use shadecast_protocol::motion::skeleton::{ClipRef, PoseSource, SkeletonInfo, SkinnedInstance};
use shadecast_protocol::world_clock::WorldClock;
use shadecast_shaders::constants::{CUBIC_TRACK, LINEAR_TRACK, NO_PARENT, STEP_TRACK};
use shadecast_shaders::generated::{EntryGpu, TrackGpu};
use shadecast_shaders::records::{Rest, RestId, morph_delta_word};
use std::collections::{BTreeMap, VecDeque};

/// Numbers of 4 bytes in an arena word.
const NUMBERS: u32 = WORD_BYTES as u32 / 4;
/// Arena words of a palette entry.
const ENTRY_WORDS: u32 = (size_of::<EntryGpu>() / WORD_BYTES) as u32;

/// Contents of messages about motion. They overtake each other and updates.
#[derive(Debug, Default)]
pub(super) struct ReceivedMotion {
    places: ChunkPlaces,
    /// By instance: the newest schedule, and the number of its message.
    schedules: BTreeMap<InstanceId, (u32, Schedule<ClipRef>)>,
    /// The newest, and the number of its message.
    clock: Option<(u32, WorldClock)>,
    /// The writes of skeletons and morph targets that an update brought, until the GPU has them. By rising updates.
    updates: VecDeque<(UpdateId, ArenaSerial)>,
}

/// Which chunk lies in which words of the arena: no two in the same, and each in one place.
#[derive(Debug, Default)]
struct ChunkPlaces {
    /// By first word.
    chunks: BTreeMap<u32, Tenant>,
    /// First words.
    first_words: BTreeMap<ChunkKey, u32>,
}

#[derive(Clone, Copy, Debug)]
struct Tenant {
    end_word: u32,
    sequence: u32,
    chunk: ChunkKey,
}

impl ChunkPlaces {
    /// Gives the words to a chunk; the chunks that are no longer where they were. `None`: a later message has the words, or has
    /// put the chunk elsewhere.
    fn take(&mut self, chunk: &ClipChunk, sequence: u32) -> Option<Vec<ChunkKey>> {
        let (key, first) = ((chunk.clip, chunk.index), chunk.first_word);
        let end_word = first + chunk.words();
        let mut gone = self.overlapping(first, end_word);
        let elsewhere = self.first_words.get(&key).filter(|word| !gone.contains(word));
        gone.extend(elsewhere.copied());
        if gone.iter().any(|word| is_later(self.chunks[word].sequence, sequence)) {
            return None;
        }
        let gone = gone.into_iter().filter_map(|word| self.remove(word)).collect();
        self.chunks.insert(first, Tenant { end_word, sequence, chunk: key });
        self.first_words.insert(key, first);
        Some(gone)
    }

    /// Words that hold something else for good; the chunks that lay there.
    fn clear(&mut self, first: u32, end_word: u32) -> Vec<ChunkKey> {
        self.overlapping(first, end_word).into_iter().filter_map(|word| self.remove(word)).collect()
    }

    /// First words of the chunks that have some of these words. As no two overlap, they are the last that begin before the end.
    fn overlapping(&self, first: u32, end_word: u32) -> Vec<u32> {
        let before = self.chunks.range(..end_word).rev();
        before.take_while(|(_, tenant)| tenant.end_word > first).map(|(word, _)| *word).collect()
    }

    fn remove(&mut self, first_word: u32) -> Option<ChunkKey> {
        let Tenant { chunk, .. } = self.chunks.remove(&first_word)?;
        self.first_words.remove(&chunk);
        Some(chunk)
    }
}

/// Half of the circle of numbers lies before a number.
fn is_later(a: u32, b: u32) -> bool {
    a.wrapping_sub(b) as i32 > 0
}

impl Motion {
    /// Takes in what the next update says of vertices, skeletons and samples. It comes from a decoder that has checked it
    /// against the client's memory. Its positions are taken out of it.
    pub fn take_delta(&mut self, delta: &mut ReceivedDelta) {
        let positions = std::mem::take(&mut delta.positions);
        let geometry::Skinned { skeletons, instances, .. } = &delta.geometry.skinned;
        let update = delta.geometry.update;
        let skeletons = skeletons.iter().map(|skeleton| self.learn_skeleton(skeleton)).max();
        instances.iter().for_each(|instance| self.learn_instance(instance));
        let morphs = delta.rests.iter().filter_map(|rest| self.learn_rest(rest)).max();
        self.received.updates.extend(skeletons.max(morphs).map(|written| (update, written)));
        let geometry::GeometryDelta { time, new_vertices, predictions, .. } = &delta.geometry;
        match delta.is_update && !predictions.is_empty() {
            false => self.take(update, new_vertices, positions, delta.is_update),
            true => {
                // The update is complete with its last prediction.
                self.take(update, new_vertices, positions, false);
                self.predict(update, *time, predictions);
            }
        }
    }

    /// The last update all of whose vertices, skeletons and morph targets are on their way to the GPU's memory, and with it those
    /// before.
    pub fn complete(&mut self) -> Option<UpdateId> {
        let (written, updates) = (self.arena.written(), &mut self.received.updates);
        while updates.front().is_some_and(|(_, write)| *write <= written) {
            updates.pop_front();
        }
        let complete = self.writes.complete()?;
        match updates.front() {
            Some((waiting, _)) if *waiting <= complete => waiting.0.checked_sub(1).map(UpdateId),
            _ => Some(complete),
        }
    }

    /// Takes in news of motion. What is of an instance that is yet to come waits for it.
    pub fn take_motion(&mut self, MotionMessage { sequence, news }: MotionMessage) {
        match news {
            MotionNews::Chunk(chunk) => self.take_chunk(&chunk, sequence),
            MotionNews::Schedule(NewSchedule { instance, schedule }) => {
                let newest = self.received.schedules.get(&instance);
                if newest.is_none_or(|(newest, _)| !is_later(*newest, sequence)) {
                    self.received.schedules.insert(instance, (sequence, schedule.clone()));
                    self.change(SkinnedChange::Schedule(instance, schedule));
                }
            }
            MotionNews::Poses(poses) => poses.into_iter().for_each(|pose| self.take_pose(pose)),
            MotionNews::Clock(clock) => {
                let newest = self.received.clock.map(|(newest, _)| newest);
                if newest.is_none_or(|newest| !is_later(newest, sequence)) {
                    self.received.clock = Some((sequence, *clock));
                }
            }
        }
    }

    /// How the world's time goes on, as far as that has been told.
    pub fn world_clock(&self) -> WorldClock {
        self.received.clock.map_or(WorldClock::default(), |(_, clock)| clock)
    }

    fn take_pose(&mut self, pose: GridPose) {
        if !self.skinned.knows(pose.instance) {
            return self.early.keep(pose, self.arena.arena_words());
        }
        let size = [pose.bones.len() as u32, pose.weights.len() as u32];
        let has_place = self.skinned.has_place_for(pose.instance, pose.grid, size);
        let word = self.skinned.grid_step_word(pose.instance, pose.grid).filter(|_| has_place);
        let Some(word) = word else {
            tracing::debug!("a pose of instance {} has no place", pose.instance.0);
            return;
        };
        let written = self.push_for_good(word, bytemuck::cast_slice(&pose_words(&pose)));
        self.change(SkinnedChange::GridStep(pose.instance, pose.grid, written));
    }

    /// Words for good, whatever a chunk has put there.
    fn push_for_good(&mut self, first_word: u32, bytes: &[u8]) -> ArenaSerial {
        let end_word = first_word + bytes.len().div_ceil(WORD_BYTES) as u32;
        let gone = self.received.places.clear(first_word, end_word);
        gone.into_iter().for_each(|chunk| self.change(SkinnedChange::ChunkGone(chunk)));
        self.arena.push(first_word, bytes)
    }

    fn learn_skeleton(&mut self, info: &SkeletonInfo) -> ArenaSerial {
        let [levels, entries, words] = info.layout();
        let mut bytes = vec![0; words as usize * WORD_BYTES];
        let mut put = |word: u32, of: &[u8]| {
            let at = word as usize * WORD_BYTES;
            bytes[at..at + of.len()].copy_from_slice(of);
        };
        let parents = info.parents.iter().map(|parent| parent.map_or(NO_PARENT, i32::from));
        put(0, bytemuck::cast_slice(&parents.collect::<Vec<i32>>()));
        let starts: Vec<u32> = info.level_starts.iter().map(|start| u32::from(*start)).collect();
        put(levels, bytemuck::cast_slice(&starts));
        let gpu = info.entries.iter().map(|entry| EntryGpu {
            bone_from_mesh: entry.bone_from_mesh,
            bone: [u32::from(entry.bone), 0, 0, 0],
        });
        put(entries, bytemuck::cast_slice(&gpu.collect::<Vec<_>>()));
        let written = self.push_for_good(info.first_word, &bytes);
        let place = SkeletonPlace {
            bone_base: info.first_word * NUMBERS,
            level_base: (info.first_word + levels) * NUMBERS,
            level_count: info.level_starts.len() as u32 - 1,
            entry_base: (info.first_word + entries) / ENTRY_WORDS,
            entry_count: info.entries.len() as u32,
            bone_count: info.bone_count(),
            morph_count: info.morph_count,
            written,
        };
        self.change(SkinnedChange::Skeleton(info.skeleton, place));
        written
    }

    fn learn_instance(&mut self, told: &SkinnedInstance) {
        // What is said of an instance that is known is newer than what it was told with, though it may come before that.
        let newest = self.received.schedules.get(&told.instance).map(|(_, schedule)| schedule);
        let source = match told.source {
            PoseSource::Clips => Source::Clips(newest.unwrap_or(&told.schedule).clone()),
            PoseSource::Grid { first_word } => Source::Grid { first_word, steps: self.sample_ring },
        };
        let instance = super::skinned::SkinnedInstance {
            skeleton: told.skeleton,
            placement: told.placement,
            path: told.path.clone(),
            palette_base: told.palette_base,
            global_base: told.bone_base,
            source,
        };
        self.change(SkinnedChange::Instance(told.instance, Box::new(instance)));
        self.early.take(told.instance).into_iter().for_each(|pose| self.take_pose(pose));
    }

    /// Gives the write of its morph targets, where it has any.
    fn learn_rest(&mut self, told: &PlacedRest) -> Option<ArenaSerial> {
        let rest = Rest {
            position_m: told.position,
            joints: told.joints,
            weights: told.weights,
            first_delta: told.morph_word,
            delta_count: told.morphs.len() as u8,
        };
        self.write_rest(RestId(told.rest.0), &rest);
        let words = told.morphs.iter().map(|(morph, delta)| morph_delta_word(*delta, u32::from(*morph)));
        let words: Vec<[u32; 4]> = words.collect();
        (!words.is_empty()).then(|| self.push_for_good(told.morph_word, bytemuck::cast_slice(&words)))
    }

    fn take_chunk(&mut self, chunk: &ClipChunk, sequence: u32) {
        let Some(gone) = self.received.places.take(chunk, sequence) else { return };
        gone.into_iter().for_each(|chunk| self.change(SkinnedChange::ChunkGone(chunk)));
        let written = self.arena.push(chunk.first_word, &chunk_words(chunk));
        let place = [chunk.first_word, chunk.tracks.len() as u32];
        self.change(SkinnedChange::Chunk((chunk.clip, chunk.index), place, written));
    }
}

/// A pose as the arena holds it: of each bone translation, rotation and scale, then morph weights, four a word.
fn pose_words(pose: &GridPose) -> Vec<[f32; 4]> {
    let vector = |[x, y, z]: [f32; 3]| [x, y, z, 0.0];
    let bones = pose.bones.iter();
    let mut words: Vec<[f32; 4]> =
        bones.flat_map(|bone| [vector(bone.translation), bone.rotation, vector(bone.scale)]).collect();
    for weights in pose.weights.chunks(4) {
        let mut word = [0.0; 4];
        word[..weights.len()].copy_from_slice(weights);
        words.push(word);
    }
    words
}

/// A chunk as the arena holds it: tracks, keys, key times.
fn chunk_words(chunk: &ClipChunk) -> Vec<u8> {
    let [keys_word, times_word, words] = layout(&chunk.tracks);
    let mut first_key = chunk.first_word + keys_word;
    let mut first_time = (chunk.first_word + times_word) * NUMBERS;
    let (mut tracks, mut keys, mut times): (Vec<TrackGpu>, Vec<[f32; 4]>, Vec<f32>) = Default::default();
    for track in &chunk.tracks {
        tracks.push(TrackGpu {
            first_key,
            first_time,
            key_count: track.values.len() as u32,
            kind: kind_of(track),
            interval_s: 0.0,
            reserved0: 0,
            reserved1: 0,
            reserved2: 0,
        });
        match track.tangents.is_empty() {
            true => keys.extend(&track.values),
            false => keys.extend(track.values.iter().zip(&track.tangents).flat_map(|(v, t)| [*v, *t])),
        }
        times.extend(&track.times_s);
        first_key = chunk.first_word + keys_word + keys.len() as u32;
        first_time = (chunk.first_word + times_word) * NUMBERS + times.len() as u32;
    }
    let mut bytes: Vec<u8> = bytemuck::cast_slice(&tracks).to_vec();
    bytes.extend_from_slice(bytemuck::cast_slice(&keys));
    bytes.extend_from_slice(bytemuck::cast_slice(&times));
    bytes.resize(words as usize * WORD_BYTES, 0);
    bytes
}

fn kind_of(track: &ChunkTrack) -> u32 {
    match track.kind {
        TrackKind::Step => STEP_TRACK,
        TrackKind::Linear => LINEAR_TRACK,
        TrackKind::Cubic => CUBIC_TRACK,
    }
}

#[cfg(test)]
mod tests;

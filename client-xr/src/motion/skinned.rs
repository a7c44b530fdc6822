//! Instances that move by clips or by poses on the grid, and their data for the GPU in a display frame. This module knows the
//! places of skeletons and chunks in the arena, and which have arrived. It does not know their contents.
//!
//! Instances are evaluated at the display time itself, whatever samples are missing. An instance with missing data for that
//! time is withheld: it is never displayed in a pose of another time.

use super::arena::ArenaSerial;
use super::pace::{BLEND_NS, GridTime};
use shadecast_protocol::ids::{ClipId, InstanceId, SkeletonId};
use shadecast_protocol::limits::ARENA_ALIGNMENT_WORDS;
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::clip::chunk_at;
use shadecast_protocol::motion::playback::{At, Playback, Playing, Schedule};
use shadecast_protocol::motion::skeleton::{ClipRef, grid_words};
use shadecast_protocol::time::{Grid, GridIndex, WorldTime};
use shadecast_shaders::constants::{AFFINE_ROWS, GRID_STEPS, POSE_FROM_GRID, POSE_HAS_PATH, POSE_READY};
use shadecast_shaders::curve::cubic_weights;
use shadecast_shaders::generated::{PlacedPoseGpu, PoseGpu, TrackGpu};
use std::collections::HashMap;

/// Local times that differ by less are the same, seconds.
const SAME_S: f64 = 1e-6;
/// Tracks of a bone: translation, rotation, scale.
const BONE_TRACKS: u32 = 3;
/// Arena words of a track.
const TRACK_WORDS: u32 = (size_of::<TrackGpu>() / super::arena::WORD_BYTES) as u32;

/// A clip, and the number of a chunk of it.
pub type ChunkKey = (ClipId, u32);

/// Where a skeleton lies in the arena, each number in the unit of its own view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SkeletonPlace {
    /// First parent, words of 4 bytes.
    pub bone_base: u32,
    /// First level's start, words of 4 bytes.
    pub level_base: u32,
    /// Levels of bones.
    pub level_count: u32,
    /// First palette entry, 64 bytes each.
    pub entry_base: u32,
    /// Palette entries.
    pub entry_count: u32,
    /// Bones.
    pub bone_count: u32,
    /// Morph targets.
    pub morph_count: u32,
    /// The write that completes it.
    pub written: ArenaSerial,
}

/// What an instance is evaluated from.
#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// Clips, as a schedule says.
    Clips(Schedule<ClipRef>),
    /// Local transforms on the time grid, in a ring in the arena.
    Grid {
        /// First arena word of the ring.
        first_word: u32,
        /// Steps that the ring holds, at least 1.
        steps: u32,
    },
}

/// An instance as the server describes it.
#[derive(Clone, Debug, PartialEq)]
pub struct SkinnedInstance {
    /// Its skeleton.
    pub skeleton: SkeletonId,
    /// `world_from_model` where there is no path, else `path_from_model`; rows.
    pub placement: [[f32; 4]; AFFINE_ROWS as usize],
    /// What moves it as a whole.
    pub path: Option<Schedule<ClipRef>>,
    /// First place of its palette and of its morph weights.
    pub palette_base: u32,
    /// First place of its bones.
    pub global_base: u32,
    /// What moves its bones.
    pub source: Source,
}

/// What changes in [`Skinned`], for tables that follow those of another thread.
#[derive(Clone, Debug)]
pub enum SkinnedChange {
    /// See [`Skinned::set_skeleton`].
    Skeleton(SkeletonId, SkeletonPlace),
    /// See [`Skinned::set_chunk`]: its first word, its tracks, and the write that completes it.
    Chunk(ChunkKey, [u32; 2], ArenaSerial),
    /// See [`Skinned::forget_chunk`].
    ChunkGone(ChunkKey),
    /// See [`Skinned::set_instance`].
    Instance(InstanceId, Box<SkinnedInstance>),
    /// See [`Skinned::set_schedule`].
    Schedule(InstanceId, Schedule<ClipRef>),
    /// See [`Skinned::set_grid_step`].
    GridStep(InstanceId, GridIndex, ArenaSerial),
}

/// An instance names a skeleton that the client does not know.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("instance {} names skeleton {}, which was never sent; the server is at fault", .0.0, .1.0)]
pub struct UnknownSkeleton(pub InstanceId, pub SkeletonId);

/// An instance on the draw list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Drawn {
    /// The instance.
    pub instance: InstanceId,
    /// Its vertices on the list.
    pub vertices: u32,
}

/// The time of an evaluation, and the part of the arena that the GPU has.
#[derive(Clone, Copy, Debug)]
pub struct PoseQuery {
    /// The display time.
    pub time: WorldTime,
    /// The grid of poses that come as time goes by.
    pub grid: Grid,
    /// The last write that the arena has.
    pub written: ArenaSerial,
}

/// How a display frame stands with skinned instances.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SkinnedCounts {
    /// Instances for the GPU, ready or not.
    pub instances: u32,
    /// Vertices of instances that are not ready.
    pub withheld_vertices: u32,
    /// Vertices that go on at the last velocity of their poses on the grid, for at most one step.
    pub held_vertices: u32,
    /// Vertices that have stopped for want of poses on the grid.
    pub frozen_vertices: u32,
}

/// The skinned instances of a draw list, each once.
#[derive(Debug, Default)]
pub struct DrawnInstances {
    drawn: Vec<Drawn>,
    /// By instance: its place in `drawn`, believed only where that names the instance.
    places: Vec<u32>,
}

/// See the module.
#[derive(Debug, Default)]
pub struct Skinned {
    skeletons: HashMap<SkeletonId, SkeletonPlace>,
    /// By clip and number: the chunks that are there.
    chunks: HashMap<ChunkKey, Chunk>,
    /// By instance.
    instances: Vec<Option<Instance>>,
    /// The time at which instances were last evaluated.
    shown: Option<WorldTime>,
}

#[derive(Clone, Copy, Debug)]
struct Chunk {
    first_word: u32,
    /// Its tracks: an instance with more bones and morphs is not evaluated from it.
    tracks: u32,
    written: ArenaSerial,
}

#[derive(Debug)]
struct Instance {
    skeleton: SkeletonPlace,
    placement: [[f32; 4]; AFFINE_ROWS as usize],
    path: Option<Schedule<ClipRef>>,
    palette_base: u32,
    global_base: u32,
    moved_by: MovedBy,
}

#[derive(Debug)]
enum MovedBy {
    Clips { told: Schedule<ClipRef>, playing: Schedule<ClipRef> },
    Grid(GridRing),
}

#[derive(Debug)]
struct GridRing {
    first_word: u32,
    /// By place in the ring: the step there, and the write that brought it.
    steps: Vec<Option<(GridIndex, ArenaSerial)>>,
}

/// Tracks and how far into them.
#[derive(Clone, Copy, Debug)]
struct TrackPhase {
    track_base: u32,
    phase_s: f32,
    phase_low_s: f32,
}

/// How an instance stands with poses on the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Supply {
    Enough,
    Held,
    Frozen,
}

/// Places that a connection's instances have in the client's memory, all of them together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SkinCapacity {
    /// Rests of skinned vertices.
    pub rests: u32,
    /// Words of the arena, 16 bytes each.
    pub arena_words: u32,
    /// Palette entries, and morph weights likewise.
    pub palette_entries: u32,
    /// Bones.
    pub bones: u32,
    /// Steps of the time grid that are kept of each instance that is posed on it, and of each sampled vertex.
    pub sample_ring: u32,
}

impl From<MotionMemory> for SkinCapacity {
    /// At least a place of each, since there is no memory of nothing.
    fn from(agreed: MotionMemory) -> Self {
        let MotionMemory { arena_words, rest_vertices, pose_places, sample_ring } = agreed;
        Self {
            rests: rest_vertices.max(1),
            arena_words: arena_words.max(ARENA_ALIGNMENT_WORDS),
            palette_entries: pose_places.max(1),
            bones: pose_places.max(1),
            sample_ring,
        }
    }
}

impl DrawnInstances {
    /// The list draws one more vertex of the instance.
    pub fn add_vertex(&mut self, instance: InstanceId) {
        if self.places.len() <= instance.index() {
            self.places.resize(instance.index() + 1, 0);
        }
        let place = &mut self.places[instance.index()];
        match self.drawn.get_mut(*place as usize).filter(|drawn| drawn.instance == instance) {
            Some(drawn) => drawn.vertices += 1,
            None => {
                *place = self.drawn.len() as u32;
                self.drawn.push(Drawn { instance, vertices: 1 });
            }
        }
    }

    /// The list draws a vertex less of an instance that is in it.
    pub fn remove_vertex(&mut self, instance: InstanceId) {
        let place = self.places[instance.index()] as usize;
        self.drawn[place].vertices -= 1;
        if self.drawn[place].vertices > 0 {
            return;
        }
        self.drawn.swap_remove(place);
        if let Some(moved) = self.drawn.get(place) {
            self.places[moved.instance.index()] = place as u32;
        }
    }

    /// All of them.
    pub fn all(&self) -> &[Drawn] {
        &self.drawn
    }
}

impl Skinned {
    /// Changes what `change` says.
    pub fn apply(&mut self, change: SkinnedChange) {
        match change {
            SkinnedChange::Skeleton(id, place) => self.set_skeleton(id, place),
            SkinnedChange::Chunk(key, [first_word, tracks], written) => {
                self.set_chunk(key, first_word, tracks, written);
            }
            SkinnedChange::ChunkGone(key) => self.forget_chunk(key),
            SkinnedChange::Instance(id, told) => {
                // The memory that both sides keep knows the skeleton.
                if let Err(error) = self.set_instance(id, *told) {
                    tracing::error!("{error}");
                }
            }
            SkinnedChange::Schedule(id, schedule) => self.set_schedule(id, schedule),
            SkinnedChange::GridStep(id, step, written) => self.set_grid_step(id, step, written),
        }
    }

    /// A skeleton has a place in the arena.
    pub fn set_skeleton(&mut self, id: SkeletonId, place: SkeletonPlace) {
        self.skeletons.insert(id, place);
    }

    /// Where a chunk of a clip lies in the arena, so many tracks first; the write that completes it.
    pub fn set_chunk(&mut self, key: ChunkKey, first_word: u32, tracks: u32, written: ArenaSerial) {
        self.chunks.insert(key, Chunk { first_word, tracks, written });
    }

    /// The words of a chunk are to hold something else. To be said before that is written.
    pub fn forget_chunk(&mut self, key: ChunkKey) {
        self.chunks.remove(&key);
    }

    /// An instance, new or anew: all that was known of it is forgotten.
    ///
    /// # Errors
    /// Its skeleton is not known.
    pub fn set_instance(&mut self, id: InstanceId, told: SkinnedInstance) -> Result<(), UnknownSkeleton> {
        let skeleton = *self.skeletons.get(&told.skeleton).ok_or(UnknownSkeleton(id, told.skeleton))?;
        let SkinnedInstance { placement, path, palette_base, global_base, .. } = told;
        let moved_by = match told.source {
            Source::Clips(told) => MovedBy::Clips { playing: told.clone(), told },
            Source::Grid { first_word, steps } => {
                MovedBy::Grid(GridRing { first_word, steps: vec![None; steps.max(1) as usize] })
            }
        };
        let instance = Instance { skeleton, placement, path, palette_base, global_base, moved_by };
        if self.instances.len() <= id.index() {
            self.instances.resize_with(id.index() + 1, || None);
        }
        self.instances[id.index()] = Some(instance);
        Ok(())
    }

    /// True where no instance is known, so that no vertex can be skinned.
    pub fn is_empty(&self) -> bool {
        self.instances.iter().all(Option::is_none)
    }

    /// True where an instance is known.
    pub fn knows(&self, id: InstanceId) -> bool {
        self.instance(id).is_some()
    }

    /// Where an instance's palette begins.
    pub fn palette_base(&self, id: InstanceId) -> Option<u32> {
        self.instance(id).map(|instance| instance.palette_base)
    }

    /// What an instance plays from now on. Where that is not what it was last seen to play, it is blended to.
    pub fn set_schedule(&mut self, id: InstanceId, schedule: Schedule<ClipRef>) {
        let shown = self.shown;
        let instance = self.instances.get_mut(id.index()).and_then(Option::as_mut);
        let Some(MovedBy::Clips { told, playing }) = instance.map(|instance| &mut instance.moved_by) else {
            return;
        };
        *playing = match shown {
            Some(shown) => continued(told, playing, &schedule, shown),
            None => schedule.clone(),
        };
        *told = schedule;
    }

    /// A pose on the grid has been written to its place in the instance's ring.
    pub fn set_grid_step(&mut self, id: InstanceId, step: GridIndex, written: ArenaSerial) {
        let instance = self.instances.get_mut(id.index()).and_then(Option::as_mut);
        if let Some(MovedBy::Grid(ring)) = instance.map(|instance| &mut instance.moved_by) {
            let place = ring.place(step);
            ring.steps[place] = Some((step, written));
        }
    }

    /// Whether a step's pose with so many bones and morph weights has a place: in an instance with a ring, of a skeleton like
    /// that, in whose place no later step is.
    pub fn has_place_for(&self, id: InstanceId, step: GridIndex, [bones, morphs]: [u32; 2]) -> bool {
        let Some(Instance { skeleton, moved_by: MovedBy::Grid(ring), .. }) = self.instance(id) else {
            return false;
        };
        let is_open = ring.steps[ring.place(step)].is_none_or(|(known, _)| known <= step);
        is_open && [skeleton.bone_count, skeleton.morph_count] == [bones, morphs]
    }

    /// The arena word of a step's place in an instance's ring, where it has one.
    pub fn grid_step_word(&self, id: InstanceId, step: GridIndex) -> Option<u32> {
        let instance = self.instance(id)?;
        match &instance.moved_by {
            MovedBy::Grid(ring) => Some(ring.word(step, &instance.skeleton)),
            MovedBy::Clips { .. } => None,
        }
    }

    /// What the GPU must be told of the instances on a draw list, one after the other in `out`. What does not fit there is
    /// withheld, and so is what is not known.
    pub fn poses(&mut self, moment: PoseQuery, drawn: &[Drawn], out: &mut [PlacedPoseGpu]) -> SkinnedCounts {
        self.shown = Some(moment.time);
        let mut counts = SkinnedCounts::default();
        for Drawn { instance, vertices } in drawn {
            let place = out.get_mut(counts.instances as usize);
            let Some((place, instance)) = place.zip(self.instance(*instance)) else {
                counts.withheld_vertices += vertices;
                continue;
            };
            let (pose, supply) = self.placed(instance, moment);
            counts.instances += 1;
            match supply {
                None => counts.withheld_vertices += vertices,
                Some(Supply::Enough) => {}
                Some(Supply::Held) => counts.held_vertices += vertices,
                Some(Supply::Frozen) => counts.frozen_vertices += vertices,
            }
            *place = pose;
        }
        counts
    }

    fn instance(&self, id: InstanceId) -> Option<&Instance> {
        self.instances.get(id.index())?.as_ref()
    }

    /// An instance for the GPU, and how it stands; `None`: it is not ready.
    fn placed(&self, instance: &Instance, moment: PoseQuery) -> (PlacedPoseGpu, Option<Supply>) {
        let mut placed = instance.unready();
        let is_there = instance.skeleton.written <= moment.written;
        let supply = (is_there && self.place_path(instance, moment, &mut placed))
            .then(|| match &instance.moved_by {
                MovedBy::Clips { playing, .. } => {
                    let least = instance.skeleton.track_count();
                    self.place_clips(playing, least, moment, &mut placed)
                }
                MovedBy::Grid(ring) => ring.place_steps(&instance.skeleton, moment, &mut placed),
            })
            .flatten();
        placed.flags |= if supply.is_some() { POSE_READY } else { 0 };
        (placed, supply)
    }

    /// False where there is a path, but not its keys.
    fn place_path(&self, instance: &Instance, moment: PoseQuery, placed: &mut PlacedPoseGpu) -> bool {
        let Some(path) = &instance.path else { return true };
        let Some(tracks) = self.tracks(path.at(moment.time).now, BONE_TRACKS, moment.written) else {
            return false;
        };
        placed.flags |= POSE_HAS_PATH;
        placed.path_track_base = tracks.track_base;
        (placed.path_phase_s, placed.path_phase_low_s) = (tracks.phase_s, tracks.phase_low_s);
        true
    }

    fn place_clips(
        &self,
        playing: &Schedule<ClipRef>,
        least: u32,
        moment: PoseQuery,
        placed: &mut PlacedPoseGpu,
    ) -> Option<Supply> {
        let Playing { now, fading } = playing.at(moment.time);
        let (now, pose) = (self.tracks(now, least, moment.written)?, &mut placed.pose);
        pose.track_base = now.track_base;
        (pose.phase_s, pose.phase_low_s) = (now.phase_s, now.phase_low_s);
        if let Some((before, share)) = fading {
            let before = self.tracks(before, least, moment.written)?;
            pose.fading_track_base = before.track_base;
            (pose.fading_phase_s, pose.fading_phase_low_s) = (before.phase_s, before.phase_low_s);
            pose.fading = share as f32;
        }
        Some(Supply::Enough)
    }

    /// The tracks of the chunk in which a clip is, where they are there, and as many as are needed.
    fn tracks(&self, at: At<ClipRef>, least: u32, written: ArenaSerial) -> Option<TrackPhase> {
        let ClipRef { clip, duration_s } = at.clip;
        let phase_s = at.phase_s(duration_s);
        let chunk = self.chunks.get(&(clip, chunk_at(phase_s, duration_s)))?;
        if chunk.written > written || chunk.tracks < least {
            return None;
        }
        let high_s = phase_s as f32;
        let phase_low_s = (phase_s - f64::from(high_s)) as f32;
        Some(TrackPhase { track_base: chunk.first_word / TRACK_WORDS, phase_s: high_s, phase_low_s })
    }
}

impl SkeletonPlace {
    /// Tracks of a clip that moves it.
    fn track_count(&self) -> u32 {
        BONE_TRACKS * self.bone_count + self.morph_count
    }
}

impl Instance {
    /// Without anything that depends on the time.
    fn unready(&self) -> PlacedPoseGpu {
        let skeleton = &self.skeleton;
        PlacedPoseGpu {
            placement: self.placement,
            pose: PoseGpu {
                bone_base: skeleton.bone_base,
                level_base: skeleton.level_base,
                level_count: skeleton.level_count,
                entry_base: skeleton.entry_base,
                entry_count: skeleton.entry_count,
                global_base: self.global_base,
                palette_base: self.palette_base,
                ..bytemuck::Zeroable::zeroed()
            },
            morph_count: skeleton.morph_count,
            ..bytemuck::Zeroable::zeroed()
        }
    }
}

impl GridRing {
    fn place(&self, step: GridIndex) -> usize {
        step.0.rem_euclid(self.steps.len() as i32) as usize
    }

    fn word(&self, step: GridIndex, skeleton: &SkeletonPlace) -> u32 {
        self.first_word + self.place(step) as u32 * grid_words(skeleton.bone_count, skeleton.morph_count)
    }

    fn has(&self, step: GridIndex, written: ArenaSerial) -> bool {
        self.steps[self.place(step)].is_some_and(|(known, write)| known == step && write <= written)
    }

    /// The last step at or before `step` that is there.
    fn last_until(&self, step: GridIndex, written: ArenaSerial) -> Option<GridIndex> {
        let there = self.steps.iter().flatten().filter(|(_, write)| *write <= written);
        there.map(|(known, _)| *known).filter(|known| *known <= step).max()
    }

    /// `None`: before the first pose.
    fn place_steps(
        &self,
        skeleton: &SkeletonPlace,
        moment: PoseQuery,
        placed: &mut PlacedPoseGpu,
    ) -> Option<Supply> {
        let at = GridTime::of(moment.grid, moment.time);
        let is_between = [0, 1].iter().all(|ahead| self.has(at.step.plus(*ahead), moment.written));
        let step = if is_between { at.step } else { self.last_until(at.step, moment.written)? };
        let steps: [GridIndex; GRID_STEPS as usize] = [-1, 0, 1, 2].map(|by| step.plus(by));
        let has = steps.map(|step| self.has(step, moment.written));
        placed.flags |= POSE_FROM_GRID;
        placed.grid_weights = match (is_between, has) {
            (true, [true, _, _, true]) => cubic_weights(at.fraction),
            (true, _) => [0.0, 1.0 - at.fraction, at.fraction, 0.0],
            (false, [true, ..]) => {
                // Past the last step it goes on for one step at its last velocity, as samples do, and then stays.
                let steps = (moment.grid.time_of(at.step).since(moment.grid.time_of(step)) as f64
                    / moment.grid.spacing_ns as f64
                    + f64::from(at.fraction))
                .min(1.0) as f32;
                [-steps, 1.0 + steps, 0.0, 0.0]
            }
            (false, _) => [0.0, 1.0, 0.0, 0.0],
        };
        let place = |i: usize| self.word(if has[i] { steps[i] } else { step }, skeleton);
        placed.grid_words = std::array::from_fn(place);
        Some(match (is_between, at.step == step) {
            (true, _) => Supply::Enough,
            (false, true) => Supply::Held,
            (false, false) => Supply::Frozen,
        })
    }
}

/// What to play when `next` is told in place of `told`, while `playing` was seen at `shown`.
fn continued(
    told: &Schedule<ClipRef>,
    playing: &Schedule<ClipRef>,
    next: &Schedule<ClipRef>,
    shown: WorldTime,
) -> Schedule<ClipRef> {
    let later = next.entries().iter().copied().filter(|entry| entry.from > shown);
    let is_same = is_same(&told.at(shown), &next.at(shown));
    let mut entries: Vec<_> = if is_same {
        // What is seen goes on, with what is being blended; only what is to come may have changed.
        let begun = playing.entries().iter().copied().filter(|entry| entry.from <= shown);
        // Before its first time the first entry plays, and nothing is blended.
        if begun.clone().next().is_none() {
            return next.clone();
        }
        begun.collect()
    } else {
        let before = seen_at(playing, shown);
        let now = next.entry(shown);
        let next_from = later.clone().map(|entry| entry.from).next();
        let fade_ns = next_from.map_or(BLEND_NS, |from| from.since(shown).min(BLEND_NS));
        vec![before, Playback { from: shown, start_s: now.local_s(shown), fade_ns, ..*now }]
    };
    entries.extend(later);
    Schedule::of(entries).unwrap_or_else(|| next.clone())
}

/// What is seen most at a time, as something that was played until then.
fn seen_at(playing: &Schedule<ClipRef>, shown: WorldTime) -> Playback<ClipRef> {
    let from = shown.plus_ns(-1);
    let now = *playing.entry(shown);
    let before = playing.entries().iter().rfind(|entry| entry.from < now.from).copied();
    let share = playing.at(shown).fading.map_or(0.0, |(_, share)| share);
    let most = before.filter(|_| share > 0.5).unwrap_or(now);
    Playback { from, start_s: most.local_s(from), fade_ns: 0, ..most }
}

fn is_same(a: &Playing<ClipRef>, b: &Playing<ClipRef>) -> bool {
    let same = |a: &At<ClipRef>, b: &At<ClipRef>| {
        a.clip == b.clip && a.repetition == b.repetition && (a.local_s - b.local_s).abs() < SAME_S
    };
    let same_fading = match (a.fading, b.fading) {
        (Some((a, share)), Some((b, other))) => same(&a, &b) && (share - other).abs() < SAME_S,
        (a, b) => a.is_none() && b.is_none(),
    };
    same(&a.now, &b.now) && same_fading
}

#[cfg(test)]
mod tests;

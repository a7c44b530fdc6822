//! What clients can be told of the scene's motion, each thing once for the scene: skeletons, vertices before skinning, clips.
//!
//! Skeletons, morph targets and rings of poses have places in the client's arena that are the same for every client, at its
//! beginning; chunks of clips share what is left (`motion/chunks.rs`).

use super::rasters::{Joints, Raster, Rasters};
use crate::animation::manager::{AnimationManager, BoneOrder, rows};
use crate::scene::numbering::Numbering;
use crate::support::named::{UnknownName, named};
use shadecast_protocol::ids::{ClipId, InstanceId, RestId, SkeletonId};
use shadecast_protocol::limits::{
    ARENA_ALIGNMENT_WORDS, CHUNK_S, DEFAULT_ARENA_WORDS, DEFAULT_SAMPLE_RING, MAX_ARENA_WORDS,
    MAX_COORDINATE_M, MAX_MORPHS, MAX_POSE_PLACES, MAX_REST_VERTICES, MAX_SKELETON_BONES,
    MAX_SKELETON_ENTRIES, MAX_VERTEX_MORPHS,
};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::clip::{chunk_count, layout_of};
use shadecast_protocol::motion::keys::{ChunkTrack, TrackKind};
use shadecast_protocol::motion::playback::{Playback, Schedule};
use shadecast_protocol::motion::rest::{MeshInfo, RestVertex};
use shadecast_protocol::motion::skeleton::{
    ClipRef, PoseSource, SkeletonEntry, SkeletonInfo, SkinnedInstance, ring_words,
};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::pose;
use shadecast_scene::animation::sampling::{
    KeyInterpolation, SampledClip, SampledTrack, longest_axis, world_scale,
};
use shadecast_scene::identity::ContentHash;
use shadecast_scene::influences::units_of_weight;
use shadecast_scene::timeline::ClipIndex;
use shadecast_scene::{Model, Path, Scene};
use std::collections::{BTreeSet, HashMap};
use std::ops::Range;
use std::sync::Arc;

/// How instances that move are sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MotionOption {
    /// Clips where there are any, poses where an application gives them, samples for the rest
    #[default]
    Auto,
    /// Clips, whatever they take
    Clip,
    /// A transform a bone and grid step
    Palette,
    /// A position a vertex and grid step
    Samples,
    /// Three predicted positions a vertex with every update, as the paper does
    Paper,
}

impl MotionOption {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Auto, Self::Clip, Self::Palette, Self::Samples, Self::Paper];

    /// Its name, as a person writes it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Clip => "clip",
            Self::Palette => "palette",
            Self::Samples => "samples",
            Self::Paper => "paper",
        }
    }
}

impl std::fmt::Display for MotionOption {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

impl std::str::FromStr for MotionOption {
    type Err = UnknownName;

    fn from_str(text: &str) -> Result<Self, UnknownName> {
        named("the motion", text, &Self::ALL, Self::name)
    }
}

/// Step of positions before skinning, metres in the world at the largest size at which their mesh is drawn.
const REST_STEP_M: f32 = 2e-5;
/// So many steps from 0 a position can be.
const MOST_STEPS: f32 = (1u32 << 31) as f32;
/// Moments of a clip at which that size is looked up.
const MOMENTS: u32 = 16;
/// Morph targets of a mesh are sent as long as they take less than its samples of so many seconds, bytes a vertex.
const MOST_MORPH_BYTES: f32 = 10.0 * 30.0 * 2.2;
/// What a morph target takes on the wire, about, bytes a vertex that it moves.
const MORPH_BYTES: f32 = 8.0;

/// A number of a clip is at most this: less than what clients take, since it is rounded.
const MOST_NUMBER: f32 = 0.5 * MAX_COORDINATE_M;
/// Rings of poses end before this word: beside them a client with the usual memory has room for chunks of clips.
const MAX_RINGS_END: u32 = DEFAULT_ARENA_WORDS / 2;

/// See the module.
#[derive(Debug)]
pub struct MotionLibrary {
    /// Of each skeleton that can be sent.
    skeletons: Vec<Option<SkeletonInfo>>,
    meshes: Vec<MeshRest>,
    /// By model.
    of_model: Vec<OfModel>,
    /// Clips of skeletons, then paths.
    clips: Vec<LibraryClip>,
    /// By skeleton, the place of each bone in the order of the model.
    orders: Vec<Arc<[u32]>>,
    /// By instance: what it is, as far as all clients agree.
    instances: Vec<Option<InstanceMotion>>,
    /// Words at the beginning of the arena that chunks leave alone.
    fixed_words: u32,
    /// Whether updates predict what moves.
    is_predicted: bool,
    /// Whether an instance moves that no client can follow by clips alone.
    is_sampled: bool,
}

/// The vertices of a mesh before skinning.
#[derive(Clone, Debug)]
struct MeshRest {
    info: MeshInfo,
    /// The model that they are taken from.
    model: usize,
    /// By vertex: its first word of morph targets, and which those are. Empty for a mesh without.
    morphs: Vec<(u32, Vec<(u16, u32)>)>,
}

#[derive(Clone, Copy, Debug)]
struct OfModel {
    skeleton: usize,
    mesh: usize,
    /// Whether clients can skin it at all.
    is_sendable: bool,
}

#[derive(Clone, Debug)]
struct LibraryClip {
    sampled: Arc<SampledClip>,
    /// By bone of its skeleton, the place in the order of the model.
    old_of_new: Arc<[u32]>,
    rasters: Rasters,
    info: ClipRef,
    /// Whether clients take its numbers.
    is_sendable: bool,
}

impl LibraryClip {
    /// Its curves in the order of clients.
    fn tracks(&self) -> impl Iterator<Item = (&SampledTrack, Raster)> {
        let Self { sampled, old_of_new, rasters, .. } = self;
        let bone = |old: &u32| sampled.bones[*old as usize].iter().zip(rasters.bones[*old as usize]);
        old_of_new.iter().flat_map(bone).chain(sampled.morphs.iter().zip(rasters.morphs.iter().copied()))
    }
}

/// An instance that clients can skin.
#[derive(Clone, Debug)]
struct InstanceMotion {
    told: SkinnedInstance,
    /// The clips that it can ever play on the client, its path among them.
    playable: Vec<ClipId>,
    /// Bones, and palette entries or morph targets, whichever are more.
    places: [u32; 2],
    model: usize,
}

impl InstanceMotion {
    /// The ends of its bones and of its palette entries behind those of others.
    fn ends_after(&self, [bones, entries]: [u32; 2]) -> [u32; 2] {
        [bones.saturating_add(self.places[0]), entries.saturating_add(self.places[1])]
    }
}

impl MotionLibrary {
    /// Of a scene.
    pub(crate) fn new(
        scene: &Scene,
        manager: &AnimationManager,
        numbering: &Numbering,
        option: MotionOption,
    ) -> Self {
        let mut building = Building::new(scene, manager, numbering, option);
        let of_model = (0..scene.models.len()).map(|model| building.add_model(model)).collect();
        let Building { skeletons, meshes, words, orders, .. } = building;
        let mut library = Self {
            skeletons,
            meshes,
            of_model,
            clips: Vec::new(),
            orders,
            instances: Vec::new(),
            fixed_words: words,
            is_predicted: option == MotionOption::Paper,
            is_sampled: false,
        };
        library.add_clips(scene, manager);
        for index in 0..scene.instances.len() {
            let is_sent = !matches!(option, MotionOption::Samples | MotionOption::Paper)
                && numbering.instances[index].is_animated;
            let is_posed = option == MotionOption::Palette || scene.instances[index].live;
            let instance = is_sent.then(|| library.instance(scene, manager, index, is_posed)).flatten();
            let has_clips =
                instance.as_ref().is_some_and(|instance| instance.told.source == PoseSource::Clips);
            library.is_sampled |=
                numbering.instances[index].is_animated && !has_clips && !library.is_predicted;
            library.instances.push(instance);
        }
        library
    }

    /// Whether updates predict what no client skins; else it is sampled on the time grid.
    pub(crate) fn is_predicted(&self) -> bool {
        self.is_predicted
    }

    /// As much of a client's memory as the scene can use.
    pub fn memory(&self) -> MotionMemory {
        if self.instances.iter().all(Option::is_none) {
            return MotionMemory::NONE;
        }
        let used = self.used_clips();
        let chunk_words: u64 = used.map(|clip| self.clip_words(clip)).sum();
        let places = |which: usize| -> u32 {
            let all = self.instances.iter().flatten().map(|instance| instance.places[which]);
            all.fold(0, u32::saturating_add)
        };
        let arena_words = (u64::from(self.fixed_words) + chunk_words).min(u64::from(MAX_ARENA_WORDS)) as u32;
        let rests = self.meshes.iter().map(|mesh| mesh.info.first_rest.0 + mesh.info.count).max();
        MotionMemory {
            arena_words: arena_words.next_multiple_of(ARENA_ALIGNMENT_WORDS),
            rest_vertices: rests.unwrap_or(0),
            pose_places: places(0).max(places(1)).min(MAX_POSE_PLACES),
            sample_ring: DEFAULT_SAMPLE_RING,
        }
    }

    /// The least memory of a client that is sent no samples and no poses: all that moves plays clips there. `None`: every client
    /// is sent some.
    pub(crate) fn unsampled_memory(&self) -> Option<MotionMemory> {
        if self.is_sampled {
            return None;
        }
        let (mut least, mut ends) = (MotionMemory::LEAST, [0; 2]);
        for instance in self.instances.iter().flatten() {
            ends = instance.ends_after(ends);
            least = least.max(self.least_memory(instance, ends));
        }
        Some(least)
    }

    /// What a client keeps at least to skin an instance by itself whose places end there.
    fn least_memory(&self, instance: &InstanceMotion, [bones_end, entries_end]: [u32; 2]) -> MotionMemory {
        let mesh = self.mesh(instance.model);
        MotionMemory {
            arena_words: self.fixed_words + self.least_chunk_words(&instance.playable),
            rest_vertices: mesh.first_rest.0 + mesh.count,
            pose_places: bones_end.max(entries_end),
            ..MotionMemory::LEAST
        }
    }

    /// Which instances a client with this memory skins by itself, and what it is told of each. Instances that find no room are
    /// sampled.
    pub fn skinned(&self, memory: MotionMemory) -> Vec<Option<SkinnedInstance>> {
        let mut bases = [0u32; 2];
        let mut of = |instance: &Option<InstanceMotion>| {
            let instance = instance.as_ref()?;
            let ends = instance.ends_after(bases);
            let told = memory.holds(self.least_memory(instance, ends)).then(|| SkinnedInstance {
                bone_base: bases[0],
                palette_base: bases[1],
                ..instance.told.clone()
            })?;
            bases = ends;
            Some(told)
        };
        self.instances.iter().map(&mut of).collect()
    }

    /// The skeleton of an instance that is skinned.
    pub(crate) fn skeleton(&self, skeleton: SkeletonId) -> &SkeletonInfo {
        self.skeletons[usize::from(skeleton.0)].as_ref().expect("only skeletons that can be sent are used")
    }

    /// The vertices of a model before skinning.
    pub(crate) fn mesh(&self, model: usize) -> MeshInfo {
        self.meshes[self.of_model[model].mesh].info
    }

    /// A vertex of a model before skinning.
    pub(crate) fn rest(&self, scene: &Scene, model: usize, number: u32) -> RestVertex {
        let mesh = &self.meshes[self.of_model[model].mesh];
        let model = &scene.models[mesh.model];
        let vertex = &model.vertices[number as usize];
        let (morph_word, morphs) = mesh.morphs.get(number as usize).cloned().unwrap_or_default();
        let delta = |(morph, place): &(u16, u32)| {
            let delta = &model.morphs[usize::from(*morph)].deltas[*place as usize];
            (*morph, mesh.info.quantise(delta.position.to_array()))
        };
        let (joints, weights) = sorted_influences(vertex);
        RestVertex {
            rest: RestId(mesh.info.first_rest.0 + number),
            position: mesh.info.quantise(vertex.position.to_array()),
            joints,
            weights,
            morph_word,
            morphs: morphs.iter().map(delta).collect(),
        }
    }

    /// First word of the arena that chunks may use.
    pub fn first_chunk_word(&self) -> u32 {
        self.fixed_words
    }

    /// Length of a clip.
    pub(crate) fn clip(&self, clip: ClipId) -> ClipRef {
        self.clips[clip.index()].info
    }

    /// The clip of an instance of a model: the rest pose for `None`.
    pub(crate) fn clip_of(manager: &AnimationManager, model: usize, clip: Option<usize>) -> ClipId {
        ClipId(manager.materials[model].clips[clip.map_or(0, |clip| clip + 1)] as u32)
    }

    /// What a client is told of what an instance of a model plays.
    pub(crate) fn schedule(
        &self,
        manager: &AnimationManager,
        model: usize,
        schedule: &Schedule<ClipIndex>,
    ) -> Schedule<ClipRef> {
        let clip = |clip| self.clip(Self::clip_of(manager, model, clip));
        let entries = schedule.entries().iter().map(|entry| entry.with_clip(clip(entry.clip)));
        Schedule::of(entries.collect()).expect("as many entries at the same times")
    }

    /// By bone of a model's skeleton as clients know it, the place in the order of the model.
    pub(crate) fn bone_order(&self, model: usize) -> &[u32] {
        &self.orders[self.of_model[model].skeleton]
    }

    /// A clip between two times.
    pub(crate) fn chunk(&self, clip: ClipId, index: u32) -> Vec<ChunkTrack> {
        let between_s = chunk_s(index);
        self.clips[clip.index()].tracks().map(|(track, raster)| cut(track, raster, between_s)).collect()
    }

    /// Words of the arena that it takes.
    pub(crate) fn chunk_words(&self, clip: ClipId, index: u32) -> u32 {
        let between_s = chunk_s(index);
        let count = |(track, _): (&SampledTrack, Raster)| {
            let keys = needed(track, between_s).len();
            [keys + if has_tangents(track, keys) { keys } else { 0 }, keys]
        };
        layout_of(self.clips[clip.index()].tracks().map(count))[2]
    }

    fn clip_words(&self, clip: ClipId) -> u64 {
        let LibraryClip { sampled, info, .. } = &self.clips[clip.index()];
        let chunks = u64::from(chunk_count(info.duration_s));
        let per_track = |track: &SampledTrack| {
            let keys = (track.values.len() + track.tangents.len()) as u64;
            // Each chunk repeats the keys around it.
            let repeated = if track.is_constant() { 1 } else { 5 };
            (keys + keys.div_ceil(4) + chunks * (2 + repeated)).max(3 * chunks)
        };
        sampled.tracks().map(per_track).sum::<u64>() + 4 * chunks
    }

    /// What must be there to show an instance that plays these clips: two chunks of each of two of them, and of its path.
    fn least_chunk_words(&self, playable: &[ClipId]) -> u32 {
        let of = |clip: ClipId| {
            let (words, duration_s) = (self.clip_words(clip), self.clip(clip).duration_s);
            words.min(2 * words.div_ceil(u64::from(chunk_count(duration_s))))
        };
        let clips: BTreeSet<ClipId> = playable.iter().copied().collect();
        let mut words: Vec<u64> = clips.into_iter().map(of).collect();
        words.sort_unstable_by_key(|words| std::cmp::Reverse(*words));
        words.iter().take(3).sum::<u64>().min(u64::from(MAX_ARENA_WORDS)) as u32
    }

    fn used_clips(&self) -> impl Iterator<Item = ClipId> + '_ {
        let mut used = vec![false; self.clips.len()];
        let playable = self.instances.iter().flatten().flat_map(|instance| &instance.playable);
        playable.for_each(|clip| used[clip.index()] = true);
        used.into_iter().enumerate().filter(|(_, used)| *used).map(|(clip, _)| ClipId(clip as u32))
    }

    fn add_clips(&mut self, scene: &Scene, manager: &AnimationManager) {
        let mut model_of_clip = vec![0; manager.clips.len()];
        for (model, material) in manager.materials.iter().enumerate() {
            material.clips.iter().for_each(|clip| model_of_clip[*clip] = model);
        }
        let joints: Vec<Joints> = scene.models.iter().map(Joints::new).collect();
        for (stored, model) in manager.clips.iter().zip(model_of_clip) {
            let order = self.orders[manager.materials[model].skeleton].clone();
            // Models that share a clip share the mesh, and the size at which it is drawn.
            let (source, scale) = (&scene.models[model], world_scale(scene, model));
            let rasters = Rasters::of_clip(source, &joints[model], &stored.sampled, scale);
            self.push_clip(&stored.sampled, &order, rasters);
        }
        let one: Arc<[u32]> = Arc::from([0]);
        for (path, reach_m) in path_reaches(scene, manager, &joints) {
            self.push_clip(path, &one, Rasters::of_path(path, reach_m));
        }
    }

    fn push_clip(&mut self, sampled: &Arc<SampledClip>, old_of_new: &Arc<[u32]>, rasters: Rasters) {
        let clip = ClipId(self.clips.len() as u32);
        let info = ClipRef { clip, duration_s: sampled.duration_s };
        let mut numbers = sampled.tracks().flat_map(|track| track.values.iter().chain(&track.tangents));
        let is_sendable = numbers.all(|number| number.abs().max_element() <= MOST_NUMBER);
        let (sampled, old_of_new) = (sampled.clone(), old_of_new.clone());
        self.clips.push(LibraryClip { sampled, old_of_new, rasters, info, is_sendable });
    }

    /// What clients skin of an instance; `is_posed`: by poses on the grid. `None`: they cannot.
    fn instance(
        &mut self,
        scene: &Scene,
        manager: &AnimationManager,
        index: usize,
        is_posed: bool,
    ) -> Option<InstanceMotion> {
        let instance = &scene.instances[index];
        let OfModel { skeleton, is_sendable, .. } = self.of_model[instance.model];
        let info = self.skeletons[skeleton].as_ref().filter(|_| is_sendable)?;
        let (bones, morphs) = (info.bone_count(), info.morph_count);
        let places = [bones, (info.entries.len() as u32).max(morphs)];
        let clip_of = |clip| Self::clip_of(manager, instance.model, clip);
        let path = instance.path.as_ref().zip(manager.paths.of(index));
        let path = path.map(|(path, sampled)| self.path_schedule(path, sampled));
        let own = scene.playable(index).into_iter().filter(|_| !is_posed).map(clip_of);
        let of_path = path.iter().flat_map(|path| path.entries()).map(|entry| entry.clip.clip);
        let playable: Vec<ClipId> = own.chain(of_path).collect();
        if !playable.iter().all(|clip| self.clips[clip.index()].is_sendable) {
            return None;
        }
        let first = instance.playback();
        let told = SkinnedInstance {
            instance: InstanceId(index as u16),
            skeleton: SkeletonId(skeleton as u16),
            source: if is_posed { self.ring(bones, morphs)? } else { PoseSource::Clips },
            placement: rows(instance.placement),
            path,
            schedule: Schedule::new(first.with_clip(self.clip(clip_of(first.clip)))),
            bone_base: 0,
            palette_base: 0,
        };
        Some(InstanceMotion { told, playable, places, model: instance.model })
    }

    /// Room for the poses of one more instance, as long as there is some.
    fn ring(&mut self, bones: u32, morphs: u32) -> Option<PoseSource> {
        let first_word = self.fixed_words;
        let end = first_word.checked_add(ring_words(DEFAULT_SAMPLE_RING, bones, morphs))?;
        (end <= MAX_RINGS_END).then(|| {
            self.fixed_words = end;
            PoseSource::Grid { first_word }
        })
    }

    fn path_schedule(&self, path: &Path, sampled: &Arc<SampledClip>) -> Schedule<ClipRef> {
        let clip = self.clips.iter().find(|clip| Arc::ptr_eq(&clip.sampled, sampled));
        Schedule::new(Playback {
            from: WorldTime(0),
            clip: clip.expect("every path was added").info,
            start_s: f64::from(path.time_shift_s) * f64::from(path.speed),
            speed: f64::from(path.speed),
            repetition: path.repetition,
            fade_ns: 0,
        })
    }
}

/// What is being put together, model by model.
struct Building<'a> {
    scene: &'a Scene,
    manager: &'a AnimationManager,
    option: MotionOption,
    skeletons: Vec<Option<SkeletonInfo>>,
    orders: Vec<Arc<[u32]>>,
    meshes: Vec<MeshRest>,
    known_meshes: HashMap<ContentHash, usize>,
    /// By model, whether any of its instances moves.
    moves: Vec<bool>,
    words: u32,
    rests: u32,
}

impl<'a> Building<'a> {
    fn new(
        scene: &'a Scene,
        manager: &'a AnimationManager,
        numbering: &Numbering,
        option: MotionOption,
    ) -> Self {
        let mut moves = vec![false; scene.models.len()];
        numbering.instances.iter().for_each(|place| moves[place.model] |= place.is_animated);
        let skeletons = vec![None; manager.skeletons.len()];
        let orders = vec![Arc::from([]); manager.skeletons.len()];
        let (meshes, known_meshes) = (Vec::new(), HashMap::new());
        Self { scene, manager, option, skeletons, orders, meshes, known_meshes, moves, words: 0, rests: 0 }
    }

    fn add_model(&mut self, index: usize) -> OfModel {
        let material = &self.manager.materials[index];
        if self.orders[material.skeleton].is_empty() {
            let order = BoneOrder::new(&self.scene.models[index]);
            self.orders[material.skeleton] = Arc::from(order.old_of_new);
        }
        if !self.moves[index] {
            // Another model with the same mesh or skeleton may move: nothing is decided for it here.
            return OfModel { skeleton: material.skeleton, mesh: 0, is_sendable: false };
        }
        if self.skeletons[material.skeleton].is_none() {
            self.add_skeleton(index, material.skeleton);
        }
        let mesh = match self.known_meshes.get(&material.mesh) {
            Some(mesh) => *mesh,
            None => {
                self.known_meshes.insert(material.mesh, self.meshes.len());
                self.add_mesh(index);
                self.meshes.len() - 1
            }
        };
        let is_sendable = self.skeletons[material.skeleton].is_some() && self.meshes[mesh].info.count > 0;
        OfModel { skeleton: material.skeleton, mesh, is_sendable }
    }

    fn add_skeleton(&mut self, index: usize, skeleton: usize) {
        let model = &self.scene.models[index];
        let order = BoneOrder::new(model);
        let fits = model.bones.len() <= MAX_SKELETON_BONES as usize
            && model.palette.len() <= MAX_SKELETON_ENTRIES as usize
            && model.morphs.len() <= MAX_MORPHS as usize
            && model.palette.iter().flat_map(|entry| rows(entry.bone_from_mesh)).flatten().all(is_near);
        if !fits {
            return;
        }
        let entry = |entry: &shadecast_scene::PaletteEntry| SkeletonEntry {
            bone: order.new_of_old[entry.bone as usize] as u16,
            bone_from_mesh: rows(entry.bone_from_mesh),
        };
        let info = SkeletonInfo {
            skeleton: SkeletonId(skeleton as u16),
            first_word: self.words,
            parents: order.parents.iter().map(|parent| u16::try_from(*parent).ok()).collect(),
            level_starts: order.level_starts.iter().map(|start| *start as u16).collect(),
            entries: model.palette.iter().map(entry).collect(),
            morph_count: model.morphs.len() as u32,
        };
        if self.words + info.words() <= MAX_ARENA_WORDS / 2 {
            self.words += info.words();
            self.skeletons[skeleton] = Some(info);
        }
    }

    /// Adds the mesh of a model; one that cannot be sent has no vertices.
    fn add_mesh(&mut self, index: usize) {
        let model = &self.scene.models[index];
        let count = model.vertices.len() as u32;
        let morphs = morphs_of(model);
        let deltas: u32 = morphs.iter().map(|(_, of)| of.len() as u32).sum();
        let words = deltas.next_multiple_of(ARENA_ALIGNMENT_WORDS);
        let is_light = self.option == MotionOption::Clip
            || deltas as f32 * MORPH_BYTES <= MOST_MORPH_BYTES * count as f32;
        let step = REST_STEP_M / drawn_scale(self.scene, index);
        let fits = self.rests + count <= MAX_REST_VERTICES
            && farthest(model) <= step * MOST_STEPS
            && self.words.saturating_add(words) <= MAX_ARENA_WORDS / 2
            && morphs.iter().all(|(_, of)| of.len() <= MAX_VERTEX_MORPHS as usize)
            && is_light;
        let count = if fits { count } else { 0 };
        let info = MeshInfo { first_rest: RestId(self.rests), count, step };
        let place = |(first, of): (u32, Vec<_>)| (self.words + first, of);
        let morphs = if fits { morphs.into_iter().map(place).collect() } else { Vec::new() };
        self.meshes.push(MeshRest { info, model: index, morphs });
        if fits {
            self.rests += count;
            self.words += words;
        }
    }
}

/// The largest number of a vertex before skinning, in units of the mesh.
fn farthest(model: &Model) -> f32 {
    let deltas = model.morphs.iter().flat_map(|morph| &morph.deltas).map(|delta| delta.position);
    let positions = model.vertices.iter().map(|vertex| vertex.position);
    positions.chain(deltas).map(|position| position.abs().max_element()).fold(0.0, f32::max)
}

fn is_near(number: f32) -> bool {
    number.abs() <= MAX_COORDINATE_M
}

/// By vertex its first delta among all, and target and index of each; empty where there are no morph targets.
fn morphs_of(model: &Model) -> Vec<(u32, Vec<(u16, u32)>)> {
    if model.morphs.is_empty() {
        return Vec::new();
    }
    let mut of_vertex = vec![(0, Vec::new()); model.vertices.len()];
    for (morph, source) in model.morphs.iter().enumerate() {
        for (place, delta) in source.deltas.iter().enumerate() {
            of_vertex[delta.vertex as usize].1.push((morph as u16, place as u32));
        }
    }
    let mut next = 0;
    for (first, deltas) in &mut of_vertex {
        *first = next;
        next += deltas.len() as u32;
    }
    of_vertex
}

/// Each path of the scene once, and how far from what moves along it any vertex is at most, metres.
fn path_reaches<'a>(
    scene: &Scene,
    manager: &'a AnimationManager,
    joints: &[Joints],
) -> Vec<(&'a Arc<SampledClip>, f32)> {
    let reach = |model: usize| {
        let clips = manager.materials[model].clips.iter().map(|clip| &manager.clips[*clip].sampled);
        clips.map(|clip| joints[model].reach_of_model(&scene.models[model], clip)).fold(0.0, f32::max)
    };
    let mut of_model: HashMap<usize, f32> = HashMap::new();
    let mut paths: Vec<(&Arc<SampledClip>, f32)> = Vec::new();
    let mut places: HashMap<*const SampledClip, usize> = HashMap::new();
    for (index, instance) in scene.instances.iter().enumerate() {
        let Some(path) = manager.paths.of(index) else { continue };
        let place = *places.entry(Arc::as_ptr(path)).or_insert_with(|| {
            paths.push((path, 0.0));
            paths.len() - 1
        });
        let reach = *of_model.entry(instance.model).or_insert_with(|| reach(instance.model));
        let reach_m = instance.placement.translation.length() + longest_axis(&instance.placement) * reach;
        paths[place].1 = paths[place].1.max(reach_m);
    }
    paths
}

/// How many times as large as its mesh says a model is drawn at most, by any of its instances and in any of their clips.
fn drawn_scale(scene: &Scene, index: usize) -> f32 {
    let model = &scene.models[index];
    let mut largest = 0.0f32;
    for clip in std::iter::once(None).chain((0..model.clips.len()).map(Some)) {
        let duration_s = f64::from(model.duration_s(clip));
        for moment in 0..if duration_s > 0.0 { MOMENTS } else { 1 } {
            let palette =
                pose::source_palette(model, clip, duration_s * f64::from(moment) / f64::from(MOMENTS));
            largest = palette.iter().map(longest_axis).fold(largest, f32::max);
        }
    }
    let scale = largest * world_scale(scene, index);
    if scale.is_finite() && scale > 1e-3 { scale.min(20.0) } else { 1.0 }
}

/// Joints and weights, the largest weight first, those of 0 last.
fn sorted_influences(vertex: &shadecast_scene::Vertex) -> ([u16; 4], [u16; 4]) {
    let mut order = [0, 1, 2, 3];
    let units = vertex.weights.map(units_of_weight);
    order.sort_by_key(|influence| std::cmp::Reverse(units[*influence]));
    let weights = order.map(|influence| units[influence]);
    let first = vertex.joints[order[0]];
    let joint = |influence: usize| if units[influence] > 0 { vertex.joints[influence] } else { first };
    (order.map(joint), weights)
}

/// From when to when a chunk is, seconds of its clip.
fn chunk_s(index: u32) -> [f64; 2] {
    let from_s = f64::from(index) * CHUNK_S;
    [from_s, from_s + CHUNK_S]
}

/// Which keys of a curve are needed between two times: those within, and one to each side.
fn needed(track: &SampledTrack, [from_s, to_s]: [f64; 2]) -> Range<usize> {
    let (first, _) = track.place(from_s);
    let after = track.times_s.partition_point(|time_s| f64::from(*time_s) < to_s);
    first..after.min(track.values.len() - 1).max(first) + 1
}

/// Whether so many keys of a curve need their tangents.
fn has_tangents(track: &SampledTrack, keys: usize) -> bool {
    keys > 1 && track.interpolation == KeyInterpolation::Cubic
}

/// What of a curve is needed between two times, as it is sent.
fn cut(track: &SampledTrack, raster: Raster, between_s: [f64; 2]) -> ChunkTrack {
    let keys = needed(track, between_s);
    let kind = match track.interpolation {
        KeyInterpolation::Step => TrackKind::Step,
        KeyInterpolation::Linear => TrackKind::Linear,
        KeyInterpolation::Cubic => TrackKind::Cubic,
    };
    let tangents = if has_tangents(track, keys.len()) { &track.tangents[keys.clone()] } else { &[] };
    ChunkTrack {
        kind,
        times_s: if keys.len() == 1 { vec![0.0] } else { track.times_s[keys.clone()].to_vec() },
        values: track.values[keys].iter().map(|value| raster.value(*value)).collect(),
        tangents: tangents.iter().map(|tangent| raster.tangent(*tangent)).collect(),
    }
}

#[cfg(test)]
mod clip_tests;
#[cfg(test)]
mod tests;

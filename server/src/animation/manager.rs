//! The animation manager: skeletons, clips and morph targets of the whole scene, as arrays for the GPU. Each is stored once,
//! however many models and instances use it. Pure; `skinning/gpu.rs` owns the buffers.

use super::saved::MOST_PLACES;
use super::timeline::Shown;
use crate::time::RingPlace;
use glam::{Affine3A, Vec4};
use shadecast_protocol::motion::playback::{At, Playing};
use shadecast_scene::animation::playing;
use shadecast_scene::animation::sampling::{
    KeyInterpolation, SampledClip, SampledPaths, SampledTrack, Sampling, world_scale,
};
use shadecast_scene::identity::{ContentHash, clip_hash, mesh_hash, skeleton_hash};
use shadecast_scene::process::{Loading, sampled};
use shadecast_scene::timeline::ClipIndex;
use shadecast_scene::{Cancelled, Model, Scene, Trs};
use shadecast_shaders::constants::{AFFINE_ROWS, CUBIC_TRACK, LINEAR_TRACK, NO_PARENT, STEP_TRACK};
use shadecast_shaders::generated::{EntryGpu, PoseGpu, TrackGpu};
use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

/// What one model needs to be animated: its parts in the scene-wide arrays.
#[derive(Clone, Debug)]
pub struct AnimationMaterial {
    /// The mesh that is animated; equal meshes have equal hashes.
    pub mesh: ContentHash,
    /// Index into [`AnimationManager::skeletons`].
    pub skeleton: usize,
    /// Indices into [`AnimationManager::clips`]: the rest pose first, then the model's clips.
    pub clips: Vec<usize>,
}

/// Bone hierarchy meta and inverse bind matrices of a skeleton, in the scene-wide arrays.
#[derive(Clone, Copy, Debug)]
pub struct Skeleton {
    /// First entry in `parents`.
    pub bone_base: u32,
    /// Bones.
    pub bone_count: u32,
    level_base: u32,
    level_count: u32,
    entry_base: u32,
    /// Palette entries.
    pub entry_count: u32,
}

/// Animation meta and keyframes of a clip, in the scene-wide arrays; what the CPU needs of it beside.
#[derive(Clone, Debug)]
pub struct StoredClip {
    /// First of three tracks a bone.
    track_base: u32,
    /// Seconds.
    pub duration_s: f32,
    /// Its curves, by the model's own order of bones.
    pub sampled: Arc<SampledClip>,
}

/// Skeletons, clips and who uses them.
#[derive(Debug, Default)]
pub struct AnimationManager {
    /// By model.
    pub materials: Vec<AnimationMaterial>,
    /// Each different one once.
    pub skeletons: Vec<Skeleton>,
    /// Each different one (for its skeleton) once.
    pub clips: Vec<StoredClip>,
    /// The instances' paths.
    pub paths: SampledPaths,
    /// Where the poses of live instances lie, by instance.
    live: HashMap<usize, LiveTracks>,
    /// The keys of all of them.
    live_keys: Range<u32>,
    /// What goes to the GPU.
    pub arrays: Arrays,
}

/// Tracks of a live instance, one set a place of the ring: each of one key, which the pose of that place gives.
#[derive(Clone, Debug)]
struct LiveTracks {
    track_base: u32,
    key_base: u32,
    /// By bone in the skeleton's own order: the model's.
    old_of_new: Vec<u32>,
}

/// The scene-wide arrays.
#[derive(Debug, Default)]
pub struct Arrays {
    /// Bone hierarchy meta: parent in the skeleton's own order, [`NO_PARENT`] for a root.
    pub parents: Vec<i32>,
    /// First bone of each level of each skeleton, and the count at its end.
    pub level_starts: Vec<u32>,
    /// Inverse bind matrices.
    pub entries: Vec<EntryGpu>,
    /// Animation meta.
    pub tracks: Vec<TrackGpu>,
    /// Keyframes.
    pub keys: Vec<[f32; 4]>,
    /// Their times, seconds.
    pub key_times: Vec<f32>,
}

/// What decides which pose an instance is in. Equal keys share a palette.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct PoseKey {
    skeleton: usize,
    now: TrackTime,
    /// What is faded out, and the bits of its share.
    fading: Option<(TrackTime, u32)>,
}

/// Tracks to evaluate, and their time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum TrackTime {
    /// A stored clip, and the bits of its phase.
    Clip(usize, u64),
    /// As a live instance, of this number, is posed; the rest pose of this stored clip gives its morph weights.
    Live(usize, usize),
}

impl AnimationManager {
    /// Samples every clip of the scene, through the cache, and every path.
    ///
    /// # Errors
    /// Somebody asked to end.
    pub fn new(scene: &Scene, sampling: Sampling, loading: &Loading) -> Result<Self, Cancelled> {
        let paths = SampledPaths::until(scene, sampling, &loading.cancel)?;
        let mut manager = Self { paths, ..Self::default() };
        let mut skeletons: HashMap<ContentHash, (usize, BoneOrder)> = HashMap::new();
        let mut clips: HashMap<(usize, ContentHash, ContentHash, u32), usize> = HashMap::new();
        for (index, model) in scene.models.iter().enumerate() {
            // How exact a clip must be depends on the mesh that it moves and on the size at which that is drawn.
            let (scale, mesh) = (world_scale(scene, index), mesh_hash(model));
            let sampling = sampling.in_model(scale);
            let (skeleton, order) = skeletons
                .entry(skeleton_hash(model))
                .or_insert_with(|| (manager.skeletons.len(), manager.add_skeleton(model)));
            let all = std::iter::once(None).chain((0..model.clips.len()).map(Some));
            let stored = all.map(|clip| {
                let key = (*skeleton, clip_hash(model, clip), mesh, scale.to_bits());
                if let Some(known) = clips.get(&key) {
                    return Ok(*known);
                }
                let number = manager.add_clip(sampled(model, clip, sampling, loading)?, order);
                clips.insert(key, number);
                Ok(number)
            });
            let clips = stored.collect::<Result<_, _>>()?;
            manager.materials.push(AnimationMaterial { mesh, skeleton: *skeleton, clips });
        }
        manager.live_keys = manager.arrays.keys.len() as u32..0;
        for (number, instance) in scene.instances.iter().enumerate().filter(|(_, own)| own.live) {
            manager.add_live(number, &BoneOrder::new(&scene.models[instance.model]));
        }
        manager.live_keys.end = manager.arrays.keys.len() as u32;
        Ok(manager)
    }

    /// Makes room for the poses of a live instance.
    fn add_live(&mut self, instance: usize, order: &BoneOrder) {
        let (track_base, key_base) = (self.arrays.tracks.len() as u32, self.arrays.keys.len() as u32);
        let tracks = MOST_PLACES as usize * 3 * order.old_of_new.len();
        // Something of unit length, until there is a pose.
        let none = SampledTrack::constant(Vec4::ONE);
        (0..tracks).for_each(|_| self.arrays.add_track(&none));
        let old_of_new = order.old_of_new.clone();
        self.live.insert(instance, LiveTracks { track_base, key_base, old_of_new });
    }

    fn add_skeleton(&mut self, model: &Model) -> BoneOrder {
        let (order, arrays) = (BoneOrder::new(model), &mut self.arrays);
        self.skeletons.push(Skeleton {
            bone_base: arrays.parents.len() as u32,
            bone_count: model.bones.len() as u32,
            level_base: arrays.level_starts.len() as u32,
            level_count: order.level_starts.len() as u32 - 1,
            entry_base: arrays.entries.len() as u32,
            entry_count: model.palette.len() as u32,
        });
        arrays.parents.extend(&order.parents);
        arrays.level_starts.extend(&order.level_starts);
        arrays.entries.extend(model.palette.iter().map(|entry| EntryGpu {
            bone_from_mesh: rows(entry.bone_from_mesh),
            bone: [order.new_of_old[entry.bone as usize], 0, 0, 0],
        }));
        order
    }

    /// Returns the clip's number.
    fn add_clip(&mut self, clip: SampledClip, order: &BoneOrder) -> usize {
        let track_base = self.arrays.tracks.len() as u32;
        for old in &order.old_of_new {
            clip.bones[*old as usize].iter().for_each(|track| self.arrays.add_track(track));
        }
        self.clips.push(StoredClip { track_base, duration_s: clip.duration_s, sampled: Arc::new(clip) });
        self.clips.len() - 1
    }

    /// Which pose an instance of a model is in that shows this.
    pub(crate) fn pose_key(&self, model: usize, instance: usize, shown: &Shown) -> PoseKey {
        let AnimationMaterial { skeleton, clips, .. } = &self.materials[model];
        let moment = |at: &At<ClipIndex>| {
            let clip = clips[at.clip.map_or(0, |clip| clip + 1)];
            TrackTime::Clip(clip, at.phase_s(self.clips[clip].duration_s).to_bits())
        };
        let (now, fading) = match shown {
            Shown::Clips(Playing { now, fading }) => {
                (moment(now), fading.map(|(at, share)| (moment(&at), (share as f32).to_bits())))
            }
            Shown::Live(_) => (TrackTime::Live(instance, clips[0]), None),
        };
        PoseKey { skeleton: *skeleton, now, fading }
    }

    /// First of the tracks that a moment is evaluated by, and the phase, in a place of the ring.
    fn tracks_of(&self, moment: TrackTime, place: RingPlace) -> (u32, f64) {
        match moment {
            TrackTime::Clip(clip, phase_bits) => (self.clips[clip].track_base, f64::from_bits(phase_bits)),
            TrackTime::Live(instance, _) => {
                let live = &self.live[&instance];
                (live.track_base + live.block(place), 0.0)
            }
        }
    }

    /// The pose of a key for the GPU in a place of the ring, its bones and palette where the caller has room for them.
    pub(crate) fn pose(
        &self,
        key: PoseKey,
        place: RingPlace,
        global_base: u32,
        palette_base: u32,
    ) -> PoseGpu {
        let skeleton = &self.skeletons[key.skeleton];
        let (track_base, phase_s) = self.tracks_of(key.now, place);
        let fading = key.fading.map(|(moment, share)| (self.tracks_of(moment, place), f32::from_bits(share)));
        let ((fading_track_base, fading_phase_s), fading) = fading.unwrap_or(((0, 0.0), 0.0));
        PoseGpu {
            bone_base: skeleton.bone_base,
            level_base: skeleton.level_base,
            level_count: skeleton.level_count,
            track_base,
            entry_base: skeleton.entry_base,
            entry_count: skeleton.entry_count,
            global_base,
            palette_base,
            phase_s: phase_s as f32,
            phase_low_s: low_part(phase_s),
            fading_track_base,
            fading_phase_s: fading_phase_s as f32,
            fading_phase_low_s: low_part(fading_phase_s),
            fading,
            reserved0: 0,
            reserved1: 0,
        }
    }

    /// The local transforms of a model's bones, in the model's own order, that shows this.
    pub(crate) fn local_pose(&self, model: usize, shown: &Shown) -> Vec<Trs> {
        let clips = &self.materials[model].clips;
        let sampled = |clip: ClipIndex| &*self.clips[clips[clip.map_or(0, |clip| clip + 1)]].sampled;
        match shown {
            Shown::Clips(playing) => playing::sampled_pose(sampled, playing),
            Shown::Live(pose) => pose.clone(),
        }
    }

    /// The skeleton of a pose.
    pub(crate) fn skeleton(&self, key: PoseKey) -> &Skeleton {
        &self.skeletons[key.skeleton]
    }

    /// The morph weights of a pose.
    pub(crate) fn morph_weights(&self, key: PoseKey) -> impl Iterator<Item = f32> + '_ {
        let of = |moment: TrackTime| {
            let (clip, phase_s) = match moment {
                TrackTime::Clip(clip, phase_bits) => (clip, f64::from_bits(phase_bits)),
                TrackTime::Live(_, rest) => (rest, 0.0),
            };
            self.clips[clip].sampled.morphs.iter().map(move |track| track.evaluate(phase_s).x)
        };
        let (moment, share) =
            key.fading.map_or((key.now, 0.0), |(moment, share)| (moment, f32::from_bits(share)));
        of(key.now)
            .zip(of(moment))
            .map(move |(now, before)| if share > 0.0 { now + (before - now) * share } else { now })
    }

    /// The keys that live poses give.
    pub(super) fn live_key_range(&self) -> Range<u32> {
        self.live_keys.clone()
    }

    /// The keys of a live instance's pose, local transforms in the model's order, and where in the keys they belong for a
    /// place of the ring.
    pub(crate) fn keys_of_pose(
        &self,
        instance: usize,
        place: RingPlace,
        pose: &[Trs],
    ) -> (u32, Vec<[f32; 4]>) {
        let live = &self.live[&instance];
        let keys = live.old_of_new.iter().flat_map(|old| {
            let Trs { translation, rotation, scale } = pose[*old as usize];
            [translation.extend(0.0), rotation.into(), scale.extend(0.0)].map(|key| key.to_array())
        });
        (live.key_base + live.block(place), keys.collect())
    }
}

impl LiveTracks {
    /// First track, and first key, of a place, from the instance's first.
    fn block(&self, place: RingPlace) -> u32 {
        3 * self.old_of_new.len() as u32 * place.0
    }
}

/// What single precision cannot hold of a number.
fn low_part(number: f64) -> f32 {
    (number - f64::from(number as f32)) as f32
}

impl Arrays {
    fn add_track(&mut self, track: &SampledTrack) {
        self.tracks.push(TrackGpu {
            first_key: self.keys.len() as u32,
            first_time: self.key_times.len() as u32,
            key_count: track.values.len() as u32,
            kind: track_kind(track.interpolation),
            interval_s: track.interval_s,
            reserved0: 0,
            reserved1: 0,
            reserved2: 0,
        });
        self.key_times.extend(&track.times_s);
        if track.interpolation == KeyInterpolation::Cubic && track.values.len() > 1 {
            let both = track.values.iter().zip(&track.tangents);
            self.keys.extend(both.flat_map(|(value, tangent)| [value.to_array(), tangent.to_array()]));
        } else {
            self.keys.extend(track.values.iter().map(|value| value.to_array()));
        }
    }

    /// Bytes on the GPU.
    pub fn bytes(&self) -> u64 {
        let sizes = [
            size_of_val(&self.parents[..]),
            size_of_val(&self.level_starts[..]),
            size_of_val(&self.entries[..]),
            size_of_val(&self.tracks[..]),
            size_of_val(&self.keys[..]),
            size_of_val(&self.key_times[..]),
        ];
        sizes.iter().sum::<usize>() as u64
    }
}

fn track_kind(interpolation: KeyInterpolation) -> u32 {
    match interpolation {
        KeyInterpolation::Step => STEP_TRACK,
        KeyInterpolation::Linear => LINEAR_TRACK,
        KeyInterpolation::Cubic => CUBIC_TRACK,
    }
}

/// An affine transform as rows.
pub(crate) fn rows(transform: Affine3A) -> [[f32; 4]; AFFINE_ROWS as usize] {
    let (m, t) = (transform.matrix3, transform.translation);
    [0, 1, 2].map(|r| [m.x_axis[r], m.y_axis[r], m.z_axis[r], t[r]])
}

/// Bones sorted by depth in the hierarchy, so that one level after the other can be evaluated in parallel.
pub(crate) struct BoneOrder {
    pub(crate) old_of_new: Vec<u32>,
    pub(crate) new_of_old: Vec<u32>,
    /// In the new order; [`NO_PARENT`] for a root.
    pub(crate) parents: Vec<i32>,
    /// First bone of each level, and the count at the end.
    pub(crate) level_starts: Vec<u32>,
}

impl BoneOrder {
    pub(crate) fn new(model: &Model) -> Self {
        let mut depth = vec![0u32; model.bones.len()];
        for (index, bone) in model.bones.iter().enumerate() {
            depth[index] = bone.parent.map_or(0, |parent| depth[parent as usize] + 1);
        }
        let mut old_of_new: Vec<u32> = (0..model.bones.len() as u32).collect();
        old_of_new.sort_by_key(|old| depth[*old as usize]);
        let mut new_of_old = vec![0; old_of_new.len()];
        for (new, old) in old_of_new.iter().enumerate() {
            new_of_old[*old as usize] = new as u32;
        }
        let parent = |old: &u32| {
            model.bones[*old as usize].parent.map_or(NO_PARENT, |p| new_of_old[p as usize] as i32)
        };
        let parents = old_of_new.iter().map(parent).collect();
        let levels = depth.iter().max().map_or(0, |deepest| deepest + 1);
        let level_starts = (0..=levels)
            .map(|level| old_of_new.partition_point(|old| depth[*old as usize] < level) as u32)
            .collect();
        Self { old_of_new, new_of_old, parents, level_starts }
    }
}

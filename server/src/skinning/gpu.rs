//! Samples of the needed part of the scene. Each is computed once on the GPU, kept for a while, and shared by all updates that
//! cover its time. Instances with the same skeleton, clip and phase share a palette.

use crate::animation::live::LivePoses;
use crate::animation::manager::{PoseKey, rows};
use crate::animation::packing::packing_box;
use crate::animation::saved::{InstanceVertices, Saved};
use crate::animation::timeline::{SharedTimeline, Shown, Timeline};
use crate::scene::SceneGpu;
use crate::scene::drawing::FULL_DETAIL;
use crate::scene::numbering::InstancePlace;
use crate::scene::skins::Skinning;
use crate::skinning::passes::palette::Palette;
use crate::skinning::passes::skin::{Output, Skin, SkinJobs};
use crate::time::RingPlace;
use shadecast_gpu::{Access, Bind, Buffer, Gpu, GpuError, Memory, Recorder};
use shadecast_protocol::time::WorldTime;
use shadecast_shaders::constants::{CHUNK_VERTICES, NO_MORPHS, SAVED_CHUNKS};
use shadecast_shaders::generated::{BoxGpu, PoseGpu, SkinJob};
use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

/// An instance to be skinned at a sample time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleJob {
    /// Index into the scene's instances.
    pub instance: usize,
    /// The finest LOD whose vertices are to be there.
    pub lod: usize,
    /// Where its samples are kept.
    pub place: RingPlace,
    /// That place's time; the same for all jobs of a place until it is used for another time.
    pub time: WorldTime,
}

/// How much work the animation has done, and how much it was spared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct AnimationCounts {
    /// Poses evaluated.
    pub poses: u64,
    /// Instances that found their pose evaluated for another one.
    pub shared_poses: u64,
    /// Instances skinned, times sample times.
    pub instance_samples: u64,
    /// Vertices skinned.
    pub vertices: u64,
}

/// Palettes and saved vertices of a few sample times.
pub struct Animation {
    scene: Arc<SceneGpu>,
    palette: Palette,
    skin: Skin,
    /// Where the skinned positions are, and the frames of the time that is shaded.
    saved: Saved,
    frames: Saved,
    /// By instance: what its positions are packed in.
    boxes: Buffer,
    morph_weights: Buffer,
    live: LivePoses,
    timeline: SharedTimeline,
    /// By place of the ring.
    poses: Vec<Poses>,
    statics_done: bool,
    jobs: SkinJobs,
    /// Poses of a recording that were not there.
    fresh: Vec<Range<u32>>,
    /// Whose frames a recording skins.
    framed: Vec<SampleJob>,
    counts: AnimationCounts,
}

/// The poses of a sample time, and which of them an instance has.
#[derive(Clone, Debug, Default)]
struct Poses {
    time: Option<WorldTime>,
    by_key: HashMap<PoseKey, PoseRef>,
    bones: u32,
    entries: u32,
    weights: u32,
    of_instance: Vec<Option<PoseRef>>,
}

/// Where a pose's parts lie.
#[derive(Clone, Copy, Debug)]
struct PoseRef {
    pose: u32,
    palette_base: u32,
    weight_base: u32,
    /// The finest LOD that was skinned.
    lod: usize,
}

impl Animation {
    /// With room for `times` sample times, of what the scene says of itself.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>, times: u32) -> Result<Self, GpuError> {
        Self::of_timeline(gpu, scene, times, SharedTimeline::new(&scene.scene))
    }

    /// With room for `times` sample times, of what a timeline of this scene says.
    pub(crate) fn of_timeline(
        gpu: &Arc<Gpu>,
        scene: &Arc<SceneGpu>,
        times: u32,
        timeline: SharedTimeline,
    ) -> Result<Self, GpuError> {
        let palette = Palette::new(gpu, scene, times)?;
        let weights_bytes = u64::from(times) * u64::from(scene.numbering.totals.morphs.max(1)) * 4;
        let morph_weights = Buffer::new(gpu, "morph weights", weights_bytes, Memory::Upload)?;
        let (saved, frames) = (saved(scene, times)?, saved(scene, 1)?);
        let boxes = Buffer::device_local(gpu, "boxes of positions", &boxes(scene))?;
        let skin = Skin::new(gpu, scene, &palette, &morph_weights, &boxes, [&saved, &frames])?;
        let empty = Poses { of_instance: vec![None; scene.numbering.instances.len()], ..Poses::default() };
        Ok(Self {
            scene: scene.clone(),
            palette,
            skin,
            saved,
            frames,
            boxes,
            morph_weights,
            live: LivePoses::new(gpu, &scene.animation)?,
            timeline,
            poses: vec![empty; times as usize],
            statics_done: false,
            jobs: SkinJobs::default(),
            fresh: Vec::new(),
            framed: Vec::new(),
            counts: AnimationCounts::default(),
        })
    }

    /// How many sample times of a scene are worth keeping.
    pub(crate) fn places_for(scene: &SceneGpu) -> u32 {
        Saved::places_for(&vertices(scene))
    }

    /// How many sample times are kept.
    pub(crate) fn places(&self) -> u32 {
        self.poses.len() as u32
    }

    /// Whether an instance's sample is there, in as much detail.
    pub fn has(&self, job: SampleJob) -> bool {
        let poses = &self.poses[job.place.index()];
        let pose = poses.of_instance[job.instance];
        poses.time == Some(job.time) && pose.is_some_and(|pose| pose.lod <= job.lod)
    }

    /// What it evaluates.
    pub fn timeline(&self) -> &SharedTimeline {
        &self.timeline
    }

    /// Poses and skins all animated instances in full detail at `time` into `place`; the static ones with the first call.
    pub fn record_sample(&mut self, recorder: &mut Recorder, place: RingPlace, time: WorldTime) {
        let animated =
            self.scene.numbering.instances.iter().enumerate().filter(|(_, instance)| instance.is_animated);
        let jobs: Vec<SampleJob> =
            animated.map(|(instance, _)| SampleJob { instance, lod: FULL_DETAIL, place, time }).collect();
        self.record(recorder, &jobs, SampleJob { instance: 0, lod: FULL_DETAIL, place, time });
    }

    /// Poses and skins the instances of `samples`; the static ones with the first call, posed at `statics`.
    pub fn record(&mut self, recorder: &mut Recorder, samples: &[SampleJob], statics: SampleJob) {
        let all = 0..self.scene.numbering.instances.len();
        let still =
            |instance: &usize| !self.statics_done && !self.scene.numbering.instances[*instance].is_animated;
        let still: Vec<SampleJob> =
            all.filter(still).map(|instance| SampleJob { instance, lod: FULL_DETAIL, ..statics }).collect();
        let mut jobs = self.no_jobs();
        let mut poses = std::mem::take(&mut self.fresh);
        poses.clear();
        let timeline = self.timeline.clone();
        let mut timeline = timeline.lock();
        for sample in samples.iter().chain(&still) {
            let pose = self.pose(*sample, &timeline, &mut poses);
            timeline.sampled(sample.time);
            // What has no room is drawn nowhere.
            if let Some(base) = self.saved.keep(sample.instance, sample.place) {
                self.push_job(&mut jobs, *sample, pose, base);
            }
        }
        drop(timeline);
        // The palettes and vertices of these places may still be read by the last samples.
        recorder.barrier(Access::COMPUTE, Access::COMPUTE);
        self.live.record(recorder, &self.scene.animation);
        if self.scene.skinning != Skinning::PerVertexChain {
            recorder.scope("palette", |r| {
                poses.iter().for_each(|range| self.palette.record(r, range.clone()));
            });
            recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ);
        }
        recorder.scope("skin", |r| self.skin.record(r, &jobs, Output::Positions));
        let skinned = samples.iter().chain(&still);
        self.counts.instance_samples += skinned.clone().count() as u64;
        self.counts.vertices += skinned.map(|sample| u64::from(self.vertex_count(sample))).sum::<u64>();
        (self.jobs, self.fresh) = (jobs, poses);
        self.statics_done = true;
        if !still.is_empty() {
            self.record_tangents_of(recorder, &still);
        }
    }

    /// Normals and tangents of another time come next.
    pub(crate) fn forget_tangents(&mut self) {
        self.frames.begin(SHADED);
    }

    /// Skins normals and tangents of the animated instances that are in `place` and that `is_wanted` names, as finely as their
    /// positions.
    pub fn record_tangents(
        &mut self,
        recorder: &mut Recorder,
        place: RingPlace,
        is_wanted: impl Fn(usize) -> bool,
    ) {
        let Some(time) = self.poses[place.index()].time else { return };
        let scene = self.scene.clone();
        let sample = |instance: usize| {
            let pose = self.poses[place.index()].of_instance[instance]?;
            let is_wanted = scene.numbering.instances[instance].is_animated && is_wanted(instance);
            is_wanted.then_some(SampleJob { instance, lod: pose.lod, place, time })
        };
        let mut samples = std::mem::take(&mut self.framed);
        samples.clear();
        samples.extend((0..scene.numbering.instances.len()).filter_map(sample));
        self.record_tangents_of(recorder, &samples);
        self.framed = samples;
    }

    fn record_tangents_of(&mut self, recorder: &mut Recorder, samples: &[SampleJob]) {
        let mut jobs = self.no_jobs();
        for sample in samples {
            let pose = self.poses[sample.place.index()].of_instance[sample.instance];
            let pose = pose.expect("posed before its frames are wanted");
            if let Some(base) = self.frames.keep(sample.instance, SHADED) {
                self.push_job(&mut jobs, *sample, pose, base);
            }
        }
        recorder.scope("skin frames", |r| self.skin.record(r, &jobs, Output::Frames));
        self.jobs = jobs;
    }

    /// The pose of an instance at a sample time: that of another one in the same pose, or a new one, which is added to
    /// `fresh`.
    fn pose(&mut self, sample: SampleJob, timeline: &Timeline, fresh: &mut Vec<Range<u32>>) -> PoseRef {
        let (scene, RingPlace(place)) = (self.scene.clone(), sample.place);
        let (manager, instance) = (&scene.animation.manager, &scene.scene.instances[sample.instance]);
        let shown = timeline.at(sample.instance, sample.time);
        let key = manager.pose_key(instance.model, sample.instance, &shown);
        let poses = &mut self.poses[sample.place.index()];
        if poses.time != Some(sample.time) {
            poses.start(sample.time);
            self.saved.begin(sample.place);
        }
        if let Some(known) = poses.by_key.get(&key).copied() {
            let known = PoseRef { lod: sample.lod, ..known };
            poses.of_instance[sample.instance] = Some(known);
            self.counts.shared_poses += 1;
            return known;
        }
        let (skeleton, totals) = (manager.skeleton(key), scene.numbering.totals);
        let pose = place * scene.numbering.instances.len() as u32 + poses.by_key.len() as u32;
        let global_base = place * totals.bones + poses.bones;
        let palette_base = place * totals.palette + poses.entries;
        let weight_base = place * totals.morphs + poses.weights;
        poses.bones += skeleton.bone_count;
        poses.entries += skeleton.entry_count;
        for weight in manager.morph_weights(key) {
            let at = place * totals.morphs + poses.weights;
            self.morph_weights.write(at as usize * 4, bytemuck::bytes_of(&weight));
            poses.weights += 1;
        }
        let found = PoseRef { pose, palette_base, weight_base, lod: sample.lod };
        poses.by_key.insert(key, found);
        poses.of_instance[sample.instance] = Some(found);
        if let Shown::Live(pose) = &shown {
            self.live.add(manager.keys_of_pose(sample.instance, sample.place, pose));
        }
        let gpu = manager.pose(key, sample.place, global_base, palette_base);
        self.palette.poses.write(pose as usize * size_of::<PoseGpu>(), bytemuck::bytes_of(&gpu));
        self.counts.poses += 1;
        match fresh.last_mut() {
            Some(range) if range.end == pose => range.end += 1,
            _ => fresh.push(pose..pose + 1),
        }
        found
    }

    /// How many vertices are skinned for a sample.
    fn vertex_count(&self, sample: &SampleJob) -> u32 {
        let mesh = self.scene.mesh(sample.instance);
        // In full detail those too that no triangle uses.
        if sample.lod == FULL_DETAIL { mesh.vertex_count } else { mesh.lods[sample.lod].skinned }
    }

    /// An empty list with the room of the last one.
    fn no_jobs(&mut self) -> SkinJobs {
        let mut jobs = std::mem::take(&mut self.jobs);
        jobs.clear();
        jobs
    }

    fn push_job(&self, jobs: &mut SkinJobs, sample: SampleJob, pose: PoseRef, output_base: u32) {
        let model = &self.scene.models[self.scene.numbering.instances[sample.instance].model];
        let paths = &self.scene.animation.manager.paths;
        let world_from_model =
            paths.world_from_model(&self.scene.scene, sample.instance, sample.time.seconds());
        let whole = SkinJob {
            world_from_model: rows(world_from_model),
            vertex_base: model.vertex_base,
            vertex_count: self.vertex_count(&sample),
            palette_base: pose.palette_base,
            output_base,
            weight_base: if model.skin.has_morphs { pose.weight_base } else { NO_MORPHS },
            pose: pose.pose,
            packed_base: 0,
            instance: sample.instance as u32,
        };
        if self.scene.skinning != Skinning::Packed {
            jobs.whole.push(whole);
            return;
        }
        for (list, run) in jobs.packed.iter_mut().zip(&model.skin.packed).filter(|(_, run)| !run.is_empty()) {
            list.push(SkinJob { vertex_count: run.len() as u32, packed_base: run.start, ..whole });
        }
    }

    /// Nothing that was computed is believed any more.
    pub(crate) fn forget(&mut self) {
        self.poses.iter_mut().for_each(Poses::forget);
        self.statics_done = false;
    }

    /// Makes room for an instance's positions in a place and for its frames, for who poses elsewhere; gives the first of both.
    pub(crate) fn keep(&mut self, instance: usize, place: RingPlace) -> Option<(u32, u32)> {
        self.saved.keep(instance, place).zip(self.frames.keep(instance, SHADED))
    }

    /// First saved vertex of an instance at the time of a place; `None` where it is not there.
    pub fn position_base(&self, instance: usize, place: RingPlace) -> Option<u32> {
        self.saved.base(instance, place)
    }

    /// The finest LOD of an instance whose positions are in a place, if it is there; that of what stands still is full detail.
    pub(crate) fn lod_in(&self, instance: usize, place: RingPlace) -> usize {
        self.poses[place.index()].of_instance[instance].map_or(FULL_DETAIL, |pose| pose.lod)
    }

    /// First saved frame of an instance; `None` where it is not there.
    pub fn tangent_base(&self, instance: usize) -> Option<u32> {
        self.frames.base(instance, SHADED)
    }

    /// What reads positions binds: they lie in several buffers, packed in boxes.
    pub(crate) fn position_binds(&self) -> [(&'static str, Bind<'_>); 2] {
        [("SavedVertices", Bind::Buffers(self.saved_vertices())), ("Boxes", Bind::Buffer(&self.boxes))]
    }

    /// What reads normals and tangents binds.
    pub(crate) fn frame_bind(&self) -> (&'static str, Bind<'_>) {
        ("Tangents", Bind::Buffers(self.tangents()))
    }

    /// Packed positions in the world.
    pub fn saved_vertices(&self) -> &[Buffer] {
        &self.skin.saved_vertices
    }

    /// Packed normals and tangents in the world.
    pub fn tangents(&self) -> &[Buffer] {
        &self.skin.tangents
    }

    /// By instance what its positions are packed in.
    pub fn boxes(&self) -> &Buffer {
        &self.boxes
    }

    /// Work done so far.
    pub fn counts(&self) -> AnimationCounts {
        self.counts
    }
}

/// The place of the one time that is shaded.
const SHADED: RingPlace = RingPlace(0);

fn vertices(scene: &SceneGpu) -> Vec<InstanceVertices> {
    let instances = scene.numbering.instances.iter();
    let of = |place: &InstancePlace| InstanceVertices {
        count: scene.models[place.model].vertex_count,
        moves: place.is_animated,
    };
    instances.map(of).collect()
}

fn saved(scene: &SceneGpu, times: u32) -> Result<Saved, GpuError> {
    Saved::new(vertices(scene), times).ok_or_else(|| {
        let count = scene.numbering.totals.static_vertices;
        GpuError::TooLarge(format!(
            "{count} vertices of instances that stand still are more than are kept, {} millions of all instances, and {} millions \
             of one; use fewer or smaller models",
            SAVED_CHUNKS * CHUNK_VERTICES / 1_000_000,
            CHUNK_VERTICES / 1_000_000
        ))
    })
}

/// That all that stands still can be kept.
///
/// # Errors
/// It cannot; the text says what to do.
pub(crate) fn check_room(scene: &SceneGpu) -> Result<(), GpuError> {
    saved(scene, 1).map(|_| ())
}

/// By instance what its positions are packed in.
pub(crate) fn boxes(scene: &SceneGpu) -> Vec<BoxGpu> {
    scene.world_bounds.iter().map(|bounds| packing_box(*bounds)).collect()
}

impl Poses {
    fn start(&mut self, time: WorldTime) {
        self.time = Some(time);
        self.by_key.clear();
        self.of_instance.fill(None);
        (self.bones, self.entries, self.weights) = (0, 0, 0);
    }

    fn forget(&mut self) {
        self.time = None;
    }
}

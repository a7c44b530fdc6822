//! What one connection shows: the terms it was made under, the bundles, and their place on the GPU. A new connection has a
//! new one; the old one stays on display until the new one has its first complete bundle.

use crate::bundle::Bundler;
use crate::decode::Picture;
use crate::draw_list::ListScratch;
use crate::motion::pace::{GridTime, Pace};
use crate::motion::skinned::{SkinCapacity, SkinnedCounts};
use crate::motion::{Motion, Motionless};
use crate::report::ClientError;
use crate::stages::arena::{ArenaStaging, SkinMemory};
use crate::stages::atlas_draw::BundleSet;
use crate::stages::interpolate::{self, Interpolation, Slots};
use crate::stages::pose::PoseStaging;
use crate::stages::scatter::{ScatterStaging, VertexMemory};
use crate::stages::{Stages, wait_for};
use shadecast_gpu::{Access, BindGroup, Gpu, GpuError, Recorder};
use shadecast_protocol::clock::ClockEstimator;
use shadecast_protocol::delta::ReceivedDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::Welcome;
use shadecast_protocol::time::{ClientTime, GridIndex, ServerTime};
use shadecast_shaders::generated::{CornerGpu, EyesGpu};
use std::sync::Arc;

/// A decoded picture, and when it came.
#[derive(Debug)]
pub struct ArrivedPicture {
    /// When its last byte came.
    pub arrived: ClientTime,
    /// The picture.
    pub picture: Picture,
}

/// One connection's scene.
pub struct Scene {
    /// Which connection made it.
    pub serial: u64,
    /// Its terms.
    pub terms: Welcome,
    /// What may be drawn.
    pub bundler: Bundler<ArrivedPicture>,
    /// How its vertices move.
    pub motion: Motion,
    /// The server's clock as a connection knew it that has ended; while it lives, it is the connection's.
    pub ended_clock: Option<Box<ClockEstimator>>,
    memory: VertexMemory,
    staging: ScatterStaging,
    interpolate_group: BindGroup,
    skin_memory: SkinMemory,
    arena_staging: ArenaStaging,
    pose_staging: PoseStaging,
    skin_group: BindGroup,
    sets: [BundleSet; 3],
    list_scratch: ListScratch,
    /// The set on display.
    shown: usize,
    /// The time at which its vertices are.
    pace: Pace,
    has_switched: bool,
}

/// A bundle that has just come on display.
#[derive(Clone, Copy, Debug)]
pub struct Switched {
    /// Its frame.
    pub update: UpdateId,
    /// When the last byte of its picture came.
    pub picture_arrived: ClientTime,
}

/// How a scene stands at a display time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SceneReport {
    /// Indices to draw.
    pub index_count: u32,
    /// Patches that cannot be drawn yet for want of samples.
    pub withheld_patches: u32,
    /// Bytes of skeletons, keys and morph targets that wait for the GPU's memory.
    pub arena_waiting_bytes: u64,
    /// Vertices that have run out of samples.
    pub motionless: Motionless,
    /// How instances stand that move by clips or by poses on the grid.
    pub skinned: SkinnedCounts,
    /// The time at which all sampled vertices drawn are.
    pub motion_time: Option<ServerTime>,
}

impl Scene {
    /// Allocates everything that a connection under these terms can need.
    pub fn new(gpu: &Arc<Gpu>, stages: &Stages, terms: Welcome, serial: u64) -> Result<Self, GpuError> {
        let mut recorder = gpu.record()?;
        let capacity = SkinCapacity::from(terms.motion);
        let memory = VertexMemory::new(gpu, &mut recorder, terms.vertex_slots, capacity)?;
        let staging = stages.scatter.staging(gpu, &memory)?;
        let interpolate_group = stages.interpolate.bind(&memory)?;
        let skin_memory = SkinMemory::new(gpu, &mut recorder, capacity)?;
        let arena_staging = ArenaStaging::new(gpu)?;
        let pose_staging = stages.pose.staging(gpu, &skin_memory)?;
        let skin_group = stages.skin.bind(&memory, &skin_memory)?;
        let mut set = || {
            let eyes = stages.eyes.each_ref();
            stages.atlas.bundle_set(
                gpu,
                &mut recorder,
                terms.patch_slots,
                terms.atlas_extent_texels,
                &memory,
                eyes,
            )
        };
        let sets = [set()?, set()?, set()?];
        recorder.submit()?;
        let (bundler, motion) = (
            Bundler::new(terms.patch_slots, terms.atlas_extent_texels),
            Motion::new(terms.vertex_slots, capacity),
        );
        let list_scratch = ListScratch::new(terms.patch_slots);
        let (shown, pace, has_switched) = (0, Pace::default(), false);
        Ok(Self {
            serial,
            terms,
            bundler,
            motion,
            ended_clock: None,
            memory,
            staging,
            interpolate_group,
            skin_memory,
            arena_staging,
            pose_staging,
            skin_group,
            sets,
            list_scratch,
            shown,
            pace,
            has_switched,
        })
    }

    /// Bytes of the device's memory for vertices and how they move.
    pub fn motion_memory_bytes(&self) -> u64 {
        self.memory.bytes() + self.skin_memory.bytes()
    }

    /// Whether a bundle of it can be drawn.
    pub fn is_drawable(&self) -> bool {
        self.bundler.current().is_some()
    }

    /// Takes in the next delta: its vertices and samples count at once, its patches with a picture.
    pub fn take_delta(&mut self, mut delta: ReceivedDelta) {
        self.motion.take_delta(&mut delta);
        if delta.is_update {
            self.bundler.add_delta(delta.geometry);
        }
    }

    /// Bytes that wait: for the GPU's vertex memory, and for pictures.
    pub fn waiting_bytes(&self) -> usize {
        self.motion.waiting_bytes() + self.bundler.waiting_bytes()
    }

    /// Whether anything has arrived about vertices or skeletons that is not written.
    pub fn has_arrivals(&self) -> bool {
        self.motion.has_writes()
    }

    /// Writes what has arrived about vertices and skeletons. Needs a barrier before and after it.
    pub fn record_arrivals(&mut self, recorder: &mut Recorder, stages: &Stages, flight: usize) {
        self.arena_staging.record(recorder, flight, &self.skin_memory, self.motion.arena());
        let (memory, writes) = (&self.memory, self.motion.writes());
        stages.scatter.record(recorder, &mut self.staging, flight, memory, writes);
    }

    /// Switches to the newest complete bundle, if there is a newer one: its picture into images, its patches into a draw
    /// list. Pictures that are not needed any more go to `recycle`.
    pub fn record_switch(
        &mut self,
        gpu: &Gpu,
        recorder: &mut Recorder,
        time: ServerTime,
        mut recycle: impl FnMut(Picture),
    ) -> Result<Option<Switched>, ClientError> {
        let Some(complete) = self.motion.complete() else { return Ok(None) };
        let newest = self.bundler.take_newest_complete(complete, |dropped| recycle(dropped.picture));
        let Some((frame, arrived)) = newest else { return Ok(None) };
        self.shown = (self.shown + 1) % self.sets.len();
        let set = &mut self.sets[self.shown];
        wait_for(gpu, &mut set.last_use)?;
        set.planes.record(recorder, &arrived.picture);
        set.coverage.write(0, bytemuck::cast_slice(self.bundler.coverage().words()));
        recycle(arrived.picture);
        self.write_list(GridTime::of(self.terms.grid, time).step);
        self.has_switched = true;
        Ok(Some(Switched { update: frame, picture_arrived: arrived.arrived }))
    }

    /// Writes the draw list of the set on display, for times from `step` on.
    fn write_list(&mut self, step: GridIndex) {
        let set = &mut self.sets[self.shown];
        let corners: &mut [CornerGpu] = bytemuck::cast_slice_mut(set.corners.bytes_mut());
        let indices: &mut [u32] = bytemuck::cast_slice_mut(set.indices.bytes_mut());
        let patches = self.bundler.patches();
        set.list.write(patches, &mut self.motion, step, (corners, indices), &mut self.list_scratch);
    }

    /// Skeletons of the draw list's instances at `time`. Needs a barrier after it, before what reads their palettes.
    pub fn record_poses(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
        flight: usize,
        time: ServerTime,
    ) -> SkinnedCounts {
        let poses = self.pose_staging.poses_mut(flight);
        let counts = self.motion.poses(self.terms.grid, time, poses);
        stages.pose.record(recorder, &self.pose_staging, flight, counts.instances);
        counts
    }

    /// Skins what those instances move.
    pub fn record_skin(&mut self, recorder: &mut Recorder, stages: &Stages) {
        if !self.motion.skinned().is_empty() {
            stages.skin.record(recorder, &self.skin_group, self.motion.vertex_count());
        }
    }

    /// Moves the sampled vertices to where they are at `time`, or all of them to where all can be.
    pub fn record_motion(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
        time: ServerTime,
        interpolation: Interpolation,
    ) -> SceneReport {
        let grid = self.terms.grid;
        let has_switched = std::mem::take(&mut self.has_switched);
        if let Some(evaluation) = self.pace.advance(grid, time, self.motion.span(), has_switched) {
            let VertexMemory { vertex_slots, sample_ring, .. } = self.memory;
            let slots = Slots { vertex_count: self.motion.vertex_count(), vertex_slots, sample_ring };
            let push = interpolate::push(grid, evaluation, slots, interpolation);
            stages.interpolate.record(recorder, &self.interpolate_group, &push);
        }
        let motion_time = self.pace.shown();
        let step = GridTime::of(grid, motion_time.unwrap_or(time)).step;
        if has_switched && step < self.sets[self.shown].list.ready {
            // A server that sends samples with holes: what has none at this time is not drawn yet.
            self.write_list(step);
        }
        let (index_count, withheld_patches) = self.sets[self.shown].list.at(step);
        let motionless = self.motion.motionless(grid, time);
        let arena_waiting_bytes = self.motion.arena().waiting_bytes() as u64;
        let skinned = SkinnedCounts::default();
        SceneReport { index_count, withheld_patches, arena_waiting_bytes, motionless, skinned, motion_time }
    }

    /// Draws the bundle on display.
    pub fn record_draw(&self, recorder: &mut Recorder, stages: &Stages, flight: usize, index_count: u32) {
        stages.atlas.record(recorder, &self.sets[self.shown], flight, index_count);
    }

    /// Notes that the recording behind `ticket` reads the bundle on display.
    pub fn used_by(&mut self, ticket: shadecast_gpu::Ticket) {
        self.sets[self.shown].last_use = Some(ticket);
    }

    /// The bundle on display, for the probe.
    pub fn probe(
        &self,
        probe: &mut crate::stages::probe::Probe,
        eyes: &EyesGpu,
        index_count: u32,
    ) -> Result<[crate::stages::probe::ProbeView; 2], GpuError> {
        probe.run(&self.sets[self.shown], &self.memory.positions, eyes, index_count)
    }

    /// The vertex slots of every triangle that the first `index_count` indices draw; for tests.
    pub fn drawn_triangles(&self, index_count: u32) -> Vec<[u32; 3]> {
        let set = &self.sets[self.shown];
        let corners: &[CornerGpu] = set.corners.values();
        let indices = &set.indices.values::<u32>()[..index_count as usize];
        indices.chunks_exact(3).map(|t| [t[0], t[1], t[2]].map(|c| corners[c as usize].vertex_slot)).collect()
    }

    /// Positions and states of all vertex slots as the last display frame left them. Waits for the GPU; for tests.
    pub fn read_positions(&self, gpu: &Arc<Gpu>) -> Result<Vec<[f32; 4]>, GpuError> {
        let positions = &self.memory.positions;
        let readback =
            shadecast_gpu::Buffer::new(gpu, "positions", positions.size(), shadecast_gpu::Memory::Readback)?;
        let mut recorder = gpu.record()?;
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        recorder.copy_buffer(positions, 0, &readback, 0, positions.size());
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        gpu.wait(recorder.submit()?)?;
        Ok(readback.values::<[f32; 4]>()[..self.memory.vertex_slots as usize].to_vec())
    }
}

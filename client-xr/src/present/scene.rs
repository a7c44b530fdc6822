//! One connection's scene on the GPU: its terms, vertices, skeletons and bundles. A new connection has a new scene; the old one
//! stays on display until the new one has its first complete bundle. Costly work on arrivals is done earlier
//! ([`crate::stream::preparing`]).

use crate::draw::draw_list::{DrawList, Drawable};
use crate::draw::stages::Stages;
use crate::draw::stages::arena::SkinMemory;
use crate::draw::stages::atlas_draw::{BUNDLES, BundleMemory, BundleSet, OnDevice, Shared};
use crate::draw::stages::batch::{BATCHES, Batch};
use crate::draw::stages::interpolate::{self, Interpolation, Slots};
use crate::draw::stages::pose::PoseStaging;
use crate::draw::stages::probe::{EyeView, Probe, ProbeView};
use crate::draw::stages::scatter::VertexMemory;
use crate::draw::stages::settle::Store;
use crate::handover::{Bundle, Loan};
use crate::motion::pace::{GridTime, Pace, Span};
use crate::motion::skinned::{PoseQuery, SkinCapacity, Skinned, SkinnedCounts};
use crate::motion::state::{MotionState, Motionless};
use crate::report::ClientError;
use bytemuck::Zeroable;
use shadecast_gpu::{Access, BindGroup, Buffer, Gpu, GpuError, Memory, Recorder};
use shadecast_protocol::clock::ShownClock;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::limits::MAX_INSTANCES;
use shadecast_protocol::message::Welcome;
use shadecast_protocol::time::{ClientTime, GridIndex, ServerTime, WorldTime};
use shadecast_protocol::world_clock::ShownWorldClock;
use shadecast_shaders::generated::{CornerGpu, InterpolatePush, PlacedPoseGpu};
use std::collections::VecDeque;
use std::sync::Arc;

/// One connection's scene.
pub struct Scene {
    /// Which connection made it.
    pub(crate) serial: u64,
    /// Its terms.
    pub(crate) terms: Welcome,
    /// Its server's clock, as far as the connection knows it, or knew it when it ended.
    pub(crate) clock: ShownClock,
    /// How its world's time follows that clock, likewise.
    pub(crate) world: ShownWorldClock,
    /// What was handed over, and is not taken in.
    coming: VecDeque<Loan>,
    /// What was taken in and is not needed any more, once the GPU is done with this frame.
    pub(crate) spent: Vec<Loan>,
    memory: VertexMemory,
    store: Store,
    scatter_groups: Vec<BindGroup>,
    interpolate_group: BindGroup,
    skin_memory: SkinMemory,
    pose_staging: PoseStaging,
    skin_group: BindGroup,
    sets: Vec<BundleSet>,
    skinned: Skinned,
    state: MotionState,
    /// What is complete and not yet on display.
    next: Option<Box<Bundle>>,
    shown: Option<Box<Bundle>>,
    /// What was shown before it.
    before: Option<Before>,
    /// The first step at which all of it can be drawn that could be when it came on display.
    ready: GridIndex,
    /// The time at which its vertices are.
    pace: Pace,
    has_switched: bool,
}

/// The picture that was on display before the one that is.
#[derive(Default)]
struct Before {
    /// What it is shaded for.
    shaded: WorldTime,
    /// It, where the device has it; else it is in its bundle's planes until the next bundle is shown.
    on_device: Option<OnDevice>,
    /// What is on display blends from it.
    blends: bool,
}

/// How much of a colour is the second picture's, which are shaded for such times.
fn newest_part([from, to]: [WorldTime; 2], time: WorldTime) -> f32 {
    let (whole_ns, passed_ns) = (to.since(from), time.since(from));
    if whole_ns <= 0 { 1.0 } else { (passed_ns as f64 / whole_ns as f64).clamp(0.0, 1.0) as f32 }
}

/// How a scene stands at a display time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SceneReport {
    /// What is drawn.
    pub drawn: Drawable,
    /// Bytes of skeletons, keys and morph targets that wait for the GPU's memory.
    pub arena_waiting_bytes: u64,
    /// Vertices that have run out of samples.
    pub motionless: Motionless,
    /// How instances stand that move by clips or by poses on the grid.
    pub skinned: SkinnedCounts,
    /// The time at which all sampled vertices drawn are.
    pub motion_time: Option<WorldTime>,
}

impl Scene {
    /// Allocates everything that a connection under these terms can need. What arrives is to be written to the loans.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        stages: &Stages,
        terms: Welcome,
        serial: u64,
    ) -> Result<(Self, Vec<Loan>), GpuError> {
        let mut recorder = gpu.record()?;
        let capacity = SkinCapacity::from(terms.motion);
        let memory = VertexMemory::new(gpu, &mut recorder, terms.vertex_slots, capacity)?;
        let skin_memory = SkinMemory::new(gpu, &mut recorder, capacity)?;
        let store = Store::new(gpu, &mut recorder, terms.store_pages)?;
        let shared = Shared { memory: &memory, store: &store, eyes: stages.eyes.each_ref() };
        let has_store = terms.store_pages > 0;
        let (mut scatter_groups, mut sets, mut loans) = (Vec::new(), Vec::new(), Vec::new());
        for index in 0..BATCHES {
            let batch = Batch::new(gpu, index, terms.vertex_slots, capacity.sample_ring)?;
            scatter_groups.push(stages.scatter.bind(&batch, &memory)?);
            loans.push(Loan::Batch(Box::new(batch)));
        }
        for index in 0..BUNDLES {
            let extent = terms.atlas_extent_texels;
            let bundle = stages.atlas.bundle_memory(gpu, index, terms.patch_slots, extent, has_store)?;
            sets.push(stages.atlas.bundle_set(gpu, &mut recorder, &bundle, extent, shared)?);
            loans.push(Loan::Bundle(Box::new(Bundle {
                memory: bundle,
                coverage: None,
                list: DrawList::of_capacity(terms.patch_slots),
                drawn: Vec::with_capacity(MAX_INSTANCES as usize),
                state: MotionState::default(),
                update: UpdateId(0),
                shaded: WorldTime(0),
                before: None,
                picture_arrived: ClientTime(0),
            })));
        }
        let scene = Self {
            serial,
            clock: ShownClock::default(),
            world: ShownWorldClock::default(),
            coming: VecDeque::with_capacity(loans.len()),
            spent: Vec::with_capacity(loans.len()),
            interpolate_group: stages.interpolate.bind(&memory)?,
            pose_staging: stages.pose.staging(gpu, &skin_memory)?,
            skin_group: stages.skin.bind(&memory, &skin_memory)?,
            terms,
            memory,
            store,
            scatter_groups,
            skin_memory,
            sets,
            skinned: Skinned::default(),
            state: MotionState::default(),
            next: None,
            shown: None,
            before: None,
            ready: GridIndex(i32::MIN),
            pace: Pace::default(),
            has_switched: false,
        };
        recorder.submit()?;
        Ok((scene, loans))
    }

    /// Bytes of the device's memory for vertices and how they move.
    pub(crate) fn motion_memory_bytes(&self) -> u64 {
        self.memory.bytes() + self.skin_memory.bytes()
    }

    /// The update on display.
    pub(crate) fn update(&self) -> Option<UpdateId> {
        self.shown.as_ref().map(|bundle| bundle.update)
    }

    /// Something was handed over.
    pub(crate) fn add(&mut self, loan: Loan) {
        self.coming.push_back(loan);
    }

    /// Whether anything was handed over that is not taken in.
    pub(crate) fn has_arrivals(&self) -> bool {
        !self.coming.is_empty()
    }

    /// Takes in what was handed over: writes what is said of vertices and skeletons, and keeps the newest bundle. Of one that it
    /// passes over, blocks settle. Needs a barrier before and after it.
    ///
    /// # Errors
    /// As [`AtlasDraw::record_picture`](crate::draw::stages::atlas_draw::AtlasDraw::record_picture).
    pub(crate) fn record_arrivals(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
    ) -> Result<(), GpuError> {
        while let Some(loan) = self.coming.pop_front() {
            match loan {
                Loan::Batch(batch) => self.record_batch(recorder, stages, batch),
                Loan::Bundle(bundle) => {
                    self.state.clone_from(&bundle.state);
                    if let Some(passed_over) = self.next.replace(bundle) {
                        if !passed_over.memory.settled.is_empty() {
                            self.record_picture(recorder, stages, &passed_over.memory)?;
                        }
                        self.spent.push(Loan::Bundle(passed_over));
                    }
                }
            }
        }
        Ok(())
    }

    fn record_picture(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
        memory: &BundleMemory,
    ) -> Result<(), GpuError> {
        let shared = Shared { memory: &self.memory, store: &self.store, eyes: stages.eyes.each_ref() };
        stages.atlas.record_picture(recorder, &mut self.sets[memory.index], memory, shared)
    }

    fn record_batch(&mut self, recorder: &mut Recorder, stages: &Stages, mut batch: Box<Batch>) {
        batch.changes.drain(..).for_each(|change| self.skinned.apply(change));
        self.state.clone_from(&batch.state);
        self.skin_memory.record(recorder, &batch);
        stages.scatter.record(recorder, &self.scatter_groups[batch.index], &self.memory, &batch);
        self.spent.push(Loan::Batch(batch));
    }

    /// Puts the newest complete bundle on display, if there is a newer one. Gives when the last byte of its picture came.
    ///
    /// # Errors
    /// As [`AtlasDraw::record_picture`](crate::draw::stages::atlas_draw::AtlasDraw::record_picture).
    pub(crate) fn record_switch(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
        time: WorldTime,
    ) -> Result<Option<ClientTime>, GpuError> {
        let Some(bundle) = self.next.take() else { return Ok(None) };
        self.record_picture(recorder, stages, &bundle.memory)?;
        self.ready = bundle.list.ready_at(GridTime::of(self.terms.grid, time).step);
        self.has_switched = true;
        let picture_arrived = bundle.picture_arrived;
        if let Some(shown) = self.shown.replace(bundle) {
            self.keep_before(stages, shown);
        }
        Ok(Some(picture_arrived))
    }

    /// What was shown until now is spent, but for its picture: what comes next blends from that.
    fn keep_before(&mut self, stages: &Stages, mut shown: Box<Bundle>) {
        if stages.atlas.blends() {
            let before = self.before.get_or_insert_default();
            // The one that this one blended from is given back with it.
            std::mem::swap(&mut before.on_device, &mut shown.memory.on_device);
            (before.shaded, before.blends) = (shown.shaded, false);
            if let Some(now) = self.shown.as_deref().filter(|now| now.before == Some(shown.update)) {
                let sets = self.sets.get_disjoint_mut([now.memory.index, shown.memory.index]);
                let [set, set_before] = sets.expect("two bundles have two sets");
                let picture_before = (&*set_before, before.on_device.as_ref());
                before.blends = stages.atlas.bind_before((set, &now.memory), picture_before);
            }
        }
        self.spent.push(Loan::Bundle(shown));
    }

    /// How much of a colour the picture on display has at `time`, where the one before it has the same block; the rest is of that one.
    pub(crate) fn newest_part(&self, time: WorldTime) -> f32 {
        let before = self.before.as_ref().filter(|before| before.blends);
        let Some((before, shown)) = before.zip(self.shown.as_ref()) else { return 1.0 };
        newest_part([before.shaded, shown.shaded], time)
    }

    /// Skeletons of the draw list's instances at `time`. Needs a barrier after it, before what reads their palettes.
    pub(crate) fn record_poses(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
        flight: usize,
        time: WorldTime,
    ) -> SkinnedCounts {
        let Some(shown) = &self.shown else { return SkinnedCounts::default() };
        let moment = PoseQuery { time, grid: self.terms.grid, written: self.state.written };
        let counts = self.skinned.poses(moment, &shown.drawn, self.pose_staging.poses_mut(flight));
        stages.pose.record(recorder, &self.pose_staging, flight, counts.instances);
        counts
    }

    /// Skins what those instances move.
    pub(crate) fn record_skin(&mut self, recorder: &mut Recorder, stages: &Stages) {
        if !self.skinned.is_empty() {
            stages.skin.record(recorder, &self.skin_group, self.state.vertex_count);
        }
    }

    /// Moves the sampled vertices to where they are at the world's `time`, seen at `now`, or all of them to where all can be.
    pub(crate) fn record_motion(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
        (now, time): (ServerTime, WorldTime),
        interpolation: Interpolation,
    ) -> SceneReport {
        let grid = self.terms.grid;
        let has_switched = std::mem::take(&mut self.has_switched);
        let Span { first, last } = self.state.span;
        let span = Span { first: first.max(self.ready), last };
        if let Some(evaluation) = self.pace.advance(grid, (now, time), span, has_switched) {
            let VertexMemory { vertex_slots, sample_ring, .. } = self.memory;
            let slots = Slots { vertex_count: self.state.vertex_count, vertex_slots, sample_ring };
            let push = interpolate::push(grid, evaluation, slots, interpolation);
            stages.interpolate.record(recorder, &self.interpolate_group, &push);
        }
        let motion_time = self.pace.shown();
        let step = GridTime::of(grid, motion_time.unwrap_or(time)).step;
        let list = self.shown.as_ref().map(|bundle| &bundle.list);
        if has_switched {
            // A server that sends samples with holes: what has none at this time is not drawn yet.
            self.ready = list.map_or(self.ready, |list| list.ready_at(step));
        }
        SceneReport {
            drawn: list.map_or(Drawable::default(), |list| list.at(step)),
            arena_waiting_bytes: self.state.arena_waiting_bytes,
            motionless: self.state.motionless(grid, time),
            skinned: SkinnedCounts::default(),
            motion_time,
        }
    }

    /// Draws the bundle on display.
    pub(crate) fn record_draw(
        &self,
        recorder: &mut Recorder,
        stages: &Stages,
        flight: usize,
        drawn: Drawable,
    ) {
        if let Some(Bundle { memory, .. }) = self.shown.as_deref() {
            stages.atlas.record(recorder, &self.sets[memory.index], memory, flight, drawn);
        }
    }

    /// Runs each stage before the draw once: on a vertex, an instance and a picture of zeros. Needs the barriers of a display frame
    /// before and after it.
    pub(crate) fn record_zeros(
        &mut self,
        recorder: &mut Recorder,
        stages: &Stages,
        flight: usize,
    ) -> Result<(), GpuError> {
        for mut loan in std::mem::take(&mut self.coming) {
            match &mut loan {
                Loan::Batch(batch) => {
                    batch.vertices.bytes_mut().fill(0);
                    batch.ranges.push(0..1);
                    stages.scatter.record(recorder, &self.scatter_groups[batch.index], &self.memory, batch);
                }
                Loan::Bundle(bundle) => {
                    let BundleMemory { corners, indices, coverage, settled, .. } = &mut bundle.memory;
                    settled.write_zeros();
                    [corners, indices, coverage].into_iter().for_each(|buffer| buffer.bytes_mut().fill(0));
                }
            }
            match loan {
                Loan::Bundle(bundle) if self.next.is_none() => self.next = Some(bundle),
                loan => self.spent.push(loan),
            }
        }
        self.record_switch(recorder, stages, WorldTime(0))?;
        self.pose_staging.poses_mut(flight)[0] = PlacedPoseGpu::zeroed();
        stages.pose.record(recorder, &self.pose_staging, flight, 1);
        let push = InterpolatePush { vertex_count: 1, vertex_slots: 1, sample_ring: 1, ..Zeroable::zeroed() };
        stages.interpolate.record(recorder, &self.interpolate_group, &push);
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ);
        stages.skin.record(recorder, &self.skin_group, 1);
        Ok(())
    }

    /// The bundle on display, for the probe; `None` where there is none.
    pub(crate) fn probe(
        &self,
        probe: &mut Probe,
        eyes: [EyeView; 2],
        drawn: Drawable,
    ) -> Result<Option<[ProbeView; 2]>, GpuError> {
        let shown = self.shown.as_ref();
        shown.map(|shown| probe.run(&shown.memory, &self.memory.positions, eyes, drawn)).transpose()
    }

    /// The vertex slots of every triangle that was drawn; for tests.
    pub(crate) fn drawn_triangles(&self, drawn: Drawable) -> Vec<[u32; 3]> {
        let Some(Bundle { memory, .. }) = self.shown.as_deref() else { return Vec::new() };
        let (corners, indices) = (memory.corners.values::<CornerGpu>(), memory.indices.values::<u32>());
        let ranges = drawn.ranges().into_iter();
        let triangles =
            ranges.flat_map(|[first, count]| indices[first as usize..][..count as usize].chunks_exact(3));
        let whole = triangles.filter(|t| t[0] != t[1]);
        whole.map(|t| [t[0], t[1], t[2]].map(|c| corners[c as usize].vertex_slot)).collect()
    }

    /// Positions and states of all vertex slots as the last display frame left them. Waits for the GPU; for tests.
    pub(crate) fn read_positions(&self, gpu: &Arc<Gpu>) -> Result<Vec<[f32; 4]>, ClientError> {
        let positions = &self.memory.positions;
        let readback = Buffer::new(gpu, "positions", positions.size(), Memory::Readback)?;
        let mut recorder = gpu.record()?;
        recorder.barrier(Access::COMPUTE_WRITE, Access::COPY_READ);
        recorder.copy_buffer(positions, 0, &readback, 0, positions.size());
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        gpu.wait(recorder.submit()?)?;
        Ok(readback.values::<[f32; 4]>()[..self.memory.vertex_slots as usize].to_vec())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_colour_goes_from_one_picture_to_the_next_by_time() {
        let part = |from, to, time| newest_part([WorldTime(from), WorldTime(to)], WorldTime(time));
        assert_eq!([100, 125, 200].map(|time| part(100, 200, time)), [0.0, 0.25, 1.0]);
        assert_eq!([90, 210].map(|time| part(100, 200, time)), [0.0, 1.0], "it goes no farther");
        // The world stands, or goes back to its beginning.
        assert_eq!([part(100, 100, 100), part(200, 100, 150)], [1.0, 1.0]);
    }
}

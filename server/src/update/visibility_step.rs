//! Steps 2 and 3 of an update: LOD set, vertex samples of the predicted times, visibility passes.
//!
//! Predicted views enter with the placement's demands. A [`Begun`] update leaves: its visibility pass is on the device. [`Seen`] is
//! the result of the pass. Placement answers whether this has room. If not, another pass follows at coarser LODs. A pass for the
//! surround of the head may come last. Blocks, slots and colours are unknown here.

use crate::pacing::relief::{Measure, Measures};
use crate::pacing::room::Room;
use crate::residency::Residency;
use crate::scene::SceneGpu;
use crate::scene::meshes::MeshLod;
use crate::shading::passes::shadow::Casters;
use crate::time::view_time::ViewTime;
use crate::time::{RingPlace, VIEW_TIMES};
use crate::update::ShowOptions;
use crate::update::eye::EyeSize;
use crate::update::policy::{ONLY_THE_FIRST, UpdatePolicy};
use crate::update::views::{ViewsBuffer, first_views};
use crate::visibility::culling::{Culling, Needed, Sight};
use crate::visibility::detail::{Detail, ErrorFactors, LodCost};
use crate::visibility::lod_set::{LodInstance, LodSet};
use crate::visibility::nearness::{Nearness, nearness};
use crate::visibility::passes::extents::{Extents, ExtentsMemory};
use crate::visibility::passes::id_buffer::{IdBuffer, IdBufferMemory, Pass, TriangleNumbers};
use crate::visibility::passes::mark::Mark;
use crate::visibility::passes::spread::Spread;
use crate::visibility::predict::PredictedViews;
use crate::visibility::sweep::{Glance, Sweep};
use crate::world::{SampleTimes, Sampled, ViewerId, World};
use shadecast_gpu::{Access, Gpu, GpuError, Part, Recorder, Ticket, Timings};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::ServerTime;
use shadecast_shaders::generated::SeenGpu;
use std::sync::Arc;

/// Visibility passes of an update's views, each at coarser LODs than the one before. After them patches are left out.
const MAX_VIEW_PASSES: u32 = 3;

/// Owner of everything that sees, for one viewer.
pub(crate) struct VisibilityStep {
    viewer: ViewerId,
    eye: EyeSize,
    policy: Arc<UpdatePolicy>,
    measures: Measures,
    culling: Culling,
    /// Instances needed for what is in view and for the surround.
    needs: Needed,
    /// `None` without a surround.
    around: Option<Around>,
    detail: Detail,
    views: ViewsBuffer,
    /// Turned frusta of each eye; 0: each is drawn as it is.
    turned_frusta: usize,
    /// The times at which the last update had a visibility pass.
    pass_times: [bool; VIEW_TIMES],
    id_buffer: IdBuffer,
    mark: Mark,
    spread: Spread,
    extents: Extents,
    lists: Lists,
    /// The extents that the last pass found.
    seen: Vec<SeenGpu>,
}

/// What it has on the device, in no world.
pub(crate) struct VisibilityMemory {
    views: ViewsBuffer,
    id_buffer: IdBufferMemory,
    mark: Mark,
    spread: Spread,
    extents: ExtentsMemory,
}

/// The sweep around the head.
struct Around {
    sweep: Sweep,
    culling: Culling,
}

/// Lists of one update, in whose memory the next makes its own.
#[derive(Default)]
struct Lists {
    /// How near each instance is.
    nearness: Vec<Nearness>,
    /// The LODs of the update.
    lods: LodSet,
    /// The LODs that are drawn for it.
    drawn: [Vec<LodInstance>; 2],
    /// LODs that are shown at once, for want of room.
    coarser: Vec<LodInstance>,
    /// LODs of the next pass with the rings of patches that are added to them.
    rings: Vec<(LodInstance, u32)>,
}

/// An update as it starts, and the placement's demands on it.
pub(crate) struct Start {
    /// Its number.
    pub update: UpdateId,
    /// When it starts.
    pub time: ServerTime,
    /// Its predicted views.
    pub views: PredictedViews,
    /// Texels for a pixel that extents are measured with.
    pub texels_per_pixel: f32,
    /// Factors on the allowed error of LODs.
    pub error: ErrorFactors,
    /// How much the client can be shown at once.
    pub room: Room,
    /// Bytes of geometry that it may bring.
    pub geometry_bytes: usize,
    /// Memory for the device time of its passes.
    pub timings: Timings,
}

/// An update whose visibility pass is on the device.
pub(crate) struct Begun {
    start: Start,
    glance: Option<Glance>,
    sampled: Sampled,
    aim: Aim,
    pass: VisibilityPass,
}

/// The aim of a visibility pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Aim {
    /// The views of the eyes, for so many times with this one: at coarser LODs each time.
    InView(u32),
    /// The surround of the head.
    Around,
}

/// Whether a client can be shown what a pass has seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Fit {
    /// All of it.
    Fits,
    /// The client's memory is too small.
    LacksRoom,
    /// The update may not bring so many bytes. Coarser LODs are chosen.
    LacksBytes,
}

/// A pass, and its recording.
struct VisibilityPass {
    lods: LodSet,
    ticket: Ticket,
}

/// The result of a pass, for placement.
pub(crate) struct Seen<'a> {
    /// The aim of the pass.
    pub aim: Aim,
    /// Texels for a pixel that extents were measured with.
    pub texels_per_pixel: f32,
    /// The LODs of the pass. Placement switches those whose next LOD the client can show.
    pub lods: &'a mut LodSet,
    /// Extents by entry of `lods`.
    pub seen: &'a [SeenGpu],
    /// The LODs of instances, which hear of each switch.
    pub detail: &'a mut Detail,
}

/// A begun update after its last visibility pass.
pub(crate) struct PlacementInput {
    /// The update.
    pub start: Start,
    /// The samples of its times.
    pub sampled: Sampled,
    /// The LODs that it shows.
    pub lods: LodSet,
}

/// Pairs of views of one pass, and where in the ring their samples are.
#[derive(Clone, Copy)]
struct PassInputs<'a> {
    lods: &'a LodSet,
    /// LODs to draw: each once, and no two of an instance in a scene. The second may be empty.
    scenes: &'a [Vec<LodInstance>; 2],
    places: [RingPlace; VIEW_TIMES],
    sight: &'a Sight,
    times: [bool; VIEW_TIMES],
    turned_frusta: usize,
    /// Both eyes are one.
    one_eye: bool,
}

/// An update that is on display for longer shows surfaces that no predicted view has seen: what moves turns them into view,
/// nanoseconds.
const RARE_NS: i64 = 100_000_000;
/// Meanwhile, rings of patches around those that a view has seen come into view: one for so many nanoseconds, and so many at most. What
/// stands gets one, of what they uncover.
const RING_NS: i64 = 60_000_000;
const MOST_RINGS: i64 = 8;

impl VisibilityMemory {
    /// For eyes of this size in `scene`. Any thread makes it.
    pub(crate) fn new(gpu: &Arc<Gpu>, scene: &SceneGpu, eye: EyeSize) -> Result<Self, GpuError> {
        let id_buffer_extent = eye.id_buffer_extent();
        let views = ViewsBuffer::new(gpu, eye, id_buffer_extent)?;
        let id_buffer = IdBufferMemory::new(gpu, scene, id_buffer_extent, TriangleNumbers::of(gpu))?;
        let mark = Mark::new(gpu, &id_buffer.image, scene.numbering.totals.in_lod_set)?;
        let spread = Spread::new(gpu, scene, &mark.visible)?;
        Ok(Self { views, id_buffer, mark, spread, extents: ExtentsMemory::new(gpu, scene)? })
    }

    /// As it was when it was made. Each pass clears what it draws and counts in.
    pub(crate) fn wipe(&mut self) {
        self.views.wipe();
    }
}

impl VisibilityStep {
    /// For a viewer of `world`, whose client's memory is as it begins.
    pub(crate) fn new(
        world: &World,
        (viewer, eye): (ViewerId, EyeSize),
        show: ShowOptions,
        policy: &Arc<UpdatePolicy>,
        (residency, memory): (&Residency, VisibilityMemory),
    ) -> Result<Self, GpuError> {
        let (scene, animation) = (world.scene(), world.animation());
        let VisibilityMemory { views, id_buffer, mark, spread, extents } = memory;
        let id_buffer = id_buffer.bind(scene, animation, &views.buffer)?;
        let extents = extents.bind(scene, animation, &views.buffer, &mark.visible)?;
        Ok(Self {
            viewer,
            eye,
            policy: policy.clone(),
            measures: Measures::default(),
            culling: culling(scene),
            needs: Needed::none(scene.numbering.instances.len()),
            around: (show.surround > 0.0).then(|| Around::new(scene)),
            detail: Detail::new(show.detail_pixels, eye.pixels_per_radian(), lod_costs(world, residency)),
            views,
            turned_frusta: 0,
            pass_times: [false; VIEW_TIMES],
            id_buffer,
            mark,
            spread,
            extents,
            lists: Lists::default(),
            seen: Vec::new(),
        })
    }

    /// Leaves the world. No submitted work still uses it.
    pub(crate) fn into_memory(self) -> VisibilityMemory {
        let Self { views, id_buffer, mark, spread, extents, .. } = self;
        VisibilityMemory { views, id_buffer: id_buffer.unbind(), mark, spread, extents: extents.unbind() }
    }

    /// Records and submits the samples of an update and its first visibility pass.
    pub(crate) fn begin(&mut self, world: &mut World, start: Start) -> Result<Begun, GpuError> {
        let views = &start.views;
        self.culling.needs(views.eyes.iter().flatten().copied());
        let glance = self.glance_around(views);
        let near: &mut Vec<Nearness> = &mut self.lists.nearness;
        nearness(world.scene(), world.grid(), views, self.eye.pixels_per_radian(), near);
        self.detail.begin((start.room, start.geometry_bytes), &self.needs, near, start.error);
        let mut recorder = world.gpu().record()?;
        let began = world.effort().begin();
        self.needs.set_lods(self.detail.finest());
        let casters = if self.measures.error() > 1.0 { Casters::Coarse } else { Casters::Fine };
        self.pass_times = self.times_of_passes(world, &start);
        let times = SampleTimes { times: views.times, looks: self.pass_times, shaded: views.shaded };
        let sampled = world.animate(&mut recorder, self.viewer, times, (&self.needs, casters)); // 2
        world.effort_mut().add_animation(began);
        self.views.extent = self.ids_extent();
        self.turned_frusta = self.views.write(views, start.update, start.texels_per_pixel);
        let pass = self.submit_view_pass(recorder, world, (&sampled, views))?; // 3
        Ok(Begun { start, glance, sampled, aim: Aim::InView(1), pass })
    }

    /// The result of the pass on the device: waits for it.
    pub(crate) fn see<'a>(&'a mut self, world: &World, begun: &'a mut Begun) -> Result<Seen<'a>, GpuError> {
        let Begun { start, aim, pass, .. } = begun;
        world.gpu().wait_timed_into(pass.ticket, &mut start.timings)?;
        self.extents.read(&mut self.seen);
        Ok(Seen {
            aim: *aim,
            texels_per_pixel: start.texels_per_pixel,
            lods: &mut pass.lods,
            seen: &self.seen,
            detail: &mut self.detail,
        })
    }

    /// Submits the next pass, if there is one: at coarser LODs until what is visible has room, then around the
    /// head.
    pub(crate) fn submit_next_pass(
        &mut self,
        world: &World,
        begun: &mut Begun,
        fit: Fit,
    ) -> Result<bool, GpuError> {
        let Begun { start, glance, sampled, aim, pass } = begun;
        let Aim::InView(number) = aim else { return Ok(false) };
        if fit == Fit::LacksBytes {
            // `Detail` has coarser LODs for the same views.
            *number += 1;
            self.lists.lods = std::mem::take(&mut pass.lods);
            *pass = self.submit_view_pass(world.gpu().record()?, world, (&*sampled, &start.views))?;
            return Ok(true);
        }
        let has_room = fit == Fit::Fits;
        if !has_room && *number < MAX_VIEW_PASSES && self.detail.tighten(start.room) {
            *number += 1;
            self.lists.lods = std::mem::take(&mut pass.lods);
            *pass = self.submit_view_pass(world.gpu().record()?, world, (&*sampled, &start.views))?;
            return Ok(true);
        }
        if !has_room {
            self.switch_at_once(&mut pass.lods);
        }
        let Some(glance) = glance else { return Ok(false) };
        pass.ticket =
            self.submit_surround_pass(world, glance, &pass.lods, (&*sampled, &start.views.times))?;
        *aim = Aim::Around;
        Ok(true)
    }

    /// What updates do without from now on.
    pub(crate) fn set_measures(&mut self, measures: Measures) {
        self.measures = measures;
        self.detail.change_gradually(measures.are_some());
    }

    /// Takes back the LODs of an update, for their memory.
    pub(crate) fn recycle(&mut self, lods: LodSet) {
        self.lists.lods = lods;
    }

    /// LODs of the instances that are needed, in their order.
    pub(crate) fn detail(&self) -> &Detail {
        &self.detail
    }

    /// Pairs of views with a visibility pass in the last update.
    pub(crate) fn pairs(&self) -> usize {
        self.pass_times.iter().filter(|has_pass| **has_pass).count()
    }

    /// Records and submits a visibility pass at the present LODs.
    fn submit_view_pass(
        &mut self,
        recorder: Recorder,
        world: &World,
        (sampled, views): (&Sampled, &PredictedViews),
    ) -> Result<VisibilityPass, GpuError> {
        let mut lods = std::mem::take(&mut self.lists.lods);
        lods.refill(&world.scene().numbering, self.detail.lods());
        let mut drawn = std::mem::take(&mut self.lists.drawn);
        lods.scenes(&mut drawn, |instance| self.culling.needed().has(instance));
        self.lists.rings.clear();
        if are_rare(world, &views.times) {
            self.lists.rings.extend(rings(world, &lods, &views.times));
        }
        let inputs = PassInputs {
            lods: &lods,
            scenes: &drawn,
            places: sampled.places,
            sight: &Sight::of(views.eyes.iter().flatten()),
            times: self.pass_times,
            turned_frusta: self.turned_frusta,
            one_eye: views.eyes.iter().all(|[left, right]| left == right),
        };
        let ticket = self.submit_pass(recorder, world, inputs)?;
        self.lists.drawn = drawn;
        Ok(VisibilityPass { lods, ticket })
    }

    /// Submits a visibility pass in two directions around the head, in view or not. Rare updates have seen few places of the sweep:
    /// a ring adds what lies between the patches that were seen.
    fn submit_surround_pass(
        &mut self,
        world: &World,
        glance: &Glance,
        lods: &LodSet,
        (sampled, times): (&Sampled, &[ViewTime; VIEW_TIMES]),
    ) -> Result<Ticket, GpuError> {
        self.lists.rings.clear();
        if are_rare(world, times) {
            self.lists.rings.extend(lods.shown().map(|lod| (*lod, 1)));
        }
        self.views.write_glance(glance);
        let sight = Sight::of(glance.views.iter());
        let mut drawn = std::mem::take(&mut self.lists.drawn);
        drawn.iter_mut().for_each(Vec::clear);
        drawn[0].extend(lods.shown());
        let places = [sampled.places[VIEW_TIMES / 2]; VIEW_TIMES];
        let (scenes, times) = (&drawn, ONLY_THE_FIRST);
        let inputs =
            PassInputs { lods, scenes, places, sight: &sight, times, turned_frusta: 0, one_eye: false };
        let ticket = self.submit_pass(world.gpu().record()?, world, inputs)?;
        self.lists.drawn = drawn;
        Ok(ticket)
    }

    /// Rasterises views at their times, and measures what is visible.
    fn submit_pass(
        &mut self,
        mut recorder: Recorder,
        world: &World,
        PassInputs { lods, scenes, places, sight, times, turned_frusta, one_eye }: PassInputs<'_>,
    ) -> Result<Ticket, GpuError> {
        let (scene, animation) = (world.scene(), world.animation());
        let within = (self.policy.clusters(world), sight);
        recorder.fill(&self.mark.visible, 0);
        self.extents.record_start(&mut recorder);
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE_WRITE);
        recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
        let part = Part { extent: self.views.extent, first_alone: one_eye };
        for (time, place) in places.into_iter().enumerate().filter(|(time, _)| times[*time]) {
            let [now, next] = scenes;
            let drawn = [Some(now), Some(next).filter(|next| !next.is_empty())];
            let all = drawn.into_iter().flatten();
            let all = all.flat_map(|drawn| first_views(time, turned_frusta).map(move |first| (drawn, first)));
            for (drawn, first_view) in all {
                recorder.scope("id buffer", |r| {
                    let pass = Pass { lods: drawn, place, first_view, part, within };
                    self.id_buffer.record(r, scene, animation, pass);
                });
                recorder.barrier(Access::COLOR_WRITE, Access::COMPUTE_READ);
                recorder.scope("mark", |r| self.mark.record(r, part));
                recorder.barrier(Access::COMPUTE_READ, Access::COLOR_WRITE); // the next one draws over the ID buffer
            }
        }
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE);
        if !self.lists.rings.is_empty() {
            recorder.scope("spread", |r| self.spread.record(r, scene, &self.lists.rings));
        }
        recorder.scope("extents", |r| {
            self.extents.record(r, scene, animation, lods, places);
        });
        recorder.barrier(Access::COMPUTE_WRITE, Access::HOST_READ);
        recorder.submit()
    }

    /// Pixels of the ID buffer that the next views are drawn to.
    fn ids_extent(&self) -> [u32; 2] {
        let whole = self.id_buffer.image().desc().extent;
        match self.measures.has(Measure::FewerIds) {
            true => self.mark.half_of(whole),
            false => whole,
        }
    }

    /// The times that may show something that another does not: one of them where the head and all in view stand still.
    fn times_of_passes(&self, world: &World, Start { update, views, .. }: &Start) -> [bool; VIEW_TIMES] {
        self.policy.pass_times(*update, self.measures, || {
            views.eyes.iter().all(|pair| *pair == views.eyes[0])
                && world.stands(self.culling.needed(), &views.times)
        })
    }

    /// Adds the needs of the surround to those of the view. Returns the glance of this update, if it has one.
    fn glance_around(&mut self, views: &PredictedViews) -> Option<Glance> {
        self.needs.copy(self.culling.needed());
        let around = self.around.as_mut().filter(|_| !self.measures.has(Measure::NoSurround));
        let Around { sweep, culling } = around?;
        let glance = sweep.next(views.world_from_head);
        self.needs.add(culling.needs(glance.iter().flat_map(|glance| glance.views)));
        glance
    }

    /// There is no room for what is seen, not even for a moment beside what is to be shown instead: whatever is to be coarser is
    /// so from now on, and comes in as the other goes.
    fn switch_at_once(&mut self, lods: &mut LodSet) {
        let coarser = &mut self.lists.coarser;
        coarser.clear();
        coarser.extend(lods.coarser());
        for lod in coarser {
            lods.switch(lod.instance);
            self.detail.switched(lod.instance);
        }
    }
}

/// Rings of patches that come into view from the first of these times to the last: of what moves, and one of what it uncovers. An LOD
/// that is to be shown next gets them too, since it must be whole when it is.
fn rings<'a>(
    world: &'a World,
    lods: &'a LodSet,
    times: &'a [ViewTime; VIEW_TIMES],
) -> impl Iterator<Item = (LodInstance, u32)> + 'a {
    let of_motion = (span_ns(world, times) / RING_NS).min(MOST_RINGS) as u32;
    let rings_of = move |instance| if world.instance_stands(instance, times) { 1 } else { of_motion };
    lods.all().iter().map(move |lod| (*lod, rings_of(lod.instance)))
}

/// Whether updates with such times are so far apart that rings are added.
fn are_rare(world: &World, times: &[ViewTime; VIEW_TIMES]) -> bool {
    span_ns(world, times) > RARE_NS
}

/// From the first of an update's predicted times to the last.
fn span_ns(world: &World, times: &[ViewTime; VIEW_TIMES]) -> i64 {
    let [first, .., last] = times.map(|at| at.time(world.grid()));
    last.since(first)
}

impl Begun {
    /// The pass on the device.
    pub(crate) fn ticket(&self) -> Ticket {
        self.pass.ticket
    }

    /// After the last pass.
    pub(crate) fn finish(self) -> PlacementInput {
        let Self { start, sampled, pass: VisibilityPass { lods, .. }, .. } = self;
        PlacementInput { start, sampled, lods }
    }
}

impl Around {
    fn new(scene: &SceneGpu) -> Self {
        Self { sweep: Sweep::default(), culling: Culling::new(&scene.world_bounds, |_| false, None) }
    }
}

/// The instances that the views of a viewer need.
fn culling(scene: &SceneGpu) -> Culling {
    let sun = scene.scene.sun;
    let casts_shadow = |index: usize| scene.scene.instances[index].casts_shadow;
    Culling::new(&scene.world_bounds, casts_shadow, sun.casts_shadows.then_some(sun.to_sun))
}

/// The costs of each LOD of each instance.
fn lod_costs(world: &World, residency: &Residency) -> Vec<Vec<LodCost>> {
    let (scene, geometry) = (world.scene(), world.samples());
    let bytes = |instance: usize, lod: &MeshLod| {
        residency.new_bytes(geometry, instance as u16, (lod.patches.len(), lod.vertices as usize))
    };
    let costs = |instance: usize| {
        let cost = |lod: &MeshLod| LodCost {
            error_m: lod.error_m,
            patches: lod.patches.len() as u32,
            vertices: lod.vertices,
            triangles: lod.triangles,
            bytes: bytes(instance, lod) as u32,
        };
        scene.mesh(instance).lods.iter().map(cost).collect()
    };
    (0..scene.numbering.instances.len()).map(costs).collect()
}

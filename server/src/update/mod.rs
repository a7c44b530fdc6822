//! One update for one viewer, from the head's pose to what is sent: the design's steps 1 to 9 on one page, with the barriers
//! between the stages. What does not depend on who looks is the [`World`]'s.

pub mod ideal;

use crate::atlas::capacity::{Notice, Shortage};
use crate::atlas::layout::{Layout, Visible};
use crate::atlas::placement::PlacementChange;
use crate::encode::Source;
use crate::motion::delta::{UpdateDelta, UpdateStamp};
use crate::motion::predictions::predictions;
use crate::motion::skinning::Skinning;
use crate::motion::steps::wanted_steps_m;
use crate::pacing::density::{Density, Spare};
use crate::pacing::gate::Budget;
use crate::pacing::overlap::Flight;
use crate::pacing::room::Room;
use crate::residency::{Allowance, Residency};
use crate::scene::SceneGpu;
use crate::scene::meshes::MeshLevel;
use crate::scene::numbering::{ScenePatch, Totals};
use crate::scene::views::predicted_view_gpu;
use crate::shading::passes::shading::Shading;
use crate::shading::passes::ycbcr::Ycbcr;
use crate::shading::reuse::{Moment, Reuse, Reused};
use crate::skinning::gpu::{Animation, check_room as check_saved};
use crate::skinning::passes::palette::BONE_BYTES;
use crate::support::pool::Pool;
use crate::support::upload::check_room;
use crate::time::RingPlace;
use crate::time::VIEW_TIMES;
use crate::update::ideal::Ideal;
use crate::visibility::clusters::Clusters;
use crate::visibility::culling::{Culling, Needed, Sight};
use crate::visibility::detail::{Detail, LevelCost};
use crate::visibility::frusta::{Frusta, Frustum, MIN_MARGIN, widened};
use crate::visibility::lod_set::{Look, Looks};
use crate::visibility::nearness::pixels_per_metre;
use crate::visibility::passes::id_buffer::{IdBuffer, Pass, shift_ndc};
use crate::visibility::passes::level_selection::LevelSelection;
use crate::visibility::passes::mark::Mark;
use crate::visibility::predict::{HeadTrack, PredictedViews, View};
use crate::visibility::sweep::{Glance, Sweep};
use crate::world::moment::Stance;
use crate::world::{Sampled, ViewerId, World};
use glam::{Mat4, Vec3};
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Image, Memory, Recorder, Ticket, Timings};
use shadecast_protocol::delta::EncodedDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::limits::{ATLAS_MAX_EXTENT, MAX_VIEWS};
use shadecast_protocol::message::{Capabilities, Displayed, HeadState, Welcome};
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::ServerTime;
use shadecast_shaders::constants::{EYES, ID_BUFFER_VIEWS};
use shadecast_shaders::generated::{SeenGpu, ViewGpu};
use std::collections::VecDeque;
use std::time::Duration;

/// Updates remembered until their display is reported.
const REMEMBERED_UPDATES: usize = 256;
/// Pixels of the ID buffer, each eye: as many as the largest atlas has texels. Two images of 4 bytes a pixel and eye.
const MAX_ID_BUFFER_PIXELS: u32 = ATLAS_MAX_EXTENT[0] * ATLAS_MAX_EXTENT[1];
/// Pixels of a side of the ID buffer: every device draws to as many.
const MAX_ID_BUFFER_SIDE: f32 = 8192.0;

const ONLY_THE_FIRST: [bool; VIEW_TIMES] = [true, false, false];

/// Times that an update looks at the scene, at coarser levels each time, before it leaves patches out.
const MAX_LOOKS: u32 = 3;

/// The pipeline of one viewer.
pub struct Frame {
    id: ViewerId,
    eye: EyeSize,
    head: HeadTrack,
    culling: Culling,
    /// What is needed for what is in view and for the surround.
    needs: Needed,
    /// What looks around; `None` without a surround.
    around: Option<Around>,
    detail: Detail,
    density: Density,
    spare_bits: Spare,
    views: Buffer,
    /// In how many turned frusta each eye is looked at; 0: as it is.
    turned: usize,
    /// The times that the last update looked at.
    looked_at: [bool; VIEW_TIMES],
    id_buffer: IdBuffer,
    mark: Mark,
    level_selection: LevelSelection,
    lists: Lists,
    /// What the last look saw.
    seen: Vec<SeenGpu>,
    layout: Layout,
    /// What the last update placed otherwise than the one before.
    changes: Vec<PlacementChange>,
    residency: Residency,
    room: Room,
    shortage: Shortage,
    shading: Shading,
    reuse: Reuse<Stance>,
    /// What an update may shade beside new blocks.
    shading_budget_texels: u64,
    ycbcr: Ycbcr,
    /// Memory for the pictures and the timings of updates that come.
    pictures: Pool<I420>,
    timings: Pool<Timings>,
    ideal: Ideal,
    next: UpdateId,
    update_times: VecDeque<(UpdateId, ServerTime)>,
    begun: Option<Begun>,
    placed: Option<Placed>,
    in_work: Option<InWork>,
}

/// Lists of one update, in whose memory the next makes its own.
#[derive(Default)]
struct Lists {
    /// How much larger than a metre a pixel is, by instance.
    pixels_per_metre: Vec<f32>,
    /// What is looked at.
    looks: Looks,
    /// What is drawn for it.
    drawn: [Vec<Look>; 2],
    /// What is to be shown next of it.
    next: Vec<Look>,
    /// The patches that are shown, with their instance.
    shown: Vec<(usize, ScenePatch)>,
    /// What of that the client can be brought.
    left: Allowance,
}

/// An update whose visibility is on the device.
struct Begun {
    now: ServerTime,
    views: PredictedViews,
    glance: Option<Glance>,
    sampled: Sampled,
    look: Seeing,
    aim: Aim,
    /// Of what the device has done for it.
    timings: Timings,
}

/// What an update looks at.
#[derive(Clone, Copy)]
enum Aim {
    /// The views of the eyes, for so many times with this one: at coarser levels of detail each time.
    InView(u32),
    /// What is around the head.
    Around,
}

/// What is looked at, and the recording that does.
struct Seeing {
    looks: Looks,
    ticket: Ticket,
}

/// An update of which the client can be told all but the colours.
struct Placed {
    views: PredictedViews,
    sampled: Sampled,
    /// Without its picture.
    shaded: Shaded,
}

/// An update whose blocks are shaded by the device.
struct InWork {
    shaded: Shaded,
    ticket: Ticket,
}

/// The client's eyes, for densities.
#[derive(Clone, Copy, Debug)]
struct EyeSize {
    extent_pixels: [u32; 2],
    fovs: [Fov; 2],
}

/// How much of the scene a viewer is shown, and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShowOptions {
    /// Pixels of the display that a level of detail may err by where bits and time suffice; 0: everything has full detail.
    pub detail_pixels: f32,
    /// Part of the client's slots and of the atlas for what an abrupt head could see, 0..1; 0: none.
    pub surround: f32,
}

/// What looks around.
struct Around {
    sweep: Sweep,
    culling: Culling,
}

/// Pairs of views that the scene is looked at from, and where in the ring what they see is.
#[derive(Clone, Copy)]
struct Looking<'a> {
    looks: &'a Looks,
    /// What is drawn: each once, and none of them twice in a scene. The second may be empty.
    scenes: &'a [Vec<Look>; 2],
    places: [RingPlace; VIEW_TIMES],
    /// From where.
    sight: &'a Sight,
    /// At which of them.
    times: [bool; VIEW_TIMES],
    /// In how many turned frusta; 0: as they are.
    turned: usize,
}

/// What an update shows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shows {
    /// Patches.
    pub patches: u32,
    /// Triangles that are drawn for them: those of two sides twice.
    pub triangles: u32,
    /// Levels of detail of the instances that are needed, in their order.
    pub levels: Vec<usize>,
    /// Pixels of error that a level may have.
    pub detail_pixels: f32,
    /// Texels that blocks are asked to have for a pixel of the display, before sides are rounded up.
    pub texels_per_pixel: f32,
    /// Pairs of views that the scene was looked at from.
    pub pairs: usize,
    /// What was shaded, and what was not.
    pub reused: Reused,
    /// Texels of the atlas that were converted for the encoder.
    pub converted_texels: u64,
}

/// One update, shaded and ready to be encoded.
#[derive(Clone, Debug)]
pub struct Shaded {
    /// The update.
    pub update: UpdateId,
    /// When it started.
    pub time: ServerTime,
    /// What changes in the client's memory.
    pub delta: UpdateDelta,
    /// The atlas; of no texels while an encoder has it.
    pub picture: Source,
    /// What its stages took on the device.
    pub timings: Timings,
}

impl Frame {
    /// For a viewer of `world` that agreed to `welcome` and has told its `capabilities`.
    pub fn new(
        world: &World,
        id: ViewerId,
        welcome: &Welcome,
        capabilities: &Capabilities,
        show: ShowOptions,
    ) -> Result<Self, GpuError> {
        Self::with_ideal(world, id, welcome, capabilities, show, Ideal::default())
    }

    /// The same, spared what a measurement leaves out.
    pub fn with_ideal(
        world: &World,
        id: ViewerId,
        welcome: &Welcome,
        capabilities: &Capabilities,
        show: ShowOptions,
        ideal: Ideal,
    ) -> Result<Self, GpuError> {
        let (gpu, scene, animation) = (world.gpu(), world.scene(), &world.animation);
        let eye = EyeSize::of(capabilities);
        let views = Buffer::new(
            gpu,
            "views",
            u64::from(ID_BUFFER_VIEWS) * size_of::<ViewGpu>() as u64,
            Memory::Upload,
        )?;
        let id_buffer = IdBuffer::new(gpu, scene, animation, &views, eye.id_buffer_extent())?;
        let mark = Mark::new(gpu, &id_buffer.image, scene.numbering.totals.looked_at)?;
        let level_selection = LevelSelection::new(gpu, scene, animation, &views, &mark.visible)?;
        let shading =
            Shading::new(gpu, scene, animation, &world.shadow, welcome.atlas_extent_texels, ideal.filter)?;
        let ycbcr = Ycbcr::new(gpu, &shading.atlas, scene.has_masks())?;
        let room = Room {
            patches: welcome.patch_slots.min(Layout::most_blocks(welcome.atlas_extent_texels)),
            vertices: welcome.vertex_slots,
            triangles: capabilities.max_triangles,
        };
        Ok(Self {
            lists: Lists::default(),
            seen: Vec::new(),
            changes: Vec::new(),
            needs: Needed::none(scene.numbering.instances.len()),
            layout: Layout::new(welcome.atlas_extent_texels, scene.numbering.totals.patches as usize)
                .with_surround(show.surround),
            residency: Residency::new(&world.samples, welcome.patch_slots, welcome.vertex_slots)
                .with_skinning(Skinning::new(scene, world.timeline(), welcome.motion), welcome.motion),
            room,
            shortage: Shortage::default(),
            id,
            eye,
            head: HeadTrack::new(capabilities.display_period_ns),
            culling: culling(scene),
            around: (show.surround > 0.0).then(|| Around::new(scene)),
            detail: Detail::new(show.detail_pixels, level_costs(scene)),
            density: Density::default(),
            spare_bits: Spare::Enough,
            views,
            turned: 0,
            looked_at: [false; VIEW_TIMES],
            id_buffer,
            mark,
            level_selection,
            shading,
            reuse: Reuse::new(ideal.reuse),
            shading_budget_texels: u64::MAX,
            ycbcr,
            pictures: Pool::default(),
            timings: Pool::default(),
            ideal,
            next: UpdateId(0),
            update_times: VecDeque::new(),
            begun: None,
            placed: None,
            in_work: None,
        })
    }

    /// Who looks.
    pub fn id(&self) -> ViewerId {
        self.id
    }

    /// The client's head, as reported.
    pub fn head(&mut self, state: HeadState) {
        self.head.head(state);
    }

    /// Updates pause or go on: how long the last one stays on display says nothing about the way.
    pub fn interrupted(&mut self) {
        self.head.interrupted();
    }

    /// The client shows an update: frees slots, and teaches the prediction how long the way is.
    pub fn displayed(&mut self, report: &Displayed) {
        self.residency.displayed(report.update);
        while self.update_times.front().is_some_and(|(frame, _)| *frame < report.update) {
            self.update_times.pop_front();
        }
        if let Some((frame, started)) = self.update_times.front().copied()
            && frame == report.update
        {
            self.update_times.pop_front();
            self.head.displayed(started, report.display_time);
        }
    }

    /// What each update may take on the wire from now on.
    pub fn set_budget(&mut self, budget: Budget) {
        self.residency.set_budget(budget);
    }

    /// Whether bits and time are left over by the updates that it makes.
    pub fn set_spare(&mut self, spare: Spare) {
        self.spare_bits = spare;
    }

    /// How many texels an update may shade from now on, beside those of new blocks.
    pub fn set_shading_budget(&mut self, texels: u64) {
        self.shading_budget_texels = texels;
    }

    /// What the last update shaded, and what it did not have to.
    pub fn reused(&self) -> Reused {
        self.reuse.reused()
    }

    /// Part of the blocks' texels that was not shaded again, over all updates, 0..1.
    pub fn reused_share(&self) -> f32 {
        self.reuse.total_share()
    }

    /// An update that is not needed any more: its memory is used for those that come.
    pub fn recycle(&mut self, shaded: Shaded) {
        let Shaded { delta, picture: Source::Planes(picture), timings, .. } = shaded;
        self.residency.recycle(delta);
        self.pictures.give(picture);
        self.timings.give(timings);
    }

    /// Steps 1 to 6 and 8, one after the other. `None` before the first head state: there is nowhere to look from.
    pub fn update(&mut self, world: &mut World, now: ServerTime) -> Result<Option<Shaded>, GpuError> {
        if !self.begin(world, now)? {
            return Ok(None);
        }
        self.place(world)?;
        self.shade(world)?;
        self.collect(world)
    }

    /// Steps 1 to 3 up to the device, which nobody waits for: it shades an update that is placed after them. False before the
    /// first head state. The update before that was collected.
    pub fn begin(&mut self, world: &mut World, now: ServerTime) -> Result<bool, GpuError> {
        let (clock, wider) = (world.clock(), self.ideal.views.margin());
        let Some(views) = self.head.predict(now, &clock, world.grid(), wider) else { return Ok(false) }; // 1
        // What the next update does to world and layout is not for this one.
        let placed = self.record_shading(world)?;
        self.culling.needs(views.eyes.iter().flatten().copied());
        let glance = self.look_for_surround(&views);
        let near: &mut Vec<f32> = &mut self.lists.pixels_per_metre;
        pixels_per_metre(world.scene(), world.grid(), &views, self.eye.pixels_per_radian(), near);
        self.detail.begin(self.room, &self.needs, near, self.density.error());
        let mut recorder = world.gpu().record()?;
        let began = world.effort.begin();
        self.needs.set_levels(self.detail.finest());
        let sampled: Sampled = world.animate(&mut recorder, self.id, &views, &self.needs); // 2
        world.effort.add_animation(began);
        self.write_views(&views);
        self.looked_at = self.times_to_look_at(world, &views);
        let look: Seeing = self.look_again(recorder, world, (&sampled, &views))?; // 3
        let mut timings = self.timings.take();
        timings.clear();
        self.begun = Some(Begun { now, views, glance, sampled, look, aim: Aim::InView(1), timings });
        self.submit_shading(placed)?;
        Ok(true)
    }

    /// Steps 4, 5 and 8 of what was begun: waits for what the device has seen.
    pub fn place(&mut self, world: &mut World) -> Result<(), GpuError> {
        while self.begun.is_some() {
            self.place_seen(world)?;
        }
        Ok(())
    }

    /// The same as far as it goes without another look, which is before the device then; waits for the one that is.
    pub fn place_seen(&mut self, world: &mut World) -> Result<(), GpuError> {
        let Some(mut begun) = self.begun.take() else { return Ok(()) };
        world.gpu().wait_timed_into(begun.look.ticket, &mut begun.timings)?;
        self.level_selection.read(&mut self.seen);
        if self.looks_again(world, &mut begun)? {
            self.begun = Some(begun);
            return Ok(());
        }
        let Begun { now, views, sampled, look: Seeing { looks, .. }, timings, .. } = begun;
        let mut changes: Vec<PlacementChange> = std::mem::take(&mut self.changes);
        self.layout.place(&world.samples, &looks, self.room, &mut changes); // 4, 5
        self.lists.looks = looks;
        self.density.note(self.spare_bits, self.layout.settled_share(), self.layout.density() < 1.0);
        let began = world.effort.begin();
        let delta: UpdateDelta = self.tell(world, &views, &changes); // 8
        world.effort.add_delta(began);
        self.changes = changes;
        self.report_shortage();
        let update = self.begin_next(now);
        let shaded = Shaded { update, time: now, delta, picture: Source::default(), timings };
        self.placed = Some(Placed { views, sampled, shaded });
        Ok(())
    }

    /// Step 6 of what is placed, up to the device, which nobody waits for. The update before was collected.
    pub fn shade(&mut self, world: &mut World) -> Result<(), GpuError> {
        let placed = self.record_shading(world)?;
        self.submit_shading(placed)
    }

    /// What the device has shaded, or shades by now: waits for it. `None` where there is nothing.
    pub fn collect(&mut self, world: &World) -> Result<Option<Shaded>, GpuError> {
        let Some(InWork { mut shaded, ticket }) = self.in_work.take() else { return Ok(None) };
        world.gpu().wait_timed_into(ticket, &mut shaded.timings)?;
        let blocks = shaded.delta.masked.iter();
        let covered = blocks.map(|(slot, block)| (*slot, self.ycbcr.coverage(*block)));
        shaded.delta.geometry.coverage.extend(covered.filter(|(_, coverage)| !coverage.is_whole()));
        let mut picture = self.pictures.take();
        self.ycbcr.read(&mut picture);
        shaded.picture = Source::Planes(picture);
        Ok(Some(shaded))
    }

    /// How far the updates in flight have come.
    pub fn flight(&self, world: &World) -> Result<Flight, GpuError> {
        let is_done = |ticket: Option<Ticket>| ticket.map_or(Ok(false), |ticket| world.gpu().is_done(ticket));
        let [look, shading] = self.tickets();
        Ok(Flight {
            is_begun: look.is_some(),
            is_seen: is_done(look)?,
            is_placed: self.placed.is_some(),
            is_in_work: shading.is_some(),
            is_shaded: is_done(shading)?,
            is_alone: !world.is_shared(),
        })
    }

    /// Waits until the device has come further with what is in flight, at most so long; false where it has nothing to do.
    pub fn rest(&self, world: &World, at_most: Duration) -> Result<bool, GpuError> {
        for ticket in self.tickets().into_iter().flatten() {
            if world.gpu().wait_at_most(ticket, at_most)? {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Of the look and of the shading that are before the device.
    fn tickets(&self) -> [Option<Ticket>; 2] {
        [self.begun.as_ref().map(|begun| begun.look.ticket), self.in_work.as_ref().map(|work| work.ticket)]
    }

    /// The viewer goes. Whatever was in flight is left, once the device reads no more of the world for it.
    pub fn leave(self, world: &mut World) {
        for ticket in self.tickets().into_iter().flatten() {
            let _ = world.gpu().wait(ticket); // a lost device reads nothing either
        }
        world.leave(self.id);
    }

    /// What the client must learn, of vertices as they are seen from `views`.
    fn tell(&mut self, world: &World, views: &PredictedViews, changes: &[PlacementChange]) -> UpdateDelta {
        let (scene, eyes) = (world.scene(), views.eyes.iter().flatten());
        let wanted_m = wanted_steps_m(&scene.world_bounds, eyes, self.eye.pixels_per_radian());
        self.residency.want_steps(wanted_m);
        self.residency.put_behind(self.layout.around().map(|(patch, _)| patch));
        let stamp = UpdateStamp { update: self.next, time: views.begun };
        let mut delta = self.residency.update(&world.samples, changes, stamp);
        if self.residency.predicts() {
            delta.geometry.predictions =
                predictions(scene, world.timeline(), views.begun, self.residency.moving());
        }
        delta
    }

    /// The bytes of an update's delta, in the order of updates.
    pub fn encode(&self, delta: &UpdateDelta) -> EncodedDelta {
        self.residency.encode(delta)
    }

    /// The update that is being made has been; gives it.
    fn begin_next(&mut self, now: ServerTime) -> UpdateId {
        let made = self.next;
        self.next = made.next();
        self.update_times.push_back((made, now));
        if self.update_times.len() > REMEMBERED_UPDATES {
            self.update_times.pop_front();
        }
        made
    }

    /// Records and submits a look at the levels of detail as they are.
    fn look_again(
        &mut self,
        recorder: Recorder,
        world: &World,
        (sampled, views): (&Sampled, &PredictedViews),
    ) -> Result<Seeing, GpuError> {
        let mut looks = std::mem::take(&mut self.lists.looks);
        looks.refill(&world.scene().numbering, self.detail.levels());
        let mut drawn = std::mem::take(&mut self.lists.drawn);
        looks.scenes(&mut drawn, |instance| self.culling.needed().has(instance));
        let looking = Looking {
            looks: &looks,
            scenes: &drawn,
            places: sampled.places,
            sight: &Sight::of(views.eyes.iter().flatten()),
            times: self.looked_at,
            turned: self.turned,
        };
        let ticket = self.look_at(recorder, world, looking)?;
        self.lists.drawn = drawn;
        Ok(Seeing { looks, ticket })
    }

    /// Takes in what was seen, and submits the look that comes after it, if one does: at coarser levels of detail until what is
    /// visible has room, then around the head.
    fn looks_again(&mut self, world: &World, begun: &mut Begun) -> Result<bool, GpuError> {
        let Begun { views, glance, sampled, look, aim, .. } = begun;
        match aim {
            Aim::InView(number) => {
                if !self.see_in_view(world, *number, &mut look.looks) {
                    *number += 1;
                    self.lists.looks = std::mem::take(&mut look.looks);
                    *look = self.look_again(world.gpu().record()?, world, (&*sampled, &*views))?;
                    return Ok(true);
                }
                let Some(glance) = glance else { return Ok(false) };
                look.ticket = self.look_around(world, glance, &look.looks, sampled)?;
                *aim = Aim::Around;
                Ok(true)
            }
            Aim::Around => {
                let (residency, geometry) = (&self.residency, &world.samples);
                let may_be = |instance: usize| residency.is_told_once(geometry, instance as u16);
                self.layout.see_around(Visible { looks: &look.looks, seen: &self.seen }, may_be);
                Ok(false)
            }
        }
    }

    /// Takes in what the views of the eyes see, for so many times; whether it is to be shown so.
    fn see_in_view(&mut self, world: &World, number: u32, looks: &mut Looks) -> bool {
        if number == 1 {
            self.layout.begin(self.asked_texels_per_pixel());
        }
        self.layout.see(Visible { looks, seen: &self.seen });
        self.switch(world, looks);
        self.measure(looks);
        if self.layout.has_room(&world.samples, looks, self.room) {
            return true;
        }
        let is_last = number == MAX_LOOKS || !self.detail.tighten(self.room);
        if is_last {
            self.switch_at_once(looks);
        }
        is_last
    }

    /// At which times there may be something to be seen that is not at another: at one where the head and all in view stand still.
    fn times_to_look_at(&self, world: &World, views: &PredictedViews) -> [bool; VIEW_TIMES] {
        let stands = self.ideal.looks_once
            && views.eyes.iter().all(|pair| *pair == views.eyes[0])
            && world.stands(self.culling.needed(), &views.times);
        if stands { ONLY_THE_FIRST } else { self.ideal.views.times(self.next.0) }
    }

    /// Adds what is needed for the surround to what is in view; gives where to look for it, if this update does.
    fn look_for_surround(&mut self, views: &PredictedViews) -> Option<Glance> {
        self.needs.copy(self.culling.needed());
        let Around { sweep, culling } = self.around.as_mut()?;
        let glance = sweep.next(views.world_from_head);
        self.needs.add(culling.needs(glance.iter().flat_map(|glance| glance.views)));
        glance
    }

    /// Submits a look at what two directions around the head show, whether it is in view or not.
    fn look_around(
        &mut self,
        world: &World,
        glance: &Glance,
        looks: &Looks,
        sampled: &Sampled,
    ) -> Result<Ticket, GpuError> {
        self.write_glance(glance);
        let sight = Sight::of(glance.views.iter());
        let mut drawn = std::mem::take(&mut self.lists.drawn);
        drawn.iter_mut().for_each(Vec::clear);
        drawn[0].extend(looks.shown());
        let places = [sampled.places[VIEW_TIMES / 2]; VIEW_TIMES];
        let looking =
            Looking { looks, scenes: &drawn, places, sight: &sight, times: ONLY_THE_FIRST, turned: 0 };
        let ticket = self.look_at(world.gpu().record()?, world, looking)?;
        self.lists.drawn = drawn;
        Ok(ticket)
    }

    /// Rasterises views at their times, and measures what is visible.
    fn look_at(
        &mut self,
        mut recorder: Recorder,
        world: &World,
        Looking { looks, scenes, places, sight, times, turned }: Looking<'_>,
    ) -> Result<Ticket, GpuError> {
        let (scene, animation) = (world.scene(), &world.animation);
        let unknown = Clusters::default();
        let clusters = if self.ideal.clusters { &world.clusters } else { &unknown };
        recorder.fill(&self.mark.visible, 0);
        self.level_selection.record_start(&mut recorder);
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE_WRITE);
        recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
        for (time, place) in places.into_iter().enumerate().filter(|(time, _)| times[*time]) {
            let [now, next] = scenes;
            let drawn = [Some(now), Some(next).filter(|next| !next.is_empty())];
            let all = drawn.into_iter().flatten();
            let all = all.flat_map(|drawn| pairs(time, turned).map(move |first_view| (drawn, first_view)));
            for (drawn, first_view) in all {
                recorder.scope("id buffer", |r| {
                    let pass = Pass { looked_at: drawn, place, first_view, within: (clusters, sight) };
                    self.id_buffer.record(r, scene, animation, pass);
                });
                recorder.barrier(Access::COLOR_WRITE, Access::COMPUTE_READ);
                recorder.scope("mark", |r| self.mark.record(r));
                recorder.barrier(Access::COMPUTE_READ, Access::COLOR_WRITE); // the next one draws over the ID buffer
            }
        }
        recorder.barrier(Access::COMPUTE_WRITE, Access::COMPUTE_READ);
        recorder.scope("level selection", |r| {
            self.level_selection.record(r, scene, animation, looks, places);
        });
        recorder.barrier(Access::COMPUTE_WRITE, Access::HOST_READ);
        recorder.submit()
    }

    /// Lets the client show the next level of those instances of which it has all that is seen, or gets it with this update. Of
    /// the others, the one that lacks least is brought ahead.
    fn switch(&mut self, world: &World, looks: &mut Looks) {
        let (geometry, layout) = (&world.samples, &self.layout);
        let Lists { next, shown, left, .. } = &mut self.lists;
        next.clear();
        next.extend(looks.next());
        shown.clear();
        if next.is_empty() {
            return self.residency.bring_ahead(&[]);
        }
        shown.extend(layout.shown(looks));
        self.residency.allow(left);
        let waits = |instance: usize| next.iter().any(|look| look.instance == instance);
        let stays = shown.iter().filter(|(instance, _)| !waits(*instance)).map(|(_, patch)| *patch);
        self.residency.reserve_what_fits(geometry, stays, left);
        let mut least: Option<&[ScenePatch]> = None;
        for look in next.iter() {
            let seen = layout.seen_of(look);
            if self.residency.reserve(geometry, seen.iter().copied(), left) {
                looks.switch(look.instance);
                self.detail.switched(look.instance);
                continue;
            }
            let stays = shown.iter().filter(|(instance, _)| *instance == look.instance);
            self.residency.reserve_what_fits(geometry, stays.map(|(_, patch)| *patch), left);
            let lacking = |patches: &[ScenePatch]| self.residency.lacking(patches);
            least = Some(least.filter(|least| lacking(least) <= lacking(seen)).unwrap_or(seen));
        }
        self.residency.bring_ahead(least.unwrap_or_default());
    }

    /// There is no room for what is seen, not even for a moment beside what is to be shown instead: whatever is to be coarser is
    /// so from now on, and comes in as the other goes.
    fn switch_at_once(&mut self, looks: &mut Looks) {
        let next = &mut self.lists.next;
        next.clear();
        next.extend(looks.coarser());
        for look in next {
            looks.switch(look.instance);
            self.detail.switched(look.instance);
        }
    }

    /// How much of each level that is shown was seen.
    fn measure(&mut self, looks: &Looks) {
        for look in looks.shown() {
            self.detail.measured(look.instance, self.layout.seen_of(look).len() as u32);
        }
    }

    /// Hands what was recorded of an update's shading to the device.
    fn submit_shading(&mut self, placed: Option<(Recorder, Shaded)>) -> Result<(), GpuError> {
        let Some((recorder, shaded)) = placed else { return Ok(()) };
        self.in_work = Some(InWork { shaded, ticket: recorder.submit_beside()? });
        Ok(())
    }

    /// Fills the blocks whose inputs have changed as they are in the middle of the update's time on display, and converts them.
    fn record_shading(&mut self, world: &mut World) -> Result<Option<(Recorder, Shaded)>, GpuError> {
        let Some(Placed { views, sampled, shaded }) = self.placed.take() else { return Ok(None) };
        assert!(self.in_work.is_none(), "the device still reads the lists of the update before");
        let (middle, place) = (views.times[VIEW_TIMES / 2], sampled.places[VIEW_TIMES / 2]);
        let mut recorder = world.gpu().record()?;
        let time = match self.ideal.shading_times.get(&shaded.update) {
            Some(time) => {
                world.light_at(&mut recorder, place, *time);
                *time
            }
            None => {
                world.light(&mut recorder, middle, place);
                middle.time(world.grid())
            }
        };
        let (surfaces, placed) = (world.surfaces(time, place), self.layout.all_placed());
        let moment = |now: &mut Moment<Stance>| world.moment(time, now);
        let due =
            self.reuse.due(moment, views.world_from_head, placed, &surfaces, self.shading_budget_texels);
        let blocks = due.iter().map(|due| (due.patch, due.block));
        self.shading.write_blocks(world.scene(), &world.animation, place, blocks);
        self.ycbcr.note_changed(due.iter().map(|due| due.block));
        self.ycbcr.write_cells(self.layout.cell_extents());
        recorder.barrier(Access::COMPUTE_READ, Access::COLOR_WRITE); // the last conversion has read the atlas
        let pixels_per_tangent = self.eye.pixels_per_tangent();
        recorder.scope("shading", |r| self.shading.record(r, views.world_from_head, pixels_per_tangent));
        recorder.barrier(Access::COLOR_WRITE, Access::COMPUTE_READ);
        recorder.scope("ycbcr", |r| self.ycbcr.record(r));
        Ok(Some((recorder, shaded)))
    }

    /// Texels for a pixel that extents are measured with.
    fn asked_texels_per_pixel(&self) -> f32 {
        self.density.texels_per_pixel() * self.ideal.texels_per_pixel
    }

    fn write_views(&mut self, views: &PredictedViews) {
        let texels_per_pixel = self.asked_texels_per_pixel();
        let eyes = || views.eyes.iter().flat_map(|pair| pair.iter().enumerate()).enumerate();
        self.turned = eyes().map(|(_, (_, view))| Frusta::of(view.fov).turned()).max().unwrap_or(0);
        for (index, (side, view)) in eyes() {
            let shift_ndc = self.shift_ndc(self.next.0, index as u32, MAX_VIEWS);
            let shown = self.eye.fovs[side];
            let texels = self.eye.pixels_per_tangent_of(shown).map(|pixels| pixels * texels_per_pixel);
            self.write_view(index, view, shift_ndc, (shown, texels));
            let frusta = Frusta::of(view.fov);
            for number in 0..self.turned {
                let index = MAX_VIEWS as usize * (1 + number) + index;
                self.write_view(index, &turned(view, frusta.at(number)), shift_ndc, (shown, texels));
            }
        }
    }

    /// The two views of a glance, in place of all pairs: an extent is the largest of all.
    fn write_glance(&mut self, glance: &Glance) {
        for index in 0..MAX_VIEWS {
            let side = index % EYES;
            let view = &glance.views[side as usize];
            let shift_ndc = self.shift_ndc(glance.number, side, EYES);
            let pixels = self.eye.pixels_per_tangent_of(self.eye.fovs[side as usize]);
            self.write_view(index as usize, view, shift_ndc, (view.fov, pixels));
        }
    }

    /// Where the samples of one of so many views lie in a round of updates.
    fn shift_ndc(&self, number: u32, view: u32, views: u32) -> [f32; 2] {
        shift_ndc(number, view, views, self.id_buffer.image.desc().extent.map(|side| side as f32))
    }

    /// Tells the shaders of a view; `shown`: what the display shows of it, with how many texels a tangent.
    fn write_view(&mut self, index: usize, view: &View, [x, y]: [f32; 2], shown: (Fov, [f32; 2])) {
        let shift = Mat4::from_translation(Vec3::new(x, y, 0.0));
        let clip_from_world = shift * view.fov.clip_from_eye() * view.world_from_eye.inverse().matrix();
        let gpu =
            predicted_view_gpu(clip_from_world, view.world_from_eye.position, view.fov, shown.0, shown.1);
        self.views.write(index * size_of::<ViewGpu>(), bytemuck::bytes_of(&gpu));
    }

    /// Which patch has which block.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// The atlas of the last update, as shaders read it.
    pub fn atlas(&self) -> &Image {
        &self.shading.atlas
    }

    /// The client's memory.
    pub fn residency(&self) -> &Residency {
        &self.residency
    }

    /// Patches in view that were not shown, for want of a block or of a free slot, summed over all updates.
    pub fn dropped_patches(&self) -> u64 {
        self.shortage.total()
    }

    /// What the last update shows.
    pub fn shows(&self, world: &World) -> Shows {
        let drawn = || self.layout.live().chain(self.layout.around()).map(|(patch, _)| patch);
        let levels: Vec<usize> = self.detail.levels().flatten().map(|levels| levels.shown).collect();
        Shows {
            patches: drawn().count() as u32,
            triangles: drawn().map(|patch| world.scene().patch(patch).drawn_triangles()).sum(),
            levels,
            detail_pixels: self.detail.allowed_pixels(),
            texels_per_pixel: self.density.texels_per_pixel() * self.layout.density(),
            pairs: self.looked_at.iter().filter(|looks| **looks).count(),
            reused: self.reuse.reused(),
            converted_texels: self.ycbcr.converted_texels(),
        }
    }

    fn report_shortage(&mut self) {
        match self.shortage.update(self.layout.dropped() + self.residency.waiting()) {
            Some(Notice::Begins(count)) => tracing::warn!(
                "{count} patches in view are not shown, those smallest on screen: the client holds {} patches and {} vertices at most",
                self.room.patches,
                self.room.vertices
            ),
            Some(Notice::Ends(worst)) => {
                tracing::warn!(
                    "all patches in view are shown again; {worst} were missing in the worst update"
                );
            }
            None => {}
        }
    }

    /// How the head moves and how long the way to the display is.
    pub fn head_track(&self) -> &HeadTrack {
        &self.head
    }
}

/// Of each pair of views that the ID buffer is drawn from at this time, the first: of the predicted views themselves, from which
/// extents are measured, or of so many turned ones in place of them.
fn pairs(time: usize, turned: usize) -> impl Iterator<Item = u32> + Clone {
    let groups = if turned == 0 { 0..=0 } else { 1..=turned as u32 };
    groups.map(move |group| MAX_VIEWS * group + EYES * time as u32)
}

fn turned(view: &View, Frustum { eye_from_frustum, fov }: Frustum) -> View {
    let eye_from_view = Pose { position: Vec3::ZERO, orientation: eye_from_frustum };
    View { world_from_eye: view.world_from_eye.then(eye_from_view), fov }
}

/// Of the whole width and height.
fn span_tangents(fov: Fov) -> [f32; 2] {
    [fov.right.tan() - fov.left.tan(), fov.up.tan() - fov.down.tan()]
}

impl EyeSize {
    fn of(capabilities: &Capabilities) -> Self {
        Self { extent_pixels: capabilities.eye_extent_pixels, fovs: capabilities.eyes.map(|eye| eye.fov) }
    }

    /// In the middle of the picture, along the denser side of the denser eye.
    fn pixels_per_radian(&self) -> f32 {
        self.pixels_per_tangent().into_iter().fold(0.0, f32::max)
    }

    /// Pixels of the picture across which the tangent of the view angle grows by 1, x and y, of the denser eye.
    fn pixels_per_tangent(&self) -> [f32; 2] {
        let eyes = self.fovs.map(|fov| self.pixels_per_tangent_of(fov));
        [0, 1].map(|axis| eyes[0][axis].max(eyes[1][axis]))
    }

    /// The same of an eye with this field of view.
    fn pixels_per_tangent_of(&self, fov: Fov) -> [f32; 2] {
        let [width, height] = span_tangents(fov);
        [self.extent_pixels[0] as f32 / width, self.extent_pixels[1] as f32 / height]
    }

    /// Pixels that all frusta of an eye with this field of view can be seen with.
    fn extent_of(&self, fov: Fov) -> [f32; 2] {
        let frusta = Frusta::of(widened(fov, MIN_MARGIN));
        let extents =
            frusta.all().iter().map(|frustum| frustum.extent_pixels(fov, self.pixels_per_tangent_of(fov)));
        extents.fold([0.0, 0.0], |most, extent| [0, 1].map(|axis: usize| most[axis].max(extent[axis])))
    }

    /// Large enough for the widest field of view that a steady head needs; a wider one is seen more coarsely, and so is one
    /// that would need more than [`MAX_ID_BUFFER_PIXELS`].
    fn id_buffer_extent(&self) -> [u32; 2] {
        let widest = self.fovs.map(|fov| self.extent_of(fov));
        let side = |axis: usize| widest[0][axis].max(widest[1][axis]);
        let sides =
            [side(0), side(1)].map(|side| if side > 1.0 { side.min(MAX_ID_BUFFER_SIDE) } else { 1.0 });
        let most = MAX_ID_BUFFER_PIXELS as f32;
        // Each side by the same factor; a long and narrow buffer is bounded by its sides already.
        let scale = (most / (sides[0] * sides[1])).sqrt().min(1.0);
        sides.map(|side| ((side * scale).ceil() as u32).next_multiple_of(8))
    }
}

/// What each level of detail of each instance costs.
fn level_costs(scene: &SceneGpu) -> Vec<Vec<LevelCost>> {
    let cost = |level: &MeshLevel| LevelCost {
        error_m: level.error_m,
        patches: level.patches.len() as u32,
        vertices: level.vertices,
        triangles: level.triangles,
    };
    let instances = 0..scene.numbering.instances.len();
    instances.map(|instance| scene.mesh(instance).levels.iter().map(cost).collect()).collect()
}

impl Around {
    fn new(scene: &SceneGpu) -> Self {
        Self { sweep: Sweep::default(), culling: Culling::new(&scene.world_bounds, |_| false, None) }
    }
}

/// Which instances the views of a viewer need.
fn culling(scene: &SceneGpu) -> Culling {
    let sun = scene.scene.sun;
    let casts_shadow = |index: usize| scene.scene.instances[index].casts_shadow;
    Culling::new(&scene.world_bounds, casts_shadow, sun.casts_shadows.then_some(sun.to_sun))
}

/// That the device can hold what updates of this scene need.
///
/// # Errors
/// It cannot; the text names what is too large, what the device binds, and what to do.
pub fn check_device(gpu: &Gpu, scene: &SceneGpu) -> Result<(), GpuError> {
    check_saved(scene)?;
    let needs = needs(scene.numbering.totals, Animation::places_for(scene));
    needs.into_iter().try_for_each(|(what, bytes)| check_room(gpu, what, bytes))
}

/// What the stages bind at once, in bytes, as far as it grows with the scene.
fn needs(totals: Totals, times: u32) -> [(&'static str, u64); 3] {
    let of_all_times = |count: u32| u64::from(times) * u64::from(count) * BONE_BYTES;
    [
        ("bones of all instances and sample times", of_all_times(totals.bones)),
        ("palettes of all instances and sample times", of_all_times(totals.palette)),
        ("patches of all instances", u64::from(totals.looked_at) * size_of::<u32>() as u64),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn eye(extent_pixels: [u32; 2], left: f32, right: f32) -> EyeSize {
        EyeSize { extent_pixels, fovs: [Fov { left, right, up: right, down: left }; 2] }
    }

    #[test]
    fn a_usual_eye_has_an_id_buffer_of_its_own_density() {
        let [width, height] = eye([1024, 1024], -0.785, 0.785).id_buffer_extent();
        assert!((1130..1152).contains(&width) && width == height, "{width}x{height}");
    }

    #[test]
    fn the_id_buffer_is_bounded_whatever_a_client_says_of_its_eyes() {
        let angles = [-1.55f32, -1.2, -0.7, -0.02, -1e-40, 0.0, 1e-40, 0.02, 0.7, 1.2, 1.55, f32::NAN];
        for (left, right) in angles.into_iter().flat_map(|left| angles.map(|right| (left, right))) {
            for extent in [[1, 1], [8192, 8192], [1, 8192], [8192, 1]] {
                let [width, height] = eye(extent, left, right).id_buffer_extent();
                let pixels = u64::from(width) * u64::from(height);
                let most = u64::from(MAX_ID_BUFFER_PIXELS) + 8 * 2 * MAX_ID_BUFFER_SIDE as u64;
                assert!(
                    width > 0 && height > 0 && pixels <= most,
                    "{left} {right} {extent:?}: {width}x{height}"
                );
            }
        }
    }

    #[test]
    fn what_a_scene_needs_of_the_device_is_known_before_a_client_comes() {
        let dragons = |count: u32| Totals { bones: count * 60, palette: count * 60, ..Totals::default() };
        let most = |count| needs(dragons(count), 4).into_iter().map(|(_, bytes)| bytes).max();
        assert!(most(169) < Some(128 << 20), "the paper's largest scene fits what every device binds");
        assert!(most(20_000) > Some(128 << 20));
    }
}

//! Steps 4, 5 and 8 of an update: blocks for the patches that were seen, slots in the client's memory, and the delta.
//!
//! The result of a visibility pass enters ([`Seen`]). The answer whether it has room leaves, and after the last pass the delta.
//! Views of the device and colours are unknown here.

use crate::atlas::capacity::{Notice, Shortage};
use crate::atlas::layout::{Layout, Visible};
use crate::atlas::placement::PlacementChange;
use crate::motion::delta::{UpdateDelta, UpdateStamp};
use crate::motion::predictions::predictions;
use crate::motion::skinning::Skinning;
use crate::motion::steps::wanted_steps_m;
use crate::pacing::density::{Density, Filled, Spare};
use crate::pacing::relief::{Measure, Measures};
use crate::pacing::room::Room;
use crate::residency::{Allowance, Residency};
use crate::scene::geometry::Geometry;
use crate::scene::numbering::ScenePatch;
use crate::shading::reuse::Reuse;
use crate::update::eye::EyeSize;
use crate::update::policy::UpdatePolicy;
use crate::update::visibility_step::{Aim, Fit, PlacementInput, Seen};
use crate::visibility::detail::{Detail, ErrorFactors};
use crate::visibility::lod_set::{LodInstance, LodSet};
use crate::visibility::predict::PredictedViews;
use crate::world::moment::Stance;
use crate::world::{Site, World};
use shadecast_protocol::geometry::Settled;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::Welcome;
use std::sync::Arc;

/// Owner of the atlas layout and of the client's memory, for one viewer.
pub(crate) struct PlacementStep {
    eye: EyeSize,
    policy: Arc<UpdatePolicy>,
    layout: Layout,
    /// Differences of the last update's placement to the one before.
    changes: Vec<PlacementChange>,
    /// The client's memory.
    pub residency: Residency,
    room: Room,
    shortage: Shortage,
    density: Density,
    spare: Spare,
    measures: Measures,
    lists: Lists,
}

/// Lists of one update, in whose memory the next makes its own.
#[derive(Default)]
struct Lists {
    /// The LODs to be shown next.
    next: Vec<LodInstance>,
    /// The patches that are shown, with their instance.
    shown: Vec<(usize, ScenePatch)>,
    /// The rest that the client can be brought.
    left: Allowance,
    /// Bytes that the client lacks of what is shown, by instance.
    lacking: Vec<(usize, usize)>,
}

/// Half the texels of a block, along a side.
const FEWER_TEXELS: f32 = std::f32::consts::FRAC_1_SQRT_2;
/// On a slow device new blocks begin with this part of the texels for a pixel: else many that come at once take long.
const NEW_PART: f32 = 0.35;
/// Of the bytes of geometry that an update may take, the part that blocks which settle may, and about what each takes.
const SETTLED_PART: usize = 8;
const SETTLED_BYTES: usize = 7;
/// On a slow device LODs change with an update for this part of what is seen, and for the instance that makes it so much.
const SWITCHED_PART: u64 = 16;
/// Part of what is seen that may be missing until the next update, before coarser LODs are shown.
const MOST_MISSING: f64 = 0.003;

impl PlacementStep {
    /// For a client with so much room. `surround`: part of the room for what an abrupt head could see.
    pub(crate) fn new(
        Site { scene, timeline, .. }: &Site,
        eye: EyeSize,
        welcome: &Welcome,
        (room, surround): (Room, f32),
        policy: &Arc<UpdatePolicy>,
    ) -> Self {
        let counts = [scene.numbering.totals.patches, scene.numbering.totals.vertices];
        Self {
            eye,
            policy: policy.clone(),
            layout: Layout::new(welcome.atlas_extent_texels, scene.numbering.totals.patches as usize)
                .with_surround(surround)
                .with_store(welcome.store_pages),
            changes: Vec::new(),
            residency: Residency::new(counts, welcome.patch_slots, welcome.vertex_slots)
                .with_atlas(welcome.atlas_extent_texels)
                .with_store(welcome.store_pages)
                .with_skinning(Skinning::new(scene, timeline, welcome.motion), welcome.motion),
            room,
            shortage: Shortage::default(),
            density: Density::default(),
            spare: Spare::Enough,
            measures: Measures::default(),
            lists: Lists::default(),
        }
    }

    /// Whether updates leave bits and time over.
    pub(crate) fn set_spare(&mut self, spare: Spare) {
        self.spare = spare;
    }

    /// Texels that an update may shade from now on, beside new blocks. On a slow device, blocks with another size have a part of these:
    /// a large one is as many texels as thousands of small ones.
    pub(crate) fn set_shading_budget(&mut self, texels: u64) {
        self.layout.resize_by(self.measures.resized(texels));
    }

    /// What updates do without from now on.
    pub(crate) fn set_measures(&mut self, measures: Measures) {
        self.measures = measures;
        self.layout.begin_blocks_with(if measures.are_some() { NEW_PART } else { 1.0 });
    }

    /// Texels for a pixel that extents are measured with.
    pub(crate) fn asked_texels_per_pixel(&self) -> f32 {
        self.wanted_texels_per_pixel() * self.policy.texels_per_pixel
    }

    /// Factors on the allowed error of LODs.
    pub(crate) fn error(&self) -> ErrorFactors {
        ErrorFactors { density: self.density.error(), measures: self.measures.error() }
    }

    /// Texels that blocks are asked to have for a pixel of the display, before sides are rounded up.
    pub(crate) fn texels_per_pixel(&self) -> f32 {
        self.wanted_texels_per_pixel() * self.layout.density()
    }

    fn wanted_texels_per_pixel(&self) -> f32 {
        let part = if self.measures.has(Measure::FewerTexels) { FEWER_TEXELS } else { 1.0 };
        part * self.density.texels_per_pixel()
    }

    /// The block of each patch.
    pub(crate) fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Patches in view without a block or a free slot, summed over all updates.
    pub(crate) fn dropped_patches(&self) -> u64 {
        self.shortage.total()
    }

    /// How much the client can be shown at once.
    pub(crate) fn room(&self) -> Room {
        self.room
    }

    /// Takes in the result of a visibility pass. Returns whether the client can be shown all of it.
    pub(crate) fn see(&mut self, world: &World, seen: Seen<'_>) -> Fit {
        let Seen { aim, texels_per_pixel, lods, seen, detail } = seen;
        if aim == Aim::Around {
            let (residency, geometry) = (&self.residency, world.samples());
            let may_be = |instance: usize| residency.is_told_once(geometry, instance as u16);
            self.layout.see_around(Visible { lods, seen }, may_be);
            return Fit::Fits;
        }
        if aim == Aim::InView(1) {
            self.layout.begin(texels_per_pixel);
        }
        self.layout.see(Visible { lods, seen });
        if aim == Aim::InView(1) && self.gives_way(world, lods, detail) {
            return Fit::LacksBytes;
        }
        self.switch(world, lods, detail);
        self.measure(lods, detail);
        if self.layout.has_room(world.samples(), lods, self.room) { Fit::Fits } else { Fit::LacksRoom }
    }

    /// Whether so much of what is shown is missing, and more than the update may bring, that coarser LODs are to be shown: a whole
    /// coarse surface before a part of a fine one.
    fn gives_way(&mut self, world: &World, lods: &LodSet, detail: &mut Detail) -> bool {
        let geometry = world.samples();
        self.residency.allow(&mut self.lists.left);
        if self.lists.left.is_unlimited() {
            return false;
        }
        self.measure(lods, detail);
        let Lists { left, lacking, .. } = &mut self.lists;
        lacking.clear();
        let (mut seen_texels, mut missing_texels) = (0u64, 0u64);
        for (instance, patch) in self.layout.shown(lods) {
            let texels = self.layout.seen_texels(patch);
            seen_texels += texels;
            let bytes = self.residency.entry_bytes(geometry, patch);
            if !self.residency.reserve(geometry, [patch], left) {
                missing_texels += texels;
            }
            match lacking.last_mut() {
                _ if bytes == 0 => {}
                Some((last, sum)) if *last == instance => *sum += bytes,
                _ => lacking.push((instance, bytes)),
            }
        }
        missing_texels as f64 > MOST_MISSING * seen_texels as f64 && detail.give_way(lacking)
    }

    /// Places what was seen. Returns what the client must learn.
    pub(crate) fn place(
        &mut self,
        world: &mut World,
        PlacementInput { start, lods, .. }: &PlacementInput,
    ) -> UpdateDelta {
        let mut changes: Vec<PlacementChange> = std::mem::take(&mut self.changes);
        self.layout.look_from(start.views.world_from_head);
        self.layout.place(world.samples(), lods, (self.room, start.update), &mut changes); // 4, 5
        let filled = Filled {
            share: self.layout.settled_share(),
            is_full: self.layout.density() < 1.0,
            most_growth: self.layout.most_growth(),
        };
        self.density.note(self.spare, filled);
        let began = world.effort().begin();
        let mut delta = self.delta(world, start.update, &start.views, &changes); // 8
        self.settle(world, start.update, &mut delta);
        world.effort_mut().add_delta(began);
        self.changes = changes;
        self.report_shortage();
        delta
    }

    /// Lets the client show the next LOD of those instances of which it has all that is seen, or gets it with this update. Of
    /// the others, the one that lacks least is brought ahead.
    fn switch(&mut self, world: &World, lods: &mut LodSet, detail: &mut Detail) {
        let (geometry, layout) = (world.samples(), &self.layout);
        let Lists { next, shown, left, .. } = &mut self.lists;
        next.clear();
        next.extend(lods.next());
        shown.clear();
        if next.is_empty() {
            return self.residency.bring_ahead(&[]);
        }
        shown.extend(layout.shown(lods));
        self.residency.allow(left);
        let waits = |instance: usize| next.iter().any(|lod| lod.instance == instance);
        let stays = shown.iter().filter(|(instance, _)| !waits(*instance)).map(|(_, patch)| *patch);
        self.residency.reserve_what_fits(geometry, stays, left);
        let mut least: Option<&[ScenePatch]> = None;
        let texels =
            |patches: &[ScenePatch]| patches.iter().map(|patch| layout.seen_texels(*patch)).sum::<u64>();
        // All blocks of another LOD are new: where that takes too long, a few instances at a time.
        let most_texels = match self.measures.are_some() {
            true => {
                1 + shown.iter().map(|(_, patch)| layout.seen_texels(*patch)).sum::<u64>() / SWITCHED_PART
            }
            false => u64::MAX,
        };
        let mut switched_texels = 0;
        for lod in next.iter() {
            let seen = layout.seen_of(lod);
            if switched_texels < most_texels && self.residency.reserve(geometry, seen.iter().copied(), left) {
                switched_texels += texels(seen);
                lods.switch(lod.instance);
                detail.switched(lod.instance);
                continue;
            }
            let stays = shown.iter().filter(|(instance, _)| *instance == lod.instance);
            self.residency.reserve_what_fits(geometry, stays.map(|(_, patch)| *patch), left);
            let lacking = |patches: &[ScenePatch]| self.residency.lacking(patches);
            least = Some(least.filter(|least| lacking(least) <= lacking(seen)).unwrap_or(seen));
        }
        self.residency.bring_ahead(least.unwrap_or_default());
    }

    /// Measures how much of each LOD that is shown was seen.
    fn measure(&self, lods: &LodSet, detail: &mut Detail) {
        for lod in lods.shown() {
            detail.measured(lod.instance, self.layout.seen_of(lod).len() as u32);
        }
    }

    /// The delta of an update, with vertices as they are seen from `views`.
    fn delta(
        &mut self,
        world: &World,
        update: UpdateId,
        views: &PredictedViews,
        changes: &[PlacementChange],
    ) -> UpdateDelta {
        let (scene, eyes) = (world.scene(), views.eyes.iter().flatten());
        let wanted_m = wanted_steps_m(&scene.world_bounds, eyes, self.eye.pixels_per_radian());
        self.residency.want_steps(wanted_m);
        let around = self.layout.all_placed().filter(|placed| placed.is_around);
        self.residency.put_behind(around.map(|placed| placed.patch));
        let stamp = UpdateStamp { update, time: views.begun };
        let mut delta = self.residency.update(world.samples(), changes, stamp);
        if self.residency.predicts() {
            delta.geometry.predictions =
                predictions(scene, world.timeline(), views.begun, self.residency.moving());
        }
        delta
    }

    /// Lets blocks settle whose surfaces neither move nor are cut out. A slow link has few bytes for that: they would delay what is new.
    fn settle(&mut self, world: &World, update: UpdateId, delta: &mut UpdateDelta) {
        let (geometry, residency) = (world.samples(), &self.residency);
        let stands = |patch: ScenePatch| {
            let first = geometry.first_vertex(geometry.instance_of_patch(patch));
            geometry.static_position(first).is_some() && !geometry.is_masked(patch)
        };
        let may = |patch: ScenePatch| residency.slot_with_block(patch).is_some() && stands(patch);
        let settled = &mut delta.geometry.settled;
        let put = |patch, to, pixel| {
            settled.extend(residency.slot_with_block(patch).map(|slot| Settled { slot, to, pixel }));
        };
        let most_blocks = residency.budget_bytes() / SETTLED_PART / SETTLED_BYTES;
        self.layout.settle((update, most_blocks), may, put);
        settled.sort_unstable_by_key(|settled| settled.slot);
    }

    /// An update shaded this and found that stale.
    pub(crate) fn shaded(&mut self, update: UpdateId, reuse: &Reuse<Stance>) {
        let store = self.layout.store_mut();
        reuse.shaded().iter().for_each(|due| store.shaded(due.patch, update));
        reuse.stale().for_each(|patch| store.stale(patch));
    }

    /// An update's picture is coded with this quantiser.
    pub(crate) fn coded(&mut self, update: UpdateId, qp: u8) {
        self.layout.store_mut().coded(update, qp);
    }

    /// Pictures of updates later than `after` were lost.
    pub(crate) fn lost_after(&mut self, after: Option<UpdateId>) {
        self.layout.store_mut().lost_after(after);
    }

    /// The client shows no update before this one any more.
    pub(crate) fn displayed(&mut self, update: UpdateId) {
        self.residency.displayed(update);
        self.layout.store_mut().displayed(update);
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
}

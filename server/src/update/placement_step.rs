//! Steps 4, 5 and 8 of an update: blocks for the patches that were seen, slots in the client's memory, and the delta.
//!
//! What a look has [`Seen`] enters. The answer whether it has room leaves, and after the last look the delta. Views of the device,
//! passes and colours are unknown here.

use crate::atlas::capacity::{Notice, Shortage};
use crate::atlas::layout::{Layout, Visible};
use crate::atlas::placement::PlacementChange;
use crate::motion::delta::{UpdateDelta, UpdateStamp};
use crate::motion::predictions::predictions;
use crate::motion::skinning::Skinning;
use crate::motion::steps::wanted_steps_m;
use crate::pacing::density::{Density, Spare};
use crate::pacing::room::Room;
use crate::residency::{Allowance, Residency};
use crate::scene::numbering::ScenePatch;
use crate::update::eye::EyeSize;
use crate::update::policy::UpdatePolicy;
use crate::update::visibility_step::{Aim, Looked, Seen};
use crate::visibility::detail::Detail;
use crate::visibility::lod_set::{Look, Looks};
use crate::visibility::predict::PredictedViews;
use crate::world::World;
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
    lists: Lists,
}

/// Lists of one update, in whose memory the next makes its own.
#[derive(Default)]
struct Lists {
    /// The levels to be shown next.
    next: Vec<Look>,
    /// The patches that are shown, with their instance.
    shown: Vec<(usize, ScenePatch)>,
    /// The rest that the client can be brought.
    left: Allowance,
}

impl PlacementStep {
    /// For a client with so much room. `surround`: part of the room for what an abrupt head could see.
    pub fn new(
        world: &World,
        eye: EyeSize,
        welcome: &Welcome,
        (room, surround): (Room, f32),
        policy: &Arc<UpdatePolicy>,
    ) -> Self {
        let scene = world.scene();
        Self {
            eye,
            policy: policy.clone(),
            layout: Layout::new(welcome.atlas_extent_texels, scene.numbering.totals.patches as usize)
                .with_surround(surround),
            changes: Vec::new(),
            residency: Residency::new(world.samples(), welcome.patch_slots, welcome.vertex_slots)
                .with_skinning(Skinning::new(scene, world.timeline(), welcome.motion), welcome.motion),
            room,
            shortage: Shortage::default(),
            density: Density::default(),
            spare: Spare::Enough,
            lists: Lists::default(),
        }
    }

    /// Whether updates leave bits and time over.
    pub(crate) fn set_spare(&mut self, spare: Spare) {
        self.spare = spare;
    }

    /// Texels for a pixel that extents are measured with.
    pub(crate) fn asked_texels_per_pixel(&self) -> f32 {
        self.density.texels_per_pixel() * self.policy.texels_per_pixel
    }

    /// Factor on the allowed error of levels of detail.
    pub fn error(&self) -> f32 {
        self.density.error()
    }

    /// Texels that blocks are asked to have for a pixel of the display, before sides are rounded up.
    pub fn texels_per_pixel(&self) -> f32 {
        self.density.texels_per_pixel() * self.layout.density()
    }

    /// The block of each patch.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Patches in view without a block or a free slot, summed over all updates.
    pub fn dropped_patches(&self) -> u64 {
        self.shortage.total()
    }

    /// How much the client can be shown at once.
    pub fn room(&self) -> Room {
        self.room
    }

    /// Takes in the result of a look. Returns whether there is room for all of it.
    pub fn see(&mut self, world: &World, seen: Seen<'_>) -> bool {
        let Seen { aim, texels_per_pixel, looks, seen, detail } = seen;
        if aim == Aim::Around {
            let (residency, geometry) = (&self.residency, world.samples());
            let may_be = |instance: usize| residency.is_told_once(geometry, instance as u16);
            self.layout.see_around(Visible { looks, seen }, may_be);
            return true;
        }
        if aim == Aim::InView(1) {
            self.layout.begin(texels_per_pixel);
        }
        self.layout.see(Visible { looks, seen });
        self.switch(world, looks, detail);
        self.measure(looks, detail);
        self.layout.has_room(world.samples(), looks, self.room)
    }

    /// Places what was seen. Returns what the client must learn.
    pub fn place(&mut self, world: &mut World, Looked { start, looks, .. }: &Looked) -> UpdateDelta {
        let mut changes: Vec<PlacementChange> = std::mem::take(&mut self.changes);
        self.layout.place(world.samples(), looks, self.room, &mut changes); // 4, 5
        self.density.note(self.spare, self.layout.settled_share(), self.layout.density() < 1.0);
        let began = world.effort().begin();
        let delta = self.delta(world, start.update, &start.views, &changes); // 8
        world.effort_mut().add_delta(began);
        self.changes = changes;
        self.report_shortage();
        delta
    }

    /// Lets the client show the next level of those instances of which it has all that is seen, or gets it with this update. Of
    /// the others, the one that lacks least is brought ahead.
    fn switch(&mut self, world: &World, looks: &mut Looks, detail: &mut Detail) {
        let (geometry, layout) = (world.samples(), &self.layout);
        let Lists { next, shown, left } = &mut self.lists;
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
                detail.switched(look.instance);
                continue;
            }
            let stays = shown.iter().filter(|(instance, _)| *instance == look.instance);
            self.residency.reserve_what_fits(geometry, stays.map(|(_, patch)| *patch), left);
            let lacking = |patches: &[ScenePatch]| self.residency.lacking(patches);
            least = Some(least.filter(|least| lacking(least) <= lacking(seen)).unwrap_or(seen));
        }
        self.residency.bring_ahead(least.unwrap_or_default());
    }

    /// Measures how much of each level that is shown was seen.
    fn measure(&self, looks: &Looks, detail: &mut Detail) {
        for look in looks.shown() {
            detail.measured(look.instance, self.layout.seen_of(look).len() as u32);
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
        self.residency.put_behind(self.layout.around().map(|(patch, _)| patch));
        let stamp = UpdateStamp { update, time: views.begun };
        let mut delta = self.residency.update(world.samples(), changes, stamp);
        if self.residency.predicts() {
            delta.geometry.predictions =
                predictions(scene, world.timeline(), views.begun, self.residency.moving());
        }
        delta
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

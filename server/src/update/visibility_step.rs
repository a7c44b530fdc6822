//! Steps 2 and 3 of an update: the levels of detail to look at, the samples of the predicted times, and looks at them.
//!
//! Predicted views enter with the placement's demands. A [`Begun`] update leaves, whose look is before the device, then what that
//! look has [`Seen`]. Placement answers whether this has room: if not, another look follows at coarser levels. A look around the
//! head may come last. Blocks, slots and colours are unknown here.

use crate::pacing::room::Room;
use crate::scene::SceneGpu;
use crate::scene::meshes::MeshLevel;
use crate::time::{RingPlace, VIEW_TIMES};
use crate::update::ShowOptions;
use crate::update::eye::EyeSize;
use crate::update::policy::{ONLY_THE_FIRST, UpdatePolicy};
use crate::update::views::{ViewsBuffer, first_views};
use crate::visibility::culling::{Culling, Needed, Sight};
use crate::visibility::detail::{Detail, LevelCost};
use crate::visibility::lod_set::{Look, Looks};
use crate::visibility::nearness::pixels_per_metre;
use crate::visibility::passes::id_buffer::{IdBuffer, Pass};
use crate::visibility::passes::level_selection::LevelSelection;
use crate::visibility::passes::mark::Mark;
use crate::visibility::predict::PredictedViews;
use crate::visibility::sweep::{Glance, Sweep};
use crate::world::{Sampled, ViewerId, World};
use shadecast_gpu::{Access, GpuError, Recorder, Ticket, Timings};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::ServerTime;
use shadecast_shaders::generated::SeenGpu;
use std::sync::Arc;

/// Looks of an update at its views, each at coarser levels than the one before, until patches are left out.
const MAX_LOOKS: u32 = 3;

/// Owner of everything that looks, for one viewer.
pub(crate) struct VisibilityStep {
    viewer: ViewerId,
    eye: EyeSize,
    policy: Arc<UpdatePolicy>,
    culling: Culling,
    /// Instances needed for what is in view and for the surround.
    needs: Needed,
    /// `None` without a surround.
    around: Option<Around>,
    detail: Detail,
    views: ViewsBuffer,
    /// Turned frusta of each eye; 0: each is drawn as it is.
    turned_frusta: usize,
    /// The times that the last update looked at.
    looked_at: [bool; VIEW_TIMES],
    id_buffer: IdBuffer,
    mark: Mark,
    level_selection: LevelSelection,
    lists: Lists,
    /// The extents that the last look found.
    seen: Vec<SeenGpu>,
}

/// The sweep around the head.
struct Around {
    sweep: Sweep,
    culling: Culling,
}

/// Lists of one update, in whose memory the next makes its own.
#[derive(Default)]
struct Lists {
    /// Pixels per metre of each instance.
    pixels_per_metre: Vec<f32>,
    /// The levels to look at.
    looks: Looks,
    /// The levels that are drawn for it.
    drawn: [Vec<Look>; 2],
    /// Levels that are shown at once, for want of room.
    coarser: Vec<Look>,
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
    /// Factor on the allowed error of levels of detail.
    pub error: f32,
    /// How much the client can be shown at once.
    pub room: Room,
    /// Memory for the device time of its looks.
    pub timings: Timings,
}

/// An update whose look is before the device.
pub(crate) struct Begun {
    start: Start,
    glance: Option<Glance>,
    sampled: Sampled,
    aim: Aim,
    look: Seeing,
}

/// The aim of a look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Aim {
    /// The views of the eyes, for so many times with this one: at coarser levels of detail each time.
    InView(u32),
    /// The surround of the head.
    Around,
}

/// A look, and its recording.
struct Seeing {
    looks: Looks,
    ticket: Ticket,
}

/// The result of a look, for placement.
pub struct Seen<'a> {
    /// The aim of the look.
    pub aim: Aim,
    /// Texels for a pixel that extents were measured with.
    pub texels_per_pixel: f32,
    /// The levels looked at. Placement switches those whose next level the client can show.
    pub looks: &'a mut Looks,
    /// Extents by entry of `looks`.
    pub seen: &'a [SeenGpu],
    /// The levels of instances, which hear of each switch.
    pub detail: &'a mut Detail,
}

/// A begun update after its last look.
pub(crate) struct Looked {
    /// The update.
    pub start: Start,
    /// The samples of its times.
    pub sampled: Sampled,
    /// The levels of detail that it shows.
    pub looks: Looks,
}

/// Pairs of views of one look, and where in the ring their samples are.
#[derive(Clone, Copy)]
struct Looking<'a> {
    looks: &'a Looks,
    /// Levels to draw: each once, and no two of an instance in a scene. The second may be empty.
    scenes: &'a [Vec<Look>; 2],
    places: [RingPlace; VIEW_TIMES],
    sight: &'a Sight,
    times: [bool; VIEW_TIMES],
    turned_frusta: usize,
}

impl VisibilityStep {
    /// For a viewer of `world`.
    pub fn new(
        world: &World,
        (viewer, eye): (ViewerId, EyeSize),
        show: ShowOptions,
        policy: &Arc<UpdatePolicy>,
    ) -> Result<Self, GpuError> {
        let (gpu, scene, animation) = (world.gpu(), world.scene(), world.animation());
        let id_buffer_extent = eye.id_buffer_extent();
        let views = ViewsBuffer::new(gpu, eye, id_buffer_extent)?;
        let id_buffer = IdBuffer::new(gpu, scene, animation, &views.buffer, id_buffer_extent)?;
        let mark = Mark::new(gpu, &id_buffer.image, scene.numbering.totals.looked_at)?;
        let level_selection = LevelSelection::new(gpu, scene, animation, &views.buffer, &mark.visible)?;
        Ok(Self {
            viewer,
            eye,
            policy: policy.clone(),
            culling: culling(scene),
            needs: Needed::none(scene.numbering.instances.len()),
            around: (show.surround > 0.0).then(|| Around::new(scene)),
            detail: Detail::new(show.detail_pixels, level_costs(scene)),
            views,
            turned_frusta: 0,
            looked_at: [false; VIEW_TIMES],
            id_buffer,
            mark,
            level_selection,
            lists: Lists::default(),
            seen: Vec::new(),
        })
    }

    /// Records and submits the samples of an update and its first look.
    pub fn begin(&mut self, world: &mut World, start: Start) -> Result<Begun, GpuError> {
        let views = &start.views;
        self.culling.needs(views.eyes.iter().flatten().copied());
        let glance = self.look_for_surround(views);
        let near: &mut Vec<f32> = &mut self.lists.pixels_per_metre;
        pixels_per_metre(world.scene(), world.grid(), views, self.eye.pixels_per_radian(), near);
        self.detail.begin(start.room, &self.needs, near, start.error);
        let mut recorder = world.gpu().record()?;
        let began = world.effort().begin();
        self.needs.set_levels(self.detail.finest());
        let sampled = world.animate(&mut recorder, self.viewer, views, &self.needs); // 2
        world.effort_mut().add_animation(began);
        self.turned_frusta = self.views.write(views, start.update, start.texels_per_pixel);
        self.looked_at = self.times_to_look_at(world, &start);
        let look = self.look_again(recorder, world, (&sampled, views))?; // 3
        Ok(Begun { start, glance, sampled, aim: Aim::InView(1), look })
    }

    /// The result of the look that is before the device: waits for it.
    pub fn see<'a>(&'a mut self, world: &World, begun: &'a mut Begun) -> Result<Seen<'a>, GpuError> {
        let Begun { start, aim, look, .. } = begun;
        world.gpu().wait_timed_into(look.ticket, &mut start.timings)?;
        self.level_selection.read(&mut self.seen);
        Ok(Seen {
            aim: *aim,
            texels_per_pixel: start.texels_per_pixel,
            looks: &mut look.looks,
            seen: &self.seen,
            detail: &mut self.detail,
        })
    }

    /// Submits the look that follows, if one does: at coarser levels of detail until what is visible has room, then around the
    /// head.
    pub(crate) fn looks_again(
        &mut self,
        world: &World,
        begun: &mut Begun,
        has_room: bool,
    ) -> Result<bool, GpuError> {
        let Begun { start, glance, sampled, aim, look } = begun;
        let Aim::InView(number) = aim else { return Ok(false) };
        if !has_room && *number < MAX_LOOKS && self.detail.tighten(start.room) {
            *number += 1;
            self.lists.looks = std::mem::take(&mut look.looks);
            *look = self.look_again(world.gpu().record()?, world, (&*sampled, &start.views))?;
            return Ok(true);
        }
        if !has_room {
            self.switch_at_once(&mut look.looks);
        }
        let Some(glance) = glance else { return Ok(false) };
        look.ticket = self.look_around(world, glance, &look.looks, sampled)?;
        *aim = Aim::Around;
        Ok(true)
    }

    /// Takes back the levels of an update, for their memory.
    pub fn recycle(&mut self, looks: Looks) {
        self.lists.looks = looks;
    }

    /// Levels of the instances that are needed, in their order.
    pub fn detail(&self) -> &Detail {
        &self.detail
    }

    /// Pairs of views that the last update looked at.
    pub fn pairs(&self) -> usize {
        self.looked_at.iter().filter(|looks| **looks).count()
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
            turned_frusta: self.turned_frusta,
        };
        let ticket = self.look_at(recorder, world, looking)?;
        self.lists.drawn = drawn;
        Ok(Seeing { looks, ticket })
    }

    /// Submits a look at what two directions around the head show, whether it is in view or not.
    fn look_around(
        &mut self,
        world: &World,
        glance: &Glance,
        looks: &Looks,
        sampled: &Sampled,
    ) -> Result<Ticket, GpuError> {
        self.views.write_glance(glance);
        let sight = Sight::of(glance.views.iter());
        let mut drawn = std::mem::take(&mut self.lists.drawn);
        drawn.iter_mut().for_each(Vec::clear);
        drawn[0].extend(looks.shown());
        let places = [sampled.places[VIEW_TIMES / 2]; VIEW_TIMES];
        let (scenes, times) = (&drawn, ONLY_THE_FIRST);
        let looking = Looking { looks, scenes, places, sight: &sight, times, turned_frusta: 0 };
        let ticket = self.look_at(world.gpu().record()?, world, looking)?;
        self.lists.drawn = drawn;
        Ok(ticket)
    }

    /// Rasterises views at their times, and measures what is visible.
    fn look_at(
        &mut self,
        mut recorder: Recorder,
        world: &World,
        Looking { looks, scenes, places, sight, times, turned_frusta }: Looking<'_>,
    ) -> Result<Ticket, GpuError> {
        let (scene, animation) = (world.scene(), world.animation());
        let within = (self.policy.clusters(world), sight);
        recorder.fill(&self.mark.visible, 0);
        self.level_selection.record_start(&mut recorder);
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE_WRITE);
        recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
        for (time, place) in places.into_iter().enumerate().filter(|(time, _)| times[*time]) {
            let [now, next] = scenes;
            let drawn = [Some(now), Some(next).filter(|next| !next.is_empty())];
            let all = drawn.into_iter().flatten();
            let all = all.flat_map(|drawn| first_views(time, turned_frusta).map(move |first| (drawn, first)));
            for (drawn, first_view) in all {
                recorder.scope("id buffer", |r| {
                    let pass = Pass { looked_at: drawn, place, first_view, within };
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

    /// The times that may show something that another does not: one of them where the head and all in view stand still.
    fn times_to_look_at(&self, world: &World, Start { update, views, .. }: &Start) -> [bool; VIEW_TIMES] {
        self.policy.looked_at(*update, || {
            views.eyes.iter().all(|pair| *pair == views.eyes[0])
                && world.stands(self.culling.needed(), &views.times)
        })
    }

    /// Adds the needs of the surround to those of the view. Returns the glance of this update, if it has one.
    fn look_for_surround(&mut self, views: &PredictedViews) -> Option<Glance> {
        self.needs.copy(self.culling.needed());
        let Around { sweep, culling } = self.around.as_mut()?;
        let glance = sweep.next(views.world_from_head);
        self.needs.add(culling.needs(glance.iter().flat_map(|glance| glance.views)));
        glance
    }

    /// There is no room for what is seen, not even for a moment beside what is to be shown instead: whatever is to be coarser is
    /// so from now on, and comes in as the other goes.
    fn switch_at_once(&mut self, looks: &mut Looks) {
        let coarser = &mut self.lists.coarser;
        coarser.clear();
        coarser.extend(looks.coarser());
        for look in coarser {
            looks.switch(look.instance);
            self.detail.switched(look.instance);
        }
    }
}

impl Begun {
    /// The look that is before the device.
    pub(crate) fn ticket(&self) -> Ticket {
        self.look.ticket
    }

    /// After the last look.
    pub fn looked(self) -> Looked {
        let Self { start, sampled, look: Seeing { looks, .. }, .. } = self;
        Looked { start, sampled, looks }
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

/// The costs of each level of detail of each instance.
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

//! A viewer's updates before they are part of a world, and after.
//!
//! All that takes long is made here, by whichever thread: tables of the client's memory, images and buffers of the device. What is
//! left for the thread that drives the world is to bind them to it ([`ReadyUpdates::join`]). The device memory of a viewer that has
//! gone serves another with the same eyes and atlas, once it is wiped. Which viewers come, and when, is unknown here.

use crate::atlas::layout::Layout;
use crate::pacing::room::Room;
use crate::support::pool::Pool;
use crate::update::eye::EyeSize;
use crate::update::in_flight::InFlight;
use crate::update::numbers::UpdateNumbers;
use crate::update::placement_step::PlacementStep;
use crate::update::policy::UpdatePolicy;
use crate::update::shading_step::{ColourMemory, ShadingStep};
use crate::update::visibility_step::{VisibilityMemory, VisibilityStep};
use crate::update::{ShowOptions, ViewerUpdates};
use crate::visibility::predict::{DisplayTiming, HeadTrack};
use crate::world::{Site, ViewerId, World};
use shadecast_gpu::{Gpu, GpuError};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::{Capabilities, Welcome};
use std::sync::Arc;

/// What a viewer's device memory is made for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct MemoryTerms {
    eye: EyeSize,
    atlas: AtlasExtent,
}

impl MemoryTerms {
    /// Those of a client that agreed to `welcome` and has told its `capabilities`.
    pub(crate) fn of(welcome: &Welcome, capabilities: &Capabilities) -> Self {
        Self { eye: EyeSize::of(capabilities), atlas: welcome.atlas_extent_texels }
    }
}

/// What a viewer has on the device, in no world.
pub struct ViewerMemory {
    terms: MemoryTerms,
    visibility: VisibilityMemory,
    colours: ColourMemory,
}

impl ViewerMemory {
    fn new(site: &Site, terms: MemoryTerms, policy: &UpdatePolicy) -> Result<Self, GpuError> {
        let Site { gpu, scene, .. } = site;
        // A thread each: drivers compile on the thread that asks.
        let (visibility, colours) = std::thread::scope(|scope| {
            let colours = scope.spawn(|| ColourMemory::new(gpu, scene, terms.atlas, policy));
            let visibility = VisibilityMemory::new(gpu, scene, terms.eye);
            (visibility, colours.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
        });
        Ok(Self { terms, visibility: visibility?, colours: colours? })
    }

    /// What it is made for.
    pub(crate) fn terms(&self) -> MemoryTerms {
        self.terms
    }
}

/// What a viewer's updates were made of. Dropping it takes a while.
pub struct LeftUpdates(pub(super) ViewerUpdates);

impl LeftUpdates {
    /// What of it can serve another viewer. Nothing of this one is left in it. Waits for the device.
    ///
    /// # Errors
    /// The device is lost.
    pub fn wiped(self, gpu: &Arc<Gpu>) -> Result<ViewerMemory, GpuError> {
        let ViewerUpdates { terms, visibility, shading, .. } = self.0;
        let (mut visibility, mut colours) = (visibility.into_memory(), shading.into_memory());
        visibility.wipe();
        colours.wipe(gpu)?;
        Ok(ViewerMemory { terms, visibility, colours })
    }
}

/// See the module.
pub(crate) struct ReadyUpdates {
    policy: Arc<UpdatePolicy>,
    show: ShowOptions,
    display: DisplayTiming,
    placement: PlacementStep,
    memory: ViewerMemory,
}

impl ReadyUpdates {
    /// For a viewer that agreed to `welcome` and has told its `capabilities`; with wiped memory that is made for the same terms,
    /// where there is any.
    ///
    /// # Errors
    /// The device has no memory for it, or is lost.
    pub(crate) fn new(
        site: &Site,
        kept: Option<ViewerMemory>,
        welcome: &Welcome,
        capabilities: &Capabilities,
        show: ShowOptions,
        policy: UpdatePolicy,
    ) -> Result<Self, GpuError> {
        let terms = MemoryTerms::of(welcome, capabilities);
        let room = Room {
            patches: welcome.patch_slots.min(Layout::most_blocks(welcome.atlas_extent_texels)),
            vertices: welcome.vertex_slots,
            triangles: capabilities.max_triangles,
        };
        let policy = Arc::new(policy);
        let memory = match kept.filter(|kept| kept.terms == terms) {
            Some(kept) => kept,
            None => ViewerMemory::new(site, terms, &policy)?,
        };
        Ok(Self {
            placement: PlacementStep::new(site, terms.eye, welcome, (room, show.surround), &policy),
            display: DisplayTiming { period_ns: capabilities.display_period_ns, blends: capabilities.blends },
            policy,
            show,
            memory,
        })
    }

    /// What of them can serve another viewer: nobody has used it.
    pub(crate) fn into_memory(self) -> ViewerMemory {
        self.memory
    }

    /// They become those of a viewer of `world`, which is of the same device and scene.
    ///
    /// # Errors
    /// The device has no room for their bindings, or is lost.
    pub(crate) fn join(self, world: &World, id: ViewerId) -> Result<ViewerUpdates, GpuError> {
        let Self { policy, show, display, placement, memory } = self;
        let ViewerMemory { terms, visibility, colours } = memory;
        let seen = (&placement.residency, visibility);
        Ok(ViewerUpdates {
            id,
            terms,
            head: HeadTrack::new(display),
            visibility: VisibilityStep::new(world, (id, terms.eye), show, &policy, seen)?,
            placement,
            shading: ShadingStep::new(world, terms.eye, &policy, colours)?,
            policy,
            in_flight: InFlight::default(),
            numbers: UpdateNumbers::new(),
            timings: Pool::default(),
            rehearsed_s: None,
        })
    }
}

//! What a measurement spares a viewer's updates, so that it can say what each cause of error costs. The product spares nothing:
//! that is the default.

use crate::shading::filter::Filter;
use crate::visibility::view_plan::ViewPlan;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::WorldTime;
use std::collections::BTreeMap;

/// See the module.
#[derive(Clone, Debug, PartialEq)]
pub struct Ideal {
    /// Texels that blocks get for a pixel of the display, in an atlas with room.
    pub texels_per_pixel: f32,
    /// What textures are filtered for.
    pub filter: Filter,
    /// Blocks whose inputs have not changed are not shaded again.
    pub reuse: bool,
    /// What stands still is looked at once an update, not at each of its times.
    pub looks_once: bool,
    /// Of what stands still, only what is in sight is drawn to look at.
    pub clusters: bool,
    /// For when exactly updates are shaded, where that is known ahead; others for the middle of their time on display, as expected.
    pub shading_times: BTreeMap<UpdateId, WorldTime>,
    /// At which of its times an update looks.
    pub views: ViewPlan,
}

impl Default for Ideal {
    fn default() -> Self {
        Self {
            texels_per_pixel: 1.0,
            filter: Filter::default(),
            reuse: true,
            looks_once: true,
            clusters: true,
            shading_times: BTreeMap::new(),
            views: ViewPlan::default(),
        }
    }
}

//! What a measurement spares a viewer's updates, so that it can say what each cause of error costs. The product spares nothing:
//! that is the default.

use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::ServerTime;
use std::collections::BTreeMap;

/// See the module.
#[derive(Clone, Debug, PartialEq)]
pub struct Ideal {
    /// Texels that blocks get for a pixel of the display, in an atlas with room.
    pub texels_per_pixel: f32,
    /// Each texel is shaded at many places, and has their mean.
    pub is_supersampled: bool,
    /// For when exactly updates are shaded, where that is known ahead; others for the middle of their time on display, as expected.
    pub shading_times: BTreeMap<UpdateId, ServerTime>,
}

impl Default for Ideal {
    fn default() -> Self {
        Self { texels_per_pixel: 1.0, is_supersampled: false, shading_times: BTreeMap::new() }
    }
}

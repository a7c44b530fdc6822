//! The sample times of an update, and their places in the ring of samples.
//!
//! Grid times and world times enter; places of the ring leave. Nothing here knows the scene or the device.

pub(crate) mod view_time;

use shadecast_protocol::limits::MAX_VIEWS;
use shadecast_shaders::constants::EYES;

/// View times per update.
pub(crate) const VIEW_TIMES: usize = (MAX_VIEWS / EYES) as usize;

/// A place in which samples of one time are kept, until those of another time take it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RingPlace(pub u32);

impl RingPlace {
    /// As an index into an array by place.
    pub(crate) fn index(self) -> usize {
        self.0 as usize
    }
}

//! How the scene moves: what the GPU needs of it, each once, and samples of it on the time grid.

pub mod buffers;
pub mod gpu;
mod live;
pub mod manager;
pub mod posing;
pub mod skinning;
pub mod timeline;

/// Grid points kept on the GPU: those of a few updates.
pub const RING: u32 = 16;

/// A place of the ring in which samples are kept: that of a grid point until another one takes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RingPlace(pub u32);

impl RingPlace {
    /// As an index into an array by place.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

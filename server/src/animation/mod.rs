//! How the scene moves: what the GPU needs of it, each once, and samples of it on the time grid.

pub mod buffers;
pub mod gpu;
pub mod manager;
pub mod skinning;

/// A place of the ring in which samples are kept: that of a grid point until another one takes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RingPlace(pub u32);

impl RingPlace {
    /// As an index into an array by place.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

//! How the scene moves: what the GPU needs of it, each once, and samples of it on the time grid.

pub mod buffers;
pub mod gpu;
mod live;
pub mod manager;
pub mod packing;
pub mod posing;
pub mod saved;
pub mod skinning;
pub mod timeline;

/// A place in which samples of one time are kept, until those of another time take it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RingPlace(pub u32);

impl RingPlace {
    /// As an index into an array by place.
    pub fn index(self) -> usize {
        self.0 as usize
    }
}

//! Changes of one update in a client's memory, before coding.

use crate::scene::numbering::SceneVertex;
use shadecast_protocol::atlas::Block;
use shadecast_protocol::geometry::GeometryDelta;
use shadecast_protocol::ids::{PatchSlot, UpdateId, VertexSlot};
use shadecast_protocol::time::WorldTime;

/// An update, as far as its delta says.
#[derive(Clone, Copy, Debug)]
pub(crate) struct UpdateStamp {
    /// The update.
    pub update: UpdateId,
    /// The world's time when it was begun.
    pub time: WorldTime,
}

/// What one update changes in a client's memory, before it is coded.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct UpdateDelta {
    /// What the client is told.
    pub geometry: GeometryDelta,
    /// Of the vertices that enter, those with samples.
    pub sampled: Vec<(VertexSlot, SceneVertex)>,
    /// Of the patches that get a block, those with a cutout material, ascending.
    pub masked: Vec<(PatchSlot, Block)>,
}

impl UpdateDelta {
    /// Says nothing any more; the memory of its lists stays.
    pub(crate) fn clear(&mut self) {
        let Self { geometry, sampled, masked } = self;
        geometry.clear();
        sampled.clear();
        masked.clear();
    }
}

//! Which patch has which block, as the layout tells others.

use crate::scene::numbering::ScenePatch;
use shadecast_protocol::atlas::Block;

/// A patch that has a block, in the atlas or in the store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Placed {
    /// The patch.
    pub patch: ScenePatch,
    /// Its block.
    pub block: Block,
    /// It belongs to the surround, which is shaded in turn.
    pub is_around: bool,
    /// It is in the store and not shown.
    pub is_hidden: bool,
}

/// A block that changed with this update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct PlacementChange {
    /// The patch.
    pub patch: ScenePatch,
    /// Its block now; `None`: it has none any more.
    pub block: Option<Block>,
}

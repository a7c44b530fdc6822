//! The records that write the client's vertex memory, as `client_scatter.comp` reads them.

use crate::constants::{NO_SAMPLE, STATIC_BIT};
use crate::generated::VertexWriteGpu;
use shadecast_protocol::time::GridIndex;

/// The tag of a grid step: tags order like grid indices, and 0 is no sample.
pub fn tag(grid: GridIndex) -> u32 {
    (grid.0 as u32) ^ (1 << 31)
}

/// The record of a sample.
pub fn sample_write(slot: u32, grid: GridIndex, position: [f32; 3]) -> VertexWriteGpu {
    let [x, y, z] = position.map(f32::to_bits);
    VertexWriteGpu { slot, tag: tag(grid), x, y, z }
}

/// The record of an animated vertex that enters a slot: what the slot held is forgotten.
pub fn sampled_entry(slot: u32) -> VertexWriteGpu {
    VertexWriteGpu { slot, tag: NO_SAMPLE, x: 0, y: 0, z: 0 }
}

/// The record of a static vertex that enters a slot.
pub fn static_entry(slot: u32, position: [f32; 3]) -> VertexWriteGpu {
    let [x, y, z] = position.map(f32::to_bits);
    VertexWriteGpu { slot: slot | STATIC_BIT, tag: NO_SAMPLE, x, y, z }
}

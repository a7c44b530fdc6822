//! The GPU passes of visibility, in pipeline order. A pass is one file with its layout, pipeline and `record`; its shader
//! carries the same stem. Passes know nothing of each other: barriers between them stand in `update/` and `world/`.

pub mod id_buffer;
pub mod mark;
pub mod spread;
pub mod extents;

//! The GPU stages, in pipeline order. A stage is one file with its layout, pipeline and `record`; its shader carries
//! the same stem. Stages know nothing of each other: the barriers between them stand in `frame.rs`.

pub mod palette;
pub mod skin;
pub mod id_buffer;
pub mod mark;
pub mod level_selection;
pub mod shadow;
pub mod shading;
pub mod ycbcr;
pub mod forward;
pub mod present;

mod geometry;

//! Motion of the scene, each part once: skeletons, clips, the timeline of all instances, and the places of saved vertices.
//!
//! A loaded scene and events enter; poses to evaluate leave. Nothing here knows meshes on the GPU or a viewer.

pub(crate) mod buffers;
pub(crate) mod live;
pub mod manager;
pub mod packing;
pub mod saved;
pub mod timeline;

//! Assets made by the program itself, so that a first start and every test have something real to render.
//!
//! The [`dragon()`] is the embedded default scene. It is produced as the bytes of a GLB file and goes through the
//! same importer as any other file: nothing in here knows of scenes, renderers or Vulkan.

mod dragon;
pub mod glb;

pub use dragon::dragon;

//! Capacities of a scene, and of foreign text. The wire crate re-exports them, and adds those of streams and clients.

/// Placed models of a scene.
pub const MAX_INSTANCES: u32 = 4096;
/// Lights beside the sun that a scene is lit by at one time.
pub const MAX_LIGHTS: u32 = 16;
/// Largest magnitude of a coordinate in metres; larger ones are refused as nonsense.
pub const MAX_COORDINATE_M: f32 = 1e6;
/// Characters of a stranger's text that are shown; see [`crate::text::printable`].
pub const MAX_PRINTED_CHARS: usize = 200;

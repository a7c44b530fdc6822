//! How much an update may take: of time, bits, texels and the client's memory. Pure.
//!
//! Measurements of the link, the encoder and the device enter; budgets, quantisers and densities leave. Nothing here knows
//! the scene or makes an update.

pub(crate) mod density;
pub mod gate;
pub mod overlap;
pub(crate) mod pressure;
pub mod quality;
pub mod relief;
pub mod room;
pub(crate) mod shade_rate;
pub mod share;

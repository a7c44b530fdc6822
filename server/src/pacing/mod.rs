//! How much an update may take: of time, bits, texels and the client's memory. Pure.
//!
//! Measurements of the link, the encoder and the device enter; budgets, quantisers and densities leave. Nothing here knows
//! the scene or makes an update.

pub mod density;
pub mod gate;
pub mod overlap;
pub mod pressure;
pub mod quality;
pub mod room;
pub mod shade_rate;

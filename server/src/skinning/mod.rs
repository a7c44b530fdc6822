//! Poses and vertices at sample times: palettes and skinned vertices on the GPU, single vertices on the CPU.
//!
//! Schedules and times enter; places of the ring with positions leave. Nothing here knows a viewer.

pub mod gpu;
pub mod passes;
pub mod posing;

//! The render thread: one display frame after another.
//!
//! Prepared scenes, batches and bundles enter through `handover`, and poses from the display. Pictures leave for the
//! display, and notes on each display frame for the intake. Nothing here knows messages, codecs and sockets.

mod figures;
mod figures_panel;
mod frame;
pub mod presenter;
mod rehearsal;
mod renderer;
mod scene;
mod scenes;
pub mod stats;
mod stillness;

//! What desktop programs share: a window, and the numbers of their command lines.
//!
//! The server shows its ground truth in the window, the client its eyes. Device and images ([`canvas`]), the last stage
//! ([`present`]), a camera ([`camera`]), its keys and pointer ([`controls`]), screenshots ([`png`]), ranges of numbers
//! ([`flags`]). The crate knows no clock; its callers do.

pub mod camera;
pub mod canvas;
pub mod controls;
pub mod flags;
pub mod png;
pub mod present;

pub use winit;

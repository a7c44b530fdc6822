//! What desktop programs share: a window, and the numbers of their command lines.
//!
//! The server shows its ground truth in the window, the client its eyes. It has a device and images ([`canvas`]), the last stage
//! ([`present`]), a camera ([`camera`]), keys and pointer that move it ([`controls`]), and pictures of it are kept ([`png`]). It knows
//! no clock: whoever has one draws. Numbers of the command line have ranges ([`flags`]).

pub mod camera;
pub mod canvas;
pub mod controls;
pub mod flags;
pub mod png;
pub mod present;

pub use winit;

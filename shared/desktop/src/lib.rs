//! A window of the desktop, for who shows something in one: the server its ground truth, the client its eyes. Device and
//! images ([`canvas`]), the last stage ([`present`]), a camera ([`camera`]), keys and pointer that move it ([`controls`]),
//! and what is kept of it ([`png`]). Knows no clock: who has one draws.

pub mod camera;
pub mod canvas;
pub mod controls;
pub mod png;
pub mod present;

pub use winit;

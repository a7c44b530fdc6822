//! A desktop window, for the server's ground truth and the client's eyes. Device and images ([`canvas`]), the last stage
//! ([`present`]), a camera ([`camera`]), its keys and pointer ([`controls`]), and screenshots ([`png`]). The crate knows no
//! clock; its callers do.

pub mod camera;
pub mod canvas;
pub mod controls;
pub mod png;
pub mod present;

pub use winit;

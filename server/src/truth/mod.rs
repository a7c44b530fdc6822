//! The ground truth: the renderer per pixel, its window, its cameras and its files.
//!
//! A scene, a camera and a time enter; pictures leave. Nothing here knows clients and updates, and serving a client needs none
//! of it.

pub mod forward;
pub mod video;
pub mod window;

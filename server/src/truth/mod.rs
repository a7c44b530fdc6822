//! The ground truth, and all that serves it alone: the renderer per pixel, its window, its cameras and its files. Serving a
//! client needs none of it.

pub mod forward;
pub mod video;
pub mod window;

//! Scenes for one measurement each.
//!
//! A folder enters, and sizes. A scene description leaves, with its models and textures. Nothing here knows runs and figures.

pub mod assets;
pub mod hall;
pub mod leaves;
pub mod robot;
pub mod room;
pub mod sheets;
pub mod walls;

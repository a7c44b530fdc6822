//! How good a picture is, and how exact motion: metrics, and the truth that they compare with.
//!
//! Pictures, probes and a scene's source curves enter. Figures leave: decibels, FLIP, SSIM, pixels, percentiles. Nothing here
//! knows how a run is set up and how its figures are written down.

pub mod compare;
pub mod flip;
pub mod metrics;
pub mod motion;
pub(crate) mod percentiles;
pub mod ssim;
pub mod truth;

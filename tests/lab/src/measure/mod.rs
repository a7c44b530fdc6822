//! Quality of pictures and accuracy of motion: metrics, and the truth for their comparison.
//!
//! Pictures, probes and a scene's source curves enter. Figures leave: decibels, FLIP, SSIM, pixels, percentiles. Nothing here
//! knows the set-up of a run and the files of its figures.

pub mod compare;
pub mod fit;
pub mod flicker;
pub mod flip;
pub mod metrics;
pub mod motion;
pub(crate) mod percentiles;
pub mod ssim;
pub(crate) mod triangle;
pub mod truth;

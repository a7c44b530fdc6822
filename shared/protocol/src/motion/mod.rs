//! Motion of vertices, one file per kind: its data for the client, and its coding. A static vertex carries its position
//! ([`crate::geometry::Motion::Static`]). A skinned vertex is sent before skinning ([`rest`]). The others are sampled on the
//! time grid ([`samples`]), or predicted with each update ([`predicted`]).

pub mod clip;
pub mod keys;
pub mod message;
pub mod poses;
pub mod predicted;
pub mod rest;
pub mod skeleton;
pub mod samples;

mod bits;
mod key_times;

pub use shadecast_model::playback;

use crate::ids::VertexSlot;
use crate::time::GridIndex;
use glam::Vec3;

/// Quantised world positions by slot: metres are `value * step_m` of the vertex's instance.
pub type SampleValues = Vec<(VertexSlot, [i32; 3])>;

/// Samples of some vertices at one grid step.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SampleBatch {
    /// The grid step.
    pub grid: GridIndex,
    /// In ascending order of slots.
    pub values: SampleValues,
}

/// The same in metres, for those who have no memory of the client at hand.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PositionBatch {
    /// The grid step.
    pub grid: GridIndex,
    /// World positions in metres, in ascending order of slots.
    pub positions: Vec<(VertexSlot, Vec3)>,
}

/// A world position in metres as a sample of this step; coordinates beyond what 32 bits hold are clamped.
pub fn quantise(position: Vec3, step_m: f32) -> [i32; 3] {
    position.to_array().map(|metres| (f64::from(metres) / f64::from(step_m)).round() as i32)
}

/// The world position in metres of a sample of this step.
pub fn dequantise(value: [i32; 3], step_m: f32) -> Vec3 {
    Vec3::from_array(value.map(|steps| (f64::from(steps) * f64::from(step_m)) as f32))
}

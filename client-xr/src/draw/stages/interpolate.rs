//! Positions of animated vertices at the display time (`client_interpolate.comp`), once per display frame for both eyes.

use super::scatter::VertexMemory;
use crate::motion::pace::{BLEND_NS, Evaluation, GridTime};
use shadecast_gpu::{Bind, BindGroup, ComputePipeline, Gpu, GpuError, Recorder};
use shadecast_protocol::time::Grid;
use shadecast_shaders::generated::{CLIENT_INTERPOLATE_COMP, InterpolatePush};
use shadecast_shaders::records::{prediction_time, tag};
use std::sync::Arc;

/// How positions between samples are found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Interpolation {
    /// A cubic through four samples.
    #[default]
    Cubic,
    /// A line through two: the paper's, and the baseline.
    Linear,
}

/// What of the vertex memory is moved.
#[derive(Clone, Copy, Debug)]
pub struct Slots {
    /// Slots from 0 on.
    pub vertex_count: u32,
    /// All that there are.
    pub vertex_slots: u32,
    /// Steps of the time grid that are kept of each.
    pub sample_ring: u32,
}

/// The pipeline.
pub struct Interpolate {
    pipeline: ComputePipeline,
}

/// What the shader is told for a display frame.
pub fn push(
    grid: Grid,
    evaluation: Evaluation,
    Slots { vertex_count, vertex_slots, sample_ring }: Slots,
    interpolation: Interpolation,
) -> InterpolatePush {
    let (at, was) = (GridTime::of(grid, evaluation.at), GridTime::of(grid, evaluation.before));
    InterpolatePush {
        vertex_count,
        vertex_slots,
        sample_ring,
        tag: tag(at.step),
        fraction: at.fraction,
        tag_before: tag(was.step),
        fraction_before: was.fraction,
        blend_step: (evaluation.elapsed_ns as f64 / BLEND_NS as f64).clamp(0.0, 1.0) as f32,
        cubic: u32::from(interpolation == Interpolation::Cubic),
        // Whoever is sent predictions is sent no samples: all move at the display time.
        now: prediction_time(evaluation.at),
    }
}

impl Interpolate {
    /// The pipeline.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        Ok(Self { pipeline: ComputePipeline::new(gpu, &CLIENT_INTERPOLATE_COMP)? })
    }

    /// Binds `memory`.
    pub fn bind(&self, memory: &VertexMemory) -> Result<BindGroup, GpuError> {
        let binds = [
            ("Samples", Bind::Buffer(&memory.samples)),
            ("Positions", Bind::Buffer(&memory.positions)),
            ("Blends", Bind::Buffer(&memory.blends)),
        ];
        BindGroup::new(self.pipeline.layout(), &binds)
    }

    /// Interpolates the first `push.vertex_count` slots.
    pub fn record(&self, recorder: &mut Recorder, group: &BindGroup, push: &InterpolatePush) {
        if push.vertex_count > 0 {
            recorder.dispatch(&self.pipeline, group, push, [push.vertex_count, 1, 1]);
        }
    }
}

#[cfg(test)]
mod tests;

//! Positions of skinned vertices at the display time (`client_skin.comp`), once per display frame for both eyes.

use super::arena::SkinMemory;
use super::scatter::VertexMemory;
use shadecast_gpu::{Bind, BindGroup, ComputePipeline, Gpu, GpuError, Recorder};
use shadecast_shaders::generated::{CLIENT_SKIN_COMP, SkinPush};
use std::sync::Arc;

/// The pipeline.
pub struct Skin {
    pipeline: ComputePipeline,
}

impl Skin {
    /// The pipeline.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        Ok(Self { pipeline: ComputePipeline::new(gpu, &CLIENT_SKIN_COMP)? })
    }

    /// Binds a connection's memory.
    pub fn bind(&self, vertices: &VertexMemory, skin: &SkinMemory) -> Result<BindGroup, GpuError> {
        let binds = [
            ("Skins", Bind::Buffer(&vertices.skins)),
            ("Rests", Bind::Buffer(&vertices.rests)),
            ("Palettes", Bind::Buffer(&skin.palettes)),
            ("MorphWeights", Bind::Buffer(&skin.morph_weights)),
            ("Arena", Bind::Buffer(&skin.arena)),
            ("Positions", Bind::Buffer(&vertices.positions)),
        ];
        BindGroup::new(self.pipeline.layout(), &binds)
    }

    /// Skins what is skinned of the first `vertex_count` slots.
    pub fn record(&self, recorder: &mut Recorder, group: &BindGroup, vertex_count: u32) {
        if vertex_count > 0 {
            recorder.dispatch(&self.pipeline, group, &SkinPush { vertex_count }, [vertex_count, 1, 1]);
        }
    }
}

#[cfg(test)]
mod tests;

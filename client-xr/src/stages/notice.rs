//! A panel with a text in front of everything, for what a person must know while the world stands still
//! (`client_notice.*`).

use super::FRAMES_IN_FLIGHT;
use super::background::{CELL_EXTENT_M, TEXT_CELLS, Text};
use shadecast_gpu::{
    Bind, BindGroup, Buffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Memory, Recorder,
    RenderPass, vk,
};
use shadecast_protocol::pose::Pose;
use shadecast_shaders::generated::{CLIENT_NOTICE_FRAG, CLIENT_NOTICE_VERT, NoticeGpu};
use std::sync::Arc;

/// The pipeline, and what it reads per frame in flight.
pub struct Notice {
    pipeline: GraphicsPipeline,
    slots: [(Buffer, Buffer, BindGroup); FRAMES_IN_FLIGHT],
}

impl Notice {
    /// The pipeline for `pass`.
    pub fn new(
        gpu: &Arc<Gpu>,
        pass: &RenderPass,
        eyes: [&Buffer; FRAMES_IN_FLIGHT],
    ) -> Result<Self, GpuError> {
        let desc = GraphicsPipelineDesc {
            topology: vk::PrimitiveTopology::TRIANGLE_STRIP,
            blend: true,
            ..GraphicsPipelineDesc::new(&CLIENT_NOTICE_VERT, &CLIENT_NOTICE_FRAG, pass)
        };
        let pipeline = GraphicsPipeline::new(gpu, &desc)?;
        let slot = |eyes: &Buffer| {
            let notice = Buffer::new(gpu, "notice", size_of::<NoticeGpu>() as u64, Memory::Upload)?;
            let text =
                Buffer::new(gpu, "notice text", size_of_val(Text::default().words()) as u64, Memory::Upload)?;
            let binds = [
                ("Eyes", Bind::Buffer(eyes)),
                ("Notice", Bind::Buffer(&notice)),
                ("Text", Bind::Buffer(&text)),
            ];
            let group = BindGroup::new(pipeline.layout(), &binds)?;
            Ok::<_, GpuError>((notice, text, group))
        };
        let slots = [slot(eyes[0])?, slot(eyes[1])?, slot(eyes[2])?];
        Ok(Self { pipeline, slots })
    }

    /// Draws `text` over all that was drawn before. The last recording of frame slot `frame_slot` has finished.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        frame_slot: usize,
        world_from_panel: Pose,
        text: &Text,
    ) {
        let (uniform, words, group) = &mut self.slots[frame_slot];
        let notice = NoticeGpu {
            world_from_panel: world_from_panel.matrix().to_cols_array_2d(),
            box_cells: text.box_cells(),
            cell_extent_m: [CELL_EXTENT_M[0], CELL_EXTENT_M[1], 0.0, 0.0],
            text_cells: [TEXT_CELLS[0] as u32, TEXT_CELLS[1] as u32, 0, 0],
        };
        uniform.write(0, bytemuck::bytes_of(&notice));
        words.write(0, bytemuck::cast_slice(text.words()));
        recorder.bind(&self.pipeline, group);
        recorder.draw(4, 1);
    }
}

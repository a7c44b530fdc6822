//! A panel with a text in front of everything, for notices while the world stands still (`client_notice.*`).

use super::FRAMES_IN_FLIGHT;
use super::text::{CELL_EXTENT_M, TEXT_CELLS, Text, TextDraw};
use shadecast_gpu::{Buffer, Gpu, GpuError, GraphicsPipelineDesc, Recorder, RenderPass, vk};
use shadecast_protocol::pose::Pose;
use shadecast_shaders::generated::{CLIENT_NOTICE_FRAG, CLIENT_NOTICE_VERT, NoticeGpu};
use std::sync::Arc;

/// The stage.
pub struct Notice {
    draw: TextDraw<NoticeGpu>,
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
        Ok(Self { draw: TextDraw::new(gpu, &desc, "Notice", eyes)? })
    }

    /// Draws `text` over all that was drawn before. The last recording of frame in flight `flight` has finished.
    pub fn record(&mut self, recorder: &mut Recorder, flight: usize, world_from_panel: Pose, text: &Text) {
        let notice = NoticeGpu {
            world_from_panel: world_from_panel.matrix().to_cols_array_2d(),
            box_cells: text.box_cells(),
            cell_extent_m: [CELL_EXTENT_M[0], CELL_EXTENT_M[1], 0.0, 0.0],
            text_cells: [TEXT_CELLS[0] as u32, TEXT_CELLS[1] as u32, 0, 0],
        };
        self.draw.record(recorder, flight, &notice, Some(text), 4);
    }
}

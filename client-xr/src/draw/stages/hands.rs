//! The controllers in the hands, as simple shapes (`client_hands.*`).

use super::FRAMES_IN_FLIGHT;
use glam::Mat4;
use shadecast_gpu::{
    Bind, BindGroup, Buffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Memory, Recorder,
    RenderPass, vk,
};
use shadecast_protocol::pose::Pose;
use shadecast_shaders::generated::{CLIENT_HANDS_FRAG, CLIENT_HANDS_VERT, HandsGpu};
use std::sync::Arc;

/// Two triangles for each side of a box.
const VERTICES: u32 = 36;

/// The stage.
pub struct Hands {
    pipeline: GraphicsPipeline,
    poses: [Buffer; FRAMES_IN_FLIGHT],
    groups: [BindGroup; FRAMES_IN_FLIGHT],
    /// Of the last frame: where there was none, there is none to draw.
    are_known: bool,
}

impl Hands {
    /// The pipeline for `pass`.
    pub fn new(
        gpu: &Arc<Gpu>,
        pass: &RenderPass,
        eyes: [&Buffer; FRAMES_IN_FLIGHT],
    ) -> Result<Self, GpuError> {
        let desc = GraphicsPipelineDesc {
            cull: vk::CullModeFlags::BACK,
            depth_write: Some(true),
            ..GraphicsPipelineDesc::new(&CLIENT_HANDS_VERT, &CLIENT_HANDS_FRAG, pass)
        };
        let pipeline = GraphicsPipeline::new(gpu, &desc)?;
        let buffer = || Buffer::new(gpu, "hands", size_of::<HandsGpu>() as u64, Memory::Upload);
        let poses = [buffer()?, buffer()?, buffer()?];
        let group = |flight: usize| {
            let binds = [("Eyes", Bind::Buffer(eyes[flight])), ("Hands", Bind::Buffer(&poses[flight]))];
            BindGroup::new(pipeline.layout(), &binds)
        };
        let groups = [group(0)?, group(1)?, group(2)?];
        Ok(Self { pipeline, poses, groups, are_known: false })
    }

    /// Draws both, where [`Self::write`] says that they are, before what is behind everything.
    pub fn record(&self, recorder: &mut Recorder, flight: usize) {
        if self.are_known {
            recorder.bind(&self.pipeline, &self.groups[flight]);
            recorder.draw(VERTICES, 2);
        }
    }

    /// Says where they are in the space of the eyes, left and right. The recording for `flight` is not yet submitted.
    pub fn write(&mut self, flight: usize, space_from_hand: [Option<Pose>; 2]) {
        let matrix =
            |pose: Option<Pose>| pose.map_or(Mat4::IDENTITY, |pose| pose.matrix()).to_cols_array_2d();
        let [left, right] = space_from_hand.map(|pose| f32::from(u8::from(pose.is_some())));
        let hands =
            HandsGpu { space_from_hand: space_from_hand.map(matrix), is_shown: [left, right, 0.0, 0.0] };
        self.poses[flight].write(0, bytemuck::bytes_of(&hands));
        self.are_known = space_from_hand.iter().any(Option::is_some);
    }
}

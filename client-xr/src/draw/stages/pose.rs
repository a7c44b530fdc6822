//! Palettes and morph weights of the skinned instances on the draw list (`client_pose.comp`), once per display frame.

use super::FRAMES_IN_FLIGHT;
use super::arena::SkinMemory;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_protocol::limits::MAX_INSTANCES;
use shadecast_shaders::generated::{CLIENT_POSE_COMP, PlacedPoseGpu};
use std::sync::Arc;

/// The pipeline.
pub struct PoseStage {
    pipeline: ComputePipeline,
}

/// What one connection needs to evaluate poses: those of each frame in flight.
pub struct PoseStaging {
    in_flight: [(Buffer, BindGroup); FRAMES_IN_FLIGHT],
}

impl PoseStage {
    /// The pipeline.
    pub fn new(gpu: &Arc<Gpu>) -> Result<Self, GpuError> {
        Ok(Self { pipeline: ComputePipeline::new(gpu, &CLIENT_POSE_COMP)? })
    }

    /// Staging for `memory`.
    pub fn staging(&self, gpu: &Arc<Gpu>, memory: &SkinMemory) -> Result<PoseStaging, GpuError> {
        let bytes = u64::from(MAX_INSTANCES) * size_of::<PlacedPoseGpu>() as u64;
        let of_frame = || {
            let poses = Buffer::new(gpu, "placed poses", bytes, Memory::Upload)?;
            // The arena under all its views.
            let arena = ["Parents", "Tracks", "Keys", "KeyTimes", "Entries", "Levels"];
            let mut binds = arena.map(|view| (view, Bind::Buffer(&memory.arena))).to_vec();
            binds.extend([
                ("Globals", Bind::Buffer(&memory.globals)),
                ("Palettes", Bind::Buffer(&memory.palettes)),
                ("PlacedPoses", Bind::Buffer(&poses)),
                ("MorphWeights", Bind::Buffer(&memory.morph_weights)),
            ]);
            let group = BindGroup::new(self.pipeline.layout(), &binds)?;
            Ok::<_, GpuError>((poses, group))
        };
        Ok(PoseStaging { in_flight: [of_frame()?, of_frame()?, of_frame()?] })
    }

    /// Evaluates the first `count` poses of frame in flight `flight`.
    pub fn record(&self, recorder: &mut Recorder, staging: &PoseStaging, flight: usize, count: u32) {
        if count > 0 {
            // A workgroup for each instance.
            let invocations = count * self.pipeline.workgroup()[0];
            recorder.dispatch(&self.pipeline, &staging.in_flight[flight].1, &(), [invocations, 1, 1]);
        }
    }
}

impl PoseStaging {
    /// Where the poses of frame in flight `flight` go. Its last recording has finished.
    pub fn poses_mut(&mut self, flight: usize) -> &mut [PlacedPoseGpu] {
        let bytes = MAX_INSTANCES as usize * size_of::<PlacedPoseGpu>();
        bytemuck::cast_slice_mut(&mut self.in_flight[flight].0.bytes_mut()[..bytes])
    }
}

//! The client's GPU stages, in the order of a display frame. Each is one file: layout, pipeline, `record`. Its shader and twin
//! have the same stem.
//!
//! Batches, lists, planes and eye poses enter. Recorded commands leave. Nothing here knows the times of bundles and the
//! barriers between stages, which are in `present/frame.rs`.

pub mod arena;
pub mod atlas_draw;
pub mod background;
pub mod batch;
pub mod hands;
pub mod interpolate;
pub mod notice;
pub mod pose;
pub mod probe;
pub mod scatter;
pub mod settle;
pub mod skin;
pub mod text;
pub mod upload;

use crate::display::EyeImages;
use atlas_draw::{AtlasDraw, Colours, EyeTargets, eye_buffers};
use background::Background;
use glam::{Mat4, Vec3, Vec4};
use hands::Hands;
use interpolate::Interpolate;
use notice::Notice;
use pose::PoseStage;
use scatter::Scatter;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Ticket, vk};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_shaders::generated::EyesGpu;
use skin::Skin;
use std::sync::Arc;
use std::thread::ScopedJoinHandle;

/// Display frames that the CPU may be ahead of the GPU. What the CPU writes for a frame exists this often.
pub const FRAMES_IN_FLIGHT: usize = 3;

/// Everything that a display frame does with the vertex memory: compute shaders write it, vertex shaders read it.
pub const VERTEX_MEMORY_USE: Access = Access(
    vk::PipelineStageFlags::from_raw(
        vk::PipelineStageFlags::VERTEX_SHADER.as_raw() | vk::PipelineStageFlags::COMPUTE_SHADER.as_raw(),
    ),
    vk::AccessFlags::from_raw(vk::AccessFlags::SHADER_READ.as_raw() | vk::AccessFlags::SHADER_WRITE.as_raw()),
);

/// Everything that what has arrived does with the memory of vertices and skeletons.
pub const ARRIVALS: Access = Access(
    vk::PipelineStageFlags::from_raw(
        vk::PipelineStageFlags::COMPUTE_SHADER.as_raw() | vk::PipelineStageFlags::TRANSFER.as_raw(),
    ),
    vk::AccessFlags::from_raw(Access::COMPUTE.1.as_raw() | vk::AccessFlags::TRANSFER_WRITE.as_raw()),
);

/// All stages, in order.
pub struct Stages {
    /// Deltas into the vertex memory.
    pub scatter: Scatter,
    /// Positions at the display time.
    pub interpolate: Interpolate,
    /// Skeletons at the display time.
    pub pose: PoseStage,
    /// Skinned positions at the display time.
    pub skin: Skin,
    /// The one draw.
    pub atlas: AtlasDraw,
    /// What is behind it.
    pub background: Background,
    /// Controllers in it.
    pub hands: Hands,
    /// Words in front of it.
    pub notice: Notice,
    /// Figures in front of it.
    pub figures: Notice,
    /// What is drawn to.
    pub targets: EyeTargets,
    /// The eyes of each frame in flight.
    pub eyes: [Buffer; FRAMES_IN_FLIGHT],
    last_use: [Option<Ticket>; FRAMES_IN_FLIGHT],
    next_flight: usize,
}

impl Stages {
    /// Pipelines and targets for `eyes`. `colours`: where those of blocks are.
    pub fn new(
        gpu: &Arc<Gpu>,
        eyes: EyeImages<'_>,
        samples: vk::SampleCountFlags,
        colours: Colours,
    ) -> Result<Self, GpuError> {
        let targets = EyeTargets::new(gpu, eyes, samples)?;
        let eyes = eye_buffers(gpu)?;
        let (pass, of_eyes) = (&targets.pass, eyes.each_ref());
        // A thread each: drivers compile on the thread that asks.
        let (moving, atlas, background, hands, notices) = std::thread::scope(|scope| {
            let moving = scope.spawn(|| {
                let (scatter, interpolate) = (Scatter::new(gpu)?, Interpolate::new(gpu)?);
                Ok((scatter, interpolate, PoseStage::new(gpu)?, Skin::new(gpu)?))
            });
            let atlas = scope.spawn(|| AtlasDraw::new(gpu, pass, colours));
            let background = scope.spawn(|| Background::new(gpu, pass, of_eyes));
            let hands = scope.spawn(|| Hands::new(gpu, pass, of_eyes));
            let notices = (Notice::new(gpu, pass, of_eyes)?, Notice::new(gpu, pass, of_eyes)?);
            Ok((joined(moving)?, joined(atlas)?, joined(background)?, joined(hands)?, notices))
        })?;
        let (scatter, interpolate, pose, skin) = moving;
        let (notice, figures) = notices;
        Ok(Self {
            scatter,
            interpolate,
            pose,
            skin,
            atlas,
            background,
            hands,
            notice,
            figures,
            targets,
            eyes,
            last_use: [None; FRAMES_IN_FLIGHT],
            next_flight: 0,
        })
    }

    /// Which of the frames in flight the next one is; `None` while the GPU is not done with the one before in its place.
    pub fn free_flight(&mut self, gpu: &Gpu) -> Result<Option<usize>, GpuError> {
        if let Some(ticket) = self.last_use[self.next_flight]
            && !gpu.is_done(ticket)?
        {
            return Ok(None);
        }
        Ok(Some(self.take_flight()))
    }

    /// The same, once the GPU is done with it: for who goes by a clock that waits too.
    pub fn wait_for_flight(&mut self, gpu: &Gpu) -> Result<usize, GpuError> {
        if let Some(ticket) = self.last_use[self.next_flight] {
            gpu.wait(ticket)?;
        }
        Ok(self.take_flight())
    }

    fn take_flight(&mut self) -> usize {
        let flight = self.next_flight;
        self.next_flight = (flight + 1) % FRAMES_IN_FLIGHT;
        self.last_use[flight] = None;
        flight
    }

    /// Writes the eyes that the recording for `flight`, not yet submitted, will read.
    pub fn write_eyes(&mut self, flight: usize, eyes: &EyesGpu) {
        self.eyes[flight].write(0, bytemuck::bytes_of(eyes));
    }

    /// Notes which recording is in flight there.
    pub fn used_by(&mut self, flight: usize, ticket: Ticket) {
        self.last_use[flight] = Some(ticket);
    }
}

fn joined<T>(thread: ScopedJoinHandle<'_, Result<T, GpuError>>) -> Result<T, GpuError> {
    thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}

/// What the shaders must know of two eyes in the world, and of the same eyes in the backdrop's space.
pub fn eyes_gpu(world_from_eye: [Pose; 2], space_from_eye: [Pose; 2], fov: [Fov; 2]) -> EyesGpu {
    let clip_from_world = |eye: usize| fov[eye].clip_from_eye() * world_from_eye[eye].inverse().matrix();
    let direction = |eye: usize| direction_from_clip(space_from_eye[eye], fov[eye]);
    let position = |eye: usize| space_from_eye[eye].position.extend(1.0).to_array();
    EyesGpu {
        clip_from_world: [clip_from_world(0), clip_from_world(1)].map(|m| m.to_cols_array_2d()),
        space_from_clip_direction: [direction(0), direction(1)].map(|m| m.to_cols_array_2d()),
        space_eye: [position(0), position(1)],
        blend: [1.0, 0.0, 0.0, 0.0],
    }
}

/// Takes (ndc, 1, 0) to a direction in the space, of length 1 along the view axis.
fn direction_from_clip(space_from_eye: Pose, fov: Fov) -> Mat4 {
    let (l, r, u, d) = (fov.left.tan(), fov.right.tan(), fov.up.tan(), fov.down.tan());
    let turned = |x: f32, y: f32, z: f32| (space_from_eye.orientation * Vec3::new(x, y, z)).extend(0.0);
    Mat4::from_cols(
        turned((r - l) * 0.5, 0.0, 0.0),
        turned(0.0, (d - u) * 0.5, 0.0),
        turned((r + l) * 0.5, (u + d) * 0.5, -1.0),
        Vec4::ZERO,
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    #[test]
    fn a_direction_from_clip_projects_back_to_the_same_place() {
        let fov = Fov { left: -0.8, right: 0.6, up: 0.5, down: -0.7 };
        let pose = Pose { position: Vec3::new(1.0, 2.0, 3.0), orientation: Quat::from_rotation_y(0.7) };
        let eyes = eyes_gpu([pose; 2], [pose; 2], [fov; 2]);
        for ndc in [[0.0, 0.0], [-1.0, 1.0], [0.3, -0.9]] {
            let direction = Mat4::from_cols_array_2d(&eyes.space_from_clip_direction[1])
                * Vec4::new(ndc[0], ndc[1], 1.0, 0.0);
            let point = (pose.position + direction.truncate() * 5.0).extend(1.0);
            let clip = Mat4::from_cols_array_2d(&eyes.clip_from_world[1]) * point;
            let seen = clip.truncate().truncate() / clip.w;
            assert!((seen.x - ndc[0]).abs() < 1e-5 && (seen.y - ndc[1]).abs() < 1e-5, "{ndc:?}: {seen}");
        }
    }
}

//! The stages of a display frame with what they share: one per headset session, whatever connections come and go.

use crate::stages::atlas_draw::{AtlasDraw, EyeTargets, eye_buffers};
use crate::stages::background::Background;
use crate::stages::interpolate::Interpolate;
use crate::stages::notice::Notice;
use crate::stages::scatter::Scatter;
use crate::stages::{FRAMES_IN_FLIGHT, wait_for};
use crate::xr::Swapchain;
use shadecast_gpu::{Buffer, Gpu, GpuError, Ticket, vk};
use shadecast_shaders::generated::EyesGpu;
use std::sync::Arc;

/// All stages, in order.
pub struct Stages {
    /// Deltas into the vertex memory.
    pub scatter: Scatter,
    /// Positions at the display time.
    pub interpolate: Interpolate,
    /// The one draw.
    pub atlas: AtlasDraw,
    /// What is behind it.
    pub background: Background,
    /// Words in front of it.
    pub notice: Notice,
    /// What is drawn to.
    pub targets: EyeTargets,
    /// The eyes of each frame in flight.
    pub eyes: [Buffer; FRAMES_IN_FLIGHT],
    last_use: [Option<Ticket>; FRAMES_IN_FLIGHT],
    next_slot: usize,
}

impl Stages {
    /// Pipelines and targets for `swapchain`.
    pub fn new(
        gpu: &Arc<Gpu>,
        swapchain: &Swapchain,
        samples: vk::SampleCountFlags,
    ) -> Result<Self, GpuError> {
        let extent = swapchain.extent_pixels();
        let targets = EyeTargets::new(gpu, swapchain.images(), swapchain.format(), extent, samples)?;
        let eyes = eye_buffers(gpu)?;
        Ok(Self {
            scatter: Scatter::new(gpu)?,
            interpolate: Interpolate::new(gpu)?,
            atlas: AtlasDraw::new(gpu, &targets.pass)?,
            background: Background::new(gpu, &targets.pass, eyes.each_ref())?,
            notice: Notice::new(gpu, &targets.pass, eyes.each_ref())?,
            targets,
            eyes,
            last_use: [None; FRAMES_IN_FLIGHT],
            next_slot: 0,
        })
    }

    /// The frame slot of the next frame, once the GPU has done with its last user. The only wait of a display frame.
    pub fn next_slot(&mut self, gpu: &Gpu) -> Result<usize, GpuError> {
        let slot = self.next_slot;
        self.next_slot = (slot + 1) % FRAMES_IN_FLIGHT;
        wait_for(gpu, &mut self.last_use[slot])?;
        Ok(slot)
    }

    /// Writes the eyes that the recording for `frame_slot`, not yet submitted, will read.
    pub fn write_eyes(&mut self, frame_slot: usize, eyes: &EyesGpu) {
        self.eyes[frame_slot].write(0, bytemuck::bytes_of(eyes));
    }

    /// Notes which recording reads the slot.
    pub fn used_by(&mut self, frame_slot: usize, ticket: Ticket) {
        self.last_use[frame_slot] = Some(ticket);
    }
}

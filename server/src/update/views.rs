//! The views buffer: the predicted views of an update, their turned parts, and glances around the head, as shaders read them.

use crate::scene::views::predicted_view_gpu;
use crate::update::eye::EyeSize;
use crate::visibility::frusta::{Frusta, Frustum};
use crate::visibility::passes::id_buffer::shift_ndc;
use crate::visibility::predict::{PredictedViews, View};
use crate::visibility::sweep::Glance;
use glam::{Mat4, Vec3};
use shadecast_gpu::{Buffer, Gpu, GpuError, Memory};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::limits::MAX_VIEWS;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_shaders::constants::{EYES, ID_BUFFER_VIEWS};
use shadecast_shaders::generated::ViewGpu;
use std::sync::Arc;

/// See the module.
pub(crate) struct ViewsBuffer {
    /// Read by the passes of visibility.
    pub buffer: Buffer,
    eye: EyeSize,
    /// Of the ID buffer that the next views are drawn to, pixels.
    pub extent: [u32; 2],
}

impl ViewsBuffer {
    /// For eyes that are drawn into an ID buffer of this extent.
    pub(crate) fn new(gpu: &Arc<Gpu>, eye: EyeSize, id_buffer_extent: [u32; 2]) -> Result<Self, GpuError> {
        let bytes = u64::from(ID_BUFFER_VIEWS) * size_of::<ViewGpu>() as u64;
        Ok(Self { buffer: Buffer::new(gpu, "views", bytes, Memory::Upload)?, eye, extent: id_buffer_extent })
    }

    /// As it was when it was made. No submitted work still reads it.
    pub(crate) fn wipe(&mut self) {
        self.buffer.bytes_mut().fill(0);
    }

    /// Writes the views of an update. Returns the number of turned frusta of each eye; 0: each is drawn as it is.
    pub(crate) fn write(&mut self, views: &PredictedViews, update: UpdateId, texels_per_pixel: f32) -> usize {
        let eyes = || views.eyes.iter().flat_map(|pair| pair.iter().enumerate()).enumerate();
        let turned_frusta = eyes().map(|(_, (_, view))| Frusta::of(view.fov).turned()).max().unwrap_or(0);
        for (index, (side, view)) in eyes() {
            let shift_ndc = self.shift_ndc(update.0, index as u32, MAX_VIEWS);
            let shown = self.eye.fovs[side];
            let texels = self.eye.pixels_per_tangent_of(shown).map(|pixels| pixels * texels_per_pixel);
            self.write_view(index, view, shift_ndc, (shown, texels));
            let frusta = Frusta::of(view.fov);
            for number in 0..turned_frusta {
                let index = MAX_VIEWS as usize * (1 + number) + index;
                self.write_view(index, &turned(view, frusta.at(number)), shift_ndc, (shown, texels));
            }
        }
        turned_frusta
    }

    /// Writes the two views of a glance in place of all pairs: an extent is the largest of all.
    pub(crate) fn write_glance(&mut self, glance: &Glance) {
        for index in 0..MAX_VIEWS {
            let side = index % EYES;
            let view = &glance.views[side as usize];
            let shift_ndc = self.shift_ndc(glance.number, side, EYES);
            let pixels = self.eye.pixels_per_tangent_of(self.eye.fovs[side as usize]);
            self.write_view(index as usize, view, shift_ndc, (view.fov, pixels));
        }
    }

    /// Shift of the samples of one of so many views, in a round of updates.
    fn shift_ndc(&self, number: u32, view: u32, views: u32) -> [f32; 2] {
        shift_ndc(number, view, views, self.extent.map(|side| side as f32))
    }

    /// `shown`: the part that the display shows, and its texels a tangent.
    fn write_view(&mut self, index: usize, view: &View, [x, y]: [f32; 2], shown: (Fov, [f32; 2])) {
        let shift = Mat4::from_translation(Vec3::new(x, y, 0.0));
        let clip_from_world = shift * view.fov.clip_from_eye() * view.world_from_eye.inverse().matrix();
        let gpu =
            predicted_view_gpu(clip_from_world, view.world_from_eye.position, view.fov, shown.0, shown.1);
        self.buffer.write(index * size_of::<ViewGpu>(), bytemuck::bytes_of(&gpu));
    }
}

/// The first view of each pair that the ID buffer is drawn from at a time: the predicted pair, from which extents are measured, or
/// its turned frusta in place of it.
pub(crate) fn first_views(time: usize, turned_frusta: usize) -> impl Iterator<Item = u32> + Clone {
    let groups = if turned_frusta == 0 { 0..=0 } else { 1..=turned_frusta as u32 };
    groups.map(move |group| MAX_VIEWS * group + EYES * time as u32)
}

fn turned(view: &View, Frustum { eye_from_frustum, fov }: Frustum) -> View {
    let eye_from_view = Pose { position: Vec3::ZERO, orientation: eye_from_frustum };
    View { world_from_eye: view.world_from_eye.then(eye_from_view), fov }
}

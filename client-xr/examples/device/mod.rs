//! What both measurements of draws share: a device with eyes to draw to, eyes that see clip space, and the middle of many values.

use shadecast_client::display::EyeImages;
use shadecast_client::draw::stages::FRAMES_IN_FLIGHT;
use shadecast_client::draw::stages::atlas_draw::{EyeTargets, eye_buffers};
use shadecast_gpu::{Buffer, DesktopDevice, Gpu, GpuError, GpuOptions, Image, ImageDesc, Needs, vk};
use shadecast_shaders::generated::EyesGpu;
use std::sync::Arc;

/// A client's device, and both eyes of `side` pixels, which can be copied from.
pub fn open(
    side: u32,
    format: vk::Format,
    samples: vk::SampleCountFlags,
) -> Result<(Arc<Gpu>, Image, EyeTargets), GpuError> {
    let options = GpuOptions { needs: Needs::Client, validation: false, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)?;
    let usage = vk::ImageUsageFlags::COLOR_ATTACHMENT | vk::ImageUsageFlags::TRANSFER_SRC;
    let desc = ImageDesc { layers: 2, ..ImageDesc::new("eyes", [side; 2], format, usage) };
    let image = Image::new(&gpu, desc)?;
    let images = &[image.handle()];
    let images = EyeImages { images, format, extent_pixels: [side; 2], one_eye: false, density_maps: None };
    let targets = EyeTargets::new(&gpu, images, samples)?;
    Ok((gpu, image, targets))
}

/// Eyes whose world is clip space.
pub fn eyes_in_clip_space(gpu: &Arc<Gpu>) -> Result<[Buffer; FRAMES_IN_FLIGHT], GpuError> {
    const IDENTITY: [[f32; 4]; 4] =
        [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    let eyes = EyesGpu {
        clip_from_world: [IDENTITY; 2],
        space_from_clip_direction: [IDENTITY; 2],
        space_eye: [[0.0; 4]; 2],
        blend: [0.5, 0.0, 0.0, 0.0],
    };
    let mut buffers = eye_buffers(gpu)?;
    buffers.iter_mut().for_each(|buffer| buffer.write(0, bytemuck::bytes_of(&eyes)));
    Ok(buffers)
}

/// The middle one; no number where there is none.
pub fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

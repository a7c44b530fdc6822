//! A window with the device that presents to it. One frame is in flight: data for the GPU is written after the previous frame
//! has finished.

use crate::present::{Present, Shows};
use ash::vk;
use shadecast_gpu::{
    Access, Buffer, Framebuffer, Gpu, GpuError, GpuOptions, Image, ImageDesc, Memory, Recorder, Swapchain,
    Ticket, Timings, WindowDevice, WindowImage,
};
use std::sync::Arc;
use winit::dpi::PhysicalSize;
use winit::event_loop::ActiveEventLoop;
use winit::raw_window_handle::{HasDisplayHandle, HasWindowHandle};
use winit::window::Window;

/// Pixels of a window where nobody says how many.
pub const DEFAULT_EXTENT: [u32; 2] = [1280, 800];

/// Why there is no window.
#[derive(Debug, thiserror::Error)]
pub enum CanvasError {
    /// No display, or it refuses.
    #[error("no window can be opened here: {0}")]
    NoDisplay(String),
    /// No device for it, or the device failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

impl CanvasError {
    /// What `winit` says of a display, without the place in its source that it puts before that.
    pub fn no_display(error: &dyn std::fmt::Display) -> Self {
        Self::NoDisplay(reason(&error.to_string()))
    }
}

fn reason(text: &str) -> String {
    let after_place = text.split_once(".rs:").and_then(|(_, rest)| rest.split_once(": "));
    after_place.map_or(text, |(_, reason)| reason).trim_end_matches('.').to_owned()
}

/// A window, its device and its images. Fields drop in order: what uses the window goes before it.
pub struct Canvas {
    present: Present,
    swapchain: Swapchain,
    gpu: Arc<Gpu>,
    window: Arc<Window>,
    last: Option<Ticket>,
}

/// A picture as it was on the window.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Screenshot {
    /// Width and height in pixels.
    pub extent: [u32; 2],
    /// Rows of red, green, blue.
    pub rgb8: Vec<u8>,
}

impl Canvas {
    /// Opens a window of `extent` pixels, as far as the desktop allows that, and a device for it.
    ///
    /// # Errors
    /// No display, or no device that can present to it.
    pub fn open(
        events: &ActiveEventLoop,
        title: &str,
        extent: [u32; 2],
        gpu: &GpuOptions,
        shows: Shows,
    ) -> Result<Self, CanvasError> {
        let attributes = Window::default_attributes()
            .with_title(format!("{title} - Shadecast"))
            .with_inner_size(PhysicalSize::new(extent[0], extent[1]));
        let made = events.create_window(attributes);
        let window = Arc::new(made.map_err(|error| CanvasError::no_display(&error))?);
        let display = window.display_handle().map_err(|error| CanvasError::no_display(&error))?.as_raw();
        let handle = window.window_handle().map_err(|error| CanvasError::no_display(&error))?.as_raw();
        let gpu = Gpu::open(gpu, &WindowDevice { display })?;
        // SAFETY: the window and, through the event loop, its display outlive the swapchain: fields drop in order.
        let swapchain = unsafe { Swapchain::new(&gpu, display, handle)? };
        let present = Present::new(&gpu, swapchain.pass(), !swapchain.codes_srgb(), shows)?;
        Ok(Self { present, swapchain, gpu, window, last: None })
    }

    /// The device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// The window.
    pub fn window(&self) -> &Arc<Window> {
        &self.window
    }

    /// Width and height of the images in pixels.
    pub fn extent(&self) -> [u32; 2] {
        self.swapchain.extent()
    }

    /// The last stage: what it shows, and its figures. Write to it after [`Canvas::finish`].
    pub fn present_mut(&mut self) -> &mut Present {
        &mut self.present
    }

    /// Waits for the frame that was presented last; what its stages took.
    pub fn finish(&mut self) -> Result<Option<Timings>, GpuError> {
        self.last.take().map(|ticket| self.gpu.wait_timed(ticket)).transpose()
    }

    /// The next image; `None` where the window has no area, or changed while it was asked. After [`Canvas::finish`].
    pub fn acquire(&mut self) -> Result<Option<WindowImage>, GpuError> {
        let size = self.window.inner_size();
        self.swapchain.acquire([size.width, size.height])
    }

    /// Draws what the stage shows over all of `image`, submits what was recorded, and shows it.
    pub fn present(&mut self, mut recorder: Recorder, image: WindowImage) -> Result<(), GpuError> {
        recorder.scope("present", |r| {
            self.present.record(r, self.swapchain.pass(), self.swapchain.target(&image));
        });
        self.window.pre_present_notify();
        self.last = Some(self.swapchain.present(recorder, image)?);
        Ok(())
    }

    /// Draws the last frame once more, as it is on the window.
    pub fn screenshot(&mut self) -> Result<Screenshot, GpuError> {
        self.finish()?;
        let (extent, format) = (self.swapchain.extent(), self.swapchain.format());
        let usage = vk::ImageUsageFlags::COLOR_ATTACHMENT | vk::ImageUsageFlags::TRANSFER_SRC;
        let image = Image::new(&self.gpu, ImageDesc::new("screenshot", extent, format, usage))?;
        let target = Framebuffer::new(&self.gpu, self.swapchain.pass(), extent, &[image.view()])?;
        let bytes = u64::from(extent[0]) * u64::from(extent[1]) * 4;
        let readback = Buffer::new(&self.gpu, "screenshot", bytes, Memory::Readback)?;
        let mut recorder = self.gpu.record()?;
        self.present.record(&mut recorder, self.swapchain.pass(), &target);
        let layouts = [vk::ImageLayout::PRESENT_SRC_KHR, vk::ImageLayout::TRANSFER_SRC_OPTIMAL];
        recorder.transition(&image, layouts, Access::COLOR_WRITE, Access::COPY_READ);
        recorder.read_image(&image, 0, &readback, 0);
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        self.gpu.wait(recorder.submit()?)?;
        let is_bgr = matches!(format, vk::Format::B8G8R8A8_SRGB | vk::Format::B8G8R8A8_UNORM);
        let order = if is_bgr { [2, 1, 0] } else { [0, 1, 2] };
        let pixels = readback.bytes()[..bytes as usize].chunks_exact(4);
        let rgb8 = pixels.flat_map(|p| order.map(|i| p[i])).collect();
        Ok(Screenshot { extent, rgb8 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn missing_display_is_explained_without_places_in_the_source() {
        let text = "os error at /a/b.rs:765: neither WAYLAND_DISPLAY nor DISPLAY is set.";
        assert_eq!(reason(text), "neither WAYLAND_DISPLAY nor DISPLAY is set");
        assert_eq!(reason("not supported"), "not supported");
    }
}

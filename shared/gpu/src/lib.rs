//! The only general Vulkan code of the project: device, memory, retire ring, pipelines from reflection, recorder. It does not
//! know scenes, atlases or headsets.

mod bind;
mod context;
mod devices;
#[cfg(target_os = "android")]
mod hardware_buffer;
mod kept_pipelines;
mod lanes;
pub mod limits;
mod lock;
mod memory;
mod pass;
mod pending;
mod pipeline;
mod recorder;
mod selftest;
mod shared_pipelines;
mod timings;
#[cfg(feature = "window")]
mod window;
mod ycbcr;

pub use ash::vk;
pub use bind::{Bind, BindGroup, FixedSampler, Layout};
pub use context::{DesktopDevice, DeviceSource, Gpu, GpuOptions, survey};
pub use devices::{DENSITY_MAP_EXTENSION, FoundDevice, Needs, PICTURE_EXTENSIONS};
#[cfg(target_os = "android")]
pub use hardware_buffer::HardwareBufferKind;
pub use memory::{Buffer, Image, ImageDesc, ImageLevel, Memory, MemoryUse, Sampler, SamplerDesc};
pub use pass::{Attachment, DENSITY_MAP_FORMAT, Foreign, Framebuffer, Part, RenderPass, RenderPassDesc};
pub use pipeline::{ComputePipeline, GraphicsPipeline, GraphicsPipelineDesc, VertexInput};
pub use recorder::{Access, Recorder, Ticket};
pub use shared_pipelines::HeldPipelines;
pub use timings::{Timing, Timings};
#[cfg(feature = "window")]
pub use window::{Swapchain, WindowDevice, WindowImage};
pub use ycbcr::{YcbcrFormat, YcbcrImage, YcbcrSampler};

/// What can go wrong with a device.
#[derive(Debug, thiserror::Error)]
pub enum GpuError {
    /// The Vulkan loader library is missing.
    #[error("the Vulkan loader could not be opened ({0}); {remedy}", remedy = devices::NO_LOADER)]
    NoLoader(String),
    /// No device does what is needed.
    #[error("no Vulkan device is usable: {0}")]
    NoDevice(String),
    /// More than the device can hold or bind at once; the text says what, and what to do.
    #[error("{0}")]
    TooLarge(String),
    /// A Vulkan call failed.
    #[error("{doing}: {result}")]
    Vulkan {
        /// What was being done.
        doing: &'static str,
        /// The driver's answer.
        result: vk::Result,
    },
    /// Device memory ran out or could not be had.
    #[error("{size} bytes of GPU memory for {name}: {reason}")]
    Memory {
        /// What for.
        name: String,
        /// Bytes asked for.
        size: u64,
        /// The allocator's answer.
        reason: String,
    },
}

impl GpuError {
    /// True where the device is gone: only opening it anew, and all that was on it, helps.
    pub fn is_lost(&self) -> bool {
        matches!(self, Self::Vulkan { result: vk::Result::ERROR_DEVICE_LOST, .. })
    }
}

/// Turns a Vulkan result into an error that says what was being done.
pub(crate) trait Doing<T> {
    fn doing(self, doing: &'static str) -> Result<T, GpuError>;
}

impl<T> Doing<T> for Result<T, vk::Result> {
    fn doing(self, doing: &'static str) -> Result<T, GpuError> {
        self.map_err(|result| GpuError::Vulkan { doing, result })
    }
}

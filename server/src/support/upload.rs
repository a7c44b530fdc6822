//! Arrays on the device, which may be empty or larger than it can bind.

use shadecast_gpu::limits::check;
use shadecast_gpu::{Buffer, Gpu, GpuError, Memory};
use shadecast_shaders::Shader;
use std::sync::Arc;

/// A device-local buffer of an array that may be empty; Vulkan has no empty buffers.
///
/// # Errors
/// Memory, or more than the device can bind.
pub(crate) fn array<T: bytemuck::Pod>(gpu: &Arc<Gpu>, name: &str, data: &[T]) -> Result<Buffer, GpuError> {
    check_room(gpu, name, size_of_val(data) as u64)?;
    match data.is_empty() {
        true => Buffer::new(gpu, name, 64, Memory::Device),
        false => Buffer::device_local(gpu, name, data),
    }
}

/// That the device can bind so many bytes of `what` as one buffer.
///
/// # Errors
/// It cannot; the text says what to do.
pub(crate) fn check_room(gpu: &Gpu, what: &str, bytes: u64) -> Result<(), GpuError> {
    let most = gpu.max_storage_buffer_bytes();
    if bytes <= most {
        return Ok(());
    }
    Err(GpuError::TooLarge(format!(
        "{} MiB are needed for the {what}, this device binds at most {} MiB at once; use fewer or smaller models",
        bytes.div_ceil(1 << 20),
        most >> 20
    )))
}

/// That the device can be given all workgroups of a dispatch of `shader` for so many of `what`.
///
/// # Errors
/// It cannot; the text says what to do.
pub(crate) fn check_groups(gpu: &Gpu, what: &str, items: u32, shader: &Shader) -> Result<(), GpuError> {
    let [side, ..] = shader.workgroup.expect("a compute shader");
    let groups = items.div_ceil(side);
    let what = format!("{items} {what} of a model, in workgroups,");
    check(gpu.limits(), "maxComputeWorkGroupCount[0]", &what, groups.into(), "use smaller models")
}

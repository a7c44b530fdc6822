//! `shadecast-lab device`, and the device that other subcommands would use.

use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use std::sync::Arc;

pub(super) fn run() -> anyhow::Result<()> {
    open_device().map(|_| ())
}

/// Opens the device that would be used, and says which it is.
pub(super) fn open_device() -> anyhow::Result<Arc<Gpu>> {
    let gpu = Gpu::open(
        &GpuOptions { needs: Needs::Server, validation: false, device_name: None },
        &DesktopDevice,
    )?;
    println!("Vulkan device: {}", gpu.device_name());
    if gpu.is_cpu() {
        println!("warning: this device is a CPU; everything works, slowly");
    }
    Ok(gpu)
}

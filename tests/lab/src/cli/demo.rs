//! `shadecast-lab demo`.

use super::device::open_device;
use clap::Args;
use shadecast_desktop::flags::{number, size};
use shadecast_lab::demo::window::{DemoWindowOptions, demo_window};
use shadecast_lab::demo::{DemoOptions, demo};
use shadecast_scene::load::SceneSource;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct DemoArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    #[arg(default_value = "courtyard")]
    scene: SceneSource,
    /// Server and a window, to look around in until it is closed; needs a desktop, and no simulator
    #[arg(long, conflicts_with_all = ["refresh", "virtual_seconds"])]
    window: bool,
    /// Folder for pictures and stats.json
    #[arg(long, default_value = "out/demo")]
    out: PathBuf,
    /// Pixels per eye [default: 1024x1024, of a window 1280x800; 256x256 and 480x300 on a CPU]
    #[arg(long, value_parser = size)]
    size: Option<[u32; 2]>,
    /// Display frames per second in real time [default: 72; 15 on a CPU]
    #[arg(long, value_parser = number(5.0..=240.0, "frames a second"))]
    refresh: Option<f64>,
    /// Seconds of streaming in real time [default: 6; of a window: until it is closed]
    #[arg(long, value_parser = number(0.5..=3600.0, "seconds"))]
    seconds: Option<f64>,
    /// Seconds of virtual time
    #[arg(long, default_value_t = 2.5, value_parser = number(0.5..=3600.0, "seconds"))]
    virtual_seconds: f64,
    /// Vulkan validation layers on
    #[arg(long)]
    validation: bool,
}

pub(super) fn run(args: DemoArgs) -> anyhow::Result<()> {
    let gpu = open_device()?;
    let is_cpu = gpu.is_cpu();
    drop(gpu);
    if args.window {
        return demo_window(&DemoWindowOptions {
            scene: args.scene,
            out: args.out,
            extent_pixels: args.size.unwrap_or(if is_cpu { [480, 300] } else { [1280, 800] }),
            seconds: args.seconds,
            validation: args.validation,
        });
    }
    let options = DemoOptions {
        scene: args.scene,
        out: args.out,
        extent_pixels: args.size.unwrap_or(if is_cpu { [256, 256] } else { [1024, 1024] }),
        seconds: args.seconds.unwrap_or(6.0),
        virtual_seconds: args.virtual_seconds,
        refresh_hz: args.refresh.unwrap_or(if is_cpu { 15.0 } else { 72.0 }),
        validation: args.validation,
    };
    let report = demo(&options)?;
    println!("Real time, two processes on this machine:\n{}", report.real_time);
    println!("Virtual time, as a fast machine shows it:\n{}", report.virtual_time);
    println!(
        "Open {} in a browser; the pictures alone: sheet.png beside it",
        options.out.join("index.html").display()
    );
    Ok(())
}

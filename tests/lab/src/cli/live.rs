//! `shadecast-lab live`.

use super::write_json;
use clap::Args;
use shadecast_desktop::flags::size;
use shadecast_lab::experiments::live::{LiveOptions, measure};
use shadecast_scene::load::SceneSource;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct LiveArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    #[arg(default_value = "dragons:3")]
    scene: SceneSource,
    /// Shows it in a window, which needs a desktop; else by the OpenXR runtime of this machine
    #[arg(long)]
    window: bool,
    /// Pixels of the window
    #[arg(long, value_name = "WxH", requires = "window", default_value = "1280x800", value_parser = size)]
    size: [u32; 2],
    /// Seconds of each of the two sessions, after the first picture
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u32).range(2..=3600))]
    seconds: u32,
    /// Folder for live.json, traces and the last picture of the window
    #[arg(long, default_value = "out/live")]
    out: PathBuf,
}

pub(super) fn run(args: LiveArgs) -> anyhow::Result<()> {
    let found = measure(&LiveOptions {
        scene: args.scene,
        out: args.out.clone(),
        window_pixels: args.window.then_some(args.size),
        seconds: args.seconds,
    })?;
    print!("{found}");
    write_json(&args.out.join("live.json"), &found)
}

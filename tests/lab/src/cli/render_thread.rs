//! `shadecast-lab render-thread`.

use anyhow::Context;

use clap::{Args, value_parser};
use shadecast_desktop::flags::number;
use shadecast_lab::experiments::{render_thread, table1};
use shadecast_scene::load::MAX_DRAGONS;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct RenderThreadArgs {
    /// Dragons, all in view
    #[arg(long, default_value_t = render_thread::DRAGONS, value_parser = value_parser!(u32).range(1..=i64::from(MAX_DRAGONS)))]
    dragons: u32,
    /// Part of the paper's 1300x1300 pixels a side for which the server chooses levels of detail
    #[arg(long, default_value_t = 1.0, value_parser = number(0.02..=1.0, "of the paper's sizes"))]
    scale: f64,
    /// Seconds that are streamed
    #[arg(long, default_value_t = render_thread::SECONDS, value_parser = number(1.0..=60.0, "seconds"))]
    seconds: f64,
    /// Folder for render-thread.json and the trace
    #[arg(long, default_value = "out/render-thread")]
    out: PathBuf,
}

pub(super) fn run(args: &RenderThreadArgs) -> anyhow::Result<()> {
    let size = table1::cell::Size::at(args.scale)?;
    let found = render_thread::measure(args.dragons, size, args.seconds, &args.out)?;
    print!("{found}");
    let path = args.out.join("render-thread.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&found)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

//! `shadecast-lab motion`.

use super::write_json;
use clap::Args;
use shadecast_desktop::flags::{MOST_S, number, size};
use shadecast_lab::experiments::motion_table::{self, Condition, KINDS, Kind};
use shadecast_lab::session::options::RunOptions;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_server_cli::arguments::GpuArgs;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct MotionArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    scene: String,
    /// The clip that animated instances play [default: the scene's own choice]
    #[arg(long)]
    clip: Option<String>,
    /// Ways in which vertices move, with commas between them [default: all]
    #[arg(long, value_delimiter = ',')]
    kinds: Vec<Kind>,
    /// A network, as of run, with outage=3s and updates=2 (a second) beside; may be given more than once [default: six]
    #[arg(long)]
    link: Vec<Condition>,
    /// Virtual seconds of each run; an outage begins after 2
    #[arg(long, default_value_t = 6.0, value_parser = number(0.01..=MOST_S, "seconds"))]
    seconds: f64,
    /// Pixels per eye
    #[arg(long, value_parser = size, default_value = "128x128")]
    size: [u32; 2],
    /// Atlas width and height in texels, powers of two from 512x512 to 4096x2048
    #[arg(long, value_name = "WxH", default_value_t = AtlasExtent::DEFAULT)]
    atlas: AtlasExtent,
    /// Seed of links and connections
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Writes the table to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
    #[command(flatten)]
    gpu: GpuArgs,
}

pub(super) fn run(args: MotionArgs) -> anyhow::Result<()> {
    let kinds = if args.kinds.is_empty() { KINDS.to_vec() } else { args.kinds };
    let links = if args.link.is_empty() { Condition::all() } else { args.link };
    let folder = std::env::temp_dir().join(format!("shadecast-motion-{}", std::process::id()));
    let options = RunOptions {
        clip: args.clip,
        seconds: args.seconds,
        extent_pixels: args.size,
        atlas_extent_texels: args.atlas,
        seed: args.seed,
        validation: args.gpu.validation,
        device: args.gpu.device,
        verbose: true,
        ..RunOptions::new(args.scene.parse()?, folder.clone())
    };
    let found = motion_table::measure(&options, &args.scene, &kinds, &links);
    let _ = std::fs::remove_dir_all(&folder);
    let found = found?;
    println!("{found}");
    args.json.iter().try_for_each(|path| write_json(path, &found))
}

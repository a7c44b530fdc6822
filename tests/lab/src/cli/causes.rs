//! `shadecast-lab causes`.

use super::run::ReconstructionArgument;
use super::write_json;
use clap::Args;
use shadecast_desktop::flags::{MOST_S, number, size};
use shadecast_lab::experiments::causes::{self, CAUSES, Cause};
use shadecast_lab::session::options::{RunOptions, USUAL_LINK};
use shadecast_server_cli::arguments::GpuArgs;
use std::path::{Path, PathBuf};

#[derive(Args)]
pub(super) struct CausesArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    scene: String,
    /// The causes, with commas between them [default: all]
    #[arg(long, value_enum, value_delimiter = ',')]
    cause: Vec<Cause>,
    /// How the client finds colours between the atlas's texels in the run as it ships
    #[arg(long, value_enum, default_value = "bilinear")]
    reconstruction: ReconstructionArgument,
    /// The network of the run as it ships, as of run
    #[arg(long, default_value = USUAL_LINK)]
    link: String,
    /// Virtual seconds of each run, the first of which is not compared
    #[arg(long, default_value_t = causes::SECONDS, value_parser = number(1.2..=MOST_S, "seconds"))]
    seconds: f64,
    /// Pixels per eye
    #[arg(long, value_parser = size, default_value = "256x256")]
    size: [u32; 2],
    /// Writes the table to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
    #[command(flatten)]
    gpu: GpuArgs,
}

pub(super) fn run(args: CausesArgs) -> anyhow::Result<()> {
    let causes = if args.cause.is_empty() { CAUSES.to_vec() } else { args.cause };
    let folder = std::env::temp_dir().join(format!("shadecast-causes-{}", std::process::id()));
    let options = RunOptions {
        link: args.link.parse()?,
        reconstruction: args.reconstruction.into(),
        seconds: args.seconds,
        extent_pixels: args.size,
        validation: args.gpu.validation,
        device: args.gpu.device,
        verbose: true,
        ..causes::usual(args.scene.parse()?, folder.clone())
    };
    let name = Path::new(&args.scene).file_name().unwrap_or_default().to_string_lossy();
    let found = causes::measure(&options, &name, &causes);
    let _ = std::fs::remove_dir_all(&folder);
    let found = found?;
    println!("{found}");
    args.json.iter().try_for_each(|path| write_json(path, &found))
}

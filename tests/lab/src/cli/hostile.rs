//! `shadecast-lab hostile`.

use anyhow::Context;

use clap::Args;
use shadecast_lab::hostile::{self, HostileOptions};
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct HostileArgs {
    /// Which attack; may be given more than once
    #[arg(long, default_value = "all")]
    attack: Vec<String>,
    /// Seconds that each lasts
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// What is served: courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml [default: one turning cube]
    #[arg(long)]
    scene: Option<String>,
    /// Writes the figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

pub(super) fn run(args: HostileArgs) -> anyhow::Result<()> {
    anyhow::ensure!(
        (0.1..=600.0).contains(&args.seconds),
        "--seconds {} must lie between 0.1 and 600",
        args.seconds
    );
    let options = HostileOptions {
        attacks: args.attack,
        scene: args.scene,
        verbose: true,
        ..HostileOptions::all(args.seconds)
    };
    let report = hostile::run(&options)?;
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&report)?)
            .with_context(|| format!("writing {}", path.display()))?;
    }
    let misses = report.misses();
    anyhow::ensure!(misses.is_empty(), "{} of the bars were missed", misses.len());
    Ok(())
}

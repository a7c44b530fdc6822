//! `shadecast-lab skinning`.

use anyhow::Context;

use clap::Args;
use shadecast_lab::experiments::skinning;
use shadecast_server_cli::arguments::SamplingArgs;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct SkinningArgs {
    /// courtyard, dragons:N, a .glb/.gltf file, or a scene .toml
    #[arg(default_value = "dragons:9")]
    scene: String,
    #[command(flatten)]
    sampling: SamplingArgs,
    /// Writes the figures to this JSON file
    #[arg(long)]
    out: Option<PathBuf>,
}

pub(super) fn run(args: &SkinningArgs) -> anyhow::Result<()> {
    let report = skinning::measure(&args.scene.parse()?, args.sampling.sampling)?;
    println!("{report}");
    if let Some(path) = &args.out {
        shadecast_system::write_atomically(path, serde_json::to_string_pretty(&report)?.as_bytes())
            .with_context(|| format!("writing {}", path.display()))?;
    }
    Ok(())
}

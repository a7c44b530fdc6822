//! `shadecast-lab slow`.

use super::run::{RunArgs, run_options};
use anyhow::Context;
use clap::Args;
use shadecast_lab::experiments::slow::{self, SLOWER};

#[derive(Args)]
pub(super) struct SlowArgs {
    #[command(flatten)]
    run: RunArgs,
    /// How many times slower than --stage-ms a device is; may be given more than once [default: 1, 2, 4, 8, 15 and 30]
    #[arg(long, value_name = "TIMES")]
    slower: Vec<f64>,
}

pub(super) fn run(SlowArgs { run, slower }: SlowArgs) -> anyhow::Result<()> {
    let (out, scene) = (run.out.clone(), run.scene.clone());
    let slower = if slower.is_empty() { SLOWER.to_vec() } else { slower };
    let report = slow::measure(&run_options(run)?, &scene, &slower)?;
    print!("{report}");
    let path = out.join("slow.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&report)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

//! `shadecast-lab links`.

use super::run::{RunArgs, run_options};
use anyhow::Context;
use clap::Args;
use shadecast_lab::experiments::links;

#[derive(Args)]
pub(super) struct LinksArgs {
    #[command(flatten)]
    run: RunArgs,
    /// Measures only links whose name begins so: steps, LAN, "20 ms", nothing, another, restart, beside
    #[arg(long, default_value = "")]
    only: String,
}

pub(super) fn run(LinksArgs { run, only }: LinksArgs) -> anyhow::Result<()> {
    let (out, scene) = (run.out.clone(), run.scene.clone());
    let report = links::measure(&run_options(run)?, &scene, |name| name.starts_with(&only))?;
    anyhow::ensure!(!report.rows.is_empty(), "no link's name begins with \"{only}\"");
    let path = out.join("links.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&report)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))?;
    let misses = report.missed_bars();
    anyhow::ensure!(misses == 0, "{misses} bars are missed: the rows with MISSED");
    Ok(())
}

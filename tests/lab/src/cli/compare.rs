//! `shadecast-lab compare`.

use anyhow::ensure;
use clap::Args;
use shadecast_lab::results::compare::compare;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct CompareArgs {
    /// The earlier result, or a folder of results
    before: PathBuf,
    /// The later one
    after: PathBuf,
}

/// Prints what changed; fails where a figure became worse beyond noise, or is gone.
pub(super) fn run(args: &CompareArgs) -> anyhow::Result<()> {
    let found = compare(&args.before, &args.after)?;
    println!("{found}");
    let regressions = found.regressions();
    ensure!(regressions == 0, "{regressions} figures are worse than before, or gone");
    Ok(())
}

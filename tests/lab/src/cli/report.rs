//! `shadecast-lab report`.

use clap::Args;
use shadecast_lab::results::page::{self, MOST_BYTES};
use shadecast_lab::results::sources::freshness;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct ReportArgs {
    /// Folder of the JSON results
    #[arg(long, default_value = "docs/results")]
    results: PathBuf,
    /// Stills: a folder of `run --dump-every`, or one with such a folder for each way [default: the README's picture]
    #[arg(long)]
    pictures: Option<PathBuf>,
    /// The page
    #[arg(long)]
    out: PathBuf,
}

pub(super) fn run(args: &ReportArgs) -> anyhow::Result<()> {
    let bytes = page::write(&args.results, args.pictures.as_deref(), &args.out)?;
    let large = if bytes > MOST_BYTES { ", larger than it should be" } else { "" };
    println!("{}: {:.2} MB{large}", args.out.display(), bytes as f64 * 1e-6);
    println!("{}", freshness(&args.results));
    Ok(())
}

//! `shadecast-lab scale`.

use super::write_json;
use clap::{Args, value_parser};
use shadecast_lab::experiments::scale::{self, Axis};
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct ScaleArgs {
    /// What grows, with commas between [default: all]
    #[arg(long, value_enum, value_delimiter = ',')]
    axes: Vec<Axis>,
    /// Rounds of each run; medians count
    #[arg(long, default_value_t = 3, value_parser = value_parser!(u32).range(1..=100))]
    rounds: u32,
    /// Folder for scale.json
    #[arg(long, default_value = "out/scale")]
    out: PathBuf,
}

pub(super) fn run(args: &ScaleArgs) -> anyhow::Result<()> {
    let axes = if args.axes.is_empty() { &Axis::ALL[..] } else { &args.axes };
    let found = scale::measure(axes, args.rounds as usize, &args.out)?;
    print!("{found}");
    write_json(&args.out.join("scale.json"), &found)
}

//! `shadecast-lab table1`.

use clap::{Args, value_parser};
use shadecast_desktop::flags::number;
use shadecast_lab::experiments::table1::{self, Table1Options};
use shadecast_scene::load::MAX_DRAGONS;
use shadecast_server_cli::arguments::GpuArgs;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct Table1Args {
    /// Numbers of dragons, with commas between them [default: the paper's]
    #[arg(long, value_delimiter = ',', value_parser = value_parser!(u32).range(1..=i64::from(MAX_DRAGONS)))]
    dragons: Vec<u32>,
    /// Rounds, in each of which everything is measured once
    #[arg(long, default_value_t = table1::ROUNDS, value_parser = value_parser!(u32).range(1..))]
    rounds: u32,
    /// Updates that are measured in each round
    #[arg(long, default_value_t = 5, value_parser = value_parser!(u32).range(1..))]
    updates: u32,
    /// Part of the paper's 1300x1300 pixels a side [default: 1; 0.125 on a CPU]
    #[arg(long, value_parser = number(0.02..=1.0, "of the paper's sizes"))]
    scale: Option<f64>,
    /// Also by the paper's ways: skinning by chains, three predictions of 48 bytes a vertex with each update, on lines between
    #[arg(long)]
    as_paper: bool,
    /// Folder for table1.json, .csv, .svg and table1-cost.svg; a run that was broken off goes on there
    #[arg(long, default_value = "out/table1")]
    out: PathBuf,
    #[command(flatten)]
    gpu: GpuArgs,
}

pub(super) fn run(args: Table1Args) -> anyhow::Result<()> {
    let scale = match args.scale {
        Some(scale) => scale,
        None => table1::usual_scale(args.gpu.device.as_deref())?,
    };
    let usual = Table1Options::new(args.out, scale);
    let options = Table1Options {
        dragons: if args.dragons.is_empty() { usual.dragons } else { args.dragons },
        rounds: args.rounds,
        updates: args.updates,
        as_paper: args.as_paper,
        validation: args.gpu.validation,
        device: args.gpu.device,
        ..usual
    };
    let report = table1::measure(&options, &|line| println!("{line}"))?;
    print!("{report}");
    println!("written to {}", options.out.display());
    Ok(())
}

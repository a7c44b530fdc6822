//! `shadecast-lab abrupt`.

use super::run::{RunArgs, run_options};
use shadecast_lab::experiments::abrupt;

pub(super) fn run(args: RunArgs) -> anyhow::Result<()> {
    let report = abrupt::measure(&run_options(args)?)?;
    println!("{report}");
    Ok(())
}

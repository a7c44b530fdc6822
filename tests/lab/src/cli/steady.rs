//! `shadecast-lab steady`.

use super::run::{RunArgs, run_options};
use anyhow::Context;
use shadecast_lab::experiments::steadiness;

pub(super) fn run(args: RunArgs) -> anyhow::Result<()> {
    let out = args.out.clone();
    let report = steadiness::measure(&run_options(args)?)?;
    print!("{report}");
    let path = out.join("steadiness.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&report)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

//! `shadecast-lab detail`.

use super::run::{RunArgs, run_options};
use anyhow::Context;
use shadecast_lab::experiments::detail;

pub(super) fn run(args: RunArgs) -> anyhow::Result<()> {
    let out = args.out.clone();
    let report = detail::measure(&run_options(args)?)?;
    print!("{report}");
    let path = out.join("detail.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&report)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

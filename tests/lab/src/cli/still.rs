//! `shadecast-lab still`.

use super::run::{RunArgs, run_options};
use anyhow::Context;
use shadecast_lab::experiments::still;

pub(super) fn run(args: RunArgs) -> anyhow::Result<()> {
    let path = args.out.join("still.json");
    let found = still::measure(&run_options(args)?)?;
    println!("{found}");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&found)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

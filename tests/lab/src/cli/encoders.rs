//! `shadecast-lab encoders`.

use anyhow::Context;

use std::path::Path;

pub(super) fn run(out: &Path) -> anyhow::Result<()> {
    let found = shadecast_lab::experiments::encoders::measure(out)?;
    print!("{found}");
    let path = out.join("encoders.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&found)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

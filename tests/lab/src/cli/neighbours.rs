//! `shadecast-lab neighbours`.

use anyhow::Context;

use shadecast_lab::hostile;
use std::path::Path;

pub(super) fn run(seconds: f64, json: Option<&Path>) -> anyhow::Result<()> {
    anyhow::ensure!((0.5..=600.0).contains(&seconds), "--seconds {seconds} must lie between 0.5 and 600");
    let report = hostile::neighbours::measure(seconds)?;
    println!("{report}");
    if let Some(path) = json {
        std::fs::write(path, serde_json::to_string_pretty(&report)?)
            .with_context(|| format!("writing {}", path.display()))?;
    }
    Ok(())
}

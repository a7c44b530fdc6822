//! `shadecast-lab bars`.

use anyhow::Context;

use shadecast_lab::results::bars::{BARS, Bars};
use std::path::Path;

/// Prints every figure beside its bar.
pub(super) fn run(results: &Path, bars: Option<&Path>) -> anyhow::Result<()> {
    let text = match bars {
        Some(path) => std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?,
        None => BARS.to_owned(),
    };
    let report = Bars::parse(&text)?.check(results);
    println!("{report}");
    anyhow::ensure!(report.failures() == 0, "{} bars are missed", report.failures());
    Ok(())
}

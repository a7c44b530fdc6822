//! `shadecast-lab merge-traces`.

use std::path::{Path, PathBuf};

/// Puts traces into one, and says how busy each row was, and the device beside the encoder.
pub(super) fn run(traces: &[PathBuf], out: &Path) -> anyhow::Result<()> {
    shadecast_trace::merge(traces, out)?;
    let shares = shadecast_trace::Shares::read(out)?;
    println!("{} ms", (shares.took_us * 1e-3).round());
    for (row, share) in shares.rows() {
        println!("{row:<16} at work {:5.1} %", share * 100.0);
    }
    let at_once = shares.at_once("server device", "server encoder") * 100.0;
    println!("device and encoder at once {at_once:.1} %");
    Ok(())
}

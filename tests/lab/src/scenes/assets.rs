//! Real models for the runs, where present; the project ships none.

use std::path::{Path, PathBuf};

/// The model of this name, where it is there.
pub fn asset(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets").join(name);
    path.exists().then_some(path)
}

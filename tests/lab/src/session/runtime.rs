//! The mock OpenXR runtime as a client of the lab's finds it: its configuration, and the variables that lead to it.

use anyhow::Context;
use shadecast_mock_runtime::config::MockConfig;
use shadecast_mock_runtime::manifest;
use std::path::{Path, PathBuf};

/// A walk of a few steps to the side and forward, turning the head: 5 s, then it goes back the same way.
pub const BUILT_IN_WALK: &str = include_str!("walk.csv");

/// Writes the mock runtime's configuration and points the process's OpenXR loader to it.
///
/// # Errors
/// The folder cannot be written, or the runtime library is not built.
pub fn prepare_runtime(config: &MockConfig, folder: &Path) -> anyhow::Result<[(&'static str, PathBuf); 2]> {
    std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    let config_path = folder.join("mock.json");
    config.write(&config_path).with_context(|| format!("writing {}", config_path.display()))?;
    let library = manifest::find_library()
        .context("the mock OpenXR runtime is not built; run `cargo build -p shadecast-mock-runtime`")?;
    let manifest = manifest::write(folder, &library).context("writing the runtime's manifest")?;
    Ok([("XR_RUNTIME_JSON", manifest), (shadecast_mock_runtime::config::CONFIG_VARIABLE, config_path)])
}

/// Sets the variables that the OpenXR loader and the mock runtime read.
///
/// # Safety
/// No other thread may read or write the environment meanwhile.
pub unsafe fn set_runtime(variables: &[(&'static str, PathBuf)]) {
    for (name, value) in variables {
        // SAFETY: the caller's promise.
        unsafe { std::env::set_var(name, value) };
    }
}

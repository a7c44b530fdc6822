//! The mock OpenXR runtime for a test in one process.

use shadecast_mock_runtime::config::{CONFIG_VARIABLE, MockConfig};
use shadecast_mock_runtime::manifest;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// The right to be the only test of the process that runs or reads the environment, where the OpenXR loader looks.
pub fn turn() -> MutexGuard<'static, ()> {
    static TURN: Mutex<()> = Mutex::new(());
    TURN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// One run of the runtime: its folder, its environment, and the [`turn`].
pub struct Run {
    folder: tempfile::TempDir,
    _turn: MutexGuard<'static, ()>,
}

impl Run {
    /// Sets the environment up for `config`, whose capture folder becomes [`Self::captures`].
    pub fn new(config: &MockConfig) -> Self {
        let run = Self::unconfigured();
        let config = MockConfig { capture_dir: Some(run.captures()), ..config.clone() };
        config.write(&run.config_path()).expect("write the configuration");
        run
    }

    /// Sets the environment up, without a configuration file yet.
    pub fn unconfigured() -> Self {
        let turn = turn();
        let folder = tempfile::tempdir().expect("a temporary folder");
        let library = manifest::find_library().expect("the mock runtime is built beside the tests");
        let manifest = manifest::write(folder.path(), &library).expect("write the manifest");
        let run = Self { folder, _turn: turn };
        // SAFETY: the turn makes this the only test that runs, and nothing else reads the environment meanwhile.
        unsafe {
            std::env::set_var("XR_RUNTIME_JSON", manifest);
            std::env::set_var(CONFIG_VARIABLE, run.config_path());
        }
        run
    }

    /// Its folder.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Where its configuration is, or is to be.
    pub fn config_path(&self) -> PathBuf {
        self.folder().join("mock.json")
    }

    /// Where its pictures and its log go.
    pub fn captures(&self) -> PathBuf {
        self.folder().join("captures")
    }
}

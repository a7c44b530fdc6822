//! The Android activity as the client sees it: a Java machine, an activity object, two folders, and events that must be
//! answered.
//!
//! `NativeActivity` calls us on Java's main thread, and `android-activity` holds that thread until `android_main` has taken
//! the event. Whoever runs on `android_main` must therefore call [`Activity::poll`] often, and never wait long for anything
//! else; and every input event must be taken from its queue, or the system reports an application that does not respond.

use crate::settings::{FILE_BYTES_MAX, FILE_NAME, Settings};
use android_activity::{AndroidApp, InputStatus, MainEvent, PollEvent};
use anyhow::Context;
use openxr::AndroidPlatformInfo;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// The running activity.
pub struct Activity {
    app: AndroidApp,
    destroyed: bool,
}

impl Activity {
    /// Wraps what `android_main` was given.
    pub fn new(app: AndroidApp) -> Self {
        Self { app, destroyed: false }
    }

    /// Answers all events that wait, and waits up to `timeout` for the first. Returns whether the activity goes on.
    pub fn poll(&mut self, timeout: Duration) -> bool {
        let mut destroyed = self.destroyed;
        let mut has_input = false;
        self.app.poll_events(Some(timeout), |event| match event {
            PollEvent::Main(MainEvent::Destroy) => destroyed = true,
            PollEvent::Main(MainEvent::InputAvailable) => has_input = true,
            PollEvent::Main(MainEvent::LowMemory) => tracing::warn!("the system is low on memory"),
            PollEvent::Main(event) => tracing::debug!("activity: {event:?}"),
            _ => {}
        });
        self.destroyed = destroyed;
        if has_input {
            self.discard_input();
        }
        !self.destroyed
    }

    /// Buttons come through OpenXR; what arrives here (a volume key, a paired keyboard) goes back to the system.
    fn discard_input(&self) {
        match self.app.input_events_iter() {
            Ok(mut events) => while events.next(|_| InputStatus::Unhandled) {},
            Err(error) => tracing::warn!("input events could not be taken: {error}"),
        }
    }

    /// What OpenXR must know of the process: the loader finds the runtime through it, and the runtime follows this activity.
    ///
    /// The pointers come from the activity itself. The `ndk_context` crate would give the *application* object instead
    /// (android-activity 0.6.1), which is no `android.app.Activity`, as `XR_KHR_android_create_instance` demands.
    pub fn openxr_platform(&self) -> AndroidPlatformInfo {
        // SAFETY: `vm_as_ptr` is the process's JavaVM, which never goes away. `activity_as_ptr` is a global reference to the
        // NativeActivity that stays valid until the last `AndroidApp` is dropped: the caller's loop ends before `self` does.
        unsafe { AndroidPlatformInfo::new(self.app.vm_as_ptr(), self.app.activity_as_ptr()) }
    }

    /// A private folder for what must survive a restart, such as the known servers.
    pub fn data_folder(&self) -> anyhow::Result<PathBuf> {
        self.app.internal_data_path().context("the system names no folder for this app's data")
    }

    /// The user's settings; a missing file means the defaults, a wrong one is reported and ignored.
    pub fn settings(&self) -> Settings {
        let Some(path) = self.app.external_data_path().map(|folder| folder.join(FILE_NAME)) else {
            return Settings::default();
        };
        let bytes = match read_bounded(&path) {
            Ok(bytes) => bytes,
            Err(error) => {
                tracing::info!("no settings: {}: {error}", path.display());
                return Settings::default();
            }
        };
        Settings::parse(&bytes).unwrap_or_else(|error| {
            tracing::error!("{error} (in {})", path.display());
            Settings::default()
        })
    }
}

/// One byte more than settings may have, so that a longer file is seen to be one.
fn read_bounded(path: &Path) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    File::open(path)?.take(FILE_BYTES_MAX as u64 + 1).read_to_end(&mut bytes)?;
    Ok(bytes)
}

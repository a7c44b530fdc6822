//! The client on its own thread. The activity's thread stays free to answer the system.

use crate::settings::{FORGETTING, Foveation, Settings};
use android_activity::AndroidApp;
use anyhow::Context;
use openxr::AndroidPlatformInfo;
use shadecast_client::client::ClientOptions;
use shadecast_client::display::Display;
use shadecast_client::display::xr::{Xr, XrOptions, foveation};
use shadecast_client::net::{self, RunOptions};
use shadecast_client::platform::Platform;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// How long the client may take to leave. Java's main thread waits for it; after 5 s the system would report the app.
const LEAVING_PATIENCE: Duration = Duration::from_secs(3);

/// The running client.
pub struct Headset {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<()>,
}

impl Headset {
    /// Starts the client; the activity's thread is woken when it has ended.
    ///
    /// `notice` is what the user is to read of the settings.
    pub fn start(
        app: AndroidApp,
        settings: Settings,
        notice: Option<String>,
        data_folder: PathBuf,
    ) -> anyhow::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let flag = Arc::clone(&stop);
        let thread = std::thread::Builder::new().name("headset".to_owned()).spawn(move || {
            match run(&app, &settings, notice, data_folder, &flag) {
                Ok(()) => tracing::info!("the session has ended"),
                Err(error) => tracing::error!("{error:#}"),
            }
            app.create_waker().wake();
        });
        Ok(Self { stop, thread: thread.context("starting the headset's thread")? })
    }

    /// True until the client has ended by itself.
    pub fn is_running(&self) -> bool {
        !self.thread.is_finished()
    }

    /// Asks the client to leave and waits for it.
    pub fn leave(self) {
        self.stop.store(true, Ordering::Relaxed);
        let start = Instant::now();
        while !self.thread.is_finished() {
            if start.elapsed() > LEAVING_PATIENCE {
                // Its session still uses an activity that is about to vanish.
                tracing::error!("the client did not end within {LEAVING_PATIENCE:?}; ending the process");
                std::process::exit(1);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        if self.thread.join().is_err() {
            tracing::error!("the client's thread panicked; its message is above");
        }
    }
}

/// Runtimes call Java from the thread that drives the session, so it is attached to the virtual machine for as long.
fn run(
    app: &AndroidApp,
    settings: &Settings,
    notice: Option<String>,
    data_folder: PathBuf,
    stop: &AtomicBool,
) -> anyhow::Result<()> {
    let options = RunOptions {
        server: settings.server().into(),
        fingerprint: settings.fingerprint,
        asks_first: settings.asks_first(),
        pipelines: Some(data_folder.clone()),
        identity_dir: data_folder,
        forgetting: Some(FORGETTING),
        notice,
        client: ClientOptions::default(),
        seconds: 0.0,
        trace: None,
    };
    // SAFETY: the pointer is the process's JavaVM, which never goes away.
    let machine = unsafe { jni::JavaVM::from_raw(app.vm_as_ptr().cast()) };
    machine.attach_current_thread(|_| {
        let platform = Platform { activity: openxr_platform(app) };
        let wanted = xr_options(settings);
        let mut open = || Ok(Box::new(Xr::open(&platform, wanted)?) as Box<dyn Display>);
        let outcome = net::run(&mut open, &options, stop, &mut |_, _| Ok(()));
        outcome.ended.context("showing the server's scene")
    })
}

fn xr_options(settings: &Settings) -> XrOptions {
    let foveation = settings.foveation.map(|level| match level {
        Foveation::None => foveation::Foveation::None,
        Foveation::Low => foveation::Foveation::Low,
        Foveation::Medium => foveation::Foveation::Medium,
        Foveation::High => foveation::Foveation::High,
    });
    let usual = XrOptions::default();
    XrOptions {
        refresh_hz: settings.refresh_hz.or(usual.refresh_hz),
        foveation: foveation.unwrap_or(usual.foveation),
        ..usual
    }
}

/// What OpenXR must know of the process: the loader finds the runtime through it, and the runtime follows this activity.
///
/// The pointers come from the activity itself. The `ndk_context` crate would give the *application* object instead
/// (android-activity 0.6.1), which is no `android.app.Activity`, as `XR_KHR_android_create_instance` demands.
fn openxr_platform(app: &AndroidApp) -> AndroidPlatformInfo {
    // SAFETY: `vm_as_ptr` is the process's JavaVM, which never goes away. `activity_as_ptr` is a global reference to the
    // NativeActivity, valid until the last `AndroidApp` is dropped, and the caller keeps `app` until the client has ended.
    unsafe { AndroidPlatformInfo::new(app.vm_as_ptr(), app.activity_as_ptr()) }
}

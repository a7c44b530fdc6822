//! The Android library around the Shadecast client.
//!
//! A headset starts an app as an activity, not through `main`. This crate answers the system's events, names the activity to
//! OpenXR, and runs the same client as everywhere else. On other systems only [`settings`] is compiled.

pub mod settings;

#[cfg(target_os = "android")]
mod activity;
#[cfg(target_os = "android")]
mod headset;
#[cfg(target_os = "android")]
mod intent;

/// Where `android-activity` starts the app, on a thread of its own; returning ends the activity.
#[cfg(target_os = "android")]
#[unsafe(no_mangle)] // SAFETY: `android-activity` declares just this function, and nothing else here carries its name.
fn android_main(app: android_activity::AndroidApp) {
    // Standard error goes to the system's log. A second start in the same process finds the subscriber there already.
    let log = tracing_subscriber::fmt().with_ansi(false).with_target(false).with_writer(std::io::stderr);
    let _ = log.try_init();
    activity::run(app);
}

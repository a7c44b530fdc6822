//! The Android activity. It answers the system's events and knows the app's folders.
//!
//! `NativeActivity` calls us on Java's main thread. `android-activity` holds that thread until `android_main` has taken the
//! event. So this thread does nothing else. Every input event must leave its queue; otherwise the system reports an application
//! that does not respond.

use crate::headset::Headset;
use crate::intent;
use crate::settings::{FILE_BYTES_MAX, FILE_NAME, Settings};
use android_activity::{AndroidApp, InputStatus, MainEvent, PollEvent};
use anyhow::Context;
use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::time::Duration;

/// Longest wait for an event. The headset's thread wakes this one when it ends; the limit is for a wake-up that got lost.
const POLL_TIMEOUT: Duration = Duration::from_millis(500);

/// Runs the client until it ends or the system destroys the activity.
pub fn run(app: AndroidApp) {
    let headset = match start(&app) {
        Ok(headset) => headset,
        Err(error) => return tracing::error!("{error:#}"),
    };
    while headset.is_running() && answer_events(&app) {}
    headset.leave();
}

fn start(app: &AndroidApp) -> anyhow::Result<Headset> {
    let data_folder = app.internal_data_path().context("the system names no folder for this app's data")?;
    let (settings, errors) = Settings::gather(&intent::extras(app), &file(app));
    errors.iter().for_each(|error| tracing::error!("{error}"));
    let notice = errors.first().map(ToString::to_string);
    Headset::start(app.clone(), settings, notice, data_folder)
}

/// Answers all events that wait, and waits for the first. Returns whether the activity goes on.
fn answer_events(app: &AndroidApp) -> bool {
    let mut goes_on = true;
    let mut has_input = false;
    app.poll_events(Some(POLL_TIMEOUT), |event| match event {
        PollEvent::Main(MainEvent::Destroy) => goes_on = false,
        PollEvent::Main(MainEvent::InputAvailable) => has_input = true,
        PollEvent::Main(MainEvent::LowMemory) => tracing::warn!("the system is low on memory"),
        PollEvent::Main(event) => tracing::debug!("activity: {event:?}"),
        _ => {}
    });
    if has_input {
        give_back_input(app);
    }
    goes_on
}

/// Buttons come through OpenXR; what arrives here (a volume key, a paired keyboard) is the system's to handle.
fn give_back_input(app: &AndroidApp) {
    match app.input_events_iter() {
        Ok(mut events) => while events.next(|_| InputStatus::Unhandled) {},
        Err(error) => tracing::warn!("input events could not be taken: {error}"),
    }
}

/// The user's settings file; none of its bytes where there is none.
fn file(app: &AndroidApp) -> Vec<u8> {
    let Some(path) = app.external_data_path().map(|folder| folder.join(FILE_NAME)) else {
        return Vec::new();
    };
    read_bounded(&path).unwrap_or_else(|error| {
        tracing::warn!("no settings: {}: {error}", path.display());
        Vec::new()
    })
}

/// One byte more than settings may have, so that a longer file is seen to be one.
fn read_bounded(path: &Path) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    File::open(path)?.take(FILE_BYTES_MAX as u64 + 1).read_to_end(&mut bytes)?;
    Ok(bytes)
}

//! The Android library around the Shadecast client.
//!
//! It exists because a headset starts an app as an activity and not through `main`: it answers the system's events, brings up
//! the OpenXR loader, and then runs the same client as everywhere else. On other systems only [`settings`] is compiled.

pub mod settings;

#[cfg(target_os = "android")]
mod activity;

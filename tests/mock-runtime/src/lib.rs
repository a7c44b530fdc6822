//! A mock OpenXR runtime: a headset for machines that have none.
//!
//! The library is loaded by the system's OpenXR loader through a JSON manifest (`XR_RUNTIME_JSON`, see [`manifest`]),
//! so the application under test is the one that ships. It exports `xrNegotiateLoaderRuntimeInterface` and offers
//! OpenXR 1.0 with `XR_KHR_vulkan_enable2`, `XR_KHR_convert_timespec_time` (on Windows
//! `XR_KHR_win32_convert_performance_counter_time`), `XR_FB_display_refresh_rate`, `XR_EXT_performance_settings` and
//! `XR_EXT_debug_utils`, and fixed foveation where the configuration says so: one stereo headset, with controllers where the
//! configuration names some. `docs/mock.md` tells other projects how to use it.
//!
//! One run is described by a [`config::MockConfig`] in the file that the environment variable `SHADECAST_MOCK_CONFIG`
//! names: how large and wide the eyes see, where the head goes ([`head_path`]), how time passes ([`clock`]), what
//! happens when. What the application submits comes out in the capture folder ([`record`]): poses and times of every
//! frame, and pictures of the frames asked for.
//!
//! It checks what applications must keep to (the order of calls, rectangles, poses, times), answers with the code that
//! OpenXR has for it, says on stderr what was wrong, and counts. It composites nothing and shows nothing: pictures are
//! exactly what the application drew.
//!
//! The modules below are also a Rust library, for who writes the configuration and reads the captures.

mod actions;
mod capture;
pub mod clock;
pub mod config;
mod debug_utils;
mod fault;
mod ffi;
mod foveation;
mod frame;
mod gpu;
pub mod head_path;
mod inputs;
mod instance;
mod layers;
pub mod manifest;
mod names;
mod negotiate;
mod paths;
mod profiles;
pub mod record;
mod performance;
mod refresh_rate;
mod runtime;
mod session;
mod space;
mod swapchain;
mod time;
mod vulkan;

pub use negotiate::xrNegotiateLoaderRuntimeInterface;

//! The Shadecast headset client: receives, decodes, bundles and draws.
//!
//! [`client::Client`] is the whole of it without I/O, [`intake`] and [`presenter`] its halves; [`frame`] is one display frame on
//! one page. Without features
//! nothing here needs a C++ compiler or a command line: the Android library is built so.

pub mod bundle;
pub mod client;
pub mod coverage;
pub mod decode;
pub mod decoding;
pub mod display;
pub mod draw_list;
mod figures;
mod figures_panel;
pub mod frame;
mod handover;
pub mod index_places;
pub mod intake;
mod link;
mod locomotion;
pub mod motion;
pub mod net;
pub mod options;
pub mod platform;
mod preparing;
pub mod presenter;
mod renderer;
pub mod report;
mod scene;
mod scenes;
pub mod stages;
pub mod stats;
mod stillness;
pub mod taking;
pub mod traced;
pub mod watch;
#[cfg(feature = "desktop")]
pub mod window;
pub mod xr;

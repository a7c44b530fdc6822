//! The Shadecast headset client: receives, decodes, bundles and draws.
//!
//! [`client::Client`] is the whole client without I/O; [`stream::intake`] and [`present::presenter`] are its halves.
//! `present/frame.rs` is one display frame on one page. Without features the crate needs no C++ compiler and no command line:
//! the Android library is built so.
//!
//! Folders import downwards only, in this order: [`net`], [`client`], [`present`], [`stream`], `handover`, [`report`] and
//! [`options`], [`draw`], [`motion`] and [`display`], [`platform`], [`decode`].

pub mod client;
pub mod decode;
pub mod display;
pub mod draw;
mod handover;
pub mod motion;
pub mod net;
pub mod options;
pub mod platform;
pub mod present;
pub mod report;
pub mod stream;

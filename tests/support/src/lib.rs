//! What tests of several crates begin with. Nothing here checks the product; it knows of it no more than the protocol, so
//! that every crate may have it as a dev-dependency.

#[cfg(feature = "headset")]
pub mod headset;
pub mod peers;
pub mod programs;

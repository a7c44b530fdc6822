//! Windows on the test's own display: the forward renderer's, and the client's.

#![cfg(unix)]

mod client;
mod display;
mod forward;
mod x11;

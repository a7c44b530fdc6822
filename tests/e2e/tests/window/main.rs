//! Windows on a display of the test's own: the forward renderer's, and the client's.

#![cfg(unix)]

mod client;
mod display;
mod forward;
mod x11;

//! From a server's bytes to the render thread's input: the session, decoding, bundles, draw lists.
//!
//! Packets enter, and notes on each display frame from the presenter. Scenes, batches and bundles leave through
//! `handover`, and messages to the server. Nothing here knows sockets, displays and Vulkan's queues: the GPU is memory
//! to fill.

mod bundle;
pub mod intake;
mod link;
mod preparing;
pub mod taking;
mod watch;

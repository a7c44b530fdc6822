//! From a server's bytes to what the render thread takes: the session, decoding, bundles, draw lists.
//!
//! Packets enter, and notes on each display frame from the presenter. Scenes, batches and bundles leave through
//! [`crate::handover`], and messages to the server. Nothing here knows sockets, displays and Vulkan's queues: the GPU is memory
//! that is filled.

mod bundle;
pub mod intake;
mod link;
mod preparing;
pub mod taking;
mod watch;

//! All differences between operating systems: clocks, private files, the user's folders, other processes. Code for Windows or
//! Unix alone is in here, except that for OpenXR and Vulkan.

pub mod clock;
pub mod files;
pub mod folders;
pub mod memory;
pub mod owner;
pub mod process;

pub use clock::monotonic_now_ns;
pub use files::{PendingFile, remove_pending_files, write_atomically};

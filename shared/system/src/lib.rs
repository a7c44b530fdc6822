//! What differs between operating systems, and nothing else: clocks, files that are their owner's alone, where a user's files
//! lie, other processes. All that is Windows' or Unix's own is in here, but for what OpenXR and Vulkan ask of them.

pub mod clock;
pub mod files;
pub mod folders;
pub mod owner;
pub mod process;

pub use clock::monotonic_now_ns;
pub use files::{PendingFile, remove_pending_files, write_atomically};

//! The parts of the world that server, client and files share: poses, times, playback of clips, kinds of patches, a scene's
//! limits, printable text. Pure, and below the wire crate: it knows no message, no session and no file format.
#![forbid(unsafe_code)]

pub mod limits;
pub mod patch;
pub mod playback;
pub mod pose;
pub mod text;
pub mod time;

//! The draw of a display frame: lists of patches, and the GPU stages.
//!
//! Patches, vertex writes and decoded planes enter. Draw calls leave, recorded into the caller's command buffer. Nothing here
//! knows sessions, connections and which bundle is due.

pub mod coverage;
pub mod draw_list;
pub mod index_places;
pub mod stages;

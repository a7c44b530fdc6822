//! The GPU passes of animation, in pipeline order: poses, then vertices.

pub mod palette;
pub(crate) mod skin;

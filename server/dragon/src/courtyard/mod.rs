//! The generated courtyard in pieces: walls, ground, plants and a lamp, as GLB files.
//!
//! Walls (`wall`) and bodies of revolution (`shapes`) are set together in `masonry`; foliage is of cutouts (`plants`). Textures
//! are painted by place (`paint`). The walls and the ground are where the courtyard's scene has them; a scene places the rest.
//! Everything is a pure function of constants, so every call gives the same bytes.

mod export;
mod lantern;
mod masonry;
mod paint;
mod plants;
mod shapes;
#[cfg(test)]
mod tests;
mod wall;

pub(crate) use lantern::lantern;
pub(crate) use masonry::{masonry, paving};
pub(crate) use plants::{cypress, ivy, pot, tree};

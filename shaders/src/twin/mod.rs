//! CPU reference twins: what each GPU stage must compute, in plain Rust, one file per shader stem.
pub mod interpolate;
pub mod level_selection;
pub mod mark;
pub mod ycbcr;

//! Motion of a model on the CPU: source curves, their sampling, poses, skinning.

pub mod bounds;
pub mod clip;
pub mod error;
pub mod played;
pub mod playing;
pub mod pose;
pub mod sampling;
#[cfg(test)]
mod test_models;

//! How vertices move for a client: which way each instance takes, what is told of it once, and what is sent as time goes by.
//!
//! Clips need keys once and nothing afterwards; poses need a transform a bone and grid step; samples need a position a vertex and
//! grid step. What is chosen is the way that takes the fewest bytes among those that are exact.

mod allowance;
pub mod chunks;
pub mod library;
pub mod posed;
pub mod predictions;
pub mod rasters;
pub mod sampled;
pub mod schedules;
pub mod sender;
pub mod skinning;
pub mod steps;

/// How instances that move are sent.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum MotionOption {
    /// Clips where there are any, poses where an application gives them, samples for the rest
    #[default]
    Auto,
    /// Clips, whatever they take
    Clip,
    /// A transform a bone and grid step
    Palette,
    /// A position a vertex and grid step
    Samples,
    /// Three predicted positions a vertex with every update, as the paper does
    Paper,
}

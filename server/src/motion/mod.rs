//! Motion as one client receives it: the kind of each instance, its one-time data, and its messages over time.
//!
//! The scene's poses and a client's visible instances enter; messages about motion leave. Clips need keys once and nothing
//! afterwards. Poses need a transform per bone and grid step. Samples need a position per vertex and grid step. Of the exact
//! kinds, the one with the fewest bytes is chosen.

mod allowance;
pub(crate) mod chunks;
pub(crate) mod delta;
pub(crate) mod posed;
pub(crate) mod predictions;
pub(crate) mod sampled;
pub(crate) mod schedules;
pub mod sender;
pub(crate) mod skinning;
pub(crate) mod steps;

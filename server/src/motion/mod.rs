//! Motion as one client receives it: the kind of each instance, its one-time data, and its messages over time.
//!
//! The scene's poses and a client's visible instances enter; messages about motion leave. Clips need keys once and nothing
//! afterwards. Poses need a transform per bone and grid step. Samples need a position per vertex and grid step. Of the exact
//! kinds, the one with the fewest bytes is chosen.

mod allowance;
pub mod chunks;
pub mod delta;
pub mod posed;
pub mod predictions;
pub mod sampled;
pub mod schedules;
pub mod sender;
pub mod skinning;
pub mod steps;

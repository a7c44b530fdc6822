//! How vertices move for a client: which way each instance takes, what is told of it once, and what is sent as time goes by.
//!
//! Clips need keys once and nothing afterwards; poses need a transform a bone and grid step; samples need a position a vertex and
//! grid step. What is chosen is the way that takes the fewest bytes among those that are exact.

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

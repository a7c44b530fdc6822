//! Helpers of the tests.

pub mod x11;

//! Collections and helpers that know nothing of the product.

pub mod bit_set;
pub mod lock;
pub mod merged;
pub mod named;
pub(crate) mod pool;
pub mod upload;

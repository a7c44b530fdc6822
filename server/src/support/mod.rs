//! Collections and helpers that know nothing of the product.

pub(crate) mod least;
pub mod lock;
pub(crate) mod merged;
pub(crate) mod named;
pub(crate) mod pool;
pub(crate) mod upload;

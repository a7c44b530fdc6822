//! Server, link and client on one virtual clock; metrics and reports.

pub mod bars;
pub mod compare;
pub mod demo;
pub mod flip;
mod forward_run;
pub mod hostile;
pub mod headset_off;
pub mod image;
pub mod long;
pub mod metrics;
pub mod motion;
pub mod options;
pub mod page;
mod percentiles;
pub mod robot;
pub mod run;
pub mod session;
pub mod skinning;
pub mod sheet;
pub mod ssim;
pub mod stats;
pub mod tearing;
pub mod typeface;
mod text_table;
pub mod truth;

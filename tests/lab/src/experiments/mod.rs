//! Experiments: one question each, asked of one or several runs.
//!
//! Options of a run enter ([`crate::session::options`]). A report leaves, as JSON and as a table. Nothing here knows the command
//! line, bars and the project's documents.

pub mod abrupt;
pub mod causes;
pub mod churn;
pub mod costs;
pub mod detail;
#[cfg(feature = "libavcodec")]
pub mod encoders;
pub mod headset_off;
pub mod links;
pub mod live;
pub mod motion_table;
pub mod paper_size;
pub mod picture;
pub mod quality;
pub mod render_thread;
pub mod run;
pub mod scale;
pub mod skinning;
pub mod slow;
pub mod slow_link;
pub mod steadiness;
pub mod still;
pub mod table1;
pub mod tearing;
pub mod viewers;
pub mod worth;

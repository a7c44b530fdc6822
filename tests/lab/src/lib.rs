//! Server, link and client on one virtual clock; metrics and reports.
//!
//! Folders import downwards only, in this order: [`results`], [`demo`] and [`hostile`], [`experiments`], [`scenes`], [`report`],
//! [`measure`], [`session`], [`probe_file`], [`image`] and `process`. The command line (`cli/`) belongs to the program.

pub mod demo;
pub mod experiments;
pub mod hostile;
pub mod image;
pub mod measure;
pub mod probe_file;
mod process;
pub mod report;
pub mod results;
pub mod scenes;
pub mod session;

//! Figures and pictures for people: a run's summary, tables, a contact sheet, a page.
//!
//! Figures and pictures enter. JSON, text, PNG and HTML leave. Nothing here knows their measurement.

pub mod page;
pub mod sheet;
pub mod stats;
pub(crate) mod text_table;
pub mod typeface;

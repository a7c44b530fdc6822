//! The committed results: made ([`long`]), checked ([`bars`]), and put into the documents ([`figures`]).
//!
//! A folder of results enters. Results, verdicts and the documents' tables leave. Nothing here knows virtual time and metrics.

pub mod bars;
mod budget;
pub mod figures;
pub mod keys;
pub mod long;

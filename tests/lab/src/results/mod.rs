//! The committed results: made ([`long`]), checked ([`bars`], [`compare`], [`sources`]), and put into the documents ([`figures`])
//! and onto a page ([`page`]).
//!
//! A folder of results enters. Results, verdicts, the documents' tables and a page leave. Nothing here knows virtual time and metrics.

pub mod bars;
mod budget;
pub mod compare;
pub mod figures;
pub mod keys;
pub mod long;
pub mod page;
pub mod sources;

use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// All records of a folder by their names; what is no JSON is left out.
fn records(folder: &Path) -> BTreeMap<String, Value> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let record = |path: std::path::PathBuf| {
        if path.extension()? != "json" {
            return None;
        }
        let value = serde_json::from_str(&std::fs::read_to_string(&path).ok()?).ok()?;
        Some((path.file_stem()?.to_str()?.to_owned(), value))
    };
    entries.filter_map(record).collect()
}

/// All texts under a key of a record, such as its commands, wherever they are.
fn texts_under<'a>(record: &'a Value, key: &str) -> Vec<&'a str> {
    match record {
        Value::Object(fields) => fields
            .iter()
            .flat_map(|(field, value)| match value.as_str() {
                Some(text) if field == key => vec![text],
                _ => texts_under(value, key),
            })
            .collect(),
        Value::Array(list) => list.iter().flat_map(|value| texts_under(value, key)).collect(),
        _ => Vec::new(),
    }
}

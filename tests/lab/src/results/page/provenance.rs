//! Where figures come from: device, driver, commit with its date, age and the commands of every record.
//!
//! A folder of records enters, and git where it is there. A box below each section leaves. Nothing here knows figures.

use super::html::{folded, inline, markdown, preformatted};
use crate::results::figures;
use crate::results::sources::{Checkout, git};
use crate::results::texts_under;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

const NOT_RECORDED: &str = "not recorded";

/// All committed records.
pub(super) struct Committed {
    /// Where they are.
    pub folder: PathBuf,
    /// By their names.
    pub records: BTreeMap<String, Value>,
    checkout: Option<Checkout>,
    /// Dates of commits, where git knows them.
    dates: BTreeMap<String, String>,
}

impl Committed {
    /// Reads a folder.
    pub(super) fn read(folder: &Path) -> Self {
        let records = crate::results::records(folder);
        let commits: BTreeSet<&str> = records.values().filter_map(commit).collect();
        let date = |commit: &str| {
            let date = git(folder, &["show", "-s", "--format=%cs", commit.trim_end_matches("-dirty"), "--"])?;
            Some((commit.to_owned(), date.trim().to_owned()))
        };
        let dates = commits.into_iter().filter_map(date).collect();
        Self { folder: folder.into(), checkout: Checkout::read(folder), records, dates }
    }

    /// A record; nothing where it is not there.
    pub(super) fn record(&self, name: &str) -> Option<&Value> {
        self.records.get(name)
    }

    /// Names of records that begin so.
    pub(super) fn names(&self, start: &str) -> Vec<String> {
        self.records.keys().filter(|name| name.starts_with(start)).cloned().collect()
    }

    /// Whether a record is older than its sources; `None` outside of git.
    fn is_older(&self, name: &str, record: &Value) -> Option<bool> {
        Some(self.checkout.as_ref()?.is_newer_than(name, record))
    }

    /// The box below a section that shows these records.
    pub(super) fn provenance(&self, names: &[String]) -> String {
        let found: Vec<(&str, &Value)> =
            names.iter().filter_map(|name| Some((name.as_str(), self.records.get(name)?))).collect();
        if found.is_empty() {
            return String::new();
        }
        let older = found.iter().filter(|(name, record)| self.is_older(name, record) == Some(true)).count();
        let age = match (older, &self.checkout) {
            (_, None) => String::new(),
            (0, _) => "; all are of today's sources".to_owned(),
            (older, _) => format!("; {older} of {} older than their sources", found.len()),
        };
        let devices: BTreeSet<String> =
            found.iter().filter_map(|(_, record)| said(record, "device")).collect();
        let devices: Vec<String> = devices.into_iter().collect();
        let devices = if devices.is_empty() { "device not recorded".to_owned() } else { devices.join(", ") };
        let heads = ["result", "device", "driver", "commit", "date of the commit", "age"];
        let rows = found.iter().map(|(name, record)| self.row(name, record));
        let commands: String = found.iter().map(|(name, record)| commands(name, record)).collect();
        folded(
            &format!("Where these figures come from: {devices}{age}"),
            &(markdown("Records", &figures::markdown(&heads, rows)) + &preformatted("Commands", &commands)),
        )
    }

    fn row(&self, name: &str, record: &Value) -> Vec<String> {
        let or_not = |said: Option<String>| said.unwrap_or_else(|| NOT_RECORDED.to_owned());
        let commit = commit(record);
        let date = commit.and_then(|commit| self.dates.get(commit).cloned());
        let age = match self.is_older(name, record) {
            Some(true) => "older than its sources",
            Some(false) => "of today's sources",
            None => "not known outside of git",
        };
        vec![
            format!("`{name}`"),
            or_not(said(record, "device")),
            // llvmpipe names its own version; other devices have drivers.
            or_not(said(record, "driver")),
            or_not(commit.map(str::to_owned)),
            date.unwrap_or_else(|| "-".to_owned()),
            age.to_owned(),
        ]
    }

    /// A sentence on all records, with the names of the older ones behind it.
    pub(super) fn freshness(&self) -> String {
        let sentence = crate::results::sources::freshness(&self.folder);
        match sentence.split_once(": ") {
            Some((sentence, names)) => folded(sentence, &format!("<p>{}</p>", inline(names))),
            None => format!("<p>{}</p>", inline(&sentence)),
        }
    }
}

fn commit(record: &Value) -> Option<&str> {
    record["commit"].as_str()
}

/// The first text under a key, wherever it is.
fn said(record: &Value, key: &str) -> Option<String> {
    texts_under(record, key).into_iter().next().map(str::to_owned)
}

/// What repeats a record: its own commands, or the long run that makes it.
fn commands(name: &str, record: &Value) -> String {
    let found = texts_under(record, "command");
    if found.is_empty() {
        return format!("# {name}\n./shadecast test --long --only {name}\n");
    }
    format!("# {name}\n{}\n", found.join("\n"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn every_record_says_its_device_commit_and_commands() {
        let folder = tempfile::tempdir().expect("a folder");
        let write = |name: &str, record: Value| {
            std::fs::write(folder.path().join(name), record.to_string()).expect("written");
        };
        write(
            "a.json",
            json!({"commit": "abc", "way": {"command": "run a --x", "stats": {"device": "a <GPU>"}}}),
        );
        write("b.json", json!({"ms": 1.0}));
        let committed = Committed::read(folder.path());
        let html = committed.provenance(&["a".to_owned(), "b".to_owned(), "c".to_owned()]);
        for part in [
            "a &lt;GPU&gt;",
            "<td>abc</td>",
            "# a\nrun a --x",
            "# b\n./shadecast test --long --only b",
            "not known outside of git",
            NOT_RECORDED,
        ] {
            assert!(html.contains(part), "{part} is missing in {html}");
        }
        assert_eq!(committed.provenance(&["c".to_owned()]), "");
    }
}

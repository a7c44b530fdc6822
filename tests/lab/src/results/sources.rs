//! Which records were measured by older code than that of the checkout.
//!
//! A folder inside a git checkout enters. A hash of the code that makes a record leaves, and the names of records with another
//! one. Nothing here knows what a record holds, apart from its `sources`.

use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;
use std::process::Command;

/// Folders whose code makes the figures of every record, from the project's root. What only prints them is left out, and so are
/// options of long runs: a record's commands name those.
const FOLDERS: [&str; 9] = [
    "client-xr",
    "server",
    "shaders",
    "shared",
    "tests/lab/src/experiments",
    "tests/lab/src/measure",
    "tests/lab/src/scenes",
    "tests/lab/src/session",
    "tests/mock-runtime",
];
/// Folders that records count on besides, by the beginning of their names.
const MORE_FOLDERS: [(&str, &str); 2] =
    [("hostile", "tests/lab/src/hostile"), ("neighbours", "tests/lab/src/hostile")];
/// Digits of a hash that are kept.
const HASH_DIGITS: usize = 16;
/// What a hash ends with where files differ from the commit.
const DIRTY: &str = "-dirty";

/// The code of a checkout.
#[derive(Clone, Debug)]
pub struct Checkout {
    /// Tree ids by folder.
    trees: BTreeMap<&'static str, String>,
    /// Files that differ from the commit, or that it lacks, from the project's root.
    changed: Vec<String>,
}

/// Folders that a record counts on, in alphabetical order.
fn folders_of(name: &str) -> Vec<&'static str> {
    let more = MORE_FOLDERS.iter().filter(|(start, _)| name.starts_with(start)).map(|(_, folder)| *folder);
    let mut folders: Vec<_> = FOLDERS.into_iter().chain(more).collect();
    folders.sort_unstable();
    folders.dedup();
    folders
}

/// What git prints in `folder`; `None` where it fails, as it does outside of a checkout.
pub(super) fn git(folder: &Path, arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").arg("-C").arg(folder).args(arguments).output().ok()?;
    output.status.success().then(|| String::from_utf8(output.stdout).ok()).flatten()
}

impl Checkout {
    /// That of which `folder` is a part; `None` outside of git.
    pub fn read(folder: &Path) -> Option<Self> {
        let mut folders: Vec<&str> =
            FOLDERS.into_iter().chain(MORE_FOLDERS.map(|(_, folder)| folder)).collect();
        folders.sort_unstable();
        folders.dedup();
        let objects: Vec<String> = folders.iter().map(|folder| format!("HEAD:{folder}")).collect();
        let arguments: Vec<&str> =
            std::iter::once("rev-parse").chain(objects.iter().map(String::as_str)).collect();
        let ids = git(folder, &arguments)?;
        let trees = folders.into_iter().zip(ids.lines().map(str::to_owned)).collect();
        let root = git(folder, &["rev-parse", "--show-toplevel"])?;
        let changed = git(Path::new(root.trim()), &["status", "--porcelain", "--no-renames"])?;
        let changed = changed.lines().filter_map(|line| line.get(3..)).map(str::to_owned).collect();
        Some(Self { trees, changed })
    }

    /// A stable hash of the code that makes the record `name`; it ends with `-dirty` where files differ from the commit.
    pub fn sources(&self, name: &str) -> String {
        let folders = folders_of(name);
        let lines = folders.iter().fold(String::new(), |mut lines, folder| {
            let id = self.trees.get(folder).map_or("", String::as_str);
            let _ = writeln!(lines, "{folder} {id}");
            lines
        });
        let is_changed = self.changed.iter().any(|file| folders.iter().any(|folder| is_in(file, folder)));
        let hash = blake3::hash(lines.as_bytes()).to_hex();
        format!("{}{}", &hash[..HASH_DIGITS], if is_changed { DIRTY } else { "" })
    }

    /// Whether a record was made by other code than this, or does not say by which.
    pub fn is_newer_than(&self, name: &str, record: &Value) -> bool {
        let sources = self.sources(name);
        sources.ends_with(DIRTY) || record["sources"] != sources.as_str()
    }
}

/// Whether a file, or a folder with new files alone, belongs to a folder.
fn is_in(file: &str, folder: &str) -> bool {
    file.strip_prefix(folder).is_some_and(|rest| rest.starts_with('/'))
}

/// A sentence on the records of `folder` that are older than their sources.
pub fn freshness(folder: &Path) -> String {
    let records = super::records(folder);
    let Some(checkout) = Checkout::read(folder) else {
        return "Outside of git the age of records is not known.".to_owned();
    };
    let older: Vec<&str> = records
        .iter()
        .filter(|(name, record)| checkout.is_newer_than(name, record))
        .map(|(name, _)| name.as_str())
        .collect();
    if older.is_empty() {
        return format!("All {} records are of this checkout's sources.", records.len());
    }
    format!("{} of {} records are older than their sources: {}", older.len(), records.len(), older.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    /// A checkout with a file in each folder; git's own settings are not asked.
    fn checkout() -> tempfile::TempDir {
        let root = tempfile::tempdir().expect("a folder");
        for folder in FOLDERS.into_iter().chain(MORE_FOLDERS.map(|(_, folder)| folder)) {
            std::fs::create_dir_all(root.path().join(folder)).expect("a folder");
            std::fs::write(root.path().join(folder).join("code.rs"), folder).expect("written");
        }
        git(root.path(), &["init", "-q"]).expect("git is installed");
        commit(root.path());
        root
    }

    fn commit(root: &Path) {
        git(root, &["add", "-A"]).expect("added");
        let who = ["-c", "user.name=a", "-c", "user.email=a@b.c", "commit", "-q", "-m", "a change"];
        git(root, &who).expect("a commit");
    }

    fn sources(root: &Path, name: &str) -> String {
        Checkout::read(root).expect("a checkout").sources(name)
    }

    #[test]
    fn sources_change_with_the_code_that_makes_the_record() {
        let root = checkout();
        let before = ["picture-helmet", "hostile"].map(|name| sources(root.path(), name));
        assert_eq!(before[0].len(), HASH_DIGITS, "{before:?}");
        assert_ne!(before[0], before[1]);
        std::fs::write(root.path().join("tests/lab/src/hostile/code.rs"), "new").expect("written");
        assert_eq!(sources(root.path(), "hostile").strip_suffix(DIRTY), Some(before[1].as_str()));
        commit(root.path());
        assert_eq!(sources(root.path(), "picture-helmet"), before[0]);
        assert_ne!(sources(root.path(), "hostile"), before[1]);
    }

    #[test]
    fn a_record_of_other_sources_or_of_none_is_older() {
        let root = checkout();
        let results = root.path().join("docs/results");
        std::fs::create_dir_all(&results).expect("a folder");
        let now = sources(root.path(), "new");
        let write = |name: &str, record: Value| {
            std::fs::write(results.join(format!("{name}.json")), record.to_string()).expect("written");
        };
        write("new", json!({ "sources": now }));
        assert_eq!(freshness(&results), "All 1 records are of this checkout's sources.");
        write("other", json!({ "sources": "0123456789abcdef" }));
        write("silent", json!({ "commit": "abc" }));
        assert_eq!(freshness(&results), "2 of 3 records are older than their sources: other, silent");
        std::fs::write(root.path().join("server/more.rs"), "").expect("written");
        assert!(freshness(&results).starts_with("3 of 3"), "a changed checkout has no records");
    }

    #[test]
    fn outside_of_git_there_are_no_sources() {
        let folder = tempfile::tempdir().expect("a folder");
        assert!(Checkout::read(folder.path()).is_none());
        assert!(freshness(folder.path()).contains("not known"));
    }
}

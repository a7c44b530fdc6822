//! Finished measurements, in a file beside the results. An interrupted run with the same options resumes there.

use super::bench::Measured;
use super::cell::Cell;
use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What a measurement depends on beside its cell: states of others cannot be gone on with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Terms {
    /// Part of the paper's sizes.
    pub scale: f64,
    /// Updates that each cell measures in a round.
    pub updates: u32,
    /// Part of the wanted device's name.
    pub device: Option<String>,
    /// Of the program.
    pub version: String,
}

/// A cell in a round.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Done {
    /// Of all rounds, from 0.
    pub round: u32,
    /// What was measured.
    pub cell: Cell,
    /// What came out.
    pub measured: Measured,
}

#[derive(Debug, Serialize, Deserialize)]
struct Contents {
    terms: Terms,
    done: Vec<Done>,
}

/// See the module.
#[derive(Debug)]
pub struct State {
    path: PathBuf,
    contents: Contents,
}

impl State {
    /// What the file holds; nothing where there is none.
    ///
    /// # Errors
    /// The file cannot be read, or is of a run on other terms.
    pub fn open(path: PathBuf, terms: Terms) -> anyhow::Result<Self> {
        if !path.exists() {
            return Ok(Self { path, contents: Contents { terms, done: Vec::new() } });
        }
        let text = std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
        let contents: Contents = serde_json::from_str(&text).with_context(|| {
            format!("{} is not the state of a table; remove it to begin anew", path.display())
        })?;
        if contents.terms != terms {
            bail!(
                "{} is of a run on other terms ({:?}, not {terms:?}); go on with those, remove it, or choose another --out",
                path.display(),
                contents.terms
            );
        }
        Ok(Self { path, contents })
    }

    /// Whether this was measured.
    pub fn has(&self, round: u32, cell: Cell) -> bool {
        self.contents.done.iter().any(|done| done.round == round && done.cell == cell)
    }

    /// Takes in what was measured, and writes all down.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn add(&mut self, done: Done) -> anyhow::Result<()> {
        self.contents.done.push(done);
        write(&self.path, &serde_json::to_string(&self.contents)?)
    }

    /// All that was measured.
    pub fn done(&self) -> &[Done] {
        &self.contents.done
    }

    /// The results are written: nothing is to be gone on with.
    pub fn remove(self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Writes a file whole.
///
/// # Errors
/// It cannot be written; the message names it.
pub fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    shadecast_system::write_atomically(path, text.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::experiments::table1::cell::{Column, Mode, Set};

    fn terms(scale: f64) -> Terms {
        Terms { scale, updates: 2, device: None, version: "1".into() }
    }

    fn cell(dragons: u32) -> Cell {
        Cell { dragons, set: Set::Paper, mode: Mode::Ours, column: Column::Off }
    }

    #[test]
    fn what_was_measured_is_there_after_a_restart_and_nothing_else() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("state.json");
        let mut state = State::open(path.clone(), terms(0.5)).expect("new");
        let measured = Measured { device: "d".into(), ..Measured::default() };
        state.add(Done { round: 1, cell: cell(9), measured: measured.clone() }).expect("written");
        drop(state);
        let state = State::open(path.clone(), terms(0.5)).expect("the same terms");
        assert!(state.has(1, cell(9)) && !state.has(0, cell(9)) && !state.has(1, cell(25)));
        assert_eq!(state.done(), [Done { round: 1, cell: cell(9), measured }]);
        state.remove();
        assert!(!path.exists());
    }

    #[test]
    fn a_state_of_other_terms_or_none_is_refused_with_a_remedy() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("state.json");
        let mut state = State::open(path.clone(), terms(0.5)).expect("new");
        state.add(Done { round: 0, cell: cell(9), measured: Measured::default() }).expect("written");
        let refused = State::open(path.clone(), terms(0.25)).expect_err("other terms").to_string();
        assert!(refused.contains("other terms") && refused.contains("remove it"), "{refused}");
        std::fs::write(&path, "[]").expect("written");
        let refused = State::open(path, terms(0.5)).expect_err("no state").to_string();
        assert!(refused.contains("remove it to begin anew"), "{refused}");
    }
}

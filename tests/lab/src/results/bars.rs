//! The bars: limits for the figures of the long runs, in `tests/lab/bars.toml`. A figure that misses its bar is a failure, and
//! so is a missing figure.

use crate::report::text_table::table;
use anyhow::{Context, ensure};
use serde::Deserialize;
use serde_json::Value;
use std::fmt;
use std::path::Path;

/// The bars of the project.
pub const BARS: &str = include_str!("../../bars.toml");

/// A list of bars.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bars {
    bar: Vec<Bar>,
}

/// What one figure must reach, in one or several files.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Bar {
    /// Names of result files without `.json`.
    files: Vec<String>,
    /// Way to the number: keys and places in lists, joined by dots.
    key: String,
    /// It must not be smaller.
    at_least: Option<f64>,
    /// It must not be larger.
    at_most: Option<f64>,
    /// Unit, for people.
    #[serde(default)]
    unit: String,
    /// Why it is known to be missed. It fails all the same.
    missed: Option<String>,
}

/// A figure beside its bar.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// File and way to the number.
    pub figure: String,
    /// Bound with unit.
    pub bar: String,
    /// What was found.
    pub measured: Result<f64, String>,
    /// By how much it misses the bound, positive; `None` where it holds, or was not measured.
    pub missed_by: Option<f64>,
    /// Why it is known to be missed.
    pub known: Option<String>,
}

impl Verdict {
    /// Whether the bar is missed.
    pub fn fails(&self) -> bool {
        self.measured.is_err() || self.missed_by.is_some()
    }
}

/// All verdicts, for people.
pub struct Report(pub Vec<Verdict>);

impl Bars {
    /// Reads a list.
    ///
    /// # Errors
    /// It is no list of bars, or one of them has no bound or no file.
    pub fn parse(text: &str) -> anyhow::Result<Self> {
        let bars: Self = toml::from_str(text).context("reading the bars")?;
        for bar in &bars.bar {
            let bounds = usize::from(bar.at_least.is_some()) + usize::from(bar.at_most.is_some());
            ensure!(bounds == 1, "bar \"{}\" needs at_least or at_most, one of both", bar.key);
            ensure!(!bar.files.is_empty(), "bar \"{}\" names no file", bar.key);
        }
        Ok(bars)
    }

    /// Checks all results in `folder`.
    pub fn check(&self, folder: &Path) -> Report {
        let of_bar = |bar: &Bar| {
            let check = |file: &String| bar.check(file, read(&folder.join(format!("{file}.json"))));
            bar.files.iter().map(check).collect::<Vec<_>>()
        };
        Report(self.bar.iter().flat_map(of_bar).collect())
    }

    /// The files that bars speak of.
    #[cfg(test)]
    fn files(&self) -> std::collections::BTreeSet<&str> {
        self.bar.iter().flat_map(|bar| bar.files.iter().map(String::as_str)).collect()
    }
}

fn read(path: &Path) -> Result<Value, String> {
    let text = std::fs::read_to_string(path).map_err(|_| "no such file".to_owned())?;
    serde_json::from_str(&text).map_err(|error| format!("not JSON: {error}"))
}

impl Bar {
    fn check(&self, file: &str, result: Result<Value, String>) -> Verdict {
        let measured = result.and_then(|value| number(&value, &self.key));
        let missed_by = measured.as_ref().ok().and_then(|measured| self.missed_by(*measured));
        Verdict {
            figure: format!("{file}: {}", self.key),
            bar: self.text(),
            measured,
            missed_by,
            known: self.missed.clone(),
        }
    }

    /// A number that cannot be compared misses its bar by as much as there is.
    fn missed_by(&self, measured: f64) -> Option<f64> {
        let short = match (self.at_least, self.at_most) {
            (Some(least), _) => least - measured,
            (_, Some(most)) => measured - most,
            _ => return None,
        };
        if short.is_nan() { Some(f64::INFINITY) } else { (short > 0.0).then_some(short) }
    }

    fn text(&self) -> String {
        let unit = if self.unit.is_empty() { String::new() } else { format!(" {}", self.unit) };
        match (self.at_least, self.at_most) {
            (Some(least), _) => format!(">= {least}{unit}"),
            (_, Some(most)) => format!("<= {most}{unit}"),
            _ => String::new(),
        }
    }
}

fn number(value: &Value, key: &str) -> Result<f64, String> {
    let mut at = value;
    for part in key.split('.') {
        let next = match at {
            Value::Array(list) => part.parse().ok().and_then(|place: usize| list.get(place)),
            other => other.get(part),
        };
        at = next.ok_or_else(|| format!("no key {part}"))?;
    }
    at.as_f64().ok_or_else(|| format!("not a number: {at}"))
}

impl Report {
    /// How many bars are missed.
    pub fn failures(&self) -> usize {
        self.0.iter().filter(|verdict| verdict.fails()).count()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let row = |verdict: &Verdict| {
            let measured = match &verdict.measured {
                Ok(measured) => short(*measured),
                Err(why) => why.clone(),
            };
            let missed = match verdict.missed_by {
                _ if verdict.measured.is_err() => "MISSED".to_owned(),
                Some(by) => format!("MISSED by {}", short(by)),
                None => "ok".to_owned(),
            };
            let cause = verdict.known.as_ref().filter(|_| verdict.fails());
            let cause = cause.map_or(String::new(), |cause| format!("known: {cause}"));
            [verdict.figure.clone(), verdict.bar.clone(), measured, missed, cause]
        };
        write!(out, "{}", table(["figure", "bar", "measured", "", ""], self.0.iter().map(row)))?;
        write!(out, "{} bars, {} missed", self.0.len(), self.failures())
    }
}

/// Four digits that count.
pub(super) fn short(value: f64) -> String {
    if value == 0.0 || !value.is_finite() {
        return value.to_string();
    }
    let decimals = (3 - value.abs().log10().floor() as i32).clamp(0, 8) as usize;
    format!("{value:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"
        [[bar]]
        files = ["run"]
        key = "stats.psnr_db"
        at_least = 30
        unit = "dB"

        [[bar]]
        files = ["run"]
        key = "list.1.ms"
        at_most = 1.2
        missed = "a cause"
    "#;

    fn report(json: Option<&str>) -> Report {
        let folder = tempfile::tempdir().expect("a folder");
        if let Some(json) = json {
            std::fs::write(folder.path().join("run.json"), json).expect("written");
        }
        Bars::parse(TEXT).expect("good").check(folder.path())
    }

    #[test]
    fn figures_that_reach_their_bars_pass() {
        let report = report(Some(r#"{"stats": {"psnr_db": 30.0}, "list": [{"ms": 9}, {"ms": 1.2}]}"#));
        assert_eq!(report.failures(), 0, "{report}");
        assert!(!report.to_string().contains("known"), "{report}");
    }

    #[test]
    fn a_missed_bar_fails_and_says_by_how_much() {
        let report = report(Some(r#"{"stats": {"psnr_db": 28.75}, "list": [{"ms": 9}, {"ms": 1.5}]}"#));
        assert_eq!(report.failures(), 2, "a known cause is no excuse");
        assert_eq!(report.0[0].missed_by, Some(1.25));
        let text = report.to_string();
        assert!(text.contains(">= 30 dB") && text.contains("MISSED by 1.250"), "{text}");
        assert!(text.contains("MISSED by 0.3000") && text.contains("known: a cause"), "{text}");
    }

    #[test]
    fn what_was_not_measured_fails() {
        assert_eq!(report(None).failures(), 2);
        assert!(report(None).to_string().contains("no such file"));
        assert_eq!(report(Some("{")).failures(), 2);
        for json in
            [r#"{"stats": {}, "list": []}"#, r#"{"stats": {"psnr_db": null}, "list": [1, {"ms": "1"}]}"#]
        {
            assert_eq!(report(Some(json)).failures(), 2, "{json}");
        }
    }

    #[test]
    fn a_bar_without_a_bound_or_with_a_misspelt_key_is_refused() {
        let with = |line: &str| Bars::parse(&format!("[[bar]]\nfiles = [\"a\"]\nkey = \"k\"\n{line}"));
        assert!(with("at_most = 1").is_ok());
        for bad in ["", "at_most = 1\nat_least = 0", "at_mots = 1"] {
            assert!(with(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn every_file_with_a_bar_is_made_by_a_long_run() {
        let bars = Bars::parse(BARS).expect("the project's bars");
        let jobs: Vec<String> = crate::results::long::names();
        for file in bars.files() {
            assert!(jobs.iter().any(|job| job == file), "no long run makes {file}.json");
        }
    }
}

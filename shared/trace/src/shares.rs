//! Busy share of each row of a trace, and the share in which two rows overlap.

use crate::TraceError;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// Rows of a trace with the times at which they were at work.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shares {
    /// From the first event's begin to the last one's end, microseconds.
    pub took_us: f64,
    rows: Vec<(String, Vec<[f64; 2]>)>,
}

impl Shares {
    /// Of a file.
    ///
    /// # Errors
    /// It cannot be read, or is no trace.
    pub fn read(path: &Path) -> Result<Self, TraceError> {
        Ok(Self::of(&crate::read(path)?))
    }

    /// Of events; what takes no time is no work.
    pub fn of(events: &[Value]) -> Self {
        let mut names: BTreeMap<[u64; 2], [String; 2]> = BTreeMap::new();
        let mut spans: BTreeMap<[u64; 2], Vec<[f64; 2]>> = BTreeMap::new();
        let mut ends: Option<[f64; 2]> = None;
        for event in events {
            let row = ["pid", "tid"].map(|key| event[key].as_u64().unwrap_or_default());
            let name = event["args"]["name"].as_str().unwrap_or_default().to_owned();
            match (event["ph"].as_str(), event["name"].as_str()) {
                (Some("M"), Some("process_name")) => names.entry(row).or_default()[0] = name,
                (Some("M"), Some("thread_name")) => names.entry(row).or_default()[1] = name,
                (Some("X"), _) => {
                    let [begin, took] = ["ts", "dur"].map(|key| event[key].as_f64().unwrap_or_default());
                    let [first, last] = ends.unwrap_or([begin, begin + took]);
                    ends = Some([first.min(begin), last.max(begin + took)]);
                    spans.entry(row).or_default().push([begin, begin + took]);
                }
                _ => {}
            }
        }
        let rows = spans.into_iter().map(|(row, spans)| {
            let name = names.get(&row).map_or_else(String::new, |names| names.join(" "));
            (name, united(spans))
        });
        Self {
            took_us: ends.map_or(0.0, |[first, last]| last - first),
            rows: rows.filter(|(_, spans)| !spans.is_empty()).collect(),
        }
    }

    /// Names of rows with the part of the time at which each was at work, 0..1, in the order of the file.
    pub fn rows(&self) -> impl Iterator<Item = (&str, f64)> {
        self.rows.iter().map(|(name, spans)| (name.as_str(), length(spans) / self.took_us))
    }

    /// The part of the time at which the two rows that are named so were at work at once, 0..1; 0 where one is not there.
    pub fn at_once(&self, one: &str, other: &str) -> f64 {
        let spans = |name: &str| self.rows.iter().find(|(row, _)| row == name).map(|(_, spans)| spans);
        let (Some(one), Some(other)) = (spans(one), spans(other)) else { return 0.0 };
        let both = united(one.iter().chain(other).copied().collect());
        (length(one) + length(other) - length(&both)) / self.took_us
    }
}

/// In order, none over another, none of no length.
fn united(mut spans: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    spans.retain(|[begin, end]| end > begin);
    spans.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let mut united: Vec<[f64; 2]> = Vec::new();
    for [begin, end] in spans {
        match united.last_mut().filter(|last| begin <= last[1]) {
            Some(last) => last[1] = last[1].max(end),
            None => united.push([begin, end]),
        }
    }
    united
}

fn length(spans: &[[f64; 2]]) -> f64 {
    spans.iter().map(|[begin, end]| end - begin).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Process, Trace};
    use shadecast_protocol::time::ServerTime;

    #[test]
    fn work_is_counted_once_and_what_is_done_at_once_is_found() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.json");
        let trace = Trace::create(&path).unwrap();
        let (device, encoder) =
            (trace.track(Process::Server, "device"), trace.track(Process::Server, "encoder"));
        let at = |ms: i64| ServerTime(ms * 1_000_000);
        for [begin, end] in [[0, 30], [10, 40], [60, 70]] {
            device.span("skin", [at(begin), at(end)], None);
        }
        for [begin, end] in [[20, 50], [65, 100]] {
            encoder.span("encode", [at(begin), at(end)], None);
        }
        trace.track(Process::Client, "display").instant("shown", at(80), None);
        drop(trace);
        let shares = Shares::read(&path).unwrap();
        let percent = |share: f64| (share * 100.0).round() as i64;
        let rows: Vec<_> = shares.rows().map(|(name, share)| (name, percent(share))).collect();
        assert_eq!(rows, [("server device", 50), ("server encoder", 65)]);
        assert_eq!(percent(shares.at_once("server device", "server encoder")), 25);
        assert_eq!(percent(shares.at_once("server device", "client display")), 0);
    }

    #[test]
    fn a_trace_of_nothing_has_no_rows() {
        let shares = Shares::of(&[]);
        assert_eq!(shares, Shares::default());
        assert_eq!(shares.rows().count(), 0);
    }
}

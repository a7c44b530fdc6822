//! Traces of server and client: a file in Chrome's trace event format, for Perfetto (ui.perfetto.dev) and chrome://tracing.
//!
//! All times are the server's. Arrows join the spans of an update in the order of time, from its making to its display. A
//! separate thread writes the file, so tracing waits for no disk.

mod shares;

pub use shares::Shares;

use serde_json::{Map, Value, json};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::ServerTime;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;

/// Which program something happened in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Process {
    /// The server.
    Server,
    /// A client.
    Client,
}

/// A trace that cannot be written, or read.
#[derive(Debug, thiserror::Error)]
pub enum TraceError {
    /// The file.
    #[error("writing the trace {path}: {error}; name a file in a writable folder with --trace")]
    File {
        /// Which.
        path: PathBuf,
        /// What is wrong with it.
        error: io::Error,
    },
    /// It is no trace.
    #[error("{path} is not a trace written by --trace: {reason}")]
    Content {
        /// Which.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

/// A trace under way. Dropping it ends the file; what tracks tell later is left out.
pub struct Trace {
    /// `None` ends the file.
    events: Sender<Option<Value>>,
    tracks: AtomicU64,
    writer: Option<JoinHandle<()>>,
}

/// A row of the trace: what happens one after the other, in one thread or on one device.
#[derive(Clone)]
pub struct Track {
    events: Sender<Option<Value>>,
    process: Process,
    number: u64,
}

impl Process {
    fn number(self) -> u64 {
        match self {
            Self::Server => 1,
            Self::Client => 2,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Server => "server",
            Self::Client => "client",
        }
    }
}

impl Trace {
    /// Begins a file, in place of the one that may be there.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn create(path: &Path) -> Result<Self, TraceError> {
        let of_file = |error| TraceError::File { path: path.to_owned(), error };
        let file = BufWriter::new(File::create(path).map_err(of_file)?);
        let (events, to_write) = channel();
        let path = path.to_owned();
        let write_all = move || {
            if let Err(error) = write(file, &to_write) {
                tracing::error!("{}", TraceError::File { path, error });
            }
        };
        let writer = std::thread::Builder::new().name("trace".into()).spawn(write_all).map_err(of_file)?;
        Ok(Self { events, tracks: AtomicU64::new(0), writer: Some(writer) })
    }

    /// A new row, below those that were made before.
    pub fn track(&self, process: Process, name: &str) -> Track {
        let number = self.tracks.fetch_add(1, Ordering::Relaxed) + 1;
        let of_track = |what: &str, args: Value| json!({ "ph": "M", "name": what, "pid": process.number(), "tid": number, "args": args });
        self.write(of_track("process_name", json!({ "name": process.name() })));
        self.write(of_track("thread_name", json!({ "name": name })));
        self.write(of_track("thread_sort_index", json!({ "sort_index": number })));
        Track { events: self.events.clone(), process, number }
    }

    fn write(&self, event: Value) {
        // Where the writer has ended it has said why.
        let _ = self.events.send(Some(event));
    }
}

impl Drop for Trace {
    fn drop(&mut self) {
        let _ = self.events.send(None);
        if let Some(writer) = self.writer.take() {
            // It has said what went wrong.
            let _ = writer.join();
        }
    }
}

impl Track {
    /// Something that took from `begin` to `end`, for an update if it names one.
    pub fn span(&self, name: &'static str, [begin, end]: [ServerTime; 2], update: Option<UpdateId>) {
        let mut event = json!({
            "ph": "X",
            "name": name,
            "pid": self.process.number(),
            "tid": self.number,
            "ts": microseconds(begin.0),
            "dur": microseconds(end.since(begin).max(0)),
        });
        if let Some(UpdateId(update)) = update {
            event["args"] = json!({ "update": update });
            event["bind_id"] = json!(format!("{update:#x}"));
            (event["flow_in"], event["flow_out"]) = (json!(true), json!(true));
        }
        let _ = self.events.send(Some(event));
    }

    /// What a figure of this row is from a time on.
    pub fn counter(&self, name: &'static str, at: ServerTime, value: f64) {
        self.counters(name, at, &[("value", value)]);
    }

    /// The same of several figures that are shown one above the other.
    pub fn counters(&self, name: &'static str, at: ServerTime, values: &[(&'static str, f64)]) {
        let values: Map<String, Value> =
            values.iter().map(|(name, value)| ((*name).to_owned(), json!(value))).collect();
        let event = json!({
            "ph": "C",
            "name": name,
            "pid": self.process.number(),
            "tid": self.number,
            "ts": microseconds(at.0),
            "args": values,
        });
        let _ = self.events.send(Some(event));
    }

    /// Something that took no time.
    pub fn instant(&self, name: &'static str, at: ServerTime, update: Option<UpdateId>) {
        self.span(name, [at, at], update);
    }
}

fn microseconds(ns: i64) -> f64 {
    ns as f64 * 1e-3
}

/// Until the trace ends.
fn write(mut file: impl Write, events: &Receiver<Option<Value>>) -> io::Result<()> {
    for (number, event) in events.iter().map_while(|event| event).enumerate() {
        file.write_all(if number == 0 { b"[\n" } else { b",\n" })?;
        serde_json::to_writer(&mut file, &event)?;
    }
    file.write_all(b"\n]\n")?;
    file.flush()
}

/// Puts traces of several programs into one: the processes of each file keep to themselves.
///
/// # Errors
/// A file cannot be read or written, or is no trace.
pub fn merge(files: &[PathBuf], into: &Path) -> Result<(), TraceError> {
    let mut all: Vec<Value> = Vec::new();
    for (number, path) in files.iter().enumerate() {
        for mut event in read(path)? {
            let process = event["pid"].as_u64().unwrap_or_default();
            event["pid"] = json!(process + 2 * number as u64);
            all.push(event);
        }
    }
    let of_file = |error| TraceError::File { path: into.to_owned(), error };
    let mut file = BufWriter::new(File::create(into).map_err(of_file)?);
    serde_json::to_writer(&mut file, &all).map_err(|error| of_file(error.into()))?;
    file.flush().map_err(of_file)
}

/// The events of a file, each of a process.
fn read(path: &Path) -> Result<Vec<Value>, TraceError> {
    let text = std::fs::read_to_string(path);
    let text = text.map_err(|error| TraceError::File { path: path.to_owned(), error })?;
    let not_a_trace = |reason: String| TraceError::Content { path: path.to_owned(), reason };
    let events: Vec<Value> = serde_json::from_str(&text).map_err(|error| not_a_trace(error.to_string()))?;
    let is_whole = |event: &Value| event.get("pid").and_then(Value::as_u64).is_some();
    if events.iter().all(is_whole) {
        Ok(events)
    } else {
        Err(not_a_trace("an event is of no process".into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64) -> ServerTime {
        ServerTime(ms * 1_000_000)
    }

    fn events(path: &Path) -> Vec<Value> {
        serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
    }

    fn spans(path: &Path) -> Vec<(u64, String, f64, f64)> {
        let spans = events(path).into_iter().filter(|event| event["ph"] == "X");
        let of = |event: Value| {
            let [ts, dur] = ["ts", "dur"].map(|key| event[key].as_f64().unwrap());
            (event["pid"].as_u64().unwrap(), event["name"].as_str().unwrap().to_owned(), ts, dur)
        };
        spans.map(of).collect()
    }

    #[test]
    fn spans_of_an_update_are_joined_and_each_row_has_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.json");
        let trace = Trace::create(&path).unwrap();
        let (pipeline, display) =
            (trace.track(Process::Server, "pipeline"), trace.track(Process::Client, "display"));
        pipeline.span("update", [at(10), at(22)], Some(UpdateId(7)));
        display.instant("shown", at(60), Some(UpdateId(7)));
        pipeline.span("idle", [at(30), at(29)], None);
        drop(trace);
        let expected = [(1, "update", 10e3, 12e3), (2, "shown", 60e3, 0.0), (1, "idle", 30e3, 0.0)];
        assert_eq!(
            spans(&path),
            expected.map(|(process, name, ts, dur)| (process, name.to_owned(), ts, dur))
        );
        let all = events(&path);
        let joined: Vec<&Value> = all.iter().filter(|event| event["bind_id"] == "0x7").collect();
        assert_eq!(joined.len(), 2);
        assert!(joined.iter().all(|event| event["flow_in"] == true && event["flow_out"] == true));
        let names: Vec<&Value> = all.iter().filter(|event| event["name"] == "thread_name").collect();
        assert_eq!(
            names.iter().map(|event| &event["args"]["name"]).collect::<Vec<_>>(),
            ["pipeline", "display"]
        );
    }

    #[test]
    fn a_trace_ends_though_somebody_might_go_on() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.json");
        let trace = Trace::create(&path).unwrap();
        let track = trace.track(Process::Server, "pipeline");
        track.instant("before", at(1), None);
        drop(trace);
        track.instant("after", at(2), None);
        assert_eq!(spans(&path).len(), 1);
    }

    #[test]
    fn counters_have_their_names() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.json");
        let trace = Trace::create(&path).unwrap();
        trace.track(Process::Server, "encoder").counters("bits", at(1), &[("moving", 7.0), ("refresh", 0.0)]);
        drop(trace);
        let all = events(&path);
        let counters: Vec<&Value> = all.iter().filter(|event| event["ph"] == "C").collect();
        assert_eq!(counters.len(), 1);
        assert_eq!(counters[0]["args"], json!({ "moving": 7.0, "refresh": 0.0 }));
    }

    #[test]
    fn several_threads_write_whole_events() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.json");
        let trace = Trace::create(&path).unwrap();
        std::thread::scope(|scope| {
            for number in 0..4 {
                let track = trace.track(Process::Server, &format!("thread {number}"));
                scope.spawn(move || (0..500).for_each(|ms| track.instant("event", at(ms), None)));
            }
        });
        drop(trace);
        assert_eq!(spans(&path).len(), 2000);
    }

    #[test]
    fn merged_traces_keep_their_processes_apart() {
        let folder = tempfile::tempdir().unwrap();
        let file = |name: &str| folder.path().join(name);
        for (name, process) in [("server.json", Process::Server), ("client.json", Process::Client)] {
            let trace = Trace::create(&file(name)).unwrap();
            trace.track(process, "main").instant("event", at(1), None);
        }
        merge(&[file("server.json"), file("client.json")], &file("all.json")).unwrap();
        assert_eq!(spans(&file("all.json")).iter().map(|(process, ..)| *process).collect::<Vec<_>>(), [1, 4]);
        std::fs::write(file("other.json"), "{\"a\": 1}").unwrap();
        std::fs::write(file("strange.json"), "[{\"a\": 1}]").unwrap();
        for name in ["other.json", "strange.json", "none.json"] {
            let error = merge(&[file(name)], &file("all.json")).unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
    }

    #[test]
    fn a_trace_that_cannot_be_written_says_so_with_a_remedy() {
        let folder = tempfile::tempdir().unwrap();
        let error = Trace::create(folder.path()).err().map(|error| error.to_string()).unwrap_or_default();
        assert!(error.contains("--trace"), "{error}");
    }
}

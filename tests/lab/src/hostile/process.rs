//! The server under attack: the real program on loopback, with its memory and its last output.

use crate::process::program;
use anyhow::{Context, bail};
use shadecast_system::process::resident_bytes;
use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// How long a program may take to start.
const PATIENCE: Duration = Duration::from_secs(120);
/// Lines of a program's output that are kept.
const KEPT_LINES: usize = 40;
/// From one look at a program's memory to the next.
const MEMORY_INTERVAL: Duration = Duration::from_millis(50);

/// The last lines that a program wrote.
type Lines = Arc<Mutex<VecDeque<String>>>;

/// A program that is ended when it is dropped.
pub(crate) struct Program {
    child: Child,
    lines: Lines,
    heard: Receiver<String>,
}

impl Program {
    /// Starts it, and keeps what it writes.
    pub(crate) fn start(command: &mut Command) -> anyhow::Result<Self> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().with_context(|| format!("starting {command:?}"))?;
        let (to, heard) = channel();
        let lines = Lines::default();
        if let Some(output) = child.stdout.take() {
            collect(output, lines.clone(), to.clone());
        }
        if let Some(output) = child.stderr.take() {
            collect(output, lines.clone(), to);
        }
        Ok(Self { child, lines, heard })
    }

    /// Waits for a line that holds `text`, and gives it.
    pub(crate) fn wait_line(&mut self, text: &str) -> anyhow::Result<String> {
        let deadline = Instant::now() + PATIENCE;
        while let Ok(line) = self.heard.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            if line.contains(text) {
                return Ok(line);
            }
        }
        bail!("\"{text}\" was not said in time; what was said: {}", self.last_words())
    }

    /// Whether it has not ended.
    pub(crate) fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// Its last lines.
    pub(crate) fn last_words(&self) -> String {
        let lines = self.lines.lock().unwrap_or_else(PoisonError::into_inner);
        lines.iter().cloned().collect::<Vec<_>>().join("\n")
    }

    /// Its resident memory in bytes; `None` once it has ended.
    pub(crate) fn memory_bytes(&self) -> Option<u64> {
        resident_bytes(self.child.id())
    }

    /// Watches its memory from now on.
    pub(crate) fn watch_memory(&self) -> MemoryWatch {
        MemoryWatch::start(self.child.id())
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn collect(output: impl Read + Send + 'static, lines: Lines, to: Sender<String>) {
    std::thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            let mut kept = lines.lock().unwrap_or_else(PoisonError::into_inner);
            if kept.len() == KEPT_LINES {
                kept.pop_front();
            }
            kept.push_back(line.clone());
            drop(kept);
            let _ = to.send(line); // nobody may listen any more
        }
    });
}

/// Samples a process's memory.
pub(crate) struct MemoryWatch {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<u64>>,
}

impl MemoryWatch {
    fn start(pid: u32) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let flag = stop.clone();
        let thread = std::thread::spawn(move || {
            let mut peak = 0;
            loop {
                peak = peak.max(resident_bytes(pid).unwrap_or(0));
                if flag.load(Ordering::Relaxed) {
                    return peak;
                }
                std::thread::sleep(MEMORY_INTERVAL);
            }
        });
        Self { stop, thread: Some(thread) }
    }

    /// The most that it was, in bytes.
    pub(crate) fn peak_bytes(mut self) -> u64 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.take().and_then(|thread| thread.join().ok()).unwrap_or(0)
    }
}

impl Drop for MemoryWatch {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
    }
}

/// The server with a scene on a free port of this machine. It ends by itself after `seconds`.
pub(crate) struct Server {
    /// The process.
    pub(crate) program: Program,
    /// Where it listens.
    pub(crate) address: SocketAddr,
}

impl Server {
    pub(crate) fn start(scene: &str, identity: &Path, admit: &str, seconds: f64) -> anyhow::Result<Self> {
        let mut command = Command::new(program("shadecast-server")?);
        command.args(["stream", scene, "--listen", "127.0.0.1:0", "--atlas", "512x512", "--no-shadows"]);
        command.args(["--no-cache", "--seconds", &seconds.to_string(), "--admit", admit]);
        command.arg("--identity").arg(identity);
        let mut program = Program::start(&mut command)?;
        let line = program.wait_line("Listening on ")?;
        let address = line
            .split_once("Listening on ")
            .and_then(|(_, rest)| rest.split_whitespace().next())
            .and_then(|address| address.parse().ok())
            .with_context(|| format!("no address in \"{line}\""))?;
        Ok(Self { program, address })
    }
}

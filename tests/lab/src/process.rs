//! Programs of the project as processes: found beside this one, started, listened to, and ended.

use anyhow::{Context, bail, ensure};
use shadecast_system::process::{interrupt, interruptible};
use std::env::consts::EXE_SUFFIX;
use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

/// How long a process may take to start, to show the first picture, or to end.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);

/// A free port of this machine, for itself alone: bound for a moment, then left to a server.
pub(crate) fn free_address() -> anyhow::Result<SocketAddr> {
    UdpSocket::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).context("finding a free port")
}

/// A process that is ended when it is dropped.
pub(crate) struct Running {
    pub(crate) name: &'static str,
    child: Child,
    /// Its output, once somebody has asked for it.
    lines: Option<Receiver<String>>,
}

impl Running {
    pub(crate) fn start(name: &'static str, command: &mut Command) -> anyhow::Result<Self> {
        let child = interruptible(command.stdin(Stdio::null())).spawn();
        Ok(Self { name, child: child.with_context(|| format!("starting {name}"))?, lines: None })
    }

    /// Reads the process's output on until a line holds `text`. The process never waits for a reader.
    pub(crate) fn says(&mut self, text: &str) -> anyhow::Result<()> {
        let output = self.child.stdout.take();
        let lines = self.lines.get_or_insert_with(|| {
            let (said, lines) = std::sync::mpsc::channel();
            std::thread::spawn(move || {
                let read = output.into_iter().flat_map(|output| BufReader::new(output).lines());
                read.map_while(Result::ok).for_each(|line| drop(said.send(line)));
            });
            lines
        });
        let deadline = Instant::now() + PATIENCE;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match lines.recv_timeout(left) {
                Ok(line) if line.contains(text) => return Ok(()),
                Ok(_) => {}
                Err(_) => bail!("{} did not say {text:?}; its messages are above", self.name),
            }
        }
    }

    pub(crate) fn is_running(&mut self) -> anyhow::Result<bool> {
        Ok(self.child.try_wait()?.is_none())
    }

    pub(crate) fn wait(&mut self, deadline: Instant) -> anyhow::Result<()> {
        loop {
            match self.child.try_wait()? {
                Some(status) if status.success() => return Ok(()),
                Some(status) => bail!("{} ended with {status}; its messages are above", self.name),
                None if Instant::now() > deadline => bail!("{} did not end in time", self.name),
                None => std::thread::sleep(Duration::from_millis(50)),
            }
        }
    }

    /// Asks the process to end, as Ctrl-C does.
    pub(crate) fn interrupt(&self) -> anyhow::Result<()> {
        interrupt(&self.child).with_context(|| format!("{} could not be asked to end", self.name))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A program of the project, which lies beside this one.
pub(crate) fn program(name: &str) -> anyhow::Result<PathBuf> {
    let here = std::env::current_exe().context("finding the programs")?;
    let folder = here.parent().context("finding the programs")?;
    let folder = if folder.ends_with("deps") { folder.parent().unwrap_or(folder) } else { folder };
    let path = folder.join(format!("{name}{EXE_SUFFIX}"));
    ensure!(path.exists(), "{} is not built; run `cargo build --release -p {name}`", path.display());
    Ok(path)
}

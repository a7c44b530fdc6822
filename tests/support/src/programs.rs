//! Programs as users run them: started, heard, interrupted, and ended by their id when a test is over.

use std::io::{BufRead, BufReader, Read};
use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// A software device on a busy machine is slow to start.
pub const PATIENCE: Duration = Duration::from_secs(120);
/// From one look at something to the next.
const NAP: Duration = Duration::from_millis(20);

/// One of the project's programs, built beside the test that asks.
#[track_caller]
pub fn program(name: &str) -> PathBuf {
    let here = std::env::current_exe().expect("this test is a file");
    let path = here.parent().and_then(Path::parent).expect("the folder of programs");
    let path = path.join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
    assert!(path.exists(), "{} is not built; `./shadecast test` builds it first", path.display());
    path
}

/// A free UDP port of this machine, for itself alone: bound for a moment, then left to a server.
#[track_caller]
pub fn free_address() -> SocketAddr {
    UdpSocket::bind("127.0.0.1:0").and_then(|socket| socket.local_addr()).expect("a free port")
}

/// Sends a signal, by its name with a dash, as `kill` has it.
#[track_caller]
pub fn signal(child: &Child, signal: &str) {
    let status = Command::new("kill").args([signal, &child.id().to_string()]).status();
    assert!(status.is_ok_and(|status| status.success()), "the process is there");
}

/// Waits for the end; kills and fails after `most`.
#[track_caller]
pub fn end_within(child: &mut Child, most: Duration) -> ExitStatus {
    let deadline = Instant::now() + most;
    while Instant::now() < deadline {
        if let Some(status) = child.try_wait().expect("a child can be asked") {
            return status;
        }
        std::thread::sleep(NAP);
    }
    let _ = child.kill();
    let _ = child.wait();
    panic!("it did not end within {most:?}");
}

/// Runs a program to its end, with nothing on its standard input: what it says and how it ends. Kills it and fails after
/// [`PATIENCE`].
#[track_caller]
pub fn output_of(command: &mut Command) -> Output {
    let command = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().expect("it starts");
    let [stdout, stderr] =
        [read(child.stdout.take().expect("piped")), read(child.stderr.take().expect("piped"))];
    let status = end_within(&mut child, PATIENCE);
    let all = |read: JoinHandle<Vec<u8>>| read.join().expect("a pipe can be read");
    Output { status, stdout: all(stdout), stderr: all(stderr) }
}

fn read(mut output: impl Read + Send + 'static) -> JoinHandle<Vec<u8>> {
    std::thread::spawn(move || {
        let mut said = Vec::new();
        output.read_to_end(&mut said).expect("a pipe can be read");
        said
    })
}

/// Waits for something that is to come true.
#[track_caller]
pub fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !is_so() {
        assert!(Instant::now() < deadline, "not in time: {what}");
        std::thread::sleep(NAP);
    }
}

/// Which of a program's outputs is listened to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Voice {
    /// Standard output.
    Output,
    /// Standard error.
    Errors,
}

/// A program with one of its outputs as lines, killed when it is dropped.
pub struct Program {
    child: Child,
    lines: Receiver<String>,
    said: String,
}

impl Program {
    /// Starts it and listens to its end.
    pub fn start(command: &mut Command, voice: Voice) -> Self {
        Self::start_reading(command, voice, usize::MAX)
    }

    /// Reads so many lines of the output, then closes it.
    pub fn start_reading(command: &mut Command, voice: Voice, most: usize) -> Self {
        command.stdin(Stdio::null());
        let (to, lines) = channel();
        let child = match voice {
            Voice::Output => {
                let mut child = command.stdout(Stdio::piped()).spawn().expect("it starts");
                listen(child.stdout.take().expect("piped"), to, most);
                child
            }
            Voice::Errors => {
                let mut child = command.stderr(Stdio::piped()).spawn().expect("it starts");
                listen(child.stderr.take().expect("piped"), to, most);
                child
            }
        };
        Self { child, lines, said: String::new() }
    }

    /// Waits for a further line with these words.
    #[track_caller]
    pub fn says(&mut self, words: &str) {
        self.line_with(words);
    }

    /// The same, and gives the line.
    #[track_caller]
    pub fn line_with(&mut self, words: &str) -> String {
        let deadline = Instant::now() + PATIENCE;
        while let Some(line) = self.next_line(deadline) {
            if line.contains(words) {
                return line;
            }
        }
        panic!("\"{words}\" was not said in time, but: {}", self.said);
    }

    /// Waits until it has said these words, now or before.
    #[track_caller]
    pub fn has_said(&mut self, words: &str) {
        let deadline = Instant::now() + PATIENCE;
        while !self.said.contains(words) {
            assert!(self.next_line(deadline).is_some(), "\"{words}\" was not said, but: {}", self.said);
        }
    }

    fn next_line(&mut self, deadline: Instant) -> Option<String> {
        let line = self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now())).ok()?;
        self.said += &line;
        self.said.push('\n');
        Some(line)
    }

    /// Sends a signal, as [`signal`].
    #[track_caller]
    pub fn signal(&self, name: &str) {
        signal(&self.child, name);
    }

    /// How it ends, and all that it has said.
    #[track_caller]
    pub fn ends(mut self) -> (ExitStatus, String) {
        let status = end_within(&mut self.child, PATIENCE);
        while self.next_line(Instant::now() + PATIENCE).is_some() {}
        (status, std::mem::take(&mut self.said))
    }

    /// It ends by itself, successfully.
    #[track_caller]
    pub fn ends_well(self) {
        let (status, said) = self.ends();
        assert!(status.success(), "{status}: {said}");
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn listen(output: impl Read + Send + 'static, to: Sender<String>, most: usize) {
    std::thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok).take(most) {
            println!("{line}");
            let _ = to.send(line); // nobody may listen any more
        }
    });
}

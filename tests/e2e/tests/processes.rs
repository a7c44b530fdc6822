//! Server and client as users run them: two processes on loopback, killed and started again.

use serde_json::Value;
use shadecast_lab::demo::read_probe;
use shadecast_lab::options::RunOptions;
use shadecast_lab::run::{mock_config, prepare_runtime};
use shadecast_mock_runtime::config::ClockKind;
use shadecast_scene::load::SceneSource;
use std::io::{BufRead, BufReader};
use std::net::{SocketAddr, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

/// A software device on a busy machine is slow to start.
const PATIENCE: Duration = Duration::from_secs(120);

fn program(name: &str) -> PathBuf {
    let here = std::env::current_exe().unwrap();
    let path = here.parent().and_then(Path::parent).unwrap().join(name);
    assert!(path.exists(), "{} is not built; `./shadecast test` builds it first", path.display());
    path
}

/// A process with its output as lines, ended by pid when the test is over.
struct Running {
    child: Child,
    lines: Receiver<String>,
}

impl Running {
    fn start(command: &mut Command) -> Self {
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).spawn().unwrap();
        let output = child.stdout.take().unwrap();
        let (to, lines) = channel();
        std::thread::spawn(move || {
            for line in BufReader::new(output).lines().map_while(Result::ok) {
                println!("{line}");
                let _ = to.send(line);
            }
        });
        Self { child, lines }
    }

    #[track_caller]
    fn says(&self, text: &str) {
        let deadline = Instant::now() + PATIENCE;
        while let Ok(line) = self.lines.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            if line.contains(text) {
                return;
            }
        }
        panic!("\"{text}\" was not said in time");
    }

    fn signal(&self, signal: &str) {
        let killed = Command::new("kill").args([signal, &self.child.id().to_string()]).status().unwrap();
        assert!(killed.success());
    }

    #[track_caller]
    fn ends_well(&mut self) {
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if let Some(status) = self.child.try_wait().unwrap() {
                assert!(status.success(), "{status}");
                return;
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        panic!("it did not end in time");
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

struct Stage {
    folder: tempfile::TempDir,
    address: SocketAddr,
}

impl Stage {
    fn new() -> Self {
        let address = UdpSocket::bind("127.0.0.1:0").and_then(|s| s.local_addr()).unwrap();
        Self { folder: tempfile::tempdir().unwrap(), address }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn server(&self, stats: &str) -> Running {
        let mut command = Command::new(program("shadecast-server"));
        command.args(["stream", "dragon", "--listen", &self.address.to_string(), "--atlas", "1024x1024"]);
        command.args(["--seconds", "300", "--validation"]).arg("--identity").arg(self.path("server"));
        Running::start(command.arg("--stats").arg(self.path(stats)))
    }

    /// A client on a runtime of its own.
    fn client(&self, name: &str) -> Running {
        let out = self.path(name);
        let options = RunOptions {
            extent_pixels: [96, 96],
            seconds: 240.0,
            ..RunOptions::new(SceneSource::Dragons(1), out.clone())
        };
        let config = mock_config(&options, ClockKind::Real, 0).unwrap();
        let runtime = prepare_runtime(&config, &out).unwrap();
        let mut command = Command::new(program("shadecast-client"));
        command.args(["--connect", &self.address.to_string(), "--validation", "--probe-every", "3"]);
        command.arg("--probe-dir").arg(out.join("probe"));
        command.arg("--identity").arg(self.path("client")).arg("--stats").arg(out.join("client.json"));
        command.envs(runtime.iter().map(|(name, value)| (name, value)));
        Running::start(&mut command)
    }

    /// Waits until the client shows geometry in a frame that is not there yet: one of its probes holds an instance.
    #[track_caller]
    fn shows_the_scene(&self, name: &str) {
        let folder = self.path(name).join("probe");
        let probes = || std::fs::read_dir(&folder).into_iter().flatten().flatten().map(|entry| entry.path());
        let known: Vec<PathBuf> = probes().collect();
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if probes()
                .filter(|path| !known.contains(path))
                .any(|path| read_probe(&path).is_ok_and(|probe| probe.coverage() > 0.0))
            {
                return;
            }
            std::thread::sleep(Duration::from_millis(200));
        }
        panic!("the client showed nothing of the scene in time");
    }

    fn json(&self, name: &str) -> Value {
        serde_json::from_str(&std::fs::read_to_string(self.path(name)).unwrap()).unwrap()
    }
}

fn number(value: &Value, key: &str) -> f64 {
    value.get(key).and_then(Value::as_f64).unwrap_or_else(|| panic!("{key} in {value}"))
}

#[test]
fn a_killed_server_comes_back_and_the_client_goes_on() {
    let stage = Stage::new();
    let first = stage.server("first.json");
    first.says("Listening");
    let mut client = stage.client("a");
    first.says("Client connected");
    stage.shows_the_scene("a");
    first.signal("-KILL");
    drop(first);
    stage.shows_the_scene("a"); // the last frame stays
    let mut second = stage.server("second.json");
    second.says("Client connected");
    second.says("First update sent"); // until then the client still shows the first server's
    stage.shows_the_scene("a");
    client.signal("-INT");
    client.ends_well();
    second.signal("-INT");
    second.ends_well();
    let (shown, served) = (stage.json("a/client.json"), stage.json("second.json"));
    assert!(number(&shown, "connections") >= 2.0, "{shown}");
    assert!(number(&shown, "frames_with_bundle") > 10.0, "{shown}");
    assert!(number(&served, "updates") > 0.0, "{served}");
    for stats in [&shown, &served] {
        assert_eq!(number(stats, "validation_messages"), 0.0, "{stats}");
    }
}

#[test]
fn a_killed_client_is_forgotten_and_the_next_one_is_served() {
    let stage = Stage::new();
    let mut server = stage.server("server.json");
    server.says("Listening");
    let first = stage.client("a");
    server.says("Client connected");
    stage.shows_the_scene("a");
    first.signal("-KILL");
    drop(first);
    let mut next = stage.client("b");
    server.says("Client connected");
    stage.shows_the_scene("b");
    next.signal("-INT");
    next.ends_well();
    server.signal("-INT");
    server.ends_well();
    assert!(number(&stage.json("b/client.json"), "frames_with_bundle") > 0.0);
    let served = stage.json("server.json");
    assert!(number(&served, "clients") >= 2.0, "{served}");
    assert_eq!(number(&served, "validation_messages"), 0.0, "{served}");
}

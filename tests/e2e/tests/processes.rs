//! Server and client as users run them: two processes on loopback, killed and started again.

use serde_json::Value;
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_lab::experiments::run::mock_config;
use shadecast_lab::probe_file::read_probe;
use shadecast_lab::session::options::RunOptions;
use shadecast_lab::session::runtime::prepare_runtime;
use shadecast_mock_runtime::config::ClockKind;
use shadecast_protocol::message::{Capabilities, ClientHello, ClientMessage, ServerMessage};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_scene::load::SceneSource;
use shadecast_test_support::peers::hello;
use shadecast_test_support::programs::{PATIENCE, Program, Voice, free_address, output_of, program};
use shadecast_transport::mio::any_address_for;
use shadecast_transport::{
    Driver, Endpoint, EndpointConfig, Event, Events, ExpectedIdentity, Handle, PeerId, spawn,
};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

struct Stage {
    folder: tempfile::TempDir,
    address: SocketAddr,
}

impl Stage {
    fn new() -> Self {
        let address = free_address();
        Self { folder: tempfile::tempdir().unwrap(), address }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn server(&self, stats: &str) -> Program {
        Program::start(&mut self.server_command("dragon", stats), Voice::Output)
    }

    fn server_command(&self, scene: &str, stats: &str) -> Command {
        let mut command = Command::new(program("shadecast-server"));
        command.args(["stream", scene, "--listen", &self.address.to_string(), "--atlas", "1024x1024"]);
        command.args(["--seconds", "300", "--validation"]).arg("--identity").arg(self.path("server"));
        command.arg("--stats").arg(self.path(stats));
        command
    }

    /// A client on a runtime of its own.
    fn client(&self, name: &str) -> Program {
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
        Program::start(&mut command, Voice::Output)
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
                .any(|path| read_probe(&path).is_ok_and(|probe| probe.view.coverage() > 0.0))
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
    let mut first = stage.server("first.json");
    first.says("Listening");
    let client = stage.client("a");
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
    let mut server =
        Program::start(stage.server_command("dragon", "server.json").args(["--viewers", "1"]), Voice::Output);
    server.says("Listening");
    let first = stage.client("a");
    server.says("Client connected");
    stage.shows_the_scene("a");
    first.signal("-KILL");
    drop(first);
    let next = stage.client("b");
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

#[test]
fn killing_one_client_does_not_disturb_the_other() {
    let stage = Stage::new();
    let mut server = stage.server("server.json");
    server.says("Listening");
    let first = stage.client("a");
    server.says("Client connected");
    let second = stage.client("b");
    server.says("Client connected");
    stage.shows_the_scene("a");
    stage.shows_the_scene("b");
    first.signal("-KILL");
    drop(first);
    stage.shows_the_scene("b");
    server.says("Client away");
    stage.shows_the_scene("b");
    second.signal("-INT");
    second.ends_well();
    server.signal("-INT");
    server.ends_well();
    let (shown, served) = (stage.json("b/client.json"), stage.json("server.json"));
    assert_eq!(number(&shown, "connections"), 1.0, "the other one's end is nothing to it: {shown}");
    let viewers = served["viewers"].as_array().unwrap();
    assert!(viewers.len() == 2 && viewers.iter().all(|viewer| number(viewer, "updates") > 0.0), "{served}");
    for stats in [&shown, &served] {
        assert_eq!(number(stats, "validation_messages"), 0.0, "{stats}");
    }
}

/// A client that is nothing but a connection and the words it is given.
struct Stranger {
    handle: Handle,
    events: Events,
    peer: PeerId,
}

impl Stranger {
    fn connect(address: SocketAddr) -> Self {
        let endpoint = Endpoint::client(EndpointConfig::default());
        let (handle, events) = spawn(Driver::bind(endpoint, any_address_for(address)).unwrap()).unwrap();
        let peer = handle.connect(address, ExpectedIdentity::TrustOnFirstUse).unwrap();
        Self { handle, events, peer }
    }

    /// Says hello with these eyes, and gives the answer.
    #[track_caller]
    fn greet(&self, eye_extent_pixels: [u32; 2], fov: Fov) -> ServerMessage {
        let eye = Eye { head_from_eye: Pose::IDENTITY, fov };
        let hello = hello();
        let capabilities = Capabilities { eyes: [eye; 2], eye_extent_pixels, ..hello.capabilities };
        let hello = ClientHello { capabilities, ..hello };
        self.handle.send_control(self.peer, ClientMessage::Hello(hello).encode()).unwrap();
        let deadline = Instant::now() + PATIENCE;
        while Instant::now() < deadline {
            if let Ok(Some(Event::Control { message, .. })) =
                self.events.next_timeout(Duration::from_millis(50))
            {
                return ServerMessage::decode(&message).unwrap();
            }
        }
        panic!("no answer to a hello");
    }
}

#[test]
fn impossible_eyes_are_refused_and_valid_clients_served() {
    let stage = Stage::new();
    let mut server = stage.server("server.json");
    server.says("Listening");
    let angle = |a: f32| Fov { left: -a, right: a, up: a, down: -a };
    let outside = Fov { left: -0.5, right: 1.56, up: 0.5, down: -0.5 };
    let impossible = [
        ([8192, 8192], angle(0.0005)),
        ([1000, 1000], angle(f32::MIN_POSITIVE / 2.0)),
        ([1000, 1000], outside),
        ([8192, 8192], angle(0.7)),
    ];
    for (extent, fov) in impossible {
        let answer = Stranger::connect(stage.address).greet(extent, fov);
        let ServerMessage::Refused(refused) = answer else { panic!("{answer:?}") };
        assert!(refused.reason.contains("eye") && !refused.remedy.is_empty(), "{refused:?}");
    }
    let client = stage.client("a");
    server.says("Client connected");
    stage.shows_the_scene("a");
    client.signal("-INT");
    client.ends_well();
    server.signal("-INT");
    server.ends_well();
}

#[test]
fn a_server_whose_output_is_closed_goes_on_serving() {
    let stage = Stage::new();
    let mut server =
        Program::start_reading(&mut stage.server_command("dragon", "server.json"), Voice::Output, 1);
    server.says("Listening");
    let client = stage.client("a");
    stage.shows_the_scene("a");
    client.signal("-INT");
    client.ends_well();
    let answer = Stranger::connect(stage.address).greet([64, 64], Fov::symmetric_degrees(90.0));
    assert!(matches!(answer, ServerMessage::Welcome(_)), "{answer:?}");
    server.signal("-INT");
    server.ends_well();
    assert!(number(&stage.json("server.json"), "updates") > 0.0);
}

#[test]
fn a_too_large_scene_is_refused_before_listening() {
    let options = GpuOptions { needs: Needs::Server, validation: false, device_name: None };
    let most = Gpu::open(&options, &DesktopDevice).unwrap().max_storage_buffer_bytes();
    // The patches of 4095 dragons, the most that a scene may have, take 400 MiB.
    if most >= 400 << 20 {
        eprintln!(
            "SKIPPED: this device binds {} MiB at once, more than any scene of dragons needs",
            most >> 20
        );
        return;
    }
    let stage = Stage::new();
    let scene = stage.path("many.toml");
    let text = "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[grid]]\nmodel = \"d\"\ncount = [63, 1, 65]\nspacing = [3, 0, 3]\n";
    std::fs::write(&scene, text).unwrap();
    let scene = scene.to_str().unwrap();
    let output = output_of(&mut stage.server_command(scene, "server.json"));
    let (said, failed) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(!output.status.success() && !said.contains("Listening"), "{said}{failed}");
    for words in [scene, "MiB are needed", &format!("at most {} MiB", most >> 20), "use fewer"] {
        assert!(failed.contains(words), "\"{words}\" in: {failed}");
    }
    assert!(!failed.contains("no Vulkan device"), "{failed}");
}

//! Messages on a terminal, and interrupted programs.

use serde_json::Value;
use shadecast_lab::session::runtime::prepare_runtime;
use shadecast_mock_runtime::config::{EventKind, MockConfig, ScriptedEvent, ScriptedInput};
use shadecast_test_support::programs::{Program, Voice, output_of, program};
use shadecast_transport::discovery::announce::Announcement;
use shadecast_transport::{
    Driver, Endpoint, EndpointConfig, Events, Fingerprint, Handle, ServerIdentity, spawn,
};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

/// The program ends by itself, unsuccessfully; what it says on standard error.
#[track_caller]
fn refused(name: &str, arguments: &[&str]) -> String {
    let output = output_of(Command::new(program(name)).args(arguments));
    assert!(!output.status.success(), "{name} {arguments:?} succeeded");
    String::from_utf8(output.stderr).expect("text")
}

#[test]
fn an_atlas_that_no_client_takes_is_refused_at_the_command_line() {
    let lab: &[&str] = &["run", "dragon", "--out", "/dev/null/out", "--atlas"];
    for (name, arguments) in
        [("shadecast-server", &["stream", "dragon", "--atlas"][..]), ("shadecast-lab", lab)]
    {
        for value in ["1536x1536", "512x8192", "256x256", "2048"] {
            let said = refused(name, &[arguments, &[value]].concat());
            for word in ["--atlas", value, "2048x2048"] {
                assert!(said.contains(word), "{name}: {said}");
            }
        }
        let said = refused(name, &[arguments, &["1536x1536"]].concat());
        assert!(said.contains("power of two from 512 to 4096"), "{said}");
    }
}

#[test]
fn the_doctor_reports_abilities_and_obstacles() {
    let taken = UdpSocket::bind("127.0.0.1:0").expect("a socket");
    let address = taken.local_addr().expect("its address").to_string();
    let doctor = |address: &str, more: &[&str]| {
        let mut command = Command::new(program("shadecast-server"));
        output_of(command.args(["doctor", "--listen", address]).args(more))
    };
    let busy = doctor(&address, &[]);
    let said = String::from_utf8(busy.stdout).expect("text");
    assert!(!busy.status.success(), "{said}");
    assert!(
        said.contains("another program uses this port") && said.contains("openh264, 2048x2048"),
        "{said}"
    );
    drop(taken);
    let free = doctor(&address, &["--json"]);
    let found: Value = serde_json::from_slice(&free.stdout).expect("JSON");
    assert!(free.status.success(), "{found}");
    assert_eq!(found["can_serve"], true, "{found}");
    assert!(found["devices"][0]["is_chosen"] == true && found["udp"]["error"].is_null(), "{found}");
    for trial in found["encoders"].as_array().expect("encoders") {
        assert!(trial["first_ms"].as_f64() > Some(0.1) && trial["next_ms"].as_f64() > Some(0.1), "{trial}");
    }
    let none = doctor(&address, &["--device", "no such device"]);
    let said = String::from_utf8(none.stdout).expect("text");
    assert!(!none.status.success() && said.contains("no usable device has"), "{said}");
}

/// Folders and environment of clients.
struct Stage {
    folder: tempfile::TempDir,
}

impl Stage {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().expect("a folder") }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn manifest(&self) -> PathBuf {
        let manifest = std::fs::read_dir(self.path("runtime")).expect("the runtime's folder").flatten();
        let mut files =
            manifest.map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|e| e == "json"));
        files.find(|path| !path.ends_with("mock.json")).expect("a manifest")
    }

    /// A client that keeps what it knows in `identity`; the runtime loses its instance at these frames.
    fn client(&self, arguments: &[&str], losses: impl Iterator<Item = u64>) -> Program {
        let events = losses.map(|frame| ScriptedEvent { frame, kind: EventKind::InstanceLoss }).collect();
        self.client_on(MockConfig { events, ..MockConfig::default() }, arguments)
    }

    /// The same on another runtime.
    fn client_on(&self, config: MockConfig, arguments: &[&str]) -> Program {
        let config = MockConfig { extent_pixels: [64, 64], ..config };
        let runtime = prepare_runtime(&config, &self.path("runtime")).expect("a runtime");
        let mut command = Command::new(program("shadecast-client"));
        command.args(arguments).arg("--identity").arg(self.path("identity"));
        command.envs(runtime.iter().map(|(name, value)| (name, value)));
        Program::start(&mut command, Voice::Errors)
    }
}

/// The transport's half of a server: connections stand, and nothing is said over them.
fn mute_server(seed: u64, address: SocketAddr) -> (SocketAddr, (Handle, Events), Fingerprint) {
    let identity = ServerIdentity::from_seed(seed).expect("an identity");
    let endpoint = Endpoint::server(&identity, EndpointConfig::default()).expect("an endpoint");
    let driver = Driver::bind(endpoint, address).expect("a socket");
    let address = driver.local_addr().expect("an address");
    (address, spawn(driver).expect("a thread"), identity.fingerprint())
}

const ANY: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

#[test]
fn ctrl_c_without_headset_keeps_the_statistics() {
    let stage = Stage::new();
    let stats = stage.path("stats.json");
    let arguments = ["--connect", "127.0.0.1:9", "--stats", stats.to_str().expect("text")];
    let mut client = stage.client(&arguments, (1..200).map(|n| n * 30));
    client.has_said("per eye"); // the first frame was shown
    std::fs::remove_file(stage.manifest()).expect("the runtime goes away");
    client.has_said("the headset is gone; trying again for 30 s");
    client.signal("-INT");
    let (status, said) = client.ends();
    assert_eq!(status.code(), Some(0), "{said}");
    assert!(said.contains("frames/s"), "a summary: {said}");
    let stats: Value = serde_json::from_slice(&std::fs::read(stats).expect("statistics")).expect("JSON");
    assert!(stats["frames"].as_u64().is_some_and(|frames| frames > 0), "{stats}");
}

/// Whether a datagram to many arrives on loopback: not in every container.
fn loopback_carries_multicast() -> std::io::Result<bool> {
    let group = Ipv4Addr::new(224, 0, 0, 251);
    let hears = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))?;
    hears.join_multicast_v4(&group, &Ipv4Addr::LOCALHOST)?;
    hears.set_read_timeout(Some(Duration::from_secs(1)))?;
    let says = socket2::SockRef::from(&hears);
    says.set_multicast_if_v4(&Ipv4Addr::LOCALHOST)?;
    hears.send_to(b"?", (group, hears.local_addr()?.port()))?;
    Ok(hears.recv(&mut [0; 8]).is_ok())
}

#[test]
fn a_server_that_announces_itself_is_found_without_its_address() {
    if !loopback_carries_multicast().unwrap_or(false) {
        return eprintln!("SKIPPED: loopback carries no multicast here");
    }
    let (address, server, fingerprint) = mute_server(71, ANY);
    let announcement =
        Announcement::start("a test's server", address, fingerprint).expect("multicast on loopback");
    let stage = Stage::new();
    // Of whoever else announces itself here, this one.
    let id = fingerprint.to_string();
    let mut client = stage.client(&["--connect", "find", "--fingerprint", &id], std::iter::empty());
    client.has_said(&format!("Found a test's server at {address}"));
    client.has_said(&format!("first connection to a test's server ({address})"));
    client.signal("-INT");
    client.ends_well();
    drop((announcement, server));
    let mut alone = stage.client(&["--connect", "find", "--fingerprint", &id], std::iter::empty());
    alone.has_said("No server answers on this network yet: start one with --listen");
    alone.signal("-INT");
    alone.ends_well();
}

/// Makes a network of this process alone, with IPv6 and many listeners, and runs a program in it. Loopback carries no multicast by IPv6.
const IN_A_NETWORK: &str =
    "(ip link set lo up && ip link add one type veth peer name other && ip link set one up &&
    ip link set other up && ip -6 addr add fd05::1/64 dev one nodad) || exit 75; exec \"$0\" \"$@\"";

#[test]
fn a_server_that_listens_by_ipv6_alone_is_found() {
    const IS_INSIDE: &str = "SHADECAST_TEST_IN_A_NETWORK";
    const NAME: &str = "a_server_that_listens_by_ipv6_alone_is_found";
    if std::env::var_os(IS_INSIDE).is_none() {
        let own = std::env::current_exe().expect("this program");
        let mut inside = Command::new("unshare");
        inside.args(["--map-root-user", "--net", "sh", "-c", IN_A_NETWORK]).arg(own);
        inside.args([NAME, "--exact", "--nocapture"]).env(IS_INSIDE, "1");
        let output = inside
            .output()
            .map(|output| (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned()));
        return match output {
            Ok((Some(0), _)) => {}
            Ok((Some(101), said)) => panic!("{said}"),
            other => eprintln!("SKIPPED: no network of its own for a test: {other:?}"),
        };
    }
    let (address, server, fingerprint) = mute_server(74, "[fd05::1]:0".parse().expect("an address"));
    let announcement = Announcement::start("a server by IPv6", address, fingerprint).expect("multicast");
    let stage = Stage::new();
    let id = fingerprint.to_string();
    let mut client = stage.client(&["--connect", "find", "--fingerprint", &id], std::iter::empty());
    client.has_said(&format!("Found a server by IPv6 at {address}"));
    client.has_said(&format!("first connection to a server by IPv6 ({address})"));
    client.signal("-INT");
    client.ends_well();
    drop((announcement, server));
}

/// Others may announce themselves here too: whichever is marked, the trigger takes it, and takes another where that one has gone.
#[test]
fn of_several_servers_the_trigger_takes_the_one_that_is_marked() {
    if !loopback_carries_multicast().unwrap_or(false) {
        return eprintln!("SKIPPED: loopback carries no multicast here");
    }
    let servers = [72, 73].map(|seed| mute_server(seed, ANY));
    let announced = servers.each_ref().map(|(address, _, fingerprint)| {
        Announcement::start(&format!("one of several, {address}"), *address, *fingerprint)
    });
    assert!(announced.iter().all(Result::is_ok), "multicast on loopback");
    let stage = Stage::new();
    let presses = |number: u64| {
        let press = |input: &str, frame: u64, value: f32| {
            let path = format!("/user/hand/right/input/{input}");
            ScriptedInput { frame: 150 + number * 60 + frame, path, value }
        };
        let [next, take] = ["b/click", "trigger/value"];
        [press(next, 0, 1.0), press(next, 10, 0.0), press(take, 20, 1.0), press(take, 30, 0.0)]
    };
    let config = MockConfig {
        controllers: Some("/interaction_profiles/oculus/touch_controller".to_owned()),
        inputs: (0..40).flat_map(presses).collect(),
        ..MockConfig::default()
    };
    let mut client = stage.client_on(config, &["--connect", "find"]);
    client.has_said("Several servers: ");
    client.has_said("Found ");
    client.has_said("first connection to ");
    client.signal("-INT");
    client.ends_well();
}

#[test]
fn what_goes_wrong_is_said_in_plain_text_to_who_wants_quiet_too() {
    let silent = UdpSocket::bind(ANY).expect("a socket");
    let address = silent.local_addr().expect("an address").to_string();
    let stage = Stage::new();
    let mut client = stage.client(&["--quiet", "--connect", &address], std::iter::empty());
    client.has_said("did not answer");
    client.signal("-INT");
    let (status, said) = client.ends();
    assert_eq!(status.code(), Some(0), "{said}");
    assert!(!said.contains('\x1b'), "no colours where nobody sees them: {said:?}");
}

#[test]
fn a_known_server_is_recognised_by_any_name() {
    let stage = Stage::new();
    let (address, server, fingerprint) = mute_server(1, ANY);
    let typed = address.to_string();
    let says = |arguments: &[&str], words: &[&str]| {
        let mut client = stage.client(arguments, std::iter::empty());
        words.iter().for_each(|word| client.has_said(word));
        client.signal("-INT");
        assert_eq!(client.ends().0.code(), Some(0));
    };
    says(&["--connect", &typed], &[&format!("first connection to {typed}: its identity is {fingerprint}")]);
    let by_name = format!("localhost:{}", address.port());
    says(&["--connect", &by_name], &[&format!("is the server known as {typed}")]);
    let wrong = ServerIdentity::from_seed(2).expect("an identity").fingerprint().to_string();
    says(&["--quiet", "--connect", &typed, "--fingerprint", &wrong], &["another identity", "--fingerprint"]);
    drop(server);
    let (_, _impostor, _) = mute_server(2, address);
    says(&["--quiet", "--connect", &typed], &["another identity", "delete the line", "known_servers.toml"]);
}

#[cfg(unix)]
#[test]
fn the_second_signal_ends_the_client_at_once() {
    let stage = Stage::new();
    let pipe = stage.path("stats.json");
    assert!(Command::new("mkfifo").arg(&pipe).status().expect("mkfifo runs").success());
    // Nobody reads the pipe: after the first signal the client waits for ever to write its statistics.
    let arguments = ["--connect", "127.0.0.1:9", "--stats", pipe.to_str().expect("text")];
    let mut client = stage.client(&arguments, std::iter::empty());
    client.has_said("per eye");
    client.signal("-INT");
    std::thread::sleep(Duration::from_millis(500));
    client.signal("-INT");
    let (status, said) = client.ends();
    assert_eq!(status.code(), Some(130), "{said}");
}

#[test]
fn a_runtime_that_the_environment_names_and_nobody_has_is_named() {
    let missing = Stage::new().path("missing.json");
    let mut command = Command::new(program("shadecast-client"));
    let output = output_of(command.env("XR_RUNTIME_JSON", &missing));
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success(), "{said}");
    let words = format!("XR_RUNTIME_JSON names {}, which does not exist", missing.display());
    assert!(said.contains(&words), "{said}");
}

#[test]
fn durations_that_are_none_are_refused_by_name() {
    for value in ["nan", "-1", "inf", "1e300", "ten"] {
        let said = refused("shadecast-client", &[&format!("--seconds={value}")]);
        assert!(said.contains("--seconds") && said.contains(value), "{said}");
    }
    let said = refused("shadecast-client", &["--fingerprint", "12ab"]);
    assert!(said.contains("--fingerprint") && said.contains("64 hexadecimal digits"), "{said}");
}

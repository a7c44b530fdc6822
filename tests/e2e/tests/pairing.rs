//! Pairing as users do it: a client shows a code, and it is typed at the server.

use shadecast_lab::session::runtime::prepare_runtime;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_test_support::programs::{Program, Voice, free_address, output_of, program};
use shadecast_transport::identity::pairing::Code;
use shadecast_transport::{ClientIdentity, KnownServers, ServerIdentity};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::{Command, Output};

struct Stage {
    folder: tempfile::TempDir,
    address: SocketAddr,
}

impl Stage {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().expect("a folder"), address: free_address() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A server that asks programs of this machine for a code, too.
    fn server(&self) -> Program {
        let mut command = Command::new(program("shadecast-server"));
        command.args(["stream", "dragon", "--listen", &self.address.to_string(), "--atlas", "512x512"]);
        command.args(["--seconds", "300", "--admit", "paired-only", "--no-shadows"]);
        command.arg("--identity").arg(self.path("server"));
        Program::start(&mut command, Voice::Output)
    }

    fn client(&self) -> Program {
        let config = MockConfig { extent_pixels: [64, 64], clock: ClockKind::Real, ..MockConfig::default() };
        let runtime = prepare_runtime(&config, &self.path("runtime")).expect("a runtime");
        let mut command = Command::new(program("shadecast-client"));
        command.args(["--connect", &self.address.to_string(), "--seconds", "240"]);
        command.arg("--identity").arg(self.path("client"));
        command.envs(runtime.iter().map(|(name, value)| (name, value)));
        Program::start(&mut command, Voice::Errors)
    }

    fn ask(&self, arguments: &[&str]) -> Output {
        let mut command = Command::new(program("shadecast-server"));
        output_of(command.args(arguments).arg("--identity").arg(self.path("server")))
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The code that a client shows next.
#[track_caller]
fn shown_code(client: &mut Program) -> Code {
    let line = client.line_with("shadecast-server pair ");
    let code = line.rsplit("pair ").next().and_then(|code| code.trim().parse().ok());
    code.unwrap_or_else(|| panic!("no six digits in \"{line}\""))
}

#[test]
fn a_client_is_paired_by_the_code_that_it_shows_and_forgotten_when_it_is_to_be() {
    let stage = Stage::new();
    let nobody = stage.ask(&["pair", "123456"]);
    assert!(!nobody.status.success());
    assert!(text(&nobody.stderr).contains("no server with the identity"), "{}", text(&nobody.stderr));
    let mut server = stage.server();
    server.says("Listening");
    let mut client = stage.client();
    server.says("asks to be paired");
    let code = shown_code(&mut client).to_string().replace(' ', "");
    let other = if code == "000000" { "000001" } else { "000000" };
    let wrong = stage.ask(&["pair", other]);
    assert!(!wrong.status.success(), "{}", text(&wrong.stderr));
    assert!(text(&wrong.stderr).contains("is not the one that the headset shows"), "{}", text(&wrong.stderr));
    client.says("is not the one that the headset shows");
    let again = shown_code(&mut client).to_string().replace(' ', "");
    let right = stage.ask(&["pair", &again]);
    assert!(right.status.success(), "{}", text(&right.stderr));
    assert!(text(&right.stderr).contains("Paired with \"device 1\""), "{}", text(&right.stderr));
    client.has_said("Connected to");
    let own = ClientIdentity::load_or_create(&stage.path("client")).expect("its key").fingerprint();
    let listed = text(&stage.ask(&["devices", "list"]).stdout);
    assert!(listed.contains("device 1") && listed.contains(&own.to_string()), "{listed}");
    let of_server = ServerIdentity::load_or_create(&stage.path("server")).expect("its key").fingerprint();
    assert!(KnownServers::load(&stage.path("client")).expect("a list").knows(of_server));
    assert!(stage.ask(&["devices", "rename", "device 1", "attic"]).status.success());
    assert!(stage.ask(&["devices", "forget", "attic"]).status.success());
    client.has_said("this device was forgotten at the server");
    shown_code(&mut client);
    client.signal("-INT");
    server.signal("-INT");
    server.ends_well();
}

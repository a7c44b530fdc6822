//! The client in a desktop window, on its own display (Xvfb), with a server as another process.

use crate::display::{Display, colours};
use crate::x11::{self, Connection};
use shadecast_lab::image::Rgb8Image;
use shadecast_lab::measure::metrics::psnr_db;
use shadecast_test_support::programs::{Program, Voice, free_address, output_of, program, wait_until};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

const SIZE: [u32; 2] = [192, 144];
const SCREEN: [u32; 2] = [320, 240];
/// A dragon that stands still.
const STILL: &str = "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\ntranslation = [0.0, 0.0, -4.0]\nclip = \"\"\n";

/// A server of a still scene, with a display beside it.
struct Stage {
    folder: tempfile::TempDir,
    display: Display,
    server: Program,
    address: String,
}

impl Stage {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("still.toml");
        std::fs::write(&scene, STILL).unwrap();
        let address = free_address().to_string();
        let mut command = Command::new(program("shadecast-server"));
        command.args(["stream", "--listen", &address, "--seconds", "300"]).arg(&scene);
        command.arg("--identity").arg(folder.path().join("server"));
        let mut server = Program::start(command.stderr(Stdio::null()), Voice::Output);
        server.says("Listening");
        Self { display: Display::start(SCREEN), folder, server, address }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn client(&self) -> Command {
        let mut command = client();
        command.args(["--connect", &self.address, "--size", &format!("{}x{}", SIZE[0], SIZE[1])]);
        command.args(["--validation", "--no-figures", "--identity"]).arg(self.path("client"));
        command.arg("--stats").arg(self.path("client.json")).env("DISPLAY", self.display.name());
        command
    }

    fn stats(&self) -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(self.path("client.json")).unwrap()).unwrap()
    }
}

fn client() -> Command {
    let mut command = Command::new(program("shadecast-client"));
    command.arg("--window");
    command.env_remove("WAYLAND_DISPLAY").env_remove("WAYLAND_SOCKET").env_remove("DISPLAY");
    command
}

/// What the forward renderer shows from where the window's one eye is.
fn truth(scene: &Path, folder: &Path) -> Rgb8Image {
    let mut forward = Command::new(program("shadecast-server"));
    forward.arg("forward").arg(scene).args(["--fov", "60", "--position=0,1.6,0", "--frames", "1"]);
    forward.args(["--size", &format!("{}x{}", SIZE[0], SIZE[1])]).arg("--out").arg(folder);
    let output = output_of(&mut forward);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Rgb8Image::read_png(&folder.join("forward-000000.png")).unwrap()
}

#[test]
fn a_window_shows_what_the_server_streams_as_the_truth_has_it() {
    let stage = Stage::new();
    let shot = stage.path("window.png");
    let window = Program::start(stage.client().arg("--screenshot").arg(&shot), Voice::Errors);
    wait_until("the window shows a picture", || colours(&stage.display.screen()) >= 500);
    std::thread::sleep(Duration::from_secs(3)); // the picture grows sharp within a few updates
    window.signal("-INT");
    window.ends_well();
    let shown = Rgb8Image::read_png(&shot).unwrap();
    let truth = truth(&stage.path("still.toml"), stage.folder.path());
    assert_eq!([shown.width, shown.height], SIZE);
    let db = psnr_db(&shown, &truth, &vec![true; shown.pixel_count()]);
    println!("{db:.1} dB");
    assert!(db > 28.0, "{db:.1} dB between the window and the truth");
    let stats = stage.stats();
    assert_eq!(stats["validation_messages"], 0, "{stats}");
    assert!(stats["bundles"].as_u64() > Some(1), "{stats}");
}

#[test]
fn a_halted_server_leaves_the_head_free_and_a_notice_in_view() {
    let stage = Stage::new();
    let window = Program::start(&mut stage.client(), Voice::Errors);
    wait_until("the window shows a picture", || colours(&stage.display.screen()) >= 500);
    stage.server.signal("-STOP");
    let mut user = Connection::open(stage.display.number()).unwrap();
    user.focus().unwrap();
    let differs = |a: &[u8], b: &[u8]| a.iter().zip(b).filter(|(a, b)| a.abs_diff(**b) > 8).count();
    // A picture more may be under way; then all stands still, but for the words that come after two seconds.
    std::thread::sleep(Duration::from_secs(1));
    let before = stage.display.screen();
    user.hold(x11::KEY_D).unwrap();
    wait_until("the picture follows the head", || differs(&stage.display.screen(), &before) > 4000);
    user.let_go(x11::KEY_D).unwrap();
    std::thread::sleep(Duration::from_millis(3500));
    let mut last = stage.display.screen();
    let mut changed_a_little = || {
        std::thread::sleep(Duration::from_millis(100));
        let before = std::mem::replace(&mut last, stage.display.screen());
        (1..2000).contains(&differs(&last, &before))
    };
    wait_until("the words count the seconds", &mut changed_a_little);
    wait_until("and go on", &mut changed_a_little);
    let one_eye = stage.display.screen();
    user.press(x11::KEY_B).unwrap();
    wait_until("both eyes are seen", || differs(&stage.display.screen(), &one_eye) > 4000);
    stage.server.signal("-CONT");
    user.press(x11::KEY_F).unwrap();
    user.press(x11::KEY_ESCAPE).unwrap();
    window.ends_well();
    assert_eq!(stage.stats()["validation_messages"], 0);
}

#[test]
fn the_window_demo_ends_with_its_window() {
    let (display, folder) = (Display::start(SCREEN), tempfile::tempdir().unwrap());
    let mut demo = Command::new(program("shadecast-lab"));
    demo.args([
        "demo",
        "dragon",
        "--window",
        "--seconds",
        "6",
        "--size",
        &format!("{}x{}", SIZE[0], SIZE[1]),
    ]);
    demo.arg("--validation").arg("--out").arg(folder.path()).env("DISPLAY", display.name());
    demo.env_remove("WAYLAND_DISPLAY").env_remove("WAYLAND_SOCKET");
    let output = output_of(&mut demo);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let shown = Rgb8Image::read_png(&folder.path().join("window.png")).unwrap();
    assert_eq!([shown.width, shown.height], SIZE);
    for name in ["client.json", "server.json"] {
        let text = std::fs::read_to_string(folder.path().join(name)).unwrap();
        assert!(text.contains("\"validation_messages\": 0"), "{name}: {text}");
    }
}

#[test]
fn without_a_display_the_error_says_what_to_do() {
    let output = output_of(&mut client());
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success());
    for part in ["no window can be opened here", "DISPLAY", "--window"] {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn flags_of_a_window_need_the_window() {
    let mut command = Command::new(program("shadecast-client"));
    let output = output_of(command.args(["--both-eyes", "--seconds", "1"]));
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && text.contains("--window"), "{text}");
}

//! The server's program as a person meets it: signals, messages, and what it leaves behind.

use shadecast_test_support::programs::{end_within, signal, wait_until};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::Duration;

/// What "at once" means on such a machine: far less than the work that is interrupted takes there.
const SOON: Duration = Duration::from_secs(10);

fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_shadecast-server"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

/// Whether the process has a handler for Ctrl-C: bit 1 of the mask of caught signals (proc(5)).
fn catches_signals(child: &Child) -> bool {
    let status = std::fs::read_to_string(format!("/proc/{}/status", child.id())).unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).is_some_and(|mask| mask & 2 != 0)
}

/// Interrupts the program when it is at work but far from done.
#[track_caller]
fn interrupted(command: &mut Command) -> (ExitStatus, String) {
    let mut child = command.spawn().expect("the program starts");
    wait_until("it catches signals", || catches_signals(&child));
    std::thread::sleep(Duration::from_millis(500));
    assert!(child.try_wait().expect("a child can be asked").is_none(), "it is still at work");
    signal(&child, "-INT");
    let status = end_within(&mut child, SOON);
    let Output { stdout, stderr, .. } = child.wait_with_output().expect("output");
    (status, [stdout, stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat())
}

#[test]
fn a_server_that_is_stopped_while_it_loads_ends_at_once_and_well() {
    let folder = tempfile::tempdir().expect("a folder");
    // Many different dragons' worth of work: each size is split, simplified and sampled for itself.
    let scene = large_scene(folder.path());
    let mut command = program();
    command.args([
        "stream",
        &scene,
        "--no-cache",
        "--listen",
        "127.0.0.1:0",
        "--seconds",
        "60",
        "--identity",
    ]);
    let (status, said) = interrupted(command.arg(folder.path()));
    assert!(status.success(), "{status}: {said}");
    assert!(!said.contains("Listening") && !said.contains("error"), "{said}");
}

#[test]
fn commands_that_are_interrupted_say_so_by_their_exit_code() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = large_scene(folder.path());
    let pictures = folder.path().join("pictures");
    let out = pictures.to_string_lossy();
    for arguments in [&["inspect", &*scene][..], &["forward", &scene, "--no-cache", "--out", &out]] {
        let mut command = program();
        command.args(arguments).env("XDG_CACHE_HOME", folder.path());
        let (status, said) = interrupted(&mut command);
        assert_eq!(status.code(), Some(130), "{arguments:?}: {said}");
        assert!(!said.contains("error"), "{arguments:?}: {said}");
    }
}

/// A scene with so many differently scaled dragons that it takes minutes to load without a cache.
fn large_scene(folder: &Path) -> String {
    let mut text = String::new();
    for number in 0..40 {
        let scale = 1.0 + 0.01 * f64::from(number);
        text += &format!("[[model]]\nname = \"m{number}\"\nfile = \"dragon\"\n");
        text += &format!("[[instance]]\nmodel = \"m{number}\"\nscale = {scale}\n");
    }
    let path = folder.join("large.toml");
    std::fs::write(&path, text).expect("written");
    path.to_string_lossy().into_owned()
}

/// What a program that refuses says, and how it ends.
fn refused(command: &mut Command) -> (ExitStatus, String) {
    let mut child = command.spawn().expect("the program starts");
    let status = end_within(&mut child, Duration::from_secs(60));
    let output = child.wait_with_output().expect("output");
    (status, String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn numbers_that_are_none_are_refused_with_the_name_of_their_option() {
    let wrong = [
        ("seconds", "nan"),
        ("seconds", "-1"),
        ("rate", "nan"),
        ("rate", "inf"),
        ("rate", "0"),
        ("qp", "52"),
    ];
    for (option, value) in wrong {
        let (status, said) = refused(program().args(["stream", "dragon"]).arg(format!("--{option}={value}")));
        assert_eq!(status.code(), Some(2), "{said}");
        assert!(said.contains(&format!("--{option}")) && said.contains(value), "{said}");
    }
}

#[test]
fn numbers_of_the_other_commands_are_looked_at_too() {
    let wrong = [
        ("forward dragon --out x", "frames", "0"),
        ("forward dragon --out x", "frames", "-1"),
        ("forward dragon --out x", "fps", "nan"),
        ("forward dragon --out x", "fps", "0"),
        ("forward dragon --out x", "fov", "inf"),
        ("forward dragon --out x", "fov", "180"),
        ("forward dragon --out x", "start", "nan"),
        ("forward dragon --out x", "yaw", "inf"),
        ("forward dragon --out x", "pitch", "nan"),
        ("forward dragon --out x", "position", "1,x,2,3"),
        ("forward dragon --out x", "position", "1,nan,2"),
        ("forward dragon --out x", "qp", "52"),
        ("forward dragon --out x", "size", "0x0"),
        ("forward dragon --out x", "msaa", "3"),
        ("forward dragon --window", "seconds", "nan"),
        ("inspect error dragon", "spacing-ms", "nan"),
        ("inspect error dragon", "spacing-ms", "0"),
    ];
    for (arguments, option, value) in wrong {
        let (status, said) = refused(program().args(arguments.split(' ')).arg(format!("--{option}={value}")));
        assert_eq!(status.code(), Some(2), "{arguments} --{option}={value}: {said}");
        assert!(said.contains(&format!("--{option}")) && said.contains(value), "{said}");
    }
}

#[test]
fn what_the_system_says_is_said_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = triangle(folder.path());
    let missing = folder.path().join("missing/there");
    let missing = missing.to_string_lossy();
    for arguments in [
        &["inspect", &format!("{missing}.glb")][..],
        &["inspect", &format!("{missing}.toml")],
        &["generate", "dragon", "--out", &missing],
        &["stream", &scene, "--link", &format!("{missing}.toml")],
        &["forward", &scene, "--no-cache", "--out", &format!("{missing}.mp4")],
        &["forward", &scene, "--no-cache", "--out", &format!("{missing}.y4m")],
    ] {
        let (status, said) = refused(program().args(arguments));
        assert_eq!(status.code(), Some(1), "{arguments:?}: {said}");
        assert_eq!(said.matches("No such file").count(), 1, "{arguments:?}: {said}");
        assert!(said.contains(&*missing), "{arguments:?}: {said}");
    }
}

/// An asset of one triangle.
fn triangle(folder: &Path) -> String {
    let text = r#"{ "asset": { "version": "2.0" }, "scenes": [{ "nodes": [0] }], "nodes": [{ "mesh": 0 }],
        "meshes": [{ "primitives": [{ "attributes": { "POSITION": 0 } }] }],
        "accessors": [{ "bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3" }],
        "bufferViews": [{ "buffer": 0, "byteLength": 36 }],
        "buffers": [{ "byteLength": 36, "uri": "data:application/octet-stream;base64,AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA" }] }"#;
    let path = folder.join("triangle.gltf");
    std::fs::write(&path, text).expect("written");
    path.to_string_lossy().into_owned()
}

/// Names in a folder, hidden ones too.
fn names(folder: &Path) -> Vec<String> {
    let items = std::fs::read_dir(folder).expect("a folder");
    items.map(|item| item.expect("an item").file_name().to_string_lossy().into_owned()).collect()
}

#[test]
fn a_video_that_is_interrupted_is_whole_or_not_there() {
    let folder = tempfile::tempdir().expect("a folder");
    let scene = triangle(folder.path());
    for (name, signals) in [("a.mp4", 1), ("a.y4m", 1), ("b.mp4", 2)] {
        let videos = folder.path().join(name.replace('.', "-"));
        std::fs::create_dir(&videos).expect("made");
        let out = videos.join(name);
        let mut command = program();
        command.args(["forward", &scene, "--no-cache", "--size", "64x64", "--msaa", "1"]);
        let mut child =
            command.args(["--frames", "9999999", "--out"]).arg(&out).spawn().expect("the program starts");
        wait_until("it writes", || !names(&videos).is_empty());
        assert!(!out.exists(), "{name}: it is not there before it is finished");
        (0..signals).for_each(|_| signal(&child, "-INT"));
        let status = end_within(&mut child, Duration::from_secs(60));
        assert_eq!(status.code(), Some(130), "{name}");
        assert!(names(&videos).iter().all(|left| left == name), "{name}: {:?}", names(&videos));
        if let Ok(bytes) = std::fs::read(&out) {
            let is_whole = match name.ends_with("mp4") {
                true => bytes.windows(4).any(|four| four == b"moov"),
                false => bytes.len() > 64 * 64,
            };
            assert!(is_whole, "{name}: {} bytes", bytes.len());
        }
    }
}

#[test]
fn without_a_driver_the_remedy_is_named() {
    let mut command = program();
    command.args(["stream", "dragon", "--no-cache", "--listen", "127.0.0.1:0", "--seconds", "60"]);
    // Both names of the variable: the older one is ignored by newer loaders where the newer one is set.
    command.env("VK_DRIVER_FILES", "/nowhere.json").env("VK_ICD_FILENAMES", "/nowhere.json");
    let (status, said) = refused(&mut command);
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains("no Vulkan device") && said.contains("mesa-vulkan-drivers"), "{said}");
}

//! The server's program as a person meets it: signals, messages, and what it leaves behind.

use std::path::Path;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

/// What "at once" means on such a machine: far less than the work that is interrupted takes there.
const SOON: Duration = Duration::from_secs(10);

fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_shadecast-server"));
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn signal(child: &Child) {
    let status = Command::new("kill").args(["-INT", &child.id().to_string()]).status();
    assert!(status.is_ok_and(|status| status.success()), "the process is there");
}

/// Waits for the end; kills and fails after `most`.
#[track_caller]
fn end_within(child: &mut Child, most: Duration) -> ExitStatus {
    let deadline = Instant::now() + most;
    while Instant::now() < deadline {
        if let Some(status) = child.try_wait().expect("a child can be asked") {
            return status;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    let _ = child.kill();
    let _ = child.wait();
    panic!("it did not end within {most:?}");
}

/// Interrupts the program a while after its start, when it is at work but far from done.
#[track_caller]
fn interrupted(command: &mut Command, after: Duration) -> (ExitStatus, String) {
    let mut child = command.spawn().expect("the program starts");
    std::thread::sleep(after);
    assert!(child.try_wait().expect("a child can be asked").is_none(), "it is still at work");
    signal(&child);
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
    let (status, said) = interrupted(command.arg(folder.path()), Duration::from_millis(1500));
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
        let (status, said) = interrupted(&mut command, Duration::from_millis(1500));
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
fn without_a_driver_the_remedy_is_named() {
    let mut command = program();
    command.args(["stream", "dragon", "--no-cache", "--listen", "127.0.0.1:0", "--seconds", "60"]);
    // Both names of the variable: the older one is ignored by newer loaders where the newer one is set.
    command.env("VK_DRIVER_FILES", "/nowhere.json").env("VK_ICD_FILENAMES", "/nowhere.json");
    let (status, said) = refused(&mut command);
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains("no Vulkan device") && said.contains("mesa-vulkan-drivers"), "{said}");
}

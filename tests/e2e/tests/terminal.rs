//! What a person at a terminal is told: wrong options are refused by name before anything is opened.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

fn program(name: &str) -> PathBuf {
    let here = std::env::current_exe().expect("this test is a file");
    let path = here.parent().and_then(Path::parent).expect("the folder of programs").join(name);
    assert!(path.exists(), "{} is not built; `./shadecast test` builds it first", path.display());
    path
}

/// The program ends by itself, unsuccessfully; what it says on standard error.
#[track_caller]
fn refused(name: &str, arguments: &[&str]) -> String {
    let output =
        Command::new(program(name)).args(arguments).stdin(Stdio::null()).output().expect("it starts");
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

//! The lab's program as a person meets it.

use std::process::{Command, Stdio};

#[test]
fn numbers_that_are_none_are_refused_with_the_name_of_their_option() {
    let wrong = [
        ("run", "seconds", "nan"),
        ("run", "seconds", "0"),
        ("run", "seconds", "inf"),
        ("run", "fov", "nan"),
        ("run", "fov", "180"),
        ("run", "compare-every", "0"),
        ("run", "qp", "52"),
        ("run", "size", "1x1"),
        ("run", "stage-ms", "server=nan"),
        ("demo", "seconds", "nan"),
        ("demo", "refresh", "nan"),
        ("demo", "refresh", "1000"),
    ];
    for (command, option, value) in wrong {
        let mut lab = Command::new(env!("CARGO_BIN_EXE_shadecast-lab"));
        lab.args([command, "dragon", "--out", "/nonexistent/out", &format!("--{option}={value}")]);
        let output = lab.stdin(Stdio::null()).output().expect("the program starts");
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{command} --{option}={value}: {said}");
        assert!(said.contains(&format!("--{option}")) && said.contains(value), "{said}");
    }
}

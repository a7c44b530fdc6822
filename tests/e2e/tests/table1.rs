//! The paper's table at a small size: its contents, and the resumption of an interrupted run.

use serde_json::Value;
use shadecast_lab::experiments::table1::{Table1Options, measure};
use std::cell::RefCell;
use std::path::Path;

fn read(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Numbers of a row that a reader counts on, by their keys.
const NUMBERS: [&str; 7] =
    ["dragons", "server_fps", "client_fps", "update_ms", "animation_geometry_ms", "client_cpu_ms", "patches"];

#[track_caller]
fn assert_row(row: &Value) {
    for key in NUMBERS {
        assert!(row[key].as_f64().is_some_and(|value| value > 0.0), "{key} of {row}");
    }
    for key in ["server_ms", "server_cpu_ms", "client_ms"] {
        assert!(row[key].as_object().is_some_and(|stages| !stages.is_empty()), "{key} of {row}");
    }
    assert_eq!(row["dragons_seen"], row["dragons"], "all are in the client's picture: {row}");
    assert_eq!(row["withheld_vertices"], 0, "{row}");
    let animates = row["server_ms"]["skin"].as_f64().is_some_and(|ms| ms > 0.0);
    assert!(animates || row["column"] == "off", "{row}");
    let is_predicted = row["prediction_bytes"].as_u64().is_some_and(|bytes| bytes > 48);
    assert_eq!(is_predicted, row["mode"] == "as-paper", "{row}");
}

#[test]
fn the_table_is_complete_and_an_interrupted_run_resumes() {
    let folder = tempfile::tempdir().expect("a folder");
    // This file has one test, and no thread has been started yet: the environment is its own.
    let usual = Table1Options {
        dragons: vec![1],
        rounds: 1,
        validation: true,
        ..Table1Options::new(folder.path().join("table"), 0.05)
    };
    let said = RefCell::new(Vec::new());
    let measured = |options: &Table1Options| {
        said.borrow_mut().clear();
        measure(options, &|line| said.borrow_mut().push(line.to_owned()))
    };
    let state = usual.out.join("table1.state.json");
    // Where the results belong there is a folder: all is measured, and nothing can be written.
    let in_the_way = usual.out.join("table1.csv");
    std::fs::create_dir_all(in_the_way.join("x")).expect("a folder");
    measured(&usual).expect_err("the results cannot be written");
    assert_eq!(said.borrow().len(), 8, "{said:?}");
    assert!(said.borrow()[0].contains("min left"), "{said:?}");
    assert!(state.exists(), "what was measured is kept");
    std::fs::remove_dir_all(&in_the_way).expect("removed");
    let other = Table1Options { scale: 0.06, ..usual.clone() };
    assert!(measured(&other).expect_err("other terms").to_string().contains("other terms"));

    let report = measured(&usual).expect("a table");
    assert_eq!(*said.borrow(), ["8 of 8 cells are measured already"]);
    assert!(!state.exists());
    let json: Value = serde_json::from_str(&read(&usual.out.join("table1.json"))).expect("JSON");
    assert!(json["device"].as_str().is_some_and(|device| !device.is_empty()) && json["scale"] == 0.05);
    let rows = json["rows"].as_array().expect("rows");
    assert_eq!((rows.len(), report.rows.len()), (8, 8));
    rows.iter().for_each(assert_row);
    assert_eq!(json["speedups"][0]["dragons"], 1);
    let csv = read(&in_the_way);
    assert_eq!(csv.lines().count(), 9);
    for plot in ["table1.svg", "table1-cost.svg"] {
        assert!(read(&usual.out.join(plot)).contains("<polyline"), "{plot}");
    }
}

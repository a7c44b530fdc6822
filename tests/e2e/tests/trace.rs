//! The trace of a run in virtual time: each update from its making to its display, in the order of time.

use serde_json::Value;
use shadecast_lab::experiments::run::run;
use shadecast_lab::session::options::RunOptions;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_test_support::headset::turn;
use std::collections::BTreeMap;

/// Begin and end of a span, microseconds.
type Span = [f64; 2];

/// Spans of each update by their names.
fn spans(trace: &str) -> BTreeMap<u64, BTreeMap<String, Span>> {
    let events: Vec<Value> = serde_json::from_str(trace).expect("a whole trace");
    let mut spans: BTreeMap<u64, BTreeMap<String, Span>> = BTreeMap::new();
    for event in events.iter().filter(|event| event["ph"] == "X") {
        let Some(update) = event["args"]["update"].as_u64() else { continue };
        let [begin, took] = ["ts", "dur"].map(|key| event[key].as_f64().expect("a time"));
        let name = event["name"].as_str().expect("a name").to_owned();
        // Of several frames of an update the first.
        spans.entry(update).or_default().entry(name).or_insert([begin, begin + took]);
    }
    spans
}

#[test]
fn each_update_is_traced_from_making_to_display() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let trace = out.path().join("trace.json");
    let options = RunOptions {
        extent_pixels: [64, 64],
        atlas_extent_texels: AtlasExtent::MIN,
        seconds: 1.0,
        trace: Some(trace.clone()),
        ..RunOptions::new(SceneSource::Dragons(1), out.path().join("run"))
    };
    let stages = options.stages;
    run(&options).unwrap();
    let spans = spans(&std::fs::read_to_string(&trace).unwrap());
    let shown = spans.values().filter(|of_update| of_update.contains_key("on display"));
    // Of the first the client cannot say in the server's time when they came.
    let shown: Vec<_> = shown.skip(3).collect();
    assert!(shown.len() >= 12, "{} updates were on display", shown.len());
    for of_update in shown {
        let at = |name: &str| *of_update.get(name).unwrap_or_else(|| panic!("no {name} in {of_update:?}"));
        let (update, encode) = (at("update"), at("encode"));
        let (delta, picture, display) = (at("delta has come"), at("picture has come"), at("on display"));
        let ms = |[begin, end]: Span| (end - begin) * 1e-3;
        assert!((ms(update) - stages.server).abs() < 1e-3 && (ms(encode) - stages.encode).abs() < 1e-3);
        assert!((update[1] - encode[0]).abs() < 1e-3, "the encoder begins when the update is shaded");
        // The link has 20 +- 5 ms, and the client's idea of the server's time is a little off.
        assert!((14e3..40e3).contains(&(picture[0] - encode[1])), "{of_update:?}");
        let decode = at("decode");
        // Its idea moves by 0.1 ms a frame at most, between one row's telling and another's.
        assert!((decode[0] - picture[0]).abs() < 300.0 && display[0] > decode[1], "{of_update:?}");
        assert!((ms(decode) - stages.decode).abs() < 1e-3, "{of_update:?}");
        assert!(delta[0] > update[1] + 14e3 && display[0] > delta[0].max(picture[0]), "{of_update:?}");
    }
}

/// Runs with these stages at 72 updates a second; gives start and end of the updates of the second half, milliseconds.
fn updates_ms(stages: &str) -> Vec<Span> {
    let out = tempfile::tempdir().unwrap();
    let trace = out.path().join("trace.json");
    let options = RunOptions {
        extent_pixels: [64, 64],
        atlas_extent_texels: AtlasExtent::MIN,
        seconds: 2.0,
        rate_hz: 72.0,
        stages: stages.parse().unwrap(),
        trace: Some(trace.clone()),
        ..RunOptions::new(SceneSource::Dragons(1), out.path().join("run"))
    };
    run(&options).unwrap();
    let spans = spans(&std::fs::read_to_string(&trace).unwrap());
    let updates: Vec<Span> =
        spans.values().filter_map(|of_update| of_update.get("update")).copied().collect();
    updates[updates.len() / 2..].iter().map(|span| span.map(|us| us * 1e-3)).collect()
}

#[test]
fn updates_that_do_not_fit_in_a_row_overlap() {
    let _turn = turn();
    let updates = updates_ms("visibility=10,placement=3,shading=10,encode=20");
    assert!(updates.len() > 20, "{updates:?}");
    for pair in updates.windows(2) {
        assert!((19.99..=22.0).contains(&(pair[1][0] - pair[0][0])), "{pair:?}");
    }
    for [begin, end] in &updates {
        assert!(end - begin <= 23.0 + 20.0, "one stage later than in a row at most: {updates:?}");
    }
}

#[test]
fn updates_that_fit_are_made_in_a_row() {
    let _turn = turn();
    let updates = updates_ms("visibility=5,placement=2,shading=5,encode=10");
    assert!(updates.len() > 20 && updates.iter().all(|[begin, end]| end - begin < 12.01), "{updates:?}");
    assert!(updates.windows(2).all(|pair| pair[1][0] >= pair[0][1]), "{updates:?}");
}

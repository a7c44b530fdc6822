use super::*;
use crate::measure::metrics::Holes;

fn frame(psnr_db: f64, strict: f64, has_bundle: bool) -> FrameMetrics {
    let picture = PictureMetrics { psnr_db, ssim: psnr_db / 100.0, flip: 0.1, flip_at_view: 0.2 };
    let holes = Holes { strict, beyond_outlines: strict / 2.0 };
    let region = |pixels| RegionMetrics {
        picture: Some(PictureMetrics { psnr_db: psnr_db - 5.0, ..picture }),
        holes: Holes { strict: strict / 4.0, beyond_outlines: 0.0 },
        pixels,
    };
    FrameMetrics {
        picture: Some(picture),
        holes,
        truth_coverage: 0.5,
        pixels: 1000,
        has_bundle,
        animated: region(100),
        shadowed: region(50),
    }
}

fn counted() -> Counted {
    let mbit_per_s = MbitPerS { atlas: 12.5, geometry: 3.25 };
    let bits_by_cause = Some(CauseBits { moving: 700, headers: 300, ..CauseBits::default() });
    let geometry_mbit_per_s = [("blocks", 2.0), ("corners", 1.25), ("head", 0.0)];
    Counted {
        device: "a device".into(),
        renderer: "stream".into(),
        mbit_per_s,
        bits_by_cause,
        geometry_mbit_per_s: geometry_mbit_per_s.map(|(part, mbit)| (part.to_owned(), mbit)).into(),
        ..Counted::default()
    }
}

#[test]
fn the_largest_parts_of_geometry_are_printed() {
    let text = Summary::default().finish(counted()).to_string();
    assert!(text.contains("3.25 Mbit/s (blocks 2.000, corners 1.250)\n"), "{text}");
    let bare = Counted { geometry_mbit_per_s: BTreeMap::new(), ..counted() };
    let text = Summary::default().finish(bare).to_string();
    assert!(text.contains("3.25 Mbit/s\n"), "{text}");
}

#[test]
fn figures_are_means_over_the_compared_views() {
    let mut summary = Summary::default();
    summary.add(frame(30.0, 0.0, true));
    summary.add(frame(40.0, 1.0, false));
    summary.add(FrameMetrics { picture: None, ..frame(0.0, 0.9, true) });
    let stats = summary.finish(counted());
    assert_eq!((stats.psnr_db, stats.ssim), (Some(35.0), Some(0.35)));
    assert_eq!((stats.hole_fraction, stats.hole_fraction_beyond_outlines), (Some(0.5), Some(0.25)));
    assert_eq!((stats.psnr_db_worst, stats.hole_fraction_worst), (Some(30.0), Some(1.0)));
    assert_eq!((stats.frames_compared, stats.frames_too_empty, stats.frames_without_bundle), (2, 1, 1));
}

#[test]
fn figures_of_a_region_are_means_over_the_views_that_have_it() {
    let mut summary = Summary::default();
    summary.add(frame(30.0, 0.0, true));
    summary.add(frame(40.0, 1.0, true));
    let few = RegionMetrics { picture: None, holes: Holes::default(), pixels: 10 };
    summary.add(FrameMetrics { animated: few, ..frame(50.0, 0.0, true) });
    let RegionStats { psnr_db, ssim, flip, hole_fraction, psnr_db_worst, share, views } =
        summary.finish(counted()).animated;
    assert_eq!((psnr_db, psnr_db_worst, views), (Some(30.0), Some(25.0), 2));
    assert_eq!((ssim, flip, hole_fraction), (Some(0.35), Some(0.1), Some(0.125)));
    assert_eq!(share, Some(210.0 / 3000.0), "of all compared pixels, those of the views without figures too");
    assert_eq!(Summary::default().finish(counted()).animated, RegionStats::default());
}

#[test]
fn clock_errors_count_by_their_size() {
    let of = |clock_errors_ms| {
        let stats = Summary::default().finish(Counted { clock_errors_ms, ..counted() });
        (stats.clock_error_ms, stats.clock_error_p99_ms)
    };
    assert_eq!(of(vec![]), (None, None));
    assert_eq!(of(vec![0.5, -2.0, 1.0]), (Some(2.0), Some(2.0)));
    assert_eq!(of((0..200).map(f64::from).collect()), (Some(199.0), Some(197.0)));
}

#[test]
fn a_run_without_comparisons_has_no_figures() {
    let stats = Summary::default().finish(counted());
    assert_eq!(
        (stats.psnr_db, stats.flip, stats.hole_fraction, stats.frames_compared),
        (None, None, None, 0)
    );
    assert!(stats.to_string().contains("not measured"));
}

#[test]
fn silence_without_validation_is_not_taken_for_a_check() {
    let of = |validation_messages| {
        let stats = Summary::default().finish(Counted { validation_messages, ..counted() });
        let text = stats.to_string();
        text.lines().find(|line| line.trim_start().starts_with("validation")).map(str::to_owned)
    };
    let ends =
        |line: Option<String>, end: &str| assert!(line.is_some_and(|line| line.ends_with(end)), "{end}");
    ends(of(None), " not checked");
    ends(of(Some(0)), " 0 messages");
    ends(of(Some(3)), " 3 messages");
}

#[test]
fn the_file_has_the_promised_keys() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("stats.json");
    let mut summary = Summary::default();
    summary.add(frame(30.0, 0.0, true));
    let stats = summary.finish(counted());
    stats.write_json(&path).expect("it can be written");
    let json = std::fs::read_to_string(&path).expect("it can be read");
    let value: serde_json::Value = serde_json::from_str(&json).expect("it is JSON");
    for key in [
        "device",
        "renderer",
        "server_fps",
        "client_fps",
        "mbit_per_s",
        "bits_by_cause",
        "geometry_mbit_per_s",
        "bytes_per_animated_vertex_sample",
        "psnr_db",
        "ssim",
        "flip",
        "hole_fraction",
        "frames_compared",
        "validation_messages",
        "animated",
        "shadowed",
        "dropped_patches",
        "clock_error_ms",
        "clock_error_bound_ms",
        "stage_ms",
    ] {
        assert!(value.get(key).is_some(), "{key} is missing in {json}");
    }
    for region in ["animated", "shadowed"] {
        for key in ["psnr_db", "ssim", "flip", "hole_fraction", "share"] {
            assert!(value[region].get(key).is_some(), "{region}.{key} is missing in {json}");
        }
    }
    assert_eq!(value["mbit_per_s"]["atlas"], 12.5);
    assert_eq!(value["mbit_per_s"]["geometry"], 3.25);
    assert_eq!(value["bits_by_cause"]["moving"], 700);
    assert!(stats.to_string().contains("moving 70.0 %, headers 30.0 %"), "{stats}");
    assert_eq!(serde_json::from_str::<Stats>(&json).expect("it is the same type"), stats);
}

#[test]
fn an_unwritable_file_is_named() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = folder.path().join("missing/stats.json");
    let error = Summary::default().finish(counted()).write_json(&path).expect_err("there is no such folder");
    assert!(error.to_string().contains("missing/stats.json"), "{error}");
}

#[test]
fn the_summary_is_aligned() {
    let mut summary = Summary::default();
    summary.add(frame(31.25, 0.002, true));
    let text = summary.finish(counted()).to_string();
    println!("{text}");
    let value_column = |line: &str| line.chars().nth(17) == Some(' ') && line.chars().nth(18) != Some(' ');
    assert!(text.lines().all(value_column), "{text}");
    assert!(
        text.contains("  PSNR            31.2 dB") && text.contains("  holes           0.200 %"),
        "{text}"
    );
}

//! The whole system in virtual time, at a size for a software device: quality against the ground truth, motion between updates,
//! and the same pictures twice. Validation is on.

use shadecast_client::client::Step;
use shadecast_client::present::stats::ClientStats;
use shadecast_lab::experiments::headset_off::{Absence, measure};
use shadecast_lab::experiments::motion_table::{
    Condition, KINDS, Kind, MotionTable, measure as measure_motion,
};
use shadecast_lab::experiments::run::{Report, mock_config, run};
use shadecast_lab::image::Rgb8Image;
use shadecast_lab::measure::metrics::psnr_db;
use shadecast_lab::report::stats::RegionStats;
use shadecast_lab::scenes::walls::write_walls;
use shadecast_lab::session::Lab;
use shadecast_lab::session::options::{Renderer, RunOptions, StageMs, ViewerOptions};
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_mock_runtime::record::read_frames;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::limits::DEFAULT_VERTEX_SLOTS;
use shadecast_scene::load::SceneSource;
use shadecast_server::scene::SceneOptions;
use shadecast_server::scene::motion_library::MotionOption;
use shadecast_server::world::WorldCounts;
use shadecast_test_support::headset::turn;
use std::path::Path;

fn small(scene: SceneSource, out: &Path) -> RunOptions {
    RunOptions {
        extent_pixels: [144, 144],
        atlas_extent_texels: AtlasExtent::new(1024, 1024).expect("an atlas"),
        seconds: 1.2,
        compare_every: 9,
        validation: true,
        motion: true,
        ..RunOptions::new(scene, out.to_owned())
    }
}

#[track_caller]
fn assert_good(report: &Report, what: &str) {
    let stats = &report.stats;
    println!("{what}:\n{stats}\n{:?}", report.motion);
    assert_eq!(stats.validation_messages, Some(0), "{what}");
    assert_eq!(report.runtime_errors, 0, "{what}: calls that the OpenXR runtime refused");
    assert!(stats.frames_compared >= 10, "{what}: {} views compared", stats.frames_compared);
    assert_eq!(stats.frames_without_bundle, 0, "{what}: after the first bundle there is always one");
    assert!(stats.psnr_db.is_some_and(|db| db >= 30.0), "{what}: PSNR {:?}", stats.psnr_db);
    assert!(stats.flip.is_some_and(|flip| flip <= 0.10), "{what}: FLIP {:?}", stats.flip);
    assert!(
        stats.hole_fraction.is_some_and(|holes| holes <= 0.005),
        "{what}: holes {:?}",
        stats.hole_fraction
    );
}

#[test]
fn a_dragon_over_a_link_looks_like_the_truth() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let report = run(&small(SceneSource::Dragons(1), out.path())).unwrap();
    assert_good(&report, "dragon, stream");
    let motion = report.motion.expect("vertices were followed");
    assert!(motion.vertices > 50, "{motion:?}");
    assert!(
        motion.moved_share.is_some_and(|share| share > 0.99),
        "vertices move at every display frame: {motion:?}"
    );
    assert!(motion.p99_error_percent_of_range.is_some_and(|percent| percent <= 0.3), "{motion:?}");
    let stats = &report.stats;
    // The truth is that of the true time. All but one in a hundred vertices are slower than 3 m/s, and a clock that is off moves
    // each by its speed; what is left is quantisation.
    let clock_p99_ms = stats.clock_error_p99_ms.expect("there is a clock to find out");
    assert!(motion.p99_error_mm <= 0.5 + 3.0 * clock_p99_ms && motion.p99_error_px <= 1.0, "{motion:?}");
    assert!(stats.animated.views >= 10 && stats.shadowed.views >= 10, "{stats:?}");
    assert!(stats.animated.share.is_some_and(|share| (0.01..0.5).contains(&share)), "{:?}", stats.animated);
    assert!(stats.shadowed.share.is_some_and(|share| (0.001..0.5).contains(&share)), "{:?}", stats.shadowed);
    assert!(stats.clock_error_ms.is_some_and(|worst_ms| worst_ms < 2.0), "{:?}", stats.clock_error_ms);
    let bound_ms = stats.clock_error_bound_ms;
    // Ways of 15 to 25 ms, and no exchange says which of the two was the longer.
    assert!(bound_ms.is_some_and(|bound_ms| (15.0..30.0).contains(&bound_ms)), "{bound_ms:?}");
    assert!(stats.clock_error_ms <= bound_ms, "{:?} {bound_ms:?}", stats.clock_error_ms);
    assert_eq!(report.stats.bytes_per_animated_vertex_sample, None, "a clip needs no samples");
    let (parts_mbit, mbit) = (stats.geometry_mbit_per_s.values().sum::<f64>(), stats.mbit_per_s.geometry);
    assert!((parts_mbit - mbit).abs() < 1e-9 && mbit > 0.0, "{:?}", stats.geometry_mbit_per_s);
    for name in
        ["stats.json", "sheet.png", "atlas.png", "client-left.png", "truth-right.png", "difference-left.png"]
    {
        assert!(out.path().join(name).metadata().is_ok_and(|m| m.len() > 0), "{name} is missing");
    }
}

#[test]
fn the_local_renderer_looks_like_the_truth() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let options = RunOptions { renderer: Renderer::Local, ..small(SceneSource::Dragons(1), out.path()) };
    let report = run(&options).unwrap();
    assert_good(&report, "dragon, local");
    let [width, height] = options.atlas_extent_texels.texels();
    let raw_mbit = f64::from(width * height) * 1.5 * 8e-6 * report.stats.server_fps;
    let mbit = report.stats.mbit_per_s.atlas;
    assert!((mbit - raw_mbit).abs() < 1e-6 * raw_mbit, "nothing is encoded: {mbit} and {raw_mbit} Mbit/s");
    assert!(report.stats.clock_error_ms.is_some_and(|worst_ms| worst_ms < 0.01), "nothing delays a clock");
}

#[test]
fn textures_are_filtered_for_display_pixels() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let scene = SceneSource::File(write_walls(out.path(), 1024).expect("a room"));
    let local = RunOptions { renderer: Renderer::Local, truth_places: 4, ..small(scene, out.path()) };
    let report = run(&local).unwrap();
    assert_good(&report, "painted walls, local");
    // It has 32.2 dB; with one sample of a pixel 5 dB less and a FLIP of 0.09 (`causes.rs`).
    assert!(report.stats.psnr_db.is_some_and(|db| db > 31.5), "{:?}", report.stats.psnr_db);
    assert!(report.stats.flip.is_some_and(|flip| flip < 0.055), "{:?}", report.stats.flip);
}

#[test]
fn the_forward_renderer_writes_the_truth_and_compares_nothing() {
    let _turn = turn();
    let [out, local_out] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let options = |renderer, out: &Path| RunOptions {
        renderer,
        extent_pixels: [128, 128],
        seconds: 0.6,
        dump_every: 20,
        motion: false,
        ..small(SceneSource::Dragons(1), out)
    };
    let report = run(&options(Renderer::Forward, out.path())).unwrap();
    let stats = &report.stats;
    assert_eq!(
        (stats.psnr_db, stats.flip, stats.hole_fraction, stats.frames_compared),
        (None, None, None, 0)
    );
    assert_eq!(
        (stats.animated.psnr_db, stats.shadowed.ssim, stats.validation_messages),
        (None, None, Some(0))
    );
    for name in ["truth-left.png", "truth-right.png", "truth-000000-left.png"] {
        assert!(out.path().join(name).metadata().is_ok_and(|m| m.len() > 0), "{name} is missing");
    }
    // The truth that another renderer was compared with, at the same frame, is the same picture.
    run(&options(Renderer::Local, local_out.path())).unwrap();
    for side in ["left", "right"] {
        let read =
            |folder: &Path| Rgb8Image::read_png(&folder.join(format!("truth-000040-{side}.png"))).unwrap();
        let (alone, beside) = (read(out.path()), read(local_out.path()));
        let psnr_db = psnr_db(&alone, &beside, &vec![true; alone.pixel_count()]);
        assert!(psnr_db > 50.0, "{side}: {psnr_db} dB");
    }
}

/// The truth is not made of what it judges: if it were, a coarse sampling would be coarse in both.
#[test]
fn coarse_sampling_costs_the_picture_of_what_is_animated() {
    let _turn = turn();
    let measure = |sampling: &str| {
        let out = tempfile::tempdir().unwrap();
        let options = RunOptions {
            renderer: Renderer::Local,
            seconds: 1.2,
            scene_options: SceneOptions { sampling: sampling.parse().unwrap(), ..SceneOptions::default() },
            ..small(SceneSource::Dragons(1), out.path())
        };
        let report = run(&options).unwrap();
        println!("{sampling}: {:?} {:?}", report.stats.animated, report.motion);
        (report.stats, report.motion.unwrap())
    };
    let (fine, fine_motion) = measure("error-bounded");
    let (coarse, coarse_motion) = measure("constant:500ms");
    let [fine, coarse] = [fine, coarse].map(|stats| stats.animated);
    let psnr_db = |region: RegionStats| region.psnr_db.unwrap();
    assert!(psnr_db(coarse) < psnr_db(fine) - 3.0, "{} against {} dB", psnr_db(coarse), psnr_db(fine));
    assert!(coarse.flip > fine.flip && coarse.ssim < fine.ssim && coarse.hole_fraction > fine.hole_fraction);
    assert!(coarse_motion.max_error_mm > 300.0 && fine_motion.max_error_mm < 5.0);
}

#[test]
fn two_runs_in_virtual_time_give_identical_pictures() {
    let _turn = turn();
    let run_once = || {
        let out = tempfile::tempdir().unwrap();
        let options = RunOptions {
            extent_pixels: [96, 96],
            seconds: 0.7,
            compare_every: 7,
            motion: false,
            ..small(SceneSource::Dragons(1), out.path())
        };
        run(&options).unwrap();
        let capture = out.path().join("capture");
        let frames = read_frames(&capture).unwrap();
        let pictures: Vec<Vec<u8>> = frames
            .iter()
            .filter(|frame| frame.captured)
            .flat_map(|frame| {
                use shadecast_mock_runtime::record::{Side, picture_path};
                [Side::Left, Side::Right]
                    .map(|side| std::fs::read(picture_path(&capture, frame.frame, side)).unwrap())
            })
            .collect();
        (frames, pictures)
    };
    let (first, second) = (run_once(), run_once());
    assert!(first.1.len() >= 8, "{} pictures", first.1.len());
    assert_eq!(first.0, second.0, "poses and times");
    assert!(first.1 == second.1, "pictures differ");
}

#[test]
fn real_models_look_like_the_truth() {
    let _turn = turn();
    for file in ["CesiumMan.glb", "Fox.glb"] {
        let Some(path) = shadecast_lab::scenes::assets::asset(file) else {
            eprintln!("SKIPPED: {file} is not there; the project ships no models of others");
            continue;
        };
        let out = tempfile::tempdir().unwrap();
        let options = RunOptions { motion: false, ..small(SceneSource::File(path), out.path()) };
        assert_good(&run(&options).unwrap(), file);
    }
}

/// Off for 10 seconds, by either way that runtimes have; the long form is `shadecast_lab::experiments::headset_off` with more seconds.
#[test]
fn a_headset_taken_off_costs_nothing_and_returns_within_a_second() {
    let _turn = turn();
    for absence in [Absence::Hidden, Absence::Resting] {
        let out = tempfile::tempdir().unwrap();
        let options = RunOptions { extent_pixels: [96, 96], ..small(SceneSource::Dragons(1), out.path()) };
        let report = measure(&options, absence, 10.0).unwrap();
        println!("{absence:?}: {report}");
        assert_eq!(report.updates_while_off, 0, "{absence:?}: nothing is shaded for nobody");
        assert!(report.most_waiting_bytes < 10_000_000, "{absence:?}: {report}");
        assert!(report.rss_after_mb - report.rss_before_mb < 20.0, "{absence:?}: {report}");
        assert!(report.picture_back_s <= 1.0, "{absence:?}: {report}");
    }
}

/// Corners of a triangle that are evaluated at different times lie apart by as much as a wing moves meanwhile.
#[test]
fn no_triangle_is_torn_at_two_updates_a_second() {
    let _turn = turn();
    let run = |motion: MotionOption, link: &str| {
        let out = tempfile::tempdir().unwrap();
        let options = RunOptions {
            rate_hz: 2.0,
            link: link.parse::<Condition>().unwrap().link,
            extent_pixels: [96, 96],
            seconds: 4.0,
            motion: false,
            scene_options: SceneOptions { motion, ..SceneOptions::default() },
            ..small(SceneSource::Dragons(1), out.path())
        };
        let report = shadecast_lab::experiments::tearing::measure(&options).unwrap();
        println!("{motion:?} over {link}: {report:?}");
        assert!(report.frames > 100 && report.triangles > 100_000, "{report:?}");
        report
    };
    const LINK: &str = "latency=20ms,jitter=5ms,rate=100mbit";
    let clips = run(MotionOption::Auto, LINK);
    assert!(clips.frames_behind == 0 && clips.max_error_m < 2e-4, "{clips:?}");
    // Motion waits for no update, so that samples are there in time, too.
    let samples = run(MotionOption::Samples, LINK);
    assert!(samples.frames_behind == 0 && samples.max_error_m < 1e-3, "{samples:?}");
    // Where nothing comes for longer than samples reach ahead, all vertices wait together.
    let cut_off = run(MotionOption::Samples, &format!("{LINK},outage=1.2s"));
    assert!(cut_off.frames_behind > 10, "samples came in time, so that nothing could tear: {cut_off:?}");
    assert!(cut_off.max_error_m < cut_off.last_step_error_m + 0.01, "{cut_off:?}");
}

fn other(link: &str) -> ViewerOptions {
    format!("link={link}").parse().unwrap()
}

/// The table of motion for one dragon, drawn small.
fn motion_table(kinds: &[Kind], link: &str, seconds: f64, out: &Path) -> MotionTable {
    let options = RunOptions {
        extent_pixels: [64, 64],
        atlas_extent_texels: AtlasExtent::new(512, 512).expect("an atlas"),
        seconds,
        motion: false,
        ..small(SceneSource::Dragons(1), out)
    };
    let table = measure_motion(&options, "dragon", kinds, &[link.parse().unwrap()]).unwrap();
    println!("{table}");
    table
}

#[test]
fn the_motion_table_has_a_row_for_each_kind() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let table = motion_table(KINDS, "latency=20ms,jitter=5ms,rate=100mbit", 1.0, out.path());
    assert_eq!(table.rows.len(), KINDS.len());
    let samples = table.rows.iter().find(|row| row.kind.name == "samples").expect("a kind");
    // Rounded to half a millimetre, and curves through it: no vertex of a good link is further off.
    assert!((0.2..0.8).contains(&samples.max_error_mm) && samples.p99_error_mm <= 0.5, "{samples:?}");
    assert!((samples.max_error_px - samples.max_error_mm * 0.325).abs() < 1e-9, "{samples:?}");
    assert_eq!((samples.frozen_vertex_frames, samples.torn_vertex_frames), (0, 0), "{samples:?}");
    assert!(samples.frames > 50 && samples.vertices > 1000, "{samples:?}");
    assert!(samples.vertex_frames > samples.vertices * 20, "{samples:?}");
    // A vertex has a sample for each of 30 steps a second.
    let bytes_per_sample = samples.motion_bytes as f64 / (samples.vertex_frames as f64 * 30.0 / 72.0);
    assert!((0.5..4.0).contains(&bytes_per_sample), "{bytes_per_sample}, {samples:?}");
    assert!(samples.client_gpu_ms > 0.0 && samples.server_cpu_ms > samples.server_animation_cpu_ms);
    assert!(samples.max_clock_step_ms <= 0.1 + 1e-9, "{samples:?}");
    assert!(samples.clock_error_bound_ms.is_some_and(|bound_ms| samples.clock_error_ms <= bound_ms));
    assert_eq!(samples.validation_messages, Some(0));
    let rings = table.rows.iter().map(|row| (row.kind.name, row.sample_ring)).collect::<Vec<_>>();
    assert_eq!(rings, [("auto", 8), ("clip", 8), ("palette", 32), ("samples", 32), ("paper", 8)]);
    let json = serde_json::to_value(&table).unwrap();
    for name in [
        "kind",
        "link",
        "max_error_mm",
        "p99_error_mm",
        "max_error_px",
        "motion_bytes",
        "frozen_vertex_frames",
        "torn_vertex_frames",
        "client_gpu_ms",
        "server_cpu_ms",
    ] {
        assert!(!json["rows"][0][name].is_null(), "{name} is missing in {json}");
    }
    assert_eq!((&json["rows"][0]["kind"], &json["scene"]), (&KINDS[0].name.into(), &"dragon".into()));
}

#[test]
fn triangles_tear_as_the_paper_says_in_its_own_way_alone() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let kinds = ["paper", "samples", "auto"].map(|kind| kind.parse().unwrap());
    let link = "latency=20ms,jitter=5ms,rate=100mbit,updates=2";
    let table = motion_table(&kinds, link, 3.0, out.path());
    let [paper, others @ ..] = &table.rows[..] else { panic!("no rows") };
    // Section 4, "Animation tearing artifacts": strong where predictions reach less far than to the next update, which then
    // puts vertices elsewhere.
    assert!(
        paper.torn_vertex_frames > 100 && paper.frozen_vertex_frames > paper.vertex_frames / 4,
        "{paper:?}"
    );
    for row in others {
        assert_eq!((row.torn_vertex_frames, row.frozen_vertex_frames), (0, 0), "{row:?}");
        assert_eq!(row.bytes.predictions, row.updates, "each says in a byte that there are none: {row:?}");
    }
    assert!(paper.stopped_vertex_frames > paper.vertex_frames / 4, "the client says so itself: {paper:?}");
    assert_eq!(paper.bytes.predictions, paper.motion_bytes, "and nothing between updates: {paper:?}");
    let bytes_per_vertex_and_update = paper.motion_bytes as f64 / (paper.updates * paper.vertices) as f64;
    assert!((20.0..=49.0).contains(&bytes_per_vertex_and_update), "{bytes_per_vertex_and_update}, {paper:?}");
    assert!(table.rows.iter().all(|row| row.validation_messages == Some(0)));
}

#[test]
fn after_three_silent_seconds_no_clock_jumps() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let (kinds, link) = (["samples".parse().unwrap()], "latency=20ms,jitter=5ms,rate=100mbit");
    let table = motion_table(&kinds, &format!("{link},outage=3s"), 5.2, out.path());
    let samples = &table.rows[0];
    let until_silence = &motion_table(&kinds, link, 1.9, out.path()).rows[0];
    // Before and after it about as much is sent.
    assert!(2 * samples.motion_bytes > 3 * until_silence.motion_bytes, "those of both: {samples:?}");
    assert_eq!(samples.connections, 1, "it outlives the silence: {samples:?}");
    assert!(samples.frozen_vertex_frames > samples.vertex_frames / 4, "samples end: {samples:?}");
    assert!(samples.worst.as_ref().is_some_and(|worst| worst.error_mm > 100.0), "{samples:?}");
    assert!(samples.max_clock_step_ms <= 0.1 + 1e-9, "{samples:?}");
    assert_eq!(samples.validation_messages, Some(0));
}

/// What the client keeps in a scene, once the session stands.
fn kept(scene: SceneSource, motion: MotionOption, out: &Path) -> ClientStats {
    let options = RunOptions {
        extent_pixels: [64, 64],
        seconds: 0.4,
        scene_options: SceneOptions { motion, ..SceneOptions::default() },
        ..small(scene, out)
    };
    let config = MockConfig { capture_dir: None, ..mock_config(&options, ClockKind::Virtual, 0).unwrap() };
    // SAFETY: it is the caller's turn.
    let mut lab = unsafe { Lab::open(&options, &config) }.unwrap();
    while let Step::Frame(_) = lab.step().unwrap() {}
    let stats = lab.client.presenter.stats();
    println!("{motion:?}: a ring of {}, {} bytes", stats.sample_ring, stats.motion_memory_bytes);
    assert!(stats.bundles > 0, "{stats:?}");
    stats
}

#[test]
fn clips_and_static_scenes_need_a_short_ring() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let still = out.path().join("still.toml");
    let text = "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\nclip = \"\"\n";
    std::fs::write(&still, text).unwrap();
    let still = kept(SceneSource::File(still), MotionOption::Samples, out.path());
    let clips = kept(SceneSource::Dragons(1), MotionOption::Auto, out.path());
    let samples = kept(SceneSource::Dragons(1), MotionOption::Samples, out.path());
    assert_eq!([still.sample_ring, clips.sample_ring, samples.sample_ring], [8, 8, 32]);
    // Nothing else differs: 24 steps of 16 bytes for each vertex.
    let saved_bytes = u64::from(DEFAULT_VERTEX_SLOTS) * 24 * 16;
    assert_eq!(still.motion_memory_bytes + saved_bytes, samples.motion_memory_bytes);
    assert!(clips.motion_memory_bytes < samples.motion_memory_bytes, "with its skeletons and clips");
}

/// A loss and its repair take 0.7 s there: samples reach that far ahead, within the 0.87 s of a ring of 32.
#[test]
fn samples_arrive_in_time_over_200_ms() {
    let _turn = turn();
    let out = tempfile::tempdir().unwrap();
    let table = motion_table(&["samples".parse().unwrap()], "latency=200ms,jitter=10ms", 3.0, out.path());
    let row = &table.rows[0];
    assert_eq!((row.frozen_vertex_frames, row.stopped_vertex_frames), (0, 0), "{row:?}");
    assert!(row.vertex_frames > 100_000 && row.sample_ring == 32, "{row:?}");
}

/// A device with time for the updates of several viewers in each period.
fn fast() -> StageMs {
    "server=3".parse().expect("durations")
}

/// What the world has made for a viewer and these others beside it, and the updates that each was sent.
fn counts(stages: StageMs, others: Vec<ViewerOptions>) -> (WorldCounts, Vec<u64>) {
    let out = tempfile::tempdir().unwrap();
    let options = RunOptions {
        extent_pixels: [96, 96],
        seconds: 1.0,
        link: other("latency=20ms").link,
        others,
        stages,
        ..small(SceneSource::Dragons(1), out.path())
    };
    let config = MockConfig { capture_dir: None, ..mock_config(&options, ClockKind::Virtual, 0).unwrap() };
    // SAFETY: it is the caller's turn.
    let mut lab = unsafe { Lab::open(&options, &config) }.unwrap();
    while let Step::Frame(_) = lab.step().unwrap() {}
    assert_eq!(lab.server.gpu.validation_messages(), 0);
    for (number, (_, ghost)) in lab.ghosts().enumerate() {
        let (shown, error_ms) = (ghost.shown(), ghost.clock_error_ms());
        assert!(
            shown.is_some() && error_ms < 1.0,
            "viewer {}: shows {shown:?}, clock {error_ms} ms off",
            number + 2
        );
    }
    let updates =
        std::iter::once(lab.seat()).chain(lab.ghosts().map(|(seat, _)| seat)).map(|seat| seat.sent.updates);
    (lab.server.world.counts(), updates.collect())
}

#[test]
fn shared_work_is_done_once_per_sample_time() {
    let _turn = turn();
    let (alone, updates) = counts(fast(), Vec::new());
    let (together, of_each) = counts(fast(), vec![other("latency=20ms"); 2]);
    println!("{alone:?}, {updates:?} updates; {together:?}, {of_each:?}");
    assert!(updates[0] > 20 && of_each.iter().all(|of_one| of_one.abs_diff(updates[0]) <= 2), "{of_each:?}");
    // The two others come at the same moment and need the same times, the first viewer others: twice the work, not three times.
    assert!(together.animation.poses <= 2 * alone.animation.poses + 3, "each pose once for a time");
    assert!(together.animation.vertices * 10 <= alone.animation.vertices * 21, "each vertex once for a time");
    assert!(together.shadow_maps <= 2 * alone.shadow_maps + 3 && together.tangents <= 2 * alone.tangents + 3);
    // On a longer way other times are needed, and those of both ways once.
    let (_, of_each) = counts(fast(), vec![other("latency=110ms")]);
    assert!(of_each.iter().all(|updates| *updates > 15), "{of_each:?}");
}

/// With updates of 15 ms a device makes 66 in a second; 90 are wanted.
#[test]
fn three_viewers_share_a_busy_device_alike() {
    let _turn = turn();
    let (_, of_each) = counts("server=15".parse().expect("durations"), vec![other("latency=20ms"); 2]);
    let (least, most) = (of_each.iter().min().unwrap(), of_each.iter().max().unwrap());
    assert!(most - least <= 2 && (15..=23).contains(most), "{of_each:?}");
}

#[test]
fn a_viewer_among_others_has_the_picture_that_it_has_alone() {
    let _turn = turn();
    let measured = |others: Vec<ViewerOptions>| {
        let out = tempfile::tempdir().unwrap();
        let link = other("latency=50ms,jitter=5ms,rate=100mbit").link;
        let options =
            RunOptions { link, others, stages: fast(), ..small(SceneSource::Dragons(1), out.path()) };
        run(&options).unwrap()
    };
    let one = measured(Vec::new());
    let among = measured(vec![
        other("latency=5ms"),
        other("latency=110ms,jitter=10ms"),
        other("latency=20ms,rate=1mbit"),
    ]);
    assert_good(&among, "among others");
    let db = |report: &Report| report.stats.psnr_db.unwrap();
    assert!((db(&one) - db(&among)).abs() <= 0.3, "{} dB alone, {} dB among others", db(&one), db(&among));
}

//! `shadecast-lab long`: the long measurements, as a list of named jobs that write a JSON file each. Existing files are kept,
//! so an interrupted run resumes.

mod against_video;

pub(super) use against_video::{names as names_against_video, usual_name as name_against_video};

use crate::experiments::abrupt;
use crate::experiments::causes::{self, CAUSES, Cause};
use crate::experiments::churn;
use crate::experiments::costs;
use crate::experiments::headset_off::{self, Absence};
use crate::experiments::links;
use crate::experiments::live;
use crate::experiments::motion_table::{self, Condition, Kind};
use crate::experiments::paper_size;
use crate::experiments::picture;
use crate::experiments::render_thread;
use crate::experiments::run::run;
use crate::experiments::scale::{self, Axis};
use crate::experiments::skinning;
use crate::experiments::slow;
use crate::experiments::slow_link;
use crate::experiments::table1::cell::Size;
use crate::experiments::table1::{self, Table1Options};
use crate::experiments::viewers::among_others;
use crate::experiments::worth;
use crate::results::sources::Checkout;
use crate::scenes::assets::asset;
use crate::scenes::hall::write_hall;
use crate::scenes::leaves::write_leaves;
use crate::scenes::robot::robot;
use crate::scenes::room::{MANY_VASES, write_room};
use crate::scenes::walls::{TEXELS, write_walls};
use crate::session::options::{Renderer, RunOptions, StageMs, ViewerOptions};
use crate::session::runtime::{prepare_runtime, set_runtime};
use anyhow::{Context, bail, ensure};
use serde_json::{Value, json};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_mock_runtime::config::MockConfig;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::animation::sampling::{DEFAULT_INTERVAL_S, Sampling};
use shadecast_scene::cache::Cache;
use shadecast_scene::load::{SceneSource, load_scene_with};
use shadecast_scene::process::Loading;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::truth::forward::Forward;
use shadecast_transport::LinkProfile;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::time::Instant;

/// Display frames between two that are compared: no multiple of twelve, as [`crate::session::options::COMPARE_EVERY`] says.
const COMPARE_EVERY: u32 = 23;
/// The same for the runs with longer stages.
const COMPARE_EVERY_SLOW: u32 = 35;
/// Seconds of each run that motion is measured in: an outage from the second to the fifth, and what follows.
const MOTION_SECONDS: f64 = 6.0;
/// Nine dragons, each cause of bytes by itself.
const NINE_SECONDS: f64 = 10.0;
const NINE_LINK: &str = "latency=20ms,jitter=5ms,rate=400mbit";
/// Seconds on the link that changes, a quarter at each rate, and on each of the others.
const STEPS_SECONDS: f64 = 60.0;
const LINK_SECONDS: f64 = 60.0;
/// Whether a link of this name is measured.
type IsWanted = fn(&str) -> bool;

/// Jobs of the other links: which of them each measures.
const LINKS: [(&str, IsWanted); 7] = [
    ("links-lan", |name| name.starts_with("LAN")),
    ("links-loss-5ms", |name| name.starts_with("5 ms")),
    ("links-loss-20ms", |name| name.starts_with("20 ms")),
    ("links-loss-50ms", |name| name.starts_with("50 ms")),
    ("links-loss-110ms", |name| name.starts_with("110 ms")),
    ("links-loss-200ms", |name| name.starts_with("200 ms")),
    ("links-events", |name| !name.starts_with("LAN") && !name.ends_with("lost") && name != "steps"),
];
/// Seconds that each attack lasts.
const HOSTILE_SECONDS: f64 = 20.0;
/// Seconds for which each neighbour is beside a lawful client, in each round.
const NEIGHBOUR_SECONDS: f64 = 4.0;
/// Seconds for which the headset is off.
const HEADSET_OFF_SECONDS: f64 = 600.0;
/// Rounds in which updates of one and of two viewers are measured.
const SECOND_VIEWER_ROUNDS: usize = 11;
/// Seconds of a link that is slower than its scene.
const SLOW_LINK_SECONDS: f64 = 25.0;
/// Seconds of each run that says what a part of the picture costs, and rounds of all of them.
const COST_SECONDS: f64 = 1.2;
const COST_ROUNDS: usize = 3;
/// Rounds of each run that says how cost grows.
const SCALE_ROUNDS: usize = 3;
/// Devices whose updates take 33, 100, 250, 700 and 1,000 ms.
const SLOW_STAGES: StageMs =
    StageMs { server: 100.0 / 3.0, encode: 8.0 / 3.0, decode: 4.0 / 3.0, steps: None };
const SLOWER: [f64; 5] = [1.0, 3.0, 7.5, 21.0, 30.0];
const SLOW_SECONDS: f64 = 10.0;
/// The window that is watched in real time, and for how long.
const LIVE_WINDOW_PIXELS: [u32; 2] = [1280, 800];
/// Of each eye, where it is a headset.
const LIVE_EYE_PIXELS: [u32; 2] = [512; 2];
const LIVE_SECONDS: u32 = 60;
/// Milliseconds one way of the link for the head that starts abruptly.
const ABRUPT_WAY_MS: f64 = 110.0;
/// Dragons of the paper's largest group.
const PAPER_GROUP: u32 = 169;

/// Makes a result in a folder for what it needs meanwhile.
type Work = dyn Fn(&Path) -> anyhow::Result<Option<Value>>;

/// Updates after which nothing may have grown.
const CHURN_UPDATES: u32 = 10_000;

/// A measurement: what it is called, and what makes its result. `None` where something that it needs is not there.
struct Job {
    name: String,
    work: Box<Work>,
}

impl Job {
    fn new(name: &str, work: impl Fn(&Path) -> anyhow::Result<Option<Value>> + 'static) -> Self {
        Self { name: name.to_owned(), work: Box::new(work) }
    }

    /// Makes `out/NAME.json`, unless it is there.
    fn run(&self, out: &Path) -> anyhow::Result<()> {
        let (name, result) = (&self.name, out.join(format!("{}.json", self.name)));
        if result.exists() {
            println!("done already: {}", result.display());
            return Ok(());
        }
        println!("running {name}");
        let started = Instant::now();
        let folder = std::env::temp_dir().join(format!("shadecast-long-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&folder).with_context(|| format!("making {}", folder.display()))?;
        let value = (self.work)(&folder).with_context(|| format!("running {name}"));
        let _ = std::fs::remove_dir_all(&folder);
        let Some(mut value) = value? else { return Ok(()) };
        if let Some(fields) = value.as_object_mut() {
            fields.insert("commit".into(), commit().into());
            if let Some(checkout) = Checkout::read(Path::new(".")) {
                fields.insert("sources".into(), checkout.sources(name).into());
            }
        }
        write_whole(&result, &(serde_json::to_string_pretty(&value)? + "\n"))?;
        println!("{name}: {:.0} s", started.elapsed().as_secs_f64());
        Ok(())
    }
}

/// The commit that is measured, with `-dirty` where files differ from it; `None` outside of a git checkout.
fn commit() -> Option<String> {
    let described =
        Command::new("git").args(["describe", "--always", "--dirty", "--exclude=*"]).output().ok()?;
    let text = String::from_utf8(described.stdout).ok()?;
    (described.status.success() && !text.trim().is_empty()).then(|| text.trim().to_owned())
}

/// All of them, in their order: what has bars that ordinary assets must reach comes first.
fn jobs() -> Vec<Job> {
    let paper = Sampling::Constant { interval_s: DEFAULT_INTERVAL_S };
    let mut jobs = Vec::new();
    for (suffix, stages, every) in
        [("", StageMs::default(), COMPARE_EVERY), ("-slow", StageMs::MEASURED, COMPARE_EVERY_SLOW)]
    {
        for scene in SCENES {
            let work = move |folder: &Path| scene_run(scene, folder, stages, every);
            jobs.push(Job::new(&format!("{}-512{suffix}", scene.name), work));
        }
    }
    for scene in CAUSED {
        jobs.push(Job::new(&format!("auto-{}", scene.name), move |folder| auto_run(scene, folder)));
    }
    for scene in PICTURED {
        let work = move |folder: &Path| {
            let Some((source, shown)) = scene.found(folder)? else { return Ok(None) };
            picture::measure(&source, &shown, folder).map(Some)
        };
        jobs.push(Job::new(&format!("picture-{}", scene.name), work));
    }
    jobs.extend(against_video::jobs());
    for scene in CAUSED {
        let work = move |folder: &Path| {
            let Some((source, shown)) = scene.found(folder)? else { return Ok(None) };
            causes_of(&causes::usual(source, folder.join("run")), &shown, &CAUSES)
        };
        jobs.push(Job::new(&format!("causes-{}", scene.name), work));
    }
    jobs.push(Job::new("causes-picture-dragons9", |folder| {
        causes_of(&picture::streamed(&SceneSource::Dragons(9), folder), "dragons:9", &PICTURE_CAUSES)
    }));
    for scene in MOVING {
        let work = move |folder: &Path| motion(scene, "auto", &Condition::all(), MOTION_SECONDS, folder);
        jobs.push(Job::new(&format!("motion-auto-{}", scene.name), work));
    }
    jobs.push(Job::new("motion-dragon-kinds", |folder| {
        motion(MOVING[0], "palette samples paper", &Condition::all(), MOTION_SECONDS, folder)
    }));
    jobs.push(Job::new("motion-dragons9-kinds", |folder| {
        // Wide enough for the paper's predictions, too.
        let link: Condition = NINE_LINK.parse().map_err(anyhow::Error::msg)?;
        motion(NINE_DRAGONS, "auto palette samples paper", &[link], NINE_SECONDS, folder)
    }));
    jobs.push(Job::new("inspect-error-dragon", |_| inspect_error_of_the_dragon().map(Some)));
    jobs.push(Job::new("second-start-dragons169", |folder| second_start(folder).map(Some)));
    for (name, sampling) in
        [("skinning-dragons9", Sampling::default()), ("skinning-dragons9-constant", paper)]
    {
        let work = move |_: &Path| {
            let report = skinning::measure(&SceneSource::Dragons(9), sampling)?;
            println!("{report}");
            Ok(Some(serde_json::to_value(report)?))
        };
        jobs.push(Job::new(name, work));
    }
    jobs.push(Job::new("abrupt-room", |folder| abrupt_room(folder).map(Some)));
    jobs.push(Job::new("costs-dragons3", |folder| {
        let options = RunOptions {
            extent_pixels: [192, 192],
            seconds: COST_SECONDS,
            surround: DEFAULT_SURROUND,
            ..RunOptions::new(SceneSource::Dragons(3), folder.join("run"))
        };
        let found = costs::measure(&options, COST_ROUNDS)?;
        println!("{found}");
        Ok(Some(serde_json::to_value(found)?))
    }));
    jobs.push(Job::new("scale", |folder| {
        let found = scale::measure(&Axis::ALL, SCALE_ROUNDS, folder)?;
        println!("{found}");
        Ok(Some(serde_json::to_value(found)?))
    }));
    jobs.push(Job::new("worth-dragons3", |folder| {
        let found = worth::measure(3, COST_ROUNDS, folder.join("run"))?;
        print!("{found}");
        Ok(Some(serde_json::to_value(found)?))
    }));
    jobs.push(Job::new("table1", |_| {
        // In a place of its own, so that a run that is broken off goes on.
        let out = Path::new("out/table1");
        let report = table1::measure(&Table1Options::new(out.into(), table1::usual_scale(None)?), &say)?;
        print!("{report}");
        Ok(Some(serde_json::to_value(report)?))
    }));
    jobs.push(Job::new("paper-size", |folder| {
        let found = paper_size::measure(PAPER_GROUP, Size::at(1.0)?, folder)?;
        println!("{found}");
        Ok(Some(serde_json::to_value(found)?))
    }));
    jobs.push(Job::new("render-thread", |folder| {
        let (dragons, seconds) = (render_thread::DRAGONS, render_thread::SECONDS);
        let found = render_thread::measure(dragons, Size::at(1.0)?, seconds, folder)?;
        print!("{found}");
        Ok(Some(serde_json::to_value(found)?))
    }));
    jobs.push(Job::new("slow-link", |folder| slow_links(folder).map(Some)));
    jobs.push(Job::new("slow-dragons3", |folder| {
        let options = RunOptions {
            extent_pixels: [512, 512],
            seconds: SLOW_SECONDS,
            stages: SLOW_STAGES,
            surround: DEFAULT_SURROUND,
            ..RunOptions::new(SceneSource::Dragons(3), folder.join("run"))
        };
        let found = slow::measure(&options, "dragons:3", &SLOWER)?;
        println!("{found}");
        Ok(Some(serde_json::to_value(found)?))
    }));
    jobs.push(Job::new("links-steps", |folder| {
        bad_links(folder, 3, (AtlasExtent::DEFAULT, STEPS_SECONDS), |name| name == "steps").map(Some)
    }));
    // A small atlas, which is encoded soon: the pictures' rate is what counts.
    for (name, is_wanted) in LINKS {
        let links = move |folder: &Path| bad_links(folder, 1, (AtlasExtent::MIN, LINK_SECONDS), is_wanted);
        jobs.push(Job::new(name, move |folder| links(folder).map(Some)));
    }
    jobs.push(Job::new("live-window-dragons3", live_window));
    jobs.push(Job::new("live-mock-dragons3", |folder| live_mock(folder).map(Some)));
    jobs.push(Job::new("viewers-4", |folder| four_viewers(folder).map(Some)));
    jobs.push(Job::new("second-viewer-dragons9", |folder| second_viewer(folder).map(Some)));
    jobs.push(Job::new("headset-off", |folder| headset_off(folder).map(Some)));
    jobs.push(Job::new("churn", |folder| {
        let options = RunOptions {
            extent_pixels: [64, 64],
            validation: true,
            surround: DEFAULT_SURROUND,
            ..RunOptions::new(SceneSource::Dragons(25), folder.join("run"))
        };
        let report = churn::measure(&options, CHURN_UPDATES)?;
        println!("{report}");
        Ok(Some(serde_json::to_value(report)?))
    }));
    jobs.push(Job::new("neighbours", |_| {
        let report = crate::hostile::neighbours::measure(NEIGHBOUR_SECONDS)?;
        println!("{report}");
        Ok(Some(serde_json::to_value(report)?))
    }));
    jobs.push(Job::new("hostile", |_| hostile_peers().map(Some)));
    jobs
}

fn say(line: &str) {
    println!("{line}");
}

/// Those of a picture of a headset's size: the others cost little in the small, and each takes minutes here.
const PICTURE_CAUSES: [Cause; 6] = [
    Cause::Quantisation,
    Cause::Outlines,
    Cause::Density,
    Cause::ShadowTime,
    Cause::LevelsOfDetail,
    Cause::Jitter,
];

fn causes_of(options: &RunOptions, shown: &str, causes: &[Cause]) -> anyhow::Result<Option<Value>> {
    let found = causes::measure(options, shown, causes)?;
    println!("{found}");
    Ok(Some(serde_json::to_value(found)?))
}

/// The abrupt head over a long way at two rates, and beside it the same delay without a link.
fn abrupt_room(folder: &Path) -> anyhow::Result<Value> {
    let scene = SceneSource::File(write_room(folder, MANY_VASES)?);
    let usual = RunOptions {
        extent_pixels: [256, 256],
        validation: true,
        surround: DEFAULT_SURROUND,
        ..RunOptions::new(scene, folder.join("run"))
    };
    let StageMs { server, encode, decode, .. } = usual.stages;
    let at_once = StageMs {
        server: 2.0 * ABRUPT_WAY_MS + server + encode + decode,
        encode: 0.0,
        decode: 0.0,
        steps: None,
    };
    let measured = |what: &str, options: &RunOptions| -> anyhow::Result<Value> {
        let report = abrupt::measure(options)?;
        println!("{what}: {report}");
        Ok(serde_json::to_value(report)?)
    };
    let stream = |rate: &str| -> anyhow::Result<Value> {
        let link: LinkProfile = format!("latency={ABRUPT_WAY_MS}ms,rate={rate}").parse()?;
        measured(rate, &RunOptions { link: link.into(), ..usual.clone() })
    };
    let local = RunOptions { renderer: Renderer::Local, stages: at_once, ..usual.clone() };
    Ok(json!({
        "one_way_ms": ABRUPT_WAY_MS,
        "stream_100_mbit": stream("100mbit")?,
        "stream_1_gbit": stream("1gbit")?,
        "local": measured("local", &local)?,
    }))
}

/// Four viewers of one dragon over ways of different length, each alone and beside the others.
fn four_viewers(folder: &Path) -> anyhow::Result<Value> {
    let link = |ms: &str| format!("link=latency={ms}ms,jitter=2ms,rate=100mbit").parse::<ViewerOptions>();
    let viewers: Result<Vec<ViewerOptions>, String> =
        ["5", "20", "50", "110"].map(link).into_iter().collect();
    let viewers = viewers.map_err(anyhow::Error::msg)?;
    let options = RunOptions {
        extent_pixels: [256, 256],
        seconds: 3.0,
        validation: true,
        ..RunOptions::new(SceneSource::Dragons(1), folder.join("run"))
    };
    let found = among_others(&options, &viewers)?;
    let differences = found.iter().map(|one| (one.among_psnr_db - one.alone_psnr_db).abs());
    let mut clocks: Vec<f64> = found.iter().map(|one| one.clock_error_ms).collect();
    clocks.sort_by(f64::total_cmp);
    Ok(json!({
        "worst_psnr_difference_db": differences.fold(0.0, f64::max),
        // No two are further apart than the two worst together.
        "clocks_apart_ms": clocks.iter().rev().take(2).sum::<f64>(),
        "viewers": found,
    }))
}

/// What a second viewer of nine dragons costs.
fn second_viewer(folder: &Path) -> anyhow::Result<Value> {
    let options = RunOptions {
        extent_pixels: [512, 512],
        ..RunOptions::new(SceneSource::Dragons(9), folder.join("run"))
    };
    let report = crate::experiments::viewers::second_viewer(&options, SECOND_VIEWER_ROUNDS)?;
    println!("{report:?}");
    Ok(serde_json::to_value(report)?)
}

/// So many dragons over the links that are wanted, with how many bars they miss.
fn bad_links(
    folder: &Path,
    dragons: u32,
    (atlas, seconds): (AtlasExtent, f64),
    is_wanted: IsWanted,
) -> anyhow::Result<Value> {
    let options = RunOptions {
        extent_pixels: [128, 128],
        seconds,
        compare_every: COMPARE_EVERY,
        atlas_extent_texels: atlas,
        ..RunOptions::new(SceneSource::Dragons(dragons), folder.join("run"))
    };
    let links = links::measure(&options, &format!("dragons:{dragons}"), is_wanted)?;
    let missed_bars = links.missed_bars();
    let mut value = serde_json::to_value(links)?;
    value["missed_bars"] = missed_bars.into();
    Ok(value)
}

/// Links that carry a small part of what their scene needs.
fn slow_links(folder: &Path) -> anyhow::Result<Value> {
    let measured = |scene: SceneSource, rate: &str| -> anyhow::Result<Value> {
        let link: LinkProfile = format!("latency=20ms,rate={rate}").parse()?;
        let options = RunOptions {
            seconds: SLOW_LINK_SECONDS,
            extent_pixels: [128, 128],
            link: link.into(),
            ..RunOptions::new(scene, folder.join("run"))
        };
        let report = slow_link::measure(&options)?;
        println!("{rate}: {report}");
        Ok(serde_json::to_value(report)?)
    };
    Ok(json!({
        "dragon_0_4_mbit": measured(SceneSource::Dragons(1), "0.4mbit")?,
        "dragons3_1_mbit": measured(SceneSource::Dragons(3), "1mbit")?,
    }))
}

/// A window in real time; `None` without a desktop to show it on.
fn live_window(folder: &Path) -> anyhow::Result<Option<Value>> {
    if cfg!(unix) && ["DISPLAY", "WAYLAND_DISPLAY"].iter().all(|name| std::env::var_os(name).is_none()) {
        println!("SKIPPED: a window needs a desktop: set DISPLAY");
        return Ok(None);
    }
    live_in(folder, Some(LIVE_WINDOW_PIXELS)).map(Some)
}

/// The same with the OpenXR client, on the mock runtime.
fn live_mock(folder: &Path) -> anyhow::Result<Value> {
    let config = MockConfig { extent_pixels: LIVE_EYE_PIXELS, ..MockConfig::default() };
    // SAFETY: jobs run one after the other, and this one has started no thread yet.
    unsafe { set_runtime(&prepare_runtime(&config, folder)?) };
    live_in(folder, None)
}

fn live_in(folder: &Path, window_pixels: Option<[u32; 2]>) -> anyhow::Result<Value> {
    let (scene, out) = (SceneSource::Dragons(3), folder.to_owned());
    let found = live::measure(&live::LiveOptions { scene, out, window_pixels, seconds: LIVE_SECONDS })?;
    println!("{found}");
    Ok(serde_json::to_value(found)?)
}

/// One dragon, and the headset taken off by either way that runtimes have.
fn headset_off(folder: &Path) -> anyhow::Result<Value> {
    let options = RunOptions {
        extent_pixels: [128, 128],
        ..RunOptions::new(SceneSource::Dragons(1), folder.join("run"))
    };
    let measured = |absence| -> anyhow::Result<Value> {
        let report = headset_off::measure(&options, absence, HEADSET_OFF_SECONDS)?;
        println!("{absence:?}: {report}");
        Ok(serde_json::to_value(report)?)
    };
    Ok(json!({ "hidden": measured(Absence::Hidden)?, "resting": measured(Absence::Resting)? }))
}

/// Every attack for as long as the acceptance asks, with what missed its bar.
fn hostile_peers() -> anyhow::Result<Value> {
    let report = crate::hostile::run_all(HOSTILE_SECONDS)?;
    let misses = report.misses();
    Ok(json!({ "missed_bars": misses.len(), "misses": misses, "report": report }))
}

/// Names of all jobs, which are those of their files.
pub fn names() -> Vec<String> {
    jobs().into_iter().map(|job| job.name).collect()
}

/// Runs all jobs that are not done yet and whose name begins with `only`.
///
/// # Errors
/// A run fails, or the folder cannot be written.
pub fn run_all(out: &Path, only: &str) -> anyhow::Result<()> {
    let wanted: Vec<Job> = jobs().into_iter().filter(|job| job.name.starts_with(only)).collect();
    ensure!(!wanted.is_empty(), "no long run is called \"{only}\"; there are {}", names().join(", "));
    std::fs::create_dir_all(out).with_context(|| format!("making {}", out.display()))?;
    wanted.iter().try_for_each(|job| job.run(out))
}

/// Beside its place, then moved there: a run that is broken off leaves no half result that counts as done.
fn write_whole(path: &Path, text: &str) -> anyhow::Result<()> {
    let writing = || format!("writing {}", path.display());
    shadecast_system::write_atomically(path, text.as_bytes()).with_context(writing)
}

// ---- scenes in virtual time ----

/// A scene that is run.
#[derive(Clone, Copy)]
struct LongScene {
    /// Of the result.
    name: &'static str,
    source: LongSource,
    clip: Option<&'static str>,
}

#[derive(Clone, Copy)]
enum LongSource {
    Dragons(u32),
    /// A file of the assets folder.
    Asset(&'static str),
    /// Written for the run.
    Robot,
    /// Many of it; written for the run.
    Hall,
    /// Written for the run.
    Walls,
    /// Cutouts that sway; written for the run.
    Leaves,
    /// The demo's.
    Courtyard,
}

/// Ordinary assets, the paper's, the stiff one, and two that stand still.
const SCENES: [LongScene; 10] = [
    LongScene { name: "dragons3", source: LongSource::Dragons(3), clip: None },
    LongScene { name: "cesium-man", source: LongSource::Asset("CesiumMan.glb"), clip: None },
    LongScene { name: "fox-survey", source: LongSource::Asset("Fox.glb"), clip: Some("Survey") },
    LongScene { name: "fox-walk", source: LongSource::Asset("Fox.glb"), clip: Some("Walk") },
    LongScene { name: "fox-run", source: LongSource::Asset("Fox.glb"), clip: Some("Run") },
    LongScene { name: "robot", source: LongSource::Robot, clip: None },
    LongScene { name: "morph", source: LongSource::Asset("MorphStressTest.gltf"), clip: None },
    LongScene {
        name: "kenney-fbx",
        source: LongSource::Asset("maya_kenney_character_7700_binary.fbx"),
        clip: None,
    },
    LongScene { name: "helmet", source: LongSource::Asset("DamagedHelmet.glb"), clip: None },
    LongScene { name: "walls", source: LongSource::Walls, clip: None },
];

/// The paper's smallest group.
const NINE_DRAGONS: LongScene = LongScene { name: "dragons9", source: LongSource::Dragons(9), clip: None };

/// What is looked at in pictures of a headset's size.
const PICTURED: [LongScene; 4] = [NINE_DRAGONS, SCENES[1], SCENES[8], SCENES[9]];
/// Whose causes of error are measured, at a smaller size.
const CAUSED: [LongScene; 4] = [SCENES[0], SCENES[1], SCENES[8], SCENES[9]];

/// What motion is measured with: one that we made, and ordinary ones of each sort.
const MOVING: [LongScene; 7] = [
    LongScene { name: "dragon", source: LongSource::Dragons(1), clip: None },
    LongScene { name: "fox-survey", source: LongSource::Asset("Fox.glb"), clip: Some("Survey") },
    LongScene { name: "fox-walk", source: LongSource::Asset("Fox.glb"), clip: Some("Walk") },
    LongScene { name: "fox-run", source: LongSource::Asset("Fox.glb"), clip: Some("Run") },
    LongScene { name: "cesium-man", source: LongSource::Asset("CesiumMan.glb"), clip: None },
    LongScene {
        name: "kenney-fbx",
        source: LongSource::Asset("maya_kenney_character_7700_binary.fbx"),
        clip: None,
    },
    LongScene { name: "morph", source: LongSource::Asset("MorphStressTest.gltf"), clip: None },
];

impl LongScene {
    /// As [`Self::source`]; says where its file is not there.
    fn found(&self, folder: &Path) -> anyhow::Result<Option<(SceneSource, String)>> {
        let found = self.source(folder)?;
        if found.is_none() {
            println!("left out: {}, its file is not there", self.name);
        }
        Ok(found)
    }

    /// The scene, and what a person writes for it.
    fn source(&self, folder: &Path) -> anyhow::Result<Option<(SceneSource, String)>> {
        Ok(match self.source {
            LongSource::Dragons(count) => Some((SceneSource::Dragons(count), format!("dragons:{count}"))),
            LongSource::Asset(file) => asset(file).map(|path| (SceneSource::File(path), file.to_owned())),
            LongSource::Robot => {
                let path = folder.join("robot.glb");
                std::fs::write(&path, robot()).with_context(|| format!("writing {}", path.display()))?;
                Some((SceneSource::File(path), "robot.glb".to_owned()))
            }
            LongSource::Walls => {
                let path = write_walls(folder, TEXELS)?;
                Some((SceneSource::File(path), "walls.toml".to_owned()))
            }
            LongSource::Hall => Some((SceneSource::File(write_hall(folder)?), "hall.toml".to_owned())),
            LongSource::Leaves => {
                Some((SceneSource::File(write_leaves(folder, true)?), "swaying.toml".to_owned()))
            }
            LongSource::Courtyard => Some((SceneSource::Courtyard, "courtyard".to_owned())),
        })
    }
}

/// What the acceptance runs use, measured in full: pictures, every vertex, validation.
fn scene_run(
    scene: LongScene,
    folder: &Path,
    stages: StageMs,
    compare_every: u32,
) -> anyhow::Result<Option<Value>> {
    let Some((source, shown)) = scene.found(folder)? else { return Ok(None) };
    let options = RunOptions {
        clip: scene.clip.map(str::to_owned),
        motion: true,
        validation: true,
        compare_every,
        stages,
        surround: DEFAULT_SURROUND,
        ..RunOptions::new(source, folder.join("run"))
    };
    let report = run(&options)?;
    println!("{}", report.stats);
    Ok(Some(json!({
        "command": options.command_line(&shown),
        "stage_ms": stages,
        "stats": report.stats,
        "motion": report.motion,
    })))
}

/// A walk past a scene with pictures of 20 Mbit/s, and of what the link carries.
fn auto_run(scene: LongScene, folder: &Path) -> anyhow::Result<Option<Value>> {
    let Some((source, shown)) = scene.found(folder)? else { return Ok(None) };
    let measured = |quality: QualityOptions| -> anyhow::Result<Value> {
        let options = RunOptions {
            compare_every: COMPARE_EVERY,
            surround: DEFAULT_SURROUND,
            quality,
            ..RunOptions::new(source.clone(), folder.join("run"))
        };
        let report = run(&options)?;
        println!("{}", report.stats);
        Ok(json!({ "command": options.command_line(&shown), "stats": report.stats }))
    };
    Ok(Some(json!({
        "capped": measured(QualityOptions::default())?,
        "auto": measured(QualityOptions::Auto)?,
    })))
}

/// The table of motion of these kinds, with spaces between them, over these links, each for so many seconds.
fn motion(
    scene: LongScene,
    kinds: &str,
    links: &[Condition],
    seconds: f64,
    folder: &Path,
) -> anyhow::Result<Option<Value>> {
    let Some((source, shown)) = scene.found(folder)? else { return Ok(None) };
    let options = RunOptions {
        clip: scene.clip.map(str::to_owned),
        seconds,
        extent_pixels: [64, 64],
        atlas_extent_texels: AtlasExtent::MIN,
        validation: true,
        ..RunOptions::new(source, folder.join("run"))
    };
    let kinds = kinds.split(' ').map(|kind| kind.parse().map_err(anyhow::Error::msg));
    let kinds = kinds.collect::<anyhow::Result<Vec<Kind>>>()?;
    let found = motion_table::measure(&options, &shown, &kinds, links)?;
    println!("{found}");
    Ok(Some(serde_json::to_value(found)?))
}

// ---- others ----

/// The error table, by the program that a user runs.
fn inspect_error_of_the_dragon() -> anyhow::Result<Value> {
    let mut command = Command::new(crate::process::program("shadecast-server")?);
    let output = command.args(["inspect", "error", "dragon", "--curve", "--json"]).output()?;
    if !output.status.success() {
        bail!("inspect error: {}", String::from_utf8_lossy(&output.stderr).trim());
    }
    serde_json::from_slice(&output.stdout).context("understanding what inspect error printed")
}

/// How long the paper's largest group takes to start, first with an empty cache and then with a full one: device, scene and
/// the pipelines of a picture.
fn second_start(folder: &Path) -> anyhow::Result<Value> {
    let start = || -> anyhow::Result<f64> {
        let started = Instant::now();
        let loading = Loading::complete(Cache::new(folder.join("cache")));
        let gpu_options = GpuOptions { needs: Needs::Server, validation: false, device_name: None };
        let gpu = Gpu::open(&gpu_options, &DesktopDevice)?;
        let source = SceneSource::Dragons(PAPER_GROUP);
        let scene = load_scene_with(&source, &loading)?;
        let scene = Arc::new(SceneGpu::cached(&gpu, scene, &SceneOptions::default(), &loading)?);
        Forward::new(&gpu, &scene, [512, 512])?;
        Ok(started.elapsed().as_secs_f64())
    };
    Ok(json!({ "scene": format!("dragons:{PAPER_GROUP}"), "first_s": start()?, "second_s": start()? }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::Cell;
    use std::rc::Rc;

    #[test]
    fn a_job_whose_file_is_there_is_not_run_again() {
        let out = tempfile::tempdir().expect("a folder");
        let runs = Rc::new(Cell::new(0));
        let counted = runs.clone();
        let job = Job::new("a-test", move |_| {
            counted.set(counted.get() + 1);
            Ok(Some(json!({ "runs": counted.get() })))
        });
        job.run(out.path()).expect("it runs");
        job.run(out.path()).expect("it is done");
        assert_eq!(runs.get(), 1);
        assert!(
            std::fs::read_to_string(out.path().join("a-test.json")).expect("written").contains("\"runs\": 1")
        );
    }

    #[test]
    fn a_job_that_fails_or_cannot_run_leaves_no_file() {
        let out = tempfile::tempdir().expect("a folder");
        assert!(Job::new("fails", |_| bail!("broken")).run(out.path()).is_err());
        Job::new("absent", |_| Ok(None)).run(out.path()).expect("left out");
        assert_eq!(std::fs::read_dir(out.path()).expect("a folder").count(), 0);
    }

    #[test]
    fn every_job_has_a_name_of_its_own() {
        let mut names = names();
        let count = names.len();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), count);
        assert!(run_all(Path::new("/nonexistent/x"), "no such").is_err());
    }
}

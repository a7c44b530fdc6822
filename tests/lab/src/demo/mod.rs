//! `shadecast-lab demo`: first server and client as a user runs them, two processes on loopback in real time, with the mock
//! runtime behind the system's OpenXR loader; then the same scene in virtual time, at a fast machine's rates.
//!
//! A scene enters, and a size. Pictures beside the truth's leave, with a sheet and a page that explain them. Nothing here knows
//! the bars of the figures.

pub mod window;

use crate::experiments::run::{compare, mock_config, progress, run, write_pictures};
use crate::image::Rgb8Image;
use crate::measure::compare::Comparer;
use crate::probe_file::{read_probe, read_probes};
use crate::process::{PATIENCE, Running, free_address, program};
use crate::report::page::Page;
use crate::report::sheet::Sheet;
use crate::report::stats::{Counted, MbitPerS, Stats, Summary};
use crate::session::options::RunOptions;
use crate::session::runtime::prepare_runtime;
use anyhow::{Context, ensure};
use serde_json::Value;
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_mock_runtime::config::ClockKind;
use shadecast_mock_runtime::record::read_frames;
use shadecast_protocol::time::WorldTime;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_server::scene::{SceneGpu, SceneOptions};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Display frames between two that are captured: captures wait for the GPU, so they are few.
const CAPTURE_EVERY: u32 = 8;
/// Display frames per second of virtual time: those of a common headset, since no machine is too slow for them.
const VIRTUAL_REFRESH_HZ: f64 = 72.0;
/// Moments of virtual time that the page offers.
const MOMENTS: f64 = 8.0;
/// Where the real-time half's files are, in the demo's folder.
const REAL_TIME: &str = "real-time";

/// What to show.
#[derive(Clone, Debug)]
pub struct DemoOptions {
    /// Scene.
    pub scene: SceneSource,
    /// Folder for what comes out.
    pub out: PathBuf,
    /// Pixels per eye.
    pub extent_pixels: [u32; 2],
    /// Seconds of display in real time.
    pub seconds: f64,
    /// Seconds of virtual time.
    pub virtual_seconds: f64,
    /// Display frames per second.
    pub refresh_hz: f64,
    /// Validation layers in both processes.
    pub validation: bool,
}

/// What both halves measured.
#[derive(Clone, Debug)]
pub struct DemoReport {
    /// Two processes, on this machine as fast as it is.
    pub real_time: Stats,
    /// The same scene on the virtual clock.
    pub virtual_time: Stats,
}

/// Runs the demo: writes `index.html`, `sheet.png`, `stats.json` and pictures into `options.out`, and those of the real-time
/// half into its folder `real-time`.
///
/// # Errors
/// A program is missing or fails, or nothing was shown.
pub fn demo(options: &DemoOptions) -> anyhow::Result<DemoReport> {
    let out = std::path::absolute(&options.out)?;
    clear(&out)?;
    let real_out = out.join(REAL_TIME);
    std::fs::create_dir_all(&real_out).with_context(|| format!("making {}", real_out.display()))?;
    println!("1 of 2: server and client as two processes over loopback, in real time");
    let real_time = in_real_time(options, &real_out)?;
    println!(
        "  the real path works: {:.1} updates/s, {:.1} display frames/s on this machine",
        real_time.server_fps, real_time.client_fps
    );
    println!("2 of 2: the same scene in virtual time, as a fast machine shows it");
    let run_options = virtual_options(options, &out);
    let virtual_time = run(&run_options)?.stats;
    write_sheet(options, &out, &virtual_time, &real_time)?;
    write_page(options, &out)?;
    Ok(DemoReport { real_time, virtual_time })
}

fn in_real_time(options: &DemoOptions, out: &Path) -> anyhow::Result<Stats> {
    let run = RunOptions {
        extent_pixels: options.extent_pixels,
        seconds: 0.0, // the session ends when the client is asked to
        refresh_hz: options.refresh_hz,
        ..RunOptions::new(options.scene.clone(), out.to_owned())
    };
    let config = mock_config(&run, ClockKind::Real, CAPTURE_EVERY)?;
    let runtime = prepare_runtime(&config, out)?;
    stream(options, out, &runtime)?;
    measure(options, &run, out)
}

fn virtual_options(options: &DemoOptions, out: &Path) -> RunOptions {
    let frames = options.virtual_seconds * VIRTUAL_REFRESH_HZ;
    RunOptions {
        extent_pixels: options.extent_pixels,
        seconds: options.virtual_seconds,
        refresh_hz: VIRTUAL_REFRESH_HZ,
        dump_every: (frames / MOMENTS).floor().max(1.0) as u32,
        motion: true,
        validation: options.validation,
        verbose: true,
        ..RunOptions::new(options.scene.clone(), out.to_owned())
    }
}

/// Takes away what an earlier demo left in `out`, and nothing else.
fn clear(out: &Path) -> anyhow::Result<()> {
    for folder in ["capture", "probe", REAL_TIME] {
        let path = out.join(folder);
        if path.exists() {
            std::fs::remove_dir_all(&path).with_context(|| format!("clearing {}", path.display()))?;
        }
    }
    let files = ["atlas.png", "index.html", "motion.json", "sheet.png", "stats.json"];
    let paths = files.iter().map(|file| out.join(file));
    for path in paths.chain(dumped(out).into_iter().flat_map(|moment| moment_files(out, moment))) {
        if path.exists() {
            std::fs::remove_file(&path).with_context(|| format!("clearing {}", path.display()))?;
        }
    }
    Ok(())
}

/// Numbers of the display frames whose pictures lie in `out`, in order.
fn dumped(out: &Path) -> Vec<u64> {
    let names = std::fs::read_dir(out).into_iter().flatten().flatten().map(|entry| entry.file_name());
    let number = |name: &str| name.strip_prefix("client-")?.strip_suffix("-left.png")?.parse().ok();
    let mut moments: Vec<u64> = names.filter_map(|name| number(name.to_str()?)).collect();
    moments.sort_unstable();
    moments
}

fn moment_files(out: &Path, moment: u64) -> impl Iterator<Item = PathBuf> {
    let names = ["client", "truth"].into_iter().flat_map(|kind| ["left", "right"].map(|side| (kind, side)));
    names.map(move |(kind, side)| out.join(format!("{kind}-{moment:06}-{side}.png")))
}

/// One sheet with both halves, each under its name.
fn write_sheet(
    options: &DemoOptions,
    out: &Path,
    virtual_time: &Stats,
    real_time: &Stats,
) -> anyhow::Result<()> {
    let cell = options.extent_pixels.map(|side| side.clamp(256, 384));
    let mut sheet = Sheet::new(&format!("Shadecast: {}", options.scene), 3, cell);
    let note = "Server, network and client on one simulated clock: what a machine with a fast GPU shows. Link of 20 \u{b1} 5 ms \
                and 100 Mbit/s, 30 updates and 72 display frames per second.";
    sheet.section("Virtual time", &format!("{note} {}.", virtual_time.in_words()));
    add_eyes(&mut sheet, out)?;
    let atlas = Rgb8Image::read_png(&out.join("atlas.png"))?;
    sheet.add("Shading atlas", &atlas, "All surfaces in reach, shaded once, sent as video.")?;
    let note = format!(
        "Two processes over loopback on this machine ({}): {:.1} updates and {:.1} display frames per second.",
        real_time.device, real_time.server_fps, real_time.client_fps
    );
    sheet.section("Real time", &format!("{note} {}.", real_time.in_words()));
    add_eyes(&mut sheet, &out.join(REAL_TIME))?;
    sheet.render()?.write_png(&out.join("sheet.png"))?;
    Ok(())
}

/// Client, truth and difference of both eyes, from the files of a run.
fn add_eyes(sheet: &mut Sheet, folder: &Path) -> anyhow::Result<()> {
    for (side, name) in [("left", "Left eye"), ("right", "Right eye")] {
        let [client, truth] =
            ["client", "truth"].map(|kind| Rgb8Image::read_png(&folder.join(format!("{kind}-{side}.png"))));
        crate::experiments::run::add_eye(sheet, name, &client?, &truth?)?;
    }
    Ok(())
}

fn write_page(options: &DemoOptions, out: &Path) -> anyhow::Result<()> {
    let page = Page {
        scene: options.scene.to_string(),
        moments: dumped(out),
        refresh_hz: VIRTUAL_REFRESH_HZ,
        virtual_time: read_json(&out.join("stats.json"))?,
        real_time: read_json(&out.join(REAL_TIME).join("stats.json"))?,
        motion: read_json(&out.join("motion.json")).unwrap_or(Value::Null),
    };
    let path = out.join("index.html");
    shadecast_system::write_atomically(&path, page.html().as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

/// Runs both processes to their end.
fn stream(options: &DemoOptions, out: &Path, runtime: &[(&'static str, PathBuf); 2]) -> anyhow::Result<()> {
    let address = free_address()?;
    let mut server = Command::new(program("shadecast-server")?);
    server.args(["stream", &options.scene.to_string(), "--listen", &address.to_string()]);
    server.arg("--identity").arg(out.join("server-identity")).arg("--stats").arg(out.join("server.json"));
    server.arg("--atlas-png").arg(out.join("atlas.png"));
    server.arg("--trace").arg(out.join("server-trace.json"));
    server.args(["--seconds", &(options.seconds + 300.0).to_string()]);
    let mut client = Command::new(program("shadecast-client")?);
    client.args(["--connect", &address.to_string(), "--quiet", "--probe-every", &CAPTURE_EVERY.to_string()]);
    client.arg("--probe-dir").arg(out.join("probe")).arg("--stats").arg(out.join("client.json"));
    client.arg("--identity").arg(out.join("client-identity"));
    client.arg("--trace").arg(out.join("client-trace.json"));
    client.envs(runtime.iter().map(|(name, value)| (name, value)));
    if options.validation {
        server.arg("--validation");
        client.arg("--validation");
    }
    let mut server = Running::start("shadecast-server", server.stdout(Stdio::piped()))?;
    server.says("Listening")?;
    let mut client = Running::start("shadecast-client", client.stdout(Stdio::null()))?;
    watch(options, &out.join("probe"), [&mut server, &mut client])?;
    client.interrupt()?;
    client.wait(Instant::now() + PATIENCE)?;
    server.interrupt()?;
    server.wait(Instant::now() + PATIENCE)?;
    let traces = ["server-trace.json", "client-trace.json"].map(|name| out.join(name));
    Ok(shadecast_trace::merge(&traces, &out.join("trace.json"))?)
}

/// Waits for the first picture of the scene, then for as long as was asked for.
fn watch(options: &DemoOptions, probes: &Path, mut processes: [&mut Running; 2]) -> anyhow::Result<()> {
    let bar = progress(true, (options.seconds * 10.0) as u64);
    let start = Instant::now();
    let mut first = None;
    loop {
        for process in &mut processes {
            ensure!(process.is_running()?, "{} ended early; its messages are above", process.name);
        }
        match first {
            None if shows_geometry(probes) => first = Some(Instant::now()),
            None => ensure!(start.elapsed() < PATIENCE, "the client showed no picture of the scene in time"),
            Some(first) => {
                let shown_s = first.elapsed().as_secs_f64();
                bar.set_position((shown_s * 10.0) as u64);
                if shown_s >= options.seconds {
                    break;
                }
            }
        }
        std::thread::sleep(Duration::from_millis(100));
    }
    bar.finish_and_clear();
    Ok(())
}

/// Whether any probe in the folder holds more than background.
fn shows_geometry(folder: &Path) -> bool {
    let files = std::fs::read_dir(folder).into_iter().flatten().flatten();
    files
        .map(|file| read_probe(&file.path()))
        .any(|probe| probe.is_ok_and(|probe| probe.view.coverage() > 0.0))
}

fn read_json(path: &Path) -> anyhow::Result<Value> {
    let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
    serde_json::from_str(&text).with_context(|| format!("understanding {}", path.display()))
}

/// Of a list of numbers; 0 of none.
fn mean(list: &Value) -> f64 {
    let numbers: Vec<f64> = list.as_array().into_iter().flatten().filter_map(Value::as_f64).collect();
    numbers.iter().sum::<f64>() / numbers.len().max(1) as f64
}

fn number(value: &Value, key: &str) -> f64 {
    value.get(key).and_then(Value::as_f64).unwrap_or(0.0)
}

/// Compares what was captured with the truth, and sums up.
fn measure(options: &DemoOptions, run: &RunOptions, out: &Path) -> anyhow::Result<Stats> {
    let (server, client) = (read_json(&out.join("server.json"))?, read_json(&out.join("client.json"))?);
    let epoch_ns = server.get("epoch_monotonic_ns").and_then(Value::as_i64).context("the server's epoch")?;
    let gpu = Gpu::open(
        &GpuOptions { needs: Needs::Server, validation: options.validation, device_name: None },
        &DesktopDevice,
    )?;
    let scene = Arc::new(SceneGpu::new(&gpu, load_scene(&options.scene)?, &SceneOptions::default())?);
    let mut comparer = Comparer::new(&gpu, &scene, options.extent_pixels)?;
    let capture = out.join("capture");
    let frames = read_frames(&capture).context("reading the runtime's frame log")?;
    let mut summary = Summary::default();
    let mut last = None;
    let mut has_begun = false;
    for record in frames.iter().filter(|record| record.captured) {
        let Some(probed) = read_probes(&out.join("probe"), record.predicted_display_time_ns)? else {
            continue;
        };
        let probes = probed.map(|probed| probed.view);
        has_begun |= probes.iter().any(|probe| probe.coverage() > 0.0);
        if !has_begun {
            continue; // the waiting room, before the first bundle
        }
        let time = WorldTime(record.predicted_display_time_ns - epoch_ns);
        let world_from_stage = scene.scene.world_from_stage;
        let pictures =
            compare(&mut comparer, &mut summary, record, &capture, world_from_stage, time, Some(&probes))?;
        last = Some(pictures);
    }
    let [shown, truth] = last.context("the client showed no picture of the scene; give it more --seconds")?;
    let seconds = number(&server, "seconds").max(1e-3);
    let viewer = server["viewers"][0].clone(); // as it was last
    let samples = number(&server, "samples");
    let [server_said, client_said] = [&server, &client].map(|side| side["validation_messages"].as_u64());
    let stats = summary.finish(Counted {
        device: gpu.device_name(),
        device_is_cpu: gpu.is_cpu(),
        renderer: "stream".into(),
        triangles: number(&viewer, "triangles"),
        mean_level: mean(&viewer["levels"]),
        texels_per_pixel: number(&viewer, "texels_per_pixel"),
        reused_share: number(&viewer, "reused_share"),
        stored_blocks: 0,
        server_fps: number(&server, "server_fps"),
        client_fps: number(&client, "client_fps"),
        mbit_per_s: MbitPerS {
            atlas: number(&server, "atlas_bytes") * 8e-6 / seconds,
            geometry: (number(&server, "geometry_bytes") + number(&server, "motion_bytes")) * 8e-6 / seconds,
        },
        mean_qp: server.get("mean_qp").and_then(Value::as_f64),
        bits_by_cause: serde_json::from_value(server["bits_by_cause"].clone())?,
        bytes_per_animated_vertex_sample: (samples > 0.0).then(|| number(&server, "sample_bytes") / samples),
        validation_messages: [server_said, client_said, gpu.checked_messages().map(u64::from)]
            .into_iter()
            .sum(),
        gpu_ms: server.get("gpu_ms").cloned().map(serde_json::from_value).transpose()?.unwrap_or_default(),
        dropped_patches: number(&server, "dropped_patches") as u64,
        clock_error_bound_ms: client.get("clock_error_bound_ms").and_then(Value::as_f64),
        ..Counted::default()
    });
    stats.write_json(&run.out.join("stats.json"))?;
    let atlas = Rgb8Image::read_png(&out.join("atlas.png")).ok();
    write_pictures(out, &shown, &truth, atlas.as_ref(), &stats)?;
    Ok(stats)
}

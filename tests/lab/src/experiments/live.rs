//! `shadecast-lab live`: the server and the client that ship, as two processes on this machine in real time. How soon the first picture
//! comes; updates, frames, sharpness and holes of each second after it.
//!
//! A scene enters, and a display. A table leaves. Two sessions are run: one without probes, for times and rates; one with probes, for holes.

use crate::measure::compare::Comparer;
use crate::probe_file::{probed_times_ns, read_probes};
use crate::process::{PATIENCE, Running, free_address, program};
use anyhow::{Context, ensure};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use shadecast_client::platform::monotonic_now;
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_server::scene::{SceneGpu, SceneOptions};
use std::fmt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Seconds that a session is given to begin, beside those that are measured.
const START_S: f64 = 60.0;
/// Display frames between two that are probed.
const PROBE_EVERY: u32 = 8;
/// Seconds after the first picture from which it is to be as sharp as it gets.
const SHARP_AFTER_S: usize = 20;
/// Probes of a second that are compared.
const LOOKS_PER_S: usize = 2;

/// What to measure.
#[derive(Clone, Debug)]
pub struct LiveOptions {
    /// Scene.
    pub scene: SceneSource,
    /// Folder for what the programs write.
    pub out: std::path::PathBuf,
    /// Pixels of a window; `None`: the OpenXR runtime that the environment names.
    pub window_pixels: Option<[u32; 2]>,
    /// Seconds after the first picture.
    pub seconds: u32,
}

/// How it went.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Live {
    /// What was shown.
    pub scene: String,
    /// The device of both programs.
    pub device: String,
    /// Pixels an eye.
    pub extent_pixels: [u32; 2],
    /// From the first update's begin, which is when a client has been welcomed, to its first picture on display, seconds.
    pub first_picture_s: f64,
    /// The same from the start of the client's process.
    pub after_client_start_s: f64,
    /// Of each second from the first picture on.
    pub rows: Vec<Second>,
    /// Fewest updates displayed in a second.
    pub least_updates: u32,
    /// Mean of updates displayed in a second.
    pub mean_updates: f64,
    /// Fewest frames in a second.
    pub least_frames: u32,
    /// Largest error of an LOD from 20 s after the first picture on, pixels.
    #[serde(default)]
    pub settled_lod_error_pixels: Option<f64>,
    /// Fewest texels for a pixel from then on.
    #[serde(default)]
    pub settled_texels_per_pixel: Option<f64>,
    /// Largest part of the geometry that was missing in a frame, 0..1.
    pub worst_holes: f64,
    /// The same of the first picture that was looked at.
    pub first_holes: f64,
    /// The mean over all that were looked at.
    pub mean_holes: f64,
    /// The mean of what is animated.
    pub mean_animated_holes: f64,
}

/// A second of the session.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Second {
    /// Updates that came on display.
    pub updates: u32,
    /// Display frames with a picture.
    pub frames: u32,
    /// Largest error of an LOD in the updates that were made, pixels.
    #[serde(default)]
    pub lod_error_pixels: Option<f64>,
    /// Fewest texels that blocks were asked to have for a pixel.
    #[serde(default)]
    pub texels_per_pixel: Option<f64>,
    /// Largest part of the geometry that was missing, 0..1; null where no frame of this second was looked at.
    pub holes: Option<f64>,
    /// The same of what is animated.
    pub animated_holes: Option<f64>,
}

impl fmt::Display for Live {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [width, height] = self.extent_pixels;
        writeln!(f, "{}, {width}x{height} pixels an eye, {}", self.scene, self.device)?;
        writeln!(
            f,
            "The first picture came {:.2} s after the first update began, {:.2} s after the client's start. {:.2} % of it was missing.",
            self.first_picture_s,
            self.after_client_start_s,
            100.0 * self.first_holes
        )?;
        let heads = ["second", "updates", "frames", "LOD error", "texels", "holes", "animated"];
        writeln!(f, "{}", heads.map(|head| format!("{head:>10}")).concat())?;
        let number = |value: Option<f64>, unit: &str| {
            value.map_or("-".to_owned(), |value| format!("{value:.2}{unit}"))
        };
        for (second, row) in self.rows.iter().enumerate() {
            let Second { updates, frames, .. } = row;
            let [holes, animated] = [row.holes, row.animated_holes].map(|part| part.map(|part| 100.0 * part));
            let cells = [
                second.to_string(),
                updates.to_string(),
                frames.to_string(),
                number(row.lod_error_pixels, " px"),
                number(row.texels_per_pixel, ""),
                number(holes, " %"),
                number(animated, " %"),
            ];
            writeln!(f, "{}", cells.map(|cell| format!("{cell:>10}")).concat())?;
        }
        if let (Some(error_pixels), Some(texels)) =
            (self.settled_lod_error_pixels, self.settled_texels_per_pixel)
        {
            writeln!(
                f,
                "From {SHARP_AFTER_S} s on LODs err by {error_pixels:.2} pixels at most. Blocks have {texels:.2} texels a pixel at least."
            )?;
        }
        writeln!(
            f,
            "Each second has {} updates (mean {:.1}) and {} frames at least. Holes are {:.2} % at most, mean {:.2} %. Animated ones are {:.2} % in the mean.",
            self.least_updates,
            self.mean_updates,
            self.least_frames,
            100.0 * self.worst_holes,
            100.0 * self.mean_holes,
            100.0 * self.mean_animated_holes
        )
    }
}

/// Runs both sessions.
///
/// # Errors
/// A program is missing or fails, or shows nothing of the scene.
pub fn measure(options: &LiveOptions) -> anyhow::Result<Live> {
    let out = std::path::absolute(&options.out)?;
    let rates = Session::run(options, &out.join("rates"), false)?;
    let looks = Session::run(options, &out.join("looks"), true)?;
    let (first_s, mut rows) = rates.seconds(options.seconds)?;
    let gpu = Gpu::open(
        &GpuOptions { needs: Needs::Server, validation: false, device_name: None },
        &DesktopDevice,
    )?;
    let looked = look(&gpu, options, &looks, &mut rows)?;
    let mean = |of: &dyn Fn(&Look) -> f64| looked.iter().map(of).sum::<f64>() / looked.len().max(1) as f64;
    let first = looked.first().context("no frame with a picture was probed; give it more --seconds")?;
    let settled = rows.get(SHARP_AFTER_S..).unwrap_or_default();
    Ok(Live {
        settled_lod_error_pixels: settled.iter().filter_map(|row| row.lod_error_pixels).reduce(f64::max),
        settled_texels_per_pixel: settled.iter().filter_map(|row| row.texels_per_pixel).reduce(f64::min),
        scene: options.scene.to_string(),
        device: gpu.device_name().to_owned(),
        extent_pixels: first.extent_pixels,
        first_picture_s: first_s - rates.first_begin_s()?,
        after_client_start_s: first_s - rates.client_started_s,
        least_updates: rows.iter().map(|row| row.updates).min().unwrap_or(0),
        mean_updates: rows.iter().map(|row| f64::from(row.updates)).sum::<f64>() / rows.len().max(1) as f64,
        least_frames: rows.iter().map(|row| row.frames).min().unwrap_or(0),
        worst_holes: looked.iter().map(|look| look.holes).fold(0.0, f64::max),
        first_holes: first.holes,
        mean_holes: mean(&|look| look.holes),
        mean_animated_holes: mean(&|look| look.animated_holes),
        rows,
    })
}

/// Both programs, from start to end, and what they wrote.
struct Session {
    probes: std::path::PathBuf,
    /// Events of both traces; times in server time.
    events: [Vec<Value>; 2],
    /// When the client's process was started, in server time.
    client_started_s: f64,
    epoch_ns: i64,
}

impl Session {
    fn run(options: &LiveOptions, out: &Path, with_probes: bool) -> anyhow::Result<Self> {
        let probes = out.join("probe");
        if probes.exists() {
            std::fs::remove_dir_all(&probes).with_context(|| format!("clearing {}", probes.display()))?;
        }
        std::fs::create_dir_all(&probes).with_context(|| format!("making {}", probes.display()))?;
        let address = free_address()?.to_string();
        let seconds = f64::from(options.seconds) + 1.0;
        let mut server = Command::new(program("shadecast-server")?);
        server.args(["stream", &options.scene.to_string(), "--listen", &address]);
        server.args(["--seconds", &(seconds + 2.0 * START_S + PATIENCE.as_secs_f64()).to_string()]);
        server.arg("--identity").arg(out.join("server-identity")).arg("--stats").arg(out.join("server.json"));
        server.arg("--trace").arg(out.join("server-trace.json"));
        let mut client = Command::new(program("shadecast-client")?);
        client.args(["--connect", &address, "--quiet"]);
        client.arg("--identity").arg(out.join("client-identity")).arg("--stats").arg(out.join("client.json"));
        client.arg("--trace").arg(out.join("client-trace.json"));
        if let Some([width, height]) = options.window_pixels {
            client.args(["--window", "--size", &format!("{width}x{height}")]);
            client.arg("--screenshot").arg(out.join("window.png"));
        }
        if with_probes {
            client.arg("--probe-dir").arg(&probes).args(["--probe-every", &PROBE_EVERY.to_string()]);
        }
        let mut server = Running::start("shadecast-server", server.stdout(Stdio::piped()))?;
        server.says("Listening")?;
        let client_started_ns = monotonic_now().0;
        let mut client = Running::start("shadecast-client", client.stdout(Stdio::piped()))?;
        server.says("First update sent")?;
        let end = Instant::now() + Duration::from_secs_f64(seconds + 2.0);
        while Instant::now() < end {
            ensure!(server.is_running()?, "{} ended early; its messages are above", server.name);
            ensure!(client.is_running()?, "{} ended early; its messages are above", client.name);
            std::thread::sleep(Duration::from_millis(100));
        }
        client.interrupt()?;
        client.wait(Instant::now() + PATIENCE)?;
        server.interrupt()?;
        server.wait(Instant::now() + PATIENCE)?;
        let server: Value = read_json(&out.join("server.json"))?;
        let epoch_ns = server["epoch_monotonic_ns"].as_i64().context("the server's epoch")?;
        let events = |name: &str| -> anyhow::Result<Vec<Value>> { read_json(&out.join(name)) };
        Ok(Self {
            probes,
            events: [events("server-trace.json")?, events("client-trace.json")?],
            client_started_s: (client_started_ns - epoch_ns) as f64 * 1e-9,
            epoch_ns,
        })
    }

    /// When the events of a name begin, in server time, seconds.
    fn times_s(&self, side: usize, name: &str) -> Vec<f64> {
        let named = self.events[side].iter().filter(|event| event["name"] == name);
        named.filter_map(|event| Some(event["ts"].as_f64()? * 1e-6)).collect()
    }

    fn first_begin_s(&self) -> anyhow::Result<f64> {
        self.times_s(0, "begin").into_iter().reduce(f64::min).context("no update was begun")
    }

    /// The first picture's time, and what came in each second after it.
    fn seconds(&self, seconds: u32) -> anyhow::Result<(f64, Vec<Second>)> {
        let shown_s = self.times_s(1, "on display");
        let first_s = shown_s.iter().copied().reduce(f64::min).context("no picture was displayed")?;
        let mut rows = vec![Second::default(); seconds as usize];
        let mut count = |times_s: &[f64], add: fn(&mut Second)| {
            let seconds =
                times_s.iter().filter(|at_s| **at_s >= first_s).map(|at_s| (at_s - first_s) as usize);
            for second in seconds {
                if let Some(row) = rows.get_mut(second) {
                    add(row);
                }
            }
        };
        count(&shown_s, |row| row.updates += 1);
        count(&self.times_s(1, "frame"), |row| row.frames += 1);
        for event in self.events[0].iter().filter(|event| event["name"] == "sharpness") {
            let at_s = event["ts"].as_f64().unwrap_or(0.0) * 1e-6 - first_s;
            let Some(row) = rows.get_mut(at_s as usize).filter(|_| at_s >= 0.0) else { continue };
            let of = |name: &str| event["args"][name].as_f64();
            row.lod_error_pixels = merged(row.lod_error_pixels, of("lod error pixels"), f64::max);
            row.texels_per_pixel = merged(row.texels_per_pixel, of("texels per pixel"), f64::min);
        }
        Ok((first_s, rows))
    }
}

/// A display frame beside the truth.
struct Look {
    extent_pixels: [u32; 2],
    holes: f64,
    animated_holes: f64,
}

/// Compares what was probed from the first picture on, and notes the worst of each second.
fn look(
    gpu: &Arc<Gpu>,
    options: &LiveOptions,
    session: &Session,
    rows: &mut [Second],
) -> anyhow::Result<Vec<Look>> {
    let scene = Arc::new(SceneGpu::new(gpu, load_scene(&options.scene)?, &SceneOptions::default())?);
    let (first_s, _) = session.seconds(options.seconds)?;
    let mut comparer = None;
    let (mut looks, mut looked) = (Vec::new(), vec![0; rows.len()]);
    for time_ns in probed_times_ns(&session.probes)? {
        let Some([left, _]) = read_probes(&session.probes, time_ns)? else { continue };
        let Some((world_from_eye, fov)) = left.eye else { continue };
        let time = WorldTime(time_ns - session.epoch_ns);
        let second = (time.0 as f64 * 1e-9 - first_s).max(0.0) as usize;
        let Some(row) = rows.get_mut(second).filter(|_| looked[second] < LOOKS_PER_S) else { continue };
        looked[second] += 1;
        let extent_pixels = [left.view.width, left.view.height];
        let comparer = match &mut comparer {
            Some(comparer) => comparer,
            none => none.insert(Comparer::new(gpu, &scene, extent_pixels)?),
        };
        let [all, animated] = comparer.missing(world_from_eye, fov, time, &left.view)?;
        row.holes = merged(row.holes, Some(all.strict), f64::max);
        row.animated_holes = merged(row.animated_holes, Some(animated.strict), f64::max);
        looks.push(Look { extent_pixels, holes: all.strict, animated_holes: animated.strict });
    }
    Ok(looks)
}

fn merged(known: Option<f64>, new: Option<f64>, pick: fn(f64, f64) -> f64) -> Option<f64> {
    [known, new].into_iter().flatten().reduce(pick)
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
    serde_json::from_str(&text).with_context(|| format!("understanding {}", path.display()))
}

//! `shadecast-lab render-thread`: the render thread's cost of a display frame while updates arrive.
//!
//! The paper's dragons are streamed to the client in virtual time, and its input is recorded. Then a new client gets the same
//! input, in the same order between the same display frames: once by an intake thread, as in `shadecast-client`, and once on
//! the render thread. The measure is the render thread's CPU time, from the runtime's request of a frame to its end; a
//! decoder's thread decodes as shipped. Real time runs slower than the recording's, so a slow device finishes a frame before
//! the next, and the decoder a picture. There are as many display frames per update as at full speed.

use super::run::mock_config;
use super::table1::cell::{FOV_DEGREES, Size, boxes, eye_for, head_csv, source};
use crate::measure::percentiles::Percentiles;
use crate::session::Lab;
use crate::session::heard::{Recording, What};
use crate::session::options::{Head, Renderer, RunOptions};
use crate::session::runtime::{prepare_runtime, set_runtime};
use anyhow::{Context, bail, ensure};
use serde::{Deserialize, Serialize};
use shadecast_client::client::{Client, ClientOptions, FrameReport, Notice, Step, halves};
use shadecast_client::display::Display;
use shadecast_client::display::xr::{Xr, XrOptions};
use shadecast_client::net::traced::Traced;
use shadecast_client::options::USUAL_MSAA;
use shadecast_client::platform::Platform;
use shadecast_client::present::presenter::Presenter;
use shadecast_client::stream::intake::Intake;
use shadecast_client::stream::taking::{Source, Taking};
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_scene::load::load_scene;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::pacing::room::Room;
use shadecast_system::clock::thread_cpu_ns;
use shadecast_trace::Trace;
use std::fmt;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

/// The paper's most.
pub const DRAGONS: u32 = 169;
/// Of virtual time: until all has arrived, and two seconds more.
pub const SECONDS: f64 = 3.0;
/// Updates and display frames a second of virtual time.
const UPDATES_HZ: f64 = 30.0;
const REFRESH_HZ: f64 = 72.0;
/// Vertices that the client offers to keep.
const ROOM_VERTICES: u32 = 150_000;
/// Pixels of an eye's side where frames are timed: what a pixel takes is the device's.
const SIDE_PIXELS: u32 = 128;
/// Display frames of the session's start, in which one thread waits for the other, so that all is as it was recorded.
const FRAMES_IN_STEP: usize = 48;
/// Display frames after the first bundle that are not timed.
const FRAMES_BEFORE: u64 = 24;
/// From a display frame to the next at least.
const PACE: Duration = Duration::from_millis(60);
/// A thread that has not taken what it was handed by now is broken.
const PATIENCE: Duration = Duration::from_secs(60);

/// Milliseconds of a processor for a display frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Half of the frames took no more.
    pub median_ms: f64,
    /// 99 % took no more.
    pub p99_ms: f64,
    /// The worst.
    pub worst_ms: f64,
    /// Half of those took no more in which a new bundle came on display.
    pub switch_median_ms: f64,
}

/// What was measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RenderThread {
    /// The Vulkan device.
    pub device: String,
    /// Dragons in view.
    pub dragons: u32,
    /// Updates a second, and display frames.
    pub rates_hz: [f64; 2],
    /// Texels of the atlas.
    pub atlas_extent_texels: [u32; 2],
    /// Vertices that the draw list on display used at the end.
    pub vertices: usize,
    /// Display frames that were timed, and bundles that came on display in them.
    pub frames: u64,
    /// See [`Self::frames`].
    pub bundles: u64,
    /// Display frames for which the device was behind, so that the last picture was shown again: they are not timed.
    #[serde(default)]
    pub repeated: u64,
    /// With the intake on a thread of its own, as it ships.
    pub split: Cost,
    /// With the intake on the thread that draws.
    pub together: Cost,
}

impl fmt::Display for RenderThread {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { device, dragons, vertices, frames, bundles, repeated, .. } = self;
        writeln!(
            f,
            "{dragons} dragons, {vertices} vertices, {frames} display frames ({repeated} repeated), {bundles} bundles; {device}"
        )?;
        writeln!(f, "ms of a processor     median     p99   worst   with a new bundle")?;
        for (name, cost) in [("own thread", self.split), ("one thread", self.together)] {
            let Cost { median_ms, p99_ms, worst_ms, switch_median_ms } = cost;
            writeln!(
                f,
                "  {name:<18} {median_ms:>7.3} {p99_ms:>7.3} {worst_ms:>7.3} {switch_median_ms:>7.3}"
            )?;
        }
        Ok(())
    }
}

/// Measures for `seconds` of virtual time; files go to `folder`, the trace of the split client too. To be called where
/// [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn measure(dragons: u32, size: Size, seconds: f64, folder: &Path) -> anyhow::Result<RenderThread> {
    let scene = load_scene(&source(dragons))?;
    std::fs::create_dir_all(folder)?;
    let head = folder.join("head.csv");
    std::fs::write(&head, head_csv(&scene, eye_for(&boxes(&scene))))?;
    let usual = RunOptions::new(source(dragons), folder.join("run"));
    let options = RunOptions {
        renderer: Renderer::Stream,
        head: Head::File(head),
        extent_pixels: size.extent_pixels,
        fov_degrees: FOV_DEGREES,
        atlas_extent_texels: size.atlas_extent_texels,
        room: Room { vertices: ROOM_VERTICES, ..usual.room },
        rate_hz: UPDATES_HZ,
        refresh_hz: REFRESH_HZ,
        seconds,
        surround: DEFAULT_SURROUND,
        ..usual
    };
    let config = mock_config(&options, ClockKind::Virtual, 0)?;
    let recording = record(&options, &config)?;
    let shown = MockConfig { extent_pixels: [SIDE_PIXELS; 2], ..config };
    let [split, together] = [true, false].map(|is_split| Replay::run(&options, &shown, &recording, is_split));
    let (split, together) = (split?, together?);
    Ok(RenderThread {
        device: split.device,
        dragons,
        rates_hz: [UPDATES_HZ, REFRESH_HZ],
        atlas_extent_texels: size.atlas_extent_texels.texels(),
        vertices: split.vertices,
        frames: split.frames,
        bundles: split.bundles,
        repeated: split.repeated,
        split: split.cost,
        together: together.cost,
    })
}

/// All that the client is handed in a run.
fn record(options: &RunOptions, config: &MockConfig) -> anyhow::Result<Arc<Recording>> {
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, config) }?;
    lab.recording = Some(Vec::new());
    while let Step::Frame(_) = lab.step()? {}
    Ok(Arc::new(lab.recording.take().unwrap_or_default()))
}

/// What a client was timed with.
struct Replay {
    device: String,
    vertices: usize,
    frames: u64,
    bundles: u64,
    repeated: u64,
    cost: Cost,
}

impl Replay {
    fn run(
        options: &RunOptions,
        config: &MockConfig,
        recording: &Arc<Recording>,
        is_split: bool,
    ) -> anyhow::Result<Self> {
        let variables = prepare_runtime(config, &options.out)?;
        // SAFETY: the caller's promise, as for `run`.
        unsafe { set_runtime(&variables) };
        let xr = Xr::open(&Platform, XrOptions::default())?;
        let client_options = ClientOptions {
            msaa: Some(USUAL_MSAA),
            max_vertex_slots: options.room.vertices,
            max_patch_slots: options.room.patches,
            max_triangles: options.room.triangles,
            ..ClientOptions::default()
        };
        let (mut presenter, timed) = match is_split {
            true => split(Box::new(xr), client_options, recording, &options.out.join("trace.json"))?,
            false => together(Box::new(xr), client_options, recording)?,
        };
        ensure!(timed.frames > 0, "no display frame showed a bundle; record more seconds");
        let mut vertices: Vec<u32> = presenter.drawn_triangles().into_iter().flatten().collect();
        vertices.sort_unstable();
        vertices.dedup();
        presenter.frame_timings()?;
        let cost = timed.cost().context("frames with a new bundle are among them")?;
        let device = presenter.gpu().device_name();
        let Timed { frames, bundles, repeated, .. } = timed;
        Ok(Self { device, vertices: vertices.len(), frames, bundles, repeated, cost })
    }
}

fn turns(recording: &Recording) -> usize {
    recording.iter().filter(|heard| matches!(heard.what, What::Frame)).count()
}

/// The intake has a thread of its own.
fn split(
    display: Box<dyn Display>,
    options: ClientOptions,
    recording: &Arc<Recording>,
    trace: &Path,
) -> anyhow::Result<(Presenter, Timed)> {
    let trace = Trace::create(trace)?;
    let mut traced = Traced::new(Some(&trace));
    let (mut presenter, intake) = halves(display, options)?;
    let feed = Feed::new(recording);
    let progress = feed.progress.clone();
    let mut taking = Taking::start(intake, feed)?;
    let thread = taking.thread().cloned().context("the thread runs")?;
    presenter.wake(thread.clone());
    let mut timed = Timed::default();
    for turn in 0..turns(recording) {
        std::thread::sleep(PACE);
        progress.may_begin.store(turn + 1, Ordering::Release);
        thread.unpark();
        // What came up to the frame before is taken in by now; at the start all that came up to this one.
        progress.wait_for(if turn < FRAMES_IN_STEP { turn + 1 } else { turn })?;
        let turn = presenter.wait_turn()?;
        let began_cpu_ns = thread_cpu_ns();
        let step = presenter.present(turn, None)?;
        let cpu_ns = thread_cpu_ns() - began_cpu_ns;
        if let Step::Frame(report) = &step {
            // In the recording's time, from the wish for the frame on.
            let began = report.display_time.plus_ns(-(1e9 / REFRESH_HZ) as i64);
            traced.ended([began, began.plus_ns(cpu_ns)], Some(cpu_ns), report);
            timed.note(report, cpu_ns);
        }
        taking.assert_alive();
    }
    Ok((presenter, timed))
}

/// One thread does all.
fn together(
    display: Box<dyn Display>,
    options: ClientOptions,
    recording: &Arc<Recording>,
) -> anyhow::Result<(Presenter, Timed)> {
    let mut client = Client::new(display, options)?;
    let mut feed = Feed::new(recording);
    let mut timed = Timed::default();
    for turn in 0..turns(recording) {
        std::thread::sleep(PACE);
        feed.progress.may_begin.store(turn + 1, Ordering::Release);
        let mut began_cpu_ns = 0;
        let step = client.step_with(|intake| {
            began_cpu_ns = thread_cpu_ns();
            feed.pump(intake);
        })?;
        let cpu_ns = thread_cpu_ns() - began_cpu_ns;
        if let Step::Frame(report) = &step {
            timed.note(report, cpu_ns);
        }
    }
    Ok((client.presenter, timed))
}

/// What display frames took.
#[derive(Default)]
struct Timed {
    with_bundle: u64,
    frames: u64,
    bundles: u64,
    repeated: u64,
    all: Percentiles,
    with_new: Percentiles,
}

impl Timed {
    fn note(&mut self, report: &FrameReport, cpu_ns: i64) {
        self.with_bundle += u64::from(report.update.is_some());
        if self.with_bundle <= FRAMES_BEFORE {
            return;
        }
        if report.is_repeated {
            self.repeated += 1;
            return;
        }
        let ms = cpu_ns as f64 * 1e-6;
        self.frames += 1;
        self.bundles += u64::from(report.is_new);
        self.all.add(ms);
        if report.is_new {
            self.with_new.add(ms);
        }
    }

    fn cost(&self) -> Option<Cost> {
        Some(Cost {
            median_ms: self.all.at(50.0)?,
            p99_ms: self.all.at(99.0)?,
            worst_ms: self.all.largest()?,
            switch_median_ms: self.with_new.at(50.0)?,
        })
    }
}

/// Hands a client what another one was handed.
struct Feed {
    recording: Arc<Recording>,
    next: usize,
    progress: Arc<Progress>,
}

/// How far it may go, and has gone: display frames.
#[derive(Default)]
struct Progress {
    may_begin: AtomicUsize,
    begun: AtomicUsize,
}

impl Progress {
    fn wait_for(&self, frames: usize) -> anyhow::Result<()> {
        let began = Instant::now();
        while self.begun.load(Ordering::Acquire) < frames {
            if began.elapsed() > PATIENCE {
                bail!("the intake's thread has taken nothing for {PATIENCE:?}");
            }
            std::thread::sleep(Duration::from_micros(200));
        }
        Ok(())
    }
}

impl Feed {
    fn new(recording: &Arc<Recording>) -> Self {
        Self { recording: recording.clone(), next: 0, progress: Arc::default() }
    }
}

impl Source for Feed {
    fn pump(&mut self, intake: &mut Intake) {
        while self.progress.begun.load(Ordering::Relaxed) < self.progress.may_begin.load(Ordering::Acquire) {
            let Some(heard) = self.recording.get(self.next) else { return };
            heard.tell(intake);
            self.next += 1;
            if let What::Frame = heard.what {
                while intake.poll_out().is_some() {}
                while let Some(notice) = intake.poll_notice() {
                    assert!(
                        matches!(notice, Notice::Welcome(_)),
                        "what was recorded is played as it was: {notice:?}"
                    );
                }
                self.progress.begun.fetch_add(1, Ordering::Release);
            }
        }
    }

    fn leave(&mut self, _: &mut Intake) {}
}

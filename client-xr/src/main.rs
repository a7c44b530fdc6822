//! `shadecast-client`: the command line around [`shadecast_client::net`].

use anyhow::Context;
use clap::{Args, Parser, ValueEnum};
use shadecast_client::client::{ClientError, ClientOptions, FrameReport};
use shadecast_client::display::window::{Desktop, WindowDisplay, WindowOptions};
use shadecast_client::display::xr::foveation::Foveation;
use shadecast_client::display::xr::{Xr, XrOptions};
use shadecast_client::display::{Display, DisplayError};
use shadecast_client::draw::stages::atlas_draw::{Lookup, Reconstruction};
use shadecast_client::draw::stages::interpolate::Interpolation;
use shadecast_client::net::{self, RunOptions};
use shadecast_client::platform::Platform;
use shadecast_client::present::presenter::Presenter;
use shadecast_client::present::stats::ClientStats;
use shadecast_desktop::canvas::DEFAULT_EXTENT;
use shadecast_desktop::flags::{number, size};
use shadecast_protocol::limits::MAX_STORE_PAGES;
use shadecast_protocol::text::{printable, with_causes};
use shadecast_system::write_atomically;
use shadecast_transport::Fingerprint;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Longest limit of a run in seconds: eleven days.
const MAX_SECONDS: f64 = 1e6;

/// Set by SIGINT and SIGTERM.
static STOP: AtomicBool = AtomicBool::new(false);

const EXAMPLES: &str = "\
Examples:
  shadecast-client --connect 192.168.1.5:7400
  XR_RUNTIME_JSON=/usr/share/openxr/1/openxr_monado.json shadecast-client
  shadecast-client --window --connect find
  shadecast-client --seconds 10 --stats stats.json --validation

Keys in the window: drag to look around, WASD and QE to move, wheel for the speed, Tab to fly or orbit,
B for both eyes, F for figures, R to return to the start, Esc to quit.
P halts and resumes the world, for all viewers. The full stop advances a halted world by one step.
Where --connect find finds several servers, N marks the next one and Enter connects to it.

XR_RUNTIME_JSON names the manifest of an OpenXR runtime. Without it the system's active runtime is used.
The first connection to a server pins its identity. Later connections require it; --fingerprint requires a given one.
The exit status is 0 when the runtime or the user ends the session. Ctrl-C ends the session; a second Ctrl-C kills the
program.";

/// Displays the scene of a Shadecast server, on an OpenXR headset or in a window.
#[derive(Parser)]
#[command(version, after_help = EXAMPLES)]
struct Arguments {
    /// Server as HOST:PORT, or find to search this network
    #[arg(long, value_name = "ADDR", default_value = "127.0.0.1:7400")]
    connect: String,
    /// Folder for the fingerprints of known servers [default: ~/.config/shadecast]
    #[arg(long, value_name = "DIR")]
    identity: Option<PathBuf>,
    /// Required identity of the server: 64 hexadecimal digits, printed by the server at its start
    #[arg(long, value_name = "HEX")]
    fingerprint: Option<Fingerprint>,
    /// End the session this many seconds after the start; 0: never
    #[arg(long, value_name = "S", default_value = "0", hide_default_value = true, value_parser = number(0.0..=MAX_SECONDS, "seconds"))]
    seconds: f64,
    /// Write a trace for Perfetto (ui.perfetto.dev), in server time
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// Write the statistics of the session
    #[arg(long, value_name = "FILE.json")]
    stats: Option<PathBuf>,
    /// Enable the Vulkan validation layers
    #[arg(long)]
    validation: bool,
    /// Interpolation of positions between two samples
    #[arg(long, value_enum, default_value_t = InterpolationArgument::Cubic)]
    interpolation: InterpolationArgument,
    /// Measurement: folder for instance and distance of each pixel
    #[arg(long, value_name = "DIR", requires = "probe_every")]
    probe_dir: Option<PathBuf>,
    /// Measurement: write the pixels of every Nth display frame
    #[arg(long, value_name = "N", requires = "probe_dir", value_parser = clap::value_parser!(u64).range(1..))]
    probe_every: Option<u64>,
    /// Interpolation of colours between atlas texels
    #[arg(long, value_enum, default_value_t = ReconstructionArgument::Bilinear)]
    reconstruction: ReconstructionArgument,
    /// MSAA samples; 2 falls back to 4 where unsupported [default: 4, and 1 without a GPU]
    #[arg(long, value_name = "SAMPLES", value_parser = ["1", "2", "4"])]
    msaa: Option<String>,
    /// Pages of settled blocks kept on the device, 22 MB each [default: 6, and none without a GPU]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(..=i64::from(MAX_STORE_PAGES)))]
    store_pages: Option<u32>,
    /// Requested refresh rate; the nearest offered rate is used [default: chosen by the runtime]
    #[arg(long, value_name = "HZ", conflicts_with = "window", value_parser = number(1.0_f32..=1000.0, "frames a second"))]
    refresh: Option<f32>,
    /// Fixed foveation, where the headset supports XR_FB_foveation
    #[arg(long, value_enum, conflicts_with = "window", default_value_t = FoveationArgument::Low)]
    foveation: FoveationArgument,
    /// Print warnings and errors only
    #[arg(long)]
    quiet: bool,
    #[command(flatten)]
    window: WindowArguments,
}

#[derive(Args)]
struct WindowArguments {
    /// Display in a desktop window, without headset and OpenXR runtime
    #[arg(long)]
    window: bool,
    /// Pixels per eye, and initial size of the window [default: 1280x800]
    #[arg(long, value_name = "WxH", requires = "window", value_parser = size)]
    size: Option<[u32; 2]>,
    /// Vertical field of view in degrees
    #[arg(
        long,
        value_name = "DEG",
        requires = "window",
        default_value_t = 60.0,
        value_parser = number(20.0_f32..=120.0, "degrees")
    )]
    fov: f32,
    /// Start with both eyes in the window
    #[arg(long, requires = "window")]
    both_eyes: bool,
    /// Start without figures in the window
    #[arg(long, requires = "window")]
    no_figures: bool,
    /// Write the last picture of the window
    #[arg(long, value_name = "FILE.png", requires = "window")]
    screenshot: Option<PathBuf>,
    /// Part of the Vulkan device's name
    #[arg(long, value_name = "NAME", requires = "window")]
    device: Option<String>,
}

#[derive(Clone, Copy, ValueEnum)]
enum InterpolationArgument {
    /// Cubic through four samples
    Cubic,
    /// Line through two samples
    Linear,
}

#[derive(Clone, Copy, ValueEnum)]
enum ReconstructionArgument {
    /// Linear
    Bilinear,
    /// Cubic for luma: sharper, and slower
    Bicubic,
}

#[derive(Clone, Copy, ValueEnum)]
enum FoveationArgument {
    /// Off
    None,
    /// Hardly visible
    Low,
    /// Moderate
    Medium,
    /// Visible where the lens is sharp to its border
    High,
}

/// The first signal (Ctrl-C, or the system's wish to end) asks the program to end; the next one ends it.
fn stop() {
    if STOP.swap(true, Ordering::Relaxed) {
        shadecast_system::process::end_at_once();
    }
}

/// Prints a line to standard error. A closed pipe does not end the program.
fn say(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Colour escapes are for terminals without NO_COLOR.
fn wants_colour() -> bool {
    let is_refused = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    std::io::stderr().is_terminal() && !is_refused
}

fn log_to_stderr(level: tracing::Level) {
    let filter = tracing_subscriber::filter::Targets::new()
        .with_default(level)
        .with_target("winit", tracing::Level::ERROR); // it warns of displays without a size
    let lines = tracing_subscriber::fmt::layer()
        .with_target(false)
        .without_time()
        .with_ansi(wants_colour())
        .with_writer(std::io::stderr)
        .log_internal_errors(false);
    tracing_subscriber::registry().with(lines).with(filter).init();
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let level = if arguments.quiet { tracing::Level::WARN } else { tracing::Level::INFO };
    log_to_stderr(level);
    let outcome = ctrlc::set_handler(stop).context("catching signals").and_then(|()| run(&arguments));
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            say(&format!("shadecast-client: {}", with_causes(error.as_ref())));
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let identity_dir = match &arguments.identity {
        Some(folder) => folder.clone(),
        None => shadecast_transport::identity::default_directory()?,
    };
    let options = RunOptions {
        server: arguments.connect.as_str().into(),
        fingerprint: arguments.fingerprint,
        asks_first: false,
        identity_dir,
        forgetting: None,
        notice: None,
        client: ClientOptions {
            interpolation: match arguments.interpolation {
                InterpolationArgument::Cubic => Interpolation::Cubic,
                InterpolationArgument::Linear => Interpolation::Linear,
            },
            lookup: Lookup {
                reconstruction: match arguments.reconstruction {
                    ReconstructionArgument::Bilinear => Reconstruction::Bilinear,
                    ReconstructionArgument::Bicubic => Reconstruction::Bicubic,
                },
                ..Lookup::default()
            },
            msaa: arguments.msaa.as_ref().and_then(|samples| samples.parse().ok()),
            store_pages: arguments.store_pages,
            ..ClientOptions::default()
        },
        seconds: arguments.seconds,
        pipelines: shadecast_system::folders::cache(|name| std::env::var_os(name)),
        trace: arguments.trace.clone(),
    };
    let mut probes = arguments
        .probe_dir
        .as_ref()
        .zip(arguments.probe_every)
        .map(|(folder, every)| Probes::new(folder, every));
    if let Some(probes) = &probes {
        std::fs::create_dir_all(&probes.folder)
            .with_context(|| format!("making {}", probes.folder.display()))?;
    }
    let mut announced = arguments.quiet;
    let mut open = opener(arguments)?;
    let outcome = net::run(&mut *open, &options, &STOP, &mut |presenter, report| {
        if !std::mem::replace(&mut announced, true) {
            announce(presenter);
        }
        probes.as_mut().map_or(Ok(()), |probes| probes.observe(presenter, report))
    });
    // The statistics are written after a failure too.
    let written = arguments.stats.as_deref().map_or(Ok(()), |path| write_stats(path, &outcome.stats));
    if !arguments.quiet && outcome.stats.frames > 0 {
        summarise(&outcome.stats);
    }
    outcome.ended?;
    probes.and_then(|probes| probes.failure).map_or(written, Err)
}

/// Opens the headset, or the window in its place.
fn opener(arguments: &Arguments) -> Result<Box<net::Opener<'static>>, DisplayError> {
    let validation = arguments.validation;
    let window = &arguments.window;
    if !window.window {
        let foveation = match arguments.foveation {
            FoveationArgument::None => Foveation::None,
            FoveationArgument::Low => Foveation::Low,
            FoveationArgument::Medium => Foveation::Medium,
            FoveationArgument::High => Foveation::High,
        };
        let options =
            XrOptions { validation, refresh_hz: arguments.refresh, foveation, ..XrOptions::default() };
        return Ok(Box::new(move || Ok(Box::new(Xr::open(&Platform, options)?) as Box<dyn Display>)));
    }
    let options = WindowOptions {
        title: printable(&arguments.connect),
        extent_pixels: window.size.unwrap_or(DEFAULT_EXTENT),
        fov_deg: window.fov,
        both_eyes: window.both_eyes,
        figures: !window.no_figures,
        screenshot: window.screenshot.clone(),
        validation,
        device_name: window.device.clone(),
    };
    let desktop = Desktop::connect()?;
    Ok(Box::new(move || Ok(Box::new(WindowDisplay::open(&desktop, &options)?) as Box<dyn Display>)))
}

fn write_stats(path: &Path, stats: &ClientStats) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(stats)? + "\n";
    write_atomically(path, text.as_bytes()).with_context(|| format!("writing {}", path.display()))
}

fn announce(presenter: &Presenter) {
    let gpu = presenter.gpu();
    let slow = if gpu.is_cpu() { " (a CPU: correct, but slow)" } else { "" };
    let [width, height] = presenter.eye_extent_pixels();
    say(&format!("{} on {}{slow}, {width}x{height} per eye", presenter.stats().runtime, gpu.device_name()));
}

fn summarise(stats: &ClientStats) {
    say(&format!(
        "{:.1} s: {:.1} frames/s, {:.1} bundles/s, {:.1} MB atlas, {:.1} MB geometry, {} vertices frozen, {} pictures lost",
        stats.seconds,
        stats.client_fps,
        stats.bundles_per_s,
        stats.atlas_bytes as f64 * 1e-6,
        stats.geometry_bytes as f64 * 1e-6,
        stats.frozen_vertices,
        stats.lost_pictures,
    ));
}

/// Writes a probe of every Nth display frame.
struct Probes {
    folder: PathBuf,
    every: u64,
    frames: u64,
    /// The due frame repeated the last picture, so the next picture is probed.
    is_due: bool,
    /// The first file that could not be written. Later files are not tried.
    failure: Option<anyhow::Error>,
}

impl Probes {
    fn new(folder: &Path, every: u64) -> Self {
        Self { folder: folder.to_owned(), every, frames: 0, is_due: false, failure: None }
    }

    fn observe(&mut self, presenter: &mut Presenter, report: &FrameReport) -> Result<(), ClientError> {
        let is_due = self.is_due || self.frames.is_multiple_of(self.every);
        self.is_due = is_due && report.is_repeated;
        self.frames += 1;
        if !is_due || !report.is_rendered || self.failure.is_some() {
            return Ok(());
        }
        let views = presenter.probe()?;
        // A window's two eyes are one.
        let is_one = views[0].eye.is_some() && views[0].eye == views[1].eye;
        let eyes = if is_one { 1 } else { 2 };
        for (view, side) in views.iter().zip(["left", "right"]).take(eyes) {
            let path = self.folder.join(format!("probe-{}-{side}.bin", report.display_time.0));
            let written = write_atomically(&path, &view.to_bytes());
            if let Err(error) = written.with_context(|| format!("writing {}", path.display())) {
                self.failure = Some(error);
                STOP.store(true, Ordering::Relaxed);
                return Ok(());
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    /// What clap asserts of a command line: no two flags or groups of one name, and defaults that parse.
    #[test]
    fn every_command_is_well_formed() {
        Arguments::command().debug_assert();
    }
}

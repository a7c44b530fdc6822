//! The command line of the server.

mod devices;
mod doctor;
mod forward;
mod interrupt;
mod output;
mod start_up;

use anyhow::Context;
use clap::{Args, Parser, Subcommand, ValueEnum, value_parser};
use glam::Vec3;
use interrupt::FirstSignal;
use output::{Output, note};
use shadecast_desktop::flags::{MOST_S, number};
use shadecast_dragon::BuiltIn;
use shadecast_gpu::{DesktopDevice, Gpu};
use shadecast_protocol::limits::MAX_COORDINATE_M;
use shadecast_protocol::text::{printable, with_causes};
use shadecast_scene::load::{SceneSource, load_scene_with};
use shadecast_scene::process::Loading;
use shadecast_scene::{Cancel, Scene};
use shadecast_server::encode::choice::{Encoders, Wanted};
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::scene::SceneGpu;
use shadecast_server::serve::stream::{Device, StreamOptions, run};
use shadecast_server::update;
use shadecast_server_cli::arguments::{GpuArgs, RenderArgs, SceneArgs, one_of};
use shadecast_server_cli::inspect::{self, InspectArgs};
use shadecast_system::write_atomically;
use start_up::{CacheArgs, StartUp};
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Where a server listens unless asked to listen elsewhere: for this machine alone.
const DEFAULT_LISTEN: &str = "127.0.0.1:7400";
/// In the names of files that keep compiled pipelines.
const PROGRAM: &str = "server";
/// Updates a second that it makes at most unless asked for another rate.
const DEFAULT_RATE_HZ: f64 = 30.0;

/// Streams shaded, animated worlds to a headset that only rasterises and texture-maps.
#[derive(Parser)]
#[command(
    name = "shadecast-server",
    version,
    after_help = "Examples:
  shadecast-server stream courtyard
  shadecast-server stream castle.toml --listen 0.0.0.0:7400
  shadecast-server stream fox.glb --link latency=20ms,jitter=5ms,rate=100mbit
  shadecast-server forward dragon --out pictures --frames 8 --fps 8
  shadecast-server forward dragons:3 --out dragons.mp4 --frames 120 --size 1280x720
  shadecast-server forward dragons:3 --window
  shadecast-server pair 123456
  shadecast-server devices rename 'device 1' attic
  shadecast-server inspect dragon
  shadecast-server inspect error fox.glb --spacing-ms 100
  shadecast-server doctor --listen 0.0.0.0:7400
  shadecast-server generate dragon --out dragon.glb

SCENE is courtyard, dragons:N, dragons:NxMxK (a grid), a .glb, .gltf or .fbx file, or a scene description (.toml)."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Serves a scene to clients
    Stream(Box<StreamArgs>),
    /// Renders a scene with the ground-truth renderer: to PNG files, to a video, or in a window
    Forward(Box<forward::ForwardArgs>),
    /// Says what is in a scene, what it takes, and how exact its animation is; needs no GPU
    Inspect(InspectArgs),
    /// Gives a running server the code that a headset shows
    Pair(devices::PairArgs),
    /// Lists the paired devices, names them, says what they may do, and forgets them
    Devices(devices::DevicesArgs),
    /// Says what this machine can do as a server, measured, and what to change
    Doctor(doctor::DoctorArgs),
    /// Writes a generated model
    Generate {
        /// What to generate: dragon, or a piece of the courtyard: masonry, paving, tree, cypress, ivy, pot, lantern
        what: String,
        /// The .glb file to write
        #[arg(long)]
        out: PathBuf,
    },
}

#[derive(Args)]
struct DeviceArgs {
    #[command(flatten)]
    gpu: GpuArgs,
    #[command(flatten)]
    scene: SceneArgs,
    /// The sun casts no shadows, whatever the scene says
    #[arg(long)]
    no_shadows: bool,
    #[command(flatten)]
    cache: CacheArgs,
}

#[derive(Args)]
struct StreamArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    scene: String,
    /// UDP address to listen on; 0.0.0.0:7400 for headsets on the network
    #[arg(long, default_value = DEFAULT_LISTEN)]
    listen: SocketAddr,
    /// Whether clients of the network find the server by themselves (DNS-SD, _shadecast._udp)
    #[arg(long, value_enum, default_value_t = Announce::Auto)]
    announce: Announce,
    /// The name under which they find it [default: the machine's]
    #[arg(long)]
    name: Option<String>,
    /// Folder of the server's key and its paired devices [default: the user's configuration folder]
    #[arg(long)]
    identity: Option<PathBuf>,
    /// Which clients are served
    #[arg(long, value_name = "WHOM", default_value = "paired", value_parser = one_of(devices::ADMITS, devices::of_admit))]
    admit: devices::AdmitArg,
    #[command(flatten)]
    render: RenderArgs,
    /// Encoder of the video: auto, or one of those that `doctor` lists
    #[arg(long, value_name = "NAME", default_value = "auto")]
    encoder: Wanted,
    /// Updates per second, 1 to 60
    #[arg(long, default_value_t = DEFAULT_RATE_HZ, value_parser = number(1.0..=60.0, "updates a second"))]
    rate: f64,
    /// Milliseconds of an update for surfaces that are shaded again; what is new is always shaded [default: what is left
    /// of the update's period]
    #[arg(long, value_name = "MS", value_parser = number(0.1..=1000.0, "milliseconds"))]
    shade_ms: Option<f64>,
    /// Clients that are served at once, 1 to 16; all see the same moment of the same world
    #[arg(long, default_value_t = 4, value_parser = value_parser!(u8).range(1..=16))]
    viewers: u8,
    /// No client can halt the world; without this those can that have the right to, for all who look
    #[arg(long)]
    no_halt: bool,
    /// Simulates a network on the real socket, such as latency=20ms,jitter=5ms,loss=1%,rate=100mbit, or a .toml file
    #[arg(long)]
    link: Option<String>,
    /// Seed of the simulated network
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Ends after so many seconds; 0: runs until stopped
    #[arg(long, default_value_t = 0.0, value_parser = number(0.0..=MOST_S, "seconds"))]
    seconds: f64,
    /// Writes figures of the run to this JSON file on leaving
    #[arg(long)]
    stats: Option<PathBuf>,
    /// Writes the last shading atlas to this PNG file on leaving
    #[arg(long)]
    atlas_png: Option<PathBuf>,
    #[command(flatten)]
    device: DeviceArgs,
}

/// When a server announces itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Announce {
    /// Where it listens on a network
    Auto,
    /// On this machine too
    Always,
    /// Not at all
    Never,
}

impl StreamArgs {
    fn announced_as(&self) -> Option<String> {
        let is_announced = match self.announce {
            Announce::Auto => !self.listen.ip().is_loopback(),
            Announce::Always => true,
            Announce::Never => false,
        };
        let name = || printable(&gethostname::gethostname().to_string_lossy());
        is_announced.then(|| self.name.clone().unwrap_or_else(name))
    }
}

fn parse_vector(text: &str) -> Result<Vec3, String> {
    let numbers: Option<Vec<f32>> = text.split(',').map(|part| part.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[x, y, z]) if [x, y, z].iter().all(|part| part.abs() <= MAX_COORDINATE_M) => {
            Ok(Vec3::new(x, y, z))
        }
        _ => Err(format!("must be x,y,z, such as 0,1.6,0, each within {MAX_COORDINATE_M} m")),
    }
}

/// Colour escapes are for terminals: not for files, and not for who sets NO_COLOR.
fn wants_colour() -> bool {
    let is_refused = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    std::io::stderr().is_terminal() && !is_refused
}

fn main() {
    shadecast_system::memory::return_large_allocations();
    let filter = tracing_subscriber::filter::Targets::new()
        .with_default(tracing::Level::WARN)
        .with_target("winit", tracing::Level::ERROR); // it warns of displays without a size
    use tracing_subscriber::layer::SubscriberExt;
    use tracing_subscriber::util::SubscriberInitExt;
    tracing_subscriber::registry()
        .with(
            tracing_subscriber::fmt::layer()
                .with_ansi(wants_colour())
                .with_writer(std::io::stderr)
                .log_internal_errors(false),
        )
        .with(filter)
        .init();
    if let Err(error) = run_command(&Cli::parse().command) {
        if interrupt::is_interruption(&error) {
            note("interrupted");
            std::process::exit(shadecast_system::process::INTERRUPTED);
        }
        note(&format!("error: {}", with_causes(error.as_ref())));
        std::process::exit(1);
    }
}

fn run_command(command: &Command) -> anyhow::Result<()> {
    match command {
        Command::Stream(args) => {
            let cancel = interrupt::install(FirstSignal::Asks)?;
            // A server is stopped by a signal; that is no failure, at whatever time it comes.
            stream(args, &cancel)
                .or_else(|error| interrupt::is_interruption(&error).then_some(()).ok_or(error))
        }
        Command::Forward(args) => forward::forward(args, &interrupt::install(FirstSignal::Asks)?),
        // These have nothing to finish.
        Command::Inspect(args) => {
            interrupt::install(FirstSignal::Ends)?;
            inspect::run(args).map(|text| print!("{text}"))
        }
        Command::Pair(args) => {
            interrupt::install(FirstSignal::Ends)?;
            devices::pair(args)
        }
        Command::Devices(args) => {
            interrupt::install(FirstSignal::Ends)?;
            devices::run(args)
        }
        Command::Doctor(args) => {
            interrupt::install(FirstSignal::Ends)?;
            doctor::doctor(args)
        }
        Command::Generate { what, out } => {
            interrupt::install(FirstSignal::Ends)?;
            generate_model(what, out)
        }
    }
}

fn loading(args: &DeviceArgs, cancel: &Cancel) -> Loading {
    Loading::complete(args.cache.open()).until(cancel)
}

/// The scene as it is to be lit.
fn load(scene: &str, args: &DeviceArgs, loading: &Loading) -> anyhow::Result<Scene> {
    let mut scene = load_scene_with(&scene.parse::<SceneSource>()?, loading)?;
    scene.sun.casts_shadows &= !args.no_shadows;
    Ok(scene)
}

fn open(
    scene: &str,
    args: &DeviceArgs,
    cancel: &Cancel,
) -> anyhow::Result<(Arc<Gpu>, Arc<SceneGpu>, StartUp)> {
    let loading = loading(args, cancel);
    let mut start_up = StartUp::new(loading.cache.clone());
    // Before the scene, which may take long: without a device it would be loaded for nothing.
    let gpu = Gpu::open(&args.gpu.options(), &DesktopDevice)?;
    // Standard output may be where a video goes.
    note(&format!("Vulkan device: {}", gpu.device_name()));
    loading.cache.folder().into_iter().for_each(|folder| gpu.load_pipelines(folder, PROGRAM));
    if gpu.is_cpu() {
        note("warning: this device is a CPU; pictures are right, but slow");
    }
    start_up.ended("device");
    let scene = load(scene, args, &loading)?;
    start_up.ended("scene");
    let scene = SceneGpu::cached(&gpu, scene, &args.scene.options(), &loading)?;
    start_up.ended("upload");
    Ok((gpu, Arc::new(scene), start_up))
}

fn stream(args: &StreamArgs, cancel: &Cancel) -> anyhow::Result<()> {
    let link = args.link.as_deref().map(str::parse).transpose()?;
    let encoders = Encoders::choose(&args.encoder)?;
    let (gpu, scene, _) = open(&args.scene, &args.device, cancel)?;
    update::check_device(&gpu, &scene).with_context(|| format!("scene {}", args.scene))?;
    let reopen = |scene: Scene| -> anyhow::Result<Device> {
        let gpu = Gpu::open(&args.device.gpu.options(), &DesktopDevice)?;
        let loading = loading(&args.device, cancel);
        loading.cache.folder().into_iter().for_each(|folder| gpu.load_pipelines(folder, PROGRAM));
        let scene = SceneGpu::cached(&gpu, scene, &args.device.scene.options(), &loading)?;
        Ok(Device { gpu, scene: Arc::new(scene) })
    };
    let options = StreamOptions {
        listen: args.listen,
        announced_as: args.announced_as(),
        identity: args.identity.clone(),
        admit: args.admit.0,
        reads_codes: std::io::stdin().is_terminal(),
        atlas_extent_texels: args.render.atlas,
        quality: args.render.quality(QualityOptions::Auto),
        encoders,
        show: args.render.show(),
        rate_hz: args.rate,
        shade_ms: args.shade_ms,
        viewers: usize::from(args.viewers),
        viewers_steer: !args.no_halt,
        link,
        seed: args.seed,
        seconds: args.seconds,
        trace: args.render.trace.clone(),
        atlas_png: args.atlas_png.clone(),
    };
    let output = Output::start().context("starting to write")?;
    let voice = output.voice();
    let say = |line: &str| voice.say(line);
    note("compiling pipelines");
    let stats = run(Device { gpu, scene }, &reopen, &options, cancel.flag(), &say)?;
    voice.say(&format!("{} updates, {:.1} a second", stats.updates, stats.server_fps));
    if let Some(last) = stats.viewers.last() {
        voice.say(&format!(
            "{:.0} % of the texels in blocks were not shaded again",
            100.0 * last.reused_share
        ));
    }
    let busy_s: f64 = stats.viewers.iter().map(|viewer| viewer.busy_s).sum();
    for viewer in stats.viewers.iter().filter(|_| stats.viewers.len() > 1) {
        let (number, share) = (viewer.viewer, 100.0 * viewer.busy_s / busy_s.max(1e-9));
        voice.say(&format!(
            "  client {number}: {:.1} updates a second for {:.1} s, {share:.0} % of the work",
            viewer.server_fps, viewer.seconds
        ));
    }
    output.finish();
    if let Some(path) = &args.stats {
        let text = serde_json::to_string_pretty(&stats)?;
        write_atomically(path, text.as_bytes()).with_context(|| format!("writing {}", path.display()))?;
    }
    Ok(())
}

fn generate_model(what: &str, out: &Path) -> anyhow::Result<()> {
    let built_in = BuiltIn::named(what).with_context(|| {
        format!("\"{what}\" cannot be generated; what can: {}", BuiltIn::ALL.map(BuiltIn::name).join(", "))
    })?;
    let bytes = built_in.glb();
    write_atomically(out, &bytes).with_context(|| format!("writing {}", out.display()))?;
    println!("{}: {} bytes", out.display(), bytes.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    /// What clap asserts of a command line: no two flags or groups of one name, and defaults that parse.
    #[test]
    fn every_command_is_well_formed() {
        Cli::command().debug_assert();
    }
}

//! The command line of the lab.

use anyhow::Context;
use clap::{Args, Parser, Subcommand, value_parser};
use serde::Serialize;
use shadecast_client::draw::stages::atlas_draw::Reconstruction;
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_lab::abrupt;
use shadecast_lab::bars::{BARS, Bars};
use shadecast_lab::causes::{self, CAUSES, Cause};
use shadecast_lab::demo::{DemoOptions, demo};
use shadecast_lab::demo_window::{DemoWindowOptions, demo_window};
use shadecast_lab::detail;
use shadecast_lab::figures;
use shadecast_lab::hostile::{self, HostileOptions};
use shadecast_lab::long;
use shadecast_lab::motion_table::{self, Condition, KINDS, Kind};
use shadecast_lab::options::{
    Head, Renderer, RunOptions, Spared, StageMs, USUAL_LINK, ViewerOptions, parse_room,
};
use shadecast_lab::render_thread;
use shadecast_lab::robot::robot;
use shadecast_lab::room::{MANY_VASES, write_room};
use shadecast_lab::run::{Report, run};
use shadecast_lab::skinning;
use shadecast_lab::steadiness;
use shadecast_lab::still;
use shadecast_lab::table1::{self, Table1Options};
use shadecast_lab::viewers::run_each;
use shadecast_lab::walls::{TEXELS, write_walls};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::flags::{MOST_S, number, size};
use shadecast_protocol::text::with_causes;
use shadecast_scene::animation::sampling::Sampling;
use shadecast_scene::load::MAX_DRAGONS;
use shadecast_server::animation::skinning::Skinning;
use shadecast_server::choice::Room;
use shadecast_server::detail::DEFAULT_DETAIL_PIXELS;
use shadecast_server::ideal::Ideal;
use shadecast_server::motion::MotionOption;
use shadecast_server::quality::QualityArgs;
use shadecast_server::scene::SceneOptions;
use shadecast_server::surround::DEFAULT_SURROUND;
use shadecast_server::view_plan::ViewPlan;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The whole system on one virtual clock: measurements that a slow machine makes as a fast one would.
#[derive(Parser)]
#[command(
    name = "shadecast-lab",
    version,
    after_help = "Examples:
  shadecast-lab run dragons:3 --renderer stream --link latency=20ms,jitter=5ms,rate=100mbit --out out/run
  shadecast-lab run fox.glb --renderer local --size 256x256 --seconds 3 --dump-every 24 --out out/fox
  shadecast-lab motion fox.glb --clip Run --link latency=200ms,jitter=10ms --link updates=2 --json motion.json
  shadecast-lab demo --out out/demo
  shadecast-lab device

SCENE is dragon, dragons:N, dragons:NxMxK (a grid), a .glb, .gltf or .fbx file, or a scene description (.toml).
A head path is a CSV file, t_s,x,y,z,qx,qy,qz,qw: metres in the stage's frame (y up, -z forward)."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Runs server, link and client in one process on a virtual clock, and measures
    Run(RunArgs),
    /// Measures how exactly vertices move: every way over several links, in one table
    Motion(MotionArgs),
    /// Measures what each cause of error costs: a run as it ships, and the same run without each cause in turn
    Causes(CausesArgs),
    /// Measures the ways of skinning side by side, against the floor that the device's own rates set
    Skinning(SkinningArgs),
    /// Measures the second update of a scene in which nothing moves beside the first, by stage of the device
    Still(RunArgs),
    /// Measures the paper's Table 1 and Figure 4: rates of server and client for 9 to 169 dragons, and how the cost grows
    Table1(Table1Args),
    /// Measures openh264 beside libx264 on atlases of nine dragons
    #[cfg(feature = "libavcodec")]
    Encoders {
        /// Folder for encoders.json
        #[arg(long, default_value = "out/encoders")]
        out: PathBuf,
    },
    /// Measures what a display frame costs the thread that draws while updates of the paper's dragons arrive
    RenderThread(RenderThreadArgs),
    /// Runs server and client as two processes in real time, then the same scene in virtual time; pictures, figures, a page
    Demo(DemoArgs),
    /// Runs what takes long, one after the other, and checks the bars; what is done already is left out
    Long {
        /// Folder for the JSON results
        #[arg(long, default_value = "docs/results")]
        out: PathBuf,
        /// Runs only those whose name begins so, and checks no bars
        #[arg(long)]
        only: Option<String>,
    },
    /// Checks the results that are there against their bars, without running anything; fails where one is missed
    Bars {
        /// Folder of the JSON results
        #[arg(long, default_value = "docs/results")]
        out: PathBuf,
        /// Another list of bars
        #[arg(long)]
        bars: Option<PathBuf>,
    },
    /// Writes the tables of README and docs anew from the committed results, and the curve of keys
    Figures {
        /// The project's folder
        #[arg(long, default_value = ".")]
        root: PathBuf,
    },
    /// Writes the stiff character of the long runs: boxes on joints, wide steps between 24 keys a second
    Robot {
        /// The .glb file
        #[arg(long, default_value = "robot.glb")]
        out: PathBuf,
    },
    /// Writes the room of the long runs, in which the head starts abruptly: room.glb, and room.toml to stand in it
    Room {
        /// The folder
        #[arg(long, default_value = ".")]
        out: PathBuf,
    },
    /// Writes the room of the long runs whose walls are painted down to the texel: walls.toml, walls.glb and its pictures
    Walls {
        /// The folder
        #[arg(long, default_value = ".")]
        out: PathBuf,
    },
    /// Attacks a server of its own on loopback, and says what becomes of a lawful client meanwhile and afterwards
    Hostile(HostileArgs),
    /// Has a lawful client served beside others that behave badly, and says how many pictures it gets
    Neighbours {
        /// Seconds that each is beside it, in each of five rounds
        #[arg(long, default_value_t = 10.0)]
        seconds: f64,
        /// Writes the figures to this JSON file
        #[arg(long)]
        json: Option<PathBuf>,
    },
    /// Records what a server and a client say to each other, as seeds for the fuzz targets
    RecordTraffic {
        /// Folder of the seeds
        #[arg(long, default_value = "tests/fuzz/seeds")]
        out: PathBuf,
    },
    /// Puts traces of --trace into one, each in the server's time, and says how busy each row was: of a server and its clients
    MergeTraces {
        /// The traces
        #[arg(required = true)]
        traces: Vec<PathBuf>,
        /// The file of all
        #[arg(long, default_value = "trace.json")]
        out: PathBuf,
    },
    /// Runs as run does, and says what changes of levels of detail do to the picture, and how much the client draws
    Detail(RunArgs),
    /// Runs as run does with a head that stands still and then moves at full speed at once, and says how much is missing
    Abrupt(RunArgs),
    /// Runs as run does, and says how much of the atlas changes from update to update, and when it comes to rest
    Steady(RunArgs),
    /// Names the Vulkan device that would be used
    Device,
}

#[derive(Args)]
struct RunArgs {
    /// Writes there what happened when, for Perfetto (ui.perfetto.dev)
    #[arg(long, value_name = "FILE")]
    trace: Option<PathBuf>,
    /// dragon, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    scene: String,
    /// The clip that animated instances play [default: the scene's own choice]
    #[arg(long)]
    clip: Option<String>,
    /// Which renderer makes the pictures; forward writes the truth's alone, and compares nothing
    #[arg(long, value_enum, default_value = "stream")]
    renderer: Renderer,
    /// The network: latency=20ms,jitter=5ms,loss=1%,rate=100mbit, none, or a .toml file of those with start times
    #[arg(long, default_value = USUAL_LINK)]
    link: String,
    /// Several viewers of one world instead of one: link=LINK,head=PATH, each given once more; results in OUT/viewer-1 and so on
    #[arg(long, value_name = "link=LINK,head=PATH", conflicts_with_all = ["link", "head", "head_path"])]
    viewer: Vec<ViewerOptions>,
    /// Head path (CSV) [default: a short walk]
    #[arg(long)]
    head: Option<PathBuf>,
    /// A head path of the scene, by its name; every scene has still, turn, walk and stride
    #[arg(long, conflicts_with = "head")]
    head_path: Option<String>,
    /// Virtual seconds
    #[arg(long, default_value_t = 5.0, value_parser = number(0.01..=MOST_S, "seconds"))]
    seconds: f64,
    /// Pixels per eye
    #[arg(long, value_parser = size, default_value = "512x512")]
    size: [u32; 2],
    /// Field of view in degrees
    #[arg(long, default_value_t = 90.0, value_parser = number(10.0_f32..=170.0, "degrees"))]
    fov: f32,
    /// Updates of the server per second
    #[arg(long, default_value_t = 30.0, value_parser = number(1.0..=1000.0, "updates a second"))]
    rate: f64,
    /// Seed of link and connection
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for pictures and stats.json
    #[arg(long)]
    out: PathBuf,
    /// Writes client-NNNNNN-left.png, -right.png and truth-NNNNNN-left.png, -right.png every N display frames
    #[arg(long, default_value_t = 0)]
    dump_every: u32,
    /// Compares with the truth every N display frames (with --dump-every: those that are written)
    #[arg(long, default_value_t = 12, value_parser = value_parser!(u32).range(1..))]
    compare_every: u32,
    /// Compares nothing before this display frame, so that texels and bits have settled
    #[arg(long, value_name = "FRAME", default_value_t = 0)]
    compare_from: u64,
    /// Milliseconds that stages take; measured encodes of 2048x2048 texels take 13 to 65
    #[arg(long, default_value = "server=12,encode=8,decode=6")]
    stage_ms: StageMs,
    /// Also follows animated vertices at every display frame and writes motion.json
    #[arg(long)]
    measure_motion: bool,
    #[command(flatten)]
    quality: QualityArgs,
    /// Atlas width and height in texels, powers of two from 512x512 to 4096x2048
    #[arg(long, value_name = "WxH", default_value_t = AtlasExtent::DEFAULT)]
    atlas: AtlasExtent,
    /// Pixels of the client's display that a level of detail may err by, twice as many where bits or time are short, half as many where they are
    /// to spare; 0: everything has full detail
    #[arg(long, value_name = "PIXELS", default_value_t = DEFAULT_DETAIL_PIXELS, value_parser = number(0.0..=64.0f32, "pixels"))]
    detail: f32,
    /// At which of its predicted times an update looks at the scene
    #[arg(long, value_enum, default_value = "every")]
    views: ViewPlan,
    /// Part of the client's slots and of the atlas for what an abrupt turn of the head would show, 0 to 0.5; 0: none
    #[arg(long, value_name = "SHARE", default_value_t = DEFAULT_SURROUND, value_parser = number(0.0..=0.5f32, "of all"))]
    surround: f32,
    /// Texels that an update may shade again beside those of new blocks [default: all]
    #[arg(long, value_name = "TEXELS")]
    shade_texels: Option<u64>,
    /// All blocks are shaded with each update, whether anything about them has changed or not
    #[arg(long)]
    no_reuse: bool,
    /// What the client offers to keep and to draw: patches=N,vertices=N,triangles=N [default: as much as any may]
    #[arg(long, value_parser = parse_room, default_value = "patches=131072", hide_default_value = true)]
    room: Room,
    /// How the client finds colours between the atlas's texels
    #[arg(long, value_enum, default_value = "bilinear")]
    reconstruction: ReconstructionArgument,
    /// How clips become keys: error-bounded[:0.1mm], or the paper's constant[:100ms]
    #[arg(long, default_value_t)]
    sampling: Sampling,
    /// How vertices are skinned
    #[arg(long, value_enum, default_value_t)]
    skinning: Skinning,
    /// How clients are told of motion
    #[arg(long, value_enum, default_value_t)]
    motion: MotionOption,
    /// Vulkan validation layers on
    #[arg(long)]
    validation: bool,
    /// Part of the wanted Vulkan device's name
    #[arg(long)]
    device: Option<String>,
}

#[derive(Args)]
struct MotionArgs {
    /// dragon, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    scene: String,
    /// The clip that animated instances play [default: the scene's own choice]
    #[arg(long)]
    clip: Option<String>,
    /// Ways in which vertices move, with commas between them [default: all]
    #[arg(long, value_delimiter = ',')]
    kinds: Vec<Kind>,
    /// A network, as of run, with outage=3s and updates=2 (a second) beside; may be given more than once [default: six]
    #[arg(long)]
    link: Vec<Condition>,
    /// Virtual seconds of each run; an outage begins after 2
    #[arg(long, default_value_t = 6.0, value_parser = number(0.01..=MOST_S, "seconds"))]
    seconds: f64,
    /// Pixels per eye
    #[arg(long, value_parser = size, default_value = "128x128")]
    size: [u32; 2],
    /// Atlas width and height in texels, powers of two from 512x512 to 4096x2048
    #[arg(long, value_name = "WxH", default_value_t = AtlasExtent::DEFAULT)]
    atlas: AtlasExtent,
    /// Seed of links and connections
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Writes the table to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
    /// Vulkan validation layers on
    #[arg(long)]
    validation: bool,
    /// Part of the server's device's name
    #[arg(long)]
    device: Option<String>,
}

#[derive(Args)]
struct CausesArgs {
    /// dragon, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    scene: String,
    /// The causes, with commas between them [default: all]
    #[arg(long, value_enum, value_delimiter = ',')]
    cause: Vec<Cause>,
    /// How the client finds colours between the atlas's texels in the run as it ships
    #[arg(long, value_enum, default_value = "bilinear")]
    reconstruction: ReconstructionArgument,
    /// The network of the run as it ships, as of run
    #[arg(long, default_value = USUAL_LINK)]
    link: String,
    /// Virtual seconds of each run, the first of which is not compared
    #[arg(long, default_value_t = causes::SECONDS, value_parser = number(1.2..=MOST_S, "seconds"))]
    seconds: f64,
    /// Pixels per eye
    #[arg(long, value_parser = size, default_value = "256x256")]
    size: [u32; 2],
    /// Writes the table to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
    /// Vulkan validation layers on
    #[arg(long)]
    validation: bool,
    /// Part of the wanted Vulkan device's name
    #[arg(long)]
    device: Option<String>,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum ReconstructionArgument {
    /// On a line between the nearest
    Bilinear,
    /// Brightness by a cubic
    Bicubic,
}

impl From<ReconstructionArgument> for Reconstruction {
    fn from(argument: ReconstructionArgument) -> Self {
        match argument {
            ReconstructionArgument::Bilinear => Self::Bilinear,
            ReconstructionArgument::Bicubic => Self::Bicubic,
        }
    }
}

#[derive(Args)]
struct SkinningArgs {
    /// dragon, dragons:N, a .glb/.gltf file, or a scene .toml
    #[arg(default_value = "dragons:9")]
    scene: String,
    /// How clips become keys: error-bounded[:0.1mm], or the paper's constant[:100ms]
    #[arg(long, default_value_t)]
    sampling: Sampling,
    /// Writes the figures to this JSON file
    #[arg(long)]
    out: Option<PathBuf>,
}

#[derive(Args)]
struct Table1Args {
    /// Numbers of dragons, with commas between them [default: the paper's]
    #[arg(long, value_delimiter = ',', value_parser = value_parser!(u32).range(1..=i64::from(MAX_DRAGONS)))]
    dragons: Vec<u32>,
    /// Rounds, in each of which everything is measured once
    #[arg(long, default_value_t = table1::ROUNDS, value_parser = value_parser!(u32).range(1..))]
    rounds: u32,
    /// Updates that are measured in each round
    #[arg(long, default_value_t = 5, value_parser = value_parser!(u32).range(1..))]
    updates: u32,
    /// Part of the paper's 1300x1300 pixels a side [default: 1; 0.125 on a CPU]
    #[arg(long, value_parser = number(0.02..=1.0, "of the paper's sizes"))]
    scale: Option<f64>,
    /// Also by the paper's ways: skinning by chains, three predictions of 48 bytes a vertex with each update, on lines between
    #[arg(long)]
    as_paper: bool,
    /// Folder for table1.json, .csv, .svg and table1-cost.svg; a run that was broken off goes on there
    #[arg(long, default_value = "out/table1")]
    out: PathBuf,
    /// Vulkan validation layers on
    #[arg(long)]
    validation: bool,
    /// Part of the server's device's name
    #[arg(long)]
    device: Option<String>,
}

#[derive(Args)]
struct RenderThreadArgs {
    /// Dragons, all in view
    #[arg(long, default_value_t = render_thread::DRAGONS, value_parser = value_parser!(u32).range(1..=i64::from(MAX_DRAGONS)))]
    dragons: u32,
    /// Part of the paper's 1300x1300 pixels a side for which the server chooses levels of detail
    #[arg(long, default_value_t = 1.0, value_parser = number(0.02..=1.0, "of the paper's sizes"))]
    scale: f64,
    /// Seconds that are streamed
    #[arg(long, default_value_t = render_thread::SECONDS, value_parser = number(1.0..=60.0, "seconds"))]
    seconds: f64,
    /// Folder for render-thread.json and the trace
    #[arg(long, default_value = "out/render-thread")]
    out: PathBuf,
}

#[derive(Args)]
struct DemoArgs {
    /// dragon, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml [default: dragons:3; one dragon on a CPU]
    scene: Option<String>,
    /// Server and a window, to look around in until it is closed; needs a desktop, and no simulator
    #[arg(long, conflicts_with_all = ["refresh", "virtual_seconds"])]
    window: bool,
    /// Folder for pictures and stats.json
    #[arg(long, default_value = "out/demo")]
    out: PathBuf,
    /// Pixels per eye [default: 1024x1024, of a window 1280x800; 256x256 and 480x300 on a CPU]
    #[arg(long, value_parser = size)]
    size: Option<[u32; 2]>,
    /// Display frames per second in real time [default: 72; 15 on a CPU]
    #[arg(long, value_parser = number(5.0..=240.0, "frames a second"))]
    refresh: Option<f64>,
    /// Seconds of streaming in real time [default: 6; of a window: until it is closed]
    #[arg(long, value_parser = number(0.5..=3600.0, "seconds"))]
    seconds: Option<f64>,
    /// Seconds of virtual time
    #[arg(long, default_value_t = 2.5, value_parser = number(0.5..=3600.0, "seconds"))]
    virtual_seconds: f64,
    /// Vulkan validation layers on
    #[arg(long)]
    validation: bool,
}

#[derive(Args)]
struct HostileArgs {
    /// Which attack; may be given more than once
    #[arg(long, default_value = "all")]
    attack: Vec<String>,
    /// Seconds that each lasts
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// What is served: dragon, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml [default: one turning cube]
    #[arg(long)]
    scene: Option<String>,
    /// Writes the figures to this JSON file
    #[arg(long)]
    json: Option<PathBuf>,
}

/// Colour escapes are for terminals: not for files, and not for who sets NO_COLOR.
fn wants_colour() -> bool {
    let is_refused = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
    std::io::stderr().is_terminal() && !is_refused
}

fn main() {
    use tracing_subscriber::layer::SubscriberExt;
    use tracing_subscriber::util::SubscriberInitExt;
    let filter = tracing_subscriber::filter::Targets::new().with_default(tracing::Level::WARN);
    let layer = tracing_subscriber::fmt::layer().with_ansi(wants_colour()).with_writer(std::io::stderr);
    tracing_subscriber::registry().with(layer).with(filter).init();
    let result = match Cli::parse().command {
        Command::Run(args) => run_one(args),
        Command::Motion(args) => measure_motion(args),
        Command::Causes(args) => measure_causes(args),
        Command::Table1(args) => measure_table1(args),
        Command::RenderThread(args) => measure_render_thread(&args),
        #[cfg(feature = "libavcodec")]
        Command::Encoders { out } => measure_encoders(&out),
        Command::Demo(args) => run_demo(args),
        Command::Long { out, only: Some(only) } => long::run_all(&out, &only),
        Command::Long { out, only: None } => long::run_all(&out, "").and_then(|()| check_bars(&out, None)),
        Command::Bars { out, bars } => check_bars(&out, bars.as_deref()),
        Command::Figures { root } => figures::write(&root),
        Command::Robot { out } => {
            std::fs::write(&out, robot()).with_context(|| format!("writing {}", out.display()))
        }
        Command::Room { out } => write_room(&out, MANY_VASES)
            .map(|_| ())
            .with_context(|| format!("writing into {}", out.display())),
        Command::Walls { out } => {
            write_walls(&out, TEXELS).map(|_| ()).with_context(|| format!("writing into {}", out.display()))
        }
        Command::Skinning(args) => measure_skinning(&args),
        Command::Still(args) => measure_still(args),
        Command::Hostile(args) => attack(args),
        Command::Neighbours { seconds, json } => neighbours(seconds, json.as_deref()),
        Command::RecordTraffic { out } => hostile::traffic::record(&out),
        Command::MergeTraces { traces, out } => merge_traces(&traces, &out),
        Command::Detail(args) => measure_detail(args),
        Command::Abrupt(args) => measure_abrupt(args),
        Command::Steady(args) => measure_steadiness(args),
        Command::Device => name_device(),
    };
    if let Err(error) = result {
        eprintln!("error: {}", with_causes(error.as_ref()));
        std::process::exit(1);
    }
}

fn measure_abrupt(args: RunArgs) -> anyhow::Result<()> {
    let report = abrupt::measure(&run_options(args)?)?;
    println!("{report}");
    Ok(())
}

fn measure_steadiness(args: RunArgs) -> anyhow::Result<()> {
    let out = args.out.clone();
    let report = steadiness::measure(&run_options(args)?)?;
    print!("{report}");
    let path = out.join("steadiness.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&report)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

fn measure_still(args: RunArgs) -> anyhow::Result<()> {
    let path = args.out.join("still.json");
    let found = still::measure(&run_options(args)?)?;
    println!("{found}");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&found)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

fn measure_detail(args: RunArgs) -> anyhow::Result<()> {
    let out = args.out.clone();
    let report = detail::measure(&run_options(args)?)?;
    print!("{report}");
    let path = out.join("detail.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&report)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

fn run_one(args: RunArgs) -> anyhow::Result<()> {
    let viewers = args.viewer.clone();
    let options = run_options(args)?;
    if viewers.is_empty() {
        say(&run(&options)?);
        return Ok(());
    }
    anyhow::ensure!(options.renderer == Renderer::Stream, "several viewers need --renderer stream");
    for (report, number) in run_each(&options, &viewers)?.iter().zip(1..) {
        println!("viewer {number}");
        say(report);
    }
    Ok(())
}

fn run_options(args: RunArgs) -> anyhow::Result<RunOptions> {
    Ok(RunOptions {
        renderer: args.renderer,
        clip: args.clip,
        link: args.link.parse()?,
        head: match (args.head, args.head_path) {
            (Some(file), _) => Head::File(file),
            (None, Some(name)) => Head::Named(name),
            (None, None) => Head::Walk,
        },
        seconds: args.seconds,
        extent_pixels: args.size,
        fov_degrees: args.fov,
        rate_hz: args.rate,
        trace: args.trace,
        detail_pixels: args.detail,
        spared: Spared {
            ideal: Ideal { views: args.views, reuse: !args.no_reuse, ..Ideal::default() },
            ..Spared::default()
        },
        surround: args.surround,
        shade_texels: args.shade_texels,
        room: args.room,
        seed: args.seed,
        dump_every: args.dump_every,
        compare_every: args.compare_every,
        compare_from: args.compare_from,
        stages: args.stage_ms,
        validation: args.validation,
        device: args.device,
        quality: args.quality.options(),
        reconstruction: args.reconstruction.into(),
        atlas_extent_texels: args.atlas,
        scene_options: SceneOptions {
            sampling: args.sampling,
            skinning: args.skinning,
            motion: args.motion,
            ..SceneOptions::default()
        },
        motion: args.measure_motion,
        verbose: true,
        ..RunOptions::new(args.scene.parse()?, args.out)
    })
}

fn say(report: &Report) {
    println!("{}", report.stats);
    if let Some(motion) = &report.motion {
        println!("{motion}");
    }
}

/// Prints every figure beside its bar.
fn check_bars(results: &Path, bars: Option<&Path>) -> anyhow::Result<()> {
    let text = match bars {
        Some(path) => std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?,
        None => BARS.to_owned(),
    };
    let report = Bars::parse(&text)?.check(results);
    println!("{report}");
    anyhow::ensure!(report.failures() == 0, "{} bars are missed", report.failures());
    Ok(())
}

/// Puts traces into one, and says how busy each row was, and the device beside the encoder.
fn merge_traces(traces: &[PathBuf], out: &Path) -> anyhow::Result<()> {
    shadecast_trace::merge(traces, out)?;
    let shares = shadecast_trace::Shares::read(out)?;
    println!("{} ms", (shares.took_us * 1e-3).round());
    for (row, share) in shares.rows() {
        println!("{row:<16} at work {:5.1} %", share * 100.0);
    }
    let at_once = shares.at_once("server device", "server encoder") * 100.0;
    println!("device and encoder at once {at_once:.1} %");
    Ok(())
}

fn run_demo(args: DemoArgs) -> anyhow::Result<()> {
    let gpu = open_device()?;
    let is_cpu = gpu.is_cpu();
    drop(gpu);
    let scene = args.scene.as_deref().unwrap_or(if is_cpu { "dragon" } else { "dragons:3" }).parse()?;
    if args.window {
        return demo_window(&DemoWindowOptions {
            scene,
            out: args.out,
            extent_pixels: args.size.unwrap_or(if is_cpu { [480, 300] } else { [1280, 800] }),
            seconds: args.seconds,
            validation: args.validation,
        });
    }
    let options = DemoOptions {
        scene,
        out: args.out,
        extent_pixels: args.size.unwrap_or(if is_cpu { [256, 256] } else { [1024, 1024] }),
        seconds: args.seconds.unwrap_or(6.0),
        virtual_seconds: args.virtual_seconds,
        refresh_hz: args.refresh.unwrap_or(if is_cpu { 15.0 } else { 72.0 }),
        validation: args.validation,
    };
    let report = demo(&options)?;
    println!("Real time, two processes on this machine:\n{}", report.real_time);
    println!("Virtual time, as a fast machine shows it:\n{}", report.virtual_time);
    println!(
        "Open {} in a browser; the pictures alone: sheet.png beside it",
        options.out.join("index.html").display()
    );
    Ok(())
}

fn measure_motion(args: MotionArgs) -> anyhow::Result<()> {
    let kinds = if args.kinds.is_empty() { KINDS.to_vec() } else { args.kinds };
    let links = if args.link.is_empty() { Condition::all() } else { args.link };
    let folder = std::env::temp_dir().join(format!("shadecast-motion-{}", std::process::id()));
    let options = RunOptions {
        clip: args.clip,
        seconds: args.seconds,
        extent_pixels: args.size,
        atlas_extent_texels: args.atlas,
        seed: args.seed,
        validation: args.validation,
        device: args.device,
        verbose: true,
        ..RunOptions::new(args.scene.parse()?, folder.clone())
    };
    let found = motion_table::measure(&options, &args.scene, &kinds, &links);
    let _ = std::fs::remove_dir_all(&folder);
    let found = found?;
    println!("{found}");
    args.json.iter().try_for_each(|path| write_json(path, &found))
}

fn measure_causes(args: CausesArgs) -> anyhow::Result<()> {
    let causes = if args.cause.is_empty() { CAUSES.to_vec() } else { args.cause };
    let folder = std::env::temp_dir().join(format!("shadecast-causes-{}", std::process::id()));
    let options = RunOptions {
        link: args.link.parse()?,
        reconstruction: args.reconstruction.into(),
        seconds: args.seconds,
        extent_pixels: args.size,
        validation: args.validation,
        device: args.device,
        verbose: true,
        ..causes::usual(args.scene.parse()?, folder.clone())
    };
    let name = Path::new(&args.scene).file_name().unwrap_or_default().to_string_lossy();
    let found = causes::measure(&options, &name, &causes);
    let _ = std::fs::remove_dir_all(&folder);
    let found = found?;
    println!("{found}");
    args.json.iter().try_for_each(|path| write_json(path, &found))
}

fn write_json(path: &Path, found: &impl Serialize) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(found)? + "\n";
    shadecast_system::write_atomically(path, text.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

fn measure_table1(args: Table1Args) -> anyhow::Result<()> {
    let scale = match args.scale {
        Some(scale) => scale,
        None => table1::usual_scale(args.device.as_deref())?,
    };
    let usual = Table1Options::new(args.out, scale);
    let options = Table1Options {
        dragons: if args.dragons.is_empty() { usual.dragons } else { args.dragons },
        rounds: args.rounds,
        updates: args.updates,
        as_paper: args.as_paper,
        validation: args.validation,
        device: args.device,
        ..usual
    };
    let report = table1::measure(&options, &|line| println!("{line}"))?;
    print!("{report}");
    println!("written to {}", options.out.display());
    Ok(())
}

#[cfg(feature = "libavcodec")]
fn measure_encoders(out: &Path) -> anyhow::Result<()> {
    let found = shadecast_lab::encoders::measure(out)?;
    print!("{found}");
    let path = out.join("encoders.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&found)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

fn measure_render_thread(args: &RenderThreadArgs) -> anyhow::Result<()> {
    let size = table1::cell::Size::at(args.scale)?;
    let found = render_thread::measure(args.dragons, size, args.seconds, &args.out)?;
    print!("{found}");
    let path = args.out.join("render-thread.json");
    shadecast_system::write_atomically(&path, serde_json::to_string_pretty(&found)?.as_bytes())
        .with_context(|| format!("writing {}", path.display()))
}

fn measure_skinning(args: &SkinningArgs) -> anyhow::Result<()> {
    let report = skinning::measure(&args.scene.parse()?, args.sampling)?;
    println!("{report}");
    if let Some(path) = &args.out {
        shadecast_system::write_atomically(path, serde_json::to_string_pretty(&report)?.as_bytes())
            .with_context(|| format!("writing {}", path.display()))?;
    }
    Ok(())
}

fn attack(args: HostileArgs) -> anyhow::Result<()> {
    anyhow::ensure!(
        (0.1..=600.0).contains(&args.seconds),
        "--seconds {} must lie between 0.1 and 600",
        args.seconds
    );
    let options = HostileOptions {
        attacks: args.attack,
        scene: args.scene,
        verbose: true,
        ..HostileOptions::all(args.seconds)
    };
    let report = hostile::run(&options)?;
    if let Some(path) = &args.json {
        std::fs::write(path, serde_json::to_string_pretty(&report)?)
            .with_context(|| format!("writing {}", path.display()))?;
    }
    let misses = report.misses();
    anyhow::ensure!(misses.is_empty(), "{} of the bars were missed", misses.len());
    Ok(())
}

fn neighbours(seconds: f64, json: Option<&Path>) -> anyhow::Result<()> {
    anyhow::ensure!((0.5..=600.0).contains(&seconds), "--seconds {seconds} must lie between 0.5 and 600");
    let report = hostile::neighbours::measure(seconds)?;
    println!("{report}");
    if let Some(path) = json {
        std::fs::write(path, serde_json::to_string_pretty(&report)?)
            .with_context(|| format!("writing {}", path.display()))?;
    }
    Ok(())
}

fn name_device() -> anyhow::Result<()> {
    open_device().map(|_| ())
}

/// Opens the device that would be used, and says which it is.
fn open_device() -> anyhow::Result<Arc<Gpu>> {
    let gpu = Gpu::open(
        &GpuOptions { needs: Needs::Server, validation: false, device_name: None },
        &DesktopDevice,
    )?;
    println!("Vulkan device: {}", gpu.device_name());
    if gpu.is_cpu() {
        println!("warning: this device is a CPU; everything works, slowly");
    }
    Ok(gpu)
}

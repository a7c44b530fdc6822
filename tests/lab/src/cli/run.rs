//! `shadecast-lab run`.

use clap::{Args, value_parser};
use shadecast_client::draw::stages::atlas_draw::Reconstruction;
use shadecast_lab::experiments::run::{self, Report};
use shadecast_lab::experiments::viewers::run_each;
use shadecast_lab::session::options::{
    Head, Renderer, RunOptions, Spared, StageMs, USUAL_LINK, ViewerOptions, parse_room,
};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::flags::{MOST_S, number, size};
use shadecast_scene::animation::sampling::Sampling;
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::pacing::quality::QualityArgs;
use shadecast_server::pacing::room::Room;
use shadecast_server::scene::SceneOptions;
use shadecast_server::scene::motion_library::MotionOption;
use shadecast_server::scene::skins::Skinning;
use shadecast_server::update::policy::UpdatePolicy;
use shadecast_server::visibility::detail::DEFAULT_DETAIL_PIXELS;
use shadecast_server::visibility::view_plan::ViewPlan;
use std::path::PathBuf;

#[derive(Args)]
pub(super) struct RunArgs {
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
    pub(super) out: PathBuf,
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

#[derive(Clone, Copy, clap::ValueEnum)]
pub(super) enum ReconstructionArgument {
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

pub(super) fn run(args: RunArgs) -> anyhow::Result<()> {
    let viewers = args.viewer.clone();
    let options = run_options(args)?;
    if viewers.is_empty() {
        say(&run::run(&options)?);
        return Ok(());
    }
    anyhow::ensure!(options.renderer == Renderer::Stream, "several viewers need --renderer stream");
    for (report, number) in run_each(&options, &viewers)?.iter().zip(1..) {
        println!("viewer {number}");
        say(report);
    }
    Ok(())
}

pub(super) fn run_options(args: RunArgs) -> anyhow::Result<RunOptions> {
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
            ideal: UpdatePolicy { views: args.views, reuse: !args.no_reuse, ..UpdatePolicy::default() },
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

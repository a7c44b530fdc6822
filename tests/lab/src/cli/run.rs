//! `shadecast-lab run`.

use clap::{Args, value_parser};
use shadecast_client::draw::stages::atlas_draw::Reconstruction;
use shadecast_client::options::USUAL_STORE_PAGES;
use shadecast_desktop::flags::{MOST_S, number, size};
use shadecast_lab::experiments::run::{self, Report};
use shadecast_lab::experiments::viewers::run_each;
use shadecast_lab::session::options::{
    COMPARE_EVERY, Head, Renderer, RunOptions, Spared, StageMs, USUAL_LINK, USUAL_VIDEO_MARGIN_DEGREES,
    ViewerOptions, parse_room,
};
use shadecast_protocol::limits::MAX_STORE_PAGES;
use shadecast_server::encode::choice::OPENH264;
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::pacing::room::Room;
use shadecast_server::update::ShowOptions;
use shadecast_server::update::policy::UpdatePolicy;
use shadecast_server::visibility::view_plan::ViewPlan;
use shadecast_server_cli::arguments::{GpuArgs, RenderArgs, SceneArgs, one_of};
use std::path::PathBuf;

impl RunArgs {
    /// The flag, if one is given, that says which renderer and link the run has.
    pub(super) fn one_way_or_link(&self) -> Option<&'static str> {
        let flags = [
            ("--renderer", self.renderer != Renderer::Stream),
            ("--link", self.link != USUAL_LINK),
            ("--viewer", !self.viewer.is_empty()),
            ("--video-margin", self.video_margin != USUAL_VIDEO_MARGIN_DEGREES),
            ("--video-depth", self.video_depth),
        ];
        flags.into_iter().find_map(|(flag, is_given)| is_given.then_some(flag))
    }
}

#[derive(Args)]
pub(super) struct RunArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    pub(super) scene: String,
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
    /// A head path of the scene, by its name; every scene has still, turn, walk, stride, sit, peek and abrupt
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
    #[arg(long, default_value_t = COMPARE_EVERY, value_parser = value_parser!(u32).range(1..))]
    compare_every: u32,
    /// Also compares the frame after each of those, and measures flicker
    #[arg(long)]
    compare_pairs: bool,
    /// Compares nothing before this display frame, so that texels and bits have settled
    #[arg(long, value_name = "FRAME", default_value_t = 0)]
    compare_from: u64,
    /// The truth has the mean of N x N places of each pixel, with textures filtered for a place. 1: one lookup a pixel, as fast
    /// renderers have it; 4: nearly all the light that a pixel covers
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = value_parser!(u32).range(1..=8))]
    truth_places: u32,
    /// H.264 encoder of atlas and video: openh264, or libx264 with the feature libavcodec
    #[arg(long, value_name = "NAME", default_value = OPENH264)]
    encoder: String,
    /// Milliseconds that stages take; measured encodes of 2048x2048 texels take 13 to 65
    #[arg(long, default_value = "server=12,encode=8,decode=6")]
    stage_ms: StageMs,
    /// Also follows animated vertices at every display frame and writes motion.json
    #[arg(long)]
    measure_motion: bool,
    #[command(flatten)]
    render: RenderArgs,
    /// At which of its predicted times an update looks at the scene
    #[arg(long, default_value_t, value_parser = one_of(ViewPlan::ALL, of_views))]
    views: ViewPlan,
    /// Texels that an update may shade again beside those of new blocks [default: all]
    #[arg(long, value_name = "TEXELS")]
    shade_texels: Option<u64>,
    /// All blocks are shaded with each update, whether anything about them has changed or not
    #[arg(long)]
    no_reuse: bool,
    /// Updates are made for where the head was, and for the world as it is when they begin
    #[arg(long)]
    no_prediction: bool,
    /// What the client offers to keep and to draw: patches=N,vertices=N,triangles=N [default: as much as any may]
    #[arg(long, value_parser = parse_room, default_value = "patches=131072", hide_default_value = true)]
    room: Room,
    /// The client shows the newest picture alone, and does not blend from the one before it
    #[arg(long)]
    no_blend: bool,
    /// Of --renderer video: degrees that pictures show beyond each side of an eye's field of view
    #[arg(long, value_name = "DEGREES", default_value_t = USUAL_VIDEO_MARGIN_DEGREES, value_parser = number(0.0_f32..=30.0, "degrees"))]
    video_margin: f32,
    /// Of --renderer video: pictures have depth, by which they are shown to a head that moved
    #[arg(long)]
    video_depth: bool,
    /// Pages that the client offers to keep for blocks that do not change, of 2048x2048 texels; 0: none
    #[arg(long, value_name = "N", default_value_t = USUAL_STORE_PAGES, value_parser = value_parser!(u32).range(0..=i64::from(MAX_STORE_PAGES)))]
    store_pages: u32,
    /// How the client finds colours between the atlas's texels
    #[arg(long, value_enum, default_value = "bilinear")]
    reconstruction: ReconstructionArgument,
    #[command(flatten)]
    scene_options: SceneArgs,
    #[command(flatten)]
    gpu: GpuArgs,
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

fn of_views(plan: ViewPlan) -> (&'static str, &'static str) {
    let about = match plan {
        ViewPlan::Every => "At each of them",
        ViewPlan::Ends => "At the first and the last",
        ViewPlan::TwoInTurn => "At two, in turn",
        ViewPlan::EndsInTurn => "At the first and the last, in turn",
        ViewPlan::OneInTurn => "At one, in turn",
        ViewPlan::WideMiddle => "At the middle, with a wider view",
        ViewPlan::Middle => "At the middle alone",
    };
    (plan.name(), about)
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
    let ShowOptions { detail_pixels, surround } = args.render.show();
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
        quality: args.render.quality(QualityOptions::default()),
        atlas_extent_texels: args.render.atlas,
        trace: args.render.trace,
        detail_pixels,
        spared: Spared {
            policy: UpdatePolicy {
                views: args.views,
                reuse: !args.no_reuse,
                predicts: !args.no_prediction,
                ..UpdatePolicy::default()
            },
            ..Spared::default()
        },
        surround,
        shade_texels: args.shade_texels,
        room: args.room,
        store_pages: args.store_pages,
        blends: !args.no_blend,
        video_margin_degrees: args.video_margin,
        video_has_depth: args.video_depth,
        seed: args.seed,
        dump_every: args.dump_every,
        compare_every: args.compare_every,
        compare_pairs: args.compare_pairs,
        compare_from: args.compare_from,
        truth_places: args.truth_places,
        encoder: args.encoder,
        compare_waiting: false,
        stages: args.stage_ms,
        validation: args.gpu.validation,
        device: args.gpu.device,
        reconstruction: args.reconstruction.into(),
        scene_options: args.scene_options.options(),
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

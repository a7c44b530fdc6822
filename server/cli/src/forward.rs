//! `shadecast-server forward`: the ground truth as PNG files, as a video, or in a window.

use crate::{DeviceArgs, load, loading, open, parse_vector};
use anyhow::Context;
use clap::{Args, value_parser};
use glam::{EulerRot, Quat, Vec3};
use shadecast_desktop::camera::{ViewCamera, fov_of_picture};
use shadecast_desktop::canvas::DEFAULT_EXTENT;
use shadecast_desktop::flags::{MOST_S, number, size};
use shadecast_gpu::{Gpu, vk};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::file::{DEFAULT_FOV_DEG, FOV_RANGE_DEG};
use shadecast_scene::{Camera, Cancel, HeadPath, Scene};
use shadecast_server::encode::picture;
use shadecast_server::pacing::quality::DEFAULT_QP;
use shadecast_server::truth::forward::Forward;
use shadecast_server::truth::video::Video;
use shadecast_server::truth::window::{self, WindowOptions};
use std::path::{Path, PathBuf};

#[derive(Args)]
pub(crate) struct ForwardArgs {
    /// Scene: courtyard, dragons:N, a .glb, .gltf or .fbx file, or a .toml scene
    scene: String,
    /// Folder for forward-NNNNNN.png, a video FILE.y4m or FILE.mp4, or - for Y4M on standard output
    #[arg(long, required_unless_present = "window")]
    out: Option<PathBuf>,
    /// Display the scene in a window. Keys: drag and wheel, WASD and QE to move, Tab to orbit or fly, Space to pause, . and
    /// , to step, 1 to 9 for the scene's cameras, R to reset, F for figures, Esc to quit
    #[arg(long, conflicts_with = "out")]
    window: bool,
    /// Width and height in pixels [default: 1300x1300, window 1280x800]
    #[arg(long, value_parser = size)]
    size: Option<[u32; 2]>,
    /// Vertical field of view in degrees [default: the camera's, else 90]
    #[arg(long, value_parser = number(FOV_RANGE_DEG, "degrees"))]
    fov: Option<f32>,
    /// MSAA samples: 1 or 4
    #[arg(long, default_value_t = 4, value_parser = parse_samples)]
    msaa: u32,
    /// Pictures to render [default: 1, window: until closed]
    #[arg(long, value_parser = value_parser!(u32).range(1..=MAX_FRAMES))]
    frames: Option<u32>,
    /// Pictures per second of scene time
    #[arg(long, default_value_t = 30.0, value_parser = number(0.001..=1000.0, "pictures a second"))]
    fps: f64,
    /// Scene time of the first picture in seconds
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true, value_parser = number(-MOST_S..=MOST_S, "seconds"))]
    start: f64,
    /// Quantiser of an .mp4: 0 (finest) to 51
    #[arg(long, default_value_t = DEFAULT_QP, value_parser = value_parser!(u8).range(0..=51))]
    qp: u8,
    /// Close the window after this many seconds
    #[arg(long, requires = "window", value_parser = number(0.001..=MOST_S, "seconds"))]
    seconds: Option<f64>,
    /// Write the last picture of the window to this PNG file
    #[arg(long, requires = "window")]
    screenshot: Option<PathBuf>,
    /// Start without figures in the window
    #[arg(long, requires = "window")]
    no_figures: bool,
    /// Name of one of the scene's cameras
    #[arg(long, conflicts_with_all = ["position", "yaw", "pitch", "head_path"])]
    camera: Option<String>,
    /// Name of the head path that the camera follows in scene time; every scene has still, turn, walk, stride, sit, peek and abrupt
    #[arg(long, conflicts_with_all = ["position", "yaw", "pitch", "window"])]
    head_path: Option<String>,
    /// Position of the camera in the stage: x,y,z in metres, y up, -z forward
    #[arg(long, value_parser = parse_vector, default_value = "0,1.6,0", allow_hyphen_values = true)]
    position: Vec3,
    /// Turn of the camera to the left in degrees
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true, value_parser = number(-360.0_f32..=360.0, "degrees"))]
    yaw: f32,
    /// Turn of the camera upwards in degrees
    #[arg(long, default_value_t = 0.0, allow_hyphen_values = true, value_parser = number(-360.0_f32..=360.0, "degrees"))]
    pitch: f32,
    #[command(flatten)]
    device: DeviceArgs,
}

/// More than a day of pictures at the highest rate of an MP4.
const MAX_FRAMES: i64 = 10_000_000;
const HEADLESS_EXTENT: [u32; 2] = [1300, 1300];
/// Distance from the camera to the centre of its orbit in an empty scene, metres.
const DEFAULT_ORBIT_M: f32 = 3.0;

fn parse_samples(text: &str) -> Result<u32, String> {
    match text {
        "1" => Ok(1),
        "4" => Ok(4),
        _ => Err(format!("\"{text}\" must be 1 or 4")),
    }
}

/// Runs the command.
pub(crate) fn forward(args: &ForwardArgs, cancel: &Cancel) -> anyhow::Result<()> {
    match &args.out {
        None => in_window(args, cancel),
        Some(out) => to_files(args, out, cancel),
    }
}

fn samples(args: &ForwardArgs) -> vk::SampleCountFlags {
    if args.msaa == 1 { vk::SampleCountFlags::TYPE_1 } else { vk::SampleCountFlags::TYPE_4 }
}

fn in_window(args: &ForwardArgs, cancel: &Cancel) -> anyhow::Result<()> {
    let loading = loading(&args.device, cancel);
    let scene = load(&args.scene, &args.device, &loading)?;
    let viewpoint = Viewpoint::of(args, &scene)?;
    let stage_from_eye = viewpoint.stage_from_eye(args.start);
    let fov_deg = match (args.fov, &viewpoint) {
        (None, Viewpoint::Camera(camera)) => camera.fov_deg,
        (fov, _) => fov.unwrap_or(DEFAULT_FOV_DEG),
    };
    let camera = ViewCamera::new(Vec3::ZERO, 0.0, 0.0, DEFAULT_ORBIT_M, fov_deg);
    let options = WindowOptions {
        title: args.scene.clone(),
        extent: args.size.unwrap_or(DEFAULT_EXTENT),
        samples: samples(args),
        camera: camera.moved_to(stage_from_eye, fov_deg),
        start_s: args.start,
        fps: args.fps,
        frames: args.frames,
        seconds: args.seconds,
        figures: !args.no_figures,
        screenshot: args.screenshot.clone(),
        scene: args.device.scene.options(),
        loading,
        gpu: args.device.gpu.options(),
    };
    let stats = window::run(scene, options)?;
    println!("{} frames in {:.1} s", stats.frames, stats.seconds);
    anyhow::ensure!(
        stats.validation_messages == 0,
        "{} Vulkan validation messages",
        stats.validation_messages
    );
    Ok(cancel.check()?)
}

/// Destination of the pictures.
enum Output<'a> {
    Folder(&'a Path),
    Video(Video),
}

impl Output<'_> {
    fn add(&mut self, frame: u32, extent: [u32; 2], rgb8: &[u8]) -> anyhow::Result<()> {
        match self {
            Self::Folder(out) => {
                Ok(picture::write_png(&out.join(format!("forward-{frame:06}.png")), extent, rgb8)?)
            }
            Self::Video(video) => Ok(video.add(rgb8)?),
        }
    }
}

fn to_files(args: &ForwardArgs, out: &Path, cancel: &Cancel) -> anyhow::Result<()> {
    let (extent, frames) = (args.size.unwrap_or(HEADLESS_EXTENT), args.frames.unwrap_or(1));
    let (gpu, scene, start_up) = open(&args.scene, &args.device, cancel)?;
    let viewpoint = Viewpoint::of(args, &scene.scene)?;
    let mut output = if Video::is_asked_for(out) {
        Output::Video(Video::create(out, extent, args.fps, args.qp)?)
    } else {
        std::fs::create_dir_all(out).with_context(|| format!("making {}", out.display()))?;
        Output::Folder(out)
    };
    let mut renderer = Forward::with_samples(&gpu, &scene, extent, samples(args))?;
    start_up.done("pipelines and buffers");
    let fov = viewpoint.fov(args.fov, extent);
    let mut made = 0;
    for frame in 0..frames {
        if cancel.is_asked() {
            break;
        }
        let time_s = args.start + f64::from(frame) / args.fps;
        let world_from_eye = scene.scene.world_from_stage.then(viewpoint.stage_from_eye(time_s));
        let rgb8 = renderer.picture(world_from_eye, fov, WorldTime((time_s * 1e9) as i64))?;
        output.add(frame, extent, &rgb8)?;
        made += 1;
    }
    finish(output, made)?;
    if made < frames {
        eprintln!("{made} of {frames} pictures in {}", out.display());
        cancel.check()?;
    }
    eprintln!("{frames} pictures in {}", out.display());
    no_messages(&gpu)
}

/// Keeps the pictures made before an interruption. A video without pictures is discarded.
fn finish(output: Output, made: u32) -> anyhow::Result<()> {
    match output {
        Output::Video(video) if made > 0 => Ok(video.finish()?),
        Output::Video(_) | Output::Folder(_) => Ok(()),
    }
}

fn no_messages(gpu: &Gpu) -> anyhow::Result<()> {
    let messages = gpu.validation_messages();
    anyhow::ensure!(messages == 0, "{messages} Vulkan validation messages");
    Ok(())
}

/// Source of the camera's pose.
enum Viewpoint<'a> {
    Still(Pose),
    Camera(&'a Camera),
    HeadPath(&'a HeadPath),
}

impl<'a> Viewpoint<'a> {
    fn of(args: &ForwardArgs, scene: &'a Scene) -> anyhow::Result<Self> {
        if let Some(name) = &args.camera {
            return Ok(Self::Camera(scene.camera(name)?));
        }
        if let Some(name) = &args.head_path {
            return Ok(Self::HeadPath(scene.head_path(name)?));
        }
        let orientation =
            Quat::from_euler(EulerRot::YXZ, args.yaw.to_radians(), args.pitch.to_radians(), 0.0);
        Ok(Self::Still(Pose { position: args.position, orientation }))
    }

    /// Pose at a scene time in seconds.
    fn stage_from_eye(&self, time_s: f64) -> Pose {
        match self {
            Self::Still(stage_from_eye) => *stage_from_eye,
            Self::Camera(camera) => camera.stage_from_eye,
            Self::HeadPath(head_path) => head_path.stage_from_head(time_s),
        }
    }

    /// The requested field of view, else the camera's, else 90 degrees.
    fn fov(&self, asked_deg: Option<f32>, extent: [u32; 2]) -> Fov {
        match (asked_deg, self) {
            (None, Self::Camera(camera)) => fov_of_picture(camera.fov_deg, extent),
            (asked, _) => fov_of_picture(asked.unwrap_or(DEFAULT_FOV_DEG), extent),
        }
    }
}

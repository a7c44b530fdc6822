//! A program that poses a skeleton itself, through the library's public parts, and serves what it makes on loopback:
//!
//!     cargo run --release -p shadecast-server --example live -- 60
//!
//! serves a waving tentacle for 60 seconds, to which any client connects. It says itself where each bone is, again and again,
//! and lets the clip go on now and then.

use anyhow::Context;
use glam::{Affine3A, Quat, Vec3};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::pose::source_pose;
use shadecast_scene::load::around;
use shadecast_scene::process::Loading;
use shadecast_scene::{
    Bone, Clip, Instance, Interpolation, Material, Model, PaletteEntry, Primitive, Scene, Track, TrackValues,
    Trs, Vertex,
};
use shadecast_server::animation::timeline::{SharedTimeline, TimelineError};
use shadecast_server::atlas::surround::DEFAULT_SURROUND;
use shadecast_server::encode::choice::{Encoders, Wanted};
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::serve::sessions::admission::Admit;
use shadecast_server::serve::stream::{Device, StreamOptions, run_timeline};
use shadecast_server::update::ShowOptions;
use shadecast_server::visibility::detail::DEFAULT_DETAIL_PIXELS;
use std::f32::consts::TAU;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// Bones of the tentacle, one above the other.
const BONES: u32 = 8;
/// Height of each, metres.
const BONE_M: f32 = 0.2;
/// Radius at the foot, metres.
const RADIUS_M: f32 = 0.12;
/// Corners of a ring of vertices, and rings for each bone.
const CORNERS: u32 = 12;
const RINGS: u32 = 3;
/// Poses are this far apart, nanoseconds.
const STEP_NS: i64 = 10_000_000;
/// How far ahead of what was sampled poses are given, nanoseconds: two updates of a slow server.
const AHEAD_NS: i64 = 250_000_000;

fn main() -> anyhow::Result<()> {
    let seconds = std::env::args().nth(1).map_or(Ok(60.0), |text| text.parse());
    let seconds: f64 = seconds.context("the argument is how many seconds to serve, such as 60")?;
    let tentacle = tentacle();
    let instance = Instance {
        clip: Some(0),
        live: true, // room is made for whatever its bones do
        placement: Affine3A::from_translation(Vec3::new(0.0, 0.0, -2.5)),
        ..Instance::new("tentacle", 0)
    };
    let scene = around(vec![tentacle.clone()], vec![instance], &Loading::plain())?;
    let timeline = SharedTimeline::new(&scene);
    let device = open(scene)?;
    let options = options(seconds)?;
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let posing = scope.spawn(|| animate(&timeline, &tentacle, &stop));
        let say = |line: &str| println!("{line}");
        let served = run_timeline(device, timeline.clone(), &open, &options, &stop, &say);
        stop.store(true, Ordering::Relaxed);
        posing.join().map_err(|_| anyhow::anyhow!("the thread that poses has failed"))??;
        let stats = served?;
        println!("{} updates, {:.1} a second", stats.updates, stats.server_fps);
        Ok(())
    })
}

fn options(seconds: f64) -> anyhow::Result<StreamOptions> {
    Ok(StreamOptions {
        announced_as: None,
        listen: "127.0.0.1:7400".parse()?,
        identity: None,
        admit: Admit::default(),
        reads_codes: false,
        atlas_extent_texels: "1024x1024".parse().map_err(anyhow::Error::msg)?,
        quality: QualityOptions::default(),
        encoders: Encoders::choose(&Wanted::Auto)?,
        show: ShowOptions { detail_pixels: DEFAULT_DETAIL_PIXELS, surround: DEFAULT_SURROUND },
        shade_ms: None,
        rate_hz: 30.0,
        viewers: 4,
        viewers_steer: true,
        link: None,
        seed: 1,
        seconds,
        trace: None,
        atlas_png: None,
    })
}

fn open(scene: Scene) -> anyhow::Result<Device> {
    let options = GpuOptions { needs: Needs::Server, validation: false, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)?;
    let scene = SceneGpu::new(&gpu, scene, &SceneOptions::default())?;
    Ok(Device { gpu, scene: Arc::new(scene) })
}

/// Poses the tentacle while somebody looks; of every ten seconds, its clip plays for two.
fn animate(timeline: &SharedTimeline, model: &Model, stop: &AtomicBool) -> Result<(), TimelineError> {
    let mut posed = WorldTime(0);
    while !stop.load(Ordering::Relaxed) {
        let mut world = timeline.lock();
        // Nothing is sampled while nobody looks, and nothing need be posed.
        let sampled = world.sampled_until().unwrap_or(posed);
        posed = posed.max(sampled);
        while posed < sampled.plus_ns(AHEAD_NS) {
            posed = posed.plus_ns(STEP_NS);
            match posed.seconds() % 10.0 < 8.0 {
                true => world.set_pose(0, posed, wave(model, posed.seconds()))?,
                false => world.release_pose(0, posed)?,
            };
        }
        drop(world);
        std::thread::sleep(Duration::from_millis(5));
    }
    Ok(())
}

/// Where the bones are at a time: a wave that runs upwards.
fn wave(model: &Model, t_s: f64) -> Vec<Trs> {
    let mut pose = source_pose(model, None, 0.0);
    for (number, bone) in pose.iter_mut().enumerate() {
        let phase = (t_s * 4.0 % f64::from(TAU)) as f32 - number as f32 * 0.7;
        bone.rotation = Quat::from_rotation_x(0.25 * phase.sin()) * Quat::from_rotation_z(0.25 * phase.cos());
    }
    pose
}

/// A cone of bones, each at the end of the one below; its one clip bends it to and fro.
fn tentacle() -> Model {
    let bone = |number: u32| Bone {
        name: format!("bone {number}"),
        parent: number.checked_sub(1),
        rest: Trs { translation: if number == 0 { Vec3::ZERO } else { Vec3::Y * BONE_M }, ..Trs::IDENTITY },
    };
    let entry = |bone: u32| PaletteEntry {
        bone,
        bone_from_mesh: Affine3A::from_translation(-Vec3::Y * BONE_M * bone as f32),
    };
    let rings = BONES * RINGS + 1;
    let around = |ring: u32| (0..CORNERS).map(move |corner| (ring, corner));
    let vertices = (0..rings).flat_map(around).map(|(ring, corner)| vertex(ring, corner));
    let indices: Vec<u32> =
        (0..rings - 1).flat_map(around).flat_map(|(ring, corner)| quad(ring, corner)).collect();
    Model {
        name: "tentacle".into(),
        bones: (0..BONES).map(bone).collect(),
        palette: (0..BONES).map(entry).collect(),
        vertices: vertices.collect(),
        primitives: vec![Primitive { first_index: 0, index_count: indices.len() as u32, material: 0 }],
        indices,
        materials: vec![Material {
            base_color: [0.5, 0.2, 0.35, 1.0],
            roughness: 0.5,
            ..Material::default()
        }],
        clips: vec![bending()],
        ..Model::default()
    }
}

/// A corner of a ring, which follows the bones whose middles it lies between.
fn vertex(ring: u32, corner: u32) -> Vertex {
    let along = ring as f32 / RINGS as f32;
    let angle = corner as f32 / CORNERS as f32 * TAU;
    let outwards = Vec3::new(angle.sin(), 0.0, angle.cos());
    let radius_m = RADIUS_M * (1.05 - along / BONES as f32);
    let lower = (along - 0.5).floor().clamp(0.0, (BONES - 1) as f32);
    let share = (along - 0.5 - lower).clamp(0.0, 1.0);
    let upper = (lower as u16 + 1).min(BONES as u16 - 1);
    Vertex {
        position: outwards * radius_m + Vec3::Y * BONE_M * along,
        normal: outwards,
        tangent: Vec3::Y.cross(outwards).extend(1.0).to_array(),
        uv: [corner as f32 / CORNERS as f32, along],
        joints: [lower as u16, upper, 0, 0],
        weights: [1.0 - share, share, 0.0, 0.0],
        ..Vertex::default()
    }
}

/// The two triangles above a corner of a ring, counter-clockwise seen from outside.
fn quad(ring: u32, corner: u32) -> [u32; 6] {
    let at = |up: u32, on: u32| (ring + up) * CORNERS + (corner + on) % CORNERS;
    [at(0, 0), at(0, 1), at(1, 1), at(0, 0), at(1, 1), at(1, 0)]
}

fn bending() -> Clip {
    let turns = |bone: u32| Track {
        bone,
        times_s: vec![0.0, 1.0, 2.0],
        interpolation: Interpolation::Linear,
        values: TrackValues::Rotation([-0.15, 0.15, -0.15].map(Quat::from_rotation_z).to_vec()),
    };
    Clip {
        name: "bend".into(),
        duration_s: 2.0,
        tracks: (0..BONES).map(turns).collect(),
        morph_tracks: Vec::new(),
    }
}

//! Residues of a server's updates: a head jumps about in a crowded scene, for thousands of updates.

use crate::session::hello;
use crate::session::options::RunOptions;
use anyhow::{Context, anyhow, ensure};
use glam::{Quat, Vec3};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use serde::{Deserialize, Serialize};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::message::{Displayed, HeadState, negotiate};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;
use shadecast_scene::load::load_scene_with;
use shadecast_scene::process::Loading;
use shadecast_server::scene::SceneGpu;
use shadecast_server::serve::stream::offer;
use shadecast_server::update::{ShowOptions, ViewerUpdates};
use shadecast_server::world::{ViewerId, World};
use shadecast_system::process::resident_bytes;
use std::fmt;
use std::sync::Arc;

const UPDATE_NS: i64 = 33_333_333;
/// The head is elsewhere after so many updates.
const JUMP_EVERY_UPDATES: u32 = 5;
/// How far from where the scene puts people, metres.
const REACH_M: f32 = 12.0;

/// What was held early, and at the end.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ChurnReport {
    /// Updates that were made.
    pub updates: u32,
    /// Memory of the device, mapped or not, after a tenth of them, bytes.
    pub device_bytes_before: u64,
    /// The same at the end.
    pub device_bytes_after: u64,
    /// Resident memory of the process after a tenth of them, MB.
    pub rss_before_mb: f64,
    /// The same at the end.
    pub rss_after_mb: f64,
    /// What it has grown by.
    pub grown_mb: f64,
    /// Messages of the validation layers; none where they are off.
    pub validation_messages: Option<u32>,
}

impl fmt::Display for ChurnReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "  churn           {} updates: device {} -> {} bytes, process {:.1} -> {:.1} MB",
            self.updates,
            self.device_bytes_before,
            self.device_bytes_after,
            self.rss_before_mb,
            self.rss_after_mb
        )
    }
}

/// Makes so many updates, ten at least, of the scene of `options`, of its size, with its validation.
///
/// # Errors
/// The scene cannot be loaded, or the device fails.
pub fn measure(options: &RunOptions, updates: u32) -> anyhow::Result<ChurnReport> {
    ensure!(updates >= 10, "{updates} updates say nothing");
    let gpu_options = GpuOptions {
        needs: Needs::Server,
        validation: options.validation,
        device_name: options.device.clone(),
    };
    let gpu = Gpu::open(&gpu_options, &DesktopDevice)?;
    let scene = load_scene_with(&options.scene, &Loading::plain())?;
    let scene = Arc::new(SceneGpu::new(&gpu, scene, &options.scene_options)?);
    let mut world = World::new(&gpu, &scene)?;
    let hello = hello(options, options.extent_pixels);
    let welcome = negotiate(&hello, &offer(&scene, options.atlas_extent_texels, options.rate_hz, 0))
        .map_err(|refused| anyhow!("{}", refused.reason))?;
    let show = ShowOptions { detail_pixels: options.detail_pixels, surround: options.surround };
    let mut viewer = ViewerUpdates::new(&world, ViewerId(0), &welcome, &hello.capabilities, show)?;
    let (mut rng, mut report) =
        (SmallRng::seed_from_u64(options.seed), ChurnReport { updates, ..ChurnReport::default() });
    let mut pose = Pose::IDENTITY;
    for number in 0..updates {
        if number.is_multiple_of(JUMP_EVERY_UPDATES) {
            pose = scene.scene.world_from_stage.then(anywhere(&mut rng));
        }
        let now = ServerTime(i64::from(number) * UPDATE_NS);
        viewer.head(HeadState {
            sequence: number,
            time: now,
            world_from_head: pose,
            linear_velocity: Vec3::ZERO,
            angular_velocity: Vec3::ZERO,
            eyes: hello.capabilities.eyes,
            discontinuity: DiscontinuityId(number / JUMP_EVERY_UPDATES),
        });
        let shaded = viewer.update(&mut world, now)?.context("a head is known")?;
        let delta = viewer.encode(&shaded.delta);
        ensure!(!delta.bytes.is_empty(), "an update says something");
        let display_time = now.plus_ns(UPDATE_NS);
        viewer.displayed(&Displayed { update: shaded.update, display_time, ..Displayed::default() });
        viewer.recycle(shaded);
        if number + 1 == updates / 10 {
            (report.device_bytes_before, report.rss_before_mb) = held(&gpu)?;
        }
    }
    (report.device_bytes_after, report.rss_after_mb) = held(&gpu)?;
    report.grown_mb = report.rss_after_mb - report.rss_before_mb;
    report.validation_messages = gpu.checked_messages();
    Ok(report)
}

/// Somewhere near, looking anywhere.
fn anywhere(rng: &mut SmallRng) -> Pose {
    let mut within = |reach: f32| rng.random_range(-reach..reach);
    let position = Vec3::new(within(REACH_M), 1.6, within(REACH_M));
    Pose { position, orientation: Quat::from_rotation_y(within(std::f32::consts::PI)) }
}

/// Bytes on the device, and MB of the process.
fn held(gpu: &Gpu) -> anyhow::Result<(u64, f64)> {
    let resident =
        resident_bytes(std::process::id()).context("this system does not tell a process's memory")?;
    Ok((gpu.memory().iter().map(|held| held.bytes).sum(), resident as f64 / f64::from(1 << 20)))
}

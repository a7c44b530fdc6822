//! `shadecast-lab still`: the device's cost of the second update of a static scene, beside the first, and beside full shading.

use crate::measure::percentiles::median;
use crate::session::options::RunOptions;
use crate::session::{Server, hello};
use anyhow::{Context, ensure};
use glam::{Quat, Vec3};
use serde::Serialize;
use shadecast_gpu::Timings;
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::message::{HeadState, negotiate};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;
use shadecast_scene::process::Loading;
use shadecast_server::update::policy::UpdatePolicy;
use shadecast_server::update::{ShowOptions, ViewerUpdates};
use shadecast_server::world::{ViewerId, World};
use std::collections::BTreeMap;
use std::fmt;

/// Rounds, each with worlds of its own.
const ROUNDS: usize = 5;

/// What was measured, medians of the rounds, milliseconds of the device.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Still {
    /// The Vulkan device.
    pub device: String,
    /// Rounds.
    pub rounds: usize,
    /// By stage, an update each.
    pub stages: BTreeMap<String, StillMs>,
    /// All stages.
    pub all: StillMs,
    /// The second update over the first, within a round.
    pub second_over_first: f64,
}

/// Milliseconds of a first and a second update.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct StillMs {
    /// The first: everything is new.
    pub first: f64,
    /// The second.
    pub second: f64,
    /// The second where all blocks are shaded again.
    pub second_without_reuse: f64,
}

impl fmt::Display for Still {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}; milliseconds of an update, medians of {} rounds", self.device, self.rounds)?;
        writeln!(f, "  {:<17} {:>9} {:>9} {:>14}", "", "first", "second", "without reuse")?;
        for (stage, StillMs { first, second, second_without_reuse }) in
            self.stages.iter().map(|(stage, ms)| (stage.as_str(), ms)).chain([("all", &self.all)])
        {
            writeln!(f, "  {stage:<17} {first:>9.2} {second:>9.2} {second_without_reuse:>14.2}")?;
        }
        write!(f, "the second takes {:.1} % of the first", 100.0 * self.second_over_first)
    }
}

/// Milliseconds by stage.
type Stages = BTreeMap<&'static str, f64>;

/// Measures `options`'s scene as it stands at its start, whatever moves in it.
///
/// # Errors
/// No device, no scene, or no memory.
pub fn measure(options: &RunOptions) -> anyhow::Result<Still> {
    let lods = options.detail_pixels > 0.0;
    let mut scene =
        shadecast_scene::load::load_scene_with(&options.scene, &Loading { lods, ..Loading::plain() })?;
    scene.instances.iter_mut().for_each(|instance| (instance.clip, instance.path) = (None, None));
    scene.events.clear();
    let server = Server::of_scene(options, scene)?;
    let (mut found, mut ratios): (Vec<[Stages; 3]>, Vec<f64>) = (Vec::new(), Vec::new());
    for _ in 0..ROUNDS {
        let [first, second] = two_updates(&server, options, true)?;
        let [_, without] = two_updates(&server, options, false)?;
        ratios.push(all(&second) / all(&first));
        found.push([first, second, without]);
    }
    ensure!(server.gpu.validation_messages() == 0, "the validation layers have said something");
    let of = |ms: fn(&Stages, &str) -> f64, stage: &str| {
        let middle = |update: usize| median(found.iter().map(|round| ms(&round[update], stage)));
        StillMs { first: middle(0), second: middle(1), second_without_reuse: middle(2) }
    };
    let mut names: Vec<&str> = found.iter().flatten().flat_map(|stages| stages.keys().copied()).collect();
    names.sort_unstable();
    names.dedup();
    let one = |stages: &Stages, stage: &str| stages.get(stage).copied().unwrap_or(0.0);
    Ok(Still {
        device: server.gpu.device_name(),
        rounds: ROUNDS,
        stages: names.into_iter().map(|name| (name.to_owned(), of(one, name))).collect(),
        all: of(|stages, _| all(stages), ""),
        second_over_first: median(ratios.into_iter()),
    })
}

fn all(stages: &Stages) -> f64 {
    stages.values().sum()
}

/// The first two updates of a world of its own, for a head that stands still.
fn two_updates(server: &Server, options: &RunOptions, reuse: bool) -> anyhow::Result<[Stages; 2]> {
    let mut world = World::new(&server.gpu, &server.scene)?;
    let hello = hello(options, options.extent_pixels);
    let terms =
        negotiate(&hello, &server.offer()).map_err(|refused| anyhow::anyhow!("{}", refused.reason))?;
    let show = ShowOptions { detail_pixels: options.detail_pixels, surround: options.surround };
    let policy = UpdatePolicy { reuse, ..UpdatePolicy::default() };
    let mut updates =
        ViewerUpdates::with_policy(&world, ViewerId(1), &terms, &hello.capabilities, show, policy)?;
    let period_ns = (1e9 / options.rate_hz) as i64;
    let mut update = |number: u32| -> anyhow::Result<Stages> {
        let now = ServerTime(i64::from(number) * period_ns);
        let standing = Pose { position: Vec3::new(0.0, 1.6, 0.0), orientation: Quat::IDENTITY };
        updates.head(HeadState {
            sequence: number,
            time: now,
            world_from_head: server.scene.scene.world_from_stage.then(standing),
            linear_velocity: Vec3::ZERO,
            angular_velocity: Vec3::ZERO,
            eyes: hello.capabilities.eyes,
            discontinuity: DiscontinuityId(0),
        });
        let shaded = updates.update(&mut world, now)?.context("a viewer with a head has updates")?;
        Ok(by_stage(&shaded.timings))
    };
    Ok([update(0)?, update(1)?])
}

fn by_stage(timings: &Timings) -> Stages {
    let mut stages = Stages::new();
    timings.iter().for_each(|(stage, ms)| *stages.entry(stage).or_default() += ms);
    stages
}

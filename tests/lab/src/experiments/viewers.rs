//! Several viewers of one world: a run for each as the shipped client, with equally busy viewers beside it; and the cost of a
//! second viewer.

use super::run::{Report, run};
use crate::measure::percentiles::median;
use crate::session::options::{Head, RunOptions, ViewerOptions};
use crate::session::{Server, hello};
use anyhow::{Context, ensure};
use glam::{Quat, Vec3};
use serde::Serialize;
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::message::{HeadState, negotiate};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ServerTime;
use shadecast_server::update::{ShowOptions, ViewerUpdates};
use shadecast_server::world::ViewerId;
use std::time::Instant;

/// Runs `options` once for each viewer; pictures and `stats.json` of the first go to `viewer-1`, and so on.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn run_each(options: &RunOptions, viewers: &[ViewerOptions]) -> anyhow::Result<Vec<Report>> {
    let measure = |index: usize| {
        let mut others = viewers.to_vec();
        let ViewerOptions { link, head } = others.remove(index);
        let out = options.out.join(format!("viewer-{}", index + 1));
        let head = head.map_or(Head::Walk, Head::File);
        run(&RunOptions { link, head, others, out, ..options.clone() })
            .with_context(|| format!("viewer {}", index + 1))
    };
    (0..viewers.len()).map(measure).collect()
}

/// How a viewer's pictures are among others, and alone.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct AmongOthers {
    /// Mean PSNR of all pixels with geometry, dB.
    pub alone_psnr_db: f64,
    /// The same beside the others.
    pub among_psnr_db: f64,
    /// Updates a second alone.
    pub alone_updates_s: f64,
    /// The same beside the others.
    pub among_updates_s: f64,
    /// Largest error of its idea of the server's time beside the others, milliseconds.
    pub clock_error_ms: f64,
}

/// Each of these viewers alone, and beside the others.
///
/// # Errors
/// Anything that keeps a run from going on.
pub fn among_others(options: &RunOptions, viewers: &[ViewerOptions]) -> anyhow::Result<Vec<AmongOthers>> {
    let among = run_each(options, viewers)?;
    let mut found = Vec::new();
    for (viewer, among) in viewers.iter().zip(among) {
        let alone = run_each(options, std::slice::from_ref(viewer))?.remove(0).stats;
        let among = among.stats;
        found.push(AmongOthers {
            alone_psnr_db: alone.psnr_db.context("no picture could be compared")?,
            among_psnr_db: among.psnr_db.context("no picture could be compared")?,
            alone_updates_s: alone.server_fps,
            among_updates_s: among.server_fps,
            clock_error_ms: among.clock_error_ms.unwrap_or(f64::NAN),
        });
    }
    Ok(found)
}

/// What a second viewer costs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SecondViewer {
    /// The Vulkan device.
    pub device: String,
    /// An update of one viewer, from the head to the delta, milliseconds; median.
    pub one_ms: f64,
    /// Updates of two viewers at the same moment, milliseconds; median.
    pub two_ms: f64,
    /// The one divided by the other.
    pub two_over_one: f64,
    /// Rounds, in each of which both were measured.
    pub rounds: usize,
}

/// Updates that are not measured: everything is new in them.
const WARM_UP: u32 = 3;

/// Measures updates of one and of two viewers, in turn; the second stands a step beside the first and looks at the same.
///
/// # Errors
/// No device, or no memory.
pub fn second_viewer(options: &RunOptions, rounds: usize) -> anyhow::Result<SecondViewer> {
    let mut server = Server::new(options)?;
    let hello = hello(options, options.extent_pixels);
    let offer = server.offer();
    let terms = negotiate(&hello, &offer).map_err(|refused| anyhow::anyhow!("{}", refused.reason))?;
    let plain = ShowOptions { detail_pixels: 0.0, surround: 0.0 };
    let updates =
        |number| ViewerUpdates::new(&server.world, ViewerId(number), &terms, &hello.capabilities, plain);
    let mut both = [updates(1)?, updates(2)?];
    let period_ns = (1e9 / options.rate_hz) as i64;
    let (mut one_ms, mut two_ms) = (Vec::new(), Vec::new());
    for update in 0..WARM_UP + 2 * rounds as u32 {
        let now = ServerTime(i64::from(update) * period_ns);
        let counts_both = update < WARM_UP || update.is_multiple_of(2);
        for (updates, x_m) in both.iter_mut().zip([0.0, 0.5]) {
            updates.head(HeadState {
                sequence: update,
                time: now,
                world_from_head: server
                    .scene
                    .scene
                    .world_from_stage
                    .then(Pose { position: Vec3::new(x_m, 1.6, 0.0), orientation: Quat::IDENTITY }),
                linear_velocity: Vec3::ZERO,
                angular_velocity: Vec3::ZERO,
                eyes: hello.capabilities.eyes,
                discontinuity: DiscontinuityId(0),
            });
        }
        let begun = Instant::now();
        let looking = if counts_both { 2 } else { 1 };
        for updates in both.iter_mut().take(looking) {
            ensure!(updates.update(&mut server.world, now)?.is_some(), "a viewer with a head has updates");
        }
        let took_ms = begun.elapsed().as_secs_f64() * 1e3;
        match update {
            ..WARM_UP => {}
            _ if counts_both => two_ms.push(took_ms),
            _ => one_ms.push(took_ms),
        }
    }
    ensure!(server.gpu.validation_messages() == 0, "the validation layers have said something");
    let ratios = one_ms.iter().zip(&two_ms).map(|(one, two)| two / one);
    Ok(SecondViewer {
        device: server.gpu.device_name(),
        two_over_one: median(ratios),
        one_ms: median(one_ms.iter().copied()),
        two_ms: median(two_ms.iter().copied()),
        rounds,
    })
}

//! Tearing of displayed triangles: whether all corners have the positions of one time.

use super::run::mock_config;
use crate::measure::truth::{InstancePose, VertexTruth};
use crate::session::Lab;
use crate::session::options::RunOptions;
use glam::{DVec3, Vec3};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_protocol::time::{DEFAULT_GRID, WorldTime};
use shadecast_server::scene::numbering::SceneVertex;
use std::collections::BTreeSet;

/// What was found.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TearingReport {
    /// Display frames with a bundle.
    pub frames: u64,
    /// Of them those whose vertices stood behind the time of display.
    pub frames_behind: u64,
    /// Triangles looked at, summed over them.
    pub triangles: u64,
    /// How far a drawn vertex was at most from its place at the one time of its frame, metres.
    pub max_error_m: f32,
    /// How far one grid step at the last velocity leads from the curves at most, metres: vertices that have run out of
    /// samples go on for so long.
    pub last_step_error_m: f32,
}

/// Runs `options` in virtual time, and looks at every vertex drawn. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps the run from going on.
pub fn measure(options: &RunOptions) -> anyhow::Result<TearingReport> {
    let config = MockConfig { capture_dir: None, ..mock_config(options, ClockKind::Virtual, 0)? };
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(options, &config) }?;
    let mut report = TearingReport {
        last_step_error_m: last_step_error_m(&lab, options.seconds),
        ..TearingReport::default()
    };
    let mut vertex_of_slot = Vec::new();
    while let Step::Frame(frame) = lab.step()? {
        // Slots that have left the server's list may still be on display: their last vertex counts.
        if let Some(viewer) = &lab.seat().viewer {
            vertex_of_slot.clear();
            vertex_of_slot.extend_from_slice(viewer.updates().residency().vertex_of_slot());
        }
        let (Some(_), Some(time)) = (frame.update, frame.motion_time) else { continue };
        report.frames += 1;
        report.frames_behind += u64::from(frame.motion_time < frame.world_time);
        look(&lab, &vertex_of_slot, time, &mut report)?;
    }
    Ok(report)
}

fn look(
    lab: &Lab,
    vertex_of_slot: &[SceneVertex],
    time: WorldTime,
    report: &mut TearingReport,
) -> anyhow::Result<()> {
    let positions = lab.client.presenter.read_positions()?;
    let triangles = lab.client.presenter.drawn_triangles();
    report.triangles += triangles.len() as u64;
    let slots: BTreeSet<u32> = triangles.into_iter().flatten().collect();
    let mut truth = VertexTruth::at(&lab.server.scene, time);
    for slot in slots.into_iter().map(|slot| slot as usize) {
        let [x, y, z, _] = positions[slot];
        let place = truth.vertex(vertex_of_slot[slot]).position.as_vec3();
        report.max_error_m = report.max_error_m.max(Vec3::new(x, y, z).distance(place));
    }
    Ok(())
}

/// The largest second difference of any vertex's way, in steps of the time grid, over a run of so many seconds of the
/// scene's first instance.
fn last_step_error_m(lab: &Lab, seconds: f64) -> f32 {
    let scene = &lab.server.scene.scene;
    let model = &scene.models[scene.instances[0].model];
    let step_s = DEFAULT_GRID.spacing_ns as f64 * 1e-9;
    let places = |step: u32| -> Vec<DVec3> {
        let pose = InstancePose::at(scene, 0, f64::from(step) * step_s);
        (0..model.vertices.len()).map(|number| pose.vertex(model, number)).collect()
    };
    let steps = ((seconds + 1.0) / step_s).ceil() as u32;
    let (mut before, mut now, mut worst_m) = (places(0), places(1), 0.0f64);
    for step in 2..=steps {
        let next = places(step);
        for ((a, b), c) in before.iter().zip(&now).zip(&next) {
            worst_m = worst_m.max((2.0 * *b - *a).distance(*c));
        }
        (before, now) = (now, next);
    }
    worst_m as f32
}

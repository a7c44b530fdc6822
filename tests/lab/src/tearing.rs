//! Whether triangles on display are whole: all corners where their vertices are at one time.

use crate::options::RunOptions;
use crate::run::{mock_config, prepare_runtime, set_runtime};
use crate::session::{Lab, Server};
use glam::{Affine3A, Vec3};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};
use shadecast_scene::Vertex;
use shadecast_scene::animation::pose;
use std::collections::{BTreeSet, HashMap};

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

/// Runs `options` in virtual time, and looks at every vertex drawn. To be called where [`crate::run::run`] may be.
///
/// # Errors
/// Anything that keeps the run from going on.
pub fn measure(options: &RunOptions) -> anyhow::Result<TearingReport> {
    let config = MockConfig { capture_dir: None, ..mock_config(options, ClockKind::Virtual, 0)? };
    let variables = prepare_runtime(&config, &options.out)?;
    // SAFETY: the caller's promise, as for `run`.
    unsafe { set_runtime(&variables) };
    let server = Server::new(options)?;
    let mut lab = Lab::new(options, server)?;
    lab.connect();
    let mut report = TearingReport {
        last_step_error_m: last_step_error_m(&lab, options.seconds),
        ..TearingReport::default()
    };
    let mut vertex_of_slot = HashMap::new();
    while let Step::Frame(frame) = lab.step()? {
        // Slots that have left the server's list may still be on display: their last vertex counts.
        let sampled = lab.seat().viewer.iter().flat_map(|viewer| viewer.updates().residency().sampled());
        vertex_of_slot.extend(sampled.map(|(slot, vertex)| (slot.0, vertex)));
        let (Some(_), Some(time)) = (frame.frame, frame.motion_time) else { continue };
        report.frames += 1;
        report.frames_behind += u64::from(frame.motion_time < frame.server_time);
        look(&lab, &vertex_of_slot, time, &mut report)?;
    }
    Ok(report)
}

fn look(
    lab: &Lab,
    vertex_of_slot: &HashMap<u32, u32>,
    time: ServerTime,
    report: &mut TearingReport,
) -> anyhow::Result<()> {
    let positions = lab.client.read_positions()?;
    let triangles = lab.client.drawn_triangles();
    report.triangles += triangles.len() as u64;
    let slots: BTreeSet<u32> = triangles.into_iter().flatten().collect();
    let mut palettes = HashMap::new();
    for (slot, vertex) in slots.into_iter().filter_map(|slot| Some((slot, *vertex_of_slot.get(&slot)?))) {
        let [x, y, z, _] = positions[slot as usize];
        let error_m = Vec3::new(x, y, z).distance(place(lab, vertex, time, &mut palettes));
        report.max_error_m = report.max_error_m.max(error_m);
    }
    Ok(())
}

/// The largest second difference of any vertex's way, in steps of the time grid, over a run of so many seconds of the
/// scene's first instance.
fn last_step_error_m(lab: &Lab, seconds: f64) -> f32 {
    let scene = &lab.server.scene.scene;
    let instance = &scene.instances[0];
    let model = &scene.models[instance.model];
    let step_s = DEFAULT_GRID.spacing_ns as f64 * 1e-9;
    let places = |step: u32| -> Vec<Vec3> {
        let time_s = f64::from(step) * step_s;
        let phase_s = instance.clip_phase_s(model.duration_s(instance.clip), time_s);
        let palette = pose::source_palette(model, instance.clip, phase_s);
        let world_from_model = instance.world_from_model(time_s);
        let place = |v: &Vertex| {
            (world_from_model * pose::blend(&palette, v.joints, v.weights)).transform_point3(v.position)
        };
        model.vertices.iter().map(place).collect()
    };
    let steps = ((seconds + 1.0) / step_s).ceil() as u32;
    let (mut before, mut now, mut worst_m) = (places(0), places(1), 0.0f32);
    for step in 2..=steps {
        let next = places(step);
        for ((a, b), c) in before.iter().zip(&now).zip(&next) {
            worst_m = worst_m.max((2.0 * *b - *a).distance(*c));
        }
        (before, now) = (now, next);
    }
    worst_m
}

/// Where the source's curves have a scene-wide vertex at a time.
fn place(lab: &Lab, vertex: u32, time: ServerTime, palettes: &mut HashMap<usize, Vec<Affine3A>>) -> Vec3 {
    let scene = &lab.server.scene;
    let index = scene.instance_of_vertex(vertex);
    let instance = &scene.scene.instances[index];
    let model = &scene.scene.models[instance.model];
    let phase_s = instance.clip_phase_s(model.duration_s(instance.clip), time.seconds());
    let palette =
        palettes.entry(index).or_insert_with(|| pose::source_palette(model, instance.clip, phase_s));
    let v = &model.vertices[(vertex - scene.instances[index].first_vertex) as usize];
    let world_from_vertex =
        instance.world_from_model(time.seconds()) * pose::blend(palette, v.joints, v.weights);
    world_from_vertex.transform_point3(v.position)
}

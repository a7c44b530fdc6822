//! How well the client's animated vertices follow the true animation: positions at every display frame against the
//! source curves at the true time of display.

use crate::session::Lab;
use serde::{Deserialize, Serialize};
use shadecast_protocol::time::ServerTime;
use shadecast_server::animation::pose;
use glam::{Affine3A, Vec3};
use std::collections::HashMap;

/// Every so many vertices one is followed.
const STRIDE: u32 = 7;
/// Vertices that travel less than this (metres, diagonal of the box around their path) say nothing about interpolation.
const MIN_RANGE_M: f32 = 0.25;
/// A slot's new vertex is on its way to the client for a while; until so many display frames have passed, the slot is not
/// looked at.
const SETTLED_FRAMES: u64 = 30;

/// Positions of some vertices over a run.
#[derive(Debug, Default)]
pub struct Motion {
    /// By scene-wide vertex number: display frame, shown and true position.
    paths: HashMap<u32, Vec<(u64, Vec3, Vec3)>>,
    frames: u64,
    /// By slot: the vertex that the server put there, and since which display frame.
    since: HashMap<u32, (u32, u64)>,
}

/// What came of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MotionReport {
    /// Display frames looked at.
    pub frames: u64,
    /// Vertices with enough motion.
    pub vertices: u64,
    /// Share of pairs of successive display frames in which a vertex was at another place.
    pub moved_share: f64,
    /// Largest distance from the true position, in percent of the vertex's own range.
    pub max_error_percent_of_range: f64,
    /// 99th percentile of the same.
    pub p99_error_percent_of_range: f64,
    /// Largest distance, millimetres.
    pub max_error_mm: f64,
}

impl Motion {
    /// Notes where the vertices are that both the client and the server's residency hold.
    ///
    /// # Errors
    /// The client cannot read its memory back.
    pub fn look(&mut self, lab: &Lab, time: ServerTime) -> anyhow::Result<()> {
        let Some(frame) = &lab.server.frame else { return Ok(()) };
        let positions = lab.client.read_positions()?;
        let scene = &lab.server.scene;
        let mut palettes: HashMap<usize, Vec<Affine3A>> = HashMap::new();
        self.frames += 1;
        for (slot, vertex) in frame.residency().sampled().filter(|(_, vertex)| vertex % STRIDE == 0) {
            let (known, since) = self.since.entry(slot.0).or_insert((vertex, self.frames));
            if *known != vertex {
                (*known, *since) = (vertex, self.frames);
            }
            if self.frames - *since < SETTLED_FRAMES {
                continue;
            }
            let Some([x, y, z, state]) = positions.get(slot.index()).copied() else { continue };
            if state == 0.0 {
                continue; // on its way
            }
            let index = scene.instance_of_vertex(vertex);
            let instance = &scene.scene.instances[index];
            let model = &scene.scene.models[instance.model];
            let palette = palettes.entry(index).or_insert_with(|| {
                pose::source_palette(model, instance.clip, instance.clip_time_s(time.seconds()))
            });
            let v = &model.vertices[(vertex - scene.instances[index].first_vertex) as usize];
            let world_from_mesh = instance.world_from_model * pose::blend(palette, v.joints, v.weights);
            let truth = world_from_mesh.transform_point3(v.position);
            self.paths.entry(vertex).or_default().push((self.frames, Vec3::new(x, y, z), truth));
        }
        Ok(())
    }

    /// The figures; `None` where nothing moved enough.
    pub fn report(&self) -> Option<MotionReport> {
        let mut errors = Vec::new();
        let (mut pairs, mut moved, mut vertices, mut max_mm) = (0u64, 0u64, 0u64, 0.0f64);
        for path in self.paths.values() {
            let low = path.iter().fold(Vec3::INFINITY, |low, (_, _, truth)| low.min(*truth));
            let high = path.iter().fold(Vec3::NEG_INFINITY, |high, (_, _, truth)| high.max(*truth));
            let range_m = (high - low).length();
            if range_m < MIN_RANGE_M {
                continue;
            }
            vertices += 1;
            for (_, shown, truth) in path {
                let error_m = f64::from(shown.distance(*truth));
                errors.push(error_m / f64::from(range_m) * 100.0);
                max_mm = max_mm.max(error_m * 1000.0);
            }
            for pair in path.windows(2).filter(|pair| pair[1].0 == pair[0].0 + 1) {
                pairs += 1;
                moved += u64::from(pair[0].1 != pair[1].1);
            }
        }
        errors.sort_by(f64::total_cmp);
        let last = errors.len().checked_sub(1)?;
        Some(MotionReport {
            frames: self.frames,
            vertices,
            moved_share: moved as f64 / pairs.max(1) as f64,
            max_error_percent_of_range: errors[last],
            p99_error_percent_of_range: errors[last * 99 / 100],
            max_error_mm: max_mm,
        })
    }
}

//! How well the client's animated vertices follow the true animation: positions at every display frame against the
//! source curves at the true time of display.

use crate::session::Lab;
use glam::{Affine3A, Vec3};
use serde::{Deserialize, Serialize};
use shadecast_protocol::time::ServerTime;
use shadecast_scene::animation::pose;
use std::collections::HashMap;

/// Every so many vertices one is followed.
const STRIDE: u32 = 7;
/// Vertices that travel less than this (metres, diagonal of the box around their path) say nothing about interpolation.
const MIN_RANGE_M: f32 = 0.25;
/// A slot's new vertex is on its way to the client for a while; until so many display frames have passed, the slot is not
/// looked at.
const SETTLED_FRAMES: u64 = 30;

/// Times over a clip at which the range of a vertex's motion is looked at.
const RANGE_TIMES: u32 = 48;

/// Positions of some vertices over a run.
#[derive(Debug, Default)]
pub struct Motion {
    /// By scene-wide vertex number.
    paths: HashMap<u32, Path>,
    frames: u64,
    /// By slot: the vertex that the server put there, since which display frame, and until which.
    tenants: HashMap<u32, Tenant>,
    /// By instance: palettes spread over its clip.
    clips: HashMap<usize, Vec<Vec<Affine3A>>>,
}

#[derive(Clone, Copy, Debug)]
struct Tenant {
    vertex: u32,
    since: u64,
    until: u64,
}

#[derive(Debug)]
struct Path {
    /// Diagonal of the box around the vertex's way through the whole clip, metres.
    range_m: f32,
    /// Display frame, shown and true position.
    places: Vec<(u64, Vec3, Vec3)>,
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
            if !self.has_settled(slot.0, vertex) {
                continue;
            }
            let Some([x, y, z, state]) = positions.get(slot.index()).copied() else { continue };
            if state == 0.0 {
                continue; // on its way
            }
            let index = scene.instance_of_vertex(vertex);
            let instance = &scene.scene.instances[index];
            let model = &scene.scene.models[instance.model];
            let duration_s = model.duration_s(instance.clip);
            let at = |phase_s: f64| pose::source_palette(model, instance.clip, phase_s);
            let now_s = instance.clip_phase_s(duration_s, time.seconds());
            let palette = palettes.entry(index).or_insert_with(|| at(now_s));
            let v = &model.vertices[(vertex - scene.instances[index].first_vertex) as usize];
            let place = |palette: &[Affine3A]| {
                (instance.world_from_model(time.seconds()) * pose::blend(palette, v.joints, v.weights))
                    .transform_point3(v.position)
            };
            let truth = place(palette);
            let path = self.paths.entry(vertex).or_insert_with(|| {
                let moment = |i: u32| f64::from(duration_s) * f64::from(i) / f64::from(RANGE_TIMES);
                let clip = self.clips.entry(index);
                let clip = clip.or_insert_with(|| (0..RANGE_TIMES).map(|i| at(moment(i))).collect());
                Path { range_m: range_m(clip.iter().map(|palette| place(palette))), places: Vec::new() }
            });
            path.places.push((self.frames, Vec3::new(x, y, z), truth));
        }
        Ok(())
    }

    /// Whether the vertex has been in the slot for so long that the client has it too.
    fn has_settled(&mut self, slot: u32, vertex: u32) -> bool {
        let frames = self.frames;
        let fresh = Tenant { vertex, since: frames, until: frames };
        let tenant = self.tenants.entry(slot).or_insert(fresh);
        if tenant.vertex != vertex || tenant.until + 1 < frames {
            *tenant = fresh;
        }
        tenant.until = frames;
        frames - tenant.since >= SETTLED_FRAMES
    }

    /// The figures; `None` where nothing moved enough.
    pub fn report(&self) -> Option<MotionReport> {
        let mut errors = Vec::new();
        let (mut pairs, mut moved, mut vertices, mut max_mm) = (0u64, 0u64, 0u64, 0.0f64);
        for path in self.paths.values() {
            if path.range_m < MIN_RANGE_M {
                continue;
            }
            vertices += 1;
            for (_, shown, truth) in &path.places {
                let error_m = f64::from(shown.distance(*truth));
                errors.push(error_m / f64::from(path.range_m) * 100.0);
                max_mm = max_mm.max(error_m * 1000.0);
            }
            for pair in path.places.windows(2).filter(|pair| pair[1].0 == pair[0].0 + 1) {
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

fn range_m(places: impl Iterator<Item = Vec3>) -> f32 {
    let (low, high) =
        places.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
    (high - low).length()
}

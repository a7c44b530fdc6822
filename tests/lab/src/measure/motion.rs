//! Accuracy of the client's animated vertices: the client's memory at every display frame, read back, against the source curves
//! at the true display time.
//!
//! Every vertex counts from its first drawn frame on, so quantisation, clock and link are in the figures.

use super::percentiles::Percentiles;
use super::truth::{InstancePose, TrueVertex, VertexTruth};
use crate::session::Lab;
use glam::{DVec3, Vec3};
use serde::{Deserialize, Serialize};
use shadecast_client::client::FrameReport;
use shadecast_protocol::time::WorldTime;
use shadecast_scene::Scene;
use shadecast_server::scene::SceneGpu;
use shadecast_server::scene::numbering::SceneVertex;
use std::collections::HashMap;
use std::fmt;

/// A share of a vertex's range says something of it only where the vertex travels at least this, metres: the diagonal of
/// the box around its way. Millimetres and pixels count for all.
const MIN_RANGE_M: f32 = 0.25;
/// Times at which the range of a vertex's motion is looked at.
const RANGE_TIMES: u32 = 48;
/// Pixels of the paper's picture, 1300 over 90 degrees, at a distance of as many metres as the error is long.
const PIXELS_PER_UNIT: f64 = 1300.0 / 2.0;
/// Distance at which millimetres become the pixels of the bar.
const BAR_DISTANCE_M: f64 = 2.0;
/// Nobody looks at anything nearer.
const LEAST_DISTANCE_M: f64 = 0.05;

/// Pixels of the paper's picture that a way across the view takes at 2 m.
pub(crate) fn px_at_2m(way_mm: f64) -> f64 {
    way_mm * 1e-3 / BAR_DISTANCE_M * PIXELS_PER_UNIT
}

/// What was seen over a run.
#[derive(Debug, Default)]
pub struct Motion {
    frames: u64,
    /// By scene-wide vertex number: the display frame in which it was drawn last, and where.
    last: HashMap<SceneVertex, (u64, Vec3)>,
    /// By instance and vertex of its model: diagonal of the box around its way, metres.
    ranges: HashMap<usize, Vec<f32>>,
    ranged_vertices: u64,
    pairs: u64,
    moved: u64,
    errors_mm: Percentiles,
    errors_px: Percentiles,
    errors_percent: Percentiles,
}

/// What came of it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MotionReport {
    /// Display frames looked at.
    pub frames: u64,
    /// Vertices that were drawn in any of them.
    pub vertices: u64,
    /// Largest distance from the true position, millimetres.
    pub max_error_mm: f64,
    /// 99 of 100 are no larger; likewise below.
    pub p99_error_mm: f64,
    /// The same in pixels of a picture of 1300 over 90 degrees, at the vertex's true distance from the nearer eye.
    pub max_error_px: f64,
    /// The same.
    pub p99_error_px: f64,
    /// The largest distance in such pixels, as if it were seen from 2 m.
    pub max_error_px_at_2m: f64,
    /// Of those vertices, the ones that travel at least 0.25 m.
    pub ranged_vertices: u64,
    /// Their largest distance, in percent of each one's own range; none where none travels so far.
    pub max_error_percent_of_range: Option<f64>,
    /// The same.
    pub p99_error_percent_of_range: Option<f64>,
    /// Share of pairs of successive display frames in which such a vertex was at another place.
    pub moved_share: Option<f64>,
}

impl Motion {
    /// Compares the vertices that a display frame has just drawn; `time` is the true time of its display.
    ///
    /// # Errors
    /// The client cannot read its memory back.
    pub fn look(&mut self, lab: &mut Lab, shown: &FrameReport, time: WorldTime) -> anyhow::Result<()> {
        let (Some(frame), Some(head)) = (shown.update, lab.client.presenter.head_state()) else {
            return Ok(());
        };
        let positions = lab.client.presenter.read_positions()?;
        let Some(residents) = lab.seat_mut().residents.at(frame).map(<[_]>::to_vec) else { return Ok(()) };
        let scene = &lab.server.scene;
        let eyes = head.eyes.map(|eye| head.world_from_head.then(eye.head_from_eye).position.as_dvec3());
        let mut truth = VertexTruth::at(scene, time);
        self.frames += 1;
        for (slot, vertex) in &residents {
            let Some([x, y, z, state]) = positions.get(*slot as usize).copied() else { continue };
            if state == 0.0 {
                continue; // not drawn: its samples are still on their way
            }
            let TrueVertex { instance, number, position } = truth.vertex(*vertex);
            let range_m = self.range_m(scene, instance, number);
            self.add(*vertex, Vec3::new(x, y, z), position, range_m, eyes);
        }
        Ok(())
    }

    fn add(&mut self, vertex: SceneVertex, shown: Vec3, truth: DVec3, range_m: f32, eyes: [DVec3; 2]) {
        let error_m = shown.as_dvec3().distance(truth);
        let nearer_m = eyes.map(|eye| eye.distance(truth)).into_iter().fold(f64::INFINITY, f64::min);
        self.errors_mm.add(error_m * 1e3);
        self.errors_px.add(error_m / nearer_m.max(LEAST_DISTANCE_M) * PIXELS_PER_UNIT);
        let before = self.last.insert(vertex, (self.frames, shown));
        if range_m < MIN_RANGE_M {
            return;
        }
        self.errors_percent.add(error_m / f64::from(range_m) * 100.0);
        self.ranged_vertices += u64::from(before.is_none());
        if let Some((_, place)) = before.filter(|(frame, _)| frame + 1 == self.frames) {
            self.pairs += 1;
            self.moved += u64::from(place != shown);
        }
    }

    fn range_m(&mut self, scene: &SceneGpu, index: usize, number: usize) -> f32 {
        self.ranges.entry(index).or_insert_with(|| ranges_m(&scene.scene, index))[number]
    }

    /// The figures; `None` where no animated vertex was drawn.
    pub fn report(&self) -> Option<MotionReport> {
        let max_error_mm = self.errors_mm.largest()?;
        Some(MotionReport {
            frames: self.frames,
            vertices: self.last.len() as u64,
            max_error_mm,
            p99_error_mm: self.errors_mm.at(99.0)?,
            max_error_px: self.errors_px.largest()?,
            p99_error_px: self.errors_px.at(99.0)?,
            max_error_px_at_2m: px_at_2m(max_error_mm),
            ranged_vertices: self.ranged_vertices,
            max_error_percent_of_range: self.errors_percent.largest(),
            p99_error_percent_of_range: self.errors_percent.at(99.0),
            moved_share: (self.pairs > 0).then(|| self.moved as f64 / self.pairs as f64),
        })
    }
}

impl fmt::Display for MotionReport {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { max_error_mm, p99_error_mm, max_error_px, p99_error_px, .. } = self;
        write!(
            out,
            "  motion          {max_error_mm:.2} mm at worst ({p99_error_mm:.2} mm in 99 of 100 cases), "
        )?;
        write!(out, "{max_error_px:.2} pixels ({p99_error_px:.2}); {} vertices", self.vertices)?;
        let (Some(max), Some(p99), Some(moved)) =
            (self.max_error_percent_of_range, self.p99_error_percent_of_range, self.moved_share)
        else {
            return Ok(());
        };
        let moved = moved * 100.0;
        write!(out, "; {max:.3} % of range ({p99:.3} %), moved in {moved:.1} % of frames")
    }
}

/// How far each vertex of an instance travels over its clip and its path, whichever is longer.
fn ranges_m(scene: &Scene, index: usize) -> Vec<f32> {
    let instance = &scene.instances[index];
    let model = &scene.models[instance.model];
    let once_s = |duration_s: f32, speed: f32| f64::from(duration_s / speed.abs().max(1e-3));
    let of_path = instance.path.as_ref().map_or(0.0, |path| once_s(path.clip.duration_s, path.speed));
    let period_s = once_s(model.duration_s(instance.clip), instance.speed).max(of_path);
    let own = scene.events.iter().filter(|event| event.instance == index);
    let period_s =
        own.map(|event| event.at.plus_ns(event.change.fade_ns).seconds()).fold(0.0, f64::max) + period_s;
    let mut boxes = vec![(DVec3::INFINITY, DVec3::NEG_INFINITY); model.vertices.len()];
    for moment in 0..RANGE_TIMES {
        let pose = InstancePose::at(scene, index, period_s * f64::from(moment) / f64::from(RANGE_TIMES));
        for (number, (low, high)) in boxes.iter_mut().enumerate() {
            let at = pose.vertex(model, number);
            (*low, *high) = (low.min(at), high.max(at));
        }
    }
    boxes.into_iter().map(|(low, high)| (high - low).length() as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::load::{SceneSource, load_scene};

    #[test]
    fn motion_errors_have_millimetres_pixels_and_percent() {
        let mut motion = Motion::default();
        assert_eq!(motion.report(), None);
        let eyes = [DVec3::ZERO, DVec3::new(0.0, 0.0, 4.0)];
        motion.frames = 1;
        motion.add(SceneVertex(7), Vec3::new(0.0, 0.001, -2.0), DVec3::new(0.0, 0.0, -2.0), 0.5, eyes);
        motion.add(SceneVertex(8), Vec3::new(0.0, 0.0, -1.0), DVec3::new(0.0, 0.0005, -1.0), 0.01, eyes);
        motion.frames = 2;
        motion.add(SceneVertex(7), Vec3::new(0.0, 0.001, -2.0), DVec3::new(0.0, 0.0, -2.0), 0.5, eyes);
        let report = motion.report().expect("vertices");
        let close =
            |found: f64, wanted: f64| assert!((found - wanted).abs() < 1e-4 * wanted, "{found} {wanted}");
        close(report.max_error_mm, 1.0);
        close(report.max_error_px, 0.001 / 2.0 * 650.0);
        close(report.max_error_px_at_2m, 0.325);
        close(report.max_error_percent_of_range.expect("one travels"), 0.2);
        assert_eq!((report.vertices, report.ranged_vertices, report.frames), (2, 1, 2));
        assert_eq!(report.moved_share, Some(0.0), "it stayed where it was");
    }

    #[test]
    fn wings_travel_and_the_ground_does_not() {
        let scene = load_scene(&SceneSource::Dragons(1)).expect("built in");
        let largest = |index| ranges_m(&scene, index).into_iter().fold(0.0, f32::max);
        assert!((0.5..3.0).contains(&largest(0)), "{}", largest(0));
        assert_eq!(largest(1), 0.0);
    }
}

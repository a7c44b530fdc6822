//! Every vertex of every drawn triangle, in every display frame: its position, read back from the client's memory, against the
//! source curves at the display time as the client estimates it, on the server's clock. The error of that estimate is no error
//! of motion, and is counted apart.

use crate::measure::percentiles::Percentiles;
use crate::measure::truth::{TrueVertex, VertexTruth};
use crate::session::{Lab, SERVER_EPOCH_NS};
use anyhow::Context;
use glam::{DVec3, Vec3};
use serde::Serialize;
use shadecast_client::client::FrameReport;
use shadecast_protocol::ids::VertexSlot;
use shadecast_protocol::time::{ClientTime, DEFAULT_GRID, WorldTime};
use shadecast_server::scene::SceneGpu;
use shadecast_server::scene::numbering::SceneVertex;
use shadecast_server::support::lock::lock;
use std::collections::{BTreeMap, HashMap, HashSet};

/// A vertex that has not moved at all is frozen once its true place has moved on by so much, metres: less, and the steps of
/// quantised samples are taken for stillness.
const FROZEN_M: f64 = 1e-3;
/// The same in steps of samples, where these are coarse.
const FROZEN_STEPS: f64 = 2.0;
/// An edge is torn where the errors of its ends differ by more than this, metres: quantised samples from which vertices go on
/// at their last velocity make up to 2.6 mm of difference without being of two times ..
const TORN_M: f64 = 3e-3;
/// The same in steps of samples, where these are coarse.
const TORN_STEPS: f64 = 6.0;
/// .. and by more than this share of its length: errors that change slowly over a surface bend it, and tear nothing.
const TORN_SHARE: f64 = 0.25;
/// A vertex leaps that goes further from one display frame to the next than its true place does, by more than this, metres ..
const LEAP_M: f64 = 5e-3;
/// .. and by more than this share of its error: one that is blended back to its curve takes many frames.
const LEAP_SHARE: f64 = 0.5;

/// What was seen over a run.
#[derive(Debug, Default)]
pub struct Watch {
    /// Display frames that drew something animated.
    pub frames: u64,
    /// Distances from the true places, millimetres.
    pub errors_mm: Percentiles,
    /// The largest of them.
    pub worst: Option<Worst>,
    /// Animated vertices drawn, summed over frames.
    pub vertex_frames: u64,
    /// Of those: vertices that stood still though they should not have.
    pub frozen_vertex_frames: u64,
    /// Of those: corners of torn edges, of which both ends count since nobody can say which of them is at the wrong time; and
    /// vertices that an update makes leap, which is what the paper calls animation tearing.
    pub torn_vertex_frames: u64,
    /// Vertices without samples, by what the client says: those at their last velocity, and those that have stopped.
    pub held_vertex_frames: u64,
    /// The same.
    pub stopped_vertex_frames: u64,
    /// Vertices of instances that are not shown yet, by what the client says: their keys or poses are still on the way.
    pub withheld_vertex_frames: u64,
    /// Milliseconds by stage of the client's device, summed over [`Self::frames`].
    pub client_gpu_ms: BTreeMap<&'static str, f64>,
    /// Largest difference between a step of the client's idea of the server's time and what passed meanwhile, milliseconds.
    pub max_clock_step_ms: f64,
    /// Largest difference of that idea from the truth, milliseconds.
    pub max_clock_error_ms: f64,
    last_times: Option<(ClientTime, WorldTime)>,
    standing: HashMap<SceneVertex, Standing>,
    /// By instance when any of its vertices moved last.
    moved: BTreeMap<usize, WorldTime>,
}

/// Where the largest error was.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Worst {
    /// In millimetres.
    pub error_mm: f64,
    /// The server's time, seconds.
    pub time_s: f64,
    /// The instance's name.
    pub instance: String,
    /// Index into the vertices of its model.
    pub vertex: usize,
}

/// Since when a vertex has been where it is.
#[derive(Debug)]
struct Standing {
    frame: u64,
    shown: Vec3,
    /// Where it truly was when it came there.
    truth: DVec3,
    /// Where it truly was in that frame.
    latest_truth: DVec3,
}

/// How a vertex went on from the frame before.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Step {
    is_frozen: bool,
    leaps: bool,
}

/// A vertex of a triangle drawn.
struct Corner {
    vertex: SceneVertex,
    instance: usize,
    number: usize,
    shown: Vec3,
    truth: DVec3,
    /// Shown less true place at the time that suits the vertex's instance better.
    error: DVec3,
    /// What samples of the vertex are rounded to, metres; 0 where it has none.
    step_m: f64,
}

impl Watch {
    /// Distinct vertices drawn in any frame.
    pub fn vertices(&self) -> u64 {
        self.standing.len() as u64
    }

    /// Reads the vertices of the display frame that was just drawn.
    ///
    /// # Errors
    /// The client cannot read its memory back, or shows what the server has forgotten.
    pub fn look(&mut self, lab: &mut Lab, frame: &FrameReport) -> anyhow::Result<()> {
        let (Some(update), Some(time), true) = (frame.update, frame.world_time, frame.is_rendered) else {
            return Ok(());
        };
        self.note_clock(frame.display_time, time);
        // What the client withholds it may withhold as a whole, so that nothing animated is drawn.
        self.withheld_vertex_frames += u64::from(frame.withheld_vertices);
        let timings = lab.client.presenter.frame_timings()?;
        let (positions, mut triangles) =
            (lab.client.presenter.read_positions()?, lab.client.presenter.drawn_triangles());
        // An instance that the client withholds has no size: nobody sees it.
        triangles.retain(|triangle| {
            let [a, b, c] = triangle.map(|slot| positions[slot as usize]);
            a != b || b != c
        });
        let residents = lab.seat_mut().residents.at(update).map(<[_]>::to_vec);
        let residents =
            residents.with_context(|| format!("who was in whose slot at {update:?} is forgotten"))?;
        let residency = lab.seat().viewer.as_ref().map(|viewer| viewer.updates().residency());
        let coder = residency.map(|residency| lock(residency.coder()));
        let step_m = |slot| {
            let step_m = coder.as_ref().and_then(|coder| coder.encoder().memory().step_of(slot));
            f64::from(step_m.unwrap_or(0.0))
        };
        let scene = &lab.server.scene;
        let (mut corners, place_of_slot) = corners(scene, time, &triangles, &residents, &positions);
        for (slot, place) in &place_of_slot {
            corners[*place].step_m = step_m(VertexSlot(*slot));
        }
        if corners.is_empty() {
            return Ok(());
        }
        self.frames += 1;
        for (stage, ms) in timings.iter() {
            *self.client_gpu_ms.entry(stage).or_default() += ms;
        }
        self.held_vertex_frames += u64::from(frame.held_vertices);
        self.stopped_vertex_frames += u64::from(frame.frozen_vertices);
        let steps: Vec<Step> = corners.iter().map(|corner| self.add(scene, corner, time)).collect();
        if let Some(motion_time) = frame.motion_time.filter(|motion_time| *motion_time != time) {
            let mut truth = VertexTruth::at(scene, motion_time);
            suit(&mut corners, |vertex| Some(truth.vertex(vertex).position));
        }
        self.suit_standing(scene, &mut corners, time);
        let mut torn = torn(&corners, &place_of_slot, &triangles);
        torn.extend((0..corners.len()).filter(|place| steps[*place].leaps));
        self.torn_vertex_frames += torn.len() as u64;
        Ok(())
    }

    fn note_clock(&mut self, display: ClientTime, time: WorldTime) {
        let error_ns = time.0 - (display.0 - SERVER_EPOCH_NS);
        self.max_clock_error_ms = self.max_clock_error_ms.max(error_ns.abs() as f64 * 1e-6);
        if let Some((last_display, last_time)) = self.last_times.replace((display, time)) {
            let step_ns = time.since(last_time) - display.since(last_display);
            self.max_clock_step_ms = self.max_clock_step_ms.max(step_ns.abs() as f64 * 1e-6);
        }
    }

    fn add(&mut self, scene: &SceneGpu, corner: &Corner, time: WorldTime) -> Step {
        let error_mm = corner.error.length() * 1e3;
        self.vertex_frames += 1;
        self.errors_mm.add(error_mm);
        if self.worst.as_ref().is_none_or(|worst| worst.error_mm < error_mm) {
            let instance = scene.scene.instances[corner.instance].name.clone();
            self.worst = Some(Worst { error_mm, time_s: time.seconds(), instance, vertex: corner.number });
        }
        let step = self.follow(corner, time);
        self.frozen_vertex_frames += u64::from(step.is_frozen);
        step
    }

    /// An instance that stands still as a whole does so at a step of the time grid, the one before the frame in which it moved
    /// last: poses end there.
    fn suit_standing(&self, scene: &SceneGpu, corners: &mut [Corner], time: WorldTime) {
        let stands = |(instance, moved): (&usize, &WorldTime)| (*moved < time).then_some((*instance, *moved));
        for (instance, moved) in self.moved.iter().filter_map(stands) {
            let mut truth = VertexTruth::at(scene, DEFAULT_GRID.time_of(DEFAULT_GRID.floor(moved)));
            suit(corners, |vertex| {
                let vertex = truth.vertex(vertex);
                (vertex.instance == instance).then_some(vertex.position)
            });
        }
    }

    /// Whether a vertex is exactly where it was in the frame before, though it should be elsewhere, or far from there.
    fn follow(&mut self, corner: &Corner, time: WorldTime) -> Step {
        let Corner { vertex, instance, shown, truth, step_m, .. } = *corner;
        let here = Standing { frame: self.frames, shown, truth, latest_truth: truth };
        let before = self.standing.entry(vertex).or_insert(Standing { frame: 0, ..here });
        let was_drawn = before.frame + 1 == self.frames;
        let is_still = was_drawn && before.shown == shown;
        let came_there = if is_still { before.truth } else { truth };
        if was_drawn && !is_still {
            self.moved.insert(instance, time);
        }
        let excess_m = f64::from(before.shown.distance(shown)) - before.latest_truth.distance(truth);
        let error_m = before.shown.as_dvec3().distance(before.latest_truth);
        *before = Standing { truth: came_there, ..here };
        Step {
            is_frozen: came_there.distance(truth) > FROZEN_M.max(FROZEN_STEPS * step_m),
            leaps: was_drawn && excess_m > LEAP_M && excess_m > LEAP_SHARE * error_m,
        }
    }
}

/// The animated vertices of the triangles, each once, and by vertex slot which of them lives there.
fn corners(
    scene: &SceneGpu,
    time: WorldTime,
    triangles: &[[u32; 3]],
    residents: &[(u32, SceneVertex)],
    positions: &[[f32; 4]],
) -> (Vec<Corner>, HashMap<u32, usize>) {
    let mut truth = VertexTruth::at(scene, time);
    let (mut corners, mut place_of_slot) = (Vec::new(), HashMap::new());
    let slots: HashSet<u32> = triangles.iter().flatten().copied().collect();
    for (slot, vertex) in residents.iter().filter(|(slot, _)| slots.contains(slot)) {
        let [x, y, z, _] = positions[*slot as usize];
        let shown = Vec3::new(x, y, z);
        let TrueVertex { instance, number, position } = truth.vertex(*vertex);
        let error = shown.as_dvec3() - position;
        place_of_slot.insert(*slot, corners.len());
        corners.push(Corner {
            vertex: *vertex,
            instance,
            number,
            shown,
            truth: position,
            error,
            step_m: 0.0,
        });
    }
    (corners, place_of_slot)
}

/// Takes the errors of each instance at another time, whose true places are `truth`, where the sum of their squares is smaller: an
/// instance that stands still as a whole is not torn. `None`: the vertex's instance is not asked about.
fn suit(corners: &mut [Corner], mut truth: impl FnMut(SceneVertex) -> Option<DVec3>) {
    let mut instances: BTreeMap<usize, Vec<(usize, DVec3)>> = BTreeMap::new();
    for (place, corner) in corners.iter().enumerate() {
        let Some(place_then) = truth(corner.vertex) else { continue };
        let other = corner.shown.as_dvec3() - place_then;
        instances.entry(corner.instance).or_default().push((place, other));
    }
    for others in instances.into_values() {
        let now_m2: f64 = others.iter().map(|(place, _)| corners[*place].error.length_squared()).sum();
        if others.iter().map(|(_, other)| other.length_squared()).sum::<f64>() < now_m2 {
            others.into_iter().for_each(|(place, other)| corners[place].error = other);
        }
    }
}

/// The corners of torn edges: places in `corners`.
fn torn(corners: &[Corner], place_of_slot: &HashMap<u32, usize>, triangles: &[[u32; 3]]) -> HashSet<usize> {
    let mut torn = HashSet::new();
    for triangle in triangles {
        for (a, b) in [(0, 1), (1, 2), (2, 0)] {
            let place = |corner: usize| place_of_slot.get(&triangle[corner]).copied();
            let (Some(a), Some(b)) = (place(a), place(b)) else { continue };
            if is_torn(&corners[a], &corners[b]) {
                torn.extend([a, b]);
            }
        }
    }
    torn
}

fn is_torn(a: &Corner, b: &Corner) -> bool {
    let apart_m = a.error.distance(b.error);
    let place = |corner: &Corner| corner.shown.as_dvec3() - corner.error;
    let rounding_m = TORN_STEPS * a.step_m.max(b.step_m);
    apart_m > TORN_M.max(rounding_m) && apart_m > TORN_SHARE * place(a).distance(place(b))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A vertex that truly is at `truth`, and shown `off_m` further along x.
    fn corner(number: u32, truth: DVec3, off_m: f64) -> Corner {
        let error = DVec3::X * off_m;
        let shown = (truth + error).as_vec3();
        Corner {
            vertex: SceneVertex(number),
            instance: 0,
            number: number as usize,
            shown,
            truth,
            error,
            step_m: 0.0,
        }
    }

    fn torn_of(off_m: [f64; 3]) -> Vec<usize> {
        let places = [DVec3::ZERO, DVec3::X * 0.016, DVec3::Y * 0.016];
        let corners: Vec<Corner> = (0..3).map(|n| corner(n, places[n as usize], off_m[n as usize])).collect();
        let place_of_slot = (0..3).map(|place| (place as u32 + 10, place)).collect();
        // Slot 99 has no animated vertex.
        let mut torn: Vec<_> =
            torn(&corners, &place_of_slot, &[[10, 11, 12], [10, 99, 11]]).into_iter().collect();
        torn.sort_unstable();
        torn
    }

    #[test]
    fn an_edge_is_torn_where_its_ends_are_off_differently() {
        assert_eq!(torn_of([0.0, 0.0, 0.1]), [0, 1, 2]);
        assert_eq!(torn_of([0.1, 0.1, 0.1]), [0; 0], "all are off as much");
        assert_eq!(torn_of([0.0, 0.0029, 0.0]), [0; 0], "that is quantisation");
        assert_eq!(torn_of([0.0, 0.0039, 0.0039]), [0; 0], "less than a quarter of an edge");
        assert_eq!(torn_of([0.0, 0.0039, 0.0045]), [0, 2], "one edge of three");
    }

    #[test]
    fn an_instance_that_is_behind_as_a_whole_is_not_torn() {
        let mut corners: Vec<Corner> =
            (0..3).map(|n| corner(n, DVec3::Y * f64::from(n), 0.1 * f64::from(n))).collect();
        // At the time at which it stands, two are exact and one is nearly.
        let shown: Vec<DVec3> = corners.iter().map(|corner| corner.shown.as_dvec3()).collect();
        let off = |number: u32| DVec3::Z * 0.125 * f64::from(number / 2);
        suit(&mut corners, |vertex| Some(shown[vertex.0 as usize] - off(vertex.0)));
        assert_eq!([0, 1, 2].map(|n: usize| corners[n].error), [off(0), off(1), off(2)]);
        // A time that suits it worse changes nothing.
        suit(&mut corners, |_| Some(DVec3::ONE * 9.0));
        assert_eq!(corners[2].error, off(2));
    }

    #[test]
    fn a_vertex_is_frozen_once_it_should_be_elsewhere() {
        let mut watch = Watch::default();
        let mut see = |shown: f64, truth: f64| {
            watch.frames += 1;
            watch.follow(&corner(0, DVec3::X * truth, shown - truth), WorldTime(0)).is_frozen
        };
        assert!(!see(0.0, 0.0) && !see(0.0, 0.0004) && !see(0.0, 0.0008), "quantised, and slow");
        assert!(see(0.0, 0.0012), "slow, and still for long");
        assert!(!see(0.0013, 0.0014) && !see(0.5, 0.6) && !see(0.6, 0.9), "it moves, if wrongly");
        assert!(see(0.6, 1.0));
        watch.frames += 5;
        assert!(
            !watch.follow(&corner(0, DVec3::X * 3.0, -2.4), WorldTime(0)).is_frozen,
            "it has not been drawn meanwhile"
        );
    }

    #[test]
    fn a_moved_vertex_leaps_and_a_blended_one_does_not() {
        let mut watch = Watch::default();
        let mut see = |shown: f64, truth: f64| {
            watch.frames += 1;
            watch.follow(&corner(0, DVec3::X * truth, shown - truth), WorldTime(0)).leaps
        };
        assert!(!see(0.0, 0.0) && !see(0.2, 0.2) && !see(0.204, 0.2), "it goes with its true place");
        assert!(!see(0.2, 0.3) && !see(0.2, 0.4), "it stands");
        assert!(see(0.41, 0.41), "an update has come");
        assert!(!see(0.41, 0.8) && !see(0.46, 0.81), "it is blended back");
        watch.frames += 5;
        let unseen = watch.follow(&corner(0, DVec3::X * 3.0, 0.0), WorldTime(0));
        assert!(!unseen.leaps, "it has not been drawn meanwhile");
    }

    #[test]
    fn an_instance_moves_when_one_of_its_vertices_does() {
        let mut watch = Watch::default();
        let mut see = |frame: u64, number: u32, x: f64| {
            watch.frames = frame;
            watch.follow(&corner(number, DVec3::X * x, 0.0), WorldTime(frame as i64));
            watch.moved.get(&0).copied()
        };
        assert_eq!([see(1, 0, 0.0), see(2, 0, 0.5)], [None, Some(WorldTime(2))]);
        assert_eq!([see(3, 0, 0.5), see(3, 1, 9.0)], [Some(WorldTime(2)); 2]);
        assert_eq!(see(4, 1, 9.1), Some(WorldTime(4)));
    }

    #[test]
    fn a_step_of_the_clock_is_what_passes_more_or_less_than_time() {
        let mut watch = Watch::default();
        let see = |watch: &mut Watch, display_ns: i64, server_ns: i64| {
            watch.note_clock(ClientTime(SERVER_EPOCH_NS + display_ns), WorldTime(server_ns));
        };
        see(&mut watch, 0, 500_000);
        see(&mut watch, 11_000_000, 11_400_000);
        assert!((watch.max_clock_step_ms - 0.1).abs() < 1e-9 && watch.max_clock_error_ms == 0.5);
    }
}

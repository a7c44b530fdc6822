//! Bounding boxes of a model over a whole clip, and of an instance over its clip and its path. Culling, shadows and
//! quantisation rely on them at any time of the scene.
//!
//! A skinned vertex is a weighted mean of the places to which its palette entries move it. So it stays in the hull of the boxes
//! of each entry's moved vertices. Moving 8 corners per entry is far cheaper than moving every vertex, and allows as many times
//! as the display has.

use super::{clip, playing, pose};
use crate::timeline::ClipIndex;
use crate::{Instance, Model, Morph, Path, Trs};
use glam::{Affine3A, Vec3};
use shadecast_model::playback::{Playback, Schedule};

/// Moments looked at per second of a curve.
const MOMENTS_PER_S: f32 = 60.0;
/// Moments looked at in one curve at most.
const MAX_MOMENTS: u32 = 1200;
/// Between two moments a corner leaves the line between its places by at most this share of their distance: an arc's
/// height over its chord is `tan(a / 4) / 2`, and a quarter is reached at turns of 106 degrees.
const SAGITTA_SHARE: f32 = 0.25;

/// A box along the axes, metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Smallest corner.
    pub low: Vec3,
    /// Largest corner.
    pub high: Vec3,
}

impl Bounds {
    /// Around nothing.
    pub const EMPTY: Self = Self { low: Vec3::INFINITY, high: Vec3::NEG_INFINITY };

    /// Around points.
    pub fn around(points: impl IntoIterator<Item = Vec3>) -> Self {
        points.into_iter().fold(Self::EMPTY, |all, p| Self { low: all.low.min(p), high: all.high.max(p) })
    }

    /// Around both.
    pub fn union(self, other: Self) -> Self {
        Self { low: self.low.min(other.low), high: self.high.max(other.high) }
    }

    /// Larger by a margin on every side; nothing stays nothing.
    pub fn grown(self, margin: f32) -> Self {
        Self { low: self.low - margin, high: self.high + margin }
    }

    /// Around nothing at all.
    pub fn is_empty(self) -> bool {
        !self.low.cmple(self.high).all()
    }

    /// The eight corners.
    pub fn corners(self) -> [Vec3; 8] {
        let pick = |bit: usize, index: usize| index >> bit & 1 == 1;
        std::array::from_fn(|i| {
            Vec3::select(glam::BVec3::new(pick(0, i), pick(1, i), pick(2, i)), self.high, self.low)
        })
    }
}

/// Around the model in model space, over a whole clip; empty for a model without vertices.
pub fn model_bounds(model: &Model, clip: Option<usize>) -> Bounds {
    let boxes = entry_boxes(model);
    over_time(model.duration_s(clip), |t_s| moved(&boxes, &pose::source_palette(model, clip, t_s)))
}

/// Around the model in model space while one clip is faded into another; empty for a schedule without fades.
pub fn fade_bounds(model: &Model, schedule: &Schedule<ClipIndex>) -> Bounds {
    let mut fades = schedule.entries().windows(2).filter(|pair| pair[1].fade_ns > 0).peekable();
    if fades.peek().is_none() {
        return Bounds::EMPTY;
    }
    let boxes = entry_boxes(model);
    let of_fade = |pair: &[Playback<ClipIndex>]| {
        let speed = pair.iter().map(|entry| entry.speed.abs()).fold(1.0, f64::max);
        let (from, fade_s) = (pair[1].from, pair[1].fade_ns as f64 * 1e-9);
        // As long as the clips need that are faded: so many moments are looked at.
        over_time((fade_s * speed) as f32, |t_s| {
            let playing = schedule.at(from.plus_ns((t_s / speed * 1e9) as i64));
            let globals = pose::global_pose(model, &playing::source_pose(model, &playing));
            moved(&boxes, &pose::palette(model, &globals))
        })
    };
    fades.map(of_fade).fold(Bounds::EMPTY, Bounds::union)
}

/// How far from a model's origin its poses can take vertices, however their bones are turned.
#[derive(Clone, Debug)]
pub struct Reach {
    parents: Vec<Option<u32>>,
    /// For each palette entry that moves a vertex: its bone, and how far from there what it moves lies, metres.
    entries: Vec<(u32, f32)>,
}

impl Reach {
    /// Of a model.
    pub fn new(model: &Model) -> Self {
        let of_entry = |(number, corners): (usize, [Vec3; 8])| {
            let entry = &model.palette[number];
            let from_bone = corners.map(|corner| entry.bone_from_mesh.transform_point3(corner).length());
            (entry.bone, from_bone.into_iter().fold(0.0, f32::max))
        };
        let parents = model.bones.iter().map(|bone| bone.parent).collect();
        Self { parents, entries: entry_boxes(model).into_iter().map(of_entry).collect() }
    }

    /// Bones of the model.
    pub fn bone_count(&self) -> usize {
        self.parents.len()
    }

    /// Of a pose, the local transform of each bone: metres of model space.
    pub fn of_pose_m(&self, locals: &[Trs]) -> f32 {
        // By bone: how far its origin is at most, and how much it stretches.
        let mut bones: Vec<(f32, f32)> = Vec::with_capacity(locals.len());
        for (parent, local) in self.parents.iter().zip(locals) {
            let (far, scale) = parent.map_or((0.0, 1.0), |parent| bones[parent as usize]);
            let own = local.scale.abs().max_element();
            bones.push((far + scale * local.translation.length(), scale * own));
        }
        let of_entry = |(bone, from_bone): &(u32, f32)| {
            let (far, scale) = bones[*bone as usize];
            far + scale * from_bone
        };
        self.entries.iter().map(of_entry).fold(0.0, f32::max)
    }

    /// Of all of a clip of the model.
    pub fn of_clip_m(&self, model: &Model, clip: ClipIndex) -> f32 {
        let reach = |t_s: f64| self.of_pose_m(&clip::source_pose(model, clip, t_s));
        moments(model.duration_s(clip)).map(reach).fold(0.0, f32::max)
    }
}

fn moved(boxes: &EntryBoxes, palette: &[Affine3A]) -> Vec<[Vec3; 8]> {
    boxes.iter().map(|(entry, corners)| transformed(palette[*entry], corners)).collect()
}

/// Around an instance in the world, at any time: `of_model` is [`model_bounds`] of its model and clip.
pub fn instance_bounds(instance: &Instance, of_model: Bounds) -> Bounds {
    if of_model.is_empty() {
        return of_model;
    }
    let placed = transformed(instance.placement, &of_model.corners());
    match &instance.path {
        None => Bounds::around(placed),
        Some(path) => path_bounds(path, &placed),
    }
}

fn path_bounds(path: &Path, corners: &[Vec3; 8]) -> Bounds {
    // The path's own clock, played once: repetition and speed only choose moments of it.
    let still = Path { time_shift_s: 0.0, speed: 1.0, repetition: crate::Repetition::Once, ..path.clone() };
    over_time(path.clip.duration_s, |t_s| vec![transformed(still.transform(t_s), corners)])
}

/// Around all corners at all moments of a curve, and between them.
fn over_time(duration_s: f32, corners_at: impl Fn(f64) -> Vec<[Vec3; 8]>) -> Bounds {
    let mut moments = moments(duration_s);
    let mut before = corners_at(moments.next().unwrap_or(0.0));
    let mut found = Bounds::around(before.iter().flatten().copied());
    for t_s in moments {
        let now = corners_at(t_s);
        for (from, to) in before.iter().zip(&now) {
            let moved = from.iter().zip(to).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max);
            let swept = Bounds::around(from.iter().chain(to).copied());
            found = found.union(swept.grown(moved * SAGITTA_SHARE));
        }
        before = now;
    }
    found
}

/// The moments of a curve that are looked at, seconds: its start first.
fn moments(duration_s: f32) -> impl Iterator<Item = f64> {
    let steps = ((duration_s.max(0.0) * MOMENTS_PER_S).ceil() as u32).min(MAX_MOMENTS);
    let later = (1..=steps).map(move |step| f64::from(duration_s) * f64::from(step) / f64::from(steps));
    std::iter::once(0.0).chain(later)
}

fn transformed(matrix: Affine3A, corners: &[Vec3; 8]) -> [Vec3; 8] {
    corners.map(|corner| matrix.transform_point3(corner))
}

/// For each palette entry that moves a vertex: its number, and the corners of a box around what it moves.
type EntryBoxes = Vec<(usize, [Vec3; 8])>;

fn entry_boxes(model: &Model) -> EntryBoxes {
    let mut boxes = vec![Bounds::EMPTY; model.palette.len()];
    let reach = morph_reach(model);
    for (index, vertex) in model.vertices.iter().enumerate() {
        let reach = reach.get(index).copied().unwrap_or(Vec3::ZERO);
        let own = Bounds { low: vertex.position - reach, high: vertex.position + reach };
        for (joint, weight) in vertex.joints.into_iter().zip(vertex.weights) {
            if weight > 0.0 {
                boxes[usize::from(joint)] = boxes[usize::from(joint)].union(own);
            }
        }
    }
    let used = boxes.into_iter().enumerate().filter(|(_, bounds)| !bounds.is_empty());
    used.map(|(entry, bounds)| (entry, bounds.corners())).collect()
}

/// How far morphs move each vertex at most, per axis; empty without morphs.
fn morph_reach(model: &Model) -> Vec<Vec3> {
    if model.morphs.is_empty() {
        return Vec::new();
    }
    let mut reach = vec![Vec3::ZERO; model.vertices.len()];
    for (index, morph) in model.morphs.iter().enumerate() {
        let weight = largest_weight(model, index as u32, morph);
        for delta in &morph.deltas {
            reach[delta.vertex as usize] += delta.position.abs() * weight;
        }
    }
    reach
}

/// The largest weight that any clip's keys give a morph. Cubic curves may overshoot their keys: half as much again.
fn largest_weight(model: &Model, index: u32, morph: &Morph) -> f32 {
    let tracks = model.clips.iter().flat_map(|clip| &clip.morph_tracks);
    let own = tracks.filter(|t| (t.first_morph..t.first_morph + t.morph_count).contains(&index));
    let keyed = own.flat_map(|t| {
        let column = (index - t.first_morph) as usize;
        let overshoot = if t.interpolation == crate::Interpolation::CubicSpline { 1.5 } else { 1.0 };
        t.weights.iter().skip(column).step_by(t.morph_count as usize).map(move |w| w.abs() * overshoot)
    });
    keyed.fold(morph.rest_weight.abs(), f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::load::{SceneSource, load_scene};
    use crate::{Clip, Interpolation, Repetition, Track, TrackValues};
    use glam::Quat;

    #[test]
    fn dragon_never_leaves_its_box_and_the_box_is_not_much_larger() {
        let scene = load_scene(&SceneSource::Dragons(1)).expect("built in");
        let (model, instance) = (&scene.models[0], &scene.instances[0]);
        let found = model_bounds(model, instance.clip);
        let (low, high) = pose::bounds(model, instance.clip, 17).expect("vertices");
        assert!(found.low.cmple(low).all() && found.high.cmpge(high).all(), "{found:?} {low} {high}");
        let excess = (found.high - found.low) / (high - low);
        assert!(excess.max_element() < 1.35, "{excess}");
    }

    /// A bone that turns once around z, a metre away from what it moves.
    fn turning(quarter_turns: usize) -> Path {
        let turn = |i: usize| Quat::from_rotation_z(i as f32 * std::f32::consts::FRAC_PI_2);
        let keys = (0..=quarter_turns).map(turn).collect();
        let track = Track {
            bone: 0,
            times_s: (0..=quarter_turns).map(|i| i as f32).collect(),
            interpolation: Interpolation::Linear,
            values: TrackValues::Rotation(keys),
        };
        let clip = Clip { duration_s: quarter_turns as f32, tracks: vec![track], ..Clip::default() };
        Path { clip, repetition: Repetition::PingPong, time_shift_s: 0.3, speed: -2.0 }
    }

    #[test]
    fn box_of_an_instance_covers_its_whole_path() {
        let point = Bounds { low: Vec3::X, high: Vec3::X };
        let mut instance = Instance::new("i", 0);
        assert_eq!(instance_bounds(&instance, point), point);
        instance.path = Some(turning(4));
        let found = instance_bounds(&instance, point);
        let circle = Bounds { low: Vec3::new(-1.0, -1.0, 0.0), high: Vec3::new(1.0, 1.0, 0.0) };
        assert!(
            found.low.abs_diff_eq(circle.low, 0.03) && found.high.abs_diff_eq(circle.high, 0.03),
            "{found:?}"
        );
        for step in 0..100 {
            let at = instance.world_from_model(f64::from(step) * 0.037).transform_point3(Vec3::X);
            assert!(found.low.cmple(at).all() && found.high.cmpge(at).all(), "{at} leaves {found:?}");
        }
    }

    #[test]
    fn model_without_vertices_has_no_box() {
        let empty = model_bounds(&Model::default(), None);
        assert!(empty.is_empty() && instance_bounds(&Instance::new("i", 0), empty).is_empty());
    }
}

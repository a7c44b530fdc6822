//! Exchanges the fits of single curves while the bound holds.
//!
//! Errors are small and therefore add up: the effect of one curve's error on a vertex does not depend on the other curves. The
//! distance of each watched vertex from its place is stored for each watched time. The effect of another fit of one curve is
//! then a product per moved vertex, without a pose. That is exact to first order only, so the caller measures in the end.

use super::moving::{Moving, Place};
use super::probe::{VertexInputs, offset};
use super::{SampledTrack, unit_rotation};
use crate::animation::pose;
use crate::{Cancel, Cancelled, Model, Trs};
use glam::{Affine3A, Mat3A, Vec3A};
use std::collections::HashMap;

/// Most products of vertices, bones above them and times that are kept, 16 bytes each.
const MAX_PLACES: usize = 1 << 23;
/// Parts of the bound at which curves are made coarser, one after the other: what saves many bytes for little error
/// comes first.
const STAGES: [f32; 6] = [0.12, 0.25, 0.4, 0.6, 0.8, 1.0];
/// Steps of mending at most, for each curve.
const MENDS: usize = 8;

/// What one curve's errors are multiplied by, for one watched vertex.
struct Lever {
    /// Place among the watched vertices.
    vertex: usize,
    /// How much of the vertex follows the bone; 0 for a morph target, which moves no origin.
    weight: f32,
    /// By time: for a bone the part of the vertex's place that follows it, for a morph target how it moves the vertex.
    places: Vec<Vec3A>,
}

/// By time: what a change of a curve adds to a lever's place and weight.
type Change = Vec<(Mat3A, Vec3A)>;

/// The model where it is watched.
pub(super) struct Watch<'a> {
    pub model: &'a Model,
    pub clip: Option<usize>,
    pub vertices: &'a [u32],
    pub times_s: &'a [f32],
    pub truth: &'a [VertexInputs],
}

pub(super) struct Exchange {
    limit_m: f32,
    times_s: Vec<f32>,
    /// By time and bone: local transform of the original.
    locals: Vec<Vec<Trs>>,
    /// By time and bone: `model_from_parent`, `bone_from_model`.
    frames: Vec<Vec<(Affine3A, Affine3A)>>,
    /// By place among levers: bones with a curve come first, then morph targets.
    levers: HashMap<Owner, Vec<Lever>>,
    /// By watched vertex, then by time: from the original to where the vertex is now.
    offsets_m: Vec<Vec3A>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum Owner {
    Bone(usize),
    Morph(usize),
}

impl From<Place> for Owner {
    fn from(place: Place) -> Self {
        match place {
            Place::Bone(bone, _) => Self::Bone(bone),
            Place::Morph(morph) => Self::Morph(morph),
        }
    }
}

impl Exchange {
    /// Where `now` has each watched vertex at each watched time. `None` where that is too much to keep.
    pub fn new(watch: &Watch, now: &[VertexInputs], moving: &[Moving], limit_m: f32) -> Option<Self> {
        let mut exchange = Self {
            limit_m,
            times_s: watch.times_s.to_vec(),
            locals: Vec::new(),
            frames: Vec::new(),
            levers: HashMap::new(),
            offsets_m: Vec::new(),
        };
        exchange.add_levers(watch, moving)?;
        exchange.add_poses(watch);
        exchange.measure(watch, now);
        Some(exchange)
    }

    fn measure(&mut self, watch: &Watch, now: &[VertexInputs]) {
        self.offsets_m.clear();
        for vertex in watch.vertices {
            let offsets = watch.truth.iter().zip(now).map(|(a, b)| offset(watch.model, a, b, *vertex));
            self.offsets_m.extend(offsets);
        }
    }

    fn add_levers(&mut self, watch: &Watch, moving: &[Moving]) -> Option<()> {
        let curves: Vec<Owner> = moving.iter().map(|moving| Owner::from(moving.place)).collect();
        for owner in &curves {
            self.levers.insert(*owner, Vec::new());
        }
        let mut places = 0;
        for (index, vertex) in watch.vertices.iter().enumerate() {
            for (owner, lever) in levers_of(watch, index, *vertex) {
                if let Some(levers) = self.levers.get_mut(&owner) {
                    places += lever.places.len();
                    levers.push(lever);
                }
            }
            if places > MAX_PLACES {
                return None;
            }
        }
        Some(())
    }

    fn add_poses(&mut self, watch: &Watch) {
        for time_s in watch.times_s {
            let locals = pose::source_pose(watch.model, watch.clip, f64::from(*time_s));
            let globals = pose::global_pose(watch.model, &locals);
            let frames = watch.model.bones.iter().zip(&globals).map(|(bone, global)| {
                let parent = bone.parent.map_or(Affine3A::IDENTITY, |parent| globals[parent as usize]);
                (parent, global.inverse())
            });
            self.frames.push(frames.collect());
            self.locals.push(locals);
        }
    }

    // ---- what a change does ----

    fn change(&self, place: Place, from: &SampledTrack, to: &SampledTrack) -> Change {
        (0..self.times_s.len()).map(|time| self.change_at(place, from, to, time)).collect()
    }

    fn change_at(&self, place: Place, from: &SampledTrack, to: &SampledTrack, time: usize) -> (Mat3A, Vec3A) {
        let t_s = f64::from(self.times_s[time]);
        let Place::Bone(bone, channel) = place else {
            let change = to.evaluate(t_s).x - from.evaluate(t_s).x;
            return (Mat3A::from_diagonal(glam::Vec3::splat(change)), Vec3A::ZERO);
        };
        let local = |track: &SampledTrack| with(self.locals[time][bone], channel, track, t_s).affine();
        let (a, b) = (local(from), local(to));
        let (parent, bone_from_model) = self.frames[time][bone];
        let turn = parent.matrix3 * (b.matrix3 - a.matrix3);
        let shift = parent.matrix3 * (b.translation - a.translation);
        (turn * bone_from_model.matrix3, turn * bone_from_model.translation + shift)
    }

    /// Whether all vertices are within the limit after a change, or at least no further than `share` of it.
    fn allows(&self, owner: Owner, change: &Change, share: f32) -> bool {
        let limit = (share * self.limit_m).powi(2);
        let count = self.times_s.len();
        self.levers[&owner].iter().all(|lever| {
            let offsets = &self.offsets_m[lever.vertex * count..][..count];
            let all = lever.places.iter().zip(offsets).zip(change);
            // What is not a number is not allowed.
            all.into_iter().all(|((place, offset), (turn, shift))| {
                (*offset + *turn * *place + *shift * lever.weight).length_squared() <= limit
            })
        })
    }

    fn apply(&mut self, owner: Owner, change: &Change) {
        let count = self.times_s.len();
        for lever in &self.levers[&owner] {
            let offsets = &mut self.offsets_m[lever.vertex * count..][..count];
            for ((place, offset), (turn, shift)) in lever.places.iter().zip(offsets).zip(change) {
                *offset += *turn * *place + *shift * lever.weight;
            }
        }
    }

    // ---- coarser and finer ----

    /// Makes curves coarser for as long as that saves bytes and all watched vertices are within the limit.
    pub fn coarsen(&mut self, moving: &mut [Moving], cancel: &Cancel) -> Result<(), Cancelled> {
        for share in STAGES {
            while self.coarsen_once(moving, share) {
                cancel.check()?;
            }
        }
        Ok(())
    }

    /// Each curve by one step at most, those first that save most bytes for their error; whether any was.
    fn coarsen_once(&mut self, moving: &mut [Moving], share: f32) -> bool {
        let mut order: Vec<(f32, usize)> =
            moving.iter().enumerate().filter_map(|(curve, moving)| Some((moving.saving()?, curve))).collect();
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut any = false;
        for (_, curve) in order {
            any |= self.exchange(&mut moving[curve], -1, share);
        }
        any
    }

    /// Takes the next coarser (-1) or finer (1) fit, if the limit allows it.
    fn exchange(&mut self, moving: &mut Moving, step: isize, share: f32) -> bool {
        let Some(next) = moving.chosen.checked_add_signed(step) else { return false };
        let owner = Owner::from(moving.place);
        let change = self.change(moving.place, &moving.fits[moving.chosen].track, &moving.fits[next].track);
        let is_allowed = step > 0 || self.allows(owner, &change, share);
        if is_allowed {
            self.apply(owner, &change);
            moving.chosen = next;
        }
        is_allowed
    }

    /// Makes curves finer until all watched vertices are within the limit, always for the one that is worst the curve
    /// that costs the fewest bytes for what it gains. Whether that was possible.
    pub fn mend(&mut self, moving: &mut [Moving]) -> bool {
        for _ in 0..MENDS * moving.len() {
            let Some((vertex, time)) = self.worst() else { return true };
            let Some(curve) = self.best_help(moving, vertex, time) else { return false };
            self.exchange(&mut moving[curve], 1, 1.0);
        }
        false
    }

    /// The vertex that is farthest beyond the limit, and when.
    fn worst(&self) -> Option<(usize, usize)> {
        let lengths = self.offsets_m.iter().map(|offset| offset.length_squared()).enumerate();
        let beyond = lengths.filter(|(_, squared)| *squared > self.limit_m * self.limit_m);
        let (index, _) = beyond.max_by(|a, b| a.1.total_cmp(&b.1))?;
        Some((index / self.times_s.len(), index % self.times_s.len()))
    }

    fn best_help(&self, moving: &[Moving], vertex: usize, time: usize) -> Option<usize> {
        let offset = self.offsets_m[vertex * self.times_s.len() + time];
        let help = |(curve, moving): (usize, &Moving)| {
            let (now, finer) = (&moving.fits[moving.chosen], moving.fits.get(moving.chosen + 1)?);
            let lever =
                self.levers[&Owner::from(moving.place)].iter().find(|lever| lever.vertex == vertex)?;
            let (turn, shift) = self.change_at(moving.place, &now.track, &finer.track, time);
            let after = offset + turn * lever.places[time] + shift * lever.weight;
            let gain_m = offset.length() - after.length();
            let price = (finer.byte_count - now.byte_count).max(1.0);
            (gain_m > 0.0).then_some((gain_m / price, curve))
        };
        moving.iter().enumerate().filter_map(help).max_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, curve)| curve)
    }
}

/// A transform of which one channel is what a track says.
fn with(local: Trs, channel: usize, track: &SampledTrack, t_s: f64) -> Trs {
    match channel {
        0 => Trs { translation: track.evaluate(t_s).truncate(), ..local },
        1 => Trs { rotation: unit_rotation(track, t_s), ..local },
        _ => Trs { scale: track.evaluate(t_s).truncate(), ..local },
    }
}

/// What moves a vertex, and how.
fn levers_of(watch: &Watch, index: usize, vertex: u32) -> Vec<(Owner, Lever)> {
    let Watch { model, truth, .. } = watch;
    let shape = model.vertices[vertex as usize];
    let joints = shape.joints.into_iter().zip(shape.weights).filter(|(_, weight)| *weight > 0.0);
    let mut levers: Vec<(Owner, Lever)> = Vec::new();
    let points: Vec<Vec3A> = truth.iter().map(|moment| moment.morphed_point(model, vertex)).collect();
    for (joint, weight) in joints {
        let entry = usize::from(joint);
        let place = |(moment, point): (&VertexInputs, &Vec3A)| {
            weight * moment.palette[entry].transform_point3a(*point)
        };
        let places: Vec<Vec3A> = truth.iter().zip(&points).map(place).collect();
        let mut next = Some(model.palette[entry].bone as usize);
        while let Some(bone) = next {
            add_lever(&mut levers, Owner::Bone(bone), index, weight, &places);
            next = model.bones[bone].parent.map(|parent| parent as usize);
        }
    }
    for (morph, target) in model.morphs.iter().enumerate() {
        for delta in target.deltas.iter().filter(|delta| delta.vertex == vertex) {
            let moved = |moment: &VertexInputs| {
                pose::blend(&moment.palette, shape.joints, shape.weights).matrix3
                    * Vec3A::from(delta.position)
            };
            let places: Vec<Vec3A> = truth.iter().map(moved).collect();
            add_lever(&mut levers, Owner::Morph(morph), index, 0.0, &places);
        }
    }
    levers
}

fn add_lever(levers: &mut Vec<(Owner, Lever)>, owner: Owner, vertex: usize, weight: f32, places: &[Vec3A]) {
    match levers.iter_mut().find(|(known, _)| *known == owner) {
        Some((_, lever)) => {
            lever.weight += weight;
            lever.places.iter_mut().zip(places).for_each(|(sum, place)| *sum += *place);
        }
        None => levers.push((owner, Lever { vertex, weight, places: places.to_vec() })),
    }
}

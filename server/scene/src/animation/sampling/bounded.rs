//! Error-bounded sampling: the fewest keys with which no skinned vertex leaves the original by more than a bound.
//!
//! How much each curve may err is a choice for each: the errors along a chain of bones add up, and a curve that needs
//! many keys anyway gains more from a larger share of the bound than one that needs few. So every curve is fitted for
//! several tolerances, which gives bytes against error, and each vertex has a *price* in bytes for erring by the whole
//! bound. A curve takes the fit at which its bytes and what the vertices that it moves charge for its error (price
//! times arm times tolerance) are least. Prices are found by trial: vertices are measured, and the price of one beyond
//! the bound rises, that of others falls. These are the multipliers of Lagrange's method, which only come close: at last
//! curves are made finer one by one, where that costs the fewest bytes for what vertices beyond the bound gain.
//!
//! The trials watch few vertices (the outermost of each palette entry) at a limited number of times; whatever violates
//! the bound among all vertices and times is watched from then on. The bound holds at all times in `Trial::times_s`:
//! the keys of all sources, the keys that were made, and at least three points between them.

use super::curve::Curve;
use super::exchange::{Exchange, Watch};
use super::moving::{Moving, Place};
use super::probe::{VertexInputs, distances};
use super::source::{Source, Sources};
use super::{SampledClip, SampledTrack, longest_axis};
use crate::animation::bounds::Bounds;
use crate::animation::pose;
use crate::{Cancel, Cancelled, Model, Morph, MorphDelta, Trs, Vertex};
use glam::{Affine3A, Vec3, Vec3A};
use std::collections::{HashMap, HashSet};

/// Most times at which the bound is verified.
const MAX_VERIFIED_TIMES: usize = 1 << 14;
/// Most times that trials watch at first.
const WATCHED_TIMES: usize = 192;
/// Times at which arms are measured.
const ARM_TIMES: usize = 12;
/// Vertices of small models are all watched.
const FEW_VERTICES: usize = 256;
/// Sum of the prices at first, in bytes for each curve.
const FIRST_PRICE: f32 = 400.0;
/// Trials of prices.
const ROUNDS: usize = 20;
/// Trials of finer curves at most, before a clip is given up: each makes at least one curve finer.
const REPAIRS: usize = 400;
/// Of the bound, what trials aim at.
const AIM: f32 = 0.985;
/// Of the bound, what watched vertices may use up: the others need a little more.
const COARSE_AIM: f32 = 0.97;
/// How far a single curve may move a vertex at first where all are made coarser, in parts of the bound.
const FINE_START: f32 = 0.06;
/// Outermost are looked for among vertices with at least this share in a palette entry.
const MAIN_WEIGHT: f32 = 0.05;
/// Curves that move no vertex (of bones that carry lights) may err by this share of their range.
const IDLE_SHARE: f32 = 0.01;

pub(super) fn sample(
    model: &Model,
    clip: Option<usize>,
    bounds: [f32; 2],
    cancel: &Cancel,
) -> Result<SampledClip, Cancelled> {
    let Found { clip, is_kept } = find(model, clip, bounds, cancel)?;
    if !is_kept {
        tracing::warn!(
            "model '{}': a clip exceeds the error bound of {} of its own units; single precision may be too coarse",
            model.name,
            bounds[0]
        );
    }
    Ok(clip)
}

/// What was found, and whether it is within the bound: if not, it is the closest.
struct Found {
    clip: SampledClip,
    is_kept: bool,
}

fn find(
    model: &Model,
    clip: Option<usize>,
    [bound_m, range_share]: [f32; 2],
    cancel: &Cancel,
) -> Result<Found, Cancelled> {
    assert!(bound_m > 0.0 && range_share > 0.0, "bounds {bound_m} m, {range_share}");
    let duration_s = model.duration_s(clip);
    let sources = Sources::new(model, clip);
    let still = sources.map(duration_s, |source| SampledTrack::constant(source.at(0.0)));
    let moving = moving_sources(&sources);
    if duration_s <= 0.0 || moving.is_empty() {
        return Ok(Found { clip: still, is_kept: true });
    }
    let mut trial = Trial::new(model, clip, bound_m, &moving, still, cancel);
    trial.prepare(&moving, range_share)?;
    trial.run()
}

fn moving_sources<'a>(sources: &Sources<'a>) -> Vec<(Place, Source<'a>)> {
    let bones = sources.bones.iter().enumerate().flat_map(|(bone, channels)| {
        channels.iter().enumerate().map(move |(channel, source)| (Place::Bone(bone, channel), *source))
    });
    let morphs = sources.morphs.iter().enumerate().map(|(morph, source)| (Place::Morph(morph), *source));
    bones.chain(morphs).filter(|(_, source)| source.varies()).collect()
}

struct Trial<'a> {
    model: &'a Model,
    clip: Option<usize>,
    bound_m: f32,
    moving: Vec<Moving>,
    /// What has been chosen last.
    found: SampledClip,
    /// Where the bound must hold.
    times_s: Vec<f32>,
    /// Vertices that the clip moves.
    vertices: Vec<u32>,
    /// By palette entry: corners of the box around the vertices that follow it, in mesh space.
    boxes: Vec<[Vec3; 8]>,
    arms: ArmFinder<'a>,
    watched: Watched,
    cancel: &'a Cancel,
}

/// What trials measure.
#[derive(Default)]
struct Watched {
    vertices: Vec<u32>,
    /// By place in `vertices`: curves that move the vertex (indices into `Trial::moving`), and how many metres it moves
    /// at most per unit of the curve's error.
    arms_m: Vec<Vec<(usize, f32)>>,
    /// By place in `vertices`: bytes for erring by the whole bound.
    prices: Vec<f32>,
    times_s: Vec<f32>,
    /// By time.
    truth: Vec<VertexInputs>,
}

/// Distances from the original.
struct Measured {
    /// By vertex, the largest over the times; 0 for vertices that were not measured.
    by_vertex_m: Vec<f32>,
    /// By time, the largest over the vertices.
    by_time_m: Vec<f32>,
}

impl Measured {
    fn largest_m(&self) -> f32 {
        self.by_time_m.iter().copied().fold(0.0, f32::max)
    }
}

impl<'a> Trial<'a> {
    fn new(
        model: &'a Model,
        clip: Option<usize>,
        bound_m: f32,
        sources: &[(Place, Source)],
        still: SampledClip,
        cancel: &'a Cancel,
    ) -> Self {
        let moves = pose::animated_vertices(model, clip);
        let vertices: Vec<u32> = (0..moves.len() as u32).filter(|vertex| moves[*vertex as usize]).collect();
        let arms = ArmFinder::new(model, clip, sources);
        let (found, watched) = (still, Watched::default());
        let (moving, times_s) = (Vec::new(), Vec::new());
        let boxes = boxes(model, &vertices);
        Self { model, clip, bound_m, moving, found, times_s, vertices, boxes, arms, watched, cancel }
    }

    fn prepare(&mut self, sources: &[(Place, Source)], range_share: f32) -> Result<(), Cancelled> {
        self.watch_vertices(self.outermost());
        self.add_curves(sources, range_share)?;
        self.times_s = all_times(&self.moving);
        let step = self.times_s.len().div_ceil(WATCHED_TIMES).max(1);
        let few: Vec<f32> = self.times_s.iter().step_by(step).copied().collect();
        self.watch_times(few);
        Ok(())
    }

    fn add_curves(&mut self, sources: &[(Place, Source)], range_share: f32) -> Result<(), Cancelled> {
        let mut longest_m = vec![0.0f32; sources.len()];
        for (curve, arm_m) in self.watched.arms_m.iter().flatten() {
            longest_m[*curve] = longest_m[*curve].max(*arm_m);
        }
        for ((place, source), arm_m) in sources.iter().zip(longest_m) {
            self.cancel.check()?;
            let curve = Curve::new(source, self.found.duration_s);
            let share = if arm_m > 0.0 { range_share } else { range_share.min(IDLE_SHARE) };
            let range = curve.range();
            // What hardly moves is noise, of which no share need be kept.
            let ceiling = if range <= curve.still_range() { range } else { share * range };
            self.moving.push(Moving::new(*place, curve, arm_m, self.bound_m, ceiling));
        }
        Ok(())
    }

    fn watch_vertices(&mut self, vertices: Vec<u32>) {
        for vertex in vertices {
            self.watched.arms_m.push(self.arms.of(vertex));
            self.watched.vertices.push(vertex);
        }
    }

    fn watch_times(&mut self, times_s: Vec<f32>) {
        for time_s in times_s {
            self.watched.truth.push(VertexInputs::of_source(self.model, self.clip, f64::from(time_s)));
            self.watched.times_s.push(time_s);
        }
    }

    fn run(mut self) -> Result<Found, Cancelled> {
        self.find_start()?;
        for _ in 0..REPAIRS {
            let mut measured = self.measure_watched()?;
            if measured.largest_m() <= self.bound_m {
                measured = self.measure_all()?;
                if measured.largest_m() <= self.bound_m {
                    return Ok(Found { clip: self.found, is_kept: true });
                }
                self.watch_what_was_missed(&measured);
            }
            if !self.mend() && !self.make_finer(&measured) {
                break;
            }
        }
        Ok(Found { clip: self.found, is_kept: false })
    }

    // ---- exchanges ----

    /// The smaller of what two ways find: from prices, and from fine curves that are made coarser one by one.
    fn find_start(&mut self) -> Result<(), Cancelled> {
        self.find_prices()?;
        let Some((bytes, chosen)) = self.use_up_the_bound()? else { return Ok(()) };
        for moving in &mut self.moving {
            moving.start_at(FINE_START * self.bound_m);
        }
        self.show_chosen();
        if self.use_up_the_bound()?.is_none_or(|(from_fine, _)| bytes <= from_fine) {
            self.take(&chosen);
        }
        Ok(())
    }

    /// Makes curves coarser for as long as the watched vertices are within what is aimed at. Bytes and choice after
    /// that; `None` where there is too much to watch for it.
    fn use_up_the_bound(&mut self) -> Result<Option<(usize, Vec<usize>)>, Cancelled> {
        let Some(mut exchange) = self.exchange(COARSE_AIM) else { return Ok(None) };
        exchange.mend(&mut self.moving);
        exchange.coarsen(&mut self.moving, self.cancel)?;
        self.show_chosen();
        let chosen = self.moving.iter().map(|moving| moving.chosen).collect();
        Ok(Some((self.found.byte_count(), chosen)))
    }

    fn take(&mut self, chosen: &[usize]) {
        for (moving, chosen) in self.moving.iter_mut().zip(chosen) {
            moving.chosen = *chosen;
        }
        self.show_chosen();
    }

    /// Makes curves finer where watched vertices are beyond the bound; whether all are within by that.
    fn mend(&mut self) -> bool {
        let Some(mut exchange) = self.exchange(AIM) else { return false };
        let is_mended = exchange.mend(&mut self.moving);
        self.show_chosen();
        is_mended
    }

    fn exchange(&self, aim: f32) -> Option<Exchange> {
        let Watched { vertices, times_s, truth, .. } = &self.watched;
        let now: Vec<VertexInputs> = times_s
            .iter()
            .map(|time_s| VertexInputs::of_samples(self.model, &self.found, f64::from(*time_s)))
            .collect();
        let watch = Watch { model: self.model, clip: self.clip, vertices, times_s, truth };
        Exchange::new(&watch, &now, &self.moving, aim * self.bound_m)
    }

    // ---- prices ----

    /// Leaves the choice that promises to be the smallest once all is within the bound.
    fn find_prices(&mut self) -> Result<(), Cancelled> {
        let price = FIRST_PRICE * self.moving.len() as f32 / self.watched.vertices.len().max(1) as f32;
        self.watched.prices = vec![price; self.watched.vertices.len()];
        let mut best: Option<(f32, Vec<usize>)> = None;
        for round in 0..ROUNDS {
            self.choose();
            let measured = self.measure_watched()?;
            // Bytes go about with the root of the error.
            let excess = (measured.largest_m() / self.bound_m).max(1.0);
            let promise = self.found.byte_count() as f32 * excess.sqrt();
            if best.as_ref().is_none_or(|(least, _)| promise < *least) {
                best = Some((promise, self.moving.iter().map(|moving| moving.chosen).collect()));
            }
            self.change_prices(&measured, round);
        }
        if let Some((_, chosen)) = best {
            self.take(&chosen);
        }
        Ok(())
    }

    fn choose(&mut self) {
        let mut charges = vec![0.0f32; self.moving.len()];
        for (arms_m, price) in self.watched.arms_m.iter().zip(&self.watched.prices) {
            for (curve, arm_m) in arms_m {
                charges[*curve] += price * arm_m / self.bound_m;
            }
        }
        for (moving, charge) in self.moving.iter_mut().zip(charges) {
            moving.choose(charge);
        }
        self.show_chosen();
    }

    fn show_chosen(&mut self) {
        for moving in &self.moving {
            let track = moving.fits[moving.chosen].track.clone();
            match moving.place {
                Place::Bone(bone, channel) => self.found.bones[bone][channel] = track,
                Place::Morph(morph) => self.found.morphs[morph] = track,
            }
        }
    }

    /// By smaller steps the more rounds have passed.
    fn change_prices(&mut self, measured: &Measured, round: usize) {
        let power = 2.0 / (1.0 + round as f32 / 4.0);
        for (price, vertex) in self.watched.prices.iter_mut().zip(&self.watched.vertices) {
            let excess = measured.by_vertex_m[*vertex as usize] / (AIM * self.bound_m);
            *price = (*price * excess.powf(power).clamp(0.5, 4.0)).clamp(1e-6, 1e12);
        }
    }

    // ---- repairs ----

    /// Makes curves finer until each watched vertex that was found beyond the bound should be within; whether any could
    /// be. A vertex's error is supposed to follow the sum of arms times tolerances.
    fn make_finer(&mut self, measured: &Measured) -> bool {
        let before: Vec<f32> = self.moving.iter().map(Moving::tolerance).collect();
        let mut changed = false;
        let Watched { vertices, arms_m, .. } = &self.watched;
        for (vertex, arms_m) in vertices.iter().zip(arms_m) {
            let error_m = measured.by_vertex_m[*vertex as usize];
            if error_m <= self.bound_m {
                continue;
            }
            let sum_m: f32 = arms_m.iter().map(|(curve, arm_m)| arm_m * before[*curve]).sum();
            let wanted_m = sum_m * AIM * self.bound_m / error_m;
            loop {
                let moving = &self.moving;
                let now_m: f32 = arms_m.iter().map(|(curve, arm_m)| arm_m * moving[*curve].tolerance()).sum();
                if now_m <= wanted_m {
                    break;
                }
                let gain = |(curve, arm_m): &(usize, f32)| Some((moving[*curve].gain()? * arm_m, *curve));
                let best = arms_m.iter().filter_map(gain).max_by(|a, b| a.0.total_cmp(&b.0));
                let Some((_, curve)) = best else { break };
                self.moving[curve].chosen += 1;
                changed = true;
            }
        }
        self.show_chosen();
        changed
    }

    fn measure_watched(&self) -> Result<Measured, Cancelled> {
        let Watched { vertices, times_s, truth, .. } = &self.watched;
        let mut by_vertex_m = vec![0.0f32; self.model.vertices.len()];
        let by_time = times_s.iter().zip(truth).map(|(time_s, truth)| {
            self.cancel.check()?;
            let found = VertexInputs::of_samples(self.model, &self.found, f64::from(*time_s));
            let mut largest_m = 0.0f32;
            distances(self.model, truth, &found, vertices, |vertex, distance_m| {
                let so_far_m = &mut by_vertex_m[vertex as usize];
                *so_far_m = so_far_m.max(distance_m);
                largest_m = largest_m.max(distance_m);
            });
            Ok(largest_m)
        });
        let by_time_m = by_time.collect::<Result<_, _>>()?;
        Ok(Measured { by_vertex_m, by_time_m })
    }

    /// All vertices at all times; those that cannot be beyond the bound are left out.
    fn measure_all(&self) -> Result<Measured, Cancelled> {
        let mut measured =
            Measured { by_vertex_m: vec![0.0; self.model.vertices.len()], by_time_m: Vec::new() };
        for time_s in &self.times_s {
            self.cancel.check()?;
            let t_s = f64::from(*time_s);
            let truth = VertexInputs::of_source(self.model, self.clip, t_s);
            let found = VertexInputs::of_samples(self.model, &self.found, t_s);
            let mut largest_m = 0.0f32;
            distances(self.model, &truth, &found, &self.suspects(&truth, &found), |vertex, distance_m| {
                let so_far_m = &mut measured.by_vertex_m[vertex as usize];
                *so_far_m = so_far_m.max(distance_m);
                largest_m = largest_m.max(distance_m);
            });
            measured.by_time_m.push(largest_m);
        }
        Ok(measured)
    }

    /// Vertices that might be beyond the bound: those of palette entries that move a corner of the box around their
    /// vertices so far. What moves a vertex is a mean of what its entries do to it, and that is largest at corners.
    fn suspects(&self, truth: &VertexInputs, found: &VertexInputs) -> Vec<u32> {
        if !self.model.morphs.is_empty() {
            return self.vertices.clone(); // morph targets move them beside that
        }
        let moves_far = |(corners, (a, b)): (&[Vec3; 8], (&Affine3A, &Affine3A))| {
            let offset = |corner: &Vec3| {
                (b.matrix3 - a.matrix3) * Vec3A::from(*corner) + (b.translation - a.translation)
            };
            // Roundings of the corner's and of the vertex's offset may differ.
            corners.iter().any(|corner| offset(corner).length() > 0.99 * self.bound_m)
        };
        let palettes = truth.palette.iter().zip(&found.palette);
        let is_far: Vec<bool> = self.boxes.iter().zip(palettes).map(moves_far).collect();
        if !is_far.contains(&true) {
            return Vec::new();
        }
        let is_suspect = |index: &u32| {
            let vertex = &self.model.vertices[*index as usize];
            let joints = vertex.joints.iter().zip(vertex.weights);
            joints.filter(|(_, weight)| *weight > 0.0).any(|(joint, _)| is_far[usize::from(*joint)])
        };
        self.vertices.iter().copied().filter(is_suspect).collect()
    }

    /// Vertices beyond the bound and times at which there are any are watched from now on.
    fn watch_what_was_missed(&mut self, measured: &Measured) {
        let watched: HashSet<u32> = self.watched.vertices.iter().copied().collect();
        let is_missed = |v: &u32| measured.by_vertex_m[*v as usize] > self.bound_m && !watched.contains(v);
        self.watch_vertices(self.vertices.iter().copied().filter(is_missed).collect());
        let times = self.times_s.iter().zip(&measured.by_time_m);
        let late = times.filter(|(_, worst_m)| **worst_m > self.bound_m).map(|(time_s, _)| *time_s);
        let late: Vec<f32> = late.filter(|time_s| !self.watched.times_s.contains(time_s)).collect();
        self.watch_times(late);
    }

    /// The outermost vertices of each palette entry, and those that each morph target moves farthest.
    fn outermost(&self) -> Vec<u32> {
        if self.vertices.len() <= FEW_VERTICES {
            return self.vertices.clone();
        }
        let directions = directions();
        let mut best = vec![[(f32::NEG_INFINITY, u32::MAX); 14]; self.model.palette.len()];
        for index in &self.vertices {
            let vertex = &self.model.vertices[*index as usize];
            for (joint, weight) in vertex.joints.into_iter().zip(vertex.weights) {
                if weight < MAIN_WEIGHT {
                    continue;
                }
                for (direction, best) in directions.iter().zip(&mut best[usize::from(joint)]) {
                    let reach = vertex.position.dot(*direction);
                    if reach > best.0 {
                        *best = (reach, *index);
                    }
                }
            }
        }
        let mut watched: Vec<u32> = best.into_iter().flatten().map(|(_, index)| index).collect();
        let size = |delta: &&MorphDelta| delta.position.length_squared();
        let farthest = |morph: &Morph| {
            let deltas = morph.deltas.iter();
            deltas.max_by(|a, b| size(a).total_cmp(&size(b))).map(|delta| delta.vertex)
        };
        watched.extend(self.model.morphs.iter().filter_map(farthest));
        watched.retain(|index| *index != u32::MAX);
        watched.sort_unstable();
        watched.dedup();
        watched
    }
}

fn boxes(model: &Model, vertices: &[u32]) -> Vec<[Vec3; 8]> {
    let mut points: Vec<Vec<Vec3>> = vec![Vec::new(); model.palette.len()];
    for vertex in vertices.iter().map(|index| &model.vertices[*index as usize]) {
        for (joint, weight) in vertex.joints.into_iter().zip(vertex.weights) {
            if weight > 0.0 {
                points[usize::from(joint)].push(vertex.position);
            }
        }
    }
    let corners = |points: Vec<Vec3>| match points.is_empty() {
        true => [Vec3::ZERO; 8],
        false => Bounds::around(points).corners(),
    };
    points.into_iter().map(corners).collect()
}

/// Along the axes and to the corners of a cube.
fn directions() -> [Vec3; 14] {
    std::array::from_fn(|index| {
        let sign = |bit: usize| if index >> bit & 1 == 1 { 1.0 } else { -1.0 };
        match index {
            0..8 => Vec3::new(sign(0), sign(1), sign(2)).normalize(),
            _ => Vec3::AXES[(index - 8) / 2] * sign(0),
        }
    })
}

/// The times of all curves and the middles between them, ascending, no two the same; evenly fewer of them where there are too many.
fn all_times(moving: &[Moving]) -> Vec<f32> {
    let mut times_s: Vec<f32> = moving.iter().flat_map(|moving| &moving.times_s).copied().collect();
    times_s.sort_unstable_by(f32::total_cmp);
    times_s.dedup();
    let between: Vec<f32> = times_s.windows(2).map(|pair| pair[0].midpoint(pair[1])).collect();
    times_s.extend(between);
    times_s.sort_unstable_by(f32::total_cmp);
    times_s.dedup();
    let step = times_s.len().div_ceil(MAX_VERIFIED_TIMES).max(1);
    times_s.into_iter().step_by(step).collect()
}

/// Finds how far a vertex moves per unit of error of each curve, at most.
struct ArmFinder<'a> {
    model: &'a Model,
    /// At a few times: local and global transforms of bones, palette.
    poses: Vec<(Vec<Trs>, Vec<Affine3A>, Vec<Affine3A>)>,
    /// By bone and channel: the number of its curve.
    bones: Vec<[Option<usize>; 3]>,
    /// The number of a morph target's curve, and how far it moves which vertices, in mesh space.
    morphs: Vec<(usize, HashMap<u32, f32>)>,
}

impl<'a> ArmFinder<'a> {
    fn new(model: &'a Model, clip: Option<usize>, sources: &[(Place, Source)]) -> Self {
        let duration_s = f64::from(model.duration_s(clip));
        let pose = |time: usize| {
            let locals = pose::source_pose(model, clip, duration_s * time as f64 / (ARM_TIMES - 1) as f64);
            let globals = pose::global_pose(model, &locals);
            let palette = pose::palette(model, &globals);
            (locals, globals, palette)
        };
        let (mut bones, mut morphs) = (vec![[None; 3]; model.bones.len()], Vec::new());
        let lengths = |morph: &Morph| morph.deltas.iter().map(|d| (d.vertex, d.position.length())).collect();
        for (curve, (place, _)) in sources.iter().enumerate() {
            match place {
                Place::Bone(bone, channel) => bones[*bone][*channel] = Some(curve),
                Place::Morph(morph) => morphs.push((curve, lengths(&model.morphs[*morph]))),
            }
        }
        Self { model, poses: (0..ARM_TIMES).map(pose).collect(), bones, morphs }
    }

    /// Curves that move a vertex, and metres per metre of translation, radian, unit of scale, or unit of weight.
    fn of(&self, index: u32) -> Vec<(usize, f32)> {
        let vertex = &self.model.vertices[index as usize];
        let shares = shares(self.model, vertex);
        let mut arms_m = vec![[0.0f32; 3]; shares.len()];
        let mut largest_scale = 0.0f32;
        for (locals, globals, palette) in &self.poses {
            let blended = pose::blend(palette, vertex.joints, vertex.weights);
            largest_scale = largest_scale.max(longest_axis(&blended));
            let place = blended.transform_point3a(vertex.position.into());
            for ((bone, share), arms_m) in shares.iter().zip(&mut arms_m) {
                let parent =
                    self.model.bones[*bone].parent.map_or(1.0, |p| longest_axis(&globals[p as usize]));
                let arm_m = share * place.distance(globals[*bone].translation);
                let scale = locals[*bone].scale.abs().min_element().max(1e-3);
                let now_m = [share * parent, arm_m, arm_m / scale];
                *arms_m = std::array::from_fn(|channel| arms_m[channel].max(now_m[channel]));
            }
        }
        let of_bone = |((bone, _), arms_m): (&(usize, f32), &[f32; 3])| {
            let curves = self.bones[*bone];
            let arms_m = *arms_m;
            (0..3).filter_map(move |channel| Some((curves[channel]?, arms_m[channel])))
        };
        let of_morph = |(curve, lengths): &(usize, HashMap<u32, f32>)| {
            Some((*curve, lengths.get(&index)? * largest_scale))
        };
        let bones = shares.iter().zip(&arms_m).flat_map(of_bone);
        bones.chain(self.morphs.iter().filter_map(of_morph)).collect()
    }
}

/// How much of a vertex follows each bone, directly or through the bone's children.
fn shares(model: &Model, vertex: &Vertex) -> Vec<(usize, f32)> {
    let mut shares: Vec<(usize, f32)> = Vec::new();
    for (joint, weight) in vertex.joints.into_iter().zip(vertex.weights).filter(|(_, weight)| *weight > 0.0) {
        let mut next = Some(model.palette[usize::from(joint)].bone as usize);
        while let Some(bone) = next {
            match shares.iter_mut().find(|(known, _)| *known == bone) {
                Some((_, share)) => *share += weight,
                None => shares.push((bone, weight)),
            }
            next = model.bones[bone].parent.map(|parent| parent as usize);
        }
    }
    shares
}

#[cfg(test)]
mod tests;

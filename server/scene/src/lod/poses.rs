//! Poses in which a coarser LOD must be good: the rest pose, a few of the most different poses of the clips, and some with
//! every joint bent, for poses outside the clips.

use crate::animation::pose::{self, blend};
use crate::{Cancel, Cancelled, Model};
use glam::{Affine3A, Quat, Vec3};

/// From clips.
const MAX_CLIP_POSES: usize = 5;
/// Moments that are looked at, over all clips.
const CANDIDATES: usize = 48;
const MAX_CLIPS: usize = 24;
/// Pairs of vertices whose distances tell poses apart, whatever moves the whole.
const PAIRS: usize = 256;
/// Bend of each joint in a pose of ours, radians.
const BEND_RAD: f32 = 0.5;

/// What a model is posed with.
pub struct PoseSet {
    /// First the rest pose, then those of clips.
    pub real: Vec<Vec<Vec3>>,
    /// With all joints bent.
    pub bent: Vec<Vec<Vec3>>,
}

/// Bone matrices and morph weights at one time.
struct SampledPose {
    palette: Vec<Affine3A>,
    morph_weights: Vec<f32>,
}

impl PoseSet {
    /// Positions of all vertices in each chosen pose, model space; `None` where the rest pose is not finite.
    ///
    /// # Errors
    /// Somebody asked to end.
    pub fn choose(model: &Model, cancel: &Cancel) -> Result<Option<Self>, Cancelled> {
        let rest = SampledPose::of_clip(model, None, 0.0);
        let at_rest = rest.positions(model);
        if !at_rest.iter().all(|p| p.is_finite()) {
            return Ok(None);
        }
        let moments = differing(model, rest, cancel)?;
        let count = if moments.is_empty() { 4 } else { 2 };
        let finite = |moment: &SampledPose| {
            Some(moment.positions(model)).filter(|all| all.iter().all(|p| p.is_finite()))
        };
        let real = std::iter::once(at_rest).chain(moments.iter().filter_map(finite)).collect();
        let bends = if moves(model) { count } else { 0 };
        let bent = (0..bends).map(|number| SampledPose::bent(model, number, bends));
        Ok(Some(Self { real, bent: bent.filter_map(|moment| finite(&moment)).collect() }))
    }
}

/// Whether anything but the whole can move.
fn moves(model: &Model) -> bool {
    let first = |v: &crate::Vertex| (v.joints, v.weights);
    let is_rigid = model.vertices.windows(2).all(|pair| first(&pair[0]) == first(&pair[1]));
    !is_rigid || !model.morphs.is_empty()
}

impl SampledPose {
    fn of_clip(model: &Model, clip: Option<usize>, t_s: f64) -> Self {
        let palette = pose::source_palette(model, clip, t_s);
        Self { palette, morph_weights: pose::source_morph_weights(model, clip, t_s) }
    }

    /// The rest pose with each joint bent about an axis of its own, and every `of`-th morph target on.
    fn bent(model: &Model, number: u32, of: u32) -> Self {
        let mut locals = pose::source_pose(model, None, 0.0);
        for (bone, local) in locals.iter_mut().enumerate() {
            if model.bones[bone].parent.is_some() {
                local.rotation *= Quat::from_axis_angle(direction(bone as u32, number), BEND_RAD);
            }
        }
        let is_on = |morph: usize| morph as u32 % of == number;
        Self {
            palette: pose::palette(model, &pose::global_pose(model, &locals)),
            morph_weights: (0..model.morphs.len()).map(|morph| f32::from(is_on(morph))).collect(),
        }
    }

    fn positions(&self, model: &Model) -> Vec<Vec3> {
        let vertices = pose::morphed(model, &self.morph_weights);
        let at = |v: &crate::Vertex| blend(&self.palette, v.joints, v.weights).transform_point3(v.position);
        vertices.iter().map(at).collect()
    }

    /// Numbers that stay as they are when the whole moves, and whose differences are metres.
    fn features(&self, model: &Model, pairs: &[[u32; 2]], reach_of_morph: &[f32]) -> Vec<f32> {
        let at = |v: u32| {
            let v = &model.vertices[v as usize];
            blend(&self.palette, v.joints, v.weights).transform_point3(v.position)
        };
        let distances = pairs.iter().map(|[a, b]| at(*a).distance(at(*b)));
        distances.chain(self.morph_weights.iter().zip(reach_of_morph).map(|(w, reach)| w * reach)).collect()
    }
}

/// Moments of the clips, each as different as possible from the rest pose and those before it.
fn differing(model: &Model, rest: SampledPose, cancel: &Cancel) -> Result<Vec<SampledPose>, Cancelled> {
    let pairs = pairs(model.vertices.len() as u32);
    let reach = |deltas: &[crate::MorphDelta]| deltas.iter().map(|d| d.position.length()).fold(0.0, f32::max);
    let reach_of_morph: Vec<f32> = model.morphs.iter().map(|morph| reach(&morph.deltas)).collect();
    let features = |moment: &SampledPose| moment.features(model, &pairs, &reach_of_morph);
    let at_rest = features(&rest);
    let least = 1e-3 * at_rest.iter().copied().fold(0.0, f32::max);
    let mut candidates: Vec<(SampledPose, Vec<f32>, f32)> = moments(model)
        .take_while(|_| !cancel.is_asked())
        .map(|moment| {
            let own = features(&moment);
            let difference = difference(&own, &at_rest);
            (moment, own, difference)
        })
        .filter(|(_, _, difference)| difference.is_finite())
        .collect();
    cancel.check()?;
    let mut chosen = Vec::new();
    while chosen.len() < MAX_CLIP_POSES {
        let best = (0..candidates.len()).max_by(|a, b| candidates[*a].2.total_cmp(&candidates[*b].2));
        let Some(best) = best.filter(|best| candidates[*best].2 > least) else { break };
        let (moment, own, _) = candidates.swap_remove(best);
        for (_, other, nearest) in &mut candidates {
            *nearest = nearest.min(difference(&own, other));
        }
        chosen.push(moment);
    }
    Ok(chosen)
}

fn moments(model: &Model) -> impl Iterator<Item = SampledPose> + '_ {
    let clips = model.clips.len().min(MAX_CLIPS);
    let each = CANDIDATES / clips.max(1);
    let times = (0..clips).flat_map(move |clip| (0..each).map(move |moment| (clip, moment)));
    times.map(move |(clip, moment)| {
        let t_s = f64::from(model.clips[clip].duration_s) * (moment as f64 + 0.5) / each as f64;
        SampledPose::of_clip(model, Some(clip), t_s)
    })
}

fn difference(a: &[f32], b: &[f32]) -> f32 {
    let sum: f32 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
    (sum / a.len().max(1) as f32).sqrt()
}

fn pairs(vertices: u32) -> Vec<[u32; 2]> {
    let vertex = |seed: u64| (scrambled(seed) % u64::from(vertices.max(1))) as u32;
    let count = if vertices > 0 { PAIRS as u64 } else { 0 };
    (0..count).map(|pair| [vertex(2 * pair), vertex(2 * pair + 1)]).collect()
}

/// A unit vector that looks random, the same at every call.
fn direction(bone: u32, number: u32) -> Vec3 {
    let bits = scrambled(u64::from(bone) << 8 | u64::from(number));
    let unit = |shift: u32| (bits >> shift & 0xf_ffff) as f32 / (1 << 20) as f32;
    let (z, angle) = (unit(0) * 2.0 - 1.0, unit(20) * std::f32::consts::TAU);
    let (sin, cos) = angle.sin_cos();
    let radius = (1.0 - z * z).max(0.0).sqrt();
    Vec3::new(radius * cos, radius * sin, z).try_normalize().unwrap_or(Vec3::Z)
}

/// Splitmix64: Steele, Lea and Flood 2014.
fn scrambled(seed: u64) -> u64 {
    let mut z = seed.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

//! How finely the keys of clips are sent. Their numbers become multiples of powers of two, so that chunks take few bytes; each
//! curve has its own, by how far a vertex is from the joint that the curve moves. It is that of the whole clip: chunks that share a
//! key have the same of it.

use glam::Vec4;
use shadecast_scene::animation::sampling::{SampledClip, SampledTrack, longest_axis};
use shadecast_scene::{Model, PaletteEntry};

/// A step of one number of a curve moves no vertex further than this, metres in the world. The errors of the joints of a chain add
/// up: some vertex of the dragon is off by nearly four times as much at some time.
const STEP_M: f32 = 4e-6;
/// The least that a unit of a curve counts for, metres in the world.
const LEAST_ARM_M: f32 = 1e-3;
/// The least distance of a vertex from a joint that moves it, metres in the world.
const LEAST_REACH_M: f32 = 0.01;
/// Single precision holds so many steps of a number exactly, as a power of two.
const MOST_STEPS_LOG2: i32 = 22;

/// Which powers of two the numbers of a curve are multiples of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Raster {
    value_log2: i32,
    tangent_log2: i32,
}

/// The rasters of a clip's curves.
#[derive(Clone, Debug)]
pub(crate) struct Rasters {
    /// By bone, in the clip's order: translation, rotation, scale.
    pub bones: Vec<[Raster; 3]>,
    /// By morph target.
    pub morphs: Vec<Raster>,
}

impl Raster {
    /// Of a curve a unit of which moves a vertex by so many metres in the world at most.
    fn new(track: &SampledTrack, arm_m: f32) -> Self {
        let least = |numbers: &[Vec4]| log2(largest(numbers)) - MOST_STEPS_LOG2;
        let value_log2 = log2(STEP_M / arm_m.max(LEAST_ARM_M)).max(least(&track.values));
        // Between two keys a cubic follows each of their tangents by less than a sixth of the time between them.
        let longest_s = track.times_s.windows(2).map(|pair| pair[1] - pair[0]).fold(1e-3, f32::max);
        let tangent_log2 = (value_log2 + log2(4.0 / longest_s)).max(least(&track.tangents));
        Self { value_log2, tangent_log2 }
    }

    /// The nearest that a value of the curve can be.
    pub(crate) fn value(self, value: Vec4) -> [f32; 4] {
        rounded(value, self.value_log2)
    }

    /// The nearest that a tangent of the curve can be.
    pub(crate) fn tangent(self, tangent: Vec4) -> [f32; 4] {
        rounded(tangent, self.tangent_log2)
    }
}

impl Rasters {
    /// Of a clip of a model that is drawn at this scale at most.
    pub(crate) fn of_clip(model: &Model, joints: &Joints, clip: &SampledClip, world_scale: f32) -> Self {
        let reaches = joints.reaches(model, clip);
        let mut above = vec![world_scale; clip.bones.len()];
        let mut bones = Vec::with_capacity(clip.bones.len());
        for (bone, tracks) in clip.bones.iter().enumerate() {
            if let Some(parent) = model.bones[bone].parent {
                above[bone] = above[parent as usize] * largest(&clip.bones[parent as usize][2].values);
            }
            let reach_m = (above[bone] * reaches[bone]).max(LEAST_REACH_M);
            // A quaternion that errs by so much turns by twice as much.
            let arms = [above[bone], 2.0 * largest(&tracks[2].values) * reach_m, reach_m];
            bones.push(std::array::from_fn(|curve| Raster::new(&tracks[curve], arms[curve])));
        }
        let scale_of = |entry: &PaletteEntry| {
            let bone = entry.bone as usize;
            longest_axis(&entry.bone_from_mesh) * above[bone] * largest(&clip.bones[bone][2].values)
        };
        let scale = model.palette.iter().map(scale_of).fold(0.0, f32::max);
        let delta = |morph: usize| {
            let deltas = model.morphs[morph].deltas.iter();
            deltas.map(|delta| delta.position.length()).fold(0.0, f32::max)
        };
        let morphs =
            clip.morphs.iter().enumerate().map(|(morph, track)| Raster::new(track, scale * delta(morph)));
        Self { bones, morphs: morphs.collect() }
    }

    /// Of a path on which the farthest vertex is so many metres from what moves along it.
    pub(crate) fn of_path(path: &SampledClip, reach_m: f32) -> Self {
        let arms = [1.0, 2.0 * reach_m, reach_m];
        let of = |tracks: &[SampledTrack; 3]| {
            std::array::from_fn(|curve| Raster::new(&tracks[curve], arms[curve]))
        };
        Self { bones: path.bones.iter().map(of).collect(), morphs: Vec::new() }
    }
}

/// What the joints of a model move.
#[derive(Clone, Debug)]
pub(crate) struct Joints {
    /// By bone, the distance of the farthest vertex that follows it, in its own units; 0 where none does.
    own_reaches: Vec<f32>,
}

impl Joints {
    /// Of a model.
    pub(crate) fn new(model: &Model) -> Self {
        let mut own_reaches = vec![0.0f32; model.bones.len()];
        for vertex in &model.vertices {
            for (joint, _) in vertex.joints.iter().zip(vertex.weights).filter(|(_, weight)| *weight > 0.0) {
                let entry = &model.palette[usize::from(*joint)];
                let own = &mut own_reaches[entry.bone as usize];
                *own = own.max(entry.bone_from_mesh.transform_point3(vertex.position).length());
            }
        }
        Self { own_reaches }
    }

    /// By bone, how far from it the vertices are at most that it and the bones after it move, if these are stretched out, in its
    /// own units.
    fn reaches(&self, model: &Model, clip: &SampledClip) -> Vec<f32> {
        let mut reaches = self.own_reaches.clone();
        // Parents go before their children.
        for bone in (0..model.bones.len()).rev() {
            let Some(parent) = model.bones[bone].parent else { continue };
            reaches[parent as usize] = reaches[parent as usize].max(beyond(&clip.bones[bone], reaches[bone]));
        }
        reaches
    }

    /// How far from the model's origin its vertices are at most while it plays a clip, in its own units.
    pub(crate) fn reach_of_model(&self, model: &Model, clip: &SampledClip) -> f32 {
        let (reaches, roots) = (self.reaches(model, clip), 0..model.bones.len());
        let roots = roots.filter(|bone| model.bones[*bone].parent.is_none());
        roots.map(|bone| beyond(&clip.bones[bone], reaches[bone])).fold(0.0, f32::max)
    }
}

/// How far from a bone's parent what is at most so far from the bone is at most; 0 where nothing is there.
fn beyond([translation, _, scale]: &[SampledTrack; 3], reach: f32) -> f32 {
    if reach == 0.0 {
        return 0.0;
    }
    let away = translation.values.iter().map(|value| value.truncate().length()).fold(0.0, f32::max);
    away + largest(&scale.values) * reach
}

fn largest(numbers: &[Vec4]) -> f32 {
    numbers.iter().map(|number| number.abs().max_element()).fold(0.0, f32::max)
}

/// The exponent of the power of two at or below a number; for 0 that of the smallest.
fn log2(number: f32) -> i32 {
    number.max(f32::MIN_POSITIVE).log2().floor() as i32
}

fn rounded(numbers: Vec4, step_log2: i32) -> [f32; 4] {
    let step = f64::from(step_log2).exp2();
    // 0 has no sign.
    numbers.to_array().map(|number| ((f64::from(number) / step).round() * step) as f32 + 0.0)
}

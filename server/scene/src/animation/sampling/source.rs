//! A model's source curves one by one, with the data that sampling needs of them.

use super::{SampledClip, SampledTrack};
use crate::animation::clip::{self, TrackValue};
use crate::{Bone, Interpolation, Model, MorphTrack, PaletteEntry, Path, Track, TrackValues, Trs, Vertex};
use glam::{Affine3A, Vec3, Vec4};

/// One curve of a model.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Source<'a> {
    /// Nothing moves it.
    Rest(Vec4),
    /// One channel of a bone.
    Bone(&'a Track),
    /// The weight of the track's morph of this number.
    Morph(&'a MorphTrack, u32),
}

impl Source<'_> {
    /// The value `t_s` seconds into the clip: xyz, xyzw of a rotation, or a weight in x.
    pub fn at(&self, t_s: f64) -> Vec4 {
        match self {
            Self::Rest(value) => *value,
            Self::Bone(track) => match clip::evaluate_track(track, t_s) {
                TrackValue::Translation(value) | TrackValue::Scale(value) => value.extend(0.0),
                TrackValue::Rotation(value) => value.into(),
            },
            Self::Morph(track, morph) => Vec4::X * clip::evaluate_morph_track(track, *morph, t_s),
        }
    }

    /// Values at some rising times. A rotation's sign is chosen so that neighbours lie in one hemisphere.
    pub fn aligned(&self, times_s: &[f32]) -> Vec<Vec4> {
        let mut values: Vec<Vec4> = times_s.iter().map(|time| self.at(f64::from(*time))).collect();
        if self.is_rotation() {
            for index in 1..values.len() {
                if values[index - 1].dot(values[index]) < 0.0 {
                    values[index] = -values[index];
                }
            }
        }
        values
    }

    /// Whether the values are quaternions.
    pub fn is_rotation(&self) -> bool {
        matches!(self, Self::Bone(Track { values: TrackValues::Rotation(_), .. }))
    }

    /// Whether the curve changes over time.
    pub fn varies(&self) -> bool {
        match self {
            Self::Rest(_) => false,
            Self::Bone(track) => clip::track_varies(track),
            Self::Morph(track, _) => clip::morph_track_varies(track),
        }
    }

    /// Times of the source's keys, seconds.
    pub fn times_s(&self) -> &[f32] {
        match self {
            Self::Rest(_) => &[0.0],
            Self::Bone(track) => &track.times_s,
            Self::Morph(track, _) => &track.times_s,
        }
    }

    /// How the source goes from key to key.
    pub fn interpolation(&self) -> Interpolation {
        match self {
            Self::Rest(_) => Interpolation::Step,
            Self::Bone(track) => track.interpolation,
            Self::Morph(track, _) => track.interpolation,
        }
    }
}

/// All curves of a model.
pub(crate) struct Sources<'a> {
    /// By bone: translation, rotation, scale.
    pub bones: Vec<[Source<'a>; 3]>,
    /// By morph target.
    pub morphs: Vec<Source<'a>>,
}

impl<'a> Sources<'a> {
    /// The curves of a clip; rest where it has none.
    pub fn new(model: &'a Model, clip: Option<usize>) -> Self {
        let rest = |Trs { translation, rotation, scale }: Trs| {
            [translation.extend(0.0), rotation.into(), scale.extend(0.0)].map(Source::Rest)
        };
        let mut bones: Vec<[Source; 3]> = model.bones.iter().map(|bone| rest(bone.rest)).collect();
        let mut morphs: Vec<Source> =
            model.morphs.iter().map(|morph| Source::Rest(Vec4::X * morph.rest_weight)).collect();
        for clip in clip.iter().map(|clip| &model.clips[*clip]) {
            for track in &clip.tracks {
                bones[track.bone as usize][channel(track)] = Source::Bone(track);
            }
            for track in &clip.morph_tracks {
                for morph in 0..track.morph_count {
                    morphs[(track.first_morph + morph) as usize] = Source::Morph(track, morph);
                }
            }
        }
        Self { bones, morphs }
    }

    /// Number of curves.
    pub fn count(&self) -> usize {
        3 * self.bones.len() + self.morphs.len()
    }

    /// A clip made curve by curve.
    pub fn map(&self, duration_s: f32, mut sampled: impl FnMut(&Source) -> SampledTrack) -> SampledClip {
        let bones = self.bones.iter().map(|bone| bone.each_ref().map(&mut sampled)).collect();
        SampledClip { duration_s, bones, morphs: self.morphs.iter().map(sampled).collect() }
    }
}

/// 0 translation, 1 rotation, 2 scale.
fn channel(track: &Track) -> usize {
    match track.values {
        TrackValues::Translation(_) => 0,
        TrackValues::Rotation(_) => 1,
        TrackValues::Scale(_) => 2,
    }
}

/// A model of one bone that moves as the path does, with vertices on the corners of a cube around everything that is
/// within `reach_m` of the path's origin.
pub(super) fn path_model(path: &Path, reach_m: f32) -> Model {
    let corner = |index: u32| {
        let side = |bit: u32| if index >> bit & 1 == 1 { reach_m } else { -reach_m };
        Vertex { position: Vec3::new(side(0), side(1), side(2)), ..Vertex::default() }
    };
    let mut clip = path.clip.clone();
    clip.tracks.iter_mut().for_each(|track| track.bone = 0);
    Model {
        name: "path".into(),
        bones: vec![Bone { name: "path".into(), parent: None, rest: Trs::IDENTITY }],
        palette: vec![PaletteEntry { bone: 0, bone_from_mesh: Affine3A::IDENTITY }],
        vertices: (0..8).map(corner).collect(),
        clips: vec![clip],
        ..Model::default()
    }
}

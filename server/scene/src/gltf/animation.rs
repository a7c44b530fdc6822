//! glTF animations to [`Clip`]s, with their curves unchanged.

use super::super::error::Fault;
use super::super::limits::MAX_DURATION_S;
use super::super::{Cancel, Clip, Interpolation, MorphTrack, Track, TrackValues};
use super::accessor::Reader;
use super::{Warnings, label};
use ::gltf::accessor::Dimensions;
use ::gltf::animation::Property;
use glam::{Quat, Vec3};
use shadecast_model::text::printable;
use std::collections::{HashMap, HashSet};
use std::ops::Range;

/// What the nodes of a file became, by glTF index.
#[derive(Clone, Copy)]
pub(super) struct Moved<'a> {
    pub(super) bone_of_node: &'a [u32],
    /// Only of nodes that show a mesh with morph targets.
    pub(super) morphs_of_node: &'a HashMap<usize, Range<u32>>,
}

/// Reads all animations.
pub(super) fn read_all(
    reader: Reader,
    moved: Moved,
    cancel: &Cancel,
    warnings: &mut Warnings,
) -> Result<Vec<Clip>, Fault> {
    let mut read = |animation| {
        cancel.check()?;
        read(reader, &animation, moved, warnings)
    };
    reader.document.animations().map(&mut read).collect()
}

fn read(
    reader: Reader,
    animation: &::gltf::Animation,
    moved: Moved,
    warnings: &mut Warnings,
) -> Result<Clip, Fault> {
    let element = label("animation", animation.index(), animation.name());
    let mut clip = Clip {
        name: animation.name().map_or_else(|| format!("clip {}", animation.index()), printable),
        ..Clip::default()
    };
    let mut seen = HashSet::new();
    for channel in animation.channels() {
        let (node, property) = (channel.target().node().index(), channel.target().property());
        if !seen.insert((node, property_number(property))) {
            warnings.insert("a node has several curves for one property; only the first is used".into());
            continue;
        }
        let element = format!("{element} channel {}", channel.index());
        let curve = Curve::read(reader, &channel, &element)?;
        let end_s = curve.times_s.last().copied().unwrap_or(0.0);
        clip.duration_s = clip.duration_s.max(end_s);
        match (property, moved.morphs_of_node.get(&node)) {
            (Property::MorphTargetWeights, Some(morphs)) => {
                clip.morph_tracks.push(curve.into_morph_track(morphs.clone())?);
            }
            (Property::MorphTargetWeights, None) => {
                warnings.insert("weight curves of nodes without morph targets are ignored".into());
            }
            _ => clip.tracks.push(curve.into_track(moved.bone_of_node[node])?),
        }
    }
    Ok(clip)
}

fn property_number(property: Property) -> u8 {
    match property {
        Property::Translation => 0,
        Property::Rotation => 1,
        Property::Scale => 2,
        Property::MorphTargetWeights => 3,
    }
}

/// A channel of an animation with its keys, before its values are read.
struct Curve<'a> {
    reader: Reader<'a>,
    property: Property,
    output: ::gltf::Accessor<'a>,
    times_s: Vec<f32>,
    interpolation: Interpolation,
    element: String,
}

impl<'a> Curve<'a> {
    fn read(
        reader: Reader<'a>,
        channel: &::gltf::animation::Channel<'a>,
        element: &str,
    ) -> Result<Self, Fault> {
        let sampler = channel.sampler();
        let interpolation = match sampler.interpolation() {
            ::gltf::animation::Interpolation::Step => Interpolation::Step,
            ::gltf::animation::Interpolation::Linear => Interpolation::Linear,
            ::gltf::animation::Interpolation::CubicSpline => Interpolation::CubicSpline,
        };
        Ok(Self {
            reader,
            property: channel.target().property(),
            output: sampler.output(),
            times_s: read_times(reader, &sampler.input(), element)?,
            interpolation,
            element: element.to_owned(),
        })
    }

    /// In-tangent, value and out-tangent of a spline, or the value alone.
    fn parts_per_key(&self) -> usize {
        if self.interpolation == Interpolation::CubicSpline { 3 } else { 1 }
    }

    fn check_count(&self, per_key: usize) -> Result<(), Fault> {
        let (found, keys) = (self.output.count(), self.times_s.len());
        if per_key.checked_mul(keys) == Some(found) {
            return Ok(());
        }
        let problem = format!("has {found} values for {keys} keys; {per_key} per key are needed");
        Err(Fault::new(&*self.element, problem))
    }

    fn output_element(&self) -> String {
        format!("{} output (accessor {})", self.element, self.output.index())
    }

    fn into_track(self, bone: u32) -> Result<Track, Fault> {
        self.check_count(self.parts_per_key())?;
        let values = match self.property {
            Property::Rotation => TrackValues::Rotation(self.rotations()?),
            Property::Scale => TrackValues::Scale(self.vectors()?),
            _ => TrackValues::Translation(self.vectors()?),
        };
        Ok(Track { bone, times_s: self.times_s, interpolation: self.interpolation, values })
    }

    fn into_morph_track(self, morphs: Range<u32>) -> Result<MorphTrack, Fault> {
        self.check_count(self.parts_per_key() * morphs.len())?;
        let weights = self.reader.floats::<1>(&self.output, Dimensions::Scalar, &self.output_element())?;
        Ok(MorphTrack {
            first_morph: morphs.start,
            morph_count: morphs.len() as u32,
            times_s: self.times_s,
            interpolation: self.interpolation,
            weights: weights.into_iter().flatten().collect(),
        })
    }

    fn vectors(&self) -> Result<Vec<Vec3>, Fault> {
        let values = self.reader.floats::<3>(&self.output, Dimensions::Vec3, &self.output_element())?;
        Ok(values.into_iter().map(Vec3::from_array).collect())
    }

    /// Keys are made unit length; the tangents of a cubic spline are not rotations and stay as they are.
    fn rotations(&self) -> Result<Vec<Quat>, Fault> {
        let element = self.output_element();
        let values = self.reader.floats::<4>(&self.output, Dimensions::Vec4, &element)?;
        let mut rotations: Vec<Quat> = values.into_iter().map(Quat::from_array).collect();
        for (index, rotation) in rotations.iter_mut().enumerate() {
            if self.parts_per_key() == 3 && index % 3 != 1 {
                continue;
            }
            let length = rotation.length();
            if !(length.is_finite() && length > 1e-6) {
                let problem = format!("value {index} is not a rotation: its length is {length}");
                return Err(Fault::new(element, problem));
            }
            *rotation = rotation.normalize();
        }
        Ok(rotations)
    }
}

fn read_times(reader: Reader, input: &::gltf::Accessor, element: &str) -> Result<Vec<f32>, Fault> {
    let element = format!("{element} input (accessor {})", input.index());
    let times: Vec<f32> =
        reader.floats::<1>(input, Dimensions::Scalar, &element)?.into_iter().flatten().collect();
    if times.is_empty() {
        return Err(Fault::new(element, "has no keys"));
    }
    if let Some(key) = times.windows(2).position(|pair| pair[0] >= pair[1]) {
        return Err(Fault::new(element, format!("key {} is not later than key {key}", key + 1)));
    }
    let last = times[times.len() - 1];
    if times[0] < 0.0 || last > MAX_DURATION_S {
        let problem = format!("keys from {} s to {last} s; 0 to {MAX_DURATION_S} s are supported", times[0]);
        return Err(Fault::new(element, problem));
    }
    Ok(times)
}

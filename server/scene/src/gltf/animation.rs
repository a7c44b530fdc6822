//! glTF animations to [`Clip`]s: curves are kept as the file has them.

use super::super::error::Fault;
use super::super::limits::MAX_DURATION_S;
use super::super::{Clip, Interpolation, Track, TrackValues};
use super::accessor::Reader;
use super::{Warnings, label};
use ::gltf::accessor::Dimensions;
use ::gltf::animation::Property;
use glam::{Quat, Vec3};
use std::collections::HashSet;

/// Reads all animations; `bone_of_node` maps glTF node indices to bones.
pub(super) fn read_all(
    reader: Reader,
    bone_of_node: &[u32],
    warnings: &mut Warnings,
) -> Result<Vec<Clip>, Fault> {
    reader.document.animations().map(|animation| read(reader, &animation, bone_of_node, warnings)).collect()
}

fn read(
    reader: Reader,
    animation: &::gltf::Animation,
    bone_of_node: &[u32],
    warnings: &mut Warnings,
) -> Result<Clip, Fault> {
    let element = label("animation", animation.index(), animation.name());
    let mut clip = Clip {
        name: animation.name().map_or_else(|| format!("clip {}", animation.index()), str::to_owned),
        ..Clip::default()
    };
    let mut seen = HashSet::new();
    for channel in animation.channels() {
        let (node, property) = (channel.target().node().index(), channel.target().property());
        if property == Property::MorphTargetWeights {
            warnings.insert(super::MORPH_WARNING.into());
            continue;
        }
        if !seen.insert((node, property_number(property))) {
            warnings.insert("of several curves for one property of a node the first is used".into());
            continue;
        }
        let track = read_track(
            reader,
            &channel,
            bone_of_node[node],
            &format!("{element} channel {}", channel.index()),
        )?;
        clip.duration_s = track.times_s.iter().copied().fold(clip.duration_s, f32::max);
        clip.tracks.push(track);
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

fn read_track(
    reader: Reader,
    channel: &::gltf::animation::Channel,
    bone: u32,
    element: &str,
) -> Result<Track, Fault> {
    let sampler = channel.sampler();
    let times_s = read_times(reader, &sampler.input(), element)?;
    let interpolation = match sampler.interpolation() {
        ::gltf::animation::Interpolation::Step => Interpolation::Step,
        ::gltf::animation::Interpolation::Linear => Interpolation::Linear,
        ::gltf::animation::Interpolation::CubicSpline => Interpolation::CubicSpline,
    };
    let output = sampler.output();
    let per_key = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
    if output.count() != per_key * times_s.len() {
        let problem =
            format!("has {} values for {} keys; {per_key} per key are needed", output.count(), times_s.len());
        return Err(Fault::new(element, problem));
    }
    let values = match channel.target().property() {
        Property::Rotation => TrackValues::Rotation(read_rotations(reader, &output, per_key, element)?),
        Property::Scale => TrackValues::Scale(read_vectors(reader, &output, element)?),
        _ => TrackValues::Translation(read_vectors(reader, &output, element)?),
    };
    Ok(Track { bone, times_s, interpolation, values })
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

fn read_vectors(reader: Reader, output: &::gltf::Accessor, element: &str) -> Result<Vec<Vec3>, Fault> {
    let element = format!("{element} output (accessor {})", output.index());
    let values = reader.floats::<3>(output, Dimensions::Vec3, &element)?;
    Ok(values.into_iter().map(Vec3::from_array).collect())
}

/// Keys are made unit length; the tangents of a cubic spline are not rotations and stay as they are.
fn read_rotations(
    reader: Reader,
    output: &::gltf::Accessor,
    per_key: usize,
    element: &str,
) -> Result<Vec<Quat>, Fault> {
    let element = format!("{element} output (accessor {})", output.index());
    let values = reader.floats::<4>(output, Dimensions::Vec4, &element)?;
    let mut rotations: Vec<Quat> = values.into_iter().map(Quat::from_array).collect();
    for (index, rotation) in rotations.iter_mut().enumerate() {
        if per_key == 3 && index % 3 != 1 {
            continue;
        }
        let length = rotation.length();
        if !(length.is_finite() && length > 1e-6) {
            return Err(Fault::new(
                element,
                format!("value {index} is not a rotation: its length is {length}"),
            ));
        }
        *rotation = rotation.normalize();
    }
    Ok(rotations)
}

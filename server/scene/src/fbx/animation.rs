//! Animation stacks to [`Clip`]s.
//!
//! FBX animates Euler angles in layers, by curves with tangents, under pre- and post-rotations and pivots. The library
//! evaluates all that and bakes it into keys. More keys are added where a straight line would leave the library's evaluation
//! (see [`curve`](super::curve)). The keys are cut to the stack's time range and moved to start at 0.

use super::convert::{self, rotation, vec3};
use super::curve::{Curve, Key, ROTATION, Range, SCALE, TRANSLATION, WEIGHT, refined, with_bends};
use super::hierarchy::Hierarchy;
use super::morph::{Channel, Morphs};
use super::{allocator, describe};
use crate::error::Fault;
use crate::{Bone, Cancel, Clip, Interpolation, MorphTrack, Track, TrackValues};
use glam::{Quat, Vec3};

/// Reads all stacks that move anything; where there are none, the curves that belong to no stack.
pub(super) fn read_all(
    scene: &ufbx::Scene,
    hierarchy: &Hierarchy,
    morphs: &Morphs,
    cancel: &Cancel,
) -> Result<Vec<Clip>, Fault> {
    let mut clips = Vec::new();
    for stack in &scene.anim_stacks {
        let element = convert::label("animation", &stack.element);
        let baker = Baker { scene, anim: &stack.anim, hierarchy, morphs, element, cancel };
        clips.push(baker.clip(convert::name("clip", &stack.element))?);
    }
    if scene.anim_stacks.count == 0 && scene.anim_layers.count > 0 {
        let element = "animation".into();
        let baker = Baker { scene, anim: &scene.anim, hierarchy, morphs, element, cancel };
        clips.push(baker.clip("clip 0".into())?);
    }
    clips.retain(|clip| !(clip.tracks.is_empty() && clip.morph_tracks.is_empty()));
    Ok(clips)
}

struct Baker<'a> {
    scene: &'a ufbx::Scene,
    anim: &'a ufbx::Anim,
    hierarchy: &'a Hierarchy,
    morphs: &'a Morphs,
    element: String,
    cancel: &'a Cancel,
}

impl Baker<'_> {
    fn fault(&self, problem: impl Into<String>) -> Fault {
        Fault::new(self.element.clone(), problem)
    }

    fn clip(&self, name: String) -> Result<Clip, Fault> {
        let options = ufbx::BakeOpts {
            temp_allocator: allocator(),
            result_allocator: allocator(),
            key_reduction_enabled: true,
            key_reduction_rotation: true,
            ..ufbx::BakeOpts::default()
        };
        let baked =
            ufbx::bake_anim(self.scene, self.anim, options).map_err(|error| self.fault(describe(&error)))?;
        let range = Range::of(&baked).map_err(|problem| self.fault(problem))?;
        let mut clip = Clip { name, duration_s: range.duration_s(), ..Clip::default() };
        for node in &*baked.nodes {
            self.cancel.check()?;
            self.add_tracks(node, &range, &mut clip.tracks)?;
        }
        for element in &*baked.elements {
            let channel = self.morphs.channels.iter().find(|c| c.element_id == element.element_id);
            let percent = element.props.iter().find(|prop| prop.name.as_ref() == "DeformPercent");
            if let (Some(channel), Some(percent)) = (channel, percent) {
                clip.morph_tracks.push(self.morph_track(channel, percent, &range)?);
            }
        }
        Ok(clip)
    }

    fn add_tracks(
        &self,
        source: &ufbx::BakedNode,
        range: &Range,
        tracks: &mut Vec<Track>,
    ) -> Result<(), Fault> {
        let bone = self.hierarchy.bone_of(source.typed_id);
        let Bone { name, rest, .. } = &self.hierarchy.bones[bone as usize];
        let node = &self.scene.nodes[source.typed_id as usize];
        let fault = || self.fault(format!("a key of node '{name}' is not finite"));
        let transform = |time: f64| ufbx::evaluate_transform(self.anim, node, time);
        let vectors = |keys, rest, law, of: fn(ufbx::Transform) -> ufbx::Vec3| {
            let keys = vector_keys(keys).ok_or_else(fault)?;
            let keys = refined(keys, range, law, |time| Some(vec3(of(transform(time)))));
            Ok::<_, Fault>(range.curve(&keys, rest, law))
        };
        let mut push = |curve: Option<Curve<Vec3>>, values: fn(Vec<Vec3>) -> TrackValues| {
            tracks.extend(curve.map(|curve| curve.into_track(bone, values)));
        };
        let translation =
            vectors(&source.translation_keys, rest.translation, &TRANSLATION, |t| t.translation)?;
        push(translation, TrackValues::Translation);
        push(vectors(&source.scale_keys, rest.scale, &SCALE, |t| t.scale)?, TrackValues::Scale);
        let keys = rotation_keys(&source.rotation_keys).ok_or_else(fault)?;
        let keys = refined(keys, range, &ROTATION, |time| rotation(transform(time).rotation));
        let rotations = range.curve(&keys, rest.rotation, &ROTATION);
        tracks.extend(rotations.map(|curve| curve.into_track(bone, TrackValues::Rotation)));
        Ok(())
    }

    /// Keys also where the channel's weight passes one at which a shape is fully there: the weights bend there.
    fn morph_track(
        &self,
        channel: &Channel,
        percent: &ufbx::BakedProp,
        range: &Range,
    ) -> Result<MorphTrack, Fault> {
        let key =
            |key: &ufbx::BakedVec3| Key { time: key.time, value: key.value.x / 100.0, flags: key.flags };
        let keys: Vec<Key<f64>> = percent.keys.iter().map(key).collect();
        if !keys.iter().all(|key| key.value.is_finite()) {
            return Err(self.fault("a key of a blend shape's weight is not finite"));
        }
        let element = ufbx::as_blend_channel(&self.scene.elements[channel.element_id as usize]);
        let weight = |time: f64| element.map(|element| ufbx::evaluate_blend_weight(self.anim, element, time));
        let keys = refined(keys, range, &WEIGHT, weight);
        // NaN differs from everything, so that a constant weight gets its key too.
        let curve = range.curve(&keys, f64::NAN, &WEIGHT);
        let curve = curve.ok_or_else(|| self.fault("a blend shape's weight has no keys"))?;
        let steps = curve.interpolation == Interpolation::Step;
        let bent = if steps { curve } else { with_bends(curve, &channel.targets) };
        let weights = bent.values.iter().flat_map(|weight| channel.weights(*weight));
        Ok(MorphTrack {
            first_morph: channel.first_morph,
            morph_count: channel.targets.len() as u32,
            weights: weights.map(|weight| weight as f32).collect(),
            times_s: bent.times_s,
            interpolation: bent.interpolation,
        })
    }
}

/// `None` where a value is not finite.
fn vector_keys(keys: &[ufbx::BakedVec3]) -> Option<Vec<Key<Vec3>>> {
    let key = |key: &ufbx::BakedVec3| {
        let value = vec3(key.value);
        value.is_finite().then_some(Key { time: key.time, value, flags: key.flags })
    };
    keys.iter().map(key).collect()
}

/// `None` where a value is not a rotation.
fn rotation_keys(keys: &[ufbx::BakedQuat]) -> Option<Vec<Key<Quat>>> {
    let key = |key: &ufbx::BakedQuat| {
        rotation(key.value).map(|value| Key { time: key.time, value, flags: key.flags })
    };
    keys.iter().map(key).collect()
}

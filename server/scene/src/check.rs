//! Validation of a model or a sampled clip: every index in range, every number finite, every length consistent. Importers
//! guarantee this themselves. Files on disk may have been changed by anyone who can write to them, with a fitting checksum.

use crate::animation::sampling::{KeyInterpolation, SampledClip, SampledTrack};
use crate::error::shown;
use crate::limits::{MAX_DELTAS, MAX_DURATION_S, MAX_IMAGE_SIDE, MAX_MORPHS, MAX_PALETTE, MAX_TEXELS};
use crate::patches::Patches;
use crate::split::MAX_INDICES;
use crate::{
    Bone, Clip, Interpolation, Light, LightKind, Lod, Material, Model, Morph, MorphTrack, Primitive, Texture,
    TextureSlot, Track, TrackValues, Vertex,
};
use glam::{Quat, Vec3, Vec4};

/// What is wrong.
pub(crate) type Unsound = &'static str;

type Checked = Result<(), Unsound>;

fn ensure(holds: bool, otherwise: Unsound) -> Checked {
    if holds { Ok(()) } else { Err(otherwise) }
}

/// That two things of a kind are equally many.
pub(crate) fn same_count(found: usize, expected: usize, what: Unsound) -> Checked {
    ensure(found == expected, what)
}

/// All of a model.
pub(crate) fn model(model: &Model) -> Checked {
    bones(&model.bones)?;
    ensure(model.palette.len() <= MAX_PALETTE, "too many palette entries")?;
    for entry in &model.palette {
        ensure((entry.bone as usize) < model.bones.len(), "a palette entry without bone")?;
        ensure(entry.bone_from_mesh.is_finite(), "a palette entry is not finite")?;
    }
    Geometry {
        vertices: &model.vertices,
        indices: &model.indices,
        primitives: &model.primitives,
        lods: &model.lods,
        patches: &model.patches,
        morphs: &model.morphs,
        palette: model.palette.len(),
        materials: model.materials.len(),
    }
    .check()?;
    model.materials.iter().try_for_each(|m| material(m, model.textures.len()))?;
    textures(&model.textures)?;
    for placed in &model.lights {
        ensure((placed.bone as usize) < model.bones.len(), "a light without bone")?;
        light(&placed.light)?;
    }
    model.clips.iter().try_for_each(|own| clip(own, model))?;
    ensure(model.name == shown(&model.name), "a name with control characters")
}

fn name(name: &str) -> Checked {
    ensure(name == shown(name), "a name with control characters")
}

fn bones(bones: &[Bone]) -> Checked {
    for (index, bone) in bones.iter().enumerate() {
        name(&bone.name)?;
        ensure(bone.parent.is_none_or(|parent| (parent as usize) < index), "a bone before its parent")?;
        let rest = bone.rest;
        ensure(rest.translation.is_finite() && rest.scale.is_finite(), "a rest pose is not finite")?;
        rotation(rest.rotation)?;
    }
    Ok(())
}

fn rotation(rotation: Quat) -> Checked {
    let length = rotation.length();
    ensure((0.5..2.0).contains(&length), "a rotation has no length, or is not finite")
}

/// What refinement changes of a model, and how much of the rest there is.
pub(crate) struct Geometry<'a> {
    pub(crate) vertices: &'a [Vertex],
    pub(crate) indices: &'a [u32],
    pub(crate) primitives: &'a [Primitive],
    pub(crate) lods: &'a [Lod],
    pub(crate) patches: &'a [Patches],
    pub(crate) morphs: &'a [Morph],
    pub(crate) palette: usize,
    pub(crate) materials: usize,
}

impl Geometry<'_> {
    pub(crate) fn check(&self) -> Checked {
        ensure(self.vertices.len() <= MAX_INDICES, "too many vertices")?;
        self.vertices.iter().try_for_each(|v| vertex(v, self.palette))?;
        self.level(self.indices, self.primitives)?;
        for lod in self.lods {
            ensure(lod.error_m.is_finite() && lod.error_m >= 0.0, "the error of a level is no distance")?;
            self.level(&lod.indices, &lod.primitives)?;
            same_count(lod.primitives.len(), self.primitives.len(), "a level lacks primitives")?;
        }
        if !self.patches.is_empty() {
            same_count(self.patches.len(), 1 + self.lods.len(), "a level without patches")?;
            let lods = self.lods.iter().map(|lod| lod.indices.len());
            let counts = std::iter::once(self.indices.len()).chain(lods);
            self.patches.iter().zip(counts).try_for_each(|(own, count)| self.patches_of(own, count))?;
        }
        self.check_morphs()
    }

    fn level(&self, indices: &[u32], primitives: &[Primitive]) -> Checked {
        ensure(indices.len() <= MAX_INDICES, "too many indices")?;
        let exists = |index: &u32| (*index as usize) < self.vertices.len();
        ensure(indices.iter().all(exists), "an index without vertex")?;
        let mut next = 0u32;
        for primitive in primitives {
            ensure(primitive.first_index == next, "a primitive does not follow the one before")?;
            ensure(primitive.index_count.is_multiple_of(3), "a primitive ends inside a triangle")?;
            ensure((primitive.material as usize) < self.materials, "a primitive without material")?;
            next = next.checked_add(primitive.index_count).ok_or("a primitive without end")?;
        }
        same_count(next as usize, indices.len(), "primitives do not cover their indices")
    }

    fn patches_of(&self, own: &Patches, index_count: usize) -> Checked {
        same_count(own.patch_of_triangle.len(), index_count / 3, "a triangle without patch")?;
        let exists = |patch: &u32| (*patch as usize) < own.patches.len();
        ensure(own.patch_of_triangle.iter().all(exists), "a patch that there is not")?;
        for patch in &own.patches {
            let exist = patch.vertices.iter().all(|vertex| (*vertex as usize) < self.vertices.len());
            ensure(exist, "a patch without vertex")?;
            ensure((patch.material as usize) < self.materials, "a patch without material")?;
        }
        Ok(())
    }

    fn check_morphs(&self) -> Checked {
        ensure(self.morphs.len() <= MAX_MORPHS, "too many morph targets")?;
        // Refinement adds deltas for the middles of edges.
        let most = MAX_DELTAS.max(MAX_INDICES);
        ensure(self.morphs.iter().all(|morph| morph.deltas.len() <= most), "too many deltas")?;
        for morph in self.morphs {
            name(&morph.name)?;
            ensure(morph.rest_weight.is_finite(), "a weight is not finite")?;
            let rises = morph.deltas.windows(2).all(|pair| pair[0].vertex < pair[1].vertex);
            ensure(rises, "deltas are not sorted")?;
            let last = morph.deltas.last().map_or(0, |delta| delta.vertex as usize + 1);
            ensure(last <= self.vertices.len(), "a delta without vertex")?;
            let finite = |v: [Vec3; 3]| v.iter().all(|v| v.is_finite());
            let all = morph.deltas.iter().all(|d| finite([d.position, d.normal, d.tangent]));
            ensure(all, "a delta is not finite")?;
        }
        Ok(())
    }
}

fn vertex(v: &Vertex, palette: usize) -> Checked {
    let uvs = v.uv.iter().chain(&v.uv1);
    let mut numbers = v.tangent.iter().chain(uvs).chain(&v.weights);
    let finite = v.position.is_finite() && v.normal.is_finite() && numbers.all(|number| number.is_finite());
    ensure(finite, "a vertex is not finite")?;
    ensure(v.joints.iter().all(|joint| usize::from(*joint) < palette), "a vertex follows no palette entry")?;
    let sum: f32 = v.weights.iter().sum();
    let are_shares = v.weights.iter().all(|weight| *weight >= 0.0) && (sum - 1.0).abs() < 1e-2;
    ensure(are_shares, "the weights of a vertex are no shares")
}

fn material(material: &Material, textures: usize) -> Checked {
    name(&material.name)?;
    let scales = [material.metallic, material.roughness, material.normal_scale, material.occlusion_strength];
    let colours = material.base_color.iter().chain(&material.emissive).chain(&material.alpha_cutoff);
    ensure(scales.iter().chain(colours).all(|n| n.is_finite()), "a factor is not finite")?;
    for TextureSlot { texture, set, uv_transform } in material.texture_slots().into_iter().flatten() {
        ensure((texture as usize) < textures && set <= 1, "a texture that there is not")?;
        ensure(uv_transform.iter().flatten().all(|n| n.is_finite()), "a transform is not finite")?;
    }
    Ok(())
}

fn textures(textures: &[Texture]) -> Checked {
    let mut total = 0usize;
    for texture in textures {
        name(&texture.name)?;
        let [width, height] = texture.extent_texels;
        let sides = 1..=MAX_IMAGE_SIDE;
        ensure(sides.contains(&width) && sides.contains(&height), "a texture of no size")?;
        let texels = width as usize * height as usize;
        same_count(texture.rgba8.len(), 4 * texels, "a texture without all its texels")?;
        total += texels;
    }
    ensure(total <= 2 * MAX_TEXELS, "too many texels")
}

fn light(light: &Light) -> Checked {
    name(&light.name)?;
    let shines = light.intensity.is_finite() && light.intensity.min_element() >= 0.0;
    let fades = light.range_m.is_none_or(|range| range.is_finite() && range > 0.0);
    let opens = match light.kind {
        LightKind::Directional | LightKind::Point => true,
        LightKind::Spot { inner_cone_rad, outer_cone_rad } => {
            // Not true of what is no number.
            inner_cone_rad >= 0.0 && inner_cone_rad < outer_cone_rad && outer_cone_rad <= 1.6
        }
    };
    ensure(shines && fades && opens, "a light is out of range")
}

fn clip(clip: &Clip, model: &Model) -> Checked {
    name(&clip.name)?;
    ensure((0.0..=MAX_DURATION_S).contains(&clip.duration_s), "a clip of no duration")?;
    for own in &clip.tracks {
        ensure((own.bone as usize) < model.bones.len(), "a curve without bone")?;
        track(own, clip.duration_s)?;
    }
    let mut moved = vec![false; model.morphs.len()];
    for own in &clip.morph_tracks {
        let end = own.first_morph.checked_add(own.morph_count).ok_or("a curve without end")?;
        let range = moved.get_mut(own.first_morph as usize..end as usize);
        let range = range.filter(|range| !range.is_empty()).ok_or("a curve without morph target")?;
        ensure(!range.contains(&true), "two curves of one morph target")?;
        range.fill(true);
        morph_track(own, clip.duration_s)?;
    }
    Ok(())
}

fn times(times_s: &[f32], duration_s: f32) -> Checked {
    let (first, last) = (times_s.first().ok_or("a curve without keys")?, times_s[times_s.len() - 1]);
    ensure(*first >= 0.0 && last <= duration_s, "keys outside their clip")?;
    ensure(times_s.windows(2).all(|pair| pair[0] < pair[1]), "keys are not sorted")
}

fn values_per_key(interpolation: Interpolation) -> usize {
    if interpolation == Interpolation::CubicSpline { 3 } else { 1 }
}

fn track(track: &Track, duration_s: f32) -> Checked {
    times(&track.times_s, duration_s)?;
    let per_key = values_per_key(track.interpolation);
    let expected = per_key * track.times_s.len();
    match &track.values {
        TrackValues::Translation(values) | TrackValues::Scale(values) => {
            same_count(values.len(), expected, "a curve without all its values")?;
            ensure(values.iter().all(|value| value.is_finite()), "a value is not finite")
        }
        TrackValues::Rotation(values) => {
            same_count(values.len(), expected, "a curve without all its values")?;
            ensure(values.iter().all(|value| value.is_finite()), "a value is not finite")?;
            // Of in-tangent, value and out-tangent the value alone is a rotation.
            values.iter().skip(per_key / 2).step_by(per_key).try_for_each(|value| rotation(*value))
        }
    }
}

fn morph_track(track: &MorphTrack, duration_s: f32) -> Checked {
    times(&track.times_s, duration_s)?;
    let per_key = values_per_key(track.interpolation) as u64 * u64::from(track.morph_count);
    let expected = per_key * track.times_s.len() as u64;
    ensure(track.weights.len() as u64 == expected, "a curve without all its weights")?;
    ensure(track.weights.iter().all(|weight| weight.is_finite()), "a weight is not finite")
}

/// A sampled clip of a model (`None`: its rest pose).
pub(crate) fn sampled_clip(sampled: &SampledClip, model: &Model, clip: Option<usize>) -> Checked {
    ensure(sampled.duration_s == model.duration_s(clip), "the clip's duration is another one")?;
    same_count(sampled.bones.len(), model.bones.len(), "not a curve for each bone")?;
    same_count(sampled.morphs.len(), model.morphs.len(), "not a curve for each morph target")?;
    sampled.tracks().try_for_each(|track| sampled_track(track, sampled.duration_s))?;
    for [_, rotations, _] in &sampled.bones {
        ensure(rotations.values.iter().all(|value| *value != Vec4::ZERO), "a rotation has no length")?;
    }
    Ok(())
}

fn sampled_track(track: &SampledTrack, duration_s: f32) -> Checked {
    let keys = track.values.len();
    // Keys are at times of the clip, and the last may round beyond its end.
    times(&track.times_s, duration_s * (1.0 + 1e-5) + f32::MIN_POSITIVE)?;
    same_count(track.times_s.len(), keys, "a curve without all its times")?;
    ensure(track.interval_s.is_finite() && track.interval_s >= 0.0, "an interval is no time")?;
    let has_tangents = track.interpolation == KeyInterpolation::Cubic;
    let tangents = if has_tangents { keys } else { 0 };
    same_count(track.tangents.len(), tangents, "a curve without all its tangents")?;
    let mut all = track.values.iter().chain(&track.tangents);
    ensure(all.all(|value| value.is_finite()), "a value is not finite")
}

//! Rules that tests and fuzz targets verify on every importer's models, whatever the file.

use crate::animation::pose;
use crate::animation::sampling::{Sampling, sample};
use crate::{Interpolation, Model, TrackValues};
use glam::{Affine3A, Vec3};

/// What every model must keep, whatever the file was.
#[track_caller]
pub fn assert_sound(model: &Model, context: &str) {
    for (index, bone) in model.bones.iter().enumerate() {
        assert!(bone.parent.is_none_or(|parent| (parent as usize) < index), "{context}: bone {index}");
        assert!(bone.rest.translation.is_finite() && bone.rest.scale.is_finite(), "{context}: bone {index}");
        assert!(bone.rest.rotation.is_normalized(), "{context}: bone {index}");
    }
    assert!(model.palette.iter().all(|entry| (entry.bone as usize) < model.bones.len()), "{context}");
    for (index, vertex) in model.vertices.iter().enumerate() {
        let unit = |v: Vec3| (v.length() - 1.0).abs() < 1e-3;
        assert!(
            vertex.position.is_finite() && vertex.uv.iter().all(|c| c.is_finite()),
            "{context}: vertex {index}"
        );
        assert!(unit(vertex.normal), "{context}: vertex {index} normal {}", vertex.normal);
        assert!(
            unit(Vec3::from_slice(&vertex.tangent[..3])),
            "{context}: vertex {index} {:?}",
            vertex.tangent
        );
        assert!(vertex.tangent[3].abs() == 1.0, "{context}: vertex {index}");
        assert!(
            vertex.joints.iter().all(|joint| (*joint as usize) < model.palette.len()),
            "{context}: vertex {index}"
        );
        let sum: f32 = vertex.weights.iter().sum();
        assert!(
            (sum - 1.0).abs() < 1e-5 && vertex.weights.iter().all(|w| *w >= 0.0),
            "{context}: vertex {index}"
        );
    }
    let mut next = 0;
    for primitive in &model.primitives {
        assert_eq!(primitive.first_index, next, "{context}");
        assert!(primitive.index_count % 3 == 0 && primitive.index_count > 0, "{context}");
        assert!((primitive.material as usize) < model.materials.len(), "{context}");
        next += primitive.index_count;
    }
    assert_eq!(next as usize, model.indices.len(), "{context}");
    assert!(model.indices.iter().all(|index| (*index as usize) < model.vertices.len()), "{context}");
    for texture in &model.textures {
        let [width, height] = texture.extent_texels;
        assert!(
            texture.rgba8.len() == 4 * width as usize * height as usize && width * height > 0,
            "{context}"
        );
    }
    for material in &model.materials {
        let textures = [material.base_color_texture, material.normal_texture, material.emissive_texture];
        let others = [material.metallic_roughness_texture, material.occlusion_texture];
        let mut used = textures.into_iter().chain(others).flatten();
        assert!(used.all(|slot| (slot.texture as usize) < model.textures.len()), "{context}");
    }
    assert_clips_sound(model, context);
    assert_morphs_sound(model, context);
    for light in &model.lights {
        assert!((light.bone as usize) < model.bones.len(), "{context}: light {}", light.light.name);
        assert!(light.light.intensity.is_finite(), "{context}: light {}", light.light.name);
    }
}

#[track_caller]
fn assert_clips_sound(model: &Model, context: &str) {
    for (index, clip) in model.clips.iter().enumerate() {
        assert!(clip.duration_s.is_finite() && clip.duration_s >= 0.0, "{context}: clip {index}");
        let mut seen = std::collections::HashSet::new();
        for track in &clip.tracks {
            let channel = (track.bone, std::mem::discriminant(&track.values));
            assert!(seen.insert(channel), "{context}: clip {index} has two tracks for {channel:?}");
            let ends = track.times_s[0] >= 0.0 && track.times_s[track.times_s.len() - 1] <= clip.duration_s;
            assert!(ends, "{context}: clip {index} keys outside its {} s", clip.duration_s);
        }
    }
    for track in model.clips.iter().flat_map(|clip| &clip.tracks) {
        assert!((track.bone as usize) < model.bones.len(), "{context}");
        assert!(
            track.times_s.windows(2).all(|pair| pair[0] < pair[1]) && !track.times_s.is_empty(),
            "{context}"
        );
        let per_key = if track.interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        let count = match &track.values {
            TrackValues::Translation(values) | TrackValues::Scale(values) => values.len(),
            TrackValues::Rotation(values) => values.len(),
        };
        assert_eq!(count, per_key * track.times_s.len(), "{context}");
    }
}

#[track_caller]
fn assert_morphs_sound(model: &Model, context: &str) {
    for (index, morph) in model.morphs.iter().enumerate() {
        assert!(morph.rest_weight.is_finite(), "{context}: morph {index}");
        let ascending = morph.deltas.windows(2).all(|pair| pair[0].vertex < pair[1].vertex);
        assert!(ascending, "{context}: morph {index} has unsorted deltas");
        for delta in &morph.deltas {
            assert!((delta.vertex as usize) < model.vertices.len(), "{context}: morph {index}");
            let finite = delta.position.is_finite() && delta.normal.is_finite() && delta.tangent.is_finite();
            assert!(finite, "{context}: morph {index} vertex {}", delta.vertex);
        }
    }
    for clip in &model.clips {
        let mut moved = vec![false; model.morphs.len()];
        for track in &clip.morph_tracks {
            let range = track.first_morph as usize..(track.first_morph + track.morph_count) as usize;
            assert!(!range.is_empty() && range.end <= moved.len(), "{context}: {range:?}");
            assert!(moved[range.clone()].iter().all(|moved| !moved), "{context}: {range:?} moved twice");
            moved[range].fill(true);
            let rising = track.times_s.windows(2).all(|pair| pair[0] < pair[1]);
            assert!(rising && !track.times_s.is_empty(), "{context}: morph track times");
            let per_key = if track.interpolation == Interpolation::CubicSpline { 3 } else { 1 };
            let count = per_key * track.times_s.len() * track.morph_count as usize;
            assert_eq!(track.weights.len(), count, "{context}: morph track weights");
            assert!(track.weights.iter().all(|weight| weight.is_finite()), "{context}: morph track weights");
        }
    }
}

/// Whatever loads must also be usable.
pub fn exercise(model: &Model) {
    for clip in (0..model.clips.len()).map(Some).chain([None]) {
        let duration_s = clip.map_or(1.0, |clip| model.clips[clip].duration_s);
        let sampled = sample(model, clip, Sampling::Constant { interval_s: (duration_s / 4.0).max(1e-3) });
        let palette = pose::palette(model, &pose::global_pose(model, &sampled.local_pose(0.3)));
        let vertices = pose::morphed(model, &sampled.morph_weights(0.3));
        assert_eq!(pose::skin(&vertices, &palette, Affine3A::IDENTITY).len(), model.vertices.len());
        pose::animated_vertices(model, clip);
    }
}

/// Whether a damaged file that calls itself `name` was loaded all the same, to something sound and usable; else it was
/// refused with an error that names it and the element. A panic fails the test and shows `context`.
#[cfg(test)]
pub fn is_sound_or_refused(loaded: Result<Model, crate::SceneError>, name: &str, context: &str) -> bool {
    match loaded {
        Ok(model) => {
            assert_sound(&model, context);
            exercise(&model);
            true
        }
        Err(error) => {
            let text = error.to_string();
            let names_both = text.starts_with(&format!("{name}: ")) && text.matches(": ").count() >= 2;
            assert!(names_both, "{context}: '{text}'");
            false
        }
    }
}

/// `SHADECAST_MUTATIONS=100 cargo test ...` tries a hundred times as many.
#[cfg(test)]
pub fn effort() -> u32 {
    std::env::var("SHADECAST_MUTATIONS").ok().and_then(|factor| factor.parse().ok()).unwrap_or(1)
}

//! Equality of asset parts. A scene stores equal parts once, however many files have them.

use crate::Model;
use serde::Serialize;

/// A hash of content; equal content, equal hash.
pub type ContentHash = [u8; 32];

fn hash_of(content: &impl Serialize) -> ContentHash {
    let bytes = postcard::to_allocvec(content).expect("plain data serialises");
    *blake3::hash(&bytes).as_bytes()
}

/// Vertices, triangles, levels of detail and morph targets.
pub fn mesh_hash(model: &Model) -> ContentHash {
    hash_of(&(&model.vertices, &model.indices, &model.primitives, &model.lods, &model.morphs))
}

/// Hierarchy, rest pose and inverse bind matrices; names do not matter.
pub fn skeleton_hash(model: &Model) -> ContentHash {
    let bones: Vec<_> = model.bones.iter().map(|bone| (bone.parent, bone.rest)).collect();
    hash_of(&(bones, &model.palette))
}

/// Curves of a clip (`None`: of the rest pose); its name does not matter.
pub fn clip_hash(model: &Model, clip: Option<usize>) -> ContentHash {
    let weights: Vec<f32> = model.morphs.iter().map(|morph| morph.rest_weight).collect();
    let clip = clip.map(|clip| &model.clips[clip]);
    hash_of(&(weights, clip.map(|clip| (clip.duration_s, &clip.tracks, &clip.morph_tracks))))
}

/// Pixels and how they are read.
pub fn texture_hash(texture: &crate::Texture) -> ContentHash {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&texture.rgba8);
    let rest = postcard::to_allocvec(&(texture.extent_texels, texture.srgb, texture.wrap));
    hasher.update(&rest.expect("plain data serialises"));
    *hasher.finalize().as_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Bone, Clip, Interpolation, Track, TrackValues, Trs, Vertex};
    use glam::Vec3;

    fn model() -> Model {
        let track = Track {
            bone: 0,
            times_s: vec![0.0, 1.0],
            interpolation: Interpolation::Linear,
            values: TrackValues::Translation(vec![Vec3::ZERO, Vec3::X]),
        };
        Model {
            bones: vec![Bone { name: "a".into(), parent: None, rest: Trs::IDENTITY }],
            vertices: vec![Vertex::default(); 3],
            indices: vec![0, 1, 2],
            clips: vec![Clip { name: "c".into(), duration_s: 1.0, tracks: vec![track], ..Clip::default() }],
            ..Model::default()
        }
    }

    #[test]
    fn names_do_not_matter_and_content_does() {
        let (first, mut second) = (model(), model());
        second.bones[0].name = "b".into();
        second.clips[0].name = "d".into();
        assert_eq!(skeleton_hash(&first), skeleton_hash(&second));
        assert_eq!(clip_hash(&first, Some(0)), clip_hash(&second, Some(0)));
        assert_ne!(clip_hash(&first, Some(0)), clip_hash(&first, None));
        assert_eq!(mesh_hash(&first), mesh_hash(&second));
        second.vertices[2].position.x = 1e-7;
        second.bones[0].rest.scale.x = 2.0;
        second.clips[0].tracks[0].times_s[1] = 0.5;
        assert_ne!(mesh_hash(&first), mesh_hash(&second));
        assert_ne!(skeleton_hash(&first), skeleton_hash(&second));
        assert_ne!(clip_hash(&first, Some(0)), clip_hash(&second, Some(0)));
    }
}

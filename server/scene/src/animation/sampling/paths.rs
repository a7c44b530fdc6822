//! Paths of instances, sampled like any clip.

use super::{SampledClip, Sampling, sample_until, source, transform};
use crate::animation::played::PlayedBounds;
use crate::identity::{ContentHash, clip_hash};
use crate::{Cancel, Cancelled, Instance, Scene};
use glam::Affine3A;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;

/// The paths of all instances of a scene, sampled like clips: of one bone that moves the instance.
#[derive(Clone, Debug, Default)]
pub struct SampledPaths {
    of_instance: Vec<Option<Arc<SampledClip>>>,
}

impl SampledPaths {
    /// Each different one is sampled once, for the one who reaches farthest from the path's origin.
    pub fn new(scene: &Scene, sampling: Sampling) -> Self {
        Self::until(scene, sampling, &Cancel::default()).expect("nobody asks to end")
    }

    /// As [`Self::new`], until somebody asks to end.
    ///
    /// # Errors
    /// Somebody asked to end.
    pub fn until(scene: &Scene, sampling: Sampling, cancel: &Cancel) -> Result<Self, Cancelled> {
        let mut reaches = PlayedBounds::new(scene);
        let mut known: HashMap<(ContentHash, u32), Arc<SampledClip>> = HashMap::new();
        let mut of = |(index, instance): (usize, &Instance)| {
            let Some(path) = instance.path.as_ref() else { return Ok(None) };
            let of_model = reaches.of(index);
            let corners = if of_model.is_empty() { Vec::new() } else { of_model.corners().to_vec() };
            let lengths = corners.iter().map(|corner| instance.placement.transform_point3(*corner).length());
            // In steps of an eighth, so that instances that stand side by side share what they can.
            let reach_m = 2f32.powf((lengths.fold(0.01, f32::max).log2() * 8.0).ceil() / 8.0);
            let model = source::path_model(path, reach_m);
            let key = (clip_hash(&model, Some(0)), reach_m.to_bits());
            if let Some(clip) = known.get(&key) {
                return Ok(Some(clip.clone()));
            }
            let clip = Arc::new(sample_until(&model, Some(0), sampling, cancel)?);
            known.insert(key, clip.clone());
            Ok(Some(clip))
        };
        Ok(Self { of_instance: scene.instances.iter().enumerate().map(&mut of).collect::<Result<_, _>>()? })
    }

    /// `path * placement` of an instance at a time of the scene.
    pub fn world_from_model(&self, scene: &Scene, instance: usize, scene_time_s: f64) -> Affine3A {
        let (sampled, instance) = (&self.of_instance[instance], &scene.instances[instance]);
        match (sampled, &instance.path) {
            (Some(sampled), Some(path)) => {
                let bone = transform(&sampled.bones[0], path.phase_s(scene_time_s));
                bone.affine() * instance.placement
            }
            _ => instance.placement,
        }
    }

    /// The sampled path of an instance that has one.
    pub fn of(&self, instance: usize) -> Option<&Arc<SampledClip>> {
        self.of_instance[instance].as_ref()
    }

    /// Different curves.
    pub fn unique(&self) -> usize {
        let pointers: HashSet<_> = self.of_instance.iter().flatten().map(Arc::as_ptr).collect();
        pointers.len()
    }
}

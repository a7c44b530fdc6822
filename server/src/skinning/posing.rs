//! Single vertices of an instance at a time, on the CPU, for vertices sent as positions. The poses are those of the palettes,
//! by the same sampled curves.

use crate::animation::timeline::Shown;
use crate::scene::SceneGpu;
use glam::{Affine3A, Vec3};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::Model;
use shadecast_scene::animation::pose;

/// An instance at a time.
#[derive(Clone, Debug)]
pub struct CpuPose {
    world_from_mesh: Vec<Affine3A>,
    morph_weights: Vec<f32>,
}

impl CpuPose {
    /// Of an instance of the scene that shows this at a time.
    pub fn at(scene: &SceneGpu, instance: usize, shown: &Shown, time: WorldTime) -> Self {
        let (manager, placed) = (&scene.animation.manager, &scene.scene.instances[instance]);
        let model = &scene.scene.models[placed.model];
        let key = manager.pose_key(placed.model, instance, shown);
        let world_from_model = manager.paths.world_from_model(&scene.scene, instance, time.seconds());
        let globals = pose::global_pose(model, &manager.local_pose(placed.model, shown));
        let palette = pose::palette(model, &globals);
        Self {
            world_from_mesh: palette.into_iter().map(|matrix| world_from_model * matrix).collect(),
            morph_weights: manager.morph_weights(key).collect(),
        }
    }

    /// Where a vertex of its model is in the world, metres.
    pub fn vertex(&self, model: &Model, number: usize) -> Vec3 {
        let vertex = &model.vertices[number];
        let mut position = vertex.position;
        for (morph, weight) in model.morphs.iter().zip(&self.morph_weights).filter(|(_, w)| **w != 0.0) {
            if let Ok(place) = morph.deltas.binary_search_by_key(&(number as u32), |delta| delta.vertex) {
                position += *weight * morph.deltas[place].position;
            }
        }
        pose::blend(&self.world_from_mesh, vertex.joints, vertex.weights).transform_point3(position)
    }
}

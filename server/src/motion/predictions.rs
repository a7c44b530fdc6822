//! The paper's way: every update carries, for each visible moving vertex, its positions 33, 67 and 100 ms after the update. The
//! poses are those of these very times, not of the time grid. Two updates give different positions for the same time, so
//! triangles tear whose corners came with different updates.

use crate::animation::timeline::SharedTimeline;
use crate::scene::SceneGpu;
use crate::scene::numbering::SceneVertex;
use crate::skinning::posing::CpuPose;
use glam::Vec3;
use shadecast_protocol::ids::VertexSlot;
use shadecast_protocol::limits::PREDICTIONS;
use shadecast_protocol::motion::predicted::{PREDICTION_SPACING_S, PredictedVertex, Prediction};
use shadecast_protocol::time::WorldTime;
use std::collections::HashMap;

const COUNT: usize = PREDICTIONS as usize;

/// What an update of this time says of these vertices, which are those in the client's memory.
pub(crate) fn predictions(
    scene: &SceneGpu,
    timeline: &SharedTimeline,
    update: WorldTime,
    vertices: impl Iterator<Item = (VertexSlot, SceneVertex)>,
) -> Vec<PredictedVertex> {
    let empty: [Prediction; COUNT] = std::array::from_fn(|number| Prediction {
        position_m: Vec3::ZERO,
        since_update_s: PREDICTION_SPACING_S * (number + 1) as f32,
    });
    let times = empty.map(|prediction| prediction.time(update));
    // What was sent is not contradicted by a change meanwhile.
    timeline.lock().sampled(times[COUNT - 1]);
    let mut poses: HashMap<usize, [CpuPose; COUNT]> = HashMap::new();
    let predicted = |(slot, vertex): (VertexSlot, SceneVertex)| {
        let instance = scene.numbering.instance_of_vertex(vertex);
        let place = &scene.numbering.instances[instance];
        let pose = |time| CpuPose::at(scene, instance, &timeline.lock().at(instance, time), time);
        let poses = poses.entry(instance).or_insert_with(|| times.map(pose));
        let (model, number) = (&scene.scene.models[place.model], (vertex.0 - place.first_vertex.0) as usize);
        let mut predictions = empty;
        for (prediction, pose) in predictions.iter_mut().zip(poses) {
            prediction.position_m = pose.vertex(model, number);
        }
        PredictedVertex { slot, predictions }
    };
    vertices.map(predicted).collect()
}

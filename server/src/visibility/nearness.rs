//! How large what is in the scene can look: how many pixels of the client's display a metre of each model has, as near as any
//! predicted eye comes.

use crate::scene::SceneGpu;
use crate::time::VIEW_TIMES;
use crate::visibility::predict::PredictedViews;
use glam::{Affine3A, Vec3};
use shadecast_protocol::pose::NEAR_M;
use shadecast_protocol::time::Grid;
use shadecast_scene::animation::bounds::Bounds;
use shadecast_scene::animation::sampling::longest_axis;

/// By instance. The nearest point is that of the box around all that the instance can play, where its path has taken it at each of
/// the view times.
pub(crate) fn pixels_per_metre(
    scene: &SceneGpu,
    grid: Grid,
    views: &PredictedViews,
    pixels_per_radian: f32,
    pixels_per_metre: &mut Vec<f32>,
) {
    let paths = &scene.animation.manager.paths;
    let times_s = views.times.map(|at| at.time(grid).seconds());
    let of = |instance: usize| {
        let at_time = |time: usize| {
            let world_from_model = paths.world_from_model(&scene.scene, instance, times_s[time]);
            let eyes = views.eyes[time].map(|eye| eye.world_from_eye.position);
            seen_per_metre(scene.played_bounds[instance], &world_from_model, eyes)
        };
        pixels_per_radian * (0..VIEW_TIMES).map(at_time).fold(0.0, f32::max)
    };
    pixels_per_metre.clear();
    pixels_per_metre.extend((0..scene.played_bounds.len()).map(of));
}

/// Radians of a metre of a model, seen from the nearer of two eyes; 0 for an empty box.
fn seen_per_metre(of_model: Bounds, world_from_model: &Affine3A, eyes: [Vec3; 2]) -> f32 {
    if of_model.is_empty() {
        return 0.0;
    }
    let corners = of_model.corners().map(|corner| world_from_model.transform_point3(corner));
    let bounds = Bounds::around(corners);
    let distance_m = |eye: Vec3| eye.distance(eye.clamp(bounds.low, bounds.high));
    let nearest_m = eyes.into_iter().map(distance_m).fold(f32::MAX, f32::min);
    longest_axis(world_from_model) / nearest_m.max(NEAR_M)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    #[test]
    fn the_nearer_eye_and_the_nearest_point_of_the_box_count_and_so_does_scale() {
        let of_model = Bounds { low: Vec3::splat(-1.0), high: Vec3::splat(1.0) };
        let placed = Affine3A::from_scale_rotation_translation(
            Vec3::splat(2.0),
            Quat::IDENTITY,
            Vec3::new(0.0, 0.0, -12.0),
        );
        let seen = |x: [f32; 2]| seen_per_metre(of_model, &placed, x.map(|x| Vec3::new(x, 0.0, 0.0)));
        assert!((seen([0.0, 0.1]) - 2.0 / 10.0).abs() < 1e-6);
        assert!((seen([50.0, 2.0 + 7.5]) - 2.0 / 12.5).abs() < 1e-6, "past the side of the box");
        let inside = seen_per_metre(of_model, &placed, [Vec3::new(0.0, 0.0, -12.0); 2]);
        assert_eq!(inside, 2.0 / NEAR_M);
        assert_eq!(seen_per_metre(Bounds::EMPTY, &placed, [Vec3::ZERO; 2]), 0.0);
    }
}

//! Moving shadows, now or in the last second: still surfaces whose sunlight depends on moving geometry.
//!
//! Depth maps of moving and of still geometry are drawn here on the CPU from the true positions. The renderer's own shadow map
//! has no part in it.

use super::InstancePose;
use crate::measure::metrics::ProbeView;
use crate::measure::triangle::for_each_pixel;
use glam::{Mat4, Vec3};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::Scene;
use shadecast_scene::animation::bounds::Bounds;
use shadecast_server::scene::lights::{SHADOW_EXTENT_TEXELS, SunView};
use std::collections::BTreeMap;

/// How long a shadow that has gone still counts: what was shaded in it may still be on display.
const MEMORY_NS: i64 = 1_000_000_000;
/// Moments looked at lie on multiples of this, so that the next picture finds most of them done; and now.
const STEP_NS: i64 = 100_000_000;
/// Texels of a map's side.
const SIDE: usize = 1024;
/// A still surface shades itself no nearer than this, metres.
const BIAS_M: f32 = 0.03;

/// Depth maps of a scene.
pub struct MovingShadow {
    /// `None` where nothing that moves casts a shadow.
    map_from_world: Option<Mat4>,
    /// By instance.
    moves: Vec<bool>,
    still: DepthMap,
    /// By time, nanoseconds of the server.
    maps: BTreeMap<i64, DepthMap>,
}

/// Nearest to the sun by texel: 1 near, 0 far or nothing.
#[derive(Clone)]
struct DepthMap(Vec<f32>);

impl MovingShadow {
    /// For a scene of which these instances move, inside these boxes.
    pub fn new(scene: &Scene, moves: Vec<bool>, world_bounds: &[Bounds]) -> Self {
        let casters = (0..moves.len()).filter(|index| moves[*index] && scene.instances[*index].casts_shadow);
        let casters = casters.map(|index| world_bounds[index]);
        let view = SunView::around(scene.sun.to_sun, casters, SHADOW_EXTENT_TEXELS);
        let map_from_world = view.filter(|_| scene.sun.casts_shadows).map(|view| view.map_from_world);
        let mut found = Self { map_from_world, moves, still: DepthMap::empty(), maps: BTreeMap::new() };
        if let Some(map_from_world) = map_from_world {
            found.still = found.draw(scene, map_from_world, 0.0, false);
        }
        found
    }

    /// For each pixel of a truth, whether a moving shadow falls there or did within the last second.
    pub fn mask(
        &mut self,
        scene: &Scene,
        truth: &ProbeView,
        world_from_eye: Pose,
        fov: Fov,
        time: WorldTime,
    ) -> Vec<bool> {
        let Some(map_from_world) = self.map_from_world else { return vec![false; truth.instance.len()] };
        let recent = self.recent(scene, map_from_world, time);
        let bias = map_from_world.transform_vector3(scene.sun.to_sun * BIAS_M).z;
        let falls = |pixel: usize| {
            let stands = self.moves.get(truth.instance[pixel] as usize).is_some_and(|moves| !moves);
            if !stands {
                return false; // background, or what moves itself
            }
            let at = map_from_world.transform_point3(world_position(truth, world_from_eye, fov, pixel));
            !self.still.hides(at + Vec3::Z * bias, 0) && recent.hides(at, 1)
        };
        (0..truth.instance.len()).map(falls).collect()
    }

    /// What was nearest to the sun at any moment of the last second.
    fn recent(&mut self, scene: &Scene, map_from_world: Mat4, time: WorldTime) -> DepthMap {
        let from_ns = time.0 - MEMORY_NS;
        let first = from_ns.div_euclid(STEP_NS) + 1;
        let steps = (first..=time.0.div_euclid(STEP_NS)).map(|step| step * STEP_NS);
        for at_ns in steps.chain([time.0]) {
            if !self.maps.contains_key(&at_ns) {
                let map = self.draw(scene, map_from_world, at_ns as f64 * 1e-9, true);
                self.maps.insert(at_ns, map);
            }
        }
        self.maps.retain(|at_ns, _| {
            (from_ns..=time.0).contains(at_ns) && (at_ns % STEP_NS == 0 || *at_ns == time.0)
        });
        let mut nearest = DepthMap::empty();
        for map in self.maps.values() {
            nearest.0.iter_mut().zip(&map.0).for_each(|(nearest, depth)| *nearest = nearest.max(*depth));
        }
        nearest
    }

    fn draw(&self, scene: &Scene, map_from_world: Mat4, time_s: f64, moving: bool) -> DepthMap {
        let mut map = DepthMap::empty();
        let casts = |index: &usize| self.moves[*index] == moving && scene.instances[*index].casts_shadow;
        for index in (0..self.moves.len()).filter(casts) {
            let model = &scene.models[scene.instances[index].model];
            let pose = InstancePose::at(scene, index, time_s);
            let place = |vertex| map_from_world.transform_point3(pose.vertex(model, vertex).as_vec3());
            let places: Vec<Vec3> = (0..model.vertices.len()).map(place).collect();
            for corners in model.indices.chunks_exact(3) {
                map.add_triangle([0, 1, 2].map(|corner| places[corners[corner] as usize]));
            }
        }
        map
    }
}

/// Where in the world the surface lies that a truth shows at a pixel's centre.
fn world_position(truth: &ProbeView, world_from_eye: Pose, fov: Fov, pixel: usize) -> Vec3 {
    let (column, row) = (pixel % truth.width as usize, pixel / truth.width as usize);
    let across = (column as f32 + 0.5) / truth.width as f32;
    let down = (row as f32 + 0.5) / truth.height as f32;
    let [left, right, up, bottom] = [fov.left, fov.right, fov.up, fov.down].map(f32::tan);
    let ray = Vec3::new(left + (right - left) * across, up + (bottom - up) * down, -1.0);
    world_from_eye.position + world_from_eye.orientation * (ray * truth.depth_m[pixel])
}

impl DepthMap {
    fn empty() -> Self {
        Self(vec![0.0; SIDE * SIDE])
    }

    /// Whether something nearer to the sun than `at` (x and y 0 to 1) lies at its texel, or within `reach` texels of it.
    fn hides(&self, at: Vec3, reach: i32) -> bool {
        let texel = |place: f32| (place * SIDE as f32).floor() as i32;
        let (x, y) = (texel(at.x), texel(at.y));
        let depth = at.z.max(0.0);
        let inside = |place: i32| (0..SIDE as i32).contains(&place);
        let near = move |middle: i32| (middle - reach..=middle + reach).filter(move |place| inside(*place));
        near(y).any(|y| near(x).any(|x| self.0[y as usize * SIDE + x as usize] > depth))
    }

    /// Draws a triangle seen from either side, at the centres of texels.
    fn add_triangle(&mut self, corners: [Vec3; 3]) {
        let [a, b, c] =
            corners.map(|corner| Vec3::new(corner.x * SIDE as f32, corner.y * SIDE as f32, corner.z));
        for_each_pixel([a, b, c].map(Vec3::truncate), [SIDE; 2], |texel, [of_a, of_b, of_c]| {
            let depth = of_a * a.z + of_b * b.z + of_c * c.z;
            self.0[texel] = self.0[texel].max(depth);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::animation::bounds::{instance_bounds, model_bounds};
    use shadecast_scene::load::scene_from_text;
    use std::path::Path;

    /// A dragon that flies 4 m to the right in its first second and stays there, over a ground, under a sun straight above.
    fn scene(shadows: bool) -> Scene {
        let keys = "{ time_s = 0, translation = [-2, 1, 0] }, { time_s = 1, translation = [2, 1, 0] }";
        let text = format!(
            "[sun]\ndirection = [0, 1, 0]\nshadows = {shadows}\n[[model]]\nname = \"d\"\nfile = \"dragon\"\n\
             [[instance]]\nmodel = \"d\"\nclip = \"\"\nscale = 0.3\nrepetition = \"once\"\n\
             path = {{ repetition = \"once\", key = [{keys}] }}\n[ground]\nsize_m = 10\n"
        );
        scene_from_text(&text, "s.toml", Path::new("")).expect("good")
    }

    fn shadow(scene: &Scene) -> MovingShadow {
        let of_model = |i: &shadecast_scene::Instance| model_bounds(&scene.models[i.model], i.clip);
        let bounds: Vec<Bounds> = scene.instances.iter().map(|i| instance_bounds(i, of_model(i))).collect();
        MovingShadow::new(scene, vec![true, false], &bounds)
    }

    /// Looks straight down from 5 m at the ground: one pixel for each metre from -2 to 2 in x.
    fn ground(scene: &Scene, shadow: &mut MovingShadow, time_s: f64) -> Vec<bool> {
        let truth = ProbeView { width: 5, height: 1, instance: vec![1; 5], depth_m: vec![5.0; 5] };
        let down = glam::Quat::from_rotation_x(-std::f32::consts::FRAC_PI_2);
        let eye = Pose { position: Vec3::Y * 5.0, orientation: down };
        let half = 0.5f32.atan();
        let narrow = 0.01f32.atan();
        let fov = Fov { left: -half, right: half, up: narrow, down: -narrow };
        shadow.mask(scene, &truth, eye, fov, WorldTime((time_s * 1e9) as i64))
    }

    #[test]
    fn shadow_of_what_moves_counts_for_a_second() {
        let scene = scene(true);
        let mut shadow = shadow(&scene);
        let f = false;
        assert_eq!(ground(&scene, &mut shadow, 0.0), [true, f, f, f, f], "where it stands");
        assert_eq!(ground(&scene, &mut shadow, 0.5), [true, true, true, f, f], "where it has been");
        assert_eq!(ground(&scene, &mut shadow, 1.0)[1..], [true; 4], "all its way");
        assert_eq!(
            ground(&scene, &mut shadow, 2.2),
            [f, f, f, f, true],
            "what has been over for a second is forgotten"
        );
    }

    #[test]
    fn still_surfaces_exclude_movers_and_background() {
        let scene = scene(true);
        let mut shadow = shadow(&scene);
        let truth = ProbeView { width: 1, height: 1, instance: vec![0], depth_m: vec![5.0] };
        let eye = Pose { position: Vec3::new(-2.0, 5.0, 0.0), ..Pose::IDENTITY };
        let looks = |truth: &ProbeView, shadow: &mut MovingShadow| {
            shadow.mask(&scene, truth, eye, Fov::symmetric_degrees(90.0), WorldTime(0))
        };
        assert_eq!(looks(&truth, &mut shadow), [false]);
        let background = ProbeView { instance: vec![ProbeView::BACKGROUND], ..truth };
        assert_eq!(looks(&background, &mut shadow), [false]);
    }

    #[test]
    fn without_shadows_none_moves() {
        let scene = scene(false);
        assert_eq!(ground(&scene, &mut shadow(&scene), 0.5), [false; 5]);
    }

    #[test]
    fn a_triangle_hides_what_is_behind_it_alone() {
        let mut map = DepthMap::empty();
        map.add_triangle([Vec3::new(0.1, 0.1, 0.5), Vec3::new(0.9, 0.1, 0.5), Vec3::new(0.1, 0.9, 0.7)]);
        let hides = |x, y, z| map.hides(Vec3::new(x, y, z), 0);
        assert!(hides(0.3, 0.3, 0.4) && hides(0.2, 0.7, 0.6) && hides(0.3, 0.3, -3.0));
        assert!(
            !hides(0.3, 0.3, 0.7) && !hides(0.8, 0.8, 0.1) && !hides(1.5, 0.3, 0.1) && !hides(-0.1, 0.3, 0.1)
        );
        assert!(map.hides(Vec3::new(0.0995, 0.5, 0.1), 1), "within a texel");
    }
}

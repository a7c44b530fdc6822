//! All light of the scene at one time, for the shaders: sun and sky, lamps where their bones are, and the sun's view of
//! the casters. Pure; the stage that draws the shadow map owns the buffer.

use crate::animation::timeline::Timeline;
use crate::scene::gloss::Brightness;
use crate::scene::shine::StillLight;
use glam::{Affine3A, Mat4, Vec3};
use shadecast_protocol::limits::MAX_LIGHTS;
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::bounds::Bounds;
use shadecast_scene::animation::pose;
use shadecast_scene::{Environment, Light, LightKind, Scene, Sun};
use shadecast_shaders::ambient::Sky;
use shadecast_shaders::generated::{LightGpu, PunctualGpu};

/// Texels of a shadow map's side, unless a measurement wants more.
pub const SHADOW_EXTENT_TEXELS: u32 = 2048;
/// Empty texels around the casters: the filter reads two beyond a place, and what it finds outside must be lit.
const SHADOW_BORDER_TEXELS: f32 = 4.0;

/// The sun's parallel view of all casters. It depends on nothing that changes with time or with the viewer, so shadows
/// on what stands still do not crawl from one update to the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SunView {
    /// x and y 0 to 1 over the map (y down), z 1 nearest to the sun and 0 farthest.
    pub map_from_world: Mat4,
    /// Texels of a side of the map.
    pub extent_texels: u32,
    /// The larger side of a texel, metres.
    pub texel_m: f32,
}

impl SunView {
    /// Around boxes that hold the casters at any time, in a map of so many texels a side; `None` where nothing casts.
    pub fn around(to_sun: Vec3, casters: impl Iterator<Item = Bounds>, extent_texels: u32) -> Option<Self> {
        let sun_from_world = sun_from_world(to_sun);
        let corners = casters.filter(|bounds| !bounds.is_empty()).flat_map(Bounds::corners);
        let seen = Bounds::around(corners.map(|corner| sun_from_world.transform_point3(corner)));
        if seen.is_empty() || !(seen.low.is_finite() && seen.high.is_finite()) {
            return None;
        }
        let size = (seen.high - seen.low).max(Vec3::splat(1e-3));
        let inner = 1.0 - 2.0 * SHADOW_BORDER_TEXELS / extent_texels as f32;
        let scale = Vec3::new(inner / size.x, -inner / size.y, inner / size.z);
        let middle = (seen.low + seen.high) * 0.5;
        let map_from_sun = Mat4::from_translation(Vec3::splat(0.5))
            * Mat4::from_scale(scale)
            * Mat4::from_translation(-middle);
        let texel_m = size.x.max(size.y) / inner / extent_texels as f32;
        Some(Self { map_from_world: map_from_sun * sun_from_world, extent_texels, texel_m })
    }
}

/// x to the right, y up, z towards the sun, for somebody who looks along its rays.
fn sun_from_world(to_sun: Vec3) -> Mat4 {
    // Any direction across will do; the world's x, or z where the sun stands along x.
    let across = if to_sun.x.abs() < 0.9 { Vec3::X } else { Vec3::Z };
    let up = to_sun.cross(across).normalize();
    Mat4::from_cols(up.cross(to_sun).extend(0.0), up.extend(0.0), to_sun.extend(0.0), glam::Vec4::W)
        .transpose()
}

/// Corners of a box and of its shadow as far as the shadow can fall inside `scene`: a caster matters to a view that
/// misses its box where the hull of these points is in view.
pub(crate) fn caster_reach(caster: Bounds, to_sun: Vec3, scene: Bounds) -> [Vec3; 16] {
    let farthest = scene.corners().into_iter().map(|c| c.dot(to_sun)).fold(f32::INFINITY, f32::min);
    let corners = caster.corners();
    std::array::from_fn(|index| {
        let corner = corners[index % 8];
        let way = (corner.dot(to_sun) - farthest).max(0.0);
        if index < 8 { corner } else { corner - to_sun * way }
    })
}

/// Lamps beyond [`MAX_LIGHTS`]: placed ones count first, then those of the instances in their order.
pub(crate) fn surplus(scene: &Scene) -> usize {
    let hung = scene.instances.iter().map(|instance| scene.models[instance.model].lights.len());
    (scene.lights.len() + hung.sum::<usize>()).saturating_sub(MAX_LIGHTS as usize)
}

/// How bright the scene's light is at most; of lamps, a metre away.
pub(crate) fn brightness(scene: &Scene) -> Brightness {
    let hung = scene.models.iter().flat_map(|model| &model.lights).map(|hung| hung.light.intensity);
    let lamps = scene.lights.iter().map(|placed| placed.light.intensity).chain(hung);
    let lamps = lamps.map(Vec3::max_element).fold(0.0, f32::max);
    let direct = scene.sun.irradiance.max_element().max(lamps);
    let environment = scene.environment;
    let sky = environment.zenith.max(environment.horizon).max(environment.nadir).max_element();
    Brightness { direct, lamps, sky }
}

/// The light that stays.
pub(crate) fn still(scene: &Scene) -> StillLight {
    let Environment { zenith, horizon, nadir } = scene.environment;
    let Sun { to_sun, irradiance, .. } = scene.sun;
    StillLight { sky: Sky { zenith, horizon, nadir }, to_sun, irradiance }
}

/// Everything at a time of the scene, which moves as `timeline` says. `sun_view` is `None` where the sun casts no shadows.
pub(crate) fn at(
    scene: &Scene,
    timeline: &Timeline,
    sun_view: Option<&SunView>,
    time: WorldTime,
) -> LightGpu {
    let environment = scene.environment;
    let wide = |v: Vec3| v.extend(0.0).to_array();
    let mut punctual = [bytemuck::Zeroable::zeroed(); MAX_LIGHTS as usize];
    let mut count = 0;
    for (place, lamp) in punctual.iter_mut().zip(lamps(scene, timeline, time)) {
        *place = lamp;
        count += 1;
    }
    LightGpu {
        to_sun: wide(scene.sun.to_sun),
        irradiance: wide(scene.sun.irradiance),
        zenith: wide(environment.zenith),
        horizon: wide(environment.horizon),
        nadir: wide(environment.nadir),
        shadow_from_world: sun_view.map_or(Mat4::IDENTITY, |v| v.map_from_world).to_cols_array_2d(),
        shadow: sun_view.map_or([0.0; 4], |v| [v.extent_texels as f32, v.texel_m, 1.0, 0.0]),
        punctual_count: [count, 0, 0, 0],
        punctual,
    }
}

fn lamps<'a>(
    scene: &'a Scene,
    timeline: &'a Timeline,
    time: WorldTime,
) -> impl Iterator<Item = PunctualGpu> + 'a {
    let placed = scene.lights.iter().map(|placed| punctual(placed.world_from_light, &placed.light));
    let hung = (0..scene.instances.len()).flat_map(move |index| hung_lamps(scene, timeline, index, time));
    placed.chain(hung)
}

/// An instance's lamps, which follow their bones by the source curves.
fn hung_lamps(scene: &Scene, timeline: &Timeline, index: usize, time: WorldTime) -> Vec<PunctualGpu> {
    let instance = &scene.instances[index];
    let model = &scene.models[instance.model];
    if model.lights.is_empty() {
        return Vec::new();
    }
    let globals = pose::global_pose(model, &timeline.source_pose(model, index, time));
    let world_from_model = instance.world_from_model(time.seconds());
    let lamp = |hung: &shadecast_scene::ModelLight| {
        punctual(world_from_model * globals[hung.bone as usize], &hung.light)
    };
    model.lights.iter().map(lamp).collect()
}

fn punctual(world_from_light: Affine3A, light: &Light) -> PunctualGpu {
    let direction = -Vec3::from(world_from_light.matrix3.z_axis).normalize_or(Vec3::Z);
    let (parallel, scale, offset) = match light.kind {
        LightKind::Directional => (1.0, 0.0, 1.0),
        LightKind::Point => (0.0, 0.0, 1.0),
        LightKind::Spot { inner_cone_rad, outer_cone_rad } => {
            // KHR_lights_punctual, "Inner and Outer Cone Angles".
            let scale = 1.0 / (inner_cone_rad.cos() - outer_cone_rad.cos()).max(0.001);
            (0.0, scale, -outer_cone_rad.cos() * scale)
        }
    };
    let range = light.range_m.map_or(0.0, |range_m| 1.0 / range_m.max(1e-3));
    PunctualGpu {
        position_range: Vec3::from(world_from_light.translation).extend(range).to_array(),
        direction_kind: direction.extend(parallel).to_array(),
        intensity_cone_scale: light.intensity.extend(scale).to_array(),
        cone_offset: [offset, 0.0, 0.0, 0.0],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_scene::load::{SceneSource, load_scene};
    use shadecast_scene::{
        Bone, Clip, Instance, Interpolation, Model, ModelLight, PlacedLight, Track, TrackValues, Trs,
    };

    const BOX: Bounds = Bounds { low: Vec3::new(-1.0, 0.0, -3.0), high: Vec3::new(2.0, 1.5, -1.0) };

    #[test]
    fn every_corner_of_the_casters_lies_inside_the_map_and_its_border_is_free() {
        for to_sun in
            [Vec3::Y, Vec3::X, Vec3::new(-0.45, 0.75, 0.5).normalize(), Vec3::new(0.0, 0.1, -1.0).normalize()]
        {
            let view = SunView::around(to_sun, [BOX, Bounds::EMPTY].into_iter(), SHADOW_EXTENT_TEXELS)
                .expect("a caster");
            let border = 3.9 / SHADOW_EXTENT_TEXELS as f32;
            for corner in BOX.corners() {
                let at = view.map_from_world.transform_point3(corner);
                let inside = at.cmpge(Vec3::splat(border)).all() && at.cmple(Vec3::splat(1.0 - border)).all();
                assert!(inside, "{to_sun}: {corner} is at {at}");
            }
            let nearer = view.map_from_world.transform_vector3(to_sun);
            assert!(nearer.z > 0.0 && nearer.truncate().length() < 1e-5, "{to_sun}: {nearer}");
        }
        assert_eq!(SunView::around(Vec3::Y, [Bounds::EMPTY].into_iter(), SHADOW_EXTENT_TEXELS), None);
    }

    #[test]
    fn front_faces_of_casters_stay_counter_clockwise_in_the_map() {
        let to_sun = Vec3::new(0.3, 0.8, -0.2).normalize();
        let view = SunView::around(to_sun, [BOX].into_iter(), SHADOW_EXTENT_TEXELS).expect("a caster");
        // Facing up, counter-clockwise seen from above.
        let [a, b, c] =
            [Vec3::ZERO, Vec3::Z, Vec3::X].map(|p| view.map_from_world.transform_point3(p).truncate());
        // y runs down in the map, as in a picture: what turns counter-clockwise there has a negative area.
        assert!((b - a).perp_dot(c - a) < 0.0);
    }

    #[test]
    fn shadow_of_a_caster_reaches_the_far_side_of_the_scene() {
        let scene = Bounds { low: Vec3::splat(-10.0), high: Vec3::splat(10.0) };
        let reach = caster_reach(BOX, Vec3::Y, scene);
        assert_eq!(reach[..8], BOX.corners());
        assert!(reach[8..].iter().all(|p| (p.y + 10.0).abs() < 1e-4), "{reach:?}");
    }

    fn lamp(kind: LightKind) -> Light {
        Light { name: "lamp".into(), kind, intensity: Vec3::new(1.0, 2.0, 3.0), range_m: Some(4.0) }
    }

    #[test]
    fn lamp_on_a_bone_moves_with_it() {
        let mut scene = load_scene(&SceneSource::Dragons(1)).expect("built in");
        let values = TrackValues::Translation(vec![Vec3::ZERO, Vec3::new(0.0, 2.0, 0.0)]);
        let track = Track { bone: 0, times_s: vec![0.0, 1.0], interpolation: Interpolation::Linear, values };
        let model = Model {
            bones: vec![Bone { name: "b".into(), parent: None, rest: Trs::IDENTITY }],
            lights: vec![ModelLight { bone: 0, light: lamp(LightKind::Point) }],
            clips: vec![Clip { duration_s: 1.0, tracks: vec![track], ..Clip::default() }],
            ..Model::default()
        };
        let placement = Affine3A::from_translation(Vec3::X);
        scene.instances.push(Instance {
            clip: Some(0),
            placement,
            ..Instance::new("lamp", scene.models.len())
        });
        scene.models.push(model);
        let found = at(&scene, &Timeline::new(&scene), None, WorldTime(250_000_000));
        assert_eq!(found.punctual_count[0], 1);
        assert_eq!(found.punctual[0].position_range, [1.0, 0.5, 0.0, 0.25]);
        assert_eq!(found.shadow[2], 0.0, "no shadows without a view of the sun");
    }

    #[test]
    fn cone_fades_from_the_inner_to_the_outer_angle() {
        let spot = lamp(LightKind::Spot { inner_cone_rad: 0.3, outer_cone_rad: 0.6 });
        let gpu = punctual(Affine3A::from_rotation_x(-std::f32::consts::FRAC_PI_2), &spot);
        assert!(Vec3::from_slice(&gpu.direction_kind).abs_diff_eq(Vec3::NEG_Y, 1e-6), "{gpu:?}");
        let share =
            |angle: f32| (angle.cos() * gpu.intensity_cone_scale[3] + gpu.cone_offset[0]).clamp(0.0, 1.0);
        assert!((share(0.3) - 1.0).abs() < 1e-5 && share(0.6).abs() < 1e-5);
        assert!(share(0.45) > 0.3 && share(0.45) < 0.8);
    }

    #[test]
    fn lamps_beyond_the_limit_are_counted_and_left_out() {
        let mut scene = load_scene(&SceneSource::Dragons(1)).expect("built in");
        let placed =
            PlacedLight { world_from_light: Affine3A::IDENTITY, light: lamp(LightKind::Directional) };
        scene.lights = vec![placed; MAX_LIGHTS as usize + 3];
        assert_eq!(surplus(&scene), 3);
        assert_eq!(at(&scene, &Timeline::new(&scene), None, WorldTime(0)).punctual_count[0], MAX_LIGHTS);
    }
}

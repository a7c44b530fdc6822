//! Sun, shadows and lamps in the ground truth, against rays and formulas on the CPU, with validation layers on.

use glam::{Affine3A, Vec3};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::{playing, pose};
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::{
    Environment, Instance, Light, LightKind, Material, Model, PlacedLight, Scene, Texture, Wrap, ground,
};
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::truth::forward::{Forward, Truth};
use shadecast_shaders::ambient::{Sky, ambient_brdf};
use std::sync::Arc;

const SIDE: u32 = 160;
const FOV_DEGREES: f32 = 90.0;

fn gpu() -> Arc<Gpu> {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    Gpu::open(&options, &DesktopDevice).expect("a Vulkan device; `./shadecast setup` installs a software one")
}

/// What `scene` looks like from `eye`; no validation message was given.
#[track_caller]
fn picture(gpu: &Arc<Gpu>, scene: &Scene, eye: Pose, time: WorldTime) -> Truth {
    let scene = SceneGpu::new(gpu, scene.clone(), &SceneOptions::default()).unwrap();
    let mut forward = Forward::new(gpu, &Arc::new(scene), [SIDE; 2]).unwrap();
    let truth = forward.render(eye, Fov::symmetric_degrees(FOV_DEGREES), time).unwrap();
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
    truth
}

/// Straight down from a height.
fn from_above(height_m: f32) -> Pose {
    let orientation = glam::Quat::from_rotation_x(-std::f32::consts::FRAC_PI_2);
    Pose { position: Vec3::new(0.0, height_m, 0.0), orientation }
}

fn brightness(truth: &Truth, pixel: usize) -> f32 {
    truth.rgb8[pixel * 3..][..3].iter().map(|c| f32::from(*c)).sum()
}

/// Where in the world a pixel's centre shows something.
fn seen_at(truth: &Truth, eye: Pose, pixel: usize) -> Vec3 {
    let [x, y] =
        [pixel as u32 % SIDE, pixel as u32 / SIDE].map(|i| (i as f32 + 0.5) / SIDE as f32 * 2.0 - 1.0);
    let half = (FOV_DEGREES.to_radians() * 0.5).tan();
    eye.position + eye.orientation * (Vec3::new(x * half, -y * half, -1.0) * truth.distance_m[pixel])
}

/// Moeller and Trumbore (1997), both sides.
fn hits(from: Vec3, along: Vec3, [a, b, c]: [Vec3; 3]) -> bool {
    let (ab, ac, p) = (b - a, c - a, along.cross(c - a));
    let det = ab.dot(p);
    if det.abs() < 1e-12 {
        return false;
    }
    let (to, q) = (from - a, (from - a).cross(ab));
    let (u, v) = (to.dot(p) / det, along.dot(q) / det);
    u >= 0.0 && v >= 0.0 && u + v <= 1.0 && ac.dot(q) / det > 1e-3
}

fn triangles(scene: &Scene, index: usize, time: WorldTime) -> Vec<[Vec3; 3]> {
    let instance = &scene.instances[index];
    let model = &scene.models[instance.model];
    let playing = scene.schedules()[index].at(time);
    let palette = pose::palette(model, &pose::global_pose(model, &playing::source_pose(model, &playing)));
    let corners: Vec<Vec3> = model
        .vertices
        .iter()
        .map(|v| pose::blend(&palette, v.joints, v.weights).transform_point3(v.position))
        .map(|at| instance.world_from_model(time.seconds()).transform_point3(at))
        .collect();
    model.indices.chunks_exact(3).map(|t| [0, 1, 2].map(|i| corners[t[i] as usize])).collect()
}

#[test]
fn dragon_throws_the_shadow_that_rays_to_the_sun_find() {
    let gpu = gpu();
    let mut scene = load_scene(&SceneSource::Dragons(1)).unwrap();
    let time = WorldTime(700_000_000);
    let eye = Pose { position: Vec3::new(0.6, 1.6, 0.0), ..Pose::IDENTITY };
    let shaded = picture(&gpu, &scene, eye, time);
    scene.sun.casts_shadows = false;
    let lit = picture(&gpu, &scene, eye, time);
    let dragon = triangles(&scene, 0, time);
    let (mut shadowed, mut wrong, mut compared) = (0, 0, 0);
    for pixel in (0..shaded.instance.len()).step_by(7).filter(|p| shaded.instance[*p] == 1) {
        let at = seen_at(&shaded, eye, pixel);
        if at.length() > 7.0 {
            continue; // beyond the shadow, where a pixel covers a lot of ground
        }
        let expected = dragon.iter().any(|t| hits(at, scene.sun.to_sun, *t));
        let found = brightness(&shaded, pixel) < 0.8 * brightness(&lit, pixel);
        compared += 1;
        shadowed += usize::from(expected);
        wrong += usize::from(expected != found);
    }
    assert!(compared > 300 && shadowed > 50, "{shadowed} of {compared}");
    assert!(wrong * 30 < compared, "{wrong} of {compared} differ, {shadowed} in shadow");
}

/// A ground of its own under the default sun, which casts shadows itself.
fn plane(to_sun: Vec3) -> Scene {
    let mut scene = load_scene(&SceneSource::Dragons(1)).unwrap();
    scene.instances = vec![Instance::new("plane", 0)];
    scene.models = vec![ground::ground(8.0)];
    scene.sun.to_sun = to_sun.normalize();
    scene
}

#[test]
fn a_plane_never_shades_itself_under_any_sun() {
    let gpu = gpu();
    for to_sun in [Vec3::Y, Vec3::new(-0.45, 0.75, 0.5), Vec3::new(1.0, 0.15, 0.1), Vec3::new(0.3, 0.05, 1.0)]
    {
        let mut scene = plane(to_sun);
        let shaded = picture(&gpu, &scene, from_above(1.5), WorldTime(0));
        scene.sun.casts_shadows = false;
        let lit = picture(&gpu, &scene, from_above(1.5), WorldTime(0));
        assert!(shaded.rgb8 == lit.rgb8, "shadow acne under a sun towards {to_sun}");
    }
}

/// A square of 2 m over the ground whose texture is opaque on the left only.
fn half_masked_square(cutoff: Option<f32>) -> Model {
    let mut square = ground::ground(2.0);
    square.vertices.iter_mut().for_each(|v| v.uv = [v.position.x * 0.5 + 0.5, 0.5]);
    let texel = |x: u8| [255, 255, 255, if x < 4 { 255 } else { 0 }];
    square.textures = vec![Texture {
        name: "half".into(),
        extent_texels: [8, 1],
        rgba8: (0..8).flat_map(texel).collect(),
        srgb: true,
        wrap: [Wrap::Clamp; 2],
    }];
    square.materials = vec![Material {
        base_color_texture: Some(0.into()),
        alpha_cutoff: cutoff,
        double_sided: true,
        ..Material::default()
    }];
    square
}

#[test]
fn holes_of_a_masked_caster_let_the_sun_through() {
    let gpu = gpu();
    let dark_halves = |cutoff| {
        let mut scene = plane(Vec3::Y);
        scene.instances[0].casts_shadow = false;
        scene.models.push(half_masked_square(cutoff));
        // Above the eye, so that only its shadow is seen.
        let placement = Affine3A::from_translation(Vec3::new(0.0, 3.0, 0.0));
        scene.instances.push(Instance { placement, ..Instance::new("square", 1) });
        let truth = picture(&gpu, &scene, from_above(1.5), WorldTime(0));
        // The square covers the middle two of the three metres in view.
        let at = |x: i32| brightness(&truth, (SIDE / 2 * SIDE + SIDE / 2).saturating_add_signed(x) as usize);
        let side = SIDE as i32;
        [at(-side / 5), at(side / 5), at(side * 9 / 20)]
    };
    let [left, right, outside] = dark_halves(Some(0.5));
    assert!(left < 0.8 * outside && right > 0.9 * outside, "masked: {left} {right} {outside}");
    let [left, right, outside] = dark_halves(None);
    assert!(left < 0.8 * outside && right < 0.8 * outside, "opaque: {left} {right} {outside}");
}

fn lamp(kind: LightKind, range_m: Option<f32>) -> Light {
    Light { name: "lamp".into(), kind, intensity: Vec3::splat(2.0), range_m }
}

/// A grey plane in the dark, a lamp a metre above it, and what the formulas give at a distance from under the lamp.
fn night(light: Light) -> Scene {
    let mut scene = plane(Vec3::Y);
    scene.sun.irradiance = Vec3::ZERO;
    scene.environment = Environment { zenith: Vec3::ZERO, horizon: Vec3::ZERO, nadir: Vec3::ZERO };
    scene.models[0].textures.clear();
    scene.models[0].materials = vec![Material { base_color: [0.5, 0.5, 0.5, 1.0], ..Material::default() }];
    let down = Affine3A::from_rotation_x(-std::f32::consts::FRAC_PI_2);
    let world_from_light = Affine3A::from_translation(Vec3::Y) * down;
    scene.lights.push(PlacedLight { world_from_light, light });
    scene
}

#[test]
fn lamps_light_the_ground_by_the_formulas_of_khr_lights_punctual() {
    let gpu = gpu();
    let eye = from_above(1.5);
    let spot = LightKind::Spot { inner_cone_rad: 0.35, outer_cone_rad: 0.7 };
    let cases = [
        ("point", lamp(LightKind::Point, None)),
        ("point with a range", lamp(LightKind::Point, Some(1.4))),
        ("spot", lamp(spot, None)),
        ("directional", lamp(LightKind::Directional, None)),
    ];
    for (name, light) in cases {
        let truth = picture(&gpu, &night(light.clone()), eye, WorldTime(0));
        let middle = (SIDE / 2 * SIDE + SIDE / 2) as usize;
        // Brightness falls with the irradiance: the order of two places is that of the formulas, darkness is black.
        let mut last = (f32::INFINITY, f32::INFINITY);
        for step in 0..SIDE as usize / 2 {
            let at = seen_at(&truth, eye, middle + step);
            let way = Vec3::Y - at;
            let expected = irradiance(&light, way);
            let found = brightness(&truth, middle + step);
            assert!(expected > 1e-6 || found == 0.0, "{name}, {way}: {found} beyond the light's reach");
            assert!(expected < 0.05 || found > 15.0, "{name}, {way}: {found} for {expected} W/m2");
            let falls = expected < last.0 * 0.97;
            assert!(!falls || found < last.1 || found == 0.0, "{name}, {way}: {found} after {}", last.1);
            if falls {
                last = (expected, found);
            }
        }
    }
}

/// On the ground, by the extension's own text.
fn irradiance(light: &Light, way: Vec3) -> f32 {
    let (distance, cosine) = (way.length(), way.normalize().y);
    let fade = light.range_m.map_or(1.0, |r| (1.0 - (distance / r).powi(4)).clamp(0.0, 1.0));
    light.intensity.x
        * match light.kind {
            LightKind::Directional => 1.0,
            LightKind::Point => fade * cosine / distance.powi(2),
            LightKind::Spot { inner_cone_rad, outer_cone_rad } => {
                let scale = 1.0 / (inner_cone_rad.cos() - outer_cone_rad.cos()).max(0.001);
                let cone = (cosine * scale - outer_cone_rad.cos() * scale).clamp(0.0, 1.0);
                fade * cone * cone * cosine / distance.powi(2)
            }
        }
}

/// A white ground under a sky alone, as it was shaded and as the twin of `ambient.glsl` says: the largest difference of a code.
fn differs_from_the_twin(gpu: &Arc<Gpu>, sky: Sky, material: &Material) -> f32 {
    let mut scene = plane(Vec3::Y);
    scene.sun.irradiance = Vec3::ZERO;
    scene.environment = Environment { zenith: sky.zenith, horizon: sky.horizon, nadir: sky.nadir };
    scene.models[0].textures.clear();
    scene.models[0].materials = vec![material.clone()];
    // The ground leans, so that all heights of the sky are reflected.
    scene.instances[0].placement = Affine3A::from_rotation_x(0.6);
    let normal = scene.instances[0].placement.transform_vector3(Vec3::Y);
    let eye = from_above(1.5);
    let truth = picture(gpu, &scene, eye, WorldTime(0));
    let seen: Vec<usize> = (0..truth.instance.len()).filter(|pixel| truth.instance[*pixel] == 0).collect();
    assert!(seen.len() > 1000);
    let f0 = Vec3::splat(0.04).lerp(Vec3::ONE, material.metallic);
    let difference = |pixel: usize| {
        let view = (eye.position - seen_at(&truth, eye, pixel)).normalize();
        let reflected = 2.0 * view.dot(normal) * normal - view;
        let share = ambient_brdf(f0, material.roughness, view.dot(normal));
        let radiance = (1.0 - material.metallic) * sky.irradiance(normal.y)
            + share * sky.reflection(reflected.y, material.roughness);
        let found = &truth.rgb8[pixel * 3..][..3];
        (0..3).map(|i| (f32::from(found[i]) - code(radiance[i])).abs()).fold(0.0, f32::max)
    };
    // Pixels at the ground's outline hold background too.
    let mut differences: Vec<f32> = seen.into_iter().map(difference).collect();
    differences.sort_by(f32::total_cmp);
    differences[differences.len() * 97 / 100]
}

/// Tone-mapped and sRGB-coded, 0 to 255.
fn code(x: f32) -> f32 {
    let display = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14);
    255.0 * (1.055 * display.clamp(0.0, 1.0).powf(1.0 / 2.4) - 0.055)
}

#[test]
fn the_skys_light_equals_its_twin_at_any_roughness() {
    let gpu = gpu();
    let sky = Sky {
        zenith: Vec3::new(0.1, 0.3, 0.9),
        horizon: Vec3::new(0.9, 0.6, 0.2),
        nadir: Vec3::new(0.05, 0.2, 0.1),
    };
    for metallic in [0.0, 1.0] {
        for roughness in [0.04, 0.3, 0.6, 1.0] {
            let material = Material { metallic, roughness, ..Material::default() };
            let off = differs_from_the_twin(&gpu, sky, &material);
            assert!(off < 2.0, "metallic {metallic}, roughness {roughness}: {off} of 255");
        }
    }
}

//! Colours of materials and vertices in the ground truth. Validation is on.

use glam::Vec3;
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::{
    Bone, Instance, Material, Model, PaletteEntry, Primitive, Texture, TextureSlot, Trs, Vertex, Wrap,
};
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::truth::forward::{Forward, Truth};
use std::sync::Arc;

const SIDE: u32 = 96;
/// A turn, a stretch, a mirror and a shift.
const UV_TRANSFORM: [[f32; 3]; 2] = [[0.8, 1.1, 0.3], [1.6, -0.4, -0.2]];

/// A square of 2 m in the xy plane that faces +z, texture coordinates in the first set.
fn square(material: Material) -> Model {
    let corner = |x: f32, y: f32| Vertex {
        position: Vec3::new(x, y, 0.0),
        uv: [0.5 + 0.5 * x, 0.5 - 0.5 * y],
        ..Vertex::default()
    };
    Model {
        name: "square".into(),
        bones: vec![Bone { name: "root".into(), parent: None, rest: Trs::IDENTITY }],
        palette: vec![PaletteEntry { bone: 0, bone_from_mesh: glam::Affine3A::IDENTITY }],
        vertices: vec![corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)],
        indices: vec![0, 1, 2, 0, 2, 3],
        primitives: vec![Primitive { first_index: 0, index_count: 6, material: 0 }],
        materials: vec![material],
        textures: vec![checks()],
        ..Model::default()
    }
}

/// 32 x 32 texels of 4 x 4 squares, each of another colour; every second row of squares has no alpha.
fn checks() -> Texture {
    let texel = |at: u32| {
        let (x, y) = (at % 32 / 4, at / 32 / 4);
        [x as u8 * 36, y as u8 * 36, ((x ^ y) & 1) as u8 * 255, if y % 2 == 0 { 255 } else { 0 }]
    };
    let rgba8 = (0..32 * 32).flat_map(texel).collect();
    Texture {
        name: "checks".into(),
        extent_texels: [32; 2],
        rgba8,
        srgb: true,
        wrap: [Wrap::Mirror, Wrap::Repeat],
    }
}

#[track_caller]
fn picture(model: Model) -> Truth {
    let options = GpuOptions { needs: Needs::Server, validation: true, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)
        .expect("a Vulkan device; `./shadecast setup` installs a software one");
    let mut scene = load_scene(&SceneSource::Dragons(1)).unwrap();
    scene.instances = vec![Instance::new("square", 0)];
    scene.models = vec![model];
    let scene = SceneGpu::new(&gpu, scene, &SceneOptions::default()).unwrap();
    let mut forward = Forward::new(&gpu, &Arc::new(scene), [SIDE; 2]).unwrap();
    let eye = Pose { position: Vec3::new(0.3, 0.2, 1.6), ..Pose::IDENTITY };
    let truth = forward.render(eye, Fov::symmetric_degrees(90.0), WorldTime(0)).unwrap();
    assert_eq!(gpu.validation_messages(), 0, "{:#?}", gpu.validation_texts());
    truth
}

/// Pixels that differ by more than `tolerance` of 255, among those where both show the square.
fn differing(a: &Truth, b: &Truth, tolerance: u8) -> usize {
    let covered = |pixel: &usize| a.instance[*pixel] == 0 && b.instance[*pixel] == 0;
    let differs = |pixel: &usize| {
        let colors = |truth: &Truth| truth.rgb8[pixel * 3..][..3].to_vec();
        colors(a).iter().zip(colors(b)).any(|(a, b)| a.abs_diff(b) > tolerance)
    };
    (0..a.instance.len()).filter(covered).filter(differs).count()
}

fn covered(truth: &Truth) -> usize {
    truth.instance.iter().filter(|instance| **instance == 0).count()
}

/// Every slot that a material has, with one transform and set.
fn textured(slot: TextureSlot, alpha_cutoff: Option<f32>) -> Material {
    let slot = Some(slot);
    Material {
        base_color_texture: slot,
        metallic_roughness_texture: slot,
        occlusion_texture: slot,
        emissive_texture: slot,
        emissive: [0.2; 3],
        alpha_cutoff,
        ..Material::default()
    }
}

/// What a transform and a set do must equal vertices whose coordinates say the same.
#[track_caller]
fn assert_moves_into_the_vertices(slot: TextureSlot, arrange: impl Fn(&mut Vertex)) {
    for alpha_cutoff in [None, Some(0.5)] {
        let mut model = square(textured(slot, alpha_cutoff));
        model.vertices.iter_mut().for_each(&arrange);
        let mut plain = square(textured(0.into(), alpha_cutoff));
        for (vertex, source) in plain.vertices.iter_mut().zip(&model.vertices) {
            vertex.uv = slot.coordinates(source);
        }
        let (found, expected) = (picture(model), picture(plain.clone()));
        assert!(covered(&found) > 1000 && covered(&found).abs_diff(covered(&expected)) < 20);
        assert!(differing(&found, &expected, 3) < 20, "{}", differing(&found, &expected, 3));
        plain.vertices.iter_mut().for_each(|vertex| vertex.uv = [vertex.uv[1], vertex.uv[0]]);
        assert!(differing(&found, &picture(plain), 3) > 500, "the comparison would see a difference");
    }
}

#[test]
fn a_transform_of_a_texture_equals_transformed_coordinates() {
    let slot = TextureSlot { uv_transform: UV_TRANSFORM, ..0.into() };
    assert_moves_into_the_vertices(slot, |_| {});
}

#[test]
fn the_second_set_is_used_where_the_material_says_so() {
    let slot = TextureSlot { set: 1, uv_transform: UV_TRANSFORM, ..0.into() };
    assert_moves_into_the_vertices(slot, |vertex| {
        vertex.uv1 = vertex.uv;
        vertex.uv = [0.0; 2];
    });
}

#[test]
fn vertex_colours_multiply_the_base_colour_and_its_alpha() {
    let colored = |color: [u8; 4], material: Material| {
        let mut model = square(material);
        model.vertices.iter_mut().for_each(|vertex| vertex.color = color);
        picture(model)
    };
    let (half, color) = ([128, 64, 255, 51], [128, 64, 255, 51].map(|part: u8| f32::from(part) / 255.0));
    let tinted = colored(half, Material::default());
    let expected = picture(square(Material { base_color: color, ..Material::default() }));
    assert!(covered(&tinted) > 1000 && differing(&tinted, &expected, 1) == 0);
    let cut =
        |alpha_cutoff| colored(half, Material { alpha_cutoff: Some(alpha_cutoff), ..Material::default() });
    assert_eq!(covered(&cut(0.3)), 0, "alpha 0.2 is below the cutoff");
    assert_eq!(covered(&cut(0.1)), covered(&tinted));
}

#[test]
fn unlit_materials_show_their_base_colour_as_it_is() {
    let base_color = [0.25, 0.5, 1.0, 1.0];
    let truth =
        picture(square(Material { base_color, unlit: true, emissive: [9.0; 3], ..Material::default() }));
    let code = |linear: f32| ((1.055 * linear.powf(1.0 / 2.4) - 0.055) * 255.0).round() as u8;
    let expected = [0, 1, 2].map(|part| code(base_color[part]));
    for pixel in (0..truth.instance.len()).filter(|pixel| truth.instance[*pixel] == 0) {
        let found = &truth.rgb8[pixel * 3..][..3];
        assert!(found.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 1), "{found:?}, not {expected:?}");
    }
    assert!(covered(&truth) > 1000);
}

//! One generated file for each feature.

use super::*;
use crate::{Interpolation, Light, LightKind, MorphTrack, TrackValues, Vertex};
use glam::{EulerRot, Vec4};

const I16: u32 = 5122;

/// What a file says when it is loaded.
fn warnings_of(glb: GlbBuilder) -> Warnings {
    import(&glb.finish(), "features", &Surroundings::default()).expect("a good file").1
}

#[track_caller]
fn load_builder(glb: GlbBuilder) -> Model {
    let model = from_slice(&glb.finish(), "features.glb").expect("a good file");
    assert_sound(&model, "features");
    exercise(&model);
    model
}

// ---- morph targets ----

const LIFT: [[f32; 3]; 6] = [[0.0, 0.0, 1.0]; 6];
/// The second target moves file vertex 3 alone.
const PULL: [f32; 3] = [0.5, 0.25, -1.0];
const NORMALS: [[f32; 3]; 6] = [[0.0, 0.0, 1.0]; 6];

/// The sample whose two meshes have two targets: a dense one, and a sparse one that names no base data.
fn morphing() -> GlbBuilder {
    let mut glb = sample();
    let lift = glb.floats(&LIFT);
    let (at, with) = (glb.view(&[3]), glb.view(bytemuck::bytes_of(&PULL)));
    let pull = glb.push(
        "accessors",
        json!({ "componentType": FLOAT, "type": "VEC3", "count": 6, "sparse": { "count": 1,
            "indices": { "bufferView": at, "componentType": U8 }, "values": { "bufferView": with } } }),
    );
    for mesh in 0..2 {
        let targets = json!([{ "POSITION": lift }, { "POSITION": pull }]);
        glb.root["meshes"][mesh]["primitives"][0]["targets"] = targets;
    }
    glb.root["meshes"][1]["weights"] = json!([0.25, 0.5]);
    glb.root["meshes"][1]["extras"] = json!({ "targetNames": ["up", "pulled"], "other": 3 });
    glb
}

/// Adds weights of node 3 to the sample's animation.
fn animate_weights<const N: usize>(glb: &mut GlbBuilder, interpolation: &str, weights: [f32; N]) {
    let (times, output) = (glb.floats(&KEY_TIMES.map(|time| [time])), glb.floats(&weights.map(|w| [w])));
    let animation = &mut glb.root["animations"][0];
    let list = animation["samplers"].as_array_mut().expect("samplers");
    list.push(json!({ "input": times, "output": output, "interpolation": interpolation }));
    let channel = json!({ "sampler": list.len() - 1, "target": { "node": 3, "path": "weights" } });
    animation["channels"].as_array_mut().expect("channels").push(channel);
}

fn morph_deltas(model: &Model, morph: usize) -> Vec<(Vec3, Vec3)> {
    let deltas = &model.morphs[morph].deltas;
    deltas.iter().map(|delta| (model.vertices[delta.vertex as usize].position, delta.position)).collect()
}

#[test]
fn morph_targets_have_the_files_names_weights_and_deltas() {
    let model = load_builder(morphing());
    let found: Vec<(&str, f32)> = model.morphs.iter().map(|m| (m.name.as_str(), m.rest_weight)).collect();
    assert_eq!(found, [("morph 0", 0.0), ("morph 1", 0.0), ("up", 0.25), ("pulled", 0.5)]);
    // The others change their flat normals only.
    let pulled: Vec<_> =
        morph_deltas(&model, 3).into_iter().filter(|(_, delta)| *delta != Vec3::ZERO).collect();
    assert!(!pulled.is_empty());
    for (position, delta) in pulled {
        assert_eq!((position, delta), (Vec3::from(POSITIONS[3]), Vec3::from(PULL)));
    }
    let lifted = morph_deltas(&model, 2);
    assert!(lifted.iter().all(|(_, delta)| *delta == Vec3::Z));
    let of_box = model.vertices.iter().filter(|vertex| vertex.joints[0] == 2).count();
    assert_eq!(lifted.len(), of_box, "every vertex of the box and no other");
}

#[test]
fn mesh_shown_by_two_nodes_has_weights_for_each() {
    let mut glb = morphing();
    glb.root["nodes"][4]["children"] = json!([0, 2, 3, 5]);
    let second = json!({ "mesh": 1, "translation": [0, 0, 9], "weights": [1, 0] });
    glb.root["nodes"].as_array_mut().expect("nodes").push(second);
    animate_weights(&mut glb, "STEP", [0.0, 0.0, 0.5, 1.0, 0.0, 1.0]);
    let model = load_builder(glb);
    let rest: Vec<f32> = model.morphs.iter().map(|morph| morph.rest_weight).collect();
    assert_eq!(rest, [0.0, 0.0, 0.25, 0.5, 1.0, 0.0]);
    let first: Vec<u32> = model.morphs[2].deltas.iter().map(|delta| delta.vertex).collect();
    assert!(model.morphs[4].deltas.iter().all(|delta| !first.contains(&delta.vertex)));
    let tracks = &model.clips[0].morph_tracks;
    assert_eq!((tracks.len(), tracks[0].first_morph, tracks[0].morph_count), (1, 2, 2));
}

#[test]
fn animated_weights_keep_their_interpolation_and_tangents() {
    for (name, interpolation) in [("STEP", Interpolation::Step), ("LINEAR", Interpolation::Linear)] {
        let mut glb = morphing();
        animate_weights(&mut glb, name, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]);
        let track: MorphTrack = load_builder(glb).clips[0].morph_tracks[0].clone();
        assert_eq!((track.interpolation, track.times_s), (interpolation, KEY_TIMES.to_vec()));
        assert_eq!(track.weights, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]);
    }
    let mut glb = morphing();
    animate_weights(&mut glb, "CUBICSPLINE", std::array::from_fn::<f32, 18, _>(|i| i as f32));
    let track = load_builder(glb).clips[0].morph_tracks[0].clone();
    assert_eq!((track.interpolation, track.weights.len()), (Interpolation::CubicSpline, 18));
}

#[test]
fn morphs_are_added_before_the_skin_moves_the_vertices() {
    let mut glb = morphing();
    glb.root["nodes"][0]["weights"] = json!([0.5, 1.0]);
    let (model, plain) = (load_builder(glb), load_sample());
    let end_s = f64::from(KEY_TIMES[2]);
    let moved = pose::source_skin(&model, Some(0), end_s, Affine3A::IDENTITY);
    // Instead of the morphs, the same sum in the vertices themselves.
    let mut vertices = plain.vertices.clone();
    for vertex in vertices.iter_mut().filter(|vertex| vertex.joints[0] != 2) {
        let pulled = vertex.position == Vec3::from(POSITIONS[3]);
        vertex.position += 0.5 * Vec3::Z + if pulled { Vec3::from(PULL) } else { Vec3::ZERO };
    }
    let palette = pose::source_palette(&plain, Some(0), end_s);
    for (vertex, expected) in vertices.iter().zip(pose::skin(&vertices, &palette, Affine3A::IDENTITY)) {
        let near = |found: &pose::SkinnedVertex| found.position.abs_diff_eq(expected.position, 1e-5);
        assert!(vertex.joints[0] == 2 || moved.iter().any(near), "{}", expected.position);
    }
}

#[test]
fn targets_bring_normals_and_tangents_where_the_base_has_them() {
    let mut glb = morphing();
    let (normal, tangent) = (glb.floats(&NORMALS), glb.floats(&[[1.0f32, 0.0, 0.0, -1.0]; 6]));
    let (turn, skew) = (glb.floats(&[[0.0f32, 0.5, 0.0]; 6]), glb.floats(&[[0.0f32, 0.0, 0.75]; 6]));
    let primitive = &mut glb.root["meshes"][1]["primitives"][0];
    primitive["attributes"]["NORMAL"] = json!(normal);
    primitive["attributes"]["TANGENT"] = json!(tangent);
    primitive["targets"][0]["NORMAL"] = json!(turn);
    primitive["targets"][0]["TANGENT"] = json!(skew);
    let model = load_builder(glb);
    let turned = |m: &MorphDelta| (m.normal, m.tangent) == (Vec3::Y * 0.5, Vec3::Z * 0.75);
    assert!(model.morphs[2].deltas.iter().all(turned));
    let kept = |m: &MorphDelta| (m.normal, m.tangent) == (Vec3::ZERO, Vec3::ZERO);
    assert!(model.morphs[3].deltas.iter().all(kept), "a target without normals leaves the base's");
}

#[test]
fn without_normals_a_target_is_flat_where_it_is_moved_to() {
    let model = load_builder(morphing());
    let base = pose::morphed(&model, &[0.0; 4]);
    let pulled = pose::morphed(&model, &[0.0, 0.0, 0.0, 1.0]);
    let mut turned = 0;
    for triangle in model.indices.chunks_exact(3) {
        let [a, b, c] = [0, 1, 2].map(|corner| triangle[corner] as usize);
        let flat = (pulled[b].position - pulled[a].position).cross(pulled[c].position - pulled[a].position);
        let flat = flat.normalize();
        for corner in [a, b, c] {
            assert!(pulled[corner].normal.normalize().abs_diff_eq(flat, 1e-5), "{:?}", pulled[corner]);
            turned += usize::from(!base[corner].normal.abs_diff_eq(flat, 1e-2));
        }
    }
    assert!(turned > 0);
}

#[test]
fn faults_in_morph_targets_name_the_target() {
    let short = message_after(|glb| {
        *glb = morphing();
        let few = glb.floats(&[[0.0f32; 3]; 5]);
        glb.root["meshes"][1]["primitives"][0]["targets"][1]["POSITION"] = json!(few);
    });
    assert_message(&short, "mesh 'box' primitive 0 target 1 POSITION (accessor 14): has 5 elements for 6");
    let uneven = message_after(|glb| {
        *glb = morphing();
        let mut second = glb.root["meshes"][1]["primitives"][0].clone();
        second["targets"] = json!([]);
        glb.root["meshes"][1]["primitives"].as_array_mut().expect("list").push(second);
    });
    assert_message(&uneven, "mesh 'box': one primitive has 2 morph targets and another 0");
    let weights = message_after(|glb| {
        *glb = morphing();
        animate_weights(glb, "LINEAR", [0.0; 5]);
    });
    assert_message(&weights, "animation 'wave' channel 3: has 5 values for 3 keys; 2 per key are needed");
}

#[test]
fn an_accessor_without_data_cannot_claim_more_than_the_file_holds() {
    let message = message_after(|glb| {
        *glb = morphing();
        let targets = &glb.root["meshes"][1]["primitives"][0]["targets"];
        let pull = targets[1]["POSITION"].as_u64().expect("index") as usize;
        glb.root["accessors"][pull]["count"] = json!(4_000_000);
        glb.root["meshes"][0]["primitives"][0]["targets"] = json!([]);
        glb.root["meshes"][1]["primitives"][0]["attributes"] = json!({ "POSITION": pull });
    });
    assert_message(&message, "has 4000000 elements without data, more than the file's");
}

// ---- attributes ----

/// Attributes of mesh 1 as `component`s, four to an element so that every stride is a multiple of four.
fn quantised(
    glb: &mut GlbBuilder,
    component: u32,
    normalized: bool,
    kind: &str,
    values: &[[i32; 4]],
) -> usize {
    let wide = component == I16 || component == U16;
    let bytes: Vec<u8> = values
        .iter()
        .flatten()
        .flat_map(|value| if wide { (*value as i16).to_le_bytes().to_vec() } else { vec![*value as u8] })
        .collect();
    let view = glb.view(&bytes);
    glb.root["bufferViews"][view]["byteStride"] = json!(if wide { 8 } else { 4 });
    let accessor = json!({ "bufferView": view, "componentType": component, "type": kind,
        "count": values.len(), "normalized": normalized });
    glb.push("accessors", accessor)
}

fn full_scale(component: u32) -> f32 {
    [(I8, 127.0), (U8, 255.0), (I16, 32767.0), (U16, 65535.0)]
        .into_iter()
        .find_map(|(kind, full)| (kind == component).then_some(full))
        .expect("an integer type")
}

#[test]
fn every_type_that_mesh_quantisation_allows_is_read() {
    // KHR_mesh_quantization, "Extending Mesh Attributes" and "Extending Morph Target Attributes".
    for component in [I8, U8, I16, U16] {
        for normalized in [false, true] {
            let scale = if normalized { full_scale(component) } else { 1.0 };
            let values: Vec<[i32; 4]> = POSITIONS
                .iter()
                .map(|p| [p[0] * 40.0, p[1] * 40.0, p[2] * 40.0, 0.0].map(|c| c as i32))
                .collect();
            let mut glb = sample();
            let at = quantised(&mut glb, component, normalized, "VEC3", &values);
            let uv = quantised(&mut glb, component, normalized, "VEC2", &values);
            let attributes = json!({ "POSITION": at, "TEXCOORD_0": uv });
            glb.root["meshes"][1]["primitives"][0]["attributes"] = attributes;
            if component == I8 || component == I16 {
                glb.root["meshes"][1]["primitives"][0]["targets"] = json!([{ "POSITION": at }]);
            }
            glb.root["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
            let model = load_builder(glb);
            let of_box = model.vertices.iter().filter(|vertex| vertex.joints[0] == 2);
            for vertex in of_box {
                let [x, y, _] = vertex.position.to_array();
                assert_eq!(vertex.uv, [x, y], "type {component}, normalised {normalized}");
                let known =
                    values.iter().any(|value| x * scale == value[0] as f32 && y * scale == value[1] as f32);
                assert!(known, "type {component}, normalised {normalized}: {}", vertex.position);
            }
            for (position, delta) in
                model.morphs.iter().enumerate().flat_map(|(i, _)| morph_deltas(&model, i))
            {
                assert_eq!(position, delta, "type {component}, normalised {normalized}");
            }
        }
    }
}

#[test]
fn quantised_normals_and_tangents_are_unit_length_and_keep_their_sign() {
    for component in [I8, I16] {
        let full = full_scale(component) as i32;
        let mut glb = sample();
        let normal = quantised(&mut glb, component, true, "VEC3", &[[0, 0, full - 1, 0]; 6]);
        let tangent = quantised(&mut glb, component, true, "VEC4", &[[full, 0, 0, -full]; 6]);
        let bend = quantised(&mut glb, component, true, "VEC3", &[[0, full, 0, 0]; 6]);
        let primitive = &mut glb.root["meshes"][1]["primitives"][0];
        primitive["attributes"]["NORMAL"] = json!(normal);
        primitive["attributes"]["TANGENT"] = json!(tangent);
        primitive["targets"] = json!([{ "NORMAL": bend, "TANGENT": bend }]);
        let model = load_builder(glb);
        for vertex in model.vertices.iter().filter(|vertex| vertex.joints[0] == 2) {
            assert_eq!((vertex.normal, vertex.tangent), (Vec3::Z, [1.0, 0.0, 0.0, -1.0]));
        }
        let bent = |delta: &MorphDelta| delta.normal == Vec3::Y && delta.tangent == Vec3::Y;
        assert!(!model.morphs[0].deltas.is_empty() && model.morphs[0].deltas.iter().all(bent));
    }
}

#[test]
fn vertex_colours_of_every_type_become_eight_bits() {
    let cases = [
        (FLOAT, "VEC3", 12, [255, 128, 0, 255]),
        (FLOAT, "VEC4", 16, [255, 128, 0, 64]),
        (U8, "VEC3", 4, [255, 128, 0, 255]),
        (U8, "VEC4", 4, [255, 128, 0, 64]),
        (U16, "VEC3", 8, [255, 128, 0, 255]),
        (U16, "VEC4", 8, [255, 128, 0, 64]),
    ];
    for (component, kind, stride, expected) in cases {
        let mut glb = sample();
        let color = match component {
            FLOAT => [1.5f32, 0.502, -1.0, 0.25].map(|part| part.to_le_bytes()).concat(),
            U8 => vec![255, 128, 0, 64],
            _ => [65535u16, 32896, 0, 16448].map(|part| part.to_le_bytes()).concat(),
        };
        let view = glb.view(&color[..stride].repeat(6));
        glb.root["bufferViews"][view]["byteStride"] = json!(stride);
        let colors = json!({ "bufferView": view, "componentType": component, "type": kind, "count": 6 });
        let colors = glb.push("accessors", colors);
        glb.root["meshes"][1]["primitives"][0]["attributes"]["COLOR_0"] = json!(colors);
        let model = load_builder(glb);
        for vertex in &model.vertices {
            let expected = if vertex.joints[0] == 2 { expected } else { [255; 4] };
            assert_eq!(vertex.color, expected, "{component} {kind}");
        }
    }
}

#[test]
fn sparse_values_replace_indices_and_keys_too() {
    let mut glb = sample();
    let (at, triangle) = (glb.view(&[0, 1, 2]), glb.view(&[2, 1, 3]));
    let indices = glb.root["meshes"][1]["primitives"][0]["indices"].as_u64().expect("index") as usize;
    let mut own = glb.root["accessors"][indices].clone();
    own["sparse"] = json!({ "count": 3, "indices": { "bufferView": at, "componentType": U8 },
        "values": { "bufferView": triangle } });
    let own = glb.push("accessors", own);
    glb.root["meshes"][1]["primitives"][0]["indices"] = json!(own);
    let (at, shift) = (glb.view(&[4]), glb.view(bytemuck::bytes_of(&[7.0f32, 8.0, 9.0])));
    let output = glb.root["animations"][0]["samplers"][1]["output"].as_u64().expect("index") as usize;
    glb.root["accessors"][output]["sparse"] = json!({ "count": 1,
        "indices": { "bufferView": at, "componentType": U8 }, "values": { "bufferView": shift } });
    let model = load_builder(glb);
    let first = model.primitives[1].first_index as usize;
    let corners = [0, 1, 2].map(|i| model.vertices[model.indices[first + i] as usize].position);
    assert_eq!(corners, [2, 1, 3].map(|i: usize| Vec3::from(POSITIONS[i])));
    let TrackValues::Translation(keys) = &model.clips[0].tracks[1].values else { panic!("a translation") };
    assert_eq!(keys[4], Vec3::new(7.0, 8.0, 9.0));
}

// ---- materials ----

#[test]
fn texture_transforms_follow_the_extension() {
    let mut glb = sample();
    let transform =
        json!({ "offset": [0.25, 1.0], "rotation": std::f32::consts::FRAC_PI_2, "scale": [0.5, 2.0] });
    glb.root["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] =
        json!({ "index": 0, "extensions": { "KHR_texture_transform": transform } });
    glb.root["extensionsRequired"] = json!(["KHR_texture_transform"]);
    let model = load_builder(glb);
    let slot = model.materials[0].base_color_texture.expect("a texture");
    for (uv, expected) in [([0.0, 0.0], [0.25, 1.0]), ([1.0, 0.0], [0.25, 0.5]), ([0.0, 1.0], [2.25, 1.0])] {
        let found = slot.coordinates(&Vertex { uv, ..Vertex::default() });
        let error = (found[0] - expected[0]).abs().max((found[1] - expected[1]).abs());
        assert!(error < 1e-6, "{uv:?} becomes {found:?} instead of {expected:?}");
    }
}

#[test]
fn each_texture_uses_its_own_set_of_coordinates() {
    let mut glb = sample();
    let other: Vec<[f32; 2]> = UVS.iter().map(|[u, v]| [u * 3.0, v * 5.0]).collect();
    let other = glb.floats(&other);
    let attributes = &mut glb.root["meshes"][0]["primitives"][0]["attributes"];
    attributes["TEXCOORD_1"] = json!(other);
    attributes["TEXCOORD_3"] = json!(other);
    glb.root["meshes"][1]["primitives"][0]["attributes"]["TEXCOORD_1"] = json!(other);
    let transform = json!({ "KHR_texture_transform": { "texCoord": 1 } });
    glb.root["materials"][0]["occlusionTexture"] =
        json!({ "index": 1, "texCoord": 7, "strength": 0.5, "extensions": transform });
    let model = load_builder(glb);
    let cloth = &model.materials[0];
    assert_eq!(
        (cloth.base_color_texture.expect("base").set, cloth.occlusion_texture.expect("other").set),
        (0, 1)
    );
    for vertex in &model.vertices {
        let [u, v] = vertex.uv;
        let expected = if vertex.joints[0] == 2 { [0.0; 2] } else { [u * 3.0, v * 5.0] };
        assert_eq!(vertex.uv1, expected, "wood has no texture that uses the second set");
    }
}

#[test]
fn sets_of_any_number_take_the_two_places_and_a_third_is_named() {
    let numbered = |sets: [u32; 3]| {
        let mut glb = sample();
        let attributes = &mut glb.root["meshes"][0]["primitives"][0]["attributes"];
        let uv = attributes["TEXCOORD_0"].take();
        attributes.as_object_mut().expect("object").remove("TEXCOORD_0");
        for set in sets {
            attributes[format!("TEXCOORD_{set}")] = uv.clone();
        }
        let cloth = &mut glb.root["materials"][0];
        cloth["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = json!(sets[0]);
        cloth["occlusionTexture"] = json!({ "index": 1, "texCoord": sets[1] });
        cloth["emissiveTexture"] = json!({ "index": 1, "texCoord": sets[2] });
        glb
    };
    assert_eq!(warnings_of(numbered([4, 4, 2])), Warnings::new());
    let model = load_builder(numbered([4, 4, 2]));
    let cloth = &model.materials[0];
    let sets = [cloth.base_color_texture, cloth.occlusion_texture, cloth.emissive_texture];
    assert_eq!(sets.map(|slot| slot.expect("a texture").set), [1, 1, 0]);
    assert!(model.vertices.iter().any(|vertex| vertex.uv == vertex.uv1 && vertex.uv == UVS[1]));
    let warnings = warnings_of(numbered([4, 5, 6]));
    assert!(warnings.len() == 1 && warnings.iter().all(|text| text.contains("more than two sets")));
}

#[test]
fn unlit_and_emissive_strength_are_read() {
    let mut glb = sample();
    glb.root["materials"][0]["emissiveFactor"] = json!([0.5, 0.25, 1.0]);
    glb.root["materials"][0]["extensions"] =
        json!({ "KHR_materials_emissive_strength": { "emissiveStrength": 8.0 } });
    glb.root["materials"][1]["extensions"] = json!({ "KHR_materials_unlit": {} });
    glb.root["extensionsUsed"] = json!(["KHR_materials_emissive_strength", "KHR_materials_unlit"]);
    let model = load_builder(glb);
    assert_eq!((model.materials[0].emissive, model.materials[0].unlit), ([4.0, 2.0, 8.0], false));
    assert!(model.materials[1].unlit);
}

#[test]
fn faults_in_extensions_name_element_and_extension() {
    let strength = message_after(|glb| {
        glb.root["materials"][0]["extensions"] =
            json!({ "KHR_materials_emissive_strength": { "emissiveStrength": "bright" } });
    });
    assert_message(&strength, "material 'cloth': KHR_materials_emissive_strength: invalid type");
    let transform = message_after(|glb| {
        glb.root["materials"][1]["normalTexture"]["extensions"] =
            json!({ "KHR_texture_transform": { "scale": [1.0] } });
    });
    assert_message(&transform, "material 'wood': KHR_texture_transform: invalid length 1");
}

// ---- lights ----

fn lit(light: Value) -> GlbBuilder {
    let mut glb = sample();
    glb.root["extensions"] = json!({ "KHR_lights_punctual": { "lights": [
        { "type": "directional", "color": [1, 0.5, 0.25], "intensity": 2, "range": 5 }, light ] } });
    glb.root["extensionsUsed"] = json!(["KHR_lights_punctual"]);
    for (node, light) in [(1, 1), (4, 0)] {
        glb.root["nodes"][node]["extensions"] = json!({ "KHR_lights_punctual": { "light": light } });
    }
    glb
}

#[test]
fn lights_hang_on_the_bones_of_their_nodes() {
    let spot = json!({ "name": "torch", "type": "spot", "range": 3,
        "spot": { "innerConeAngle": 0.2, "outerConeAngle": 0.6 } });
    assert_eq!(warnings_of(lit(spot.clone())), Warnings::new());
    let model = load_builder(lit(spot));
    let [sun, torch] = &model.lights[..] else { panic!("two lights") };
    assert_eq!(
        [sun.bone, torch.bone].map(|bone| model.bones[bone as usize].name.as_str()),
        ["root", "upper"]
    );
    let intensity = Vec3::new(2.0, 1.0, 0.5);
    let expected = Light { name: "light 0".into(), kind: LightKind::Directional, intensity, range_m: None };
    assert_eq!(sun.light, expected);
    let kind = LightKind::Spot { inner_cone_rad: 0.2, outer_cone_rad: 0.6 };
    assert_eq!((torch.light.kind, torch.light.range_m, torch.light.intensity), (kind, Some(3.0), Vec3::ONE));
    let point = load_builder(lit(json!({ "type": "point", "intensity": 40 })));
    assert_eq!(point.lights[1].light.kind, LightKind::Point);
    let wide = load_builder(lit(json!({ "type": "spot" })));
    let (outer, kind) = (std::f32::consts::FRAC_PI_4, wide.lights[1].light.kind);
    assert_eq!(kind, LightKind::Spot { inner_cone_rad: 0.0, outer_cone_rad: outer });
}

#[test]
fn faults_in_lights_name_the_light() {
    let fault = |light: Value| message_after(|glb| *glb = lit(light));
    assert_message(&fault(json!({ "type": "area" })), "document: KHR_lights_punctual: unknown variant");
    let dark = fault(json!({ "name": "void", "type": "point", "intensity": -1 }));
    assert_message(&dark, "light 'void': colour times intensity");
    assert_message(&fault(json!({ "type": "point", "range": 0 })), "light 1: its range must be a positive");
    let cone = json!({ "type": "spot", "spot": { "innerConeAngle": 0.7, "outerConeAngle": 0.6 } });
    assert_message(&fault(cone), "light 1: innerConeAngle");
    let missing = message_after(|glb| {
        *glb = lit(json!({ "type": "point" }));
        glb.root["nodes"][1]["extensions"]["KHR_lights_punctual"]["light"] = json!(2);
    });
    assert_message(&missing, "node 1 'upper': shows light 2, but the file defines 2");
}

// ---- what is left out ----

#[test]
fn what_is_left_out_is_named_once() {
    let mut glb = morphing();
    glb.root["cameras"] = json!([{ "type": "perspective", "perspective": { "yfov": 1.0, "znear": 0.1 } }]);
    glb.root["nodes"][2]["camera"] = json!(0);
    glb.root["nodes"][3]["camera"] = json!(0);
    glb.root["extensionsUsed"] =
        json!(["KHR_materials_clearcoat", "KHR_materials_ior", "KHR_mesh_quantization"]);
    let attributes = &mut glb.root["meshes"][0]["primitives"][0]["attributes"];
    attributes["COLOR_1"] = attributes["POSITION"].clone();
    let uv = attributes["TEXCOORD_0"].clone();
    glb.root["meshes"][0]["primitives"][0]["targets"][0]["TEXCOORD_0"] = uv;
    let pointer = json!({ "KHR_animation_pointer": { "pointer": "/materials/0/alphaCutoff" } });
    let channels = glb.root["animations"][0]["channels"].as_array_mut().expect("channels");
    channels.push(json!({ "sampler": 0, "target": { "path": "pointer", "extensions": pointer } }));
    let warnings: Vec<String> = warnings_of(glb).into_iter().collect();
    let expected = [
        "cameras are ignored; the scene file can define some",
        "curves without a target node are ignored",
        "extension KHR_materials_clearcoat is ignored",
        "extension KHR_materials_ior is ignored",
        "morph targets of other attributes than positions, normals and tangents are ignored",
        "vertex colours beyond COLOR_0 are ignored",
    ];
    assert_eq!(warnings, expected);
}

/// Two white texels.
fn white_png(alphas: [u8; 2]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, 2, 1);
    encoder.set_color(png::ColorType::Rgba);
    let mut writer = encoder.write_header().expect("header");
    writer.write_image_data(&alphas.map(|alpha| [255, 255, 255, alpha]).concat()).expect("data");
    writer.finish().expect("end");
    out
}

/// The sample with its first material blended, of this alpha; its cutoff and what was said about it.
fn blended(alpha: f32, texture_alpha: Option<[u8; 2]>) -> (Option<f32>, Vec<String>) {
    let mut glb = sample();
    let material = &mut glb.root["materials"][0];
    material["alphaMode"] = json!("BLEND");
    let pbr = material["pbrMetallicRoughness"].as_object_mut().expect("an object");
    pbr.insert("baseColorFactor".into(), json!([1, 1, 1, alpha]));
    match texture_alpha {
        None => drop(pbr.remove("baseColorTexture")),
        Some(alphas) => {
            let view = glb.view(&white_png(alphas));
            glb.root["images"][0] = json!({ "bufferView": view, "mimeType": "image/png" });
        }
    }
    let (model, warnings) =
        import(&glb.finish(), "sample.glb", &Surroundings::default()).expect("a good file");
    let cloth = model.materials.iter().find(|material| material.name == "cloth").expect("the first");
    (cloth.alpha_cutoff, warnings.into_iter().collect())
}

#[test]
fn blended_materials_are_cut_out_at_half_of_their_alpha_and_named() {
    let cut =
        "material 'cloth' is blended: where it is at least half opaque it is drawn, elsewhere it is cut out";
    let gone = "material 'cloth' is blended and nowhere half opaque: it is left out";
    let cases = [
        (1.0, None, cut),
        (0.5, None, cut),
        (0.4, None, gone),
        (1.0, Some([0, 200]), cut),
        (0.6, Some([0, 200]), gone),
        (1.0, Some([0, 100]), gone),
    ];
    for (alpha, texture, said) in cases {
        assert_eq!(blended(alpha, texture), (Some(0.5), vec![said.into()]), "{alpha} {texture:?}");
    }
}

#[test]
fn required_extensions_that_are_lacking_are_refused_with_advice() {
    for (name, advice) in [
        ("KHR_texture_basisu", "convert the textures to PNG or JPEG"),
        ("EXT_mesh_gpu_instancing", "export each placed mesh as a node"),
        ("ACME_secret", "export the asset without it"),
    ] {
        let message = message_after(|glb| glb.root["extensionsRequired"] = json!([name]));
        assert_message(
            &message,
            &format!("extension {name}: is required by the file, but not supported; {advice}"),
        );
    }
}

// ---- compressed buffer views ----

/// Moves the data of a view into a compressed one of the same content.
fn compress(glb: &mut GlbBuilder, view: usize, name: &str, data: &[u8], extension: Value) {
    let packed = glb.view(data);
    let packed = glb.root["bufferViews"].as_array_mut().expect("views").remove(packed);
    let mut extension = extension;
    extension["buffer"] = json!(0);
    extension["byteOffset"] = packed["byteOffset"].clone();
    extension["byteLength"] = packed["byteLength"].clone();
    let length = glb.root["bufferViews"][view]["byteLength"].clone();
    // Buffer 1 has no bytes: it only stands for what is decoded.
    glb.root["bufferViews"][view] =
        json!({ "buffer": 1, "byteLength": length, "extensions": { name: extension } });
}

fn finish_compressed(mut glb: GlbBuilder, name: &str) -> Vec<u8> {
    glb.root["extensionsRequired"] = json!([name]);
    let bytes = glb.bin.len();
    glb.root["buffers"] = json!([{ "byteLength": bytes },
        { "byteLength": 4096, "extensions": { name: { "fallback": true } } }]);
    write_glb(&glb.root, &glb.bin)
}

fn index_of(glb: &GlbBuilder, pointer: &str) -> usize {
    glb.root.pointer(pointer).and_then(Value::as_u64).expect("an index") as usize
}

fn view_of(glb: &GlbBuilder, accessor: usize) -> usize {
    index_of(glb, &format!("/accessors/{accessor}/bufferView"))
}

#[test]
fn compression_gives_the_same_model() {
    for name in extensions::COMPRESSION {
        let mut glb = sample();
        let position = view_of(&glb, index_of(&glb, "/meshes/0/primitives/0/attributes/POSITION"));
        let data = meshopt::encode_vertex_buffer(&POSITIONS).expect("encodes");
        let extension = json!({ "byteStride": 12, "count": 6, "mode": "ATTRIBUTES" });
        compress(&mut glb, position, name, &data, extension);
        // The two meshes share their 8-bit indices; the codec knows 16 and 32 bits.
        let list: Vec<u32> = INDICES.iter().map(|index| u32::from(*index)).collect();
        let modes = [
            ("TRIANGLES", 2, U16, meshopt::encode_index_buffer(&list, 6).expect("encodes")),
            ("INDICES", 4, 5125, meshopt::encode_index_sequence(&list, 6).expect("encodes")),
        ];
        for (mesh, (mode, stride, component, data)) in modes.into_iter().enumerate() {
            let indices = glb.accessor(&vec![0; 12 * stride], component, "SCALAR", 12);
            let view = view_of(&glb, indices);
            let extension = json!({ "byteStride": stride, "count": 12, "mode": mode, "filter": "NONE" });
            compress(&mut glb, view, name, &data, extension);
            glb.root["meshes"][mesh]["primitives"][0]["indices"] = json!(indices);
        }
        let model = from_slice(&finish_compressed(glb, name), "packed").expect("a good file");
        let sorted = |model: &Model| -> Vec<[u32; 3]> {
            // The triangle codec turns triangles around, not over.
            let corner = |i: u32| model.vertices[i as usize].position.to_array().map(f32::to_bits);
            let mut list: Vec<[[u32; 3]; 3]> =
                model.indices.chunks_exact(3).map(|t| [corner(t[0]), corner(t[1]), corner(t[2])]).collect();
            list.iter_mut().for_each(|triangle| {
                let first = (0..3).min_by_key(|i| triangle[*i]).expect("three");
                triangle.rotate_left(first);
            });
            list.sort_unstable();
            list.concat()
        };
        assert_eq!(sorted(&model), sorted(&load_sample()), "{name}");
    }
}

#[test]
fn every_filter_of_the_compression_is_undone() {
    let turns: Vec<[f32; 4]> = (0..16)
        .map(|i| Quat::from_euler(EulerRot::XYZ, i as f32 * 0.3, 0.4, i as f32 * -0.2).to_array())
        .collect();
    let normals: Vec<[f32; 4]> =
        turns.iter().map(|turn| (Quat::from_array(*turn) * Vec3::Z).extend(0.0).to_array()).collect();
    let bytes: Vec<[i8; 4]> = meshopt::encode_filter_oct(&normals, 8);
    let shorts: Vec<[i16; 4]> = meshopt::encode_filter_oct(&normals, 16);
    let numbers = meshopt::encode_filter_exp(&turns, 20, meshopt::EncodeExpMode::Separate);
    let colors: Vec<[u8; 4]> =
        meshopt::encode_filter_color(&turns.iter().map(|t| t.map(f32::abs)).collect::<Vec<_>>(), 8);
    type Case = (&'static str, u32, bool, Vec<u8>, f32);
    let cases: [Case; 5] = [
        ("OCTAHEDRAL", I8, true, meshopt::encode_vertex_buffer(&bytes).expect("encodes"), 0.02),
        ("OCTAHEDRAL", I16, true, meshopt::encode_vertex_buffer(&shorts).expect("encodes"), 1e-4),
        (
            "QUATERNION",
            I16,
            true,
            meshopt::encode_vertex_buffer(&meshopt::encode_filter_quat(&turns, 16)).expect("encodes"),
            1e-4,
        ),
        ("EXPONENTIAL", FLOAT, false, meshopt::encode_vertex_buffer(&numbers).expect("encodes"), 1e-5),
        ("COLOR", U8, true, meshopt::encode_vertex_buffer(&colors).expect("encodes"), 0.02),
    ];
    for (filter, component, normalized, data, bound) in cases {
        let mut glb = GlbBuilder::new();
        let stride = match component {
            I8 | U8 => 4,
            I16 => 8,
            _ => 16,
        };
        let accessor = glb.accessor(&vec![0; 16 * stride], component, "VEC4", 16);
        glb.root["accessors"][accessor]["normalized"] = json!(normalized);
        let extension = json!({ "byteStride": stride, "count": 16, "mode": "ATTRIBUTES", "filter": filter });
        let view = view_of(&glb, accessor);
        compress(&mut glb, view, "EXT_meshopt_compression", &data, extension);
        let bytes = finish_compressed(glb, "EXT_meshopt_compression");
        let container =
            container::open(&bytes, &Surroundings::default(), &mut Warnings::new()).expect("opens");
        let container::Container { document, buffers, data_bytes, decoded } = &container;
        let reader = Reader { document, buffers, data_bytes: *data_bytes, decoded };
        let accessor = document.accessors().next().expect("one");
        let found = reader.floats::<4>(&accessor, Dimensions::Vec4, "x").expect("decodes");
        let expected = if filter == "OCTAHEDRAL" { &normals } else { &turns };
        for (found, expected) in found.iter().zip(expected) {
            let [found, expected] = [*found, *expected].map(Vec4::from_array);
            let error = match filter {
                // Both signs are the same rotation.
                "QUATERNION" => {
                    (found - expected).abs().max_element().min((found + expected).abs().max_element())
                }
                "COLOR" => (found - expected.abs()).abs().max_element(),
                _ => (found - expected).abs().max_element(),
            };
            assert!(error < bound, "{filter} {component}: {found} instead of {expected}");
        }
    }
}

#[test]
fn faults_in_compressed_views_name_the_view() {
    let message = |change: &dyn Fn(&mut Value, &mut Vec<u8>)| {
        let mut glb = sample();
        let view = view_of(&glb, index_of(&glb, "/meshes/0/primitives/0/attributes/POSITION"));
        let mut data = meshopt::encode_vertex_buffer(&POSITIONS).expect("encodes");
        let mut extension = json!({ "byteStride": 12, "count": 6, "mode": "ATTRIBUTES" });
        change(&mut extension, &mut data);
        compress(&mut glb, view, "EXT_meshopt_compression", &data, extension);
        from_slice(&finish_compressed(glb, "EXT_meshopt_compression"), "bad.glb")
            .expect_err("a fault")
            .to_string()
    };
    let element = "buffer view 0 EXT_meshopt_compression: ";
    let says = |found: String, expected: &str| assert_message(&found, &format!("{element}{expected}"));
    says(message(&|extension, _| extension["count"] = json!(7)), "decodes to 84 bytes, but the view has 72");
    says(message(&|extension, _| extension["byteStride"] = json!(11)), "byteStride 11 does not fit the mode");
    says(
        message(&|extension, _| extension["filter"] = json!("OCTAHEDRAL")),
        "the filter is not allowed with",
    );
    says(message(&|_, data| data.truncate(20)), "its data is damaged");
    says(message(&|_, data| data[0] = 0), "its data is damaged");
    let mode = message(&|extension, _| extension["mode"] = json!("LINES"));
    assert_message(&mode, "buffer view 0: EXT_meshopt_compression: unknown variant `LINES`");
}

/// A file that uses everything at once, to be damaged.
pub(super) fn rich() -> Vec<u8> {
    let mut glb = morphing();
    animate_weights(&mut glb, "CUBICSPLINE", std::array::from_fn::<f32, 18, _>(|i| i as f32 * 0.1));
    let colors = glb.accessor(&[200; 24], U8, "VEC4", 6);
    let primitive = &mut glb.root["meshes"][1]["primitives"][0];
    primitive["attributes"]["COLOR_0"] = json!(colors);
    let transform = json!({ "KHR_texture_transform": { "offset": [0.5, 0], "rotation": 1, "scale": [2, 3], "texCoord": 0 } });
    glb.root["materials"][1]["normalTexture"]["extensions"] = transform;
    glb.root["materials"][0]["extensions"] =
        json!({ "KHR_materials_unlit": {}, "KHR_materials_emissive_strength": { "emissiveStrength": 2 } });
    let spot =
        json!({ "type": "spot", "spot": { "innerConeAngle": 0.1, "outerConeAngle": 0.5 }, "range": 2 });
    glb.root["extensions"] = json!({ "KHR_lights_punctual": { "lights": [spot] } });
    glb.root["nodes"][1]["extensions"] = json!({ "KHR_lights_punctual": { "light": 0 } });
    let indices = glb.accessor(&[0; 24], U16, "SCALAR", 12);
    let list: Vec<u32> = INDICES.iter().map(|index| u32::from(*index)).collect();
    let data = meshopt::encode_index_buffer(&list, 6).expect("encodes");
    let (view, extension) =
        (view_of(&glb, indices), json!({ "byteStride": 2, "count": 12, "mode": "TRIANGLES" }));
    compress(&mut glb, view, "EXT_meshopt_compression", &data, extension);
    glb.root["meshes"][1]["primitives"][0]["indices"] = json!(indices);
    let position = view_of(&glb, index_of(&glb, "/meshes/0/primitives/0/attributes/POSITION"));
    let data = meshopt::encode_vertex_buffer(&meshopt::encode_filter_exp(
        &POSITIONS,
        20,
        meshopt::EncodeExpMode::Separate,
    ));
    let extension = json!({ "byteStride": 12, "count": 6, "mode": "ATTRIBUTES", "filter": "EXPONENTIAL" });
    compress(&mut glb, position, "EXT_meshopt_compression", &data.expect("encodes"), extension);
    finish_compressed(glb, "EXT_meshopt_compression")
}

#[test]
fn the_file_with_everything_loads() {
    let (model, warnings) = import(&rich(), "rich", &Surroundings::default()).expect("a good file");
    assert_sound(&model, "rich");
    assert_eq!((model.lights.len(), model.morphs.len(), model.clips[0].morph_tracks.len()), (1, 4, 1));
    assert_eq!(warnings, Warnings::new());
}

/// The seeds of the fuzz target are what these tests generate: as a file, and as text and numbers with a zero between
/// them, which the target puts into a container. `SHADECAST_WRITE_SEEDS=1 cargo test ...` writes them.
#[test]
fn seeds_of_the_fuzz_target_are_up_to_date() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fuzz/seeds/gltf");
    let split = |glb: &[u8]| {
        let (root, bin) = parts(glb);
        [serde_json::to_vec(&root).expect("JSON"), vec![0], bin].concat()
    };
    let (plain, rich) = (sample().finish(), rich());
    let seeds = [("plain.split", split(&plain)), ("rich.split", split(&rich)), ("rich.glb", rich)];
    for (name, bytes) in seeds {
        let path = folder.join(name);
        if std::env::var_os("SHADECAST_WRITE_SEEDS").is_some() {
            std::fs::write(&path, &bytes).expect("the seed can be written");
        }
        assert!(std::fs::read(&path).ok() == Some(bytes), "{name} is not what the tests generate");
    }
}

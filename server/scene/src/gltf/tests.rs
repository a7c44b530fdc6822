//! The importer on small generated files, on thousands of damaged ones, and on real assets where present.

use super::super::{Model, Wrap};
use super::*;
use crate::Cancel;
use crate::animation::pose;
use crate::limits::MAX_JSON_OBJECTS;
use crate::sound::{assert_sound, effort, exercise, is_sound_or_refused};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use serde_json::{Value, json};

mod curves;
mod features;

/// Builds a GLB: numbers go to one buffer, the JSON is free to be changed before it is written.
struct GlbBuilder {
    root: Value,
    bin: Vec<u8>,
}

const FLOAT: u32 = 5126;
const U8: u32 = 5121;
const I8: u32 = 5120;
const U16: u32 = 5123;

impl GlbBuilder {
    fn new() -> Self {
        let root = json!({ "asset": { "version": "2.0" }, "bufferViews": [], "accessors": [] });
        Self { root, bin: Vec::new() }
    }

    fn view(&mut self, bytes: &[u8]) -> usize {
        while !self.bin.len().is_multiple_of(4) {
            self.bin.push(0);
        }
        let view = json!({ "buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len() });
        self.bin.extend_from_slice(bytes);
        self.push("bufferViews", view)
    }

    fn push(&mut self, list: &str, value: Value) -> usize {
        let list = self.root[list].as_array_mut().expect("a list");
        list.push(value);
        list.len() - 1
    }

    fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        let view = self.view(bytes);
        self.push(
            "accessors",
            json!({ "bufferView": view, "componentType": component, "type": kind, "count": count }),
        )
    }

    fn floats<const N: usize>(&mut self, values: &[[f32; N]]) -> usize {
        let bytes: Vec<u8> = values.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
        let kind = match N {
            1 => "SCALAR",
            2 => "VEC2",
            3 => "VEC3",
            4 => "VEC4",
            _ => "MAT4",
        };
        self.accessor(&bytes, FLOAT, kind, values.len())
    }

    fn finish(mut self) -> Vec<u8> {
        self.root["buffers"] = json!([{ "byteLength": self.bin.len() }]);
        write_glb(&self.root, &self.bin)
    }
}

fn write_glb(root: &Value, bin: &[u8]) -> Vec<u8> {
    let mut json = serde_json::to_vec(root).expect("JSON");
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut bin = bin.to_vec();
    bin.resize(bin.len().next_multiple_of(4), 0);
    let mut out = b"glTF\x02\0\0\0".to_vec();
    out.extend(((28 + json.len() + bin.len()) as u32).to_le_bytes());
    out.extend((json.len() as u32).to_le_bytes());
    out.extend(b"JSON");
    out.extend(json);
    out.extend((bin.len() as u32).to_le_bytes());
    out.extend(b"BIN\0");
    out.extend(bin);
    out
}

fn parts(glb: &[u8]) -> (Value, Vec<u8>) {
    let length = u32::from_le_bytes([glb[12], glb[13], glb[14], glb[15]]) as usize;
    (serde_json::from_slice(&glb[20..20 + length]).expect("JSON"), glb[28 + length..].to_vec())
}

fn png(color: [u8; 3]) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, 2, 2);
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header().expect("header");
    writer.write_image_data(&color.repeat(4)).expect("data");
    writer.finish().expect("end");
    out
}

const POSITIONS: [[f32; 3]; 6] =
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 2.0, 0.0], [1.0, 2.0, 0.25]];
const UVS: [[f32; 2]; 6] = [[0.0, 1.0], [1.0, 1.0], [0.0, 0.5], [1.0, 0.5], [0.0, 0.0], [1.0, 0.0]];
const INDICES: [u8; 12] = [0, 1, 2, 2, 1, 3, 2, 3, 4, 4, 3, 5];
const KEY_TIMES: [f32; 3] = [0.0, 0.5, 1.25];
const TURNS: [[f32; 4]; 3] = [[0.0, 0.0, 0.0, 1.0], [0.6, 0.0, 0.0, 0.8], [0.0, 0.0, -0.6, -0.8]];
const SHIFTS: [[f32; 3]; 9] = [
    [0.0; 3],
    [0.0, 1.0, 0.0],
    [1.0, 0.0, 0.0],
    [0.0, 0.0, 2.0],
    [0.5, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [0.0; 3],
    [0.0, 1.5, 0.5],
    [0.0; 3],
];
const SIZES: [[f32; 3]; 3] = [[1.0, 1.0, 1.0], [2.0, 1.0, 0.5], [1.0, 3.0, 1.0]];
/// Weights are held in whole units of this; the sample's joints are at most three metres apart.
const WEIGHT_STEP: f32 = 1.0 / 65_535.0;
/// Inverse bind translation of the two joints along y.
const BIND_Y: [f32; 2] = [0.0, -1.0];

/// Nodes: 0 skinned mesh, 1 upper joint, 2 lower joint (parent of 1), 3 plain mesh, 4 root of all.
/// One skin with eight influences a vertex, two textured materials, one clip with all three interpolations.
fn sample() -> GlbBuilder {
    let mut glb = GlbBuilder::new();
    let position = glb.floats(&POSITIONS);
    let uv = glb.floats(&UVS);
    let indices = glb.accessor(&INDICES, U8, "SCALAR", 12);
    let joints_0 = glb.accessor(&[[0u8, 1, 0, 0]; 6].concat(), U8, "VEC4", 6);
    let weights_0: Vec<[f32; 4]> =
        POSITIONS.iter().map(|p| [1.0 - p[1] / 2.0, p[1] / 2.0, 0.0, 0.0]).collect();
    let weights_0 = glb.floats(&weights_0);
    let joints_1 = glb.accessor(&[[1u8, 0, 0, 0]; 6].concat(), U8, "VEC4", 6);
    let weights_1 = glb.accessor(&[[51u8, 0, 0, 0]; 6].concat(), U8, "VEC4", 6);
    glb.root["accessors"][weights_1]["normalized"] = json!(true);
    let mut bind = [[0.0f32; 16]; 2];
    for (matrix, y) in bind.iter_mut().zip(BIND_Y) {
        (matrix[0], matrix[5], matrix[10], matrix[15], matrix[13]) = (1.0, 1.0, 1.0, 1.0, y);
    }
    let bind = glb.floats(&bind);
    let times = glb.floats(&KEY_TIMES.map(|time| [time]));
    let (turns, shifts, sizes) = (glb.floats(&TURNS), glb.floats(&SHIFTS), glb.floats(&SIZES));
    let images: Vec<Value> = [[255, 0, 0], [128, 128, 255]]
        .map(|color| json!({ "bufferView": glb.view(&png(color)), "mimeType": "image/png" }))
        .to_vec();
    let skinned = json!({ "POSITION": position, "TEXCOORD_0": uv, "JOINTS_0": joints_0, "WEIGHTS_0": weights_0,
        "JOINTS_1": joints_1, "WEIGHTS_1": weights_1 });
    let plain = json!({ "POSITION": position, "TEXCOORD_0": uv });
    let fields = json!({
        "scene": 0,
        "scenes": [{ "nodes": [4] }],
        "nodes": [
            { "name": "body", "mesh": 0, "skin": 0, "translation": [100, 100, 100] },
            { "name": "upper", "translation": [0, 1, 0] },
            { "name": "lower", "children": [1] },
            { "name": "box", "mesh": 1, "translation": [3, 0, 0], "scale": [2, 2, 2] },
            { "name": "root", "children": [0, 2, 3] }
        ],
        "meshes": [
            { "name": "skin", "primitives": [{ "attributes": skinned, "indices": indices, "material": 0 }] },
            { "name": "box", "primitives": [{ "attributes": plain, "indices": indices, "material": 1 }] }
        ],
        "skins": [{ "name": "arm", "joints": [2, 1], "inverseBindMatrices": bind }],
        "materials": [
            { "name": "cloth", "doubleSided": true, "alphaMode": "MASK", "alphaCutoff": 0.25,
              "pbrMetallicRoughness": { "baseColorTexture": { "index": 0 }, "roughnessFactor": 0.5 } },
            { "name": "wood", "normalTexture": { "index": 1, "scale": 0.5 } }
        ],
        "images": images,
        "samplers": [{ "wrapS": 33071, "wrapT": 33648 }],
        "textures": [{ "source": 0, "sampler": 0 }, { "source": 1 }],
        "animations": [{ "name": "wave",
            "samplers": [
                { "input": times, "output": turns },
                { "input": times, "output": shifts, "interpolation": "CUBICSPLINE" },
                { "input": times, "output": sizes, "interpolation": "STEP" }
            ],
            "channels": [
                { "sampler": 0, "target": { "node": 1, "path": "rotation" } },
                { "sampler": 1, "target": { "node": 2, "path": "translation" } },
                { "sampler": 2, "target": { "node": 3, "path": "scale" } }
            ]
        }]
    });
    for (key, value) in fields.as_object().expect("an object") {
        glb.root[key] = value.clone();
    }
    glb
}

fn load_sample() -> Model {
    from_slice(&sample().finish(), "sample.glb").expect("a good file")
}

#[test]
fn sample_file_arrives_whole() {
    let model = load_sample();
    assert_sound(&model, "sample");
    let names: Vec<&str> = model.bones.iter().map(|bone| bone.name.as_str()).collect();
    assert_eq!(names, ["root", "body", "lower", "upper", "box"], "depth first, children in file order");
    assert_eq!(model.palette.iter().map(|entry| entry.bone).collect::<Vec<_>>(), [2, 3, 4]);
    assert_eq!((model.primitives.len(), model.indices.len()), (2, 24));
    let [cloth, wood] = &model.materials[..] else { panic!("two materials") };
    assert_eq!((cloth.alpha_cutoff, cloth.double_sided, cloth.roughness), (Some(0.25), true, 0.5));
    assert_eq!((wood.alpha_cutoff, wood.normal_scale, wood.normal_texture), (None, 0.5, Some(1.into())));
    let [red, bumps] = &model.textures[..] else { panic!("two textures") };
    assert_eq!(
        (red.wrap, red.srgb, &red.rgba8[..4]),
        ([Wrap::Clamp, Wrap::Mirror], true, &[255, 0, 0, 255][..])
    );
    assert_eq!((bumps.wrap, bumps.srgb), ([Wrap::Repeat; 2], false));
    assert_eq!((model.clips[0].name.as_str(), model.clips[0].duration_s), ("wave", 1.25));
    assert_eq!(model.clips[0].tracks.iter().map(|track| track.bone).collect::<Vec<_>>(), [3, 2, 4]);
}

#[test]
fn more_than_four_influences_are_merged_and_reduced() {
    let model = load_sample();
    let on_top =
        model.vertices.iter().find(|vertex| vertex.position == Vec3::from(POSITIONS[0])).expect("vertex 0");
    // Joint 0 with 1, joint 1 with 51/255: 0.2, in the second set.
    assert_eq!(on_top.joints[..2], [0, 1]);
    let error = |slot: usize, share: f32| (on_top.weights[slot] - share / 1.2).abs();
    assert!(error(0, 1.0) < WEIGHT_STEP && error(1, 0.2) < WEIGHT_STEP);
}

type Matrix = [[f64; 4]; 4];

/// Rows of `translate * rotate * scale`, from the textbook formulas in double precision.
fn textbook(t: [f64; 3], [x, y, z, w]: [f64; 4], s: [f64; 3]) -> Matrix {
    let r = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ];
    let row = |i: usize| [r[i][0] * s[0], r[i][1] * s[1], r[i][2] * s[2], t[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

fn times(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..4).map(|k| a[i][k] * b[k][j]).sum()))
}

#[test]
fn pose_at_keyframes_equals_an_independent_evaluation() {
    let model = load_sample();
    let wide = |v: [f32; 3]| v.map(f64::from);
    let none = ([0.0; 3], [0.0, 0.0, 0.0, 1.0], [1.0; 3]);
    for (key, time) in KEY_TIMES.iter().enumerate() {
        let lower = textbook(wide(SHIFTS[3 * key + 1]), none.1, none.2);
        let upper = times(&lower, &textbook([0.0, 1.0, 0.0], TURNS[key].map(f64::from), none.2));
        let unplaced = textbook([3.0, 0.0, 0.0], none.1, wide(SIZES[key]));
        let bound = times(&upper, &textbook([0.0, f64::from(BIND_Y[1]), 0.0], none.1, none.2));
        // Not wrapped: the last key is the clip's end.
        let locals = pose::source_pose(&model, Some(0), f64::from(*time));
        let palette = pose::palette(&model, &pose::global_pose(&model, &locals));
        let found = pose::skin(&model.vertices, &palette, Affine3A::IDENTITY);
        for (vertex, found) in model.vertices.iter().zip(found) {
            let p = vertex.position.to_array().map(f64::from);
            let apply = |m: &Matrix, i: usize| m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3];
            for axis in 0..3 {
                let (rise, expected) = (p[1] / 2.0, apply(&unplaced, axis));
                // Weights (1 - rise, rise) of the first set and 0.2 more on the upper joint, normalised.
                let skinned = (apply(&lower, axis) * (1.0 - rise) + apply(&bound, axis) * (rise + 0.2)) / 1.2;
                let expected = if vertex.joints[0] == 2 { expected } else { skinned };
                let error = (f64::from(found.position[axis]) - expected).abs();
                assert!(
                    error < 1e-5 + 3.0 * f64::from(WEIGHT_STEP),
                    "key {key}, {p:?}, axis {axis}: {} for {expected}",
                    found.position[axis]
                );
            }
        }
    }
}

#[test]
fn mesh_shown_by_two_nodes_is_placed_twice() {
    let mut glb = sample();
    glb.root["nodes"][4]["children"] = json!([0, 2, 3, 5]);
    glb.root["nodes"].as_array_mut().expect("nodes").push(json!({ "mesh": 1, "translation": [0, 0, 9] }));
    let model = from_slice(&glb.finish(), "two").expect("a good file");
    assert_sound(&model, "two");
    assert_eq!((model.primitives.len(), model.palette.len()), (3, 4));
    assert_eq!(model.primitives[1].material, model.primitives[2].material);
}

#[test]
fn mirrored_node_keeps_its_front_outside() {
    let mut glb = sample();
    glb.root["nodes"][3]["scale"] = json!([-1, 1, 1]);
    let model = from_slice(&glb.finish(), "mirror").expect("a good file");
    let range = model.primitives[1].first_index as usize..;
    let skinned = pose::source_skin(&model, None, 0.0, Affine3A::IDENTITY);
    for triangle in model.indices[range].chunks_exact(3) {
        let [a, b, c] = [0, 1, 2].map(|i| skinned[triangle[i] as usize]);
        let geometric = (b.position - a.position).cross(c.position - a.position);
        assert!(geometric.dot(a.normal) > 0.0, "normal {} against the winding's {geometric}", a.normal);
    }
}

#[test]
fn strips_and_fans_become_triangles() {
    for (mode, indices, triangles) in [(5, [0u8, 1, 2, 3, 4, 5], 4), (6, [0, 1, 3, 2, 4, 5], 4)] {
        let mut glb = sample();
        let list = glb.accessor(&indices, U8, "SCALAR", 6);
        glb.root["meshes"][1]["primitives"][0]["mode"] = json!(mode);
        glb.root["meshes"][1]["primitives"][0]["indices"] = json!(list);
        let model = from_slice(&glb.finish(), "strip").expect("a good file");
        assert_sound(&model, "strip");
        assert_eq!(model.primitives[1].index_count, 3 * triangles, "mode {mode}");
    }
}

#[test]
fn primitive_without_normals_is_shaded_flat() {
    let model = load_sample();
    for triangle in model.indices.chunks_exact(3) {
        let [a, b, c] = [0, 1, 2].map(|i| model.vertices[triangle[i] as usize]);
        let normal = (b.position - a.position).cross(c.position - a.position).normalize();
        assert!([a, b, c].iter().all(|corner| corner.normal.abs_diff_eq(normal, 1e-5)));
    }
}

#[test]
fn quantised_and_sparse_attributes_are_read() {
    let mut glb = sample();
    let quantised: Vec<u8> =
        POSITIONS.iter().flat_map(|p| [p[0], p[1], p[2], 0.0].map(|c| (c * 60.0) as i8 as u8)).collect();
    let view = glb.view(&quantised);
    glb.root["bufferViews"][view]["byteStride"] = json!(4);
    let position =
        json!({ "bufferView": view, "componentType": I8, "type": "VEC3", "count": 6, "normalized": true });
    let position = glb.push("accessors", position);
    let (at, with) = (glb.view(&5u16.to_le_bytes()), glb.view(&[100, 101, 102]));
    glb.root["accessors"][position]["sparse"] = json!({ "count": 1,
        "indices": { "bufferView": at, "componentType": U16 }, "values": { "bufferView": with } });
    glb.root["meshes"][1]["primitives"][0]["attributes"]["POSITION"] = json!(position);
    glb.root["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    let model = from_slice(&glb.finish(), "quantised").expect("a good file");
    let has = |wanted: Vec3| model.vertices.iter().any(|vertex| vertex.position.abs_diff_eq(wanted, 1e-6));
    assert!(has(Vec3::new(60.0, 120.0, 0.0) / 127.0 * Vec3::new(0.0, 0.5, 0.0)), "vertex 2");
    assert!(has(Vec3::new(100.0, 101.0, 102.0) / 127.0), "vertex 5 is replaced");
    assert!(!has(Vec3::new(60.0, 120.0, 15.0) / 127.0), "vertex 5 is gone");
}

#[test]
fn buffers_and_images_beside_the_file_and_in_data_uris_are_found() {
    let folder = tempfile::tempdir().expect("a folder");
    let (mut root, bin) = parts(&sample().finish());
    std::fs::write(folder.path().join("my data.bin"), &bin).expect("write");
    std::fs::write(folder.path().join("red.png"), png([255, 0, 0])).expect("write");
    root["buffers"][0]["uri"] = json!("my%20data.bin");
    root["images"][0] = json!({ "uri": "red.png" });
    let file = folder.path().join("sample.gltf");
    std::fs::write(&file, root.to_string()).expect("write");
    let model = load(&file).expect("a good file");
    assert_eq!(model.vertices, load_sample().vertices);
    assert_eq!(model.textures[0].rgba8, load_sample().textures[0].rgba8);
    assert_eq!(model.name, "sample");

    let letters = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::from("data:application/octet-stream;base64,");
    for three in bin.chunks(3) {
        let word =
            three.iter().fold(0u32, |word, byte| word << 8 | u32::from(*byte)) << (8 * (3 - three.len()));
        (0..=three.len()).for_each(|i| text.push(char::from(letters[(word >> (18 - 6 * i) & 63) as usize])));
    }
    root["buffers"][0]["uri"] = json!(text);
    root["images"][0] = json!({ "bufferView": root["images"][1]["bufferView"], "mimeType": "image/png" });
    let model = from_slice(root.to_string().as_bytes(), "embedded").expect("a good file");
    assert_eq!(model.vertices, load_sample().vertices);

    std::fs::remove_file(folder.path().join("red.png")).expect("remove");
    let message = load(&file).expect_err("no image").to_string();
    assert!(message.contains("sample.gltf: image 0: file 'red.png'"), "{message}");
}

#[cfg(unix)]
#[test]
fn what_lies_outside_the_assets_folder_is_not_read() {
    let top = tempfile::tempdir().expect("a folder");
    let asset = top.path().join("asset");
    std::fs::create_dir(&asset).expect("made");
    let (mut root, bin) = parts(&sample().finish());
    std::fs::write(top.path().join("secret.bin"), &bin).expect("written");
    std::fs::write(top.path().join("secret.png"), png([1, 2, 3])).expect("written");
    std::os::unix::fs::symlink("../secret.bin", asset.join("link.bin")).expect("linked");
    let absolute = top.path().join("secret.bin").to_string_lossy().into_owned();
    let file = asset.join("sample.gltf");
    for uri in [&absolute, "../secret.bin", "%2e%2e%2fsecret.bin", "..%5csecret.bin", "link.bin"] {
        root["buffers"][0]["uri"] = json!(uri);
        std::fs::write(&file, root.to_string()).expect("written");
        let message = load(&file).expect_err(uri).to_string();
        assert!(message.contains("buffer 0: '") && message.contains(uri), "{message}");
        assert!(message.contains("put the file into the asset's folder"), "{message}");
    }
    std::fs::write(asset.join("own.bin"), &bin).expect("written");
    root["buffers"][0]["uri"] = json!("own.bin");
    root["images"][0] = json!({ "uri": "../secret.png" });
    std::fs::write(&file, root.to_string()).expect("written");
    let message = load(&file).expect_err("an image outside").to_string();
    assert!(message.contains("image 0: '../secret.png' leads out"), "{message}");
}

/// The buffers of a document that has nothing else.
fn buffers_of(folder: &Path, buffers: &Value) -> Result<Vec<buffer::Buffer>, String> {
    let text = json!({ "asset": { "version": "2.0" }, "buffers": buffers }).to_string();
    assert!(text.len() < 4096);
    let around = Surroundings::of(&folder.join("x.gltf"), &Cancel::default());
    let opened = container::open(text.as_bytes(), &around, &mut Warnings::new());
    opened.map(|container| container.buffers).map_err(|fault| fault.problem)
}

fn sparse_file(path: &Path, bytes: u64) {
    std::fs::File::create(path).and_then(|file| file.set_len(bytes)).expect("a sparse file");
}

#[test]
fn of_a_large_file_only_what_is_asked_for_is_read_and_once() {
    let folder = tempfile::tempdir().expect("a folder");
    sparse_file(&folder.path().join("large.bin"), 900 << 20);
    let uris = ["large.bin", "./large.bin", "%6carge.bin"].into_iter().cycle();
    let named: Vec<Value> = uris.take(25).map(|uri| json!({ "uri": uri, "byteLength": 4096 })).collect();
    let (buffers, notes) = super::super::limits::noting_files(|| buffers_of(folder.path(), &json!(named)));
    let buffers = buffers.expect("they fit");
    assert!(buffers.iter().all(|buffer| buffer.len() == 4096 && Rc::ptr_eq(buffer, &buffers[0])));
    assert_eq!(notes.len(), 1, "{notes:?}");
}

#[test]
fn buffers_are_bounded_together_before_any_is_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let named = |number: u32| {
        let name = format!("{number}.bin");
        sparse_file(&folder.path().join(&name), 64 << 20);
        json!({ "uri": name, "byteLength": 64 << 20 })
    };
    let named: Vec<Value> = (0..25).map(named).collect();
    let (buffers, notes) = super::super::limits::noting_files(|| buffers_of(folder.path(), &json!(named)));
    let problem = buffers.expect_err("1.6 GB");
    assert!(problem.contains("together over 1024 MiB"), "{problem}");
    assert!(notes.is_empty(), "{notes:?}");
}

#[test]
fn names_of_a_file_reach_no_terminal_as_they_are() {
    let wild = "\u{1b}]0;x\u{7}\r\n\u{202e}";
    let is_wild = |text: &str| text.chars().any(|c| c.is_control() || c == '\u{202e}');
    let wild_sample = || {
        let mut glb = sample();
        glb.root["materials"][0]["name"] = json!(wild);
        glb.root["nodes"][0]["name"] = json!(wild);
        glb.root["extensionsUsed"] = json!([wild]);
        glb
    };
    let (model, warnings) = import(&wild_sample().finish(), "wild", &Surroundings::default())
        .map_err(|fault| fault.problem)
        .expect("loads");
    let names = model.bones.iter().map(|bone| &bone.name).chain(model.materials.iter().map(|m| &m.name));
    assert!(!names.chain(&warnings).any(|text| is_wild(text)), "{warnings:?}");
    let breaks: [fn(&mut Value, &str); 4] = [
        |root, wild| root["extensionsRequired"] = json!([wild]),
        |root, wild| root["asset"]["version"] = json!(wild),
        |root, wild| root["asset"]["minVersion"] = json!({ wild: wild }),
        |root, wild| root["images"][0] = json!({ "uri": wild }),
    ];
    for (number, break_it) in breaks.into_iter().enumerate() {
        let mut glb = wild_sample();
        break_it(&mut glb.root, wild);
        let error = from_slice(&glb.finish(), wild).expect_err("broken").to_string();
        assert!(!is_wild(&error) && error.contains("\\u{202e}"), "{number}: {error:?}");
    }
}

#[test]
fn an_import_ends_wherever_it_is_asked_to() {
    let import_until = |cancel| import(&features::rich(), "rich", &Surroundings { folder: None, cancel });
    let mut looks = 0;
    while let Err(fault) = import_until(Cancel::at_look(looks)) {
        assert!(matches!(fault.in_file("x"), SceneError::Cancelled(_)), "look {looks}");
        looks += 1;
    }
    assert!(looks > 5, "looked {looks} times");
}

/// Changes the sample's JSON and returns the message that loading it gives.
#[track_caller]
fn message_after(change: impl FnOnce(&mut GlbBuilder)) -> String {
    let mut glb = sample();
    change(&mut glb);
    from_slice(&glb.finish(), "bad.glb").expect_err("a fault").to_string()
}

#[track_caller]
fn assert_message(found: &str, expected: &str) {
    assert!(found.starts_with("bad.glb: ") && found.contains(expected), "'{found}' instead of '{expected}'");
}

#[test]
fn faults_in_the_hierarchy_name_the_node() {
    let cycle = message_after(|glb| glb.root["nodes"][1]["children"] = json!([2]));
    assert_message(&cycle, "node 2 'lower': is a child of node 1 and of node 4");
    let ring = message_after(|glb| {
        glb.root["nodes"][4]["children"] = json!([0, 3]);
        glb.root["nodes"][1]["children"] = json!([2]);
    });
    assert_message(&ring, "node 1 'upper': is its own ancestor");
    let own = message_after(|glb| glb.root["nodes"][3]["children"] = json!([3]));
    assert_message(&own, "node 3 'box': is a child of node 3 and of node 4");
    let missing = message_after(|glb| glb.root["nodes"][3]["children"] = json!([77]));
    assert_message(&missing, "nodes[3].children[0]: refers to an element that does not exist");
    let flat = message_after(|glb| glb.root["nodes"][3]["rotation"] = json!([0, 0, 0, 0]));
    assert_message(&flat, "node 3 'box': its rotation");
    let huge = message_after(|glb| glb.root["nodes"][3]["scale"] = json!([1e39, 1, 1]));
    assert_message(&huge, "node 3 'box': its transform is not finite");
}

#[test]
fn faults_in_meshes_name_the_primitive() {
    let nan = message_after(|glb| {
        let bad = glb.floats(&[[0.0f32, f32::NAN, 0.0]; 6]);
        glb.root["meshes"][1]["primitives"][0]["attributes"]["POSITION"] = json!(bad);
    });
    assert_message(&nan, "mesh 'box' primitive 0 POSITION (accessor 12): value 0 is not a finite number");
    let index = message_after(|glb| {
        let bad = glb.accessor(&[0, 1, 6], U8, "SCALAR", 3);
        glb.root["meshes"][1]["primitives"][0]["indices"] = json!(bad);
    });
    assert_message(
        &index,
        "mesh 'box' primitive 0 indices (accessor 12): index 2 is 6, but there are 6 vertices",
    );
    let outside = message_after(|glb| glb.root["accessors"][0]["count"] = json!(4_000_000));
    assert_message(&outside, "mesh 'skin' primitive 0 POSITION (accessor 0): 4000000 elements of 12 bytes");
    let count = message_after(|glb| glb.root["accessors"][1]["count"] = json!(5));
    assert_message(&count, "mesh 'skin' primitive 0 TEXCOORD_0 (accessor 1): has 5 elements for 6 vertices");
    let kind = message_after(|glb| glb.root["accessors"][1]["type"] = json!("VEC3"));
    assert_message(&kind, "TEXCOORD_0 (accessor 1): has elements of type Vec3, not Vec2");
    let partial = message_after(|glb| glb.root["accessors"][2]["count"] = json!(11));
    assert_message(&partial, "mesh 'skin' primitive 0: has 11 indices");
}

#[test]
fn faults_in_skins_name_the_element() {
    let zero = message_after(|glb| {
        let none = glb.floats(&[[0.0f32; 4]; 6]);
        let attributes = &mut glb.root["meshes"][0]["primitives"][0]["attributes"];
        attributes["WEIGHTS_0"] = json!(none);
        attributes.as_object_mut().expect("object").retain(|key, _| !key.ends_with("_1"));
    });
    assert_message(&zero, "mesh 'skin' primitive 0: vertex 0 has no weight above zero");
    let joint = message_after(|glb| {
        let far = glb.accessor(&[[9u8, 1, 0, 0]; 6].concat(), U8, "VEC4", 6);
        glb.root["meshes"][0]["primitives"][0]["attributes"]["JOINTS_0"] = json!(far);
    });
    assert_message(&joint, "mesh 'skin' primitive 0 on node 0 'body': follows joint 9, but its skin has 2");
    let empty = message_after(|glb| glb.root["skins"][0]["joints"] = json!([]));
    assert_message(&empty, "skin 'arm': has no joints");
    let few = message_after(|glb| glb.root["skins"][0]["joints"] = json!([2, 1, 3]));
    assert_message(&few, "skin 'arm' inverse bind matrices (accessor 7): has 2 matrices for 3 joints");
    let bare = message_after(|glb| glb.root["nodes"][3]["skin"] = json!(0));
    assert_message(&bare, "mesh 'box' primitive 0 on node 3 'box': has no JOINTS_0");
}

#[test]
fn what_would_grow_beyond_the_limits_is_refused_before_it_is_read() {
    let shared = message_after(|glb| {
        let zeros = glb.floats(&vec![[0.0f32; 3]; 999_999]);
        let primitive = json!({ "attributes": { "POSITION": zeros } });
        glb.root["meshes"][0]["primitives"] = json!(vec![primitive; 5]);
    });
    assert_message(&shared, "mesh 'skin' primitive 4: brings its mesh over 4000000 vertices");
    let many = format!(r#"{{"asset":{{"version":"2.0"}},"nodes":[{}{{}}]}}"#, "{},".repeat(MAX_JSON_OBJECTS));
    let message = from_slice(many.as_bytes(), "bad.glb").expect_err("too many").to_string();
    assert_message(&message, "JSON: has 524291 objects; at most 524288 are supported");
}

#[test]
fn faults_in_animations_and_images_name_the_element() {
    let node = message_after(|glb| glb.root["animations"][0]["channels"][1]["target"]["node"] = json!(8));
    assert_message(&node, "animation 0 channel 1: moves node 8");
    let path =
        message_after(|glb| glb.root["animations"][0]["channels"][1]["target"]["path"] = json!("colour"));
    assert_message(&path, "animation 0 channel 1: target path");
    let order = message_after(|glb| {
        let times = glb.floats(&[[0.0f32], [0.5], [0.5]]);
        glb.root["animations"][0]["samplers"][0]["input"] = json!(times);
    });
    assert_message(&order, "animation 'wave' channel 0 input (accessor 12): key 2 is not later than key 1");
    let values =
        message_after(|glb| glb.root["animations"][0]["samplers"][0]["interpolation"] = json!("CUBICSPLINE"));
    assert_message(&values, "animation 'wave' channel 0: has 3 values for 3 keys; 3 per key are needed");
    let image = message_after(|glb| {
        let view = glb.view(&png([1, 2, 3])[..40]);
        glb.root["images"][1]["bufferView"] = json!(view);
    });
    assert_message(&image, "image 1: damaged PNG");
    let none = message_after(|glb| glb.root["images"][1] = json!({}));
    assert_message(&none, "image 1: has neither a URI nor a buffer view");
    let extension =
        message_after(|glb| glb.root["extensionsRequired"] = json!(["KHR_draco_mesh_compression"]));
    assert_message(
        &extension,
        "extension KHR_draco_mesh_compression: is required by the file, but not supported; export without",
    );
}

#[test]
fn every_truncation_of_a_file_is_an_error() {
    let glb = features::rich();
    for length in 0..glb.len() {
        let message = from_slice(&glb[..length], "short.glb").expect_err("truncated").to_string();
        assert!(message.starts_with("short.glb: "), "{length} bytes: {message}");
    }
}

fn load_damaged(bytes: &[u8], context: &str) -> bool {
    is_sound_or_refused(from_slice(bytes, "damaged.glb"), "damaged.glb", context)
}

fn mutate_bytes(bytes: &[u8], count: u32, seed: u64) -> (u32, u32) {
    let (mut loaded, mut refused) = (0, 0);
    for case in 0..count * effort() {
        let mut rng = SmallRng::seed_from_u64(seed + u64::from(case));
        let mut damaged = bytes.to_vec();
        // Half of them in the numbers behind the JSON, where damage is not noticed by a parser.
        let json_end = 20 + u32::from_le_bytes([bytes[12], bytes[13], bytes[14], bytes[15]]) as usize;
        let start = if rng.random_bool(0.5) { json_end } else { 0 };
        for _ in 0..rng.random_range(1..=8) {
            let at = rng.random_range(start..damaged.len());
            match rng.random_range(0..4) {
                0 => damaged[at] ^= 1 << rng.random_range(0..8),
                1 => damaged[at] = rng.random(),
                2 => damaged[at] = [0, 0xff, 0x7f, 0x80][rng.random_range(0..4)],
                _ => {
                    let word = [u32::MAX, i32::MAX as u32, 0, f32::NAN.to_bits(), f32::MAX.to_bits()];
                    let word = word[rng.random_range(0..word.len())].to_le_bytes();
                    let end = (at + 4).min(damaged.len());
                    damaged[at..end].copy_from_slice(&word[..end - at]);
                }
            }
        }
        if rng.random_bool(0.1) {
            damaged.truncate(rng.random_range(0..damaged.len()));
        }
        let context = format!("seed {}", seed + u64::from(case));
        if load_damaged(&damaged, &context) { loaded += 1 } else { refused += 1 }
    }
    (loaded, refused)
}

#[test]
fn flipped_bytes_give_a_sound_model_or_an_error() {
    for (name, file) in [("sample", sample().finish()), ("rich", features::rich())] {
        let (loaded, refused) = mutate_bytes(&file, 3000, 1_000_000);
        eprintln!("{name}: {loaded} damaged files loaded, {refused} refused");
        assert!(loaded > 100 && refused > 100);
    }
}

/// All values of a JSON document by path.
fn leaves(value: &Value, path: &str, out: &mut Vec<String>) {
    match value {
        Value::Object(map) => {
            map.iter().for_each(|(key, value)| leaves(value, &format!("{path}/{key}"), out))
        }
        Value::Array(list) => {
            list.iter().enumerate().for_each(|(index, value)| leaves(value, &format!("{path}/{index}"), out));
        }
        _ => {}
    }
    out.push(path.to_owned());
}

fn mutate_json(glb: &[u8], count: u32, seed: u64) -> (u32, u32) {
    let (root, bin) = parts(glb);
    let mut paths = Vec::new();
    leaves(&root, "", &mut paths);
    let values = [
        json!(0),
        json!(1),
        json!(2),
        json!(3),
        json!(5),
        json!(-1),
        json!(255),
        json!(65_536),
        json!(4_294_967_295u64),
        json!(u64::MAX),
        json!(1e39),
        json!(-0.5),
        json!("VEC3"),
        json!("SCALAR"),
        json!("MAT4"),
        json!("x"),
        json!([]),
        json!({}),
        json!(null),
        json!(true),
        json!(5120),
        json!(5121),
        json!(5123),
        json!(5125),
        json!(5126),
        json!([0, 1, 2, 3]),
        json!("CUBICSPLINE"),
        json!("STEP"),
        json!("weights"),
        json!("data:,abc"),
        json!({ "count": 3, "indices": { "bufferView": 2, "componentType": 5121 }, "values": { "bufferView": 0 } }),
    ];
    let (mut loaded, mut refused) = (0, 0);
    for case in 0..count * effort() {
        let mut rng = SmallRng::seed_from_u64(seed + u64::from(case));
        let mut damaged = root.clone();
        for _ in 0..rng.random_range(1..=2) {
            let path = &paths[rng.random_range(0..paths.len())];
            // Mostly a value of the same kind: the others do not come past the JSON types.
            let same_kind =
                rng.random_bool(0.8).then(|| damaged.pointer(path).map(std::mem::discriminant)).flatten();
            let fits = |value: &&Value| same_kind.is_none_or(|kind| std::mem::discriminant(*value) == kind);
            let candidates: Vec<&Value> = values.iter().filter(fits).collect();
            let value = candidates
                .get(rng.random_range(0..candidates.len().max(1)))
                .map_or(json!(7), |v| (*v).clone());
            match damaged.pointer_mut(path) {
                Some(Value::Object(map)) if rng.random_bool(0.7) => {
                    let keys: Vec<String> = map.keys().cloned().collect();
                    if !keys.is_empty() {
                        map.remove(&keys[rng.random_range(0..keys.len())]);
                    }
                }
                Some(place) => *place = value,
                None => {}
            }
        }
        let context = format!("JSON seed {}", seed + u64::from(case));
        if load_damaged(&write_glb(&damaged, &bin), &context) { loaded += 1 } else { refused += 1 }
    }
    (loaded, refused)
}

#[test]
fn changed_json_values_give_a_sound_model_or_an_error() {
    for (name, file) in [("sample", sample().finish()), ("rich", features::rich())] {
        let (loaded, refused) = mutate_json(&file, 4000, 2_000_000);
        eprintln!("{name}: {loaded} files with changed JSON loaded, {refused} refused");
        assert!(loaded > 100 && refused > 100);
    }
}

// ---- real assets ----

/// Where the real assets lie, if they do.
fn assets() -> Option<std::path::PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets");
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("SKIPPED: no real assets, {} does not exist", folder.display());
    None
}

#[test]
fn damaged_real_asset_gives_a_sound_model_or_an_error() {
    let Some(folder) = assets() else { return };
    let glb = std::fs::read(folder.join("RiggedSimple.glb")).expect("RiggedSimple.glb");
    let by_bytes = mutate_bytes(&glb, 400, 3_000_000);
    let by_json = mutate_json(&glb, 400, 4_000_000);
    eprintln!("RiggedSimple: loaded and refused {by_bytes:?} by bytes, {by_json:?} by JSON");
}

#[test]
fn all_real_assets_load_and_move_as_they_should() {
    let Some(folder) = assets() else { return };
    let mut count = 0;
    for entry in std::fs::read_dir(folder).expect("assets") {
        let path = entry.expect("entry").path();
        if !path.extension().is_some_and(|extension| extension == "glb" || extension == "gltf") {
            continue;
        }
        let bytes = std::fs::read(&path).expect("asset");
        let around = Surroundings::of(&path, &Cancel::default());
        let loaded = import(&bytes, "asset", &around).map_err(|fault| fault.in_file("x"));
        if path.to_string_lossy().ends_with("-draco.glb") {
            let refused = loaded.expect_err("nobody here reads Draco").to_string();
            assert!(refused.contains("export without Draco compression"), "{refused}");
            continue;
        }
        let (model, warnings) = loaded.expect("loads");
        assert_sound(&model, &path.display().to_string());
        exercise(&model);
        let name = path.file_name().expect("name").to_string_lossy().into_owned();
        print_statistics(&name, &model, &warnings);
        assert!(warnings.is_empty(), "{name}: {warnings:?}");
        count += 1;
    }
    assert!(count > 0);
}

fn print_statistics(name: &str, model: &Model, warnings: &Warnings) {
    let clip = (!model.clips.is_empty()).then_some(0);
    let moving = pose::animated_vertices(model, clip).into_iter().filter(|moving| *moving).count();
    let (low, high) = pose::bounds(model, clip, 8).expect("vertices");
    let clips: Vec<String> =
        model.clips.iter().map(|clip| format!("{} {:.2} s", clip.name, clip.duration_s)).collect();
    let textures: Vec<String> =
        model.textures.iter().map(|t| format!("{}x{}", t.extent_texels[0], t.extent_texels[1])).collect();
    eprintln!(
        "{name}: {} vertices ({moving} animated), {} triangles, {} bones, {} palette entries, {} primitives, textures {textures:?}, clips {clips:?}, from {low:.2} to {high:.2}, warnings {warnings:?}",
        model.vertices.len(),
        model.indices.len() / 3,
        model.bones.len(),
        model.palette.len(),
        model.primitives.len(),
    );
}

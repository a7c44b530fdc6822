//! Pieces with their materials as a glTF document.

use super::paint::Painted;
use crate::glb::{Buffer, Target};
use crate::surface::Surface;
use glam::{Vec3, Vec4};
use serde_json::{Value, json};

/// What a piece is made of.
pub(super) struct Material {
    pub name: &'static str,
    pub painted: Option<Painted>,
    /// Linear RGB, a factor of the picture.
    pub color: [f32; 3],
    pub roughness: f32,
    pub metallic: f32,
    /// Linear RGB radiance.
    pub glow: [f32; 3],
    /// Cut out at half of the picture's alpha, and seen from both sides.
    pub is_masked: bool,
}

impl Material {
    pub fn painted(name: &'static str, painted: Painted, roughness: f32) -> Self {
        Self { painted: Some(painted), ..Self::plain(name, [1.0; 3], roughness) }
    }

    pub fn leaves(name: &'static str, painted: Painted) -> Self {
        Self { is_masked: true, ..Self::painted(name, painted, 0.7) }
    }

    pub fn plain(name: &'static str, color: [f32; 3], roughness: f32) -> Self {
        Self { name, painted: None, color, roughness, metallic: 0.0, glow: [0.0; 3], is_masked: false }
    }
}

/// Triangles of one material.
pub(super) struct Piece {
    pub material: Material,
    pub surface: Surface,
}

/// A lamp of one point.
pub(super) struct Lamp {
    pub at: Vec3,
    /// Linear RGB irradiance at 1 m.
    pub intensity: Vec3,
    pub range_m: f32,
}

/// The bytes of a GLB file. `open` says how much of the sky a place sees, 0..1: a factor of its colour.
pub(super) fn glb(name: &str, pieces: Vec<Piece>, lamp: Option<Lamp>, open: impl Fn(Vec3) -> f32) -> Vec<u8> {
    let mut buffer = Buffer::default();
    let mut pictures = Pictures::default();
    let (mut primitives, mut materials) = (Vec::new(), Vec::new());
    for Piece { material, surface } in pieces {
        primitives.push(primitive(&surface, materials.len(), &open, &mut buffer));
        materials.push(pictures.material(material, &mut buffer));
    }
    let mut document = json!({
        "asset": {"version": "2.0", "generator": "Shadecast"},
        "extensionsUsed": ["KHR_lights_punctual", "KHR_materials_emissive_strength"],
        "scene": 0,
        "scenes": [{"name": name, "nodes": [0]}],
        "nodes": [{"name": name, "mesh": 0}],
        "meshes": [{"name": name, "primitives": primitives}],
        "materials": materials,
    });
    if !pictures.images.is_empty() {
        document["textures"] = Value::Array(pictures.textures);
        document["images"] = Value::Array(pictures.images);
    }
    if let Some(lamp) = lamp {
        hang(&lamp, &mut document);
    }
    buffer.into_glb(document)
}

fn primitive(surface: &Surface, material: usize, open: &impl Fn(Vec3) -> f32, buffer: &mut Buffer) -> Value {
    let shade = |at: &Vec3| Vec3::splat(open(*at)).extend(1.0);
    let shades: Vec<Vec4> = surface.positions.iter().map(shade).collect();
    json!({
        "attributes": {
            "POSITION": buffer.positions(&surface.positions),
            "NORMAL": buffer.vec3s(&surface.normals, Target::Vertices),
            "TEXCOORD_0": buffer.vec2s(&surface.uvs),
            "COLOR_0": buffer.vec4s(&shades),
        },
        "indices": buffer.indices(&surface.indices),
        "material": material,
    })
}

#[derive(Default)]
struct Pictures {
    images: Vec<Value>,
    textures: Vec<Value>,
}

impl Pictures {
    fn material(&mut self, material: Material, buffer: &mut Buffer) -> Value {
        let [r, g, b] = material.color;
        let mut made = json!({
            "name": material.name,
            "pbrMetallicRoughness": {
                "baseColorFactor": [r, g, b, 1.0],
                "metallicFactor": material.metallic,
                "roughnessFactor": material.roughness,
            },
            "emissiveFactor": material.glow.map(|channel| channel.min(1.0)),
        });
        let brightest = material.glow.into_iter().fold(0.0, f32::max);
        if brightest > 1.0 {
            made["emissiveFactor"] = json!(material.glow.map(|channel| channel / brightest));
            made["extensions"] = json!({"KHR_materials_emissive_strength": {"emissiveStrength": brightest}});
        }
        if material.is_masked {
            made["alphaMode"] = json!("MASK");
            made["doubleSided"] = json!(true);
        }
        if let Some(painted) = material.painted {
            made["pbrMetallicRoughness"]["baseColorTexture"] = self.texture(&painted.color_png, buffer);
            if let Some(normal_png) = painted.normal_png {
                made["normalTexture"] = self.texture(&normal_png, buffer);
            }
        }
        made
    }

    fn texture(&mut self, png: &[u8], buffer: &mut Buffer) -> Value {
        let index = self.images.len();
        let view = buffer.view(png, Target::None);
        self.images.push(json!({"bufferView": view, "mimeType": "image/png"}));
        self.textures.push(json!({"source": index}));
        json!({"index": index})
    }
}

fn hang(lamp: &Lamp, document: &mut Value) {
    let brightest = lamp.intensity.max_element();
    document["extensions"] = json!({"KHR_lights_punctual": {"lights": [{
        "type": "point",
        "color": (lamp.intensity / brightest).to_array(),
        "intensity": brightest,
        "range": lamp.range_m,
    }]}});
    let nodes = document["nodes"].as_array_mut().expect("the node of the mesh");
    nodes.push(json!({
        "name": "light", "translation": lamp.at.to_array(), "extensions": {"KHR_lights_punctual": {"light": 0}}
    }));
    document["scenes"][0]["nodes"] = json!([0, 1]);
}

//! The supported glTF extensions, the warnings about others, and the conversion of their JSON.
//!
//! The `gltf` crate knows some of these extensions, but not on all objects that may carry them, and its messages do not name
//! the element. So their JSON is kept and read here.

use super::Warnings;
use crate::error::Fault;
use ::gltf::json;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use shadecast_model::text::printable;

pub(super) const LIGHTS: &str = "KHR_lights_punctual";
pub(super) const UNLIT: &str = "KHR_materials_unlit";
pub(super) const EMISSIVE_STRENGTH: &str = "KHR_materials_emissive_strength";
pub(super) const TEXTURE_TRANSFORM: &str = "KHR_texture_transform";
const QUANTIZATION: &str = "KHR_mesh_quantization";

/// The extension as vendors proposed it, and as Khronos ratified it: the same JSON.
pub(super) const COMPRESSION: [&str; 2] = ["EXT_meshopt_compression", "KHR_meshopt_compression"];

fn is_read(name: &str) -> bool {
    let others = [LIGHTS, UNLIT, EMISSIVE_STRENGTH, TEXTURE_TRANSFORM, QUANTIZATION];
    others.contains(&name) || COMPRESSION.contains(&name)
}

/// Refuses a file that cannot be shown without an extension that is not read, and says how to get one that can.
pub(super) fn check_required(root: &json::Root) -> Result<(), Fault> {
    let Some(name) = root.extensions_required.iter().find(|name| !is_read(name)) else { return Ok(()) };
    let problem = format!("is required by the file, but not supported; {}", remedy(name));
    Err(Fault::new(format!("extension {}", printable(name)), problem))
}

fn remedy(name: &str) -> &'static str {
    match name {
        "KHR_draco_mesh_compression" => {
            "export without Draco compression (EXT_meshopt_compression is supported)"
        }
        "KHR_texture_basisu" | "EXT_texture_webp" | "EXT_texture_avif" | "MSFT_texture_dds" => {
            "convert the textures to PNG or JPEG"
        }
        "KHR_materials_pbrSpecularGlossiness" => "convert the materials to metallic-roughness",
        "EXT_mesh_gpu_instancing" => "export each placed mesh as a node of its own",
        _ => "export the asset without it",
    }
}

/// One warning for each extension that is used and not read.
pub(super) fn note_ignored(root: &json::Root, warnings: &mut Warnings) {
    for name in root.extensions_used.iter().filter(|name| !is_read(name)) {
        warnings.insert(format!("extension {} is ignored", printable(name)));
    }
}

/// The extension `name` of an object as a `T`, `None` where the object does not have it.
pub(super) fn read<T: DeserializeOwned>(
    extensions: Option<&Map<String, Value>>,
    name: &str,
    element: &str,
) -> Result<Option<T>, Fault> {
    let Some(value) = extensions.and_then(|all| all.get(name)) else { return Ok(None) };
    let fault =
        |error: serde_json::Error| Fault::new(element, format!("{name}: {}", printable(&error.to_string())));
    T::deserialize(value).map(Some).map_err(fault)
}

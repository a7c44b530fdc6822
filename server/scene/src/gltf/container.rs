//! From bytes, GLB or plain glTF, to a validated JSON document and its buffers.
//!
//! The `gltf` crate's container reader computes with unchecked lengths, so this module reads the container. It uses the crate's
//! JSON types and index validation.

use super::super::error::Fault;
use super::super::import::Surroundings;
use super::super::limits::{MAX_JSON_OBJECTS, MAX_JSON_VALUES};
use super::buffer::{Buffer, read_buffers};
use super::compression::{self, Decoded};
use super::{Warnings, extensions};
use ::gltf::json;
use ::gltf::json::validation::{Error as Invalid, Validate};
use serde::Deserialize;
use serde_json::Value;
use shadecast_model::text::printable;
use std::collections::{BTreeMap, HashMap};
use std::rc::Rc;

/// A document whose indices are all in range, with its buffers.
pub(super) struct Container {
    pub(super) document: ::gltf::Document,
    /// As [`read_buffers`] gives them.
    pub(super) buffers: Vec<Buffer>,
    /// Bytes of all buffers, each file counted once, decompressed views included.
    pub(super) data_bytes: usize,
    /// What compressed buffer views hold.
    pub(super) decoded: Decoded,
}

/// Reads a GLB or a glTF JSON text. External files are looked up in the surroundings' folder.
pub(super) fn open(bytes: &[u8], around: &Surroundings, warnings: &mut Warnings) -> Result<Container, Fault> {
    let (json_bytes, blob) = if bytes.starts_with(b"glTF") { split_glb(bytes)? } else { (bytes, None) };
    check_amount(json_bytes)?;
    let root = parse(json_bytes, warnings).map_err(|error| {
        Fault::new("JSON", format!("not a glTF document: {}", printable(&error.to_string())))
    })?;
    check_version(&root)?;
    extensions::check_required(&root)?;
    extensions::note_ignored(&root, warnings);
    check_indices(&root)?;
    let buffers = read_buffers(&root, blob, around)?;
    let decoded = compression::decode_views(&root, &buffers)?;
    let data_bytes = data_bytes(&buffers, &decoded);
    let document = ::gltf::Document::from_json_without_validation(root);
    Ok(Container { document, buffers, data_bytes, decoded })
}

/// Counts braces and commas before anything is made of them; those in strings too, which have few.
fn check_amount(json: &[u8]) -> Result<(), Fault> {
    let count = |sign: u8| json.iter().filter(|byte| **byte == sign).count();
    for (sign, most, what) in [(b'{', MAX_JSON_OBJECTS, "objects"), (b',', MAX_JSON_VALUES, "values")] {
        let found = count(sign);
        if found > most {
            let problem =
                format!("has {found} {what}; at most {most} are supported: merge its nodes and meshes");
            return Err(Fault::new("JSON", problem));
        }
    }
    Ok(())
}

fn data_bytes(buffers: &[Buffer], decoded: &Decoded) -> usize {
    let unique: HashMap<*const Vec<u8>, usize> =
        buffers.iter().map(|buffer| (Rc::as_ptr(buffer), buffer.len())).collect();
    unique.values().sum::<usize>() + decoded.values().map(Vec::len).sum::<usize>()
}

/// What the `gltf` crate's types pass over or cannot hold.
#[derive(Default, Deserialize)]
#[serde(default)]
struct Overlooked {
    meshes: Vec<OverlookedMesh>,
    animations: Vec<OverlookedAnimation>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct OverlookedMesh {
    primitives: Vec<OverlookedPrimitive>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct OverlookedPrimitive {
    targets: Vec<BTreeMap<String, Value>>,
}

#[derive(Default, Deserialize)]
#[serde(default)]
struct OverlookedAnimation {
    channels: Vec<Value>,
}

/// Whether a channel moves a node; those that do not are for extensions (glTF 2.0 section 5.6).
fn moves_a_node(channel: &Value) -> bool {
    channel.get("target").is_none_or(|target| target.get("node").is_some())
}

fn parse(bytes: &[u8], warnings: &mut Warnings) -> Result<json::Root, serde_json::Error> {
    // What is wrong with the document is said by the second reading of it, with the place.
    let overlooked: Overlooked = serde_json::from_slice(bytes).unwrap_or_default();
    let targets = overlooked.meshes.iter().flat_map(|mesh| &mesh.primitives).flat_map(|p| &p.targets);
    if targets.flat_map(|target| target.keys()).any(|name| !is_morphed(name)) {
        warnings.insert(
            "morph targets of other attributes than positions, normals and tangents are ignored".into(),
        );
    }
    if overlooked.animations.iter().flat_map(|animation| &animation.channels).all(moves_a_node) {
        return json::Root::from_slice(bytes);
    }
    warnings.insert("curves without a target node are ignored".into());
    let mut root: Value = serde_json::from_slice(bytes)?;
    for animation in root.get_mut("animations").and_then(Value::as_array_mut).into_iter().flatten() {
        if let Some(channels) = animation.get_mut("channels").and_then(Value::as_array_mut) {
            channels.retain(moves_a_node);
        }
    }
    serde_json::from_value(root)
}

fn is_morphed(attribute: &str) -> bool {
    json::mesh::VALID_MORPH_TARGETS.contains(&attribute)
}

/// The JSON chunk and, if there is one, the binary chunk of a GLB (glTF 2.0 section 4.4).
fn split_glb(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), Fault> {
    let fault = |problem: String| Fault::new("GLB container", problem);
    let word = |at: usize| {
        let four = bytes.get(at..at + 4)?;
        Some(u32::from_le_bytes([four[0], four[1], four[2], four[3]]))
    };
    let (Some(version), Some(length)) = (word(4), word(8)) else {
        return Err(fault("the file ends inside its header".into()));
    };
    if version != 2 {
        return Err(fault(format!("is version {version}; only version 2 is supported")));
    }
    let length = length as usize;
    if length > bytes.len() {
        return Err(fault(format!("is {length} bytes long, but the file ends after {}", bytes.len())));
    }
    let (mut json, mut blob, mut at) = (None, None, 12);
    while let (Some(size), Some(kind)) = (word(at), word(at + 4)) {
        let start = at + 8;
        let end = start + size as usize;
        if end > length {
            return Err(fault(format!("the chunk at byte {at} reaches to {end}, past the end at {length}")));
        }
        // Later chunks of a known kind and chunks of unknown kinds are to be ignored.
        match &kind.to_le_bytes() {
            b"JSON" if json.is_none() => json = Some(&bytes[start..end]),
            b"BIN\0" if blob.is_none() => blob = Some(&bytes[start..end]),
            _ => {}
        }
        at = end;
    }
    Ok((json.ok_or_else(|| fault("has no JSON chunk".into()))?, blob))
}

fn check_version(root: &json::Root) -> Result<(), Fault> {
    if root.asset.version.starts_with("2.") {
        return Ok(());
    }
    Err(Fault::new("asset", format!("is glTF {}; only 2.x is supported", printable(&root.asset.version))))
}

/// The crate's validation, which makes its accessors safe to call, less what this importer can do without; plus what
/// it leaves out (animation targets, image sources).
fn check_indices(root: &json::Root) -> Result<(), Fault> {
    check_positions(root)?;
    let mut faults = Vec::new();
    root.validate(root, json::Path::new, &mut |path, error| faults.push((path().0, error)));
    faults.retain(|(path, error)| !is_tolerable(path, *error));
    if let Some((path, error)) = faults.first() {
        let more = if faults.len() > 1 { format!(" (and {} more)", faults.len() - 1) } else { String::new() };
        return Err(Fault::new(printable(path), format!("{}{more}", describe(*error))));
    }
    check_animation_targets(root)?;
    check_image_sources(root)
}

/// The crate's validation itself panics where POSITION names an accessor that does not exist (gltf-json 1.4.1), so
/// this comes first.
fn check_positions(root: &json::Root) -> Result<(), Fault> {
    let semantic = json::validation::Checked::Valid(json::mesh::Semantic::Positions);
    for (index, mesh) in root.meshes.iter().enumerate() {
        for (number, primitive) in mesh.primitives.iter().enumerate() {
            let accessor = primitive.attributes.get(&semantic).map(|accessor| accessor.value());
            if let Some(accessor) = accessor.filter(|accessor| *accessor >= root.accessors.len()) {
                let problem = format!("POSITION is accessor {accessor}, which does not exist");
                return Err(Fault::new(format!("mesh {index} primitive {number}"), problem));
            }
        }
    }
    Ok(())
}

/// Bounds of POSITION are for culling, which is not done by them here; required extensions are checked elsewhere.
fn is_tolerable(path: &str, error: Invalid) -> bool {
    let bounds = path.ends_with("].min") || path.ends_with("].max");
    bounds || error == Invalid::Unsupported
}

fn describe(error: Invalid) -> &'static str {
    match error {
        Invalid::IndexOutOfBounds => "refers to an element that does not exist",
        Invalid::Invalid => "has a value that glTF does not know",
        Invalid::Missing => "is required but missing",
        Invalid::Oversize => "is larger than this machine can address",
        Invalid::Unsupported => "is required by the file, but not supported",
    }
}

fn check_animation_targets(root: &json::Root) -> Result<(), Fault> {
    for (index, animation) in root.animations.iter().enumerate() {
        for (number, channel) in animation.channels.iter().enumerate() {
            let element = || format!("animation {index} channel {number}");
            if channel.target.node.value() >= root.nodes.len() {
                let node = channel.target.node.value();
                return Err(Fault::new(element(), format!("moves node {node}, which does not exist")));
            }
            if matches!(channel.target.path, json::validation::Checked::Invalid) {
                return Err(Fault::new(element(), "target path is not one that glTF knows"));
            }
        }
    }
    Ok(())
}

fn check_image_sources(root: &json::Root) -> Result<(), Fault> {
    match root.images.iter().position(|image| image.uri.is_none() && image.buffer_view.is_none()) {
        Some(index) => Err(Fault::new(format!("image {index}"), "has neither a URI nor a buffer view")),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn glb_whose_chunk_passes_its_end_is_refused() {
        let mut glb = b"glTF\x02\0\0\0\x14\0\0\0\xff\xff\xff\xffJSON".to_vec();
        let fault = split_glb(&glb).expect_err("chunk too long");
        assert!(fault.problem.contains("chunk at byte 12"), "{}", fault.problem);
        glb.truncate(9);
        assert!(split_glb(&glb).is_err());
    }
}

//! Writing binary glTF: the container, and the buffer with its views and accessors.
//!
//! Layout rules are those of the glTF 2.0 specification, sections 3.6 (buffers, accessors) and 4.4 (GLB).

use glam::{Mat4, Quat, Vec2, Vec3, Vec4};
use serde_json::{Value, json};

const MAGIC: u32 = 0x4654_6C67; // "glTF"
const VERSION: u32 = 2;
const CHUNK_JSON: u32 = 0x4E4F_534A;
const CHUNK_BIN: u32 = 0x004E_4942;

const COMPONENT_U8: u32 = 5121;
const COMPONENT_U16: u32 = 5123;
const COMPONENT_F32: u32 = 5126;

/// What a buffer view is bound to, where the specification asks for a target.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Target {
    /// Vertex attributes.
    Vertices,
    /// Vertex indices.
    Indices,
    /// Everything else: animation curves, inverse bind matrices, images.
    None,
}

impl Target {
    fn code(self) -> Option<u32> {
        match self {
            Self::Vertices => Some(34962),
            Self::Indices => Some(34963),
            Self::None => None,
        }
    }
}

/// Collects the one binary buffer of a GLB with the `bufferViews` and `accessors` that describe it.
#[derive(Debug, Default)]
pub struct Buffer {
    bytes: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl Buffer {
    /// Appends raw bytes as a buffer view (4-byte aligned) and returns the view's index.
    pub fn view(&mut self, bytes: &[u8], target: Target) -> usize {
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        let mut view = json!({"buffer": 0, "byteOffset": self.bytes.len(), "byteLength": bytes.len()});
        if let Some(code) = target.code() {
            view["target"] = json!(code);
        }
        self.bytes.extend_from_slice(bytes);
        self.views.push(view);
        self.views.len() - 1
    }

    /// Scalars (for example key times, seconds), with the bounds that animation inputs need.
    pub fn scalars(&mut self, values: &[f32]) -> usize {
        self.floats(values.iter().map(|&value| [value]), "SCALAR", Target::None, true)
    }

    /// Vertex positions, with the bounds that they need.
    pub fn positions(&mut self, values: &[Vec3]) -> usize {
        self.floats(values.iter().map(Vec3::to_array), "VEC3", Target::Vertices, true)
    }

    /// Three-component values: vertex attributes or animation outputs.
    pub fn vec3s(&mut self, values: &[Vec3], target: Target) -> usize {
        self.floats(values.iter().map(Vec3::to_array), "VEC3", target, false)
    }

    /// Two-component vertex attributes.
    pub fn vec2s(&mut self, values: &[Vec2]) -> usize {
        self.floats(values.iter().map(Vec2::to_array), "VEC2", Target::Vertices, false)
    }

    /// Four-component vertex attributes.
    pub fn vec4s(&mut self, values: &[Vec4]) -> usize {
        self.floats(values.iter().map(Vec4::to_array), "VEC4", Target::Vertices, false)
    }

    /// Rotations, xyzw.
    pub fn quats(&mut self, values: &[Quat]) -> usize {
        self.floats(values.iter().map(|quat| quat.to_array()), "VEC4", Target::None, false)
    }

    /// Column-major matrices.
    pub fn mat4s(&mut self, values: &[Mat4]) -> usize {
        self.floats(values.iter().map(Mat4::to_cols_array), "MAT4", Target::None, false)
    }

    /// Joint indices, four per vertex.
    pub fn joints(&mut self, values: &[[u8; 4]]) -> usize {
        let view = self.view(values.as_flattened(), Target::Vertices);
        self.accessor(json!({
            "bufferView": view, "componentType": COMPONENT_U8, "count": values.len(), "type": "VEC4"
        }))
    }

    /// Vertex indices.
    pub fn indices(&mut self, values: &[u16]) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|index| index.to_le_bytes()).collect();
        let view = self.view(&bytes, Target::Indices);
        self.accessor(json!({
            "bufferView": view, "componentType": COMPONENT_U16, "count": values.len(), "type": "SCALAR"
        }))
    }

    /// Moves `buffers`, `bufferViews` and `accessors` into the document and returns the bytes of the GLB file.
    pub fn into_glb(self, mut document: Value) -> Vec<u8> {
        document["buffers"] = json!([{"byteLength": self.bytes.len()}]);
        document["bufferViews"] = Value::Array(self.views);
        document["accessors"] = Value::Array(self.accessors);
        write_glb(&document, &self.bytes)
    }

    fn accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn floats<const N: usize>(
        &mut self,
        values: impl Iterator<Item = [f32; N]>,
        kind: &str,
        target: Target,
        bounds: bool,
    ) -> usize {
        let (mut low, mut high) = ([f32::INFINITY; N], [f32::NEG_INFINITY; N]);
        let (mut bytes, mut count) = (Vec::new(), 0_usize);
        for value in values {
            for axis in 0..N {
                low[axis] = low[axis].min(value[axis]);
                high[axis] = high[axis].max(value[axis]);
                bytes.extend_from_slice(&value[axis].to_le_bytes());
            }
            count += 1;
        }
        let view = self.view(&bytes, target);
        let mut accessor =
            json!({"bufferView": view, "componentType": COMPONENT_F32, "count": count, "type": kind});
        if bounds {
            accessor["min"] = json!(low.as_slice());
            accessor["max"] = json!(high.as_slice());
        }
        self.accessor(accessor)
    }
}

/// The bytes of a GLB file with this document and this binary chunk (buffer 0).
///
/// Both chunks are padded to 4 bytes, the document with spaces, as the container format asks.
pub fn write_glb(document: &Value, bin: &[u8]) -> Vec<u8> {
    let mut text = document.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let bin_len = bin.len().next_multiple_of(4);
    let total = 12 + 8 + text.len() + 8 + bin_len;

    let mut bytes = Vec::with_capacity(total);
    let words = [MAGIC, VERSION, length_u32(total), length_u32(text.len()), CHUNK_JSON];
    words.iter().for_each(|word| bytes.extend_from_slice(&word.to_le_bytes()));
    bytes.extend_from_slice(&text);
    let words = [length_u32(bin_len), CHUNK_BIN];
    words.iter().for_each(|word| bytes.extend_from_slice(&word.to_le_bytes()));
    bytes.extend_from_slice(bin);
    bytes.resize(total, 0);
    bytes
}

/// A GLB holds at most 4 GiB; what this program generates is thousands of times smaller.
fn length_u32(length: usize) -> u32 {
    u32::try_from(length).expect("generated assets stay far below 4 GiB")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn container_is_padded_and_states_its_length() {
        let bytes = write_glb(&json!({"asset": {"version": "2.0"}}), &[1, 2, 3, 4, 5]);
        assert_eq!(bytes.len() % 4, 0);
        assert_eq!(u32::from_le_bytes(bytes[8..12].try_into().unwrap()) as usize, bytes.len());
        let glb = gltf::Glb::from_slice(&bytes).unwrap();
        assert_eq!(glb.bin.unwrap().as_ref(), [1, 2, 3, 4, 5, 0, 0, 0]);
    }

    #[test]
    fn accessors_come_back_as_written() {
        let positions = [Vec3::new(1.0, -2.0, 3.5), Vec3::new(-4.0, 5.0, 6.25)];
        let mut buffer = Buffer::default();
        let _odd_length = buffer.view(&[7, 7, 7], Target::None);
        let position = buffer.positions(&positions);
        let index = buffer.indices(&[0, 1, 0]);
        let document = json!({
            "asset": {"version": "2.0"},
            "meshes": [{"primitives": [{"attributes": {"POSITION": position}, "indices": index}]}]
        });
        let gltf = gltf::Gltf::from_slice(&buffer.into_glb(document)).unwrap();
        let primitive = gltf.meshes().next().unwrap().primitives().next().unwrap();
        assert_eq!(primitive.bounding_box().min, [-4.0, -2.0, 3.5]);
        assert_eq!(primitive.bounding_box().max, [1.0, 5.0, 6.25]);
        let reader = primitive.reader(|_| gltf.blob.as_deref());
        let read: Vec<Vec3> = reader.read_positions().unwrap().map(Vec3::from_array).collect();
        assert_eq!(read, positions);
        assert_eq!(reader.read_indices().unwrap().into_u32().collect::<Vec<_>>(), [0, 1, 0]);
    }
}

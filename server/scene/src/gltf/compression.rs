//! `EXT_meshopt_compression`: buffer views with compressed bytes. They are decoded once, before all reads, so the rest of the
//! importer does not know of compression.

use super::buffer::Buffer;
use super::extensions::{self, COMPRESSION};
use crate::error::Fault;
use crate::limits::MAX_DECODED_BYTES;
use ::gltf::json;
use serde::Deserialize;
use serde_json::{Map, Value};
use std::collections::HashMap;

/// By buffer view.
pub(super) type Decoded = HashMap<usize, Vec<u8>>;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Compressed {
    buffer: usize,
    #[serde(default)]
    byte_offset: usize,
    byte_length: usize,
    byte_stride: usize,
    count: usize,
    mode: Mode,
    #[serde(default)]
    filter: Filter,
}

#[derive(Clone, Copy, Deserialize, PartialEq)]
#[serde(rename_all = "UPPERCASE")]
enum Mode {
    Attributes,
    Triangles,
    Indices,
}

#[derive(Clone, Copy, Default, Deserialize, PartialEq)]
#[serde(rename_all = "UPPERCASE")]
enum Filter {
    #[default]
    None,
    Octahedral,
    Quaternion,
    Exponential,
    Color,
}

/// Decodes all compressed views.
pub(super) fn decode_views(root: &json::Root, buffers: &[Buffer]) -> Result<Decoded, Fault> {
    let (mut decoded, mut total) = (Decoded::new(), 0usize);
    for (index, view) in root.buffer_views.iter().enumerate() {
        let others = view.extensions.as_ref().map(|extensions| &extensions.others);
        let Some((name, compressed)) = find(others, index)? else { continue };
        let fault = |problem: String| Fault::new(format!("buffer view {index} {name}"), problem);
        let bytes = compressed.decoded_bytes().map_err(fault)?;
        if bytes as u64 != view.byte_length.0 {
            let problem = format!("decodes to {bytes} bytes, but the view has {}", view.byte_length.0);
            return Err(fault(problem));
        }
        total = total.saturating_add(bytes);
        if total > MAX_DECODED_BYTES {
            let limit = MAX_DECODED_BYTES >> 20;
            return Err(fault(format!("brings decompressed data over {limit} MiB; reduce the asset")));
        }
        decoded.insert(index, compressed.decode(buffers).map_err(fault)?);
    }
    Ok(decoded)
}

fn find(
    others: Option<&Map<String, Value>>,
    view: usize,
) -> Result<Option<(&'static str, Compressed)>, Fault> {
    for name in COMPRESSION {
        if let Some(compressed) = extensions::read(others, name, &format!("buffer view {view}"))? {
            return Ok(Some((name, compressed)));
        }
    }
    Ok(None)
}

impl Compressed {
    /// Size after decoding; an error where mode, stride, count and filter do not go together.
    fn decoded_bytes(&self) -> Result<usize, String> {
        let Self { byte_stride: stride, count, mode, filter, .. } = *self;
        let stride_fits = match mode {
            Mode::Attributes => stride > 0 && stride <= 256 && stride.is_multiple_of(4),
            Mode::Triangles | Mode::Indices => stride == 2 || stride == 4,
        };
        if !stride_fits {
            return Err(format!("byteStride {stride} does not fit the mode"));
        }
        if mode == Mode::Triangles && !count.is_multiple_of(3) {
            return Err(format!("count {count} is not a multiple of three, though the mode is TRIANGLES"));
        }
        let filter_fits = match filter {
            Filter::None => true,
            Filter::Octahedral | Filter::Color => mode == Mode::Attributes && (stride == 4 || stride == 8),
            Filter::Quaternion => mode == Mode::Attributes && stride == 8,
            Filter::Exponential => mode == Mode::Attributes,
        };
        if !filter_fits {
            return Err(format!("the filter is not allowed with this mode and byteStride {stride}"));
        }
        count.checked_mul(stride).ok_or_else(|| format!("count {count} is too large"))
    }

    fn decode(&self, buffers: &[Buffer]) -> Result<Vec<u8>, String> {
        let buffer =
            buffers.get(self.buffer).ok_or_else(|| format!("buffer {} does not exist", self.buffer))?;
        let end = self.byte_offset.checked_add(self.byte_length);
        let source = end.and_then(|end| buffer.get(self.byte_offset..end)).ok_or_else(|| {
            let (offset, length) = (self.byte_offset, self.byte_length);
            format!("offset {offset} with {length} bytes is outside its buffer of {} bytes", buffer.len())
        })?;
        let decoded = match (self.mode, self.byte_stride) {
            (Mode::Attributes, _) => return self.decode_attributes(source),
            (Mode::Triangles, 2) => meshopt::decode_index_buffer(source, self.count).map(bytes_of::<u16>),
            (Mode::Triangles, _) => meshopt::decode_index_buffer(source, self.count).map(bytes_of::<u32>),
            (Mode::Indices, 2) => meshopt::decode_index_sequence(source, self.count).map(bytes_of::<u16>),
            (Mode::Indices, _) => meshopt::decode_index_sequence(source, self.count).map(bytes_of::<u32>),
        };
        decoded.map_err(|_| DAMAGED.to_owned())
    }

    fn decode_attributes(&self, source: &[u8]) -> Result<Vec<u8>, String> {
        let mut words = decode_vertices(source, self.count, self.byte_stride)?;
        let is_short = self.byte_stride == 8;
        match self.filter {
            Filter::None => {}
            Filter::Octahedral if is_short => meshopt::decode_filter_oct::<i16>(fours(&mut words)),
            Filter::Octahedral => meshopt::decode_filter_oct::<i8>(fours(&mut words)),
            Filter::Quaternion => meshopt::decode_filter_quat(fours(&mut words)),
            // Every number is decoded by itself, whatever the stride.
            Filter::Exponential => meshopt::decode_filter_exp::<1>(bytemuck::cast_slice_mut(&mut words)),
            Filter::Color if is_short => meshopt::decode_filter_color::<u16>(fours(&mut words)),
            Filter::Color => meshopt::decode_filter_color::<u8>(fours(&mut words)),
        }
        Ok(bytes_of(words))
    }
}

const DAMAGED: &str = "its data is damaged, or written by a newer version of the codec";

/// `count` elements of `stride` bytes, a multiple of 4 up to 256, as words, so that filters find them aligned.
fn decode_vertices(source: &[u8], count: usize, stride: usize) -> Result<Vec<u32>, String> {
    assert!(stride > 0 && stride <= 256 && stride.is_multiple_of(4), "stride {stride} was checked");
    let mut words = vec![0u32; count * (stride / 4)];
    // SAFETY: `words` has room for `count * stride` bytes, which is what the decoder writes; it reads no more than
    // `source.len()` bytes of `source`, and accepts any bytes there.
    let code = unsafe {
        let (to, from) = (words.as_mut_ptr().cast(), source.as_ptr());
        meshopt::ffi::meshopt_decodeVertexBuffer(to, count, stride, from, source.len())
    };
    if code == 0 { Ok(words) } else { Err(DAMAGED.to_owned()) }
}

fn fours<T: bytemuck::Pod>(words: &mut [u32]) -> &mut [[T; 4]] {
    bytemuck::cast_slice_mut(words)
}

fn bytes_of<T: bytemuck::Pod>(values: Vec<T>) -> Vec<u8> {
    bytemuck::cast_slice(&values).to_vec()
}

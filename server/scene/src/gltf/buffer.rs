//! The bytes of buffers and images: the container's binary chunk, `data:` URIs, files beside the asset.

use super::extensions::COMPRESSION;
use crate::error::Fault;
use crate::import::Surroundings;
use crate::limits::MAX_BUFFER_BYTES;
use crate::references::{Found, percent_decode};
use ::gltf::json;
use shadecast_model::text::printable;
use std::collections::HashMap;
use std::path::PathBuf;
use std::rc::Rc;

/// A buffer's bytes; those of one file are there once, however many buffers name it.
pub(super) type Buffer = Rc<Vec<u8>>;

/// Where a buffer's bytes come from.
enum Origin {
    File(Found),
    Data(Vec<u8>),
    Chunk,
    /// It only stands for what its compressed views decode to.
    Nowhere,
}

/// By buffer index, each at least as long as its `byteLength`; one that only stands for decoded views is empty.
pub(super) fn read_buffers(
    root: &json::Root,
    blob: Option<&[u8]>,
    around: &Surroundings,
) -> Result<Vec<Buffer>, Fault> {
    let mut origins = Vec::with_capacity(root.buffers.len().min(1024));
    for (index, buffer) in root.buffers.iter().enumerate() {
        origins.push(origin(index, buffer, blob, around)?);
    }
    let wanted = wanted_of_files(root, &origins)?;
    let chunk: Buffer = Rc::new(blob.unwrap_or_default().to_vec());
    let mut files: HashMap<PathBuf, Buffer> = HashMap::new();
    let mut buffers = Vec::with_capacity(origins.len());
    for (index, origin) in origins.into_iter().enumerate() {
        around.cancel.check()?;
        let element = || format!("buffer {index}");
        buffers.push(match origin {
            Origin::Nowhere => Buffer::default(),
            Origin::Chunk => with_length(root, index, chunk.clone())?,
            Origin::Data(bytes) => with_length(root, index, Rc::new(bytes))?,
            Origin::File(found) => match files.get(&found.real) {
                Some(known) => known.clone(),
                None => {
                    let bytes = found.read_start(wanted[&found.real]);
                    let bytes = bytes.map_err(|problem| Fault::new(element(), problem))?;
                    let read = with_length(root, index, Rc::new(bytes))?;
                    files.insert(found.real, read.clone());
                    read
                }
            },
        });
    }
    Ok(buffers)
}

fn origin(
    index: usize,
    buffer: &json::Buffer,
    blob: Option<&[u8]>,
    around: &Surroundings,
) -> Result<Origin, Fault> {
    let fault = |problem: String| Fault::new(format!("buffer {index}"), problem);
    match &buffer.uri {
        Some(uri) => match uri.strip_prefix("data:") {
            Some(data) => decode_data_uri(data).map(Origin::Data).map_err(fault),
            None => find(uri, around).map(Origin::File).map_err(fault),
        },
        None if index == 0 && blob.is_some() => Ok(Origin::Chunk),
        None if is_placeholder(buffer) => Ok(Origin::Nowhere),
        None => Err(fault("has no URI, and there is no binary chunk for it".into())),
    }
}

/// Whether a buffer only stands for what its compressed views decode to, and so may have no bytes of its own.
fn is_placeholder(buffer: &json::Buffer) -> bool {
    let others = buffer.extensions.as_ref().map(|extensions| &extensions.others);
    let is_fallback =
        |name: &&str| others.and_then(|all| all.get(*name)?.get("fallback")?.as_bool()).unwrap_or(false);
    COMPRESSION.iter().any(is_fallback)
}

/// How much of each file is needed. A few bytes of JSON can ask for any number of gigabytes, so that the sum is looked
/// at before anything is read.
fn wanted_of_files(root: &json::Root, origins: &[Origin]) -> Result<HashMap<PathBuf, u64>, Fault> {
    let mut wanted: HashMap<PathBuf, u64> = HashMap::new();
    for (index, (buffer, origin)) in root.buffers.iter().zip(origins).enumerate() {
        let Origin::File(found) = origin else { continue };
        let bytes = buffer.byte_length.0;
        if found.length < bytes {
            let problem = format!("should have {bytes} bytes, but has {}", found.length);
            return Err(Fault::new(format!("buffer {index}"), problem));
        }
        let most = wanted.entry(found.real.clone()).or_default();
        *most = bytes.max(*most);
        if wanted.values().fold(0u64, |sum, bytes| sum.saturating_add(*bytes)) > MAX_BUFFER_BYTES {
            let limit = MAX_BUFFER_BYTES >> 20;
            let problem = format!("brings the buffers together over {limit} MiB; reduce the asset");
            return Err(Fault::new(format!("buffer {index}"), problem));
        }
    }
    Ok(wanted)
}

/// The bytes, where there are as many as the document says.
fn with_length(root: &json::Root, index: usize, bytes: Buffer) -> Result<Buffer, Fault> {
    let length = root.buffers[index].byte_length.0;
    if bytes.len() as u64 >= length {
        return Ok(bytes);
    }
    let problem = format!("should have {length} bytes, but has {}", bytes.len());
    Err(Fault::new(format!("buffer {index}"), problem))
}

/// The file behind a URI that is not embedded data.
fn find(uri: &str, around: &Surroundings) -> Result<Found, String> {
    match &around.folder {
        Some(folder) => folder.find_uri(uri),
        None => Err(format!("refers to the file '{}', but the asset is not in a folder", printable(uri))),
    }
}

/// The bytes of an image's URI: embedded, or in a file beside the asset.
pub(super) fn read_uri(uri: &str, around: &Surroundings) -> Result<Vec<u8>, String> {
    match uri.strip_prefix("data:") {
        Some(data) => decode_data_uri(data),
        None => find(uri, around)?.read(),
    }
}

fn decode_data_uri(after_scheme: &str) -> Result<Vec<u8>, String> {
    let (meta, data) = after_scheme.split_once(',').ok_or("data URI without a comma")?;
    if meta.ends_with(";base64") { decode_base64(data) } else { Ok(percent_decode(data)) }
}

/// Base64 as in RFC 4648 section 4; the URL-safe letters are accepted too, padding is optional.
fn decode_base64(text: &str) -> Result<Vec<u8>, String> {
    let mut out = Vec::with_capacity(text.len() / 4 * 3 + 3);
    let (mut bits, mut count) = (0u32, 0);
    for (at, letter) in text.trim_end_matches('=').bytes().enumerate() {
        let six = match letter {
            b'A'..=b'Z' => letter - b'A',
            b'a'..=b'z' => letter - b'a' + 26,
            b'0'..=b'9' => letter - b'0' + 52,
            b'+' | b'-' => 62,
            b'/' | b'_' => 63,
            _ => return Err(format!("base64 data has an invalid character at position {at}")),
        };
        bits = bits << 6 | u32::from(six);
        count += 6;
        if count >= 8 {
            count -= 8;
            out.push((bits >> count) as u8);
            bits &= (1 << count) - 1;
        }
    }
    if count == 6 { Err("base64 data ends in the middle of a byte".into()) } else { Ok(out) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn base64_agrees_with_the_test_vectors_of_rfc_4648() {
        for (text, bytes) in [
            ("", ""),
            ("Zg==", "f"),
            ("Zm8=", "fo"),
            ("Zm9v", "foo"),
            ("Zm9vYg==", "foob"),
            ("Zm9vYmFy", "foobar"),
        ] {
            assert_eq!(decode_base64(text).expect(text), bytes.as_bytes());
        }
        assert!(decode_base64("Zm9v!").is_err());
        assert!(decode_base64("Z").is_err());
    }
}

//! Whatever the bytes, the glTF importer gives a sound model that can be evaluated, or an error.
#![no_main]

use libfuzzer_sys::fuzz_target;
use shadecast_scene::gltf::from_slice;
use shadecast_scene::sound::{assert_sound, exercise};

fuzz_target!(|data: &[u8]| {
    load(data);
    // Text and numbers apart: mutations that change a length still make a container that opens.
    if let Some(end) = data.iter().position(|byte| *byte == 0) {
        load(&container(&data[..end], &data[end + 1..]));
    }
});

fn load(file: &[u8]) {
    if let Ok(model) = from_slice(file, "fuzzed.glb") {
        assert_sound(&model, "fuzzed.glb");
        exercise(&model);
    }
}

/// A GLB of two chunks.
fn container(json: &[u8], numbers: &[u8]) -> Vec<u8> {
    let mut glb = b"glTF\x02\0\0\0".to_vec();
    glb.extend(((28 + json.len() + numbers.len()) as u32).to_le_bytes());
    for (kind, chunk) in [(b"JSON", json), (b"BIN\0", numbers)] {
        glb.extend((chunk.len() as u32).to_le_bytes());
        glb.extend(kind);
        glb.extend(chunk);
    }
    glb
}

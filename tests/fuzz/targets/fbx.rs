//! Whatever the bytes, the FBX importer gives a sound model that can be evaluated, or an error.
#![no_main]

use libfuzzer_sys::fuzz_target;
use shadecast_scene::fbx::from_slice;
use shadecast_scene::sound::{assert_sound, exercise};

fuzz_target!(|data: &[u8]| {
    if let Ok(model) = from_slice(data, "fuzzed.fbx") {
        assert_sound(&model, "fuzzed.fbx");
        exercise(&model);
    }
});

//! Whatever the text, the reader of scene files gives a scene file, or an error that names a line.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|text: &str| {
    if let Err(error) = shadecast_scene::file::parse(text, "fuzzed.toml") {
        assert!(error.to_string().starts_with("fuzzed.toml"), "{error}");
    }
});

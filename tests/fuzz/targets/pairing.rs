//! Whatever strangers say, and whatever is typed, only the device that shows the typed code is paired.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::pairing::check(data);
});

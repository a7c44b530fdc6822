//! Whatever access units hold, the decoder on the CPU gives a picture of the agreed extent or a typed error.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::decoder::check(data);
});

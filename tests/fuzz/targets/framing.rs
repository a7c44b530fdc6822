//! However the control stream is cut, the same messages come out of it.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::framing::check(data);
});

//! In whatever order pictures come, they are decoded in order, and none without the one that it needs.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::pictures::check(data);
});

//! Whatever the access unit, its sequence headers are read or refused.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::sps::check(data);
});

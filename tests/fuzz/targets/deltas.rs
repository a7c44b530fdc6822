//! Whatever deltas come one after the other, what decodes can be encoded again and is the same.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::deltas::check(data);
});

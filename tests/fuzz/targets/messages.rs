//! Whatever the bytes, a message or datagram that can be read can be written and read again.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::messages::check(data);
});

//! Whatever a client sends, and whenever, the server's session gives what is in order, or ends.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::server_session::check(data);
});

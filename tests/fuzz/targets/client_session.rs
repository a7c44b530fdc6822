//! Whatever a server sends, and whenever, the client's session gives what is in order, or ends.
#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    shadecast_fuzz::client_session::check(data);
});

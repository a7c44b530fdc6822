//! A planted bug: C reads one byte past the end of a Rust allocation. `scripts/fuzz.sh --sanitize` demands that it is reported.
#![no_main]

use libfuzzer_sys::fuzz_target;
use std::hint::black_box;

unsafe extern "C" {
    /// In `sanitize/overread.c`: the byte after the last of `count`.
    fn shadecast_overread(bytes: *const u8, count: usize) -> u8;
}

fuzz_target!(|data: &[u8]| {
    let copy: Box<[u8]> = data.iter().copied().chain([0]).collect(); // no input is empty
    // SAFETY: none, that is its purpose. The target is built with the address sanitizer only, which stops the program before the
    // byte is read.
    black_box(unsafe { shadecast_overread(copy.as_ptr(), copy.len()) });
});

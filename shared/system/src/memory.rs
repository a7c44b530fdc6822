//! What becomes of freed memory.

/// Returns large allocations to the system as soon as they are freed, here from 1 MB on. glibc keeps what is below a bound, and raises that
/// bound to 32 MB by itself: what viewers leave would stay with the process. Without effect elsewhere. To be called before threads start.
pub fn return_large_allocations() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    // SAFETY: it changes a number of the allocator; no other thread allocates meanwhile.
    unsafe {
        libc::mallopt(libc::M_MMAP_THRESHOLD, 1 << 20);
    }
}

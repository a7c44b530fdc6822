//! CPU time, for measurements of what code costs whatever else the machine does meanwhile.

/// CPU time of the calling thread, nanoseconds; 0 where the system does not tell.
pub fn thread_cpu_ns() -> i64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the pointer is to a timespec of this function.
    let failed = unsafe { libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &mut time) };
    if failed != 0 { 0 } else { time.tv_sec * 1_000_000_000 + time.tv_nsec }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn work_takes_cpu_time_and_sleep_takes_none() {
        let began_ns = thread_cpu_ns();
        std::thread::sleep(Duration::from_millis(50));
        let slept_ns = thread_cpu_ns() - began_ns;
        let mut sum = 0u64;
        while thread_cpu_ns() - began_ns - slept_ns < 1_000_000 {
            sum = std::hint::black_box(sum + 1);
        }
        assert!(slept_ns < 25_000_000 && sum > 10, "{slept_ns} ns, {sum} rounds");
    }
}

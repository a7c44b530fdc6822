//! The monotonic clock, to which OpenXR's times must be convertible, and the CPU time of a thread.

/// Nanoseconds on the monotonic clock: `CLOCK_MONOTONIC`, which is the clock of `XrTime` on Linux and Android.
#[cfg(unix)]
pub fn monotonic_now_ns() -> i64 {
    read(libc::CLOCK_MONOTONIC).expect("every Unix has CLOCK_MONOTONIC")
}

/// CPU time of the calling thread, nanoseconds; 0 where the system does not tell.
#[cfg(unix)]
pub fn thread_cpu_ns() -> i64 {
    read(libc::CLOCK_THREAD_CPUTIME_ID).unwrap_or(0)
}

#[cfg(unix)]
fn read(clock: libc::clockid_t) -> Option<i64> {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: `time` is a valid timespec to write to for the length of the call.
    let failed = unsafe { libc::clock_gettime(clock, &mut time) } != 0;
    #[allow(clippy::unnecessary_cast, reason = "the widths of the fields differ between platforms")]
    let (seconds, ns) = (time.tv_sec as i64, time.tv_nsec as i64);
    (!failed).then_some(seconds * NS_PER_S + ns)
}

/// Nanoseconds on the monotonic clock: the performance counter, which OpenXR's times are converted to on Windows.
#[cfg(windows)]
pub fn monotonic_now_ns() -> i64 {
    let mut counter = 0;
    // SAFETY: `counter` is valid to write to for the length of the call, which cannot fail since Windows XP.
    unsafe { windows_sys::Win32::System::Performance::QueryPerformanceCounter(&mut counter) };
    performance_counter_ns(counter)
}

/// A value of the performance counter on the monotonic clock, nanoseconds.
#[cfg(windows)]
pub fn performance_counter_ns(counter: i64) -> i64 {
    ns_of_ticks(counter, performance_frequency_hz())
}

/// The value of the performance counter at a time of the monotonic clock.
#[cfg(windows)]
pub fn performance_counter_at(monotonic_ns: i64) -> i64 {
    ticks_of_ns(monotonic_ns, performance_frequency_hz())
}

#[cfg(windows)]
fn performance_frequency_hz() -> i64 {
    static FREQUENCY_HZ: std::sync::OnceLock<i64> = std::sync::OnceLock::new();
    *FREQUENCY_HZ.get_or_init(|| {
        let mut frequency_hz = 0;
        // SAFETY: `frequency_hz` is valid to write to for the length of the call, which cannot fail since Windows XP.
        unsafe { windows_sys::Win32::System::Performance::QueryPerformanceFrequency(&mut frequency_hz) };
        frequency_hz.max(1)
    })
}

/// CPU time of the calling thread, nanoseconds; 0 where the system does not tell.
#[cfg(windows)]
pub fn thread_cpu_ns() -> i64 {
    use windows_sys::Win32::Foundation::FILETIME;
    use windows_sys::Win32::System::Threading::{GetCurrentThread, GetThreadTimes};
    let mut times = [FILETIME { dwLowDateTime: 0, dwHighDateTime: 0 }; 4];
    let [created, ended, kernel, user] = &mut times;
    // SAFETY: the handle means this thread, and the four times are valid to write to for the length of the call.
    let known = unsafe { GetThreadTimes(GetCurrentThread(), created, ended, kernel, user) } != 0;
    let ns = |time: &FILETIME| (i64::from(time.dwHighDateTime) << 32 | i64::from(time.dwLowDateTime)) * 100;
    if known { ns(kernel) + ns(user) } else { 0 }
}

const NS_PER_S: i64 = 1_000_000_000;

/// Ticks of a counter as nanoseconds, rounded down.
#[cfg(any(windows, test))]
fn ns_of_ticks(ticks: i64, frequency_hz: i64) -> i64 {
    (i128::from(ticks) * i128::from(NS_PER_S) / i128::from(frequency_hz)) as i64
}

/// The first tick that is not before so many nanoseconds: the inverse of [`ns_of_ticks`].
#[cfg(any(windows, test))]
fn ticks_of_ns(ns: i64, frequency_hz: i64) -> i64 {
    let (ticks, per_s) = (i128::from(ns) * i128::from(frequency_hz), i128::from(NS_PER_S));
    ((ticks + per_s - 1).div_euclid(per_s)) as i64
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn the_monotonic_clock_goes_as_time_does() {
        let before_ns = monotonic_now_ns();
        std::thread::sleep(Duration::from_millis(20));
        let took_ns = monotonic_now_ns() - before_ns;
        assert!(before_ns > 0 && took_ns >= 20_000_000, "{took_ns} ns");
    }

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

    #[test]
    fn ticks_become_nanoseconds_and_are_the_same_ticks_again() {
        for frequency_hz in [1_000_000, 1_193_182, 10_000_000, 24_000_000, 1_000_000_000] {
            for ticks in [0, 1, 2, 999_999_999, 1_234_567_890_123i64] {
                let ns = ns_of_ticks(ticks, frequency_hz);
                assert_eq!(ticks_of_ns(ns, frequency_hz), ticks, "{ticks} at {frequency_hz} Hz: {ns} ns");
            }
        }
        assert_eq!(ns_of_ticks(3, 10_000_000), 300);
        assert_eq!(ns_of_ticks(i64::MAX / 100, 10_000_000), i64::MAX / 100 * 100);
    }
}

//! Conversion of a runtime's times to the client's monotonic clock, by this system's extension or without one.
//!
//! On most systems both are the same clock. Elsewhere, without the extension, the first frame gives their distance, except for
//! the runtime's wait within a display period. That error stays constant from frame to frame, so motion stays even.

use shadecast_protocol::time::ClientTime;

/// Asks for the extension that converts times, where the runtime has it.
pub(super) fn want_conversion(wanted: &mut openxr::ExtensionSet, available: &openxr::ExtensionSet) {
    #[cfg(unix)]
    {
        wanted.khr_convert_timespec_time = available.khr_convert_timespec_time;
    }
    #[cfg(windows)]
    {
        wanted.khr_win32_convert_performance_counter_time =
            available.khr_win32_convert_performance_counter_time;
    }
}

/// A runtime's time on the client's clock; `None` where the runtime does not convert its times.
#[cfg(unix)]
pub(super) fn converted(
    instance: &openxr::Instance,
    time: openxr::Time,
) -> Option<openxr::Result<ClientTime>> {
    let convert = instance.exts().khr_convert_timespec_time.as_ref()?.convert_time_to_timespec_time;
    let mut timespec = std::mem::MaybeUninit::uninit();
    // SAFETY: the instance is alive, and the timespec valid to write to.
    let result = unsafe { convert(instance.as_raw(), time, timespec.as_mut_ptr()) };
    if result.into_raw() < 0 {
        return Some(Err(result));
    }
    // SAFETY: where the call succeeds, the whole timespec is written.
    let timespec = unsafe { timespec.assume_init() };
    Some(Ok(ClientTime(timespec.tv_sec * 1_000_000_000 + timespec.tv_nsec)))
}

/// The same.
#[cfg(windows)]
pub(super) fn converted(
    instance: &openxr::Instance,
    time: openxr::Time,
) -> Option<openxr::Result<ClientTime>> {
    let functions = instance.exts().khr_win32_convert_performance_counter_time.as_ref()?;
    let mut counter = 0;
    // SAFETY: the instance is alive, and the counter valid to write to.
    let result = unsafe {
        (functions.convert_time_to_win32_performance_counter)(instance.as_raw(), time, &mut counter)
    };
    let ns = || shadecast_system::clock::performance_counter_ns(counter);
    Some(if result.into_raw() < 0 { Err(result) } else { Ok(ClientTime(ns())) })
}

/// A frame that is to be seen later than this, or was to be seen earlier, is of another clock.
const SAME_CLOCK_NS: i64 = 1_000_000_000;

/// How far the runtime's clock is from the client's.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct GuessedClock {
    client_minus_runtime_ns: Option<i64>,
}

impl GuessedClock {
    /// When a frame will be seen for which the runtime was waited for until `now`, and which it predicts for `runtime_ns`,
    /// to be seen for `period_ns`.
    pub(super) fn convert(&mut self, runtime_ns: i64, now: ClientTime, period_ns: i64) -> ClientTime {
        let at = |offset_ns: i64| ClientTime(runtime_ns.saturating_add(offset_ns));
        let is_near = |offset_ns: &i64| at(*offset_ns).0.abs_diff(now.0) < SAME_CLOCK_NS as u64;
        let known = self.client_minus_runtime_ns.filter(is_near);
        let offset_ns = known.or(Some(0).filter(is_near)).unwrap_or_else(|| {
            // The soonest that it can be seen: a period after the wait.
            now.0.saturating_add(period_ns).saturating_sub(runtime_ns)
        });
        self.client_minus_runtime_ns = Some(offset_ns);
        at(offset_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const S: i64 = 1_000 * MS;

    #[test]
    fn a_runtime_on_the_same_clock_is_taken_at_its_word() {
        let mut clock = GuessedClock::default();
        for frame in 0..100 {
            let now = ClientTime(3_600 * S + frame * 14 * MS);
            let seen = now.plus_ns(20 * MS + frame % 3 * MS);
            assert_eq!(clock.convert(seen.0, now, 14 * MS), seen);
        }
    }

    #[test]
    fn a_runtime_on_another_clock_keeps_its_distances_between_frames() {
        let mut clock = GuessedClock::default();
        let mut last = None;
        for frame in 0..1000 {
            let jitter = frame % 5 * MS;
            let now = ClientTime(3_600 * S + frame * 14 * MS + jitter);
            let runtime_ns = 77 * S + frame * 14 * MS;
            let seen = clock.convert(runtime_ns, now, 14 * MS);
            assert!((0..30 * MS).contains(&seen.since(now)), "{frame}: {} ns ahead", seen.since(now));
            assert!(last.is_none_or(|last| seen.since(last) == 14 * MS));
            last = Some(seen);
        }
    }

    #[test]
    fn a_reset_runtime_clock_is_followed() {
        let mut clock = GuessedClock::default();
        let now = ClientTime(3_600 * S);
        clock.convert(900 * S, now, 14 * MS);
        let later = now.plus_ns(60 * S);
        assert!((0..30 * MS).contains(&clock.convert(5 * S, later, 14 * MS).since(later)));
        for nonsense in [i64::MIN, i64::MAX, 0] {
            clock.convert(nonsense, later, i64::MAX);
        }
        assert!((0..30 * MS).contains(&clock.convert(6 * S, later, 14 * MS).since(later)));
    }
}

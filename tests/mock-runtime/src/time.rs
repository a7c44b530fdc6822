//! `XrTime` is nanoseconds of the monotonic clock. On the virtual clock too: there the whole process agrees that monotonic time is
//! virtual.
//!
//! `XR_KHR_convert_timespec_time` converts to `CLOCK_MONOTONIC`, on Windows `XR_KHR_win32_convert_performance_counter_time` to the
//! performance counter.

#[cfg(windows)]
pub(crate) use counter::{convert_counter_to_time, convert_time_to_counter};
#[cfg(unix)]
pub(crate) use timespec::{convert_time_to_timespec_time, convert_timespec_time_to_time};

use crate::fault::{CallResult, Fault};
use openxr_sys as xr;

/// A time that an application may give, nanoseconds.
fn positive_ns(time: xr::Time) -> CallResult<i64> {
    let time_ns = time.as_nanos();
    if time_ns > 0 {
        return Ok(time_ns);
    }
    Err(Fault::application(xr::Result::ERROR_TIME_INVALID, format!("time {time_ns} is not positive")))
}

/// Name and version of the extension that converts on this system.
#[cfg(unix)]
pub(crate) const EXTENSION: (&[u8], u32) =
    (xr::KHR_CONVERT_TIMESPEC_TIME_EXTENSION_NAME, xr::KHR_convert_timespec_time_SPEC_VERSION);

/// The same.
#[cfg(windows)]
pub(crate) const EXTENSION: (&[u8], u32) = (
    xr::KHR_WIN32_CONVERT_PERFORMANCE_COUNTER_TIME_EXTENSION_NAME,
    xr::KHR_win32_convert_performance_counter_time_SPEC_VERSION,
);

#[cfg(unix)]
mod timespec {
    use super::positive_ns;
    use crate::fault::Fault;
    use crate::ffi::entry;
    use crate::runtime;
    use libc::timespec;
    use openxr_sys as xr;

    const SECOND_NS: i64 = 1_000_000_000;

    entry! {
        convert_time_to_timespec_time: ConvertTimeToTimespecTimeKHR = "xrConvertTimeToTimespecTimeKHR"(
            instance: value xr::Instance,
            time: value xr::Time,
            timespec_time: slot timespec,
        ) {
            runtime::lock().core(instance)?;
            let time_ns = positive_ns(time)?;
            timespec_time.tv_sec = time_ns / SECOND_NS;
            timespec_time.tv_nsec = time_ns % SECOND_NS;
            Ok(xr::Result::SUCCESS)
        }
    }

    entry! {
        convert_timespec_time_to_time: ConvertTimespecTimeToTimeKHR = "xrConvertTimespecTimeToTimeKHR"(
            instance: value xr::Instance,
            timespec_time: raw_in timespec,
            time: slot xr::Time,
        ) {
            runtime::lock().core(instance)?;
            // SAFETY: null or a timespec of the caller's.
            let given = unsafe { timespec_time.as_ref() }.ok_or_else(|| Fault::usage("timespec_time is null"))?;
            let time_ns = given.tv_sec.checked_mul(SECOND_NS).and_then(|ns| ns.checked_add(given.tv_nsec));
            let normal = (0..SECOND_NS).contains(&given.tv_nsec);
            let Some(time_ns) = time_ns.filter(|time_ns| *time_ns > 0 && normal) else {
                let message = format!("{} s {} ns is not a time", given.tv_sec, given.tv_nsec);
                return Err(Fault::application(xr::Result::ERROR_TIME_INVALID, message));
            };
            *time = xr::Time::from_nanos(time_ns);
            Ok(xr::Result::SUCCESS)
        }
    }
}

#[cfg(windows)]
mod counter {
    use super::positive_ns;
    use crate::fault::Fault;
    use crate::ffi::entry;
    use crate::runtime;
    use openxr_sys as xr;
    use openxr_sys::platform::LARGE_INTEGER;
    use shadecast_system::clock::{performance_counter_at, performance_counter_ns};

    entry! {
        convert_time_to_counter: ConvertTimeToWin32PerformanceCounterKHR = "xrConvertTimeToWin32PerformanceCounterKHR"(
            instance: value xr::Instance,
            time: value xr::Time,
            performance_counter: slot LARGE_INTEGER,
        ) {
            runtime::lock().core(instance)?;
            *performance_counter = performance_counter_at(positive_ns(time)?);
            Ok(xr::Result::SUCCESS)
        }
    }

    entry! {
        convert_counter_to_time: ConvertWin32PerformanceCounterToTimeKHR = "xrConvertWin32PerformanceCounterToTimeKHR"(
            instance: value xr::Instance,
            performance_counter: raw_in LARGE_INTEGER,
            time: slot xr::Time,
        ) {
            runtime::lock().core(instance)?;
            // SAFETY: null or a counter of the caller's.
            let given = unsafe { performance_counter.as_ref() };
            let counter = *given.ok_or_else(|| Fault::usage("performance_counter is null"))?;
            if counter <= 0 {
                let message = format!("a performance counter of {counter} is not a time");
                return Err(Fault::application(xr::Result::ERROR_TIME_INVALID, message));
            }
            *time = xr::Time::from_nanos(performance_counter_ns(counter));
            Ok(xr::Result::SUCCESS)
        }
    }
}

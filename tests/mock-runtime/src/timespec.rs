//! `XR_KHR_convert_timespec_time`: `XrTime` is nanoseconds of `CLOCK_MONOTONIC`, so both conversions are the identity.
//! On the virtual clock too: there the whole process agrees that monotonic time is virtual.

use libc::timespec;
use openxr_sys as xr;

use crate::fault::Fault;
use crate::ffi::entry;
use crate::runtime;

const SECOND_NS: i64 = 1_000_000_000;

entry! {
    convert_time_to_timespec_time: ConvertTimeToTimespecTimeKHR = "xrConvertTimeToTimespecTimeKHR"(
        instance: value xr::Instance,
        time: value xr::Time,
        timespec_time: slot timespec,
    ) {
        runtime::lock().core(instance)?;
        let time_ns = time.as_nanos();
        if time_ns <= 0 {
            return Err(Fault::application(xr::Result::ERROR_TIME_INVALID, format!("time {time_ns} is not positive")));
        }
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

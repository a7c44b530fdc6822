//! `XR_FB_display_refresh_rate`: the display has the rates of the configuration, and changes its rate at the end of a period.

use crate::fault::Fault;
use crate::ffi::{self, entry};
use crate::runtime::{self, Core, Event};
use openxr_sys as xr;

/// The display has this rate from its next period on. Who has not enabled the extension does not know its event.
pub(crate) fn change(core: &mut Core, hz: f64) {
    let before = core.grid();
    if before.hz != hz {
        core.timeline.grid = Some(before.with_rate(core.timeline.last_period, hz));
        if core.extensions.refresh_rate {
            core.events.push_back(Event::RefreshRate { from_hz: before.hz as f32, to_hz: hz as f32 });
        }
    }
}

entry! {
    enumerate_refresh_rates: EnumerateDisplayRefreshRatesFB = "xrEnumerateDisplayRefreshRatesFB"(
        session: value xr::Session,
        capacity: value u32,
        count: raw_out u32,
        rates: raw_out f32,
    ) {
        let mut runtime = runtime::lock();
        let (core, _) = runtime.session(session)?;
        let offered = core.config.rates_hz();
        // SAFETY: count and rates are the caller's, of the capacity it says.
        unsafe { ffi::enumerate((capacity, count, rates), &offered, |place, hz| *place = *hz as f32) }
    }
}

entry! {
    get_refresh_rate: GetDisplayRefreshRateFB = "xrGetDisplayRefreshRateFB"(
        session: value xr::Session,
        display_refresh_rate: slot f32,
    ) {
        let mut runtime = runtime::lock();
        let (core, _) = runtime.session(session)?;
        *display_refresh_rate = core.grid().hz as f32;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    request_refresh_rate: RequestDisplayRefreshRateFB = "xrRequestDisplayRefreshRateFB"(
        session: value xr::Session,
        display_refresh_rate: value f32,
    ) {
        let mut runtime = runtime::lock();
        let (core, _) = runtime.session(session)?;
        // 0: no preference.
        if display_refresh_rate == 0.0 {
            return Ok(xr::Result::SUCCESS);
        }
        let offered = core.config.rates_hz().into_iter().find(|hz| *hz as f32 == display_refresh_rate);
        let Some(hz) = offered else {
            let message = format!("the display has no {display_refresh_rate} Hz");
            return Err(Fault::application(xr::Result::ERROR_DISPLAY_REFRESH_RATE_UNSUPPORTED_FB, message));
        };
        change(core, hz);
        Ok(xr::Result::SUCCESS)
    }
}

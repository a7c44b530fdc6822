//! `XR_EXT_performance_settings`: the application's requests are checked and counted. They change no speed here.

use crate::fault::Fault;
use crate::ffi::entry;
use crate::runtime;
use openxr_sys as xr;

const DOMAINS: [xr::PerfSettingsDomainEXT; 2] =
    [xr::PerfSettingsDomainEXT::CPU, xr::PerfSettingsDomainEXT::GPU];
const LEVELS: [xr::PerfSettingsLevelEXT; 4] = [
    xr::PerfSettingsLevelEXT::POWER_SAVINGS,
    xr::PerfSettingsLevelEXT::SUSTAINED_LOW,
    xr::PerfSettingsLevelEXT::SUSTAINED_HIGH,
    xr::PerfSettingsLevelEXT::BOOST,
];

entry! {
    set_performance_level: PerfSettingsSetPerformanceLevelEXT = "xrPerfSettingsSetPerformanceLevelEXT"(
        session: value xr::Session,
        domain: value xr::PerfSettingsDomainEXT,
        level: value xr::PerfSettingsLevelEXT,
    ) {
        let mut runtime = runtime::lock();
        let (core, _) = runtime.session(session)?;
        if !DOMAINS.contains(&domain) || !LEVELS.contains(&level) {
            let message = format!("there is no level {level:?} of {domain:?}");
            return Err(Fault::application(xr::Result::ERROR_VALIDATION_FAILURE, message));
        }
        let place = usize::from(domain == xr::PerfSettingsDomainEXT::GPU);
        core.tally.performance_levels[place] = level.into_raw();
        Ok(xr::Result::SUCCESS)
    }
}

//! How many texels a device shades in the time that is left of an update, by what updates took before. Pure.

use shadecast_gpu::Timings;

/// Scope of shading among an update's timings.
const SHADING: &str = "shading";
/// Weight of a new measurement in the mean.
const NEW_WEIGHT: f64 = 0.2;
/// Of fewer texels the time says nothing: they are over before the pass has begun well.
const LEAST_TEXELS: u64 = 4096;
/// Part of an update's period that is left to shading, however long all else takes.
pub(crate) const LEAST_SHARE: f64 = 0.25;
/// Part of the time by which all else is behind that shading may take too: where updates are slow anyway, leaving colours as they were
/// would win little time, and show.
pub(crate) const BEHIND_SHARE: f64 = 0.5;

/// What a device was measured to take.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct ShadeRate {
    ms_by_texel: Option<f64>,
    /// All of an update but its shading.
    rest_ms: Option<f64>,
}

impl ShadeRate {
    /// An update took so long, and shaded so many texels.
    pub(crate) fn note(&mut self, timings: &Timings, shaded_texels: u64) {
        let (mut shading_ms, mut rest_ms) = (0.0, 0.0);
        for (scope, ms) in timings.iter() {
            *(if scope == SHADING { &mut shading_ms } else { &mut rest_ms }) += ms;
        }
        mean(&mut self.rest_ms, rest_ms);
        if shaded_texels >= LEAST_TEXELS && shading_ms > 0.0 {
            mean(&mut self.ms_by_texel, shading_ms / shaded_texels as f64);
        }
    }

    /// How many texels may be shaded within `wanted_ms`, or, where nothing is wanted, with what is left of `period_ms`; all while
    /// nothing was measured.
    pub(crate) fn budget_texels(&self, wanted_ms: Option<f64>, period_ms: f64) -> u64 {
        let Some(ms_by_texel) = self.ms_by_texel else { return u64::MAX };
        let left_ms = || {
            let spare_ms = period_ms - self.rest_ms.unwrap_or(0.0);
            let behind_ms = (-spare_ms).max(0.0);
            spare_ms.max(period_ms * LEAST_SHARE + behind_ms * BEHIND_SHARE)
        };
        (wanted_ms.unwrap_or_else(left_ms) / ms_by_texel).round() as u64
    }
}

fn mean(mean: &mut Option<f64>, new: f64) {
    *mean = Some(mean.map_or(new, |before| before + NEW_WEIGHT * (new - before)));
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_gpu::Timing;

    fn timings(scopes: &[(&'static str, f64)]) -> Timings {
        let timing =
            |(scope, ms): &(&'static str, f64)| Timing { scope, began_ns: 0, took_ns: (ms * 1e6) as i64 };
        scopes.iter().map(timing).collect()
    }

    #[test]
    fn texels_are_what_the_device_shades_in_time() {
        let mut rate = ShadeRate::default();
        assert_eq!(rate.budget_texels(Some(1.0), 33.0), u64::MAX, "nothing is known yet");
        rate.note(&timings(&[("id buffer", 8.0), ("shading", 10.0), ("ycbcr", 2.0)]), 1_000_000);
        assert_eq!(rate.budget_texels(Some(5.0), 33.0), 500_000);
        assert_eq!(rate.budget_texels(None, 30.0), 2_000_000, "what is left of the period");
        rate.note(&timings(&[("id buffer", 8.0), ("shading", 9.0)]), 10);
        assert_eq!(rate.budget_texels(Some(5.0), 33.0), 500_000, "a few texels tell nothing");
    }

    #[test]
    fn a_device_that_has_no_time_left_still_shades_some_and_more_the_slower_it_is_anyway() {
        let budget = |rest_ms: f64| {
            let mut rate = ShadeRate::default();
            rate.note(&timings(&[("id buffer", rest_ms), ("shading", 10.0)]), 1_000_000);
            rate.budget_texels(None, 40.0)
        };
        assert_eq!([30.0, 40.0, 240.0].map(budget), [1_000_000, 1_000_000, 11_000_000]);
        let budgets: Vec<u64> = (40..400).map(|rest_ms| budget(f64::from(rest_ms))).collect();
        assert!(budgets.is_sorted());
    }

    #[test]
    fn a_device_that_becomes_slower_is_given_less() {
        let mut rate = ShadeRate::default();
        rate.note(&timings(&[("shading", 1.0)]), 1_000_000);
        let budgets: Vec<u64> = (0..30)
            .map(|_| {
                rate.note(&timings(&[("shading", 4.0)]), 1_000_000);
                rate.budget_texels(Some(1.0), 33.0)
            })
            .collect();
        assert!(budgets.is_sorted_by(|a, b| a > b) && budgets[29].abs_diff(250_000) < 5_000, "{budgets:?}");
    }
}

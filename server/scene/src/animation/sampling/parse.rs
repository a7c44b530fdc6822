//! Sampling on a command line: `constant:100ms`, `error-bounded:0.1mm,0.2%`.

use super::{DEFAULT_BOUND_M, DEFAULT_INTERVAL_S, DEFAULT_RANGE_SHARE, Sampling};
use crate::suggest::did_you_mean;
use std::fmt;
use std::ops::RangeInclusive;
use std::str::FromStr;

const INTERVALS_S: RangeInclusive<f64> = 0.5e-3..=10.0;
const BOUNDS_M: RangeInclusive<f64> = 1e-7..=10.0;
const SHARES: RangeInclusive<f64> = 1e-6..=1.0;

/// What is wrong with the text of a sampling, and what to write instead.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("sampling '{text}': {problem}")]
pub struct SamplingError {
    /// What was written.
    pub text: String,
    /// What is wrong with it.
    pub problem: String,
}

impl FromStr for Sampling {
    type Err = SamplingError;

    /// `constant` (each 100 ms), `constant:33.3ms`, `error-bounded` (0.1 mm and 0.2 % of each curve's range),
    /// `error-bounded:1mm`, `error-bounded:1mm,0.5%`; a share of 100 % leaves curves to the bound of the vertices.
    fn from_str(text: &str) -> Result<Self, SamplingError> {
        let (name, value) = text.split_once(':').map_or((text, None), |(name, value)| (name, Some(value)));
        let parsed = match name {
            "constant" => interval(value).map(|interval_s| Self::Constant { interval_s }),
            "error-bounded" => {
                bounds(value).map(|(bound_m, range_share)| Self::ErrorBounded { bound_m, range_share })
            }
            _ => Err(unknown(name)),
        };
        parsed.map_err(|problem| SamplingError { text: text.to_owned(), problem })
    }
}

fn unknown(name: &str) -> String {
    let hint = did_you_mean(name, ["constant", "error-bounded"]);
    format!("is neither constant:100ms nor error-bounded:0.1mm{hint}")
}

fn interval(value: Option<&str>) -> Result<f32, String> {
    let Some(value) = value else { return Ok(DEFAULT_INTERVAL_S) };
    quantity(value, &[("ms", 1e-3), ("s", 1.0)], INTERVALS_S)
        .ok_or_else(|| format!("'{value}' is not an interval from 0.5ms to 10s, such as 33.3ms"))
}

fn bounds(value: Option<&str>) -> Result<(f32, f32), String> {
    let Some(value) = value else { return Ok((DEFAULT_BOUND_M, DEFAULT_RANGE_SHARE)) };
    let (bound, share) = value.split_once(',').map_or((value, None), |(bound, share)| (bound, Some(share)));
    let bound_m = quantity(bound, &[("mm", 1e-3), ("cm", 1e-2), ("m", 1.0)], BOUNDS_M)
        .ok_or_else(|| format!("'{bound}' is not a distance from 0.0001mm to 10m, such as 0.1mm"))?;
    let Some(share) = share else { return Ok((bound_m, DEFAULT_RANGE_SHARE)) };
    let range_share = quantity(share, &[("%", 1e-2)], SHARES)
        .ok_or_else(|| format!("'{share}' is not a share of range from 0.0001% to 100%, such as 0.2%"))?;
    Ok((bound_m, range_share))
}

/// A number with the first of the units that it ends in.
fn quantity(text: &str, units: &[(&str, f64)], allowed: RangeInclusive<f64>) -> Option<f32> {
    let with_unit = |(unit, factor): &(&str, f64)| Some((text.trim().strip_suffix(unit)?, *factor));
    let (number, factor) = units.iter().find_map(with_unit)?;
    let value = number.trim().parse::<f64>().ok()? * factor;
    allowed.contains(&value).then_some(value as f32)
}

impl fmt::Display for Sampling {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Constant { interval_s } => write!(out, "constant:{}ms", short(interval_s, 1e3)),
            Self::ErrorBounded { bound_m, range_share } => {
                write!(out, "error-bounded:{}mm,{}%", short(bound_m, 1e3), short(range_share, 1e2))
            }
        }
    }
}

/// A number times a factor, with as many digits as a single has.
fn short(value: f32, factor: f64) -> f64 {
    let scaled = f64::from(value) * factor;
    let digits = 10f64.powi(6 - scaled.abs().max(1e-12).log10().floor() as i32);
    (scaled * digits).round() / digits
}

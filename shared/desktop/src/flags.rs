//! Numbers of a command line: each has a range, and a number outside it is refused with the range and the flag's name.

use std::fmt::Display;
use std::ops::RangeInclusive;
use std::str::FromStr;

/// The longest that anything lasts, seconds: a year.
pub const MOST_S: f64 = 31_536_000.0;

/// A reader of finite numbers within a range, for a parser of arguments, which puts the flag before what this says.
pub fn number<T>(
    range: RangeInclusive<T>,
    unit: &'static str,
) -> impl Fn(&str) -> Result<T, String> + Clone + Send + Sync + 'static
where
    T: FromStr + PartialOrd + Display + Clone + Send + Sync + 'static,
{
    move |text| {
        // No range holds what is not a number.
        let parsed = text.parse().ok().filter(|number| range.contains(number));
        parsed.ok_or_else(|| format!("must be a number from {} to {} {unit}", range.start(), range.end()))
    }
}

/// A reader of the sides of a picture.
///
/// # Errors
/// What is none, or has a side that is out of its range.
pub fn size(text: &str) -> Result<[u32; 2], String> {
    let parsed = text.split_once('x').and_then(|(w, h)| Some([w.parse().ok()?, h.parse().ok()?]));
    parsed
        .filter(|size: &[u32; 2]| size.iter().all(|side| (16..=8192).contains(side)))
        .ok_or_else(|| format!("\"{text}\" is not WxH with sides from 16 to 8192, such as 512x512"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_numbers_of_the_range_are_taken() {
        let seconds = number(0.0..=10.0, "seconds");
        assert_eq!([seconds("0"), seconds("2.5"), seconds("1e1")], [Ok(0.0), Ok(2.5), Ok(10.0)]);
        for text in ["nan", "inf", "-inf", "-0.1", "10.1", "1e400", "", "two", "1,5"] {
            assert_eq!(seconds(text), Err("must be a number from 0 to 10 seconds".into()), "{text}");
        }
    }
}

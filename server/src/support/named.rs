//! Values that people choose by name.

use shadecast_protocol::text::printable;
use shadecast_scene::suggest::did_you_mean_or_list;

/// A name that no value has.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{what} cannot be \"{name}\"{hint}")]
pub struct UnknownName {
    what: &'static str,
    name: String,
    hint: String,
}

/// The one of `all` with this name.
///
/// # Errors
/// There is none: with the nearest name, or all of them.
pub(crate) fn named<T: Copy>(
    what: &'static str,
    text: &str,
    all: &[T],
    name: fn(T) -> &'static str,
) -> Result<T, UnknownName> {
    let found = all.iter().copied().find(|value| name(*value) == text);
    found.ok_or_else(|| {
        let hint = did_you_mean_or_list(text, all.iter().map(|value| name(*value)), "there are");
        UnknownName { what, name: printable(text), hint }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn colour(number: u8) -> &'static str {
        if number == 0 { "red" } else { "green" }
    }

    #[test]
    fn a_name_finds_its_value() {
        assert_eq!(named("colour", "green", &[0, 1], colour), Ok(1));
    }

    #[test]
    fn a_mistyped_name_is_told_the_nearest_and_a_strange_one_all() {
        let message = |text| named("colour", text, &[0, 1], colour).expect_err("no colour").to_string();
        assert_eq!(message("gren"), "colour cannot be \"gren\"; did you mean \"green\"?");
        assert_eq!(message("violet"), "colour cannot be \"violet\"; there are \"red\", \"green\"");
    }
}

//! The user's folders: `$XDG_CONFIG_HOME` or `~/.config`, `$XDG_CACHE_HOME` or `~/.cache`; on Windows `%APPDATA%` and
//! `%LOCALAPPDATA%`. Relative paths are ignored, as the XDG specification requires.

use std::ffi::OsString;
use std::path::PathBuf;

/// Of the configuration, by these variables of the environment; `None` where they name none.
pub fn configuration(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    first(variable, CONFIGURATION)
}

/// The same of what can be made again.
pub fn cache(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    first(variable, CACHE)
}

/// What names the folder of the configuration, for who reads that nothing does.
pub const CONFIGURATION_VARIABLES: &str = if cfg!(windows) { "APPDATA" } else { "XDG_CONFIG_HOME or HOME" };

/// A variable, and a folder below what it names.
type Place = (&'static str, Option<&'static str>);

const CONFIGURATION: &[Place] = if cfg!(windows) {
    &[("APPDATA", None)]
} else {
    &[("XDG_CONFIG_HOME", None), ("HOME", Some(".config"))]
};
const CACHE: &[Place] = if cfg!(windows) {
    &[("LOCALAPPDATA", None)]
} else {
    &[("XDG_CACHE_HOME", None), ("HOME", Some(".cache"))]
};

fn first(variable: impl Fn(&str) -> Option<OsString>, places: &[Place]) -> Option<PathBuf> {
    places.iter().find_map(|(name, below)| {
        let base = variable(name).map(PathBuf::from).filter(|path| path.is_absolute())?;
        Some(below.map_or(base.clone(), |below| base.join(below)).join("shadecast"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const BASE: &str = if cfg!(windows) { r"C:\base" } else { "/base" };

    fn with(places: &[Place], values: &[&str]) -> Option<PathBuf> {
        let of = |name: &str| places.iter().position(|(known, _)| *known == name);
        let value = |name: &str| of(name).and_then(|at| values.get(at)).filter(|value| !value.is_empty());
        first(|name| value(name).map(OsString::from), places)
    }

    #[test]
    fn the_first_variable_that_names_an_absolute_folder_counts() {
        for places in [CONFIGURATION, CACHE] {
            assert_eq!(with(places, &[BASE, "/other"]), Some(PathBuf::from(BASE).join("shadecast")));
            assert_eq!(with(places, &[]), None);
            assert_eq!(with(places, &["relative"]), None, "a relative path is ignored");
            if let [_, (_, Some(below))] = places {
                let expected = PathBuf::from(BASE).join(below).join("shadecast");
                assert_eq!(with(places, &["", BASE]), Some(expected.clone()));
                assert_eq!(with(places, &["relative", BASE]), Some(expected));
            }
        }
    }
}

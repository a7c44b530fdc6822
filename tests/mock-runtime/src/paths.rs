//! Semantic paths: strings that OpenXR trades for numbers.

use std::ffi::c_char;

use openxr_sys as xr;

use crate::fault::{CallResult, Fault};
use crate::ffi::{self, entry};
use crate::runtime;

/// Longest path, its final zero included (XR_MAX_PATH_LENGTH).
const MAX_PATH_LENGTH: usize = 256;

/// Most paths of one instance; a bound on what an application can make the runtime keep.
const MAX_PATHS: usize = 1 << 16;

/// The paths of one instance. Path `n` is entry `n - 1`.
#[derive(Default)]
pub(crate) struct Paths {
    strings: Vec<String>,
}

impl Paths {
    pub(crate) fn intern(&mut self, text: &str) -> CallResult<xr::Path> {
        check(text)?;
        let index = match self.strings.iter().position(|known| known == text) {
            Some(index) => index,
            None if self.strings.len() < MAX_PATHS => {
                self.strings.push(text.to_owned());
                self.strings.len() - 1
            }
            None => {
                return Err(Fault::application(xr::Result::ERROR_PATH_COUNT_EXCEEDED, "65536 paths exist"));
            }
        };
        Ok(xr::Path::from_raw(index as u64 + 1))
    }

    pub(crate) fn text(&self, path: xr::Path) -> CallResult<&str> {
        let index = usize::try_from(path.into_raw()).ok().and_then(|number| number.checked_sub(1));
        index.and_then(|index| self.strings.get(index)).map(String::as_str).ok_or_else(|| {
            let message = format!("path {} was not made by xrStringToPath", path.into_raw());
            Fault::application(xr::Result::ERROR_PATH_INVALID, message)
        })
    }
}

fn check(text: &str) -> CallResult<()> {
    let refused = |why: &str| {
        Err(Fault::application(xr::Result::ERROR_PATH_FORMAT_INVALID, format!("path {text:?} {why}")))
    };
    let Some(rest) = text.strip_prefix('/') else { return refused("does not begin with a slash") };
    if text.len() >= MAX_PATH_LENGTH {
        return refused("has more than 255 characters");
    }
    for part in rest.split('/') {
        if part.is_empty() || part.bytes().all(|byte| byte == b'.') {
            return refused("has an empty part, or one of dots only");
        }
        if !part.bytes().all(is_path_byte) {
            return refused("has characters other than a-z, 0-9, '-', '_', '.'");
        }
    }
    Ok(())
}

/// The characters of a path's parts, and of the names of actions.
pub(crate) fn is_path_byte(byte: u8) -> bool {
    matches!(byte, b'a'..=b'z' | b'0'..=b'9' | b'-' | b'_' | b'.')
}

entry! {
    string_to_path: StringToPath = "xrStringToPath"(
        instance: value xr::Instance,
        path_string: text c_char,
        path: slot xr::Path,
    ) {
        *path = runtime::lock().core(instance)?.paths.intern(path_string)?;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    path_to_string: PathToString = "xrPathToString"(
        instance: value xr::Instance,
        path: value xr::Path,
        capacity: value u32,
        count: raw_out u32,
        buffer: raw_out c_char,
    ) {
        let mut runtime = runtime::lock();
        let text = runtime.core(instance)?.paths.text(path)?;
        // SAFETY: count and buffer are the caller's, of the capacity it says.
        unsafe { ffi::enumerate_text((capacity, count, buffer), text) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_keeps_its_number_and_its_text() {
        let mut paths = Paths::default();
        let left = paths.intern("/user/hand/left").expect("valid");
        let right = paths.intern("/user/hand/right").expect("valid");
        assert_ne!(left, right);
        assert_eq!(paths.intern("/user/hand/left").expect("valid"), left);
        assert_eq!(paths.text(right).expect("known"), "/user/hand/right");
        assert!(paths.text(xr::Path::NULL).is_err() && paths.text(xr::Path::from_raw(9)).is_err());
    }

    #[test]
    fn malformed_paths_are_refused() {
        for text in ["", "/", "user", "/user/", "//user", "/User", "/user/..", "/a b"] {
            let fault = Paths::default().intern(text).expect_err(text);
            assert_eq!(fault.code, xr::Result::ERROR_PATH_FORMAT_INVALID, "{text}");
        }
    }
}

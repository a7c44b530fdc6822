//! Names of result codes and structure types, for `xrResultToString` and messages.

use openxr_sys as xr;

/// `XR_SUCCESS`, `XR_ERROR_...`; for unknown codes what the specification demands.
pub(crate) fn result(code: xr::Result) -> String {
    let raw = code.into_raw();
    match format!("{code:?}") {
        name if name.starts_with(|c: char| c.is_ascii_alphabetic()) => format!("XR_{name}"),
        _ if raw < 0 => format!("XR_UNKNOWN_FAILURE_{raw}"),
        _ => format!("XR_UNKNOWN_SUCCESS_{raw}"),
    }
}

/// `XR_TYPE_...`; for unknown types what the specification demands.
pub(crate) fn structure(ty: xr::StructureType) -> String {
    match format!("{ty:?}") {
        name if name.starts_with(|c: char| c.is_ascii_alphabetic()) => format!("XR_TYPE_{name}"),
        _ => format!("XR_UNKNOWN_STRUCTURE_TYPE_{}", ty.into_raw()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_and_unknown_codes_have_the_names_of_the_specification() {
        assert_eq!(result(xr::Result::SUCCESS), "XR_SUCCESS");
        assert_eq!(result(xr::Result::ERROR_CALL_ORDER_INVALID), "XR_ERROR_CALL_ORDER_INVALID");
        assert_eq!(result(xr::Result::from_raw(-424_242)), "XR_UNKNOWN_FAILURE_-424242");
        assert_eq!(structure(xr::StructureType::FRAME_STATE), "XR_TYPE_FRAME_STATE");
    }
}

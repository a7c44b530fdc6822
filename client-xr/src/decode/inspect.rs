//! Checks before a decoder. A library or a driver accepts any bytes, and may allocate by them.

use super::DecodeError;
use super::sps::{self, Sps};
use shadecast_protocol::limits::{MAX_ACCESS_UNIT_BYTES, MAX_PICTURE_EXTENT_TEXELS, MIN_PICTURE_SIDE_TEXELS};

/// Refuses pictures that no decoder takes.
pub(super) fn check_picture_extent(extent_texels: [u32; 2]) -> Result<(), DecodeError> {
    let fits = extent_texels
        .into_iter()
        .zip(MAX_PICTURE_EXTENT_TEXELS)
        .all(|(texels, most)| (MIN_PICTURE_SIDE_TEXELS..=most).contains(&texels) && texels % 2 == 0);
    if fits { Ok(()) } else { Err(DecodeError::Extent(extent_texels)) }
}

/// Refuses what must not reach a decoder; otherwise tells whether the unit can be decoded on its own.
pub(super) fn inspect(access_unit: &[u8], extent_texels: [u32; 2]) -> Result<bool, DecodeError> {
    if access_unit.len() > MAX_ACCESS_UNIT_BYTES {
        return Err(DecodeError::TooLong { got: access_unit.len() });
    }
    let mut is_refresh = false;
    for unit in sps::nal_units(access_unit) {
        match sps::nal_type(unit) {
            sps::NAL_SPS => check_extent(&Sps::parse(unit)?, extent_texels)?,
            sps::NAL_REFRESH_SLICE => is_refresh = true,
            sps::NAL_SLICE | sps::NAL_SEI | sps::NAL_PPS | sps::NAL_DELIMITER | sps::NAL_FILLER => {}
            other => return Err(DecodeError::UnexpectedUnit { nal_type: other }),
        }
    }
    Ok(is_refresh)
}

fn check_extent(sps: &Sps, want: [u32; 2]) -> Result<(), DecodeError> {
    let got = sps.extent_texels;
    if got == want { Ok(()) } else { Err(DecodeError::ExtentMismatch { want, got }) }
}

//! NAL units of H.264 byte streams with start codes (ITU-T H.264 annex B).

/// Types of units, the lowest five bits of their first byte: slices of two kinds, and parameter sets.
pub(crate) const SLICE: u8 = 1;
pub(crate) const REFRESH_SLICE: u8 = 5;
pub(crate) const SEQUENCE_PARAMETERS: u8 = 7;
pub(crate) const PICTURE_PARAMETERS: u8 = 8;

/// The units of a byte stream, without start codes; none is empty.
pub(crate) fn units(stream: &[u8]) -> impl Iterator<Item = &[u8]> {
    let next = |from: usize| {
        let found = stream.get(from..)?.windows(3).position(|three| three == [0, 0, 1])?;
        Some(from + found)
    };
    let mut start = next(0);
    let all = std::iter::from_fn(move || {
        let from = start? + 3;
        start = next(from);
        let unit = &stream[from..start.unwrap_or(stream.len())];
        // What follows the last byte of a unit, which is never zero, belongs to the next start code.
        let zeros = unit.iter().rev().take_while(|byte| **byte == 0).count();
        Some(&unit[..unit.len() - zeros])
    });
    all.filter(|unit| !unit.is_empty())
}

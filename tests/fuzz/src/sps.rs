//! Access units: whatever they hold, they fall into NAL units, and a sequence header is read or refused.

use shadecast_client::decode::sps::{NAL_SPS, Sps, nal_type, nal_units};

/// A bound on what any header can say, by the widths of its fields.
const LARGEST_SIDE_TEXELS: u32 = 1 << 21;

/// The number of sequence headers that could be read.
pub fn check(data: &[u8]) -> usize {
    let mut read = 0;
    let mut bytes = 0;
    for unit in nal_units(data) {
        assert!(!unit.is_empty());
        bytes += unit.len() + 3;
        if nal_type(unit) != NAL_SPS {
            continue;
        }
        let parsed = Sps::parse(unit);
        assert_eq!(parsed, Sps::parse(unit));
        if let Ok(sps) = parsed {
            assert!(sps.extent_texels.iter().all(|side| *side <= LARGEST_SIDE_TEXELS), "{sps:?}");
            read += 1;
        }
    }
    assert!(bytes <= data.len(), "units overlap");
    // A header by itself, without a start code before it.
    read + usize::from(Sps::parse(data).is_ok())
}

//! The decoder on the CPU with coded and damaged access units: each gives a picture of the agreed extent or a typed error. Its
//! library is C++.

use crate::script::steps;
use shadecast_client::decode::openh264::OpenH264Decoder;
use shadecast_client::decode::sps::{NAL_SPS, Sps, nal_type, nal_units};
use shadecast_client::decode::{Decoder, Picture};
use std::time::Duration;

/// An access unit.
pub const UNIT: u8 = 0;
/// A unit is lost.
pub const LOST: u8 = 1;

/// Longest side of pictures that are decoded: larger ones only cost time.
const LARGEST_SIDE_TEXELS: u32 = 512;
/// Units of a script that are decoded.
const MAX_UNITS: usize = 32;

/// The number of pictures that were decoded.
pub fn check(script: &[u8]) -> usize {
    let Some(extent_texels) = extent_of(script) else { return 0 };
    let Ok(mut decoder) = OpenH264Decoder::new(extent_texels) else { return 0 };
    let mut decoded = 0;
    for step in steps(script).take(MAX_UNITS) {
        if step.operation == LOST {
            decoder.unit_lost();
            continue;
        }
        // An allocation of its own: the sanitizer sees a read past its end.
        decoder.submit(&Box::<[u8]>::from(step.bytes));
        match decoder.poll(Duration::ZERO).expect("it decodes while a unit is submitted") {
            Ok(Picture::Planes(planes)) => {
                assert_eq!(planes.extent_texels(), extent_texels);
                assert!(!decoder.needs_refresh());
                decoded += 1;
                decoder.recycle(Picture::Planes(planes));
            }
            Ok(other) => panic!("{other:?} is no picture of a CPU"),
            Err(_) => assert!(decoder.needs_refresh()),
        }
    }
    decoded
}

/// That of the first sequence header, which client and server agree on before.
fn extent_of(script: &[u8]) -> Option<[u32; 2]> {
    let mut units = steps(script).flat_map(|step| nal_units(step.bytes));
    let sps = Sps::parse(units.find(|unit| nal_type(unit) == NAL_SPS)?).ok()?;
    sps.extent_texels.iter().all(|side| *side <= LARGEST_SIDE_TEXELS).then_some(sps.extent_texels)
}

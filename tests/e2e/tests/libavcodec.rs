//! The client's decoder reads the server's libx264 streams. Only with the feature `libavcodec`.
#![cfg(feature = "libavcodec")]

use shadecast_client::decode::openh264::OpenH264Decoder;
use shadecast_client::decode::sps::{Colour, NAL_SPS, Sps, nal_type, nal_units};
use shadecast_client::decode::{Decoder, Picture};
use shadecast_protocol::picture::I420;
use shadecast_server::encode::choice::{Encoders, Wanted};
use shadecast_server::encode::libavcodec::{LIBX264, LibavEncoder};
use shadecast_server::encode::openh264::EncoderSettings;
use shadecast_server::encode::{AccessUnit, EncodeError, Encoder, Source, encode_one};
use std::time::Duration;

const EXTENT: [u32; 2] = [256, 128];
const UPDATE_NS: i64 = 33_333_333;

fn settings(qp: u8) -> EncoderSettings {
    EncoderSettings { qp, threads: 4, ..EncoderSettings::new(EXTENT) }
}

#[track_caller]
fn x264(qp: u8) -> LibavEncoder {
    LibavEncoder::new(LIBX264, settings(qp)).expect("libx264; `./shadecast setup` installs it")
}

/// Blocks of 16x16 texels, smooth and rough by turns; every third row of them is another one with each number.
fn picture(number: u32) -> I420 {
    let mut picture =
        I420::new(EXTENT, vec![128; I420::byte_count(EXTENT) as usize]).expect("its own extent");
    let [luma, cb, _] = picture.planes_mut();
    for (at, value) in (0u32..).zip(luma.iter_mut()) {
        let (x, y) = (at % EXTENT[0], at / EXTENT[0]);
        let block =
            (x / 16).wrapping_mul(31) ^ (y / 16).wrapping_mul(17) ^ if y / 16 % 3 == 0 { number } else { 0 };
        let grain = if block % 2 == 0 { at.wrapping_mul(2_654_435_761) >> 29 } else { 0 };
        *value = (40 + block % 97 + (x % 16) * 3 + grain) as u8;
    }
    cb.iter_mut().enumerate().for_each(|(at, value)| *value = 64 + (at / 8 % 8 * 16) as u8);
    picture
}

fn encode(encoder: &mut dyn Encoder, number: u32, refresh: bool) -> AccessUnit {
    let source = Source::Planes(picture(number));
    encode_one(encoder, source, i64::from(number) * UPDATE_NS, refresh).expect("it is coded")
}

#[track_caller]
fn decode(decoder: &mut OpenH264Decoder, unit: &AccessUnit) -> I420 {
    decoder.submit(&unit.bytes);
    match decoder.poll(Duration::from_secs(5)).expect("at once") {
        Ok(Picture::Planes(picture)) => picture,
        other => panic!("{other:?}"),
    }
}

fn decoder() -> OpenH264Decoder {
    OpenH264Decoder::new(EXTENT).expect("a decoder")
}

fn psnr_db(a: &I420, b: &I420) -> f64 {
    let squares: f64 =
        a.bytes().iter().zip(b.bytes()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    10.0 * (255.0 * 255.0 * a.bytes().len() as f64 / squares.max(1e-9)).log10()
}

#[test]
fn only_the_first_picture_is_a_refresh() {
    let (mut encoder, mut decoder) = (x264(20), decoder());
    for number in 0..12 {
        let unit = encode(&mut encoder, number, false);
        assert_eq!(unit.is_refresh, number == 0);
        let psnr = psnr_db(&decode(&mut decoder, &unit), &picture(number));
        assert!(psnr > 38.0, "picture {number}: {psnr:.1} dB");
    }
}

#[test]
fn a_refresh_comes_with_its_picture_and_needs_no_earlier_one() {
    let mut encoder = x264(22);
    let units: Vec<AccessUnit> = (0..9).map(|number| encode(&mut encoder, number, number == 5)).collect();
    let refreshes: Vec<bool> = units.iter().map(|unit| unit.is_refresh).collect();
    assert_eq!(refreshes, [0, 1, 2, 3, 4, 5, 6, 7, 8].map(|number| number == 0 || number == 5));
    let mut late = decoder();
    for (number, unit) in (5..).zip(&units[5..]) {
        assert!(psnr_db(&decode(&mut late, unit), &picture(number)) > 36.0);
    }
}

#[test]
fn a_new_quantiser_applies_to_the_next_picture() {
    let (mut encoder, mut decoder) = (x264(40), decoder());
    let mut see = |encoder: &mut LibavEncoder, number| {
        let unit = encode(encoder, number, false);
        (psnr_db(&decode(&mut decoder, &unit), &picture(number)), unit.is_refresh)
    };
    let (coarse, _) = see(&mut encoder, 0);
    encoder.set_qp(14).expect("a quantiser");
    let (fine, is_refresh) = see(&mut encoder, 1);
    assert!(!is_refresh && fine > coarse + 6.0, "{coarse:.1} dB at 40, {fine:.1} dB at 14");
    assert!(matches!(encoder.set_qp(52), Err(EncodeError::Setting { .. })));
}

#[test]
fn what_does_not_change_costs_nothing_and_stays_as_it_is() {
    let (mut encoder, mut decoder) = (x264(24), decoder());
    let first = encode(&mut encoder, 0, false);
    let shown = decode(&mut decoder, &first);
    for _ in 0..4 {
        let unit = encode(&mut encoder, 0, false);
        assert!(unit.bytes.len() < 200, "{} bytes", unit.bytes.len());
        assert_eq!(decode(&mut decoder, &unit), shown);
    }
}

#[test]
fn the_stream_says_its_extent_and_colours() {
    let unit = encode(&mut x264(22), 0, true);
    let header = nal_units(&unit.bytes).find(|unit| nal_type(unit) == NAL_SPS).expect("in every refresh");
    let sps = Sps::parse(header).expect("a sequence header");
    let bt709 = Colour { full_range: true, primaries: 1, transfer: 1, matrix: 1 };
    assert_eq!((sps.extent_texels, sps.colour), (EXTENT, Some(bt709)));
    assert_eq!(
        (sps.max_num_ref_frames, sps.max_num_reorder_frames),
        (1, Some(0)),
        "decoders answer without delay"
    );
}

#[test]
fn the_same_pictures_give_the_same_bytes() {
    let all = || {
        let mut encoder = x264(22);
        (0..6).map(|number| encode(&mut encoder, number, number == 3)).collect::<Vec<_>>()
    };
    assert_eq!(all(), all());
}

#[test]
fn a_picture_of_another_extent_is_refused_and_the_next_is_coded() {
    let mut encoder = x264(22);
    let small = I420::new([64, 64], vec![0; 64 * 96]).expect("its own extent");
    let refused = encode_one(&mut encoder, Source::Planes(small), 0, false);
    assert!(matches!(refused, Err(EncodeError::ExtentChanged { .. })));
    assert!(encode(&mut encoder, 1, false).is_refresh);
}

#[test]
fn libx264_is_found_by_trial_and_by_its_name() {
    let named =
        |name: &str| Encoders::choose(&name.parse::<Wanted>().expect("any text")).map(|all| all.name());
    assert_eq!(named("libx264"), Ok("libx264"));
    assert_eq!(named("openh264"), Ok("openh264"));
    assert!(named("libx265").is_err());
}

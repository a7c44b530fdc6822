//! The video seams against each other: the client's decoder reads the output of the server's encoder.

use shadecast_client::decode::openh264::OpenH264Decoder;
use shadecast_client::decode::raw::RawDecoder;
use shadecast_client::decode::sps::{self, Colour, Sps, SpsError};
use shadecast_client::decode::{DecodeError, Decoder, Picture};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::Codec;
use shadecast_protocol::picture::I420;
use shadecast_server::encode::openh264::{EncoderSettings, OpenH264Encoder};
use shadecast_server::encode::{self, AccessUnit, EncodeError, Encoder, Source};
use shadecast_server::pacing::quality::DEFAULT_QP;
use std::time::Duration;

const SEED: u64 = 0x5ade_ca57;
const UPDATE_NS: i64 = 33_333_333;

/// A small, fixed generator (SplitMix64), so that pictures and damage are the same in every run.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }
}

fn flat_picture(extent_texels: [u32; 2], luma: u8) -> I420 {
    let mut picture = I420::new(extent_texels, vec![128; I420::byte_count(extent_texels) as usize])
        .expect("the sides are even");
    picture.planes_mut()[0].fill(luma);
    picture
}

fn luma(picture: &I420) -> &[u8] {
    picture.planes()[0]
}

/// Like an atlas: 16x16 blocks that have nothing to do with each other, each a gradient with some grain.
fn atlas_picture([width, height]: [u32; 2], random: &mut Random) -> I420 {
    let mut picture = flat_picture([width, height], 0);
    for block_y in 0..height.div_ceil(16) {
        for block_x in 0..width.div_ceil(16) {
            paint_block(&mut picture, [block_x * 16, block_y * 16], random);
        }
    }
    picture
}

fn paint_block(picture: &mut I420, [left, top]: [u32; 2], random: &mut Random) {
    let [width, height] = picture.extent_texels();
    let [luma_plane, cb_plane, cr_plane] = picture.planes_mut();
    let (base, slope_x, slope_y) = (40 + random.below(120), random.below(5), random.below(5));
    let (cb, cr) = (64 + random.below(128) as u8, 64 + random.below(128) as u8);
    for y in top..(top + 16).min(height) {
        for x in left..(left + 16).min(width) {
            let luma = base + slope_x * (x - left) as usize + slope_y * (y - top) as usize + random.below(8);
            luma_plane[(y * width + x) as usize] = luma.min(255) as u8;
            let chroma = (y / 2 * (width / 2) + x / 2) as usize;
            (cb_plane[chroma], cr_plane[chroma]) = (cb, cr);
        }
    }
}

/// BT.709 full range, as ITU-T H.273 gives it: Kr = 0.2126, Kb = 0.0722.
fn ycbcr_from_rgb(rgb: [f64; 3]) -> [f64; 3] {
    let [r, g, b] = rgb;
    let y = 0.2126 * r + 0.7152 * g + 0.0722 * b;
    [y, 128.0 + (b - y) / 1.8556, 128.0 + (r - y) / 1.5748]
}

fn rgb_from_ycbcr([y, cb, cr]: [f64; 3]) -> [f64; 3] {
    let (cb, cr) = (cb - 128.0, cr - 128.0);
    let g = y - (0.0722 * 1.8556 * cb + 0.2126 * 1.5748 * cr) / 0.7152;
    [y + 1.5748 * cr, g, y + 1.8556 * cb].map(|c| c.clamp(0.0, 255.0))
}

/// White, yellow, cyan, green, magenta, red, blue, black, at 100 %.
const BARS: [[f64; 3]; 8] = [
    [255.0, 255.0, 255.0],
    [255.0, 255.0, 0.0],
    [0.0, 255.0, 255.0],
    [0.0, 255.0, 0.0],
    [255.0, 0.0, 255.0],
    [255.0, 0.0, 0.0],
    [0.0, 0.0, 255.0],
    [0.0, 0.0, 0.0],
];

const BAR_WIDTH: usize = 32;

fn colour_bars() -> I420 {
    let mut picture = flat_picture([8 * BAR_WIDTH as u32, 64], 0);
    let width = 8 * BAR_WIDTH;
    let [luma, cb_plane, cr_plane] = picture.planes_mut();
    for (at, y) in luma.iter_mut().enumerate() {
        *y = ycbcr_from_rgb(BARS[at % width / BAR_WIDTH])[0].round() as u8;
    }
    for at in 0..cb_plane.len() {
        let [_, cb, cr] = ycbcr_from_rgb(BARS[at % (width / 2) * 2 / BAR_WIDTH]);
        (cb_plane[at], cr_plane[at]) = (cb.round().min(255.0) as u8, cr.round().min(255.0) as u8);
    }
    picture
}

/// The largest difference of any channel inside the bars, at least `margin` texels from their edges.
fn worst_bar_error(picture: &I420, margin: usize) -> f64 {
    let width = 8 * BAR_WIDTH;
    let [luma, cb, cr] = picture.planes();
    let mut worst: f64 = 0.0;
    for (at, luma) in luma.iter().copied().enumerate() {
        let (x, y) = (at % width, at / width);
        if !(margin..BAR_WIDTH - margin).contains(&(x % BAR_WIDTH)) {
            continue;
        }
        let chroma = y / 2 * (width / 2) + x / 2;
        let sample = [luma, cb[chroma], cr[chroma]].map(f64::from);
        let rgb = rgb_from_ycbcr(sample).map(f64::round);
        let errors = rgb.into_iter().zip(BARS[x / BAR_WIDTH]).map(|(got, want)| (got - want).abs());
        worst = errors.fold(worst, f64::max);
    }
    worst
}

#[track_caller]
fn encoder(settings: EncoderSettings) -> OpenH264Encoder {
    OpenH264Encoder::new(settings).expect("the settings are valid")
}

#[track_caller]
fn decoder(extent_texels: [u32; 2]) -> OpenH264Decoder {
    OpenH264Decoder::new(extent_texels).expect("the extent is valid")
}

fn encode_one(
    encoder: &mut OpenH264Encoder,
    picture: &I420,
    timestamp_ns: i64,
    refresh: bool,
) -> Result<AccessUnit, EncodeError> {
    encode::encode_one(encoder, Source::Planes(picture.clone()), timestamp_ns, refresh)
}

/// Decodes a unit into `picture`, which an error leaves as it is.
fn decode_one(
    decoder: &mut OpenH264Decoder,
    access_unit: &[u8],
    picture: &mut I420,
) -> Result<(), DecodeError> {
    decoder.submit(access_unit);
    let Picture::Planes(decoded) = decoder.poll(Duration::ZERO).expect("done at once")? else {
        panic!("a decoder of H.264 halves chroma")
    };
    decoder.recycle(Picture::Planes(std::mem::replace(picture, decoded)));
    Ok(())
}

/// Encodes pictures at 30 Hz; a refresh is asked for where `refresh` says so.
#[track_caller]
fn encode_all(
    settings: EncoderSettings,
    pictures: &[I420],
    refresh: impl Fn(usize) -> bool,
) -> Vec<AccessUnit> {
    let mut encoder = encoder(settings);
    let encode = |(at, picture): (usize, &I420)| {
        let unit = encode_one(&mut encoder, picture, at as i64 * UPDATE_NS, refresh(at));
        unit.expect("a valid picture encodes")
    };
    pictures.iter().enumerate().map(encode).collect()
}

/// Every picture is the one before with a few blocks painted anew.
fn changing_pictures(extent_texels: [u32; 2], count: usize, seed: u64) -> Vec<I420> {
    let mut random = Random(seed);
    let mut picture = atlas_picture(extent_texels, &mut random);
    let change = |_| {
        let now = picture.clone();
        for _ in 0..4 {
            let corner = extent_texels.map(|texels| random.below(texels.div_ceil(16) as usize) as u32 * 16);
            paint_block(&mut picture, corner, &mut random);
        }
        now
    };
    (0..count).map(change).collect()
}

fn psnr_db(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len());
    let squares: f64 = a.iter().zip(b).map(|(&a, &b)| f64::from(a.abs_diff(b)).powi(2)).sum();
    10.0 * (255.0 * 255.0 * a.len() as f64 / squares.max(1e-9)).log10()
}

#[test]
fn colour_bars_survive_within_three_of_255() {
    let bars = colour_bars();
    // Rounding to bytes alone costs this much; coding may add the rest.
    let rounding = worst_bar_error(&bars, 0);
    for (qp, bound) in [(DEFAULT_QP, 3.0), (DEFAULT_QP + 4, f64::INFINITY), (DEFAULT_QP + 8, f64::INFINITY)] {
        let settings = EncoderSettings { qp, ..EncoderSettings::new(bars.extent_texels()) };
        let mut decoder = decoder(bars.extent_texels());
        let mut decoded = I420::default();
        // A refresh and the picture after it, which is coded in another way.
        for (at, unit) in encode_all(settings, &[bars.clone(), bars.clone()], |_| false).iter().enumerate() {
            decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("a clean stream decodes");
            let (worst, whole) = (worst_bar_error(&decoded, 8), worst_bar_error(&decoded, 0));
            println!("QP {qp} picture {at}: worst {worst} flat, {whole} anywhere, {rounding} before coding");
            assert!(worst <= bound, "QP {qp}, picture {at}: a flat area is off by {worst}");
        }
    }
}

#[test]
fn exchanged_chroma_planes_do_not_pass_as_colour_bars() {
    let mut bars = colour_bars();
    let [_, cb, cr] = bars.planes_mut();
    cb.swap_with_slice(cr);
    assert!(worst_bar_error(&bars, 8) > 100.0);
}

#[test]
fn atlas_content_decodes_close_to_what_was_encoded() {
    let pictures = changing_pictures([256, 192], 10, SEED);
    let mut decoder = decoder([256, 192]);
    let mut decoded = I420::default();
    for (unit, picture) in
        encode_all(EncoderSettings::new([256, 192]), &pictures, |_| false).iter().zip(&pictures)
    {
        decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("a clean stream decodes");
        let [luma_db, cb_db, cr_db] =
            [0, 1, 2].map(|plane| psnr_db(decoded.planes()[plane], picture.planes()[plane]));
        let chroma_db = cb_db.min(cr_db);
        println!("{} bytes, luma {luma_db:.1} dB, chroma {chroma_db:.1} dB", unit.bytes.len());
        assert!(luma_db > 38.0 && chroma_db > 38.0, "seed {SEED:#x}: {luma_db:.1} dB, {chroma_db:.1} dB");
    }
}

#[test]
fn unchanged_pictures_cost_almost_nothing() {
    let picture = atlas_picture([512, 512], &mut Random(SEED));
    let units = encode_all(EncoderSettings::new([512, 512]), &vec![picture; 5], |_| false);
    let bytes: Vec<_> = units.iter().map(|unit| unit.bytes.len()).collect();
    println!("512x512, unchanged: {bytes:?} bytes");
    // The first of them still improves what the refresh left coarse.
    assert!(bytes[1] * 50 < bytes[0], "{bytes:?}");
    assert!(bytes[2..].iter().all(|&bytes| bytes < 200), "{bytes:?}");
}

#[test]
fn an_unchanged_picture_refines_and_then_costs_nothing() {
    let extent = [512, 512];
    let picture = atlas_picture(extent, &mut Random(SEED));
    let (mut encoder, mut decoder) = (encoder(EncoderSettings::new(extent)), decoder(extent));
    let mut decoded = I420::default();
    let mut quality = |qp: u8, at: i64| {
        encoder.set_qp(qp).expect("in range");
        let unit = encode_one(&mut encoder, &picture, at * UPDATE_NS, false).expect("it is encoded");
        decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("a clean stream decodes");
        (psnr_db(luma(&decoded), luma(&picture)), unit.bytes.len())
    };
    let mut found = Vec::new();
    for at in 0..14 {
        let qp = DEFAULT_QP.saturating_sub(at as u8).max(14);
        found.push((qp, quality(qp, at)));
    }
    found.iter().for_each(|(qp, (db, bytes))| println!("QP {qp}: {db:.1} dB, {bytes} bytes"));
    let (first_db, last_db) = (found[0].1.0, found[13].1.0);
    assert!(last_db > first_db + 4.0, "{first_db} to {last_db} dB");
    assert!(found[11..].iter().all(|(_, (_, bytes))| *bytes < 400));
    // A coarser quantiser takes nothing back.
    let (coarse_db, bytes) = quality(30, 14);
    assert!(coarse_db > last_db - 0.1 && bytes < 1000, "{coarse_db} dB, {bytes} bytes");
}

#[test]
fn refreshes_come_when_asked_for_and_only_then() {
    let pictures = changing_pictures([128, 128], 100, SEED);
    let asked = |at: usize| at == 7 || at == 8 || at == 50;
    for (at, unit) in encode_all(EncoderSettings::new([128, 128]), &pictures, asked).iter().enumerate() {
        let has_slice = sps::nal_units(&unit.bytes).any(|nal| sps::nal_type(nal) == sps::NAL_REFRESH_SLICE);
        assert_eq!(
            (unit.is_refresh, has_slice),
            (at == 0 || asked(at), at == 0 || asked(at)),
            "picture {at}"
        );
    }
}

#[test]
fn a_whole_other_picture_is_no_reason_for_a_refresh() {
    let pictures: Vec<_> = (0..6).map(|at| atlas_picture([128, 128], &mut Random(SEED + at))).collect();
    let units = encode_all(EncoderSettings::new([128, 128]), &pictures, |_| false);
    assert_eq!(units.iter().filter(|unit| unit.is_refresh).count(), 1);
}

#[test]
fn the_same_pictures_give_the_same_bytes() {
    let pictures = changing_pictures([512, 256], 12, SEED);
    for threads in [1, 2, 4] {
        let settings = EncoderSettings { threads, ..EncoderSettings::new([512, 256]) };
        let runs = [(); 3].map(|()| encode_all(settings, &pictures, |at| at == 5));
        let bytes: usize = runs[0].iter().map(|unit| unit.bytes.len()).sum();
        println!("{threads} threads: {bytes} bytes");
        assert!(runs[0] == runs[1] && runs[0] == runs[2], "{threads} threads, seed {SEED:#x}");
    }
}

/// What a stream is encoded with does not depend on the machine that encodes it.
#[test]
fn streams_have_fixed_slices_and_their_own_rate() {
    let extent = AtlasExtent::new(512, 512).unwrap();
    let settings = EncoderSettings::for_stream(extent, 30, 72.0);
    assert_eq!(
        (settings.qp, settings.fps, settings.threads),
        (30, 60, 4),
        "no more than the stream can declare"
    );
    assert_eq!(EncoderSettings::for_stream(extent, 22, 0.2).fps, 1);
    let pictures = changing_pictures(extent.texels(), 12, SEED);
    let size = |settings| {
        encode_all(settings, &pictures, |_| false).iter().map(|unit| unit.bytes.len()).sum::<usize>()
    };
    let whole = size(EncoderSettings::new(extent.texels()));
    let sliced = size(EncoderSettings::for_stream(extent, DEFAULT_QP, 30.0));
    println!("whole {whole}, in slices {sliced} bytes");
    assert!(sliced as f64 <= whole as f64 * 1.05, "{whole} and {sliced} bytes");
}

#[test]
fn sliced_pictures_decode_as_well_as_whole_ones() {
    let pictures = changing_pictures([256, 256], 5, SEED);
    let settings = EncoderSettings { threads: 4, ..EncoderSettings::new([256, 256]) };
    let units = encode_all(settings, &pictures, |_| false);
    let slices = |unit: &AccessUnit| {
        sps::nal_units(&unit.bytes)
            .filter(|nal| matches!(sps::nal_type(nal), 1 | sps::NAL_REFRESH_SLICE))
            .count()
    };
    let mut decoder = decoder([256, 256]);
    let mut decoded = I420::default();
    for (unit, picture) in units.iter().zip(&pictures) {
        assert_eq!(slices(unit), 4);
        decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("a clean stream decodes");
        assert!(psnr_db(luma(&decoded), luma(picture)) > 38.0);
    }
}

#[test]
fn every_unit_gives_its_own_picture_at_once() {
    let lumas = [16, 250, 90, 91, 0, 128, 255, 60, 200, 30];
    let pictures = lumas.map(|luma| flat_picture([64, 64], luma));
    let mut decoder = decoder([64, 64]);
    let mut decoded = I420::default();
    for (unit, luma) in encode_all(EncoderSettings::new([64, 64]), &pictures, |at| at == 6).iter().zip(lumas)
    {
        decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("a clean stream decodes");
        let got = decoded.planes()[0];
        assert!(got.iter().all(|got| got.abs_diff(luma) <= 3), "wanted {luma}, got {}", got[0]);
    }
}

#[test]
fn extents_that_macroblocks_do_not_divide_come_back_whole() {
    for extent in [[16, 16], [18, 16], [100, 52], [66, 130], [1000, 62]] {
        let pictures = changing_pictures(extent, 3, SEED);
        let mut decoder = decoder(extent);
        let mut decoded = I420::default();
        for (unit, picture) in
            encode_all(EncoderSettings::new(extent), &pictures, |_| false).iter().zip(&pictures)
        {
            decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("a clean stream decodes");
            assert_eq!(decoded.extent_texels(), extent);
            let db = psnr_db(luma(&decoded), luma(picture));
            assert!(db > 36.0, "{extent:?}: {db:.1} dB, seed {SEED:#x}");
        }
    }
}

#[test]
fn the_largest_atlas_goes_through() {
    for extent in [[4096, 2048], [4096, 2304]] {
        let picture = atlas_picture(extent, &mut Random(SEED));
        let units = encode_all(EncoderSettings::new(extent), &[picture.clone(), picture.clone()], |_| false);
        let mut decoder = decoder(extent);
        let mut decoded = I420::default();
        for unit in &units {
            decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("a clean stream decodes");
        }
        println!("{extent:?}: {:?} bytes", units.iter().map(|unit| unit.bytes.len()).collect::<Vec<_>>());
        assert!(psnr_db(luma(&decoded), luma(&picture)) > 38.0);
    }
}

fn stream_header(extent: [u32; 2], threads: u32) -> Vec<u8> {
    let settings = EncoderSettings { threads, ..EncoderSettings::new(extent) };
    let units = encode_all(settings, &[flat_picture(extent, 90)], |_| false);
    let header = sps::nal_units(&units[0].bytes).find(|nal| sps::nal_type(nal) == sps::NAL_SPS);
    header.expect("a refresh starts with a sequence header").to_vec()
}

#[test]
fn the_stream_declares_full_range_bt709_without_reordering() {
    for extent in [[100, 52], [2048, 2048], [4096, 2048]] {
        let sps = Sps::parse(&stream_header(extent, 1)).expect("our own header is readable");
        let bt709 = Colour { full_range: true, primaries: 1, transfer: 1, matrix: 1 };
        let want = Sps {
            profile_idc: 100,
            level_idc: 52,
            extent_texels: extent,
            max_num_ref_frames: 1,
            colour: Some(bt709),
            max_num_reorder_frames: Some(0),
        };
        assert_eq!(sps, want);
    }
}

#[test]
fn a_cut_header_is_an_error_wherever_it_is_cut() {
    let header = stream_header([100, 52], 1);
    for length in 0..header.len() - 1 {
        assert_eq!(
            Sps::parse(&header[..length]),
            Err(SpsError::CutShort),
            "{length} of {} bytes",
            header.len()
        );
    }
}

#[test]
fn a_broken_unit_is_an_error_until_the_next_refresh() {
    let pictures = changing_pictures([128, 128], 12, SEED);
    let units = encode_all(EncoderSettings::new([128, 128]), &pictures, |at| at == 8);
    let (mut clean, mut hurt) = (decoder([128, 128]), decoder([128, 128]));
    let (mut want, mut got) = (I420::default(), I420::default());
    for (at, unit) in units.iter().enumerate() {
        decode_one(&mut clean, &unit.bytes, &mut want).expect("a clean stream decodes");
        let before = got.clone();
        let cut = if at == 4 { unit.bytes.len() / 2 } else { unit.bytes.len() };
        let result = decode_one(&mut hurt, &unit.bytes[..cut], &mut got);
        match at {
            0..4 | 8.. => assert!(result.is_ok() && got == want, "picture {at}: {result:?}"),
            4 => assert!(matches!(result, Err(DecodeError::Corrupt { .. })) && got == before, "{result:?}"),
            _ => assert!(matches!(result, Err(DecodeError::NeedsRefresh)) && got == before, "{result:?}"),
        }
        assert_eq!(hurt.needs_refresh(), (4..8).contains(&at), "picture {at}");
    }
}

#[test]
fn after_a_lost_unit_only_a_refresh_is_decoded() {
    let pictures = changing_pictures([128, 128], 8, SEED);
    let units = encode_all(EncoderSettings::new([128, 128]), &pictures, |at| at == 5);
    let mut decoder = decoder([128, 128]);
    let mut decoded = I420::default();
    for (at, unit) in units.iter().enumerate() {
        if at == 3 {
            decoder.unit_lost();
            continue;
        }
        let result = decode_one(&mut decoder, &unit.bytes, &mut decoded);
        assert_eq!(result.is_ok(), at != 4, "picture {at}: {result:?}");
    }
}

#[test]
fn a_gap_that_nobody_reported_is_noticed() {
    let pictures = changing_pictures([128, 128], 5, SEED);
    let units = encode_all(EncoderSettings::new([128, 128]), &pictures, |_| false);
    let mut decoder = decoder([128, 128]);
    let mut decoded = I420::default();
    for at in [0, 1, 3] {
        let result = decode_one(&mut decoder, &units[at].bytes, &mut decoded);
        assert_eq!(result.is_ok(), at != 3, "picture {at}: {result:?}");
    }
    assert!(decoder.needs_refresh());
}

#[test]
fn a_stream_joined_in_the_middle_waits_for_a_refresh() {
    let pictures = changing_pictures([64, 64], 4, SEED);
    let units = encode_all(EncoderSettings::new([64, 64]), &pictures, |at| at == 3);
    let mut decoder = decoder([64, 64]);
    let mut decoded = I420::default();
    for unit in &units[1..3] {
        let result = decode_one(&mut decoder, &unit.bytes, &mut decoded);
        assert!(matches!(result, Err(DecodeError::NeedsRefresh)), "{result:?}");
    }
    decode_one(&mut decoder, &units[3].bytes, &mut decoded).expect("a refresh decodes on its own");
}

#[test]
fn a_stream_of_another_extent_is_refused() {
    let units = encode_all(EncoderSettings::new([128, 64]), &[flat_picture([128, 64], 50)], |_| false);
    let mut decoder = decoder([64, 128]);
    let mut decoded = I420::default();
    let result = decode_one(&mut decoder, &units[0].bytes, &mut decoded);
    assert!(
        matches!(result, Err(DecodeError::ExtentMismatch { want: [64, 128], got: [128, 64] })),
        "{result:?}"
    );
    assert_eq!(decoded, I420::default());
}

#[test]
fn extents_out_of_range_are_refused_by_both_sides() {
    for extent in [[0, 64], [64, 2], [63, 64], [64, 65], [4098, 64], [64, 2306], [u32::MAX, u32::MAX]] {
        let made = OpenH264Encoder::new(EncoderSettings::new(extent));
        assert!(matches!(made.err(), Some(EncodeError::Extent(e)) if e == extent), "{extent:?}");
        let made = OpenH264Decoder::new(extent);
        assert!(matches!(made.err(), Some(DecodeError::Extent(e)) if e == extent), "{extent:?}");
    }
}

#[test]
fn settings_out_of_range_are_refused_by_name() {
    let good = EncoderSettings::new([64, 64]);
    let bad = [
        ("qp", EncoderSettings { qp: 52, ..good }),
        ("fps", EncoderSettings { fps: 0, ..good }),
        ("fps", EncoderSettings { fps: 61, ..good }),
        ("threads", EncoderSettings { threads: 0, ..good }),
        ("threads", EncoderSettings { threads: 5, ..good }),
    ];
    for (want, settings) in bad {
        let made = OpenH264Encoder::new(settings);
        assert!(
            matches!(made.err(), Some(EncodeError::Setting { name, .. }) if name == want),
            "{settings:?}"
        );
    }
}

#[test]
fn pictures_that_do_not_fit_are_refused_and_the_stream_goes_on() {
    let mut encoder = encoder(EncoderSettings::new([64, 64]));
    let good = flat_picture([64, 64], 90);
    encode_one(&mut encoder, &good, 0, false).expect("a valid picture encodes");
    let other = flat_picture([64, 32], 90);
    let result = encode_one(&mut encoder, &other, 1, false);
    assert!(matches!(result, Err(EncodeError::ExtentChanged { .. })), "{result:?}");
    let unit = encode_one(&mut encoder, &good, 3, false).expect("a valid picture encodes");
    assert!(!unit.is_refresh, "refused pictures must leave the stream alone");
}

#[test]
fn the_quantiser_changes_without_a_refresh() {
    for extent in [[256, 256], [250, 130]] {
        let pictures: Vec<_> = (0..9).map(|at| atlas_picture(extent, &mut Random(SEED + at))).collect();
        let mut encoder = encoder(EncoderSettings::new(extent));
        let mut decoder = decoder(extent);
        let mut decoded = I420::default();
        let mut sizes = Vec::new();
        for (at, picture) in pictures.iter().enumerate() {
            encoder.set_qp([22, 34, 22][at / 3]).expect("the quantiser is in range");
            let unit = encode_one(&mut encoder, picture, at as i64 * UPDATE_NS, false).expect("it encodes");
            assert_eq!(unit.is_refresh, at == 0, "picture {at}");
            decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("it decodes");
            sizes.push(unit.bytes.len());
        }
        println!("{extent:?}, QP 22, 34, 22: {sizes:?} bytes");
        assert!(sizes[4] * 2 < sizes[2] && sizes[4] * 2 < sizes[7], "{sizes:?}");
    }
}

#[test]
fn noise_at_the_finest_quantiser_gives_a_picture_or_an_error() {
    let mut random = Random(SEED);
    let mut noise = flat_picture([256, 256], 0);
    for plane in noise.planes_mut() {
        plane.fill_with(|| random.next() as u8);
    }
    let mut encoder = encoder(EncoderSettings { qp: 0, ..EncoderSettings::new([256, 256]) });
    let mut decoder = decoder([256, 256]);
    let mut decoded = I420::default();
    for at in 0..4 {
        match encode_one(&mut encoder, &noise, at, at == 2) {
            Ok(unit) => {
                println!("noise at QP 0: {} bytes", unit.bytes.len());
                decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("what encodes, decodes");
                assert!(psnr_db(luma(&decoded), luma(&noise)) > 45.0);
            }
            Err(error) => println!("noise at QP 0: {error}"),
        }
    }
    encoder.set_qp(22).expect("the quantiser is in range");
    let unit = encode_one(&mut encoder, &noise, 9, true).expect("an ordinary quantiser encodes anything");
    decode_one(&mut decoder, &unit.bytes, &mut decoded).expect("it decodes");
}

/// Damages a unit in one of five ways.
fn mutate(unit: &[u8], random: &mut Random) -> Vec<u8> {
    let mut bytes = unit.to_vec();
    match random.below(5) {
        0 => bytes.truncate(random.below(unit.len())),
        1 => (0..1 + random.below(8)).for_each(|_| {
            let at = random.below(bytes.len());
            bytes[at] ^= 1 << random.below(8);
        }),
        2 => (0..1 + random.below(64)).for_each(|_| {
            let at = random.below(bytes.len());
            bytes[at] = random.next() as u8;
        }),
        3 => {
            let (from, to) = (random.below(bytes.len()), random.below(bytes.len()));
            drop(bytes.drain(from.min(to)..from.max(to)));
        }
        _ => {
            // Most damage is spent on slice data; hit the headers too.
            let at = random.below(bytes.len().min(48));
            bytes[at] = random.next() as u8;
        }
    }
    bytes
}

#[test]
fn damaged_units_give_a_picture_or_an_error() {
    const EXTENT: [u32; 2] = [96, 80];
    const ROUNDS: usize = 3000;
    let settings = EncoderSettings { threads: 2, ..EncoderSettings::new(EXTENT) };
    // A refresh and a picture that refers to it, over and over.
    let units = encode_all(settings, &changing_pictures(EXTENT, 24, SEED), |at| at % 2 == 0);
    let mut random = Random(SEED);
    let mut decoder = decoder(EXTENT);
    let mut decoded = I420::default();
    let (mut pictures, mut errors) = (0, 0);
    for round in 0..ROUNDS {
        let at = round % units.len();
        recover(&mut decoder, &units[at & !1], round);
        match decode_one(&mut decoder, &mutate(&units[at].bytes, &mut random), &mut decoded) {
            Ok(()) => {
                pictures += 1;
                assert_eq!(decoded.extent_texels(), EXTENT, "round {round}, seed {SEED:#x}");
            }
            Err(_) => errors += 1,
        }
    }
    println!("{ROUNDS} damaged units: {pictures} pictures, {errors} errors");
    assert!(pictures > ROUNDS / 100 && errors > ROUNDS / 4, "{pictures} pictures, {errors} errors");
}

/// An intact refresh must decode, and to what it always decodes to, whatever came before.
#[track_caller]
fn recover(hurt: &mut OpenH264Decoder, refresh: &AccessUnit, round: usize) {
    let (mut got, mut want) = (I420::default(), I420::default());
    let result = decode_one(hurt, &refresh.bytes, &mut got);
    assert!(result.is_ok(), "round {round}, seed {SEED:#x}: {result:?}");
    if round.is_multiple_of(100) {
        decode_one(&mut decoder(got.extent_texels()), &refresh.bytes, &mut want)
            .expect("an intact refresh decodes");
        assert!(got == want, "round {round}, seed {SEED:#x}");
    }
}

#[test]
fn foreign_kinds_of_units_never_reach_the_library() {
    let mut decoder = decoder([64, 64]);
    let mut decoded = I420::default();
    for nal_type in (0..32).filter(|nal_type| ![1, 5, 6, 7, 8, 9, 12].contains(nal_type)) {
        let result = decode_one(&mut decoder, &[0, 0, 0, 1, 0x60 | nal_type, 0x42, 0x80], &mut decoded);
        assert!(
            matches!(result, Err(DecodeError::UnexpectedUnit { nal_type: t }) if t == nal_type),
            "{result:?}"
        );
    }
}

#[test]
fn empty_and_endless_units_are_errors() {
    let mut decoder = decoder([64, 64]);
    let mut decoded = I420::default();
    assert!(decode_one(&mut decoder, &[], &mut decoded).is_err());
    let endless = vec![0x55; shadecast_protocol::limits::MAX_ACCESS_UNIT_BYTES + 1];
    assert!(matches!(decode_one(&mut decoder, &endless, &mut decoded), Err(DecodeError::TooLong { .. })));
}

#[test]
fn raw_pictures_come_back_as_they_were_and_each_is_a_refresh() {
    let extent = AtlasExtent::MIN;
    let mut encoder = encode::encoder(Codec::Raw, EncoderSettings::new(extent.texels())).unwrap();
    let mut decoder = RawDecoder::new(extent.texels());
    for picture in changing_pictures(extent.texels(), 3, SEED) {
        let source = Source::Planes(picture.clone());
        let unit = encode::encode_one(encoder.as_mut(), source, 0, false).expect("it fits");
        assert!(unit.is_refresh);
        decoder.submit(&unit.bytes);
        let decoded = decoder.poll(Duration::ZERO).expect("done at once").expect("a picture");
        assert_eq!(decoded, Picture::Planes(picture));
    }
    let other = Source::Planes(flat_picture([64, 32], 90));
    let result = encode::encode_one(encoder.as_mut(), other, 0, false);
    assert!(matches!(result, Err(EncodeError::ExtentChanged { .. })), "{result:?}");
}

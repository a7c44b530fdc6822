use super::*;
use crate::encode::openh264::{EncoderSettings, OpenH264Encoder};
use crate::encode::{AccessUnit, Encoder, Source, encode_one};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use shadecast_protocol::picture::I420;

const EXTENT: [u32; 2] = [256, 128];
const COLUMNS: usize = 16;

fn encoder(qp: u8, threads: u32) -> OpenH264Encoder {
    OpenH264Encoder::new(EncoderSettings { qp, threads, ..EncoderSettings::new(EXTENT) }).expect("in range")
}

fn grey() -> I420 {
    I420::new(EXTENT, vec![128; I420::byte_count(EXTENT) as usize]).expect("even sides")
}

/// Paints macroblocks with a gradient and grain.
fn paint(
    picture: &mut I420,
    macroblocks: impl IntoIterator<Item = usize>,
    grain: i32,
    random: &mut SmallRng,
) {
    for at in macroblocks {
        let (left, top) = (at % COLUMNS * 16, at / COLUMNS * 16);
        let slopes: [i32; 3] =
            [random.random_range(-6..7), random.random_range(-6..7), random.random_range(60..190)];
        for (plane, texels) in picture.planes_mut().into_iter().enumerate() {
            let shift = usize::from(plane > 0);
            let width = EXTENT[0] as usize >> shift;
            for y in 0..16 >> shift {
                for x in 0..16 >> shift {
                    let value = slopes[2]
                        + slopes[0] * x as i32
                        + slopes[1] * y as i32
                        + random.random_range(-grain..=grain);
                    texels[((top >> shift) + y) * width + (left >> shift) + x] = value.clamp(0, 255) as u8;
                }
            }
        }
    }
}

/// The same picture with its content moved by some texels.
fn moved(picture: &I420, by: usize) -> I420 {
    let mut moved = picture.clone();
    moved.planes_mut().into_iter().for_each(|plane| plane.rotate_right(by));
    moved
}

fn unit(encoder: &mut dyn Encoder, picture: &I420, refresh: bool) -> AccessUnit {
    encode_one(encoder, Source::Planes(picture.clone()), 0, refresh).expect("coded")
}

/// Bits of the payloads of all slices, and how many slices there are.
fn slices(unit: &AccessUnit) -> (f64, usize) {
    let slices = units(&unit.bytes).filter(|unit| matches!(unit[0] & 31, SLICE | REFRESH_SLICE));
    slices.fold((0.0, 0), |(bits, count), unit| (bits + 8.0 * payload(&unit[1..]).len() as f64, count + 1))
}

#[test]
fn all_bits_of_pictures_of_any_content_and_quantiser_are_counted() {
    let mut random = SmallRng::seed_from_u64(5);
    for (qp, grain, threads) in [(10, 40, 2), (16, 60, 1), (22, 8, 4), (30, 20, 1), (38, 4, 4), (51, 90, 1)] {
        let (mut encoder, mut counter, mut picture) = (encoder(qp, threads), BitCounter::default(), grey());
        paint(&mut picture, 0..128, grain, &mut random);
        for number in 0..6 {
            let coded = unit(&mut encoder, &picture, number == 4);
            let (expected, count) = slices(&coded);
            let counted =
                counter.count(&coded.bytes).unwrap_or_else(|error| panic!("qp {qp}, {number}: {error}"));
            assert_eq!((counted.columns, counted.bits.len()), (COLUMNS, 128));
            let sum: f64 = counted.bits.iter().sum();
            let most_of_headers = 80.0 * count as f64;
            assert!(
                sum <= expected && expected - sum < most_of_headers,
                "qp {qp}, {number}: {sum} of {expected}"
            );
            assert!(counted.bits.iter().all(|bits| *bits >= 0.0));
            match number % 3 {
                0 => picture = moved(&picture, 3 + 256 * number),
                1 => paint(&mut picture, (0..128).filter(|at| at % 5 == number), grain, &mut random),
                _ => {}
            }
        }
    }
}

#[test]
fn bits_lie_where_the_picture_changes() {
    let mut random = SmallRng::seed_from_u64(6);
    let (mut encoder, mut counter, mut picture) = (encoder(26, 4), BitCounter::default(), grey());
    paint(&mut picture, 0..128, 20, &mut random);
    for _ in 0..4 {
        counter.count(&unit(&mut encoder, &picture, false).bytes).expect("read");
    }
    let changed = [19, 20, 77, 120];
    paint(&mut picture, changed, 20, &mut random);
    let coded = unit(&mut encoder, &picture, false);
    let bits = &counter.count(&coded.bytes).expect("read").bits;
    let sum = |so: &dyn Fn(usize) -> bool| (0..128).filter(|at| so(*at)).map(|at| bits[at]).sum::<f64>();
    let (inside, outside) = (sum(&|at| changed.contains(&at)), sum(&|at| !changed.contains(&at)));
    assert!(inside > 2000.0 && outside < 0.02 * inside, "{inside} and {outside}");
}

#[test]
fn bits_of_a_change_are_those_that_it_adds() {
    let mut random = SmallRng::seed_from_u64(7);
    let mut before = grey();
    paint(&mut before, 0..128, 12, &mut random);
    let parts = [[17, 18, 34, 35], [90, 91, 107, 108]];
    let coded = |parts: &[[usize; 4]]| {
        let (mut encoder, mut counter, mut picture) = (encoder(24, 4), BitCounter::default(), before.clone());
        for _ in 0..4 {
            counter.count(&unit(&mut encoder, &picture, false).bytes).expect("read");
        }
        for part in parts {
            paint(&mut picture, *part, 12, &mut SmallRng::seed_from_u64(part[0] as u64));
        }
        let coded = unit(&mut encoder, &picture, false);
        let bits = &counter.count(&coded.bytes).expect("read").bits;
        (
            8.0 * coded.bytes.len() as f64,
            parts.iter().map(|part| part.iter().map(|at| bits[*at]).sum::<f64>()).collect::<Vec<_>>(),
        )
    };
    let (none, _) = coded(&[]);
    let (both, divided) = coded(&parts);
    for (part, counted) in parts.iter().zip(divided) {
        let (alone, _) = coded(&[*part]);
        assert!((alone - none - counted).abs() < 0.02 * counted, "{} bits, counted {counted}", alone - none);
    }
    assert!(both > 2000.0);
}

#[test]
fn damaged_streams_give_errors() {
    let mut random = SmallRng::seed_from_u64(8);
    let (mut encoder, mut picture) = (encoder(26, 2), grey());
    paint(&mut picture, 0..128, 20, &mut random);
    let first = unit(&mut encoder, &picture, true).bytes;
    paint(&mut picture, 0..40, 20, &mut random);
    let second = unit(&mut encoder, &picture, false).bytes;
    let early = BitCounter::default().count(&second).err();
    assert_eq!(early, Some(CountError::Damaged("a picture comes before its parameters")));
    let mut errors = 0;
    for _ in 0..400 {
        let (mut a, mut b) = (first.clone(), second.clone());
        for bytes in [&mut a, &mut b] {
            let at = random.random_range(4..bytes.len());
            bytes[at] ^= 1 << random.random_range(0..8);
            bytes.truncate(random.random_range(bytes.len() / 2..=bytes.len()));
        }
        let mut counter = BitCounter::default();
        errors += [&a, &b].into_iter().filter(|bytes| counter.count(bytes).is_err()).count();
    }
    assert!(errors > 400, "{errors} of 800");
}

#[test]
fn codes_of_variable_length_are_refused() {
    // A picture parameter set: both numbers 0, then the flag of the entropy coder.
    let error = BitCounter::default().count(&[0, 0, 1, 0x68, 0b1100_0000, 0x80]).err();
    assert!(matches!(error, Some(CountError::Unsupported(what)) if what.contains("CAVLC")), "{error:?}");
}

use super::*;
use crate::encode::openh264::{EncoderSettings, OpenH264Encoder};
use crate::encode::{Source, encode_one};
use rand::{Rng, SeedableRng, rngs::SmallRng};
use shadecast_protocol::atlas::{ATLAS_PAGE, BlockAddress, BlockSize};
use shadecast_protocol::picture::I420;

const EXTENT: [u32; 2] = [256, 256];

fn block(x: u16, y: u16, width_log2: u8, height_log2: u8) -> Block {
    let address = BlockAddress { page: ATLAS_PAGE, x, y };
    Block { address, size: BlockSize { width_log2, height_log2 } }
}

fn texels_of(blocks: &[(Block, Reason)]) -> Vec<[u16; REASONS]> {
    let (mut texels, counted) = (vec![[9; REASONS]; 3], MacroblockBits { columns: 4, bits: vec![0.0; 16] });
    note_texels(&mut texels, &counted, blocks);
    texels
}

#[test]
fn texels_of_blocks_are_counted_where_they_lie() {
    let texels = texels_of(&[
        (block(0, 0, 5, 4), Reason::Moving),
        (block(36, 24, 2, 3), Reason::Relit),
        (block(40, 24, 3, 2), Reason::Entering),
    ]);
    let of = |at: usize, reason: Reason| texels[at][reason as usize];
    assert_eq!([of(0, Reason::Moving), of(1, Reason::Moving), of(2, Reason::Moving)], [256, 256, 0]);
    assert_eq!((of(6, Reason::Relit), of(6, Reason::Entering)), (32, 32));
    let all: u32 = texels.iter().flatten().map(|texels| u32::from(*texels)).sum();
    assert_eq!(all, 512 + 64);
}

#[test]
fn blocks_beyond_the_picture_count_nothing() {
    assert!(
        texels_of(&[(block(512, 512, 6, 6), Reason::Moving)]).iter().flatten().all(|texels| *texels == 0)
    );
}

/// Grain in some blocks.
fn paint(picture: &mut I420, blocks: &[(Block, Reason)], random: &mut SmallRng) {
    for (block, _) in blocks {
        let [left, top, right, bottom] = block.rect_texels();
        for y in top..bottom {
            for x in left..right {
                picture.planes_mut()[0][(y * EXTENT[0] + x) as usize] = random.random_range(60..190);
            }
        }
    }
}

#[test]
fn bits_by_reason_add_up_and_follow_what_changes() {
    let mut random = SmallRng::seed_from_u64(3);
    let settings = EncoderSettings { qp: 26, threads: 4, ..EncoderSettings::new(EXTENT) };
    let (mut encoder, mut ledger) = (OpenH264Encoder::new(settings).expect("in range"), Ledger::default());
    let all: Vec<_> =
        (0..16).map(|at| (block(64 * (at % 4), 64 * (at / 4), 6, 6), Reason::Entering)).collect();
    let mut picture = I420::new(EXTENT, vec![128; I420::byte_count(EXTENT) as usize]).expect("even sides");
    paint(&mut picture, &all, &mut random);
    let mut next = |picture: &I420, shaded: &[(Block, Reason)]| {
        let unit = encode_one(&mut encoder, Source::Planes(picture.clone()), 0, false).expect("coded");
        let bits = ledger.divide(&unit, shaded).expect("read");
        assert_eq!(bits.total(), 8 * unit.bytes.len() as u64);
        bits
    };
    let first = next(&picture, &all);
    assert_eq!((first.refresh, first.entering), (first.total(), 0), "a first picture is a refresh");
    for _ in 0..3 {
        next(&picture, &[]);
    }
    let reasons = [Reason::Entering, Reason::Resized, Reason::Refiltered, Reason::Relit, Reason::Moving];
    for reason in reasons {
        let shaded = [(block(64, 128, 5, 5), reason), (block(160, 32, 4, 4), reason)];
        paint(&mut picture, &shaded, &mut random);
        let bits = next(&picture, &shaded);
        let found = match reason {
            Reason::Entering => bits.entering,
            Reason::Resized => bits.resized,
            Reason::Refiltered => bits.refiltered,
            Reason::Relit => bits.relit,
            Reason::Moving => bits.moving,
        };
        assert!(found > 4000 && bits.total() - found - bits.headers < found / 50, "{reason:?}: {bits:?}");
        assert!(bits.headers < 800, "{bits:?}");
    }
}

#[test]
fn sums_and_differences_are_by_reason() {
    let [a, b] =
        [(5, 2), (7, 9)].map(|(moving, refresh)| CauseBits { moving, refresh, ..CauseBits::default() });
    assert_eq!([a, b].into_iter().sum::<CauseBits>() - a, b);
    assert_eq!((a + b).total(), 23);
}

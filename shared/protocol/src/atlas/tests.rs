use super::*;
use crate::limits::CHROMA_INSET_TEXELS;

#[test]
fn an_atlas_has_powers_of_two_within_the_limits_and_nothing_else() {
    for [width, height] in [[512, 512], [1024, 512], [2048, 2048], [4096, 2048]] {
        let extent = AtlasExtent::new(width, height).unwrap();
        assert_eq!((extent.texels(), extent.to_string()), ([width, height], format!("{width}x{height}")));
        assert_eq!(extent.to_string().parse(), Ok(extent));
    }
    for [width, height] in [
        [0, 0],
        [256, 512],
        [512, 256],
        [1536, 1536],
        [2000, 2048],
        [2048, 4096],
        [8192, 2048],
        [u32::MAX; 2],
    ] {
        let error = AtlasExtent::new(width, height).unwrap_err();
        assert_eq!(error, AtlasExtentError::Sides { width, height });
        assert_eq!(format!("{width}x{height}").parse::<AtlasExtent>(), Err(error));
    }
    for text in ["", "2048", "2048x", "x2048", "2048X2048", "2048x-1", " 512x512", "512x512x512"] {
        assert_eq!(text.parse::<AtlasExtent>(), Err(AtlasExtentError::Syntax(text.to_owned())));
    }
}

#[test]
fn what_is_no_atlas_is_refused_with_what_is() {
    let words = AtlasExtent::new(1536, 1536).unwrap_err().to_string();
    for word in ["1536x1536", "power of two", "512 to 4096", "512 to 2048", "2048x2048"] {
        assert!(words.contains(word), "{words}");
    }
}

/// As bytes an extent is two numbers, as it was before it had a type; and no bytes make one that cannot be.
#[test]
fn an_extent_is_checked_as_it_is_read() {
    let bytes = postcard::to_stdvec(&AtlasExtent::MAX).unwrap();
    assert_eq!(bytes, postcard::to_stdvec(&[4096u32, 2048]).unwrap());
    assert_eq!(postcard::from_bytes(&bytes), Ok(AtlasExtent::MAX));
    let wrong = postcard::to_stdvec(&[1536u32, 1536]).unwrap();
    assert!(postcard::from_bytes::<AtlasExtent>(&wrong).is_err());
}

#[test]
fn an_atlas_is_halved_until_a_client_holds_it() {
    let halved = |max| AtlasExtent::DEFAULT.halved_to_fit(max).map(AtlasExtent::texels);
    assert_eq!(halved([4096, 2048]), Some([2048, 2048]));
    assert_eq!(halved([4096, 1500]), Some([2048, 1024]));
    assert_eq!(halved([512, 512]), Some([512, 512]));
    assert_eq!(halved([511, 4096]), None);
    assert_eq!(halved([0, 0]), None);
}

/// Inclusive range of the texels with non-zero weight in a bilinear lookup at `at`, centres at +0.5.
fn taps(at: f64) -> (i64, i64) {
    let low = (at - 0.5).floor();
    let weight_of_next = at - 0.5 - low;
    (low as i64, low as i64 + i64::from(weight_of_next > 0.0))
}

#[test]
fn lookups_never_reach_a_neighbours_luma_or_chroma() {
    for log2 in BLOCK_MIN_LOG2..=BLOCK_MAX_LOG2 {
        for start in [0, 4, 512, 1020, 3584u16] {
            let size = BlockSize::new(log2 as u8, log2 as u8).unwrap();
            let block = Block { address: BlockAddress { page: 0, x: start, y: 0 }, size };
            let [left, _, right, _] = block.rect_texels().map(i64::from);
            let [from, _, to, _] = block.lookup_rect_texels().map(f64::from);
            let steps = (to - from) as u32 * 64;
            let inset = f64::from(CHROMA_INSET_TEXELS);
            for step in 0..=steps {
                let at = from + (to - from) * f64::from(step) / f64::from(steps);
                let (low, high) = taps(at);
                assert!(low >= left && high < right, "luma {low}..={high} of {left}..{right} at {at}");
                let of_chroma = at.clamp(left as f64 + inset, right as f64 - inset);
                let (low, high) = taps(of_chroma * 0.5);
                assert!(
                    low >= left / 2 && high < right / 2,
                    "chroma {low}..={high} of {left}..{right} at {at}"
                );
            }
        }
    }
}

#[test]
fn the_inset_of_luma_would_reach_a_neighbours_chroma() {
    let at = 64.0 + f64::from(BLOCK_INSET_TEXELS);
    assert!(taps(at).0 >= 64, "luma alone would allow it");
    assert!(taps(at * 0.5).0 < 32);
}

#[test]
fn every_block_survives_packing() {
    for w in 2..=9u8 {
        for h in 2..=9u8 {
            for address in [(0, 0), (4, 8), (3584, 1536), (1020, 36)] {
                for page in [0, 1, 31] {
                    let (x, y) = if page == 0 { address } else { (address.0 % 1536, address.1 % 1536) };
                    let block = Block {
                        address: BlockAddress { page, x, y },
                        size: BlockSize { width_log2: w, height_log2: h },
                    };
                    assert_eq!(Block::unpack(block.pack()), Ok(block));
                }
            }
        }
    }
}

#[test]
fn words_that_are_no_block_are_refused() {
    assert!(Block::unpack(crate::limits::NO_BLOCK).is_err());
    assert!(Block::unpack(1 << 31).is_err());
    let beyond =
        Block { address: BlockAddress { page: 0, x: 4092, y: 0 }, size: BlockSize::new(3, 2).unwrap() };
    assert!(Block::unpack(beyond.pack()).is_err());
    let beyond =
        Block { address: BlockAddress { page: 1, x: 2044, y: 0 }, size: BlockSize::new(3, 2).unwrap() };
    assert!(Block::unpack(beyond.pack()).is_err(), "a page of the store is smaller than the largest atlas");
}

#[test]
fn blocks_of_two_pages_share_no_texel() {
    let block =
        |page| Block { address: BlockAddress { page, x: 8, y: 8 }, size: BlockSize::new(3, 3).unwrap() };
    assert!(block(1).overlaps(block(1)) && !block(0).overlaps(block(1)) && !block(1).overlaps(block(2)));
    assert!(block(1).is_stored() && !block(0).is_stored());
}

#[test]
fn texels_of_a_pixel_are_told_to_an_eighth_of_an_octave() {
    for steps in 0..=150 {
        let texels = [(steps as f32 * 0.025).exp2(), (3.75 - steps as f32 * 0.025).exp2()];
        let told = PixelTexels::from_bits(PixelTexels::new(texels).bits()).texels();
        for (told, texels) in told.into_iter().zip(texels) {
            assert!((told / texels).log2().abs() <= 0.126, "{told} for {texels}");
        }
    }
    assert_eq!(PixelTexels::new([0.3, 1000.0]).steps(), [0, 15], "what is beyond is told as the end");
    assert_eq!(PixelTexels::default().texels(), [1.0; 2]);
}

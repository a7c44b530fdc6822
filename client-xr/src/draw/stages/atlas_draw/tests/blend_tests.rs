//! Colours of two pictures, by how much of them is the newest picture's.

use super::*;

/// All of one grey.
fn grey(luma: u8) -> Picture {
    let texels = (ATLAS.width() * ATLAS.height()) as usize;
    Picture::Planes(I420::new(ATLAS.texels(), [vec![luma; texels], vec![128; texels / 2]].concat()).unwrap())
}

/// A patch on the left whose block the picture before has, and one on the right whose it has not.
fn two_patches() -> Patches {
    let mut shown = Patches { patches: Vec::new(), positions: Vec::new() };
    for (number, block) in blocks().into_iter().take(2).enumerate() {
        let left = number as f32 - 1.0;
        let corners = [[left, -1.0], [left + 1.0, -1.0], [left + 1.0, 1.0], [left, 1.0]];
        shown.add(block, PatchKind::Two, corners, 0.5);
    }
    shown
}

/// Greens left and right.
fn greens(pixels: &[u8]) -> [f32; 2] {
    [SIDE / 4, SIDE * 3 / 4].map(|x| f32::from(pixels[((SIDE / 2 * SIDE + x) * 4 + 1) as usize]))
}

#[test]
fn a_block_that_both_pictures_have_is_of_both() {
    let bench = Bench::new();
    let (newest, before) = (grey(60), grey(180));
    let shown = two_patches();
    let nothing = CoverageMap::new(ATLAS);
    let light = |luma: f32| linear_from_srgb(luma / 255.0) * 255.0;
    let blended = 60.0 * NEWEST_PART + 180.0 * (1.0 - NEWEST_PART);
    let formats = [vk::Format::G8_B8_R8_3PLANE_420_UNORM, vk::Format::G8_B8R8_2PLANE_420_UNORM];
    let mut pairs = vec![(newest, before)];
    pairs.extend(formats.map(|format| {
        let sampler = sampler_of(&bench.gpu, format);
        let [newest, before] = [60, 180].map(|luma| on_device_for(&bench.gpu, &grey(luma), format, &sampler));
        (newest, before)
    }));
    for (newest, before) in &pairs {
        for reconstruction in [Reconstruction::Bilinear, Reconstruction::Bicubic] {
            let lookup = Lookup { reconstruction, ..Lookup::default() };
            for (blends, expected) in [(true, blended), (false, 60.0)] {
                let colours = Colours { lookup, has_store: false, blends };
                let pixels = bench.draw_in(&shown, newest, colours, &nothing, Some((before, &[true, false])));
                let [left, right] = greens(&pixels);
                assert!((left - light(expected)).abs() < 2.0, "{reconstruction:?}, {blends}: {left}");
                assert!((right - light(60.0)).abs() < 2.0, "{reconstruction:?}, {blends}: {right}");
            }
        }
    }
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

/// The picture before is of another kind where a decoder goes from one to the other.
#[test]
fn pictures_of_two_kinds_do_not_blend() {
    let bench = Bench::new();
    let gpu = &bench.gpu;
    let stage =
        AtlasDraw::new(gpu, &bench.targets.pass, Colours { blends: true, ..Colours::default() }).unwrap();
    let mut recorder = gpu.record().unwrap();
    let mut bundle = |index: usize, picture: &Picture| {
        let mut bundle = stage.bundle_memory(gpu, index, PATCHES, ATLAS, false).unwrap();
        let mut set = stage.bundle_set(gpu, &mut recorder, &bundle, ATLAS, bench.shared()).unwrap();
        bench.fill(&stage, &mut bundle, picture);
        stage.record_picture(&mut recorder, &mut set, &bundle, bench.shared()).unwrap();
        (set, bundle)
    };
    let planes = bundle(0, &grey(60));
    let image = on_device(gpu, &grey(60), vk::Format::G8_B8R8_2PLANE_420_UNORM);
    let (mut set, of_image) = bundle(1, &image);
    assert!(!stage.bind_before((&mut set, &of_image), (&planes.0, None)));
    gpu.wait(recorder.submit().unwrap()).unwrap();
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
}

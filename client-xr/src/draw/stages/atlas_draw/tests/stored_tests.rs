//! Blocks in the store: their copies and their lookups against the twins, and that no neighbour is seen in either.

use super::*;
use shadecast_protocol::limits::STORE_PAGE_SIDE;
use shadecast_shaders::twin::settle::{highest_level, settled, unpacked_light};
use shadecast_shaders::twin::store_lookup::{Levels, level};

impl Bench {
    /// Copies blocks of a picture to the store.
    fn settle(&self, picture: &Picture, blocks: &[(Block, Block)]) {
        let gpu = &self.gpu;
        let mut recorder = gpu.record().unwrap();
        let stage =
            AtlasDraw::new(gpu, &self.targets.pass, Colours { has_store: true, ..Colours::default() })
                .unwrap();
        let mut bundle = stage.bundle_memory(gpu, 0, PATCHES, ATLAS, true).unwrap();
        let mut set = stage.bundle_set(gpu, &mut recorder, &bundle, ATLAS, self.shared()).unwrap();
        self.fill(&stage, &mut bundle, picture);
        bundle.settled.write(blocks.iter().copied());
        stage.record_picture(&mut recorder, &mut set, &bundle, self.shared()).unwrap();
        gpu.wait(recorder.submit().unwrap()).unwrap();
    }

    /// A level of a page: rows of packed light.
    fn page(&self, page: u32, level: u32) -> Vec<u32> {
        let side = STORE_PAGE_SIDE >> level;
        let readback = Buffer::new(&self.gpu, "page", u64::from(side * side) * 4, Memory::Readback).unwrap();
        let mut recorder = self.gpu.record().unwrap();
        let layouts = [vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL, vk::ImageLayout::TRANSFER_SRC_OPTIMAL];
        recorder.transition(&self.store.image, layouts, Access::FRAGMENT_READ, Access::COPY_READ);
        recorder.read_level(&self.store.image, [page - 1, level], &readback, 0);
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        let layouts = [layouts[1], layouts[0]];
        recorder.transition(&self.store.image, layouts, Access::COPY_READ, Access::FRAGMENT_READ);
        self.gpu.wait(recorder.submit().unwrap()).unwrap();
        bytemuck::cast_slice(readback.bytes()).to_vec()
    }
}

fn at(page: u8, [x, y]: [u32; 2], size: BlockSize) -> Block {
    Block { address: BlockAddress { page, x: x as u16, y: y as u16 }, size }
}

/// The same place in a page, which few levels fit.
fn at_odds(from: &Block, page: u8) -> Block {
    let [x, y, ..] = from.rect_texels();
    at(page, [x, y], from.size)
}

/// Places at multiples of the blocks' sides, one beside the other: all levels fit.
fn aligned(blocks: &[Block], page: u8) -> Vec<(Block, Block)> {
    let (mut x, mut y) = (0u32, 0);
    let place = |from: &Block| {
        x = x.next_multiple_of(from.size.width());
        if x + from.size.width() > STORE_PAGE_SIDE {
            (x, y) = (0, y + 512);
        }
        let to = at(page, [x, y], from.size);
        x += from.size.width();
        (*from, to)
    };
    blocks.iter().map(place).collect()
}

#[test]
fn copies_and_their_levels_are_those_of_the_twin() {
    let bench = Bench::with_store(2);
    let blocks = blocks();
    let planes = smooth();
    let Picture::Planes(texels) = &planes else { unreachable!("planes") };
    let odd: Vec<_> = blocks.iter().map(|block| (*block, at_odds(block, 1))).collect();
    let moves = [odd, aligned(&blocks, 2)].concat();
    let formats = [vk::Format::G8_B8_R8_3PLANE_420_UNORM, vk::Format::G8_B8R8_2PLANE_420_UNORM];
    let on_device = formats.map(|format| on_device(&bench.gpu, &planes, format));
    let twins: Vec<_> = moves.iter().map(|(from, to)| settled(texels, *from, *to)).collect();
    for picture in [&planes, &on_device[0], &on_device[1]] {
        bench.settle(picture, &moves);
        let pages = [1, 2].map(|page| (0..5).map(|level| bench.page(page, level)).collect::<Vec<_>>());
        for ((_, to), twin) in moves.iter().zip(&twins) {
            for (level, expected) in twin.iter().enumerate() {
                let [left, top, right, _] = to.rect_texels().map(|texels| texels as usize >> level);
                let (side, width) = (STORE_PAGE_SIDE as usize >> level, right - left);
                let page = &pages[usize::from(to.address.page) - 1][level];
                for (number, expected) in expected.iter().enumerate() {
                    let place = (top + number / width) * side + left + number % width;
                    let (light, step) = unpacked_light(page[place]);
                    // Before it was rounded, as near to the twin's as rounding allows: its own, and that of the level below.
                    let unrounded = expected.clamp(light - step, light + step);
                    let apart = unrounded.map(srgb_from_linear) - expected.map(srgb_from_linear);
                    let apart = apart.abs().max_element() * 255.0;
                    assert!(apart < 2.5, "{apart} apart at level {level} of {to:?}, texel {number}");
                }
            }
        }
    }
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

/// The page is full of another colour at all levels; so is the picture.
#[test]
fn no_lookup_bleeds_at_any_block_size_and_level() {
    let bench = Bench::with_store(2);
    let blocks = blocks();
    let foreign = picture(&[]);
    let whole = BlockSize::new(9, 9).expect("a size");
    let cell = |number: u32| at(0, [number % 4 * 512, number / 4 % 2 * 512], whole);
    let all: Vec<_> =
        (0..16).map(|number| (cell(number), at(1, [number % 4 * 512, number / 4 * 512], whole))).collect();
    let moves = [blocks.iter().map(|block| (*block, at_odds(block, 1))).collect(), aligned(&blocks, 1)];
    for moves in moves {
        bench.settle(&foreign, &all);
        bench.settle(&picture(&blocks), &moves);
        let shown = Patches::of(&moves.iter().map(|(_, to)| *to).collect::<Vec<_>>());
        for reconstruction in [Reconstruction::Bilinear, Reconstruction::Bicubic] {
            let pixels = bench.draw(&shown, &foreign, Lookup { reconstruction, ..Lookup::default() });
            for (number, pixel) in pixels.chunks_exact(4).enumerate() {
                let at = [number as u32 % SIDE, number as u32 / SIDE];
                let is_own = pixel[0] >= 252 && pixel[1] <= 3 && pixel[2] <= 3;
                assert!(is_own, "{reconstruction:?}: {pixel:?} at {at:?}");
            }
        }
    }
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

/// Magnified, of the display's size, and minified across, along and both.
#[test]
fn gpu_and_twin_agree_on_colours_between_texels_and_levels() {
    let bench = Bench::with_store(1);
    let (picture, _) = noise();
    let Picture::Planes(texels) = &picture else { unreachable!("planes") };
    let screen = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
    for [width_log2, height_log2] in [[4, 3], [7, 7], [8, 6], [6, 9], [8, 8], [9, 9]] {
        let size = BlockSize::new(width_log2, height_log2).expect("a size");
        let (from, to) = (at(0, [512, 512], size), at(1, [512, 1024], size));
        bench.settle(&picture, &[(from, to)]);
        let twin = settled(texels, from, to);
        let plane = |(number, texels): (usize, &Vec<glam::Vec3>)| {
            let [left, top, right, _] = to.rect_texels().map(|side| side as usize >> number);
            let width = STORE_PAGE_SIDE as usize >> number;
            let mut values = vec![0.0; width * width];
            for (place, texel) in texels.iter().enumerate() {
                values[(top + place / (right - left)) * width + left + place % (right - left)] = texel.y;
            }
            Plane { width, values }
        };
        let levels = Levels(twin.iter().enumerate().map(plane).collect());
        let mut shown = Patches { patches: Vec::new(), positions: Vec::new() };
        shown.add(to, PatchKind::Two, screen, 0.5);
        let pixel = PixelTexels::new([2.0, 1.4]);
        shown.patches[0].pixel = pixel;
        let rect = to.rect_texels().map(|side| side as f32);
        let [left, top, right, bottom] = to.lookup_rect_texels();
        let step = Vec2::new(right - left, bottom - top) / SIDE as f32;
        let level = level(
            Vec2::new(step.x, 0.0),
            Vec2::new(0.0, step.y),
            highest_level(to) as f32,
            pixel.texels().into(),
        );
        for reconstruction in [Reconstruction::Bilinear, Reconstruction::Bicubic] {
            let pixels = bench.draw(&shown, &picture, Lookup { reconstruction, ..Lookup::default() });
            for (number, pixel) in pixels.chunks_exact(4).enumerate() {
                let place = [number as u32 % SIDE, number as u32 / SIDE].map(|p| p as f32 + 0.5);
                let at = Vec2::new(left, top) + step * Vec2::from(place);
                let value = match reconstruction {
                    Reconstruction::Bilinear => levels.linear(at, rect, level),
                    Reconstruction::Bicubic => levels.cubic(at, rect, level),
                };
                let expected = value.clamp(0.0, 1.0) * 255.0;
                let is_close = (f32::from(pixel[1]) - expected).abs() <= 5.0;
                assert!(is_close, "{reconstruction:?}: {pixel:?} for {expected} at {at}, level {level}");
            }
        }
    }
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

/// As no server says it.
#[test]
fn a_cutout_in_the_store_is_drawn_whole() {
    let bench = Bench::with_store(1);
    let blocks = blocks();
    let moves = aligned(&blocks, 1);
    bench.settle(&picture(&blocks), &moves);
    let mut shown = Patches::of(&moves.iter().map(|(_, to)| *to).collect::<Vec<_>>());
    shown.patches.iter_mut().for_each(|patch| patch.is_masked = true);
    let nothing = CoverageMap::new(ATLAS);
    let pixels = bench.draw_cutouts(&shown, &picture(&[]), Lookup::default(), &nothing);
    assert!(pixels.chunks_exact(4).all(|pixel| pixel[0] >= 252 && pixel[1] <= 3));
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

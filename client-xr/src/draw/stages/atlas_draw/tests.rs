//! Colours never leak between blocks: blocks of all sizes, small and large on the display, with neighbours of the most distant
//! colours. The lookup is compared with its twin. Validation is on; any message fails.

use super::*;
use crate::decode::{DevicePicture, Picture};
use crate::display::EyeImages;
use crate::draw::coverage::CoverageMap;
use crate::draw::draw_list::{Drawable, ListWriter};
use crate::draw::stages::eyes_gpu;
use crate::motion::skinned::SkinCapacity;
use glam::{Mat4, Vec2};
use shadecast_gpu::{Access, DesktopDevice, GpuOptions, Needs, YcbcrFormat};
use shadecast_protocol::atlas::{Block, BlockAddress, BlockSize, PatchKind, PixelTexels};
use shadecast_protocol::coverage::Coverage;
use shadecast_protocol::ids::{InstanceId, VertexSlot};
use shadecast_protocol::limits::{BLOCK_MAX_LOG2, BLOCK_MIN_LOG2};
use shadecast_protocol::memory::ResidentPatch;
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_shaders::color::{linear_from_srgb, srgb_from_linear};
use shadecast_shaders::constants::IS_KEPT;
use shadecast_shaders::twin::atlas_lookup::{Plane, inside_block};

const SIDE: u32 = 128;
const ATLAS: AtlasExtent = AtlasExtent::DEFAULT;
const PATCHES: u32 = 1024;
const VERTICES: u32 = PATCHES * 4;
/// Luma and both differences of the blocks, and of all between them.
const OWN: [u8; 3] = [54, 99, 255];
const FOREIGN: [u8; 3] = [182, 30, 12];
/// Of a block's colour, where the picture before has it too.
const NEWEST_PART: f32 = 0.25;

/// Blocks of each size, none beside another.
fn blocks() -> Vec<Block> {
    let sides = BLOCK_MIN_LOG2 as u8..BLOCK_MAX_LOG2 as u8;
    let sizes = sides.clone().flat_map(|w| sides.clone().map(move |h| (w, h)));
    let mut at = [4u32, 4u32];
    let mut row_height = 0;
    let mut found = Vec::new();
    for (width_log2, height_log2) in sizes {
        let size = BlockSize::new(width_log2, height_log2).expect("a size");
        if at[0] + size.width() + 4 > ATLAS.width() {
            at = [4, at[1] + row_height + 4];
            row_height = 0;
        }
        let block = Block { address: BlockAddress { page: 0, x: at[0] as u16, y: at[1] as u16 }, size };
        assert!(block.fits(ATLAS.texels()));
        at[0] += size.width() + 4;
        row_height = row_height.max(size.height());
        found.push(block);
    }
    found
}

/// The blocks in one colour, all else in another.
fn picture(blocks: &[Block]) -> Picture {
    let [width, height] = ATLAS.texels().map(|side| side as usize);
    let plane = |step: usize, component: usize| {
        let across = width / step;
        let mut texels = vec![FOREIGN[component]; across * (height / step)];
        for block in blocks {
            let [left, top, right, bottom] = block.rect_texels().map(|side| side as usize / step);
            (top..bottom).for_each(|y| texels[y * across..][left..right].fill(OWN[component]));
        }
        texels
    };
    Picture::Planes(I420::new(ATLAS.texels(), [plane(1, 0), plane(2, 1), plane(2, 2)].concat()).unwrap())
}

/// Patches on the display, with their vertices in clip space.
struct Patches {
    patches: Vec<ResidentPatch>,
    positions: Vec<[f32; 4]>,
}

impl Patches {
    /// Adds a patch of two triangles, or one, whose corners on the display are these.
    fn add(&mut self, block: Block, kind: PatchKind, corners: [[f32; 2]; 4], depth: f32) {
        let first = self.positions.len() as u32;
        self.positions.extend(corners.map(|[x, y]| [x, y, depth, 1.0]));
        let vertices = [0, 1, 2, 3, 0].map(|corner| VertexSlot(first + corner));
        let (instance, block, pixel) = (InstanceId(0), Some(block), PixelTexels::default());
        let patch =
            ResidentPatch { instance, kind, vertices, double_sided: true, block, pixel, is_masked: false };
        self.patches.push(patch);
    }

    /// Every block on a patch that fills its cell, on one of a pixel and a half, and on slivers.
    fn of(blocks: &[Block]) -> Self {
        let mut all = Self { patches: Vec::new(), positions: Vec::new() };
        let pixel = 2.0 / SIDE as f32;
        let screen = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
        all.add(blocks[blocks.len() - 1], PatchKind::Two, screen, 0.1);
        for (number, block) in blocks.iter().enumerate() {
            let cell = [number % 8, number / 8].map(|place| place as f32 * 0.25 - 1.0);
            let sizes = [[13.3, 12.7], [1.4, 1.6], [0.7, 9.2], [8.1, 0.4], [2.3, 0.9]];
            for (turn, [width, height]) in sizes.into_iter().enumerate() {
                let kind = if turn % 2 == 0 { PatchKind::Two } else { PatchKind::One };
                let (x, y) = (cell[0] + 0.37 * pixel, cell[1] + (0.2 + 2.3 * turn as f32) * pixel);
                let (w, h) = (width * pixel, height * pixel);
                let corners =
                    [[x, y], [x + w, y + 0.2 * h], [x + 0.9 * w, y + h], [x + 0.1 * w, y + 0.8 * h]];
                all.add(*block, kind, corners, 0.2 + 0.01 * turn as f32);
            }
        }
        all
    }
}

struct Bench {
    gpu: Arc<Gpu>,
    image: Image,
    targets: EyeTargets,
    memory: VertexMemory,
    eyes: [Buffer; FRAMES_IN_FLIGHT],
    /// Without pages, unless a test has others.
    store: Store,
    has_store: bool,
}

impl Bench {
    fn new() -> Self {
        Self::with_store(0)
    }

    fn with_store(pages: u32) -> Self {
        let options = GpuOptions { needs: Needs::ClientOfPictures, validation: true, device_name: None };
        let gpu = Gpu::open(&options, &DesktopDevice)
            .expect("a Vulkan device; `./shadecast setup` installs a software one");
        let format = vk::Format::R8G8B8A8_UNORM;
        let usage = vk::ImageUsageFlags::COLOR_ATTACHMENT | vk::ImageUsageFlags::TRANSFER_SRC;
        let desc = ImageDesc { layers: 2, ..ImageDesc::new("eyes", [SIDE; 2], format, usage) };
        let image = Image::new(&gpu, desc).unwrap();
        let four = vk::SampleCountFlags::TYPE_4;
        let images = &[image.handle()];
        let images =
            EyeImages { images, format, extent_pixels: [SIDE; 2], one_eye: false, density_maps: None };
        let targets = EyeTargets::new(&gpu, images, four).unwrap();
        let mut recorder = gpu.record().unwrap();
        let capacity = SkinCapacity::from(MotionMemory { sample_ring: 8, ..MotionMemory::NONE });
        let memory = VertexMemory::new(&gpu, &mut recorder, VERTICES, capacity).unwrap();
        let store = Store::new(&gpu, &mut recorder, pages).unwrap();
        gpu.wait(recorder.submit().unwrap()).unwrap();
        let mut eyes = eye_buffers(&gpu).unwrap();
        let as_they_are = [Mat4::IDENTITY.to_cols_array_2d(); 2];
        let usual = eyes_gpu([Pose::IDENTITY; 2], [Pose::IDENTITY; 2], [Fov::symmetric_degrees(90.0); 2]);
        let blend = [NEWEST_PART, 0.0, 0.0, 0.0];
        let eyes_in_clip_space = EyesGpu { clip_from_world: as_they_are, blend, ..usual };
        eyes.iter_mut().for_each(|buffer| buffer.write(0, bytemuck::bytes_of(&eyes_in_clip_space)));
        Self { gpu, image, targets, memory, eyes, store, has_store: pages > 0 }
    }

    fn shared(&self) -> Shared<'_> {
        Shared { memory: &self.memory, store: &self.store, eyes: self.eyes.each_ref() }
    }

    /// Takes a picture in.
    fn fill(&self, stage: &AtlasDraw, bundle: &mut BundleMemory, picture: &Picture) {
        match picture {
            Picture::Planes(planes) => bundle.planes.write(planes.planes()),
            Picture::OnDevice(DevicePicture { image, .. }) => {
                let (image, lease) = (image.clone(), Box::new(()));
                let ways = PictureWays::new(&self.gpu, &self.targets.pass, stage).of(&image).unwrap();
                bundle.on_device = Some((DevicePicture { image, is_foreign: false, lease }, ways));
            }
            Picture::FullChroma(_) => unreachable!("no test has such"),
        }
    }

    /// The left eye's bytes of the patches, whose blocks `picture` holds.
    fn draw(&self, shown: &Patches, picture: &Picture, lookup: Lookup) -> Vec<u8> {
        self.draw_cutouts(shown, picture, lookup, &CoverageMap::new(ATLAS))
    }

    /// The same of patches of which some cover only what `coverage` leaves, from the first on.
    fn draw_cutouts(
        &self,
        shown: &Patches,
        picture: &Picture,
        lookup: Lookup,
        coverage: &CoverageMap,
    ) -> Vec<u8> {
        let colours = Colours { lookup, has_store: self.has_store, blends: false };
        self.draw_in(shown, picture, colours, coverage, None)
    }

    /// The same with a picture before, and by patch whether that has its block.
    fn draw_in(
        &self,
        shown: &Patches,
        picture: &Picture,
        colours: Colours,
        coverage: &CoverageMap,
        before: Option<(&Picture, &[bool])>,
    ) -> Vec<u8> {
        let gpu = &self.gpu;
        let mut recorder = gpu.record().unwrap();
        let positions = Buffer::upload(gpu, "positions", &shown.positions).unwrap();
        recorder.copy_buffer(&positions, 0, &self.memory.positions, 0, positions.size());
        let stage = AtlasDraw::new(gpu, &self.targets.pass, colours).unwrap();
        let mut bundle = stage.bundle_memory(gpu, 0, PATCHES, ATLAS, false).unwrap();
        let shared = self.shared();
        let mut set = stage.bundle_set(gpu, &mut recorder, &bundle, ATLAS, shared).unwrap();
        let corners: &mut [CornerGpu] = bytemuck::cast_slice_mut(bundle.corners.bytes_mut());
        let indices: &mut [u32] = bytemuck::cast_slice_mut(bundle.indices.bytes_mut());
        let mut writer = ListWriter::new(corners, indices);
        let mut firsts = vec![0];
        for patch in &shown.patches {
            writer.write(patch);
            firsts.push(writer.corner_count());
        }
        let mut drawn = Drawable { opaque: writer.index_count(), ..Drawable::default() };
        for (number, _) in
            before.iter().flat_map(|(_, kept)| kept.iter().enumerate()).filter(|(_, kept)| **kept)
        {
            corners[firsts[number]..firsts[number + 1]]
                .iter_mut()
                .for_each(|corner| corner.block[0] |= IS_KEPT);
        }
        bundle.coverage.write(0, bytemuck::cast_slice(coverage.words()));
        if shown.patches.iter().any(|patch| patch.is_masked) {
            drawn = Drawable { cutouts: [0, drawn.opaque], ..Drawable::default() };
        }
        self.fill(&stage, &mut bundle, picture);
        stage.record_picture(&mut recorder, &mut set, &bundle, shared).unwrap();
        let mut kept_alive = None;
        if let Some((picture, _)) = before {
            let mut bundle_before = stage.bundle_memory(gpu, 1, PATCHES, ATLAS, false).unwrap();
            let mut set_before = stage.bundle_set(gpu, &mut recorder, &bundle_before, ATLAS, shared).unwrap();
            self.fill(&stage, &mut bundle_before, picture);
            // As a decoder does, whose pictures are of one format.
            if let (Some((_, ways)), Some((_, of_before))) = (&bundle.on_device, &mut bundle_before.on_device)
            {
                *of_before = ways.clone();
            }
            stage.record_picture(&mut recorder, &mut set_before, &bundle_before, shared).unwrap();
            let blends = colours.blends
                && stage.bind_before((&mut set, &bundle), (&set_before, bundle_before.on_device.as_ref()));
            assert_eq!(blends, colours.blends);
            kept_alive = Some((set_before, bundle_before));
        }
        recorder.barrier(Access::COPY_WRITE, Access::VERTEX_READ);
        self.targets.begin(&mut recorder, 0);
        stage.record(&mut recorder, &set, &bundle, 0, drawn);
        recorder.end_pass();
        let readback = Buffer::new(gpu, "eye", u64::from(SIDE * SIDE) * 4, Memory::Readback).unwrap();
        let layouts = [vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL, vk::ImageLayout::TRANSFER_SRC_OPTIMAL];
        recorder.transition(&self.image, layouts, Access::COLOR_WRITE, Access::COPY_READ);
        recorder.read_image(&self.image, 0, &readback, 0);
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        gpu.wait(recorder.submit().unwrap()).unwrap();
        drop(kept_alive);
        readback.bytes().to_vec()
    }
}

#[test]
fn no_reconstruction_bleeds_at_any_block_size() {
    let bench = Bench::new();
    let blocks = blocks();
    assert_eq!(blocks.len(), 49, "each size but the largest");
    let (shown, picture) = (Patches::of(&blocks), picture(&blocks));
    for reconstruction in [Reconstruction::Bilinear, Reconstruction::Bicubic] {
        let pixels = bench.draw(&shown, &picture, Lookup { reconstruction, ..Lookup::default() });
        // The target is linear, and the planes are those of red.
        for (number, pixel) in pixels.chunks_exact(4).enumerate() {
            let at = [number as u32 % SIDE, number as u32 / SIDE];
            let is_own = pixel[0] >= 253 && pixel[1] <= 2 && pixel[2] <= 2;
            assert!(is_own, "{reconstruction:?}: {pixel:?} at {at:?}");
        }
    }
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

/// A grey picture of noise, and its luma for the twin.
fn noise() -> (Picture, Plane) {
    let [width, height] = ATLAS.texels();
    let luma: Vec<u8> = (0..width * height).map(|at| (at.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let values = luma.iter().map(|value| f32::from(*value) / 255.0).collect();
    let chroma = vec![128; luma.len() / 2];
    let picture = I420::new(ATLAS.texels(), [luma, chroma].concat()).unwrap();
    (Picture::Planes(picture), Plane { width: width as usize, values })
}

#[test]
fn gpu_and_twin_agree_on_colours_between_texels() {
    let bench = Bench::new();
    let (picture, luma) = noise();
    let size = BlockSize::new(4, 3).expect("a size");
    let block = Block { address: BlockAddress { page: 0, x: 36, y: 20 }, size };
    let screen = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
    let mut shown = Patches { patches: Vec::new(), positions: Vec::new() };
    shown.add(block, PatchKind::Two, screen, 0.5);
    let rect = block.rect_texels().map(|side| side as f32);
    let [left, top, right, bottom] = block.lookup_rect_texels();
    for reconstruction in [Reconstruction::Bilinear, Reconstruction::Bicubic] {
        let pixels = bench.draw(&shown, &picture, Lookup { reconstruction, ..Lookup::default() });
        for (number, pixel) in pixels.chunks_exact(4).enumerate() {
            let place = [number as u32 % SIDE, number as u32 / SIDE].map(|p| (p as f32 + 0.5) / SIDE as f32);
            let at = Vec2::new(left + (right - left) * place[0], top + (bottom - top) * place[1]);
            let value = match reconstruction {
                Reconstruction::Bilinear => luma.linear(inside_block(at, rect)),
                Reconstruction::Bicubic => luma.cubic(inside_block(at, rect), rect),
            };
            let expected = linear_from_srgb(value.clamp(0.0, 1.0)) * 255.0;
            let is_close = (f32::from(pixel[1]) - expected).abs() <= 4.0;
            assert!(is_close, "{reconstruction:?}: {pixel:?} for {expected} at {at}");
        }
    }
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

#[test]
fn gpu_and_twin_agree_on_what_a_cutout_leaves() {
    let bench = Bench::new();
    let blocks = blocks();
    let picture = picture(&blocks);
    let block = blocks.into_iter().find(|b| [b.size.width(), b.size.height()] == [16, 8]).expect("a size");
    let screen = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];
    let mut shown = Patches { patches: Vec::new(), positions: Vec::new() };
    shown.add(block, PatchKind::Two, screen, 0.5);
    shown.patches[0].is_masked = true;
    let coverage = Coverage::from_fn(128, |texel| texel.wrapping_mul(2_654_435_761) >> 31 == 1);
    let mut map = CoverageMap::new(ATLAS);
    map.cover(block, &coverage);
    let [first_x, first_y, ..] = block.rect_texels();
    let value = |at: u32| {
        let (x, y) = ((at % ATLAS.width()).wrapping_sub(first_x), (at / ATLAS.width()).wrapping_sub(first_y));
        f32::from(u8::from(x < 16 && y < 8 && coverage.is_covered(y * 16 + x)))
    };
    let values = (0..ATLAS.width() * ATLAS.height()).map(value).collect();
    let bits = Plane { width: ATLAS.width() as usize, values };
    let rect = block.rect_texels().map(|side| side as f32);
    let [left, top, right, bottom] = block.lookup_rect_texels();
    for reconstruction in [Reconstruction::Bilinear, Reconstruction::Bicubic] {
        let lookup = Lookup { reconstruction, ..Lookup::default() };
        let pixels = bench.draw_cutouts(&shown, &picture, lookup, &map);
        let mut drawn = 0;
        for (number, pixel) in pixels.chunks_exact(4).enumerate() {
            let place = [number as u32 % SIDE, number as u32 / SIDE].map(|p| (p as f32 + 0.5) / SIDE as f32);
            let at = Vec2::new(left + (right - left) * place[0], top + (bottom - top) * place[1]);
            let share = bits.linear(inside_block(at, rect));
            // Rounding decides where a line passes a half.
            if (share - 0.5).abs() > 0.01 {
                assert_eq!(pixel[0] > 128, share > 0.5, "{reconstruction:?}: {share} at {at}");
            }
            drawn += usize::from(pixel[0] > 128);
        }
        assert!((2000..14_000).contains(&drawn), "{drawn} of {}", SIDE * SIDE);
    }
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

/// The same picture on the device, in one image of this format, as a platform's decoder leaves it.
fn on_device(gpu: &Arc<Gpu>, picture: &Picture, format: vk::Format) -> Picture {
    on_device_for(gpu, picture, format, &sampler_of(gpu, format))
}

fn sampler_of(gpu: &Arc<Gpu>, format: vk::Format) -> Arc<YcbcrSampler> {
    YcbcrSampler::new(gpu, YcbcrFormat::Known(format)).expect("a software device samples it")
}

/// The same for a sampler that several may share.
fn on_device_for(
    gpu: &Arc<Gpu>,
    picture: &Picture,
    format: vk::Format,
    sampler: &Arc<YcbcrSampler>,
) -> Picture {
    let Picture::Planes(picture) = picture else { panic!("made of planes") };
    let image = YcbcrImage::new(gpu, sampler, ATLAS.texels()).unwrap();
    let [luma, cb, cr] = picture.planes();
    let planes = match format {
        vk::Format::G8_B8R8_2PLANE_420_UNORM => {
            vec![luma.to_vec(), cb.iter().zip(cr).flat_map(|(cb, cr)| [*cb, *cr]).collect()]
        }
        _ => vec![luma.to_vec(), cb.to_vec(), cr.to_vec()],
    };
    let staging = Buffer::upload(gpu, "picture", &planes.concat()).unwrap();
    let mut recorder = gpu.record().unwrap();
    let written = [vk::ImageLayout::UNDEFINED, vk::ImageLayout::TRANSFER_DST_OPTIMAL];
    recorder.transition(&image.image, written, Access::NONE, Access::COPY_WRITE);
    let mut offset = 0;
    for (plane, bytes) in planes.iter().enumerate() {
        recorder.write_plane(&image, plane as u32, &staging, offset);
        offset += bytes.len() as u64;
    }
    let read = [vk::ImageLayout::TRANSFER_DST_OPTIMAL, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
    recorder.transition(&image.image, read, Access::COPY_WRITE, Access::FRAGMENT_READ);
    gpu.wait(recorder.submit().unwrap()).unwrap();
    Picture::OnDevice(DevicePicture { image: Arc::new(image), is_foreign: false, lease: Box::new(()) })
}

/// Smooth in all three planes, with all of their range, and no two blocks alike.
fn smooth() -> Picture {
    let [width, height] = ATLAS.texels().map(|side| side as usize);
    let wave = |x: usize, y: usize, turn: f32| {
        let phase = x as f32 * 0.031 + y as f32 * 0.047 * turn;
        (127.5 + 127.5 * (phase + turn).sin()).round() as u8
    };
    let plane = |step: usize, turn: f32| -> Vec<u8> {
        let texels = (0..height / step).flat_map(|y| (0..width / step).map(move |x| (x * step, y * step)));
        texels.map(|(x, y)| wave(x, y, turn)).collect()
    };
    let planes = [plane(1, 1.0), plane(2, 1.7), plane(2, 2.9)].concat();
    Picture::Planes(I420::new(ATLAS.texels(), planes).unwrap())
}

#[test]
fn a_multi_plane_image_has_the_colours_of_its_planes() {
    let bench = Bench::new();
    let blocks = blocks();
    let shown = Patches::of(&blocks);
    let mut cutouts = Patches::of(&blocks);
    cutouts.patches.iter_mut().for_each(|patch| patch.is_masked = true);
    let mut all = CoverageMap::new(ATLAS);
    for block in &blocks {
        all.cover(*block, &Coverage::from_fn(block.size.texels(), |texel| texel % 3 != 0));
    }
    for picture in [smooth(), picture(&blocks)] {
        let want = bench.draw(&shown, &picture, Lookup::default());
        let want_cutouts = bench.draw_cutouts(&cutouts, &picture, Lookup::default(), &all);
        assert!(want.chunks_exact(4).any(|pixel| pixel[..3] != want[..3]) || want[0] >= 253);
        for format in [vk::Format::G8_B8_R8_3PLANE_420_UNORM, vk::Format::G8_B8R8_2PLANE_420_UNORM] {
            let picture = on_device(&bench.gpu, &picture, format);
            let got = bench.draw(&shown, &picture, Lookup::default());
            let got_cutouts = bench.draw_cutouts(&cutouts, &picture, Lookup::default(), &all);
            for (got, want) in [(&got, &want), (&got_cutouts, &want_cutouts)] {
                let farthest = got.iter().zip(want.iter()).map(|(a, b)| a.abs_diff(*b)).max();
                assert!(farthest <= Some(3), "{format:?}: {farthest:?} of 255 apart");
            }
        }
    }
    assert_eq!(bench.gpu.validation_messages(), 0, "{:?}", bench.gpu.validation_texts());
}

mod blend_tests;
mod stored_tests;

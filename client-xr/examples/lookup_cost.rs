//! What each reconstruction costs on this device: the client's one draw of a wall of patches, all ways in turn in each round.
//! `cargo run --release -p shadecast-client --example lookup_cost -- [PIXELS A SIDE] [ROUNDS]`

mod device;

use shadecast_client::draw::draw_list::{Drawable, ListWriter};
use shadecast_client::draw::stages::FRAMES_IN_FLIGHT;
use shadecast_client::draw::stages::atlas_draw::{
    AtlasDraw, BundleMemory, BundleSet, Colours, EyeTargets, Lookup, Reconstruction, Shared,
};
use shadecast_client::draw::stages::scatter::VertexMemory;
use shadecast_client::draw::stages::settle::Store;
use shadecast_client::motion::skinned::SkinCapacity;
use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Image, Recorder,
    Sampler, SamplerDesc, vk,
};
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockAddress, BlockSize, PatchKind, PixelTexels};
use shadecast_protocol::ids::{InstanceId, VertexSlot};
use shadecast_protocol::memory::ResidentPatch;
use shadecast_protocol::message::MotionMemory;
use shadecast_shaders::constants::IS_KEPT;
use shadecast_shaders::generated::{BENCH_ATLAS_FRAG, CLIENT_ATLAS_VERT, CornerGpu};
use std::sync::Arc;

/// Patches across and down, each with a block of 32x32 texels.
const ACROSS: u16 = 32;
/// Name, reconstruction, and where all blocks are.
const WAYS: [(&str, Reconstruction, Of); 6] = [
    ("bilinear", Reconstruction::Bilinear, Of::Atlas),
    ("bicubic", Reconstruction::Bicubic, Of::Atlas),
    ("bilinear in the store", Reconstruction::Bilinear, Of::Store),
    ("bicubic in the store", Reconstruction::Bicubic, Of::Store),
    ("bilinear of two pictures", Reconstruction::Bilinear, Of::TwoPictures),
    ("bicubic of two pictures", Reconstruction::Bicubic, Of::TwoPictures),
];

#[derive(Clone, Copy, PartialEq, Eq)]
enum Of {
    Atlas,
    Store,
    /// Blended from the picture before.
    TwoPictures,
}

const WITHOUT_STORE: &str = "bilinear without the choice of a store";

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1).map(|argument| argument.parse::<u32>());
    let side = arguments.next().transpose()?.unwrap_or(512);
    let rounds = arguments.next().transpose()?.unwrap_or(41);
    let bench = Bench::new(side)?;
    let ways = WAYS.iter().map(|(_, reconstruction, of)| bench.way(*reconstruction, *of));
    let ways = ways.collect::<Result<Vec<_>, _>>()?;
    let plain = bench.plain(&ways[0])?;
    let mut rows = Vec::new();
    for round in 0..=rounds {
        let mut ms = vec![bench.draw_plain(&plain, &ways[0])?];
        for way in &ways {
            ms.push(bench.draw(way)?);
        }
        // The first round makes the pipelines.
        rows.extend((round > 0).then_some(ms));
    }
    println!("{}: {side}x{side} pixels, two eyes, four samples, {rounds} rounds", bench.gpu.device_name());
    let names = std::iter::once(WITHOUT_STORE).chain(WAYS.map(|(name, ..)| name));
    for (index, name) in names.enumerate() {
        let ms = device::median(rows.iter().map(|row| row[index]));
        let ratio = device::median(rows.iter().map(|row| row[index] / row[0]));
        println!("{name}: {ms:.3} ms, {ratio:.2} times the first in the same round (medians)");
    }
    Ok(())
}

struct Bench {
    gpu: Arc<Gpu>,
    _image: Image,
    targets: EyeTargets,
    memory: VertexMemory,
    eyes: [Buffer; FRAMES_IN_FLIGHT],
    store: Store,
}

struct Way {
    stage: AtlasDraw,
    bundle: BundleMemory,
    set: BundleSet,
    drawn: Drawable,
}

struct Plain {
    pipeline: GraphicsPipeline,
    group: BindGroup,
    _sampler: Sampler,
}

impl Bench {
    fn new(side: u32) -> Result<Self, GpuError> {
        let four = vk::SampleCountFlags::TYPE_4;
        let (gpu, image, targets) = device::open(side, vk::Format::R8G8B8A8_SRGB, four)?;
        let mut recorder = gpu.record()?;
        let capacity = SkinCapacity::from(MotionMemory { sample_ring: 8, ..MotionMemory::NONE });
        let vertices = u32::from(ACROSS) * u32::from(ACROSS) * 4;
        let memory = VertexMemory::new(&gpu, &mut recorder, vertices, capacity)?;
        let positions = Buffer::upload(&gpu, "positions", &positions())?;
        recorder.copy_buffer(&positions, 0, &memory.positions, 0, positions.size());
        recorder.barrier(Access::COPY_WRITE, Access::VERTEX_READ);
        let store = Store::new(&gpu, &mut recorder, 1)?;
        gpu.wait(recorder.submit()?)?;
        let eyes = device::eyes_in_clip_space(&gpu)?;
        Ok(Self { gpu, _image: image, targets, memory, eyes, store })
    }

    fn way(&self, reconstruction: Reconstruction, of: Of) -> Result<Way, GpuError> {
        let lookup = Lookup { reconstruction, ..Lookup::default() };
        let colours = Colours { lookup, has_store: of == Of::Store, blends: of == Of::TwoPictures };
        let stage = AtlasDraw::new(&self.gpu, &self.targets.pass, colours)?;
        let mut recorder = self.gpu.record()?;
        let patches = u32::from(ACROSS) * u32::from(ACROSS);
        let shared = Shared { memory: &self.memory, store: &self.store, eyes: self.eyes.each_ref() };
        let extent = AtlasExtent::DEFAULT;
        let mut bundle = stage.bundle_memory(&self.gpu, 0, patches, extent, false)?;
        let set = stage.bundle_set(&self.gpu, &mut recorder, &bundle, extent, shared)?;
        self.gpu.wait(recorder.submit()?)?;
        let corners: &mut [CornerGpu] = bytemuck::cast_slice_mut(bundle.corners.bytes_mut());
        let indices: &mut [u32] = bytemuck::cast_slice_mut(bundle.indices.bytes_mut());
        let mut writer = ListWriter::new(corners, indices);
        (0..ACROSS * ACROSS).for_each(|number| writer.write(&patch(number, u8::from(of == Of::Store))));
        let drawn = Drawable { opaque: writer.index_count(), ..Drawable::default() };
        if of == Of::TwoPictures {
            corners.iter_mut().for_each(|corner| corner.block[0] |= IS_KEPT);
        }
        Ok(Way { stage, bundle, set, drawn })
    }

    /// The pipeline without a store, for the patches of a way.
    fn plain(&self, way: &Way) -> Result<Plain, GpuError> {
        let desc = GraphicsPipelineDesc {
            cull: vk::CullModeFlags::BACK,
            depth_write: Some(true),
            constants: &[0, 0], // no store, no second picture
            ..GraphicsPipelineDesc::new(&CLIENT_ATLAS_VERT, &BENCH_ATLAS_FRAG, &self.targets.pass)
        };
        let pipeline = GraphicsPipeline::new(&self.gpu, &desc)?;
        let sampler = SamplerDesc::clamped(vk::Filter::LINEAR);
        let sampler = Sampler::new(&self.gpu, sampler)?;
        let mut binds = vec![
            ("Corners", Bind::Buffer(&way.bundle.corners)),
            ("Positions", Bind::Buffer(&self.memory.positions)),
            ("Eyes", Bind::Buffer(&self.eyes[0])),
        ];
        let planes = way.set.planes.images.iter().map(|plane| Bind::Sampled(plane, &sampler));
        let names = ["luma_plane", "cb_plane", "cr_plane", "luma_before", "cb_before", "cr_before"];
        binds.extend(names.into_iter().zip(planes.clone().chain(planes)));
        binds.push(("store", Bind::Sampled(&self.store.image, &sampler)));
        let group = BindGroup::of(pipeline.layout(), &binds)?;
        Ok(Plain { pipeline, group, _sampler: sampler })
    }

    /// Milliseconds of the device.
    fn draw(&self, way: &Way) -> Result<f64, GpuError> {
        self.time(|r| way.stage.record(r, &way.set, &way.bundle, 0, way.drawn))
    }

    /// The same without a store.
    fn draw_plain(&self, plain: &Plain, way: &Way) -> Result<f64, GpuError> {
        self.time(|r| {
            r.bind(&plain.pipeline, &plain.group);
            r.bind_indices(&way.bundle.indices, 0);
            r.draw_indexed(0, way.drawn.opaque);
        })
    }

    fn time(&self, draw: impl FnOnce(&mut Recorder)) -> Result<f64, GpuError> {
        let mut recorder = self.gpu.record()?;
        recorder.scope("draw", |r| {
            self.targets.begin(r, 0);
            draw(r);
            r.end_pass();
        });
        let timings = self.gpu.wait_timed(recorder.submit()?)?;
        Ok(timings.iter().map(|(_, ms)| ms).sum())
    }
}

/// Corners of all patches, which cover the display.
fn positions() -> Vec<[f32; 4]> {
    let step = 2.0 / f32::from(ACROSS);
    let corners = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
    let of_patch = |number: u16| {
        let at = [number % ACROSS, number / ACROSS].map(f32::from);
        corners.map(|[x, y]: [f32; 2]| [(at[0] + x) * step - 1.0, (at[1] + y) * step - 1.0, 0.5, 1.0])
    };
    (0..ACROSS * ACROSS).flat_map(of_patch).collect()
}

fn patch(number: u16, page: u8) -> ResidentPatch {
    let first = u32::from(number) * 4;
    let address = BlockAddress { page, x: number % ACROSS * 32, y: number / ACROSS * 32 };
    ResidentPatch {
        instance: InstanceId(0),
        kind: PatchKind::Two,
        vertices: [0, 1, 2, 3, 0].map(|corner| VertexSlot(first + corner)),
        double_sided: true,
        block: BlockSize::new(5, 5).map(|size| Block { address, size }),
        pixel: PixelTexels::default(),
        is_masked: false,
    }
}

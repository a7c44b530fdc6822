//! What each reconstruction costs on this device: the client's one draw of a wall of patches, all ways in turn in each round.
//! `cargo run --release -p shadecast-client --example lookup_cost -- [PIXELS A SIDE] [ROUNDS]`

mod device;

use shadecast_client::draw::draw_list::{Drawable, ListWriter};
use shadecast_client::draw::stages::FRAMES_IN_FLIGHT;
use shadecast_client::draw::stages::atlas_draw::{
    AtlasDraw, BundleMemory, BundleSet, EyeTargets, Lookup, Reconstruction, Shared,
};
use shadecast_client::draw::stages::scatter::VertexMemory;
use shadecast_client::draw::stages::settle::Store;
use shadecast_client::motion::skinned::SkinCapacity;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Image, vk};
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockAddress, BlockSize, PatchKind};
use shadecast_protocol::ids::{InstanceId, VertexSlot};
use shadecast_protocol::memory::ResidentPatch;
use shadecast_protocol::message::MotionMemory;
use shadecast_shaders::generated::CornerGpu;
use std::sync::Arc;

/// Patches across and down, each with a block of 32x32 texels.
const ACROSS: u16 = 32;
const WAYS: [(&str, Reconstruction); 2] =
    [("bilinear", Reconstruction::Bilinear), ("bicubic", Reconstruction::Bicubic)];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1).map(|argument| argument.parse::<u32>());
    let side = arguments.next().transpose()?.unwrap_or(512);
    let rounds = arguments.next().transpose()?.unwrap_or(41);
    let bench = Bench::new(side)?;
    let ways = WAYS.map(|(name, reconstruction)| bench.way(name, reconstruction));
    let [bilinear, bicubic] = ways;
    let ways = [bilinear?, bicubic?];
    let mut rows = Vec::new();
    for round in 0..=rounds {
        let ms = [bench.draw(&ways[0])?, bench.draw(&ways[1])?];
        // The first round makes the pipelines.
        rows.extend((round > 0).then_some(ms));
    }
    println!("{}: {side}x{side} pixels, two eyes, four samples, {rounds} rounds", bench.gpu.device_name());
    for (index, (name, _)) in WAYS.into_iter().enumerate() {
        let ms = device::median(rows.iter().map(|row| row[index]));
        let ratio = device::median(rows.iter().map(|row| row[index] / row[0]));
        println!("{name}: {ms:.3} ms, {ratio:.2} times bilinear in the same round (medians)");
    }
    Ok(())
}

struct Bench {
    gpu: Arc<Gpu>,
    _image: Image,
    targets: EyeTargets,
    memory: VertexMemory,
    eyes: [Buffer; FRAMES_IN_FLIGHT],
}

struct Way {
    name: &'static str,
    stage: AtlasDraw,
    bundle: BundleMemory,
    set: BundleSet,
    drawn: Drawable,
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
        gpu.wait(recorder.submit()?)?;
        let eyes = device::eyes_in_clip_space(&gpu)?;
        Ok(Self { gpu, _image: image, targets, memory, eyes })
    }

    fn way(&self, name: &'static str, reconstruction: Reconstruction) -> Result<Way, GpuError> {
        let stage =
            AtlasDraw::new(&self.gpu, &self.targets.pass, Lookup { reconstruction, ..Lookup::default() })?;
        let mut recorder = self.gpu.record()?;
        let patches = u32::from(ACROSS) * u32::from(ACROSS);
        let store = Store::new(&self.gpu, &mut recorder, 0)?;
        let shared = Shared { memory: &self.memory, store: &store, eyes: self.eyes.each_ref() };
        let extent = AtlasExtent::DEFAULT;
        let mut bundle = stage.bundle_memory(&self.gpu, 0, patches, extent, false)?;
        let set = stage.bundle_set(&self.gpu, &mut recorder, &bundle, extent, shared)?;
        self.gpu.wait(recorder.submit()?)?;
        let corners: &mut [CornerGpu] = bytemuck::cast_slice_mut(bundle.corners.bytes_mut());
        let indices: &mut [u32] = bytemuck::cast_slice_mut(bundle.indices.bytes_mut());
        let mut writer = ListWriter::new(corners, indices);
        (0..ACROSS * ACROSS).for_each(|number| writer.write(&patch(number)));
        let drawn = Drawable { opaque: writer.index_count(), ..Drawable::default() };
        Ok(Way { name, stage, bundle, set, drawn })
    }

    /// Milliseconds of the device.
    fn draw(&self, way: &Way) -> Result<f64, GpuError> {
        let mut recorder = self.gpu.record()?;
        recorder.scope(way.name, |r| {
            self.targets.begin(r, 0);
            way.stage.record(r, &way.set, &way.bundle, 0, way.drawn);
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

fn patch(number: u16) -> ResidentPatch {
    let first = u32::from(number) * 4;
    let address = BlockAddress { page: 0, x: number % ACROSS * 32, y: number / ACROSS * 32 };
    ResidentPatch {
        instance: InstanceId(0),
        kind: PatchKind::Two,
        vertices: [0, 1, 2, 3, 0].map(|corner| VertexSlot(first + corner)),
        double_sided: true,
        block: BlockSize::new(5, 5).map(|size| Block { address, size }),
        is_masked: false,
    }
}

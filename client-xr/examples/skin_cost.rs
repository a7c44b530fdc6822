//! Skinning in a pass before the draw, which pulls its positions, against skinning in the vertex shader: the same picture, both ways in
//! turn in each round, as many vertices, patches and bones as `docs/budget.md` counts.
//! `cargo run --release -p shadecast-client --example skin_cost -- [PIXELS A SIDE] [ROUNDS]`

mod device;

use shadecast_client::draw::draw_list::{ListWriter, MAX_CORNERS_PER_PATCH, MAX_INDICES_PER_PATCH};
use shadecast_client::draw::stages::atlas_draw::EyeTargets;
use shadecast_client::draw::stages::settle::Store;
use shadecast_client::draw::stages::upload::{Chroma, PlaneStaging, Planes};
use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc,
    Image, Memory, Sampler, SamplerDesc, vk,
};
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockAddress, BlockSize, PatchKind, PixelTexels};
use shadecast_protocol::ids::{InstanceId, VertexSlot};
use shadecast_protocol::memory::ResidentPatch;
use shadecast_shaders::Shader;
use shadecast_shaders::generated::{
    BENCH_SKIN_VERT, CLIENT_ATLAS_FRAG, CLIENT_ATLAS_VERT, CLIENT_SKIN_COMP, RestGpu, SkinPush,
};
use std::sync::Arc;

/// Strips of patches. Patches of a strip share vertices, strips do not: about two vertices a patch, as dragons have.
const STRIPS: u32 = 212;
const PATCHES_A_STRIP: u32 = 212;
const VERTICES: u32 = STRIPS * 2 * (PATCHES_A_STRIP + 1);
const CORNERS: usize = (STRIPS * PATCHES_A_STRIP) as usize * MAX_CORNERS_PER_PATCH;
const INDICES: usize = (STRIPS * PATCHES_A_STRIP) as usize * MAX_INDICES_PER_PATCH;
const INSTANCES: u32 = 64;
const BONES: u32 = 136;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1).map(|argument| argument.parse::<u32>());
    let side = arguments.next().transpose()?.unwrap_or(128);
    let rounds = arguments.next().transpose()?.unwrap_or(41);
    let bench = Bench::new(side)?;
    let [before, within] = [bench.draw(true)?.1, bench.draw(false)?.1];
    assert!(before.chunks_exact(4).any(|pixel| pixel[..3] != before[..3]), "nothing was drawn");
    let differ = before.iter().zip(&within).filter(|(a, b)| a.abs_diff(**b) > 1).count();
    println!(
        "{}: {VERTICES} vertices in {} patches, {} bones",
        bench.gpu.device_name(),
        STRIPS * PATCHES_A_STRIP,
        INSTANCES * BONES
    );
    println!(
        "{side}x{side} pixels, two eyes, one sample, {rounds} rounds; bytes of the picture that differ: {differ}"
    );
    let mut rows = Vec::new();
    for _ in 0..rounds {
        rows.push([bench.draw(true)?.0, bench.draw(false)?.0]);
    }
    let all = |value: fn(&[f64; 2]) -> f64| device::median(rows.iter().map(value));
    println!("a pass before, and the draw: {:.3} ms (median)", all(|row| row[0]));
    println!(
        "in the vertex shader: {:.3} ms, {:.2} times that in the same round (medians)",
        all(|row| row[1]),
        all(|row| row[1] / row[0])
    );
    Ok(())
}

struct Bench {
    gpu: Arc<Gpu>,
    side: u32,
    image: Image,
    targets: EyeTargets,
    indices: (Buffer, u32),
    skin: (ComputePipeline, BindGroup),
    pulls: (GraphicsPipeline, BindGroup),
    skins: (GraphicsPipeline, BindGroup),
    _kept: (Vec<Buffer>, Planes, Store, Sampler),
}

impl Bench {
    fn new(side: u32) -> Result<Self, GpuError> {
        let one = vk::SampleCountFlags::TYPE_1;
        let (gpu, image, targets) = device::open(side, vk::Format::R8G8B8A8_UNORM, one)?;
        let (mut corners, mut indices) = (vec![bytemuck::Zeroable::zeroed(); CORNERS], vec![0; INDICES]);
        let mut writer = ListWriter::new(&mut corners, &mut indices);
        (0..STRIPS).for_each(|strip| (0..PATCHES_A_STRIP).for_each(|at| writer.write(&patch(strip, at))));
        let index_count = writer.index_count();
        let mut recorder = gpu.record()?;
        let planes = Planes::new(&gpu, &mut recorder, AtlasExtent::DEFAULT, Chroma::Halved)?;
        let mut staging = PlaneStaging::new(&gpu, AtlasExtent::DEFAULT, Chroma::Halved)?;
        let grey: Vec<u8> =
            (0..AtlasExtent::DEFAULT.texels().iter().product()).map(|at: u32| (at >> 3) as u8).collect();
        staging.write([&grey, &grey[..grey.len() / 4], &grey[..grey.len() / 4]]);
        planes.record(&mut recorder, &staging);
        let store = Store::new(&gpu, &mut recorder, 0)?;
        gpu.wait(recorder.submit()?)?;
        let [eyes, ..] = device::eyes_in_clip_space(&gpu)?;
        let sampler = SamplerDesc::clamped(vk::Filter::LINEAR);
        let sampler = Sampler::new(&gpu, sampler)?;
        let local = |name, bytes: &[u8]| Buffer::device_local(&gpu, name, bytes);
        let kept = vec![
            local("corners", bytemuck::cast_slice(&corners))?,
            local("skins", bytemuck::cast_slice(&(0..VERTICES).map(skin).collect::<Vec<_>>()))?,
            local("rests", bytemuck::cast_slice(&(0..VERTICES).map(rest).collect::<Vec<_>>()))?,
            local("palettes", bytemuck::cast_slice(&palettes()))?,
            local("weights", &[0; 16])?,
            local("arena", &[0; 16])?,
            Buffer::new(&gpu, "positions", u64::from(VERTICES) * 16, Memory::Device)?,
            eyes,
        ];
        let names = ["Corners", "Skins", "Rests", "Palettes", "MorphWeights", "Arena", "Positions", "Eyes"];
        let mut binds: Vec<(&str, Bind<'_>)> = names.into_iter().zip(kept.iter().map(Bind::Buffer)).collect();
        let sampled = planes.images.iter().map(|plane| Bind::Sampled(plane, &sampler));
        binds.extend(["luma_plane", "cb_plane", "cr_plane"].into_iter().zip(sampled));
        binds.push(("store", Bind::Sampled(&store.image, &sampler)));
        let compute = ComputePipeline::new(&gpu, &CLIENT_SKIN_COMP)?;
        let skin = BindGroup::of(compute.layout(), &binds)?;
        let drawn = |vertex: &Shader| {
            let desc = GraphicsPipelineDesc {
                cull: vk::CullModeFlags::BACK,
                depth_write: Some(true),
                ..GraphicsPipelineDesc::new(vertex, &CLIENT_ATLAS_FRAG, &targets.pass)
            };
            let pipeline = GraphicsPipeline::new(&gpu, &desc)?;
            let group = BindGroup::of(pipeline.layout(), &binds)?;
            Ok::<_, GpuError>((pipeline, group))
        };
        let (pulls, skins) = (drawn(&CLIENT_ATLAS_VERT)?, drawn(&BENCH_SKIN_VERT)?);
        let indices = (Buffer::device_local(&gpu, "indices", &indices)?, index_count);
        let kept = (kept, planes, store, sampler);
        Ok(Self { gpu, side, image, targets, indices, skin: (compute, skin), pulls, skins, _kept: kept })
    }

    /// Milliseconds of the device, and the left eye's bytes.
    fn draw(&self, is_before: bool) -> Result<(f64, Vec<u8>), GpuError> {
        let mut recorder = self.gpu.record()?;
        recorder.scope("frame", |r| {
            if is_before {
                r.dispatch(
                    &self.skin.0,
                    &self.skin.1,
                    &SkinPush { vertex_count: VERTICES },
                    [VERTICES, 1, 1],
                );
                r.barrier(Access::COMPUTE_WRITE, Access::VERTEX_READ);
            }
            let (pipeline, group) = if is_before { &self.pulls } else { &self.skins };
            self.targets.begin(r, 0);
            r.bind(pipeline, group);
            r.bind_indices(&self.indices.0, 0);
            r.draw_indexed(0, self.indices.1);
            r.end_pass();
        });
        let readback = Buffer::new(&self.gpu, "eye", u64::from(self.side * self.side) * 4, Memory::Readback)?;
        let layouts = [vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL, vk::ImageLayout::TRANSFER_SRC_OPTIMAL];
        recorder.transition(&self.image, layouts, Access::COLOR_WRITE, Access::COPY_READ);
        recorder.read_image(&self.image, 0, &readback, 0);
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        let timings = self.gpu.wait_timed(recorder.submit()?)?;
        Ok((timings.iter().map(|(_, ms)| ms).sum(), readback.bytes().to_vec()))
    }
}

/// Which strip, which of its two rows, and where in it a vertex is.
fn place(vertex: u32) -> [u32; 3] {
    let row = vertex / (PATCHES_A_STRIP + 1);
    [row / 2, row % 2, vertex % (PATCHES_A_STRIP + 1)]
}

fn patch(strip: u32, at: u32) -> ResidentPatch {
    let first = strip * 2 * (PATCHES_A_STRIP + 1) + at;
    let above = first + PATCHES_A_STRIP + 1;
    let number = strip * PATCHES_A_STRIP + at;
    let address = BlockAddress { page: 0, x: (number % 256 * 8) as u16, y: (number / 256 * 8 % 1024) as u16 };
    ResidentPatch {
        instance: InstanceId(0),
        kind: PatchKind::Two,
        vertices: [first, above, above + 1, first + 1, first].map(VertexSlot),
        double_sided: false,
        block: BlockSize::new(3, 3).map(|size| Block { address, size }),
        pixel: PixelTexels::default(),
        is_masked: false,
    }
}

fn instance(vertex: u32) -> u32 {
    place(vertex)[0] * INSTANCES / STRIPS
}

fn skin(vertex: u32) -> [u32; 2] {
    [vertex + 1, instance(vertex) * BONES]
}

/// Four joints that follow each other, as along a limb.
fn rest(vertex: u32) -> RestGpu {
    let [strip, row, at] = place(vertex);
    let x = at as f32 / PATCHES_A_STRIP as f32 * 2.0 - 1.0;
    let y = (strip + row) as f32 / STRIPS as f32 * 2.0 - 1.0;
    let joint = at * (BONES - 4) / PATCHES_A_STRIP;
    let (first, last) = (joint | ((joint + 1) << 16), (joint + 2) | ((joint + 3) << 16));
    let quarter = 0x4000 | 0x3fff << 16;
    RestGpu {
        position_joints: [x.to_bits(), y.to_bits(), 0.5f32.to_bits(), first],
        influences: [last, quarter, quarter, 0],
    }
}

/// Rows of each bone of each instance: all a little aside.
fn palettes() -> Vec<[f32; 4]> {
    let bone = |number: u32| {
        let aside = (number % 7) as f32 * 1e-3;
        [[1.0, 0.0, 0.0, aside], [0.0, 1.0, 0.0, -aside], [0.0, 0.0, 1.0, 0.0]]
    };
    (0..INSTANCES * BONES).flat_map(bone).collect()
}

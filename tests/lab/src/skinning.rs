//! `shadecast-lab skinning`: the three ways of skinning side by side on one device in one run, with the matrix products
//! that each needs, and with the floor that the device's own measured rates set.

use anyhow::Context;
use serde::Serialize;
use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, ComputePipeline, DesktopDevice, Gpu, GpuOptions, Memory, Needs,
};
use shadecast_protocol::time::ServerTime;
use shadecast_scene::animation::sampling::Sampling;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::{Model, Scene};
use shadecast_server::animation::gpu::Animation;
use shadecast_server::scene_gpu::{SceneGpu, SceneOptions};
use shadecast_server::stages::skin::{GROUP, Skinning};
use shadecast_shaders::generated::{BENCH_BLEND_COMP, BenchBlendPush, FrameGpu, PackedVertexGpu, VertexGpu};
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

/// Times measured of every variant and of every rate. The shortest counts, of both alike: others use the machine too, and
/// a ratio of unlike statistics would be theirs.
const REPEATS: usize = 9;
/// Seconds of the scene between two measured times; no two of them are at the same phase of a 4 s clip.
const STEP_S: f64 = 0.137;
/// Bytes copied to measure the copy rate.
const COPY_BYTES: u64 = 64 << 20;
/// Invocations and fetches of each that measure the blend rate.
const BLEND_INVOCATIONS: u32 = 1 << 16;
const BLEND_FETCHES: u32 = 256;
/// Entries of the table that is fetched from: as large as the palettes of a few dragons.
const BLEND_TABLE: u32 = 4096;

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct SkinningReport {
    /// The Vulkan device.
    pub device: String,
    /// The scene as it was asked for.
    pub scene: String,
    /// How clips were sampled.
    pub sampling: String,
    /// Animated instances.
    pub instances: usize,
    /// Their vertices.
    pub vertices: u64,
    /// Their influences (weights above 0).
    pub influences: u64,
    /// The device's rates.
    pub rates: Rates,
    /// By variant.
    pub variants: Vec<VariantReport>,
    /// Time of per-vertex-chain divided by palette's: poses and positions.
    pub chain_over_palette: f64,
    /// Matrix products of per-vertex-chain divided by palette's.
    pub products_chain_over_palette: f64,
}

/// What the device can do at most, measured in the same run.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Rates {
    /// Bytes read and written per second by a buffer copy.
    pub copy_bytes_per_s: f64,
    /// vec4 fetched from a storage buffer at a lane's own place, multiplied and added, per second.
    pub blends_per_s: f64,
}

/// One way of skinning.
#[derive(Clone, Debug, Serialize)]
pub struct VariantReport {
    /// Its name on the command line.
    pub name: String,
    /// Products of two affine matrices for one sample time.
    pub matrix_products: u64,
    /// Local transforms sampled and built for one sample time.
    pub local_transforms: u64,
    /// Matrices weighted and added for one sample time.
    pub blended_matrices: u64,
    /// Shortest milliseconds by stage for one sample time.
    pub stage_ms: BTreeMap<String, f64>,
    /// Sum of palette and skin, positions of one sample time.
    pub position_ms: f64,
    /// The least that positions can take at the measured rates.
    pub floor_ms: f64,
    /// `position_ms / floor_ms`.
    pub over_floor: f64,
    /// Bytes that positions must move.
    pub floor_bytes: u64,
    /// vec4 that positions must fetch or compute.
    pub floor_blends: u64,
}

/// What a scene's animated instances consist of.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    instances: usize,
    vertices: u64,
    influences: u64,
    bones: u64,
    entries: u64,
    /// Sum over all influences of the length of the bone's parent chain, itself included.
    chain_bones: u64,
    packed_vertices: u64,
}

/// Measures all variants on `scene`.
///
/// # Errors
/// The scene, the device.
pub fn measure(source: &SceneSource, sampling: Sampling) -> anyhow::Result<SkinningReport> {
    let options = GpuOptions { needs: Needs::Server, validation: false, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)?;
    let scene = load_scene(source)?;
    let rates = Rates { copy_bytes_per_s: copy_rate(&gpu)?, blends_per_s: blend_rate(&gpu)? };
    let all = [Skinning::PerVertexChain, Skinning::Palette, Skinning::Packed];
    let mut variants = Vec::new();
    let mut counts = Counts::default();
    for skinning in all {
        let options = SceneOptions { sampling, skinning };
        let scene = Arc::new(SceneGpu::new(&gpu, scene.clone(), &options)?);
        counts = Counts::of(&scene);
        variants.push(measure_one(&gpu, &scene, &counts, &rates)?);
    }
    let [chain, palette, _] = &variants[..] else { unreachable!("three variants") };
    Ok(SkinningReport {
        device: gpu.device_name(),
        scene: source.to_string(),
        sampling: sampling.to_string(),
        instances: counts.instances,
        vertices: counts.vertices,
        influences: counts.influences,
        rates,
        chain_over_palette: chain.position_ms / palette.position_ms,
        products_chain_over_palette: chain.matrix_products as f64 / palette.matrix_products as f64,
        variants,
    })
}

fn measure_one(
    gpu: &Arc<Gpu>,
    scene: &Arc<SceneGpu>,
    counts: &Counts,
    rates: &Rates,
) -> anyhow::Result<VariantReport> {
    let mut animation = Animation::new(gpu, scene, 1)?;
    let mut times: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    // The first one also does the static instances, and warms everything up.
    for repeat in 0..=REPEATS {
        let mut recorder = gpu.record()?;
        let time = ServerTime((repeat as f64 * STEP_S * 1e9) as i64);
        animation.record_sample(&mut recorder, 0, time);
        animation.record_frames(&mut recorder, 0, |_| true);
        gpu.wait(recorder.submit()?)?;
        for (stage, ms) in gpu.take_timings_ms() {
            if repeat > 0 {
                times.entry(stage.to_owned()).or_default().push(ms);
            }
        }
    }
    let stage_ms: BTreeMap<String, f64> =
        times.into_iter().map(|(stage, times)| (stage, shortest(&times))).collect();
    let of = |stage: &str| stage_ms.get(stage).copied().unwrap_or(0.0);
    let position_ms = of("palette") + of("skin");
    let skinning = scene.skinning;
    let (floor_bytes, floor_blends) = counts.floor(skinning);
    let by_bytes = floor_bytes as f64 / rates.copy_bytes_per_s;
    let by_blends = floor_blends as f64 / rates.blends_per_s;
    let floor_ms = by_bytes.max(by_blends) * 1e3;
    let is_chain = skinning == Skinning::PerVertexChain;
    Ok(VariantReport {
        name: name_of(skinning),
        matrix_products: if is_chain { counts.chain_bones } else { counts.bones + counts.entries },
        local_transforms: if is_chain { counts.chain_bones } else { counts.bones },
        blended_matrices: counts.influences,
        stage_ms,
        position_ms,
        floor_ms,
        over_floor: position_ms / floor_ms,
        floor_bytes,
        floor_blends,
    })
}

fn name_of(skinning: Skinning) -> String {
    use clap::ValueEnum;
    skinning.to_possible_value().map_or_else(String::new, |value| value.get_name().to_owned())
}

impl Counts {
    fn of(scene: &SceneGpu) -> Self {
        let mut counts = Self::default();
        for (place, instance) in scene.instances.iter().zip(&scene.scene.instances) {
            if place.is_animated {
                counts.add(&scene.scene, instance.model);
            }
        }
        counts
    }

    fn add(&mut self, scene: &Scene, model: usize) {
        let model = &scene.models[model];
        let depths = depths(model);
        let mut by_count = [0u64; 5];
        for vertex in &model.vertices {
            let used = vertex.joints.iter().zip(vertex.weights).filter(|(_, weight)| *weight > 0.0);
            let chains = used.map(|(joint, _)| depths[model.palette[usize::from(*joint)].bone as usize]);
            let lengths: Vec<u64> = chains.collect();
            by_count[lengths.len()] += 1;
            self.influences += lengths.len() as u64;
            self.chain_bones += lengths.iter().sum::<u64>();
        }
        self.instances += 1;
        self.vertices += model.vertices.len() as u64;
        self.bones += model.bones.len() as u64;
        self.entries += model.palette.len() as u64;
        self.packed_vertices +=
            by_count.iter().map(|count| count.next_multiple_of(u64::from(GROUP))).sum::<u64>();
    }

    /// Bytes and blends that positions of one sample time cannot do without.
    ///
    /// Bytes: what a vertex is read from, once, and the 16 that are written. Blends: three rows for each influence, the
    /// vec4 of the vertex that are read, three for each of the two transforms, and one that is written; for the
    /// chain, 16 for each bone of a chain (nine of key values, three of a product, four of the matrix) instead of three.
    fn floor(&self, skinning: Skinning) -> (u64, u64) {
        const TRANSFORMS: u64 = 7;
        let written = 16 * self.vertices;
        let whole = 56 * self.vertices; // position, weights, joints, morphs
        match skinning {
            Skinning::PerVertexChain => {
                (written + whole, 16 * self.chain_bones + (4 + TRANSFORMS) * self.vertices)
            }
            Skinning::Palette => (written + whole, 3 * self.influences + (4 + TRANSFORMS) * self.vertices),
            Skinning::Packed => {
                let packed = size_of::<PackedVertexGpu>() as u64 * self.packed_vertices;
                (written + packed, 3 * self.influences + (2 + TRANSFORMS) * self.vertices)
            }
        }
    }
}

/// Length of each bone's parent chain, itself included.
fn depths(model: &Model) -> Vec<u64> {
    let mut depths: Vec<u64> = Vec::with_capacity(model.bones.len());
    for bone in &model.bones {
        depths.push(1 + bone.parent.map_or(0, |parent| depths[parent as usize]));
    }
    depths
}

fn shortest(times: &[f64]) -> f64 {
    times.iter().copied().fold(f64::INFINITY, f64::min)
}

fn copy_rate(gpu: &Arc<Gpu>) -> anyhow::Result<f64> {
    let buffer = |name| Buffer::new(gpu, name, COPY_BYTES, Memory::Device);
    let (from, to) = (buffer("copied from")?, buffer("copied to")?);
    let ms = timed(gpu, |recorder| recorder.copy_buffer(&from, 0, &to, 0, COPY_BYTES))?;
    Ok(2.0 * COPY_BYTES as f64 / (ms * 1e-3))
}

fn blend_rate(gpu: &Arc<Gpu>) -> anyhow::Result<f64> {
    let pipeline = ComputePipeline::new(gpu, &BENCH_BLEND_COMP)?;
    let table = Buffer::device_local(gpu, "table", &vec![[0.5f32; 4]; BLEND_TABLE as usize])?;
    let sums = Buffer::new(gpu, "sums", u64::from(BLEND_INVOCATIONS) * 16, Memory::Device)?;
    let binds = [("Table", Bind::Buffer(&table)), ("Sums", Bind::Buffer(&sums))];
    let group = BindGroup::new(pipeline.layout(), &binds)?;
    let push = BenchBlendPush { fetches: BLEND_FETCHES, mask: BLEND_TABLE - 1 };
    let ms = timed(gpu, |recorder| {
        recorder.dispatch(&pipeline, &group, &push, [BLEND_INVOCATIONS / 64, 1, 1]);
    })?;
    Ok(f64::from(BLEND_INVOCATIONS) * f64::from(BLEND_FETCHES) / (ms * 1e-3))
}

/// Shortest of a few runs in milliseconds.
fn timed(gpu: &Arc<Gpu>, record: impl Fn(&mut shadecast_gpu::Recorder)) -> anyhow::Result<f64> {
    let mut best = f64::INFINITY;
    for _ in 0..REPEATS {
        gpu.take_timings_ms();
        let mut recorder = gpu.record()?;
        recorder.scope("rate", |r| record(r));
        recorder.barrier(Access::COMPUTE, Access::COMPUTE);
        gpu.wait(recorder.submit()?)?;
        let times = gpu.take_timings_ms();
        let (_, ms) =
            times.iter().find(|(name, _)| *name == "rate").context("the device has no timestamps")?;
        best = best.min(*ms);
    }
    Ok(best)
}

/// Sizes of the records that floors are computed from.
const _: () = assert!(size_of::<VertexGpu>() >= 56 && size_of::<FrameGpu>() == 32);

impl fmt::Display for SkinningReport {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(out, "{}: {}, {}", self.device, self.scene, self.sampling)?;
        writeln!(
            out,
            "{} animated instances, {} vertices, {:.2} influences a vertex",
            self.instances,
            self.vertices,
            self.influences as f64 / self.vertices.max(1) as f64
        )?;
        writeln!(
            out,
            "rates: copy {:.1} GB/s, {:.0} million vec4 fetched and blended a second",
            self.rates.copy_bytes_per_s * 1e-9,
            self.rates.blends_per_s * 1e-6
        )?;
        writeln!(
            out,
            "{:<17} {:>12} {:>10} {:>9} {:>9} {:>11}",
            "", "products", "blends", "ms", "floor", "over floor"
        )?;
        for v in &self.variants {
            writeln!(
                out,
                "{:<17} {:>12} {:>10} {:>9.3} {:>9.3} {:>10.2}x",
                v.name, v.matrix_products, v.blended_matrices, v.position_ms, v.floor_ms, v.over_floor
            )?;
        }
        write!(
            out,
            "per-vertex-chain takes {:.1}x as long as palette, with {:.0}x the matrix products",
            self.chain_over_palette, self.products_chain_over_palette
        )
    }
}

//! `shadecast-lab skinning`: the three ways of skinning side by side on one device in one run, with the matrix products of
//! each, and with the floor of the device's own measured rates.

use crate::measure::percentiles::median;
use anyhow::Context;
use serde::Serialize;
use shadecast_gpu::{
    Access, Bind, BindGroup, Buffer, ComputePipeline, DesktopDevice, Gpu, GpuOptions, Memory, Needs,
};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::sampling::Sampling;
use shadecast_scene::load::{SceneSource, load_scene};
use shadecast_scene::{Model, Scene};
use shadecast_server::scene::skins::Skinning;
use shadecast_server::scene::{SceneGpu, SceneOptions};
use shadecast_server::skinning::gpu::Animation;
use shadecast_server::time::RingPlace;
use shadecast_shaders::generated::{BENCH_FETCH_COMP, BenchFetchPush};
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

/// Rounds. In each one every rate and every variant is measured, one after the other: a machine that is shared changes its
/// speed by a factor of two for seconds, so only ratios within a round mean something. Their median is reported.
const ROUNDS: usize = 41;
/// Seconds of the scene between two rounds; no two of them are at the same phase of a 4 s clip.
const STEP_S: f64 = 0.137;
/// Bytes copied to measure the copy rate.
const COPY_BYTES: u64 = 64 << 20;
/// Invocations that measure the fetch rate, and fetches of each: about as many as a vertex needs, so that the rate holds what
/// starting an invocation costs.
const FETCH_INVOCATIONS: u32 = 1 << 18;
const FETCHES: u32 = 8;
/// Entries of the table that is fetched from: as large as the palettes of a few dragons.
const FETCH_TABLE: u32 = 4096;

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
    /// Time of per-vertex-chain divided by palette's, poses and positions; median of the rounds.
    pub chain_over_palette: f64,
    /// Matrix products of per-vertex-chain divided by palette's.
    pub products_chain_over_palette: f64,
}

/// What the device can do at most, medians of the same rounds.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Rates {
    /// Bytes read and written per second by a buffer copy.
    pub copy_bytes_per_s: f64,
    /// vec4 fetched from a storage buffer at a lane's own place, multiplied and added, per second.
    pub fetches_per_s: f64,
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
    /// By stage for one sample time.
    pub stages: BTreeMap<String, StageReport>,
    /// All stages.
    pub all: StageReport,
    /// Milliseconds of palette and skin, positions of one sample time.
    pub position_ms: f64,
}

/// A stage, or several, for one sample time.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct StageReport {
    /// Median.
    pub ms: f64,
    /// The least that it can take at the rates of its round; median.
    pub floor_ms: f64,
    /// Time divided by the floor of its round; median.
    pub over_floor: f64,
    /// The least that it can take at the round's plain copy rate alone, whatever invocations cost; median.
    pub copy_floor_ms: f64,
    /// Time divided by that; median. `None` where nothing has to be copied.
    pub over_copy_floor: Option<f64>,
    /// Bytes that cannot but be moved.
    pub floor_bytes: u64,
    /// vec4 that cannot but be fetched or stored, four scalars for one.
    pub floor_fetches: u64,
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
}

/// Measures all variants on `scene`.
///
/// # Errors
/// The scene, the device.
pub fn measure(source: &SceneSource, sampling: Sampling) -> anyhow::Result<SkinningReport> {
    let options = GpuOptions { needs: Needs::Server, validation: false, device_name: None };
    let gpu = Gpu::open(&options, &DesktopDevice)?;
    let scene = load_scene(source)?;
    let rates = RateBench::new(&gpu)?;
    let mut variants = Vec::new();
    for skinning in [Skinning::PerVertexChain, Skinning::Palette, Skinning::Packed] {
        let options = SceneOptions { sampling, skinning, ..SceneOptions::default() };
        variants.push(Variant::new(&gpu, Arc::new(SceneGpu::new(&gpu, scene.clone(), &options)?))?);
    }
    let mut rates_of_rounds = Vec::new();
    // The first round also does the static instances, and warms everything up.
    for round in 0..=ROUNDS {
        let measured = rates.measure(&gpu)?;
        for variant in &mut variants {
            variant.measure(&gpu, round as f64 * STEP_S, &measured)?;
        }
        rates_of_rounds.push(measured);
    }
    for variant in &mut variants {
        variant.rounds.remove(0);
    }
    let [chain, palette, packed] = &variants[..] else { unreachable!("three variants") };
    let ratio = |round: usize| chain.rounds[round].position_ms() / palette.rounds[round].position_ms();
    let reports = [chain, palette, packed].map(Variant::report);
    let counts = Counts::of(&palette.scene);
    Ok(SkinningReport {
        device: gpu.device_name(),
        scene: source.to_string(),
        sampling: sampling.to_string(),
        instances: counts.instances,
        vertices: counts.vertices,
        influences: counts.influences,
        rates: Rates {
            copy_bytes_per_s: median(rates_of_rounds.iter().map(|rates| rates.copy_bytes_per_s)),
            fetches_per_s: median(rates_of_rounds.iter().map(|rates| rates.fetches_per_s)),
        },
        chain_over_palette: median((0..ROUNDS).map(ratio)),
        products_chain_over_palette: reports[0].matrix_products as f64 / reports[1].matrix_products as f64,
        variants: reports.to_vec(),
    })
}

/// A way of skinning with what was measured of it.
struct Variant {
    scene: Arc<SceneGpu>,
    animation: Animation,
    floors: BTreeMap<&'static str, Floor>,
    rounds: Vec<Round>,
}

/// Milliseconds of each stage and its floors at the rates of the round.
#[derive(Clone, Debug, Default)]
struct Round {
    stages: BTreeMap<&'static str, Measured>,
}

/// Milliseconds.
#[derive(Clone, Copy, Debug, Default)]
struct Measured {
    took: f64,
    floor: f64,
    copy_floor: f64,
}

impl Round {
    fn position_ms(&self) -> f64 {
        let of = |stage: &str| self.stages.get(stage).map_or(0.0, |stage| stage.took);
        of("palette") + of("skin")
    }

    /// Time and floors of the stages that `is_wanted` names.
    fn sum(&self, is_wanted: impl Fn(&str) -> bool) -> Measured {
        let wanted = self.stages.iter().filter(|(stage, _)| is_wanted(stage));
        wanted.fold(Measured::default(), |sum, (_, stage)| Measured {
            took: sum.took + stage.took,
            floor: sum.floor + stage.floor,
            copy_floor: sum.copy_floor + stage.copy_floor,
        })
    }
}

impl Variant {
    fn new(gpu: &Arc<Gpu>, scene: Arc<SceneGpu>) -> anyhow::Result<Self> {
        let animation = Animation::new(gpu, &scene, 1)?;
        let floors = Counts::of(&scene).floors(scene.skinning);
        Ok(Self { scene, animation, floors, rounds: Vec::new() })
    }

    fn measure(&mut self, gpu: &Arc<Gpu>, time_s: f64, rates: &Rates) -> anyhow::Result<()> {
        let mut recorder = gpu.record()?;
        self.animation.record_sample(&mut recorder, RingPlace(0), WorldTime((time_s * 1e9) as i64));
        self.animation.record_tangents(&mut recorder, RingPlace(0), |_| true);
        let timings = gpu.wait_timed(recorder.submit()?)?;
        let mut round = Round::default();
        for (stage, ms) in timings.iter() {
            if let Some(floor) = self.floors.get(stage) {
                let copy_floor = floor.copy_ms(rates);
                round.stages.insert(stage, Measured { took: ms, floor: floor.ms(rates), copy_floor });
            }
        }
        self.rounds.push(round);
        Ok(())
    }

    fn report(&self) -> VariantReport {
        let skinning = self.scene.skinning;
        let counts = Counts::of(&self.scene);
        let is_chain = skinning == Skinning::PerVertexChain;
        let one = |stage: &&'static str| ((*stage).to_owned(), self.stage(|name| name == *stage));
        VariantReport {
            name: name_of(skinning),
            matrix_products: if is_chain { counts.chain_bones } else { counts.bones + counts.entries },
            local_transforms: if is_chain { counts.chain_bones } else { counts.bones },
            blended_matrices: counts.influences,
            stages: self.floors.keys().map(one).collect(),
            all: self.stage(|_| true),
            position_ms: median(self.rounds.iter().map(Round::position_ms)),
        }
    }

    fn stage(&self, is_wanted: impl Fn(&str) -> bool) -> StageReport {
        let of =
            |value: fn(Measured) -> f64| median(self.rounds.iter().map(|round| value(round.sum(&is_wanted))));
        let floors = self.floors.iter().filter(|(stage, _)| is_wanted(stage)).map(|(_, floor)| floor);
        let (bytes, scalars) = floors.fold((0, 0), |sum, f| (sum.0 + f.bytes, sum.1 + f.scalars));
        StageReport {
            ms: of(|stage| stage.took),
            floor_ms: of(|stage| stage.floor),
            over_floor: of(|stage| stage.took / stage.floor),
            copy_floor_ms: of(|stage| stage.copy_floor),
            over_copy_floor: (bytes > 0).then(|| of(|stage| stage.took / stage.copy_floor)),
            floor_bytes: bytes,
            floor_fetches: scalars / 4,
        }
    }
}

fn name_of(skinning: Skinning) -> String {
    skinning.name().to_owned()
}

impl Counts {
    fn of(scene: &SceneGpu) -> Self {
        let mut counts = Self::default();
        for (place, instance) in scene.numbering.instances.iter().zip(&scene.scene.instances) {
            if place.is_animated {
                counts.add(&scene.scene, instance.model);
            }
        }
        counts
    }

    fn add(&mut self, scene: &Scene, model: usize) {
        let model = &scene.models[model];
        let depths = depths(model);
        for vertex in &model.vertices {
            let used = vertex.joints.iter().zip(vertex.weights).filter(|(_, weight)| *weight > 0.0);
            let chains = used.map(|(joint, _)| depths[model.palette[usize::from(*joint)].bone as usize]);
            let lengths: Vec<u64> = chains.collect();
            self.influences += lengths.len() as u64;
            self.chain_bones += lengths.iter().sum::<u64>();
        }
        self.instances += 1;
        self.vertices += model.vertices.len() as u64;
        self.bones += model.bones.len() as u64;
        self.entries += model.palette.len() as u64;
    }

    /// What the stages of one sample time cannot do without: each member that a vertex is made from is read once, each
    /// influence's matrix once, and what comes out is written once. Nothing is counted for arithmetic, for finding out
    /// what to do, or for members that are read beside those wanted.
    fn floors(&self, skinning: Skinning) -> BTreeMap<&'static str, Floor> {
        const MATRIX: u64 = 12;
        const INFLUENCES: u64 = 4 + 2 + 1; // weights, joints, the vertex's number
        const PACKED: u64 = 2 + 2 + 1; // weights, joints, the vertex's number
        const POSITION: u64 = 3 + 2; // read, written packed
        const FRAME: u64 = 3 + 4 + 2; // normal and tangent read, both written packed
        const KEYS: u64 = 3 + 4 + 3; // of one key, translation, rotation, scale
        let vertices = |scalars: u64| scalars * self.vertices;
        let blends = MATRIX * self.influences;
        // A bone's matrix is written and read by a child; an entry's is made from two.
        let palette = (KEYS + 2 * MATRIX) * self.bones + 3 * MATRIX * self.entries;
        let chain = (KEYS + 1) * self.chain_bones;
        // Matrices of bones and keys are few and stay in a cache: of these, only fetches count.
        let stage = |streamed: u64, cached: u64| Floor { bytes: 4 * streamed, scalars: streamed + cached };
        let (position, frame) = (vertices(INFLUENCES + POSITION), vertices(INFLUENCES + FRAME));
        let stages = match skinning {
            Skinning::PerVertexChain => {
                vec![("skin", stage(position, chain)), ("skin frames", stage(frame, chain))]
            }
            Skinning::Palette => vec![
                ("palette", stage(0, palette)),
                ("skin", stage(position, blends)),
                ("skin frames", stage(frame, blends)),
            ],
            Skinning::Packed => vec![
                ("palette", stage(0, palette)),
                ("skin", stage(vertices(PACKED + POSITION), blends)),
                ("skin frames", stage(vertices(PACKED + FRAME), blends)),
            ],
        };
        stages.into_iter().collect()
    }
}

/// What a stage cannot do without.
#[derive(Clone, Copy, Debug)]
struct Floor {
    /// Bytes from and to memory.
    bytes: u64,
    /// Numbers fetched from and stored to buffers.
    scalars: u64,
}

impl Floor {
    fn ms(&self, rates: &Rates) -> f64 {
        let by_fetches = self.scalars as f64 / 4.0 / rates.fetches_per_s;
        self.copy_ms(rates).max(by_fetches * 1e3)
    }

    fn copy_ms(&self, rates: &Rates) -> f64 {
        self.bytes as f64 / rates.copy_bytes_per_s * 1e3
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

/// What measures the device's rates.
struct RateBench {
    from: Buffer,
    to: Buffer,
    pipeline: ComputePipeline,
    group: BindGroup,
    _table: Buffer,
    _sums: Buffer,
}

impl RateBench {
    fn new(gpu: &Arc<Gpu>) -> anyhow::Result<Self> {
        let buffer = |name, bytes| Buffer::new(gpu, name, bytes, Memory::Device);
        let pipeline = ComputePipeline::new(gpu, &BENCH_FETCH_COMP)?;
        let table = Buffer::device_local(gpu, "table", &vec![[0.5f32; 4]; FETCH_TABLE as usize])?;
        let sums = buffer("sums", u64::from(FETCH_INVOCATIONS) * 16)?;
        let binds = [("Table", Bind::Buffer(&table)), ("Sums", Bind::Buffer(&sums))];
        let group = BindGroup::new(pipeline.layout(), &binds)?;
        let (from, to) = (buffer("copied from", COPY_BYTES)?, buffer("copied to", COPY_BYTES)?);
        Ok(Self { from, to, pipeline, group, _table: table, _sums: sums })
    }

    fn measure(&self, gpu: &Arc<Gpu>) -> anyhow::Result<Rates> {
        let push = BenchFetchPush { fetches: FETCHES, mask: FETCH_TABLE - 1 };
        let mut recorder = gpu.record()?;
        recorder.scope("copy", |r| r.copy_buffer(&self.from, 0, &self.to, 0, COPY_BYTES));
        recorder.barrier(Access::COMPUTE, Access::COMPUTE);
        recorder.scope("fetch", |r| {
            r.dispatch(&self.pipeline, &self.group, &push, [FETCH_INVOCATIONS, 1, 1]);
        });
        let times: BTreeMap<_, _> = gpu.wait_timed(recorder.submit()?)?.iter().collect();
        let seconds =
            |scope: &str| times.get(scope).map(|ms| ms * 1e-3).context("the device has no timestamps");
        Ok(Rates {
            copy_bytes_per_s: 2.0 * COPY_BYTES as f64 / seconds("copy")?,
            fetches_per_s: f64::from(FETCH_INVOCATIONS) * f64::from(FETCHES + 1) / seconds("fetch")?,
        })
    }
}

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
            "rates: copy {:.1} GB/s, {:.0} million vec4 fetched a second",
            self.rates.copy_bytes_per_s * 1e-9,
            self.rates.fetches_per_s * 1e-6
        )?;
        writeln!(
            out,
            "{:<17} {:<12} {:>10} {:>9} {:>9} {:>9} {:>11} {:>11} {:>10}",
            "", "", "products", "blends", "ms", "floor", "over floor", "copy floor", "over it"
        )?;
        for v in &self.variants {
            let (name, products, blends) = (&v.name, v.matrix_products, v.blended_matrices);
            write!(out, "{name:<17} {:<12} {products:>10} {blends:>9} ", "all")?;
            writeln!(out, "{}", v.all)?;
            for (stage, report) in &v.stages {
                writeln!(out, "{:<17} {stage:<12} {:>10} {:>9} {report}", "", "", "")?;
            }
        }
        write!(
            out,
            "positions by per-vertex-chain take {:.1}x as long as by palette, with {:.0}x the matrix products",
            self.chain_over_palette, self.products_chain_over_palette
        )
    }
}

impl fmt::Display for StageReport {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{:>9.3} {:>9.3} {:>10.2}x", self.ms, self.floor_ms, self.over_floor)?;
        match self.over_copy_floor {
            Some(over) => write!(out, " {:>11.3} {over:>9.2}x", self.copy_floor_ms),
            None => write!(out, " {:>11} {:>10}", "-", "-"),
        }
    }
}

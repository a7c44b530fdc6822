//! `shadecast-server inspect`: what is in a scene and what it takes, without a GPU. The report is a value; text and
//! JSON are two ways to print it. `docs/inspect.md` says what each key means.

pub mod errors;
mod memory;
mod table;

use crate::arguments::SamplingArgs;
use clap::{Args, Subcommand};
use serde::Serialize;
use shadecast_protocol::text::printable;
use shadecast_scene::animation::sampling::{self, Sampling};
use shadecast_scene::cache::Cache;
use shadecast_scene::identity::{mesh_hash, texture_hash};
use shadecast_scene::load::{SceneSource, load_scene_with};
use shadecast_scene::patches::PatchReport;
use shadecast_scene::process::Loading;
use shadecast_scene::{Model, Scene, Texture, mips};
use shadecast_server::animation::manager::AnimationManager;
use shadecast_server::animation::packing::SAVED_BYTES;
use shadecast_server::animation::saved::{InstanceVertices, Saved};
use shadecast_server::skinning::passes::palette::BONE_BYTES;
use shadecast_shaders::generated::{MaterialGpu, MorphDeltaGpu, PatchGpu, PoseGpu, VertexGpu};
use std::collections::HashSet;
use std::sync::{Arc, Mutex};
use table::{Table, bytes};
use tracing::field::{Field, Visit};
use tracing_subscriber::layer::{Context, Layer, SubscriberExt};

/// `inspect SCENE` and `inspect error SCENE`.
#[derive(Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct InspectArgs {
    #[command(subcommand)]
    inspection: Option<Inspection>,
    #[command(flatten)]
    contents: ContentsArgs,
}

#[derive(Subcommand)]
enum Inspection {
    /// How far sampled clips and the client's interpolation are from the original curves
    Error(errors::ErrorArgs),
    /// What a scene and one viewer hold on the device and of the host, measured
    Memory(memory::MemoryArgs),
}

#[derive(Args)]
struct ContentsArgs {
    /// courtyard, dragons:N, a .glb/.gltf/.fbx file, or a scene .toml
    #[arg(required = true)]
    scene: Option<String>,
    /// JSON, as docs/inspect.md describes it, instead of text
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    sampling: SamplingArgs,
}

/// Runs the command; returns what it prints.
///
/// # Errors
/// The scene cannot be loaded, or an argument is out of its range.
pub fn run(args: &InspectArgs) -> anyhow::Result<String> {
    match &args.inspection {
        Some(Inspection::Error(args)) => return errors::run(args),
        Some(Inspection::Memory(args)) => return memory::run(args),
        None => {}
    }
    let args = &args.contents;
    let (scene, warnings) = load(args.scene.as_deref().unwrap_or_default())?;
    let report = Report::new(&scene, args.sampling.sampling, warnings);
    Ok(if args.json { serde_json::to_string_pretty(&report)? + "\n" } else { report.text() })
}

/// A scene, and the warnings that loading it gave.
fn load(argument: &str) -> anyhow::Result<(Scene, Vec<String>)> {
    let source = argument.parse::<SceneSource>()?;
    let collector = Collector::default();
    let subscriber = tracing_subscriber::registry().with(collector.clone());
    let scene = tracing::subscriber::with_default(subscriber, || {
        load_scene_with(&source, &Loading::complete(Cache::of_user()))
    })?;
    let warnings = collector.0.lock().expect("no panic while loading").clone();
    Ok((scene, warnings))
}

/// Keeps the texts of warnings.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Vec<String>>>);

impl<S: tracing::Subscriber> Layer<S> for Collector {
    fn on_event(&self, event: &tracing::Event<'_>, _: Context<'_, S>) {
        if *event.metadata().level() <= tracing::Level::WARN {
            let mut message = Message::default();
            event.record(&mut message);
            self.0.lock().expect("no panic while loading").push(message.0);
        }
    }
}

#[derive(Default)]
struct Message(String);

impl Visit for Message {
    fn record_debug(&mut self, field: &Field, value: &dyn std::fmt::Debug) {
        if field.name() == "message" {
            self.0 = format!("{value:?}");
        }
    }
}

/// What is in a scene.
#[derive(Serialize)]
pub struct Report {
    sampling: String,
    instances: usize,
    models: Vec<ModelReport>,
    lights: Vec<String>,
    cameras: Vec<String>,
    head_paths: Vec<String>,
    memory: Vec<MemoryPart>,
    memory_shared_bytes: u64,
    memory_instances_bytes: u64,
    warnings: Vec<String>,
}

#[derive(Serialize)]
struct ModelReport {
    name: String,
    instances: usize,
    vertices: usize,
    triangles: usize,
    bones: usize,
    palette_entries: usize,
    morphs: usize,
    clips: Vec<ClipReport>,
    lods: Vec<LodReport>,
    patches: PatchesReport,
    materials: Vec<String>,
    textures: Vec<TextureReport>,
    lights: Vec<String>,
}

#[derive(Serialize)]
struct ClipReport {
    name: String,
    duration_s: f32,
    source_curves: usize,
    source_keys: usize,
    sampled_keys: usize,
    sampled_bytes: usize,
    sampled_curves_step: usize,
    sampled_curves_linear: usize,
    sampled_curves_cubic: usize,
    sampled_curves_constant: usize,
}

#[derive(Serialize)]
struct LodReport {
    triangles: usize,
    error_m: f32,
    patches: PatchesReport,
}

#[derive(Default, Serialize)]
struct PatchesReport {
    single: usize,
    pairs: usize,
    triples: usize,
    single_share: f32,
    pairs_share: f32,
    triples_share: f32,
    triangles_per_patch: f32,
    wasted_share: f32,
    mean_stretch: f32,
    worst_stretch: f32,
}

#[derive(Serialize)]
struct TextureReport {
    name: String,
    width: u32,
    height: u32,
    srgb: bool,
    bytes: u64,
}

#[derive(Serialize)]
struct MemoryPart {
    part: &'static str,
    /// Bytes that do not grow with the number of instances, or those that do.
    shared: bool,
    bytes: u64,
}

impl Report {
    /// Inspects a scene; clips are sampled to count their keys.
    pub fn new(scene: &Scene, sampling: Sampling, warnings: Vec<String>) -> Self {
        let models = (0..scene.models.len()).map(|index| ModelReport::new(scene, index, sampling)).collect();
        let memory = memory(scene, sampling);
        let sum = |shared: bool| memory.iter().filter(|p| p.shared == shared).map(|part| part.bytes).sum();
        Self {
            sampling: sampling.to_string(),
            instances: scene.instances.len(),
            models,
            lights: scene.lights.iter().map(|placed| printable(&placed.light.name)).collect(),
            cameras: scene.cameras.iter().map(|camera| printable(&camera.name)).collect(),
            head_paths: scene.head_paths.iter().map(|path| printable(&path.name)).collect(),
            memory_shared_bytes: sum(true),
            memory_instances_bytes: sum(false),
            memory,
            warnings,
        }
    }

    fn text(&self) -> String {
        let mut text = format!("{} instances of {} models\n", self.instances, self.models.len());
        self.models.iter().for_each(|model| text += &model.text());
        for (what, names) in
            [("lights", &self.lights), ("cameras", &self.cameras), ("head paths", &self.head_paths)]
        {
            text += &named(what, names);
        }
        text += "\nmemory on the GPU, bytes\n";
        let mut table = Table::new(&["part", "shared", "per instances"]);
        for part in &self.memory {
            let cells = if part.shared {
                [bytes(part.bytes), String::new()]
            } else {
                [String::new(), bytes(part.bytes)]
            };
            table.row(part.part, cells);
        }
        table.row("together", [bytes(self.memory_shared_bytes), bytes(self.memory_instances_bytes)]);
        text += &table.text();
        self.warnings.iter().for_each(|warning| text += &format!("warning: {warning}\n"));
        text
    }
}

fn named(what: &str, names: &[String]) -> String {
    if names.is_empty() { String::new() } else { format!("{what}: {}\n", names.join(", ")) }
}

impl PatchesReport {
    fn new(model: &Model, level: usize) -> Self {
        let report = model.patches_of(level).report(&model.vertices);
        let [single, pairs, triples] = report.count_by_kind;
        let all = (single + pairs + triples).max(1) as f32;
        let [single_share, pairs_share, triples_share] = report.count_by_kind.map(|count| count as f32 / all);
        let PatchReport { triangles_per_patch, wasted_share, mean_stretch, worst_stretch, .. } = report;
        Self {
            single,
            pairs,
            triples,
            single_share,
            pairs_share,
            triples_share,
            triangles_per_patch,
            wasted_share,
            mean_stretch,
            worst_stretch,
        }
    }

    fn text(&self) -> String {
        let Self { single, pairs, triples, .. } = self;
        let percent = |share: f32| format!("{:.1} %", 100.0 * share);
        format!(
            "{single} of one triangle ({}), {pairs} of two ({}), {triples} of three ({}), {:.2} triangles each; {} of the area wasted, stretch {:.2}, at worst {:.2}",
            percent(self.single_share),
            percent(self.pairs_share),
            percent(self.triples_share),
            self.triangles_per_patch,
            percent(self.wasted_share),
            self.mean_stretch,
            self.worst_stretch
        )
    }
}

impl ModelReport {
    fn new(scene: &Scene, index: usize, sampling: Sampling) -> Self {
        let model = &scene.models[index];
        let own = sampling.in_model(sampling::world_scale(scene, index));
        let lod = |(level, lod): (usize, &shadecast_scene::Lod)| LodReport {
            triangles: lod.indices.len() / 3,
            error_m: lod.error_m,
            patches: PatchesReport::new(model, level + 1),
        };
        Self {
            name: printable(&model.name),
            instances: scene.instances.iter().filter(|instance| instance.model == index).count(),
            vertices: model.vertices.len(),
            triangles: model.indices.len() / 3,
            bones: model.bones.len(),
            palette_entries: model.palette.len(),
            morphs: model.morphs.len(),
            clips: (0..model.clips.len()).map(|clip| ClipReport::new(model, clip, own)).collect(),
            lods: model.lods.iter().enumerate().map(lod).collect(),
            patches: PatchesReport::new(model, 0),
            materials: model.materials.iter().map(|material| material.name.clone()).collect(),
            textures: model.textures.iter().map(TextureReport::new).collect(),
            lights: model.lights.iter().map(|placed| placed.light.name.clone()).collect(),
        }
    }

    fn text(&self) -> String {
        let mut text = format!(
            "\n{}: {} instances, {} vertices, {} triangles, {} bones, {} palette entries, {} morph targets\n",
            self.name,
            self.instances,
            self.vertices,
            self.triangles,
            self.bones,
            self.palette_entries,
            self.morphs
        );
        text += &format!("  patches: {}\n", self.patches.text());
        for (level, lod) in (1..).zip(&self.lods) {
            let LodReport { triangles, error_m, patches } = lod;
            let patches = patches.text();
            text += &format!(
                "  level {level}: {triangles} triangles, {:.2} mm; patches: {patches}\n",
                error_m * 1e3
            );
        }
        for texture in &self.textures {
            let TextureReport { name, width, height, bytes: size, .. } = texture;
            text += &format!("  texture {name}: {width}x{height}, {} bytes\n", bytes(*size));
        }
        text += &format!("  {}", named("materials", &self.materials));
        text += if self.materials.is_empty() { "\n" } else { "" };
        text += &named("  lights", &self.lights);
        if !self.clips.is_empty() {
            let heads = [
                "  clip",
                "seconds",
                "source curves",
                "source keys",
                "keys",
                "bytes",
                "constant",
                "step",
                "linear",
                "cubic",
            ];
            let mut table = Table::new(&heads);
            self.clips.iter().for_each(|clip| clip.add_to(&mut table));
            text += &table.text();
        }
        text
    }
}

impl ClipReport {
    fn new(model: &Model, index: usize, sampling: Sampling) -> Self {
        use sampling::KeyInterpolation::{Cubic, Linear, Step};
        let clip = &model.clips[index];
        let sampled = sampling::sample(model, Some(index), sampling);
        let count = |kind| sampled.tracks().filter(|t| !t.is_constant() && t.interpolation == kind).count();
        let morph_curves: usize = clip.morph_tracks.iter().map(|track| track.morph_count as usize).sum();
        let morph_keys =
            clip.morph_tracks.iter().map(|track| track.morph_count as usize * track.times_s.len());
        Self {
            name: clip.name.clone(),
            duration_s: clip.duration_s,
            source_curves: clip.tracks.len() + morph_curves,
            source_keys: clip.tracks.iter().map(|track| track.times_s.len()).chain(morph_keys).sum(),
            sampled_keys: sampled.key_count(),
            sampled_bytes: sampled.byte_count(),
            sampled_curves_step: count(Step),
            sampled_curves_linear: count(Linear),
            sampled_curves_cubic: count(Cubic),
            sampled_curves_constant: sampled.tracks().filter(|track| track.is_constant()).count(),
        }
    }

    fn add_to(&self, table: &mut Table) {
        let counts = [
            self.source_curves,
            self.source_keys,
            self.sampled_keys,
            self.sampled_bytes,
            self.sampled_curves_constant,
            self.sampled_curves_step,
            self.sampled_curves_linear,
            self.sampled_curves_cubic,
        ];
        let cells = std::iter::once(format!("{:.3}", self.duration_s)).chain(counts.map(|n| n.to_string()));
        table.row(&format!("  {}", self.name), cells);
    }
}

impl TextureReport {
    fn new(texture: &Texture) -> Self {
        let [width, height] = texture.extent_texels;
        Self { name: texture.name.clone(), width, height, srgb: texture.srgb, bytes: texture_bytes(texture) }
    }
}

/// With all its smaller versions.
fn texture_bytes(texture: &Texture) -> u64 {
    mips::chain(texture).iter().map(|level| level.len() as u64).sum()
}

/// The arrays as they go to the GPU: what equals is stored once.
fn memory(scene: &Scene, sampling: Sampling) -> Vec<MemoryPart> {
    let mut known = HashSet::new();
    let meshes: Vec<&Model> = scene.models.iter().filter(|model| known.insert(mesh_hash(model))).collect();
    let mut known = HashSet::new();
    let textures = scene.models.iter().flat_map(|model| &model.textures);
    let textures = textures.filter(|texture| known.insert(texture_hash(texture)));
    let total = |size: usize, count: &dyn Fn(&Model) -> usize| -> u64 {
        meshes.iter().map(|model| (size * count(model)) as u64).sum()
    };
    let instanced = |size: usize, count: &dyn Fn(&Model) -> usize| -> u64 {
        scene.instances.iter().map(|instance| (size * count(&scene.models[instance.model])) as u64).sum()
    };
    let deltas = |model: &Model| model.morphs.iter().map(|morph| morph.deltas.len()).sum();
    let patches: usize = meshes.iter().map(|model| model.patches_of(0).patches.len()).sum();
    let materials: usize = scene.models.iter().map(|model| model.materials.len()).sum();
    let manager = AnimationManager::new(scene, sampling, &Loading::complete(Cache::of_user()));
    let manager = manager.expect("nobody asks to end");
    let part = |part, shared, bytes| MemoryPart { part, shared, bytes };
    vec![
        part("vertices", true, total(size_of::<VertexGpu>(), &|model| model.vertices.len())),
        part("indices", true, total(4, &|model| model.indices.len())),
        part("patches", true, (size_of::<PatchGpu>() * patches) as u64),
        part("patch of triangle", true, total(4, &|model| model.indices.len() / 3)),
        part("morph targets", true, total(size_of::<MorphDeltaGpu>(), &deltas)),
        part("materials", true, (size_of::<MaterialGpu>() * materials) as u64),
        part("textures", true, textures.map(texture_bytes).sum()),
        part("skeletons and clips", true, manager.arrays.bytes()),
        part("poses", false, (size_of::<PoseGpu>() * scene.instances.len()) as u64),
        part("bone transforms", false, instanced(BONE_BYTES as usize, &|model| model.bones.len())),
        part("palettes", false, instanced(BONE_BYTES as usize, &|model| model.palette.len())),
        part("skinned vertices, all sample times", false, saved_bytes(scene, None)),
        part("normals and tangents", false, saved_bytes(scene, Some(1))),
    ]
}

/// Of a moving instance for each of so many sample times, or as many as are kept; of a still one once. 0 where no device has room.
fn saved_bytes(scene: &Scene, times: Option<u32>) -> u64 {
    let of_instance = |(index, instance): (usize, &shadecast_scene::Instance)| InstanceVertices {
        count: scene.models[instance.model].vertices.len() as u32,
        moves: scene.moves(index),
    };
    let vertices: Vec<_> = scene.instances.iter().enumerate().map(of_instance).collect();
    let times = times.unwrap_or_else(|| Saved::places_for(&vertices));
    let chunks = Saved::new(vertices, times).map(|saved| saved.chunks()).unwrap_or_default();
    chunks.into_iter().map(|count| u64::from(count) * SAVED_BYTES).sum()
}

#[cfg(test)]
mod tests;

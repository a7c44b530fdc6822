//! Skinning: each vertex that is needed once per sample time into `saved_vertices`, each frame once per update into `tangents`.
//! Three ways ([`Skinning`]), to be measured side by side.

use crate::animation::packing::SAVED_BYTES;
use crate::animation::saved::Saved;
use crate::scene::SceneGpu;
use crate::scene::skins::Skinning;
use crate::skinning::passes::palette::Palette;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::constants::MAX_INFLUENCES;
use shadecast_shaders::generated::{SKIN_CHAIN_COMP, SKIN_COMP, SKIN_PACKED_COMP, SkinJob};
use std::sync::Arc;

/// The stage with its outputs, which lie where [`Saved`] says.
pub(crate) struct Skin {
    /// Of vertices as they are; per-vertex-chain where that is asked for.
    whole: Variant,
    /// Of packed vertices, for 1, 2, 3 and 4 influences, where that is asked for.
    packed: Vec<Variant>,
    /// World positions, packed.
    pub saved_vertices: Vec<Buffer>,
    /// Normals and tangents at shading time, packed.
    pub tangents: Vec<Buffer>,
}

struct Variant {
    /// By [`Output`].
    pipelines: [ComputePipeline; 2],
    group: BindGroup,
}

/// What is written of each vertex.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Output {
    /// Its position.
    Positions,
    /// Its normal and tangent.
    Frames,
}

/// Instances to be skinned, each at a sample time.
#[derive(Debug, Default)]
pub(crate) struct SkinJobs {
    /// Of vertices as they are.
    pub whole: Vec<SkinJob>,
    /// Of packed vertices, by the number of their influences.
    pub packed: [Vec<SkinJob>; MAX_INFLUENCES as usize],
}

impl SkinJobs {
    /// Forgets all, keeps the room.
    pub(crate) fn clear(&mut self) {
        self.whole.clear();
        self.packed.iter_mut().for_each(Vec::clear);
    }
}

impl Skin {
    /// With room for what is saved of positions and of frames. `morph_weights` holds those of each pose.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        palette: &Palette,
        morph_weights: &Buffer,
        boxes: &Buffer,
        [positions, frames]: [&Saved; 2],
    ) -> Result<Self, GpuError> {
        let saved_vertices = chunks(gpu, "saved vertices", positions)?;
        let tangents = chunks(gpu, "tangents", frames)?;
        let mut binds = scene.animation.binds();
        binds.extend([
            ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
            ("VertexOrder", Bind::Buffer(&scene.meshes.vertex_order)),
            ("PackedVertices", Bind::Buffer(&scene.skins.packed_vertices)),
            ("MorphDeltas", Bind::Buffer(&scene.skins.morph_deltas)),
            ("MorphWeights", Bind::Buffer(morph_weights)),
            ("SavedVertices", Bind::Buffers(&saved_vertices)),
            ("Tangents", Bind::Buffers(&tangents)),
            ("Boxes", Bind::Buffer(boxes)),
            ("Palettes", Bind::Buffer(&palette.palettes)),
            ("Poses", Bind::Buffer(&palette.poses)),
        ]);
        let variant = |shader, constants: &[u32]| {
            let pipeline = |output: Output| {
                let constants: Vec<u32> = [output as u32].iter().chain(constants).copied().collect();
                ComputePipeline::specialised(gpu, shader, &constants)
            };
            let pipelines = [pipeline(Output::Positions)?, pipeline(Output::Frames)?];
            let group = BindGroup::of(pipelines[0].layout(), &binds)?;
            Ok::<_, GpuError>(Variant { pipelines, group })
        };
        let is_chain = scene.skinning == Skinning::PerVertexChain;
        let whole = variant(if is_chain { &SKIN_CHAIN_COMP } else { &SKIN_COMP }, &[])?;
        let most = if scene.skinning == Skinning::Packed { MAX_INFLUENCES } else { 0 };
        let packed =
            (1..=most).map(|count| variant(&SKIN_PACKED_COMP, &[count])).collect::<Result<_, _>>()?;
        Ok(Self { whole, packed, saved_vertices, tangents })
    }

    /// A dispatch for each of `jobs`.
    pub(crate) fn record(&self, recorder: &mut Recorder, jobs: &SkinJobs, output: Output) {
        let lists = [(&self.whole, &jobs.whole)].into_iter().chain(self.packed.iter().zip(&jobs.packed));
        for (variant, jobs) in lists.filter(|(_, jobs)| !jobs.is_empty()) {
            let dispatches = jobs.iter().map(|job| (job, [job.vertex_count, 1, 1]));
            recorder.dispatch_each(&variant.pipelines[output as usize], &variant.group, dispatches);
        }
    }
}

fn chunks(gpu: &Arc<Gpu>, name: &str, saved: &Saved) -> Result<Vec<Buffer>, GpuError> {
    let chunk = |count: u32| Buffer::new(gpu, name, u64::from(count) * SAVED_BYTES, Memory::Device);
    saved.chunks().into_iter().map(chunk).collect()
}

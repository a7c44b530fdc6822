//! Skinning: each vertex once per sample time into `saved_vertices`, each frame once per update into `tangents`.
//! Three ways ([`Skinning`]), to be measured side by side.

use crate::animation::RingPlace;
use crate::animation::skinning::Skinning;
use crate::scene::SceneGpu;
use crate::scene::numbering::{InstancePlace, Totals};
use crate::stages::palette::Palette;
use crate::upload::check_room;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_shaders::constants::MAX_INFLUENCES;
use shadecast_shaders::generated::{SKIN_CHAIN_COMP, SKIN_COMP, SKIN_PACKED_COMP, SkinJob, TangentGpu};
use std::sync::Arc;

/// The stage with its outputs: static instances first, then one run of the animated ones a place of the ring.
pub struct Skin {
    /// Of vertices as they are; per-vertex-chain where that is asked for.
    whole: Variant,
    /// Of packed vertices, for 1, 2, 3 and 4 influences, where that is asked for.
    packed: Vec<Variant>,
    /// World positions, vec4.
    pub saved_vertices: Buffer,
    /// Normals and tangents at shading time, static ones first.
    pub tangents: Buffer,
    static_vertices: u32,
    animated_vertices: u32,
}

struct Variant {
    pipeline: ComputePipeline,
    group: BindGroup,
}

/// Instances to be skinned, each at a sample time.
#[derive(Debug, Default)]
pub struct SkinJobs {
    /// Of vertices as they are.
    pub whole: Vec<SkinJob>,
    /// Of packed vertices, by the number of their influences.
    pub packed: [Vec<SkinJob>; MAX_INFLUENCES as usize],
}

impl SkinJobs {
    /// Forgets all, keeps the room.
    pub fn clear(&mut self) {
        self.whole.clear();
        self.packed.iter_mut().for_each(Vec::clear);
    }
}

impl Skin {
    /// With room for `times` sample times. `morph_weights` holds those of each pose.
    ///
    /// # Errors
    /// More skinned vertices than the device can bind as one buffer.
    pub fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        palette: &Palette,
        morph_weights: &Buffer,
        times: u32,
    ) -> Result<Self, GpuError> {
        let totals = scene.numbering.totals;
        let [(_, positions_bytes), (_, tangents_bytes)] = Self::needs(totals, times);
        Self::needs(totals, times).into_iter().try_for_each(|(what, bytes)| check_room(gpu, what, bytes))?;
        let saved_vertices = Buffer::new(gpu, "saved vertices", positions_bytes, Memory::Device)?;
        let tangents = Buffer::new(gpu, "tangents", tangents_bytes, Memory::Device)?;
        let mut binds = scene.animation.binds();
        binds.extend([
            ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
            ("PackedVertices", Bind::Buffer(&scene.skins.packed_vertices)),
            ("MorphDeltas", Bind::Buffer(&scene.skins.morph_deltas)),
            ("MorphWeights", Bind::Buffer(morph_weights)),
            ("SavedVertices", Bind::Buffer(&saved_vertices)),
            ("Tangents", Bind::Buffer(&tangents)),
            ("Palettes", Bind::Buffer(&palette.palettes)),
            ("Poses", Bind::Buffer(&palette.poses)),
        ]);
        let variant = |shader, constants: &[u32]| {
            let pipeline = ComputePipeline::specialised(gpu, shader, constants)?;
            let group = BindGroup::of(pipeline.layout(), &binds)?;
            Ok::<_, GpuError>(Variant { pipeline, group })
        };
        let is_chain = scene.skinning == Skinning::PerVertexChain;
        let whole = variant(if is_chain { &SKIN_CHAIN_COMP } else { &SKIN_COMP }, &[])?;
        let most = if scene.skinning == Skinning::Packed { MAX_INFLUENCES } else { 0 };
        let packed =
            (1..=most).map(|count| variant(&SKIN_PACKED_COMP, &[count])).collect::<Result<_, _>>()?;
        Ok(Self {
            whole,
            packed,
            saved_vertices,
            tangents,
            static_vertices: totals.static_vertices,
            animated_vertices: totals.animated_vertices,
        })
    }

    /// What it binds at once, in bytes.
    pub fn needs(totals: Totals, times: u32) -> [(&'static str, u64); 2] {
        let positions =
            u64::from(totals.static_vertices) + u64::from(times) * u64::from(totals.animated_vertices);
        let tangents_bytes = u64::from(totals.vertices) * size_of::<TangentGpu>() as u64;
        [
            ("skinned vertices of all instances and sample times", positions * 16),
            ("normals and tangents of all instances", tangents_bytes),
        ]
    }

    /// First saved vertex of an instance at the time of a place.
    pub fn position_base(&self, instance: &InstancePlace, place: RingPlace) -> u32 {
        match instance.is_animated {
            true => self.static_vertices + place.0 * self.animated_vertices + instance.saved_base,
            false => instance.saved_base,
        }
    }

    /// First saved frame of an instance.
    pub fn tangent_base(&self, instance: &InstancePlace) -> u32 {
        if instance.is_animated { self.static_vertices + instance.saved_base } else { instance.saved_base }
    }

    /// A dispatch for each of `jobs`.
    pub fn record(&self, recorder: &mut Recorder, jobs: &SkinJobs) {
        let lists = [(&self.whole, &jobs.whole)].into_iter().chain(self.packed.iter().zip(&jobs.packed));
        for (variant, jobs) in lists.filter(|(_, jobs)| !jobs.is_empty()) {
            let dispatches = jobs.iter().map(|job| (job, [job.vertex_count, 1, 1]));
            recorder.dispatch_each(&variant.pipeline, &variant.group, dispatches);
        }
    }
}

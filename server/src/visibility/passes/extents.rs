//! The visible patches, each with its largest projected extent. What the CPU reads grows with what is visible, not with the LOD
//! set.

use crate::scene::SceneGpu;
use crate::skinning::gpu::Animation;
use crate::time::RingPlace;
use crate::time::VIEW_TIMES;
use crate::visibility::lod_set::LodSet;
use shadecast_gpu::{Bind, BindGroup, Buffer, ComputePipeline, Gpu, GpuError, Memory, Recorder};
use shadecast_protocol::limits::MAX_VIEWS;
use shadecast_shaders::generated::{EXTENTS_COMP, ExtentsPush, SeenGpu};
use std::sync::Arc;

/// The stage with its output.
pub struct Extents {
    memory: ExtentsMemory,
    group: BindGroup,
}

/// The stage as it is in no world: any thread makes it.
pub(crate) struct ExtentsMemory {
    pipeline: ComputePipeline,
    /// What is visible, in any order, for the CPU, and how many there are.
    seen: Buffer,
    count: Buffer,
}

impl Extents {
    /// `views` is the uniform buffer of all predicted views, `visible` the marks.
    pub fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        animation: &Animation,
        views: &Buffer,
        visible: &Buffer,
    ) -> Result<Self, GpuError> {
        ExtentsMemory::new(gpu, scene)?.bind(scene, animation, views, visible)
    }

    /// Leaves the world.
    pub(crate) fn unbind(self) -> ExtentsMemory {
        self.memory
    }

    /// Nothing is visible: before [`Self::record`], with a barrier from the copy between them.
    pub fn record_start(&self, recorder: &mut Recorder) {
        recorder.fill(&self.memory.count, 0);
    }

    /// What was visible, ascending by entry, into `seen`. What was recorded is done.
    pub fn read(&self, seen: &mut Vec<SeenGpu>) {
        let count = self.memory.count.values::<u32>()[0] as usize;
        seen.clear();
        seen.extend_from_slice(&self.memory.seen.values()[..count]);
        seen.sort_unstable_by_key(|patch| patch.entry); // each is there once
    }

    /// Measures the visible patches of the LOD set, with the vertex samples at the ring place of each view time.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        animation: &Animation,
        lods: &LodSet,
        places: [RingPlace; VIEW_TIMES],
    ) {
        for lod in lods.all() {
            let instance = &scene.numbering.instances[lod.instance];
            let model = &scene.models[instance.model];
            let patch_count = lod.patches.count;
            let bases = places.map(|place| animation.position_base(lod.instance, place));
            // What is not there at a time is not seen then; what is never there is only told so.
            let any = bases.iter().flatten().next().copied().unwrap_or_default();
            let push = ExtentsPush {
                vertex_base: model.vertex_base,
                patch_base: model.lods[lod.lod].patch_base,
                first_entry: lod.first_entry,
                patch_count,
                view_count: MAX_VIEWS,
                position_base: bases.map(|base| base.unwrap_or(any)),
                material_base: model.material_base,
                instance: lod.instance as u32,
            };
            recorder.dispatch(&self.memory.pipeline, &self.group, &push, [patch_count, 1, 1]);
        }
    }
}

impl ExtentsMemory {
    pub(crate) fn new(gpu: &Arc<Gpu>, scene: &SceneGpu) -> Result<Self, GpuError> {
        let pipeline = ComputePipeline::new(gpu, &EXTENTS_COMP)?;
        let bytes = u64::from(scene.numbering.totals.in_lod_set) * size_of::<SeenGpu>() as u64;
        let seen = Buffer::new(gpu, "what is visible", bytes, Memory::Readback)?;
        let count = Buffer::new(gpu, "how much is visible", size_of::<u32>() as u64, Memory::Readback)?;
        Ok(Self { pipeline, seen, count })
    }

    /// Comes into a world. `views` is the uniform buffer of all predicted views, `visible` the marks.
    pub(crate) fn bind(
        self,
        scene: &SceneGpu,
        animation: &Animation,
        views: &Buffer,
        visible: &Buffer,
    ) -> Result<Extents, GpuError> {
        let [saved_vertices, boxes] = animation.position_binds();
        let group = BindGroup::new(
            self.pipeline.layout(),
            &[
                saved_vertices,
                boxes,
                ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
                ("Views", Bind::Buffer(views)),
                ("Patches", Bind::Buffer(&scene.meshes.patches)),
                ("Materials", Bind::Buffer(&scene.materials.buffer)),
                ("Visible", Bind::Buffer(visible)),
                ("Seen", Bind::Buffer(&self.seen)),
                ("SeenCount", Bind::Buffer(&self.count)),
            ],
        )?;
        Ok(Extents { memory: self, group })
    }
}

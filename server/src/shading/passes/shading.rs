//! Object-space shading: one quad per due block, gutter included, into the atlas. Other blocks keep their texels.

use crate::animation::manager::rows;
use crate::scene::SceneGpu;
use crate::scene::numbering::{PatchRange, ScenePatch};
use crate::shading::filter::Filter;
use crate::shading::passes::shadow::Shadow;
use crate::skinning::gpu::Animation;
use crate::time::RingPlace;
use ash::vk;
use glam::Affine3A;
use shadecast_gpu::{
    Attachment, Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc,
    Image, ImageDesc, Memory, Recorder, RenderPass, RenderPassDesc,
};
use shadecast_protocol::atlas::{AtlasExtent, Block};
use shadecast_protocol::limits::MAX_PATCH_SLOTS;
use shadecast_protocol::pose::Pose;
use shadecast_shaders::Shader;
use shadecast_shaders::generated::{BlockGpu, SHADING_FRAG, SHADING_TEXEL_FRAG, SHADING_VERT, ShadingPush};
use std::sync::Arc;

/// The stage with its output.
pub(crate) struct Shading {
    memory: ShadingMemory,
    group: BindGroup,
}

/// The stage as it is in no world: any thread makes it.
pub(crate) struct ShadingMemory {
    pass: RenderPass,
    pipeline: GraphicsPipeline,
    target: Framebuffer,
    blocks: Buffer,
    count: u32,
    /// RGBA8, sRGB-coded display values; what no block covers keeps its last content, which costs no bits.
    pub atlas: Image,
}

/// The shader of a filter.
fn fragment(filter: Filter) -> &'static Shader {
    match filter {
        Filter::Pixel | Filter::Supersampled => &SHADING_FRAG,
        Filter::Texel => &SHADING_TEXEL_FRAG,
    }
}

impl ShadingMemory {
    /// For an atlas of this extent; textures are filtered as a measurement wants it, or as usual.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        extent: AtlasExtent,
        filter: Filter,
    ) -> Result<Self, GpuError> {
        let format = vk::Format::R8G8B8A8_UNORM;
        let extent = extent.texels();
        let atlas = Image::new(
            gpu,
            ImageDesc::new(
                "shading atlas",
                extent,
                format,
                vk::ImageUsageFlags::COLOR_ATTACHMENT
                    | vk::ImageUsageFlags::SAMPLED
                    | vk::ImageUsageFlags::TRANSFER_SRC
                    | vk::ImageUsageFlags::TRANSFER_DST,
            ),
        )?;
        clear(gpu, &atlas)?;
        let read = vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL;
        let pass = RenderPass::new(
            gpu,
            &RenderPassDesc::new(vec![Attachment {
                format,
                load: vk::AttachmentLoadOp::LOAD,
                store: vk::AttachmentStoreOp::STORE,
                before: read,
                after: read,
            }]),
        )?;
        let pipeline = GraphicsPipeline::new(
            gpu,
            &GraphicsPipelineDesc {
                topology: vk::PrimitiveTopology::TRIANGLE_STRIP,
                textures: scene.materials.texture_count(),
                ..GraphicsPipelineDesc::new(&SHADING_VERT, fragment(filter), &pass)
            },
        )?;
        let bytes =
            u64::from(MAX_PATCH_SLOTS.min(scene.numbering.totals.patches)) * size_of::<BlockGpu>() as u64;
        let blocks = Buffer::new(gpu, "live blocks", bytes, Memory::Upload)?;
        let target = Framebuffer::new(gpu, &pass, extent, &[atlas.view()])?;
        Ok(Self { pass, pipeline, target, blocks, count: 0, atlas })
    }

    /// Comes into a world.
    pub(crate) fn bind(
        self,
        scene: &SceneGpu,
        animation: &Animation,
        shadow: &Shadow,
    ) -> Result<Shading, GpuError> {
        let textures = scene.materials.texture_binds();
        let [light, shadow_map] = shadow.binds();
        let [saved_vertices, boxes] = animation.position_binds();
        let group = BindGroup::new(
            self.pipeline.layout(),
            &[
                ("Blocks", Bind::Buffer(&self.blocks)),
                ("Patches", Bind::Buffer(&scene.meshes.patches)),
                ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
                saved_vertices,
                boxes,
                animation.frame_bind(),
                ("Materials", Bind::Buffer(&scene.materials.buffer)),
                light,
                shadow_map,
                ("textures", Bind::Textures(&textures)),
            ],
        )?;
        Ok(Shading { memory: self, group })
    }

    /// As it was when it was made: nothing of what was shaded is left.
    pub(crate) fn wipe(&mut self, gpu: &Arc<Gpu>) -> Result<(), GpuError> {
        self.blocks.bytes_mut().fill(0);
        self.count = 0;
        clear(gpu, &self.atlas)
    }
}

impl Shading {
    /// The atlas, as shaders read it.
    pub(crate) fn atlas(&self) -> &Image {
        &self.memory.atlas
    }

    /// Leaves the world. No submitted work still uses it.
    pub(crate) fn unbind(self) -> ShadingMemory {
        self.memory
    }

    /// Writes the list of blocks to shade, ascending by patch, with geometry as it is in `place`. No submitted work still reads the list.
    pub(crate) fn write_blocks(
        &mut self,
        scene: &SceneGpu,
        animation: &Animation,
        place: RingPlace,
        due: impl Iterator<Item = (ScenePatch, Block)>,
    ) {
        let list: &mut [BlockGpu] = bytemuck::cast_slice_mut(self.memory.blocks.bytes_mut());
        self.memory.count = 0;
        // Live patches come in ascending order: most are of the LOD of the one before.
        let mut now: Option<(usize, usize, PatchRange)> = None;
        for (patch, block) in due {
            let (number, lod, range) = now.filter(|(.., range)| range.has(patch)).unwrap_or_else(|| {
                let (number, lod) = scene.numbering.place_of_patch(patch);
                let range = scene.numbering.patches(number, lod);
                (number, lod, range.expect("it holds the patch"))
            });
            now = Some((number, lod, range));
            let bases = animation.position_base(number, place).zip(animation.tangent_base(number));
            // What had no room when it was skinned keeps the colours that it has.
            let Some((position_base, tangent_base)) = bases else { continue };
            let Some(entry) = list.get_mut(self.memory.count as usize) else { break };
            let model = &scene.models[scene.numbering.instances[number].model];
            *entry = BlockGpu {
                patch_index: model.lods[lod].patch_base + range.model_number(patch),
                address_texels: u32::from(block.address.x) | u32::from(block.address.y) << 16,
                extent_texels: block.size.width() | block.size.height() << 16,
                vertex_base: model.vertex_base,
                position_base,
                tangent_base,
                material_base: model.material_base,
                instance: number as u32,
            };
            self.memory.count += 1;
        }
    }

    /// Shades the listed blocks as seen by a head, filtered for a display of so many pixels to a tangent of 1, x and y. Where textures
    /// are finer than a pixel, it has so many samples a side. `cleared` become grey before.
    pub(crate) fn record(
        &self,
        recorder: &mut Recorder,
        world_from_head: Pose,
        pixels_per_tangent: [f32; 2],
        samples_a_side: u32,
        cleared: &[Block],
    ) {
        let ShadingMemory { pass, pipeline, target, count, atlas, .. } = &self.memory;
        if *count == 0 && cleared.is_empty() {
            return;
        }
        let [width, height] = atlas.desc().extent;
        let push = ShadingPush {
            head_from_world: rows(Affine3A::from_mat4(world_from_head.inverse().matrix())),
            world_eye: world_from_head.position.extend(0.0).to_array(),
            atlas_extent_texels: [width as f32, height as f32],
            pixels_per_tangent,
            samples_a_side,
            _pad_end: Default::default(),
        };
        recorder.begin_pass(pass, target, &[]);
        recorder.clear_rects(GREY, cleared.iter().map(|block| block.rect_texels()));
        recorder.bind(pipeline, &self.group);
        recorder.push_constants(pipeline, &push);
        recorder.draw(4, *count);
        recorder.end_pass();
    }
}

/// What is empty.
const GREY: [f32; 4] = [0.5, 0.5, 0.5, 1.0];

/// Mid-grey, ready to be sampled: an empty atlas costs the encoder nothing.
fn clear(gpu: &Arc<Gpu>, atlas: &Image) -> Result<(), GpuError> {
    use shadecast_gpu::Access;
    let (from, to) = (vk::ImageLayout::TRANSFER_DST_OPTIMAL, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL);
    let mut recorder = gpu.record()?;
    recorder.transition(atlas, [vk::ImageLayout::UNDEFINED, from], Access::NONE, Access::COPY_WRITE);
    recorder.clear_image(atlas, GREY);
    recorder.transition(atlas, [from, to], Access::COPY_WRITE, Access::FRAGMENT_READ);
    gpu.wait(recorder.submit()?)
}

//! Visibility's first half: which patch each pixel of the predicted views shows.

use crate::scene::SceneGpu;
use crate::scene::drawing::Geometry;
use crate::skinning::gpu::Animation;
use crate::time::RingPlace;
use crate::visibility::clusters::Clusters;
use crate::visibility::culling::Sight;
use crate::visibility::lod_set::LodInstance;
use ash::vk;
use shadecast_gpu::{
    Attachment, Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, Image, ImageDesc, Part, Recorder,
    RenderPass, RenderPassDesc,
};
use shadecast_shaders::Shader;
use shadecast_shaders::generated::{
    ID_BUFFER_FRAG, ID_BUFFER_PULLED_FRAG, ID_BUFFER_PULLED_VERT, ID_BUFFER_VERT, IdBufferPush,
};
use std::sync::Arc;

/// Updates after which the places of samples within a pixel repeat: what any of them sees is held for longer.
const SAMPLE_PLACES: u32 = 8;
const _: () = assert!(SAMPLE_PLACES <= crate::visibility::holding::HOLD_UPDATES);

/// By how much an update's views are shifted, in normalised device coordinates of an image of `extent_pixels`: half a
/// pixel at most to each side, another place for each of the `views` and in each of several updates. A head that stands
/// still would see the same samples for ever, and never a triangle that lies between them.
pub(crate) fn shift_ndc(update: u32, view: u32, views: u32, extent_pixels: [f32; 2]) -> [f32; 2] {
    // R2, a sequence of low discrepancy (Roberts, "The Unreasonable Effectiveness of Quasirandom Sequences", 2018).
    const STEPS: [f32; 2] = [0.754_877_7, 0.569_840_3];
    let place = (update % SAMPLE_PLACES * views + view) as f32;
    [0, 1].map(|axis| ((0.5 + STEPS[axis] * place).fract() - 0.5) * 2.0 / extent_pixels[axis].max(1.0))
}

/// How a pixel learns its triangle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TriangleNumbers {
    /// The device numbers the triangles of a draw: `gl_PrimitiveID`.
    Given,
    /// The vertex shader reads the indices, and so knows. Every device can. A vertex is placed once for each of its triangles, which
    /// graphics processors would spare; of one that is software it takes less than to look up what was placed.
    Pulled,
}

impl TriangleNumbers {
    /// What costs least of what the device can.
    pub fn of(gpu: &Gpu) -> Self {
        if gpu.numbers_triangles() && !gpu.is_cpu() { Self::Given } else { Self::Pulled }
    }

    fn shaders(self) -> [&'static Shader; 2] {
        match self {
            Self::Given => [&ID_BUFFER_VERT, &ID_BUFFER_FRAG],
            Self::Pulled => [&ID_BUFFER_PULLED_VERT, &ID_BUFFER_PULLED_FRAG],
        }
    }
}

/// What is drawn at once.
#[derive(Clone, Copy, Debug)]
pub struct Pass<'a> {
    /// Ascending by instance, each once.
    pub lods: &'a [LodInstance],
    /// Where their positions are.
    pub place: RingPlace,
    /// The left eye's; the right one's follows.
    pub first_view: u32,
    /// Pixels of each view, from the first corner on, and whether no other view is drawn: both eyes are one.
    pub part: Part,
    /// What stands still, and what can be seen of it.
    pub within: (&'a Clusters, &'a Sight),
}

/// The stage with its output; both eyes of one time at once.
pub struct IdBuffer {
    memory: IdBufferMemory,
    group: BindGroup,
}

/// The stage as it is in no world: any thread makes it.
pub(crate) struct IdBufferMemory {
    pass: RenderPass,
    geometry: Geometry,
    target: Framebuffer,
    /// R32_UINT, two layers: entry of the patch from `FIRST_ID` on, 0 for background.
    pub(crate) image: Image,
    _depth: Image,
}

impl IdBuffer {
    /// For views of `extent` pixels. `views` is the uniform buffer of all predicted views.
    pub fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        animation: &Animation,
        views: &Buffer,
        extent: [u32; 2],
    ) -> Result<Self, GpuError> {
        Self::with_numbers(gpu, scene, animation, views, extent, TriangleNumbers::of(gpu))
    }

    /// The same, with triangles numbered as said.
    pub fn with_numbers(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        animation: &Animation,
        views: &Buffer,
        extent: [u32; 2],
        numbers: TriangleNumbers,
    ) -> Result<Self, GpuError> {
        IdBufferMemory::new(gpu, scene, extent, numbers)?.bind(scene, animation, views)
    }

    /// R32_UINT, two layers: entry of the patch from `FIRST_ID` on, 0 for background.
    pub fn image(&self) -> &Image {
        &self.memory.image
    }

    /// Leaves the world.
    pub(crate) fn unbind(self) -> IdBufferMemory {
        self.memory
    }

    /// Both views, whole.
    pub fn whole(&self) -> Part {
        Part { extent: self.image().desc().extent, first_alone: false }
    }

    /// Draws what is `lods`, as it is in `place`, into the two views from `first_view` on, or into that alone: of what stands still
    /// no more than is in sight.
    pub fn record(
        &self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        animation: &Animation,
        Pass { lods, place, first_view, part, within }: Pass<'_>,
    ) {
        let clears = [vk::ClearValue::default(), vk::ClearValue::default()]; // no patch; far, which is 0
        let base = |number: usize| animation.position_base(number, place);
        let lod_of = |number: usize| {
            let at = lods.binary_search_by_key(&number, |lod| lod.instance).ok()?;
            base(number).is_some().then_some(lods[at])
        };
        recorder.begin_pass_of(&self.memory.pass, &self.memory.target, &clears, part);
        self.memory.geometry.record_runs(
            recorder,
            (&self.group, scene),
            |number| lod_of(number).map(|lod| lod.lod),
            |of, primitive| within.0.runs(of, primitive, within.1),
            |draw| IdBufferPush {
                vertex_base: draw.model.vertex_base,
                position_base: base(draw.number).unwrap_or_default(),
                triangle_base: (draw.lod.index_base + draw.first_index) / 3,
                first_entry: lod_of(draw.number).map_or(0, |lod| lod.first_entry),
                material: draw.model.material_base + draw.primitive.material,
                first_view,
                instance: draw.number as u32,
            },
        );
        recorder.end_pass();
    }
}

impl IdBufferMemory {
    /// For views of `extent` pixels, with triangles numbered as said.
    pub(crate) fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        extent: [u32; 2],
        numbers: TriangleNumbers,
    ) -> Result<Self, GpuError> {
        let (image, depth) = (id_image(gpu, extent)?, depth_image(gpu, extent, 2)?);
        let pass = RenderPass::new(
            gpu,
            &RenderPassDesc {
                depth: Some(vk::Format::D32_SFLOAT),
                view_mask: 0b11,
                first_alone: true,
                ..RenderPassDesc::new(vec![Attachment {
                    format: vk::Format::R32_UINT,
                    load: vk::AttachmentLoadOp::CLEAR,
                    store: vk::AttachmentStoreOp::STORE,
                    before: vk::ImageLayout::UNDEFINED,
                    after: vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL,
                }])
            },
        )?;
        let [vertex, fragment] = numbers.shaders();
        let geometry = Geometry::new(gpu, scene, vertex, fragment, &pass)?;
        let target = Framebuffer::new(gpu, &pass, extent, &[image.view(), depth.view()])?;
        Ok(Self { pass, geometry, target, image, _depth: depth })
    }

    /// Comes into a world. `views` is the uniform buffer of all predicted views.
    pub(crate) fn bind(
        self,
        scene: &SceneGpu,
        animation: &Animation,
        views: &Buffer,
    ) -> Result<IdBuffer, GpuError> {
        let textures = scene.materials.texture_binds();
        let [saved_vertices, boxes] = animation.position_binds();
        let group = BindGroup::of(
            self.geometry.layout(),
            &[
                saved_vertices,
                boxes,
                ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
                ("Views", Bind::Buffer(views)),
                ("PatchOfTriangle", Bind::Buffer(&scene.meshes.patch_of_triangle)),
                ("Materials", Bind::Buffer(&scene.materials.buffer)),
                ("textures", Bind::Textures(&textures)),
                ("Indices", Bind::Buffer(&scene.meshes.indices)),
            ],
        )?;
        Ok(IdBuffer { memory: self, group })
    }
}

fn id_image(gpu: &Arc<Gpu>, extent: [u32; 2]) -> Result<Image, GpuError> {
    Image::new(
        gpu,
        ImageDesc {
            layers: 2,
            ..ImageDesc::new(
                "ID buffer",
                extent,
                vk::Format::R32_UINT,
                vk::ImageUsageFlags::COLOR_ATTACHMENT
                    | vk::ImageUsageFlags::SAMPLED
                    | vk::ImageUsageFlags::TRANSFER_SRC,
            )
        },
    )
}

/// A depth buffer that no pass stores.
pub(crate) fn depth_image(gpu: &Arc<Gpu>, extent: [u32; 2], layers: u32) -> Result<Image, GpuError> {
    Image::new(
        gpu,
        ImageDesc {
            layers,
            ..ImageDesc::new(
                "depth",
                extent,
                vk::Format::D32_SFLOAT,
                vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT,
            )
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_lie_everywhere_in_a_pixel_and_come_back_before_what_they_see_is_given_up() {
        const VIEWS: u32 = 6;
        let places = |updates: std::ops::Range<u32>| -> Vec<[f32; 2]> {
            let of_update = |update| (0..VIEWS).map(move |view| shift_ndc(update, view, VIEWS, [2.0, 2.0]));
            updates.flat_map(of_update).collect()
        };
        let seen = places(0..SAMPLE_PLACES);
        assert_eq!(seen, places(SAMPLE_PLACES..2 * SAMPLE_PLACES));
        assert!(seen.iter().flatten().all(|shift| shift.abs() <= 0.5), "pixels of this image are 1 wide");
        for (x, y) in (0..16).flat_map(|x| (0..16).map(move |y| (x, y))) {
            let at = [x, y].map(|place| (place as f32 + 0.5) / 16.0 - 0.5);
            let nearest = seen.iter().map(|[x, y]| (x - at[0]).hypot(y - at[1])).fold(f32::MAX, f32::min);
            assert!(nearest < 0.15, "{at:?}: {nearest} of a pixel to the nearest sample");
        }
        assert_eq!(shift_ndc(0, 0, VIEWS, [2.0, 2.0]), [0.0, 0.0], "the first sample is the pixel's middle");
    }
}

//! The sun's shadows: the depth of all casters as the sun sees them, and the buffer of all light, which the map's lookup
//! belongs to.

use crate::animation::RingPlace;
use crate::animation::gpu::Animation;
use crate::culling::Needed;
use crate::lights::{self, SunView};
use crate::scene::SceneGpu;
use crate::stages::geometry::{FULL_DETAIL, Geometry};
use ash::vk;
use shadecast_gpu::{
    Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, Image, ImageDesc, Memory, Recorder, RenderPass,
    Sampler, SamplerDesc,
};
use shadecast_protocol::time::ServerTime;
use shadecast_shaders::generated::{LightGpu, SHADOW_FRAG, SHADOW_VERT, ShadowPush};
use std::sync::Arc;

/// The stage with its outputs.
pub struct Shadow {
    pass: RenderPass,
    geometry: Geometry,
    group: BindGroup,
    target: Framebuffer,
    map: Image,
    sampler: Sampler,
    light: Buffer,
    view: Option<SunView>,
    /// Whether any caster moves.
    is_animated: bool,
    is_drawn: bool,
}

impl Shadow {
    /// For the scene's sun. Where it casts no shadows, or nothing is in its way, the map is a small empty one.
    pub fn new(gpu: &Arc<Gpu>, scene: &SceneGpu, animation: &Animation) -> Result<Self, GpuError> {
        let view = scene.sun_view();
        let side = view.map_or(16, |view| view.extent_texels);
        let format = vk::Format::D32_SFLOAT;
        let map = Image::new(
            gpu,
            ImageDesc::new(
                "shadow map",
                [side; 2],
                format,
                vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT | vk::ImageUsageFlags::SAMPLED,
            ),
        )?;
        let pass = RenderPass::depth_map(gpu, format)?;
        let geometry = Geometry::new(gpu, &SHADOW_VERT, &SHADOW_FRAG, &pass)?;
        let light = Buffer::new(gpu, "light", size_of::<LightGpu>() as u64, Memory::Upload)?;
        let textures = scene.materials.texture_binds();
        let [saved_vertices, boxes] = animation.position_binds();
        let binds = [
            saved_vertices,
            boxes,
            ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
            ("Light", Bind::Buffer(&light)),
            ("Materials", Bind::Buffer(&scene.materials.buffer)),
            ("textures", Bind::Textures(&textures)),
        ];
        let edge = vk::SamplerAddressMode::CLAMP_TO_EDGE;
        let nearest =
            SamplerDesc { filter: vk::Filter::NEAREST, wrap: [edge; 2], mips: false, anisotropy: 1.0 };
        Ok(Self {
            group: BindGroup::new(geometry.layout(), &binds)?,
            target: Framebuffer::new(gpu, &pass, [side; 2], &[map.view()])?,
            sampler: Sampler::new(gpu, nearest)?,
            is_animated: scene.casters().any(|index| scene.moves(index)),
            pass,
            geometry,
            map,
            light,
            view,
            is_drawn: false,
        })
    }

    /// Writes the light as it is at `time` by the animation's timeline. No submitted work still reads it.
    pub fn write(&mut self, scene: &SceneGpu, animation: &Animation, time: ServerTime) {
        let light = lights::at(&scene.scene, &animation.timeline().lock(), self.view.as_ref(), time);
        self.light.write(0, bytemuck::bytes_of(&light));
    }

    /// Draws the casters in `needs` as they are in `place`; once and all where none of them moves. Gives whether it did.
    pub fn record(
        &mut self,
        recorder: &mut Recorder,
        scene: &SceneGpu,
        animation: &Animation,
        needs: &Needed,
        place: RingPlace,
    ) -> bool {
        if self.is_drawn && !(self.is_animated && self.view.is_some()) {
            return false;
        }
        self.is_drawn = true;
        recorder.begin_pass(&self.pass, &self.target, &[vk::ClearValue::default()]); // 0: far from the sun
        if self.view.is_some() {
            let all = !self.is_animated;
            // One map serves all viewers, who see different levels.
            let base = |number: usize| animation.position_base(number, place);
            let casts = |number: usize| {
                let is_drawn = (all || needs.has(number))
                    && scene.scene.instances[number].casts_shadow
                    && base(number).is_some();
                is_drawn.then_some(FULL_DETAIL)
            };
            self.geometry.record(recorder, &self.group, scene, casts, |draw| ShadowPush {
                vertex_base: draw.model.vertex_base,
                position_base: base(draw.number).unwrap_or_default(),
                material: draw.model.material_base + draw.primitive.material,
                instance: draw.number as u32,
            });
        }
        recorder.end_pass();
        true
    }

    /// The map is drawn anew.
    pub fn forget(&mut self) {
        self.is_drawn = false;
    }

    /// What shading binds to see by: the light, and the map.
    pub fn binds(&self) -> [(&'static str, Bind<'_>); 2] {
        [("Light", Bind::Buffer(&self.light)), ("shadow_map", Bind::Sampled(&self.map, &self.sampler))]
    }
}

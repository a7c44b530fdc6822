//! The sun's shadows: the depth of all casters from the sun, and the buffer of all lights, which holds the map's lookup.

use crate::scene::SceneGpu;
use crate::scene::drawing::{FULL_DETAIL, Geometry};
use crate::scene::lights::{self, SunView};
use crate::skinning::gpu::Animation;
use crate::time::RingPlace;
use crate::visibility::culling::Needed;
use ash::vk;
use shadecast_gpu::{
    Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, Image, ImageDesc, Memory, Recorder, RenderPass,
    Sampler, SamplerDesc,
};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::sampling::longest_axis;
use shadecast_scene::{Instance, TrackValues};
use shadecast_shaders::generated::{LightGpu, PunctualGpu, SHADOW_FRAG, SHADOW_VERT, ShadowPush};
use std::sync::Arc;

/// Texels of the map that the surface of a caster may be off.
const ERROR_TEXELS: f32 = 0.5;
/// The same of coarse casters. None is coarser than its surface is shown, which it would darken otherwise.
const COARSE_ERROR_TEXELS: f32 = 3.0;

/// How fine the casters of a map are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Casters {
    /// As fine as the map can show.
    Fine,
    /// No finer than their surfaces are shown, where the map hardly shows that.
    Coarse,
}

/// The stage with its outputs.
pub(crate) struct Shadow {
    pass: RenderPass,
    geometry: Geometry,
    group: BindGroup,
    target: Framebuffer,
    map: Image,
    sampler: Sampler,
    light: Buffer,
    view: Option<SunView>,
    /// By instance: the LOD that its shadow is drawn at, or the finest that was skinned where that is coarser.
    lods: Vec<usize>,
    /// The same with coarse casters.
    coarse_lods: Vec<usize>,
    /// Whether any caster moves.
    is_animated: bool,
    is_drawn: bool,
    /// By instance, whether the map holds it.
    held: Vec<bool>,
    /// What was written last.
    written: LightGpu,
}

impl Shadow {
    /// For the scene's sun, with casters as fine as its map can show. Where it casts no shadows, or nothing is in its way, the map is a
    /// small empty one.
    pub(crate) fn new(gpu: &Arc<Gpu>, scene: &SceneGpu, animation: &Animation) -> Result<Self, GpuError> {
        let [lods, coarse_lods] =
            [ERROR_TEXELS, COARSE_ERROR_TEXELS].map(|texels| caster_lods(scene, texels));
        Ok(Self { lods, coarse_lods, ..Self::in_full_detail(gpu, scene, animation)? })
    }

    /// The same with casters in full detail.
    pub(crate) fn in_full_detail(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        animation: &Animation,
    ) -> Result<Self, GpuError> {
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
        let geometry = Geometry::new(gpu, scene, &SHADOW_VERT, &SHADOW_FRAG, &pass)?;
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
        let nearest = SamplerDesc::clamped(vk::Filter::NEAREST);
        Ok(Self {
            group: BindGroup::new(geometry.layout(), &binds)?,
            target: Framebuffer::new(gpu, &pass, [side; 2], &[map.view()])?,
            sampler: Sampler::new(gpu, nearest)?,
            lods: vec![FULL_DETAIL; scene.numbering.instances.len()],
            coarse_lods: vec![FULL_DETAIL; scene.numbering.instances.len()],
            is_animated: scene.casters().any(|index| scene.moves(index)),
            pass,
            geometry,
            map,
            light,
            view,
            is_drawn: false,
            held: vec![false; scene.numbering.instances.len()],
            written: bytemuck::Zeroable::zeroed(),
        })
    }

    /// By instance the coarsest LOD that such casters have: vertices must be there as finely.
    pub(crate) fn lods(&self, casters: Casters) -> impl Iterator<Item = usize> + '_ {
        let lods = match casters {
            Casters::Fine => &self.lods,
            Casters::Coarse => &self.coarse_lods,
        };
        lods.iter().copied()
    }

    /// Writes the light as it is at `time` by the animation's timeline. No submitted work still reads it.
    pub(crate) fn write(&mut self, scene: &SceneGpu, animation: &Animation, time: WorldTime) {
        let light = lights::at(&scene.scene, &animation.timeline().lock(), self.view.as_ref(), time);
        self.light.write(0, bytemuck::bytes_of(&light));
        self.written = light;
    }

    /// Draws the casters in `needs` as they are in `place`; once and all where none of them moves. Gives whether it did.
    pub(crate) fn record(
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
            // One map serves all viewers, who see different LODs.
            let base = |number: usize| animation.position_base(number, place);
            let casts = |number: usize| {
                let is_drawn = (all || needs.has(number))
                    && scene.scene.instances[number].casts_shadow
                    && base(number).is_some();
                is_drawn.then(|| self.lods[number].max(animation.lod_in(number, place)))
            };
            let held = (0..self.held.len()).map(|number| casts(number).is_some());
            self.held.iter_mut().zip(held).for_each(|(held, now)| *held = now);
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
    pub(crate) fn forget(&mut self) {
        self.is_drawn = false;
    }

    /// Whether the map holds an instance's shadow.
    pub(crate) fn has(&self, instance: usize) -> bool {
        self.held[instance]
    }

    /// How the sun sees its casters, where it casts shadows.
    pub(crate) fn sun_view(&self) -> Option<&SunView> {
        self.view.as_ref()
    }

    /// The lamps as they were written last.
    pub(crate) fn lamps(&self) -> &[PunctualGpu] {
        &self.written.punctual[..self.written.punctual_count[0] as usize]
    }

    /// What shading binds to see by: the light, and the map.
    pub(crate) fn binds(&self) -> [(&'static str, Bind<'_>); 2] {
        [("Light", Bind::Buffer(&self.light)), ("shadow_map", Bind::Sampled(&self.map, &self.sampler))]
    }
}

/// By instance the coarsest LOD whose error is so many texels of the map at most.
fn caster_lods(scene: &SceneGpu, error_texels: f32) -> Vec<usize> {
    let texel_m = scene.sun_view().map_or(0.0, |view| view.texel_m);
    let lod = |number: usize| {
        let instance = &scene.scene.instances[number];
        let allowed_m = error_texels * texel_m / largest_scale(instance).max(f32::MIN_POSITIVE);
        let casts = instance.casts_shadow;
        let lods = &scene.mesh(number).lods;
        match casts {
            true => lods.iter().rposition(|lod| lod.error_m <= allowed_m).unwrap_or(FULL_DETAIL),
            false => lods.len() - 1,
        }
    };
    (0..scene.numbering.instances.len()).map(lod).collect()
}

/// How much larger than its model an instance is anywhere on its path.
fn largest_scale(instance: &Instance) -> f32 {
    let tracks = instance.path.iter().flat_map(|path| &path.clip.tracks);
    let of_path = tracks.map(|track| match &track.values {
        TrackValues::Scale(keys) => keys.iter().map(|key| key.abs().max_element()).fold(1.0, f32::max),
        _ => 1.0,
    });
    longest_axis(&instance.placement) * of_path.fold(1.0, f32::max)
}

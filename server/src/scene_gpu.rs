//! The scene in GPU memory, every asset once: geometry, patches, bones, resampled clips, materials, textures.
//!
//! Numbers: a *scene-wide* vertex or patch number counts over all instances, in their order; a *model* number counts
//! within one model.

use crate::lights::{self, SunView};
use ash::vk;
use glam::Affine3A;
use shadecast_gpu::{
    Access, Bind, Buffer, Gpu, GpuError, Image, ImageDesc, SCENE_TEXTURES, Sampler, SamplerDesc,
};
use shadecast_protocol::limits::MAX_LIGHTS;
use shadecast_scene::animation::bounds::{self, Bounds};
use shadecast_scene::animation::clip::{self, ResampledClip};
use shadecast_scene::animation::pose;
use shadecast_scene::patches::{Patch, Patches};
use shadecast_scene::{Instance, Material, Model, Scene, Texture, TextureSlot, Wrap};
use shadecast_shaders::generated::{EntryGpu, KeyGpu, MaterialGpu, PatchGpu, PoseGpu, VertexGpu};
use std::collections::HashMap;
use std::sync::Arc;

/// A model's place in the shared buffers.
#[derive(Debug)]
pub struct ModelGpu {
    /// First entry in the vertex buffer.
    pub vertex_base: u32,
    /// Vertices.
    pub vertex_count: u32,
    /// First entry in the index buffer; a third of it is the first entry in `patch_of_triangle`.
    pub index_base: u32,
    /// First entry in the patch buffer.
    pub patch_base: u32,
    /// The patches, for the CPU.
    pub patches: Vec<Patch>,
    /// First entry in the material buffer.
    pub material_base: u32,
    bone_base: u32,
    bone_count: u32,
    level_base: u32,
    level_count: u32,
    entry_base: u32,
    entry_count: u32,
    /// Rest pose first, then the clips.
    clips: Vec<ClipGpu>,
}

#[derive(Debug)]
struct ClipGpu {
    key_base: u32,
    timing: ResampledClip,
}

/// An instance's place in the shared buffers.
#[derive(Clone, Debug)]
pub struct InstanceGpu {
    /// Index into the models.
    pub model: usize,
    /// First scene-wide patch number.
    pub first_patch: u32,
    /// First scene-wide vertex number.
    pub first_vertex: u32,
    /// Whether any vertex of it moves.
    pub is_animated: bool,
    /// First vertex among the static or the animated ones, as `is_animated` says.
    pub saved_base: u32,
    /// First palette entry.
    pub palette_base: u32,
    global_base: u32,
}

/// Sizes of the per-instance buffers.
#[derive(Clone, Copy, Debug, Default)]
pub struct Totals {
    /// Patches over all instances.
    pub patches: u32,
    /// Vertices over all instances.
    pub vertices: u32,
    /// Vertices of instances that do not move.
    pub static_vertices: u32,
    /// Vertices of instances that move.
    pub animated_vertices: u32,
    /// Palette entries over all instances.
    pub palette: u32,
    /// Bones over all instances.
    pub bones: u32,
}

/// All of it.
pub struct SceneGpu {
    /// The scene it was made from.
    pub scene: Scene,
    /// By model.
    pub models: Vec<ModelGpu>,
    /// By instance.
    pub instances: Vec<InstanceGpu>,
    /// By instance: a box in the world that it never leaves, over its clip and its path; empty without vertices.
    pub world_bounds: Vec<Bounds>,
    /// Sizes.
    pub totals: Totals,
    /// `VertexGpu` of all models.
    pub vertices: Buffer,
    /// Indices of all models.
    pub indices: Buffer,
    /// `PatchGpu` of all models; materials are scene-wide numbers.
    pub patches: Buffer,
    /// Model patch number of every triangle.
    pub patch_of_triangle: Buffer,
    /// `MaterialGpu`.
    pub materials: Buffer,
    pub(crate) parents: Buffer,
    pub(crate) levels: Buffer,
    pub(crate) keys: Buffer,
    pub(crate) entries: Buffer,
    textures: Vec<Image>,
    samplers: Vec<Sampler>,
    sampler_of_texture: Vec<usize>,
}

/// What goes into the shared buffers, collected model by model.
#[derive(Default)]
struct Arrays {
    vertices: Vec<VertexGpu>,
    indices: Vec<u32>,
    patches: Vec<PatchGpu>,
    patch_of_triangle: Vec<u32>,
    materials: Vec<MaterialGpu>,
    parents: Vec<i32>,
    levels: Vec<u32>,
    keys: Vec<KeyGpu>,
    entries: Vec<EntryGpu>,
}

impl SceneGpu {
    /// Uploads `scene`, its clips resampled at `interval_s`.
    ///
    /// # Errors
    /// Memory, or more textures than [`SCENE_TEXTURES`].
    pub fn new(gpu: &Arc<Gpu>, scene: Scene, interval_s: f32) -> Result<Self, GpuError> {
        let mut arrays = Arrays::default();
        let mut models = Vec::new();
        let mut texture_base = 0;
        for model in &scene.models {
            models.push(arrays.add(model, interval_s, texture_base));
            texture_base += model.textures.len();
        }
        if texture_base > SCENE_TEXTURES as usize {
            return Err(GpuError::NoDevice(format!(
                "the scene has {texture_base} textures, at most {SCENE_TEXTURES} can be bound; use fewer"
            )));
        }
        let (instances, totals) = place_instances(&scene, &models);
        let world_bounds = world_bounds(&scene);
        let surplus = lights::surplus(&scene);
        if surplus > 0 {
            tracing::warn!("{surplus} lights are left out: a scene has at most {MAX_LIGHTS} beside the sun");
        }
        let (textures, samplers, sampler_of_texture) = upload_textures(gpu, &scene)?;
        let local = |name, bytes: &[u8]| Buffer::device_local(gpu, name, bytes);
        Ok(Self {
            vertices: local("vertices", bytemuck::cast_slice(&arrays.vertices))?,
            indices: local("indices", bytemuck::cast_slice(&arrays.indices))?,
            patches: local("patches", bytemuck::cast_slice(&arrays.patches))?,
            patch_of_triangle: local("patch of triangle", bytemuck::cast_slice(&arrays.patch_of_triangle))?,
            materials: local("materials", bytemuck::cast_slice(&arrays.materials))?,
            parents: local("bone parents", bytemuck::cast_slice(&arrays.parents))?,
            levels: local("bone levels", bytemuck::cast_slice(&arrays.levels))?,
            keys: local("keyframes", bytemuck::cast_slice(&arrays.keys))?,
            entries: local("palette entries", bytemuck::cast_slice(&arrays.entries))?,
            scene,
            models,
            instances,
            world_bounds,
            totals,
            textures,
            samplers,
            sampler_of_texture,
        })
    }

    /// Every texture with its sampler, in scene-wide order.
    pub fn texture_binds(&self) -> Vec<(&Image, &Sampler)> {
        self.textures.iter().zip(&self.sampler_of_texture).map(|(t, s)| (t, &self.samplers[*s])).collect()
    }

    /// The instance that a scene-wide patch number belongs to.
    pub fn instance_of_patch(&self, patch: u32) -> usize {
        self.instances.partition_point(|instance| instance.first_patch <= patch) - 1
    }

    /// The instance that a scene-wide vertex number belongs to.
    pub fn instance_of_vertex(&self, vertex: u32) -> usize {
        self.instances.partition_point(|instance| instance.first_vertex <= vertex) - 1
    }

    /// An instance's pose at `time_s`, for the palette stage.
    pub fn pose(&self, index: usize, time_s: f64) -> PoseGpu {
        let (place, instance) = (&self.instances[index], &self.scene.instances[index]);
        let model = &self.models[place.model];
        let clip = &model.clips[instance.clip.map_or(0, |c| c + 1)];
        let phase = instance.clip_phase_s(clip.timing.duration_s, time_s);
        let (key, fraction) = pose::sample_at(&clip.timing, phase);
        let next = (key + 1).min(clip.timing.count as usize - 1);
        PoseGpu {
            world_from_model: rows(instance.world_from_model(time_s)),
            bone_base: model.bone_base,
            level_base: model.level_base,
            level_count: model.level_count,
            key0_base: clip.key_base + key as u32 * model.bone_count,
            key1_base: clip.key_base + next as u32 * model.bone_count,
            fraction,
            entry_base: model.entry_base,
            entry_count: model.entry_count,
            global_base: place.global_base,
            palette_base: place.palette_base,
            reserved0: 0,
            reserved1: 0,
        }
    }

    /// The instances that cast shadows.
    pub fn casters(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.instances.len()).filter(|index| self.scene.instances[*index].casts_shadow)
    }

    /// Whether an instance is ever elsewhere than at first.
    pub fn moves(&self, index: usize) -> bool {
        self.instances[index].is_animated || self.scene.instances[index].path.is_some()
    }

    /// The sun's view of the casters; `None` where it casts no shadows.
    pub fn sun_view(&self) -> Option<SunView> {
        let sun = self.scene.sun;
        let casters = self.casters().map(|index| self.world_bounds[index]);
        if sun.casts_shadows { SunView::around(sun.to_sun, casters) } else { None }
    }

    /// Texture array for a bind group.
    pub fn textures_bind<'a>(binds: &'a [(&'a Image, &'a Sampler)]) -> (&'static str, Bind<'a>) {
        ("textures", Bind::Textures(binds))
    }
}

fn rows(transform: Affine3A) -> [[f32; 4]; 3] {
    let (m, t) = (transform.matrix3, transform.translation);
    [0, 1, 2].map(|r| [m.x_axis[r], m.y_axis[r], m.z_axis[r], t[r]])
}

impl Arrays {
    fn add(&mut self, model: &Model, interval_s: f32, texture_base: usize) -> ModelGpu {
        let patches = Patches::build(model);
        let material_base = self.materials.len() as u32;
        let order = BoneOrder::new(model);
        let result = ModelGpu {
            vertex_base: self.vertices.len() as u32,
            vertex_count: model.vertices.len() as u32,
            index_base: self.indices.len() as u32,
            patch_base: self.patches.len() as u32,
            material_base,
            bone_base: self.parents.len() as u32,
            bone_count: model.bones.len() as u32,
            level_base: self.levels.len() as u32,
            level_count: order.level_starts.len() as u32 - 1,
            entry_base: self.entries.len() as u32,
            entry_count: model.palette.len() as u32,
            clips: self.add_clips(model, &order, interval_s),
            patches: patches.patches.clone(),
        };
        self.vertices.extend(model.vertices.iter().map(vertex));
        self.indices.extend(&model.indices);
        self.patches.extend(patches.patches.iter().map(|p| PatchGpu {
            vertices: p.vertices,
            kind: p.kind as u32,
            material: material_base + p.material,
            reserved: 0,
        }));
        self.patch_of_triangle.extend(&patches.patch_of_triangle);
        self.materials.extend(model.materials.iter().map(|m| material(m, model, texture_base)));
        self.parents.extend(&order.parents);
        self.levels.extend(&order.level_starts);
        self.entries.extend(model.palette.iter().map(|entry| EntryGpu {
            bone_from_mesh: rows(entry.bone_from_mesh),
            bone: [order.new_of_old[entry.bone as usize], 0, 0, 0],
        }));
        result
    }

    fn add_clips(&mut self, model: &Model, order: &BoneOrder, interval_s: f32) -> Vec<ClipGpu> {
        let all = std::iter::once(None).chain((0..model.clips.len()).map(Some));
        all.map(|clip| {
            let mut timing = clip::resample(model, clip, interval_s);
            let key_base = self.keys.len() as u32;
            for sample in timing.samples.chunks_exact(model.bones.len().max(1)) {
                self.keys.extend(order.old_of_new.iter().map(|old| {
                    let key = sample[*old as usize];
                    KeyGpu {
                        translation: key.translation.extend(0.0).to_array(),
                        rotation: key.rotation.to_array(),
                        scale: key.scale.extend(0.0).to_array(),
                    }
                }));
            }
            timing.samples = Vec::new(); // the GPU has them now
            ClipGpu { key_base, timing }
        })
        .collect()
    }
}

/// Bones sorted by depth in the hierarchy, so that one level after the other can be evaluated in parallel.
struct BoneOrder {
    old_of_new: Vec<u32>,
    new_of_old: Vec<u32>,
    /// In the new order; -1 for a root.
    parents: Vec<i32>,
    /// First bone of each level, and the count at the end.
    level_starts: Vec<u32>,
}

impl BoneOrder {
    fn new(model: &Model) -> Self {
        let mut depth = vec![0u32; model.bones.len()];
        for (index, bone) in model.bones.iter().enumerate() {
            depth[index] = bone.parent.map_or(0, |parent| depth[parent as usize] + 1);
        }
        let mut old_of_new: Vec<u32> = (0..model.bones.len() as u32).collect();
        old_of_new.sort_by_key(|old| depth[*old as usize]);
        let mut new_of_old = vec![0; old_of_new.len()];
        for (new, old) in old_of_new.iter().enumerate() {
            new_of_old[*old as usize] = new as u32;
        }
        let parent =
            |old: &u32| model.bones[*old as usize].parent.map_or(-1, |p| new_of_old[p as usize] as i32);
        let parents = old_of_new.iter().map(parent).collect();
        let levels = depth.iter().max().map_or(0, |deepest| deepest + 1);
        let level_starts = (0..=levels)
            .map(|level| old_of_new.partition_point(|old| depth[*old as usize] < level) as u32)
            .collect();
        Self { old_of_new, new_of_old, parents, level_starts }
    }
}

fn vertex(v: &shadecast_scene::Vertex) -> VertexGpu {
    let pair = |a: u16, b: u16| u32::from(a) | u32::from(b) << 16;
    VertexGpu {
        position_u: v.position.extend(v.uv[0]).to_array(),
        normal_v: v.normal.extend(v.uv[1]).to_array(),
        tangent: v.tangent,
        weights: v.weights,
        joints: [pair(v.joints[0], v.joints[1]), pair(v.joints[2], v.joints[3])],
        morphs: [0; 2],
        uv1: v.uv1,
        color: u32::from_le_bytes(v.color),
        reserved: 0,
    }
}

fn material(m: &Material, model: &Model, texture_base: usize) -> MaterialGpu {
    let index = |slot: Option<TextureSlot>| slot.map_or(-1, |s| texture_base as i32 + s.texture as i32);
    let all = [
        m.base_color_texture,
        m.metallic_roughness_texture,
        m.normal_texture,
        m.occlusion_texture,
        m.emissive_texture,
    ];
    let extent = all
        .iter()
        .flatten()
        .map(|t| model.textures[t.texture as usize].extent_texels)
        .map(|[w, h]| w.max(h))
        .max()
        .unwrap_or(0);
    let [r, g, b] = m.emissive;
    MaterialGpu {
        base_color: m.base_color,
        emissive_metallic: [r, g, b, m.metallic],
        roughness: m.roughness,
        normal_scale: m.normal_scale,
        occlusion_strength: m.occlusion_strength,
        alpha_cutoff: m.alpha_cutoff.unwrap_or(-1.0),
        base_color_texture: index(all[0]),
        metallic_roughness_texture: index(all[1]),
        normal_texture: index(all[2]),
        occlusion_texture: index(all[3]),
        emissive_texture: index(all[4]),
        double_sided: u32::from(m.double_sided),
        texture_extent_texels: extent as f32,
        reserved: 0,
    }
}

fn place_instances(scene: &Scene, models: &[ModelGpu]) -> (Vec<InstanceGpu>, Totals) {
    let mut totals = Totals::default();
    let mut place = |instance: &Instance| {
        let (source, model) = (&scene.models[instance.model], &models[instance.model]);
        let is_animated = pose::animated_vertices(source, instance.clip).iter().any(|moves| *moves);
        let saved = if is_animated { &mut totals.animated_vertices } else { &mut totals.static_vertices };
        let saved_base = *saved;
        *saved += model.vertex_count;
        let result = InstanceGpu {
            model: instance.model,
            first_patch: totals.patches,
            first_vertex: totals.vertices,
            is_animated,
            saved_base,
            palette_base: totals.palette,
            global_base: totals.bones,
        };
        totals.patches += model.patches.len() as u32;
        totals.vertices += model.vertex_count;
        totals.palette += model.entry_count;
        totals.bones += model.bone_count;
        result
    };
    let instances = scene.instances.iter().map(&mut place).collect();
    (instances, totals)
}

/// The boxes of all instances; each clip of each model is looked at once.
fn world_bounds(scene: &Scene) -> Vec<Bounds> {
    let mut known = HashMap::new();
    let mut of = |instance: &Instance| {
        let of_model = known
            .entry((instance.model, instance.clip))
            .or_insert_with(|| bounds::model_bounds(&scene.models[instance.model], instance.clip));
        bounds::instance_bounds(instance, *of_model)
    };
    scene.instances.iter().map(&mut of).collect()
}

type Textures = (Vec<Image>, Vec<Sampler>, Vec<usize>);

fn upload_textures(gpu: &Arc<Gpu>, scene: &Scene) -> Result<Textures, GpuError> {
    let mut wraps: Vec<[Wrap; 2]> = Vec::new();
    let (mut images, mut samplers, mut sampler_of_texture) = (Vec::new(), Vec::new(), Vec::new());
    for texture in scene.models.iter().flat_map(|m| &m.textures) {
        let known = wraps.iter().position(|w| *w == texture.wrap);
        sampler_of_texture.push(known.unwrap_or(wraps.len()));
        if known.is_none() {
            wraps.push(texture.wrap);
            samplers.push(Sampler::new(gpu, sampler(texture.wrap))?);
        }
        images.push(upload_texture(gpu, texture)?);
    }
    Ok((images, samplers, sampler_of_texture))
}

fn sampler(wrap: [Wrap; 2]) -> SamplerDesc {
    let mode = |wrap| match wrap {
        Wrap::Repeat => vk::SamplerAddressMode::REPEAT,
        Wrap::Mirror => vk::SamplerAddressMode::MIRRORED_REPEAT,
        Wrap::Clamp => vk::SamplerAddressMode::CLAMP_TO_EDGE,
    };
    SamplerDesc { filter: vk::Filter::LINEAR, wrap: wrap.map(mode), mips: true, anisotropy: 8.0 }
}

/// Uploads an image with a full mip chain, made on the CPU in linear light.
fn upload_texture(gpu: &Arc<Gpu>, texture: &Texture) -> Result<Image, GpuError> {
    let levels = shadecast_scene::mips::chain(texture);
    let image = Image::new(
        gpu,
        ImageDesc {
            name: "texture",
            extent: texture.extent_texels,
            layers: 1,
            mips: levels.len() as u32,
            samples: vk::SampleCountFlags::TYPE_1,
            format: if texture.srgb { vk::Format::R8G8B8A8_SRGB } else { vk::Format::R8G8B8A8_UNORM },
            usage: vk::ImageUsageFlags::SAMPLED | vk::ImageUsageFlags::TRANSFER_DST,
        },
    )?;
    let staging = Buffer::upload(gpu, "texture staging", &levels.concat())?;
    let mut recorder = gpu.record()?;
    let layouts = [
        vk::ImageLayout::UNDEFINED,
        vk::ImageLayout::TRANSFER_DST_OPTIMAL,
        vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL,
    ];
    recorder.transition(&image, [layouts[0], layouts[1]], Access::NONE, Access::COPY_WRITE);
    let mut offset = 0;
    for (mip, level) in levels.iter().enumerate() {
        recorder.write_image(&image, mip as u32, &staging, offset);
        offset += level.len() as u64;
    }
    recorder.transition(&image, [layouts[1], layouts[2]], Access::COPY_WRITE, Access::GRAPHICS_READ);
    gpu.wait(recorder.submit()?)?;
    Ok(image)
}

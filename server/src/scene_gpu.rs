//! The scene in GPU memory, every asset once: geometry, patches, bones, resampled clips, materials, textures.
//!
//! Numbers: a *scene-wide* vertex or patch number counts over all instances, in their order; a *model* number counts
//! within one model.

use crate::animation::manager::AnimationManager;
use crate::culling::Culling;
use crate::lights::{self, SunView};
use crate::stages::skin::Skinning;
use ash::vk;
use shadecast_gpu::{Access, Bind, Buffer, Gpu, GpuError, Image, ImageDesc, Memory, Sampler, SamplerDesc};
use shadecast_protocol::limits::{MAX_LIGHTS, SCENE_TEXTURES};
use shadecast_scene::animation::bounds::{self, Bounds};
use shadecast_scene::animation::pose;
use shadecast_scene::animation::sampling::Sampling;
use shadecast_scene::identity::{ContentHash, texture_hash};
use shadecast_scene::influences::units_of_weight;
use shadecast_scene::patches::Patch;
use shadecast_scene::process::Loading;
use shadecast_scene::{
    Cancel, Cancelled, Instance, Material, Model, Scene, Texture, TextureSlot, Vertex, Wrap,
};
use shadecast_shaders::constants::{
    BASE_COLOR_SLOT, EMISSIVE_SLOT, MAX_INFLUENCES, METALLIC_ROUGHNESS_SLOT, NO_ALPHA_CUTOFF, NO_TEXTURE,
    NORMAL_SLOT, OCCLUSION_SLOT, TEXTURE_SLOTS,
};
use shadecast_shaders::generated::{MaterialGpu, MorphDeltaGpu, PackedVertexGpu, PatchGpu, VertexGpu};
use std::collections::HashMap;
use std::ops::Range;
use std::sync::Arc;

/// A model's place in the shared buffers.
#[derive(Debug)]
pub struct ModelGpu {
    /// Its mesh, which other models may share.
    pub mesh: MeshGpu,
    /// First entry in the material buffer.
    pub material_base: u32,
}

impl std::ops::Deref for ModelGpu {
    type Target = MeshGpu;

    fn deref(&self) -> &MeshGpu {
        &self.mesh
    }
}

/// A mesh's place in the shared buffers; equal meshes have one.
#[derive(Clone, Debug)]
pub struct MeshGpu {
    /// First entry in the vertex buffer.
    pub vertex_base: u32,
    /// Vertices.
    pub vertex_count: u32,
    /// First entry in the index buffer; a third of it is the first entry in `patch_of_triangle`.
    pub index_base: u32,
    /// First entry in the patch buffer.
    pub patch_base: u32,
    /// The patches, for the CPU.
    pub patches: Arc<[Patch]>,
    /// Whether any morph target moves its vertices.
    pub has_morphs: bool,
    /// Entries in the packed vertices, those of 1, 2, 3 and 4 influences.
    pub packed: [Range<u32>; MAX_INFLUENCES as usize],
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
    /// Morph targets over all instances.
    pub morphs: u32,
}

/// Why a scene was not brought to a device.
#[derive(Debug, thiserror::Error)]
pub enum SceneGpuError {
    /// The device, or a scene that is too large for it.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// Somebody asked to end.
    #[error("loading was interrupted")]
    Cancelled(#[from] Cancelled),
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
    /// How vertices are skinned.
    pub skinning: Skinning,
    /// Skeletons and clips.
    pub animation: AnimationBuffers,
    /// `PackedVertexGpu` of all meshes, where the skinning uses them.
    pub packed_vertices: Buffer,
    /// `MorphDeltaGpu` of all meshes, by vertex.
    pub morph_deltas: Buffer,
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
    packed: Vec<PackedVertexGpu>,
    morph_deltas: Vec<MorphDeltaGpu>,
    /// Meshes that are there already.
    meshes: HashMap<ContentHash, MeshGpu>,
}

/// How a scene is brought to the GPU.
#[derive(Clone, Copy, Debug, Default)]
pub struct SceneOptions {
    /// How clips become keys.
    pub sampling: Sampling,
    /// How vertices are skinned.
    pub skinning: Skinning,
}

/// The animation manager with its arrays on the GPU.
pub struct AnimationBuffers {
    /// Skeletons, clips and who uses them; its arrays are empty, the GPU has them.
    pub manager: AnimationManager,
    /// Bytes of the arrays.
    pub bytes: u64,
    pub(crate) level_starts: Buffer,
    parents: Buffer,
    tracks: Buffer,
    keys: Buffer,
    key_times: Buffer,
    entries: Buffer,
}

impl AnimationBuffers {
    fn new(gpu: &Arc<Gpu>, mut manager: AnimationManager) -> Result<Self, GpuError> {
        let arrays = std::mem::take(&mut manager.arrays);
        Ok(Self {
            manager,
            bytes: arrays.bytes(),
            level_starts: filled(gpu, "bone levels", &arrays.level_starts)?,
            parents: filled(gpu, "bone parents", &arrays.parents)?,
            tracks: filled(gpu, "animation meta", &arrays.tracks)?,
            keys: filled(gpu, "keyframes", &arrays.keys)?,
            key_times: filled(gpu, "keyframe times", &arrays.key_times)?,
            entries: filled(gpu, "inverse bind matrices", &arrays.entries)?,
        })
    }

    /// What evaluates a bone.
    pub(crate) fn binds(&self) -> Vec<(&'static str, Bind<'_>)> {
        vec![
            ("Parents", Bind::Buffer(&self.parents)),
            ("Tracks", Bind::Buffer(&self.tracks)),
            ("Keys", Bind::Buffer(&self.keys)),
            ("KeyTimes", Bind::Buffer(&self.key_times)),
            ("Entries", Bind::Buffer(&self.entries)),
        ]
    }
}

/// A device-local buffer of an array that may be empty; Vulkan has no empty buffers.
fn filled<T: bytemuck::Pod>(gpu: &Arc<Gpu>, name: &str, data: &[T]) -> Result<Buffer, GpuError> {
    check_room(gpu, name, size_of_val(data) as u64)?;
    match data.is_empty() {
        true => Buffer::new(gpu, name, 64, Memory::Device),
        false => Buffer::device_local(gpu, name, data),
    }
}

impl SceneGpu {
    /// Uploads `scene`, its clips sampled.
    ///
    /// # Errors
    /// Memory, or more than the device can bind.
    pub fn new(gpu: &Arc<Gpu>, scene: Scene, options: &SceneOptions) -> Result<Self, SceneGpuError> {
        Self::cached(gpu, scene, options, &Loading::plain())
    }

    /// As [`Self::new`], with clips that were sampled before taken from the cache, until somebody asks to end.
    ///
    /// # Errors
    /// Those of [`Self::new`], and that somebody asked to end.
    pub fn cached(
        gpu: &Arc<Gpu>,
        scene: Scene,
        options: &SceneOptions,
        loading: &Loading,
    ) -> Result<Self, SceneGpuError> {
        let manager = AnimationManager::new(&scene, options.sampling, loading)?;
        let mut arrays = Arrays::default();
        let mut textures = UniqueTextures::default();
        let models: Vec<ModelGpu> = scene
            .models
            .iter()
            .zip(&manager.materials)
            .map(|(model, material)| {
                arrays.add(model, material.mesh, &textures.add(&model.textures), options.skinning)
            })
            .collect();
        let count = textures.unique.len();
        if count > SCENE_TEXTURES as usize {
            return Err(GpuError::TooLarge(format!(
                "the scene has {count} textures, at most {SCENE_TEXTURES} can be bound; use fewer"
            ))
            .into());
        }
        let (instances, totals) = place_instances(&scene, &models);
        let world_bounds = world_bounds(&scene, &loading.cancel)?;
        let surplus = lights::surplus(&scene);
        if surplus > 0 {
            tracing::warn!("{surplus} lights are left out: a scene has at most {MAX_LIGHTS} beside the sun");
        }
        let (textures, samplers, sampler_of_texture) =
            upload_textures(gpu, &textures.unique, &loading.cancel)?;
        let local = |name, bytes: &[u8]| {
            check_room(gpu, name, bytes.len() as u64)?;
            Buffer::device_local(gpu, name, bytes)
        };
        Ok(Self {
            vertices: local("vertices", bytemuck::cast_slice(&arrays.vertices))?,
            indices: local("indices", bytemuck::cast_slice(&arrays.indices))?,
            patches: local("patches", bytemuck::cast_slice(&arrays.patches))?,
            patch_of_triangle: local("patch of triangle", bytemuck::cast_slice(&arrays.patch_of_triangle))?,
            materials: local("materials", bytemuck::cast_slice(&arrays.materials))?,
            skinning: options.skinning,
            animation: AnimationBuffers::new(gpu, manager)?,
            packed_vertices: filled(gpu, "packed vertices", &arrays.packed)?,
            morph_deltas: filled(gpu, "morph targets", &arrays.morph_deltas)?,
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

    /// The instances that cast shadows.
    pub fn casters(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.instances.len()).filter(|index| self.scene.instances[*index].casts_shadow)
    }

    /// Which instances views need, for one client.
    pub fn culling(&self) -> Culling {
        let sun = self.scene.sun;
        let casts_shadow = |index: usize| self.scene.instances[index].casts_shadow;
        Culling::new(&self.world_bounds, casts_shadow, sun.casts_shadows.then_some(sun.to_sun))
    }

    /// Whether an instance is ever elsewhere than at first.
    pub fn moves(&self, index: usize) -> bool {
        self.instances[index].is_animated
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

/// That the device can bind so many bytes of `what` as one buffer.
///
/// # Errors
/// It cannot; the text says what to do.
pub fn check_room(gpu: &Gpu, what: &str, bytes: u64) -> Result<(), GpuError> {
    check_room_within(gpu.max_storage_buffer_bytes(), what, bytes)
}

fn check_room_within(most: u64, what: &str, bytes: u64) -> Result<(), GpuError> {
    if bytes <= most {
        return Ok(());
    }
    Err(GpuError::TooLarge(format!(
        "{} MiB are needed for the {what}, this device binds at most {} MiB at once; use fewer or smaller models",
        bytes.div_ceil(1 << 20),
        most >> 20
    )))
}

impl Arrays {
    fn add(&mut self, model: &Model, hash: ContentHash, textures: &[u32], skinning: Skinning) -> ModelGpu {
        let material_base = self.materials.len() as u32;
        self.materials.extend(model.materials.iter().map(|m| material(m, model, textures)));
        let mesh = match self.meshes.get(&hash) {
            Some(known) => known.clone(),
            None => self.add_mesh(model, skinning),
        };
        self.meshes.insert(hash, mesh.clone());
        ModelGpu { mesh, material_base }
    }

    fn add_mesh(&mut self, model: &Model, skinning: Skinning) -> MeshGpu {
        let patches = model.patches_of(0).into_owned();
        let packed = if skinning == Skinning::Packed { self.add_packed(model) } else { Default::default() };
        let mesh = MeshGpu {
            vertex_base: self.vertices.len() as u32,
            vertex_count: model.vertices.len() as u32,
            index_base: self.indices.len() as u32,
            patch_base: self.patches.len() as u32,
            has_morphs: !model.morphs.is_empty(),
            packed,
            patches: patches.patches.into(),
        };
        let morphs = self.add_morphs(model);
        let vertices = model.vertices.iter().zip(morphs);
        self.vertices.extend(vertices.map(|(v, morphs)| VertexGpu { morphs, ..vertex(v) }));
        self.indices.extend(&model.indices);
        self.patches.extend(mesh.patches.iter().map(|p| PatchGpu {
            vertices: p.vertices,
            kind: p.kind as u32,
            material: p.material,
            reserved: 0,
        }));
        self.patch_of_triangle.extend(&patches.patch_of_triangle);
        mesh
    }

    /// Sorts the morph targets' deltas by vertex; returns the first delta of each vertex and their number.
    fn add_morphs(&mut self, model: &Model) -> Vec<[u32; 2]> {
        let mut of_vertex: Vec<Vec<MorphDeltaGpu>> = vec![Vec::new(); model.vertices.len()];
        for (morph, source) in model.morphs.iter().enumerate() {
            for delta in &source.deltas {
                of_vertex[delta.vertex as usize].push(MorphDeltaGpu {
                    position: delta.position.to_array(),
                    morph: morph as u32,
                    normal: delta.normal.to_array(),
                    tangent: delta.tangent.to_array(),
                    reserved0: 0,
                    reserved1: 0,
                });
            }
        }
        let place = |deltas: Vec<MorphDeltaGpu>| {
            let range = [self.morph_deltas.len() as u32, deltas.len() as u32];
            self.morph_deltas.extend(deltas);
            range
        };
        of_vertex.into_iter().map(place).collect()
    }

    /// Positions with their influences, sorted by the number of influences.
    fn add_packed(&mut self, model: &Model) -> [Range<u32>; MAX_INFLUENCES as usize] {
        [1, 2, 3, 4].map(|count| {
            let first = self.packed.len() as u32;
            let vertices = (0..).zip(&model.vertices).filter(|(_, v)| v.influences().max(1) == count);
            self.packed.extend(vertices.map(|(index, v)| packed(index, v)));
            first..self.packed.len() as u32
        })
    }
}

fn packed(index: u32, v: &Vertex) -> PackedVertexGpu {
    let (joints, weights) = used_first(v);
    let units = weights.map(units_of_weight);
    let [x, y, z] = v.position.to_array().map(f32::to_bits);
    PackedVertexGpu {
        position_joints: [x, y, z, pair(joints[0], joints[1])],
        influences: [pair(joints[2], joints[3]), pair(units[0], units[1]), pair(units[2], units[3]), index],
    }
}

/// A vertex's influences in their order, those of weight 0 last: shaders stop at the first one.
fn used_first(v: &Vertex) -> ([u16; 4], [f32; 4]) {
    let mut slots = [0, 1, 2, 3];
    slots.sort_by_key(|slot| v.weights[*slot] <= 0.0);
    (slots.map(|slot| v.joints[slot]), slots.map(|slot| v.weights[slot]))
}

fn pair(low: u16, high: u16) -> u32 {
    u32::from(low) | u32::from(high) << 16
}

fn vertex(v: &Vertex) -> VertexGpu {
    let (joints, weights) = used_first(v);
    VertexGpu {
        position_u: v.position.extend(v.uv[0]).to_array(),
        normal_v: v.normal.extend(v.uv[1]).to_array(),
        tangent: v.tangent,
        weights,
        joints: [pair(joints[0], joints[1]), pair(joints[2], joints[3])],
        morphs: [0; 2],
        uv1: v.uv1,
        color: u32::from_le_bytes(v.color),
        reserved: 0,
    }
}

/// A material's textures by slot.
type TextureSlots = [Option<TextureSlot>; SLOTS];
const SLOTS: usize = TEXTURE_SLOTS as usize;

fn texture_slots(m: &Material) -> TextureSlots {
    let mut slots = [None; SLOTS];
    slots[BASE_COLOR_SLOT as usize] = m.base_color_texture;
    slots[METALLIC_ROUGHNESS_SLOT as usize] = m.metallic_roughness_texture;
    slots[NORMAL_SLOT as usize] = m.normal_texture;
    slots[OCCLUSION_SLOT as usize] = m.occlusion_texture;
    slots[EMISSIVE_SLOT as usize] = m.emissive_texture;
    slots
}

fn material(m: &Material, model: &Model, textures: &[u32]) -> MaterialGpu {
    let index = |slot: Option<TextureSlot>| slot.map_or(NO_TEXTURE, |s| textures[s.texture as usize] as i32);
    let all = texture_slots(m);
    let texels = |set: u32| {
        let of_set = all.iter().flatten().filter(|slot| slot.set == set);
        of_set.map(|slot| texels_per_unit(slot, &model.textures)).fold(0.0, f32::max)
    };
    let [r, g, b] = m.emissive;
    MaterialGpu {
        base_color: m.base_color,
        emissive_metallic: [r, g, b, m.metallic],
        roughness: m.roughness,
        normal_scale: m.normal_scale,
        occlusion_strength: m.occlusion_strength,
        alpha_cutoff: m.alpha_cutoff.unwrap_or(NO_ALPHA_CUTOFF),
        base_color_texture: index(m.base_color_texture),
        metallic_roughness_texture: index(m.metallic_roughness_texture),
        normal_texture: index(m.normal_texture),
        occlusion_texture: index(m.occlusion_texture),
        emissive_texture: index(m.emissive_texture),
        double_sided: u32::from(m.double_sided),
        texture_extent_texels: texels(0),
        texture_extent1_texels: texels(1),
        uv_rows: uv_rows(all),
        unlit: u32::from(m.unlit),
        reserved: [0; 3],
    }
}

/// Largest number of texels that one unit of the vertices' texture coordinates can cover.
fn texels_per_unit(slot: &TextureSlot, textures: &[Texture]) -> f32 {
    let [width, height] = textures[slot.texture as usize].extent_texels;
    let [[a, b, _], [c, d, _]] = slot.uv_transform;
    // The larger singular value of the 2x2 part.
    let (p, q, r) = (a * a + c * c, b * b + d * d, a * b + c * d);
    let stretch = ((p + q) / 2.0 + ((p - q) / 2.0).hypot(r)).sqrt();
    width.max(height) as f32 * stretch
}

/// By slot the rows of its matrix; the first row's w is its set.
fn uv_rows(slots: TextureSlots) -> [[f32; 4]; 2 * SLOTS] {
    let mut rows = [[0.0; 4]; 2 * SLOTS];
    for (at, slot) in slots.into_iter().enumerate() {
        let slot = slot.unwrap_or_else(|| 0.into());
        let [[a, b, x], [c, d, y]] = slot.uv_transform;
        rows[2 * at] = [a, b, x, slot.set as f32];
        rows[2 * at + 1] = [c, d, y, 0.0];
    }
    rows
}

fn place_instances(scene: &Scene, models: &[ModelGpu]) -> (Vec<InstanceGpu>, Totals) {
    let mut totals = Totals::default();
    let mut place = |instance: &Instance| {
        let (source, model) = (&scene.models[instance.model], &models[instance.model]);
        let is_animated = instance.path.is_some()
            || pose::animated_vertices(source, instance.clip).iter().any(|moves| *moves);
        let saved = if is_animated { &mut totals.animated_vertices } else { &mut totals.static_vertices };
        let saved_base = *saved;
        *saved += model.vertex_count;
        let result = InstanceGpu {
            model: instance.model,
            first_patch: totals.patches,
            first_vertex: totals.vertices,
            is_animated,
            saved_base,
        };
        totals.patches += model.patches.len() as u32;
        totals.vertices += model.vertex_count;
        totals.palette += source.palette.len() as u32;
        totals.bones += source.bones.len() as u32;
        totals.morphs += source.morphs.len() as u32;
        result
    };
    let instances = scene.instances.iter().map(&mut place).collect();
    (instances, totals)
}

/// The boxes of all instances; each clip of each model is looked at once.
fn world_bounds(scene: &Scene, cancel: &Cancel) -> Result<Vec<Bounds>, Cancelled> {
    let mut known = HashMap::new();
    let mut of = |instance: &Instance| {
        cancel.check()?;
        let of_model = known
            .entry((instance.model, instance.clip))
            .or_insert_with(|| bounds::model_bounds(&scene.models[instance.model], instance.clip));
        Ok(bounds::instance_bounds(instance, *of_model))
    };
    scene.instances.iter().map(&mut of).collect()
}

type Textures = (Vec<Image>, Vec<Sampler>, Vec<usize>);

/// Textures of all models, equal ones once.
#[derive(Default)]
struct UniqueTextures<'a> {
    unique: Vec<&'a Texture>,
    known: HashMap<ContentHash, u32>,
}

impl<'a> UniqueTextures<'a> {
    /// The scene-wide numbers of a model's textures.
    fn add(&mut self, textures: &'a [Texture]) -> Vec<u32> {
        let mut number = |texture: &'a Texture| {
            *self.known.entry(texture_hash(texture)).or_insert_with(|| {
                self.unique.push(texture);
                self.unique.len() as u32 - 1
            })
        };
        textures.iter().map(&mut number).collect()
    }
}

fn upload_textures(
    gpu: &Arc<Gpu>,
    textures: &[&Texture],
    cancel: &Cancel,
) -> Result<Textures, SceneGpuError> {
    let mut wraps: Vec<[Wrap; 2]> = Vec::new();
    let (mut images, mut samplers, mut sampler_of_texture) = (Vec::new(), Vec::new(), Vec::new());
    for texture in textures.iter().copied() {
        cancel.check()?;
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
            mips: levels.len() as u32,
            ..ImageDesc::new(
                "texture",
                texture.extent_texels,
                if texture.srgb { vk::Format::R8G8B8A8_SRGB } else { vk::Format::R8G8B8A8_UNORM },
                vk::ImageUsageFlags::SAMPLED | vk::ImageUsageFlags::TRANSFER_DST,
            )
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

//! Descriptor layouts from reflection, and descriptor sets bound by GLSL's names.

use crate::memory::Garbage;
use crate::ycbcr::{YcbcrImage, YcbcrSampler};
use crate::{Buffer, Doing, Gpu, GpuError, Image, ImageLevel, Sampler, limits};
use ash::vk;
use shadecast_spirv::{Binding, BindingKind, Shader, Stage};
use std::sync::Arc;

/// Descriptor set layout and pipeline layout of one or two shaders.
pub struct Layout {
    gpu: Arc<Gpu>,
    pub(crate) handle: vk::PipelineLayout,
    set_layout: vk::DescriptorSetLayout,
    bindings: Vec<(Binding, vk::ShaderStageFlags)>,
    pub(crate) push_stages: vk::ShaderStageFlags,
    pub(crate) push_bytes: u32,
    /// Part of the layout.
    fixed: Option<FixedSampler>,
    name: &'static str,
}

/// A sampler that is part of a layout, and the names of its bindings.
pub type FixedSampler = (&'static [&'static str], Arc<YcbcrSampler>);

/// A picture of a platform's format may take as many descriptors as it has planes.
const DESCRIPTORS_PER_PICTURE: u32 = 4;

/// A resource for a binding.
#[derive(Clone, Copy)]
pub enum Bind<'a> {
    /// A whole buffer, storage or uniform as the shader says.
    Buffer(&'a Buffer),
    /// Whole storage buffers for an array of them, one at least; elements that are left have the first.
    Buffers(&'a [Buffer]),
    /// An image to sample, in SHADER_READ_ONLY_OPTIMAL.
    Sampled(&'a Image, &'a Sampler),
    /// A picture, in SHADER_READ_ONLY_OPTIMAL, for the layout's own sampler.
    Picture(&'a YcbcrImage),
    /// Images for a texture array, from element 0 on.
    Textures(&'a [(&'a Image, &'a Sampler)]),
    /// A mip level as a storage image, in GENERAL.
    Storage(&'a ImageLevel),
}

/// A descriptor set.
pub struct BindGroup {
    gpu: Arc<Gpu>,
    pool: vk::DescriptorPool,
    pub(crate) set: vk::DescriptorSet,
}

impl Layout {
    /// The layout that reflection found in `shaders` (one compute shader, or a vertex and a fragment shader).
    pub fn new(gpu: &Arc<Gpu>, shaders: &[&Shader]) -> Result<Arc<Self>, GpuError> {
        Self::fixing(gpu, shaders, None, 0)
    }

    /// The same with a sampler that is part of it, and places for so many textures in an array whose length GLSL leaves open.
    pub fn fixing(
        gpu: &Arc<Gpu>,
        shaders: &[&Shader],
        fixed: Option<FixedSampler>,
        textures: u32,
    ) -> Result<Arc<Self>, GpuError> {
        let mut bindings = merged(shaders);
        let is_open: Vec<_> = bindings.iter().map(|(binding, _)| binding.count == 0).collect();
        // Vulkan wants a place even where a scene has no textures.
        let open = bindings.iter_mut().filter(|(binding, _)| binding.count == 0);
        open.for_each(|(binding, _)| binding.count = textures.max(1));
        let name = shaders.last().map_or("", |s| s.name);
        check_descriptors(gpu, name, &bindings, fixed.as_ref().map_or(&[], |(names, _)| names))?;
        let samplers: Vec<_> = fixed.iter().map(|(_, sampler)| sampler.handle).collect();
        let infos: Vec<_> = bindings
            .iter()
            .map(|(binding, stages)| {
                let info = vk::DescriptorSetLayoutBinding::default()
                    .binding(binding.index)
                    .descriptor_type(descriptor_type(binding.kind))
                    .descriptor_count(binding.count)
                    .stage_flags(*stages);
                match &fixed {
                    Some((names, _)) if names.contains(&binding.name) => info.immutable_samplers(&samplers),
                    _ => info,
                }
            })
            .collect();
        let flags: Vec<_> = is_open
            .iter()
            .map(|is_open| match is_open {
                true => vk::DescriptorBindingFlags::PARTIALLY_BOUND,
                false => vk::DescriptorBindingFlags::empty(),
            })
            .collect();
        let mut flag_info = vk::DescriptorSetLayoutBindingFlagsCreateInfo::default().binding_flags(&flags);
        let mut info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&infos);
        if is_open.contains(&true) {
            info = info.push_next(&mut flag_info);
        }
        let push_bytes = shaders.iter().map(|s| s.push_bytes).max().unwrap_or(0);
        let push_stages = shaders
            .iter()
            .filter(|s| s.push_bytes > 0)
            .fold(vk::ShaderStageFlags::empty(), |flags, s| flags | stage_flag(s.stage));
        let ranges = [vk::PushConstantRange { stage_flags: push_stages, offset: 0, size: push_bytes }];
        // SAFETY: the device is alive; all that the create infos point to lives through the calls.
        let (set_layout, handle) = unsafe {
            let set_layout = gpu.device().create_descriptor_set_layout(&info, None);
            let set_layout = set_layout.doing("creating a descriptor set layout")?;
            let sets = [set_layout];
            let mut info = vk::PipelineLayoutCreateInfo::default().set_layouts(&sets);
            if push_bytes > 0 {
                info = info.push_constant_ranges(&ranges);
            }
            let handle = gpu.device().create_pipeline_layout(&info, None);
            (set_layout, handle.doing("creating a pipeline layout")?)
        };
        let gpu = gpu.clone();
        Ok(Arc::new(Self { gpu, handle, set_layout, bindings, push_stages, push_bytes, fixed, name }))
    }

    fn find(&self, name: &str) -> &Binding {
        self.bindings
            .iter()
            .map(|(binding, _)| binding)
            .find(|binding| binding.name == name)
            .unwrap_or_else(|| panic!("{} has no binding {name}", self.name))
    }
}

impl Drop for Layout {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::Layout(self.handle, self.set_layout));
    }
}

fn merged(shaders: &[&Shader]) -> Vec<(Binding, vk::ShaderStageFlags)> {
    let mut bindings: Vec<(Binding, vk::ShaderStageFlags)> = Vec::new();
    for shader in shaders {
        for binding in shader.bindings {
            match bindings.iter_mut().find(|(b, _)| b.index == binding.index) {
                Some((known, stages)) => {
                    assert_eq!(known.name, binding.name, "{}: two names at one binding", shader.name);
                    *stages |= stage_flag(shader.stage);
                }
                None => bindings.push((*binding, stage_flag(shader.stage))),
            }
        }
    }
    bindings.sort_by_key(|(b, _)| b.index);
    bindings
}

/// That a stage, and the set, may have as many descriptors. A picture for a sampler of the layout may take several.
fn check_descriptors(
    gpu: &Gpu,
    shader: &str,
    bindings: &[(Binding, vk::ShaderStageFlags)],
    fixed: &[&str],
) -> Result<(), GpuError> {
    let count = |kind: Option<BindingKind>, stages| -> u64 {
        let counted =
            bindings.iter().filter(|(b, s)| kind.is_none_or(|kind| b.kind == kind) && s.intersects(stages));
        let places =
            counted.map(|(b, _)| if fixed.contains(&b.name) { DESCRIPTORS_PER_PICTURE } else { b.count });
        places.map(u64::from).sum()
    };
    let check = |limit, needed| limits::check(gpu.limits(), limit, shader, needed, "update the driver");
    for stage in [vk::ShaderStageFlags::VERTEX, vk::ShaderStageFlags::FRAGMENT, vk::ShaderStageFlags::COMPUTE]
    {
        for (limit, kind) in limits::OF_STAGES {
            check(limit, count(kind, stage))?;
        }
    }
    limits::OF_SETS
        .into_iter()
        .try_for_each(|(limit, kind)| check(limit, count(Some(kind), vk::ShaderStageFlags::ALL)))
}

pub(crate) fn stage_flag(stage: Stage) -> vk::ShaderStageFlags {
    match stage {
        Stage::Vertex => vk::ShaderStageFlags::VERTEX,
        Stage::Fragment => vk::ShaderStageFlags::FRAGMENT,
        Stage::Compute => vk::ShaderStageFlags::COMPUTE,
    }
}

fn descriptor_type(kind: BindingKind) -> vk::DescriptorType {
    match kind {
        BindingKind::UniformBuffer => vk::DescriptorType::UNIFORM_BUFFER,
        BindingKind::StorageBuffer => vk::DescriptorType::STORAGE_BUFFER,
        BindingKind::SampledImage => vk::DescriptorType::COMBINED_IMAGE_SAMPLER,
        BindingKind::StorageImage => vk::DescriptorType::STORAGE_IMAGE,
    }
}

impl BindGroup {
    /// A set of `layout` with every binding bound by name. What is bound must outlive the group's use.
    ///
    /// # Panics
    /// A name that the shaders do not have, or a binding left out: mistakes of ours.
    pub fn new(layout: &Layout, binds: &[(&str, Bind<'_>)]) -> Result<Self, GpuError> {
        for (binding, _) in &layout.bindings {
            let bound = binds.iter().any(|(name, _)| *name == binding.name);
            assert!(bound, "{}: binding {} is left out", layout.name, binding.name);
        }
        let gpu = &layout.gpu;
        let sizes: Vec<_> = layout
            .bindings
            .iter()
            .map(|(b, _)| {
                let is_fixed = layout.fixed.as_ref().is_some_and(|(names, _)| names.contains(&b.name));
                let descriptor_count = if is_fixed { DESCRIPTORS_PER_PICTURE } else { b.count };
                vk::DescriptorPoolSize { ty: descriptor_type(b.kind), descriptor_count }
            })
            .collect();
        let info = vk::DescriptorPoolCreateInfo::default().max_sets(1).pool_sizes(&sizes);
        // SAFETY: the pool holds exactly one set of this layout.
        let (pool, set) = unsafe {
            let pool =
                gpu.device().create_descriptor_pool(&info, None).doing("creating a descriptor pool")?;
            let layouts = [layout.set_layout];
            let info = vk::DescriptorSetAllocateInfo::default().descriptor_pool(pool).set_layouts(&layouts);
            let sets = gpu.device().allocate_descriptor_sets(&info).doing("allocating a descriptor set")?;
            (pool, sets[0])
        };
        let group = Self { gpu: gpu.clone(), pool, set };
        for (name, bind) in binds {
            group.write(layout.find(name), bind)?;
        }
        Ok(group)
    }

    /// As [`Self::new`], but `candidates` may have names that the shaders lack: for variants of one stage.
    pub fn of(layout: &Layout, candidates: &[(&str, Bind<'_>)]) -> Result<Self, GpuError> {
        let known = |name: &str| layout.bindings.iter().any(|(binding, _)| binding.name == name);
        let binds: Vec<_> = candidates.iter().filter(|(name, _)| known(name)).copied().collect();
        Self::new(layout, &binds)
    }

    /// Binds another image or picture to `name`, of the group's own layout. No submitted work uses the group. Allocates nothing.
    ///
    /// # Panics
    /// With a bind of another kind.
    pub fn rebind(&mut self, layout: &Layout, name: &str, bind: &Bind<'_>) {
        let binding = layout.find(name);
        let infos = match bind {
            Bind::Sampled(image, sampler) => [of_sampled(image, sampler)],
            Bind::Picture(picture) => [of_picture(picture)],
            _ => panic!("{name}: images and pictures alone are bound anew"),
        };
        let write = vk::WriteDescriptorSet::default()
            .dst_set(self.set)
            .dst_binding(binding.index)
            .descriptor_type(descriptor_type(binding.kind))
            .image_info(&infos);
        // SAFETY: no submitted work uses the set; the image is alive.
        unsafe { self.gpu.device().update_descriptor_sets(&[write], &[]) };
    }

    fn write(&self, binding: &Binding, bind: &Bind<'_>) -> Result<(), GpuError> {
        let whole = |buffer: &Buffer| {
            check_range(&self.gpu, binding, buffer.size())?;
            Ok(vk::DescriptorBufferInfo::default().buffer(buffer.handle).range(vk::WHOLE_SIZE))
        };
        let mut buffers = Vec::new();
        let mut images = Vec::new();
        match bind {
            Bind::Buffer(buffer) => buffers.push(whole(buffer)?),
            Bind::Buffers(all) => {
                let places = (0..binding.count as usize).map(|at| whole(all.get(at).unwrap_or(&all[0])));
                buffers = places.collect::<Result<_, GpuError>>()?;
            }
            Bind::Sampled(image, sampler) => images.push(of_sampled(image, sampler)),
            Bind::Picture(picture) => images.push(of_picture(picture)),
            Bind::Textures(all) => {
                assert!(all.len() <= binding.count as usize, "{}: a layout for fewer", binding.name);
                images.extend(all.iter().map(|(i, s)| of_sampled(i, s)));
            }
            Bind::Storage(level) => images.push(
                vk::DescriptorImageInfo::default()
                    .image_view(level.view)
                    .image_layout(vk::ImageLayout::GENERAL),
            ),
        }
        if buffers.is_empty() && images.is_empty() {
            return Ok(());
        }
        let write = vk::WriteDescriptorSet::default()
            .dst_set(self.set)
            .dst_binding(binding.index)
            .descriptor_type(descriptor_type(binding.kind));
        // Each setter sets the count, so only one may be called.
        let write = if images.is_empty() { write.buffer_info(&buffers) } else { write.image_info(&images) };
        // SAFETY: no submitted work uses the set; the resources are alive.
        unsafe { self.gpu.device().update_descriptor_sets(&[write], &[]) };
        Ok(())
    }
}

/// That the device can bind a buffer of this size as a whole.
fn check_range(gpu: &Gpu, binding: &Binding, bytes: u64) -> Result<(), GpuError> {
    let limit = match binding.kind {
        BindingKind::UniformBuffer => "maxUniformBufferRange",
        _ => "maxStorageBufferRange",
    };
    let what = format!("the buffer {}, in bytes,", binding.name);
    limits::check(gpu.limits(), limit, &what, bytes, "use fewer or smaller models")
}

fn of_sampled(image: &Image, sampler: &Sampler) -> vk::DescriptorImageInfo {
    vk::DescriptorImageInfo::default()
        .image_view(image.view)
        .sampler(sampler.handle)
        .image_layout(vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL)
}

/// The layout has the sampler.
fn of_picture(picture: &YcbcrImage) -> vk::DescriptorImageInfo {
    vk::DescriptorImageInfo::default()
        .image_view(picture.image.view)
        .image_layout(vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL)
}

impl Drop for BindGroup {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::DescriptorPool(self.pool));
    }
}

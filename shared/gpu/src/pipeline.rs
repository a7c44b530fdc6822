//! Pipelines from reflected shaders.

use crate::bind::{FixedSampler, Layout};
use crate::pass::{OfViews, RenderPass};
use crate::shared_pipelines::Made;
use crate::{Doing, Gpu, GpuError};
use ash::vk;
use shadecast_spirv::Shader;
use std::hash::{Hash, Hasher};
use std::sync::Arc;

/// A compute pipeline with its layout. Those of the same shader and constants are one.
pub struct ComputePipeline {
    made: Arc<Made>,
    workgroup: [u32; 3],
}

/// A vertex buffer's content, one attribute per entry, tight, in location order.
#[derive(Clone, Copy, Debug)]
pub struct VertexInput<'a> {
    /// Formats and byte offsets.
    pub attributes: &'a [(vk::Format, u32)],
    /// Bytes per vertex.
    pub stride_bytes: u32,
}

/// What a graphics pipeline is, beyond its shaders. Viewport and scissor are dynamic.
#[derive(Clone, Copy)]
pub struct GraphicsPipelineDesc<'a> {
    /// Vertex shader.
    pub vertex: &'a Shader,
    /// Fragment shader.
    pub fragment: &'a Shader,
    /// The pass it draws in.
    pub pass: &'a RenderPass,
    /// Topology.
    pub topology: vk::PrimitiveTopology,
    /// Which faces are dropped; front is counter-clockwise as glTF has it.
    pub cull: vk::CullModeFlags,
    /// `Some(write)`: tested against reversed depth (nearer is greater, equal passes).
    pub depth_write: Option<bool>,
    /// Alpha blending (over).
    pub blend: bool,
    /// A vertex buffer; `None` where the shader pulls its vertices.
    pub vertex_input: Option<VertexInput<'a>>,
    /// Textures of the scene, where a shader reads them.
    pub textures: u32,
    /// Specialisation constants of both shaders, numbered as they stand.
    pub constants: &'a [u32],
}

impl<'a> GraphicsPipelineDesc<'a> {
    /// Triangles, none of them culled; no depth, no blending, no vertex buffer.
    pub fn new(vertex: &'a Shader, fragment: &'a Shader, pass: &'a RenderPass) -> Self {
        Self {
            vertex,
            fragment,
            pass,
            topology: vk::PrimitiveTopology::TRIANGLE_LIST,
            cull: vk::CullModeFlags::NONE,
            depth_write: None,
            blend: false,
            vertex_input: None,
            textures: 0,
            constants: &[],
        }
    }

    /// Says all that a pipeline of it is made of.
    fn key(&self) -> String {
        let Self { vertex, fragment, pass, topology, cull, depth_write, blend, .. } = self;
        let Self { vertex_input, textures, constants, .. } = self;
        let shaders = [vertex, fragment].map(|shader| identity(shader));
        format!(
            "{shaders:?} {} {topology:?} {cull:?} {depth_write:?} {blend} {vertex_input:?} {textures} {constants:?}",
            pass.key
        )
    }
}

/// A graphics pipeline with its layout. Those of the same description are one, unless a sampler is part of them.
pub struct GraphicsPipeline(Arc<Made>);

/// Says which shader it is: its name, and a hash of its words.
fn identity(shader: &Shader) -> String {
    let mut hasher = std::hash::DefaultHasher::new();
    shader.words.hash(&mut hasher);
    format!("{} {:x}", shader.name, hasher.finish())
}

fn module(gpu: &Gpu, shader: &Shader) -> Result<vk::ShaderModule, GpuError> {
    let info = vk::ShaderModuleCreateInfo::default().code(shader.words);
    // SAFETY: the words are SPIR-V that glslangValidator wrote.
    unsafe { gpu.device().create_shader_module(&info, None) }.doing("creating a shader module")
}

fn constant_entries(constants: &[u32]) -> Vec<vk::SpecializationMapEntry> {
    let entry = |id: u32| vk::SpecializationMapEntry { constant_id: id, offset: id * 4, size: 4 };
    (0..constants.len() as u32).map(entry).collect()
}

/// A shader takes those of its own constants.
fn specialisation<'a>(
    entries: &'a [vk::SpecializationMapEntry],
    constants: &'a [u32],
) -> vk::SpecializationInfo<'a> {
    vk::SpecializationInfo::default().map_entries(entries).data(bytemuck::cast_slice(constants))
}

impl ComputePipeline {
    /// A pipeline of one compute shader.
    pub fn new(gpu: &Arc<Gpu>, shader: &Shader) -> Result<Self, GpuError> {
        Self::specialised(gpu, shader, &[])
    }

    /// The same with specialisation constants, numbered as they stand.
    pub fn specialised(gpu: &Arc<Gpu>, shader: &Shader, constants: &[u32]) -> Result<Self, GpuError> {
        let workgroup = shader.workgroup.expect("a compute shader");
        let key = format!("{} {constants:?}", identity(shader));
        let made = gpu.pipelines.get(key, || Self::make(gpu, shader, constants, None))?;
        Ok(Self { made, workgroup })
    }

    /// A pipeline with a sampler that is part of it.
    pub fn fixing(gpu: &Arc<Gpu>, shader: &Shader, fixed: FixedSampler) -> Result<Self, GpuError> {
        let workgroup = shader.workgroup.expect("a compute shader");
        Ok(Self { made: Arc::new(Self::make(gpu, shader, &[], Some(fixed))?), workgroup })
    }

    fn make(
        gpu: &Arc<Gpu>,
        shader: &Shader,
        constants: &[u32],
        fixed: Option<FixedSampler>,
    ) -> Result<Made, GpuError> {
        let layout = Layout::fixing(gpu, &[shader], fixed, 0)?;
        let module = module(gpu, shader)?;
        let entries = constant_entries(constants);
        let specialisation = specialisation(&entries, constants);
        let stage = vk::PipelineShaderStageCreateInfo::default()
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(module)
            .specialization_info(&specialisation)
            .name(c"main");
        let infos = [vk::ComputePipelineCreateInfo::default().stage(stage).layout(layout.handle)];
        // SAFETY: module and layout are alive; the module is not needed after creation.
        let made = unsafe {
            let made = gpu.device().create_compute_pipelines(gpu.pipeline_cache(), &infos, None);
            gpu.device().destroy_shader_module(module, None);
            made
        };
        let handle = made.map_err(|(_, e)| e).doing("creating a compute pipeline")?[0];
        Ok(Made::new(gpu, OfViews { all: handle, first: None }, layout))
    }

    pub(crate) fn handle(&self) -> vk::Pipeline {
        self.made.handles.all
    }

    /// Layout, for bind groups.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.made.layout
    }

    /// Invocations of a workgroup in x, y and z.
    pub fn workgroup(&self) -> [u32; 3] {
        self.workgroup
    }

    /// Workgroups that have an invocation for each of `items`.
    pub(crate) fn groups(&self, items: [u32; 3]) -> [u32; 3] {
        std::array::from_fn(|axis| items[axis].div_ceil(self.workgroup[axis]))
    }
}

impl GraphicsPipeline {
    /// A pipeline.
    pub fn new(gpu: &Arc<Gpu>, desc: &GraphicsPipelineDesc<'_>) -> Result<Self, GpuError> {
        gpu.pipelines.get(desc.key(), || make(gpu, desc, None)).map(Self)
    }

    /// A pipeline with a sampler that is part of it.
    pub fn fixing(
        gpu: &Arc<Gpu>,
        desc: &GraphicsPipelineDesc<'_>,
        fixed: Option<FixedSampler>,
    ) -> Result<Self, GpuError> {
        match fixed {
            None => Self::new(gpu, desc),
            fixed => Ok(Self(Arc::new(make(gpu, desc, fixed)?))),
        }
    }

    pub(crate) fn handle(&self, first_alone: bool) -> vk::Pipeline {
        self.0.handles.of(first_alone)
    }

    /// Layout, for bind groups.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.0.layout
    }
}

fn make(
    gpu: &Arc<Gpu>,
    desc: &GraphicsPipelineDesc<'_>,
    fixed: Option<FixedSampler>,
) -> Result<Made, GpuError> {
    let layout = Layout::fixing(gpu, &[desc.vertex, desc.fragment], fixed, desc.textures)?;
    let modules = [module(gpu, desc.vertex)?, module(gpu, desc.fragment)?];
    let made = desc.pass.handles.map(|pass| create(gpu, desc, pass, &layout, modules));
    // SAFETY: modules are not needed after the pipeline's creation.
    modules.iter().for_each(|m| unsafe { gpu.device().destroy_shader_module(*m, None) });
    Ok(Made::new(gpu, made?, layout))
}

fn create(
    gpu: &Gpu,
    desc: &GraphicsPipelineDesc<'_>,
    pass: vk::RenderPass,
    layout: &Layout,
    modules: [vk::ShaderModule; 2],
) -> Result<vk::Pipeline, GpuError> {
    let entries = constant_entries(desc.constants);
    let specialisation = specialisation(&entries, desc.constants);
    let stage = |module, stage| {
        vk::PipelineShaderStageCreateInfo::default()
            .stage(stage)
            .module(module)
            .specialization_info(&specialisation)
            .name(c"main")
    };
    let stages =
        [stage(modules[0], vk::ShaderStageFlags::VERTEX), stage(modules[1], vk::ShaderStageFlags::FRAGMENT)];
    let (bindings, attributes) = vertex_input(desc.vertex_input);
    let vertex_input = vk::PipelineVertexInputStateCreateInfo::default()
        .vertex_binding_descriptions(&bindings)
        .vertex_attribute_descriptions(&attributes);
    let assembly = vk::PipelineInputAssemblyStateCreateInfo::default().topology(desc.topology);
    let viewport = vk::PipelineViewportStateCreateInfo::default().viewport_count(1).scissor_count(1);
    // The projection turns y down, so what is counter-clockwise in the world is counter-clockwise here too.
    let raster = vk::PipelineRasterizationStateCreateInfo::default()
        .polygon_mode(vk::PolygonMode::FILL)
        .cull_mode(desc.cull)
        .front_face(vk::FrontFace::COUNTER_CLOCKWISE)
        .line_width(1.0);
    let multisample =
        vk::PipelineMultisampleStateCreateInfo::default().rasterization_samples(desc.pass.samples);
    let depth = vk::PipelineDepthStencilStateCreateInfo::default()
        .depth_test_enable(desc.depth_write.is_some() && desc.pass.has_depth)
        .depth_write_enable(desc.depth_write == Some(true))
        .depth_compare_op(vk::CompareOp::GREATER_OR_EQUAL);
    let blends = vec![blend_state(desc.blend); desc.pass.colors];
    let blend = vk::PipelineColorBlendStateCreateInfo::default().attachments(&blends);
    let dynamic_states = [vk::DynamicState::VIEWPORT, vk::DynamicState::SCISSOR];
    let dynamic = vk::PipelineDynamicStateCreateInfo::default().dynamic_states(&dynamic_states);
    let infos = [vk::GraphicsPipelineCreateInfo::default()
        .stages(&stages)
        .vertex_input_state(&vertex_input)
        .input_assembly_state(&assembly)
        .viewport_state(&viewport)
        .rasterization_state(&raster)
        .multisample_state(&multisample)
        .depth_stencil_state(&depth)
        .color_blend_state(&blend)
        .dynamic_state(&dynamic)
        .layout(layout.handle)
        .render_pass(pass)];
    // SAFETY: all handles are alive and all that the info points to lives through the call.
    let made = unsafe { gpu.device().create_graphics_pipelines(gpu.pipeline_cache(), &infos, None) };
    Ok(made.map_err(|(_, e)| e).doing("creating a graphics pipeline")?[0])
}

fn vertex_input(
    input: Option<VertexInput<'_>>,
) -> (Vec<vk::VertexInputBindingDescription>, Vec<vk::VertexInputAttributeDescription>) {
    let Some(input) = input else { return Default::default() };
    let binding = vk::VertexInputBindingDescription {
        binding: 0,
        stride: input.stride_bytes,
        input_rate: vk::VertexInputRate::VERTEX,
    };
    let attributes = input.attributes.iter().enumerate().map(|(location, (format, offset))| {
        vk::VertexInputAttributeDescription {
            location: location as u32,
            binding: 0,
            format: *format,
            offset: *offset,
        }
    });
    (vec![binding], attributes.collect())
}

fn blend_state(over: bool) -> vk::PipelineColorBlendAttachmentState {
    vk::PipelineColorBlendAttachmentState::default()
        .blend_enable(over)
        .src_color_blend_factor(vk::BlendFactor::SRC_ALPHA)
        .dst_color_blend_factor(vk::BlendFactor::ONE_MINUS_SRC_ALPHA)
        .src_alpha_blend_factor(vk::BlendFactor::ONE)
        .dst_alpha_blend_factor(vk::BlendFactor::ONE_MINUS_SRC_ALPHA)
        .color_write_mask(vk::ColorComponentFlags::RGBA)
}

//! Pipelines from reflected shaders.

use crate::bind::{FixedSampler, Layout};
use crate::memory::Garbage;
use crate::pass::RenderPass;
use crate::{Doing, Gpu, GpuError};
use ash::vk;
use shadecast_spirv::Shader;
use std::sync::Arc;

/// A compute pipeline with its layout.
pub struct ComputePipeline {
    gpu: Arc<Gpu>,
    pub(crate) handle: vk::Pipeline,
    layout: Arc<Layout>,
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
        }
    }
}

/// A graphics pipeline with its layout.
pub struct GraphicsPipeline {
    gpu: Arc<Gpu>,
    pub(crate) handle: vk::Pipeline,
    layout: Arc<Layout>,
}

fn module(gpu: &Gpu, shader: &Shader) -> Result<vk::ShaderModule, GpuError> {
    let info = vk::ShaderModuleCreateInfo::default().code(shader.words);
    // SAFETY: the words are SPIR-V that glslangValidator wrote.
    unsafe { gpu.device().create_shader_module(&info, None) }.doing("creating a shader module")
}

impl ComputePipeline {
    /// A pipeline of one compute shader.
    pub fn new(gpu: &Arc<Gpu>, shader: &Shader) -> Result<Self, GpuError> {
        Self::specialised(gpu, shader, &[])
    }

    /// The same with specialisation constants, numbered as they stand.
    pub fn specialised(gpu: &Arc<Gpu>, shader: &Shader, constants: &[u32]) -> Result<Self, GpuError> {
        let workgroup = shader.workgroup.expect("a compute shader");
        let layout = Layout::new(gpu, &[shader])?;
        let module = module(gpu, shader)?;
        let entry = |id: u32| vk::SpecializationMapEntry { constant_id: id, offset: id * 4, size: 4 };
        let entries: Vec<_> = (0..constants.len() as u32).map(entry).collect();
        let specialisation =
            vk::SpecializationInfo::default().map_entries(&entries).data(bytemuck::cast_slice(constants));
        let stage = vk::PipelineShaderStageCreateInfo::default()
            .stage(vk::ShaderStageFlags::COMPUTE)
            .module(module)
            .specialization_info(&specialisation)
            .name(c"main");
        let infos = [vk::ComputePipelineCreateInfo::default().stage(stage).layout(layout.handle)];
        // SAFETY: module and layout are alive; the module is not needed after creation.
        let made = unsafe {
            let made = gpu.device().create_compute_pipelines(vk::PipelineCache::null(), &infos, None);
            gpu.device().destroy_shader_module(module, None);
            made
        };
        let handle = made.map_err(|(_, e)| e).doing("creating a compute pipeline")?[0];
        Ok(Self { gpu: gpu.clone(), handle, layout, workgroup })
    }

    /// Layout, for bind groups.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
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

impl Drop for ComputePipeline {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::Pipeline(self.handle));
    }
}

impl GraphicsPipeline {
    /// A pipeline.
    pub fn new(gpu: &Arc<Gpu>, desc: &GraphicsPipelineDesc<'_>) -> Result<Self, GpuError> {
        Self::fixing(gpu, desc, None)
    }

    /// A pipeline with a sampler that is part of it.
    pub fn fixing(
        gpu: &Arc<Gpu>,
        desc: &GraphicsPipelineDesc<'_>,
        fixed: Option<FixedSampler>,
    ) -> Result<Self, GpuError> {
        let layout = Layout::fixing(gpu, &[desc.vertex, desc.fragment], fixed, desc.textures)?;
        let modules = [module(gpu, desc.vertex)?, module(gpu, desc.fragment)?];
        let made = create(gpu, desc, &layout, modules);
        // SAFETY: modules are not needed after the pipeline's creation.
        modules.iter().for_each(|m| unsafe { gpu.device().destroy_shader_module(*m, None) });
        Ok(Self { gpu: gpu.clone(), handle: made?, layout })
    }

    /// Layout, for bind groups.
    pub fn layout(&self) -> &Arc<Layout> {
        &self.layout
    }
}

fn create(
    gpu: &Gpu,
    desc: &GraphicsPipelineDesc<'_>,
    layout: &Layout,
    modules: [vk::ShaderModule; 2],
) -> Result<vk::Pipeline, GpuError> {
    let stage = |module, stage| {
        vk::PipelineShaderStageCreateInfo::default().stage(stage).module(module).name(c"main")
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
        .render_pass(desc.pass.handle)];
    // SAFETY: all handles are alive and all that the info points to lives through the call.
    let made = unsafe { gpu.device().create_graphics_pipelines(vk::PipelineCache::null(), &infos, None) };
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

impl Drop for GraphicsPipeline {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::Pipeline(self.handle));
    }
}

//! For measurements only: instance and distance of each pixel, without the picture (`client_probe.*`). The stage draws the
//! bundle on display once more, with one sample per pixel, and waits for the read-back.

use super::atlas_draw::{BOTH_EYES, BundleMemory, DEPTH_FORMAT};
use super::{FRAMES_IN_FLIGHT, eyes_gpu};
use crate::draw::draw_list::Drawable;
use shadecast_gpu::{
    Access, Attachment, Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, GraphicsPipeline,
    GraphicsPipelineDesc, Image, ImageDesc, Memory, RenderPass, RenderPassDesc, vk,
};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_shaders::constants::FIRST_ID;
use shadecast_shaders::generated::{CLIENT_PROBE_FRAG, CLIENT_PROBE_VERT, EyesGpu};
use std::sync::Arc;

/// Of one eye: takes its coordinates to the world's, and its frustum.
pub type EyeView = (Pose, Fov);

/// What one eye sees, row by row from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct ProbeView {
    /// From where; `None` where nothing was drawn.
    pub eye: Option<EyeView>,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// The nearest instance; `u32::MAX` is the background.
    pub instance: Vec<u32>,
    /// Distance along the view axis in metres; infinite for the background.
    pub distance_m: Vec<f32>,
}

impl ProbeView {
    /// A view of nothing.
    pub fn empty([width, height]: [u32; 2]) -> Self {
        let pixels = (width * height) as usize;
        Self {
            eye: None,
            width,
            height,
            instance: vec![u32::MAX; pixels],
            distance_m: vec![f32::INFINITY; pixels],
        }
    }

    /// Little-endian, four bytes each: width, height, position and orientation (x, y, z, w) of the eye in the world, angles of its
    /// frustum (left, right, up, down; all 0 where nothing was drawn), then instances, then distances.
    pub fn to_bytes(&self) -> Vec<u8> {
        let eye = self.eye.map_or([0.0; 11], |(Pose { position: p, orientation: q }, fov)| {
            [p.x, p.y, p.z, q.x, q.y, q.z, q.w, fov.left, fov.right, fov.up, fov.down]
        });
        let instances = self.instance.iter().flat_map(|i| i.to_le_bytes());
        let distances = self.distance_m.iter().flat_map(|d| d.to_le_bytes());
        [self.width, self.height]
            .into_iter()
            .flat_map(u32::to_le_bytes)
            .chain(eye.into_iter().flat_map(f32::to_le_bytes))
            .chain(instances)
            .chain(distances)
            .collect()
    }
}

/// Pass, pipeline and images.
pub struct Probe {
    gpu: Arc<Gpu>,
    pass: RenderPass,
    pipeline: GraphicsPipeline,
    framebuffer: Framebuffer,
    images: [Image; 2],
    _depth: Image,
    eyes: Buffer,
    readback: Buffer,
    extent_pixels: [u32; 2],
}

impl Probe {
    /// For views of `extent_pixels`.
    pub fn new(gpu: &Arc<Gpu>, extent_pixels: [u32; 2]) -> Result<Self, GpuError> {
        let target = |format| Attachment {
            format,
            load: vk::AttachmentLoadOp::CLEAR,
            store: vk::AttachmentStoreOp::STORE,
            before: vk::ImageLayout::UNDEFINED,
            after: vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
        };
        let formats = [vk::Format::R32_UINT, vk::Format::R32_SFLOAT];
        let samples = vk::SampleCountFlags::TYPE_1;
        let colors = formats.map(target).to_vec();
        let desc = RenderPassDesc {
            depth: Some(DEPTH_FORMAT),
            samples,
            view_mask: BOTH_EYES,
            ..RenderPassDesc::new(colors)
        };
        let pass = RenderPass::new(gpu, &desc)?;
        let image = |format, usage| {
            Image::new(
                gpu,
                ImageDesc { layers: 2, samples, ..ImageDesc::new("probe", extent_pixels, format, usage) },
            )
        };
        let read = vk::ImageUsageFlags::COLOR_ATTACHMENT | vk::ImageUsageFlags::TRANSFER_SRC;
        let images = [image(formats[0], read)?, image(formats[1], read)?];
        let depth = image(DEPTH_FORMAT, vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT)?;
        let views = [images[0].view(), images[1].view(), depth.view()];
        let framebuffer = Framebuffer::new(gpu, &pass, extent_pixels, &views)?;
        let pipeline = GraphicsPipeline::new(
            gpu,
            &GraphicsPipelineDesc {
                cull: vk::CullModeFlags::BACK,
                depth_write: Some(true),
                ..GraphicsPipelineDesc::new(&CLIENT_PROBE_VERT, &CLIENT_PROBE_FRAG, &pass)
            },
        )?;
        let eyes = Buffer::new(gpu, "probe eyes", size_of::<EyesGpu>() as u64, Memory::Upload)?;
        let pixels = u64::from(extent_pixels[0]) * u64::from(extent_pixels[1]);
        let readback = Buffer::new(gpu, "probe", pixels * 16, Memory::Readback)?;
        Ok(Self {
            gpu: gpu.clone(),
            pass,
            pipeline,
            framebuffer,
            images,
            _depth: depth,
            eyes,
            readback,
            extent_pixels,
        })
    }

    /// What both eyes see of what was drawn of a bundle. Waits for the GPU.
    pub fn run(
        &mut self,
        bundle: &BundleMemory,
        positions: &Buffer,
        eyes: [EyeView; 2],
        drawn: Drawable,
    ) -> Result<[ProbeView; 2], GpuError> {
        const _: () = assert!(FRAMES_IN_FLIGHT > 0);
        let (world_from_eye, fov) = (eyes.map(|(pose, _)| pose), eyes.map(|(_, fov)| fov));
        self.eyes.write(0, bytemuck::bytes_of(&eyes_gpu(world_from_eye, world_from_eye, fov)));
        let binds = [
            ("Corners", Bind::Buffer(&bundle.corners)),
            ("Positions", Bind::Buffer(positions)),
            ("Eyes", Bind::Buffer(&self.eyes)),
            ("Coverage", Bind::Buffer(&bundle.coverage)),
        ];
        let group = BindGroup::new(self.pipeline.layout(), &binds)?;
        let mut recorder = self.gpu.record()?;
        recorder.barrier(Access::COPY_READ, Access::COLOR_WRITE);
        let far = vk::ClearValue { depth_stencil: vk::ClearDepthStencilValue { depth: 0.0, stencil: 0 } };
        let clears = [vk::ClearValue::default(), vk::ClearValue::default(), far];
        recorder.begin_pass(&self.pass, &self.framebuffer, &clears);
        for [first, count] in drawn.ranges().into_iter().filter(|[_, count]| *count > 0) {
            recorder.bind(&self.pipeline, &group);
            recorder.bind_indices(&bundle.indices, 0);
            recorder.draw_indexed(first, count);
        }
        recorder.end_pass();
        recorder.barrier(Access::COLOR_WRITE, Access::COPY_READ);
        let plane = self.readback.size() / 4;
        for (index, image) in self.images.iter().enumerate() {
            for layer in 0..2 {
                let offset = (index as u64 * 2 + u64::from(layer)) * plane;
                recorder.read_image(image, layer, &self.readback, offset);
            }
        }
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        self.gpu.wait(recorder.submit()?)?;
        Ok([0, 1].map(|eye| ProbeView { eye: Some(eyes[eye]), ..self.view(eye) }))
    }

    fn view(&self, eye: usize) -> ProbeView {
        let [width, height] = self.extent_pixels;
        let pixels = (width * height) as usize;
        let plane = self.readback.size() as usize / 4;
        let bytes = self.readback.bytes();
        let part = |index: usize| &bytes[(index * 2 + eye) * plane..][..pixels * 4];
        let ids: &[u32] = bytemuck::cast_slice(part(0));
        let distances: &[f32] = bytemuck::cast_slice(part(1));
        let is_hit = |index: usize| ids[index] >= FIRST_ID;
        ProbeView {
            eye: None,
            width,
            height,
            instance: ids.iter().map(|id| id.wrapping_sub(FIRST_ID)).collect(),
            distance_m: (0..pixels).map(|i| if is_hit(i) { distances[i] } else { f32::INFINITY }).collect(),
        }
    }
}

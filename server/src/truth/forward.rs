//! The ground truth: skins at the exact time of the picture, or takes vertices that were posed elsewhere; shades per pixel
//! with the atlas's own shading code, antialiased by multisampling. A second pass tells what is where, one sample a pixel.

use crate::animation::RingPlace;
use crate::animation::gpu::Animation;
use crate::culling::Needed;
use crate::scene::SceneGpu;
use crate::stages::geometry::Geometry;
use crate::stages::shadow::Shadow;
use crate::stages::view_gpu;
use ash::vk;
use glam::Mat4;
use shadecast_gpu::{
    Access, Attachment, Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, GraphicsPipeline,
    GraphicsPipelineDesc, Image, ImageDesc, Memory, Recorder, RenderPass, RenderPassDesc,
};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::ServerTime;
use shadecast_shaders::constants::FIRST_ID;
use shadecast_shaders::generated::{
    BackgroundPush, FORWARD_BACKGROUND_FRAG, FORWARD_BACKGROUND_VERT, FORWARD_FRAG, FORWARD_PROBE_FRAG,
    FORWARD_PROBE_VERT, FORWARD_VERT, ForwardPush, TangentGpu, ViewGpu,
};
use std::sync::Arc;

const SRGB: vk::Format = vk::Format::R8G8B8A8_SRGB;
const ONE: vk::SampleCountFlags = vk::SampleCountFlags::TYPE_1;

/// A picture with what is where in it; rows from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct Truth {
    /// Width and height in pixels.
    pub extent_pixels: [u32; 2],
    /// sRGB, three bytes a pixel.
    pub rgb8: Vec<u8>,
    /// Instance at the pixel's centre; `u32::MAX` for background.
    pub instance: Vec<u32>,
    /// Distance along the view axis at the pixel's centre, metres; infinite for background.
    pub distance_m: Vec<f32>,
}

/// Of a ring for one time.
const ONLY: RingPlace = RingPlace(0);

/// Vertices in the world that were posed elsewhere: those of static instances first, then the others, in both as
/// [`InstancePlace::saved_base`](crate::scene::numbering::InstancePlace::saved_base) numbers them.
#[derive(Clone, Debug, Default)]
pub struct Posed {
    /// xyz, metres.
    pub positions: Vec<[f32; 4]>,
    /// Normals and tangents.
    pub frames: Vec<TangentGpu>,
}

/// The renderer.
pub struct Forward {
    gpu: Arc<Gpu>,
    scene: Arc<SceneGpu>,
    animation: Animation,
    shadow: Shadow,
    /// Every instance is needed: the eye may be anywhere in the next picture.
    all: Needed,
    color: Pass,
    probe: Pass,
    background: GraphicsPipeline,
    background_group: BindGroup,
    view: Buffer,
    targets: Targets,
    samples: vk::SampleCountFlags,
}

/// A pass that draws the scene.
struct Pass {
    pass: RenderPass,
    geometry: Geometry,
    group: BindGroup,
}

/// What depends on the picture's size.
struct Targets {
    extent: [u32; 2],
    color: Framebuffer,
    probe: Framebuffer,
    resolved: Image,
    probes: [Image; 2],
    readback: Buffer,
    _attachments: Vec<Image>,
}

impl Forward {
    /// For pictures of `extent` pixels, with 4 samples a pixel.
    pub fn new(gpu: &Arc<Gpu>, scene: &Arc<SceneGpu>, extent: [u32; 2]) -> Result<Self, GpuError> {
        Self::with_samples(gpu, scene, extent, vk::SampleCountFlags::TYPE_4)
    }

    /// For pictures of `extent` pixels with so many samples a pixel.
    pub fn with_samples(
        gpu: &Arc<Gpu>,
        scene: &Arc<SceneGpu>,
        extent: [u32; 2],
        samples: vk::SampleCountFlags,
    ) -> Result<Self, GpuError> {
        let animation = Animation::new(gpu, scene, 1)?;
        let shadow = Shadow::new(gpu, scene, &animation)?;
        let view = Buffer::new(gpu, "forward view", size_of::<ViewGpu>() as u64, Memory::Upload)?;
        let color_pass = RenderPass::new(gpu, &color_desc(SRGB, samples))?;
        let probe_pass = RenderPass::new(gpu, &probe_desc())?;
        let background = GraphicsPipeline::new(
            gpu,
            &GraphicsPipelineDesc {
                depth_write: Some(false),
                ..GraphicsPipelineDesc::new(&FORWARD_BACKGROUND_VERT, &FORWARD_BACKGROUND_FRAG, &color_pass)
            },
        )?;
        let background_group = BindGroup::new(background.layout(), &shadow.binds()[..1])?;
        let color = Pass::new(gpu, scene, &animation, &view, color_pass, Some(&shadow))?;
        let probe = Pass::new(gpu, scene, &animation, &view, probe_pass, None)?;
        Ok(Self {
            targets: Targets::new(gpu, [&color.pass, &probe.pass], extent, samples)?,
            color,
            probe,
            gpu: gpu.clone(),
            scene: scene.clone(),
            animation,
            shadow,
            all: Needed::all(scene.numbering.instances.len()),
            background,
            background_group,
            view,
            samples,
        })
    }

    /// Renders pictures of another size from now on. Nothing submitted still uses the old one.
    pub fn resize(&mut self, extent: [u32; 2]) -> Result<(), GpuError> {
        self.targets = Targets::new(&self.gpu, [&self.color.pass, &self.probe.pass], extent, self.samples)?;
        Ok(())
    }

    /// Width and height of pictures, pixels.
    pub fn extent(&self) -> [u32; 2] {
        self.targets.extent
    }

    /// What was drawn last: sRGB, one sample a pixel, in TRANSFER_SRC_OPTIMAL after [`Forward::record`].
    pub fn image(&self) -> &Image {
        &self.targets.resolved
    }

    /// Records what an eye sees at `time`. Nothing submitted still reads the last recording's view.
    pub fn record(&mut self, recorder: &mut Recorder, world_from_eye: Pose, fov: Fov, time: ServerTime) {
        self.animation.record_sample(recorder, ONLY, time);
        self.animation.record_tangents(recorder, ONLY, |_| true);
        recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
        self.record_posed(recorder, world_from_eye, fov, time);
    }

    /// Records what an eye sees of the saved vertices under the light of `time`.
    fn record_posed(&mut self, recorder: &mut Recorder, world_from_eye: Pose, fov: Fov, time: ServerTime) {
        let clip_from_world = fov.clip_from_eye() * world_from_eye.inverse().matrix();
        let view = view_gpu(clip_from_world, world_from_eye.position);
        self.view.write(0, bytemuck::bytes_of(&view));
        self.shadow.write(&self.scene, &self.animation, time);
        recorder.scope("shadow", |r| self.shadow.record(r, &self.scene, &self.animation, &self.all, ONLY));
        recorder.barrier(Access::DEPTH_WRITE, Access::FRAGMENT_READ);
        recorder.scope("forward", |r| self.draw_color(r, world_from_eye, fov));
    }

    /// Renders what an eye sees at `time`: sRGB, three bytes a pixel.
    pub fn picture(&mut self, world_from_eye: Pose, fov: Fov, time: ServerTime) -> Result<Vec<u8>, GpuError> {
        let mut recorder = self.gpu.record()?;
        self.record(&mut recorder, world_from_eye, fov, time);
        self.read(recorder, &[&self.targets.resolved])?;
        Ok(rgb8(&self.targets.readback.bytes()[..self.targets.plane_bytes()]))
    }

    /// Renders what an eye sees at `time`, and what is where in it.
    pub fn render(&mut self, world_from_eye: Pose, fov: Fov, time: ServerTime) -> Result<Truth, GpuError> {
        let mut recorder = self.gpu.record()?;
        self.record(&mut recorder, world_from_eye, fov, time);
        self.probe_and_collect(recorder)
    }

    /// Renders what an eye sees of vertices posed elsewhere, under the light of `time`, and what is where in it. Nothing of
    /// the scene's own animation has a part in it.
    pub fn render_posed(
        &mut self,
        world_from_eye: Pose,
        fov: Fov,
        time: ServerTime,
        posed: &Posed,
    ) -> Result<Truth, GpuError> {
        let all = (self.scene.numbering.totals.static_vertices
            + self.scene.numbering.totals.animated_vertices) as usize;
        assert_eq!(
            [posed.positions.len(), posed.frames.len()],
            [all; 2],
            "a place for each vertex of the scene"
        );
        let positions = Buffer::upload(&self.gpu, "posed positions", &posed.positions)?;
        let frames = Buffer::upload(&self.gpu, "posed frames", &posed.frames)?;
        let mut recorder = self.gpu.record()?;
        for (from, to) in
            [(&positions, self.animation.saved_vertices()), (&frames, self.animation.tangents())]
        {
            recorder.copy_buffer(from, 0, to, 0, from.size().min(to.size()));
        }
        recorder.barrier(Access::COPY_WRITE, Access::GRAPHICS_READ);
        self.record_posed(&mut recorder, world_from_eye, fov, time);
        self.probe_and_collect(recorder)
    }

    fn probe_and_collect(&self, mut recorder: Recorder) -> Result<Truth, GpuError> {
        recorder.scope("forward probe", |r| {
            r.begin_pass(&self.probe.pass, &self.targets.probe, &[vk::ClearValue::default(); 3]);
            self.probe.draw(r, &self.scene, &self.animation);
            r.end_pass();
        });
        let [instances, distances] = &self.targets.probes;
        self.read(recorder, &[&self.targets.resolved, instances, distances])?;
        Ok(self.targets.collect())
    }

    /// Copies images to the read-back buffer, one behind the other, and waits for all that was recorded.
    fn read(&self, mut recorder: Recorder, images: &[&Image]) -> Result<(), GpuError> {
        recorder.barrier(Access::COLOR_WRITE, Access::COPY_READ);
        let plane = self.targets.plane_bytes() as u64;
        for (index, image) in images.iter().enumerate() {
            recorder.read_image(image, 0, &self.targets.readback, index as u64 * plane);
        }
        recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
        self.gpu.wait(recorder.submit()?)
    }

    fn draw_color(&self, recorder: &mut Recorder, world_from_eye: Pose, fov: Fov) {
        recorder.begin_pass(&self.color.pass, &self.targets.color, &[vk::ClearValue::default(); 3]);
        self.color.draw(recorder, &self.scene, &self.animation);
        recorder.bind(&self.background, &self.background_group);
        let push = BackgroundPush {
            world_from_clip_direction: direction_from_ndc(world_from_eye, fov).to_cols_array_2d(),
        };
        recorder.push_constants(&self.background, &push);
        recorder.draw(3, 1);
        recorder.end_pass();
    }
}

impl Targets {
    /// For a colour and a probe pass.
    fn new(
        gpu: &Arc<Gpu>,
        [color_pass, probe_pass]: [&RenderPass; 2],
        extent: [u32; 2],
        samples: vk::SampleCountFlags,
    ) -> Result<Self, GpuError> {
        let image = |format, samples, usage| {
            Image::new(gpu, ImageDesc { samples, ..ImageDesc::new("forward", extent, format, usage) })
        };
        let attachment = vk::ImageUsageFlags::COLOR_ATTACHMENT;
        let readable = attachment | vk::ImageUsageFlags::TRANSFER_SRC;
        let depth_usage = vk::ImageUsageFlags::DEPTH_STENCIL_ATTACHMENT;
        let resolved = image(SRGB, ONE, readable | vk::ImageUsageFlags::SAMPLED)?;
        let deep = image(vk::Format::D32_SFLOAT, samples, depth_usage)?;
        let probes =
            [image(vk::Format::R32_UINT, ONE, readable)?, image(vk::Format::R32_SFLOAT, ONE, readable)?];
        let shallow = image(vk::Format::D32_SFLOAT, ONE, depth_usage)?;
        let probe_views = [probes[0].view(), probes[1].view(), shallow.view()];
        let mut attachments = vec![deep, shallow];
        let mut color_views = vec![resolved.view(), attachments[0].view()];
        if samples != ONE {
            attachments.push(image(SRGB, samples, attachment)?);
            color_views.insert(0, attachments[2].view());
        }
        let pixels = u64::from(extent[0]) * u64::from(extent[1]);
        Ok(Self {
            extent,
            color: Framebuffer::new(gpu, color_pass, extent, &color_views)?,
            probe: Framebuffer::new(gpu, probe_pass, extent, &probe_views)?,
            resolved,
            probes,
            readback: Buffer::new(gpu, "forward read-back", pixels * 12, Memory::Readback)?,
            _attachments: attachments,
        })
    }

    /// Bytes of one of the three images, each four bytes a pixel.
    fn plane_bytes(&self) -> usize {
        self.extent[0] as usize * self.extent[1] as usize * 4
    }

    fn collect(&self) -> Truth {
        let (plane, bytes) = (self.plane_bytes(), self.readback.bytes());
        let ids: &[u32] = bytemuck::cast_slice(&bytes[plane..2 * plane]);
        let distances: &[f32] = bytemuck::cast_slice(&bytes[2 * plane..3 * plane]);
        Truth {
            extent_pixels: self.extent,
            rgb8: rgb8(&bytes[..plane]),
            instance: ids.iter().map(|id| id.wrapping_sub(FIRST_ID)).collect(),
            distance_m: ids
                .iter()
                .zip(distances)
                .map(|(id, d)| if *id < FIRST_ID { f32::INFINITY } else { *d })
                .collect(),
        }
    }
}

fn rgb8(rgba8: &[u8]) -> Vec<u8> {
    rgba8.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect()
}

/// Takes (ndc x, ndc y, 1, 0) to the direction in the world that is seen there.
fn direction_from_ndc(world_from_eye: Pose, fov: Fov) -> Mat4 {
    let (l, r, u, d) = (fov.left.tan(), fov.right.tan(), fov.up.tan(), fov.down.tan());
    let eye_from_ndc = Mat4::from_cols_array(&[
        (r - l) / 2.0,
        0.0,
        0.0,
        0.0, //
        0.0,
        (d - u) / 2.0,
        0.0,
        0.0, //
        (r + l) / 2.0,
        (u + d) / 2.0,
        -1.0,
        0.0, //
        0.0,
        0.0,
        0.0,
        1.0,
    ]);
    Mat4::from_quat(world_from_eye.orientation) * eye_from_ndc
}

fn color_desc(format: vk::Format, samples: vk::SampleCountFlags) -> RenderPassDesc {
    let shown = Attachment {
        format,
        load: vk::AttachmentLoadOp::CLEAR,
        store: vk::AttachmentStoreOp::STORE,
        before: vk::ImageLayout::UNDEFINED,
        after: vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
    };
    let multisampled = Attachment {
        store: vk::AttachmentStoreOp::DONT_CARE,
        after: vk::ImageLayout::COLOR_ATTACHMENT_OPTIMAL,
        ..shown
    };
    let resolve = Attachment { load: vk::AttachmentLoadOp::DONT_CARE, ..shown };
    let (colors, resolves) =
        if samples == ONE { (vec![shown], vec![]) } else { (vec![multisampled], vec![resolve]) };
    RenderPassDesc { resolves, depth: Some(vk::Format::D32_SFLOAT), samples, ..RenderPassDesc::new(colors) }
}

fn probe_desc() -> RenderPassDesc {
    let attachment = |format| Attachment {
        format,
        load: vk::AttachmentLoadOp::CLEAR,
        store: vk::AttachmentStoreOp::STORE,
        before: vk::ImageLayout::UNDEFINED,
        after: vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
    };
    RenderPassDesc {
        depth: Some(vk::Format::D32_SFLOAT),
        samples: ONE,
        ..RenderPassDesc::new(vec![attachment(vk::Format::R32_UINT), attachment(vk::Format::R32_SFLOAT)])
    }
}

impl Pass {
    fn new(
        gpu: &Arc<Gpu>,
        scene: &SceneGpu,
        animation: &Animation,
        view: &Buffer,
        pass: RenderPass,
        shaded: Option<&Shadow>,
    ) -> Result<Self, GpuError> {
        let geometry = match shaded {
            None => Geometry::new(gpu, &FORWARD_PROBE_VERT, &FORWARD_PROBE_FRAG, &pass)?,
            Some(_) => Geometry::new(gpu, &FORWARD_VERT, &FORWARD_FRAG, &pass)?,
        };
        let textures = scene.materials.texture_binds();
        let mut binds = vec![
            ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
            ("SavedVertices", Bind::Buffer(animation.saved_vertices())),
            ("View", Bind::Buffer(view)),
            ("Materials", Bind::Buffer(&scene.materials.buffer)),
            ("textures", Bind::Textures(&textures)),
        ];
        if let Some(shadow) = shaded {
            binds.push(("Tangents", Bind::Buffer(animation.tangents())));
            binds.extend(shadow.binds());
        }
        let group = BindGroup::new(geometry.layout(), &binds)?;
        Ok(Self { pass, geometry, group })
    }

    fn draw(&self, recorder: &mut Recorder, scene: &SceneGpu, animation: &Animation) {
        self.geometry.record(recorder, &self.group, scene, |draw| ForwardPush {
            vertex_base: draw.model.vertex_base,
            position_base: animation.position_base(draw.instance, ONLY),
            tangent_base: animation.tangent_base(draw.instance),
            material: draw.model.material_base + draw.primitive.material,
            instance: draw.number as u32,
        });
    }
}

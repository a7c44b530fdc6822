//! The ground truth. It skins at the exact time of the picture, or takes vertices posed elsewhere. It shades per pixel with the
//! atlas's own shading code, antialiased by multisampling. A second pass gives instance and distance, one sample per pixel.

use crate::animation::packing::{SAVED_BYTES, pack_frame, pack_position, packing_box};
use crate::scene::SceneGpu;
use crate::scene::drawing::{FULL_DETAIL, Geometry};
use crate::scene::views::view_gpu;
use crate::shading::passes::shadow::Shadow;
use crate::skinning::gpu::{Animation, boxes};
use crate::time::RingPlace;
use crate::visibility::culling::Needed;
use ash::vk;
use glam::{Mat4, Vec3, Vec4};
use shadecast_gpu::{
    Access, Attachment, Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, GraphicsPipeline,
    GraphicsPipelineDesc, Image, ImageDesc, Memory, Recorder, RenderPass, RenderPassDesc,
};
use shadecast_protocol::pose::{Fov, Pose};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::animation::bounds::Bounds;
use shadecast_shaders::constants::{CHUNK_VERTICES, FIRST_ID};
use shadecast_shaders::generated::{
    BackgroundPush, BoxGpu, FORWARD_BACKGROUND_FRAG, FORWARD_BACKGROUND_VERT, FORWARD_FRAG,
    FORWARD_PROBE_FRAG, FORWARD_PROBE_VERT, FORWARD_VERT, ForwardPush, ViewGpu,
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
    pub frames: Vec<PosedFrame>,
}

/// Normal and tangent of a vertex in the world.
#[derive(Clone, Copy, Debug, Default)]
pub struct PosedFrame {
    /// Of unit length.
    pub normal: Vec3,
    /// xyz of unit length, w the bitangent's side.
    pub tangent: Vec4,
}

/// The renderer.
pub struct Forward {
    gpu: Arc<Gpu>,
    scene: Arc<SceneGpu>,
    animation: Animation,
    shadow: Shadow,
    /// Whether what is saved is none of the scene's own animation.
    is_posed: bool,
    /// What the scene's own animation packs positions in.
    boxes: Buffer,
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
        let shadow = Shadow::in_full_detail(gpu, scene, &animation)?;
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
            is_posed: false,
            boxes: Buffer::upload(gpu, "boxes of positions", &boxes(scene))?,
            all: Needed::all(scene.numbering.instances.len()),
            background,
            background_group,
            view,
            samples,
        })
    }

    /// Renders pictures of another size from now on. Nothing submitted still uses the old one.
    pub(crate) fn resize(&mut self, extent: [u32; 2]) -> Result<(), GpuError> {
        self.targets = Targets::new(&self.gpu, [&self.color.pass, &self.probe.pass], extent, self.samples)?;
        Ok(())
    }

    /// Width and height of pictures, pixels.
    pub(crate) fn extent(&self) -> [u32; 2] {
        self.targets.extent
    }

    /// What was drawn last: sRGB, one sample a pixel, in TRANSFER_SRC_OPTIMAL after [`Forward::record`].
    pub(crate) fn image(&self) -> &Image {
        &self.targets.resolved
    }

    /// Records what an eye sees at `time`. Nothing submitted still reads the last recording's view.
    pub(crate) fn record(
        &mut self,
        recorder: &mut Recorder,
        world_from_eye: Pose,
        fov: Fov,
        time: WorldTime,
    ) {
        if std::mem::take(&mut self.is_posed) {
            self.animation.forget();
            let (from, to) = (&self.boxes, self.animation.boxes());
            recorder.barrier(Access::GRAPHICS_READ, Access::COPY_WRITE);
            recorder.copy_buffer(from, 0, to, 0, to.size());
            recorder.barrier(Access::COPY_WRITE, Access::COMPUTE_READ);
        }
        self.animation.record_sample(recorder, ONLY, time);
        self.animation.forget_tangents();
        self.animation.record_tangents(recorder, ONLY, |_| true);
        recorder.barrier(Access::COMPUTE_WRITE, Access::GRAPHICS_READ);
        self.record_posed(recorder, world_from_eye, fov, time);
    }

    /// Records what an eye sees of the saved vertices under the light of `time`.
    fn record_posed(&mut self, recorder: &mut Recorder, world_from_eye: Pose, fov: Fov, time: WorldTime) {
        let clip_from_world = fov.clip_from_eye() * world_from_eye.inverse().matrix();
        let view = view_gpu(clip_from_world, world_from_eye.position);
        self.view.write(0, bytemuck::bytes_of(&view));
        self.shadow.write(&self.scene, &self.animation, time);
        recorder.scope("shadow", |r| self.shadow.record(r, &self.scene, &self.animation, &self.all, ONLY));
        recorder.barrier(Access::DEPTH_WRITE, Access::FRAGMENT_READ);
        recorder.scope("forward", |r| self.draw_color(r, world_from_eye, fov));
    }

    /// Renders what an eye sees at `time`: sRGB, three bytes a pixel.
    pub fn picture(&mut self, world_from_eye: Pose, fov: Fov, time: WorldTime) -> Result<Vec<u8>, GpuError> {
        let mut recorder = self.gpu.record()?;
        self.record(&mut recorder, world_from_eye, fov, time);
        self.read(recorder, &[&self.targets.resolved])?;
        Ok(rgb8(&self.targets.readback.bytes()[..self.targets.plane_bytes()]))
    }

    /// Renders what an eye sees at `time`, and what is where in it.
    pub fn render(&mut self, world_from_eye: Pose, fov: Fov, time: WorldTime) -> Result<Truth, GpuError> {
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
        time: WorldTime,
        posed: &Posed,
    ) -> Result<Truth, GpuError> {
        let all = (self.scene.numbering.totals.static_vertices
            + self.scene.numbering.totals.animated_vertices) as usize;
        assert_eq!(
            [posed.positions.len(), posed.frames.len()],
            [all; 2],
            "a place for each vertex of the scene"
        );
        let packed = self.pack(posed);
        let upload = |words: &Vec<[u32; 2]>| Buffer::upload(&self.gpu, "posed vertices", words);
        let positions = packed.positions.iter().map(upload).collect::<Result<Vec<_>, _>>()?;
        let frames = packed.frames.iter().map(upload).collect::<Result<Vec<_>, _>>()?;
        let boxes = Buffer::upload(&self.gpu, "posed boxes", &packed.boxes)?;
        let mut recorder = self.gpu.record()?;
        let positions = positions.iter().zip(self.animation.saved_vertices());
        let frames = frames.iter().zip(self.animation.tangents());
        for (from, to) in positions.chain(frames).chain([(&boxes, self.animation.boxes())]) {
            recorder.copy_buffer(from, 0, to, 0, from.size().min(to.size()));
        }
        self.is_posed = true;
        recorder.barrier(Access::COPY_WRITE, Access::GRAPHICS_READ);
        self.record_posed(&mut recorder, world_from_eye, fov, time);
        self.probe_and_collect(recorder)
    }

    /// Packs posed vertices as what draws them reads them, each instance in a box of its own.
    fn pack(&mut self, posed: &Posed) -> PackedScene {
        let numbering = &self.scene.numbering;
        let words = |buffers: &[Buffer]| -> Vec<Vec<[u32; 2]>> {
            buffers.iter().map(|buffer| vec![[0; 2]; (buffer.size() / SAVED_BYTES) as usize]).collect()
        };
        let mut packed = PackedScene {
            positions: words(self.animation.saved_vertices()),
            frames: words(self.animation.tangents()),
            boxes: Vec::new(),
        };
        for (number, place) in numbering.instances.iter().enumerate() {
            let still = if place.is_animated { numbering.totals.static_vertices } else { 0 };
            let first = (still + place.saved_base) as usize;
            let vertices = first..first + self.scene.models[place.model].vertex_count as usize;
            let positions = posed.positions[vertices.clone()].iter().map(|at| Vec4::from(*at).truncate());
            let within = packing_box(Bounds::around(positions.clone()));
            packed.boxes.push(within);
            if let Some((position_base, frame_base)) = self.animation.keep(number, ONLY) {
                for (count, position) in (0..).zip(positions) {
                    *of_chunk(&mut packed.positions, position_base + count) =
                        pack_position(&within, position);
                }
                for (count, frame) in (0..).zip(&posed.frames[vertices]) {
                    *of_chunk(&mut packed.frames, frame_base + count) =
                        pack_frame(frame.normal, frame.tangent);
                }
            }
        }
        packed
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

/// Vertices as they are in the buffers that are drawn from, and the boxes of the instances.
struct PackedScene {
    positions: Vec<Vec<[u32; 2]>>,
    frames: Vec<Vec<[u32; 2]>>,
    boxes: Vec<BoxGpu>,
}

fn of_chunk(chunks: &mut [Vec<[u32; 2]>], vertex: u32) -> &mut [u32; 2] {
    &mut chunks[(vertex / CHUNK_VERTICES) as usize][(vertex % CHUNK_VERTICES) as usize]
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
            None => Geometry::new(gpu, scene, &FORWARD_PROBE_VERT, &FORWARD_PROBE_FRAG, &pass)?,
            Some(_) => Geometry::new(gpu, scene, &FORWARD_VERT, &FORWARD_FRAG, &pass)?,
        };
        let textures = scene.materials.texture_binds();
        let [saved_vertices, boxes] = animation.position_binds();
        let mut binds = vec![
            ("Vertices", Bind::Buffer(&scene.meshes.vertices)),
            saved_vertices,
            boxes,
            ("View", Bind::Buffer(view)),
            ("Materials", Bind::Buffer(&scene.materials.buffer)),
            ("textures", Bind::Textures(&textures)),
        ];
        if let Some(shadow) = shaded {
            binds.push(animation.frame_bind());
            binds.extend(shadow.binds());
        }
        let group = BindGroup::new(geometry.layout(), &binds)?;
        Ok(Self { pass, geometry, group })
    }

    fn draw(&self, recorder: &mut Recorder, scene: &SceneGpu, animation: &Animation) {
        let is_there = |number: usize| {
            let bases = animation.position_base(number, ONLY).zip(animation.tangent_base(number));
            bases.map(|_| FULL_DETAIL)
        };
        self.geometry.record(recorder, &self.group, scene, is_there, |draw| ForwardPush {
            vertex_base: draw.model.vertex_base,
            position_base: animation.position_base(draw.number, ONLY).unwrap_or_default(),
            tangent_base: animation.tangent_base(draw.number).unwrap_or_default(),
            material: draw.model.material_base + draw.primitive.material,
            instance: draw.number as u32,
        });
    }
}

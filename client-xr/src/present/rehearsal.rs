//! A rehearsal before a connection: one small display frame that nobody sees, with every stage. Drivers without a GPU compile a
//! pipeline when it draws first. After the rehearsal that is done.

use super::renderer::Renderer;
use super::scene::Scene;
use crate::display::EyeImages;
use crate::draw::draw_list::Drawable;
use crate::draw::stages::background::Backdrop;
use crate::draw::stages::text::Text;
use crate::draw::stages::{ARRIVALS, Stages, VERTEX_MEMORY_USE};
use shadecast_gpu::{Access, Gpu, GpuError, Image, ImageDesc, Part, Recorder, vk};
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::{Codec, Environment, MotionMemory, ResumeSecret, Welcome};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::DEFAULT_GRID;
use std::sync::Arc;

/// Pixels: as few as compile everything.
const EXTENT_PIXELS: [u32; 2] = [16, 16];
/// Frame in flight.
const FLIGHT: usize = 0;
/// A triangle that covers its block, and one of a cutout, both in one point.
const DRAWN: Drawable = Drawable { opaque: 3, cutouts: [3, 3], withheld_patches: 0 };
/// Patches that have room for them.
const PATCH_SLOTS: u32 = 2;

/// Draws the frame and waits for it. Nothing of it stays once the next frames have been drawn.
///
/// # Errors
/// Those of the device.
pub(crate) fn rehearse(renderer: &mut Renderer) -> Result<(), GpuError> {
    let Renderer { stages, gpu, display, .. } = renderer;
    let (mut scene, loans) = Scene::new(gpu, stages, terms(), 0)?;
    loans.into_iter().for_each(|loan| scene.add(loan));
    let mut recorder = gpu.record()?;
    recorder.barrier(VERTEX_MEMORY_USE, ARRIVALS);
    scene.record_zeros(&mut recorder, stages, FLIGHT)?;
    recorder.barrier(Access::COMPUTE_WRITE, Access::VERTEX_READ);
    let eyes = display.eye_images();
    // Devices with density maps have compiled all pipelines when they were made.
    let image = match eyes.density_maps {
        None => Some(record_draw(&mut recorder, gpu, stages, &scene, eyes, display.part())?),
        Some(_) => None,
    };
    gpu.wait(recorder.submit()?)?;
    stages.hands.write(FLIGHT, [None; 2]);
    drop((scene, image)); // with the next display frames
    Ok(())
}

fn record_draw(
    recorder: &mut Recorder,
    gpu: &Arc<Gpu>,
    stages: &mut Stages,
    scene: &Scene,
    eyes: EyeImages<'_>,
    part: Part,
) -> Result<Image, GpuError> {
    let usage = vk::ImageUsageFlags::COLOR_ATTACHMENT;
    let desc = ImageDesc { layers: 2, ..ImageDesc::new("rehearsal", EXTENT_PIXELS, eyes.format, usage) };
    let image = Image::new(gpu, desc)?;
    let own = EyeImages { images: &[image.handle()], extent_pixels: EXTENT_PIXELS, ..eyes };
    let targets = stages.targets.for_images(gpu, own)?;
    stages.hands.write(FLIGHT, [Some(Pose::IDENTITY); 2]);
    targets.begin_part(recorder, 0, Part { extent: EXTENT_PIXELS, ..part });
    scene.record_draw(recorder, stages, FLIGHT, DRAWN);
    stages.hands.record(recorder, FLIGHT);
    let (stage_from_panel, text) = (Pose::IDENTITY, &Text::default());
    stages.background.record(recorder, FLIGHT, Backdrop::WaitingRoom { stage_from_panel, text });
    stages.notice.record(recorder, FLIGHT, Pose::IDENTITY, text);
    recorder.end_pass();
    Ok(image)
}

/// The smallest that a server could offer.
fn terms() -> Welcome {
    Welcome {
        protocol_version: PROTOCOL_VERSION,
        session: 0,
        grid: DEFAULT_GRID,
        atlas_extent_texels: AtlasExtent::MIN,
        vertex_slots: 1,
        patch_slots: PATCH_SLOTS,
        motion: MotionMemory::LEAST,
        store_pages: 1,
        codec: Codec::H264,
        environment: Environment { zenith: [0.0; 3], horizon: [0.0; 3], nadir: [0.0; 3] },
        world_from_stage: Pose::IDENTITY,
        update_period_ns: 1,
        resume: ResumeSecret([0; 16]),
    }
}

//! Refuses a device that draws only one of two views. A clear error is better than one black eye.

use crate::pass::{Attachment, Framebuffer, RenderPass, RenderPassDesc};
use crate::{
    Buffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Image, ImageDesc, Memory, Recorder,
};
use ash::vk;
use generated::{SELFTEST_FRAG, SELFTEST_VERT, SelftestPush};
use std::sync::Arc;

/// `glsl/`, compiled by the build script.
mod generated {
    #![allow(clippy::unreadable_literal, unused_qualifications)]
    include!(concat!(env!("OUT_DIR"), "/selftest.rs"));
}

/// The first view's number; the other's is the next.
const FIRST_NUMBER: u32 = 7;

/// Draws a number into each of two views and reads both back.
pub(crate) fn multiview(gpu: &Arc<Gpu>) -> Result<(), GpuError> {
    let seen = draw_two_views(gpu)?;
    let expected = [FIRST_NUMBER, FIRST_NUMBER + 1];
    if seen == expected {
        return Ok(());
    }
    Err(GpuError::NoDevice(format!(
        "{} fails the multiview self-test (views show {seen:?} instead of {expected:?}); update the driver \
         (Debian 12's own Mesa 22 has this fault, Mesa from bookworm-backports does not)",
        gpu.device_name()
    )))
}

fn draw_two_views(gpu: &Arc<Gpu>) -> Result<[u32; 2], GpuError> {
    let format = vk::Format::R32_UINT;
    let image = Image::new(
        gpu,
        ImageDesc {
            layers: 2,
            ..ImageDesc::new(
                "self-test",
                [4, 4],
                format,
                vk::ImageUsageFlags::COLOR_ATTACHMENT | vk::ImageUsageFlags::TRANSFER_SRC,
            )
        },
    )?;
    let color = Attachment {
        format,
        load: vk::AttachmentLoadOp::CLEAR,
        store: vk::AttachmentStoreOp::STORE,
        before: vk::ImageLayout::UNDEFINED,
        after: vk::ImageLayout::TRANSFER_SRC_OPTIMAL,
    };
    let pass = RenderPass::new(gpu, &RenderPassDesc { view_mask: 0b11, ..RenderPassDesc::new(vec![color]) })?;
    let target = Framebuffer::new(gpu, &pass, [4, 4], &[image.view()])?;
    let pipeline =
        GraphicsPipeline::new(gpu, &GraphicsPipelineDesc::new(&SELFTEST_VERT, &SELFTEST_FRAG, &pass))?;
    let readback = Buffer::new(gpu, "self-test", 128, Memory::Readback)?;
    let mut recorder: Recorder = gpu.record()?;
    recorder.begin_pass(&pass, &target, &[vk::ClearValue::default()]);
    recorder.bind_pipeline(&pipeline);
    recorder.push_constants(&pipeline, &SelftestPush { first_number: FIRST_NUMBER });
    recorder.draw(3, 1);
    recorder.end_pass();
    recorder.barrier(crate::Access::COLOR_WRITE, crate::Access::COPY_READ);
    (0..2).for_each(|layer| recorder.read_image(&image, layer, &readback, u64::from(layer) * 64));
    recorder.barrier(crate::Access::COPY_WRITE, crate::Access::HOST_READ);
    gpu.wait(recorder.submit()?)?;
    let values = readback.values::<u32>();
    Ok([values[5], values[16 + 5]])
}

//! The last stage of a window: the rendered picture, with figures as text over it.

use ash::vk;
use shadecast_gpu::{
    Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Image,
    Memory, Recorder, RenderPass, Sampler, SamplerDesc,
};
use shadecast_shaders::font::{self, Glyph};
use shadecast_shaders::generated::{PRESENT_FRAG, PRESENT_VERT, PresentPush};
use std::sync::Arc;

/// Columns and rows of text at most.
pub const MAX_CELLS: [u32; 2] = [72, 24];

/// The stage.
pub struct Present {
    pipeline: GraphicsPipeline,
    sampler: Sampler,
    group: Option<BindGroup>,
    text: Buffer,
    cells: [u32; 2],
    codes_srgb: bool,
}

impl Present {
    /// For a window's pass; `codes_srgb` where its format does not.
    pub fn new(gpu: &Arc<Gpu>, pass: &RenderPass, codes_srgb: bool) -> Result<Self, GpuError> {
        let desc = GraphicsPipelineDesc::new(&PRESENT_VERT, &PRESENT_FRAG, pass);
        let edge = vk::SamplerAddressMode::CLAMP_TO_EDGE;
        let nearest =
            SamplerDesc { filter: vk::Filter::NEAREST, wrap: [edge; 2], mips: false, anisotropy: 1.0 };
        let bytes = u64::from(MAX_CELLS[0] * MAX_CELLS[1]) * size_of::<Glyph>() as u64;
        Ok(Self {
            pipeline: GraphicsPipeline::new(gpu, &desc)?,
            sampler: Sampler::new(gpu, nearest)?,
            group: None,
            text: Buffer::new(gpu, "figures", bytes, Memory::Upload)?,
            cells: [0, 0],
            codes_srgb,
        })
    }

    /// Shows this picture from now on.
    pub fn show(&mut self, picture: &Image) -> Result<(), GpuError> {
        let binds = [("picture", Bind::Sampled(picture, &self.sampler)), ("Text", Bind::Buffer(&self.text))];
        self.group = Some(BindGroup::new(self.pipeline.layout(), &binds)?);
        Ok(())
    }

    /// Writes the figures, a line a row; what does not fit is cut. Nothing submitted still reads the old ones.
    pub fn write(&mut self, lines: &[String]) {
        let columns = lines.iter().map(|line| line.chars().count() as u32).max().unwrap_or(0);
        let [columns, rows] = [columns.min(MAX_CELLS[0]), (lines.len() as u32).min(MAX_CELLS[1])];
        self.cells = [columns, rows];
        let glyphs: &mut [Glyph] = bytemuck::cast_slice_mut(self.text.bytes_mut());
        for (row, line) in lines.iter().take(rows as usize).enumerate() {
            let cells = &mut glyphs[row * columns as usize..][..columns as usize];
            let padded = line.chars().chain(std::iter::repeat(' '));
            for (cell, character) in cells.iter_mut().zip(padded) {
                *cell = font::glyph(character);
            }
        }
    }

    /// Draws picture and figures over all of `target`. The picture can be sampled.
    pub fn record(&self, recorder: &mut Recorder, pass: &RenderPass, target: &Framebuffer) {
        let group = self.group.as_ref().expect("a picture is shown before the first frame");
        let push = PresentPush {
            cells: self.cells,
            pixels_per_dot: (target.extent()[1] / 400).clamp(1, 4),
            codes_srgb: u32::from(self.codes_srgb),
        };
        recorder.begin_pass(pass, target, &[vk::ClearValue::default()]);
        recorder.bind(&self.pipeline, group);
        recorder.push_constants(&self.pipeline, &push);
        recorder.draw(3, 1);
        recorder.end_pass();
    }
}

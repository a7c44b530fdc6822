//! The last stage of a window: a rendered picture unscaled, or the pictures of two eyes scaled to fit, with figures as text
//! over them (`present.*`, `present_eyes.frag`).

use ash::vk;
use shadecast_gpu::{
    Bind, BindGroup, Buffer, Framebuffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Image,
    Memory, Part, Recorder, RenderPass, Sampler, SamplerDesc,
};
use shadecast_shaders::constants::{FIGURES_MARGIN_DOTS, GLYPH_CELL_DOTS};
use shadecast_shaders::font::{self, Glyph};
use shadecast_shaders::generated::{PRESENT_EYES_FRAG, PRESENT_FRAG, PRESENT_VERT, PresentPush};
use std::sync::Arc;

/// Columns and rows of text at most.
pub const MAX_CELLS: [u32; 2] = [72, 24];

/// What is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shows {
    /// A picture of the window's own extent.
    Picture,
    /// An image of two layers, left and right eye, of any extent.
    Eyes,
}

/// The stage.
pub struct Present {
    shows: Shows,
    /// Width and height of what is shown.
    picture_extent: [u32; 2],
    /// Eyes that are seen, from the left one on: 1 or 2, beside each other.
    eyes: u32,
    /// The part of it that is drawn, across and along.
    picture_part: [f32; 2],
    picture: GraphicsPipeline,
    /// The same with figures over it.
    figures: GraphicsPipeline,
    sampler: Sampler,
    group: Option<BindGroup>,
    text: Buffer,
    cells: [u32; 2],
}

impl Present {
    /// For a window's pass; `codes_srgb` where its format does not.
    pub fn new(gpu: &Arc<Gpu>, pass: &RenderPass, codes_srgb: bool, shows: Shows) -> Result<Self, GpuError> {
        let (fragment, filter) = match shows {
            Shows::Picture => (&PRESENT_FRAG, vk::Filter::NEAREST),
            Shows::Eyes => (&PRESENT_EYES_FRAG, vk::Filter::LINEAR),
        };
        let pipeline = |has_figures: bool| {
            let constants = &[u32::from(has_figures), u32::from(codes_srgb)];
            let desc = GraphicsPipelineDesc::new(&PRESENT_VERT, fragment, pass);
            GraphicsPipeline::new(gpu, &GraphicsPipelineDesc { constants, ..desc })
        };
        let sampler = SamplerDesc::clamped(filter);
        let bytes = u64::from(MAX_CELLS[0] * MAX_CELLS[1]) * size_of::<Glyph>() as u64;
        Ok(Self {
            shows,
            picture_extent: [1, 1],
            eyes: 1,
            picture_part: [1.0; 2],
            picture: pipeline(false)?,
            figures: pipeline(true)?,
            sampler: Sampler::new(gpu, sampler)?,
            group: None,
            text: Buffer::new(gpu, "figures", bytes, Memory::Upload)?,
            cells: [0, 0],
        })
    }

    /// Shows this picture from now on.
    pub fn show(&mut self, picture: &Image) -> Result<(), GpuError> {
        let binds = [("picture", Bind::Sampled(picture, &self.sampler)), ("Text", Bind::Buffer(&self.text))];
        self.group = Some(BindGroup::new(self.picture.layout(), &binds)?);
        self.picture_extent = picture.desc().extent;
        Ok(())
    }

    /// Shows a part of the picture, from its first corner on: the left eye of it, or both beside each other.
    pub fn show_part(&mut self, Part { extent, first_alone }: Part) {
        self.eyes = if first_alone { 1 } else { 2 };
        self.picture_part =
            std::array::from_fn(|side| extent[side] as f32 / self.picture_extent[side] as f32);
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
        let window = target.extent().map(|side| side as f32);
        let eyes = if self.shows == Shows::Eyes { self.eyes } else { 1 };
        let push = PresentPush {
            cells: self.cells,
            pixels_per_dot: (target.extent()[1] / 400).clamp(1, 4),
            panes: eyes,
            window_extent: window,
            pane_extent: pane_extent(window, self.picture_extent, eyes),
            picture_part: self.picture_part,
        };
        let figures = figures_extent(self.cells, push.pixels_per_dot, target.extent());
        recorder.begin_pass(pass, target, &[vk::ClearValue::default()]);
        for (pipeline, extent) in [(&self.picture, target.extent()), (&self.figures, figures)] {
            recorder.bind(pipeline, group);
            recorder.push_constants(pipeline, &push);
            recorder.draw_within(extent, 3);
        }
        recorder.end_pass();
    }
}

/// Pixels of the panel of figures, from the window's first corner on: half a cell more than they are.
fn figures_extent(cells: [u32; 2], pixels_per_dot: u32, window: [u32; 2]) -> [u32; 2] {
    if cells.contains(&0) {
        return [0, 0];
    }
    std::array::from_fn(|side| {
        let dots = FIGURES_MARGIN_DOTS + (cells[side] as f32 + 0.5) * GLYPH_CELL_DOTS[side] as f32;
        ((dots * pixels_per_dot as f32).round() as u32).min(window[side])
    })
}

/// Width and height in pixels at which a picture fits into each of `panes` equal parts of a window, side by side, as large
/// as it can without another shape.
fn pane_extent([width, height]: [f32; 2], picture: [u32; 2], panes: u32) -> [f32; 2] {
    let picture = picture.map(|side| side.max(1) as f32);
    let scale = (width / panes as f32 / picture[0]).min(height / picture[1]);
    picture.map(|side| side * scale)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panel_ends_half_a_cell_behind_its_figures_and_with_the_window() {
        assert_eq!(figures_extent([10, 2], 2, [640, 400]), [130, 49]);
        assert_eq!(figures_extent([72, 24], 2, [100, 90]), [100, 90]);
        assert_eq!(figures_extent([0, 0], 2, [640, 400]), [0, 0]);
    }

    #[test]
    fn pictures_of_eyes_keep_their_shape_and_fill_one_side() {
        assert_eq!(pane_extent([800.0, 400.0], [1000, 1000], 1), [400.0, 400.0]);
        assert_eq!(pane_extent([800.0, 400.0], [1000, 1000], 2), [400.0, 400.0]);
        assert_eq!(pane_extent([600.0, 400.0], [1000, 1000], 2), [300.0, 300.0]);
        assert_eq!(pane_extent([1280.0, 720.0], [1280, 720], 1), [1280.0, 720.0]);
    }
}

//! Text in the headset: lines in cells of the dot font, their panel, and their draw (`text.glsl`).

use super::FRAMES_IN_FLIGHT;
use glam::{Quat, Vec3};
use shadecast_gpu::{
    Bind, BindGroup, Buffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Memory, Recorder,
};
use shadecast_protocol::pose::Pose;
use shadecast_shaders::font::{self, Glyph};
use std::marker::PhantomData;
use std::sync::Arc;

/// Columns and rows of text that are shown at most.
pub const TEXT_CELLS: [usize; 2] = [40, 6];
/// A character's extent in metres: at 1.75 m about 1.2 by 1.8 degrees.
pub(super) const CELL_EXTENT_M: [f32; 2] = [0.036, 0.054];
/// How far ahead of the head the text appears.
const TEXT_DISTANCE_M: f32 = 1.75;
/// A text as the shaders read it.
#[derive(Clone, Debug, PartialEq)]
pub struct Text {
    /// Row by row.
    glyphs: [Glyph; TEXT_CELLS[0] * TEXT_CELLS[1]],
    /// First and last cell, exclusive, that holds a character: left, top, right, bottom.
    used: [usize; 4],
}

impl Default for Text {
    /// Nothing.
    fn default() -> Self {
        let [columns, rows] = TEXT_CELLS;
        Self { glyphs: [Glyph::default(); TEXT_CELLS[0] * TEXT_CELLS[1]], used: [columns, rows, 0, 0] }
    }
}

/// A draw that reads the eyes, a uniform block of type `U` and a text, the last two once per frame in flight.
pub(super) struct TextDraw<U> {
    pipeline: GraphicsPipeline,
    in_flight: [InFlight; FRAMES_IN_FLIGHT],
    block: PhantomData<U>,
}

/// What the CPU writes for a frame, and its bindings.
struct InFlight {
    uniform: Buffer,
    glyphs: Buffer,
    group: BindGroup,
}

impl Text {
    /// `text` broken into lines and centred; what does not fit is cut. Characters outside ASCII become boxes.
    pub fn new(text: &str) -> Self {
        Self::of(text.lines())
    }

    /// The same of paragraphs. The thread that draws makes texts, and takes no memory for them.
    pub fn of<'a>(paragraphs: impl Iterator<Item = &'a str> + Clone) -> Self {
        let mut made = Self::default();
        let lines = shown_lines(paragraphs);
        let first_row = (TEXT_CELLS[1] - lines.clone().count()) / 2;
        for (row, line) in lines.enumerate() {
            let length = line.chars().count();
            let indent = (TEXT_CELLS[0] - length) / 2;
            let [left, top, right, bottom] = made.used;
            let (this, next) = (first_row + row, first_row + row + 1);
            made.used = [left.min(indent), top.min(this), right.max(indent + length), bottom.max(next)];
            for (column, character) in line.chars().enumerate() {
                let cell = this * TEXT_CELLS[0] + indent + column;
                made.glyphs[cell] = font::glyph(character);
            }
        }
        made
    }

    /// What a panel behind the text covers: left, top, right, bottom, in cells from the upper left.
    pub(super) fn box_cells(&self) -> [f32; 4] {
        let [left, top, right, bottom] = self.used.map(|cell| cell as f32);
        [left - 1.5, top - 0.75, right + 1.5, bottom + 0.75]
    }
}

/// The lines of these paragraphs that there is room for.
pub(crate) fn shown_lines<'a>(
    paragraphs: impl Iterator<Item = &'a str> + Clone,
) -> impl Iterator<Item = &'a str> + Clone {
    paragraphs.flat_map(|paragraph| wrapped(paragraph, TEXT_CELLS[0])).take(TEXT_CELLS[1])
}

/// Lines of at most `columns` characters, broken at spaces where there are any, and else inside of words.
fn wrapped(paragraph: &str, columns: usize) -> impl Iterator<Item = &str> + Clone {
    let mut rest = Some(paragraph);
    std::iter::from_fn(move || {
        let text = rest?;
        let Some((end, next)) = text.char_indices().nth(columns) else { return rest.take() };
        let line = match text[..end].rfind(' ') {
            _ if next == ' ' => &text[..end],
            Some(space) if space > 0 => &text[..space],
            _ => &text[..end],
        };
        let after = &text[line.len()..];
        rest = Some(after.strip_prefix(' ').unwrap_or(after));
        Some(line)
    })
}

/// A panel ahead of a head, upright, at the head's height.
pub fn panel_ahead(stage_from_head: Pose) -> Pose {
    let ahead = stage_from_head.orientation * Vec3::NEG_Z;
    let yaw = f32::atan2(-ahead.x, -ahead.z);
    let orientation = Quat::from_rotation_y(yaw);
    let position = stage_from_head.position + orientation * Vec3::new(0.0, 0.0, -TEXT_DISTANCE_M);
    Pose { position, orientation }
}

impl<U: bytemuck::Pod> TextDraw<U> {
    /// The pipeline of `desc`. Its shaders have the uniform block `block`, `Eyes` and `Text`.
    pub(super) fn new(
        gpu: &Arc<Gpu>,
        desc: &GraphicsPipelineDesc<'_>,
        block: &'static str,
        eyes: [&Buffer; FRAMES_IN_FLIGHT],
    ) -> Result<Self, GpuError> {
        let pipeline = GraphicsPipeline::new(gpu, desc)?;
        let of_frame = |eyes: &Buffer| {
            let uniform = Buffer::new(gpu, block, size_of::<U>() as u64, Memory::Upload)?;
            let bytes = size_of_val(&Text::default().glyphs) as u64;
            let glyphs = Buffer::new(gpu, "text", bytes, Memory::Upload)?;
            let binds = [
                ("Eyes", Bind::Buffer(eyes)),
                (block, Bind::Buffer(&uniform)),
                ("Text", Bind::Buffer(&glyphs)),
            ];
            let group = BindGroup::new(pipeline.layout(), &binds)?;
            Ok::<_, GpuError>(InFlight { uniform, glyphs, group })
        };
        let in_flight = [of_frame(eyes[0])?, of_frame(eyes[1])?, of_frame(eyes[2])?];
        Ok(Self { pipeline, in_flight, block: PhantomData })
    }

    /// Draws `vertices` vertices with `uniform`, and with `text` where there is one. The last recording of frame in flight
    /// `flight` has finished.
    pub(super) fn record(
        &mut self,
        recorder: &mut Recorder,
        flight: usize,
        uniform: &U,
        text: Option<&Text>,
        vertices: u32,
    ) {
        let frame = &mut self.in_flight[flight];
        frame.uniform.write(0, bytemuck::bytes_of(uniform));
        if let Some(text) = text {
            frame.glyphs.write(0, bytemuck::cast_slice(&text.glyphs));
        }
        recorder.bind(&self.pipeline, &frame.group);
        recorder.draw(vertices, 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_at_spaces_and_keep_every_word() {
        let lines = |text| wrapped(text, 12).collect::<Vec<_>>();
        assert_eq!(
            lines("the server is not the one that was pinned"),
            ["the server", "is not the", "one that was", "pinned"]
        );
        assert_eq!((lines(""), lines("twelve chars")), (vec![""], vec!["twelve chars"]));
    }

    #[test]
    fn long_words_are_broken_and_keep_every_character() {
        let lines = |text| wrapped(text, 4).collect::<Vec<_>>();
        assert_eq!(lines("delete /ho\u{e9}me/user x"), ["dele", "te", "/ho\u{e9}", "me/u", "ser", "x"]);
        assert_eq!(lines(" abcdef"), [" abc", "def"]);
    }

    #[test]
    fn text_that_does_not_fit_is_cut() {
        let long = "x".repeat(1000) + "\n\n\n\n\n\n\n\n\nlast";
        Text::new(&long);
        assert_ne!(Text::new("a"), Text::new("b"));
    }

    #[test]
    fn a_panel_covers_all_lines_and_not_much_more() {
        assert_eq!(Text::new("ab\nabcd").used, [18, 2, 22, 4]);
        let full = Text::new(&"x".repeat(1000));
        assert_eq!(full.used, [0, 0, TEXT_CELLS[0], TEXT_CELLS[1]], "all lines, cut");
    }

    #[test]
    fn the_panel_is_ahead_of_the_head_and_upright() {
        let head = Pose {
            position: Vec3::new(1.0, 1.5, 2.0),
            orientation: Quat::from_rotation_y(0.5) * Quat::from_rotation_x(-0.4),
        };
        let panel = panel_ahead(head);
        assert!((panel.position.y - 1.5).abs() < 1e-6);
        let ahead = (panel.position - head.position).normalize();
        assert!(ahead.dot(Quat::from_rotation_y(0.5) * Vec3::NEG_Z) > 0.9999, "{ahead}");
        assert!(((panel.orientation * Vec3::Z) + ahead).length() < 1e-5, "it faces the head");
    }
}

//! What is behind everything, at far depth: the scene's environment, or before there is a scene a waiting room with a
//! gradient, a floor grid and a text (`client_background.*`).

use super::FRAMES_IN_FLIGHT;

use glam::{Mat4, Quat, Vec3};
use shadecast_gpu::{
    Bind, BindGroup, Buffer, Gpu, GpuError, GraphicsPipeline, GraphicsPipelineDesc, Memory, Recorder,
    RenderPass,
};
use shadecast_protocol::message::Environment;
use shadecast_protocol::pose::Pose;
use shadecast_shaders::font;
use shadecast_shaders::generated::{BackdropGpu, CLIENT_BACKGROUND_FRAG, CLIENT_BACKGROUND_VERT};
use std::sync::Arc;

/// Columns and rows of text that are shown at most.
pub const TEXT_CELLS: [usize; 2] = [40, 6];
/// A character's extent in metres: at 1.75 m about 1.2 by 1.8 degrees.
pub(super) const CELL_EXTENT_M: [f32; 2] = [0.036, 0.054];
/// How far ahead of the head the text appears.
const TEXT_DISTANCE_M: f32 = 1.75;
/// The waiting room's light: neutral, dim enough for a dark room.
const WAITING_ROOM: Environment =
    Environment { zenith: [0.035, 0.038, 0.045], horizon: [0.11, 0.115, 0.125], nadir: [0.05, 0.05, 0.055] };

/// What to show behind everything.
#[derive(Clone, Copy, Debug)]
pub enum Backdrop<'a> {
    /// The scene's environment; its space is the world.
    Environment(&'a Environment),
    /// The waiting room; its space is the stage.
    WaitingRoom {
        /// Where the text is.
        stage_from_panel: Pose,
        /// What it says.
        text: &'a Text,
    },
}

/// A text as the shaders read it.
#[derive(Clone, Debug, PartialEq)]
pub struct Text {
    words: [u32; TEXT_CELLS[0] * TEXT_CELLS[1] * 2],
    /// First and last cell, exclusive, that holds a character: left, top, right, bottom.
    used: [usize; 4],
}

impl Default for Text {
    /// Nothing.
    fn default() -> Self {
        let [columns, rows] = TEXT_CELLS;
        Self { words: [0; TEXT_CELLS[0] * TEXT_CELLS[1] * 2], used: [columns, rows, 0, 0] }
    }
}

/// The pipeline, and what it reads per frame in flight.
pub struct Background {
    pipeline: GraphicsPipeline,
    slots: [(Buffer, Buffer, BindGroup); FRAMES_IN_FLIGHT],
}

impl Text {
    /// `text` broken into lines and centred; what does not fit is cut. Characters outside ASCII become boxes.
    pub fn new(text: &str) -> Self {
        let mut made = Self::default();
        let lines = wrapped(text, TEXT_CELLS[0]);
        let first_row = (TEXT_CELLS[1] - lines.len().min(TEXT_CELLS[1])) / 2;
        for (row, line) in lines.iter().take(TEXT_CELLS[1]).enumerate() {
            let length = line.chars().count().min(TEXT_CELLS[0]);
            let indent = (TEXT_CELLS[0] - length) / 2;
            let [left, top, right, bottom] = made.used;
            let (this, next) = (first_row + row, first_row + row + 1);
            made.used = [left.min(indent), top.min(this), right.max(indent + length), bottom.max(next)];
            for (column, character) in line.chars().take(TEXT_CELLS[0]).enumerate() {
                let cell = this * TEXT_CELLS[0] + indent + column;
                made.words[cell * 2..cell * 2 + 2].copy_from_slice(&font::glyph(character));
            }
        }
        made
    }

    /// Two words a cell, row by row.
    pub(super) fn words(&self) -> &[u32] {
        &self.words
    }

    /// What a panel behind the text covers: left, top, right, bottom, in cells from the upper left.
    pub(super) fn box_cells(&self) -> [f32; 4] {
        let [left, top, right, bottom] = self.used.map(|cell| cell as f32);
        [left - 1.5, top - 0.75, right + 1.5, bottom + 0.75]
    }
}

/// Lines of at most `columns` characters, broken at spaces where there are any.
fn wrapped(text: &str, columns: usize) -> Vec<String> {
    let mut lines = Vec::new();
    for paragraph in text.lines() {
        let mut line = String::new();
        for word in paragraph.split(' ') {
            if !line.is_empty() && line.chars().count() + 1 + word.chars().count() > columns {
                lines.push(std::mem::take(&mut line));
            }
            if !line.is_empty() {
                line.push(' ');
            }
            line.push_str(word);
        }
        lines.push(line);
    }
    lines
}

/// A panel ahead of a head, upright, at the head's height.
pub fn panel_ahead(stage_from_head: Pose) -> Pose {
    let ahead = stage_from_head.orientation * Vec3::NEG_Z;
    let yaw = f32::atan2(-ahead.x, -ahead.z);
    let orientation = Quat::from_rotation_y(yaw);
    let position = stage_from_head.position + orientation * Vec3::new(0.0, 0.0, -TEXT_DISTANCE_M);
    Pose { position, orientation }
}

impl Background {
    /// The pipeline for `pass`.
    pub fn new(
        gpu: &Arc<Gpu>,
        pass: &RenderPass,
        eyes: [&Buffer; FRAMES_IN_FLIGHT],
    ) -> Result<Self, GpuError> {
        let desc = GraphicsPipelineDesc {
            depth_write: Some(false),
            ..GraphicsPipelineDesc::new(&CLIENT_BACKGROUND_VERT, &CLIENT_BACKGROUND_FRAG, pass)
        };
        let pipeline = GraphicsPipeline::new(gpu, &desc)?;
        let slot = |eyes: &Buffer| {
            let backdrop = Buffer::new(gpu, "backdrop", size_of::<BackdropGpu>() as u64, Memory::Upload)?;
            let text = Buffer::new(gpu, "text", size_of_val(Text::default().words()) as u64, Memory::Upload)?;
            let binds = [
                ("Eyes", Bind::Buffer(eyes)),
                ("Backdrop", Bind::Buffer(&backdrop)),
                ("Text", Bind::Buffer(&text)),
            ];
            let group = BindGroup::new(pipeline.layout(), &binds)?;
            Ok::<_, GpuError>((backdrop, text, group))
        };
        let slots = [slot(eyes[0])?, slot(eyes[1])?, slot(eyes[2])?];
        Ok(Self { pipeline, slots })
    }

    /// Draws `backdrop` where nothing nearer is. The last recording of frame slot `frame_slot` has finished.
    pub fn record(&mut self, recorder: &mut Recorder, frame_slot: usize, backdrop: Backdrop<'_>) {
        let (uniform, text, group) = &mut self.slots[frame_slot];
        uniform.write(0, bytemuck::bytes_of(&backdrop.gpu()));
        if let Backdrop::WaitingRoom { text: shown, .. } = backdrop {
            text.write(0, bytemuck::cast_slice(&shown.words));
        }
        recorder.bind(&self.pipeline, group);
        recorder.draw(3, 1);
    }
}

impl Backdrop<'_> {
    fn gpu(&self) -> BackdropGpu {
        let (environment, panel_from_space, waits) = match self {
            Self::Environment(environment) => (*environment, Mat4::IDENTITY, 0.0),
            Self::WaitingRoom { stage_from_panel, .. } => {
                (&WAITING_ROOM, stage_from_panel.inverse().matrix(), 1.0)
            }
        };
        let rgb = |c: [f32; 3], w: f32| [c[0], c[1], c[2], w];
        BackdropGpu {
            zenith: rgb(environment.zenith, waits),
            horizon: rgb(environment.horizon, 0.0),
            nadir: rgb(environment.nadir, 0.0),
            panel_from_space: panel_from_space.to_cols_array_2d(),
            text_cells: [TEXT_CELLS[0] as u32, TEXT_CELLS[1] as u32, 0, 0],
            cell_extent_m: [CELL_EXTENT_M[0], CELL_EXTENT_M[1], 0.0, 0.0],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_at_spaces_and_keep_every_word() {
        assert_eq!(
            wrapped("the server is not the one that was pinned", 12),
            ["the server", "is not the", "one that was", "pinned"]
        );
        assert_eq!(wrapped("a\nb", 12), ["a", "b"]);
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
        assert_eq!(full.used, [0, 2, TEXT_CELLS[0], 3], "one line, cut");
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

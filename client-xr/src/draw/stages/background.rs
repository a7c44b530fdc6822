//! The background at far depth: the scene's environment, or, before there is a scene, a waiting room with a gradient, a floor
//! grid and a text (`client_background.*`).

use super::FRAMES_IN_FLIGHT;
use super::text::{CELL_EXTENT_M, TEXT_CELLS, Text, TextDraw};
use glam::Mat4;
use shadecast_gpu::{Buffer, Gpu, GpuError, GraphicsPipelineDesc, Recorder, RenderPass};
use shadecast_protocol::message::Environment;
use shadecast_protocol::pose::Pose;
use shadecast_shaders::generated::{BackdropGpu, CLIENT_BACKGROUND_FRAG, CLIENT_BACKGROUND_VERT};
use std::sync::Arc;

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

/// The stage.
pub struct Background {
    environment: TextDraw<BackdropGpu>,
    waiting_room: TextDraw<BackdropGpu>,
}

impl Background {
    /// The pipelines for `pass`.
    pub fn new(
        gpu: &Arc<Gpu>,
        pass: &RenderPass,
        eyes: [&Buffer; FRAMES_IN_FLIGHT],
    ) -> Result<Self, GpuError> {
        let draw = |is_waiting_room: bool| {
            let desc = GraphicsPipelineDesc {
                depth_write: Some(false),
                constants: &[u32::from(is_waiting_room)],
                ..GraphicsPipelineDesc::new(&CLIENT_BACKGROUND_VERT, &CLIENT_BACKGROUND_FRAG, pass)
            };
            TextDraw::new(gpu, &desc, "Backdrop", eyes)
        };
        Ok(Self { environment: draw(false)?, waiting_room: draw(true)? })
    }

    /// Draws `backdrop` where nothing nearer is. The last recording of frame in flight `flight` has finished.
    pub fn record(&mut self, recorder: &mut Recorder, flight: usize, backdrop: Backdrop<'_>) {
        let (draw, text) = match backdrop {
            Backdrop::Environment(_) => (&mut self.environment, None),
            Backdrop::WaitingRoom { text, .. } => (&mut self.waiting_room, Some(text)),
        };
        draw.record(recorder, flight, &backdrop.gpu(), text, 3);
    }
}

impl Backdrop<'_> {
    fn gpu(&self) -> BackdropGpu {
        let (environment, panel_from_space) = match self {
            Self::Environment(environment) => (*environment, Mat4::IDENTITY),
            Self::WaitingRoom { stage_from_panel, .. } => {
                (&WAITING_ROOM, stage_from_panel.inverse().matrix())
            }
        };
        let rgb = |c: [f32; 3]| [c[0], c[1], c[2], 0.0];
        BackdropGpu {
            zenith: rgb(environment.zenith),
            horizon: rgb(environment.horizon),
            nadir: rgb(environment.nadir),
            panel_from_space: panel_from_space.to_cols_array_2d(),
            text_cells: [TEXT_CELLS[0] as u32, TEXT_CELLS[1] as u32, 0, 0],
            cell_extent_m: [CELL_EXTENT_M[0], CELL_EXTENT_M[1], 0.0, 0.0],
        }
    }
}

//! The client's display: a headset behind OpenXR ([`xr`]), or a desktop window in its place.
//!
//! The runtime's or desktop's events enter, and drawn images of two layers. Display times, head and eye poses, presses and
//! images to draw to leave, by the trait [`Display`]. Nothing here knows scenes, servers and pictures.

pub(crate) mod rest;
#[cfg(feature = "desktop")]
pub mod window;
pub mod xr;

use glam::{Quat, Vec3};
use shadecast_gpu::{Gpu, GpuError, Part, vk};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::time::ClientTime;
use std::sync::Arc;
use xr::error::XrError;

/// Eye height where nobody knows a floor, metres.
pub const ASSUMED_EYE_HEIGHT_M: f32 = 1.6;

/// What goes wrong with a display.
#[derive(Debug, thiserror::Error)]
pub enum DisplayError {
    /// The headset's runtime.
    #[error(transparent)]
    Xr(XrError),
    /// The device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// There is no window, or no longer.
    #[error("{0}")]
    Window(String),
}

impl From<XrError> for DisplayError {
    fn from(error: XrError) -> Self {
        match error {
            XrError::Gpu(error) => Self::Gpu(error),
            error => Self::Xr(error),
        }
    }
}

impl DisplayError {
    /// True where device or session are gone, and opening the display anew helps.
    pub fn is_lost(&self) -> bool {
        match self {
            Self::Xr(error) => matches!(error, XrError::Lost(_)),
            Self::Gpu(error) => error.is_lost(),
            Self::Window(_) => false,
        }
    }
}

/// What to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Activity {
    /// Nothing is shown: look again soon.
    Idle,
    /// Wait for a frame and draw it.
    Running,
    /// The session has ended for good.
    Exit,
}

/// A frame that the display asked for, between waiting and ending. Consumed by [`Display::end_frame`].
#[derive(Debug)]
#[must_use]
pub struct FrameTurn {
    /// What the display itself calls the time at which the frame will be seen, nanoseconds.
    pub(crate) own_time_ns: i64,
    /// When it will be seen, on `CLOCK_MONOTONIC`.
    pub display_time: ClientTime,
    /// How long it will be seen, nanoseconds.
    pub period_ns: i64,
    /// False where nobody sees it, so that drawing it is a waste.
    pub should_render: bool,
}

/// Where the head and its two eyes are at a display time, in the stage's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Views {
    /// The head.
    pub stage_from_head: Pose,
    /// Metres per second along the stage's axes.
    pub linear_velocity: Vec3,
    /// Radians per second about the stage's axes.
    pub angular_velocity: Vec3,
    /// Left and right eye in the stage.
    pub stage_from_eye: [Pose; 2],
    /// Left and right frustum.
    pub fov: [Fov; 2],
    /// Where the left and the right hand hold a controller in the stage, as far as that is known.
    pub stage_from_hand: [Option<Pose>; 2],
    /// Rises whenever the stage has got another origin, or the session has begun anew: poses before and after it are not of
    /// one motion.
    pub jumps: u32,
}

/// The images of both eyes, two layers each, that are drawn to in turn.
#[derive(Clone, Copy, Debug)]
pub struct EyeImages<'a> {
    /// All of them.
    pub images: &'a [vk::Image],
    /// Of all.
    pub format: vk::Format,
    /// Width and height of one eye in pixels.
    pub extent_pixels: [u32; 2],
    /// Whether the left eye may be drawn alone.
    pub one_eye: bool,
    /// What says where fewer fragments are enough, where there is such a thing.
    pub density_maps: Option<DensityMaps<'a>>,
}

/// The maps of fragment densities that a display makes for its images: of two layers, as these are.
#[derive(Clone, Copy, Debug)]
pub struct DensityMaps<'a> {
    /// One for each image.
    pub images: &'a [vk::Image],
    /// Width and height of one layer.
    pub extent_texels: [u32; 2],
}

/// What somebody has pressed, counted since the display was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Presses {
    /// To go to the next entry of a list.
    pub nexts: u32,
    /// To take the one that is marked.
    pub takes: u32,
    /// To halt the world, or to let it go on.
    pub halts: u32,
    /// To let a halted world go on by a step.
    pub steps: u32,
}

/// Who shows frames. In this order: wait, acquire, locate, release, end; where nothing is drawn: wait, locate, end.
pub trait Display {
    /// The device to draw with.
    fn gpu(&self) -> &Arc<Gpu>;

    /// The display's name for itself.
    fn name(&self) -> &str;

    /// What is drawn to.
    fn eye_images(&self) -> EyeImages<'_>;

    /// What is drawn of them in this frame.
    fn part(&self) -> Part {
        Part { extent: self.eye_images().extent_pixels, first_alone: false }
    }

    /// Asks for the session's end; [`Activity::Exit`] follows.
    fn request_exit(&mut self);

    /// Takes in what happened to the session, and begins or ends it as that says.
    fn poll_events(&mut self) -> Result<Activity, DisplayError>;

    /// Sleeps until the next frame is wanted, and begins it.
    fn wait_frame(&mut self) -> Result<FrameTurn, DisplayError>;

    /// Where head and eyes will be when the frame is seen. Call it as late as possible.
    fn locate_views(&mut self, turn: &FrameTurn) -> Result<Views, DisplayError>;

    /// Takes the next image to draw to, once nobody shows it any more: its place in [`Display::eye_images`].
    fn acquire_image(&mut self) -> Result<usize, DisplayError>;

    /// Gives the image, drawn to by submitted work, back to be shown.
    fn release_image(&mut self) -> Result<(), DisplayError>;

    /// Ends a frame: the last released image is shown as seen from where the eyes were located last.
    fn end_frame(&mut self, turn: FrameTurn) -> Result<(), DisplayError>;

    /// Ends a frame for which nothing was drawn: what was shown last is shown again, as seen from where the eyes were then. Nothing is
    /// shown where nothing was.
    fn end_same_frame(&mut self, turn: FrameTurn) -> Result<(), DisplayError>;

    /// Ends a frame that shows nothing.
    fn end_empty_frame(&mut self, turn: FrameTurn) -> Result<(), DisplayError>;

    /// Whether it leaves cores to others by itself, where there is no GPU.
    fn rests(&self) -> bool {
        false
    }

    /// What somebody has pressed.
    fn presses(&self) -> Presses {
        Presses::default()
    }

    /// Whether somebody wants to see figures over the picture.
    fn wants_figures(&self) -> bool {
        false
    }

    /// Shows these from now on, a line a row. False: it has no place of its own for them, and they are to be drawn into the picture.
    fn show_figures(&mut self, _lines: &[String]) -> bool {
        false
    }
}

impl Views {
    /// The eyes as the protocol has them.
    pub fn eyes(&self) -> [Eye; 2] {
        let head_from_stage = self.stage_from_head.inverse();
        std::array::from_fn(|eye| Eye {
            head_from_eye: head_from_stage.then(self.stage_from_eye[eye]),
            fov: self.fov[eye],
        })
    }

    pub(crate) fn is_valid(&self) -> bool {
        self.stage_from_head.is_valid()
            && self.stage_from_eye.iter().all(|pose| pose.is_valid())
            && self.fov.iter().all(|fov| fov.is_valid())
    }

    /// A standing head that looks ahead, with whatever frusta are known.
    pub(crate) fn without_tracking(self) -> Self {
        let head = Pose { position: Vec3::new(0.0, ASSUMED_EYE_HEIGHT_M, 0.0), orientation: Quat::IDENTITY };
        let fov = self.fov.map(|fov| if fov.is_valid() { fov } else { Fov::symmetric_degrees(90.0) });
        Self {
            stage_from_head: head,
            linear_velocity: Vec3::ZERO,
            angular_velocity: Vec3::ZERO,
            stage_from_eye: [head; 2],
            fov,
            stage_from_hand: self.stage_from_hand,
            jumps: self.jumps,
        }
    }
}

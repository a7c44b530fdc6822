//! Reports of a client to its driver: its connection, its display frames and its end.

use crate::display::DisplayError;
use shadecast_gpu::GpuError;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{Refused, Welcome};
use shadecast_protocol::time::{ClientTime, ServerTime, WorldTime};

/// What ends a client.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The headset, or the window in its place.
    #[error(transparent)]
    Display(#[from] DisplayError),
    /// The device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

impl ClientError {
    /// True where device or session are gone, and opening the display anew helps.
    pub fn is_lost(&self) -> bool {
        match self {
            Self::Display(error) => error.is_lost(),
            Self::Gpu(error) => error.is_lost(),
        }
    }
}

#[cfg(test)]
impl FrameReport {
    /// A rendered frame of which nothing else is to be said.
    pub(crate) fn rendered_at(display_time: ClientTime) -> Self {
        Self {
            display_time,
            server_time: None,
            world_time: None,
            clock_error_bound_ns: None,
            motion_time: None,
            is_rendered: true,
            is_repeated: false,
            update: None,
            is_new: false,
            held_vertices: 0,
            frozen_vertices: 0,
            withheld_vertices: 0,
            withheld_patches: 0,
            arena_waiting_bytes: 0,
        }
    }
}

/// How long a picture was in the decoder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DecodedIn {
    /// Its update.
    pub update: UpdateId,
    /// Begin and end.
    pub times: [ClientTime; 2],
}

/// What became of a connection, for who drives it.
#[derive(Clone, Debug, PartialEq)]
pub enum Notice {
    /// The session stands.
    Welcome(Welcome),
    /// The server wants no session: close, tell the user, and try again later.
    Refused(Refused),
    /// The server does not know this client: a code is to be shown.
    PairingNeeded,
    /// A code was typed at the server.
    PairingAnswer {
        /// The server's part of the exchange.
        element: [u8; 32],
        /// That the server has the code.
        proof: [u8; 32],
    },
    /// The server has ended the session: close, and connect again.
    ServerLeft,
    /// What the server said makes no sense, or cannot be shown: close, and connect again.
    Failed(String),
}

/// What came of one call of [`crate::client::Client::step`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Step {
    /// A display frame.
    Frame(FrameReport),
    /// The headset shows nothing of ours now; step again soon.
    Idle,
    /// The session has ended for good.
    Exit,
}

/// One display frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameReport {
    /// When it is seen.
    pub display_time: ClientTime,
    /// The same on the server's clock, once that is known.
    pub server_time: Option<ServerTime>,
    /// The world's time that is due then: the same as the server's until somebody halts the world.
    pub world_time: Option<WorldTime>,
    /// How far that can be off, nanoseconds.
    pub clock_error_bound_ns: Option<i64>,
    /// The world's time at which all animated vertices drawn are; the same as `world_time` unless samples are short.
    pub motion_time: Option<WorldTime>,
    /// False where the runtime wanted no picture, or where the device was not done with those before.
    pub is_rendered: bool,
    /// The device was not done with those before, so that the last one is shown again.
    pub is_repeated: bool,
    /// The update on display; `None`: no bundle yet, the waiting room is seen.
    pub update: Option<UpdateId>,
    /// True where the bundle is on display for the first time.
    pub is_new: bool,
    /// Animated vertices that go on at their last velocity for want of samples or poses.
    pub held_vertices: u32,
    /// Animated vertices that have stopped for want of samples, poses or predictions.
    pub frozen_vertices: u32,
    /// Vertices not drawn for want of their skeleton, or of its keys or poses.
    pub withheld_vertices: u32,
    /// Patches not drawn for want of samples.
    pub withheld_patches: u32,
    /// Bytes of skeletons, keys and morph targets that wait for the GPU's memory.
    pub arena_waiting_bytes: u64,
}

impl FrameReport {
    /// Whether somebody sees a picture: a new one, or the last one again.
    pub fn is_seen(&self) -> bool {
        self.is_rendered || self.is_repeated
    }
}

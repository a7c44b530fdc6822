//! Control messages and datagrams: what the two sides say beside pictures and geometry.
//!
//! All are `postcard`. The version fields of a hello and the whole of a refusal keep their place and type in every
//! version of the protocol, so that two versions that understand nothing else can still say what to update.

use crate::ids::{DiscontinuityId, FrameId};
use crate::limits::{
    ATLAS_MAX_EXTENT, BLOCK_MAX_LOG2, MAX_CODECS, MAX_CONTROL_BYTES, MAX_COORDINATE_M, MAX_DATAGRAM_BYTES,
    MAX_EYE_EXTENT_PIXELS, MAX_PATCH_SLOTS, MAX_SPEED, MAX_TEXT_BYTES, MAX_VERTEX_SLOTS,
};
use crate::pose::{Eye, Pose};
use crate::time::{DisplayTime, Grid, ServerTime};
use crate::wire::WireError;
use glam::Vec3;
use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// What a client says on the control stream.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ClientMessage {
    /// The first message: who I am and what I can hold.
    Hello(ClientHello),
    /// What is on display; frees the slots of earlier frames for reuse.
    Displayed(Displayed),
    /// The picture stream is broken: send one that needs no other.
    RefreshRequest {
        /// The last frame whose picture decoded, if any.
        after: Option<FrameId>,
    },
    /// The user left.
    Goodbye,
}

/// What a server says on the control stream.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ServerMessage {
    /// The session stands, under these terms.
    Welcome(Welcome),
    /// There will be no session.
    Refused(Refused),
    /// The server ends the session.
    Goodbye,
}

/// Why there is no session, in words for the user.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Refused {
    /// What is wrong.
    pub reason: String,
    /// What to do about it.
    pub remedy: String,
}

/// The client's first words. The first three fields stay as they are in every version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClientHello {
    /// Newest protocol version that the client speaks.
    pub protocol_version: u32,
    /// Oldest protocol version that the client speaks.
    pub min_protocol_version: u32,
    /// The client program's version, for people.
    pub app_version: String,
    /// What the client can hold and decode.
    pub capabilities: Capabilities,
}

/// What a client can hold and decode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Capabilities {
    /// Largest atlas in texels, width and height.
    pub max_atlas_extent: [u32; 2],
    /// Vertices it can keep, 1..=`MAX_VERTEX_SLOTS`.
    pub max_vertex_slots: u32,
    /// Patches it can keep, 1..=`MAX_PATCH_SLOTS`.
    pub max_patch_slots: u32,
    /// What it decodes, best first.
    pub codecs: Vec<Codec>,
    /// Its eyes, left and right.
    pub eyes: [Eye; 2],
    /// Pixels per eye, width and height.
    pub eye_extent_pixels: [u32; 2],
    /// Nanoseconds from one display frame to the next.
    pub display_period_ns: i64,
}

/// How the atlas is coded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Codec {
    /// H.264 byte stream (Annex B), full-range BT.709, 4:2:0 with centre-sited chroma.
    H264,
}

/// The terms of a session.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Welcome {
    /// The version that both will speak.
    pub protocol_version: u32,
    /// Names this session in logs.
    pub session: u64,
    /// The sample grid.
    pub grid: Grid,
    /// Atlas width and height in texels.
    pub atlas_extent_texels: [u32; 2],
    /// Vertex slots that the server will use: 0 to this, exclusive.
    pub vertex_slots: u32,
    /// Patch slots that the server will use: 0 to this, exclusive.
    pub patch_slots: u32,
    /// How the atlas is coded.
    pub codec: Codec,
    /// What is seen where no geometry is.
    pub environment: Environment,
    /// Where the client's stage starts in the world.
    pub world_from_stage: Pose,
    /// Nanoseconds from one update to the next.
    pub update_period_ns: i64,
}

/// A vertical gradient at infinite distance, in linear radiance (red, green, blue).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Environment {
    /// Straight up.
    pub zenith: [f32; 3],
    /// At eye height.
    pub horizon: [f32; 3],
    /// Straight down.
    pub nadir: [f32; 3],
}

/// What a client has on display, and how it fared since it last said so.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Displayed {
    /// The update on display. No earlier one will be shown again.
    pub frame: FrameId,
    /// When it was first on display, by the client's estimate of the server's clock.
    pub display_time: ServerTime,
    /// Display frames since the last report.
    pub display_frames: u32,
    /// Display frames without any bundle since the last report.
    pub frames_without_bundle: u32,
    /// Vertices that ran out of samples and froze, summed over the display frames since the last report.
    pub frozen_vertices: u32,
    /// Patches not drawn for want of samples, summed likewise.
    pub withheld_patches: u32,
    /// Pictures given up or undecodable since the last report.
    pub lost_pictures: u32,
    /// Nanoseconds from a picture's arrival to its bundle's first display, the last one's.
    pub decode_to_display_ns: i64,
}

/// What a server has to offer; [`negotiate`] makes a [`Welcome`] of it.
#[derive(Clone, Debug, PartialEq)]
pub struct ServerOffer {
    /// Newest protocol version that the server speaks.
    pub protocol_version: u32,
    /// Oldest protocol version that the server speaks.
    pub min_protocol_version: u32,
    /// The server program's version, for people.
    pub app_version: String,
    /// Names the session in logs.
    pub session: u64,
    /// The sample grid.
    pub grid: Grid,
    /// Wanted atlas width and height in texels; halved until the client can hold it.
    pub atlas_extent_texels: [u32; 2],
    /// Vertex slots wanted.
    pub vertex_slots: u32,
    /// Patch slots wanted.
    pub patch_slots: u32,
    /// What the server encodes, best first.
    pub codecs: Vec<Codec>,
    /// What is seen where no geometry is.
    pub environment: Environment,
    /// Where the client's stage starts in the world.
    pub world_from_stage: Pose,
    /// Nanoseconds from one update to the next.
    pub update_period_ns: i64,
}

/// What a client sends unreliably.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ClientDatagram {
    /// Where the head is and how it moves.
    Pose(HeadState),
    /// Asks for a [`ServerDatagram::ClockPong`].
    ClockPing {
        /// The client's clock on sending.
        client_send: DisplayTime,
    },
}

/// What a server sends unreliably.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ServerDatagram {
    /// Answers a ping.
    ClockPong {
        /// From the ping.
        client_send: DisplayTime,
        /// The server's clock when the ping came.
        server_receive: ServerTime,
        /// The server's clock when this was sent.
        server_send: ServerTime,
    },
}

/// Where the head is and how it moves, in the world's frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct HeadState {
    /// Rises by one per state; wraps.
    pub sequence: u32,
    /// When the head is there, by the client's estimate of the server's clock.
    pub time: ServerTime,
    /// The head's pose.
    pub world_from_head: Pose,
    /// Metres per second, in the world.
    pub linear_velocity: Vec3,
    /// Radians per second about the world's axes.
    pub angular_velocity: Vec3,
    /// Left and right.
    pub eyes: [Eye; 2],
    /// Changes with every jump.
    pub discontinuity: DiscontinuityId,
}

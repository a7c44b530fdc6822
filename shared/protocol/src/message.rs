//! Control messages and datagrams: everything that the two sides send beside pictures and geometry.
//!
//! All are `postcard`. The version fields of a hello and the whole of a refusal keep their place and type in every version of
//! the protocol. So even two incompatible versions can report which side to update.

use crate::PROTOCOL_VERSION;
use crate::atlas::AtlasExtent;
use crate::ids::{DiscontinuityId, UpdateId};
use crate::limits::{
    ATLAS_MAX_EXTENT, ATLAS_MIN_SIDE, DEFAULT_ARENA_WORDS, DEFAULT_REST_VERTICES, DEFAULT_SAMPLE_RING,
    MAX_ARENA_WORDS, MAX_CODECS, MAX_CONTROL_BYTES, MAX_COORDINATE_M, MAX_DATAGRAM_BYTES,
    MAX_EYE_EXTENT_PIXELS, MAX_EYE_PIXELS, MAX_KEPT_SAMPLES, MAX_PATCH_SLOTS, MAX_POSE_PLACES,
    MAX_REST_VERTICES, MAX_SAMPLE_RING, MAX_SAMPLED_SLOTS, MAX_SPEED, MAX_STORE_PAGES, MAX_TEXT_BYTES,
    MAX_TRIANGLES, MAX_VERTEX_SLOTS, MIN_SAMPLE_RING, PADDING_BYTES,
};
use crate::pairing::{ClientPairing, ServerPairing};
use crate::pose::{Eye, Pose};
use crate::text::printable;
use crate::time::{ClientTime, Grid, ServerTime};
use crate::wire::{WireError, check_count, invalid};
use crate::world_clock::Steer;
use glam::Vec3;
use serde::{Deserialize, Serialize, de::DeserializeOwned};

/// What a client says on the control stream.
#[allow(clippy::large_enum_variant, reason = "a hello is said once a connection")]
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ClientMessage {
    /// The first message: who I am and what I can hold.
    Hello(ClientHello),
    /// What is on display; frees the slots of earlier frames for reuse.
    Displayed(Displayed),
    /// The picture stream is broken: send one that needs no other.
    RefreshRequest {
        /// The last frame whose picture decoded, if any.
        after: Option<UpdateId>,
    },
    /// The user left.
    Goodbye,
    /// Whether somebody looks at the display; taken to be so until said otherwise. Nothing is shaded for nobody.
    Watching {
        /// False while the headset is off, or shows something else.
        is_watched: bool,
    },
    /// The person who looks wants the world to stand, or to go on: for all who look.
    Steer(Steer),
    /// A step of pairing.
    Pairing(ClientPairing),
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
    /// A step of pairing.
    Pairing(ServerPairing),
    /// Of no meaning: how it arrives says what the path carries. [`PADDING_BYTES`] at most.
    Padding(Vec<u8>),
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
    /// From the welcome of the client's last session with this server, if it had one.
    pub resume: Option<ResumeSecret>,
}

impl ClientHello {
    /// That of a client of this version of the protocol alone, which was not served before.
    pub fn new(app_version: &str, capabilities: Capabilities) -> Self {
        Self {
            protocol_version: PROTOCOL_VERSION,
            min_protocol_version: PROTOCOL_VERSION,
            app_version: app_version.to_owned(),
            capabilities,
            resume: None,
        }
    }
}

/// Lets a client that was served come back to its place before others: random, and new with every welcome.
#[derive(Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ResumeSecret(pub [u8; 16]);

impl std::fmt::Debug for ResumeSecret {
    /// Without the bytes: logs are read by others.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ResumeSecret(..)")
    }
}

/// What a client can hold and decode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Capabilities {
    /// Largest texture in texels, width and height; an atlas is halved until it fits.
    pub max_atlas_extent: [u32; 2],
    /// Vertices it can keep, 1..=`MAX_VERTEX_SLOTS`.
    pub max_vertex_slots: u32,
    /// Patches it can keep, 1..=`MAX_PATCH_SLOTS`.
    pub max_patch_slots: u32,
    /// Triangles it draws for each eye, those of two sides twice, 1..=`MAX_TRIANGLES`.
    pub max_triangles: u32,
    /// What it can keep of how vertices move.
    pub motion: MotionMemory,
    /// Pages of the store that it can keep, at most `MAX_STORE_PAGES`.
    pub store_pages: u32,
    /// Whether a block's colours go from one picture to the next while that is on display.
    pub blends: bool,
    /// What it decodes, best first.
    pub codecs: Vec<Codec>,
    /// Its eyes, left and right.
    pub eyes: [Eye; 2],
    /// Pixels per eye, width and height.
    pub eye_extent_pixels: [u32; 2],
    /// Nanoseconds from one display frame to the next.
    pub display_period_ns: i64,
}

impl Capabilities {
    /// Those of a client that holds as much of geometry as any may, and of motion as much as usual.
    pub fn most(eyes: [Eye; 2], eye_extent_pixels: [u32; 2], display_period_ns: i64) -> Self {
        Self {
            max_atlas_extent: ATLAS_MAX_EXTENT,
            max_vertex_slots: MAX_VERTEX_SLOTS,
            max_patch_slots: MAX_PATCH_SLOTS,
            max_triangles: MAX_TRIANGLES,
            motion: MotionMemory::DEFAULT,
            store_pages: 0,
            blends: false,
            codecs: vec![Codec::H264],
            eyes,
            eye_extent_pixels,
            display_period_ns,
        }
    }
}

/// What a client keeps of how vertices move: to skin them by itself, and of what is sent step by step. The server decides what
/// lies where.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MotionMemory {
    /// Words of 16 bytes for skeletons, clips and morph targets, at most `MAX_ARENA_WORDS`.
    pub arena_words: u32,
    /// Vertices before skinning, at most `MAX_REST_VERTICES`.
    pub rest_vertices: u32,
    /// Bones, and palette entries, of all instances together, at most `MAX_POSE_PLACES`.
    pub pose_places: u32,
    /// Steps of the time grid, of each animated vertex and of each instance that is posed on the grid: step `g` lies at `g`
    /// modulo this. A power of two, `MIN_SAMPLE_RING` to `MAX_SAMPLE_RING`.
    pub sample_ring: u32,
}

impl MotionMemory {
    /// As much as a client keeps unless it says otherwise.
    pub const DEFAULT: Self = Self {
        arena_words: DEFAULT_ARENA_WORDS,
        rest_vertices: DEFAULT_REST_VERTICES,
        pose_places: MAX_POSE_PLACES,
        sample_ring: DEFAULT_SAMPLE_RING,
    };
    /// As much as any client may keep.
    pub const MAX: Self = Self {
        arena_words: MAX_ARENA_WORDS,
        rest_vertices: MAX_REST_VERTICES,
        sample_ring: MAX_SAMPLE_RING,
        ..Self::DEFAULT
    };
    /// Nothing but samples: all that moves is sampled.
    pub const NONE: Self =
        Self { arena_words: 0, rest_vertices: 0, pose_places: 0, sample_ring: DEFAULT_SAMPLE_RING };
    /// As little as there can be: nothing moves, or by what updates predict.
    pub const LEAST: Self = Self { sample_ring: MIN_SAMPLE_RING, ..Self::NONE };

    /// The smaller of both, in each.
    #[must_use]
    pub fn min(self, other: Self) -> Self {
        Self {
            arena_words: self.arena_words.min(other.arena_words),
            rest_vertices: self.rest_vertices.min(other.rest_vertices),
            pose_places: self.pose_places.min(other.pose_places),
            sample_ring: self.sample_ring.min(other.sample_ring),
        }
    }

    /// The larger of both, in each.
    #[must_use]
    pub fn max(self, other: Self) -> Self {
        Self {
            arena_words: self.arena_words.max(other.arena_words),
            rest_vertices: self.rest_vertices.max(other.rest_vertices),
            pose_places: self.pose_places.max(other.pose_places),
            sample_ring: self.sample_ring.max(other.sample_ring),
        }
    }

    /// Whether it is no less than another one in anything.
    pub fn holds(self, other: Self) -> bool {
        self.min(other) == other
    }

    fn check(self) -> Result<(), WireError> {
        let rings = MIN_SAMPLE_RING..=MAX_SAMPLE_RING;
        require(
            self.sample_ring.is_power_of_two() && rings.contains(&self.sample_ring),
            "the ring of samples of a client",
            || format!("{} is not a power of two within {rings:?}", self.sample_ring),
        )?;
        check_count("the arena of a client", self.arena_words as usize, MAX_ARENA_WORDS as usize)?;
        check_count(
            "the rest vertices of a client",
            self.rest_vertices as usize,
            MAX_REST_VERTICES as usize,
        )?;
        check_count("the poses of a client", self.pose_places as usize, MAX_POSE_PLACES as usize).map(drop)
    }
}

/// How the atlas is coded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Codec {
    /// H.264 byte stream (Annex B), full-range BT.709, 4:2:0 with centre-sited chroma.
    H264,
    /// The bytes of an [`I420`](crate::picture::I420), each picture a refresh: for links that carry anything.
    Raw,
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
    pub atlas_extent_texels: AtlasExtent,
    /// Vertex slots that the server will use: 0 to this, exclusive.
    pub vertex_slots: u32,
    /// Patch slots that the server will use: 0 to this, exclusive.
    pub patch_slots: u32,
    /// What the client keeps of how vertices move.
    pub motion: MotionMemory,
    /// Pages of the store that the server will use: 1 to this, inclusive.
    pub store_pages: u32,
    /// How the atlas is coded.
    pub codec: Codec,
    /// What is seen where no geometry is.
    pub environment: Environment,
    /// Where the client's stage starts in the world.
    pub world_from_stage: Pose,
    /// Nanoseconds from one update to the next.
    pub update_period_ns: i64,
    /// What to say in the next hello, to come back to the same place.
    pub resume: ResumeSecret,
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
    pub update: UpdateId,
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

impl Displayed {
    /// One report of two: what is on display by that of the later frame, the counters summed.
    #[must_use]
    pub fn merged(self, other: Self) -> Self {
        let newest = if other.update >= self.update { other } else { self };
        let sum = |count: fn(&Self) -> u32| count(&self).saturating_add(count(&other));
        Self {
            display_frames: sum(|report| report.display_frames),
            frames_without_bundle: sum(|report| report.frames_without_bundle),
            frozen_vertices: sum(|report| report.frozen_vertices),
            withheld_patches: sum(|report| report.withheld_patches),
            lost_pictures: sum(|report| report.lost_pictures),
            ..newest
        }
    }
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
    pub atlas_extent_texels: AtlasExtent,
    /// Vertex slots wanted.
    pub vertex_slots: u32,
    /// Patch slots wanted.
    pub patch_slots: u32,
    /// The most that clients need of how vertices move.
    pub motion: MotionMemory,
    /// Whoever keeps this, or more, is sent no samples and no poses, and keeps a ring of as many steps as this says; `None`:
    /// everybody is sent some.
    pub unsampled: Option<MotionMemory>,
    /// Pages of the store wanted.
    pub store_pages: u32,
    /// What the server encodes, best first.
    pub codecs: Vec<Codec>,
    /// What is seen where no geometry is.
    pub environment: Environment,
    /// Where the client's stage starts in the world.
    pub world_from_stage: Pose,
    /// Nanoseconds from one update to the next.
    pub update_period_ns: i64,
    /// What lets this client come back.
    pub resume: ResumeSecret,
}

/// What a client sends unreliably.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum ClientDatagram {
    /// Where the head is and how it moves.
    Pose(HeadState),
    /// Asks for a [`ServerDatagram::ClockPong`].
    ClockPing {
        /// The client's clock on sending.
        client_send: ClientTime,
    },
}

/// What a server sends unreliably.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ServerDatagram {
    /// Answers a ping.
    ClockPong {
        /// From the ping.
        client_send: ClientTime,
        /// The server's clock when the ping came.
        server_receive: ServerTime,
        /// The server's clock when this was sent.
        server_send: ServerTime,
    },
    /// Leaves just before an update's streams.
    ClockStamp {
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

/// The part of a hello that every version of the protocol can read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HelloVersions {
    /// Newest protocol version that the client speaks.
    pub protocol_version: u32,
    /// Oldest protocol version that the client speaks.
    pub min_protocol_version: u32,
    /// The client program's version.
    pub app_version: String,
}

/// Shortest and longest period, in nanoseconds, that makes sense for a display, an update or the sample grid.
const PERIOD_NS: std::ops::RangeInclusive<i64> = 1_000_000..=1_000_000_000;

impl ClientMessage {
    /// The message's bytes, without the control stream's framing.
    pub fn encode(&self) -> Vec<u8> {
        to_bytes(self)
    }

    /// The message of these bytes. A hello of a later protocol version may be followed by fields unknown here.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        check_count("a control message's length in bytes", bytes.len(), MAX_CONTROL_BYTES)?;
        let (mut message, left) = from_prefix::<Self>("a client's message", bytes)?;
        message.check()?;
        if let Self::Hello(hello) = &mut message {
            hello.app_version = printable(&hello.app_version);
        }
        let may_be_longer =
            matches!(&message, Self::Hello(hello) if hello.protocol_version > PROTOCOL_VERSION);
        if left > 0 && !may_be_longer {
            return Err(WireError::Trailing { what: "a client's message", left });
        }
        Ok(message)
    }

    /// The versions in a hello's bytes, whatever follows them; `None` where they are no hello.
    pub fn peek_versions(bytes: &[u8]) -> Option<HelloVersions> {
        let ((variant, protocol_version, min_protocol_version, app_version), _) =
            postcard::take_from_bytes::<(u32, u32, u32, String)>(bytes).ok()?;
        (variant == 0 && app_version.len() <= MAX_TEXT_BYTES).then_some(HelloVersions {
            protocol_version,
            min_protocol_version,
            app_version: printable(&app_version),
        })
    }

    fn check(&self) -> Result<(), WireError> {
        match self {
            Self::Hello(hello) => hello.check(),
            Self::Displayed(_)
            | Self::RefreshRequest { .. }
            | Self::Goodbye
            | Self::Watching { .. }
            | Self::Steer(_)
            | Self::Pairing(_) => Ok(()),
        }
    }
}

impl ServerMessage {
    /// The message's bytes, without the control stream's framing.
    pub fn encode(&self) -> Vec<u8> {
        to_bytes(self)
    }

    /// The message of these bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        check_count("a control message's length in bytes", bytes.len(), MAX_CONTROL_BYTES)?;
        let mut message: Self = from_whole("a server's message", bytes)?;
        match &mut message {
            Self::Welcome(welcome) => welcome.check()?,
            Self::Refused(refused) => {
                check_count("a refusal's reason in bytes", refused.reason.len(), MAX_TEXT_BYTES)?;
                check_count("a refusal's remedy in bytes", refused.remedy.len(), MAX_TEXT_BYTES)?;
                *refused = Refused::new(&refused.reason, &refused.remedy);
            }
            Self::Goodbye | Self::Pairing(_) => {}
            Self::Padding(bytes) => {
                check_count("padding in bytes", bytes.len(), PADDING_BYTES)?;
            }
        }
        Ok(message)
    }
}

impl ClientDatagram {
    /// The datagram's bytes.
    pub fn encode(&self) -> Vec<u8> {
        to_bytes(self)
    }

    /// The datagram of these bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        check_count("a datagram's length in bytes", bytes.len(), MAX_DATAGRAM_BYTES)?;
        let datagram: Self = from_whole("a client's datagram", bytes)?;
        if let Self::Pose(head) = &datagram {
            head.check()?;
        }
        Ok(datagram)
    }
}

impl ServerDatagram {
    /// The datagram's bytes.
    pub fn encode(&self) -> Vec<u8> {
        to_bytes(self)
    }

    /// The datagram of these bytes.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        check_count("a datagram's length in bytes", bytes.len(), MAX_DATAGRAM_BYTES)?;
        from_whole("a server's datagram", bytes)
    }
}

impl Refused {
    /// A refusal whose texts can be shown anywhere; see [`printable`].
    pub fn new(reason: &str, remedy: &str) -> Self {
        Self { reason: printable(reason), remedy: printable(remedy) }
    }
}

impl ClientHello {
    /// True limits and ranges of every field, as an error that names the first that is wrong.
    pub fn check(&self) -> Result<(), WireError> {
        check_versions("a hello's protocol versions", self.protocol_version, self.min_protocol_version)?;
        check_count("a hello's program version in bytes", self.app_version.len(), MAX_TEXT_BYTES)?;
        self.capabilities.check()
    }
}

impl Capabilities {
    fn check(&self) -> Result<(), WireError> {
        check_count("the list of codecs", self.codecs.len(), MAX_CODECS)?;
        self.eyes.iter().try_for_each(check_eye)?;
        let pixels = 1..=MAX_EYE_EXTENT_PIXELS;
        require(
            self.eye_extent_pixels.iter().all(|side| pixels.contains(side)),
            "an eye's extent in pixels",
            || format!("{:?} is not within 1..={MAX_EYE_EXTENT_PIXELS}", self.eye_extent_pixels),
        )?;
        let [width, height] = self.eye_extent_pixels;
        check_count("an eye's number of pixels", width as usize * height as usize, MAX_EYE_PIXELS as usize)?;
        check_slots("the vertex slots of a client", self.max_vertex_slots, MAX_VERTEX_SLOTS)?;
        check_slots("the patch slots of a client", self.max_patch_slots, MAX_PATCH_SLOTS)?;
        check_slots("the triangles of a client", self.max_triangles, MAX_TRIANGLES)?;
        self.motion.check()?;
        check_pages(self.store_pages)?;
        check_period("the display period", self.display_period_ns)
    }
}

impl Welcome {
    /// True limits and ranges of every field, as an error that names the first that is wrong.
    pub fn check(&self) -> Result<(), WireError> {
        check_period("the sample grid's spacing", self.grid.spacing_ns)?;
        check_period("the update period", self.update_period_ns)?;
        check_slots("the vertex slots of a session", self.vertex_slots, MAX_VERTEX_SLOTS)?;
        check_slots("the patch slots of a session", self.patch_slots, MAX_PATCH_SLOTS)?;
        self.motion.check()?;
        check_pages(self.store_pages)?;
        let samples = self.vertex_slots * self.motion.sample_ring;
        check_count("the samples of a session", samples as usize, MAX_KEPT_SAMPLES as usize)?;
        check_pose("where the stage starts", &self.world_from_stage)?;
        self.environment.check()
    }
}

impl Environment {
    fn check(&self) -> Result<(), WireError> {
        let colours = [self.zenith, self.horizon, self.nadir];
        require(colours.iter().flatten().all(|c| c.is_finite() && *c >= 0.0), "the environment", || {
            format!("{colours:?} are not finite radiances of zero or more")
        })
    }
}

impl HeadState {
    /// True ranges of every field, as an error that names the first that is wrong.
    pub fn check(&self) -> Result<(), WireError> {
        check_pose("a head's pose", &self.world_from_head)?;
        let speed_ok = |v: Vec3| v.is_finite() && v.length() <= MAX_SPEED;
        require(
            speed_ok(self.linear_velocity) && speed_ok(self.angular_velocity),
            "a head's velocity",
            || {
                format!(
                    "{} m/s and {} rad/s are not finite and below {MAX_SPEED}",
                    self.linear_velocity, self.angular_velocity
                )
            },
        )?;
        self.eyes.iter().try_for_each(check_eye)
    }
}

/// The terms under which this client and this server can work together, or why they cannot and what to do.
pub fn negotiate(hello: &ClientHello, offer: &ServerOffer) -> Result<Welcome, Refused> {
    let protocol_version =
        negotiate_version(hello.protocol_version, hello.min_protocol_version, &hello.app_version, offer)?;
    let capabilities = &hello.capabilities;
    let codec = offer.codecs.iter().find(|codec| capabilities.codecs.contains(codec)).ok_or_else(|| {
        Refused::new(
            &format!("the client decodes {:?}, the server encodes {:?}", capabilities.codecs, offer.codecs),
            "install a client and a server that share a codec",
        )
    })?;
    let (motion, is_sampled) = negotiate_motion(capabilities.motion, offer);
    let most_slots = if is_sampled { MAX_SAMPLED_SLOTS } else { MAX_VERTEX_SLOTS };
    let vertex_slots = offer.vertex_slots.min(capabilities.max_vertex_slots).min(most_slots);
    Ok(Welcome {
        protocol_version,
        session: offer.session,
        grid: offer.grid,
        atlas_extent_texels: negotiate_atlas(capabilities.max_atlas_extent, offer.atlas_extent_texels)?,
        vertex_slots: vertex_slots.min(MAX_KEPT_SAMPLES / motion.sample_ring),
        patch_slots: offer.patch_slots.min(capabilities.max_patch_slots),
        motion,
        store_pages: offer.store_pages.min(capabilities.store_pages),
        codec: *codec,
        environment: offer.environment,
        world_from_stage: offer.world_from_stage,
        update_period_ns: offer.update_period_ns,
        resume: offer.resume,
    })
}

/// The newest version that both speak; otherwise which of the two to update.
pub fn negotiate_version(
    newest: u32,
    oldest: u32,
    app_version: &str,
    offer: &ServerOffer,
) -> Result<u32, Refused> {
    let version = newest.min(offer.protocol_version);
    if version >= oldest.max(offer.min_protocol_version) {
        return Ok(version);
    }
    let client = format!("the client ({app_version}) speaks protocol {}", span(oldest, newest));
    let server = format!(
        "the server ({}) speaks protocol {}",
        offer.app_version,
        span(offer.min_protocol_version, offer.protocol_version)
    );
    let remedy = if newest < offer.min_protocol_version {
        format!("update the client to one that speaks protocol {}", offer.min_protocol_version)
    } else {
        format!("update the server to one that speaks protocol {oldest}")
    };
    Err(Refused::new(&format!("{client}, {server}"), &remedy))
}

fn span(oldest: u32, newest: u32) -> String {
    if oldest == newest { format!("{newest}") } else { format!("{oldest} to {newest}") }
}

/// The smaller of both, with the ring of samples as small as what is sent allows; and whether any are sent.
fn negotiate_motion(capable: MotionMemory, offer: &ServerOffer) -> (MotionMemory, bool) {
    let agreed = offer.motion.min(capable);
    let unsampled = offer.unsampled.filter(|least| agreed.holds(*least));
    let sample_ring = unsampled.map_or(agreed.sample_ring, |least| least.sample_ring);
    (MotionMemory { sample_ring, ..agreed }, unsampled.is_none())
}

/// The offered extent with its sides halved until the client can hold it.
fn negotiate_atlas(client_max: [u32; 2], offered: AtlasExtent) -> Result<AtlasExtent, Refused> {
    offered.halved_to_fit(client_max).ok_or_else(|| {
        Refused::new(
            &format!("the client holds an atlas of at most {}x{} texels", client_max[0], client_max[1]),
            &format!("use a device with textures of at least {ATLAS_MIN_SIDE}x{ATLAS_MIN_SIDE} texels"),
        )
    })
}

/// What most messages take at most, bytes: they are allocated once.
const USUAL_BYTES: usize = 256;

fn to_bytes<T: Serialize>(value: &T) -> Vec<u8> {
    // Fails only for types that cannot be serialised at all, which ours are not.
    postcard::to_extend(value, Vec::with_capacity(USUAL_BYTES)).expect("plain messages serialise")
}

fn from_prefix<T: DeserializeOwned>(what: &'static str, bytes: &[u8]) -> Result<(T, usize), WireError> {
    let (value, rest) = postcard::take_from_bytes(bytes).map_err(|error| match error {
        // A type of ours that checks itself; what it said does not come through.
        postcard::Error::SerdeDeCustom => invalid(what, "a value in it is outside its range"),
        error => invalid(what, error.to_string()),
    })?;
    Ok((value, rest.len()))
}

fn from_whole<T: DeserializeOwned>(what: &'static str, bytes: &[u8]) -> Result<T, WireError> {
    match from_prefix(what, bytes)? {
        (value, 0) => Ok(value),
        (_, left) => Err(WireError::Trailing { what, left }),
    }
}

fn require(good: bool, what: &'static str, reason: impl FnOnce() -> String) -> Result<(), WireError> {
    if good { Ok(()) } else { Err(invalid(what, reason())) }
}

fn check_versions(what: &'static str, newest: u32, oldest: u32) -> Result<(), WireError> {
    require(oldest <= newest, what, || format!("the oldest, {oldest}, is above the newest, {newest}"))
}

/// The nearest period that a peer may say: a display that tells nonsense of itself is no reason not to be served.
pub fn sayable_period_ns(period_ns: i64) -> i64 {
    period_ns.clamp(*PERIOD_NS.start(), *PERIOD_NS.end())
}

fn check_period(what: &'static str, period_ns: i64) -> Result<(), WireError> {
    require(PERIOD_NS.contains(&period_ns), what, || format!("{period_ns} ns is not within {PERIOD_NS:?}"))
}

fn check_slots(what: &'static str, slots: u32, limit: u32) -> Result<(), WireError> {
    require((1..=limit).contains(&slots), what, || format!("{slots} is not within 1..={limit}"))
}

fn check_pages(pages: u32) -> Result<(), WireError> {
    check_count("the pages of a store", pages as usize, MAX_STORE_PAGES as usize).map(drop)
}

fn check_pose(what: &'static str, pose: &Pose) -> Result<(), WireError> {
    require(pose.is_valid() && pose.position.abs().max_element() <= MAX_COORDINATE_M, what, || {
        format!("{pose:?} is not a rotation of unit length and a position within {MAX_COORDINATE_M} m")
    })
}

fn check_eye(eye: &Eye) -> Result<(), WireError> {
    check_pose("an eye's pose", &eye.head_from_eye)?;
    require(eye.fov.is_valid(), "an eye's field of view", || {
        format!("{:?} is not a frustum of 2 degrees or more within 89 degrees of straight ahead", eye.fov)
    })
}

#[cfg(test)]
mod tests;

//! The client without I/O: bytes and time come in, bytes go out, and each display frame is one [`Client::step`].
//!
//! Two drivers use it: [`crate::net`] with a socket and the real clock, and the lab, which steps it in virtual time beside a
//! server. What it does not know is sockets and who waits for whom.

pub use crate::report::{ClientError, FrameReport, Step};

use crate::decoding::{DecodeTiming, Decoded};
use crate::display::{Display, Views};
use crate::figures::Figures;
use crate::link::Link;
use crate::platform::{self, MakeDecoder};
use crate::renderer::Renderer;
use crate::scene::{ArrivedPicture, Scene};
use crate::scenes::{Scenes, server_time};
use crate::stages::atlas_draw::Lookup;
use crate::stages::interpolate::Interpolation;
use crate::stages::probe::ProbeView;
use crate::stats::{ClientStats, Counters};
use shadecast_gpu::{Gpu, Timings};
use shadecast_protocol::delta::ReceivedDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::limits::{
    ATLAS_MAX_EXTENT, DEFAULT_PATCH_SLOTS, DEFAULT_TRIANGLES, DEFAULT_VERTEX_SLOTS, MAX_PATCH_SLOTS,
    MAX_TRIANGLES, MAX_VERTEX_SLOTS,
};
use shadecast_protocol::message::{Capabilities, Codec, HeadState, MotionMemory, Refused, Welcome};
use shadecast_protocol::motion::message::MotionMessage;
use shadecast_protocol::session::{ClientEvent, Out};
use shadecast_protocol::time::ClientTime;
use shadecast_protocol::wire::{self, StreamMessage, WireError};
use std::collections::VecDeque;
use std::sync::Arc;

/// How a client behaves.
#[derive(Clone, Copy, Debug)]
pub struct ClientOptions {
    /// How positions between samples are found.
    pub interpolation: Interpolation,
    /// Samples per pixel: 1, 2 or 4.
    pub msaa: u32,
    /// How the atlas is looked up.
    pub lookup: Lookup,
    /// How decoding takes time.
    pub decoding: DecodeTiming,
    /// What is announced to the server, best first.
    pub codecs: &'static [Codec],
    /// Makes a decoder for what was agreed.
    pub decoder: MakeDecoder,
    /// Vertices that the client offers to keep.
    pub max_vertex_slots: u32,
    /// Patches that the client offers to keep.
    pub max_patch_slots: u32,
    /// Triangles that the client offers to draw for each eye, those of two sides twice.
    pub max_triangles: u32,
    /// What the client offers to keep to skin by itself.
    pub motion: MotionMemory,
}

impl Default for ClientOptions {
    fn default() -> Self {
        Self {
            interpolation: Interpolation::Cubic,
            msaa: 4,
            lookup: Lookup::default(),
            decoding: DecodeTiming::Thread { now: platform::CLOCK },
            codecs: &[Codec::H264],
            decoder: platform::decoder,
            max_vertex_slots: DEFAULT_VERTEX_SLOTS,
            max_patch_slots: DEFAULT_PATCH_SLOTS,
            max_triangles: DEFAULT_TRIANGLES,
            motion: MotionMemory::DEFAULT,
        }
    }
}

/// Decoded pictures that are remembered for who drives the client.
const MAX_DECODED_TOLD: usize = 16;

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
    /// The server has ended the session: close, and connect again.
    ServerLeft,
    /// What the server said makes no sense, or cannot be shown: close, and connect again.
    Failed(String),
}

/// The client. Fields are dropped in this order: scenes go before the device that made them.
pub struct Client {
    pub(crate) scenes: Scenes,
    pub(crate) renderer: Renderer,
    pub(crate) link: Link,
    pub(crate) options: ClientOptions,
    pub(crate) now: ClientTime,
    counters: Counters,
    figures: Figures,
    notices: VecDeque<Notice>,
    /// Pictures that were decoded, for who wants to know how long that took.
    decoded: VecDeque<DecodedIn>,
}

impl Drop for Client {
    fn drop(&mut self) {
        // The session goes with its images: the GPU must be done with them. A device that is lost is done.
        if let Err(error) = self.renderer.wait_idle() {
            tracing::debug!("waiting for the GPU before the session's end: {error}");
        }
    }
}

impl Client {
    /// A client on an open display, not connected.
    pub fn new(display: Box<dyn Display>, options: ClientOptions) -> Result<Self, ClientError> {
        let counters = Counters::new(display.gpu(), display.name());
        Ok(Self {
            scenes: Scenes::default(),
            renderer: Renderer::new(display, options.msaa, options.lookup)?,
            link: Link::default(),
            options,
            now: ClientTime(0),
            counters,
            figures: Figures::default(),
            notices: VecDeque::new(),
            decoded: VecDeque::with_capacity(MAX_DECODED_TOLD),
        })
    }

    /// Says `text` in the waiting room, which is seen until the first bundle, and before a world that stands still.
    pub fn set_status(&mut self, text: &str) {
        self.renderer.set_status(text);
    }

    /// Asks the runtime to end the session; [`Step::Exit`] follows.
    pub fn request_exit(&mut self) {
        self.renderer.display.request_exit();
    }

    /// The device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.renderer.gpu
    }

    /// Pixels per eye, width and height.
    pub fn eye_extent_pixels(&self) -> [u32; 2] {
        self.renderer.eye_extent_pixels()
    }

    /// Bytes can flow from `now` on. The session begins once the eyes have been located.
    pub fn on_connected(&mut self, now: ClientTime) {
        self.on_closed(now);
        self.link.open();
        self.begin_session();
    }

    /// The connection is gone. What was on display stays there.
    pub fn on_closed(&mut self, now: ClientTime) {
        self.now = now;
        self.scenes.end(self.link.close());
    }

    /// Takes leave of the server: the last bytes come out of [`Client::poll_out`].
    pub fn say_goodbye(&mut self) {
        if let Some(session) = self.link.session() {
            session.goodbye();
        }
    }

    fn begin_session(&mut self) {
        let (options, eye_extent_pixels) = (&self.options, self.renderer.eye_extent_pixels());
        self.link.begin(self.now, |eyes, display_period_ns| Capabilities {
            max_atlas_extent: ATLAS_MAX_EXTENT,
            max_vertex_slots: options.max_vertex_slots.min(MAX_VERTEX_SLOTS),
            max_patch_slots: options.max_patch_slots.min(MAX_PATCH_SLOTS),
            max_triangles: options.max_triangles.min(MAX_TRIANGLES),
            motion: options.motion.min(MotionMemory::MAX),
            codecs: options.codecs.to_vec(),
            eyes,
            eye_extent_pixels,
            display_period_ns,
        });
    }

    /// Takes one message of the server's control stream.
    pub fn receive_control(&mut self, now: ClientTime, message: &[u8]) -> Result<(), ClientError> {
        self.now = now;
        if let Some(session) = self.link.session() {
            session.on_control(message);
        }
        self.take_events()
    }

    /// Takes one whole unidirectional stream.
    pub fn receive_stream(&mut self, now: ClientTime, bytes: &[u8]) -> Result<(), ClientError> {
        self.now = now;
        match wire::parse_stream(bytes) {
            Ok(StreamMessage::Picture { access_unit, .. }) => {
                self.counters.atlas_bytes += access_unit.len() as u64
            }
            _ => self.counters.geometry_bytes += bytes.len() as u64,
        }
        if let Some(session) = self.link.session() {
            session.on_stream(bytes);
        }
        self.take_events()
    }

    /// The server gave up a stream of which `head` had come: a picture that will not be shown in time.
    pub fn receive_reset(&mut self, now: ClientTime, head: &[u8]) {
        self.now = now;
        self.link.stream_was_reset(head);
    }

    /// Takes a datagram.
    pub fn receive_datagram(&mut self, now: ClientTime, bytes: &[u8]) {
        self.now = now;
        if let Some(session) = self.link.session() {
            session.on_datagram(bytes, now);
        }
    }

    /// Does what is due at `now`: pings, decoded pictures, requests.
    pub fn advance(&mut self, now: ClientTime) -> Result<(), ClientError> {
        self.now = now;
        self.begin_session();
        if let Some(session) = self.link.session() {
            session.hold_back(self.scenes.is_full());
            session.on_tick(now);
        }
        self.take_pictures();
        self.take_events()
    }

    /// What is decoded goes to the scene of its connection.
    fn take_pictures(&mut self) {
        let Some(scene) = self.scenes.arriving_mut() else { return };
        let decoded = &mut self.decoded;
        let (lost, has_asked) =
            self.link.decode(self.now, |serial, Decoded { update, arrived, decoding: times, picture }| {
                if scene.serial != serial {
                    return Some(picture);
                }
                if decoded.len() == MAX_DECODED_TOLD {
                    decoded.pop_front();
                }
                decoded.push_back(DecodedIn { update, times });
                let unused = scene.bundler.add_picture(update, ArrivedPicture { arrived, picture });
                unused.map(|unused| unused.picture)
            });
        self.counters.lost_pictures += u64::from(lost);
        self.counters.refresh_requests += u64::from(has_asked);
    }

    /// When [`Client::advance`] next has something to do by itself.
    pub fn next_tick(&self) -> Option<ClientTime> {
        self.link.next_tick()
    }

    /// The next bytes to carry to the server.
    pub fn poll_out(&mut self) -> Option<Out> {
        self.link.poll_out()
    }

    /// What became of the connection.
    pub fn poll_notice(&mut self) -> Option<Notice> {
        self.notices.pop_front()
    }

    /// Pictures that were decoded, each once; of many that nobody asks for the newest.
    pub fn take_decoded(&mut self) -> impl Iterator<Item = DecodedIn> + '_ {
        self.decoded.drain(..)
    }

    fn take_events(&mut self) -> Result<(), ClientError> {
        while let Some(event) = self.link.poll_event() {
            match event {
                ClientEvent::Welcome(welcome) => self.welcome(welcome)?,
                ClientEvent::Delta(delta) => self.take_delta(delta),
                ClientEvent::Picture { header, access_unit } => {
                    if let Some(decoding) = self.link.decoding() {
                        decoding.add(header, access_unit, self.now);
                    }
                }
                ClientEvent::Motion(news) => self.take_motion(news),
                ClientEvent::Refused(refused) => self.notices.push_back(Notice::Refused(refused)),
                ClientEvent::Goodbye => self.notices.push_back(Notice::ServerLeft),
                ClientEvent::Failed(error) => self.notices.push_back(Notice::Failed(error.to_string())),
            }
        }
        Ok(())
    }

    fn welcome(&mut self, welcome: Welcome) -> Result<(), ClientError> {
        let decoder = match (self.options.decoder)(welcome.codec, welcome.atlas_extent_texels) {
            Ok(decoder) => decoder,
            Err(error) => {
                self.notices.push_back(Notice::Failed(error.to_string()));
                return Ok(());
            }
        };
        let Some(serial) = self.link.welcomed(&welcome, decoder, self.options.decoding) else {
            return Ok(());
        };
        self.counters.connections += 1;
        let Renderer { gpu, stages, .. } = &self.renderer;
        let scene = Scene::new(gpu, stages, welcome.clone(), serial)?;
        self.counters.motion_memory_bytes = scene.motion_memory_bytes();
        self.counters.sample_ring = welcome.motion.sample_ring;
        self.scenes.begin(scene);
        self.notices.push_back(Notice::Welcome(welcome));
        Ok(())
    }

    fn take_delta(&mut self, delta: ReceivedDelta) {
        self.counters.vertex_samples +=
            delta.positions.iter().map(|batch| batch.positions.len() as u64).sum::<u64>();
        // A session without a scene of its own, for want of a decoder, has nothing to say to that of another.
        let serial = self.link.serial();
        let Some(scene) = self.scenes.arriving_mut().filter(|scene| Some(scene.serial) == serial) else {
            return;
        };
        scene.take_delta(delta);
        let (contradiction, is_full) = (scene.motion.take_contradiction(), scene.motion.is_full());
        if let Some(session) = self.link.session() {
            session.hold_back(is_full);
        }
        if let Some(slot) = contradiction {
            let reason = format!("vertex slot {} is given anew while it is on display", slot.0);
            self.link.fail(WireError::Invalid { what: "a geometry delta", reason });
        }
    }

    fn take_motion(&mut self, news: MotionMessage) {
        let serial = self.link.serial();
        if let Some(scene) = self.scenes.arriving_mut().filter(|scene| Some(scene.serial) == serial) {
            scene.motion.take_motion(news);
        }
    }

    /// Takes note of a display frame, and tells the server.
    pub(crate) fn note_frame(
        &mut self,
        frame: &FrameReport,
        picture_arrived: Option<ClientTime>,
        views: &Views,
        period_ns: i64,
    ) {
        self.counters.count(frame);
        self.show_figures(frame, picture_arrived);
        self.renderer.note(frame, views.stage_from_head);
        self.link.note_eyes(views, period_ns);
        if let Some(scene) = self.scenes.arriving()
            && let Some(time) = server_time(scene, &self.link, frame.display_time)
        {
            self.link.tell_head(scene.serial, time, scene.terms.world_from_stage, views);
        }
        self.link.report(self.scenes.shown().map(|scene| scene.serial), frame, picture_arrived);
    }

    /// Tells who wants to see it how it goes.
    fn show_figures(&mut self, frame: &FrameReport, picture_arrived: Option<ClientTime>) {
        let display = &mut self.renderer.display;
        if !display.wants_figures() {
            self.figures = Figures::default();
        } else if let Some(lines) = self.figures.note(&self.counters, frame, picture_arrived) {
            display.show_figures(lines);
        }
    }

    /// The head's state at the last display frame, once the server's clock is known.
    pub fn head_state(&self) -> Option<HeadState> {
        self.link.head_state()
    }

    /// For measurements: instance and distance of what the last rendered frame showed, left and right eye. Waits for the
    /// GPU.
    pub fn probe(&mut self) -> Result<[ProbeView; 2], ClientError> {
        Ok(self.renderer.probe(self.scenes.shown())?)
    }

    /// For measurements: what the stages of the last rendered frame took on the device, once for each frame. Waits for the
    /// GPU.
    pub fn frame_timings(&mut self) -> Result<Timings, ClientError> {
        Ok(self.renderer.frame_timings()?)
    }

    /// Bytes of what has come and waits: for an earlier one, for its picture, for the GPU's vertex memory.
    pub fn waiting_bytes(&self) -> usize {
        self.scenes.waiting_bytes() + self.link.waiting_bytes()
    }

    /// For tests: the vertex slots of every triangle that the last rendered frame drew.
    pub fn drawn_triangles(&self) -> Vec<[u32; 3]> {
        let drawn = self.scenes.shown().zip(self.renderer.drawn_indices());
        drawn.map_or(Vec::new(), |(scene, index_count)| scene.drawn_triangles(index_count))
    }

    /// For tests: position and state of every vertex slot as the last display frame had them; empty without a bundle.
    pub fn read_positions(&self) -> Result<Vec<[f32; 4]>, ClientError> {
        let shown = self.scenes.shown();
        Ok(shown.map_or(Ok(Vec::new()), |scene| scene.read_positions(&self.renderer.gpu))?)
    }

    /// How it went so far.
    pub fn stats(&self) -> ClientStats {
        self.counters.stats(&self.renderer.gpu)
    }
}

//! The client without I/O: bytes and time come in, bytes go out, and each display frame is one [`Client::step`].
//!
//! Two drivers use it: [`crate::net`] with a socket and the real clock, and the lab, which steps it in virtual time beside a
//! server. What it does not know is sockets and who waits for whom.

use crate::decode::Picture;
use crate::decoding::{self, DecodeTiming, Decoding};
use crate::platform::{self, MakeDecoder};
use crate::renderer::Stages;
use crate::scene::{ArrivedPicture, Scene};
use crate::stages::background::{self, Text};
use crate::stages::interpolate::Interpolation;
use crate::stages::probe::{Probe, ProbeView};
use crate::stats::{ClientStats, Counters};
use crate::stillness::Stillness;
use crate::watch::Watch;
use crate::xr::{Views, Xr, XrError};
use shadecast_gpu::{Gpu, GpuError, vk};
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::delta::GeometryDelta;
use shadecast_protocol::ids::{DiscontinuityId, UpdateId};
use shadecast_protocol::limits::{ATLAS_MAX_EXTENT, MAX_PATCH_SLOTS, MAX_VERTEX_SLOTS};
use shadecast_protocol::message::{
    Capabilities, ClientHello, Codec, Displayed, HeadState, Refused, ResumeSecret, Welcome,
};
use shadecast_protocol::pose::{Eye, Pose};
use shadecast_protocol::session::{ClientEvent, ClientSession, Out};
use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_protocol::wire::{self, StreamMessage, WireError};
use shadecast_shaders::generated::EyesGpu;
use std::collections::VecDeque;
use std::sync::Arc;

/// What is on display is reported at least this often.
const REPORT_NS: i64 = 250_000_000;

/// How a client behaves.
#[derive(Clone, Copy, Debug)]
pub struct ClientOptions {
    /// How positions between samples are found.
    pub interpolation: Interpolation,
    /// Samples per pixel: 1 or 4.
    pub msaa: u32,
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
}

impl Default for ClientOptions {
    fn default() -> Self {
        Self {
            interpolation: Interpolation::Cubic,
            msaa: 4,
            decoding: DecodeTiming::Thread,
            codecs: &[Codec::H264],
            decoder: platform::decoder,
            max_vertex_slots: MAX_VERTEX_SLOTS,
            max_patch_slots: MAX_PATCH_SLOTS,
        }
    }
}

/// What ends a client.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// The headset.
    #[error(transparent)]
    Xr(#[from] XrError),
    /// The device.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

impl ClientError {
    /// True where device or session are gone, and opening the headset anew helps.
    pub fn is_lost(&self) -> bool {
        let gpu = match self {
            Self::Xr(XrError::Lost(_)) => return true,
            Self::Xr(XrError::Gpu(gpu)) | Self::Gpu(gpu) => gpu,
            Self::Xr(_) => return false,
        };
        gpu.is_lost()
    }
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

/// What came of one call of [`Client::step`].
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
    /// The time, on the server's clock, at which all animated vertices drawn are; the same as `server_time` unless samples
    /// are short.
    pub motion_time: Option<ServerTime>,
    /// False where the runtime wanted no picture.
    pub is_rendered: bool,
    /// The update on display; `None`: no bundle yet, the waiting room is seen.
    pub frame: Option<UpdateId>,
    /// True where the bundle is on display for the first time.
    pub is_new: bool,
    /// Animated vertices that go on at their last velocity for want of samples.
    pub held_vertices: u32,
    /// Animated vertices that have stopped for want of samples.
    pub frozen_vertices: u32,
    /// Patches not drawn for want of samples.
    pub withheld_patches: u32,
}

/// A connection, from the moment that bytes can flow.
pub(crate) struct Connection {
    serial: u64,
    session: ClientSession,
    decoding: Option<Decoding>,
}

impl Drop for Client {
    fn drop(&mut self) {
        // The session goes with its images: the GPU must be done with them. A device that is lost is done.
        let idle =
            self.gpu.record().and_then(|recorder| recorder.submit()).and_then(|last| self.gpu.wait(last));
        if let Err(error) = idle {
            tracing::debug!("waiting for the GPU before the session's end: {error}");
        }
    }
}

impl Connection {
    /// A picture that is not needed any more goes back to the decoder.
    pub(crate) fn recycle(&mut self, picture: Picture) {
        if let Some(decoding) = &mut self.decoding {
            decoding.recycle(picture);
        }
    }
}

/// What the last rendered frame showed, for the probe.
#[derive(Clone, Copy)]
pub(crate) struct LastDrawn {
    pub(crate) eyes: EyesGpu,
    pub(crate) index_count: u32,
}

/// The client. Fields are dropped in this order: what the device made goes before the session.
pub struct Client {
    pub(crate) shown: Option<Scene>,
    pub(crate) next: Option<Scene>,
    pub(crate) stages: Stages,
    pub(crate) probe: Option<Probe>,
    pub(crate) last_drawn: Option<LastDrawn>,
    pub(crate) options: ClientOptions,
    pub(crate) gpu: Arc<Gpu>,
    pub(crate) xr: Xr,
    pub(crate) counters: Counters,
    pub(crate) now: ClientTime,
    pub(crate) panel: Option<Pose>,
    pub(crate) status: Text,
    pub(crate) stillness: Stillness,
    /// Said while the connection stands and brings nothing.
    pub(crate) waiting: Text,
    pub(crate) connection: Option<Connection>,
    watch: Watch,
    spare: Vec<ArrivedPicture>,
    /// The driver is connected; the session begins when the eyes are known, since the hello names them.
    is_connected: bool,
    /// What lets this client come back to its place at the server.
    resume: Option<ResumeSecret>,
    serial: u64,
    eyes: Option<([Eye; 2], i64)>,
    head: Option<HeadState>,
    sequence: u32,
    report: Displayed,
    reported: Option<ClientTime>,
    out: VecDeque<Out>,
    notices: VecDeque<Notice>,
}

impl Client {
    /// A client on an open headset, not connected.
    pub fn new(xr: Xr, options: ClientOptions) -> Result<Self, ClientError> {
        let gpu = xr.headset.gpu().clone();
        let samples =
            if options.msaa > 1 { vk::SampleCountFlags::TYPE_4 } else { vk::SampleCountFlags::TYPE_1 };
        let stages = Stages::new(&gpu, &xr.swapchain, samples)?;
        Ok(Self {
            shown: None,
            next: None,
            stages,
            probe: None,
            last_drawn: None,
            options,
            counters: Counters::new(&gpu, xr.headset.runtime_name()),
            gpu,
            xr,
            now: ClientTime(0),
            panel: None,
            status: Text::new("Shadecast"),
            stillness: Stillness::default(),
            waiting: Text::new("No new pictures from the server"),
            connection: None,
            watch: Watch::default(),
            spare: Vec::with_capacity(8),
            is_connected: false,
            resume: None,
            serial: 0,
            eyes: None,
            head: None,
            sequence: 0,
            report: Displayed::default(),
            reported: None,
            out: VecDeque::new(),
            notices: VecDeque::new(),
        })
    }

    /// Says `text` in the waiting room, which is seen until the first bundle, and before a world that stands still.
    pub fn set_status(&mut self, text: &str) {
        self.status = Text::new(text);
    }

    /// Asks the runtime to end the session; [`Step::Exit`] follows.
    pub fn request_exit(&mut self) {
        self.xr.headset.request_exit();
    }

    /// The device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Pixels per eye, width and height.
    pub fn eye_extent_pixels(&self) -> [u32; 2] {
        self.xr.swapchain.extent_pixels()
    }

    /// Bytes can flow from `now` on. The session begins once the eyes have been located.
    pub fn on_connected(&mut self, now: ClientTime) {
        self.on_closed(now);
        self.is_connected = true;
        self.begin_session();
    }

    /// The connection is gone. What was on display stays there.
    pub fn on_closed(&mut self, now: ClientTime) {
        self.now = now;
        self.is_connected = false;
        self.next = None;
        self.out.clear();
        let Some(connection) = self.connection.take() else { return };
        if let Some(shown) = self.shown.as_mut().filter(|shown| shown.serial == connection.serial) {
            shown.ended_clock = Some(Box::new(connection.session.clock().clone()));
        }
    }

    /// Takes leave of the server: the last bytes come out of [`Client::poll_out`].
    pub fn say_goodbye(&mut self) {
        if let Some(connection) = &mut self.connection {
            connection.session.goodbye();
        }
    }

    fn begin_session(&mut self) {
        let (Some((eyes, display_period_ns)), true, None) = (self.eyes, self.is_connected, &self.connection)
        else {
            return;
        };
        let hello = ClientHello {
            protocol_version: PROTOCOL_VERSION,
            min_protocol_version: PROTOCOL_VERSION,
            app_version: env!("CARGO_PKG_VERSION").to_owned(),
            capabilities: Capabilities {
                max_atlas_extent: ATLAS_MAX_EXTENT,
                max_vertex_slots: self.options.max_vertex_slots.min(MAX_VERTEX_SLOTS),
                max_patch_slots: self.options.max_patch_slots.min(MAX_PATCH_SLOTS),
                codecs: self.options.codecs.to_vec(),
                eyes,
                eye_extent_pixels: self.xr.swapchain.extent_pixels(),
                display_period_ns,
            },
            resume: self.resume,
        };
        self.serial += 1;
        let session = ClientSession::start(hello, self.now);
        self.connection = Some(Connection { serial: self.serial, session, decoding: None });
    }

    /// Takes one message of the server's control stream.
    pub fn receive_control(&mut self, now: ClientTime, message: &[u8]) -> Result<(), ClientError> {
        self.now = now;
        if let Some(connection) = &mut self.connection {
            connection.session.on_control(message);
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
        if let Some(connection) = &mut self.connection {
            connection.session.on_stream(bytes);
        }
        self.take_events()
    }

    /// The server gave up a stream of which `head` had come: a picture that will not be shown in time.
    pub fn receive_reset(&mut self, now: ClientTime, head: &[u8]) {
        self.now = now;
        if let Some(decoding) = self.connection.as_mut().and_then(|connection| connection.decoding.as_mut()) {
            decoding.given_up(decoding::frame_of_head(head));
        }
    }

    /// Takes a datagram.
    pub fn receive_datagram(&mut self, now: ClientTime, bytes: &[u8]) {
        self.now = now;
        if let Some(connection) = &mut self.connection {
            connection.session.on_datagram(bytes, now);
        }
    }

    /// Does what is due at `now`: pings, decoded pictures, requests.
    pub fn advance(&mut self, now: ClientTime) -> Result<(), ClientError> {
        self.now = now;
        self.begin_session();
        let Some(connection) = &mut self.connection else { return Ok(()) };
        let is_full = |scene: &Option<Scene>| scene.as_ref().is_some_and(|scene| scene.bundler.is_full());
        connection.session.hold_back(is_full(&self.shown) || is_full(&self.next));
        connection.session.on_tick(now);
        if let Some(decoding) = &mut connection.decoding {
            let spare = &mut self.spare;
            let scene = self.next.as_mut().or(self.shown.as_mut());
            let scene = scene.filter(|scene| scene.serial == connection.serial);
            if let Some(scene) = scene {
                decoding.advance(now, |decoded| {
                    let picture = ArrivedPicture { arrived: decoded.arrived, picture: decoded.picture };
                    spare.extend(scene.bundler.add_picture(decoded.frame, picture));
                });
            }
            spare.drain(..).for_each(|unused| decoding.recycle(unused.picture));
            if let Some(after) = decoding.refresh_request(now) {
                self.counters.refresh_requests += 1;
                connection.session.request_refresh(after);
            }
            let lost = decoding.take_lost();
            self.report.lost_pictures = self.report.lost_pictures.saturating_add(lost);
            self.counters.lost_pictures += u64::from(lost);
        }
        self.take_events()
    }

    /// When [`Client::advance`] next has something to do by itself.
    pub fn next_tick(&self) -> Option<ClientTime> {
        self.connection.as_ref().and_then(|connection| connection.session.next_tick())
    }

    /// The next bytes to carry to the server.
    pub fn poll_out(&mut self) -> Option<Out> {
        self.connection.as_mut().and_then(|connection| connection.session.poll_out())
    }

    /// What became of the connection.
    pub fn poll_notice(&mut self) -> Option<Notice> {
        self.notices.pop_front()
    }

    fn take_events(&mut self) -> Result<(), ClientError> {
        while let Some(event) = self.connection.as_mut().and_then(|c| c.session.poll_event()) {
            match event {
                ClientEvent::Welcome(welcome) => self.welcome(welcome)?,
                ClientEvent::Delta(delta) => self.take_delta(delta),
                ClientEvent::Picture { header, access_unit } => {
                    if let Some(decoding) = self.connection.as_mut().and_then(|c| c.decoding.as_mut()) {
                        decoding.add(header, access_unit, self.now);
                    }
                }
                ClientEvent::Refused(refused) => self.notices.push_back(Notice::Refused(refused)),
                ClientEvent::Goodbye => self.notices.push_back(Notice::ServerLeft),
                ClientEvent::Failed(error) => self.notices.push_back(Notice::Failed(error.to_string())),
            }
        }
        Ok(())
    }

    fn welcome(&mut self, welcome: Welcome) -> Result<(), ClientError> {
        let Some(connection) = &mut self.connection else { return Ok(()) };
        match (self.options.decoder)(welcome.codec, welcome.atlas_extent_texels) {
            Ok(decoder) => connection.decoding = Some(Decoding::new(decoder, self.options.decoding)),
            Err(error) => {
                self.notices.push_back(Notice::Failed(error.to_string()));
                return Ok(());
            }
        }
        self.watch.begin_session();
        self.counters.connections += 1;
        self.resume = Some(welcome.resume);
        let scene = Scene::new(&self.gpu, &self.stages, welcome.clone(), connection.serial)?;
        self.next = Some(scene);
        self.notices.push_back(Notice::Welcome(welcome));
        Ok(())
    }

    fn take_delta(&mut self, delta: GeometryDelta) {
        self.counters.vertex_samples +=
            delta.samples.iter().map(|batch| batch.values.len() as u64).sum::<u64>();
        let Some(scene) = self.next.as_mut().or(self.shown.as_mut()) else { return };
        scene.bundler.add_delta(delta);
        let (contradiction, is_full) = (scene.bundler.take_contradiction(), scene.bundler.is_full());
        let Some(connection) = &mut self.connection else { return };
        connection.session.hold_back(is_full);
        if let Some(slot) = contradiction {
            let reason = format!("vertex slot {} is given anew while it is on display", slot.0);
            connection.session.fail(WireError::Invalid { what: "a geometry delta", reason });
        }
    }

    /// `at` on the clock of the server that made `scene`.
    pub(crate) fn server_time(&self, scene: &Scene, at: ClientTime) -> Option<ServerTime> {
        let live = || self.connection.as_ref().map(|connection| connection.session.clock());
        scene.ended_clock.as_deref().or_else(live)?.server_time(at)
    }

    /// Notes whether this turn of the runtime is seen, and tells the server where it must know.
    pub(crate) fn watch(&mut self, is_seen: bool) {
        let Some(connection) = self.connection.as_mut().filter(|c| c.decoding.is_some()) else { return };
        if let Some(is_watched) = self.watch.turn(is_seen, self.now) {
            connection.session.tell_watching(is_watched);
        }
    }

    /// Notes where the head will be at `display_time`, and tells the server.
    pub(crate) fn tell_head(&mut self, display_time: ClientTime, period_ns: i64, views: &Views) {
        self.eyes = Some((views.eyes(), period_ns));
        if self.panel.is_none() {
            self.panel = Some(background::panel_ahead(views.stage_from_head));
        }
        let Some(scene) = self.next.as_ref().or(self.shown.as_ref()) else { return };
        let Some(time) = self.server_time(scene, display_time) else { return };
        let world_from_stage = scene.terms.world_from_stage;
        let head = HeadState {
            sequence: self.sequence,
            time,
            world_from_head: world_from_stage.then(views.stage_from_head),
            linear_velocity: world_from_stage.orientation * views.linear_velocity,
            angular_velocity: world_from_stage.orientation * views.angular_velocity,
            eyes: views.eyes(),
            discontinuity: DiscontinuityId(views.jumps),
        };
        let serial = scene.serial;
        self.head = Some(head);
        self.sequence = self.sequence.wrapping_add(1);
        if let Some(connection) = self.connection.as_mut().filter(|connection| connection.serial == serial) {
            connection.session.send_pose(head);
        }
    }

    /// The head's state at the last display frame, once the server's clock is known.
    pub fn head_state(&self) -> Option<HeadState> {
        self.head
    }

    /// Counts a display frame, and reports what is on display where that is new or due.
    pub(crate) fn report_frame(&mut self, frame: &FrameReport, picture_arrived: Option<ClientTime>) {
        self.counters.count(frame);
        self.report.display_frames += u32::from(frame.is_rendered);
        self.report.frames_without_bundle += u32::from(frame.is_rendered && frame.frame.is_none());
        self.report.frozen_vertices = self.report.frozen_vertices.saturating_add(frame.frozen_vertices);
        self.report.withheld_patches = self.report.withheld_patches.saturating_add(frame.withheld_patches);
        let Some(shown) = self.shown.as_ref() else { return };
        let (Some(id), Some(time)) = (frame.frame, frame.server_time) else { return };
        if frame.is_new {
            self.report.frame = id;
            self.report.display_time = time;
            let since = picture_arrived.map_or(0, |arrived| frame.display_time.since(arrived));
            self.report.decode_to_display_ns = since;
        }
        let is_due = self.reported.is_none_or(|reported| frame.display_time.since(reported) >= REPORT_NS);
        let live = self.connection.as_mut().filter(|connection| connection.serial == shown.serial);
        if let Some(connection) = live.filter(|_| frame.is_new || is_due) {
            connection.session.send_displayed(self.report);
            self.reported = Some(frame.display_time);
            let Displayed { frame, display_time, decode_to_display_ns, .. } = self.report;
            self.report = Displayed { frame, display_time, decode_to_display_ns, ..Displayed::default() };
        }
    }

    /// For measurements: instance and distance of what the last rendered frame showed, left and right eye. Waits for the
    /// GPU.
    pub fn probe(&mut self) -> Result<[ProbeView; 2], ClientError> {
        let extent = self.xr.swapchain.extent_pixels();
        let (Some(scene), Some(drawn)) = (&self.shown, self.last_drawn) else {
            return Ok([ProbeView::empty(extent), ProbeView::empty(extent)]);
        };
        let probe = match &mut self.probe {
            Some(probe) => probe,
            none => none.insert(Probe::new(&self.gpu, extent)?),
        };
        Ok(scene.probe(probe, &drawn.eyes, drawn.index_count)?)
    }

    /// Bytes of what has come and waits: for an earlier one, for its picture, for the GPU's vertex memory.
    pub fn waiting_bytes(&self) -> usize {
        let scenes = self.shown.iter().chain(&self.next).map(|scene| scene.bundler.waiting_bytes());
        let connection = self.connection.as_ref();
        let streams = connection.map_or(0, |c| c.session.waiting_bytes());
        let pictures = connection.and_then(|c| c.decoding.as_ref()).map_or(0, Decoding::waiting_bytes);
        scenes.sum::<usize>() + streams + pictures
    }

    /// For tests: the vertex slots of every triangle that the last rendered frame drew.
    pub fn drawn_triangles(&self) -> Vec<[u32; 3]> {
        let drawn = self.shown.as_ref().zip(self.last_drawn);
        drawn.map_or(Vec::new(), |(scene, drawn)| scene.drawn_triangles(drawn.index_count))
    }

    /// For tests: position and state of every vertex slot as the last display frame had them; empty without a bundle.
    pub fn read_positions(&self) -> Result<Vec<[f32; 4]>, ClientError> {
        Ok(self.shown.as_ref().map_or(Ok(Vec::new()), |scene| scene.read_positions(&self.gpu))?)
    }

    /// How it went so far.
    pub fn stats(&self) -> ClientStats {
        self.counters.stats(&self.gpu)
    }
}

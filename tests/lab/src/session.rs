//! The whole system in one process on one virtual clock: server, link and client, stepped in the order of time.
//!
//! Durations of stages are parameters, never measured, so that a slow machine shows exactly what a fast one would and
//! two runs are the same. The client is the one that ships: it draws through the system's OpenXR loader into the mock
//! runtime, whose clock moves on by one period per `xrWaitFrame`.

use crate::motion::Residents;
use crate::options::{Renderer, RunOptions, StageMs};
use anyhow::{Context, bail};
use shadecast_client::client::{Client, ClientOptions, FrameReport, Step};
use shadecast_client::decode::Picture;
use shadecast_client::decoding::DecodeTiming;
use shadecast_client::platform::Platform;
use shadecast_client::xr::{Xr, XrOptions};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::delta::DeltaSizes;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::limits::{ATLAS_MAX_EXTENT, MAX_PATCH_SLOTS, MAX_VERTEX_SLOTS};
use shadecast_protocol::message::{Capabilities, ClientHello, ClientMessage, Codec, Displayed, Welcome};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::session::{Out, ServerEvent, ServerSession, picture_stream};
use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_protocol::wire::PictureHeader;
use shadecast_scene::Scene;
use shadecast_scene::load::load_scene;
use shadecast_scene::suggest::did_you_mean_or_list;
use shadecast_server::encode::Encoder;
use shadecast_server::encode::openh264::{EncoderSettings, OpenH264Encoder};
use shadecast_server::frame::{Frame, Shaded};
use shadecast_server::pacing::{Kind, WayState};
use shadecast_server::scene_gpu::SceneGpu;
use shadecast_server::stream::offer;
use shadecast_server::viewer::{Told, Update, Viewer, bytes_of};
use shadecast_server::world::{ViewerId, World};
use shadecast_transport::endpoint::{Endpoint, EndpointConfig, Event, PeerId};
use shadecast_transport::{Direction, ExpectedIdentity, Pair, ServerIdentity};
use std::collections::VecDeque;
use std::sync::Arc;

/// Server time 0 on the virtual clock: the client's estimate of it has something to find out.
pub const SERVER_EPOCH_NS: i64 = 700_000_000;
/// The first `xrWaitFrame` on the virtual clock.
pub const START_NS: i64 = 1_000_000_000;

/// What crossed from server to client.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sent {
    /// Updates made.
    pub updates: u64,
    /// Bytes of access units.
    pub atlas_bytes: u64,
    /// Bytes of geometry deltas.
    pub geometry_bytes: u64,
    /// Bytes of vertex samples in them.
    pub sample_bytes: u64,
    /// Vertex samples in them.
    pub samples: u64,
    /// Updates that were not made because the link was behind.
    pub withheld: u64,
}

/// The server's side.
pub struct Server {
    /// Its device.
    pub gpu: Arc<Gpu>,
    /// Its scene.
    pub scene: Arc<SceneGpu>,
    /// What every viewer looks at.
    pub world: World,
    /// The client, once it was accepted.
    pub viewer: Option<Viewer<Frame>>,
    /// What it sent.
    pub sent: Sent,
    /// The last update's planes and their extent, for the atlas picture.
    pub last: Option<Shaded>,
    /// Who was in the client's memory at which update.
    pub residents: Residents,
    session: ServerSession,
    /// What the server sends beside the session.
    streams: VecDeque<Out>,
    encoder: Option<Box<dyn Encoder>>,
    peer: Option<PeerId>,
    qp: u8,
    sessions: u64,
    atlas_extent_texels: AtlasExtent,
    rate_hz: f64,
}

/// What leaves the server when its stages are done.
struct Leaving {
    at_ns: i64,
    /// The session that it is of.
    session: u64,
    frame: UpdateId,
    what: Departure,
}

enum Departure {
    /// The stream of a delta.
    Delta(Out, DeltaSizes),
    Picture(PictureHeader, Vec<u8>),
    /// In memory there are no streams.
    Local(Box<Shaded>),
}

/// Server, link and client.
pub struct Lab {
    /// The server.
    pub server: Server,
    /// The client.
    pub client: Client,
    renderer: Renderer,
    pair: Pair,
    client_peer: Option<PeerId>,
    leaving: VecDeque<Leaving>,
    next_update_ns: i64,
    update_period_ns: i64,
    refresh_hz: f64,
    stages: StageMs,
    fov: Fov,
    frame: u64,
}

/// Turns of the runtime without a frame that are taken for a start-up or a rest, one display period each; more are a runtime
/// that never starts.
const MAX_IDLE_TURNS: u32 = 100_000;

impl Server {
    /// Opens the server's device and loads the scene.
    pub fn new(options: &RunOptions) -> anyhow::Result<Self> {
        let mut scene = load_scene(&options.scene)?;
        if let Some(clip) = &options.clip {
            play_clip(&mut scene, clip)?;
        }
        let gpu_options = GpuOptions {
            needs: Needs::Server,
            validation: options.validation,
            device_name: options.device.clone(),
        };
        let gpu = Gpu::open(&gpu_options, &DesktopDevice)?;
        let scene = Arc::new(SceneGpu::new(&gpu, scene, &options.scene_options)?);
        let session = ServerSession::new(offer(&scene, options.atlas_extent_texels, options.rate_hz, 1));
        Ok(Self {
            world: World::new(&gpu, &scene)?,
            gpu,
            scene,
            viewer: None,
            sent: Sent::default(),
            last: None,
            residents: Residents::default(),
            session,
            streams: VecDeque::new(),
            encoder: None,
            peer: None,
            qp: options.qp,
            sessions: 1,
            atlas_extent_texels: options.atlas_extent_texels,
            rate_hz: options.rate_hz,
        })
    }

    /// A client came: a new session, and nothing kept of the last one.
    fn connected(&mut self, peer: PeerId) {
        self.sessions += 1;
        self.peer = Some(peer);
        self.part();
        let offer = offer(&self.scene, self.atlas_extent_texels, self.rate_hz, self.sessions);
        self.session = ServerSession::new(offer);
        self.streams.clear();
    }

    /// Nobody is served any more.
    fn part(&mut self) {
        if let Some(viewer) = self.viewer.take() {
            self.world.leave(viewer.into_updates().id());
        }
    }

    /// Hands what the session learnt to the viewer. Gives the terms of a session that begins.
    fn listen(&mut self, now_ns: i64) -> anyhow::Result<Option<Welcome>> {
        let (mut told, mut begins) = (Told::default(), None);
        while let Some(event) = self.session.poll_event() {
            match told.take(event) {
                None => {}
                Some(ServerEvent::Asked { hello, welcome }) => {
                    self.accept(&welcome, &hello.capabilities, now_ns)?;
                    begins = Some(welcome);
                }
                Some(ServerEvent::Refused(refused)) => {
                    bail!("the server refused: {} {}", refused.reason, refused.remedy)
                }
                Some(ServerEvent::Goodbye) => self.part(),
                Some(ServerEvent::Failed(error)) => {
                    bail!("the server could not understand the client: {error}")
                }
                Some(event) => unreachable!("what a client tells is taken in: {event:?}"),
            }
        }
        self.viewer.iter_mut().for_each(|viewer| viewer.hear(told, now_ns));
        Ok(begins)
    }

    fn accept(&mut self, welcome: &Welcome, capabilities: &Capabilities, now_ns: i64) -> anyhow::Result<()> {
        let sender = self.session.accept().context("who asked has gone")?;
        let settings = EncoderSettings::for_stream(welcome.atlas_extent_texels, self.qp, self.rate_hz);
        self.encoder = Some(Box::new(OpenH264Encoder::new(settings)?));
        let frame = Frame::new(&self.world, ViewerId(self.sessions), welcome, capabilities)?;
        self.viewer = Some(Viewer::new(frame, sender, period_ns(self.rate_hz), now_ns));
        Ok(())
    }

    /// A stream leaves.
    fn send(&mut self, frame: UpdateId, kind: Kind, out: Out, now_ns: i64) {
        let Some(viewer) = &mut self.viewer else { return };
        viewer.sent(frame, kind, bytes_of(&out), now_ns);
        self.streams.push_back(out);
    }

    /// Patches that were visible but had no room, in the atlas or in the client's memory.
    pub fn dropped_patches(&self) -> u64 {
        self.viewer.as_ref().map_or(0, |viewer| viewer.updates().dropped_patches())
    }

    fn count(&mut self, sizes: DeltaSizes) {
        self.sent.geometry_bytes += sizes.total_bytes as u64;
        self.sent.sample_bytes += sizes.sample_bytes as u64;
        self.sent.samples += sizes.samples as u64;
    }
}

impl Lab {
    /// Opens both sides; the mock runtime must be set up in the environment.
    pub fn new(options: &RunOptions, server: Server) -> anyhow::Result<Self> {
        let identity = ServerIdentity::from_seed(options.seed)?;
        let config = |salt| EndpointConfig { seed: Some(options.seed ^ salt), ..EndpointConfig::default() };
        let server_end = Endpoint::server(&identity, config(1))?;
        let pair = Pair::new(server_end, Endpoint::client(config(2)), options.link.clone(), options.seed);
        let xr = Xr::open(&Platform, XrOptions { validation: options.validation })
            .context("opening the OpenXR runtime")?;
        let decoding = DecodeTiming::Virtual { delay_ns: options.stages.ns(options.stages.decode) };
        let client = Client::new(xr, ClientOptions { decoding, ..ClientOptions::default() })
            .context("making the client")?;
        Ok(Self {
            server,
            client,
            renderer: options.renderer,
            pair,
            client_peer: None,
            leaving: VecDeque::new(),
            next_update_ns: START_NS,
            update_period_ns: period_ns(options.rate_hz),
            refresh_hz: options.refresh_hz,
            stages: options.stages,
            fov: Fov::symmetric_degrees(options.fov_degrees),
            frame: 0,
        })
    }

    /// Connects over the link, or in memory.
    ///
    /// # Errors
    /// The two do not agree, or memory is short.
    pub fn connect(&mut self) -> anyhow::Result<()> {
        if self.renderer == Renderer::Stream {
            let expected = ExpectedIdentity::TrustOnFirstUse;
            let peer = self.pair.client.connect(START_NS, shadecast_transport::pair::SERVER_ADDR, expected);
            self.client_peer = Some(peer);
            return Ok(());
        }
        let hello = ClientMessage::Hello(self.local_hello()).encode();
        self.server.session.on_control(&hello);
        let terms = self.server.listen(START_NS)?.context("the server does not agree")?;
        Ok(self.client.start_local(terms, -SERVER_EPOCH_NS)?)
    }

    /// What the client would say of itself over a network.
    fn local_hello(&self) -> ClientHello {
        let eye = |x| Eye {
            head_from_eye: Pose { position: glam::Vec3::new(x, 0.0, 0.0), ..Pose::IDENTITY },
            fov: self.fov,
        };
        ClientHello {
            protocol_version: shadecast_protocol::PROTOCOL_VERSION,
            min_protocol_version: shadecast_protocol::PROTOCOL_VERSION,
            app_version: env!("CARGO_PKG_VERSION").into(),
            capabilities: Capabilities {
                max_atlas_extent: ATLAS_MAX_EXTENT,
                max_vertex_slots: MAX_VERTEX_SLOTS,
                max_patch_slots: MAX_PATCH_SLOTS,
                codecs: vec![Codec::H264],
                eyes: [eye(-0.0315), eye(0.0315)],
                eye_extent_pixels: self.client.eye_extent_pixels(),
                display_period_ns: (1e9 / self.refresh_hz) as i64,
            },
            resume: None,
        }
    }

    /// When the next display frame begins, nanoseconds of the virtual clock.
    pub fn next_frame_ns(&self) -> i64 {
        shadecast_mock_runtime::clock::period_begin_ns(START_NS, self.refresh_hz, self.frame)
    }

    /// Plays everything up to the next display frame, then shows it.
    ///
    /// # Errors
    /// Anything that keeps the run from going on, and a session that never starts.
    pub fn step(&mut self) -> anyhow::Result<Step> {
        for _ in 0..MAX_IDLE_TURNS {
            match self.turn()? {
                Step::Idle => continue,
                step => return Ok(step),
            }
        }
        bail!("the OpenXR runtime does not start the session")
    }

    /// Plays everything up to the runtime's next turn, then lets the client have it: a frame, or a period without one.
    ///
    /// # Errors
    /// Anything that keeps the run from going on.
    pub fn turn(&mut self) -> anyhow::Result<Step> {
        let frame_ns = self.next_frame_ns();
        self.play_until(frame_ns)?;
        let step = self.client.step_with(|client| client.advance(ClientTime(frame_ns)))?;
        match &step {
            Step::Idle => self.frame += 1,
            Step::Frame(report) => self.frame_shown(report),
            Step::Exit => {}
        }
        self.flush()?;
        Ok(step)
    }

    /// In memory there are no messages: the server looks at the client itself.
    fn frame_shown(&mut self, report: &FrameReport) {
        self.frame += 1;
        if self.renderer == Renderer::Stream {
            return;
        }
        let mut told = Told { pose: self.client.head_state(), ..Told::default() };
        if let (true, Some(id), Some(time)) = (report.is_new, report.frame, report.server_time) {
            told.displayed = Some(Displayed { frame: id, display_time: time, ..Displayed::default() });
        }
        let now_ns = self.next_frame_ns();
        self.server.viewer.iter_mut().for_each(|viewer| viewer.hear(told, now_ns));
    }

    /// Updates, departures and arrivals in the order of time.
    fn play_until(&mut self, until_ns: i64) -> anyhow::Result<()> {
        loop {
            let departure_ns = self.leaving.front().map_or(i64::MAX, |leaving| leaving.at_ns);
            let next_ns = departure_ns.min(self.next_update_ns).min(until_ns);
            self.play_link(next_ns)?;
            if departure_ns <= next_ns {
                self.depart(departure_ns)?;
            } else if self.next_update_ns <= next_ns {
                self.update()?;
            } else {
                return Ok(());
            }
        }
    }

    fn play_link(&mut self, until_ns: i64) -> anyhow::Result<()> {
        if self.renderer != Renderer::Stream {
            return Ok(());
        }
        loop {
            let events = self.pair.step_to_events(until_ns);
            if events.is_empty() {
                return Ok(());
            }
            for (end, event) in events {
                match end {
                    Direction::ToServer => self.server_event(event)?,
                    Direction::ToClient => self.client_event(event)?,
                }
            }
            self.flush()?;
        }
    }

    fn server_event(&mut self, event: Event) -> anyhow::Result<()> {
        match event {
            Event::Connected { peer, .. } => self.server.connected(peer),
            Event::Control { message, .. } => self.server.session.on_control(&message),
            Event::Datagram { bytes, at_ns, .. } => {
                self.server.session.on_datagram(&bytes, ServerTime(at_ns - SERVER_EPOCH_NS));
            }
            Event::Closed { .. } => self.server.part(),
            Event::Stream { .. } | Event::StreamReset { .. } => {}
        }
        self.server.listen(self.pair.now_ns()).map(drop)
    }

    fn client_event(&mut self, event: Event) -> anyhow::Result<()> {
        match event {
            Event::Connected { .. } => self.client.on_connected(ClientTime(self.pair.now_ns())),
            Event::Control { message, at_ns, .. } => {
                self.client.receive_control(ClientTime(at_ns), &message)?
            }
            Event::Datagram { bytes, at_ns, .. } => self.client.receive_datagram(ClientTime(at_ns), &bytes),
            Event::Stream { bytes, at_ns, .. } => self.client.receive_stream(ClientTime(at_ns), &bytes)?,
            Event::StreamReset { head, .. } => {
                self.client.receive_reset(ClientTime(self.pair.now_ns()), &head)
            }
            Event::Closed { reason, .. } => bail!("the connection ended: {reason}"),
        }
        Ok(())
    }

    /// Hands what both sides want to send to the link.
    fn flush(&mut self) -> anyhow::Result<()> {
        let (Some(client), Some(server)) = (self.client_peer, self.server.peer) else { return Ok(()) };
        while let Some(out) = self.client.poll_out() {
            match out {
                Out::Control(message) => self.pair.client.send_control(client, &message)?,
                Out::Datagram(bytes) => drop(self.pair.client.send_datagram(client, &bytes)),
                Out::Stream { .. } => bail!("the client opened a stream"),
            }
        }
        let now = ServerTime(self.pair.now_ns() - SERVER_EPOCH_NS);
        while let Some(out) = self.server.session.poll_out(now).or_else(|| self.server.streams.pop_front()) {
            match out {
                Out::Control(message) => self.pair.server.send_control(server, &message)?,
                Out::Datagram(bytes) => drop(self.pair.server.send_datagram(server, &bytes)),
                Out::Stream { bytes, priority } => {
                    self.pair.server.send_stream(server, bytes, priority)?;
                }
            }
        }
        Ok(())
    }

    /// One update; what it makes leaves when its stages are done.
    fn update(&mut self) -> anyhow::Result<()> {
        let now_ns = self.next_update_ns;
        self.next_update_ns += self.update_period_ns;
        let server = &mut self.server;
        let way = server.peer.and_then(|peer| self.pair.server.stats(peer)).map(WayState::from);
        let Some(viewer) = server.viewer.as_mut().filter(|viewer| viewer.due_ns().is_some()) else {
            return Ok(());
        };
        if !viewer.is_open(way.as_ref(), now_ns) {
            server.sent.withheld += 1;
            return Ok(());
        }
        if let Some(shortfall) = viewer.shortfall(now_ns) {
            tracing::warn!("{shortfall}");
        }
        let frame = viewer.begin(way.as_ref(), now_ns);
        let Some(shaded) = frame.update(&mut server.world, ServerTime(now_ns - SERVER_EPOCH_NS))? else {
            return Ok(());
        };
        server.sent.updates += 1;
        server.residents.note(shaded.frame, frame.residency());
        let (delta, Update { shaded, sizes, refresh }) = viewer.finish(shaded)?;
        let frame = shaded.frame;
        server.last = Some((*shaded).clone());
        let shaded_ns = now_ns + self.stages.ns(self.stages.server);
        if self.renderer != Renderer::Stream {
            self.leave(shaded_ns, frame, Departure::Local(shaded));
            return Ok(());
        }
        let encoder = server.encoder.as_mut().context("an encoder comes with the viewer")?;
        let (header, unit) = shaded.encode(encoder.as_mut(), refresh)?;
        server.sent.atlas_bytes += unit.bytes.len() as u64;
        let encoded_ns = shaded_ns + self.stages.ns(self.stages.encode);
        self.leave(encoded_ns, frame, Departure::Picture(header, unit.bytes));
        self.leave(shaded_ns, frame, Departure::Delta(delta, sizes));
        Ok(())
    }

    fn leave(&mut self, at_ns: i64, frame: UpdateId, what: Departure) {
        let place = self.leaving.partition_point(|other| other.at_ns <= at_ns);
        self.leaving.insert(place, Leaving { at_ns, session: self.server.sessions, frame, what });
    }

    /// What is ready leaves; what belongs to a session that has ended is dropped.
    fn depart(&mut self, now_ns: i64) -> anyhow::Result<()> {
        let server = &mut self.server;
        let next = self.leaving.pop_front().filter(|leaving| leaving.session == server.sessions);
        let Some(Leaving { frame, what, .. }) = next else { return Ok(()) };
        match what {
            Departure::Local(shaded) => {
                let picture = picture_of(&shaded);
                self.client.accept_local(ClientTime(now_ns), shaded.delta, Some(picture));
            }
            Departure::Delta(out, sizes) => {
                server.count(sizes);
                server.send(frame, Kind::Delta, out, now_ns);
            }
            Departure::Picture(header, bytes) => {
                server.send(frame, Kind::Picture, picture_stream(header, &bytes)?, now_ns);
            }
        }
        self.flush()
    }
}

fn period_ns(rate_hz: f64) -> i64 {
    (1e9 / rate_hz) as i64
}

/// Lets every instance that plays a clip play the one of this name.
fn play_clip(scene: &mut Scene, name: &str) -> anyhow::Result<()> {
    let mut found = false;
    for instance in scene.instances.iter_mut().filter(|instance| instance.clip.is_some()) {
        let clips = &scene.models[instance.model].clips;
        if let Some(clip) = clips.iter().position(|clip| clip.name == name) {
            (instance.clip, found) = (Some(clip), true);
        }
    }
    if !found {
        let names = scene.models.iter().flat_map(|model| model.clips.iter().map(|clip| clip.name.as_str()));
        bail!("no animated instance has a clip \"{name}\"{}", did_you_mean_or_list(name, names, "there are"));
    }
    Ok(())
}

/// The planes as a decoder would give them: the renderer without codec and network.
fn picture_of(shaded: &Shaded) -> Picture {
    let luma = shaded.extent_texels[0] as usize * shaded.extent_texels[1] as usize;
    let (y, chroma) = shaded.planes.split_at(luma);
    let (cb, cr) = chroma.split_at(luma / 4);
    Picture { extent_texels: shaded.extent_texels, y: y.to_vec(), cb: cb.to_vec(), cr: cr.to_vec() }
}

//! The whole system in one process on one virtual clock: server, links and clients, stepped in the order of time.
//!
//! Options of a run enter ([`options`]). Steps of the client leave, and each update of the server. Nothing here knows metrics,
//! truth and files of results.
//!
//! Durations of stages are parameters, never measured, so that a slow machine shows exactly what a fast one would and
//! two runs are the same. The client is the one that ships: it draws through the system's OpenXR loader into the mock
//! runtime, whose clock moves on by one period per `xrWaitFrame`. Further viewers are [`ghost::Ghost`]s.

pub mod ghost;
pub mod heard;
pub mod options;
pub mod originals;
mod reception;
pub mod residents;
pub mod runtime;
pub mod seat;
pub mod walk;

use anyhow::{Context, bail};
use ghost::Ghost;
use heard::{Heard, Recording, What};
use options::{Medium, RunOptions, Spared, StageMs, ViewerOptions};
use reception::{Reception, line_of};
use runtime::{BUILT_IN_WALK, prepare_runtime, set_runtime};
use seat::{Rows, Seat};
use serde::{Deserialize, Serialize};
use shadecast_client::client::{Client, ClientOptions, Step};
use shadecast_client::decode::decoding::DecodeTiming;
use shadecast_client::display::xr::{Xr, XrOptions};
use shadecast_client::draw::stages::atlas_draw::Lookup;
use shadecast_client::net::traced::Traced;
use shadecast_client::options::USUAL_MSAA;
use shadecast_client::platform::Platform;
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs};
use shadecast_mock_runtime::clock::period_begin_ns;
use shadecast_mock_runtime::config::MockConfig;
use shadecast_mock_runtime::head_path::HeadPath;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::{Capabilities, ClientHello, Codec, ServerOffer};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::session::Out;
use shadecast_protocol::time::{ClientTime, DEFAULT_GRID, ServerTime, WorldTime};
use shadecast_scene::Scene;
use shadecast_scene::cache::Cache;
use shadecast_scene::load::load_scene_with;
use shadecast_scene::process::Loading;
use shadecast_scene::suggest::did_you_mean_or_list;
use shadecast_server::encode::choice::{Encoders, Wanted};
use shadecast_server::pacing::overlap::{Flight, Step as UpdateStep};
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::pacing::share::WayState;
use shadecast_server::scene::SceneGpu;
use shadecast_server::serve::scheduler::simulated::{SimulatedDevice, StepsNs};
use shadecast_server::serve::scheduler::{Action, LONGEST_WAIT_NS, Scheduler, Situation};
use shadecast_server::serve::stream::offer;
use shadecast_server::update::ShowOptions;
use shadecast_server::world::World;
use shadecast_trace::Trace;
use shadecast_transport::endpoint::{Endpoint, EndpointConfig};
use shadecast_transport::event::{Event, PeerId};
use shadecast_transport::link::LinkCounts;
use shadecast_transport::neighbour::Neighbour;
use shadecast_transport::{Direction, ExpectedIdentity, LinkSchedule, Pair, ServerIdentity};
use std::borrow::Cow;
use std::convert::Infallible;
use std::net::SocketAddr;
use std::path::Path;
use std::sync::Arc;

/// Server time 0 on the virtual clock: the client's estimate of it has something to find out.
pub const SERVER_EPOCH_NS: i64 = 700_000_000;
/// The first `xrWaitFrame` on the virtual clock.
pub const START_NS: i64 = 1_000_000_000;

/// What the server has for all its viewers.
pub struct Server {
    /// Its device.
    pub gpu: Arc<Gpu>,
    /// Its scene.
    pub scene: Arc<SceneGpu>,
    /// What every viewer looks at.
    pub world: World,
    codecs: &'static [Codec],
    /// What codes pictures as H.264.
    pub encoders: Encoders,
    quality: QualityOptions,
    stages: StageMs,
    scheduler: Scheduler<PeerId>,
    device: SimulatedDevice<PeerId>,
    reception: Reception,
    /// What it was asked for and decided.
    pub schedule: Schedule,
    viewers: u64,
    atlas_extent_texels: AtlasExtent,
    rate_hz: f64,
    spared: Spared,
    show: ShowOptions,
    shade_texels: Option<u64>,
}

/// What the scheduler was told and decided, at which times of the virtual clock.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Schedule {
    /// Which viewer came when.
    pub joined: Vec<(i64, usize)>,
    /// When, for which viewer, and what.
    pub decisions: Vec<(i64, usize, Cow<'static, str>)>,
    /// Updates that could not begin, since the viewer's head was not known yet.
    pub headless: Vec<(i64, usize)>,
}

/// A link with a client at its end, and the server's side of it.
struct Line {
    seat: Seat,
    pair: Pair,
    client_peer: Option<PeerId>,
    reconnects: bool,
    /// `None`: the client that ships.
    ghost: Option<Ghost>,
}

/// Server, links and clients.
pub struct Lab {
    traced: Traced,
    /// The server.
    pub server: Server,
    /// The client that ships, which is the first viewer.
    pub client: Client,
    lines: Vec<Line>,
    /// When the scheduler is asked next.
    next_poll_ns: i64,
    next_motion_ns: i64,
    refresh_hz: f64,
    frame: u64,
    /// All that the client that ships is handed, where somebody wants to play it again.
    pub recording: Option<Recording>,
    /// Ends with the run.
    _trace: Option<Trace>,
}

/// Names a folder where prepared scenes are kept from run to run. Without it each run prepares its own.
const CACHE_VARIABLE: &str = "SHADECAST_LAB_CACHE";

fn loading() -> Loading {
    let folder = std::env::var_os(CACHE_VARIABLE).filter(|folder| !folder.is_empty());
    let cache = folder.map_or_else(Cache::disabled, Cache::new);
    Loading { cache, ..Loading::plain() }
}

/// Turns of the runtime without a frame that are taken for a start-up or a rest, one display period each; more are a runtime
/// that never starts.
const MAX_IDLE_TURNS: u32 = 100_000;

impl Server {
    /// Opens the server's device and loads the scene.
    pub fn new(options: &RunOptions) -> anyhow::Result<Self> {
        let lods = options.detail_pixels > 0.0;
        let mut scene = load_scene_with(&options.scene, &Loading { lods, ..loading() })?;
        if let Some(clip) = &options.clip {
            play_clip(&mut scene, clip)?;
        }
        Self::of_scene(options, scene)
    }

    /// Opens the server's device for a scene that is loaded, whatever the options name.
    ///
    /// # Errors
    /// No device, or a scene that is too large for it.
    pub fn of_scene(options: &RunOptions, scene: Scene) -> anyhow::Result<Self> {
        let gpu_options = GpuOptions {
            needs: Needs::Server,
            validation: options.validation,
            device_name: options.device.clone(),
        };
        let gpu = Gpu::open(&gpu_options, &DesktopDevice)?;
        let scene = Arc::new(SceneGpu::cached(&gpu, scene, &options.scene_options, &loading())?);
        let stages = options.medium().stages;
        let usual = offer(&scene, options.atlas_extent_texels, options.rate_hz, 0);
        let terms = ServerOffer { codecs: options.medium().codecs.to_vec(), ..usual };
        Ok(Self {
            scheduler: Scheduler::new((1e9 / options.rate_hz) as i64),
            device: SimulatedDevice::new(stages.steps_ns()),
            reception: Reception::new(terms, 1 + options.others.len()),
            schedule: Schedule::default(),
            stages,
            world: World::new(&gpu, &scene)?,
            gpu,
            scene,
            codecs: options.medium().codecs,
            encoders: Encoders::choose(&Wanted::Named(options.encoder.clone()))?,
            quality: options.quality,
            viewers: 0,
            atlas_extent_texels: options.atlas_extent_texels,
            rate_hz: options.rate_hz,
            spared: options.spared.clone(),
            shade_texels: options.shade_texels,
            show: ShowOptions { detail_pixels: options.detail_pixels, surround: options.surround },
        })
    }

    fn next_viewer(&mut self) -> u64 {
        self.viewers += 1;
        self.viewers
    }

    /// The world's time of what is seen at `display_ns` on the virtual clock.
    pub fn world_time(&self, display_ns: i64) -> WorldTime {
        self.world.clock().world_time(ServerTime(display_ns - SERVER_EPOCH_NS))
    }

    /// The terms of its sessions.
    pub fn offer(&self) -> ServerOffer {
        let usual = offer(&self.scene, self.atlas_extent_texels, self.rate_hz, 0);
        ServerOffer { codecs: self.codecs.to_vec(), ..usual }
    }

    /// What an update takes the device and the thread.
    fn update_ns(&self) -> i64 {
        let StepsNs { visibility, placement, shading } = self.stages.steps_ns();
        visibility + placement + shading
    }

    fn period_ns(&self) -> i64 {
        self.scheduler.period_ns()
    }
}

impl Line {
    fn new(
        server: &Server,
        number: usize,
        (link, seed): (&LinkSchedule, u64),
        ghost: Option<Ghost>,
    ) -> anyhow::Result<Self> {
        let identity = ServerIdentity::from_seed(seed)?;
        let config = |salt| EndpointConfig { seed: Some(seed ^ salt), ..EndpointConfig::default() };
        let server_end = Endpoint::server(&identity, config(1))?;
        let pair = Pair::new(server_end, Endpoint::client(config(2)), link.clone(), seed);
        Ok(Self { seat: Seat::new(server, number), pair, client_peer: None, reconnects: false, ghost })
    }

    fn connect(&mut self, now_ns: i64) {
        let expected = ExpectedIdentity::TrustOnFirstUse;
        let peer = self.pair.client.connect(now_ns, shadecast_transport::pair::SERVER_ADDR, expected);
        self.client_peer = Some(peer);
    }

    fn way(&self) -> Option<WayState> {
        self.seat.peer.and_then(|peer| self.pair.server.stats(peer)).map(WayState::from)
    }

    /// Plays the link up to a time, or to the first news for the server; gives when these came.
    fn play(
        &mut self,
        server: &mut Server,
        client: &mut Client,
        (traced, recording): (&Traced, &mut Option<Recording>),
        until_ns: i64,
    ) -> anyhow::Result<Option<i64>> {
        loop {
            let events = self.pair.step_to_events(until_ns);
            if events.is_empty() {
                return Ok(None);
            }
            let now_ns = self.pair.now_ns();
            let has_news = events.iter().any(|(end, _)| *end == Direction::ToServer);
            for (end, event) in events {
                match (end, &mut self.ghost) {
                    (Direction::ToServer, _) => self.seat.take(server, event, now_ns)?,
                    (Direction::ToClient, Some(ghost)) => ghost.take(event, now_ns)?,
                    (Direction::ToClient, None) if self.reconnects && is_closed(&event) => {
                        client.intake.on_closed(ClientTime(now_ns));
                        self.connect(now_ns);
                    }
                    (Direction::ToClient, None) => {
                        if let Event::Stream { bytes, at_ns, .. } = &event {
                            traced.arrived(bytes, ClientTime(*at_ns));
                        }
                        let heard = Heard::of(self.seat.with_original(event), now_ns)?;
                        heard.tell(&mut client.intake);
                        recording.iter_mut().for_each(|recording| recording.push(heard.clone()));
                    }
                }
            }
            self.flush(server, client)?;
            if has_news {
                return Ok(Some(now_ns));
            }
        }
    }

    /// Hands what both sides want to send to the link.
    fn flush(&mut self, server: &mut Server, client: &mut Client) -> anyhow::Result<()> {
        let (Some(client_peer), Some(server_peer)) = (self.client_peer, self.seat.peer) else {
            return Ok(());
        };
        let mut next = || self.ghost.as_mut().map_or_else(|| client.intake.poll_out(), Ghost::poll_out);
        while let Some(out) = next() {
            match out {
                Out::Control(message) => self.pair.client.send_control(client_peer, &message)?,
                Out::Datagram(bytes) => drop(self.pair.client.send_datagram(client_peer, &bytes)),
                Out::Stream { .. } => bail!("the client opened a stream"),
            }
        }
        while let Some(out) = self.seat.poll_out(server) {
            match out {
                Out::Control(message) => self.pair.server.send_control(server_peer, &message)?,
                Out::Datagram(bytes) => drop(self.pair.server.send_datagram(server_peer, &bytes)),
                Out::Stream { bytes, priority } => {
                    self.pair.server.send_stream(server_peer, bytes, priority)?;
                }
            }
        }
        Ok(())
    }
}

/// What the scheduler asks about viewers, on the virtual clock.
struct Situated<'a> {
    device: &'a SimulatedDevice<PeerId>,
    lines: &'a mut [Line],
    now_ns: i64,
}

impl Situation<PeerId> for Situated<'_> {
    type Error = Infallible;

    fn flight(&mut self, peer: PeerId) -> Result<Flight, Infallible> {
        Ok(self.device.flight(peer, self.now_ns))
    }

    fn is_open(&mut self, peer: PeerId, now_ns: i64) -> bool {
        let line = &mut self.lines[line_of(peer)];
        let way = line.way();
        line.seat.is_open(way, now_ns)
    }
}

fn is_closed(event: &Event) -> bool {
    matches!(event, Event::Closed { .. })
}

impl Lab {
    /// Points the process's OpenXR loader to a mock runtime of this configuration, opens server and clients, and connects
    /// them.
    ///
    /// # Errors
    /// No device, no runtime, no memory, a file, or two that do not agree.
    ///
    /// # Safety
    /// No other thread may read or write the environment meanwhile.
    pub unsafe fn open(options: &RunOptions, config: &MockConfig) -> anyhow::Result<Self> {
        // SAFETY: the caller's promise.
        unsafe { Self::open_with(options, config, || Server::new(options)) }
    }

    /// The same with a server of one's own.
    ///
    /// # Errors
    /// Those of [`Self::open`].
    ///
    /// # Safety
    /// That of [`Self::open`].
    pub unsafe fn open_with(
        options: &RunOptions,
        config: &MockConfig,
        server: impl FnOnce() -> anyhow::Result<Server>,
    ) -> anyhow::Result<Self> {
        let variables = prepare_runtime(config, &options.out)?;
        // SAFETY: the caller's promise.
        unsafe { set_runtime(&variables) };
        let mut lab = Self::new(options, server()?)?;
        lab.connect();
        Ok(lab)
    }

    fn new(options: &RunOptions, server: Server) -> anyhow::Result<Self> {
        let xr = Xr::open(&Platform, XrOptions { validation: options.validation, ..XrOptions::default() })
            .context("opening the OpenXR runtime")?;
        let Medium { codecs, link, stages } = options.medium();
        let decode_ns = stages.ns(stages.decode);
        let client_options = ClientOptions {
            msaa: Some(USUAL_MSAA), // as with a GPU
            decoding: DecodeTiming::Virtual { delay_ns: decode_ns },
            codecs,
            max_vertex_slots: options.room.vertices,
            max_patch_slots: options.room.patches,
            max_triangles: options.room.triangles,
            store_pages: Some(options.store_pages),
            blends: Some(options.blends),
            lookup: Lookup {
                reconstruction: options.reconstruction,
                chroma: options.spared.arrival.chroma(),
            },
            decoder: options.spared.arrival.decoder(),
            ..ClientOptions::default()
        };
        let client = Client::new(Box::new(xr), client_options).context("making the client")?;
        let hello = hello(options, client.presenter.eye_extent_pixels());
        let trace = options.trace.as_deref().map(Trace::create).transpose()?;
        let mut own = Line::new(&server, 0, (&link, options.seed), None)?;
        own.seat.rows = trace.as_ref().map(Rows::new);
        let mut lines = vec![Line { reconnects: options.reconnects, ..own }];
        for (other, number) in options.others.iter().zip(1..) {
            let ViewerOptions { link, head } = other;
            let ghost = Ghost::new(hello.clone(), read_head_path(head.as_deref())?, START_NS, decode_ns);
            let seed = options.seed + number as u64;
            lines.push(Line::new(&server, number, (link, seed), Some(ghost))?);
        }
        Ok(Self {
            traced: Traced::new(trace.as_ref()),
            _trace: trace,
            server,
            client,
            lines,
            next_poll_ns: START_NS,
            next_motion_ns: START_NS,
            refresh_hz: options.refresh_hz,
            frame: 0,
            recording: None,
        })
    }

    /// The server's side of the client that ships.
    pub fn seat(&self) -> &Seat {
        &self.lines[0].seat
    }

    /// Those of all viewers, the client that ships first.
    pub fn seats(&self) -> impl Iterator<Item = &Seat> {
        self.lines.iter().map(|line| &line.seat)
    }

    /// The first.
    pub fn seat_mut(&mut self) -> &mut Seat {
        &mut self.lines[0].seat
    }

    /// Server and client, for who drives each by itself from now on: what they share a clock for is over.
    pub fn apart(&mut self) -> (&mut Server, &mut Seat, &mut Client) {
        (&mut self.server, &mut self.lines[0].seat, &mut self.client)
    }

    /// How long what the server sends now waits before the bottleneck of the first viewer's link, nanoseconds.
    pub fn queue_ns(&self) -> i64 {
        let pair = &self.lines[0].pair;
        pair.link().queue_ns(Direction::ToClient, pair.now_ns())
    }

    /// What became of the datagrams to the first viewer.
    pub fn link_counts(&self) -> LinkCounts {
        self.lines[0].pair.link().counts(Direction::ToClient)
    }

    /// Somebody else takes the first viewer's link from now on.
    pub fn add_neighbour(&mut self, neighbour: Neighbour) {
        self.lines[0].pair.add_neighbour(neighbour);
    }

    /// Pictures that need no other, which the first viewer was sent.
    pub fn refreshes(&self) -> u64 {
        self.lines[0].seat.sent.refreshes
    }

    /// Bytes of datagrams that the first viewer's link has delivered to others.
    pub fn neighbours_bytes(&self) -> u64 {
        self.lines[0].pair.neighbours().iter().map(Neighbour::delivered_bytes).sum()
    }

    /// The client that ships has another address from now on.
    pub fn move_client(&mut self, to: SocketAddr) {
        self.lines[0].pair.move_client(to);
    }

    /// The server is killed, and runs again at once with the same identity. It is that of a lone client.
    ///
    /// # Errors
    /// No identity.
    pub fn restart_server(&mut self, seed: u64) -> anyhow::Result<()> {
        let line = &mut self.lines[0];
        let config = EndpointConfig { seed: Some(seed ^ 3), ..EndpointConfig::default() };
        let endpoint = Endpoint::server(&ServerIdentity::from_seed(seed)?, config)?;
        line.pair.restart(Direction::ToServer, endpoint);
        line.seat.vanish(&mut self.server);
        self.server.reception = Reception::new(self.server.offer(), 1);
        Ok(())
    }

    /// When the updates of the first viewer began, in their order, nanoseconds of the virtual clock.
    pub fn updates_begun_ns(&self) -> Vec<i64> {
        let Schedule { decisions, headless, .. } = &self.server.schedule;
        let begun = decisions.iter().filter(|(at_ns, line, step)| {
            *line == 0 && *step == UpdateStep::Begin.name() && !headless.contains(&(*at_ns, 0))
        });
        begun.map(|(at_ns, ..)| *at_ns).collect()
    }

    /// The other viewers.
    pub fn ghosts(&self) -> impl Iterator<Item = (&Seat, &Ghost)> {
        self.lines.iter().filter_map(|line| Some((&line.seat, line.ghost.as_ref()?)))
    }

    /// Connects all clients over their links.
    fn connect(&mut self) {
        self.lines.iter_mut().for_each(|line| line.connect(START_NS));
    }

    /// Durations of stages in this run.
    pub fn stages(&self) -> StageMs {
        self.server.stages
    }

    /// When the next display frame begins, nanoseconds of the virtual clock.
    pub fn next_frame_ns(&self) -> i64 {
        period_begin_ns(START_NS, self.refresh_hz, self.frame)
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
        let begins = Heard { at_ns: frame_ns, what: What::Frame };
        let step = self.client.step_with(|intake| begins.tell(intake))?;
        self.recording.iter_mut().for_each(|recording| recording.push(begins.clone()));
        self.traced.decoded(self.client.intake.take_decoded());
        if let Step::Frame(report) = &step {
            self.traced.ended([ClientTime(frame_ns); 2], None, report);
        }
        self.frame += u64::from(step != Step::Exit);
        let display_ns = self.next_frame_ns();
        for line in &mut self.lines {
            if let Some(ghost) = &mut line.ghost {
                ghost.display(frame_ns, display_ns)?;
            }
            line.flush(&mut self.server, &mut self.client)?;
        }
        Ok(step)
    }

    /// Departures, arrivals and what the scheduler wants, in the order of time.
    fn play_until(&mut self, until_ns: i64) -> anyhow::Result<()> {
        loop {
            let departures = self.lines.iter().filter_map(|line| line.seat.next_departure_ns());
            let departure_ns = departures.min().unwrap_or(i64::MAX);
            let mut next_ns = departure_ns.min(self.next_poll_ns).min(self.next_motion_ns).min(until_ns);
            let mut has_news = false;
            for line in &mut self.lines {
                let ears = (&self.traced, &mut self.recording);
                if let Some(at_ns) = line.play(&mut self.server, &mut self.client, ears, next_ns)? {
                    (next_ns, has_news) = (at_ns, true);
                }
            }
            if has_news {
                self.drive(next_ns)?; // they wake the scheduler
            } else if departure_ns <= next_ns {
                self.depart(departure_ns)?;
                self.next_poll_ns = departure_ns; // an update may wait for the encoder
            } else if self.next_poll_ns <= next_ns {
                self.drive(next_ns)?;
            } else if self.next_motion_ns <= next_ns {
                self.motion()?;
            } else {
                return Ok(());
            }
        }
    }

    /// Carries out what the scheduler decides, until it or the thread has to wait.
    fn drive(&mut self, now_ns: i64) -> anyhow::Result<()> {
        loop {
            if now_ns < self.server.device.thread_ns() {
                self.next_poll_ns = self.server.device.thread_ns();
                return Ok(());
            }
            let Server { scheduler, device, .. } = &mut self.server;
            let action = scheduler.poll(now_ns, &mut Situated { device, lines: &mut self.lines, now_ns });
            let Ok(action) = action;
            let (peer, step) = match action {
                Action::Make(peer, step) => (peer, Some(step)),
                Action::HandOver(peer) => (peer, None),
                Action::AwaitDevice(_, at_most_ns) => {
                    let comes_ns = self.server.device.next_ns(now_ns).unwrap_or(i64::MAX);
                    self.next_poll_ns = comes_ns.min(now_ns + at_most_ns);
                    return Ok(());
                }
                Action::Sleep(wait_ns) => {
                    self.next_poll_ns = now_ns + wait_ns.min(LONGEST_WAIT_NS);
                    return Ok(());
                }
            };
            let number = line_of(peer);
            self.server.schedule.decisions.push((
                now_ns,
                number,
                step.map_or("hand over", UpdateStep::name).into(),
            ));
            let line = &mut self.lines[number];
            let way = line.way();
            match step {
                Some(step) => line.seat.make(&mut self.server, way, step, now_ns)?,
                None => line.seat.hand_over(&mut self.server, way, now_ns)?,
            }
            line.flush(&mut self.server, &mut self.client)?;
        }
    }

    /// A step of motion for every viewer.
    fn motion(&mut self) -> anyhow::Result<()> {
        let now_ns = self.next_motion_ns;
        self.next_motion_ns += DEFAULT_GRID.spacing_ns;
        for line in &mut self.lines {
            let way = line.way();
            line.seat.motion(&mut self.server, way, now_ns);
            line.flush(&mut self.server, &mut self.client)?;
        }
        Ok(())
    }

    fn depart(&mut self, now_ns: i64) -> anyhow::Result<()> {
        let is_due = |line: &&mut Line| line.seat.next_departure_ns() == Some(now_ns);
        let Some(line) = self.lines.iter_mut().find(is_due) else { return Ok(()) };
        line.seat.depart(&mut self.server, now_ns)?;
        line.flush(&mut self.server, &mut self.client)
    }
}

/// What a client says of itself.
pub fn hello(options: &RunOptions, eye_extent_pixels: [u32; 2]) -> ClientHello {
    let eye = |x| Eye {
        head_from_eye: Pose { position: glam::Vec3::new(x, 0.0, 0.0), ..Pose::IDENTITY },
        fov: Fov::symmetric_degrees(options.fov_degrees),
    };
    let (eyes, display_period_ns) = ([eye(-0.0315), eye(0.0315)], (1e9 / options.refresh_hz) as i64);
    let capabilities = Capabilities {
        max_vertex_slots: options.room.vertices,
        max_patch_slots: options.room.patches,
        max_triangles: options.room.triangles,
        store_pages: options.store_pages,
        blends: options.blends,
        codecs: options.medium().codecs.to_vec(),
        ..Capabilities::most(eyes, eye_extent_pixels, display_period_ns)
    };
    ClientHello::new(env!("CARGO_PKG_VERSION"), capabilities)
}

/// The head path in a file; without one, a short walk.
fn read_head_path(path: Option<&Path>) -> anyhow::Result<HeadPath> {
    let Some(path) = path else { return Ok(HeadPath::parse(BUILT_IN_WALK, "the built-in walk")?) };
    let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
    Ok(HeadPath::parse(&text, &path.display().to_string())?)
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

//! `shadecast-server stream`: the pipeline on real sockets and the real clock.
//!
//! Three threads that never wait for each other: the network (sessions, answers to pings), the pipeline (updates at a
//! constant rate), and the encoder (one picture at a time; while it is busy no new update is started, so that what
//! leaves is always the newest).

use crate::encode::Encoder;
use crate::encode::openh264::{EncoderSettings, OpenH264Encoder};
use crate::frame::{Frame, Shaded};
use crate::scene_gpu::SceneGpu;
use anyhow::Context;
use serde::Serialize;
use shadecast_gpu::Gpu;
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::limits::{MAX_PATCH_SLOTS, MAX_VERTEX_SLOTS};
use shadecast_protocol::message::{
    Codec, Displayed, Environment, HeadState, ResumeSecret, ServerOffer, Welcome,
};
use shadecast_protocol::session::{Out, ServerEvent, ServerSession};
use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};
use shadecast_transport::endpoint::{Endpoint, EndpointConfig, Event, PeerId};
use shadecast_transport::mio::{Driver, Events, Handle, monotonic_now_ns, spawn};
use shadecast_transport::{LinkSchedule, ServerIdentity};
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, TryRecvError, channel, sync_channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A client that was heard from within this time is not displaced by another one.
const ALIVE_NS: i64 = 1_000_000_000;
/// How long a thread sleeps at most before it looks whether the program is to end.
const LOOK_UP: Duration = Duration::from_millis(50);

/// What to serve, and how.
#[derive(Clone, Debug)]
pub struct StreamOptions {
    /// UDP address.
    pub listen: SocketAddr,
    /// Folder of the server's identity; `None` for the user's default.
    pub identity: Option<PathBuf>,
    /// Wanted atlas width and height in texels.
    pub atlas_extent_texels: AtlasExtent,
    /// Quantisation of the atlas, 0 (finest) to 51.
    pub qp: u8,
    /// Updates per second.
    pub rate_hz: f64,
    /// A simulated link on the real socket.
    pub link: Option<LinkSchedule>,
    /// Seed of the simulated link.
    pub seed: u64,
    /// Ends after so many seconds; 0: never.
    pub seconds: f64,
    /// Writes the last atlas there on leaving.
    pub atlas_png: Option<PathBuf>,
}

/// How a run went.
#[derive(Clone, Debug, Default, Serialize)]
pub struct StreamStats {
    /// The Vulkan device.
    pub device: String,
    /// Nanoseconds of the monotonic clock at server time 0.
    pub epoch_monotonic_ns: i64,
    /// Updates sent.
    pub updates: u64,
    /// From the first to the last update.
    pub seconds: f64,
    /// Updates per second.
    pub server_fps: f64,
    /// Bytes of access units.
    pub atlas_bytes: u64,
    /// Bytes of geometry deltas, samples included.
    pub geometry_bytes: u64,
    /// Bytes of vertex samples, headers and first samples included.
    pub sample_bytes: u64,
    /// Vertex samples.
    pub samples: u64,
    /// How often the atlas was full.
    pub coarsened: u32,
    /// Patches in view that were not shown for want of room, summed over the updates for the last client.
    pub dropped_patches: u64,
    /// Clients accepted.
    pub clients: u32,
    /// Mean milliseconds per update by GPU stage.
    pub gpu_ms: BTreeMap<String, f64>,
    /// Vulkan validation warnings and errors.
    pub validation_messages: u32,
}

/// The terms that a server with this scene offers; who has more than one client puts a random secret into them.
pub fn offer(scene: &SceneGpu, atlas_extent_texels: AtlasExtent, rate_hz: f64, session: u64) -> ServerOffer {
    let environment = scene.scene.environment;
    ServerOffer {
        protocol_version: PROTOCOL_VERSION,
        min_protocol_version: PROTOCOL_VERSION,
        app_version: env!("CARGO_PKG_VERSION").into(),
        session,
        grid: DEFAULT_GRID,
        atlas_extent_texels,
        vertex_slots: MAX_VERTEX_SLOTS,
        patch_slots: MAX_PATCH_SLOTS,
        codecs: vec![Codec::H264],
        environment: Environment {
            zenith: environment.zenith.to_array(),
            horizon: environment.horizon.to_array(),
            nadir: environment.nadir.to_array(),
        },
        world_from_stage: scene.scene.world_from_stage,
        update_period_ns: (1e9 / rate_hz) as i64,
        resume: ResumeSecret([0; 16]),
    }
}

/// The one client that is served, and the way to it.
struct Served {
    handle: Handle,
    active: Mutex<Option<Active>>,
    epoch_ns: i64,
}

struct Active {
    peer: PeerId,
    session: ServerSession,
    heard_ns: i64,
}

/// What the network tells the pipeline.
enum News {
    Accepted(Box<Welcome>, Box<shadecast_protocol::message::Capabilities>, PeerId),
    Pose(HeadState),
    Displayed(Displayed),
    Refresh,
    Gone,
}

/// A picture for the encoder.
struct Job {
    peer: PeerId,
    shaded: Shaded,
    refresh: bool,
}

impl Served {
    fn now(&self) -> ServerTime {
        ServerTime(monotonic_now_ns() - self.epoch_ns)
    }

    /// Runs `body` on the session of `peer`, if it is still the one served, and sends what came of it.
    fn with<R>(&self, peer: PeerId, body: impl FnOnce(&mut ServerSession) -> R) -> Option<R> {
        let mut active = self.active.lock().expect("not poisoned");
        let active = active.as_mut().filter(|active| active.peer == peer)?;
        let result = body(&mut active.session);
        while let Some(out) = active.session.poll_out(self.now()) {
            let sent = match out {
                Out::Control(message) => self.handle.send_control(peer, message),
                Out::Stream { bytes, priority } => self.handle.send_stream(peer, bytes, priority).map(|_| ()),
                Out::Datagram(bytes) => self.handle.send_datagram(peer, bytes),
            };
            if let Err(error) = sent {
                tracing::debug!("not sent: {error}");
            }
        }
        Some(result)
    }
}

/// Serves until `stop` is set, the time is over, or the network fails.
///
/// # Errors
/// The address cannot be bound, the identity not be read, or the device is lost.
pub fn run(
    gpu: &Arc<Gpu>,
    scene: &Arc<SceneGpu>,
    options: &StreamOptions,
    stop: &Arc<AtomicBool>,
) -> anyhow::Result<StreamStats> {
    let identity = match &options.identity {
        Some(folder) => ServerIdentity::load_or_create(folder)?,
        None => ServerIdentity::load_or_create(&shadecast_transport::identity::default_directory()?)?,
    };
    let endpoint = Endpoint::server(&identity, EndpointConfig::default())?;
    let mut driver = Driver::bind(endpoint, options.listen)?;
    if let Some(link) = &options.link {
        driver = driver.with_link(link.clone(), options.seed);
    }
    let (handle, events) = spawn(driver)?;
    println!("Listening on {} with identity {}", handle.local_addr(), identity.fingerprint());
    let epoch_ns = monotonic_now_ns();
    let served = Arc::new(Served { handle, active: Mutex::new(None), epoch_ns });
    let (news_to, news) = channel();
    let network = {
        let (served, stop, options, scene) = (served.clone(), stop.clone(), options.clone(), scene.clone());
        std::thread::Builder::new().name("network".into()).spawn(move || {
            let make_offer = |session| offer(&scene, options.atlas_extent_texels, options.rate_hz, session);
            network(&served, &events, &news_to, &stop, &make_offer);
        })?
    };
    let mut pipeline = Pipeline::new(gpu, scene, options, &served, epoch_ns)?;
    let result = pipeline.run(&news, stop);
    stop.store(true, Ordering::Relaxed);
    let _ = network.join();
    result?;
    pipeline.finish()
}

/// The network thread: sessions, pings, and news for the pipeline.
fn network(
    served: &Served,
    events: &Events,
    news: &Sender<News>,
    stop: &AtomicBool,
    make_offer: &dyn Fn(u64) -> ServerOffer,
) {
    let mut sessions = 0;
    while !stop.load(Ordering::Relaxed) {
        let event = match events.next_timeout(LOOK_UP) {
            Ok(Some(event)) => event,
            Ok(None) => continue,
            Err(_) => {
                tracing::error!("the network thread has ended");
                stop.store(true, Ordering::Relaxed);
                return;
            }
        };
        match event {
            Event::Connected { peer, remote, .. } => {
                sessions += 1;
                welcome(served, peer, remote, make_offer(sessions), news);
            }
            Event::Control { peer, message, at_ns } => {
                heard(served, peer, at_ns);
                served.with(peer, |session| session.on_control(&message));
                tell(served, peer, news);
            }
            Event::Datagram { peer, bytes, at_ns } => {
                heard(served, peer, at_ns);
                let received = ServerTime(at_ns - served.epoch_ns);
                served.with(peer, |session| session.on_datagram(&bytes, received));
                tell(served, peer, news);
            }
            Event::Closed { peer, reason, .. } => gone(served, peer, &reason, news),
            Event::Stream { .. } | Event::StreamReset { .. } => {}
        }
    }
    let peer = served.active.lock().expect("not poisoned").as_ref().map(|active| active.peer);
    if let Some(peer) = peer {
        served.with(peer, ServerSession::goodbye);
    }
}

fn welcome(served: &Served, peer: PeerId, remote: SocketAddr, offer: ServerOffer, news: &Sender<News>) {
    let now_ns = monotonic_now_ns();
    let mut active = served.active.lock().expect("not poisoned");
    if active.as_ref().is_some_and(|a| now_ns - a.heard_ns < ALIVE_NS) {
        println!("{remote} turned away: another client is being served");
        let _ = served.handle.close(peer, 1, "another client is being served; try again when it has left");
        return;
    }
    if let Some(old) = active.take() {
        let _ = served.handle.close(old.peer, 2, "silent for too long; another client came");
        let _ = news.send(News::Gone);
    }
    println!("Client connected from {remote}");
    *active = Some(Active { peer, session: ServerSession::new(offer), heard_ns: now_ns });
}

fn heard(served: &Served, peer: PeerId, at_ns: i64) {
    let mut active = served.active.lock().expect("not poisoned");
    if let Some(active) = active.as_mut().filter(|active| active.peer == peer) {
        active.heard_ns = active.heard_ns.max(at_ns);
    }
}

fn gone(served: &Served, peer: PeerId, reason: &str, news: &Sender<News>) {
    let mut active = served.active.lock().expect("not poisoned");
    if active.as_ref().is_some_and(|active| active.peer == peer) {
        println!("Client gone: {reason}");
        *active = None;
        let _ = news.send(News::Gone);
    }
}

/// Hands the session's events on to the pipeline.
fn tell(served: &Served, peer: PeerId, news: &Sender<News>) {
    while let Some(Some(event)) = served.with(peer, ServerSession::poll_event) {
        let item = match event {
            ServerEvent::Accepted { hello, welcome } => {
                News::Accepted(Box::new(welcome), Box::new(hello.capabilities), peer)
            }
            ServerEvent::Pose(state) => News::Pose(state),
            ServerEvent::Displayed(report) => News::Displayed(report),
            ServerEvent::RefreshRequest { .. } => News::Refresh,
            ServerEvent::Refused(refused) => {
                println!("Client refused: {} {}", refused.reason, refused.remedy);
                let _ = served.handle.close(peer, 3, &refused.reason);
                continue;
            }
            ServerEvent::Goodbye => {
                let _ = served.handle.close(peer, 0, "goodbye");
                gone(served, peer, "it said goodbye", news);
                return;
            }
            ServerEvent::Failed(error) => {
                let _ = served.handle.close(peer, 4, &error.to_string());
                gone(served, peer, &error.to_string(), news);
                return;
            }
        };
        let _ = news.send(item);
    }
}

/// The pipeline's thread.
struct Pipeline<'a> {
    gpu: &'a Arc<Gpu>,
    scene: &'a Arc<SceneGpu>,
    options: &'a StreamOptions,
    served: &'a Arc<Served>,
    client: Option<Client>,
    refresh: bool,
    stats: StreamStats,
    encoded_bytes: Arc<Mutex<u64>>,
    first_ns: Option<i64>,
    last_ns: i64,
    last_atlas: Option<Shaded>,
}

struct Client {
    peer: PeerId,
    frame: Frame,
    /// A rendezvous: sending succeeds only while the encoder waits for work.
    jobs: SyncSender<Job>,
    done: Receiver<Shaded>,
    encoding: bool,
}

impl<'a> Pipeline<'a> {
    fn new(
        gpu: &'a Arc<Gpu>,
        scene: &'a Arc<SceneGpu>,
        options: &'a StreamOptions,
        served: &'a Arc<Served>,
        epoch_ns: i64,
    ) -> anyhow::Result<Self> {
        let stats =
            StreamStats { device: gpu.device_name(), epoch_monotonic_ns: epoch_ns, ..StreamStats::default() };
        Ok(Self {
            gpu,
            scene,
            options,
            served,
            client: None,
            refresh: false,
            stats,
            encoded_bytes: Arc::default(),
            first_ns: None,
            last_ns: 0,
            last_atlas: None,
        })
    }

    fn run(&mut self, news: &Receiver<News>, stop: &AtomicBool) -> anyhow::Result<()> {
        let period_ns = (1e9 / self.options.rate_hz) as i64;
        let start_ns = monotonic_now_ns();
        let mut due_ns = start_ns;
        while !stop.load(Ordering::Relaxed) {
            self.listen(news)?;
            let now_ns = monotonic_now_ns();
            if self.options.seconds > 0.0 && (now_ns - start_ns) as f64 * 1e-9 > self.options.seconds {
                break;
            }
            if now_ns >= due_ns && self.encoder_is_free() {
                self.update()?;
                // A late update does not make the next ones hurry.
                due_ns = (due_ns + period_ns).max(monotonic_now_ns() - period_ns);
            } else {
                let wait_ns = (due_ns - now_ns).clamp(500_000, 5_000_000);
                std::thread::sleep(Duration::from_nanos(wait_ns as u64));
            }
        }
        Ok(())
    }

    fn listen(&mut self, news: &Receiver<News>) -> anyhow::Result<()> {
        loop {
            match news.try_recv() {
                Ok(News::Accepted(welcome, capabilities, peer)) => {
                    self.stats.clients += 1;
                    let frame = Frame::new(self.gpu, self.scene, &welcome, &capabilities)
                        .context("making the pipeline for a client")?;
                    self.client = Some(self.start_encoder(peer, frame, welcome.atlas_extent_texels)?);
                }
                Ok(News::Gone) => self.client = None,
                Ok(other) => self.tell_client(other),
                Err(TryRecvError::Empty | TryRecvError::Disconnected) => return Ok(()),
            }
        }
    }

    fn tell_client(&mut self, news: News) {
        let Some(client) = &mut self.client else { return };
        match news {
            News::Pose(state) => client.frame.head(state),
            News::Displayed(report) => client.frame.displayed(&report),
            News::Refresh => self.refresh = true,
            News::Accepted(..) | News::Gone => {}
        }
    }

    fn start_encoder(&self, peer: PeerId, frame: Frame, extent: AtlasExtent) -> anyhow::Result<Client> {
        let threads = std::thread::available_parallelism().map_or(1, |n| (n.get() as u32 / 2).clamp(1, 4));
        let settings = EncoderSettings {
            qp: self.options.qp,
            fps: self.options.rate_hz.round() as u32,
            threads,
            ..EncoderSettings::for_atlas(extent)
        };
        let encoder = OpenH264Encoder::new(settings).context("making the encoder")?;
        let (jobs, jobs_from) = sync_channel(1);
        let (done_to, done) = channel();
        let (served, bytes) = (self.served.clone(), self.encoded_bytes.clone());
        std::thread::Builder::new().name("encoder".into()).spawn(move || {
            encode(Box::new(encoder), &served, &jobs_from, &done_to, &bytes);
        })?;
        Ok(Client { peer, frame, jobs, done, encoding: false })
    }

    fn encoder_is_free(&mut self) -> bool {
        let Some(client) = &mut self.client else { return true };
        if let Ok(shaded) = client.done.try_recv() {
            client.encoding = false;
            self.last_atlas = Some(shaded);
        }
        !client.encoding
    }

    fn update(&mut self) -> anyhow::Result<()> {
        let now = self.served.now();
        let Some(client) = &mut self.client else { return Ok(()) };
        let Some(shaded) = client.frame.update(now).context("shading an update")? else { return Ok(()) };
        let sizes = self.served.with(client.peer, |session| session.send_delta(&shaded.delta));
        if let Some(sizes) = sizes {
            self.stats.geometry_bytes += sizes.total_bytes as u64;
            self.stats.sample_bytes += sizes.sample_bytes as u64;
            self.stats.samples += sizes.samples as u64;
        }
        self.stats.updates += 1;
        if self.stats.updates == 1 {
            println!("First update sent");
        }
        self.stats.coarsened = client.frame.layout().coarsened();
        self.stats.dropped_patches = client.frame.dropped_patches();
        let now_ns = monotonic_now_ns();
        self.first_ns.get_or_insert(now_ns);
        self.last_ns = now_ns;
        for (scope, ms) in self.gpu.take_timings_ms() {
            *self.stats.gpu_ms.entry(scope.to_owned()).or_default() += ms;
        }
        let job = Job { peer: client.peer, shaded, refresh: std::mem::take(&mut self.refresh) };
        client.encoding = client.jobs.try_send(job).is_ok();
        Ok(())
    }

    fn finish(mut self) -> anyhow::Result<StreamStats> {
        self.client = None;
        if let (Some(path), Some(shaded)) = (&self.options.atlas_png, &self.last_atlas) {
            let rgb = crate::picture::rgb_from_planes(shaded.extent_texels, &shaded.planes);
            crate::picture::write_png(path, shaded.extent_texels, &rgb)?;
        }
        let updates = self.stats.updates.max(1) as f64;
        self.stats.gpu_ms.values_mut().for_each(|ms| *ms /= updates);
        self.stats.seconds = (self.last_ns - self.first_ns.unwrap_or(self.last_ns)) as f64 * 1e-9;
        if self.stats.seconds > 0.0 {
            self.stats.server_fps = (self.stats.updates.saturating_sub(1)) as f64 / self.stats.seconds;
        }
        self.stats.atlas_bytes = *self.encoded_bytes.lock().expect("not poisoned");
        self.stats.validation_messages = self.gpu.validation_messages();
        Ok(self.stats)
    }
}

/// The encoder's thread: ends when the pipeline drops the client.
fn encode(
    mut encoder: Box<dyn Encoder>,
    served: &Served,
    jobs: &Receiver<Job>,
    done: &Sender<Shaded>,
    bytes: &Mutex<u64>,
) {
    while let Ok(job) = jobs.recv() {
        match job.shaded.encode(encoder.as_mut(), job.refresh) {
            Ok((header, unit)) => {
                *bytes.lock().expect("not poisoned") += unit.bytes.len() as u64;
                served.with(job.peer, |session| session.send_picture(header, &unit.bytes));
            }
            Err(error) => tracing::error!("update {}: {error}", job.shaded.frame.0),
        }
        if done.send(job.shaded).is_err() {
            return;
        }
    }
}

//! `shadecast-server stream`: the pipeline on real sockets and the real clock.
//!
//! Threads that never wait for each other: the network (connections, sessions, answers to pings), the pipeline (updates for
//! every viewer of the one world) and an encoder a viewer (one picture at a time; while it is busy no new update is started,
//! so that what leaves is always the newest). What the network tells the pipeline is the newest of each kind; what the pipeline
//! makes goes to the transport without the network's thread.

mod backstage;
mod cadence;
mod codes;
mod encoder;
mod outlet;
mod pipeline;
mod rebuild;
mod rehearsal;
mod stats;
mod studio;
mod traced;

pub use codes::pair;
pub use stats::{StreamStats, ViewerStats};
pub use studio::{Device, Reopen};

use crate::animation::timeline::SharedTimeline;
use crate::encode::Source;
use crate::encode::choice::Encoders;
use crate::pacing::quality::QualityOptions;
use crate::pacing::share::WayState;
use crate::scene::SceneGpu;
use crate::serve::sessions::admission::{Admission, Admit};
use crate::serve::sessions::mailbox::Mailbox;
use crate::serve::sessions::{Carrier, Say, Sessions, Surroundings, Verdicts};
use crate::update::ShowOptions;
use cadence::Cadence;
use codes::{Codes, Devices, Terminal};
use outlet::Outlet;
use pipeline::{Pipeline, Studio};
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::limits::{MAX_PATCH_SLOTS, MAX_STORE_PAGES, MAX_VERTEX_SLOTS};
use shadecast_protocol::message::{Codec, Environment, Refused, ResumeSecret, ServerOffer};
use shadecast_protocol::session::Out;
use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};
use shadecast_system::monotonic_now_ns;
use shadecast_trace::Trace;
use shadecast_transport::discovery::announce::Announcement;
use shadecast_transport::endpoint::{Endpoint, EndpointConfig};
use shadecast_transport::event::{PeerId, SendError};
use shadecast_transport::identity::KnownDevices;
use shadecast_transport::mio::{Driver, Events, Handle, spawn};
use shadecast_transport::{LinkSchedule, ServerIdentity};
use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use studio::GpuStudio;
use traced::{Row, Traced};

/// How long a thread sleeps at most before it looks whether the program is to end.
const LOOK_UP: Duration = Duration::from_millis(20);

/// What to serve, and how.
#[derive(Clone, Debug)]
pub struct StreamOptions {
    /// UDP address.
    pub listen: SocketAddr,
    /// The name under which clients of this network find the server by themselves; `None`: they do not.
    pub announced_as: Option<String>,
    /// Folder of the server's identity and of its list of devices; `None` for the user's default.
    pub identity: Option<PathBuf>,
    /// Whom it serves.
    pub admit: Admit,
    /// Lines of the standard input are codes of devices that are paired.
    pub reads_codes: bool,
    /// Wanted atlas width and height in texels.
    pub atlas_extent_texels: AtlasExtent,
    /// Of pictures.
    pub quality: QualityOptions,
    /// What makes video of them.
    pub encoders: Encoders,
    /// How much of the scene a client is shown, and how.
    pub show: ShowOptions,
    /// Updates per second.
    pub rate_hz: f64,
    /// Milliseconds of an update for blocks that are shaded again; `None`: what is left of its period.
    pub shade_ms: Option<f64>,
    /// Clients that are served at once.
    pub viewers: usize,
    /// Whether those with the right to may halt the world, for all, and let it go on.
    pub viewers_steer: bool,
    /// A simulated link on the real socket.
    pub link: Option<LinkSchedule>,
    /// Seed of the simulated link.
    pub seed: u64,
    /// Ends after so many seconds; 0: never.
    pub seconds: f64,
    /// Writes there what happens when, for Perfetto.
    pub trace: Option<PathBuf>,
    /// Writes the last atlas there on leaving.
    pub atlas_png: Option<PathBuf>,
}

/// The terms that a server with this scene offers; one with strangers among its clients puts a random secret into them.
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
        motion: scene.motion.memory(),
        unsampled: scene.motion.unsampled_memory(),
        store_pages: MAX_STORE_PAGES,
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

/// The transport and the network's thread, as the pipeline sees them.
struct Way {
    handle: Handle,
    verdicts: Arc<Verdicts>,
    traced: Row,
}

impl Outlet for Way {
    fn send(&self, peer: PeerId, out: Out) -> Result<(), SendError> {
        self.traced.leaves(&out);
        Carrier::send(&self.handle, peer, out)
    }

    fn way(&self, peer: PeerId) -> Option<WayState> {
        self.handle.stats(peer).map(WayState::from)
    }

    fn refuse(&self, peer: PeerId, refused: Refused) {
        self.verdicts.refuse(peer, refused);
    }
}

/// Sets a flag when a thread ends, however it ends.
struct StopOnEnd<'a>(&'a AtomicBool);

impl Drop for StopOnEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Serves a scene that moves as it says itself, until `stop` is set, the time is over, or the network fails.
///
/// # Errors
/// The address cannot be bound, the identity not be read, or the device is lost for good.
pub fn run(
    device: Device,
    reopen: &Reopen<'_>,
    options: &StreamOptions,
    stop: &AtomicBool,
    say: &Say<'_>,
) -> anyhow::Result<StreamStats> {
    let timeline = SharedTimeline::new(&device.scene.scene);
    run_timeline(device, timeline, reopen, options, stop, say)
}

/// As [`run`], moving as a timeline of the scene says, which the caller changes meanwhile: it outlives lost devices.
///
/// # Errors
/// Those of [`run`].
pub fn run_timeline(
    device: Device,
    timeline: SharedTimeline,
    reopen: &Reopen<'_>,
    options: &StreamOptions,
    stop: &AtomicBool,
    say: &Say<'_>,
) -> anyhow::Result<StreamStats> {
    let trace = options.trace.as_deref().map(Trace::create).transpose()?;
    let mut studio = GpuStudio::rehearsed(device, timeline, reopen, options)?;
    let (identity, admission, codes) = open_door(options)?;
    let (handle, events, _announcement) = listen(&identity, options, studio.rehearsal_s(), say)?;
    let terms = offer(&studio.device()?.scene, options.atlas_extent_texels, options.rate_hz, 0);
    let terms = move |session| {
        let resume = ResumeSecret(shadecast_transport::random_bytes());
        ServerOffer { session, resume, ..terms.clone() }
    };
    let (mailbox, verdicts, epoch_ns) =
        (Mailbox::default(), Arc::new(Verdicts::default()), monotonic_now_ns());
    let cadence = Cadence::default();
    let traced = Traced::new(trace, epoch_ns);
    let (mut stats, last_atlas) = std::thread::scope(|scope| {
        let (mailbox, verdicts, carrier) = (&mailbox, &verdicts, handle.clone());
        let network = std::thread::Builder::new().name("sessions".into()).spawn_scoped(scope, move || {
            let _stop = StopOnEnd(stop);
            let sessions = Sessions::new(Box::new(terms), options.viewers, epoch_ns).admitting(admission);
            let around = Surroundings { carrier: &carrier, mailbox, verdicts, say };
            run_sessions((sessions, codes), &around, &events, stop);
            events // without them the transport ends, and the pipeline may still be sending
        })?;
        let outlet: Arc<dyn Outlet> =
            Arc::new(Way { handle, verdicts: verdicts.clone(), traced: traced.row("network") });
        let (cadence, of_motion, motion_row) = (&cadence, outlet.clone(), traced.row("motion"));
        std::thread::Builder::new().name("motion".into()).spawn_scoped(scope, move || {
            run_motion(cadence, of_motion.as_ref(), &motion_row, epoch_ns, stop)
        })?;
        let _stop = StopOnEnd(stop);
        let mut pipeline = Pipeline::new(
            &mut studio,
            outlet,
            cadence,
            mailbox,
            say,
            options.rate_hz,
            (traced, &monotonic_now_ns),
        );
        let worked = run_pipeline(&mut pipeline, mailbox, options.seconds, stop);
        stop.store(true, Ordering::Relaxed);
        let has_panicked = network.join().is_err();
        worked?;
        anyhow::ensure!(!has_panicked, "the thread of the sessions has failed; its reason is in the log");
        anyhow::Ok(pipeline.finish(monotonic_now_ns()))
    })?;
    if let (Some(path), Some(shaded)) = (&options.atlas_png, &last_atlas) {
        let Source::Planes(atlas) = &shaded.picture;
        crate::encode::picture::write_png(
            path,
            atlas.extent_texels(),
            &crate::encode::picture::rgb_of(atlas),
        )?;
    }
    if let Ok(device) = studio.device() {
        stats.device = device.gpu.device_name();
        stats.validation_messages = device.gpu.checked_messages();
    }
    Ok(stats)
}

/// Who the server is, whom it lets in, and where codes come from.
fn open_door(options: &StreamOptions) -> anyhow::Result<(ServerIdentity, Admission, Codes)> {
    let folder = match &options.identity {
        Some(folder) => folder.clone(),
        None => shadecast_transport::identity::default_directory()?,
    };
    let identity = ServerIdentity::load_or_create(&folder)?;
    let devices = Box::new(Devices::new(KnownDevices::load(&folder)?));
    let admission = Admission::new(options.admit, identity.fingerprint(), devices);
    let terminal = options.reads_codes.then(Terminal::read).transpose()?;
    Ok((identity, admission, Codes::new(&folder, terminal)))
}

/// Opens the socket, and says so: here, and on the network.
fn listen(
    identity: &ServerIdentity,
    options: &StreamOptions,
    rehearsal_s: f64,
    say: &Say<'_>,
) -> anyhow::Result<(Handle, Events, Option<Announcement>)> {
    let usual = EndpointConfig::default();
    // One more than viewers and those who greet: the device that is being paired.
    let max_peers = usual.max_peers + options.viewers;
    let endpoint = Endpoint::server(identity, EndpointConfig { max_peers, ..usual })?;
    let mut driver = Driver::bind(endpoint, options.listen)?;
    if let Some(link) = &options.link {
        driver = driver.with_link(link.clone(), options.seed);
    }
    let (handle, events) = spawn(driver)?;
    let (address, fingerprint) = (handle.local_addr(), identity.fingerprint());
    say(&format!("Listening on {address} with identity {fingerprint}"));
    say(&format!("Pipelines are ready after {rehearsal_s:.1} s"));
    let announce = |name: &String| match Announcement::start(name, address, fingerprint) {
        Ok(announcement) => {
            say(&format!("Announced as {name}: clients of this network find it with --connect find"));
            Some(announcement)
        }
        Err(error) => {
            tracing::warn!("{error}");
            None
        }
    };
    let announcement = options.announced_as.as_ref().and_then(announce);
    Ok((handle, events, announcement))
}

fn run_sessions(
    (mut sessions, mut codes): (Sessions, Codes),
    around: &Surroundings<'_>,
    events: &Events,
    stop: &AtomicBool,
) {
    while !stop.load(Ordering::Relaxed) {
        match events.next_timeout(LOOK_UP) {
            Ok(Some(event)) => sessions.take(event, monotonic_now_ns(), around),
            Ok(None) => {}
            Err(stopped) => {
                tracing::error!("{stopped}");
                return;
            }
        }
        sessions.tick(monotonic_now_ns(), around);
        codes.tend(&mut sessions, monotonic_now_ns(), around);
    }
    sessions.goodbye(monotonic_now_ns(), around);
}

fn run_motion(cadence: &Cadence, outlet: &dyn Outlet, traced: &Row, epoch_ns: i64, stop: &AtomicBool) {
    let now = || ServerTime(monotonic_now_ns() - epoch_ns);
    while !stop.load(Ordering::Relaxed) {
        let began_ns = monotonic_now_ns();
        cadence.step(outlet, now());
        traced.ended("motion", began_ns, None);
        std::thread::sleep(Cadence::wait(now()));
    }
}

fn run_pipeline<S: Studio>(
    pipeline: &mut Pipeline<'_, S>,
    mailbox: &Mailbox,
    seconds: f64,
    stop: &AtomicBool,
) -> anyhow::Result<()> {
    let start_ns = monotonic_now_ns();
    while !stop.load(Ordering::Relaxed) {
        let now_ns = monotonic_now_ns();
        if seconds > 0.0 && (now_ns - start_ns) as f64 * 1e-9 > seconds {
            break;
        }
        let wait = pipeline.step(now_ns)?;
        mailbox.wait(wait);
    }
    Ok(())
}

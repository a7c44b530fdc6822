//! The scheduler's driver on the real device: carries out what it decides, for the clients that are served.
//!
//! A fault while one client's updates are made ends that client's session, with a reason, and the server goes on. Only a lost
//! device stops all of it; then it is opened again from the top. Time comes in; nothing here reads a clock by itself.

use super::cadence::Cadence;
use super::encoder::{EncodeOutcome, EncoderThread, Job, PictureEncoder, Pictures, refused_by};
use super::outlet::Outlet;
use super::rebuild::Rebuild;
use super::traced::{DeviceRow, Row, Traced};
use super::{StreamStats, ViewerStats};
use crate::encode::{EncodeError, Encoder};
use crate::pacing::gate::Kind;
use crate::pacing::overlap::{Flight, Step};
use crate::pacing::quality::QualityOptions;
use crate::serve::scheduler::{Action, LONGEST_WAIT_NS, SHORTEST_WAIT_NS, Scheduler, Situation};
use crate::serve::sessions::Say;
use crate::serve::sessions::mailbox::{Accepted, Client, Mailbox, News};
use crate::serve::viewer::{Reported, Update, Updates, Viewer};
use crate::support::lock::lock;
use crate::update::Shaded;
use anyhow::Context;
use shadecast_gpu::GpuError;
use shadecast_protocol::delta::DeltaSizes;
use shadecast_protocol::message::{Capabilities, Refused, Welcome};
use shadecast_protocol::session::clock_stamp;
use shadecast_protocol::time::ServerTime;
use shadecast_protocol::world_clock::Steering;
use shadecast_transport::{PeerId, SendError};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

/// What a fault of the device came in the way of.
const SHADING: &str = "shading an update";
/// Encoders that may fail one after the other, without a picture between them, before the session ends.
const MAX_ENCODER_FAILURES: u32 = 3;
/// Clients that have gone whose figures are kept.
const MAX_VIEWERS_REMEMBERED: usize = 64;
/// From one look at what is made for a newcomer to the next, at most, nanoseconds.
const NEWCOMER_WAIT_NS: i64 = 1_000_000;

/// What serves a client: what makes its updates, and what encodes their pictures.
pub(super) type Opened<U> = (U, Box<dyn PictureEncoder>);

/// Why a client cannot be served.
pub(super) enum OpenError {
    /// The device.
    Device(GpuError),
    /// Its encoder.
    Encoder(String),
}

/// What makes updates: the device and the scene on it.
pub(super) trait Studio {
    /// What makes one client's updates.
    type Updates: Updates;
    /// What is being made for a client that has come. Dropped, it is not wanted any more.
    type Opening;
    /// Begins to make what serves a client that has come. Nobody waits for it.
    fn open(
        &mut self,
        welcome: &Welcome,
        capabilities: &Capabilities,
        pictures: Pictures,
    ) -> Result<Self::Opening, OpenError>;
    /// What serves the client, once it is made.
    fn opened(&mut self, opening: &mut Self::Opening) -> Option<Result<Opened<Self::Updates>, OpenError>>;
    /// How far a client's updates in flight have come.
    fn flight(&self, updates: &Self::Updates) -> Result<Flight, GpuError>;
    /// Makes a step of a client's updates, which begin at `now` if they do; gives what it collects. Before the first head state
    /// there is nothing to make.
    fn advance(
        &mut self,
        updates: &mut Self::Updates,
        step: Step,
        now: ServerTime,
    ) -> Result<Option<Shaded>, GpuError>;
    /// Waits until the device has come further with a client's updates in flight, at most so long; false where it has nothing to
    /// do for them.
    fn rest(&self, updates: &Self::Updates, at_most: Duration) -> Result<bool, GpuError>;
    /// A client has gone, and what it had in flight with it. `has_failed`: in the middle of an update, of which nothing is to be
    /// believed.
    fn close(&mut self, opened: Opened<Self::Updates>, has_failed: bool);
    /// What is known of a client's pictures.
    fn account(&self, updates: &Self::Updates, stats: &mut ViewerStats);
    /// How finely pictures are quantised.
    fn quality(&self) -> QualityOptions;
    /// An encoder for the pictures of a session.
    fn encoder(&mut self, welcome: &Welcome) -> Result<Box<dyn Encoder>, EncodeError>;
    /// Starts an encoder beside the pipeline, which sends the pictures of a peer.
    fn start_encoder(
        &mut self,
        welcome: &Welcome,
        pictures: Pictures,
    ) -> anyhow::Result<Box<dyn PictureEncoder>> {
        let encoder = self.encoder(welcome)?;
        Ok(Box::new(EncoderThread::start(encoder, pictures)?))
    }
    /// A viewer wants the world to stand, or to go on.
    fn steer(&mut self, wanted: Steering, now: ServerTime);
    /// Opens the device again, after it was lost, and brings the scene to it.
    fn reopen(&mut self) -> anyhow::Result<()>;
}

/// Updates for whoever is served.
pub(super) struct Pipeline<'a, S: Studio> {
    studio: &'a mut S,
    outlet: Arc<dyn Outlet>,
    cadence: &'a Cadence,
    mailbox: &'a Mailbox,
    say: &'a Say<'a>,
    /// Reads the monotonic clock, nanoseconds.
    clock: &'a dyn Fn() -> i64,
    epoch_ns: i64,
    clients: BTreeMap<PeerId, Served<S::Updates>>,
    /// Accepted clients whose updates nobody can make yet.
    newcomers: BTreeMap<PeerId, Newcomer<S::Opening>>,
    scheduler: Scheduler<PeerId>,
    rebuild: Rebuild,
    /// When the device is opened again; `None` while it is open.
    reopen_ns: Option<i64>,
    stats: StreamStats,
    first_ns: Option<i64>,
    last_ns: i64,
    /// Quantisers of all pictures, summed.
    qp_sum: u64,
    last_atlas: Option<Box<Shaded>>,
    traced: Traced,
    of_pipeline: Row,
    of_steps: Row,
    of_device: DeviceRow,
}

/// A client that will be served.
struct Newcomer<O> {
    accepted: Accepted,
    opening: O,
    /// What it has told meanwhile.
    reported: Reported,
    /// Of all clients so far.
    number: u32,
}

/// A client that is served.
struct Served<U> {
    viewer: Viewer<U>,
    welcome: Welcome,
    encoder: Box<dyn PictureEncoder>,
    encoder_failures: u32,
    /// An update that leaves when the picture before it has.
    made: Option<Shaded>,
    stats: ViewerStats,
    since_ns: i64,
}

/// What the scheduler asks about clients.
struct Situated<'p, S: Studio> {
    studio: &'p S,
    outlet: &'p dyn Outlet,
    clients: &'p mut BTreeMap<PeerId, Served<S::Updates>>,
}

impl<S: Studio> Situation<PeerId> for Situated<'_, S> {
    type Error = Fault;

    fn flight(&mut self, peer: PeerId) -> Result<Flight, Fault> {
        let Some(client) = self.clients.get(&peer) else { return Ok(Flight::default()) };
        let flight =
            || self.studio.flight(client.viewer.updates()).map_err(|error| Fault::of(&error, SHADING));
        guarded(flight).map_err(Fault::in_update)
    }

    fn is_open(&mut self, peer: PeerId, now_ns: i64) -> bool {
        let Some(client) = self.clients.get_mut(&peer) else { return false };
        let is_open = client.viewer.is_open(self.outlet.way(peer).as_ref(), now_ns);
        if let Some(shortfall) = client.viewer.shortfall(now_ns) {
            tracing::warn!("{shortfall}");
        }
        is_open
    }
}

/// What ends a client's session.
enum Fault {
    /// Its own: it is told, and the server goes on.
    Client(Refused),
    /// The same in the middle of an update: what that has made in the world is not to be believed.
    Update(Refused),
    /// The device is gone, and with it all pipelines.
    Lost(String),
}

impl Fault {
    fn of(error: &GpuError, doing: &str) -> Self {
        match error.is_lost() {
            true => Self::Lost(format!("{doing}: {error}")),
            false => {
                let remedy =
                    "ask for a smaller atlas or eyes of fewer pixels, or free memory of the server's device";
                Self::Client(Refused::new(&format!("{doing}: {error}"), remedy))
            }
        }
    }

    /// The same fault, where it happened while an update was made.
    fn in_update(self) -> Self {
        match self {
            Self::Client(refused) => Self::Update(refused),
            other => other,
        }
    }

    fn of_panic(panic: &(dyn std::any::Any + Send)) -> Self {
        Self::Client(refused_by(panic))
    }

    fn of_opening(error: &OpenError) -> Self {
        match error {
            OpenError::Device(error) => Self::of(error, "making the pipeline for this client"),
            OpenError::Encoder(reason) => Self::of_encoder(reason),
        }
    }

    fn of_encoder(reason: &str) -> Self {
        let reason = format!("pictures cannot be encoded: {reason}");
        Self::Client(Refused::new(&reason, "connect again; the server's log says more"))
    }
}

/// Runs `body`; a panic in it is a fault of this client's session alone.
fn guarded<T>(body: impl FnOnce() -> Result<T, Fault>) -> Result<T, Fault> {
    // What a panic leaves behind belongs to the client, which is dropped then.
    catch_unwind(AssertUnwindSafe(body)).unwrap_or_else(|panic| Err(Fault::of_panic(panic.as_ref())))
}

impl<'a, S: Studio> Pipeline<'a, S> {
    pub(super) fn new(
        studio: &'a mut S,
        outlet: Arc<dyn Outlet>,
        cadence: &'a Cadence,
        mailbox: &'a Mailbox,
        say: &'a Say<'a>,
        rate_hz: f64,
        (traced, clock): (Traced, &'a dyn Fn() -> i64),
    ) -> Self {
        let epoch_ns = traced.epoch_ns();
        Self {
            of_pipeline: traced.row("updates"),
            of_steps: traced.row("pipeline"),
            of_device: traced.device(),
            traced,
            studio,
            outlet,
            cadence,
            mailbox,
            say,
            clock,
            epoch_ns,
            clients: BTreeMap::new(),
            newcomers: BTreeMap::new(),
            scheduler: Scheduler::new((1e9 / rate_hz) as i64),
            rebuild: Rebuild::default(),
            reopen_ns: None,
            stats: StreamStats { epoch_monotonic_ns: epoch_ns, ..StreamStats::default() },
            first_ns: None,
            last_ns: 0,
            qp_sum: 0,
            last_atlas: None,
        }
    }

    /// Takes what is new, and carries out the scheduler's next action; gives how long nothing will be due.
    ///
    /// # Errors
    /// The device is lost, and cannot be opened again.
    pub(super) fn step(&mut self, now_ns: i64) -> anyhow::Result<Duration> {
        if let Some(at_ns) = self.reopen_ns {
            if now_ns < at_ns {
                return Ok(nanoseconds((at_ns - now_ns).min(LONGEST_WAIT_NS)));
            }
            self.reopen(now_ns)?;
            if self.reopen_ns.is_some() {
                return Ok(nanoseconds(LONGEST_WAIT_NS));
            }
        }
        for (peer, news) in self.mailbox.take() {
            self.take_news(peer, news, now_ns)?;
        }
        for peer in self.newcomers.keys().copied().collect::<Vec<_>>() {
            self.poll_newcomer(peer, now_ns)?;
        }
        for peer in self.clients.keys().copied().collect::<Vec<_>>() {
            let polled = self.poll_encoder(peer, now_ns);
            self.settle(peer, polled, now_ns)?;
        }
        let (studio, outlet, clients) = (&*self.studio, self.outlet.as_ref(), &mut self.clients);
        let action = self.scheduler.poll(now_ns, &mut Situated { studio, outlet, clients });
        let (peer, done) = match action {
            Ok(Action::Make(peer, step)) => (peer, self.make(peer, step, now_ns)),
            Ok(Action::HandOver(peer)) => (peer, self.hand_over(peer, now_ns)),
            Ok(Action::AwaitDevice(peer, at_most_ns)) => return self.rest(peer, at_most_ns, now_ns),
            Ok(Action::Sleep(wait_ns)) if self.newcomers.is_empty() => return Ok(nanoseconds(wait_ns)),
            Ok(Action::Sleep(wait_ns)) => return Ok(nanoseconds(wait_ns.min(NEWCOMER_WAIT_NS))),
            Err((peer, fault)) => (peer, Err(fault)),
        };
        self.settle(peer, done, now_ns)?;
        Ok(Duration::ZERO)
    }

    /// Nothing is to be done until the device or the encoder has come further: gives how long there is still to sleep.
    fn rest(&mut self, peer: PeerId, at_most_ns: i64, now_ns: i64) -> anyhow::Result<Duration> {
        let Some(client) = self.clients.get(&peer) else { return Ok(nanoseconds(SHORTEST_WAIT_NS)) };
        // The device wakes it; on one that is a CPU, each look beside it costs the device time.
        match self.studio.rest(client.viewer.updates(), nanoseconds(at_most_ns)) {
            Ok(has_rested) => Ok(nanoseconds(if has_rested { 0 } else { SHORTEST_WAIT_NS })),
            Err(error) => {
                let fault = Fault::of(&error, SHADING).in_update();
                self.settle(peer, Err(fault), now_ns)?;
                Ok(Duration::ZERO)
            }
        }
    }

    /// Takes what is new of a client; has made what serves it where it has just come.
    fn take_news(
        &mut self,
        peer: PeerId,
        News { client, reported }: News,
        now_ns: i64,
    ) -> anyhow::Result<()> {
        match client {
            Client::Unchanged => {}
            Client::Gone => self.close(peer, false, now_ns),
            Client::Accepted(accepted) => {
                self.close(peer, false, now_ns);
                let opened = self.open(peer, *accepted);
                self.settle(peer, opened, now_ns)?;
            }
        }
        self.report(peer, reported, now_ns)
    }

    /// A client has told something.
    fn report(&mut self, peer: PeerId, reported: Reported, now_ns: i64) -> anyhow::Result<()> {
        if let Some(newcomer) = self.newcomers.get_mut(&peer) {
            newcomer.reported.then(reported);
        }
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(()) };
        if let Some(report) = &reported.displayed {
            self.of_pipeline.happens("display is known", Some(report.update));
        }
        let now = ServerTime(now_ns - self.epoch_ns);
        reported.steering.into_iter().for_each(|wanted| self.studio.steer(wanted, now));
        let applied = guarded(|| {
            client.viewer.apply(reported);
            Ok(())
        });
        self.scheduler.watch(peer, client.viewer.wants_updates(), now_ns);
        self.settle(peer, applied, now_ns)
    }

    /// Has made what serves a client that has come.
    fn open(&mut self, peer: PeerId, accepted: Accepted) -> Result<(), Fault> {
        self.stats.clients += 1;
        let (number, reported) = (self.stats.clients, Reported::default());
        let Accepted { welcome, capabilities, .. } = &accepted;
        let pictures = self.pictures_of(peer);
        let opening = guarded(|| {
            let opening = self.studio.open(welcome, capabilities, pictures);
            opening.map_err(|error| Fault::of_opening(&error))
        })?;
        self.newcomers.insert(peer, Newcomer { accepted, opening, reported, number });
        Ok(())
    }

    /// Serves a newcomer from now on, if what serves it is made.
    fn poll_newcomer(&mut self, peer: PeerId, now_ns: i64) -> anyhow::Result<()> {
        let Some(newcomer) = self.newcomers.get_mut(&peer) else { return Ok(()) };
        let opened = guarded(|| {
            let opened = self.studio.opened(&mut newcomer.opening).transpose();
            opened.map_err(|error| Fault::of_opening(&error))
        });
        if matches!(opened, Ok(None)) {
            return Ok(());
        }
        let Some(Newcomer { accepted, reported, number, .. }) = self.newcomers.remove(&peer) else {
            return Ok(());
        };
        match opened {
            Ok(None) => {}
            Ok(Some(opened)) => self.serve(peer, (accepted, number), opened, now_ns),
            Err(fault) => self.settle(peer, Err(fault), now_ns)?,
        }
        self.report(peer, reported, now_ns)
    }

    fn serve(
        &mut self,
        peer: PeerId,
        (Accepted { welcome, sender, .. }, number): (Accepted, u32),
        (updates, encoder): Opened<S::Updates>,
        now_ns: i64,
    ) {
        let quality = self.studio.quality().of_codec(welcome.codec);
        let viewer = Viewer::new(updates, sender, quality, self.scheduler.period_ns());
        viewer.motion().into_iter().for_each(|motion| self.cadence.join(peer, motion.clone()));
        self.scheduler.join(peer, now_ns);
        self.clients.insert(
            peer,
            Served {
                viewer,
                welcome,
                encoder,
                encoder_failures: 0,
                made: None,
                stats: ViewerStats { viewer: number, ..ViewerStats::default() },
                since_ns: now_ns,
            },
        );
    }

    fn pictures_of(&self, peer: PeerId) -> Pictures {
        Pictures { outlet: self.outlet.clone(), peer, row: self.traced.row("encoder") }
    }

    fn start_encoder(&mut self, peer: PeerId, welcome: &Welcome) -> Result<Box<dyn PictureEncoder>, Fault> {
        let pictures = self.pictures_of(peer);
        let started = self.studio.start_encoder(welcome, pictures);
        started.map_err(|error| Fault::of_encoder(&error.to_string()))
    }

    fn poll_encoder(&mut self, peer: PeerId, now_ns: i64) -> Result<(), Fault> {
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(()) };
        match client.encoder.poll() {
            None => {}
            Some(EncodeOutcome::Sent { shaded, picture, unit_bytes, bits }) => {
                client.encoder_failures = 0;
                self.scheduler.encoded(peer, Some((picture.encode_s * 1e9) as i64));
                client.viewer.sent_picture(shaded.update, picture, now_ns);
                client.stats.atlas_bytes += unit_bytes as u64;
                self.stats.atlas_bytes += unit_bytes as u64;
                if let Some(bits) = bits {
                    self.stats.bits_by_cause = Some(self.stats.bits_by_cause.unwrap_or_default() + bits);
                }
                if let Some(earlier) = self.last_atlas.replace(shaded) {
                    client.viewer.recycle(*earlier);
                }
            }
            Some(EncodeOutcome::Failed(reason)) => return self.restart_encoder(peer, &reason),
        }
        Ok(())
    }

    /// A fresh encoder, whose first picture needs no other; not again and again.
    fn restart_encoder(&mut self, peer: PeerId, reason: &str) -> Result<(), Fault> {
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(()) };
        tracing::error!("the encoder is started anew: {reason}");
        self.stats.encoder_restarts += 1;
        client.encoder_failures += 1;
        if client.encoder_failures > MAX_ENCODER_FAILURES {
            return Err(Fault::of_encoder(reason));
        }
        let welcome = client.welcome.clone();
        let encoder = guarded(|| self.start_encoder(peer, &welcome))?;
        if let Some(client) = self.clients.get_mut(&peer) {
            client.encoder = encoder;
            client.viewer.refresh();
            self.scheduler.encoded(peer, None);
        }
        Ok(())
    }

    /// Makes a step of a client's updates.
    fn make(&mut self, peer: PeerId, step: Step, now_ns: i64) -> Result<(), Fault> {
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(()) };
        let (studio, outlet, now) = (&mut *self.studio, &self.outlet, ServerTime(now_ns - self.epoch_ns));
        let begun_ns = (self.clock)();
        let made = guarded(|| {
            let updates = match step {
                Step::Begin => client.viewer.begin(outlet.way(peer).as_ref(), now_ns),
                _ => client.viewer.updates_mut(),
            };
            studio.advance(updates, step, now).map_err(|error| Fault::of(&error, SHADING))
        });
        self.of_steps.ended(step.name(), begun_ns, None);
        let shaded = made.map_err(Fault::in_update)?;
        let cpu_ns = (self.clock)() - begun_ns;
        let cost = self.scheduler.completed((peer, step), cpu_ns, shaded.as_ref().map(device_ns), now_ns);
        let Some((shaded, cost)) = shaded.zip(cost) else { return Ok(()) };
        client.stats.busy_s += cost.took_ns as f64 * 1e-9;
        client.viewer.note_update(cost.shared_s(), cost.apart_s());
        self.of_pipeline.ended("update", self.epoch_ns + shaded.time.0, Some(shaded.update));
        self.of_pipeline.sharpness(shaded.sharpness);
        self.of_device.ended(&shaded.timings, shaded.update);
        self.stats.add_gpu(&shaded.timings);
        client.made = Some(shaded);
        Ok(())
    }

    /// Sends what an update changes in the client's memory, and gives its picture to the encoder.
    fn hand_over(&mut self, peer: PeerId, now_ns: i64) -> Result<(), Fault> {
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(()) };
        let Some(shaded) = client.made.take() else { return Ok(()) };
        let (outlet, now, begun_ns) = (&self.outlet, ServerTime(now_ns - self.epoch_ns), (self.clock)());
        let clock = || now.plus_ns((self.clock)() - begun_ns);
        let Update { shaded, sizes, refresh, qp } =
            guarded(|| client.send_delta(outlet.as_ref(), peer, shaded, now_ns, clock))?;
        client.stats.busy_s += ((self.clock)() - begun_ns) as f64 * 1e-9;
        client.count(sizes, now_ns);
        self.qp_sum += u64::from(qp);
        client.encoder.give(Job { shaded, refresh, qp });
        self.scheduler.handed_over(peer, now_ns);
        self.count(sizes, now_ns);
        Ok(())
    }

    fn count(&mut self, sizes: DeltaSizes, now_ns: i64) {
        self.stats.geometry_bytes += sizes.total_bytes as u64;
        self.stats.prediction_bytes += sizes.prediction_bytes as u64;
        self.stats.updates += 1;
        if self.stats.updates == 1 {
            (self.say)("First update sent");
        }
        self.first_ns.get_or_insert(now_ns);
        self.last_ns = now_ns;
    }

    /// Ends the session of a client whose turn has failed, and everything on the device where that is lost.
    fn settle(&mut self, peer: PeerId, turn: Result<(), Fault>, now_ns: i64) -> anyhow::Result<()> {
        match turn {
            Ok(()) => {}
            Err(Fault::Client(refused)) => self.refuse(peer, refused, false, now_ns),
            Err(Fault::Update(refused)) => self.refuse(peer, refused, true, now_ns),
            Err(Fault::Lost(reason)) => {
                let all = self.clients.keys().chain(self.newcomers.keys()).copied();
                let others = all.filter(|other| *other != peer);
                let all: Vec<PeerId> = others.chain([peer]).collect();
                for peer in all {
                    self.close(peer, true, now_ns);
                    self.outlet.refuse(peer, device_lost());
                }
                self.lost(&reason, now_ns)?;
            }
        }
        Ok(())
    }

    /// Ends a session, with a reason. `was_updating`: in the middle of an update.
    fn refuse(&mut self, peer: PeerId, refused: Refused, was_updating: bool, now_ns: i64) {
        tracing::warn!("a session ends: {}", refused.reason);
        self.stats.refused += 1;
        self.close(peer, was_updating, now_ns);
        self.outlet.refuse(peer, refused);
    }

    /// Forgets a client; what its figures were stays.
    fn close(&mut self, peer: PeerId, has_failed: bool, now_ns: i64) {
        self.newcomers.remove(&peer);
        let Some(client) = self.clients.remove(&peer) else { return };
        self.scheduler.leave(peer);
        self.cadence.leave(peer);
        let Served { viewer, mut stats, since_ns, encoder, .. } = client;
        let motion = viewer.motion().map(|motion| lock(motion).bytes()).unwrap_or_default();
        self.stats.sample_bytes += motion.sample_bytes;
        self.stats.samples += motion.samples;
        self.stats.motion_bytes += motion.total();
        let updates = viewer.into_updates();
        self.studio.account(&updates, &mut stats);
        stats.seconds = (now_ns - since_ns) as f64 * 1e-9;
        self.stats.coarsened = stats.coarsened;
        self.stats.dropped_patches = stats.dropped_patches;
        self.stats.viewers.push(stats);
        if self.stats.viewers.len() > MAX_VIEWERS_REMEMBERED {
            self.stats.viewers.remove(0);
        }
        self.studio.close((updates, encoder), has_failed);
    }

    fn lost(&mut self, reason: &str, now_ns: i64) -> anyhow::Result<()> {
        let wait = self.rebuild.failed(now_ns).with_context(|| {
            format!(
                "the graphics device is lost again and again ({reason}); restart the server or its driver"
            )
        })?;
        tracing::error!("{reason}; the device is opened again in {:.2} s", wait.as_secs_f32());
        self.reopen_ns = Some(now_ns + wait.as_nanos() as i64);
        Ok(())
    }

    fn reopen(&mut self, now_ns: i64) -> anyhow::Result<()> {
        self.last_atlas = None;
        match self.studio.reopen() {
            Ok(()) => {
                tracing::warn!("the device is open again");
                self.stats.devices_lost += 1;
                self.rebuild.succeeded(now_ns);
                self.of_device.forget();
                self.reopen_ns = None;
                Ok(())
            }
            Err(error) => self.lost(&format!("opening the device again: {error:#}"), now_ns),
        }
    }

    /// The figures of the run, and the last picture.
    pub(super) fn finish(mut self, now_ns: i64) -> (StreamStats, Option<Box<Shaded>>) {
        for peer in self.clients.keys().copied().collect::<Vec<_>>() {
            self.close(peer, false, now_ns);
        }
        let updates = self.stats.updates.max(1) as f64;
        self.stats.mean_qp = (self.stats.updates > 0).then(|| self.qp_sum as f64 / updates);
        self.stats.gpu_ms.values_mut().for_each(|ms| *ms /= updates);
        self.stats.seconds = (self.last_ns - self.first_ns.unwrap_or(self.last_ns)) as f64 * 1e-9;
        if self.stats.seconds > 0.0 {
            self.stats.server_fps = (self.stats.updates.saturating_sub(1)) as f64 / self.stats.seconds;
        }
        (self.stats, self.last_atlas)
    }
}

impl<U: Updates> Served<U> {
    /// Sends what changes in the client's memory. A delta cannot be left out: what cannot be sent is the end. `clock` reads the
    /// server's.
    fn send_delta(
        &mut self,
        outlet: &dyn Outlet,
        peer: PeerId,
        shaded: Shaded,
        now_ns: i64,
        clock: impl Fn() -> ServerTime,
    ) -> Result<Update, Fault> {
        let number = shaded.update;
        let time = shaded.time;
        let (delta, update) = self.viewer.finish(shaded);
        let bytes = delta.bytes();
        // What is sent unreliably may be lost here as well.
        let _ = outlet.send(peer, clock_stamp(clock()));
        outlet.send(peer, delta).map_err(|error| unsent(&error))?;
        self.viewer.sent(number, Kind::Delta, bytes, now_ns);
        // What it shows first follows at once.
        if let Some(motion) = self.viewer.motion() {
            let due = lock(motion).tick(time, outlet.way(peer).as_ref());
            due.into_iter().try_for_each(|out| outlet.send(peer, out)).map_err(|error| unsent(&error))?;
        }
        Ok(update)
    }

    fn count(&mut self, sizes: DeltaSizes, now_ns: i64) {
        let stats = &mut self.stats;
        stats.updates += 1;
        stats.geometry_bytes += sizes.total_bytes as u64;
        let seconds = (now_ns - self.since_ns) as f64 * 1e-9;
        stats.server_fps = if seconds > 0.0 { stats.updates.saturating_sub(1) as f64 / seconds } else { 0.0 };
    }
}

fn nanoseconds(wait_ns: i64) -> Duration {
    Duration::from_nanos(wait_ns.max(0) as u64)
}

/// What the device did for an update, nanoseconds.
fn device_ns(shaded: &Shaded) -> i64 {
    shaded.timings.scopes().iter().map(|timing| timing.took_ns).sum()
}

fn unsent(error: &SendError) -> Fault {
    let reason = format!("an update's geometry could not be sent: {error}");
    Fault::Client(Refused::new(&reason, "connect again; over a slow link choose a smaller scene"))
}

fn device_lost() -> Refused {
    Refused::new("the server's graphics device was lost; it is being opened again", "wait a few seconds")
}

#[cfg(test)]
mod tests;
#[cfg(test)]
mod replay_tests;

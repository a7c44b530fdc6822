//! The pipeline's thread: updates for the clients that are served, each at a constant rate or as often as its link takes them.
//!
//! Whatever fails while one client's pipeline is made or run is that client's end, with a reason, and the server goes on.
//! Only a lost device stops all of it; then it is opened again from the top. Where the device is slower than all updates
//! together, who has had least of it is next.

use super::cadence::Cadence;
use super::encoder::{EncoderThread, Job, Outcome, refused_by};
use super::outlet::Outlet;
use super::rebuild::Rebuild;
use super::traced::{DeviceRow, Row, Traced};
use super::turns::{Share, Turns};
use super::{StreamStats, ViewerStats};
use crate::encode::{EncodeError, Encoder};
use crate::pacing::gate::Kind;
use crate::pacing::overlap::{Flight, Overlap, Step, StepTimes};
use crate::pacing::quality::QualityOptions;
use crate::serve::sessions::Say;
use crate::serve::sessions::mailbox::{Accepted, Client, Mailbox, News};
use crate::serve::viewer::{Update, Updates, Viewer};
use crate::support::lock::lock;
use crate::update::Shaded;
use anyhow::Context;
use shadecast_gpu::GpuError;
use shadecast_protocol::delta::DeltaSizes;
use shadecast_protocol::message::{Capabilities, Refused, Welcome};
use shadecast_protocol::session::clock_stamp;
use shadecast_protocol::time::ServerTime;
use shadecast_protocol::world_clock::Steering;
use shadecast_system::monotonic_now_ns;
use shadecast_transport::{PeerId, SendError};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Encoders that may fail one after the other, without a picture between them, before the session ends.
const MAX_ENCODER_FAILURES: u32 = 3;
/// How long the pipeline sleeps at least and at most before it looks again; news from the network wakes it.
const SHORTEST_WAIT_NS: i64 = 500_000;
const LONGEST_WAIT_NS: i64 = 5_000_000;
/// Clients that have gone whose figures are kept.
const MAX_VIEWERS_REMEMBERED: usize = 64;
/// How long it sleeps while nobody is served.
const IDLE_WAIT: Duration = Duration::from_millis(50);

/// What makes updates: the device and the scene on it.
pub trait Studio {
    /// What makes one client's updates.
    type Updates: Updates;
    /// For a client that has come.
    fn open(&mut self, welcome: &Welcome, capabilities: &Capabilities) -> Result<Self::Updates, GpuError>;
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
    fn close(&mut self, updates: Self::Updates, has_failed: bool);
    /// What is known of a client's pictures.
    fn account(&self, updates: &Self::Updates, stats: &mut ViewerStats);
    /// How finely pictures are quantised.
    fn quality(&self) -> QualityOptions;
    /// An encoder for the pictures of a session.
    fn encoder(&mut self, welcome: &Welcome) -> Result<Box<dyn Encoder>, EncodeError>;
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
    period_ns: i64,
    epoch_ns: i64,
    clients: BTreeMap<PeerId, Served<S::Updates>>,
    turns: Turns,
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

/// A client that is served. Its next update is made while the picture of the last one is encoded, so that the slower of the two
/// says how many there are.
struct Served<U> {
    viewer: Viewer<U>,
    welcome: Welcome,
    encoder: EncoderThread,
    encoder_failures: u32,
    overlap: Overlap,
    is_in_flight: bool,
    /// What the steps of updates took of the CPU since one was collected, nanoseconds.
    steps_ns: i64,
    /// An update that leaves when the picture before it has.
    made: Option<Shaded>,
    /// How long the last update's steps took in a row, and the encoder for the last picture, nanoseconds.
    update_ns: i64,
    encode_ns: i64,
    /// When the encoder is expected to be done.
    encoded_ns: i64,
    share: Share,
    stats: ViewerStats,
    since_ns: i64,
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

/// Makes a step, and tells the trace of it; that there was nothing to do is not told.
fn traced_step<T>(row: &Row, step: Step, make: impl FnOnce() -> T) -> T {
    let began_ns = monotonic_now_ns();
    let made = make();
    if step != Step::Wait {
        row.ended(step.name(), began_ns, None);
    }
    made
}

impl<'a, S: Studio> Pipeline<'a, S> {
    pub(super) fn new(
        studio: &'a mut S,
        outlet: Arc<dyn Outlet>,
        cadence: &'a Cadence,
        mailbox: &'a Mailbox,
        say: &'a Say<'a>,
        rate_hz: f64,
        traced: Traced,
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
            period_ns: (1e9 / rate_hz) as i64,
            epoch_ns,
            clients: BTreeMap::new(),
            turns: Turns::default(),
            rebuild: Rebuild::default(),
            reopen_ns: None,
            stats: StreamStats { epoch_monotonic_ns: epoch_ns, ..StreamStats::default() },
            first_ns: None,
            last_ns: 0,
            qp_sum: 0,
            last_atlas: None,
        }
    }

    /// Does what is due, one client's updates at most; gives how long nothing will be.
    ///
    /// # Errors
    /// The device is lost, and cannot be opened again.
    pub(super) fn step(&mut self, now_ns: i64) -> anyhow::Result<Duration> {
        if let Some(at_ns) = self.reopen_ns {
            if now_ns < at_ns {
                return Ok(Duration::from_nanos((at_ns - now_ns).min(LONGEST_WAIT_NS) as u64));
            }
            self.reopen(now_ns)?;
            if self.reopen_ns.is_some() {
                return Ok(Duration::from_nanos(LONGEST_WAIT_NS as u64));
            }
        }
        for (peer, news) in self.mailbox.take() {
            self.listen(peer, news, now_ns)?;
        }
        for peer in self.clients.keys().copied().collect::<Vec<_>>() {
            let looked = self.look_at_encoder(peer, now_ns).and_then(|()| self.hand_on(peer, now_ns));
            self.settle(peer, looked, now_ns)?;
        }
        if let Some(peer) = self.in_flight().or_else(|| self.next_to_serve(now_ns)) {
            let served = self.serve(peer, now_ns);
            self.settle(peer, served, now_ns)?;
        }
        if let Some(peer) = self.in_flight() {
            return self.rest(peer, now_ns);
        }
        let Some(due_ns) = self.clients.values().filter_map(|client| client.viewer.due_ns()).min() else {
            return Ok(IDLE_WAIT);
        };
        let wait_ns = (due_ns - now_ns).clamp(SHORTEST_WAIT_NS, LONGEST_WAIT_NS);
        Ok(Duration::from_nanos(wait_ns as u64))
    }

    /// Nothing is to be done until the device or the encoder has come further: gives how long there is still to sleep.
    fn rest(&mut self, peer: PeerId, now_ns: i64) -> anyhow::Result<Duration> {
        let [shortest, longest] =
            [SHORTEST_WAIT_NS, LONGEST_WAIT_NS].map(|wait_ns| Duration::from_nanos(wait_ns as u64));
        let Some(client) = self.clients.get(&peer) else { return Ok(shortest) };
        // The device wakes it; on one that is a CPU, each look beside it costs the device time.
        match self.studio.rest(client.viewer.updates(), longest) {
            Ok(has_rested) => Ok(if has_rested { Duration::ZERO } else { shortest }),
            Err(error) => {
                let fault = Fault::of(&error, "shading an update").in_update();
                self.settle(peer, Err(fault), now_ns)?;
                Ok(Duration::ZERO)
            }
        }
    }

    /// Takes what is new of a client; makes its pipeline where it has just come.
    fn listen(&mut self, peer: PeerId, News { client, told }: News, now_ns: i64) -> anyhow::Result<()> {
        match client {
            Client::Unchanged => {}
            Client::Gone => self.close(peer, false, now_ns),
            Client::Accepted(accepted) => {
                self.close(peer, false, now_ns);
                let accepted = self.accept(peer, *accepted, now_ns);
                self.settle(peer, accepted, now_ns)?;
            }
        }
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(()) };
        if let Some(report) = &told.displayed {
            self.of_pipeline.happens("display is known", Some(report.update));
        }
        let now = ServerTime(now_ns - self.epoch_ns);
        told.steering.into_iter().for_each(|wanted| self.studio.steer(wanted, now));
        let heard = guarded(|| {
            client.viewer.hear(told, now_ns);
            Ok(())
        });
        self.settle(peer, heard, now_ns)
    }

    fn accept(&mut self, peer: PeerId, accepted: Accepted, now_ns: i64) -> Result<(), Fault> {
        self.stats.clients += 1;
        let Accepted { welcome, capabilities, sender } = accepted;
        let encoder = guarded(|| self.start_encoder(peer, &welcome))?;
        let updates = guarded(|| {
            let updates = self.studio.open(&welcome, &capabilities);
            updates.map_err(|error| Fault::of(&error, "making the pipeline for this client"))
        })?;
        let quality = self.studio.quality().of_codec(welcome.codec);
        let viewer = Viewer::new(updates, sender, quality, self.period_ns, now_ns);
        viewer.motion().into_iter().for_each(|motion| self.cadence.join(peer, motion.clone()));
        self.clients.insert(
            peer,
            Served {
                viewer,
                welcome,
                encoder,
                encoder_failures: 0,
                overlap: Overlap::new(self.period_ns),
                is_in_flight: false,
                steps_ns: 0,
                made: None,
                update_ns: 0,
                encode_ns: 0,
                encoded_ns: now_ns,
                share: self.turns.join(),
                stats: ViewerStats { viewer: self.stats.clients, ..ViewerStats::default() },
                since_ns: now_ns,
            },
        );
        Ok(())
    }

    fn start_encoder(&mut self, peer: PeerId, welcome: &Welcome) -> Result<EncoderThread, Fault> {
        let encoder = self.studio.encoder(welcome).map_err(|error| Fault::of_encoder(&error.to_string()))?;
        EncoderThread::start(encoder, self.outlet.clone(), peer, self.traced.row("encoder"))
            .map_err(|error| Fault::of_encoder(&error.to_string()))
    }

    /// Of the clients whose update is due and would not have to wait for an encoder, and whose way is open, the one that has had
    /// least of the device; of equals the one that waits longest.
    fn next_to_serve(&mut self, now_ns: i64) -> Option<PeerId> {
        let mut next: Option<([i64; 2], PeerId)> = None;
        for (peer, client) in &mut self.clients {
            let Some(due_ns) = client.viewer.due_ns().filter(|due_ns| *due_ns <= now_ns) else { continue };
            if client.made.is_some() || client.would_wait(now_ns) {
                continue;
            }
            let is_open = client.viewer.is_open(self.outlet.way(*peer).as_ref(), now_ns);
            if let Some(shortfall) = client.viewer.shortfall(now_ns) {
                tracing::warn!("{shortfall}");
            }
            let order = [self.turns.order(client.share), due_ns];
            if is_open && next.is_none_or(|(least, _)| order < least) {
                next = Some((order, *peer));
            }
        }
        next.map(|(_, peer)| peer)
    }

    fn look_at_encoder(&mut self, peer: PeerId, now_ns: i64) -> Result<(), Fault> {
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(()) };
        match client.encoder.poll() {
            None => {}
            Some(Outcome::Sent { shaded, picture, unit_bytes }) => {
                client.encoder_failures = 0;
                client.encode_ns = (picture.encode_s * 1e9) as i64;
                client.viewer.sent_picture(shaded.update, picture, now_ns);
                client.stats.atlas_bytes += unit_bytes as u64;
                self.stats.atlas_bytes += unit_bytes as u64;
                if let Some(earlier) = self.last_atlas.replace(shaded) {
                    client.viewer.recycle(*earlier);
                }
            }
            Some(Outcome::Failed(reason)) => return self.restart_encoder(peer, &reason),
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
        }
        Ok(())
    }

    /// Whose updates are in flight: one client's at most, since those of others take the places of samples that they need.
    fn in_flight(&self) -> Option<PeerId> {
        self.clients.iter().find(|(_, client)| client.is_in_flight).map(|(peer, _)| *peer)
    }

    /// Whether a client's updates overlap: nobody else's come between.
    fn overlaps(&self, peer: PeerId) -> bool {
        self.clients.len() == 1 && self.clients.get(&peer).is_some_and(|client| client.overlap.is_on())
    }

    /// Makes all steps of a client's updates that need not wait for the device. Where updates do not overlap, the next one begins
    /// when the one before is made.
    fn serve(&mut self, peer: PeerId, now_ns: i64) -> Result<(), Fault> {
        let begun = Instant::now();
        let mut may_begin = self.in_flight().is_none();
        loop {
            let at_ns = now_ns + begun.elapsed().as_nanos() as i64;
            may_begin = (may_begin || self.overlaps(peer)) && self.next_to_serve(at_ns) == Some(peer);
            if self.advance(peer, may_begin, at_ns)? == Step::Wait {
                return Ok(());
            }
            may_begin = false;
        }
    }

    /// Makes the next step of a client's updates, if there is one that need not wait for the device; says which.
    fn advance(&mut self, peer: PeerId, may_begin: bool, now_ns: i64) -> Result<Step, Fault> {
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(Step::Wait) };
        let (studio, outlet, now) = (&mut *self.studio, &self.outlet, ServerTime(now_ns - self.epoch_ns));
        let begun = Instant::now();
        let made = guarded(|| {
            let fault = |error: GpuError| Fault::of(&error, "shading an update");
            let flight = studio.flight(client.viewer.updates()).map_err(fault)?;
            client.is_in_flight = flight.is_any();
            let step = client.next_step(flight, may_begin);
            let updates = match step {
                Step::Begin => client.viewer.begin(outlet.way(peer).as_ref(), now_ns),
                _ => client.viewer.updates_mut(),
            };
            Ok((
                step,
                traced_step(&self.of_steps, step, || studio.advance(updates, step, now)).map_err(fault)?,
            ))
        });
        let (step, shaded) = made.map_err(Fault::in_update)?;
        let took_ns = begun.elapsed().as_nanos() as i64;
        client.steps_ns += took_ns;
        if let Some(shaded) = shaded {
            let steps_ns = std::mem::take(&mut client.steps_ns);
            self.spent(peer, steps_ns + device_ns(&shaded));
            self.made(peer, shaded, steps_ns, now_ns + took_ns)?;
        }
        Ok(step)
    }

    /// The steps of a client's update took so long in a row.
    fn spent(&mut self, peer: PeerId, took_ns: i64) {
        let viewers = self.clients.len();
        let Some(client) = self.clients.get_mut(&peer) else { return };
        let took_s = took_ns as f64 * 1e-9;
        client.update_ns = took_ns;
        client.stats.busy_s += took_s;
        client.viewer.note_update(took_s * viewers as f64);
        self.turns.served(&mut client.share, took_ns);
    }

    /// An update is shaded; `steps_ns`: what it took of the CPU.
    fn made(&mut self, peer: PeerId, shaded: Shaded, steps_ns: i64, ended_ns: i64) -> Result<(), Fault> {
        let Some(client) = self.clients.get_mut(&peer) else { return Ok(()) };
        self.of_pipeline.ended("update", self.epoch_ns + shaded.time.0, Some(shaded.update));
        self.of_device.ended(&shaded.timings, shaded.update);
        self.stats.add_gpu(&shaded.timings);
        let (device_ns, encode_ns) = (device_ns(&shaded), client.encode_ns);
        client.overlap.note(StepTimes { device_ns, placement_ns: steps_ns, encode_ns });
        client.made = Some(shaded);
        self.hand_on(peer, ended_ns)
    }

    /// Sends what an update changes in the client's memory, and gives its picture to the encoder, once that has none.
    fn hand_on(&mut self, peer: PeerId, now_ns: i64) -> Result<(), Fault> {
        let Some(client) = self.clients.get_mut(&peer).filter(|client| !client.encoder.is_busy()) else {
            return Ok(());
        };
        let Some(shaded) = client.made.take() else { return Ok(()) };
        let (outlet, now, begun) = (&self.outlet, ServerTime(now_ns - self.epoch_ns), Instant::now());
        let clock = || now.plus_ns(begun.elapsed().as_nanos() as i64);
        let Update { shaded, sizes, refresh, qp } =
            guarded(|| client.send_delta(outlet.as_ref(), peer, shaded, now_ns, clock))?;
        client.stats.busy_s += begun.elapsed().as_secs_f64();
        client.count(sizes, now_ns);
        self.qp_sum += u64::from(qp);
        client.encoded_ns = now_ns + client.encode_ns;
        client.encoder.give(Job { shaded, refresh, qp });
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
                let others = self.clients.keys().copied().filter(|other| *other != peer);
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
        let Some(client) = self.clients.remove(&peer) else { return };
        self.cadence.leave(peer);
        let Served { viewer, mut stats, since_ns, encoder, .. } = client;
        drop(encoder);
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
        self.studio.close(updates, has_failed);
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
    /// Whether an update that is begun now would be made long before the encoder is done: its views would be older for it.
    fn would_wait(&self, now_ns: i64) -> bool {
        self.encoder.is_busy() && now_ns + self.update_ns < self.encoded_ns
    }

    /// The next step of its updates; one is collected when the one before has left.
    fn next_step(&self, mut flight: Flight, may_begin: bool) -> Step {
        flight.is_shaded &= self.made.is_none();
        self.overlap.step(flight, may_begin)
    }

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
        let frame = shaded.update;
        let time = shaded.time;
        let (delta, update) = self.viewer.finish(shaded);
        let bytes = delta.bytes();
        // What is sent unreliably may be lost here as well.
        let _ = outlet.send(peer, clock_stamp(clock()));
        outlet.send(peer, delta).map_err(|error| unsent(&error))?;
        self.viewer.sent(frame, Kind::Delta, bytes, now_ns);
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

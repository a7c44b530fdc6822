//! The pipeline's thread: updates for the client that is served, at a constant rate or as often as the link takes them.
//!
//! Whatever fails while one client's pipeline is made or run is that client's end, with a reason, and the server goes on.
//! Only a lost device stops all of it; then it is opened again from the top.

use super::encoder::{EncoderThread, Job, Outcome, words_of};
use super::mailbox::{Accepted, Client, Mailbox, News};
use super::rebuild::Rebuild;
use super::{Say, StreamStats};
use crate::encode::{EncodeError, Encoder};
use crate::frame::Shaded;
use crate::pacing::{Kind, UpdateGate, WayState};
use crate::residency::Budget;
use anyhow::Context;
use shadecast_gpu::GpuError;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::delta::DeltaSizes;
use shadecast_protocol::message::{Capabilities, Displayed, HeadState, Refused, Welcome};
use shadecast_protocol::session::{DeltaSender, Out};
use shadecast_protocol::time::ServerTime;
use shadecast_transport::{PeerId, SendError};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Duration;

/// Encoders that may fail one after the other, without a picture between them, before the session ends.
const MAX_ENCODER_FAILURES: u32 = 3;
/// How long the pipeline sleeps at least and at most before it looks again; news from the network wakes it.
const SHORTEST_WAIT_NS: i64 = 500_000;
const LONGEST_WAIT_NS: i64 = 5_000_000;
/// How long it sleeps while nobody is served.
const IDLE_WAIT: Duration = Duration::from_millis(50);

/// The way to the clients.
pub trait Outlet: Send + Sync {
    /// Sends a stream.
    fn send(&self, peer: PeerId, out: Out) -> Result<(), SendError>;
    /// What is known of the way to a client; `None` where nothing is yet.
    fn way(&self, peer: PeerId) -> Option<WayState>;
    /// Ends a session; the client learns why.
    fn refuse(&self, peer: PeerId, refused: Refused);
}

/// What makes one client's updates.
pub trait Updates {
    /// The client's head.
    fn head(&mut self, state: HeadState);
    /// What the client shows.
    fn displayed(&mut self, report: &Displayed);
    /// Updates pause, or go on after a pause.
    fn interrupted(&mut self);
    /// What the next update may take on the wire.
    fn set_budget(&mut self, budget: Budget);
    /// The next update; `None` before the first head state.
    fn update(&mut self, now: ServerTime) -> Result<Option<Shaded>, GpuError>;
    /// Adds what it knows to the figures of the run.
    fn account(&self, stats: &mut StreamStats);
}

/// What makes pipelines: the device and the scene on it.
pub trait Studio {
    /// The pipeline of a client.
    fn updates(
        &mut self,
        welcome: &Welcome,
        capabilities: &Capabilities,
    ) -> Result<Box<dyn Updates>, GpuError>;
    /// An encoder for pictures of an extent.
    fn encoder(&mut self, extent_texels: AtlasExtent) -> Result<Box<dyn Encoder>, EncodeError>;
    /// Milliseconds that each stage of the finished updates took on the device, since the last call.
    fn take_timings_ms(&mut self) -> Vec<(&'static str, f64)>;
    /// Opens the device again, after it was lost, and brings the scene to it.
    fn reopen(&mut self) -> anyhow::Result<()>;
}

/// Bytes of what is sent.
pub(super) fn bytes_of(out: &Out) -> usize {
    match out {
        Out::Control(bytes) | Out::Datagram(bytes) | Out::Stream { bytes, .. } => bytes.len(),
    }
}

/// Updates for whoever is served.
pub(super) struct Pipeline<'a> {
    studio: &'a mut dyn Studio,
    outlet: Arc<dyn Outlet>,
    mailbox: &'a Mailbox,
    say: &'a Say<'a>,
    period_ns: i64,
    epoch_ns: i64,
    client: Option<Served>,
    rebuild: Rebuild,
    /// When the device is opened again; `None` while it is open.
    reopen_ns: Option<i64>,
    stats: StreamStats,
    first_ns: Option<i64>,
    last_ns: i64,
    last_atlas: Option<Box<Shaded>>,
}

/// The client that is served.
struct Served {
    peer: PeerId,
    updates: Box<dyn Updates>,
    sender: DeltaSender,
    extent_texels: AtlasExtent,
    encoder: EncoderThread,
    encoder_failures: u32,
    gate: UpdateGate,
    refresh: bool,
    /// False while nobody looks: nothing is shaded then.
    is_watched: bool,
    due_ns: i64,
}

/// What ends a client's session.
enum Fault {
    /// Its own: it is told, and the server goes on.
    Client(Refused),
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

    fn of_panic(panic: &(dyn std::any::Any + Send)) -> Self {
        Self::Client(Refused::new(
            &words_of(panic),
            "connect again; if it stays so, report it with the server's log",
        ))
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

impl<'a> Pipeline<'a> {
    pub(super) fn new(
        studio: &'a mut dyn Studio,
        outlet: Arc<dyn Outlet>,
        mailbox: &'a Mailbox,
        say: &'a Say<'a>,
        rate_hz: f64,
        epoch_ns: i64,
    ) -> Self {
        Self {
            studio,
            outlet,
            mailbox,
            say,
            period_ns: (1e9 / rate_hz) as i64,
            epoch_ns,
            client: None,
            rebuild: Rebuild::default(),
            reopen_ns: None,
            stats: StreamStats { epoch_monotonic_ns: epoch_ns, ..StreamStats::default() },
            first_ns: None,
            last_ns: 0,
            last_atlas: None,
        }
    }

    /// Does what is due; gives how long nothing will be.
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
        let worked = self.listen(now_ns).and_then(|()| self.serve(now_ns));
        if let Err(fault) = worked {
            self.end(fault, now_ns)?;
        }
        let Some(client) = self.client.as_ref().filter(|client| client.is_watched) else {
            return Ok(IDLE_WAIT);
        };
        let wait_ns = (client.due_ns - now_ns).clamp(SHORTEST_WAIT_NS, LONGEST_WAIT_NS);
        Ok(Duration::from_nanos(wait_ns as u64))
    }

    /// Takes what is new, then makes a pipeline for the client that is there now, if it is another one.
    fn listen(&mut self, now_ns: i64) -> Result<(), Fault> {
        let News { client, pose, displayed, refresh, watching } = self.mailbox.take();
        match client {
            Client::Unchanged => {}
            Client::Gone => self.client = None,
            Client::Accepted(accepted) => {
                self.client = None; // its memory goes before the next one's is asked for
                self.accept(*accepted, now_ns)?;
            }
        }
        let Some(client) = &mut self.client else { return Ok(()) };
        guarded(|| {
            pose.into_iter().for_each(|pose| client.updates.head(pose));
            displayed.iter().for_each(|report| client.updates.displayed(report));
            client.refresh |= refresh;
            watching.into_iter().for_each(|is_watched| client.watch(is_watched, now_ns));
            Ok(())
        })
    }

    fn accept(&mut self, accepted: Accepted, now_ns: i64) -> Result<(), Fault> {
        self.stats.clients += 1;
        let Accepted { peer, welcome, capabilities, sender } = accepted;
        let extent_texels = welcome.atlas_extent_texels;
        let made = guarded(|| {
            let updates = self.studio.updates(&welcome, &capabilities);
            let updates =
                updates.map_err(|error| Fault::of(&error, "making the pipeline for this client"))?;
            Ok((updates, self.start_encoder(peer, extent_texels)?))
        });
        match made {
            Ok((updates, encoder)) => {
                self.client = Some(Served {
                    peer,
                    updates,
                    sender,
                    extent_texels,
                    encoder,
                    encoder_failures: 0,
                    gate: UpdateGate::new(self.period_ns),
                    refresh: false,
                    is_watched: true,
                    due_ns: now_ns,
                });
                Ok(())
            }
            Err(Fault::Client(refused)) => {
                tracing::warn!("a client is refused: {}", refused.reason);
                self.outlet.refuse(peer, refused);
                self.stats.refused += 1;
                Ok(())
            }
            Err(lost) => {
                self.outlet.refuse(peer, device_lost());
                Err(lost)
            }
        }
    }

    fn start_encoder(&mut self, peer: PeerId, extent_texels: AtlasExtent) -> Result<EncoderThread, Fault> {
        let encoder =
            self.studio.encoder(extent_texels).map_err(|error| Fault::of_encoder(&error.to_string()))?;
        EncoderThread::start(encoder, self.outlet.clone(), peer)
            .map_err(|error| Fault::of_encoder(&error.to_string()))
    }

    /// Does what the client's picture and the time ask for.
    fn serve(&mut self, now_ns: i64) -> Result<(), Fault> {
        self.look_at_encoder(now_ns)?;
        let Some(client) = &mut self.client else { return Ok(()) };
        if !client.is_watched || now_ns < client.due_ns || client.encoder.is_busy() {
            return Ok(());
        }
        let way = self.outlet.way(client.peer);
        let may_update = way.is_none_or(|way| client.gate.may_update(&way, now_ns));
        if let Some(shortfall) = client.gate.shortfall(now_ns) {
            tracing::warn!("{shortfall}");
        }
        if !may_update {
            return Ok(());
        }
        // A late update does not make the next ones hurry.
        client.due_ns = (client.due_ns + self.period_ns).max(now_ns - self.period_ns);
        self.update(now_ns)
    }

    fn look_at_encoder(&mut self, now_ns: i64) -> Result<(), Fault> {
        let Some(client) = &mut self.client else { return Ok(()) };
        match client.encoder.poll() {
            None => {}
            Some(Outcome::Sent { shaded, stream_bytes, unit_bytes }) => {
                client.encoder_failures = 0;
                client.gate.sent(shaded.frame, Kind::Picture, stream_bytes, now_ns);
                self.stats.atlas_bytes += unit_bytes as u64;
                self.last_atlas = Some(shaded);
            }
            Some(Outcome::Failed(reason)) => return self.restart_encoder(&reason),
        }
        Ok(())
    }

    /// A fresh encoder, whose first picture needs no other; not again and again.
    fn restart_encoder(&mut self, reason: &str) -> Result<(), Fault> {
        let Some(client) = &mut self.client else { return Ok(()) };
        tracing::error!("the encoder is started anew: {reason}");
        self.stats.encoder_restarts += 1;
        client.encoder_failures += 1;
        if client.encoder_failures > MAX_ENCODER_FAILURES {
            return Err(Fault::of_encoder(reason));
        }
        let (peer, extent_texels) = (client.peer, client.extent_texels);
        let encoder = guarded(|| self.start_encoder(peer, extent_texels))?;
        if let Some(client) = &mut self.client {
            (client.encoder, client.refresh) = (encoder, true);
        }
        Ok(())
    }

    fn update(&mut self, now_ns: i64) -> Result<(), Fault> {
        let Some(client) = &mut self.client else { return Ok(()) };
        let (outlet, now) = (&self.outlet, ServerTime(now_ns - self.epoch_ns));
        let made = guarded(|| {
            client.updates.set_budget(client.gate.budget(now_ns));
            let shaded =
                client.updates.update(now).map_err(|error| Fault::of(&error, "shading an update"))?;
            shaded.map(|shaded| client.send_delta(outlet.as_ref(), shaded, now_ns)).transpose()
        })?;
        let Some((shaded, sizes)) = made else { return Ok(()) };
        client.updates.account(&mut self.stats);
        client.encoder.give(Job { shaded: Box::new(shaded), refresh: std::mem::take(&mut client.refresh) });
        self.count(sizes, now_ns);
        Ok(())
    }

    fn count(&mut self, sizes: DeltaSizes, now_ns: i64) {
        self.stats.geometry_bytes += sizes.total_bytes as u64;
        self.stats.sample_bytes += sizes.sample_bytes as u64;
        self.stats.samples += sizes.samples as u64;
        self.stats.updates += 1;
        if self.stats.updates == 1 {
            (self.say)("First update sent");
        }
        self.first_ns.get_or_insert(now_ns);
        self.last_ns = now_ns;
        for (scope, ms) in self.studio.take_timings_ms() {
            *self.stats.gpu_ms.entry(scope.to_owned()).or_default() += ms;
        }
    }

    /// Ends the client's session, and everything on the device where that is lost.
    fn end(&mut self, fault: Fault, now_ns: i64) -> anyhow::Result<()> {
        let peer = self.client.take().map(|client| client.peer);
        let refused = match fault {
            Fault::Client(refused) => {
                tracing::warn!("a session ends: {}", refused.reason);
                self.stats.refused += 1;
                refused
            }
            Fault::Lost(reason) => {
                self.lost(&reason, now_ns)?;
                device_lost()
            }
        };
        peer.into_iter().for_each(|peer| self.outlet.refuse(peer, refused.clone()));
        Ok(())
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
        self.client = None;
        self.last_atlas = None;
        match self.studio.reopen() {
            Ok(()) => {
                tracing::warn!("the device is open again");
                self.stats.devices_lost += 1;
                self.rebuild.succeeded(now_ns);
                self.reopen_ns = None;
                Ok(())
            }
            Err(error) => self.lost(&format!("opening the device again: {error:#}"), now_ns),
        }
    }

    /// The figures of the run, and the last picture.
    pub(super) fn finish(mut self) -> (StreamStats, Option<Box<Shaded>>) {
        self.client = None;
        let updates = self.stats.updates.max(1) as f64;
        self.stats.gpu_ms.values_mut().for_each(|ms| *ms /= updates);
        self.stats.seconds = (self.last_ns - self.first_ns.unwrap_or(self.last_ns)) as f64 * 1e-9;
        if self.stats.seconds > 0.0 {
            self.stats.server_fps = (self.stats.updates.saturating_sub(1)) as f64 / self.stats.seconds;
        }
        (self.stats, self.last_atlas)
    }
}

impl Served {
    /// Nothing is shaded for nobody; when somebody looks again, updates begin at once, with a picture that needs no other.
    fn watch(&mut self, is_watched: bool, now_ns: i64) {
        if std::mem::replace(&mut self.is_watched, is_watched) != is_watched {
            self.updates.interrupted();
            self.refresh |= is_watched;
            self.due_ns = now_ns;
        }
    }

    /// Encodes and sends what changes in the client's memory. A delta cannot be left out: what cannot be sent is the end.
    fn send_delta(
        &mut self,
        outlet: &dyn Outlet,
        shaded: Shaded,
        now_ns: i64,
    ) -> Result<(Shaded, DeltaSizes), Fault> {
        let remedy = "connect again; over a slow link choose a smaller scene";
        let fault = |error: &dyn std::fmt::Display| {
            Fault::Client(Refused::new(&format!("an update's geometry could not be sent: {error}"), remedy))
        };
        let (out, sizes) = self.sender.delta_stream(&shaded.delta).map_err(|error| fault(&error))?;
        let bytes = bytes_of(&out);
        outlet.send(self.peer, out).map_err(|error| fault(&error))?;
        self.gate.sent(shaded.frame, Kind::Delta, bytes, now_ns);
        Ok((shaded, sizes))
    }
}

fn device_lost() -> Refused {
    Refused::new("the server's graphics device was lost; it is being opened again", "wait a few seconds")
}

#[cfg(test)]
#[path = "pipeline_tests.rs"]
mod tests;

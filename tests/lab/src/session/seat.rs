//! The server's side of one viewer on the virtual clock: the product's [`Viewer`], and what is on its way out.

use super::originals::Originals;
use super::residents::Residents;
use super::{SERVER_EPOCH_NS, Server};
use anyhow::{Context, bail};
use shadecast_protocol::delta::{DeltaSizes, Part, PartBytes};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::Codec;
use shadecast_protocol::session::{Out, clock_stamp, picture_stream};
use shadecast_protocol::time::ServerTime;
use shadecast_protocol::wire::PictureHeader;
use shadecast_server::encode;
use shadecast_server::encode::openh264::EncoderSettings;
use shadecast_server::motion::sender::MotionBytes;
use shadecast_server::pacing::gate::Kind;
use shadecast_server::pacing::overlap::Step;
use shadecast_server::pacing::quality::SentPicture;
use shadecast_server::pacing::share::WayState;
use shadecast_server::serve::cause_bits::{CauseBits, Ledger};
use shadecast_server::serve::encoding::{Coded, Encoding};
use shadecast_server::serve::sessions::mailbox::{Accepted, Client, News};
use shadecast_server::serve::viewer::{Update, Viewer};
use shadecast_server::support::lock::lock;
use shadecast_server::update::{Shaded, Shows, ViewerUpdates};
use shadecast_server::world::ViewerId;
use shadecast_trace::{Process, Trace, Track};
use shadecast_transport::{Event, PeerId};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// What crossed from server to client.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sent {
    /// Updates made.
    pub updates: u64,
    /// Pictures that need no other.
    pub refreshes: u64,
    /// Quantisers of all pictures, summed.
    pub qp_sum: u64,
    /// Texels that were asked for a pixel, summed over updates.
    pub texels_per_pixel_sum: f64,
    /// Texels of all blocks, and of those that were shaded, summed over updates.
    pub texels: [u64; 2],
    /// Bytes of access units.
    pub atlas_bytes: u64,
    /// Where their bits went; what was coded in a way that is not read is not among them.
    pub bits: CauseBits,
    /// Bytes of geometry deltas.
    pub geometry_bytes: u64,
    /// The same by part.
    pub geometry_parts: PartBytes,
    /// Vertices that entered.
    pub new_vertices: u64,
    /// Bytes of vertices that enter and leave in them.
    pub vertex_bytes: u64,
    /// Bytes of skeletons, meshes and instances in them.
    pub skeleton_bytes: u64,
    /// Bytes of vertices before skinning in them.
    pub rest_bytes: u64,
    /// Bytes of patches that enter and leave in them.
    pub patch_bytes: u64,
    /// Bytes of predictions in them.
    pub prediction_bytes: u64,
    /// Bytes of placements in them.
    pub placement_bytes: u64,
    /// Bytes of motion beside deltas.
    pub motion: MotionBytes,
    /// Updates that were not made because the link was behind.
    pub withheld: u64,
    /// Triangles that updates show, summed over them.
    pub triangles: u64,
    /// Levels of detail of the instances that updates needed, summed over both, and how many those are.
    pub lods: [u64; 2],
}

impl Sent {
    /// Bytes of geometry deltas by part, and of motion beside them, less those of `before`; together they are all that `geometry` of
    /// [`crate::report::stats::MbitPerS`] counts.
    pub fn geometry_since(&self, before: &Self) -> impl Iterator<Item = (&'static str, u64)> {
        let (now, then) = (self.geometry_parts, before.geometry_parts);
        let parts = Part::ALL.into_iter().map(move |part| (part.name(), now.of(part) - then.of(part)));
        parts.chain([("motion", self.motion.total() - before.motion.total())])
    }
}

/// See the module.
pub struct Seat {
    /// The client, once it was accepted.
    pub viewer: Option<Viewer<ViewerUpdates>>,
    /// What was sent to it.
    pub sent: Sent,
    /// Milliseconds by GPU stage, summed over its updates.
    pub gpu_ms: BTreeMap<&'static str, f64>,
    /// The last update's planes and their extent, for the atlas picture.
    pub last: Option<Box<Shaded>>,
    /// What each update shows, by its number.
    pub shows: Vec<Shows>,
    /// Who was in the client's memory at which update.
    pub residents: Residents,
    /// Which link it is on.
    line: usize,
    /// What goes out beside the session.
    streams: VecDeque<Out>,
    encoding: Option<Encoding>,
    ledger: Option<Ledger>,
    /// Who is connected.
    pub(super) peer: Option<PeerId>,
    /// Who is served, by its name among the clients of all links.
    served: Option<PeerId>,
    /// A shaded update that leaves when the picture before it has.
    made: Option<Shaded>,
    leaving: VecDeque<Leaving>,
    number: u64,
    /// From then on an update that the link holds back counts again.
    withheld_ns: i64,
    period_ns: i64,
    /// Bytes of motion to those who were served before.
    motion_before: MotionBytes,
    /// How long the encoder takes for a picture.
    encode_ns: i64,
    originals: Originals,
    /// Where a trace is asked for.
    pub(super) rows: Option<Rows>,
}

/// What the server does, in a trace.
pub(super) struct Rows {
    updates: Track,
    encoder: Track,
}

impl Rows {
    pub(super) fn new(trace: &Trace) -> Self {
        let row = |name| trace.track(Process::Server, name);
        Self { updates: row("updates"), encoder: row("encoder") }
    }
}

fn server_time(now_ns: i64) -> ServerTime {
    ServerTime(now_ns - SERVER_EPOCH_NS)
}

/// A picture that leaves when it is encoded.
struct Leaving {
    at_ns: i64,
    /// The viewer that it is for.
    viewer: u64,
    header: PictureHeader,
    bytes: Vec<u8>,
}

impl Seat {
    /// Of the link of this number, before anybody is served.
    pub(super) fn new(server: &Server, line: usize) -> Self {
        Self {
            viewer: None,
            sent: Sent::default(),
            gpu_ms: BTreeMap::new(),
            last: None,
            shows: Vec::new(),
            residents: Residents::default(),
            line,
            streams: VecDeque::new(),
            encoding: None,
            ledger: None,
            peer: None,
            served: None,
            made: None,
            leaving: VecDeque::new(),
            number: 0,
            withheld_ns: 0,
            period_ns: server.period_ns(),
            motion_before: MotionBytes::default(),
            encode_ns: 0,
            originals: Originals::new(server.spared.arrival),
            rows: None,
        }
    }

    /// Takes an event of the server's end of the link, and does what comes of it.
    ///
    /// # Errors
    /// The server has sent the client away.
    pub(super) fn take(&mut self, server: &mut Server, event: Event, now_ns: i64) -> anyhow::Result<()> {
        match event {
            Event::Connected { peer, .. } => {
                // Whoever was there before has gone, though the server may not have noticed.
                self.part(server);
                self.peer = Some(peer);
                self.streams.clear();
            }
            Event::Closed { peer, .. } if self.peer == Some(peer) => self.peer = None,
            _ => {}
        }
        server.reception.take(self.line, event, now_ns);
        for (peer, News { client, reported }) in server.reception.news_of(self.line) {
            match client {
                Client::Unchanged => {}
                Client::Gone if self.served == Some(peer) => self.part(server),
                Client::Gone => {}
                Client::Accepted(accepted) => {
                    self.part(server);
                    self.accept(server, peer, *accepted, now_ns)?;
                }
            }
            if let Some(viewer) = self.viewer.as_mut().filter(|_| self.served == Some(peer)) {
                if let Some(wanted) = reported.steering {
                    server.world.timeline().lock().steer(wanted, server_time(now_ns));
                }
                viewer.apply(reported);
                server.scheduler.watch(peer, viewer.wants_updates(), now_ns);
            }
        }
        match server.reception.ended(self.line) {
            Some(reason) => bail!("the server has ended the session: {reason}"),
            None => Ok(()),
        }
    }

    /// The server forgets everything.
    pub(super) fn vanish(&mut self, server: &mut Server) {
        self.part(server);
        self.peer = None;
        self.streams.clear();
        self.leaving.clear();
    }

    /// Nobody is served any more.
    fn part(&mut self, server: &mut Server) {
        self.made = None;
        if let Some(peer) = self.served.take() {
            server.scheduler.leave(peer);
            server.device.leave(peer);
        }
        if let Some(viewer) = self.viewer.take() {
            viewer.into_updates().leave(&mut server.world);
        }
    }

    fn accept(
        &mut self,
        server: &mut Server,
        peer: PeerId,
        accepted: Accepted,
        now_ns: i64,
    ) -> anyhow::Result<()> {
        let Accepted { welcome, capabilities, sender } = accepted;
        self.number = server.next_viewer();
        self.motion_before = self.sent.motion;
        let first_qp = server.quality.first_qp();
        let settings = EncoderSettings::for_stream(welcome.atlas_extent_texels, first_qp, server.rate_hz);
        let encoder = match welcome.codec {
            Codec::H264 => server.encoders.encoder(settings)?,
            codec => encode::encoder(codec, settings)?,
        };
        self.encoding = Some(Encoding::new(encoder));
        self.ledger = (welcome.codec == Codec::H264).then(Ledger::default);
        let mut updates = ViewerUpdates::with_policy(
            &server.world,
            ViewerId(self.number),
            &welcome,
            &capabilities,
            server.show,
            server.spared.policy.clone(),
        )?;
        server.shade_texels.into_iter().for_each(|texels| updates.set_shading_budget(texels));
        updates.note_update(server.update_ns());
        let quality = server.quality.of_codec(welcome.codec);
        self.viewer = Some(Viewer::new(updates, sender, quality, server.period_ns()));
        self.served = Some(peer);
        self.encode_ns = server.stages.ns(server.stages.encode);
        server.scheduler.join(peer, now_ns);
        server.schedule.joined.push((now_ns, self.line));
        Ok(())
    }

    /// Motion at its own cadence: it waits for no update, and leaves at once.
    pub(super) fn motion(&mut self, server: &mut Server, way: Option<WayState>, now_ns: i64) {
        let Some(motion) = self.viewer.as_ref().and_then(Viewer::motion) else { return };
        let mut sender = lock(motion);
        let began = server.world.effort().begin();
        self.streams.extend(sender.tick(server_time(now_ns), way.as_ref()));
        server.world.effort_mut().add_delta(began);
        self.sent.motion = self.motion_before + sender.bytes();
    }

    /// Whether the link takes another update.
    pub(super) fn is_open(&mut self, way: Option<WayState>, now_ns: i64) -> bool {
        let Some(viewer) = &mut self.viewer else { return false };
        let is_open = viewer.is_open(way.as_ref(), now_ns);
        if let Some(shortfall) = viewer.shortfall(now_ns) {
            tracing::warn!("{shortfall}");
        }
        if !is_open && now_ns >= self.withheld_ns {
            self.sent.withheld += 1;
            self.withheld_ns = now_ns + self.period_ns;
        }
        is_open
    }

    /// Makes a step of its updates. `way`: that to the client.
    pub(super) fn make(
        &mut self,
        server: &mut Server,
        way: Option<WayState>,
        step: Step,
        now_ns: i64,
    ) -> anyhow::Result<()> {
        let (Some(viewer), Some(peer)) = (&mut self.viewer, self.served) else { return Ok(()) };
        let world = &mut server.world;
        let (mut is_made, mut shaded) = (true, None);
        match step {
            Step::Begin => is_made = viewer.begin(way.as_ref(), now_ns).begin(world, server_time(now_ns))?,
            Step::Place => viewer.updates_mut().place(world)?,
            Step::Shade => viewer.updates_mut().shade(world)?,
            Step::Collect => shaded = viewer.updates_mut().collect(world)?,
            Step::Wait => {}
        }
        let cpu_ns = if is_made { server.device.made(peer, step, now_ns) } else { 0 };
        if !is_made {
            server.schedule.headless.push((now_ns, self.line));
        }
        let device_ns = shaded.as_ref().map(|_| server.device.update_ns());
        let cost = server.scheduler.completed((peer, step), cpu_ns, device_ns, now_ns);
        if let (Some(cost), Some(shaded)) = (cost, shaded) {
            viewer.note_update(cost.shared_s(), cost.apart_s());
            self.collected(server, shaded, now_ns)?;
        }
        Ok(())
    }

    /// An update is shaded: it is counted, and leaves when the scheduler says so.
    fn collected(&mut self, server: &mut Server, shaded: Shaded, now_ns: i64) -> anyhow::Result<()> {
        let Some(updates) = self.viewer.as_ref().map(Viewer::updates) else { return Ok(()) };
        self.originals.keep(&server.gpu, updates, &shaded)?;
        self.sent.updates += 1;
        shaded.timings.iter().for_each(|(stage, ms)| *self.gpu_ms.entry(stage).or_default() += ms);
        self.residents.note(shaded.update, updates.residency());
        let shows = updates.shows(&server.world);
        self.sent.triangles += u64::from(shows.triangles);
        self.sent.texels_per_pixel_sum += f64::from(shows.texels_per_pixel);
        self.sent.texels[0] += shows.reused.texels;
        self.sent.texels[1] += shows.reused.shaded_texels;
        self.sent.lods[0] += shows.lods.iter().sum::<usize>() as u64;
        self.sent.lods[1] += shows.lods.len() as u64;
        self.shows.resize(shaded.update.0 as usize, Shows::default());
        self.shows.push(shows);
        if let Some(rows) = &self.rows {
            rows.updates.span("update", [shaded.time, server_time(now_ns)], Some(shaded.update));
        }
        self.made = Some(shaded);
        Ok(())
    }

    /// The delta of its shaded update leaves, the picture goes to the encoder.
    pub(super) fn hand_over(
        &mut self,
        server: &mut Server,
        way: Option<WayState>,
        now_ns: i64,
    ) -> anyhow::Result<()> {
        let (Some(viewer), Some(shaded)) = (&mut self.viewer, self.made.take()) else { return Ok(()) };
        let began = server.world.effort().begin();
        let (delta, update) = viewer.finish(shaded);
        server.world.effort_mut().add_delta(began);
        self.count(update.sizes);
        self.streams.push_back(clock_stamp(server_time(now_ns)));
        self.send(update.shaded.update, Kind::Delta, delta, now_ns);
        self.motion(server, way, now_ns);
        self.served.into_iter().for_each(|peer| server.scheduler.handed_over(peer, now_ns));
        self.encode(update, now_ns + self.encode_ns)
    }

    /// Hands a picture to the encoder; what it has then leaves at `done_ns`.
    fn encode(&mut self, update: Update, done_ns: i64) -> anyhow::Result<()> {
        let encoding = self.encoding.as_mut().context("an encoder comes with the viewer")?;
        self.sent.qp_sum += u64::from(update.qp);
        encoding.submit(update.shaded, update.refresh, update.qp)?;
        while let Some(coded) = self.encoding.as_mut().and_then(|encoding| encoding.poll(Duration::ZERO)) {
            let Coded { shaded, header, unit } = coded?;
            self.sent.atlas_bytes += unit.bytes.len() as u64;
            let bits = self.ledger.as_mut().map(|ledger| ledger.divide(&unit, &shaded.blocks)).transpose()?;
            self.sent.bits = self.sent.bits + bits.unwrap_or_default();
            if let Some(rows) = &self.rows {
                let times = [done_ns - self.encode_ns, done_ns].map(server_time);
                rows.encoder.span("encode", times, Some(header.update));
                let named = bits.unwrap_or_default().named().map(|(name, bits)| (name, bits as f64));
                rows.encoder.counters("bits by cause", times[1], &named);
            }
            self.leave(Leaving { at_ns: done_ns, viewer: self.number, header, bytes: unit.bytes });
            let earlier = self.last.replace(shaded);
            if let Some((viewer, earlier)) = self.viewer.as_mut().zip(earlier) {
                viewer.recycle(*earlier);
            }
        }
        Ok(())
    }

    fn leave(&mut self, leaving: Leaving) {
        let place = self.leaving.partition_point(|other| other.at_ns <= leaving.at_ns);
        self.leaving.insert(place, leaving);
    }

    /// When something leaves next.
    pub(super) fn next_departure_ns(&self) -> Option<i64> {
        self.leaving.front().map(|leaving| leaving.at_ns)
    }

    /// A picture that is encoded leaves; one for a viewer that has left is dropped.
    pub(super) fn depart(&mut self, server: &mut Server, now_ns: i64) -> anyhow::Result<()> {
        let next = self.leaving.pop_front().filter(|leaving| leaving.viewer == self.number);
        let Some(Leaving { header, bytes, .. }) = next else { return Ok(()) };
        self.served.into_iter().for_each(|peer| server.scheduler.encoded(peer, Some(self.encode_ns)));
        self.send_picture(header, picture_stream(header, &bytes)?, now_ns);
        Ok(())
    }

    fn send(&mut self, update: UpdateId, kind: Kind, out: Out, now_ns: i64) {
        let Some(viewer) = &mut self.viewer else { return };
        viewer.sent(update, kind, out.bytes(), now_ns);
        self.streams.push_back(out);
    }

    fn send_picture(&mut self, header: PictureHeader, out: Out, now_ns: i64) {
        let Some(viewer) = &mut self.viewer else { return };
        let encode_s = self.encode_ns as f64 * 1e-9;
        self.sent.refreshes += u64::from(header.is_refresh);
        let picture = SentPicture { stream_bytes: out.bytes(), is_refresh: header.is_refresh, encode_s };
        viewer.sent_picture(header.update, picture, now_ns);
        self.streams.push_back(out);
    }

    fn count(&mut self, sizes: DeltaSizes) {
        self.sent.geometry_bytes += sizes.total_bytes as u64;
        self.sent.geometry_parts += sizes.parts;
        self.sent.new_vertices += sizes.new_vertices as u64;
        self.sent.vertex_bytes += sizes.vertex_bytes as u64;
        self.sent.skeleton_bytes += sizes.skeleton_bytes as u64;
        self.sent.rest_bytes += sizes.rest_bytes as u64;
        self.sent.patch_bytes += sizes.patch_bytes as u64;
        self.sent.placement_bytes += sizes.placement_bytes as u64;
        self.sent.prediction_bytes += sizes.prediction_bytes as u64;
    }

    /// An event of the client's end of the link, with the picture that was coded in the place of a coded one where the run
    /// is spared coding.
    pub(super) fn with_original(&mut self, event: Event) -> Event {
        match event {
            Event::Stream { peer, bytes, at_ns } => {
                let original = self.originals.of_stream(&bytes);
                Event::Stream { peer, bytes: original.map_or(bytes, Into::into), at_ns }
            }
            other => other,
        }
    }

    /// Bytes to carry.
    pub(super) fn poll_out(&mut self, server: &mut Server) -> Option<Out> {
        server.reception.poll_out(self.line).or_else(|| self.streams.pop_front())
    }

    /// Vertices that move, in the client's memory.
    pub fn moving_vertices(&self) -> usize {
        self.viewer.as_ref().map_or(0, |viewer| viewer.updates().residency().moving_count())
    }

    /// Patches that were visible but had no room, in the atlas or in the client's memory.
    pub fn dropped_patches(&self) -> u64 {
        self.viewer.as_ref().map_or(0, |viewer| viewer.updates().dropped_patches())
    }
}

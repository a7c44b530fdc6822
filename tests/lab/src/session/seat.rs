//! The server's side of one viewer on the virtual clock: the product's [`Sessions`] and [`Viewer`], and what is on its way out.

use super::options::StageMs;
use super::originals::Originals;
use super::residents::Residents;
use super::steps::Steps;
use super::{SERVER_EPOCH_NS, Server};
use anyhow::{Context, bail};
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::delta::DeltaSizes;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::ServerOffer;
use shadecast_protocol::session::{Out, clock_stamp, picture_stream};
use shadecast_protocol::time::ServerTime;
use shadecast_protocol::wire::PictureHeader;
use shadecast_server::encode;
use shadecast_server::encode::openh264::EncoderSettings;
use shadecast_server::motion::sender::MotionBytes;
use shadecast_server::pacing::gate::{Kind, WayState};
use shadecast_server::pacing::overlap::Step;
use shadecast_server::pacing::quality::SentPicture;
use shadecast_server::serve::encoding::{Coded, Encoding};
use shadecast_server::serve::sessions::mailbox::{Accepted, Client, Mailbox, News};
use shadecast_server::serve::sessions::{Carrier, Sessions, Surroundings, Verdicts};
use shadecast_server::serve::viewer::{Update, Viewer};
use shadecast_server::support::lock::lock;
use shadecast_server::update::{Shaded, Shows, ViewerUpdates};
use shadecast_server::world::ViewerId;
use shadecast_trace::{Process, Trace, Track};
use shadecast_transport::{Event, PeerId, SendError};
use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// What crossed from server to client.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sent {
    /// Updates made.
    pub updates: u64,
    /// Quantisers of all pictures, summed.
    pub qp_sum: u64,
    /// Texels that were asked for a pixel, summed over updates.
    pub texels_per_pixel_sum: f64,
    /// Texels of all blocks, and of those that were shaded, summed over updates.
    pub texels: [u64; 2],
    /// Bytes of access units.
    pub atlas_bytes: u64,
    /// Bytes of geometry deltas.
    pub geometry_bytes: u64,
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
    pub levels: [u64; 2],
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
    sessions: Sessions,
    desk: Desk,
    /// What goes out beside the session.
    streams: VecDeque<Out>,
    encoding: Option<Encoding>,
    pub(super) peer: Option<PeerId>,
    leaving: VecDeque<Leaving>,
    number: u64,
    /// Bytes of motion to those who were served before.
    motion_before: MotionBytes,
    /// Where those of an update have times of their own.
    steps: Option<Steps>,
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

/// What leaves when its stages are done.
struct Leaving {
    at_ns: i64,
    /// The viewer that it is for.
    viewer: u64,
    what: Departure,
}

enum Departure {
    /// An update that is shaded now.
    Update(Box<Shaded>),
    Picture(PictureHeader, Vec<u8>),
    /// Nothing: steps of updates may be due.
    Advance,
}

/// What the sessions work with: a carrier that keeps everything until it is fetched.
#[derive(Default)]
struct Desk {
    carrier: Kept,
    mailbox: Mailbox,
    verdicts: Verdicts,
}

impl Desk {
    fn surroundings(&self) -> Surroundings<'_> {
        let Self { carrier, mailbox, verdicts } = self;
        Surroundings { carrier, mailbox, verdicts, say: &|_| {} }
    }
}

/// What sessions have to say, and why the server has sent the client away.
#[derive(Default)]
struct Kept {
    out: RefCell<VecDeque<Out>>,
    ended: RefCell<Option<String>>,
}

impl Carrier for Kept {
    fn send(&self, _: PeerId, out: Out) -> Result<(), SendError> {
        self.out.borrow_mut().push_back(out);
        Ok(())
    }

    fn close(&self, _: PeerId, code: CloseCode, reason: &str) {
        if code != CloseCode::Leaving {
            *self.ended.borrow_mut() = Some(reason.to_owned());
        }
    }
}

impl Seat {
    pub(super) fn new(server: &Server) -> Self {
        let terms = server.offer();
        let offer = move |session| ServerOffer { session, ..terms.clone() };
        Self {
            viewer: None,
            sent: Sent::default(),
            gpu_ms: BTreeMap::new(),
            last: None,
            shows: Vec::new(),
            residents: Residents::default(),
            sessions: Sessions::new(Box::new(offer), 1, SERVER_EPOCH_NS),
            desk: Desk::default(),
            streams: VecDeque::new(),
            encoding: None,
            peer: None,
            leaving: VecDeque::new(),
            number: 0,
            motion_before: MotionBytes::default(),
            steps: None,
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
        self.sessions.take(event, now_ns, &self.desk.surroundings());
        self.sessions.tick(now_ns, &self.desk.surroundings());
        for (_, News { client, told }) in self.desk.mailbox.take() {
            match client {
                Client::Unchanged => {}
                Client::Gone => self.part(server),
                Client::Accepted(accepted) => {
                    self.part(server);
                    self.accept(server, *accepted, now_ns)?;
                }
            }
            if let Some(viewer) = &mut self.viewer {
                if let Some(wanted) = told.steering {
                    server.world.timeline().lock().steer(wanted, server_time(now_ns));
                }
                viewer.hear(told, now_ns);
            }
        }
        match self.desk.carrier.ended.take() {
            Some(reason) => bail!("the server has ended the session: {reason}"),
            None => Ok(()),
        }
    }

    /// Nobody is served any more.
    fn part(&mut self, server: &mut Server) {
        if let Some(viewer) = self.viewer.take() {
            viewer.into_updates().leave(&mut server.world);
            self.steps = None;
        }
    }

    fn accept(&mut self, server: &mut Server, accepted: Accepted, now_ns: i64) -> anyhow::Result<()> {
        let Accepted { welcome, capabilities, sender } = accepted;
        self.number = server.next_viewer();
        self.motion_before = self.sent.motion;
        let first_qp = server.quality.first_qp();
        let settings = EncoderSettings::for_stream(welcome.atlas_extent_texels, first_qp, server.rate_hz);
        self.encoding = Some(Encoding::new(encode::encoder(welcome.codec, settings)?));
        let mut frame = ViewerUpdates::with_policy(
            &server.world,
            ViewerId(self.number),
            &welcome,
            &capabilities,
            server.show,
            server.spared.ideal.clone(),
        )?;
        server.shade_texels.into_iter().for_each(|texels| frame.set_shading_budget(texels));
        let quality = server.quality.of_codec(welcome.codec);
        self.viewer = Some(Viewer::new(frame, sender, quality, server.period_ns(), now_ns));
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

    /// One update; what it makes leaves when its stages are done. `way`: that to the client.
    pub(super) fn update(
        &mut self,
        server: &mut Server,
        way: Option<WayState>,
        stages: StageMs,
        now_ns: i64,
    ) -> anyhow::Result<()> {
        let Some(viewer) = self.viewer.as_mut().filter(|viewer| viewer.due_ns().is_some()) else {
            return Ok(());
        };
        if let Some(ms) = stages.steps {
            self.encode_ns = stages.ns(stages.encode);
            self.steps.get_or_insert_with(|| Steps::new(ms, stages.ns(stages.encode), server.period_ns()));
            return self.advance(server, way, now_ns);
        }
        // One update at a time.
        if self.leaving.iter().any(|leaving| matches!(leaving.what, Departure::Update(_))) {
            return Ok(());
        }
        if !viewer.is_open(way.as_ref(), now_ns) {
            self.sent.withheld += 1;
            return Ok(());
        }
        if let Some(shortfall) = viewer.shortfall(now_ns) {
            tracing::warn!("{shortfall}");
        }
        viewer.note_update(stages.ns(stages.server) as f64 * 1e-9);
        let frame = viewer.begin(way.as_ref(), now_ns);
        let Some(shaded) = frame.update(&mut server.world, server_time(now_ns))? else {
            return Ok(());
        };
        self.encode_ns = stages.ns(stages.encode);
        self.made(server, shaded, now_ns + stages.ns(stages.server))
    }

    /// Makes the steps of updates that are due, where they have times of their own.
    fn advance(&mut self, server: &mut Server, way: Option<WayState>, now_ns: i64) -> anyhow::Result<()> {
        while let (Some(steps), Some(viewer)) = (&mut self.steps, &mut self.viewer) {
            let is_due = viewer.due_ns().is_some_and(|due_ns| due_ns <= now_ns);
            let may_begin = is_due && !steps.would_wait(now_ns) && viewer.is_open(way.as_ref(), now_ns);
            let step = steps.step(now_ns, may_begin, !server.world.is_shared());
            let world = &mut server.world;
            let mut shaded = None;
            match step {
                Step::Begin if !viewer.begin(way.as_ref(), now_ns).begin(world, server_time(now_ns))? => {
                    break;
                }
                Step::Begin => {}
                Step::Place => viewer.updates_mut().place(world)?,
                Step::Shade => viewer.updates_mut().shade(world)?,
                Step::Collect => shaded = viewer.updates_mut().collect(world)?,
                Step::Wait => break,
            }
            steps.made(step, now_ns);
            if let Some(shaded) = shaded {
                viewer.note_update((now_ns - SERVER_EPOCH_NS - shaded.time.0) as f64 * 1e-9);
                self.made(server, shaded, now_ns)?;
            }
        }
        self.look_again(now_ns);
        Ok(())
    }

    /// Wakes it when the device or the CPU has come further, or an update is due.
    fn look_again(&mut self, now_ns: i64) {
        let (Some(steps), Some(viewer)) = (&self.steps, &self.viewer) else { return };
        let due_ns = viewer.due_ns().filter(|due_ns| *due_ns > now_ns);
        let Some(at_ns) = steps.next_ns(now_ns).into_iter().chain(due_ns).min() else { return };
        let is_woken =
            |leaving: &Leaving| matches!(leaving.what, Departure::Advance) && leaving.at_ns <= at_ns;
        if !self.leaving.iter().any(is_woken) {
            self.leave(at_ns, Departure::Advance);
        }
    }

    /// An update that is shaded at `done_ns` is counted, and leaves then.
    fn made(&mut self, server: &mut Server, shaded: Shaded, done_ns: i64) -> anyhow::Result<()> {
        let Some(frame) = self.viewer.as_ref().map(Viewer::updates) else { return Ok(()) };
        self.originals.keep(&server.gpu, frame, &shaded)?;
        self.sent.updates += 1;
        shaded.timings.iter().for_each(|(stage, ms)| *self.gpu_ms.entry(stage).or_default() += ms);
        self.residents.note(shaded.update, frame.residency());
        let shows = frame.shows(&server.world);
        self.sent.triangles += u64::from(shows.triangles);
        self.sent.texels_per_pixel_sum += f64::from(shows.texels_per_pixel);
        self.sent.texels[0] += shows.reused.texels;
        self.sent.texels[1] += shows.reused.shaded_texels;
        self.sent.levels[0] += shows.levels.iter().sum::<usize>() as u64;
        self.sent.levels[1] += shows.levels.len() as u64;
        self.shows.resize(shaded.update.0 as usize, Shows::default());
        self.shows.push(shows);
        if let Some(rows) = &self.rows {
            rows.updates.span("update", [shaded.time, server_time(done_ns)], Some(shaded.update));
        }
        self.leave(done_ns, Departure::Update(Box::new(shaded)));
        Ok(())
    }

    /// An update is shaded: its delta leaves, its picture goes to the encoder.
    fn finish(
        &mut self,
        server: &mut Server,
        shaded: Shaded,
        way: Option<WayState>,
        now_ns: i64,
    ) -> anyhow::Result<()> {
        let Some(viewer) = &mut self.viewer else { return Ok(()) };
        let began = server.world.effort().begin();
        let (delta, update) = viewer.finish(shaded);
        server.world.effort_mut().add_delta(began);
        self.count(update.sizes);
        self.streams.push_back(clock_stamp(server_time(now_ns)));
        self.send(update.shaded.update, Kind::Delta, delta, now_ns);
        self.motion(server, way, now_ns);
        let done_ns = match &mut self.steps {
            Some(steps) => steps.encode(now_ns),
            None => now_ns + self.encode_ns,
        };
        self.encode(update, done_ns)
    }

    /// Hands a picture to the encoder; what it has then leaves at `done_ns`.
    fn encode(&mut self, update: Update, done_ns: i64) -> anyhow::Result<()> {
        let encoding = self.encoding.as_mut().context("an encoder comes with the viewer")?;
        self.sent.qp_sum += u64::from(update.qp);
        encoding.submit(update.shaded, update.refresh, update.qp)?;
        while let Some(coded) = self.encoding.as_mut().and_then(|encoding| encoding.poll(Duration::ZERO)) {
            let Coded { shaded, header, unit } = coded?;
            self.sent.atlas_bytes += unit.bytes.len() as u64;
            if let Some(rows) = &self.rows {
                let times = [done_ns - self.encode_ns, done_ns].map(server_time);
                rows.encoder.span("encode", times, Some(header.update));
            }
            self.leave(done_ns, Departure::Picture(header, unit.bytes));
            let earlier = self.last.replace(shaded);
            if let Some((viewer, earlier)) = self.viewer.as_mut().zip(earlier) {
                viewer.recycle(*earlier);
            }
        }
        Ok(())
    }

    fn leave(&mut self, at_ns: i64, what: Departure) {
        let place = self.leaving.partition_point(|other| other.at_ns <= at_ns);
        self.leaving.insert(place, Leaving { at_ns, viewer: self.number, what });
    }

    /// When something leaves next.
    pub(super) fn next_departure_ns(&self) -> Option<i64> {
        self.leaving.front().map(|leaving| leaving.at_ns)
    }

    /// What is ready leaves; what is for a viewer that has left is dropped.
    pub(super) fn depart(
        &mut self,
        server: &mut Server,
        way: Option<WayState>,
        now_ns: i64,
    ) -> anyhow::Result<()> {
        let next = self.leaving.pop_front().filter(|leaving| leaving.viewer == self.number);
        let Some(Leaving { what, .. }) = next else { return Ok(()) };
        match what {
            Departure::Update(shaded) => self.finish(server, *shaded, way, now_ns)?,
            Departure::Advance => self.advance(server, way, now_ns)?,
            Departure::Picture(header, bytes) => {
                self.send_picture(header, picture_stream(header, &bytes)?, now_ns);
            }
        }
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
        let picture = SentPicture { stream_bytes: out.bytes(), is_refresh: header.is_refresh, encode_s };
        viewer.sent_picture(header.update, picture, now_ns);
        self.streams.push_back(out);
    }

    fn count(&mut self, sizes: DeltaSizes) {
        self.sent.geometry_bytes += sizes.total_bytes as u64;
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
    pub(super) fn poll_out(&mut self) -> Option<Out> {
        self.desk.carrier.out.get_mut().pop_front().or_else(|| self.streams.pop_front())
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

//! The receiving half of the client: the session, the decoding of its pictures, and their preparation for the render thread. It
//! may run on its own thread, and knows the GPU only as memory to fill.

use super::link::Link;
use super::preparing::{ArrivedPicture, Preparing};
use crate::decode::decoding::Decoded;
use crate::display::Presses;
use crate::draw::stages::atlas_draw::PictureWays;
use crate::handover::{Arrived, FrameNote, IntakeEnd, Prepared, Presented, TurnNote};
use crate::options::ClientOptions;
use crate::report::{DecodedIn, Notice};
use shadecast_protocol::clock::ClockEstimate;
use shadecast_protocol::delta::ReceivedDelta;
use shadecast_protocol::limits::{
    ATLAS_MAX_EXTENT, MAX_PATCH_SLOTS, MAX_STORE_PAGES, MAX_TRIANGLES, MAX_VERTEX_SLOTS,
};
use shadecast_protocol::message::{Capabilities, MotionMemory, Welcome};
use shadecast_protocol::motion::message::{MotionMessage, MotionNews};
use shadecast_protocol::pairing::ClientPairing;
use shadecast_protocol::session::{ClientEvent, Out};
use shadecast_protocol::time::ClientTime;
use shadecast_protocol::wire::{self, StreamMessage, WireError};
use shadecast_protocol::world_clock::{Steer, WorldClock};
use std::collections::VecDeque;
use std::sync::atomic::{AtomicU64, Ordering};

/// Decoded pictures that are remembered for who drives the client.
const MAX_DECODED_TOLD: usize = 16;
/// What is said of a server that no longer answers over a connection that stands.
const SILENT: &str = "the server has answered no ping for 2 s; connecting anew";
/// Steps of the world that a turn of the display asks for.
const MAX_STEPS_AT_ONCE: u32 = 8;

/// See the module.
pub struct Intake {
    link: Link,
    /// What the connection that lives brings, from the welcome on.
    preparing: Option<Preparing>,
    end: IntakeEnd,
    options: ClientOptions,
    /// What draws pictures that decoders leave on the device.
    ways: PictureWays,
    eye_extent_pixels: [u32; 2],
    presses: Presses,
    /// That the world goes on, or stands, as was asked for; `None` where its clock says so by now.
    asked_to_go: Option<bool>,
    now: ClientTime,
    /// What the presenter knows of the clock.
    told_clock: Option<(ClockEstimate, u64)>,
    /// What it knows of the world's.
    told_world: WorldClock,
    notices: VecDeque<Notice>,
    /// Pictures that were decoded, for who wants to know how long that took.
    decoded: VecDeque<DecodedIn>,
}

impl Intake {
    pub(crate) fn new(
        end: IntakeEnd,
        options: ClientOptions,
        ways: PictureWays,
        eye_extent_pixels: [u32; 2],
    ) -> Self {
        Self {
            link: Link::default(),
            preparing: None,
            end,
            options,
            ways,
            eye_extent_pixels,
            presses: Presses::default(),
            asked_to_go: None,
            now: ClientTime(0),
            told_clock: None,
            told_world: WorldClock::default(),
            notices: VecDeque::new(),
            decoded: VecDeque::with_capacity(MAX_DECODED_TOLD),
        }
    }

    /// Says `text` in the waiting room, which is seen until the first bundle, and before a world that stands still.
    pub fn set_status(&mut self, text: &str) {
        self.end.give(Prepared::Status(text.to_owned()));
    }

    /// What somebody has pressed, as far as the presenter has told.
    pub fn presses(&self) -> Presses {
        self.presses
    }

    /// Bytes can flow from `now` on. The session begins once the eyes have been located.
    pub fn on_connected(&mut self, now: ClientTime) {
        self.on_closed(now);
        self.link.open();
        self.begin_session();
    }

    /// The connection is gone. What has come of it is handed over; what is on display stays there.
    pub fn on_closed(&mut self, now: ClientTime) {
        self.now = now;
        while self.prepare() {}
        self.preparing = None;
        if let Some(serial) = self.link.close() {
            self.end.give(Prepared::Ended(serial));
        }
    }

    /// The connection is not to be used: nothing that has come of it is handed over.
    pub fn on_discarded(&mut self, now: ClientTime) {
        self.preparing = None;
        self.on_closed(now);
    }

    /// Takes leave of the server: the last bytes come out of [`Self::poll_out`].
    pub fn say_goodbye(&mut self) {
        if let Some(session) = self.link.session() {
            session.goodbye();
        }
    }

    /// Says a step of pairing.
    pub fn pair(&mut self, step: ClientPairing) {
        if let Some(session) = self.link.session() {
            session.pair(step);
        }
    }

    fn begin_session(&mut self) {
        let (options, eye_extent_pixels) = (&self.options, self.eye_extent_pixels);
        self.link.begin(self.now, |eyes, display_period_ns| Capabilities {
            max_atlas_extent: ATLAS_MAX_EXTENT,
            max_vertex_slots: options.max_vertex_slots.min(MAX_VERTEX_SLOTS),
            max_patch_slots: options.max_patch_slots.min(MAX_PATCH_SLOTS),
            max_triangles: options.max_triangles.min(MAX_TRIANGLES),
            motion: options.motion.min(MotionMemory::MAX),
            store_pages: options.store_pages.unwrap_or(0).min(MAX_STORE_PAGES),
            blends: options.blends.unwrap_or(false),
            codecs: options.codecs.to_vec(),
            eyes,
            eye_extent_pixels,
            display_period_ns,
        });
    }

    /// Takes one message of the server's control stream.
    pub fn receive_control(&mut self, now: ClientTime, message: &[u8]) {
        self.now = now;
        if let Some(session) = self.link.session() {
            session.on_control(message);
        }
        self.take_events();
    }

    /// Takes one whole unidirectional stream.
    pub fn receive_stream(&mut self, now: ClientTime, bytes: &[u8]) {
        self.now = now;
        let arrived = &self.end.arrived;
        match wire::parse_stream(bytes) {
            Ok(StreamMessage::Picture { access_unit, .. }) => count(&arrived.atlas_bytes, access_unit.len()),
            _ => count(&arrived.geometry_bytes, bytes.len()),
        }
        if let Some(session) = self.link.session() {
            session.on_stream(bytes);
        }
        self.take_events();
    }

    /// The server gave up a stream of which `head` had come: a picture that will not be shown in time.
    pub fn receive_reset(&mut self, now: ClientTime, head: &[u8]) {
        self.now = now;
        self.link.stream_was_reset(head);
    }

    /// Takes a datagram.
    pub fn receive_datagram(&mut self, now: ClientTime, bytes: &[u8]) {
        self.now = now;
        if let Some(session) = self.link.session() {
            session.on_datagram(bytes, now);
        }
    }

    /// The connection has brought something, whatever it was.
    pub fn note_alive(&mut self, now: ClientTime) {
        if let Some(session) = self.link.session() {
            session.note_alive(now);
        }
    }

    /// Does what is due at `now`: pings, decoded pictures, requests.
    pub fn advance(&mut self, now: ClientTime) {
        self.now = now;
        self.begin_session();
        self.ways.gpu().destroy_retired();
        let is_full = self.preparing.as_ref().is_some_and(|preparing| preparing.motion.is_full());
        if let Some(session) = self.link.session() {
            session.hold_back(is_full);
            session.on_tick(now);
        }
        self.take_pictures();
        self.take_events();
    }

    /// Takes what the presenter has said, and tells the server what it must know of it. To be called before [`Self::advance`].
    pub fn take_presented(&mut self) {
        while let Some(presented) = self.end.take() {
            match presented {
                Presented::Turn(note) => self.take_turn(note),
                // Memory of a connection that has ended is no longer needed.
                Presented::Loan(loan, serial) => {
                    if let Some(preparing) = self.preparing.as_mut().filter(|p| p.serial == serial) {
                        preparing.take_back(loan);
                    }
                }
                Presented::Said(text) => drop(text),
            }
        }
    }

    fn take_turn(&mut self, TurnNote { is_seen, presses, frame }: TurnNote) {
        self.steer(presses);
        self.link.watch(is_seen, self.now);
        let Some(frame) = frame else { return };
        let FrameNote { report, shown, picture_arrived, eyes, display_period_ns, head } = frame;
        self.link.note_eyes(eyes, display_period_ns);
        if let Some((head, serial)) = head {
            self.link.report_head(serial, head);
        }
        self.link.report(shown, &report, picture_arrived);
    }

    /// Asks the server for what was pressed: that the world stands, goes on, or makes a step.
    fn steer(&mut self, presses: Presses) {
        let before = std::mem::replace(&mut self.presses, presses);
        let (Some(preparing), Some(session)) = (&self.preparing, self.link.session()) else { return };
        let stands = preparing.motion.world_clock().will_stand();
        if presses.halts.wrapping_sub(before.halts) % 2 == 1 {
            let goes = !self.asked_to_go.unwrap_or(!stands);
            session.steer(if goes { Steer::GoOn } else { Steer::Halt });
            self.asked_to_go = Some(goes);
        }
        for _ in 0..presses.steps.wrapping_sub(before.steps).min(MAX_STEPS_AT_ONCE) {
            session.steer(Steer::Step);
            self.asked_to_go = Some(false);
        }
    }

    /// Whether there is a picture, and no memory for its bundle.
    pub(crate) fn wants_bundle(&self) -> bool {
        self.preparing.as_ref().is_some_and(Preparing::wants_bundle)
    }

    /// Whether the next bundle can follow the last at once.
    pub(crate) fn is_behind(&mut self) -> bool {
        self.preparing.as_mut().is_some_and(Preparing::is_behind)
    }

    /// Hands over what is ready: one batch of arrivals, and the newest complete bundle. False where nothing was. To be called after
    /// [`Self::advance`].
    pub fn prepare(&mut self) -> bool {
        self.end.flush();
        self.report_clock();
        self.report_world();
        let Self { preparing: Some(preparing), end, link, ways, notices, .. } = self else { return false };
        let batch = preparing.next_batch();
        let bundle = preparing.next_bundle(ways, |picture| link.recycle(picture)).unwrap_or_else(|error| {
            notices.push_back(Notice::Failed(error.to_string()));
            None
        });
        if let Some(update) = preparing.take_unsettled() {
            link.note_unsettled(update);
        }
        let is_something = batch.is_some() || bundle.is_some();
        for loan in batch.into_iter().chain(bundle) {
            end.give(Prepared::Loan(loan, preparing.serial));
        }
        is_something
    }

    fn report_clock(&mut self) {
        let clock = self.link.clock_estimate();
        let Some((estimate, serial)) = clock.filter(|_| clock != self.told_clock) else { return };
        // Of a presenter that sleeps for an hour only the last counts.
        if self.end.offer(Prepared::Clock(estimate, serial)) {
            self.told_clock = clock;
        }
    }

    /// Tells the presenter how the world's time goes on, where that is new.
    fn report_world(&mut self) {
        let Some(preparing) = &self.preparing else { return };
        let clock = preparing.motion.world_clock();
        if clock != self.told_world && self.end.offer(Prepared::World(clock, preparing.serial)) {
            self.told_world = clock;
        }
    }

    /// What is decoded goes to its connection.
    fn take_pictures(&mut self) {
        let Some(preparing) = &mut self.preparing else { return };
        let decoded = &mut self.decoded;
        let (lost, has_asked) =
            self.link.decode(self.now, |serial, Decoded { update, arrived, decoding: times, picture }| {
                if preparing.serial != serial {
                    return Some(picture);
                }
                if decoded.len() == MAX_DECODED_TOLD {
                    decoded.pop_front();
                }
                decoded.push_back(DecodedIn { update, times });
                preparing.take_picture(update, ArrivedPicture { arrived, picture })
            });
        let Arrived { lost_pictures, refresh_requests, .. } = &*self.end.arrived;
        count(lost_pictures, lost as usize);
        count(refresh_requests, has_asked.into());
        self.notices.extend(self.link.take_trouble().map(Notice::Failed));
    }

    /// When [`Self::advance`] next has something to do by itself.
    pub fn next_tick(&self) -> Option<ClientTime> {
        self.link.next_tick()
    }

    /// The next bytes to carry to the server.
    pub fn poll_out(&mut self) -> Option<Out> {
        self.link.poll_out()
    }

    /// What became of the connection.
    pub fn poll_notice(&mut self) -> Option<Notice> {
        self.notices.pop_front()
    }

    /// Pictures that were decoded, each once; of many that nobody asks for the newest.
    pub fn take_decoded(&mut self) -> impl Iterator<Item = DecodedIn> + '_ {
        self.decoded.drain(..)
    }

    /// Bytes of what has come and waits: for an earlier one, for its picture, for the GPU's vertex memory.
    pub fn waiting_bytes(&self) -> usize {
        self.preparing.as_ref().map_or(0, Preparing::waiting_bytes) + self.link.waiting_bytes()
    }

    fn take_events(&mut self) {
        while let Some(event) = self.link.poll_event() {
            match event {
                ClientEvent::Welcome(welcome) => self.welcome(welcome),
                ClientEvent::Delta(delta) => self.take_delta(delta),
                ClientEvent::Picture { header, access_unit } => {
                    if let Some(decoding) = self.link.decoding() {
                        decoding.add(header, access_unit, self.now);
                    }
                }
                ClientEvent::Motion(news) => self.take_motion(news),
                ClientEvent::Refused(refused) => self.notices.push_back(Notice::Refused(refused)),
                ClientEvent::PairingNeeded { .. } => self.notices.push_back(Notice::PairingNeeded),
                ClientEvent::PairingAnswer { element, proof } => {
                    self.notices.push_back(Notice::PairingAnswer { element, proof });
                }
                ClientEvent::Goodbye => self.notices.push_back(Notice::ServerLeft),
                ClientEvent::Failed(error) => self.notices.push_back(Notice::Failed(error.to_string())),
                ClientEvent::Silent => self.notices.push_back(Notice::Failed(SILENT.to_owned())),
            }
        }
    }

    fn welcome(&mut self, welcome: Welcome) {
        let decoder =
            match (self.options.decoder)(welcome.codec, welcome.atlas_extent_texels, self.ways.gpu()) {
                Ok(decoder) => decoder,
                Err(error) => return self.notices.push_back(Notice::Failed(error.to_string())),
            };
        let Some(serial) = self.link.welcomed(&welcome, decoder, self.options.decoding) else { return };
        self.preparing = Some(Preparing::new(&welcome, serial, self.options.blends.unwrap_or(false)));
        (self.told_world, self.asked_to_go) = (WorldClock::default(), None);
        self.end.give(Prepared::Scene(Box::new(welcome.clone()), serial));
        self.notices.push_back(Notice::Welcome(welcome));
    }

    /// A session without a scene, for want of a decoder, has nothing to say.
    fn take_delta(&mut self, delta: ReceivedDelta) {
        let samples = delta.positions.iter().map(|batch| batch.positions.len()).sum();
        count(&self.end.arrived.vertex_samples, samples);
        let Some(preparing) = &mut self.preparing else { return };
        preparing.take_delta(delta);
        let (contradiction, is_full) = (preparing.motion.take_contradiction(), preparing.motion.is_full());
        if let Some(session) = self.link.session() {
            session.hold_back(is_full);
        }
        if let Some(slot) = contradiction {
            let reason = format!("vertex slot {} is reused while it is on display", slot.0);
            self.link.fail(WireError::Invalid { what: "a geometry delta", reason });
        }
    }

    fn take_motion(&mut self, news: MotionMessage) {
        if matches!(news.news, MotionNews::Clock(_)) {
            self.asked_to_go = None;
        }
        if let Some(preparing) = &mut self.preparing {
            preparing.motion.take_motion(news);
        }
    }
}

fn count(counter: &AtomicU64, by: usize) {
    counter.fetch_add(by as u64, Ordering::Relaxed);
}

//! A client that is served, from its acceptance on: what it tells, when its next update is made, what leaves with it. Without
//! I/O, threads and clocks: the server's threads and the lab drive the same.

use crate::motion::delta::UpdateDelta;
use crate::motion::sender::SharedMotion;
use crate::pacing::density::Spare;
use crate::pacing::gate::{AFTER_ALL, Kind, Shortfall, UpdateGate};
use crate::pacing::quality::{Quality, QualityOptions, SentPicture};
use crate::pacing::relief::{Measures, Relief};
use crate::pacing::share::{Budget, WayState};
use crate::support::lock::lock;
use crate::update::Shaded;
use shadecast_protocol::delta::{DeltaSizes, EncodedDelta};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{Displayed, HeadState};
use shadecast_protocol::session::{DeltaSender, Out, ServerEvent};
use shadecast_protocol::world_clock::Steering;

/// What makes a viewer's updates.
pub trait Updates {
    /// The client's head.
    fn head(&mut self, state: HeadState);
    /// What the client shows.
    fn displayed(&mut self, report: &Displayed);
    /// Updates pause, or go on after a pause.
    fn interrupted(&mut self);
    /// What the next update may take on the wire.
    fn set_budget(&mut self, budget: Budget);
    /// Whether bits and time are left over by what it makes.
    fn set_spare(&mut self, spare: Spare);
    /// What the next update does without.
    fn set_measures(&mut self, measures: Measures);
    /// What an update took when nobody looked yet, seconds, where that is known.
    fn rehearsed_s(&self) -> Option<f64> {
        None
    }
    /// An update takes about so many nanoseconds.
    fn note_update(&mut self, took_ns: i64);
    /// An update's picture is coded with this quantiser.
    fn coded(&mut self, update: UpdateId, qp: u8);
    /// The client has no picture of updates later than this one, if it has that.
    fn lost_after(&mut self, after: Option<UpdateId>);
    /// The bytes of an update's delta, in the order of updates.
    fn encode(&mut self, delta: &UpdateDelta) -> EncodedDelta;
    /// What the client is sent of motion between updates, where it is sent any.
    fn motion(&self) -> Option<SharedMotion>;
    /// An update is not needed any more.
    fn recycle(&mut self, shaded: Shaded);
}

/// What a client has told since it was asked last: the newest of each kind.
#[derive(Clone, Copy, Debug, Default)]
pub struct Reported {
    /// Its head.
    pub head: Option<HeadState>,
    /// What is on display.
    pub displayed: Option<Displayed>,
    /// A picture that needs no other is wanted, since those later than this one were lost, or all.
    pub refresh: Option<Option<UpdateId>>,
    /// Whether somebody looks, where that was told.
    pub watching: Option<bool>,
    /// Whether the way to it carries nothing, where that has changed.
    pub away: Option<bool>,
    /// That the world stands, or goes on: for whoever has the world.
    pub steering: Option<Steering>,
}

impl Reported {
    /// Takes in what a served client's session says; gives back what is no viewer's affair.
    pub(crate) fn take(&mut self, event: ServerEvent) -> Option<ServerEvent> {
        let none = Self::default();
        let told = match event {
            ServerEvent::Head(head) => Self { head: Some(head), ..none },
            ServerEvent::Displayed(report) => Self { displayed: Some(report), ..none },
            ServerEvent::RefreshRequest { after } => Self { refresh: Some(after), ..none },
            ServerEvent::Watching(is_watched) => Self { watching: Some(is_watched), ..none },
            ServerEvent::Steer(steer) => Self { steering: Some(steer), ..none },
            other => return Some(other),
        };
        self.then(told);
        None
    }

    /// Takes in what was told after it.
    pub(crate) fn then(&mut self, later: Self) {
        let Self { head, displayed, refresh, watching, steering, away } = later;
        head.into_iter().for_each(|head| self.head = Some(head));
        self.refresh = self.refresh.into_iter().chain(refresh).min();
        watching.into_iter().for_each(|is_watched| self.watching = Some(is_watched));
        away.into_iter().for_each(|is_away| self.away = Some(is_away));
        if let Some(report) = displayed {
            let earlier = self.displayed.take();
            self.displayed = Some(earlier.map_or(report, |earlier| earlier.merged(report)));
        }
        if let Some(later) = steering {
            self.steering = Some(self.steering.unwrap_or_default().then(later));
        }
    }
}

/// An update whose delta leaves; its picture follows when it is encoded.
#[derive(Debug)]
pub struct Update {
    /// What is to be encoded.
    pub shaded: Box<Shaded>,
    /// Where the bytes of its delta went.
    pub sizes: DeltaSizes,
    /// Its picture must need no other.
    pub refresh: bool,
    /// Quantiser of its picture.
    pub qp: u8,
}

/// See the module. `U` makes its updates.
pub struct Viewer<U> {
    updates: U,
    sender: DeltaSender,
    gate: UpdateGate,
    quality: Quality,
    relief: Relief,
    refresh: bool,
    /// False while nobody looks: nothing is shaded then.
    is_watched: bool,
    /// The way to it carries nothing: nothing is made that would be old when it arrives.
    is_away: bool,
    motion: Option<SharedMotion>,
    last: UpdateId,
}

impl<U: Updates> Viewer<U> {
    /// A client that has just been accepted and wants an update in each `period_ns`.
    pub fn new(updates: U, sender: DeltaSender, quality: QualityOptions, period_ns: i64) -> Self {
        Self {
            motion: updates.motion(),
            relief: Relief::new(period_ns as f64 * 1e-9, updates.rehearsed_s()),
            last: UpdateId(0),
            updates,
            sender,
            gate: UpdateGate::new(period_ns),
            quality: Quality::new(quality, period_ns),
            refresh: false,
            is_watched: true,
            is_away: false,
        }
    }

    /// What makes its updates.
    pub fn updates(&self) -> &U {
        &self.updates
    }

    /// The same, to go on with what was begun.
    pub fn updates_mut(&mut self) -> &mut U {
        &mut self.updates
    }

    /// Ends it; what made its updates is given back.
    pub fn into_updates(self) -> U {
        self.updates
    }

    /// What its client has told.
    pub fn apply(&mut self, reported: Reported) {
        if let Some(head) = reported.head {
            self.relief.head(&head);
            self.updates.head(head);
        }
        reported.displayed.iter().for_each(|report| self.updates.displayed(report));
        if let Some(after) = reported.refresh {
            self.refresh = true;
            self.updates.lost_after(after);
        }
        reported.watching.into_iter().for_each(|is_watched| self.watch(is_watched));
        reported.away.into_iter().for_each(|is_away| self.set_away(is_away));
    }

    /// Whether updates are wanted: somebody looks, and the way to the client carries something.
    pub fn wants_updates(&self) -> bool {
        self.is_watched && !self.is_away
    }

    /// Nothing is made while the way carries nothing. What was sent before waits in the transport and arrives in order, so that
    /// the client's memory is what the model says when it goes on.
    fn set_away(&mut self, is_away: bool) {
        if std::mem::replace(&mut self.is_away, is_away) != is_away {
            self.updates.interrupted();
            self.gate.resumed();
            self.motion.iter().for_each(|motion| lock(motion).set_away(is_away));
        }
    }

    /// Nothing is shaded while nobody looks. When somebody looks again, the first picture needs no other.
    fn watch(&mut self, is_watched: bool) {
        if std::mem::replace(&mut self.is_watched, is_watched) != is_watched {
            self.updates.interrupted();
            self.refresh |= is_watched;
        }
    }

    /// The next picture must need no other: its encoder is a new one, and what the one before had begun is lost.
    pub(crate) fn refresh(&mut self) {
        self.refresh = true;
        self.updates.lost_after(None);
    }

    /// What it is sent of motion between updates.
    pub fn motion(&self) -> Option<&SharedMotion> {
        self.motion.as_ref()
    }

    /// Whether the way to the client takes another update now, as far as anything is known of it.
    pub fn is_open(&mut self, way: Option<&WayState>, now_ns: i64) -> bool {
        let untold = self.motion.as_ref().map_or(Vec::new(), |motion| lock(motion).take_untold());
        for (bytes, is_urgent) in untold {
            let update = if is_urgent { self.last } else { AFTER_ALL };
            self.sent(update, Kind::Motion, bytes, now_ns);
        }
        way.is_none_or(|way| self.gate.may_update(way, now_ns))
    }

    /// What to tell the person of a slow link, now and then.
    pub fn shortfall(&mut self, now_ns: i64) -> Option<Shortfall> {
        self.gate.shortfall(self.quality.qp(), now_ns)
    }

    /// An update is to be made now, by what is given back. Over a way of which nothing is known it may take what it wants.
    pub fn begin(&mut self, way: Option<&WayState>, now_ns: i64) -> &mut U {
        self.quality.note_link(way.and_then(|way| self.gate.share(way, now_ns).streams_bytes_s()));
        self.updates.set_budget(way.map_or(Budget::UNLIMITED, |way| self.gate.budget(way, now_ns)));
        self.updates.set_spare(self.quality.spare());
        self.updates.set_measures(self.relief.measures());
        &mut self.updates
    }

    /// The update took the device so long, seconds; times as many as share the device. `apart_s`: from the one before to it, as far as
    /// this machine is the bound.
    pub fn note_update(&mut self, took_s: f64, apart_s: f64) {
        self.quality.note_update(took_s);
        self.relief.note(apart_s);
        self.updates.note_update((took_s * 1e9) as i64);
    }

    /// The update was shaded: the stream of its delta, and what is still to be done.
    pub fn finish(&mut self, shaded: Shaded) -> (Out, Update) {
        let encoded = self.updates.encode(&shaded.delta);
        let delta = self.sender.stream(&encoded);
        self.last = shaded.update;
        let refresh = std::mem::take(&mut self.refresh);
        let qp = if refresh { self.quality.refresh_qp() } else { self.quality.qp() };
        self.updates.coded(shaded.update, qp);
        (delta, Update { shaded: Box::new(shaded), sizes: encoded.sizes, refresh, qp })
    }

    /// An update is not needed any more: its memory is used for those that come.
    pub fn recycle(&mut self, shaded: Shaded) {
        self.updates.recycle(shaded);
    }

    /// A stream of an update was handed to the transport, other than its picture.
    pub fn sent(&mut self, update: UpdateId, kind: Kind, bytes: usize, now_ns: i64) {
        self.quality.note_other(bytes, now_ns);
        self.gate.sent(update, kind, bytes, now_ns);
    }

    /// The stream of an update's picture was handed to the transport.
    pub fn sent_picture(&mut self, update: UpdateId, picture: SentPicture, now_ns: i64) {
        self.quality.note_picture(picture, now_ns);
        self.gate.sent(update, Kind::Picture, picture.stream_bytes, now_ns);
    }
}

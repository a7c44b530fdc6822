//! Coded pictures enter in any order; decoded pictures leave in order. The module also reports when only a refresh helps. The
//! seam to the codec is [`crate::decode`].
//!
//! Every update has a picture. Each picture needs the previous one, unless it is a refresh. In virtual time decoding takes a
//! given time; in real time it runs on its own thread.

use super::{DecodeError, Decoder, Picture};
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::limits::MAX_ACCESS_UNIT_BYTES;
use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_protocol::wire::{PictureHeader, encode_picture};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

/// A picture that is awaited this long, and so many round trips, since a later one came is lost. The network repairs a loss within two
/// round trips, and a refresh costs a round trip and many times a picture's size. So three repairs in a row are waited for.
const GIVE_UP_NS: i64 = 250_000_000;
const GIVE_UP_ROUND_TRIPS: i64 = 5;
const LEAST_GIVE_UP_NS: i64 = 600_000_000;
/// A longer round trip is not believed.
const LONGEST_ROUND_TRIP_NS: i64 = 1_000_000_000;
/// A refresh that does not come is asked for again after this time.
const ASK_AGAIN_NS: i64 = 500_000_000;
/// Coded pictures that wait for one before them; beyond it the missing one is lost.
const MAX_WAITING: usize = 64;
/// Bytes of coded pictures that wait for one before them; as above.
const MAX_WAITING_BYTES: usize = 4 * MAX_ACCESS_UNIT_BYTES;
/// Coded pictures that wait for the decoding thread.
const THREAD_QUEUE: usize = 8;
/// Decoded pictures on their way back to the decoding thread.
const SPARE_QUEUE: usize = 4;
/// Pictures that a decoder may fail with one after the other before it is said to be of no use: those that only wait for a refresh do not
/// count.
const MOST_FAILURES: u32 = 4;
/// While a decoder has units, its thread looks for others so often.
const LOOK_UP: Duration = Duration::from_millis(2);

/// How decoding takes time.
#[derive(Clone, Copy, Debug)]
pub enum DecodeTiming {
    /// On a thread of its own, as fast as it goes.
    Thread {
        /// The clock by which it is told how long that is.
        now: fn() -> ClientTime,
    },
    /// At once, but handed on only after so many nanoseconds of the virtual clock, one picture after the other.
    Virtual {
        /// Nanoseconds per picture.
        delay_ns: i64,
    },
}

/// A decoded picture.
#[derive(Debug)]
pub struct Decoded {
    /// Its frame.
    pub update: UpdateId,
    /// When its last byte came.
    pub arrived: ClientTime,
    /// From its being handed to the decoder to its being there.
    pub decoding: [ClientTime; 2],
    /// The picture.
    pub picture: Picture,
}

/// A coded picture.
struct Coded {
    header: PictureHeader,
    access_unit: Vec<u8>,
    arrived: ClientTime,
}

/// What the decoder is told.
enum Job {
    Decode(Coded),
    /// A picture before the next is missing.
    UnitLost,
}

/// Result of one coded picture.
struct DecodedUnit {
    update: UpdateId,
    arrived: ClientTime,
    decoding: [ClientTime; 2],
    result: Result<Picture, DecodeError>,
}

/// The decoding of one connection.
pub struct Decoding {
    order: PictureOrder,
    engine: Engine,
    last_decoded: Option<UpdateId>,
    /// When a refresh was last asked for, while one is needed.
    asked: Option<ClientTime>,
    needs_refresh: bool,
    requested: Option<Requested>,
    /// The first update whose blocks could not settle, where no request says so.
    unsettled: Option<UpdateId>,
    /// The last refresh handed to the decoder.
    last_refresh: Option<UpdateId>,
    lost: u32,
    /// Since the last picture that it gave.
    failures: u32,
    trouble: Option<String>,
    round_trip_ns: i64,
}

/// The last request for a refresh.
#[derive(Clone, Copy)]
struct Requested {
    /// The server knows that the blocks of later updates have not settled: of those that it had sent.
    after: Option<UpdateId>,
    /// It had sent all before this one: the picture that was awaited, or that came as an answer.
    before: UpdateId,
    is_answered: bool,
}

/// Puts pictures in order.
#[derive(Default)]
struct PictureOrder {
    next: UpdateId,
    waiting: BTreeMap<UpdateId, Coded>,
    waiting_bytes: usize,
    /// Given up by the server, later than `next`.
    dead: BTreeSet<UpdateId>,
    /// The picture of the largest number was taken.
    is_over: bool,
}

/// A decoder with the pictures that are in it.
struct Work {
    decoder: Box<dyn Decoder>,
    /// In order.
    under_way: VecDeque<UnderWay>,
}

/// A picture that is in a decoder.
#[derive(Clone, Copy)]
struct UnderWay {
    update: UpdateId,
    arrived: ClientTime,
    began: ClientTime,
}

enum Engine {
    Virtual {
        work: Work,
        delay_ns: i64,
        busy_until: ClientTime,
        done: VecDeque<DecodedUnit>,
    },
    Thread {
        jobs: Option<SyncSender<Job>>,
        outcomes: Receiver<DecodedUnit>,
        spare: SyncSender<Picture>,
        thread: Option<JoinHandle<()>>,
        overflowed: bool,
    },
}

/// The frame of a picture of whose stream `head` has come; `None` where that is too little, or no picture.
pub fn frame_of_head(head: &[u8]) -> Option<UpdateId> {
    let header = PictureHeader { update: UpdateId(0), time: ServerTime(0), is_refresh: false };
    let kind = encode_picture(header, &[])[0];
    let frame = head.get(1..5)?.try_into().ok().map(u32::from_le_bytes)?;
    (head[0] == kind).then_some(UpdateId(frame))
}

impl PictureOrder {
    /// Takes a picture in. Gives the number of missing ones that it makes superfluous, because it needs none of them.
    fn add(&mut self, coded: Coded) -> u32 {
        let frame = coded.header.update;
        if frame < self.next || self.is_over {
            return 0;
        }
        let is_refresh = coded.header.is_refresh;
        self.waiting_bytes += coded.access_unit.len();
        let replaced = self.waiting.insert(frame, coded);
        self.waiting_bytes -= replaced.map_or(0, |coded| coded.access_unit.len());
        if is_refresh { self.skip_to(frame) } else { 0 }
    }

    /// Awaits nothing before `frame` any more. Gives the number of pictures that are missing for it.
    fn skip_to(&mut self, update: UpdateId) -> u32 {
        let skipped = update.0.saturating_sub(self.next.0);
        if skipped > 0 {
            self.waiting = self.waiting.split_off(&update);
            self.waiting_bytes = self.waiting.values().map(|coded| coded.access_unit.len()).sum();
            self.dead = self.dead.split_off(&update);
            self.next = update;
        }
        skipped
    }

    /// Awaits nothing before the oldest picture that is there.
    fn skip_to_oldest(&mut self) -> u32 {
        let oldest = self.waiting.first_key_value().map_or(self.next, |(frame, _)| *frame);
        self.skip_to(oldest)
    }

    /// The next picture in order, if it is there.
    fn pop(&mut self) -> Option<Coded> {
        let coded = self.waiting.remove(&self.next)?;
        self.waiting_bytes -= coded.access_unit.len();
        // No number follows the largest, which could be taken again.
        self.is_over = self.next == UpdateId(u32::MAX);
        self.next = self.next.next();
        Some(coded)
    }

    /// The server gave up the picture of `frame`.
    fn give_up(&mut self, update: UpdateId) {
        let is_due = update >= self.next && !update.is_too_far_after(self.next);
        if is_due && self.dead.len() < MAX_WAITING {
            self.dead.insert(update);
        }
    }

    /// Whether more waits than may.
    fn is_overfull(&self) -> bool {
        self.waiting.len() > MAX_WAITING || self.waiting_bytes > MAX_WAITING_BYTES
    }

    /// Whether the picture that is awaited must be given up.
    fn is_hopeless(&self, now: ClientTime, round_trip_ns: i64) -> bool {
        let oldest = self.waiting.values().map(|coded| coded.arrived).min();
        let patience_ns = (GIVE_UP_NS + GIVE_UP_ROUND_TRIPS * round_trip_ns).max(LEAST_GIVE_UP_NS);
        oldest.is_some_and(|arrived| now.since(arrived) > patience_ns)
    }
}

impl Decoding {
    /// For a connection whose pictures `decoder` can decode.
    pub fn new(decoder: Box<dyn Decoder>, timing: DecodeTiming) -> Self {
        let work = Work { decoder, under_way: VecDeque::new() };
        let engine = match timing {
            DecodeTiming::Thread { now } => Engine::thread(work, now),
            DecodeTiming::Virtual { delay_ns } => {
                Engine::Virtual { work, delay_ns, busy_until: ClientTime(i64::MIN), done: VecDeque::new() }
            }
        };
        Self {
            order: PictureOrder::default(),
            engine,
            last_decoded: None,
            asked: None,
            needs_refresh: false,
            requested: None,
            unsettled: None,
            last_refresh: None,
            lost: 0,
            failures: 0,
            trouble: None,
            round_trip_ns: 0,
        }
    }

    /// Takes in a coded picture that came at `now`.
    pub fn add(&mut self, header: PictureHeader, access_unit: Vec<u8>, now: ClientTime) {
        let skipped = self.order.add(Coded { header, access_unit, arrived: now });
        if skipped > 0 {
            self.lose(skipped);
        }
        self.pump();
        while self.order.is_overfull() {
            self.give_up_to_oldest();
        }
    }

    /// The connection's fastest round trip of late, nanoseconds.
    pub fn set_round_trip(&mut self, round_trip_ns: i64) {
        self.round_trip_ns = round_trip_ns.clamp(0, LONGEST_ROUND_TRIP_NS);
    }

    /// Bytes of coded pictures that wait for one before them.
    pub fn waiting_bytes(&self) -> usize {
        self.order.waiting_bytes
    }

    /// The server gave up the picture of `frame`; unknown where not a byte of it came: then it is the one awaited.
    pub fn given_up(&mut self, update: Option<UpdateId>) {
        self.order.give_up(update.unwrap_or(self.order.next));
        self.pump();
    }

    /// What is missing before the oldest picture that waits will not come: one step, however many are missing.
    fn give_up_to_oldest(&mut self) {
        let skipped = self.order.skip_to_oldest();
        self.lose(skipped);
        self.pump();
    }

    fn lose(&mut self, count: u32) {
        self.lost = self.lost.saturating_add(count);
        self.needs_refresh = true;
        self.engine.start(Job::UnitLost);
    }

    fn pump(&mut self) {
        loop {
            if self.order.dead.remove(&self.order.next) && !self.order.waiting.contains_key(&self.order.next)
            {
                self.order.next = self.order.next.next();
                self.lose(1);
                continue;
            }
            let Some(coded) = self.order.pop() else { return };
            if coded.header.is_refresh {
                self.needs_refresh = false;
                self.last_refresh = Some(coded.header.update);
                self.note_answer(coded.header.update);
            }
            if !self.engine.start(Job::Decode(coded)) {
                self.lose(1);
            }
        }
    }

    /// Does what is due at `now`, and hands on what is decoded by then.
    pub fn advance(&mut self, now: ClientTime, mut decoded: impl FnMut(Decoded)) {
        while self.order.is_hopeless(now, self.round_trip_ns) {
            self.give_up_to_oldest();
        }
        while let Some(DecodedUnit { update, arrived, decoding, result }) = self.engine.finished(now) {
            match result {
                Ok(picture) => {
                    self.last_decoded = Some(update);
                    self.failures = 0;
                    decoded(Decoded { update, arrived, decoding, picture });
                }
                Err(error) => {
                    self.lost = self.lost.saturating_add(1);
                    self.note_failure(update, &error);
                    // A refresh that is on its way heals what failed before it.
                    self.needs_refresh |= self.last_refresh.is_none_or(|refresh| refresh <= update);
                }
            }
        }
        if !self.needs_refresh {
            self.asked = None;
        }
    }

    /// One failure is a matter of a refresh; a decoder that fails with each refresh will never show anything.
    fn note_failure(&mut self, update: UpdateId, error: &DecodeError) {
        if !error.is_the_decoders() {
            return tracing::debug!("picture of update {}: {error}", update.0);
        }
        tracing::warn!("picture of update {}: {error}", update.0);
        self.failures += 1;
        if self.failures == MOST_FAILURES {
            self.trouble = Some(format!("pictures cannot be shown: {error}"));
        }
    }

    /// Why this decoder is of no use, once.
    pub fn take_trouble(&mut self) -> Option<String> {
        self.trouble.take()
    }

    /// A refresh is decoded: if a request waits for one, it is the answer.
    fn note_answer(&mut self, refresh: UpdateId) {
        if let Some(requested) = self.requested.as_mut().filter(|requested| !requested.is_answered) {
            requested.before = requested.before.max(refresh);
            requested.is_answered = true;
        }
    }

    /// The blocks of an update could not settle, for want of its picture. The server must know, unless a request has said so.
    pub fn note_unsettled(&mut self, update: UpdateId) {
        let is_known = self
            .requested
            .is_some_and(|Requested { after, before, .. }| Some(update) > after && update < before);
        if !is_known {
            self.unsettled = Some(self.unsettled.map_or(update, |first| first.min(update)));
        }
    }

    /// The request that is due at `now`, if only a refresh helps: the last update that decoded, and whose blocks have settled like
    /// those of all before it.
    pub fn refresh_request(&mut self, now: ClientTime) -> Option<Option<UpdateId>> {
        let is_due = self.asked.is_none_or(|asked| now.since(asked) >= ASK_AGAIN_NS);
        if self.unsettled.is_none() && !(self.needs_refresh && is_due) {
            return None;
        }
        let settled = self.unsettled.take().map(|update| update.0.checked_sub(1).map(UpdateId));
        let after = settled.map_or(self.last_decoded, |settled| settled.min(self.last_decoded));
        self.asked = Some(now);
        self.requested = Some(Requested { after, before: self.order.next, is_answered: false });
        Some(after)
    }

    /// Pictures lost or undecodable since the last call.
    pub fn take_lost(&mut self) -> u32 {
        std::mem::take(&mut self.lost)
    }

    /// Gives a picture back for reuse.
    pub fn recycle(&mut self, picture: Picture) {
        match &mut self.engine {
            Engine::Virtual { work, .. } => work.decoder.recycle(picture),
            // A full or closed channel only means that the picture is freed.
            Engine::Thread { spare, .. } => drop(spare.try_send(picture)),
        }
    }
}

impl Engine {
    fn thread(work: Work, now: fn() -> ClientTime) -> Self {
        let (jobs, job_receiver) = sync_channel(THREAD_QUEUE);
        let (outcome_sender, outcomes) = sync_channel(THREAD_QUEUE);
        let (spare, spare_receiver) = sync_channel(SPARE_QUEUE);
        // It may sleep until there is something for it.
        let owner = std::thread::current();
        let decode = move || {
            decode_all(work, now, &job_receiver, &spare_receiver, |outcome| {
                let is_wanted = outcome_sender.send(outcome).is_ok();
                owner.unpark();
                is_wanted
            });
        };
        let thread = std::thread::Builder::new().name("decode".into()).spawn(decode);
        if let Err(error) = &thread {
            tracing::error!("the decoding thread could not be started: {error}");
        }
        Self::Thread { jobs: Some(jobs), outcomes, spare, thread: thread.ok(), overflowed: false }
    }

    /// Starts a job. False where the queue is full: the picture is lost, and the decoder will be told.
    fn start(&mut self, job: Job) -> bool {
        match self {
            Self::Virtual { work, delay_ns, busy_until, .. } => {
                let mut began = *busy_until;
                if let Job::Decode(Coded { arrived, .. }) = &job {
                    began = began.max(*arrived);
                    *busy_until = began.plus_ns(*delay_ns);
                }
                work.start(&job, began);
                true
            }
            Self::Thread { jobs: Some(jobs), overflowed, .. } => {
                if *overflowed && jobs.try_send(Job::UnitLost).is_err() {
                    return false;
                }
                let sent = jobs.try_send(job);
                *overflowed = matches!(sent, Err(TrySendError::Full(_)));
                sent.is_ok()
            }
            Self::Thread { .. } => false,
        }
    }

    fn finished(&mut self, now: ClientTime) -> Option<DecodedUnit> {
        match self {
            Self::Virtual { work, delay_ns, done, .. } => {
                while let Some(outcome) = work.poll(Duration::ZERO, |began| began.plus_ns(*delay_ns)) {
                    done.push_back(outcome);
                }
                done.pop_front_if(|outcome| outcome.decoding[1] <= now)
            }
            Self::Thread { outcomes, .. } => outcomes.try_recv().ok(),
        }
    }
}

impl Drop for Engine {
    fn drop(&mut self) {
        if let Self::Thread { jobs, outcomes, thread, .. } = self {
            jobs.take();
            // The thread may wait for room among the outcomes.
            while outcomes.recv().is_ok() {}
            thread.take().map(JoinHandle::join);
        }
    }
}

impl Work {
    fn start(&mut self, job: &Job, began: ClientTime) {
        match job {
            Job::Decode(Coded { header, access_unit, arrived }) => {
                self.decoder.submit(access_unit);
                self.under_way.push_back(UnderWay { update: header.update, arrived: *arrived, began });
            }
            Job::UnitLost => self.decoder.unit_lost(),
        }
    }

    /// What became of the oldest picture, for which it waits at most for `timeout`; `ended` tells when, by its beginning.
    fn poll(
        &mut self,
        timeout: Duration,
        ended: impl FnOnce(ClientTime) -> ClientTime,
    ) -> Option<DecodedUnit> {
        let UnderWay { update, arrived, began } = *self.under_way.front()?;
        let result = self.decoder.poll(timeout)?;
        self.under_way.pop_front();
        Some(DecodedUnit { update, arrived, decoding: [began, ended(began)], result })
    }
}

/// Ends when the connection does.
fn decode_all(
    mut work: Work,
    now: fn() -> ClientTime,
    jobs: &Receiver<Job>,
    spare: &Receiver<Picture>,
    hand_on: impl Fn(DecodedUnit) -> bool,
) {
    loop {
        let job = match work.under_way.is_empty() {
            true => jobs.recv().map_err(|_| TryRecvError::Disconnected),
            false => jobs.try_recv(),
        };
        spare.try_iter().for_each(|picture| work.decoder.recycle(picture));
        match job {
            Ok(job) => work.start(&job, now()),
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => return,
        }
        while let Some(outcome) = work.poll(LOOK_UP, |_| now()) {
            if !hand_on(outcome) {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests;

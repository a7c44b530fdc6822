//! The pipeline with a studio and a way to clients that do what a test wants.

use super::*;
use crate::encode::{AccessUnit, Encoded, Source};
use crate::motion::delta::UpdateDelta;
use crate::motion::sender::SharedMotion;
use crate::pacing::density::Spare;
use crate::pacing::quality::QualityOptions;
use crate::pacing::share::{Budget, WayState};
use crate::serve::sessions::testing::accepted;
use ash::vk;
use shadecast_gpu::{Timing, Timings};
use shadecast_protocol::delta::{DeltaEncoder, EncodedDelta};
use shadecast_protocol::geometry::GeometryDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{Displayed, HeadState, ServerDatagram};
use shadecast_protocol::session::{Out, ServerEvent};
use shadecast_protocol::time::WorldTime;
use shadecast_protocol::wire::{StreamMessage, parse_stream};
use shadecast_protocol::world_clock::Steer;
use shadecast_system::monotonic_now_ns;
use shadecast_test_support::peers::head;
use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::rc::Rc;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

const PERIOD_NS: i64 = 20_000_000;
/// Encoders are real threads: they get this long.
const PATIENCE: Duration = Duration::from_secs(20);

fn lost() -> GpuError {
    GpuError::Vulkan { doing: "waiting for the GPU", result: vk::Result::ERROR_DEVICE_LOST }
}

/// What was sent and refused.
#[derive(Default)]
struct Recorder {
    deltas: Mutex<Vec<(PeerId, u32)>>,
    /// Frame and whether it needs no other.
    pictures: Mutex<Vec<(u32, bool)>>,
    refused: Mutex<Vec<(PeerId, Refused)>>,
    way: Mutex<WayState>,
    is_full: Mutex<bool>,
    /// Pictures that had left before each delta.
    pictures_before: Mutex<Vec<usize>>,
    /// What came between deltas, and how many of those had left.
    stamps: Mutex<Vec<(ServerDatagram, usize)>>,
}

impl Outlet for Recorder {
    fn send(&self, peer: PeerId, out: Out) -> Result<(), SendError> {
        if *self.is_full.lock().expect("whole") {
            return Err(SendError::QueueFull);
        }
        let bytes = match out {
            Out::Stream { bytes, .. } => bytes,
            Out::Datagram(bytes) => {
                let datagram = ServerDatagram::decode(&bytes).expect("a datagram");
                let deltas = self.deltas.lock().expect("whole").len();
                self.stamps.lock().expect("whole").push((datagram, deltas));
                return Ok(());
            }
            Out::Control(_) => panic!("the pipeline has nothing to say"),
        };
        match parse_stream(&bytes).expect("a stream") {
            StreamMessage::Geometry { head, .. } => {
                self.pictures_before.lock().expect("whole").push(pictures(self));
                self.deltas.lock().expect("whole").push((peer, head.update.0));
            }
            StreamMessage::Picture { header, .. } => {
                self.pictures.lock().expect("whole").push((header.update.0, header.is_refresh));
            }
            StreamMessage::Motion(_) => panic!("nothing moves"),
        }
        Ok(())
    }

    fn way(&self, _: PeerId) -> Option<WayState> {
        Some(*self.way.lock().expect("whole"))
    }

    fn refuse(&self, peer: PeerId, refused: Refused) {
        self.refused.lock().expect("whole").push((peer, refused));
    }
}

/// What one call does.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Act {
    Fail,
    Panic,
    Lose,
    /// Waits until it is let go.
    Hold,
}

/// What the next calls do; where nothing stands they succeed.
#[derive(Clone, Default)]
struct Script {
    makes: Rc<RefCell<VecDeque<Option<Act>>>>,
    updates: Rc<RefCell<VecDeque<Option<Act>>>>,
    reopens: Rc<RefCell<VecDeque<Option<Act>>>>,
    encodes: Arc<Mutex<VecDeque<Option<Act>>>>,
    /// What newcomers need is being made as long as this is set.
    is_making: Rc<Cell<bool>>,
    made: Rc<RefCell<u32>>,
    updates_made: Rc<RefCell<u32>>,
    lets_go: Arc<AtomicBool>,
    /// How many there are.
    open: Rc<RefCell<u32>>,
    encoders: Rc<RefCell<u32>>,
    /// What viewers want of the world's time.
    steered: Rc<RefCell<Vec<Steering>>>,
    /// Clients that were closed in the middle of an update.
    broken: Rc<RefCell<u32>>,
    /// What the device says that an update took.
    device_ns: Rc<Cell<i64>>,
    /// The steps of updates that were made, whose, and of which.
    steps: Rc<RefCell<Vec<(u32, Step, u32)>>>,
    /// What a step does while another update is in flight: once.
    beside: Rc<RefCell<Option<(Step, Act)>>>,
    /// How many updates were in flight when their client was closed.
    left: Rc<RefCell<u32>>,
}

fn act(acts: &Rc<RefCell<VecDeque<Option<Act>>>>) -> Result<(), GpuError> {
    let act = acts.borrow_mut().pop_front().flatten();
    done(act)
}

fn done(act: Option<Act>) -> Result<(), GpuError> {
    match act {
        None => Ok(()),
        Some(Act::Fail) => Err(GpuError::TooLarge("143 GiB for its eyes".into())),
        Some(Act::Lose) => Err(lost()),
        Some(Act::Panic) => panic!("a bug in the pipeline"),
        Some(Act::Hold) => panic!("encoders are held"),
    }
}

struct FakeStudio(Script);

impl Studio for FakeStudio {
    type Updates = FakeUpdates;
    type Opening = FakeOpening;

    fn open(
        &mut self,
        welcome: &Welcome,
        _: &Capabilities,
        pictures: Pictures,
    ) -> Result<FakeOpening, OpenError> {
        let encoder = self.start_encoder(welcome, pictures).expect("it has threads");
        *self.0.made.borrow_mut() += 1;
        act(&self.0.makes).map_err(OpenError::Device)?;
        let updates = FakeUpdates { client: *self.0.made.borrow(), ..FakeUpdates::default() };
        Ok(Some((updates, encoder)))
    }

    fn opened(&mut self, opening: &mut FakeOpening) -> Option<Result<Opened<FakeUpdates>, OpenError>> {
        if self.0.is_making.get() {
            return None;
        }
        *self.0.open.borrow_mut() += 1;
        Some(Ok(opening.take().expect("once")))
    }

    /// The device comes further whenever it is looked at.
    fn flight(&self, updates: &FakeUpdates) -> Result<Flight, GpuError> {
        let has_come = || {
            updates.looked_at.set(updates.looked_at.get() + 1);
            updates.looked_at.get().is_multiple_of(3)
        };
        Ok(Flight {
            is_begun: updates.begun.is_some(),
            is_seen: updates.begun.is_some() && has_come(),
            is_placed: updates.placed.is_some(),
            is_in_work: updates.in_work.is_some(),
            is_shaded: updates.in_work.is_some() && has_come(),
        })
    }

    fn advance(
        &mut self,
        updates: &mut FakeUpdates,
        step: Step,
        time: ServerTime,
    ) -> Result<Option<Shaded>, GpuError> {
        if step == Step::Wait || !updates.has_head {
            return Ok(None);
        }
        let others = updates.in_flight() - u32::from(step != Step::Begin && updates.in_flight() > 0);
        if others > 0 && self.0.beside.borrow().is_some_and(|(at, _)| at == step) {
            done(self.0.beside.take().map(|(_, act)| act))?;
        }
        let of = match step {
            Step::Begin => {
                act(&self.0.updates)?;
                assert!(updates.begun.is_none() && updates.in_work.is_none());
                updates.in_work = updates.placed.take();
                updates.begun = Some((UpdateId(updates.next), time));
                updates.next += 1;
                updates.begun
            }
            Step::Place => {
                assert!(updates.placed.is_none());
                // A fifth of the device's time.
                std::thread::sleep(Duration::from_nanos(self.0.device_ns.get() as u64 / 5));
                updates.placed = updates.begun.take();
                updates.placed
            }
            Step::Shade => {
                assert!(updates.in_work.is_none());
                updates.in_work = updates.placed.take();
                updates.in_work
            }
            Step::Collect | Step::Wait => updates.in_work.take(),
        };
        let (update, time) = of.expect("there is something to make the step of");
        self.0.steps.borrow_mut().push((updates.client, step, update.0));
        if step != Step::Collect {
            return Ok(None);
        }
        *self.0.updates_made.borrow_mut() += 1;
        let delta = GeometryDelta { update, time: WorldTime(time.0), ..GeometryDelta::default() };
        let delta = UpdateDelta { geometry: delta, ..UpdateDelta::default() };
        let timing = Timing { scope: "shading", began_ns: 0, took_ns: self.0.device_ns.get() };
        let timings = Timings::from_iter([timing]);
        let (sharpness, picture, blocks) = Default::default();
        Ok(Some(Shaded { update, time, sharpness, delta, picture, blocks, timings }))
    }

    fn rest(&self, _: &FakeUpdates, _: Duration) -> Result<bool, GpuError> {
        Ok(false)
    }

    fn close(&mut self, (updates, _): Opened<FakeUpdates>, has_failed: bool) {
        *self.0.left.borrow_mut() += updates.in_flight();
        *self.0.broken.borrow_mut() += u32::from(has_failed);
        *self.0.open.borrow_mut() -= 1;
    }

    fn account(&self, _: &FakeUpdates, _: &mut ViewerStats) {}

    fn quality(&self) -> QualityOptions {
        QualityOptions::default()
    }

    fn encoder(&mut self, _: &Welcome) -> Result<Box<dyn Encoder>, EncodeError> {
        *self.0.encoders.borrow_mut() += 1;
        let (acts, lets_go) = (self.0.encodes.clone(), self.0.lets_go.clone());
        Ok(Box::new(FakeEncoder { acts, lets_go, is_new: true, done: VecDeque::new() }))
    }

    fn steer(&mut self, wanted: Steering, _: ServerTime) {
        self.0.steered.borrow_mut().push(wanted);
    }

    fn reopen(&mut self) -> anyhow::Result<()> {
        Ok(act(&self.0.reopens)?)
    }
}

type FakeOpening = Option<Opened<FakeUpdates>>;

#[derive(Default)]
struct FakeUpdates {
    client: u32,
    next: u32,
    has_head: bool,
    looked_at: Cell<u32>,
    begun: Option<(UpdateId, ServerTime)>,
    placed: Option<(UpdateId, ServerTime)>,
    in_work: Option<(UpdateId, ServerTime)>,
}

impl FakeUpdates {
    fn in_flight(&self) -> u32 {
        [self.begun, self.placed, self.in_work].into_iter().flatten().count() as u32
    }
}

impl Updates for FakeUpdates {
    fn head(&mut self, _: HeadState) {
        self.has_head = true;
    }

    fn displayed(&mut self, _: &Displayed) {}

    fn interrupted(&mut self) {}

    fn set_budget(&mut self, _: Budget) {}

    fn set_spare(&mut self, _: Spare) {}

    fn set_measures(&mut self, _: crate::pacing::relief::Measures) {}

    fn note_update(&mut self, _: i64) {}

    fn coded(&mut self, _: UpdateId, _: u8) {}

    fn lost_after(&mut self, _: Option<UpdateId>) {}

    fn encode(&mut self, delta: &UpdateDelta) -> EncodedDelta {
        let mut encoder = DeltaEncoder::new(1, 1).from_delta(delta.geometry.update.0);
        encoder.encode(&delta.geometry.clone().into())
    }

    fn motion(&self) -> Option<SharedMotion> {
        None
    }

    fn recycle(&mut self, _: Shaded) {}
}

struct FakeEncoder {
    acts: Arc<Mutex<VecDeque<Option<Act>>>>,
    lets_go: Arc<AtomicBool>,
    is_new: bool,
    done: VecDeque<Encoded>,
}

impl FakeEncoder {
    fn encode(&mut self, refresh: bool) -> Result<AccessUnit, EncodeError> {
        let act = self.acts.lock().expect("whole").pop_front().flatten();
        match act {
            None => {}
            Some(Act::Panic) => panic!("a bug in the encoder"),
            Some(Act::Hold) => {
                while !self.lets_go.load(Ordering::Relaxed) {
                    std::thread::sleep(Duration::from_micros(200));
                }
            }
            Some(_) => return Err(EncodeError::Library { doing: "encoding a picture", code: 7 }),
        }
        let is_refresh = std::mem::take(&mut self.is_new) || refresh;
        Ok(AccessUnit { bytes: vec![1, 2, 3], is_refresh })
    }
}

impl Encoder for FakeEncoder {
    fn submit(&mut self, source: Source, _: i64, refresh: bool) {
        let result = self.encode(refresh);
        self.done.push_back(Encoded { source, result });
    }

    fn poll(&mut self, _: Duration) -> Option<Encoded> {
        self.done.pop_front()
    }

    fn set_qp(&mut self, _: u8) -> Result<(), EncodeError> {
        Ok(())
    }
}

/// A pipeline and all around it.
struct Bench {
    script: Script,
    outlet: Arc<Recorder>,
    mailbox: Mailbox,
}

impl Bench {
    fn new() -> Self {
        let outlet = Arc::new(Recorder::default());
        outlet.way.lock().expect("whole").window_bytes = 1 << 20;
        Self { script: Script::default(), outlet, mailbox: Mailbox::default() }
    }

    fn comes(&self, peer: u64) {
        self.mailbox.accepted(PeerId(peer), accepted());
        self.mailbox.reported(PeerId(peer), ServerEvent::Head(head(0, ServerTime(0))));
    }

    /// Steps in virtual time until `is_done`; gives what ended the server, if anything did.
    #[track_caller]
    fn run(&self, mut is_done: impl FnMut(&Recorder) -> bool) -> (anyhow::Result<()>, StreamStats) {
        let mut studio = FakeStudio(self.script.clone());
        let cadence = Cadence::default();
        let mut pipeline = Pipeline::new(
            &mut studio,
            self.outlet.clone(),
            &cadence,
            &self.mailbox,
            &|_| {},
            1e9 / PERIOD_NS as f64,
            (Traced::new(None, 0), &monotonic_now_ns),
        );
        let (begun, mut now_ns) = (Instant::now(), 0);
        loop {
            let wait = match pipeline.step(now_ns) {
                Ok(wait) => wait,
                Err(error) => return (Err(error), pipeline.finish(now_ns).0),
            };
            if is_done(&self.outlet) {
                return (Ok(()), pipeline.finish(now_ns).0);
            }
            assert!(begun.elapsed() < PATIENCE, "{:?}", self.outlet.refused.lock().expect("whole"));
            if wait > Duration::ZERO {
                now_ns += PERIOD_NS / 2;
                std::thread::sleep(Duration::from_micros(200));
            }
        }
    }

    fn refusals(&self) -> Vec<(PeerId, Refused)> {
        self.outlet.refused.lock().expect("whole").clone()
    }
}

fn pictures(recorder: &Recorder) -> usize {
    recorder.pictures.lock().expect("whole").len()
}

#[test]
fn updates_are_made_and_sent_for_the_client_that_is_there() {
    let bench = Bench::new();
    bench.comes(1);
    let (ended, stats) = bench.run(|recorder| pictures(recorder) >= 5);
    assert!(ended.is_ok() && stats.updates >= 5 && stats.clients == 1);
    let deltas = bench.outlet.deltas.lock().expect("whole").clone();
    assert!(deltas.iter().enumerate().all(|(at, delta)| *delta == (PeerId(1), at as u32)), "{deltas:?}");
    assert_eq!(bench.outlet.pictures.lock().expect("whole")[..2], [(0, true), (1, false)]);
}

#[test]
fn an_update_is_made_while_the_picture_before_is_encoded_and_leaves_after_it() {
    let bench = Bench::new();
    bench.script.encodes.lock().expect("whole").push_back(Some(Act::Hold));
    bench.comes(1);
    let mut steps = 0;
    let (ended, stats) = bench.run(|recorder| {
        let made = *bench.script.updates_made.borrow();
        steps += u32::from(made == 2);
        if steps == 50 {
            assert_eq!(
                (made, recorder.deltas.lock().expect("whole").len()),
                (2, 1),
                "one waits, and no third is made"
            );
            bench.script.lets_go.store(true, Ordering::Relaxed);
        }
        assert!(made <= 2 || steps >= 50);
        pictures(recorder) >= 4
    });
    assert!(ended.is_ok() && stats.updates >= 4);
    let pictures_before = bench.outlet.pictures_before.lock().expect("whole");
    assert!(
        pictures_before.iter().enumerate().all(|(delta, pictures)| *pictures == delta),
        "{pictures_before:?}"
    );
}

#[test]
fn each_delta_goes_right_after_a_stamp_of_the_clock() {
    let bench = Bench::new();
    bench.comes(1);
    assert!(bench.run(|recorder| pictures(recorder) >= 5).0.is_ok());
    let stamps = bench.outlet.stamps.lock().expect("whole").clone();
    let times: Vec<_> = stamps
        .iter()
        .enumerate()
        .map(|(at, (datagram, deltas))| match datagram {
            ServerDatagram::ClockStamp { server_send } if *deltas == at => server_send.0,
            other => panic!("{other:?} after {deltas} deltas"),
        })
        .collect();
    assert!(times.len() >= 5 && times.is_sorted(), "{times:?}");
}

#[test]
fn nothing_is_shaded_while_nobody_looks_and_then_at_once_a_picture_that_needs_no_other() {
    let bench = Bench::new();
    bench.comes(1);
    let (mut looks, mut before, mut after) = (0, 0, 0);
    let (ended, _) = bench.run(|recorder| {
        let deltas = recorder.deltas.lock().expect("whole").len();
        looks += u32::from(pictures(recorder) >= 3);
        match looks {
            1 => bench.mailbox.reported(PeerId(1), ServerEvent::Watching(false)),
            20 => before = deltas, // what was in flight has left
            200 => {
                after = deltas;
                bench.mailbox.reported(PeerId(1), ServerEvent::Watching(true));
            }
            _ => {}
        }
        let newest = recorder.pictures.lock().expect("whole").last().map_or(0, |(update, _)| *update);
        looks > 200 && newest as usize >= after
    });
    assert!(ended.is_ok() && before == after, "{before} updates, and {after} after two seconds");
    let pictures = bench.outlet.pictures.lock().expect("whole");
    let back = pictures.iter().find(|(update, _)| *update as usize >= after);
    assert_eq!(back, Some(&(after as u32, true)), "it needs no other");
}

#[test]
fn what_a_viewer_wants_of_the_worlds_time_comes_to_whoever_has_the_world() {
    let bench = Bench::new();
    bench.comes(1);
    let mut asked = 0;
    let (ended, _) = bench.run(|recorder| {
        if pictures(recorder) >= 3 && asked < 2 {
            bench.mailbox.reported(PeerId(1), ServerEvent::Steer(Steer::Halt.into()));
            bench.mailbox.reported(PeerId(1), ServerEvent::Steer(Steer::Step.into()));
            asked += 1;
        }
        bench.script.steered.borrow().len() >= 2
    });
    let wanted = Steering::from(Steer::Halt).then(Steer::Step.into());
    assert!(ended.is_ok());
    assert_eq!(*bench.script.steered.borrow(), [wanted, wanted]);
}

#[test]
fn several_clients_get_updates_in_turn_and_the_end_of_one_is_nothing_to_the_others() {
    let bench = Bench::new();
    (1..=3).for_each(|peer| bench.comes(peer));
    let counts = |recorder: &Recorder| {
        let deltas = recorder.deltas.lock().expect("whole");
        [1, 2, 3].map(|peer| deltas.iter().filter(|(to, _)| *to == PeerId(peer)).count())
    };
    let (mut is_gone, mut before) = (false, [0; 3]);
    let (ended, stats) = bench.run(|recorder| {
        // Encoders are real threads: each step finds them idle, so that only whose turn it is decides.
        while pictures(recorder) < recorder.deltas.lock().expect("whole").len() {
            std::thread::sleep(Duration::from_micros(200));
        }
        let counts = counts(recorder);
        if !is_gone && counts.iter().all(|count| *count >= 10) {
            assert!(counts.iter().max() <= counts.iter().min().map(|least| least + 2).as_ref(), "{counts:?}");
            bench.mailbox.gone(PeerId(2));
            (is_gone, before) = (true, counts);
        }
        is_gone && counts[0] >= before[0] + 10 && counts[2] >= before[2] + 10
    });
    assert!(ended.is_ok() && counts(&bench.outlet)[1] <= before[1] + 1);
    assert_eq!((stats.clients, stats.viewers.len(), *bench.script.open.borrow()), (3, 3, 0));
    assert_eq!(stats.viewers.iter().map(|viewer| viewer.viewer).collect::<Vec<_>>(), [2, 1, 3]);
}

#[test]
fn an_update_that_fails_for_one_client_ends_its_session_and_the_others_go_on() {
    let bench = Bench::new();
    (1..=2).for_each(|peer| bench.comes(peer));
    bench.script.updates.borrow_mut().extend([None, None, None, None, Some(Act::Panic)]);
    let (ended, stats) = bench.run(|recorder| pictures(recorder) >= 20);
    let refused = bench.refusals();
    assert!(ended.is_ok() && refused.len() == 1 && stats.refused == 1, "{refused:?}");
    let deltas = bench.outlet.deltas.lock().expect("whole").clone();
    assert!(deltas.iter().rev().take(10).all(|(peer, _)| *peer != refused[0].0), "{deltas:?}");
    assert_eq!(*bench.script.broken.borrow(), 1, "what the update had made is not believed");
}

#[test]
fn a_client_whose_pipeline_cannot_be_made_is_refused_and_the_next_one_is_served() {
    for fault in [Act::Fail, Act::Panic] {
        let bench = Bench::new();
        bench.script.makes.borrow_mut().push_back(Some(fault));
        bench.comes(1);
        let (ended, _) = bench.run(|recorder| !recorder.refused.lock().expect("whole").is_empty());
        assert!(ended.is_ok(), "{ended:?}");
        let (peer, refused) = bench.refusals().remove(0);
        let why = if fault == Act::Fail { "143 GiB" } else { "a bug in the pipeline" };
        assert!(peer == PeerId(1) && refused.reason.contains(why), "{refused:?}");
        bench.comes(2);
        let (ended, stats) = bench.run(|recorder| pictures(recorder) >= 2);
        assert!(ended.is_ok() && stats.updates >= 2);
    }
}

#[test]
fn of_300_clients_that_come_and_go_one_pipeline_is_made() {
    let bench = Bench::new();
    for peer in 0..300 {
        bench.comes(peer);
        if peer < 299 {
            bench.mailbox.gone(PeerId(peer));
        }
    }
    assert!(bench.run(|recorder| pictures(recorder) >= 1).0.is_ok());
    assert_eq!(*bench.script.made.borrow(), 1);
    assert_eq!(bench.outlet.deltas.lock().expect("whole")[0].0, PeerId(299));
}

#[test]
fn while_a_newcomer_waits_others_get_their_updates_and_what_it_tells_is_not_lost() {
    let bench = Bench::new();
    bench.comes(1);
    let of = |recorder: &Recorder, peer| {
        let deltas = recorder.deltas.lock().expect("whole");
        deltas.iter().filter(|(to, _)| *to == PeerId(peer)).count()
    };
    let (mut told, mut before) = (0, 0);
    let (ended, stats) = bench.run(|recorder| {
        let first = of(recorder, 1);
        match told {
            0 if pictures(recorder) >= 2 => {
                bench.script.is_making.set(true);
                bench.comes(2);
                bench.mailbox.reported(PeerId(2), ServerEvent::Steer(Steer::Halt.into()));
                (told, before) = (1, first);
            }
            1 if first >= before + 5 => {
                bench.mailbox.reported(PeerId(2), ServerEvent::Steer(Steer::Step.into()));
                told = 2;
            }
            2 if first >= before + 10 => {
                assert_eq!((of(recorder, 2), bench.script.steered.borrow().len()), (0, 0));
                bench.script.is_making.set(false);
                told = 3;
            }
            _ => {}
        }
        of(recorder, 2) > 0
    });
    assert!(ended.is_ok() && stats.viewers.len() == 2);
    let wanted = Steering::from(Steer::Halt).then(Steer::Step.into());
    assert_eq!(*bench.script.steered.borrow(), [wanted], "what it told while it waited, in order");
}

#[test]
fn a_newcomer_that_goes_while_it_waits_is_never_served() {
    let bench = Bench::new();
    bench.script.is_making.set(true);
    bench.comes(1);
    let mut looks = 0;
    let (ended, stats) = bench.run(|recorder| {
        looks += 1;
        if looks == 20 {
            bench.mailbox.gone(PeerId(1));
            bench.comes(2);
            bench.script.is_making.set(false);
        }
        pictures(recorder) >= 3
    });
    assert!(ended.is_ok() && stats.clients == 2 && stats.viewers.len() == 1);
    assert_eq!((*bench.script.made.borrow(), *bench.script.open.borrow()), (2, 0));
    assert!(bench.outlet.deltas.lock().expect("whole").iter().all(|(peer, _)| *peer == PeerId(2)));
}

#[test]
fn an_update_that_fails_ends_that_session_alone() {
    for fault in [Act::Fail, Act::Panic] {
        let bench = Bench::new();
        bench.script.updates.borrow_mut().extend([None, None, Some(fault)]);
        bench.comes(1);
        let (ended, _) = bench.run(|recorder| !recorder.refused.lock().expect("whole").is_empty());
        assert!(ended.is_ok() && bench.refusals()[0].0 == PeerId(1));
        bench.comes(2);
        let before = pictures(&bench.outlet);
        assert!(bench.run(|recorder| pictures(recorder) > before).0.is_ok());
    }
}

#[test]
fn an_encoder_that_fails_or_panics_is_made_anew_with_a_picture_that_needs_no_other() {
    for fault in [Act::Fail, Act::Panic] {
        let bench = Bench::new();
        bench.script.encodes.lock().expect("whole").extend([None, Some(fault)]);
        bench.comes(1);
        let (ended, stats) = bench.run(|recorder| pictures(recorder) >= 3);
        assert!(ended.is_ok() && bench.refusals().is_empty());
        assert_eq!((stats.encoder_restarts, *bench.script.encoders.borrow()), (1, 2));
        assert_eq!(bench.outlet.pictures.lock().expect("whole")[..3], [(0, true), (2, true), (3, false)]);
    }
}

#[test]
fn an_encoder_that_fails_again_and_again_ends_the_session_with_its_reason() {
    let bench = Bench::new();
    bench.script.encodes.lock().expect("whole").extend([Some(Act::Fail); 10]);
    bench.comes(1);
    let (ended, stats) = bench.run(|recorder| !recorder.refused.lock().expect("whole").is_empty());
    assert!(ended.is_ok() && pictures(&bench.outlet) == 0);
    let (peer, refused) = bench.refusals().remove(0);
    assert!(peer == PeerId(1) && refused.reason.contains("encoding a picture"), "{refused:?}");
    assert_eq!((stats.encoder_restarts, stats.refused), (MAX_ENCODER_FAILURES + 1, 1));
}

#[test]
fn a_lost_device_is_opened_again_and_clients_are_served() {
    let bench = Bench::new();
    bench.script.updates.borrow_mut().extend([None, Some(Act::Lose)]);
    bench.script.reopens.borrow_mut().extend([Some(Act::Fail), None]);
    bench.comes(1);
    let mut has_come = false;
    let (ended, stats) = bench.run(|recorder| {
        let is_refused = !recorder.refused.lock().expect("whole").is_empty();
        if is_refused && !std::mem::replace(&mut has_come, true) {
            bench.comes(2); // while the device is still away
        }
        recorder.deltas.lock().expect("whole").iter().any(|(peer, _)| *peer == PeerId(2))
    });
    assert!(ended.is_ok(), "{ended:?}");
    assert!(bench.refusals()[0].1.reason.contains("device was lost"), "{:?}", bench.refusals());
    assert_eq!(stats.devices_lost, 1);
}

#[test]
fn a_device_that_stays_lost_ends_the_server_after_some_attempts() {
    let bench = Bench::new();
    bench.script.makes.borrow_mut().push_back(Some(Act::Lose));
    bench.script.reopens.borrow_mut().extend([Some(Act::Fail); 100]);
    bench.comes(1);
    let (ended, _) = bench.run(|_| false);
    let error = ended.expect_err("it gave up").to_string();
    assert!(error.contains("again and again"), "{error}");
    assert!(bench.script.reopens.borrow().len() >= 90, "not more often than it may");
}

#[test]
fn a_delta_that_cannot_be_sent_ends_the_session_with_a_reason() {
    let bench = Bench::new();
    *bench.outlet.is_full.lock().expect("whole") = true;
    bench.comes(1);
    let (ended, _) = bench.run(|recorder| !recorder.refused.lock().expect("whole").is_empty());
    assert!(ended.is_ok());
    assert!(bench.refusals()[0].1.reason.contains("queue is full"), "{:?}", bench.refusals());
    assert_eq!(*bench.script.broken.borrow(), 0, "the update was whole; the world is as it should be");
}

#[test]
fn no_update_is_made_while_more_than_two_wait_for_the_link() {
    let bench = Bench::new();
    *bench.outlet.way.lock().expect("whole") =
        WayState { streams_under_way: u64::MAX, ..WayState::default() };
    bench.comes(1);
    let mut steps = 0;
    let (_, stats) = bench.run(|_| {
        steps += 1;
        steps > 400
    });
    assert_eq!(stats.updates, 3, "two may wait when another one is made");
}

/// A device for which updates in a row are too slow.
fn slow() -> Bench {
    let bench = Bench::new();
    bench.script.device_ns.set(PERIOD_NS * 3 / 2);
    bench
}

/// Whether one of a client's updates began before the one before it was collected.
fn has_overlapped(steps: &[(u32, Step, u32)]) -> bool {
    steps.iter().enumerate().any(|(at, (client, step, update))| {
        *step == Step::Begin && *update > 0 && !steps[..at].contains(&(*client, Step::Collect, update - 1))
    })
}

#[test]
fn updates_too_slow_in_a_row_overlap_and_leave_in_order() {
    let bench = slow();
    bench.comes(1);
    let (ended, stats) = bench.run(|recorder| pictures(recorder) >= 30);
    assert!(ended.is_ok() && stats.updates >= 30 && stats.refused == 0);
    let steps = bench.script.steps.borrow();
    assert!(has_overlapped(&steps), "{steps:?}");
    let row = [Step::Begin, Step::Place, Step::Shade, Step::Collect];
    assert!(steps[..16].chunks(4).all(|update| update.iter().map(|(_, step, _)| *step).eq(row)), "{steps:?}");
    for step in [Step::Begin, Step::Place, Step::Collect] {
        let of_step = steps.iter().filter(|(_, made, _)| *made == step);
        assert!(
            of_step.enumerate().all(|(at, (_, _, update))| at == *update as usize),
            "{step:?} of {steps:?}"
        );
    }
    let deltas = bench.outlet.deltas.lock().expect("whole").clone();
    assert!(deltas.iter().enumerate().all(|(at, delta)| *delta == (PeerId(1), at as u32)), "{deltas:?}");
}

#[test]
fn updates_that_fit_are_made_in_a_row() {
    let bench = Bench::new();
    bench.script.device_ns.set(PERIOD_NS / 2);
    bench.comes(1);
    assert!(bench.run(|recorder| pictures(recorder) >= 30).0.is_ok());
    let steps = bench.script.steps.borrow();
    assert!(
        steps.chunks(4).all(|update| update.iter().all(|(_, _, number)| *number == update[0].2)),
        "{steps:?}"
    );
}

#[test]
fn a_client_that_leaves_with_updates_in_flight_leaves_nothing_behind() {
    let bench = slow();
    bench.comes(1);
    let mut is_gone = false;
    let (ended, stats) = bench.run(|recorder| {
        let steps = bench.script.steps.borrow();
        let is_in_flight = steps.last().is_some_and(|(_, step, _)| *step != Step::Collect);
        if !is_gone && has_overlapped(&steps) && is_in_flight {
            bench.mailbox.gone(PeerId(1));
            bench.comes(2);
            is_gone = true;
        }
        let deltas = recorder.deltas.lock().expect("whole");
        deltas.iter().filter(|(peer, _)| *peer == PeerId(2)).count() >= 20
    });
    assert!(ended.is_ok() && stats.refused == 0 && stats.viewers.len() == 2, "{stats:?}");
    assert!(*bench.script.left.borrow() > 0 && *bench.script.open.borrow() == 0);
    assert_eq!(*bench.script.broken.borrow(), 0, "no step was broken off");
    let deltas = bench.outlet.deltas.lock().expect("whole");
    let second = deltas.iter().filter(|(peer, _)| *peer == PeerId(2));
    assert!(second.enumerate().all(|(at, (_, update))| at == *update as usize), "{deltas:?}");
}

#[test]
fn where_a_second_client_comes_what_is_in_flight_ends_before_its_updates_begin() {
    let bench = slow();
    bench.comes(1);
    let mut has_come = false;
    let (ended, _) = bench.run(|recorder| {
        if !has_come && has_overlapped(&bench.script.steps.borrow()) {
            bench.comes(2);
            has_come = true;
        }
        let deltas = recorder.deltas.lock().expect("whole");
        [1, 2].iter().all(|of| deltas.iter().filter(|(peer, _)| *peer == PeerId(*of)).count() >= 20)
    });
    assert!(ended.is_ok());
    let steps = bench.script.steps.borrow();
    let comes = steps.iter().position(|(client, ..)| *client == 2).expect("it is served");
    let count = |step: Step| steps[..comes].iter().filter(|(_, made, _)| *made == step).count();
    assert_eq!(count(Step::Begin), count(Step::Collect), "{steps:?}");
    assert!(
        steps[comes..].chunks(4).all(|update| update.iter().all(|step| step.0 == update[0].0)),
        "{steps:?}"
    );
}

#[test]
fn a_step_that_fails_beside_another_update_ends_that_session_alone() {
    for step in [Step::Begin, Step::Place, Step::Collect] {
        for fault in [Act::Fail, Act::Panic] {
            let bench = slow();
            *bench.script.beside.borrow_mut() = Some((step, fault));
            bench.comes(1);
            let (ended, stats) = bench.run(|recorder| !recorder.refused.lock().expect("whole").is_empty());
            assert!(ended.is_ok() && stats.refused == 1 && bench.refusals()[0].0 == PeerId(1), "{step:?}");
            assert_eq!(*bench.script.broken.borrow(), 1, "what {step:?} had made is not believed");
            bench.comes(2);
            let before = pictures(&bench.outlet);
            assert!(bench.run(|recorder| pictures(recorder) > before).0.is_ok());
        }
    }
}

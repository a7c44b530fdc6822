//! The same events lead the pipeline and the lab to the same decisions: two viewers of a run of the lab, which wrote down what it
//! decided and when, are played through the pipeline on a simulated device.

use super::*;
use crate::motion::delta::UpdateDelta;
use crate::motion::sender::SharedMotion;
use crate::pacing::density::Spare;
use crate::pacing::quality::SentPicture;
use crate::pacing::share::{Budget, WayState};
use crate::serve::scheduler::simulated::{SimulatedDevice, StepsNs};
use crate::serve::sessions::testing::accepted;
use serde::Deserialize;
use shadecast_gpu::{Timing, Timings};
use shadecast_protocol::delta::{DeltaEncoder, EncodedDelta};
use shadecast_protocol::geometry::GeometryDelta;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{Displayed, HeadState};
use shadecast_protocol::session::{Out, ServerEvent};
use shadecast_protocol::time::WorldTime;
use shadecast_test_support::peers::head;
use std::cell::RefCell;
use std::rc::Rc;

/// What `two_viewers_are_scheduled_as_recorded` of the lab wrote.
const RECORDED: &str = include_str!("two_viewers.json");

/// A run of the lab.
#[derive(Deserialize)]
struct Recorded {
    period_ns: i64,
    visibility_ns: i64,
    placement_ns: i64,
    shading_ns: i64,
    encode_ns: i64,
    /// When each viewer came.
    joined_ns: Vec<i64>,
    /// When an update of a viewer could not begin.
    headless: Vec<(i64, u64)>,
    /// When, for which viewer, and what.
    decisions: Vec<(i64, u64, String)>,
}

/// All that moves in virtual time.
struct Bench {
    now_ns: i64,
    encode_ns: i64,
    headless: Vec<(i64, u64)>,
    device: SimulatedDevice<u64>,
    /// When the encoder of each viewer is done.
    encoding: BTreeMap<u64, i64>,
    decisions: Vec<(i64, u64, String)>,
}

type Shared = Rc<RefCell<Bench>>;

impl Bench {
    fn decided(&mut self, viewer: u64, what: &str) {
        self.decisions.push((self.now_ns, viewer, what.to_owned()));
    }

    /// When something happens next, at most after so long.
    fn pass(&mut self, at_most_ns: i64) {
        let events = self.encoding.values().copied().chain(self.device.next_ns(self.now_ns));
        let next_ns = events.filter(|at_ns| *at_ns > self.now_ns).min().unwrap_or(i64::MAX);
        self.now_ns = next_ns.min(self.now_ns + at_most_ns);
    }
}

/// Every link is open and takes all.
struct Open;

impl Outlet for Open {
    fn send(&self, _: PeerId, _: Out) -> Result<(), SendError> {
        Ok(())
    }

    fn way(&self, _: PeerId) -> Option<WayState> {
        None
    }

    fn refuse(&self, peer: PeerId, refused: Refused) {
        panic!("{peer:?} is refused: {refused:?}");
    }
}

struct SimulatedStudio {
    bench: Shared,
    opened: u64,
}

struct SimulatedUpdates {
    viewer: u64,
    next: u32,
    begun: Vec<(UpdateId, ServerTime)>,
    bench: Shared,
}

struct SimulatedEncoder {
    viewer: u64,
    bench: Shared,
    job: Option<Job>,
}

impl PictureEncoder for SimulatedEncoder {
    fn give(&mut self, job: Job) {
        let mut bench = self.bench.borrow_mut();
        bench.decided(self.viewer, "hand over");
        let done_ns = bench.now_ns + bench.encode_ns;
        bench.encoding.insert(self.viewer, done_ns);
        assert!(self.job.replace(job).is_none(), "an encoder has one picture");
    }

    fn poll(&mut self) -> Option<EncodeOutcome> {
        let mut bench = self.bench.borrow_mut();
        bench.encoding.get(&self.viewer).filter(|done_ns| **done_ns <= bench.now_ns)?;
        bench.encoding.remove(&self.viewer);
        let encode_s = bench.encode_ns as f64 * 1e-9;
        let picture = SentPicture { stream_bytes: 1000, is_refresh: false, encode_s };
        self.job.take().map(|job| EncodeOutcome::Sent {
            shaded: job.shaded,
            picture,
            unit_bytes: 1000,
            bits: None,
        })
    }
}

impl Studio for SimulatedStudio {
    type Updates = SimulatedUpdates;
    type Opening = Option<Opened<SimulatedUpdates>>;

    fn open(
        &mut self,
        welcome: &Welcome,
        _: &Capabilities,
        pictures: Pictures,
    ) -> Result<Self::Opening, OpenError> {
        let encoder = self.start_encoder(welcome, pictures).expect("it is simulated");
        let viewer = self.opened;
        self.opened += 1;
        let updates = SimulatedUpdates { viewer, next: 0, begun: Vec::new(), bench: self.bench.clone() };
        Ok(Some((updates, encoder)))
    }

    fn opened(&mut self, opening: &mut Self::Opening) -> Option<Result<Opened<SimulatedUpdates>, OpenError>> {
        opening.take().map(Ok)
    }

    fn flight(&self, updates: &SimulatedUpdates) -> Result<Flight, GpuError> {
        let bench = self.bench.borrow();
        Ok(bench.device.flight(updates.viewer, bench.now_ns))
    }

    fn advance(
        &mut self,
        updates: &mut SimulatedUpdates,
        step: Step,
        now: ServerTime,
    ) -> Result<Option<Shaded>, GpuError> {
        let mut bench = self.bench.borrow_mut();
        bench.decided(updates.viewer, step.name());
        let now_ns = bench.now_ns;
        if step == Step::Begin && bench.headless.contains(&(now_ns, updates.viewer)) {
            return Ok(None);
        }
        bench.now_ns += bench.device.made(updates.viewer, step, now_ns);
        if step == Step::Begin {
            updates.begun.push((UpdateId(updates.next), now));
            updates.next += 1;
        }
        if step != Step::Collect {
            return Ok(None);
        }
        let (update, time) = updates.begun.remove(0);
        let geometry = GeometryDelta { update, time: WorldTime(time.0), ..GeometryDelta::default() };
        let delta = UpdateDelta { geometry, ..UpdateDelta::default() };
        let timing = Timing { scope: "shading", began_ns: 0, took_ns: bench.device.update_ns() };
        let timings = Timings::from_iter([timing]);
        let (sharpness, picture, blocks) = Default::default();
        Ok(Some(Shaded { update, time, sharpness, delta, picture, blocks, timings }))
    }

    fn rest(&self, _: &SimulatedUpdates, at_most: Duration) -> Result<bool, GpuError> {
        self.bench.borrow_mut().pass(at_most.as_nanos() as i64);
        Ok(true)
    }

    fn close(&mut self, _: Opened<SimulatedUpdates>, has_failed: bool) {
        assert!(!has_failed);
    }

    fn account(&self, _: &SimulatedUpdates, _: &mut ViewerStats) {}

    fn quality(&self) -> QualityOptions {
        QualityOptions::default()
    }

    fn encoder(&mut self, _: &Welcome) -> Result<Box<dyn Encoder>, EncodeError> {
        unreachable!("pictures are encoded in virtual time")
    }

    fn start_encoder(
        &mut self,
        _: &Welcome,
        Pictures { peer, .. }: Pictures,
    ) -> anyhow::Result<Box<dyn PictureEncoder>> {
        Ok(Box::new(SimulatedEncoder { viewer: peer.0, bench: self.bench.clone(), job: None }))
    }

    fn steer(&mut self, _: Steering, _: ServerTime) {}

    fn reopen(&mut self) -> anyhow::Result<()> {
        unreachable!("the device is not lost")
    }
}

impl Updates for SimulatedUpdates {
    fn head(&mut self, _: HeadState) {}

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

    fn recycle(&mut self, _: Shaded) {
        let _ = self.bench.borrow().now_ns;
    }
}

#[test]
fn the_pipeline_decides_as_the_lab_on_the_same_events() {
    let recorded: Recorded = serde_json::from_str(RECORDED).expect("a recorded run");
    let Recorded { visibility_ns, placement_ns, shading_ns, encode_ns, ref headless, .. } = recorded;
    let steps = StepsNs { visibility: visibility_ns, placement: placement_ns, shading: shading_ns };
    let bench = Rc::new(RefCell::new(Bench {
        now_ns: recorded.joined_ns[0],
        encode_ns,
        headless: headless.clone(),
        device: SimulatedDevice::new(steps),
        encoding: BTreeMap::new(),
        decisions: Vec::new(),
    }));
    let mut studio = SimulatedStudio { bench: bench.clone(), opened: 0 };
    let (cadence, mailbox) = (Cadence::default(), Mailbox::default());
    let clock = || bench.borrow().now_ns;
    let rate_hz = 1e9 / recorded.period_ns as f64;
    let mut pipeline = Pipeline::new(
        &mut studio,
        Arc::new(Open),
        &cadence,
        &mailbox,
        &|_| {},
        rate_hz,
        (Traced::new(None, 0), &clock),
    );
    assert_eq!(pipeline.scheduler.period_ns(), recorded.period_ns);
    let mut joins: Vec<(i64, u64)> = recorded.joined_ns.iter().copied().zip(0..).collect();
    let end_ns = recorded.decisions.last().expect("decisions").0;
    while clock() <= end_ns {
        for (_, viewer) in joins.extract_if(.., |(at_ns, _)| *at_ns <= clock()) {
            mailbox.accepted(PeerId(viewer), accepted());
            mailbox.reported(PeerId(viewer), ServerEvent::Head(head(0, ServerTime(0))));
        }
        let wait = pipeline.step(clock()).expect("the device is there");
        if wait > Duration::ZERO {
            let joins_ns = joins.iter().map(|(at_ns, _)| at_ns - clock()).min().unwrap_or(i64::MAX);
            bench.borrow_mut().pass(joins_ns.min(wait.as_nanos() as i64));
        }
    }
    let decisions = bench.borrow().decisions.clone();
    for (at, (here, there)) in decisions.iter().zip(&recorded.decisions).enumerate() {
        assert_eq!(here, there, "decision {at}");
    }
    assert!(decisions.len() >= recorded.decisions.len() && recorded.decisions.len() > 100);
}

//! The hand-over between the client's halves: [`crate::stream::intake`] prepares arrivals, [`crate::present::presenter`]
//! displays them. Both run on one thread or on two. Neither waits for the other; items that the other cannot take yet wait
//! here.

use crate::display::Presses;
use crate::draw::draw_list::DrawList;
use crate::draw::stages::atlas_draw::BundleMemory;
use crate::draw::stages::batch::Batch;
use crate::motion::skinned::Drawn;
use crate::motion::state::MotionState;
use crate::report::FrameReport;
use shadecast_protocol::clock::ClockEstimate;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::{HeadState, Welcome};
use shadecast_protocol::pose::Eye;
use shadecast_protocol::time::{ClientTime, WorldTime};
use shadecast_protocol::world_clock::WorldClock;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::Thread;

/// Handed over and not taken yet, at most, either way.
const CAPACITY: usize = 64;

/// A bundle that is ready to be drawn: all of it is of one update.
pub(crate) struct Bundle {
    pub(crate) memory: BundleMemory,
    /// Of which coverage its memory is; `None` before the first.
    pub(crate) coverage: Option<u64>,
    pub(crate) list: DrawList,
    /// The skinned instances on the list.
    pub(crate) drawn: Vec<Drawn>,
    /// How the list stands.
    pub(crate) state: MotionState,
    pub(crate) update: UpdateId,
    /// What its picture is shaded for.
    pub(crate) shaded: WorldTime,
    /// The bundle made before: blocks count as kept that were where they are in that one.
    pub(crate) before: Option<UpdateId>,
    /// When the last byte of its picture came.
    pub(crate) picture_arrived: ClientTime,
}

/// What is lent from one half to the other and comes back: the GPU is done with it when the intake has it.
pub(crate) enum Loan {
    Batch(Box<Batch>),
    Bundle(Box<Bundle>),
}

/// From the intake, in order; numbers are serials of connections.
#[allow(clippy::large_enum_variant, reason = "a box would be freed on the render thread")]
pub(crate) enum Prepared {
    /// What the user is to be told of the connection. It comes back.
    Status(String),
    /// A connection stands, and will bring a scene.
    Scene(Box<Welcome>, u64),
    /// What is known of its server's clock.
    Clock(ClockEstimate, u64),
    /// How its world's time goes on.
    World(WorldClock, u64),
    /// What has arrived, or what can be drawn.
    Loan(Loan, u64),
    /// A connection has ended.
    Ended(u64),
}

/// From the presenter.
#[allow(clippy::large_enum_variant, reason = "a box would be an allocation a display frame")]
pub(crate) enum Presented {
    /// A turn of the display.
    Turn(TurnNote),
    /// A loan comes back.
    Loan(Loan, u64),
    /// What was said, so that its memory is freed elsewhere.
    Said(String),
}

/// What the server may have to know of a turn of the display.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct TurnNote {
    /// Whether somebody saw it.
    pub(crate) is_seen: bool,
    pub(crate) presses: Presses,
    pub(crate) frame: Option<FrameNote>,
}

/// A display frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameNote {
    pub(crate) report: FrameReport,
    /// The connection whose scene it shows.
    pub(crate) shown: Option<u64>,
    /// When the picture came that is on display for the first time.
    pub(crate) picture_arrived: Option<ClientTime>,
    pub(crate) eyes: [Eye; 2],
    pub(crate) display_period_ns: i64,
    /// Where the head will be, for the server of a connection.
    pub(crate) head: Option<(HeadState, u64)>,
}

/// What the intake counts, for who watches.
#[derive(Debug, Default)]
pub(crate) struct Arrived {
    /// Bytes of coded pictures.
    pub(crate) atlas_bytes: AtomicU64,
    /// Bytes of deltas, samples included.
    pub(crate) geometry_bytes: AtomicU64,
    /// Positions of vertices.
    pub(crate) vertex_samples: AtomicU64,
    /// Pictures given up or undecodable.
    pub(crate) lost_pictures: AtomicU64,
    /// Refreshes asked for.
    pub(crate) refresh_requests: AtomicU64,
}

/// The intake's end.
pub(crate) struct IntakeEnd {
    to_presenter: SyncSender<Prepared>,
    /// What the presenter has had no room for.
    waiting: VecDeque<Prepared>,
    from_presenter: Receiver<Presented>,
    pub(crate) arrived: Arc<Arrived>,
}

/// The presenter's end.
pub(crate) struct PresenterEnd {
    from_intake: Receiver<Prepared>,
    to_intake: SyncSender<Presented>,
    /// Where the intake has a thread of its own, it sleeps until there is something to do.
    intake_thread: Option<Thread>,
    pub(crate) arrived: Arc<Arrived>,
}

/// Both ends.
pub(crate) fn ends() -> (PresenterEnd, IntakeEnd) {
    let (to_presenter, from_intake) = sync_channel(CAPACITY);
    let (to_intake, from_presenter) = sync_channel(CAPACITY);
    let arrived = Arc::<Arrived>::default();
    let presenter = PresenterEnd { from_intake, to_intake, intake_thread: None, arrived: arrived.clone() };
    (presenter, IntakeEnd { to_presenter, waiting: VecDeque::new(), from_presenter, arrived })
}

impl IntakeEnd {
    /// Hands over, as soon as there is room.
    pub(crate) fn give(&mut self, prepared: Prepared) {
        self.waiting.push_back(prepared);
        self.flush();
    }

    /// Hands over what there will be newer of, if there is room at once.
    pub(crate) fn offer(&mut self, prepared: Prepared) -> bool {
        self.flush();
        self.waiting.is_empty() && self.to_presenter.try_send(prepared).is_ok()
    }

    /// Hands over what waits.
    pub(crate) fn flush(&mut self) {
        while let Some(prepared) = self.waiting.pop_front() {
            // Nobody takes what comes after the presenter's end.
            if let Err(TrySendError::Full(prepared)) = self.to_presenter.try_send(prepared) {
                return self.waiting.push_front(prepared);
            }
        }
    }

    /// What has come from the presenter.
    pub(crate) fn take(&self) -> Option<Presented> {
        self.from_presenter.try_recv().ok()
    }
}

impl PresenterEnd {
    /// The intake's thread is to be woken.
    pub(crate) fn wake(&mut self, intake: Thread) {
        self.intake_thread = Some(intake);
    }

    /// What has come from the intake.
    pub(crate) fn take(&self) -> Option<Prepared> {
        self.from_intake.try_recv().ok()
    }

    /// Tells of a turn of the display. Of an intake that has not run for a second the server knows nothing anyway: it is not told.
    pub(crate) fn report(&mut self, note: TurnNote) {
        self.give(Presented::Turn(note));
    }

    /// Gives back what was said.
    pub(crate) fn give_back(&mut self, said: String) {
        self.give(Presented::Said(said));
    }

    /// Gives a loan; it comes back where there is no room.
    pub(crate) fn lend(&mut self, loan: Loan, serial: u64) -> Option<Loan> {
        match self.give(Presented::Loan(loan, serial)) {
            Some(Presented::Loan(loan, _)) => Some(loan),
            _ => None,
        }
    }

    fn give(&mut self, presented: Presented) -> Option<Presented> {
        match self.to_intake.try_send(presented) {
            Err(TrySendError::Full(presented)) => Some(presented),
            // Nobody takes what comes after the intake's end.
            _ => {
                self.intake_thread.iter().for_each(Thread::unpark);
                None
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn given_items_wait_for_the_presenter_and_offered_ones_do_not() {
        let (presenter, mut intake) = ends();
        let word = |number: usize| Prepared::Status(number.to_string());
        assert!((0..CAPACITY).all(|number| intake.offer(word(number))));
        assert!(!intake.offer(word(CAPACITY)) && intake.waiting.is_empty());
        intake.give(word(CAPACITY));
        assert!(!intake.offer(word(CAPACITY + 1)), "nothing overtakes what waits");
        let taken = std::iter::from_fn(|| presenter.take()).count();
        assert_eq!(taken, CAPACITY);
        assert!(intake.offer(word(CAPACITY + 1)));
        let last: Vec<String> = std::iter::from_fn(|| presenter.take())
            .map(|prepared| match prepared {
                Prepared::Status(text) => text,
                _ => unreachable!("only words were given"),
            })
            .collect();
        assert_eq!(last, ["64", "65"]);
    }

    #[test]
    fn neither_half_minds_that_the_other_is_gone() {
        let (presenter, mut intake) = ends();
        drop(presenter);
        intake.give(Prepared::Ended(1));
        assert!(intake.waiting.is_empty());
        let (mut presenter, intake) = ends();
        drop(intake);
        presenter.report(TurnNote::default());
        assert!(presenter.take().is_none());
    }
}

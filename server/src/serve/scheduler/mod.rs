//! Decides which step of which viewer's updates comes next. Pure: times, the device's progress and the state of links come in,
//! actions come out. Two drivers carry them out: the pipeline's thread and the lab in virtual time.
//!
//! One viewer's updates are in flight at a time, since those of others take the places of their samples. Of the viewers that are
//! due, the one with the least device time is next (`turns`). Updates of a lone viewer overlap where that pays (`Overlap`). An
//! update waits for the encoder of its viewer before it leaves, and none begins that would wait long.

pub mod simulated;
pub(crate) mod turns;

use crate::pacing::overlap::{Flight, Overlap, Step, StepTimes};
use std::collections::BTreeMap;
use turns::{Share, Turns};

/// The shortest and the longest sleep of a driver that has something to wait for, nanoseconds.
pub(crate) const SHORTEST_WAIT_NS: i64 = 500_000;
/// See `SHORTEST_WAIT_NS`.
pub const LONGEST_WAIT_NS: i64 = 5_000_000;
/// How long a driver sleeps while no update is wanted, nanoseconds.
const IDLE_WAIT_NS: i64 = 50_000_000;

/// What a decision needs to know at the moment it is made.
pub trait Situation<V> {
    /// Why the device cannot say.
    type Error;

    /// How far the device has come with a viewer's updates.
    ///
    /// # Errors
    /// The device is lost.
    fn flight(&mut self, viewer: V) -> Result<Flight, Self::Error>;

    /// Whether the link to a viewer takes another update.
    fn is_open(&mut self, viewer: V, now_ns: i64) -> bool;
}

/// What a driver does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Action<V> {
    /// Make a step of this viewer's updates, then report [`Scheduler::completed`].
    Make(V, Step),
    /// Send the delta of this viewer's shaded update, give its picture to the encoder, then report [`Scheduler::handed_over`].
    HandOver(V),
    /// Nothing, until the device has come further with this viewer's updates, for so many nanoseconds at most.
    AwaitDevice(V, i64),
    /// Nothing for so many nanoseconds, unless news arrive.
    Sleep(i64),
}

/// What the steps of one update took, once it is shaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UpdateCost {
    /// Device and CPU, in a row, nanoseconds.
    pub took_ns: i64,
    /// Since the update before was shaded, where neither its viewer's period nor its link held this one back, nanoseconds.
    pub apart_ns: Option<i64>,
    /// Viewers that share the device.
    pub viewers: usize,
}

impl UpdateCost {
    /// Seconds of the device's time between two updates of this viewer, while it is shared.
    pub fn shared_s(self) -> f64 {
        self.took_ns as f64 * 1e-9 * self.viewers as f64
    }

    /// Seconds between two updates, as far as this machine is their bound: other programs and the encoder take part in it too.
    pub fn apart_s(self) -> f64 {
        self.apart_ns.map_or(0.0, |apart_ns| apart_ns as f64 * 1e-9).max(self.shared_s())
    }
}

/// A viewer, as far as its turns go.
#[derive(Clone, Debug)]
struct Seat {
    /// When the next update is due; `None` while nobody looks.
    due_ns: Option<i64>,
    overlap: Overlap,
    is_in_flight: bool,
    /// Since the last update was collected, none was due for a while, or the link took none.
    was_held_back: bool,
    /// When the last update was collected.
    collected_ns: Option<i64>,
    /// CPU time of its steps since the last update was collected, nanoseconds.
    cpu_ns: i64,
    /// A shaded update waits for the encoder.
    is_made: bool,
    is_encoding: bool,
    /// What the last update took in a row, and its picture in the encoder, nanoseconds.
    update_ns: i64,
    encode_ns: i64,
    /// When the encoder is expected to be done.
    encoded_ns: i64,
    share: Share,
}

/// See the module. `V` names viewers.
#[derive(Clone, Debug)]
pub struct Scheduler<V> {
    period_ns: i64,
    seats: BTreeMap<V, Seat>,
    turns: Turns,
}

impl<V: Copy + Ord> Scheduler<V> {
    /// For viewers that want an update in each `period_ns`.
    pub fn new(period_ns: i64) -> Self {
        Self { period_ns, seats: BTreeMap::new(), turns: Turns::default() }
    }

    /// Nanoseconds from one update of a viewer to the next.
    pub fn period_ns(&self) -> i64 {
        self.period_ns
    }

    /// A viewer has come; its first update is due at once.
    pub fn join(&mut self, viewer: V, now_ns: i64) {
        let seat = Seat {
            due_ns: Some(now_ns),
            overlap: Overlap::new(self.period_ns),
            is_in_flight: false,
            was_held_back: true,
            collected_ns: None,
            cpu_ns: 0,
            is_made: false,
            is_encoding: false,
            update_ns: 0,
            encode_ns: 0,
            encoded_ns: now_ns,
            share: self.turns.join(),
        };
        self.seats.insert(viewer, seat);
    }

    /// A viewer has gone.
    pub fn leave(&mut self, viewer: V) {
        self.seats.remove(&viewer);
    }

    /// Whether somebody looks. Updates pause while nobody does; after that the first is due at once.
    pub fn watch(&mut self, viewer: V, is_watched: bool, now_ns: i64) {
        let Some(seat) = self.seats.get_mut(&viewer) else { return };
        if seat.due_ns.is_some() != is_watched {
            seat.due_ns = is_watched.then_some(now_ns);
        }
    }

    /// The encoder of a viewer has no picture any more. `took_ns`: what the last one took; `None` where it has failed.
    pub fn encoded(&mut self, viewer: V, took_ns: Option<i64>) {
        let Some(seat) = self.seats.get_mut(&viewer) else { return };
        seat.is_encoding = false;
        took_ns.into_iter().for_each(|took_ns| seat.encode_ns = took_ns);
    }

    /// A viewer's update has left, and its encoder has the picture.
    pub fn handed_over(&mut self, viewer: V, now_ns: i64) {
        let Some(seat) = self.seats.get_mut(&viewer) else { return };
        (seat.is_made, seat.is_encoding) = (false, true);
        seat.encoded_ns = now_ns + seat.encode_ns;
    }

    /// A step is made, which took `cpu_ns` of the CPU. `device_ns`: what the device did for the update that it has collected.
    /// Gives what that update took.
    pub fn completed(
        &mut self,
        (viewer, step): (V, Step),
        cpu_ns: i64,
        device_ns: Option<i64>,
        begun_ns: i64,
    ) -> Option<UpdateCost> {
        let viewers = self.seats.len();
        let seat = self.seats.get_mut(&viewer)?;
        seat.cpu_ns += cpu_ns;
        if step == Step::Begin {
            // A late update does not make the next ones hurry.
            let next_ns = |due_ns: i64| (due_ns + self.period_ns).max(begun_ns - self.period_ns);
            seat.due_ns = seat.due_ns.map(next_ns);
        }
        seat.is_in_flight = true; // unless the device says otherwise when it is asked next
        let device_ns = device_ns?;
        let collected_ns = begun_ns + cpu_ns;
        let cpu_ns = std::mem::take(&mut seat.cpu_ns);
        seat.update_ns = cpu_ns + device_ns;
        seat.is_made = true;
        let before_ns = seat.collected_ns.replace(collected_ns);
        let was_held_back = std::mem::take(&mut seat.was_held_back);
        let apart_ns = before_ns.filter(|_| !was_held_back).map(|before_ns| collected_ns - before_ns);
        self.turns.served(&mut seat.share, seat.update_ns);
        seat.overlap.note(StepTimes { device_ns, placement_ns: cpu_ns, encode_ns: seat.encode_ns });
        Some(UpdateCost { took_ns: seat.update_ns, apart_ns, viewers })
    }

    /// What is next.
    ///
    /// # Errors
    /// The device cannot say how far it has come with the updates of the viewer that is named.
    pub fn poll<S: Situation<V>>(
        &mut self,
        now_ns: i64,
        situation: &mut S,
    ) -> Result<Action<V>, (V, S::Error)> {
        if let Some((viewer, _)) = self.seats.iter().find(|(_, seat)| seat.is_made && !seat.is_encoding) {
            return Ok(Action::HandOver(*viewer));
        }
        if let Some(viewer) = self.in_flight() {
            let flight = self.flight(viewer, situation)?;
            if flight.is_any() {
                let may_begin =
                    self.overlaps(viewer) && self.next_to_begin(now_ns, situation) == Some(viewer);
                return Ok(match self.step(viewer, flight, may_begin) {
                    Step::Wait => Action::AwaitDevice(viewer, self.await_ns(now_ns)),
                    step => Action::Make(viewer, step),
                });
            }
        }
        Ok(match self.next_to_begin(now_ns, situation) {
            Some(viewer) => Action::Make(viewer, Step::Begin),
            None => Action::Sleep(self.rest_ns(now_ns)),
        })
    }

    /// Whose updates are in flight.
    fn in_flight(&self) -> Option<V> {
        self.seats.iter().find(|(_, seat)| seat.is_in_flight).map(|(viewer, _)| *viewer)
    }

    fn flight<S: Situation<V>>(&mut self, viewer: V, situation: &mut S) -> Result<Flight, (V, S::Error)> {
        let flight = situation.flight(viewer).map_err(|error| (viewer, error))?;
        if let Some(seat) = self.seats.get_mut(&viewer) {
            seat.is_in_flight = flight.is_any();
        }
        Ok(flight)
    }

    /// Whether a viewer's updates overlap: nobody else's come between.
    fn overlaps(&self, viewer: V) -> bool {
        self.seats.len() == 1 && self.seats.get(&viewer).is_some_and(|seat| seat.overlap.is_on())
    }

    /// The next step of what is in flight; an update is collected once the one before has left.
    fn step(&self, viewer: V, mut flight: Flight, may_begin: bool) -> Step {
        let Some(seat) = self.seats.get(&viewer) else { return Step::Wait };
        flight.is_shaded &= !seat.is_made;
        seat.overlap.step(flight, self.seats.len() == 1, may_begin)
    }

    /// Of the viewers whose update is due, whose link is open, and which would not wait for an encoder, the one with the least
    /// device time; of equals the one that waits longest.
    fn next_to_begin<S: Situation<V>>(&mut self, now_ns: i64, situation: &mut S) -> Option<V> {
        let mut next: Option<([i64; 2], V)> = None;
        for (viewer, seat) in &mut self.seats {
            let Some(due_ns) = seat.due_ns.filter(|due_ns| *due_ns <= now_ns) else {
                seat.was_held_back = true;
                continue;
            };
            if seat.is_made || seat.would_wait(now_ns) {
                continue;
            }
            if !situation.is_open(*viewer, now_ns) {
                seat.was_held_back = true;
                continue;
            }
            let order = [self.turns.order(seat.share), due_ns];
            if next.is_none_or(|(least, _)| order < least) {
                next = Some((order, *viewer));
            }
        }
        next.map(|(_, viewer)| viewer)
    }

    /// How long to wait for the device: an update that overlaps may become due meanwhile.
    fn await_ns(&self, now_ns: i64) -> i64 {
        let due_ns =
            self.seats.values().filter_map(|seat| seat.due_ns).filter(|due_ns| *due_ns > now_ns).min();
        due_ns.map_or(LONGEST_WAIT_NS, |due_ns| (due_ns - now_ns).min(LONGEST_WAIT_NS))
    }

    /// How long nothing is due, as far as is known.
    fn rest_ns(&self, now_ns: i64) -> i64 {
        let due_ns = self.seats.values().filter_map(|seat| seat.due_ns).min();
        match due_ns {
            None => IDLE_WAIT_NS,
            Some(due_ns) if due_ns > now_ns => (due_ns - now_ns).min(LONGEST_WAIT_NS),
            Some(_) => SHORTEST_WAIT_NS, // its link is closed, or its encoder is busy
        }
    }
}

impl Seat {
    /// Whether an update that begins now would be shaded long before the encoder is done: its views would be older for it.
    fn would_wait(&self, now_ns: i64) -> bool {
        self.is_encoding && now_ns + self.update_ns < self.encoded_ns
    }
}

#[cfg(test)]
mod tests;

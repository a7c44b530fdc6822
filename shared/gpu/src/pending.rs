//! Unfinished recordings, in the order of their serials. Threads query them, wait for them and take their slots back in
//! parallel. The lock is held for a few memory accesses, never for a driver call.

use crate::lock::Lock;
use ash::vk;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// See the module. `S` is what comes back when a recording has finished.
pub(crate) struct Pending<S> {
    entries: Lock<VecDeque<(u64, State<S>)>>,
    /// The last serial that was given.
    begun: AtomicU64,
    /// It and all before it have finished.
    completed: AtomicU64,
}

enum State<S> {
    /// It has a serial.
    Begun,
    /// The device has it.
    Submitted(S, Arc<vk::Fence>),
    /// It has finished, and a thread takes the slot back.
    Taken,
}

/// How a recording can be waited for.
pub(crate) enum Fence {
    /// It has finished.
    Done,
    /// It has, and its slot is being taken back.
    Signalled,
    /// By this fence, which nobody resets while it is held.
    Submitted(Arc<vk::Fence>),
}

impl<S> Default for Pending<S> {
    fn default() -> Self {
        Self { entries: Lock::default(), begun: AtomicU64::new(0), completed: AtomicU64::new(0) }
    }
}

impl<S> Pending<S> {
    /// The last serial that was given; 0 before the first.
    pub(crate) fn last_begun(&self) -> u64 {
        self.begun.load(Ordering::Acquire)
    }

    /// This serial and all before it have finished.
    pub(crate) fn completed(&self) -> u64 {
        self.completed.load(Ordering::Acquire)
    }

    /// The serial of a recording that is to be submitted next.
    pub(crate) fn begin(&self) -> u64 {
        let mut entries = self.entries.lock();
        let serial = self.begun.fetch_add(1, Ordering::AcqRel) + 1;
        entries.push_back((serial, State::Begun));
        serial
    }

    /// The device has it.
    pub(crate) fn submitted(&self, serial: u64, slot: S, fence: Arc<vk::Fence>) {
        let mut entries = self.entries.lock();
        let place = place(&entries, serial).expect("it has begun");
        entries[place].1 = State::Submitted(slot, fence);
    }

    /// The first of those that the device has after a serial.
    pub(crate) fn next_submitted(&self, after: u64) -> Option<(u64, Arc<vk::Fence>)> {
        let entries = self.entries.lock();
        let first = entries.partition_point(|(serial, _)| *serial <= after);
        entries.range(first..).find_map(|(serial, state)| match state {
            State::Submitted(_, fence) => Some((*serial, fence.clone())),
            State::Begun | State::Taken => None,
        })
    }

    /// The slot of a recording whose fence has signalled: to one of those who ask. It counts as unfinished until it is forgotten.
    pub(crate) fn take(&self, serial: u64) -> Option<S> {
        let mut entries = self.entries.lock();
        let place = place(&entries, serial)?;
        match std::mem::replace(&mut entries[place].1, State::Taken) {
            State::Submitted(slot, _) => Some(slot),
            State::Begun | State::Taken => None,
        }
    }

    /// A recording has finished, or was not submitted.
    pub(crate) fn forget(&self, serial: u64) {
        let mut entries = self.entries.lock();
        if let Some(place) = place(&entries, serial) {
            entries.remove(place);
        }
    }

    /// Finds out anew up to which serial all have finished.
    pub(crate) fn note_completed(&self) {
        let entries = self.entries.lock();
        // No serial is given while this lock is held.
        let oldest = entries.front().map_or(self.last_begun() + 1, |(serial, _)| *serial);
        self.completed.store(oldest - 1, Ordering::Release);
    }

    pub(crate) fn is_done(&self, serial: u64) -> bool {
        place(&self.entries.lock(), serial).is_none()
    }

    pub(crate) fn fence_of(&self, serial: u64) -> Fence {
        let entries = self.entries.lock();
        match place(&entries, serial).map(|place| &entries[place].1) {
            None => Fence::Done,
            Some(State::Submitted(_, fence)) => Fence::Submitted(fence.clone()),
            Some(State::Begun | State::Taken) => Fence::Signalled,
        }
    }

    /// The slots that the device has, once it is idle.
    pub(crate) fn drain(&self) -> Vec<S> {
        let mut entries = self.entries.lock();
        let slots = entries.drain(..).filter_map(|(_, state)| match state {
            State::Submitted(slot, _) => Some(slot),
            State::Begun | State::Taken => None,
        });
        slots.collect()
    }
}

fn place<S>(entries: &VecDeque<(u64, State<S>)>, serial: u64) -> Option<usize> {
    entries.binary_search_by_key(&serial, |(serial, _)| *serial).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn submit(pending: &Pending<&'static str>, slot: &'static str) -> u64 {
        let serial = pending.begin();
        pending.submitted(serial, slot, Arc::default());
        serial
    }

    #[test]
    fn what_is_being_submitted_or_taken_back_has_not_finished() {
        let pending = Pending::default();
        let begun = pending.begin();
        assert!(pending.next_submitted(0).is_none() && !pending.is_done(begun));
        pending.submitted(begun, "slot", Arc::default());
        assert_eq!(pending.next_submitted(0).map(|(serial, _)| serial), Some(begun));
        assert_eq!((pending.take(begun), pending.take(begun)), (Some("slot"), None), "once");
        assert!(!pending.is_done(begun) && pending.next_submitted(0).is_none());
        assert!(matches!(pending.fence_of(begun), Fence::Signalled));
        pending.note_completed();
        assert_eq!(pending.completed(), 0);
        pending.forget(begun);
        pending.note_completed();
        assert_eq!((pending.is_done(begun), pending.completed()), (true, 1));
    }

    #[test]
    fn all_before_the_oldest_pending_have_finished() {
        let pending = Pending::default();
        let [a, b, c] = ["a", "b", "c"].map(|slot| submit(&pending, slot));
        assert_eq!(pending.next_submitted(a).map(|(serial, _)| serial), Some(b));
        pending.take(b).expect("there");
        pending.forget(b);
        pending.note_completed();
        assert_eq!((pending.completed(), pending.is_done(b), pending.is_done(a)), (0, true, false));
        pending.take(a).expect("there");
        pending.forget(a);
        pending.note_completed();
        assert_eq!(pending.completed(), 2);
        assert_eq!((pending.drain(), pending.last_begun()), (vec!["c"], c));
    }

    #[test]
    fn a_fence_that_somebody_waits_for_is_known_to_be_his() {
        let pending = Pending::default();
        let serial = submit(&pending, "slot");
        let Fence::Submitted(waited_for) = pending.fence_of(serial) else { panic!("it was submitted") };
        assert_eq!(Arc::strong_count(&waited_for), 2);
        pending.take(serial).expect("there");
        pending.forget(serial);
        assert_eq!(Arc::strong_count(&waited_for), 1, "and by nobody else");
    }
}

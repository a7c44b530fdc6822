//! Free slots of the client's memory. A freed slot waits for the display of the update that freed it.

use shadecast_protocol::bit_set::BitSet;
use shadecast_protocol::ids::UpdateId;
use std::collections::VecDeque;

/// While less than one of so many slots is free, retained patches go at once.
const LOW_WATER: u32 = 8;

/// Slots handed out from the lowest on, and taken back once a frame has been displayed.
#[derive(Debug)]
pub(super) struct Slots {
    pub count: u32,
    pub free: BitSet,
    leaving: VecDeque<(UpdateId, u32)>,
}

impl Slots {
    pub(super) fn new(count: u32) -> Self {
        Self { count, free: BitSet::all(count as usize), leaving: VecDeque::new() }
    }

    pub(super) fn are_short(&self) -> bool {
        self.free.count() < (self.count / LOW_WATER) as usize
    }

    pub(super) fn take(&mut self) -> Option<u32> {
        self.free.pop_first().map(|slot| slot as u32)
    }

    pub(super) fn leave(&mut self, update: UpdateId, slot: u32) {
        self.leaving.push_back((update, slot));
    }

    pub(super) fn displayed(&mut self, update: UpdateId) {
        while self.leaving.front().is_some_and(|(left, _)| *left <= update) {
            if let Some((_, slot)) = self.leaving.pop_front() {
                self.free.insert(slot as usize);
            }
        }
    }
}

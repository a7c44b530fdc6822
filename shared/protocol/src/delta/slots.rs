//! Slots of the client's memory in ascending order: told as ranks among those that can be meant.

use crate::bit_set::BitSet;
use crate::range::{Coder, Number};
use crate::wire::{WireError, invalid};

/// A set of slots, of which ranks are asked for.
#[derive(Clone, Debug)]
pub(super) struct Slots {
    set: BitSet,
    count: u32,
}

/// A rank is coded according to the one before it.
const CLASSES: usize = 3;

/// How far apart the slots of a list are.
#[derive(Clone, Debug, Default)]
pub(super) struct Gaps {
    count: Number,
    gaps: [Number; CLASSES],
}

impl Slots {
    /// None of so many.
    pub(super) fn none(count: u32) -> Self {
        Self { set: BitSet::none(count as usize), count }
    }

    /// How many slots there are.
    pub(super) fn count(&self) -> u32 {
        self.count
    }

    pub(super) fn contains(&self, slot: u32) -> bool {
        slot < self.count && self.set.contains(slot as usize)
    }

    /// Slots that do not exist are left out.
    pub(super) fn insert(&mut self, slot: u32) {
        if slot < self.count {
            self.set.insert(slot as usize);
        }
    }

    pub(super) fn remove(&mut self, slot: u32) {
        if slot < self.count {
            self.set.remove(slot as usize);
        }
    }

    /// The same number of slots: those in it that are not in the other.
    pub(super) fn without<'a>(&'a self, other: &'a Self) -> impl Fn(usize) -> u64 + Copy + 'a {
        move |word| self.set.word(word) & !other.set.word(word)
    }

    /// Those in it.
    pub(super) fn these(&self) -> impl Fn(usize) -> u64 + Copy + '_ {
        move |word| self.set.word(word)
    }

    /// Those not in it, and some beyond the last.
    pub(super) fn others(&self) -> impl Fn(usize) -> u64 + Copy + '_ {
        move |word| !self.set.word(word)
    }
}

/// How many slots of a set lie in `first..end`, which exist.
pub(super) fn between(words: impl Fn(usize) -> u64, first: u32, end: u32) -> u32 {
    if end <= first {
        return 0;
    }
    let (from, last) = (first as usize / 64, (end - 1) as usize / 64);
    let masked = |word: usize| {
        let below_end = if word == last { u64::MAX >> (63 - (end - 1) % 64) } else { u64::MAX };
        let from_first = if word == from { u64::MAX << (first % 64) } else { u64::MAX };
        words(word) & below_end & from_first
    };
    (from..=last).map(|word| masked(word).count_ones()).sum()
}

/// The slot of a set from `first` on, below `end`, after so many others of it.
fn nth(words: impl Fn(usize) -> u64, first: u32, end: u32, mut rank: u32) -> Option<u32> {
    let mut mask = u64::MAX << (first % 64);
    for index in first as usize / 64..end.div_ceil(64) as usize {
        let mut word = words(index) & std::mem::replace(&mut mask, u64::MAX);
        let ones = word.count_ones();
        if rank >= ones {
            rank -= ones;
            continue;
        }
        for _ in 0..rank {
            word &= word - 1;
        }
        return Some(index as u32 * 64 + word.trailing_zeros()).filter(|slot| *slot < end);
    }
    None
}

/// The next slot of a set from `*cursor` on, `slot` where it is told; the cursor is after it then.
pub(super) fn code_slot(
    coder: &mut impl Coder,
    number: &mut Number,
    words: impl Fn(usize) -> u64 + Copy,
    (cursor, end): (&mut u32, u32),
    slot: u32,
) -> Result<u32, WireError> {
    let told = if slot < end { between(words, *cursor, slot) } else { u32::MAX };
    let rank = number.code(coder, told);
    let Some(slot) = nth(words, *cursor, end, rank) else {
        return Err(invalid("a slot", format!("slot {end} of {end} does not exist, or is not meant")));
    };
    *cursor = slot + 1;
    Ok(slot)
}

impl Gaps {
    /// Slots of a set in ascending order, `told` where they are told. `each` follows every slot.
    pub(super) fn code<C: Coder>(
        &mut self,
        coder: &mut C,
        (words, end): (impl Fn(usize) -> u64 + Copy, u32),
        told: impl ExactSizeIterator<Item = u32>,
        mut each: impl FnMut(&mut C, u32) -> Result<(), WireError>,
    ) -> Result<(), WireError> {
        let mut told = told;
        let count = self.count.code(coder, told.len() as u32);
        let (mut cursor, mut class) = (0, CLASSES - 1);
        for _ in 0..count {
            let first = cursor;
            let place = (&mut cursor, end);
            let slot = code_slot(coder, &mut self.gaps[class], words, place, told.next().unwrap_or(0))?;
            each(coder, slot)?;
            class = match slot - first {
                0 => 0,
                1..8 => 1,
                _ => 2,
            };
            if !coder.is_intact() {
                return Err(invalid("a list of slots", "it ends too early"));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Dice;

    #[test]
    fn ranks_count_the_slots_of_a_set() {
        let mut dice = Dice::new(4);
        for count in [1, 63, 64, 65, 200] {
            let mut slots = Slots::none(count);
            (0..count).filter(|_| !dice.once_in(3)).for_each(|slot| slots.insert(slot));
            let taken: Vec<u32> = (0..count).filter(|slot| slots.contains(*slot)).collect();
            for first in 0..count {
                let from = taken.partition_point(|slot| *slot < first);
                for (rank, slot) in (0..).zip(&taken[from..]) {
                    assert_eq!(nth(slots.these(), first, count, rank), Some(*slot));
                    assert_eq!(between(slots.these(), first, *slot), rank);
                }
                assert_eq!(nth(slots.these(), first, count, (taken.len() - from) as u32), None);
                let free = (first..count).find(|slot| !slots.contains(*slot));
                assert_eq!(nth(slots.others(), first, count, 0), free, "none beyond the last");
            }
            let even = (0..count).step_by(2).fold(Slots::none(count), |mut even, slot| {
                even.insert(slot);
                even
            });
            let odd = between(slots.without(&even), 0, count);
            assert_eq!(odd as usize, taken.iter().filter(|slot| *slot % 2 == 1).count());
        }
    }

    #[test]
    fn slots_that_do_not_exist_are_in_no_set() {
        let mut slots = Slots::none(10);
        slots.insert(10);
        slots.remove(900);
        assert!(!slots.contains(10) && !slots.contains(900));
        assert_eq!(nth(slots.these(), 0, 10, 0), None);
    }
}

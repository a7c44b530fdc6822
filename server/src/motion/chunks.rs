//! Chunks of clips in one client's arena, and their places. Chunks stay while there is room. Then, of the chunks not needed
//! soon, the last needed one goes: in a loop it is needed again the latest.

use shadecast_protocol::ids::ClipId;
use shadecast_protocol::time::ServerTime;
use std::collections::BTreeMap;
use std::ops::Range;

/// A chunk of a clip.
pub(crate) type ChunkKey = (ClipId, u32);

/// See the module.
#[derive(Clone, Debug)]
pub(crate) struct Chunks {
    /// First word and number of words of each run that is free, neither empty nor touching another.
    free: BTreeMap<u32, u32>,
    resident: BTreeMap<ChunkKey, Resident>,
    evicted: Vec<ChunkKey>,
    /// All words, free or not.
    words: Range<u32>,
}

#[derive(Clone, Copy, Debug)]
struct Resident {
    first_word: u32,
    words: u32,
    needed: ServerTime,
}

impl Chunks {
    /// With these words of an arena, all free.
    pub(crate) fn new(words: Range<u32>) -> Self {
        let free = (words.start < words.end).then(|| (words.start, words.end - words.start));
        Self { free: free.into_iter().collect(), resident: BTreeMap::new(), evicted: Vec::new(), words }
    }

    /// Notes that a chunk is needed at `now` or soon; true where it is there.
    pub(crate) fn need(&mut self, key: ChunkKey, now: ServerTime) -> bool {
        match self.resident.get_mut(&key) {
            Some(resident) => {
                resident.needed = now;
                true
            }
            None => false,
        }
    }

    /// Whether a chunk is there.
    pub(crate) fn has(&self, key: ChunkKey) -> bool {
        self.resident.contains_key(&key)
    }

    /// Makes room for a chunk of so many words, at the cost of those that are not needed at `now`; its first word. `None`: there
    /// is no room, and nothing has gone.
    pub(crate) fn place(&mut self, key: ChunkKey, words: u32, now: ServerTime) -> Option<u32> {
        loop {
            if let Some(first_word) = self.take(words) {
                self.resident.insert(key, Resident { first_word, words, needed: now });
                return Some(first_word);
            }
            // Else what goes in vain would be sent again, with every tick.
            if self.room_beside_needed(now) < words {
                return None;
            }
            let dispensable = self.resident.iter().filter(|(_, resident)| resident.needed < now);
            let (victim, _) = dispensable.max_by_key(|(key, resident)| (resident.needed, **key))?;
            let victim = *victim;
            self.evict(victim);
            self.evicted.push(victim);
        }
    }

    /// The longest run of words that hold nothing that is needed at `now`.
    fn room_beside_needed(&self, now: ServerTime) -> u32 {
        let needed = self.resident.values().filter(|resident| resident.needed >= now);
        let mut needed: Vec<[u32; 2]> =
            needed.map(|Resident { first_word, words, .. }| [*first_word, first_word + words]).collect();
        needed.sort_unstable();
        let starts = needed.iter().map(|[start, _]| *start).chain([self.words.end]);
        let ends = std::iter::once(self.words.start).chain(needed.iter().map(|[_, end]| *end));
        ends.zip(starts).map(|(end, start)| start.saturating_sub(end)).max().unwrap_or(0)
    }

    /// What had to make room since this was asked last.
    pub(crate) fn take_evicted(&mut self) -> Vec<ChunkKey> {
        std::mem::take(&mut self.evicted)
    }

    /// As [`Self::place`], at nobody's cost.
    pub(crate) fn place_beside(&mut self, key: ChunkKey, words: u32, now: ServerTime) -> Option<u32> {
        let first_word = self.take(words)?;
        self.resident.insert(key, Resident { first_word, words, needed: now.plus_ns(-1) });
        Some(first_word)
    }

    fn take(&mut self, words: u32) -> Option<u32> {
        let (first, free) = self.free.iter().find(|(_, free)| **free >= words).map(|(f, w)| (*f, *w))?;
        self.free.remove(&first);
        if free > words {
            self.free.insert(first + words, free - words);
        }
        Some(first)
    }

    fn evict(&mut self, key: ChunkKey) {
        let Some(Resident { mut first_word, mut words, .. }) = self.resident.remove(&key) else { return };
        if let Some((before, free)) = self.free.range(..first_word).next_back().map(|(f, w)| (*f, *w))
            && before + free == first_word
        {
            self.free.remove(&before);
            (first_word, words) = (before, words + free);
        }
        if let Some(after) = self.free.remove(&(first_word + words)) {
            words += after;
        }
        self.free.insert(first_word, words);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    fn key(index: u32) -> ChunkKey {
        (ClipId(1), index)
    }

    #[test]
    fn chunks_never_overlap_and_all_words_come_back() {
        let mut rng = SmallRng::seed_from_u64(3);
        let mut chunks = Chunks::new(100..1000);
        for step in 1..4000i64 {
            let (key, now) = (key(rng.random_range(0..60)), ServerTime(step / 4));
            if !chunks.need(key, now) {
                chunks.place(key, rng.random_range(1..50) * 4, now);
            }
            let mut ranges: Vec<_> =
                chunks.resident.values().map(|r| (r.first_word, r.first_word + r.words)).collect();
            ranges.extend(chunks.free.iter().map(|(first, words)| (*first, first + words)));
            ranges.sort_unstable();
            assert_eq!((ranges[0].0, ranges[ranges.len() - 1].1), (100, 1000), "step {step}");
            assert!(ranges.windows(2).all(|pair| pair[0].1 == pair[1].0), "step {step}: {ranges:?}");
            assert!(
                chunks.free.len() < 2 || {
                    let free: Vec<_> = chunks.free.iter().collect();
                    free.windows(2).all(|pair| pair[0].0 + pair[0].1 < *pair[1].0)
                }
            );
        }
    }

    #[test]
    fn what_is_needed_stays_and_what_was_needed_last_goes_first() {
        let mut chunks = Chunks::new(0..30);
        for index in 0..3 {
            assert!(chunks.place(key(index), 10, ServerTime(i64::from(index))).is_some());
        }
        assert!(chunks.need(key(0), ServerTime(5)));
        chunks.place(key(3), 10, ServerTime(5)).unwrap();
        assert!([0, 1, 3].map(key).into_iter().all(|key| chunks.has(key)) && !chunks.has(key(2)));
        assert_eq!(chunks.place(key(4), 11, ServerTime(5)), None, "two of them are needed now");
        assert!(chunks.has(key(1)) && chunks.take_evicted() == [key(2)], "nothing goes in vain");
        assert_eq!(chunks.place(key(4), 10, ServerTime(5)), Some(10));
    }

    #[test]
    fn what_is_sent_ahead_drives_nothing_out() {
        let mut chunks = Chunks::new(0..25);
        assert!(chunks.place_beside(key(0), 20, ServerTime(1)).is_some());
        assert_eq!(chunks.place_beside(key(1), 20, ServerTime(9)), None);
        assert!(chunks.has(key(0)));
    }
}

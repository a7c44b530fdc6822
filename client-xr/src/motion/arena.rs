//! Arrivals for the arena, the memory of skeletons, keys and morph deltas, on their way to the GPU. The server assigns the
//! words. Words still on their way must not be evaluated: each write has a serial, and [`ArenaWrites::written`] gives the GPU's
//! progress.

use std::collections::VecDeque;
use std::ops::Range;

/// Bytes of an arena word.
pub const WORD_BYTES: usize = 16;

/// Which write it was: they reach the arena in this order. The default is there from the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ArenaSerial(u64);

/// Writes to the arena, in the order in which they must be copied.
#[derive(Debug)]
pub struct ArenaWrites {
    arena_words: u32,
    /// Of all that wait, whole words.
    bytes: Vec<u8>,
    writes: VecDeque<Write>,
    pushed: ArenaSerial,
    written: ArenaSerial,
}

/// What of a write has not been handed on.
#[derive(Clone, Copy, Debug)]
struct Write {
    arena_byte: u64,
    bytes: usize,
}

/// Bytes that go from a staging buffer to the arena.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ArenaCopy {
    /// In the staging buffer.
    pub staged: Range<u64>,
    /// Where in the arena they go, bytes from its start.
    pub arena_byte: u64,
}

impl ArenaCopy {
    /// Whether two copies write some byte both.
    pub fn overlaps(&self, other: &Self) -> bool {
        self.arena_byte < other.arena_end() && other.arena_byte < self.arena_end()
    }

    fn arena_end(&self) -> u64 {
        self.arena_byte + (self.staged.end - self.staged.start)
    }
}

impl ArenaWrites {
    /// For an arena of so many words.
    pub fn new(arena_words: u32) -> Self {
        let (pushed, written) = (ArenaSerial::default(), ArenaSerial::default());
        Self { arena_words, bytes: Vec::new(), writes: VecDeque::new(), pushed, written }
    }

    /// Words that the arena has.
    pub fn arena_words(&self) -> u32 {
        self.arena_words
    }

    /// Bytes from a word on; the last word is filled up with zeros. The decoder has checked that they lie in the arena.
    pub fn push(&mut self, first_word: u32, bytes: &[u8]) -> ArenaSerial {
        let words = bytes.len().div_ceil(WORD_BYTES);
        let end = u64::from(first_word) + words as u64;
        assert!(end <= u64::from(self.arena_words), "words up to {end} of {}", self.arena_words);
        self.bytes.extend_from_slice(bytes);
        self.bytes.resize(self.bytes.len() + words * WORD_BYTES - bytes.len(), 0);
        let arena_byte = u64::from(first_word) * WORD_BYTES as u64;
        self.writes.push_back(Write { arena_byte, bytes: words * WORD_BYTES });
        self.pushed.0 += 1;
        self.pushed
    }

    /// Moves bytes into `staging`, as far as it reaches, and calls `copy` for each run of them. Writes that continue each other
    /// are one run: morph targets come a vertex at a time.
    pub fn drain_into(&mut self, staging: &mut [u8], mut copy: impl FnMut(ArenaCopy)) {
        let (room, mut used) = (staging.len() / WORD_BYTES * WORD_BYTES, 0);
        let mut run: Option<ArenaCopy> = None;
        while let Some(next) = self.writes.front_mut() {
            let count = next.bytes.min(room - used);
            staging[used..used + count].copy_from_slice(&self.bytes[used..used + count]);
            let staged = used as u64..(used + count) as u64;
            match run.as_mut().filter(|run| run.arena_end() == next.arena_byte) {
                Some(run) => run.staged.end = staged.end,
                None if count > 0 => {
                    let next = ArenaCopy { staged, arena_byte: next.arena_byte };
                    run.replace(next).into_iter().for_each(&mut copy);
                }
                None => {}
            }
            used += count;
            next.arena_byte += count as u64;
            next.bytes -= count;
            if next.bytes > 0 {
                break;
            }
            self.writes.pop_front();
            self.written.0 += 1;
        }
        run.into_iter().for_each(copy);
        self.bytes.drain(..used);
        if self.bytes.is_empty() {
            self.bytes.shrink_to(staging.len());
        }
    }

    /// The last write all of whose bytes have been handed on.
    pub fn written(&self) -> ArenaSerial {
        self.written
    }

    /// True where nothing waits.
    pub fn is_empty(&self) -> bool {
        self.writes.is_empty()
    }

    /// Bytes that have not been handed on.
    pub fn waiting_bytes(&self) -> usize {
        self.bytes.len()
    }

    /// True while more waits than the arena can hold, which is of no use to anybody.
    pub fn is_full(&self) -> bool {
        self.bytes.len() > self.arena_words as usize * WORD_BYTES
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An arena that copies at most so many bytes at a time.
    struct Bench {
        writes: ArenaWrites,
        arena: Vec<u8>,
        staging: Vec<u8>,
    }

    impl Bench {
        fn new(words: u32, staging_bytes: usize) -> Self {
            let arena = vec![0xff; words as usize * WORD_BYTES];
            Self { writes: ArenaWrites::new(words), arena, staging: vec![0; staging_bytes] }
        }

        fn copy(&mut self) -> usize {
            let mut copies = Vec::new();
            self.writes.drain_into(&mut self.staging, |copy| copies.push(copy));
            for ArenaCopy { staged, arena_byte } in &copies {
                let bytes = &self.staging[staged.start as usize..staged.end as usize];
                self.arena[*arena_byte as usize..][..bytes.len()].copy_from_slice(bytes);
            }
            copies.len()
        }
    }

    #[test]
    fn a_write_is_complete_when_its_last_byte_is_on_its_way() {
        let mut bench = Bench::new(20, 3 * WORD_BYTES + 5);
        let bytes: Vec<u8> = (0..100).collect();
        let serials = [bench.writes.push(2, &bytes), bench.writes.push(12, &[7; 16])];
        let mut complete = Vec::new();
        for _ in 0..4 {
            bench.copy();
            complete.push(serials.map(|serial| serial <= bench.writes.written()));
        }
        assert_eq!(complete, [[false, false], [false, false], [true, true], [true, true]]);
        assert_eq!(&bench.arena[32..132], &bytes[..]);
        assert_eq!(&bench.arena[132..144], &[0; 12], "the last word is filled up");
        assert_eq!([bench.arena[31], bench.arena[144]], [0xff; 2], "no other byte is touched");
        assert_eq!(bench.arena[192..208], [7; 16]);
    }

    #[test]
    fn what_is_written_later_to_the_same_words_stays() {
        let mut bench = Bench::new(4, 64);
        bench.writes.push(1, &[1; 32]);
        bench.writes.push(2, &[2; 16]);
        assert_eq!(bench.copy(), 2);
        assert_eq!([bench.arena[16], bench.arena[32]], [1, 2]);
    }

    #[test]
    fn writes_that_continue_each_other_are_one_copy() {
        let mut bench = Bench::new(20, 8 * WORD_BYTES);
        let words = [3, 4, 5, 9, 10, 4, 5, 6, 15];
        let serials: Vec<_> =
            (1..).zip(words).map(|(byte, word)| bench.writes.push(word, &[byte; WORD_BYTES])).collect();
        assert_eq!(bench.copy(), 3, "from words 3, 9 and 4 on");
        let bytes = words.map(|word| bench.arena[word as usize * WORD_BYTES]);
        assert_eq!(bytes, [1, 6, 7, 4, 5, 6, 7, 8, 0xff], "the later of two writes stays");
        assert_eq!(bench.writes.written(), serials[7]);
        assert_eq!((bench.copy(), bench.writes.written()), (1, serials[8]));
    }

    #[test]
    fn a_queue_that_is_never_empty_does_not_grow() {
        let mut bench = Bench::new(64, 64);
        bench.writes.push(0, &[0; 256]);
        for _ in 0..1000 {
            bench.writes.push(8, &[1; 64]);
            bench.copy();
            assert_eq!(bench.writes.waiting_bytes(), 256);
        }
        assert!(bench.writes.bytes.capacity() < 2048, "{}", bench.writes.bytes.capacity());
        assert!(!bench.writes.is_empty() && !bench.writes.is_full());
    }

    #[test]
    #[should_panic(expected = "words up to 5 of 4")]
    fn a_write_beyond_the_arena_is_our_bug() {
        ArenaWrites::new(4).push(3, &[0; 17]);
    }

    #[test]
    fn copies_overlap_where_they_share_a_byte() {
        let copy = |arena_byte| ArenaCopy { staged: 100..132, arena_byte };
        assert!(copy(64).overlaps(&copy(80)) && copy(80).overlaps(&copy(64)));
        assert!(!copy(64).overlaps(&copy(96)) && !copy(96).overlaps(&copy(64)));
    }
}

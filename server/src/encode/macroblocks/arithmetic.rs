//! The arithmetic decoder (clause 9.3), which also tells how many bits were spent so far.

use super::CountError;
use super::reader::Reader;
use super::tables::{AFTER_LESS_PROBABLE, CONTEXTS, INITIAL, LESS_PROBABLE};

/// The range after a start.
const WHOLE_RANGE: u32 = 510;
/// Longest suffix of a level or of a motion vector that any stream needs.
const MOST_SUFFIX_BITS: u32 = 24;

/// See the module.
pub(super) struct Engine<'a> {
    reader: Reader<'a>,
    range: u32,
    offset: u32,
    /// Twice the state, plus the more probable value.
    contexts: [u8; CONTEXTS],
}

impl<'a> Engine<'a> {
    /// Behind the header of a slice of this quantiser; `table` of [`INITIAL`].
    pub(super) fn new(mut reader: Reader<'a>, table: usize, qp: i32) -> Self {
        reader.align();
        let qp = qp.clamp(0, 51);
        let mut contexts = [0; CONTEXTS];
        for (context, line) in contexts.iter_mut().zip(INITIAL[table].chunks_exact(2)) {
            let (m, n) = (i32::from(line[0]), i32::from(line[1]));
            let state = (((m * qp) >> 4) + n).clamp(1, 126);
            *context = (if state <= 63 { (63 - state) << 1 } else { ((state - 64) << 1) | 1 }) as u8;
        }
        let mut engine = Self { reader, range: 0, offset: 0, contexts };
        engine.start();
        engine
    }

    fn start(&mut self) {
        self.range = WHOLE_RANGE;
        self.offset = self.reader.take(9);
    }

    /// Bits spent so far, with those of which a part is left.
    pub(super) fn position(&self) -> f64 {
        self.reader.at as f64 - f64::from(self.range).log2()
    }

    /// A value with a probability.
    pub(super) fn decide(&mut self, context: usize) -> bool {
        let (state, likely) = (usize::from(self.contexts[context] >> 1), self.contexts[context] & 1);
        let less = u32::from(LESS_PROBABLE[4 * state + (self.range >> 6 & 3) as usize]);
        self.range -= less;
        let (value, next) = if self.offset >= self.range {
            self.offset -= self.range;
            self.range = less;
            let next_likely = if state == 0 { likely ^ 1 } else { likely };
            (likely ^ 1, AFTER_LESS_PROBABLE[state] << 1 | next_likely)
        } else {
            (likely, (state as u8 + 1).min(62) << 1 | likely)
        };
        self.contexts[context] = next;
        self.renormalise();
        value == 1
    }

    fn renormalise(&mut self) {
        let shift = self.range.leading_zeros().saturating_sub(23);
        self.range <<= shift;
        self.offset = self.offset << shift | self.reader.take(shift);
    }

    /// A value of which nothing is known.
    pub(super) fn bypass(&mut self) -> bool {
        self.offset = self.offset << 1 | self.reader.take(1);
        let is_one = self.offset >= self.range;
        if is_one {
            self.offset -= self.range;
        }
        is_one
    }

    /// Whether the slice ends here, or raw samples follow.
    pub(super) fn ends(&mut self) -> bool {
        self.range -= 2;
        if self.offset >= self.range {
            return true;
        }
        self.renormalise();
        false
    }

    /// The suffix of a binarisation, of order `order`.
    pub(super) fn suffix(&mut self, mut order: u32) -> Result<u32, CountError> {
        let mut value = 0;
        while self.bypass() {
            value += 1 << order;
            order += 1;
            if order > MOST_SUFFIX_BITS {
                return Err(CountError::Damaged("a number is too large"));
            }
        }
        for bit in (0..order).rev() {
            value += u32::from(self.bypass()) << bit;
        }
        Ok(value)
    }

    /// Passes over raw samples of so many bytes.
    pub(super) fn pass_over(&mut self, bytes: usize) {
        self.reader.align();
        self.reader.at += 8 * bytes;
        self.start();
    }

    /// Whether the slice was read to its last bit, which is a one, and no further.
    pub(super) fn is_at_end(&self) -> bool {
        let last = Reader { bytes: self.reader.bytes, at: self.reader.at.saturating_sub(1) };
        last.peek(1) == 1 && self.reader.at.div_ceil(8) == self.reader.bytes.len()
    }

    /// Whether it has run out of bits.
    pub(super) fn is_beyond(&self) -> bool {
        self.reader.at > 8 * self.reader.bytes.len() + 9
    }
}

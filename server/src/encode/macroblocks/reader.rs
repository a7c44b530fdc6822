//! The bits in a NAL unit.

use super::CountError;

/// Longest Exp-Golomb code of a number of 32 bits.
const MOST_LEADING_ZEROS: u32 = 31;

/// What a NAL unit holds: without the bytes that keep start codes out of it.
pub(super) fn payload(unit: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(unit.len());
    let mut zeros = 0;
    for byte in unit {
        if zeros >= 2 && *byte == 3 {
            zeros = 0;
            continue;
        }
        zeros = if *byte == 0 { zeros + 1 } else { 0 };
        bytes.push(*byte);
    }
    bytes
}

/// Reads bits, the highest of a byte first.
#[derive(Clone, Debug)]
pub(super) struct Reader<'a> {
    pub(super) bytes: &'a [u8],
    /// The next bit.
    pub(super) at: usize,
}

impl<'a> Reader<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    /// So many bits, at most 16. Behind the end all are 0.
    pub(super) fn peek(&self, count: u32) -> u32 {
        if count == 0 {
            return 0;
        }
        let first = self.at / 8;
        let byte = |at: usize| self.bytes.get(first + at).copied().unwrap_or(0);
        let word = u32::from_be_bytes([byte(0), byte(1), byte(2), 0]);
        word << (self.at % 8) >> (32 - count)
    }

    /// The same, and goes on behind them.
    pub(super) fn take(&mut self, count: u32) -> u32 {
        let bits = self.peek(count);
        self.at += count as usize;
        bits
    }

    pub(super) fn flag(&mut self) -> bool {
        self.take(1) == 1
    }

    /// An unsigned Exp-Golomb code, `ue(v)`.
    pub(super) fn number(&mut self) -> Result<u32, CountError> {
        let mut zeros = 0;
        while !self.flag() {
            zeros += 1;
            if zeros > MOST_LEADING_ZEROS {
                return Err(CountError::Damaged("a header ends too early"));
            }
        }
        let (high, low) = (zeros.saturating_sub(16), zeros.min(16));
        let rest = (u64::from(self.take(high)) << low) | u64::from(self.take(low));
        Ok(((1u64 << zeros) - 1 + rest) as u32)
    }

    /// A signed one, `se(v)`.
    pub(super) fn signed(&mut self) -> Result<i32, CountError> {
        let number = i64::from(self.number()?);
        Ok((if number % 2 == 1 { number / 2 + 1 } else { -(number / 2) }) as i32)
    }

    /// Whether there is more than the bit that ends a payload, and zeros.
    pub(super) fn has_more(&self) -> bool {
        let Some(last) = self.bytes.iter().rposition(|byte| *byte != 0) else { return false };
        self.at < 8 * last + 7 - self.bytes[last].trailing_zeros() as usize
    }

    /// At the next whole byte.
    pub(super) fn align(&mut self) {
        self.at = self.at.next_multiple_of(8);
    }
}

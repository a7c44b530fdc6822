//! Numbers of any width in a row, lowest bit first, and groups of numbers that need about the same width.

use crate::wire::{WireError, unzigzag, zigzag};

/// Widths 0..=30 are themselves; 31 stands for all 32 bits.
const WIDTH_BITS: u32 = 5;

/// Packs numbers of up to 32 bits, lowest bit first.
pub(super) struct BitWriter<'a> {
    out: &'a mut Vec<u8>,
    pending: u64,
    count: u32,
}

impl<'a> BitWriter<'a> {
    pub(super) fn new(out: &'a mut Vec<u8>) -> Self {
        Self { out, pending: 0, count: 0 }
    }

    pub(super) fn put(&mut self, value: u32, width: u32) {
        self.pending |= u64::from(value) << self.count;
        self.count += width;
        if self.count >= 32 {
            self.out.extend_from_slice(&(self.pending as u32).to_le_bytes());
            self.pending >>= 32;
            self.count -= 32;
        }
    }

    /// How wide numbers are that follow, 0..=32 bits but 31.
    pub(super) fn put_width(&mut self, width: u32) {
        self.put(width.min(31), WIDTH_BITS);
    }

    /// Fills up the last byte with zeros.
    pub(super) fn finish(self) {
        let bytes = self.count.div_ceil(8) as usize;
        self.out.extend_from_slice(&self.pending.to_le_bytes()[..bytes]);
    }
}

/// Reads what [`BitWriter`] packed.
pub(super) struct BitReader<'a> {
    /// What is being read, for errors.
    what: &'static str,
    bytes: &'a [u8],
    at: usize,
    pending: u64,
    count: u32,
}

impl<'a> BitReader<'a> {
    pub(super) fn new(what: &'static str, bytes: &'a [u8]) -> Self {
        Self { what, bytes, at: 0, pending: 0, count: 0 }
    }

    pub(super) fn take(&mut self, width: u32) -> Result<u32, WireError> {
        while self.count < width {
            let Some(byte) = self.bytes.get(self.at) else {
                return Err(WireError::Truncated { what: self.what, needed: 1, left: 0 });
            };
            self.pending |= u64::from(*byte) << self.count;
            self.at += 1;
            self.count += 8;
        }
        let value = self.pending & ((1 << width) - 1);
        self.pending >>= width;
        self.count -= width;
        Ok(value as u32)
    }

    /// What [`BitWriter::put_width`] put.
    pub(super) fn take_width(&mut self) -> Result<u32, WireError> {
        Ok(round_width(self.take(WIDTH_BITS)?))
    }

    pub(super) fn bytes_read(&self) -> usize {
        self.at
    }
}

/// How one axis of a group is packed.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Packing {
    pub(super) base: i32,
    pub(super) width: u32,
}

impl Packing {
    pub(super) fn of_group(misses: &[[i32; 3]]) -> [Self; 3] {
        let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
        for miss in misses {
            for axis in 0..3 {
                low[axis] = low[axis].min(miss[axis]);
                high[axis] = high[axis].max(miss[axis]);
            }
        }
        std::array::from_fn(|axis| {
            let spread = high[axis].wrapping_sub(low[axis]) as u32;
            Self { base: low[axis], width: width_of(spread) }
        })
    }

    /// Bits of a group of this many vertices on this axis.
    pub(super) fn bits(self, count: u32) -> u32 {
        2 * WIDTH_BITS + width_of(zigzag(self.base)) + self.width * count
    }

    pub(super) fn write(self, bits: &mut BitWriter<'_>) {
        let base = zigzag(self.base);
        let base_width = width_of(base);
        bits.put_width(self.width);
        bits.put_width(base_width);
        bits.put(base, base_width);
    }

    pub(super) fn read(bits: &mut BitReader<'_>) -> Result<Self, WireError> {
        let (width, base_width) = (bits.take_width()?, bits.take_width()?);
        Ok(Self { base: unzigzag(bits.take(base_width)?), width })
    }
}

/// Bits of a number, as far as a width can say.
pub(super) fn width_of(value: u32) -> u32 {
    round_width(u32::BITS - value.leading_zeros())
}

/// Five bits cannot name 32 and 31 both: 31 becomes 32.
fn round_width(width: u32) -> u32 {
    if width == 31 { 32 } else { width }
}

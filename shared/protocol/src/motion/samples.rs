//! The vertex sample codec: quantised positions of animated vertices, one batch per step of the sample grid.
//!
//! Both sides keep the same [`SampleHistory`]: the last three samples of every animated vertex. A batch is coded in groups of
//! 32 vertices. Each group is predicted from its vertices' own history by a polynomial of the cheapest order (none, hold, line,
//! parabola). The residuals are packed at the width of the group's spread. Vertices in neighbouring slots move alike, so their
//! residuals differ little, and the common part is stored once per group and axis. Vertices without history are predicted from
//! the previous vertex.
//!
//! All arithmetic wraps: hostile bytes give wrong positions, but nothing worse.

use super::bits::{BitReader, BitWriter, Packing};
use super::{SampleBatch, SampleValues};
use crate::ids::VertexSlot;
use crate::memory::Entered;
use crate::time::GridIndex;
use crate::wire::WireError;

/// Vertices that share a prediction order and widths.
const GROUP: usize = 32;
/// Samples of a vertex that prediction looks back at.
const DEPTH: usize = 3;
const ORDERS: usize = DEPTH + 1;
const ORDER_BITS: u32 = 2;

/// The past of every vertex slot, the same on both sides. Sized once, at connection.
#[derive(Clone, Debug)]
pub struct SampleHistory {
    past: Vec<Past>,
}

/// A vertex's last samples, newest first.
#[derive(Clone, Copy, Debug, Default)]
struct Past {
    count: u8,
    grids: [i32; DEPTH],
    values: [[i32; 3]; DEPTH],
}

impl SampleHistory {
    /// For slots `0..vertex_slots`, without a past.
    pub fn new(vertex_slots: u32) -> Self {
        Self { past: vec![Past::default(); vertex_slots as usize] }
    }

    /// What a delta has changed in the client's memory: vertices that enter have no past, and where an instance's step is
    /// another one, the pasts of its vertices are carried over to it.
    pub fn follow(&mut self, entered: &Entered) {
        for (slot, ratio) in &entered.rescaled {
            for value in self.past[slot.index()].values.iter_mut().flatten() {
                // Saturates; multiplication and rounding give the same bits on every machine.
                *value = (f64::from(*value) * ratio).round() as i32;
            }
        }
        entered.sampled.iter().for_each(|slot| self.past[slot.index()] = Past::default());
    }
}

impl Past {
    /// Forgets samples at or after `grid`: they are about to be replaced, because the future changed.
    fn rewind(&mut self, grid: GridIndex) {
        while self.count > 0 && self.grids[0] >= grid.0 {
            self.grids.copy_within(1.., 0);
            self.values.copy_within(1.., 0);
            self.count -= 1;
        }
    }

    /// The highest order of prediction that the past allows: samples must be equally spaced up to `grid`.
    fn order(&self, grid: GridIndex) -> usize {
        let spacing = grid.0.wrapping_sub(self.grids[0]);
        let mut order = usize::from(self.count.min(1));
        while order > 0
            && order < usize::from(self.count)
            && self.grids[order - 1].wrapping_sub(self.grids[order]) == spacing
        {
            order += 1;
        }
        order
    }

    /// Extrapolates one axis by a polynomial through the last `order` samples, 1..=3.
    fn predict(&self, order: usize, axis: usize) -> i32 {
        let [a, b, c] = self.values.map(|value| value[axis]);
        match order {
            1 => a,
            2 => a.wrapping_mul(2).wrapping_sub(b),
            _ => a.wrapping_sub(b).wrapping_mul(3).wrapping_add(c),
        }
    }

    fn push(&mut self, grid: GridIndex, value: [i32; 3]) {
        self.grids.copy_within(..DEPTH - 1, 1);
        self.values.copy_within(..DEPTH - 1, 1);
        self.grids[0] = grid.0;
        self.values[0] = value;
        self.count = (self.count + 1).min(DEPTH as u8);
    }

    /// What each order of prediction expects at `grid`; see [`Self::expect`].
    fn expect_all(&self, grid: GridIndex, before: [i32; 3]) -> [[i32; 3]; ORDERS] {
        let possible = self.order(grid);
        let mut expected = [before; ORDERS];
        for order in 1..ORDERS {
            expected[order] = match order <= possible {
                true => std::array::from_fn(|axis| self.predict(order, axis)),
                false => expected[order - 1],
            };
        }
        expected
    }

    /// What to expect at `grid`, where a group asks for `order`; without a past it is the vertex before.
    fn expect(&self, grid: GridIndex, order: usize, before: [i32; 3]) -> [i32; 3] {
        match order.min(self.order(grid)) {
            0 => before,
            order => std::array::from_fn(|axis| self.predict(order, axis)),
        }
    }
}

/// Encodes batches; holds nothing from one batch to the next but memory.
#[derive(Clone, Debug)]
pub struct SampleEncoder {
    /// By order of prediction, then by vertex of the group.
    misses: [[[i32; 3]; GROUP]; ORDERS],
}

impl Default for SampleEncoder {
    fn default() -> Self {
        Self { misses: [[[0; 3]; GROUP]; ORDERS] }
    }
}

impl SampleEncoder {
    /// Ready for any batch.
    pub fn new() -> Self {
        Self::default()
    }

    /// Appends one batch. The decoder must be given its slots in the same order, and the same batches before.
    pub fn encode_batch(&mut self, batch: &SampleBatch, history: &mut SampleHistory, out: &mut Vec<u8>) {
        let mut bits = BitWriter::new(out);
        let mut before = [0; 3];
        for group in batch.values.chunks(GROUP) {
            self.predict_group(batch.grid, history, group, before);
            let (order, packing) = self.cheapest(group.len());
            bits.put(order as u32, ORDER_BITS);
            packing.iter().for_each(|packing| packing.write(&mut bits));
            for miss in &self.misses[order][..group.len()] {
                for axis in 0..3 {
                    bits.put(miss[axis].wrapping_sub(packing[axis].base) as u32, packing[axis].width);
                }
            }
            before = group[group.len() - 1].1;
        }
        bits.finish();
    }

    /// Fills `misses` with what each order of prediction gets wrong, and brings the history up to date.
    fn predict_group(
        &mut self,
        grid: GridIndex,
        history: &mut SampleHistory,
        group: &[(VertexSlot, [i32; 3])],
        mut before: [i32; 3],
    ) {
        for (i, (slot, value)) in group.iter().enumerate() {
            let past = &mut history.past[slot.index()];
            past.rewind(grid);
            for (misses, expected) in self.misses.iter_mut().zip(past.expect_all(grid, before)) {
                misses[i] = std::array::from_fn(|axis| value[axis].wrapping_sub(expected[axis]));
            }
            past.push(grid, *value);
            before = *value;
        }
    }

    /// The order of prediction that needs the fewest bits for a group of `count` vertices.
    fn cheapest(&self, count: usize) -> (usize, [Packing; 3]) {
        let packings = self.misses.each_ref().map(|misses| Packing::of_group(&misses[..count]));
        let cost =
            |order: &usize| packings[*order].iter().map(|packing| packing.bits(count as u32)).sum::<u32>();
        let order = (0..ORDERS).min_by_key(cost).unwrap_or(0);
        (order, packings[order])
    }
}

/// Decodes one batch from the front of `bytes`: the samples of these animated vertices at this grid step, and the
/// number of bytes they took. After an error the history is no longer the encoder's.
pub fn decode_batch(
    grid: GridIndex,
    history: &mut SampleHistory,
    slots: &[VertexSlot],
    bytes: &[u8],
) -> Result<(SampleValues, usize), WireError> {
    let mut bits = BitReader::new("a batch of samples", bytes);
    let mut values = Vec::with_capacity(slots.len());
    let mut before = [0; 3];
    for group in slots.chunks(GROUP) {
        let order = bits.take(ORDER_BITS)? as usize;
        let packing = [Packing::read(&mut bits)?, Packing::read(&mut bits)?, Packing::read(&mut bits)?];
        for &slot in group {
            let past = &mut history.past[slot.index()];
            past.rewind(grid);
            let mut value = past.expect(grid, order, before);
            for axis in 0..3 {
                let miss = packing[axis].base.wrapping_add(bits.take(packing[axis].width)? as i32);
                value[axis] = value[axis].wrapping_add(miss);
            }
            past.push(grid, value);
            before = value;
            values.push((slot, value));
        }
    }
    Ok((values, bits.bytes_read()))
}

#[cfg(test)]
mod tests;

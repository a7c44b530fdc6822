//! The vertex sample codec: quantised positions of animated vertices, one batch per step of the sample grid.
//!
//! Both sides keep the same [`SampleHistory`]: of every animated vertex its last three samples. A batch is coded in
//! groups of 32 vertices. Each group is predicted from its vertices' own past by a polynomial of the order that costs
//! least (none, hold, line, parabola); what the prediction misses is packed at the width that the group's spread needs.
//! Vertices next to each other in slots move alike, so that their misses differ little and the common part is stored
//! once per group and axis. Vertices without a past are predicted from the vertex before them.
//!
//! All arithmetic wraps, so that hostile bytes can give wrong positions but nothing worse.

use crate::delta::SampleValues;
use crate::ids::{InstanceId, VertexSlot};
use crate::limits::{MAX_INSTANCES, MAX_STEP_M, MIN_STEP_M};
use crate::time::GridIndex;
use crate::wire::{WireError, invalid, unzigzag, zigzag};

/// Vertices that share a prediction order and widths.
const GROUP: usize = 32;
/// Samples of a vertex that prediction looks back at.
const DEPTH: usize = 3;
const ORDERS: usize = DEPTH + 1;
const ORDER_BITS: u32 = 2;
/// Widths 0..=30 are themselves; 31 stands for all 32 bits.
const WIDTH_BITS: u32 = 5;

/// What the past of every vertex slot is, the same on both sides. Sized once, at connection.
#[derive(Clone, Debug)]
pub struct SampleHistory {
    /// By instance; 0 where not announced.
    steps_m: Vec<f32>,
    past: Vec<Past>,
    /// Slots in use, by any vertex.
    occupied: SlotSet,
    /// Slots in use by animated vertices.
    active: SlotSet,
}

/// A vertex's last samples, newest first.
#[derive(Clone, Copy, Debug, Default)]
struct Past {
    instance: InstanceId,
    count: u8,
    grids: [i32; DEPTH],
    values: [[i32; 3]; DEPTH],
}

impl SampleHistory {
    /// For slots `0..vertex_slots`, all free.
    pub fn new(vertex_slots: u32) -> Self {
        Self {
            steps_m: vec![0.0; MAX_INSTANCES as usize],
            past: vec![Past::default(); vertex_slots as usize],
            occupied: SlotSet::new(vertex_slots),
            active: SlotSet::new(vertex_slots),
        }
    }

    /// Slots that exist.
    pub fn vertex_slots(&self) -> u32 {
        self.past.len() as u32
    }

    /// True where a vertex lives in the slot.
    pub fn is_occupied(&self, slot: VertexSlot) -> bool {
        self.occupied.contains(slot.0)
    }

    /// True where an animated vertex lives in the slot.
    pub fn is_active(&self, slot: VertexSlot) -> bool {
        self.active.contains(slot.0)
    }

    /// The slots of all animated vertices, ascending.
    pub fn active_slots(&self) -> Vec<VertexSlot> {
        self.active.iter().map(VertexSlot).collect()
    }

    /// Quantisation step in metres of the animated vertex in this slot.
    pub fn step_m(&self, slot: VertexSlot) -> Option<f32> {
        self.is_active(slot).then(|| self.steps_m[self.past[slot.index()].instance.index()])
    }

    /// Sets the quantisation steps of some instances. Pasts of vertices whose step changes are carried over to it.
    pub(crate) fn set_steps(&mut self, steps: &[(InstanceId, f32)]) -> Result<(), WireError> {
        let mut ratios: Vec<Option<f64>> = Vec::new();
        for &(instance, step_m) in steps {
            let known = self.steps_m.get_mut(instance.index()).ok_or_else(|| {
                invalid("an instance", format!("{} is not below {MAX_INSTANCES}", instance.0))
            })?;
            if !(MIN_STEP_M..=MAX_STEP_M).contains(&step_m) {
                let reason = format!("{step_m} m of instance {} is out of range", instance.0);
                return Err(invalid("a quantisation step", reason));
            }
            if *known != 0.0 && *known != step_m {
                ratios.resize(MAX_INSTANCES as usize, None);
                let ratio = ratios[instance.index()].get_or_insert(1.0);
                *ratio *= f64::from(*known) / f64::from(step_m);
            }
            *known = step_m;
        }
        if !ratios.is_empty() {
            self.rescale(&ratios);
        }
        Ok(())
    }

    fn rescale(&mut self, ratio_of_instance: &[Option<f64>]) {
        for slot in self.active.iter() {
            let past = &mut self.past[slot as usize];
            if let Some(ratio) = ratio_of_instance[past.instance.index()] {
                for value in past.values.iter_mut().flatten() {
                    // Saturates; multiplication and rounding give the same bits on every machine.
                    *value = (f64::from(*value) * ratio).round() as i32;
                }
            }
        }
    }

    /// A vertex enters a free slot.
    pub(crate) fn insert(
        &mut self,
        slot: VertexSlot,
        instance: InstanceId,
        sampled: bool,
    ) -> Result<(), WireError> {
        const WHAT: &str = "a new vertex";
        if slot.0 >= self.vertex_slots() {
            return Err(invalid(WHAT, format!("slot {} of {} does not exist", slot.0, self.vertex_slots())));
        }
        if !self.occupied.insert(slot.0) {
            return Err(invalid(WHAT, format!("slot {} is taken", slot.0)));
        }
        if sampled {
            if self.steps_m.get(instance.index()).is_none_or(|step| *step == 0.0) {
                return Err(invalid(WHAT, format!("its instance {} was not announced", instance.0)));
            }
            self.active.insert(slot.0);
            self.past[slot.index()] = Past { instance, ..Past::default() };
        }
        Ok(())
    }

    /// A vertex leaves its slot.
    pub(crate) fn evict(&mut self, slot: VertexSlot) -> Result<(), WireError> {
        if !self.occupied.remove(slot.0) {
            return Err(invalid("the eviction of a vertex", format!("slot {} is free", slot.0)));
        }
        self.active.remove(slot.0);
        Ok(())
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

    /// What to expect at `grid`, where a group asks for `order`; without a past it is the vertex before.
    fn expect(&self, grid: GridIndex, order: usize, before: [i32; 3]) -> [i32; 3] {
        match order.min(self.order(grid)) {
            0 => before,
            order => std::array::from_fn(|axis| self.predict(order, axis)),
        }
    }
}

/// Encodes batches; holds nothing from one batch to the next but memory.
#[derive(Clone, Debug, Default)]
pub struct SampleEncoder {
    misses: [Vec<[i32; 3]>; ORDERS],
}

/// How one axis of a group is packed.
#[derive(Clone, Copy, Debug, Default)]
struct Packing {
    base: i32,
    width: u32,
}

impl SampleEncoder {
    /// Ready for any batch.
    pub fn new() -> Self {
        Self::default()
    }

    /// Appends one batch: the values of these animated vertices, in this order, at this grid step.
    /// The decoder must be given the same slots in the same order, and the same batches before.
    pub fn encode_batch(
        &mut self,
        grid: GridIndex,
        history: &mut SampleHistory,
        slots: &[VertexSlot],
        values: &[[i32; 3]],
        out: &mut Vec<u8>,
    ) {
        assert_eq!(slots.len(), values.len(), "a value per vertex");
        let mut bits = BitWriter::new(out);
        let mut before = [0; 3];
        for (slots, values) in slots.chunks(GROUP).zip(values.chunks(GROUP)) {
            self.predict_group(grid, history, slots, values, before);
            let (order, packing) = self.cheapest();
            bits.put(order as u32, ORDER_BITS);
            packing.iter().for_each(|packing| packing.write(&mut bits));
            for miss in &self.misses[order] {
                for axis in 0..3 {
                    bits.put(miss[axis].wrapping_sub(packing[axis].base) as u32, packing[axis].width);
                }
            }
            before = values[values.len() - 1];
        }
        bits.finish();
    }

    /// Fills `misses` with what each order of prediction gets wrong, and brings the history up to date.
    fn predict_group(
        &mut self,
        grid: GridIndex,
        history: &mut SampleHistory,
        slots: &[VertexSlot],
        values: &[[i32; 3]],
        mut before: [i32; 3],
    ) {
        self.misses.iter_mut().for_each(Vec::clear);
        for (slot, value) in slots.iter().zip(values) {
            let past = &mut history.past[slot.index()];
            past.rewind(grid);
            for (order, misses) in self.misses.iter_mut().enumerate() {
                let expected = past.expect(grid, order, before);
                misses.push(std::array::from_fn(|axis| value[axis].wrapping_sub(expected[axis])));
            }
            past.push(grid, *value);
            before = *value;
        }
    }

    fn cheapest(&self) -> (usize, [Packing; 3]) {
        let packings = self.misses.each_ref().map(|misses| Packing::of_group(misses));
        let count = self.misses[0].len() as u32;
        let cost = |order: &usize| packings[*order].iter().map(|packing| packing.bits(count)).sum::<u32>();
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
    let mut bits = BitReader::new(bytes);
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

impl Packing {
    fn of_group(misses: &[[i32; 3]]) -> [Self; 3] {
        std::array::from_fn(|axis| {
            let mut range = (i32::MAX, i32::MIN);
            for miss in misses {
                range = (range.0.min(miss[axis]), range.1.max(miss[axis]));
            }
            Self { base: range.0, width: round_width(bit_width(range.1.wrapping_sub(range.0) as u32)) }
        })
    }

    /// Bits of a group of this many vertices on this axis.
    fn bits(self, count: u32) -> u32 {
        2 * WIDTH_BITS + round_width(bit_width(zigzag(self.base))) + self.width * count
    }

    fn write(self, bits: &mut BitWriter<'_>) {
        let base = zigzag(self.base);
        let base_width = round_width(bit_width(base));
        bits.put(self.width.min(31), WIDTH_BITS);
        bits.put(base_width.min(31), WIDTH_BITS);
        bits.put(base, base_width);
    }

    fn read(bits: &mut BitReader<'_>) -> Result<Self, WireError> {
        let width = round_width(bits.take(WIDTH_BITS)?);
        let base_width = round_width(bits.take(WIDTH_BITS)?);
        Ok(Self { base: unzigzag(bits.take(base_width)?), width })
    }
}

fn bit_width(value: u32) -> u32 {
    u32::BITS - value.leading_zeros()
}

/// Five bits cannot name 32 and 31 both: 31 becomes 32.
fn round_width(width: u32) -> u32 {
    if width == 31 { 32 } else { width }
}

/// Packs numbers of up to 32 bits, lowest bit first.
struct BitWriter<'a> {
    out: &'a mut Vec<u8>,
    pending: u64,
    count: u32,
}

impl<'a> BitWriter<'a> {
    fn new(out: &'a mut Vec<u8>) -> Self {
        Self { out, pending: 0, count: 0 }
    }

    fn put(&mut self, value: u32, width: u32) {
        self.pending |= u64::from(value) << self.count;
        self.count += width;
        if self.count >= 32 {
            self.out.extend_from_slice(&(self.pending as u32).to_le_bytes());
            self.pending >>= 32;
            self.count -= 32;
        }
    }

    /// Fills up the last byte with zeros.
    fn finish(self) {
        let bytes = self.count.div_ceil(8) as usize;
        self.out.extend_from_slice(&self.pending.to_le_bytes()[..bytes]);
    }
}

/// Reads what [`BitWriter`] packed.
struct BitReader<'a> {
    bytes: &'a [u8],
    at: usize,
    pending: u64,
    count: u32,
}

impl<'a> BitReader<'a> {
    fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, pending: 0, count: 0 }
    }

    fn take(&mut self, width: u32) -> Result<u32, WireError> {
        while self.count < width {
            let Some(byte) = self.bytes.get(self.at) else {
                return Err(WireError::Truncated { what: "a batch of samples", needed: 1, left: 0 });
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

    fn bytes_read(&self) -> usize {
        self.at
    }
}

/// A set of slots in one bit each.
#[derive(Clone, Debug)]
pub(crate) struct SlotSet {
    words: Vec<u64>,
}

impl SlotSet {
    pub(crate) fn new(slots: u32) -> Self {
        Self { words: vec![0; slots.div_ceil(64) as usize] }
    }

    pub(crate) fn contains(&self, slot: u32) -> bool {
        self.words.get(slot as usize / 64).is_some_and(|word| word >> (slot % 64) & 1 == 1)
    }

    /// True where it was not in the set. The slot must exist.
    pub(crate) fn insert(&mut self, slot: u32) -> bool {
        let word = &mut self.words[slot as usize / 64];
        let was_in = *word >> (slot % 64) & 1 == 1;
        *word |= 1 << (slot % 64);
        !was_in
    }

    /// True where it was in the set.
    pub(crate) fn remove(&mut self, slot: u32) -> bool {
        let was_in = self.contains(slot);
        if was_in {
            self.words[slot as usize / 64] &= !(1 << (slot % 64));
        }
        was_in
    }

    /// Ascending.
    pub(crate) fn iter(&self) -> impl Iterator<Item = u32> + '_ {
        self.words.iter().enumerate().flat_map(|(index, &word)| {
            let mut rest = word;
            std::iter::from_fn(move || {
                let bit = (rest != 0).then(|| rest.trailing_zeros())?;
                rest &= rest - 1;
                Some(index as u32 * 64 + bit)
            })
        })
    }
}

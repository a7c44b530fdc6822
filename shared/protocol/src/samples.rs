//! The vertex sample codec: quantised positions of animated vertices, one batch per step of the sample grid.
//!
//! Both sides keep the same [`SampleHistory`]: of every animated vertex its last three samples. A batch is coded in
//! groups of 32 vertices. Each group is predicted from its vertices' own past by a polynomial of the order that costs
//! least (none, hold, line, parabola); what the prediction misses is packed at the width that the group's spread needs.
//! Vertices next to each other in slots move alike, so that their misses differ little and the common part is stored
//! once per group and axis. Vertices without a past are predicted from the vertex before them.
//!
//! All arithmetic wraps, so that hostile bytes can give wrong positions but nothing worse.

use crate::delta::{GeometryDelta, SampleValues};
use crate::ids::{InstanceId, VertexSlot};
use crate::limits::{MAX_INSTANCES, MAX_STEP_M, MIN_STEP_M};
use crate::time::GridIndex;
use crate::wire::{WireError, invalid, unzigzag, zigzag};
use glam::Vec3;

/// Vertices that share a prediction order and widths.
const GROUP: usize = 32;
/// Samples of a vertex that prediction looks back at.
const DEPTH: usize = 3;
const ORDERS: usize = DEPTH + 1;
const ORDER_BITS: u32 = 2;
/// Widths 0..=30 are themselves; 31 stands for all 32 bits.
const WIDTH_BITS: u32 = 5;

/// A world position in metres as a sample of this step; coordinates beyond what 32 bits hold are clamped.
pub fn quantise(position: Vec3, step_m: f32) -> [i32; 3] {
    position.to_array().map(|metres| (f64::from(metres) / f64::from(step_m)).round() as i32)
}

/// The world position in metres of a sample of this step.
pub fn dequantise(value: [i32; 3], step_m: f32) -> Vec3 {
    Vec3::from_array(value.map(|steps| (f64::from(steps) * f64::from(step_m)) as f32))
}

/// Turns samples into metres: which step each vertex slot has, as of the last delta applied. For whoever receives
/// deltas one by one, after the session has already decoded later ones.
#[derive(Clone, Debug)]
pub struct StepTable {
    step_m_of_instance: Vec<f32>,
    instance_of_vertex: Vec<InstanceId>,
}

impl StepTable {
    /// For slots `0..vertex_slots`.
    pub fn new(vertex_slots: u32) -> Self {
        Self {
            step_m_of_instance: vec![0.0; MAX_INSTANCES as usize],
            instance_of_vertex: vec![InstanceId(0); vertex_slots as usize],
        }
    }

    /// Takes in the instances and vertices of a delta; to be called before its samples are read.
    pub fn apply(&mut self, delta: &GeometryDelta) {
        for info in &delta.instances {
            self.step_m_of_instance[info.instance.index()] = info.step_m;
        }
        for vertex in &delta.new_vertices {
            self.instance_of_vertex[vertex.slot.index()] = vertex.instance;
        }
    }

    /// The world position in metres of a sample of this vertex.
    pub fn position(&self, slot: VertexSlot, value: [i32; 3]) -> Vec3 {
        dequantise(value, self.step_m_of_instance[self.instance_of_vertex[slot.index()].index()])
    }
}

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
            let (order, packing) = self.cheapest(values.len());
            bits.put(order as u32, ORDER_BITS);
            packing.iter().for_each(|packing| packing.write(&mut bits));
            for miss in &self.misses[order][..values.len()] {
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
        for (i, (slot, value)) in slots.iter().zip(values).enumerate() {
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
        let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
        for miss in misses {
            for axis in 0..3 {
                low[axis] = low[axis].min(miss[axis]);
                high[axis] = high[axis].max(miss[axis]);
            }
        }
        std::array::from_fn(|axis| {
            let spread = high[axis].wrapping_sub(low[axis]) as u32;
            Self { base: low[axis], width: round_width(bit_width(spread)) }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::delta::{InstanceInfo, Motion, NewVertex};
    use crate::testing::{Dice, damaged};

    const STEP_M: f32 = 0.0005;

    fn history_of(slots: u32) -> SampleHistory {
        let mut history = SampleHistory::new(slots);
        history.set_steps(&[(InstanceId(0), STEP_M)]).unwrap();
        (0..slots).for_each(|slot| history.insert(VertexSlot(slot), InstanceId(0), true).unwrap());
        history
    }

    /// Rest positions in metres of a rough wing of 1 m by 0.5 m: vertices in rows of 100 along the chord, each up to
    /// 5 mm off the smooth surface.
    fn wing(vertices: usize) -> Vec<[f64; 3]> {
        let mut dice = Dice::new(1);
        let mut rough = |metres: f64| metres + 0.005 * dice.signed_unit();
        (0..vertices)
            .map(|i| {
                let span = (i / 100 * 100) as f64 / vertices as f64;
                let chord = (i % 100) as f64 * 0.005;
                [rough(span), rough(0.02 * (chord * 12.0).sin()), rough(chord)]
            })
            .collect()
    }

    /// The wing when it beats at 1 Hz by +-40 degrees about the z axis while its owner walks.
    fn beat(wing: &[[f64; 3]], time_s: f64) -> Vec<[i32; 3]> {
        let angle = 40f64.to_radians() * (std::f64::consts::TAU * time_s).sin();
        let (sin, cos) = angle.sin_cos();
        wing.iter()
            .map(|[x, y, z]| {
                let world = [1.3 + x * cos - y * sin, 1.5 + x * sin + y * cos, z - 2.0 + 0.8 * time_s];
                world.map(|metres| (metres / f64::from(STEP_M)).round() as i32)
            })
            .collect()
    }

    #[derive(Default)]
    struct Cost {
        first_bytes: usize,
        later_bytes: usize,
        encode: std::time::Duration,
        decode: std::time::Duration,
    }

    /// Codes two seconds of the motion and checks that it comes back.
    fn cost_of_two_seconds(wing: &[[f64; 3]]) -> Cost {
        let slots: Vec<_> = (0..wing.len() as u32).map(VertexSlot).collect();
        let (mut ours, mut theirs) = (history_of(slots.len() as u32), history_of(slots.len() as u32));
        let mut encoder = SampleEncoder::new();
        let mut cost = Cost::default();
        for step in 0..60 {
            let (grid, values) = (GridIndex(step), beat(wing, f64::from(step) / 30.0));
            let mut bytes = Vec::new();
            let start = std::time::Instant::now();
            encoder.encode_batch(grid, &mut ours, &slots, &values, &mut bytes);
            cost.encode += start.elapsed();
            let start = std::time::Instant::now();
            let (decoded, used) = decode_batch(grid, &mut theirs, &slots, &bytes).unwrap();
            cost.decode += start.elapsed();
            assert_eq!(used, bytes.len());
            assert!(decoded.iter().zip(&values).all(|(got, sent)| got.1 == *sent), "grid step {step}");
            *(if step == 0 { &mut cost.first_bytes } else { &mut cost.later_bytes }) += bytes.len();
        }
        cost
    }

    #[track_caller]
    fn assert_cost(name: &str, wing: &[[f64; 3]], limit: f64) {
        let cost = cost_of_two_seconds(wing);
        let samples = (wing.len() * 60) as f64;
        let per_sample = (cost.first_bytes + cost.later_bytes) as f64 / samples;
        let first = cost.first_bytes as f64 / wing.len() as f64;
        let ns = [cost.encode, cost.decode].map(|time| time.as_nanos() as f64 / samples);
        println!(
            "{name}: {per_sample:.2} bytes per vertex and sample (the first {first:.2}), {:.0} ns to encode, {:.0} to decode",
            ns[0], ns[1]
        );
        assert!(per_sample <= limit, "{per_sample} bytes");
    }

    #[test]
    fn a_beating_wing_costs_less_than_two_and_a_half_bytes_per_vertex_and_sample() {
        assert_cost("rough wing, neighbours in order", &wing(20_000), 2.5);
    }

    #[test]
    fn a_wing_whose_slots_are_scattered_costs_less_than_two_and_a_half_bytes_too() {
        let (mut wing, mut dice) = (wing(20_000), Dice::new(2));
        (1..wing.len()).rev().for_each(|i| wing.swap(i, dice.below(i as u64 + 1) as usize));
        assert_cost("rough wing, slots at random", &wing, 2.5);
    }

    #[test]
    fn extreme_values_come_back_whatever_the_past() {
        let slots: Vec<_> = (0..100).map(VertexSlot).collect();
        let (mut ours, mut theirs) = (history_of(100), history_of(100));
        let (mut encoder, mut dice) = (SampleEncoder::new(), Dice::new(3));
        for step in 0..200 {
            let extremes = [i32::MIN, i32::MIN + 1, -(1 << 30), -1, 0, 1, 1 << 30, i32::MAX];
            let mut value = || match dice.below(3) {
                0 => dice.next() as i32,
                _ => extremes[dice.below(8) as usize],
            };
            let values: Vec<[i32; 3]> = slots.iter().map(|_| [value(), value(), value()]).collect();
            let mut bytes = Vec::new();
            encoder.encode_batch(GridIndex(step), &mut ours, &slots, &values, &mut bytes);
            assert!(bytes.len() <= 13 * slots.len(), "limits.rs counts on at most 13 bytes a sample");
            let (decoded, _) = decode_batch(GridIndex(step), &mut theirs, &slots, &bytes).unwrap();
            assert!(decoded.iter().zip(&values).all(|(got, sent)| got.1 == *sent), "step {step}");
        }
    }

    #[test]
    fn uniform_motion_costs_only_the_headers_of_groups() {
        let slots: Vec<_> = (0..3200).map(VertexSlot).collect();
        let (mut history, mut encoder) = (history_of(3200), SampleEncoder::new());
        for step in 0..4 {
            let values: Vec<_> =
                (0..3200).map(|i| [i * 7 % 113 + step * 9, i % 31 - step * 5, i % 17]).collect();
            let mut bytes = Vec::new();
            encoder.encode_batch(GridIndex(step), &mut history, &slots, &values, &mut bytes);
            if step >= 2 {
                assert_eq!(bytes.len(), 100 * (2 + 3 * 10) / 8, "step {step}");
            }
        }
    }

    #[test]
    fn a_missing_grid_step_lowers_the_order_instead_of_extrapolating_wrongly() {
        let mut past = Past::default();
        [(0, 10), (1, 20), (2, 30)].into_iter().for_each(|(grid, x)| past.push(GridIndex(grid), [x; 3]));
        assert_eq!(past.order(GridIndex(3)), 3);
        assert_eq!(past.order(GridIndex(4)), 1, "a gap before the new one");
        past.push(GridIndex(4), [50; 3]);
        assert_eq!(past.order(GridIndex(6)), 2, "equal gaps, then a smaller one");
        assert_eq!(past.expect(GridIndex(6), 3, [0; 3]), [70; 3]);
    }

    #[test]
    fn a_sample_sent_again_replaces_what_came_after_it() {
        let mut past = Past::default();
        [(0, 10), (1, 20), (2, 30)].into_iter().for_each(|(grid, x)| past.push(GridIndex(grid), [x; 3]));
        past.rewind(GridIndex(1));
        assert_eq!((past.count, past.grids[0], past.values[0]), (1, 0, [10; 3]));
    }

    #[test]
    fn damaged_batches_give_values_or_errors() {
        let slots: Vec<_> = (0..300).map(VertexSlot).collect();
        let (mut history, mut encoder) = (history_of(300), SampleEncoder::new());
        let wing = wing(300);
        for step in 0..4 {
            let before = history.clone();
            let mut bytes = Vec::new();
            let values = beat(&wing, f64::from(step) / 30.0);
            encoder.encode_batch(GridIndex(step), &mut history, &slots, &values, &mut bytes);
            damaged(&bytes, step as u64, 1000, |bytes| {
                let result = decode_batch(GridIndex(step), &mut before.clone(), &slots, bytes);
                assert!(result.is_err() || result.is_ok_and(|(values, _)| values.len() == slots.len()));
            });
            for length in 0..bytes.len() {
                let cut = decode_batch(GridIndex(step), &mut before.clone(), &slots, &bytes[..length]);
                assert!(matches!(cut, Err(WireError::Truncated { .. })), "{length} of {}", bytes.len());
            }
        }
    }

    #[test]
    fn a_new_step_rescales_the_past() {
        let mut history = history_of(2);
        history.past[1].push(GridIndex(0), [1000, -1001, i32::MAX]);
        history.set_steps(&[(InstanceId(0), STEP_M / 2.0)]).unwrap();
        assert_eq!(history.past[1].values[0], [2000, -2002, i32::MAX]);
        assert_eq!(history.step_m(VertexSlot(1)), Some(STEP_M / 2.0));
    }

    #[test]
    fn the_set_of_slots_iterates_in_order() {
        let mut set = SlotSet::new(200);
        let slots = [0, 1, 63, 64, 127, 128, 199];
        slots.iter().rev().for_each(|slot| assert!(set.insert(*slot)));
        assert!(!set.insert(63) && set.remove(1) && !set.remove(1) && !set.remove(1000));
        assert_eq!(set.iter().collect::<Vec<_>>(), [0, 63, 64, 127, 128, 199]);
    }

    #[test]
    fn a_position_comes_back_within_half_a_step_as_of_the_delta_in_hand() {
        let mut table = StepTable::new(8);
        let (slot, instance) = (VertexSlot(5), InstanceId(9));
        let vertex = NewVertex { slot, instance, motion: Motion::Sampled };
        let position = Vec3::new(1.234_567, -7.654_321, 0.000_2);
        for step_m in [0.0005, 0.01] {
            let mut delta = GeometryDelta::default();
            delta.instances.push(InstanceInfo { instance, step_m });
            delta.new_vertices.push(vertex);
            table.apply(&delta);
            let error = table.position(slot, quantise(position, step_m)) - position;
            assert!(error.abs().max_element() <= step_m * 0.501, "{error} at {step_m}");
        }
        assert_eq!(quantise(Vec3::new(1e30, f32::NAN, -1e30), 1e-6), [i32::MAX, 0, i32::MIN]);
    }
}

//! The records that write the client's vertex memory, in the layout of `client_scatter.comp`.

use crate::constants::{
    MORPH_FIRST_BITS, NO_SAMPLE, PREDICTED_BIT, REST_BIT, REST_END_BIT, SKINNED_BIT, SLOT_MASK, STATIC_BIT,
    TIME_TAG_UNIT,
};
use crate::generated::{RestGpu, VertexWriteGpu};
use shadecast_protocol::limits::{
    MAX_ARENA_WORDS, MAX_REST_VERTICES, MAX_VERTEX_MORPHS, MAX_VERTEX_SLOTS, PREDICTIONS,
};
use shadecast_protocol::time::{GridIndex, WorldTime};

/// The tag of a grid step: tags order like grid indices, and 0 is no sample.
pub fn tag(grid: GridIndex) -> u32 {
    (grid.0 as u32) ^ (1 << 31)
}

/// The record of a sample.
pub fn sample_write(slot: u32, grid: GridIndex, position: [f32; 3]) -> VertexWriteGpu {
    let [x, y, z] = position.map(f32::to_bits);
    VertexWriteGpu { slot, tag: tag(grid), x, y, z }
}

/// The record of an animated vertex that enters a slot: what the slot held is forgotten.
pub fn sampled_entry(slot: u32) -> VertexWriteGpu {
    VertexWriteGpu { slot, tag: NO_SAMPLE, x: 0, y: 0, z: 0 }
}

/// Unit of predictions' times, nanoseconds. A vertex moves by a tenth of a millimetre meanwhile at 2 m/s, and times repeat only
/// after 55 minutes.
const PREDICTION_UNIT_NS: i64 = 50_000;

/// A time as predictions have it in their tags, which leave room for a place of any ring. Repeats; what is not more than half of
/// that apart can be compared.
pub fn prediction_time(time: WorldTime) -> u32 {
    let units = time.0.div_euclid(PREDICTION_UNIT_NS)
        + i64::from(time.0.rem_euclid(PREDICTION_UNIT_NS) >= PREDICTION_UNIT_NS / 2);
    (units as u32).wrapping_mul(TIME_TAG_UNIT)
}

/// The record of a predicted vertex that enters a slot: what the slot held is forgotten.
pub fn predicted_entry(slot: u32) -> VertexWriteGpu {
    VertexWriteGpu { slot: slot | PREDICTED_BIT, tag: NO_SAMPLE, x: 0, y: 0, z: 0 }
}

/// The record of one of a vertex's predictions, `number` counted from 0.
pub fn prediction_write(slot: u32, number: u32, time: WorldTime, position: [f32; 3]) -> VertexWriteGpu {
    let [x, y, z] = position.map(f32::to_bits);
    VertexWriteGpu { slot, tag: prediction_time(time) | (number + 1), x, y, z }
}

/// The record of a static vertex that enters a slot.
pub fn static_entry(slot: u32, position: [f32; 3]) -> VertexWriteGpu {
    let [x, y, z] = position.map(f32::to_bits);
    VertexWriteGpu { slot: slot | STATIC_BIT, tag: NO_SAMPLE, x, y, z }
}

/// A rest number, below [`MAX_REST_NUMBER`]: which rest position a skinned vertex has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RestId(pub u32);

/// Rests have numbers below this.
pub const MAX_REST_NUMBER: u32 = SLOT_MASK;
/// Arena words that can hold morph deltas: those that a rest can name.
pub const MAX_MORPH_WORDS: u32 = 1 << MORPH_FIRST_BITS;

const _: () = {
    assert!(MAX_VERTEX_SLOTS <= SLOT_MASK && MAX_REST_VERTICES <= MAX_REST_NUMBER, "bits of a record's slot");
    assert!(MAX_ARENA_WORDS <= MAX_MORPH_WORDS && MAX_VERTEX_MORPHS < 1 << (u32::BITS - MORPH_FIRST_BITS));
    assert!(PREDICTIONS < TIME_TAG_UNIT, "a prediction's place is what its tag has above its time");
};

/// A vertex before its skeleton moves it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Rest {
    /// In the mesh's space, metres.
    pub position_m: [f32; 3],
    /// Palette entries, those of weight 0 last.
    pub joints: [u16; 4],
    /// Their weights in parts of 65535, which they add up to.
    pub weights: [u16; 4],
    /// The arena word of the vertex's first morph delta, below [`MAX_MORPH_WORDS`].
    pub first_delta: u32,
    /// How many morphs move the vertex.
    pub delta_count: u8,
}

impl Rest {
    /// As the shaders read it.
    pub fn gpu(&self) -> RestGpu {
        let pair = |low: u16, high: u16| u32::from(low) | u32::from(high) << 16;
        let ([x, y, z], [a, b, c, d], w) = (self.position_m.map(f32::to_bits), self.joints, self.weights);
        let morphs = self.first_delta | u32::from(self.delta_count) << MORPH_FIRST_BITS;
        RestGpu {
            position_joints: [x, y, z, pair(a, b)],
            influences: [pair(c, d), pair(w[0], w[1]), pair(w[2], w[3]), morphs],
        }
    }
}

/// The arena word of a morph's delta of one vertex, metres in the mesh's space.
pub fn morph_delta_word(delta_m: [f32; 3], morph: u32) -> [u32; 4] {
    let [x, y, z] = delta_m.map(f32::to_bits);
    [x, y, z, morph]
}

/// The records of a rest.
pub fn rest_writes(number: RestId, rest: &Rest) -> [VertexWriteGpu; 2] {
    let RestGpu { position_joints, influences } = rest.gpu();
    let half = |bits: u32, [x, y, z, tag]: [u32; 4]| VertexWriteGpu { slot: number.0 | bits, tag, x, y, z };
    [half(REST_BIT, position_joints), half(REST_BIT | REST_END_BIT, influences)]
}

/// The record of a skinned vertex that enters a slot, with where its instance's palette begins.
pub fn skinned_entry(slot: u32, rest: RestId, palette_base: u32) -> VertexWriteGpu {
    VertexWriteGpu { slot: slot | SKINNED_BIT, tag: NO_SAMPLE, x: rest.0 + 1, y: palette_base, z: 0 }
}

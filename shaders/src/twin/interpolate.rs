//! Twin of `client_scatter.comp` and `client_interpolate.comp`: the client's vertex memory, and the positions of animated
//! vertices at a display time.

use crate::constants::{
    NO_REST, NO_SAMPLE, ON_CURVE, PAST_THE_END, PREDICTED_BIT, PREDICTED_BLEND, REST_BIT, REST_END_BIT,
    SKINNED_BIT, SLOT_MASK, STATIC_BIT, STATIC_BLEND, TIME_TAG_UNIT,
};
use crate::curve::cubic_weights;
use crate::generated::{InterpolatePush, RestGpu, VertexWriteGpu};
use shadecast_protocol::limits::PREDICTIONS;

/// The client's vertex memory: see `client_vertices.glsl`.
#[derive(Clone, Debug, PartialEq)]
pub struct VertexMemory {
    /// Vertex slots.
    pub vertex_slots: u32,
    /// Steps of the grid that are kept of each: a power of two.
    pub sample_ring: u32,
    /// `[ring][slot]`: position as bits, tag.
    pub samples: Vec<[u32; 4]>,
    /// By slot: position in the world and state.
    pub positions: Vec<[f32; 4]>,
    /// By slot: what is left to blend away, and its share; [`STATIC_BLEND`] for one without samples,
    /// [`PREDICTED_BLEND`] for one whose samples are predictions.
    pub blends: Vec<[f32; 4]>,
    /// By slot: the number of its rest plus 1, [`NO_REST`] where it is not skinned, and where its palette begins.
    pub skins: Vec<[u32; 2]>,
    /// As many as vertex slots.
    pub rests: Vec<RestGpu>,
}

impl VertexMemory {
    /// Empty memory.
    pub fn new(vertex_slots: u32, sample_ring: u32) -> Self {
        let slots = vertex_slots as usize;
        Self {
            vertex_slots,
            sample_ring,
            samples: vec![[0; 4]; slots * sample_ring as usize],
            positions: vec![[0.0; 4]; slots],
            blends: vec![[0.0; 4]; slots],
            skins: vec![[NO_REST, 0]; slots],
            rests: vec![RestGpu { position_joints: [0; 4], influences: [0; 4] }; slots],
        }
    }

    /// One dispatch of `client_scatter.comp`.
    pub fn scatter(&mut self, writes: &[VertexWriteGpu]) {
        for write in writes {
            if write.slot & REST_BIT != 0 {
                self.write_rest(write);
                continue;
            }
            let slot = write.slot & SLOT_MASK;
            if slot >= self.vertex_slots {
                continue;
            }
            if write.tag == NO_SAMPLE {
                self.enter(slot as usize, write);
                continue;
            }
            let at = self.place(slot, write.tag);
            let position = &mut self.positions[slot as usize];
            if self.samples[at][3] == write.tag && position[3] == ON_CURVE {
                position[3] = PAST_THE_END;
            }
            self.samples[at] = [write.x, write.y, write.z, write.tag];
        }
    }

    fn write_rest(&mut self, write: &VertexWriteGpu) {
        let half = [write.x, write.y, write.z, write.tag];
        let Some(rest) = self.rests.get_mut((write.slot & SLOT_MASK) as usize) else { return };
        match write.slot & REST_END_BIT {
            0 => rest.position_joints = half,
            _ => rest.influences = half,
        }
    }

    fn enter(&mut self, slot: usize, write: &VertexWriteGpu) {
        let [is_static, is_skinned] = [STATIC_BIT, SKINNED_BIT].map(|bit| write.slot & bit != 0);
        for ring in 0..self.sample_ring as usize {
            self.samples[ring * self.vertex_slots as usize + slot] = [0; 4];
        }
        let [x, y, z] = [write.x, write.y, write.z].map(f32::from_bits);
        self.positions[slot] = if is_static { [x, y, z, ON_CURVE] } else { [0.0; 4] };
        let share = match write.slot & PREDICTED_BIT {
            0 if is_static || is_skinned => STATIC_BLEND,
            0 => 0.0,
            _ => PREDICTED_BLEND,
        };
        self.blends[slot] = [0.0, 0.0, 0.0, share];
        self.skins[slot] = if is_skinned { [write.x, write.y] } else { [NO_REST, 0] };
    }

    /// One dispatch of `client_interpolate.comp`.
    pub fn interpolate(&mut self, push: &InterpolatePush) {
        for slot in 0..push.vertex_count.min(self.vertex_slots) {
            self.interpolate_vertex(slot, push);
        }
    }

    fn interpolate_vertex(&mut self, slot: u32, push: &InterpolatePush) {
        let mut blend = self.blends[slot as usize];
        if blend[3] == STATIC_BLEND {
            return;
        }
        if blend[3] == PREDICTED_BLEND {
            self.positions[slot as usize] = self.predicted(slot, push.now);
            return;
        }
        let before = self.positions[slot as usize];
        let cubic = push.cubic != 0;
        let Some((now, state)) = self.curve(slot, push.tag, push.fraction, cubic) else {
            self.positions[slot as usize] = [0.0; 4];
            return;
        };
        if before[3] == PAST_THE_END && state == ON_CURVE {
            // After a gap the curve at that time is not known, and the samples that were gone on from may have left the ring.
            blend = match self.curve(slot, push.tag_before, push.fraction_before, cubic) {
                Some((then, ON_CURVE)) => {
                    [before[0] - then[0], before[1] - then[1], before[2] - then[2], 1.0]
                }
                _ => [0.0; 4],
            };
        }
        blend[3] = (blend[3] - push.blend_step).max(0.0);
        self.blends[slot as usize] = blend;
        let moved = |axis: usize| now[axis] + blend[axis] * blend[3];
        self.positions[slot as usize] = [moved(0), moved(1), moved(2), state];
    }

    /// Position and state at a time as predictions have it.
    fn predicted(&self, slot: u32, now: u32) -> [f32; 4] {
        let all = (1..=PREDICTIONS).map(|place| self.samples[(place * self.vertex_slots + slot) as usize]);
        let mut known = all.take_while(|sample| sample[3] != NO_SAMPLE);
        let Some(mut before) = known.next() else { return [0.0; 4] };
        let since = |tag: u32| now.wrapping_sub(tag - tag % TIME_TAG_UNIT) as i32 / TIME_TAG_UNIT as i32;
        let place = |[x, y, z, _]: [u32; 4]| [x, y, z].map(f32::from_bits);
        let with = |[x, y, z]: [f32; 3], state: f32| [x, y, z, state];
        if since(before[3]) <= 0 {
            return with(place(before), ON_CURVE);
        }
        for after in known {
            let (past, left) = (since(before[3]), -since(after[3]));
            if left >= 0 {
                let share = past as f32 / (past + left).max(1) as f32;
                let (a, b) = (place(before), place(after));
                return with(std::array::from_fn(|i| a[i] * (1.0 - share) + b[i] * share), ON_CURVE);
            }
            before = after;
        }
        with(place(before), PAST_THE_END)
    }

    /// Position and state at `f` of the way from step `at` to the next.
    fn curve(&self, slot: u32, at: u32, f: f32, cubic: bool) -> Option<([f32; 3], f32)> {
        let near = [self.sample(slot, at), self.sample(slot, at.wrapping_add(1))];
        let [Some(b), Some(c)] = near else { return self.beyond(slot, at, f) };
        let outer = [self.sample(slot, at.wrapping_sub(1)), self.sample(slot, at.wrapping_add(2))];
        let position = match outer {
            [Some(a), Some(d)] if cubic => {
                let w = cubic_weights(f);
                std::array::from_fn(|i| w[0] * a[i] + w[1] * b[i] + w[2] * c[i] + w[3] * d[i])
            }
            _ => std::array::from_fn(|i| b[i] * (1.0 - f) + c[i] * f),
        };
        Some((position, ON_CURVE))
    }

    fn beyond(&self, slot: u32, at: u32, f: f32) -> Option<([f32; 3], f32)> {
        let known =
            (0..self.sample_ring).map(|ring| self.samples[(ring * self.vertex_slots + slot) as usize][3]);
        let last = known.filter(|known| *known != NO_SAMPLE && *known <= at).max()?;
        let end = self.sample(slot, last)?;
        let earlier = self.sample(slot, last.wrapping_sub(1)).unwrap_or(end);
        let steps = ((at - last) as f32 + f).min(1.0);
        Some((std::array::from_fn(|i| end[i] + (end[i] - earlier[i]) * steps), PAST_THE_END))
    }

    fn place(&self, slot: u32, tag: u32) -> usize {
        (tag % self.sample_ring * self.vertex_slots + slot) as usize
    }

    fn sample(&self, slot: u32, tag: u32) -> Option<[f32; 3]> {
        let [x, y, z, known] = self.samples[self.place(slot, tag)];
        (known == tag && tag != NO_SAMPLE).then(|| [x, y, z].map(f32::from_bits))
    }
}

#[cfg(test)]
mod tests;

//! Twin of `client_skin.comp`: the place of a skinned vertex in the world, in double precision.

use super::pose::{Arena, Posed};
use crate::constants::MORPH_FIRST_BITS;
use crate::generated::RestGpu;

/// The position of a rest in the world, metres.
pub fn position(arena: Arena<'_>, rest: &RestGpu, posed: &Posed) -> [f64; 3] {
    let [x, y, z, first_joints] = rest.position_joints;
    let [last_joints, first_weights, last_weights, morphs] = rest.influences;
    let mut in_mesh = [x, y, z].map(|bits| f64::from(f32::from_bits(bits)));
    let first = morphs & ((1 << MORPH_FIRST_BITS) - 1);
    for word in first..first + (morphs >> MORPH_FIRST_BITS) {
        let [dx, dy, dz, morph] = arena.0[word as usize];
        let weight = posed.morph_weights[morph as usize];
        for (axis, bits) in [dx, dy, dz].into_iter().enumerate() {
            in_mesh[axis] += weight * f64::from(f32::from_bits(bits));
        }
    }
    let halves = |words: [u32; 2]| words.into_iter().flat_map(|word| [word & 0xffff, word >> 16]);
    let mut in_world = [0.0; 3];
    for (joint, weight) in halves([first_joints, last_joints]).zip(halves([first_weights, last_weights])) {
        if weight == 0 {
            break;
        }
        for (axis, row) in posed.palette[joint as usize].iter().enumerate() {
            let moved = row[0] * in_mesh[0] + row[1] * in_mesh[1] + row[2] * in_mesh[2] + row[3];
            in_world[axis] += f64::from(weight) / 65535.0 * moved;
        }
    }
    in_world
}

//! A tiny generator whose numbers never change. Simulated fates and test inputs must stay the same across crate versions and
//! platforms; the general-purpose crates do not promise that.

/// Advances `state` and returns 64 well-mixed bits (`SplitMix64`, Steele, Lea and Flood 2014).
pub(crate) fn next(state: &mut u64) -> u64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Advances `state` and returns a number in `[0, 1)`.
pub(crate) fn unit(state: &mut u64) -> f64 {
    (next(state) >> 11) as f64 / (1u64 << 53) as f64
}

/// 32 bytes that depend on `seed` and `purpose` only.
pub(crate) fn bytes32(seed: u64, purpose: u64) -> [u8; 32] {
    let mut state = seed ^ purpose.wrapping_mul(0xd6e8_feb8_6659_fd93);
    let mut out = [0; 32];
    for chunk in out.chunks_exact_mut(8) {
        chunk.copy_from_slice(&next(&mut state).to_le_bytes());
    }
    out
}

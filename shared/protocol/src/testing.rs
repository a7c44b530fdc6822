//! Seeded randomness and mutation of bytes, for this crate's tests.

/// SplitMix64: small, seeded, and the same everywhere. Source: Steele, Lea and Flood 2014.
pub(crate) struct Dice(u64);

impl Dice {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    /// 0..limit; the limit must not be 0.
    pub(crate) fn below(&mut self, limit: u64) -> u64 {
        self.next() % limit
    }

    /// True once in `times`.
    pub(crate) fn once_in(&mut self, times: u64) -> bool {
        self.below(times) == 0
    }

    /// -1 to 1.
    pub(crate) fn signed_unit(&mut self) -> f64 {
        self.next() as f64 / u64::MAX as f64 * 2.0 - 1.0
    }
}

/// Calls `check` with every prefix of `valid` (long ones at some thousand places), with bytes appended, and with
/// `mutations` seeded damages of one to four kinds.
pub(crate) fn damaged(valid: &[u8], seed: u64, mutations: usize, mut check: impl FnMut(&[u8])) {
    let step = valid.len() / 4000 + 1;
    (0..valid.len()).step_by(step).for_each(|length| check(&valid[..length]));
    let mut dice = Dice::new(seed);
    for _ in 0..mutations {
        let mut bytes = valid.to_vec();
        for _ in 0..=dice.below(4) {
            damage(&mut bytes, &mut dice);
        }
        check(&bytes);
    }
}

fn damage(bytes: &mut Vec<u8>, dice: &mut Dice) {
    if bytes.is_empty() {
        return bytes.push(dice.next() as u8);
    }
    let at = dice.below(bytes.len() as u64) as usize;
    match dice.below(6) {
        0 => bytes[at] ^= 1 << dice.below(8),
        1 => bytes[at] = dice.next() as u8,
        2 => bytes[at] = [0, 1, 0x7f, 0x80, 0xff][dice.below(5) as usize],
        3 => bytes.insert(at, dice.next() as u8),
        4 => drop(bytes.remove(at)),
        _ => {
            let end = (at + 4).min(bytes.len());
            bytes[at..end].fill(0xff);
        }
    }
}

//! An adaptive binary range coder: numbers in as few bits as their frequency so far allows. Pure, total and sequential.
//!
//! Formats are written once, for both directions: [`Coder`] is given a value and gives it back; a decoder ignores the one that
//! it is given. So nothing that depends on a value not yet coded can be used by mistake. The arithmetic is that of LZMA: a
//! range of 32 bits, and carry by counting bytes of ones.

use crate::wire::{WireError, invalid};

/// Bits of a probability.
const CHANCE_BITS: u32 = 16;
/// What is left of a probability that is almost nothing.
const LEAST_CHANCE: u16 = 48;
/// Below this the range takes in another byte.
const LEAST_RANGE: u32 = 1 << 24;
/// Bytes that a decoder reads ahead. An encoder leaves out as many zeros at most.
const AHEAD_BYTES: usize = 4;
/// Steps of a probability are at least its distance by this power of two.
const SLOWEST: u8 = 5;
/// Bits of a number's first part that have probabilities of their own.
const TOP_BITS: u32 = 3;
const NUMBER_BITS: usize = 33;

/// How likely a bit is zero, as learnt from those before.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Chance {
    zero: u16,
    seen: u8,
}

impl Default for Chance {
    fn default() -> Self {
        Self { zero: 1 << (CHANCE_BITS - 1), seen: 0 }
    }
}

impl Chance {
    /// The first bits count most: the mean of all so far, then one that forgets.
    fn learn(&mut self, bit: bool) {
        let shift = (self.seen / 2 + 1).min(SLOWEST);
        self.seen = (self.seen + 1).min(2 * SLOWEST);
        let target = if bit { LEAST_CHANCE } else { u16::MAX - LEAST_CHANCE };
        let distance = (i32::from(target) - i32::from(self.zero)) >> shift;
        self.zero = (i32::from(self.zero) + distance) as u16;
        self.zero = self.zero.clamp(LEAST_CHANCE, u16::MAX - LEAST_CHANCE);
    }
}

/// Either direction.
pub(crate) trait Coder {
    /// Whether the values that it is given are those to code.
    const TELLS: bool;

    /// A bit that is learnt from.
    fn bit(&mut self, chance: &mut Chance, bit: bool) -> bool;

    /// So many bits, at most 32, that are as likely one way as the other.
    fn raw(&mut self, bits: u32, value: u32) -> u32;

    /// What follows is counted for this account.
    fn count_for(&mut self, account: usize);

    /// False once a decoder has read more than there is.
    fn is_intact(&self) -> bool;
}

/// Makes the bytes.
#[derive(Debug)]
pub(crate) struct RangeEncoder<'a> {
    out: &'a mut Vec<u8>,
    low: u64,
    range: u32,
    /// The last byte that is not final, and how many follow it that a carry would turn.
    cache: u8,
    pending: usize,
    /// The first byte is zero always, and left out.
    has_begun: bool,
    /// By account, bits by 256.
    accounts: &'a mut [u64],
    account: usize,
}

impl<'a> RangeEncoder<'a> {
    /// Appends to `out`, and adds what it takes to the accounts, in bits by 256.
    pub(crate) fn new(out: &'a mut Vec<u8>, accounts: &'a mut [u64]) -> Self {
        Self { out, low: 0, range: u32::MAX, cache: 0, pending: 1, has_begun: false, accounts, account: 0 }
    }

    fn shift(&mut self) {
        if self.low < 0xff00_0000 || self.low > u64::from(u32::MAX) {
            let carry = (self.low >> 32) as u8;
            if std::mem::replace(&mut self.has_begun, true) {
                self.out.push(self.cache.wrapping_add(carry));
            }
            self.out.extend(std::iter::repeat_n(0xff_u8.wrapping_add(carry), self.pending - 1));
            self.pending = 0;
            self.cache = (self.low >> 24) as u8;
        }
        self.pending += 1;
        self.low = (self.low & 0x00ff_ffff) << 8;
    }

    fn normalise(&mut self) {
        while self.range < LEAST_RANGE {
            self.range <<= 8;
            self.shift();
        }
    }

    /// The last bytes.
    pub(crate) fn finish(mut self) {
        let start = self.out.len();
        // Of the values in the range, the one with the most zeros at its end.
        let end = self.low + u64::from(self.range) - 1;
        let zeros = (0..33).rev().find(|zeros| end >> zeros << zeros >= self.low).unwrap_or(0);
        self.low = end >> zeros << zeros;
        (0..5).for_each(|_| self.shift());
        let mut spare = AHEAD_BYTES;
        while spare > 0 && self.out.len() > start && self.out.last() == Some(&0) {
            self.out.pop();
            spare -= 1;
        }
    }
}

/// Bits by 256 of an event of this probability.
fn price(chance: u32) -> u64 {
    let chance = chance.max(1);
    let whole = chance.ilog2();
    // The logarithm between two powers of two is close to a line.
    let part = ((u64::from(chance) << 8) >> whole) - 256;
    u64::from(CHANCE_BITS) * 256 - u64::from(whole) * 256 - part
}

impl Coder for RangeEncoder<'_> {
    const TELLS: bool = true;

    fn bit(&mut self, chance: &mut Chance, bit: bool) -> bool {
        let bound = (self.range >> CHANCE_BITS) * u32::from(chance.zero);
        let zero = u32::from(chance.zero);
        if bit {
            self.low += u64::from(bound);
            self.range -= bound;
            self.accounts[self.account] += price((1 << CHANCE_BITS) - zero);
        } else {
            self.range = bound;
            self.accounts[self.account] += price(zero);
        }
        chance.learn(bit);
        self.normalise();
        bit
    }

    fn raw(&mut self, bits: u32, value: u32) -> u32 {
        debug_assert!(bits == 32 || value >> bits == 0, "{value} in {bits} bits");
        for shift in (0..bits).rev() {
            self.range >>= 1;
            if value >> shift & 1 == 1 {
                self.low += u64::from(self.range);
            }
            self.normalise();
        }
        self.accounts[self.account] += 256 * u64::from(bits);
        value
    }

    fn count_for(&mut self, account: usize) {
        self.account = account;
    }

    fn is_intact(&self) -> bool {
        true
    }
}

/// Reads them.
#[derive(Debug)]
pub(crate) struct RangeDecoder<'a> {
    bytes: &'a [u8],
    /// Bytes read, those beyond the end included.
    read: usize,
    code: u32,
    range: u32,
}

impl<'a> RangeDecoder<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        let mut decoder = Self { bytes, read: 0, code: 0, range: u32::MAX };
        (0..AHEAD_BYTES).for_each(|_| decoder.next_byte());
        decoder
    }

    fn next_byte(&mut self) {
        let byte = self.bytes.get(self.read).copied().unwrap_or(0);
        self.read = self.read.saturating_add(1);
        self.code = self.code << 8 | u32::from(byte);
    }

    fn normalise(&mut self) {
        while self.range < LEAST_RANGE {
            self.range <<= 8;
            self.next_byte();
        }
    }

    /// Neither more nor less was read than there is.
    pub(crate) fn finish(self, what: &'static str) -> Result<(), WireError> {
        if !self.is_intact() {
            return Err(invalid(what, "it ends too early"));
        }
        match self.bytes.len().saturating_sub(self.read) {
            0 => Ok(()),
            left => Err(WireError::Trailing { what, left }),
        }
    }
}

impl Coder for RangeDecoder<'_> {
    const TELLS: bool = false;

    fn bit(&mut self, chance: &mut Chance, _: bool) -> bool {
        let bound = (self.range >> CHANCE_BITS) * u32::from(chance.zero);
        let bit = self.code >= bound;
        if bit {
            self.code -= bound;
            self.range -= bound;
        } else {
            self.range = bound;
        }
        chance.learn(bit);
        self.normalise();
        bit
    }

    fn raw(&mut self, bits: u32, _: u32) -> u32 {
        let mut value = 0;
        for _ in 0..bits {
            self.range >>= 1;
            let bit = self.code >= self.range;
            self.code -= if bit { self.range } else { 0 };
            value = value << 1 | u32::from(bit);
            self.normalise();
        }
        value
    }

    fn count_for(&mut self, _: usize) {}

    fn is_intact(&self) -> bool {
        self.read <= self.bytes.len() + AHEAD_BYTES
    }
}

/// One of `1 << BITS` symbols; `SIZE` is that number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Symbol<const SIZE: usize>([Chance; SIZE]);

impl<const SIZE: usize> Default for Symbol<SIZE> {
    fn default() -> Self {
        const { assert!(SIZE.is_power_of_two()) };
        Self([Chance::default(); SIZE])
    }
}

impl<const SIZE: usize> Symbol<SIZE> {
    pub(crate) fn code(&mut self, coder: &mut impl Coder, symbol: u32) -> u32 {
        self.node(coder, SIZE.ilog2(), symbol) - SIZE as u32
    }

    /// A symbol of so many bits, with a one before them.
    fn node(&mut self, coder: &mut impl Coder, bits: u32, symbol: u32) -> u32 {
        let mut node = 1;
        for shift in (0..bits).rev() {
            node = node << 1 | usize::from(coder.bit(&mut self.0[node], symbol >> shift & 1 == 1));
        }
        node as u32
    }
}

/// A number, small ones short: how many bits it has, then these.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Number {
    is_longer: [Chance; NUMBER_BITS],
    top: [Symbol<{ 1 << TOP_BITS }>; NUMBER_BITS],
}

impl Default for Number {
    fn default() -> Self {
        Self { is_longer: [Chance::default(); NUMBER_BITS], top: std::array::from_fn(|_| Symbol::default()) }
    }
}

impl Number {
    pub(crate) fn code(&mut self, coder: &mut impl Coder, value: u32) -> u32 {
        let next = u64::from(value) + 1;
        let (length, mut bits) = (next.ilog2(), 0);
        while bits < 32 && coder.bit(&mut self.is_longer[bits as usize], bits < length) {
            bits += 1;
        }
        let mantissa = (next & ((1u64 << length) - 1)) as u32;
        let top_bits = bits.min(TOP_BITS);
        let low_bits = bits - top_bits;
        // Of a decoder the value is none of these; it is ignored.
        let top = (mantissa >> low_bits) & ((1 << top_bits) - 1);
        let node = self.top[bits as usize].node(coder, top_bits, top);
        let low = if low_bits == 0 { 0 } else { mantissa & ((1 << low_bits) - 1) };
        let low = coder.raw(low_bits, low);
        // `node` has the leading one.
        let next = u64::from(node) << low_bits | u64::from(low);
        u32::try_from(next - 1).unwrap_or(u32::MAX)
    }

    /// A number of either sign.
    pub(crate) fn code_signed(&mut self, coder: &mut impl Coder, value: i32) -> i32 {
        crate::wire::unzigzag(self.code(coder, crate::wire::zigzag(value)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Dice, damaged};

    /// What a test codes, of a kind that its number gives.
    #[derive(Default)]
    struct Model {
        chances: [Chance; 3],
        symbol: Symbol<16>,
        number: Number,
        signed: Number,
    }

    impl Model {
        fn code(&mut self, coder: &mut impl Coder, kind: u64, value: u32) -> u32 {
            match kind {
                0..3 => u32::from(coder.bit(&mut self.chances[kind as usize], value & 1 == 1)),
                3 => self.symbol.code(coder, value & 15),
                4 => self.signed.code_signed(coder, value as i32) as u32,
                5 => coder.raw(1, value & 1),
                6 => coder.raw(32, value),
                _ => self.number.code(coder, value),
            }
        }
    }

    fn script(seed: u64, count: usize) -> Vec<(u64, u32)> {
        let mut dice = Dice::new(seed);
        let one = |_| {
            let (kind, shift) = (dice.below(8), dice.below(33));
            let value = (dice.next() as u32 as u64 >> shift) as u32;
            let value = match kind {
                0 => u32::from(dice.once_in(500)),
                1 => u32::from(!dice.once_in(500)),
                _ if dice.once_in(40) => u32::MAX,
                _ => value,
            };
            (kind, value)
        };
        (0..count).map(one).collect()
    }

    fn encoded(script: &[(u64, u32)]) -> (Vec<u8>, Vec<u32>, u64) {
        let (mut bytes, mut accounts, mut model) = (Vec::new(), [0; 1], Model::default());
        let mut encoder = RangeEncoder::new(&mut bytes, &mut accounts);
        let values = script.iter().map(|(kind, value)| model.code(&mut encoder, *kind, *value)).collect();
        encoder.finish();
        (bytes, values, accounts[0])
    }

    #[test]
    fn what_was_coded_comes_back() {
        for (seed, count) in (0..200).map(|seed| (seed, seed as usize * 7)) {
            let script = script(seed, count);
            let (bytes, values, _) = encoded(&script);
            let (mut decoder, mut model) = (RangeDecoder::new(&bytes), Model::default());
            for ((kind, _), value) in script.iter().zip(values) {
                assert_eq!(model.code(&mut decoder, *kind, 0), value, "seed {seed}, kind {kind}");
            }
            assert_eq!(decoder.finish("a test"), Ok(()), "seed {seed}");
        }
    }

    #[test]
    fn numbers_keep_their_value() {
        for value in [0, 1, 2, 6, 7, 8, 255, 1 << 16, u32::MAX - 1, u32::MAX] {
            assert_eq!(encoded(&[(7, value), (4, value)]).1, [value, value]);
        }
    }

    #[test]
    fn frequent_values_are_short() {
        let often: Vec<_> = (0..8000).map(|n| (0, u32::from(n % 100 == 0))).collect();
        let (bytes, _, account) = encoded(&often);
        // The entropy of one in a hundred is 0.081 bits.
        assert!(bytes.len() < 8000 / 8 * 13 / 100, "{} bytes", bytes.len());
        let told = account as f64 / 256.0 / 8.0;
        assert!((told / bytes.len() as f64 - 1.0).abs() < 0.1, "{told} of {} bytes", bytes.len());
        assert_eq!(encoded(&[]).0, [], "nothing takes nothing");
    }

    #[test]
    fn any_bytes_give_values_and_too_few_an_error() {
        let script = script(3, 400);
        let (bytes, ..) = encoded(&script);
        let run = |bytes: &[u8]| {
            let (mut decoder, mut model) = (RangeDecoder::new(bytes), Model::default());
            script.iter().for_each(|(kind, _)| {
                model.code(&mut decoder, *kind, 0);
            });
            decoder.finish("a test")
        };
        damaged(&bytes, 7, 300, |bytes| drop(run(bytes)));
        assert!(run(&bytes[..bytes.len() / 2]).unwrap_err().to_string().contains("ends too early"));
        assert!(matches!(run(&[bytes, vec![0; 9]].concat()), Err(WireError::Trailing { .. })));
    }
}

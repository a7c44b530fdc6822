//! Bits of pictures by the reason for which they are spent.
//!
//! An access unit and the blocks that were shaded with its update enter; bits by reason leave, and add up to the access unit's.
//! Each macroblock's bits are read from the stream ([`BitCounter`]). A macroblock that several shaded blocks share is divided by
//! their texels in it: that is the only part that is estimated.

use crate::encode::AccessUnit;
use crate::encode::macroblocks::{BitCounter, CountError, MacroblockBits};
use crate::shading::reuse::{REASONS, Reason};
use serde::{Deserialize, Serialize};
use shadecast_protocol::atlas::Block;
use std::iter::Sum;
use std::ops::{Add, Sub};

/// Texels along a macroblock.
const MACROBLOCK_TEXELS: u32 = 16;

/// Bits by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CauseBits {
    /// Blocks that came into view, or into the surround.
    pub entering: u64,
    /// Blocks with another size or place.
    pub resized: u64,
    /// Blocks of which a pixel of the display covers more or less.
    pub refiltered: u64,
    /// Blocks on which light, shadow or reflection changed.
    pub relit: u64,
    /// Blocks that moved.
    pub moving: u64,
    /// Pictures that need no other.
    pub refresh: u64,
    /// Macroblocks without a shaded block, such as still ones that a finer quantiser refines.
    pub unshaded: u64,
    /// Headers and what encloses the slices.
    pub headers: u64,
}

impl CauseBits {
    /// Each with its name.
    pub fn named(&self) -> [(&'static str, u64); 8] {
        [
            ("entering", self.entering),
            ("resized", self.resized),
            ("refiltered", self.refiltered),
            ("relit", self.relit),
            ("moving", self.moving),
            ("refresh", self.refresh),
            ("unshaded", self.unshaded),
            ("headers", self.headers),
        ]
    }

    /// All of them.
    pub fn total(&self) -> u64 {
        self.named().iter().map(|(_, bits)| bits).sum()
    }

    fn by(self, other: Self, of: impl Fn(u64, u64) -> u64) -> Self {
        Self {
            entering: of(self.entering, other.entering),
            resized: of(self.resized, other.resized),
            refiltered: of(self.refiltered, other.refiltered),
            relit: of(self.relit, other.relit),
            moving: of(self.moving, other.moving),
            refresh: of(self.refresh, other.refresh),
            unshaded: of(self.unshaded, other.unshaded),
            headers: of(self.headers, other.headers),
        }
    }
}

impl Add for CauseBits {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        self.by(other, |a, b| a + b)
    }
}

impl Sub for CauseBits {
    type Output = Self;

    /// What came to it since `earlier`.
    fn sub(self, earlier: Self) -> Self {
        self.by(earlier, u64::saturating_sub)
    }
}

impl Sum for CauseBits {
    fn sum<I: Iterator<Item = Self>>(all: I) -> Self {
        all.fold(Self::default(), Add::add)
    }
}

/// Divides the bits of one encoder's pictures.
#[derive(Clone, Debug, Default)]
pub struct Ledger {
    counter: BitCounter,
    /// By macroblock, shaded texels by reason.
    texels: Vec<[u16; REASONS]>,
}

impl Ledger {
    /// The bits of the next access unit, with whose update these blocks of the atlas were shaded.
    ///
    /// # Errors
    /// The stream is damaged, or of a kind whose macroblocks are not read.
    pub fn divide(&mut self, unit: &AccessUnit, shaded: &[(Block, Reason)]) -> Result<CauseBits, CountError> {
        let total = 8 * unit.bytes.len() as u64;
        let counted = self.counter.count(&unit.bytes)?;
        if unit.is_refresh {
            return Ok(CauseBits { refresh: total, ..CauseBits::default() });
        }
        note_texels(&mut self.texels, counted, shaded);
        let mut by_reason = [0.0; REASONS];
        let mut unshaded = 0.0;
        for (texels, bits) in self.texels.iter().zip(&counted.bits) {
            let all: u32 = texels.iter().map(|texels| u32::from(*texels)).sum();
            if all == 0 {
                unshaded += bits;
                continue;
            }
            for (sum, texels) in by_reason.iter_mut().zip(texels) {
                *sum += bits * f64::from(*texels) / f64::from(all);
            }
        }
        let of = |reason: Reason| by_reason[reason as usize] as u64;
        let bits = CauseBits {
            entering: of(Reason::Entering),
            resized: of(Reason::Resized),
            refiltered: of(Reason::Refiltered),
            relit: of(Reason::Relit),
            moving: of(Reason::Moving),
            unshaded: unshaded as u64,
            ..CauseBits::default()
        };
        Ok(CauseBits { headers: total.saturating_sub(bits.total()), ..bits })
    }
}

/// Counts the texels of shaded blocks in each macroblock.
fn note_texels(
    texels: &mut Vec<[u16; REASONS]>,
    MacroblockBits { columns, bits }: &MacroblockBits,
    shaded: &[(Block, Reason)],
) {
    texels.clear();
    texels.resize(bits.len(), [0; REASONS]);
    let overlap = |from: u32, to: u32, at: u32| {
        let begin = at * MACROBLOCK_TEXELS;
        to.min(begin + MACROBLOCK_TEXELS) - from.max(begin)
    };
    for (block, reason) in shaded {
        let [left, top, right, bottom] = block.rect_texels();
        for row in top / MACROBLOCK_TEXELS..bottom.div_ceil(MACROBLOCK_TEXELS) {
            for column in left / MACROBLOCK_TEXELS..right.div_ceil(MACROBLOCK_TEXELS) {
                let shared = overlap(left, right, column) * overlap(top, bottom, row);
                if let Some(texels) = texels.get_mut(row as usize * columns + column as usize) {
                    texels[*reason as usize] += shared as u16;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests;

//! Coverage of a block: the texels that a cutout's material leaves. It takes one bit per texel, sent once with the block's
//! placement, and lossless: a picture's codec would move the edges of leaves.

use crate::wire::{Reader, WireError, check_count, invalid, put_varint};

/// Runs of equal bits follow, by turns uncovered and covered.
const RUNS: u8 = 0;
/// The bits follow as they are.
const BITS: u8 = 1;

/// See the module. Texels row by row, from the upper left of the block.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Coverage {
    texels: u32,
    bytes: Vec<u8>,
}

impl Coverage {
    /// Of a block of so many texels, each as told by its number.
    pub fn from_fn(texels: u32, mut is_covered: impl FnMut(u32) -> bool) -> Self {
        let mut made = Self { texels, bytes: vec![0; texels.div_ceil(8) as usize] };
        (0..texels).filter(|texel| is_covered(*texel)).for_each(|texel| made.cover(texel));
        made
    }

    fn cover(&mut self, texel: u32) {
        self.bytes[texel as usize / 8] |= 1 << (texel % 8);
    }

    /// Texels of the block.
    pub fn texels(&self) -> u32 {
        self.texels
    }

    /// Bytes that it takes in memory.
    pub fn byte_count(&self) -> usize {
        self.bytes.len()
    }

    /// Whether the texel of a number is covered.
    pub fn is_covered(&self, texel: u32) -> bool {
        self.bytes[texel as usize / 8] >> (texel % 8) & 1 == 1
    }

    /// Whether all texels are covered: then the patch is as good as opaque.
    pub fn is_whole(&self) -> bool {
        (0..self.texels).all(|texel| self.is_covered(texel))
    }

    /// Lengths of runs of equal texels: uncovered ones, of which there may be none, then covered ones, and so on.
    fn runs(&self) -> Vec<u32> {
        let (mut runs, mut covered) = (vec![0], false);
        for texel in 0..self.texels {
            if self.is_covered(texel) != covered {
                covered = !covered;
                runs.push(0);
            }
            *runs.last_mut().expect("there is a first") += 1;
        }
        runs
    }

    /// Appends it in runs, or as it is where that is shorter.
    pub(crate) fn put(&self, out: &mut Vec<u8>) {
        let start = out.len();
        out.push(RUNS);
        self.runs().into_iter().for_each(|run| put_varint(out, run));
        if out.len() - start > 1 + self.bytes.len() {
            out.truncate(start);
            out.push(BITS);
            out.extend_from_slice(&self.bytes);
        }
    }

    /// That of a block of so many texels.
    pub(crate) fn take(reader: &mut Reader<'_>, texels: u32) -> Result<Self, WireError> {
        match reader.u8()? {
            RUNS => Self::take_runs(reader, texels),
            BITS => {
                let bytes = reader.take(texels.div_ceil(8) as usize)?.to_vec();
                Ok(Self { texels, bytes })
            }
            other => Err(invalid("a block's coverage", format!("{other} is no form of it"))),
        }
    }

    fn take_runs(reader: &mut Reader<'_>, texels: u32) -> Result<Self, WireError> {
        const WHAT: &str = "a run of a block's coverage";
        let mut taken = Self::from_fn(texels, |_| false);
        let (mut at, mut covered) = (0, false);
        while at < texels {
            let run = reader.varint()?;
            check_count(WHAT, run as usize, (texels - at) as usize)?;
            if run == 0 && (covered || at > 0) {
                return Err(invalid(WHAT, "it is of no texels"));
            }
            if covered {
                (at..at + run).for_each(|texel| taken.cover(texel));
            }
            (at, covered) = (at + run, !covered);
        }
        Ok(taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{Dice, damaged};

    fn round_trip(coverage: &Coverage) -> usize {
        let mut bytes = Vec::new();
        coverage.put(&mut bytes);
        let mut reader = Reader::new("coverage", &bytes);
        assert_eq!(Coverage::take(&mut reader, coverage.texels()).as_ref(), Ok(coverage));
        reader.finish().expect("nothing is left");
        bytes.len()
    }

    #[test]
    fn coverage_round_trips_within_its_bits() {
        assert_eq!(round_trip(&Coverage::from_fn(4096, |_| false)), 3, "one run");
        assert_eq!(round_trip(&Coverage::from_fn(4096, |_| true)), 4, "none, and one run");
        assert_eq!(round_trip(&Coverage::from_fn(4096, |texel| texel % 2 == 0)), 1 + 512, "its bits");
        let mut dice = Dice::new(3);
        for _ in 0..200 {
            let rare = 1 + dice.below(40);
            let coverage = Coverage::from_fn(16 << dice.below(6), |_| dice.once_in(rare));
            assert!(round_trip(&coverage) <= 1 + coverage.byte_count());
        }
    }

    #[test]
    fn damaged_coverage_is_refused_or_is_of_the_blocks_texels() {
        let coverage = Coverage::from_fn(256, |texel| texel % 16 > texel / 16);
        let mut bytes = Vec::new();
        coverage.put(&mut bytes);
        damaged(&bytes, 1, 300, |bytes| {
            if let Ok(taken) = Coverage::take(&mut Reader::new("coverage", bytes), 256) {
                assert_eq!((taken.texels(), taken.byte_count()), (256, 32));
            }
        });
        let take = |bytes: &[u8]| Coverage::take(&mut Reader::new("coverage", bytes), 16);
        assert!(take(&[RUNS, 17]).is_err(), "a run beyond the block");
        assert!(take(&[RUNS, 4, 0, 12]).is_err(), "a run of nothing");
        assert!(take(&[BITS, 255]).is_err() && take(&[2]).is_err() && take(&[RUNS, 4]).is_err());
        assert!(take(&[RUNS, 0, 16]).is_ok_and(|coverage| coverage.is_whole()));
    }
}

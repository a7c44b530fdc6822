//! Coefficients of a macroblock (clauses 7.3.5.3 and 9.3.3.1.1.9).

use super::CountError;
use super::slice::{Kind, Macroblock, Slice};
use super::tables::{LAST_8X8, SIGNIFICANT_8X8};

/// A kind of block: its contexts, and how many coefficients it has.
#[derive(Clone, Copy)]
struct Category {
    /// Of the flag that anything is coded.
    coded: usize,
    significant: usize,
    last: usize,
    level: usize,
    coefficients: usize,
}

const fn category(offsets: [usize; 3], coefficients: usize) -> Category {
    let [coded, map, level] = offsets;
    Category { coded: 85 + coded, significant: 105 + map, last: 166 + map, level: 227 + level, coefficients }
}

const LUMA_CURRENT: Category = category([0, 0, 0], 16);
const LUMA_REST: Category = category([4, 15, 10], 15);
const LUMA: Category = category([8, 29, 20], 16);
const CHROMA_CURRENT: Category = category([12, 44, 30], 4);
const CHROMA_REST: Category = category([16, 47, 39], 15);
const LUMA_8X8: Category = Category { coded: 0, significant: 402, last: 417, level: 426, coefficients: 64 };

impl Slice<'_> {
    /// Reads all coefficients that the pattern names.
    pub(super) fn residual(&mut self) -> Result<(), CountError> {
        let is_16 = self.now.kind == Kind::Intra16;
        if is_16 {
            self.current(0, LUMA_CURRENT)?;
        }
        for quarter in 0..4 {
            if self.now.pattern >> quarter & 1 == 1 {
                self.luma_quarter(quarter, if is_16 { LUMA_REST } else { LUMA })?;
            }
        }
        let chroma = self.now.pattern >> 4;
        for plane in 1..if chroma > 0 { 3 } else { 0 } {
            self.current(plane, CHROMA_CURRENT)?;
        }
        for block in 0..if chroma > 1 { 8 } else { 0 } {
            self.chroma_block(block)?;
        }
        Ok(())
    }

    /// The direct currents of a plane.
    fn current(&mut self, plane: u8, category: Category) -> Result<(), CountError> {
        let has = |of: Macroblock| of.currents >> plane & 1 == 1;
        if self.is_coded_by(category, [self.left.map(has), self.above.map(has)]) {
            self.now.currents |= 1 << plane;
            self.levels(category)?;
        }
        Ok(())
    }

    fn luma_quarter(&mut self, quarter: u8, category: Category) -> Result<(), CountError> {
        let (left, top) = (quarter & 1, quarter >> 1);
        if self.now.is_8x8 {
            self.now.luma |= 0x33 << (8 * top + 2 * left);
            return self.levels(LUMA_8X8);
        }
        for block in 0..4 {
            let (x, y) = (2 * left + (block & 1), 2 * top + (block >> 1));
            let (before, over, now) = (self.left, self.above, self.now);
            let has = |of: &Macroblock, at: u8| of.luma >> at & 1 == 1;
            let left_is =
                if x > 0 { Some(has(&now, 4 * y + x - 1)) } else { before.map(|of| has(&of, 4 * y + 3)) };
            let above_is =
                if y > 0 { Some(has(&now, 4 * (y - 1) + x)) } else { over.map(|of| has(&of, 12 + x)) };
            if self.is_coded_by(category, [left_is, above_is]) {
                self.now.luma |= 1 << (4 * y + x);
                self.levels(category)?;
            }
        }
        Ok(())
    }

    /// Of Cb the first four, of Cr the others.
    fn chroma_block(&mut self, block: u8) -> Result<(), CountError> {
        let (x, y) = (block & 1, block >> 1 & 1);
        let has = |of: Macroblock, at: u8| of.chroma >> at & 1 == 1;
        let (before, over, now) = (self.left, self.above, self.now);
        let left_is = if x > 0 { Some(has(now, block - 1)) } else { before.map(|of| has(of, block + 1)) };
        let above_is = if y > 0 { Some(has(now, block - 2)) } else { over.map(|of| has(of, block + 2)) };
        if self.is_coded_by(CHROMA_REST, [left_is, above_is]) {
            self.now.chroma |= 1 << block;
            self.levels(CHROMA_REST)?;
        }
        Ok(())
    }

    /// Whether a block is coded, by whether those left of it and above it are. Where there is none, intra blocks count it as coded.
    fn is_coded_by(&mut self, category: Category, around: [Option<bool>; 2]) -> bool {
        let is_intra = self.now.kind != Kind::Inter;
        let [left, above] = around.map(|is_coded| usize::from(is_coded.unwrap_or(is_intra)));
        self.engine.decide(category.coded + left + 2 * above)
    }

    /// The coefficients of a coded block.
    fn levels(&mut self, category: Category) -> Result<(), CountError> {
        let is_chroma_current = category.coefficients == CHROMA_CURRENT.coefficients;
        let mut count = 0;
        for at in 0..category.coefficients {
            if at + 1 == category.coefficients {
                count += 1; // all before it are zero, or this is one more
                break;
            }
            let [significant, last] = match category.coefficients {
                4 => [at.min(2); 2],
                64 => [SIGNIFICANT_8X8[at], LAST_8X8[at]].map(usize::from),
                _ => [at; 2],
            };
            if self.engine.decide(category.significant + significant) {
                count += 1;
                if self.engine.decide(category.last + last) {
                    break;
                }
            }
        }
        let (mut ones, mut larger) = (0, 0);
        for _ in 0..count {
            let first = if larger > 0 { 0 } else { 4.min(1 + ones) };
            if self.engine.decide(category.level + first) {
                let most = if is_chroma_current { 3 } else { 4 };
                self.magnitude(category.level + 5 + most.min(larger))?;
                larger += 1;
            } else {
                ones += 1;
            }
            self.engine.bypass();
        }
        Ok(())
    }

    /// What a level is more than 2.
    fn magnitude(&mut self, context: usize) -> Result<(), CountError> {
        let mut ones = 1;
        while ones < 14 && self.engine.decide(context) {
            ones += 1;
        }
        if ones == 14 {
            self.engine.suffix(0)?;
        }
        Ok(())
    }
}

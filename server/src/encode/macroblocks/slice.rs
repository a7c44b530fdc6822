//! Macroblocks of a slice (clauses 7.3.4, 7.3.5 and 9.3.3.1.1): their syntax, and what their neighbours need to know of it.

use super::CountError;
use super::arithmetic::Engine;

/// What holds for a whole slice.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    /// Macroblocks from side to side.
    pub(super) columns: usize,
    /// A P slice.
    pub(super) is_inter: bool,
    /// Of which each part names its reference.
    pub(super) has_references: bool,
    /// Macroblocks may be transformed by 8x8.
    pub(super) has_8x8: bool,
}

/// How a macroblock is predicted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Kind {
    #[default]
    Skipped,
    Inter,
    /// By 4x4 or 8x8.
    IntraParts,
    Intra16,
    Raw,
}

/// A macroblock, as its neighbours see it. Bit 0 of a set is the upper left.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Macroblock {
    pub(super) kind: Kind,
    /// `coded_block_pattern`: luma by 8x8 in the lower four bits, chroma above.
    pub(super) pattern: u8,
    /// Whether direct currents are coded: of luma, Cb and Cr.
    pub(super) currents: u8,
    /// The same of blocks of 4x4, row by row.
    pub(super) luma: u16,
    /// Of Cb in the lower four bits, of Cr above.
    pub(super) chroma: u8,
    pub(super) is_8x8: bool,
    /// Its chroma is predicted otherwise than by the mean.
    has_chroma_mode: bool,
    /// By 8x8, whether the reference is another than the first.
    references: u8,
    /// Differences of motion vectors by 4x4, row by row, without sign.
    motion: [[u8; 2]; 16],
}

/// The way in which a macroblock is divided for its motion.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Division {
    Whole,
    Rows,
    Columns,
    Quarters,
}

enum Type {
    Inter(Division),
    IntraParts,
    Intra16 { pattern: u8 },
    Raw,
}

/// Bytes of the samples of a raw macroblock.
const RAW_BYTES: usize = 384;
/// Larger steps of the quantiser than there are.
const MOST_QP_STEPS: u32 = 2 * 52;

/// See the module.
pub(super) struct Slice<'a> {
    pub(super) engine: Engine<'a>,
    shape: Shape,
    /// The last macroblock of each column.
    line: Vec<Option<Macroblock>>,
    pub(super) now: Macroblock,
    pub(super) left: Option<Macroblock>,
    pub(super) above: Option<Macroblock>,
    /// The macroblock before has another quantiser than that before it.
    has_qp_step: bool,
}

impl<'a> Slice<'a> {
    /// Before its first macroblock.
    pub(super) fn new(engine: Engine<'a>, shape: Shape) -> Self {
        Self {
            engine,
            shape,
            line: vec![None; shape.columns],
            now: Macroblock::default(),
            left: None,
            above: None,
            has_qp_step: false,
        }
    }

    /// Writes the bits of its macroblocks into those of the picture, from `first` on.
    pub(super) fn count(mut self, first: usize, bits: &mut [f64]) -> Result<(), CountError> {
        for (at, bits) in bits.iter_mut().enumerate().skip(first) {
            let began = self.engine.position();
            let column = at % self.shape.columns;
            self.left = column.checked_sub(1).and_then(|left| self.line[left]);
            self.above = self.line[column];
            self.now = Macroblock::default();
            if self.shape.is_inter && self.is_skipped() {
                self.has_qp_step = false;
            } else {
                self.macroblock()?;
            }
            let is_last = self.engine.ends();
            *bits = self.engine.position() - began;
            self.line[column] = Some(self.now);
            if is_last {
                let is_whole = self.engine.is_at_end();
                return if is_whole { Ok(()) } else { Err(CountError::Damaged("a slice ends too early")) };
            }
            if self.engine.is_beyond() {
                break;
            }
        }
        Err(CountError::Damaged("a slice does not end"))
    }

    /// How many of the two neighbours are there and are `so`.
    fn neighbours(&self, so: impl Fn(&Macroblock) -> bool) -> usize {
        [&self.left, &self.above].into_iter().flatten().filter(|neighbour| so(neighbour)).count()
    }

    fn is_skipped(&mut self) -> bool {
        let context = 11 + self.neighbours(|neighbour| neighbour.kind != Kind::Skipped);
        self.engine.decide(context)
    }

    fn macroblock(&mut self) -> Result<(), CountError> {
        let mut may_be_8x8 = self.shape.has_8x8;
        match self.kind() {
            Type::Raw => {
                self.take_raw();
                return Ok(());
            }
            Type::Intra16 { pattern } => {
                (self.now.kind, self.now.pattern) = (Kind::Intra16, pattern);
                self.chroma_mode();
                self.quantiser()?;
                return self.residual();
            }
            Type::IntraParts => {
                self.now.kind = Kind::IntraParts;
                if may_be_8x8 {
                    self.transform();
                    may_be_8x8 = false;
                }
                self.intra_modes();
                self.chroma_mode();
            }
            Type::Inter(division) => {
                self.now.kind = Kind::Inter;
                may_be_8x8 &= self.motion(division)?;
            }
        }
        self.pattern();
        if may_be_8x8 && self.now.pattern & 15 != 0 {
            self.transform();
        }
        if self.now.pattern == 0 {
            self.has_qp_step = false;
            return Ok(());
        }
        self.quantiser()?;
        self.residual()
    }

    fn kind(&mut self) -> Type {
        if !self.shape.is_inter {
            let context = 3 + self.neighbours(|neighbour| neighbour.kind != Kind::IntraParts);
            return self.intra_kind(context, [6, 7, 8, 9, 10]);
        }
        if self.engine.decide(14) {
            return self.intra_kind(17, [18, 19, 19, 20, 20]);
        }
        let is_divided = self.engine.decide(15);
        let is_second = self.engine.decide(if is_divided { 17 } else { 16 });
        Type::Inter(match (is_divided, is_second) {
            (false, false) => Division::Whole,
            (false, true) => Division::Quarters,
            (true, false) => Division::Columns,
            (true, true) => Division::Rows,
        })
    }

    fn intra_kind(&mut self, first: usize, [luma, chroma, fine, high, low]: [usize; 5]) -> Type {
        if !self.engine.decide(first) {
            return Type::IntraParts;
        }
        if self.engine.ends() {
            return Type::Raw;
        }
        let luma = if self.engine.decide(luma) { 15 } else { 0 };
        let chroma = if self.engine.decide(chroma) { 1 + u8::from(self.engine.decide(fine)) } else { 0 };
        self.engine.decide(high);
        self.engine.decide(low);
        Type::Intra16 { pattern: luma | chroma << 4 }
    }

    fn take_raw(&mut self) {
        self.engine.pass_over(RAW_BYTES);
        self.now = Macroblock {
            kind: Kind::Raw,
            pattern: 0x2f,
            currents: 7,
            luma: 0xffff,
            chroma: 0xff,
            ..Macroblock::default()
        };
        self.has_qp_step = false;
    }

    fn transform(&mut self) {
        let context = 399 + self.neighbours(|neighbour| neighbour.is_8x8);
        self.now.is_8x8 = self.engine.decide(context);
    }

    fn intra_modes(&mut self) {
        for _ in 0..if self.now.is_8x8 { 4 } else { 16 } {
            if !self.engine.decide(68) {
                for _ in 0..3 {
                    self.engine.decide(69);
                }
            }
        }
    }

    fn chroma_mode(&mut self) {
        let context = 64 + self.neighbours(|neighbour| neighbour.has_chroma_mode);
        self.now.has_chroma_mode = self.engine.decide(context);
        if self.now.has_chroma_mode && self.engine.decide(67) {
            self.engine.decide(67);
        }
    }

    fn pattern(&mut self) {
        for block in 0..4 {
            let (is_right, is_lower) = (block & 1 == 1, block >> 1 == 1);
            let lacks =
                |of: Option<u8>, bit: u8| usize::from(of.is_some_and(|pattern| pattern >> bit & 1 == 0));
            let of = |neighbour: &Option<Macroblock>| neighbour.map(|neighbour| neighbour.pattern);
            let now = Some(self.now.pattern);
            let left = if is_right { lacks(now, block - 1) } else { lacks(of(&self.left), block + 1) };
            let above = if is_lower { lacks(now, block - 2) } else { lacks(of(&self.above), block + 2) };
            self.now.pattern |= u8::from(self.engine.decide(73 + left + 2 * above)) << block;
        }
        let context = |slice: &Self, least: u8| {
            let has = |neighbour: &Option<Macroblock>| {
                usize::from(neighbour.is_some_and(|neighbour| neighbour.pattern >> 4 >= least))
            };
            has(&slice.left) + 2 * has(&slice.above)
        };
        if self.engine.decide(77 + context(self, 1)) {
            let is_fine = self.engine.decide(81 + context(self, 2));
            self.now.pattern |= if is_fine { 2 << 4 } else { 1 << 4 };
        }
    }

    fn quantiser(&mut self) -> Result<(), CountError> {
        let (mut context, mut steps) = (60 + usize::from(self.has_qp_step), 0);
        while self.engine.decide(context) {
            context = if steps == 0 { 62 } else { 63 };
            steps += 1;
            if steps > MOST_QP_STEPS {
                return Err(CountError::Damaged("its quantiser has no such step"));
            }
        }
        self.has_qp_step = steps > 0;
        Ok(())
    }

    /// Reads references and motion vectors; gives whether no part is smaller than 8x8.
    fn motion(&mut self, division: Division) -> Result<bool, CountError> {
        let parts: &[[u8; 4]] = match division {
            Division::Whole => &[[0, 0, 4, 4]],
            Division::Rows => &[[0, 0, 4, 2], [0, 2, 4, 2]],
            Division::Columns => &[[0, 0, 2, 4], [2, 0, 2, 4]],
            Division::Quarters => &[[0, 0, 2, 2], [2, 0, 2, 2], [0, 2, 2, 2], [2, 2, 2, 2]],
        };
        let mut smaller = [[2, 2]; 4];
        if division == Division::Quarters {
            smaller = [(); 4].map(|()| self.quarter());
        }
        if self.shape.has_references {
            for part in parts {
                self.reference(*part)?;
            }
        }
        for (part, [width, height]) in parts.iter().zip(smaller) {
            let [x, y, ..] = *part;
            if division != Division::Quarters {
                self.vector(*part)?;
                continue;
            }
            for down in (0..2).step_by(height as usize) {
                for right in (0..2).step_by(width as usize) {
                    self.vector([x + right, y + down, width, height])?;
                }
            }
        }
        Ok(smaller == [[2, 2]; 4])
    }

    /// Width and height of the parts of a quarter, in blocks of 4x4.
    fn quarter(&mut self) -> [u8; 2] {
        if self.engine.decide(21) {
            [2, 2]
        } else if !self.engine.decide(22) {
            [2, 1]
        } else if self.engine.decide(23) {
            [1, 2]
        } else {
            [1, 1]
        }
    }

    fn reference(&mut self, [x, y, width, height]: [u8; 4]) -> Result<(), CountError> {
        let of = |from: Option<u8>, at: u8| usize::from(from.is_some_and(|set| set >> at & 1 == 1));
        let other = |neighbour: &Option<Macroblock>| neighbour.map(|neighbour| neighbour.references);
        let (at, now) = (y / 2 * 2 + x / 2, Some(self.now.references));
        let left = if x > 0 { of(now, at - 1) } else { of(other(&self.left), at + 1) };
        let above = if y > 0 { of(now, at - 2) } else { of(other(&self.above), at + 2) };
        let (mut context, mut number) = (54 + left + 2 * above, 0);
        while self.engine.decide(context) {
            context = if number == 0 { 58 } else { 59 };
            number += 1;
            if number > 31 {
                return Err(CountError::Damaged("there is no such reference"));
            }
        }
        if number > 0 {
            for quarter in 0..4 {
                let (across, down) = (quarter & 1, quarter >> 1);
                let is_of_it =
                    (x / 2..(x + width) / 2).contains(&across) && (y / 2..(y + height) / 2).contains(&down);
                self.now.references |= u8::from(is_of_it) << quarter;
            }
        }
        Ok(())
    }

    /// A motion vector of a part: left, top, width and height in blocks of 4x4.
    fn vector(&mut self, [x, y, width, height]: [u8; 4]) -> Result<(), CountError> {
        let [x, y, width, height] = [x, y, width, height].map(usize::from);
        let of = |neighbour: &Option<Macroblock>, at: usize| {
            neighbour.map_or([0; 2], |neighbour| neighbour.motion[at])
        };
        let left = if x > 0 { self.now.motion[4 * y + x - 1] } else { of(&self.left, 4 * y + 3) };
        let above = if y > 0 { self.now.motion[4 * (y - 1) + x] } else { of(&self.above, 12 + x) };
        let mut found = [0; 2];
        for (axis, first) in [40, 47].into_iter().enumerate() {
            found[axis] = self.component(first, u32::from(left[axis]) + u32::from(above[axis]))?;
        }
        for row in y..y + height {
            self.now.motion[4 * row + x..4 * row + x + width].fill(found);
        }
        Ok(())
    }

    /// A component without its sign, 255 where it is more: contexts tell no more than 32 apart.
    fn component(&mut self, first: usize, around: u32) -> Result<u8, CountError> {
        let near = match around {
            0..=2 => 0,
            3..=32 => 1,
            _ => 2,
        };
        if !self.engine.decide(first + near) {
            return Ok(0);
        }
        let (mut value, mut context) = (1, 3);
        while value < 9 && self.engine.decide(first + context) {
            value += 1;
            context = (context + 1).min(6);
        }
        if value == 9 {
            value += self.engine.suffix(3)?;
        }
        self.engine.bypass();
        Ok(value.min(255) as u8)
    }
}

//! Parameter sets and slice headers (clause 7.3), as far as slices need them.

use super::CountError;
use super::reader::Reader;

/// Most macroblocks of a side that a level allows, and some.
const MOST_SIDE_MACROBLOCKS: u32 = 1024;
/// Profiles whose sequence parameters tell of chroma and scaling.
const HIGH_PROFILES: [u32; 4] = [100, 110, 122, 244];

/// The parameter sets in force: one of each kind.
#[derive(Clone, Debug, Default)]
pub(super) struct Parameters {
    sequence: Option<Sequence>,
    picture: Option<Picture>,
}

#[derive(Clone, Copy, Debug)]
struct Sequence {
    extent_macroblocks: [u32; 2],
    frame_number_bits: u32,
    order: Order,
}

/// How the order of pictures is told.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Order {
    Bits(u32),
    Cycle { is_told: bool },
    OfDecoding,
}

#[derive(Clone, Copy, Debug)]
struct Picture {
    has_order_in_slices: bool,
    references: u32,
    is_weighted: bool,
    qp: i32,
    has_deblocking: bool,
    has_redundancy: bool,
    has_8x8: bool,
}

/// What a slice header says.
#[derive(Clone, Copy, Debug)]
pub(super) struct SliceHeader {
    pub(super) first_macroblock: usize,
    pub(super) is_inter: bool,
    pub(super) references: u32,
    pub(super) qp: i32,
    initial: u32,
}

impl Parameters {
    pub(super) fn take_sequence(&mut self, payload: &[u8]) -> Result<(), CountError> {
        let mut reader = Reader::new(payload);
        let profile = reader.take(8);
        reader.take(16);
        reader.number()?;
        if HIGH_PROFILES.contains(&profile) {
            read_chroma(&mut reader)?;
        }
        let frame_number_bits = 4 + reader.number()?;
        let order = match reader.number()? {
            0 => Order::Bits(4 + reader.number()?),
            1 => read_cycle(&mut reader)?,
            _ => Order::OfDecoding,
        };
        reader.number()?;
        reader.flag();
        let extent_macroblocks = [reader.number()?, reader.number()?].map(|side| side.saturating_add(1));
        if !reader.flag() {
            return Err(CountError::Unsupported("fields"));
        }
        if extent_macroblocks.iter().any(|side| *side > MOST_SIDE_MACROBLOCKS) {
            return Err(CountError::Damaged("its pictures are too large"));
        }
        if frame_number_bits > 16 || matches!(order, Order::Bits(bits) if bits > 16) {
            return Err(CountError::Damaged("a number is too large"));
        }
        self.sequence = Some(Sequence { extent_macroblocks, frame_number_bits, order });
        Ok(())
    }

    pub(super) fn take_picture(&mut self, payload: &[u8]) -> Result<(), CountError> {
        let mut reader = Reader::new(payload);
        reader.number()?;
        reader.number()?;
        if !reader.flag() {
            return Err(CountError::Unsupported("codes of variable length (CAVLC)"));
        }
        let has_order_in_slices = reader.flag();
        if reader.number()? != 0 {
            return Err(CountError::Unsupported("groups of slices"));
        }
        let references = 1 + reader.number()?.min(31);
        reader.number()?;
        let is_weighted = reader.flag();
        reader.take(2);
        let qp = 26 + reader.signed()?;
        reader.signed()?;
        reader.signed()?;
        let [has_deblocking, _, has_redundancy] = [reader.flag(), reader.flag(), reader.flag()];
        let has_8x8 = reader.has_more() && reader.flag();
        self.picture = Some(Picture {
            has_order_in_slices,
            references,
            is_weighted,
            qp,
            has_deblocking,
            has_redundancy,
            has_8x8,
        });
        Ok(())
    }

    fn both(&self) -> Result<(Sequence, Picture), CountError> {
        self.sequence.zip(self.picture).ok_or(CountError::Damaged("a picture comes before its parameters"))
    }

    /// Columns and rows.
    pub(super) fn extent_macroblocks(&self) -> Result<[usize; 2], CountError> {
        Ok(self.both()?.0.extent_macroblocks.map(|side| side as usize))
    }

    /// Whether macroblocks may be transformed by 8x8.
    pub(super) fn has_8x8(&self) -> bool {
        self.picture.is_some_and(|picture| picture.has_8x8)
    }
}

fn read_chroma(reader: &mut Reader<'_>) -> Result<(), CountError> {
    let (chroma, luma_depth, chroma_depth) = (reader.number()?, reader.number()?, reader.number()?);
    if (chroma, luma_depth, chroma_depth) != (1, 0, 0) {
        return Err(CountError::Unsupported("other samples than 4:2:0 of 8 bits"));
    }
    reader.flag();
    if reader.flag() {
        return Err(CountError::Unsupported("scaling lists"));
    }
    Ok(())
}

fn read_cycle(reader: &mut Reader<'_>) -> Result<Order, CountError> {
    let is_told = !reader.flag();
    reader.signed()?;
    reader.signed()?;
    for _ in 0..reader.number()?.min(255) {
        reader.signed()?;
    }
    Ok(Order::Cycle { is_told })
}

impl SliceHeader {
    /// Reads up to the macroblocks. `is_refresh`: of an IDR picture. `is_reference`: others depend on it.
    pub(super) fn read(
        reader: &mut Reader<'_>,
        parameters: &Parameters,
        is_refresh: bool,
        is_reference: bool,
    ) -> Result<Self, CountError> {
        let (sequence, picture) = parameters.both()?;
        let first_macroblock = reader.number()? as usize;
        let is_inter = match reader.number()? % 5 {
            0 => true,
            2 => false,
            _ => return Err(CountError::Unsupported("slices other than I and P")),
        };
        reader.number()?;
        reader.take(sequence.frame_number_bits);
        if is_refresh {
            reader.number()?;
        }
        read_order(reader, sequence.order, picture.has_order_in_slices)?;
        if picture.has_redundancy {
            reader.number()?;
        }
        let mut references = picture.references;
        if is_inter {
            if reader.flag() {
                references = 1 + reader.number()?.min(31);
            }
            pass_over_reordering(reader)?;
            if picture.is_weighted {
                pass_over_weights(reader, references)?;
            }
        }
        if is_reference {
            pass_over_marking(reader, is_refresh)?;
        }
        let initial = if is_inter { reader.number()? } else { 0 };
        if initial > 2 {
            return Err(CountError::Damaged("contexts of another kind"));
        }
        let qp = picture.qp + reader.signed()?;
        if picture.has_deblocking && reader.number()? != 1 {
            reader.signed()?;
            reader.signed()?;
        }
        Ok(Self { first_macroblock, is_inter, references, qp, initial })
    }

    /// Which initial contexts its macroblocks have.
    pub(super) fn context_table(&self) -> usize {
        if self.is_inter { 1 + self.initial as usize } else { 0 }
    }
}

fn read_order(reader: &mut Reader<'_>, order: Order, is_in_slices: bool) -> Result<(), CountError> {
    match order {
        Order::Bits(bits) => {
            reader.take(bits);
            if is_in_slices {
                reader.signed()?;
            }
        }
        Order::Cycle { is_told: true } => {
            reader.signed()?;
            if is_in_slices {
                reader.signed()?;
            }
        }
        Order::Cycle { is_told: false } | Order::OfDecoding => {}
    }
    Ok(())
}

fn pass_over_reordering(reader: &mut Reader<'_>) -> Result<(), CountError> {
    if reader.flag() {
        while reader.number()? != 3 {
            reader.number()?;
        }
    }
    Ok(())
}

fn pass_over_weights(reader: &mut Reader<'_>, references: u32) -> Result<(), CountError> {
    reader.number()?;
    reader.number()?;
    for _ in 0..references {
        for numbers in [2, 4] {
            if reader.flag() {
                for _ in 0..numbers {
                    reader.signed()?;
                }
            }
        }
    }
    Ok(())
}

fn pass_over_marking(reader: &mut Reader<'_>, is_refresh: bool) -> Result<(), CountError> {
    if is_refresh {
        reader.take(2);
        return Ok(());
    }
    if reader.flag() {
        loop {
            match reader.number()? {
                0 => break,
                3 => {
                    reader.number()?;
                    reader.number()?;
                }
                5 => {}
                _ => {
                    reader.number()?;
                }
            }
        }
    }
    Ok(())
}

//! The bits of each macroblock of an H.264 access unit, read from the stream itself.
//!
//! Access units enter, in the order of coding; bits by macroblock leave. Nothing is reconstructed: entropy decoding needs no pixels.
//! Read are streams of frames with 4:2:0, 8 bits and arithmetic coding (CABAC), of I and P slices, as openh264 and x264 make them
//! here. Any other stream gives a typed error. Arithmetic coding spends fractions of bits: a macroblock's are exact to rounding,
//! and all of a slice add up to its length.

mod arithmetic;
mod headers;
mod reader;
mod residual;
mod slice;
mod tables;

use crate::encode::nal::{PICTURE_PARAMETERS, REFRESH_SLICE, SEQUENCE_PARAMETERS, SLICE, units};
use headers::{Parameters, SliceHeader};
use reader::{Reader, payload};
use slice::{Shape, Slice};
use thiserror::Error;

/// Why the bits of a picture are not known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum CountError {
    /// The stream uses what is not read here.
    #[error("the H.264 stream has {0}, whose bits are not counted; choose --encoder openh264")]
    Unsupported(&'static str),
    /// The stream is none, or damaged.
    #[error("the H.264 stream is damaged: {0}")]
    Damaged(&'static str),
}

/// Bits by macroblock.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MacroblockBits {
    /// Macroblocks of 16x16 texels from side to side.
    pub columns: usize,
    /// Bits of each, row by row; those of headers are not among them.
    pub bits: Vec<f64>,
}

/// Counts the bits of one encoder's pictures.
#[derive(Clone, Debug, Default)]
pub struct BitCounter {
    parameters: Parameters,
    counted: MacroblockBits,
}

impl BitCounter {
    /// Counts the bits of the next access unit, a byte stream with start codes.
    ///
    /// # Errors
    /// The stream is damaged, or has what is not read here.
    pub fn count(&mut self, unit: &[u8]) -> Result<&MacroblockBits, CountError> {
        self.counted.bits.clear();
        for unit in units(unit) {
            let Some((header, body)) = unit.split_first() else { continue };
            let (kind, is_reference) = (header & 31, header & 0x60 != 0);
            match kind {
                SEQUENCE_PARAMETERS => self.parameters.take_sequence(&payload(body))?,
                PICTURE_PARAMETERS => self.parameters.take_picture(&payload(body))?,
                SLICE | REFRESH_SLICE => {
                    self.count_slice(&payload(body), kind == REFRESH_SLICE, is_reference)?;
                }
                _ => {}
            }
        }
        Ok(&self.counted)
    }

    fn count_slice(
        &mut self,
        payload: &[u8],
        is_refresh: bool,
        is_reference: bool,
    ) -> Result<(), CountError> {
        let mut reader = Reader::new(payload);
        let header = SliceHeader::read(&mut reader, &self.parameters, is_refresh, is_reference)?;
        let [columns, rows] = self.parameters.extent_macroblocks()?;
        self.counted.columns = columns;
        self.counted.bits.resize(columns * rows, 0.0);
        let shape = Shape {
            columns,
            is_inter: header.is_inter,
            has_references: header.references > 1,
            has_8x8: self.parameters.has_8x8(),
        };
        let engine = arithmetic::Engine::new(reader, header.context_table(), header.qp);
        Slice::new(engine, shape).count(header.first_macroblock, &mut self.counted.bits)
    }
}

#[cfg(test)]
mod tests;

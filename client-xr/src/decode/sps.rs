//! Parser of an H.264 stream's own description: the NAL units of an access unit, and the fields of a sequence header (SPS) that
//! decide whether it may reach a decoder.
//!
//! Decoders allocate by the header. The check keeps a damaged header from costing gigabytes, and shows whether the colours are
//! declared as agreed. It is total: any bytes give a value or an error. The syntax is ITU-T H.264, sections 7.3.2.1.1 and
//! E.1.1; names follow it.

use thiserror::Error;

/// NAL unit type of a slice that refers to other pictures.
pub const NAL_SLICE: u8 = 1;
/// NAL unit type of a slice of a refresh (IDR).
pub const NAL_REFRESH_SLICE: u8 = 5;
/// NAL unit type of supplemental information, which decoders may ignore.
pub const NAL_SEI: u8 = 6;
/// NAL unit type of a sequence header.
pub const NAL_SPS: u8 = 7;
/// NAL unit type of a picture header.
pub const NAL_PPS: u8 = 8;
/// NAL unit type of the mark between two access units.
pub const NAL_DELIMITER: u8 = 9;
/// NAL unit type of padding.
pub const NAL_FILLER: u8 = 12;

const PROFILE_BASELINE: u8 = 66;
const PROFILE_MAIN: u8 = 77;
const PROFILE_HIGH: u8 = 100;

/// Why a sequence header cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
pub enum SpsError {
    /// It ends early.
    #[error("it is cut short")]
    CutShort,
    /// A number is larger than its field allows.
    #[error("{0} is out of range")]
    OutOfRange(&'static str),
    /// It is well-formed, but for another kind of video.
    #[error("{0} is not supported")]
    Unsupported(&'static str),
}

/// What a sequence header says, as far as it matters here.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sps {
    /// Profile: 66 Baseline, 77 Main, 100 High.
    pub profile_idc: u8,
    /// Ten times the level, 52 for 5.2.
    pub level_idc: u8,
    /// Width and height after cropping, in texels.
    pub extent_texels: [u32; 2],
    /// How many pictures a picture may refer to.
    pub max_num_ref_frames: u32,
    /// How colours are meant, if the stream says so.
    pub colour: Option<Colour>,
    /// How many pictures may come out of order, if the stream says so. Zero lets decoders answer without delay.
    pub max_num_reorder_frames: Option<u32>,
}

/// The colour description of a stream (VUI), in the code points of ITU-T H.273: 1 is BT.709 in all three.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Colour {
    /// Whether 0 and 255 are black and white, rather than 16 and 235.
    pub full_range: bool,
    /// Colour primaries.
    pub primaries: u8,
    /// Transfer characteristics.
    pub transfer: u8,
    /// Matrix coefficients.
    pub matrix: u8,
}

/// The NAL units of an Annex B byte stream: what lies between start codes, header byte first. Never empty slices.
pub fn nal_units(stream: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = split_at_start_code(stream).1;
    std::iter::from_fn(move || {
        let (unit, after) = split_at_start_code(rest?);
        rest = after;
        Some(without_trailing_zeros(unit))
    })
    .filter(|unit| !unit.is_empty())
}

/// The type of a NAL unit, 0 to 31.
pub fn nal_type(unit: &[u8]) -> u8 {
    unit.first().map_or(0, |header| header & 31)
}

/// What lies before the first start code, and what lies after it if there is one.
fn split_at_start_code(stream: &[u8]) -> (&[u8], Option<&[u8]>) {
    match stream.windows(3).position(|bytes| bytes == [0, 0, 1]) {
        Some(at) => (&stream[..at], Some(&stream[at + 3..])),
        None => (stream, None),
    }
}

/// Zeros at the end belong to the next start code, never to a unit.
fn without_trailing_zeros(unit: &[u8]) -> &[u8] {
    let end = unit.iter().rposition(|&byte| byte != 0).map_or(0, |at| at + 1);
    &unit[..end]
}

impl Sps {
    /// Parses a NAL unit of type [`NAL_SPS`], header byte included.
    pub fn parse(unit: &[u8]) -> Result<Self, SpsError> {
        let payload = without_emulation_prevention(unit.get(1..).unwrap_or(&[]));
        parse_fields(&mut Bits { bytes: &payload, at: 0 })
    }
}

/// Drops the byte 3 that an encoder inserts after two zeros, so that no start code appears inside a unit.
fn without_emulation_prevention(bytes: &[u8]) -> Vec<u8> {
    let mut zeros = 0;
    let keep = |byte: &u8| {
        let inserted = *byte == 3 && zeros >= 2;
        zeros = if *byte == 0 { zeros + 1 } else { 0 };
        !inserted
    };
    bytes.iter().copied().filter(keep).collect()
}

fn parse_fields(bits: &mut Bits<'_>) -> Result<Sps, SpsError> {
    let profile_idc = bits.take(8)? as u8;
    bits.take(8)?;
    let level_idc = bits.take(8)? as u8;
    bits.exp_golomb("seq_parameter_set_id", 31)?;
    match profile_idc {
        PROFILE_BASELINE | PROFILE_MAIN => {}
        PROFILE_HIGH => parse_chroma_format(bits)?,
        _ => return Err(SpsError::Unsupported("a profile other than Baseline, Main and High")),
    }
    bits.exp_golomb("log2_max_frame_num_minus4", 12)?;
    parse_picture_order(bits)?;
    let max_num_ref_frames = bits.exp_golomb("max_num_ref_frames", 16)?;
    bits.take(1)?;
    let extent_texels = parse_extent(bits)?;
    let mut sps = Sps {
        profile_idc,
        level_idc,
        extent_texels,
        max_num_ref_frames,
        colour: None,
        max_num_reorder_frames: None,
    };
    if bits.flag()? {
        parse_vui(bits, &mut sps)?;
    }
    Ok(sps)
}

fn parse_chroma_format(bits: &mut Bits<'_>) -> Result<(), SpsError> {
    if bits.exp_golomb("chroma_format_idc", 3)? != 1 {
        return Err(SpsError::Unsupported("a chroma format other than 4:2:0"));
    }
    let luma_minus8 = bits.exp_golomb("bit_depth_luma_minus8", 6)?;
    let chroma_minus8 = bits.exp_golomb("bit_depth_chroma_minus8", 6)?;
    if (luma_minus8, chroma_minus8) != (0, 0) {
        return Err(SpsError::Unsupported("more than 8 bits a sample"));
    }
    bits.take(1)?;
    if bits.flag()? { Err(SpsError::Unsupported("a scaling matrix")) } else { Ok(()) }
}

fn parse_picture_order(bits: &mut Bits<'_>) -> Result<(), SpsError> {
    match bits.exp_golomb("pic_order_cnt_type", 2)? {
        0 => bits.exp_golomb("log2_max_pic_order_cnt_lsb_minus4", 12).map(drop),
        1 => Err(SpsError::Unsupported("picture order count type 1")),
        _ => Ok(()),
    }
}

fn parse_extent(bits: &mut Bits<'_>) -> Result<[u32; 2], SpsError> {
    let width = 16 * (bits.exp_golomb("pic_width_in_mbs_minus1", 1023)? + 1);
    let height = 16 * (bits.exp_golomb("pic_height_in_map_units_minus1", 1023)? + 1);
    if !bits.flag()? {
        return Err(SpsError::Unsupported("interlaced video"));
    }
    bits.take(1)?;
    if !bits.flag()? {
        return Ok([width, height]);
    }
    // In units of two texels, since chroma has half the resolution.
    let width = crop(bits, width, "frame_crop_left_offset and frame_crop_right_offset")?;
    let height = crop(bits, height, "frame_crop_top_offset and frame_crop_bottom_offset")?;
    Ok([width, height])
}

fn crop(bits: &mut Bits<'_>, texels: u32, name: &'static str) -> Result<u32, SpsError> {
    let cropped = 2 * (bits.exp_golomb(name, texels / 2)? + bits.exp_golomb(name, texels / 2)?);
    if cropped < texels { Ok(texels - cropped) } else { Err(SpsError::OutOfRange(name)) }
}

fn parse_vui(bits: &mut Bits<'_>, sps: &mut Sps) -> Result<(), SpsError> {
    const EXTENDED_ASPECT_RATIO: u32 = 255;
    if bits.flag()? && bits.take(8)? == EXTENDED_ASPECT_RATIO {
        bits.take(32)?;
    }
    if bits.flag()? {
        bits.take(1)?;
    }
    if bits.flag()? {
        sps.colour = parse_colour(bits)?;
    }
    if bits.flag()? {
        bits.exp_golomb("chroma_sample_loc_type_top_field", 5)?;
        bits.exp_golomb("chroma_sample_loc_type_bottom_field", 5)?;
    }
    if bits.flag()? {
        bits.take(32)?;
        bits.take(32)?;
        bits.take(1)?;
    }
    let buffered = [bits.flag()?, bits.flag()?];
    if buffered.contains(&true) {
        // Buffering models are long, and no stream of ours has one; what comes after stays unknown.
        return Ok(());
    }
    bits.take(1)?;
    if bits.flag()? {
        sps.max_num_reorder_frames = Some(parse_reordering(bits)?);
    }
    Ok(())
}

fn parse_colour(bits: &mut Bits<'_>) -> Result<Option<Colour>, SpsError> {
    bits.take(3)?;
    let full_range = bits.flag()?;
    if !bits.flag()? {
        return Ok(None);
    }
    let [primaries, transfer, matrix] = [bits.take(8)? as u8, bits.take(8)? as u8, bits.take(8)? as u8];
    Ok(Some(Colour { full_range, primaries, transfer, matrix }))
}

fn parse_reordering(bits: &mut Bits<'_>) -> Result<u32, SpsError> {
    bits.take(1)?;
    bits.exp_golomb("max_bytes_per_pic_denom", 16)?;
    bits.exp_golomb("max_bits_per_mb_denom", 16)?;
    bits.exp_golomb("log2_max_mv_length_horizontal", 16)?;
    bits.exp_golomb("log2_max_mv_length_vertical", 16)?;
    bits.exp_golomb("max_num_reorder_frames", 16)
}

/// A reader of bits, most significant first.
struct Bits<'a> {
    bytes: &'a [u8],
    /// Position in bits.
    at: usize,
}

impl Bits<'_> {
    fn flag(&mut self) -> Result<bool, SpsError> {
        let byte = self.bytes.get(self.at / 8).ok_or(SpsError::CutShort)?;
        let bit = byte >> (7 - self.at % 8) & 1;
        self.at += 1;
        Ok(bit == 1)
    }

    /// The next `count` bits, at most 32.
    fn take(&mut self, count: u32) -> Result<u32, SpsError> {
        (0..count).try_fold(0, |value, _| Ok(value << 1 | u32::from(self.flag()?)))
    }

    /// An unsigned Exp-Golomb number, ue(v), at most `most`.
    fn exp_golomb(&mut self, name: &'static str, most: u32) -> Result<u32, SpsError> {
        let mut zeros = 0;
        while !self.flag()? {
            zeros += 1;
            if zeros > 31 {
                return Err(SpsError::OutOfRange(name));
            }
        }
        let value = (1 << zeros) - 1 + self.take(zeros)?;
        if value <= most { Ok(value) } else { Err(SpsError::OutOfRange(name)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_lie_between_start_codes_of_both_lengths() {
        let stream = [0, 0, 0, 1, 0x67, 7, 0, 0, 1, 0x68, 8, 0, 0, 0, 1, 0x65, 5, 0, 5];
        let units: Vec<_> = nal_units(&stream).collect();
        assert_eq!(units, [&[0x67, 7][..], &[0x68, 8], &[0x65, 5, 0, 5]]);
        assert_eq!(units.iter().map(|unit| nal_type(unit)).collect::<Vec<_>>(), [7, 8, 5]);
    }

    #[test]
    fn bytes_without_start_code_hold_no_units() {
        for stream in [&[][..], &[0], &[0, 0], &[0, 0, 1], &[0, 0, 1, 0, 0, 1], &[1, 2, 3, 4]] {
            assert_eq!(nal_units(stream).count(), 0, "{stream:?}");
        }
    }

    #[test]
    fn an_inserted_three_is_dropped_only_after_two_zeros() {
        assert_eq!(
            without_emulation_prevention(&[0, 0, 3, 1, 0, 3, 0, 0, 3, 3, 3]),
            [0, 0, 1, 0, 3, 0, 0, 3, 3]
        );
    }
}

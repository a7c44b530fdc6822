//! Framing, the one error type of all decoders, and the reader that they share.

use crate::ids::UpdateId;
use crate::limits::{
    MAX_ACCESS_UNIT_BYTES, MAX_CONTROL_BYTES, MAX_DELTA_BYTES, MAX_EMPTY_CONTROL_MESSAGES, MAX_MOTION_BYTES,
};
use crate::time::ServerTime;
use thiserror::Error;

/// First byte of a stream that holds a geometry delta.
const KIND_GEOMETRY: u8 = 1;
/// First byte of a stream that holds a picture.
const KIND_PICTURE: u8 = 2;
/// First byte of a stream that holds a message about motion.
const KIND_MOTION: u8 = 3;
/// Bytes of the length before each control message.
const CONTROL_PREFIX: usize = 4;

/// Bytes that are not what they should be. The message names what was being read and what is wrong with it.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum WireError {
    /// The bytes end too early.
    #[error("{what} is cut off: {needed} more bytes needed, {left} left")]
    Truncated {
        /// What was being read.
        what: &'static str,
        /// Bytes needed.
        needed: usize,
        /// Bytes left.
        left: usize,
    },
    /// More than a limit allows.
    #[error("{what} is {value}, above the limit of {limit}")]
    TooMany {
        /// What was being read.
        what: &'static str,
        /// What the bytes say.
        value: u64,
        /// What is allowed.
        limit: u64,
    },
    /// A value outside its range, or one that contradicts what is known.
    #[error("{what} is not valid: {reason}")]
    Invalid {
        /// What was being read.
        what: &'static str,
        /// What is wrong.
        reason: String,
    },
    /// Bytes after the end.
    #[error("{what} is followed by {left} bytes that do not belong to it")]
    Trailing {
        /// What was being read.
        what: &'static str,
        /// Bytes left over.
        left: usize,
    },
}

/// What identifies a coded picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureHeader {
    /// The update; its placements belong to this picture.
    pub update: UpdateId,
    /// The time for which the update was made.
    pub time: ServerTime,
    /// True where the picture needs no earlier one.
    pub is_refresh: bool,
}

/// What one unidirectional stream holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StreamMessage<'a> {
    /// A geometry delta, for [`crate::delta::DeltaDecoder::decode`] in their order.
    Geometry {
        /// What it says of itself.
        head: DeltaHead,
        /// The delta's bytes.
        payload: &'a [u8],
    },
    /// A message about motion, for [`crate::motion::message::MotionMessage::decode`].
    Motion(&'a [u8]),
    /// A coded picture.
    Picture {
        /// Which one.
        header: PictureHeader,
        /// Its bytes for the decoder.
        access_unit: &'a [u8],
    },
}

/// First bytes of a delta: "Shadecast geometry", layout 2.
pub(crate) const GEOMETRY_MAGIC: [u8; 4] = *b"SCG2";

/// What a delta says of itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeltaHead {
    /// Deltas follow each other without a gap, from 0 on.
    pub sequence: u32,
    /// The update; between updates the last one.
    pub update: UpdateId,
    /// False between updates.
    pub is_update: bool,
}

impl DeltaHead {
    pub(crate) const BYTES: usize = 13;
}

/// What the bytes of a delta say of it.
pub fn peek_delta(bytes: &[u8]) -> Result<DeltaHead, WireError> {
    const WHAT: &str = "a delta's header";
    let mut reader = Reader::new(WHAT, bytes);
    if reader.take(GEOMETRY_MAGIC.len())? != GEOMETRY_MAGIC {
        return Err(invalid(WHAT, "its first bytes are not SCG2"));
    }
    let (sequence, update) = (reader.u32()?, UpdateId(reader.u32()?));
    match reader.u8()? {
        flag @ 0..=1 => Ok(DeltaHead { sequence, update, is_update: flag == 1 }),
        flag => Err(invalid(WHAT, format!("its flag {flag} is neither 0 nor 1"))),
    }
}

/// The bytes of a stream that holds this geometry delta, as [`crate::delta::DeltaEncoder::encode`] made it.
pub fn encode_geometry(payload: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(1 + payload.len());
    out.push(KIND_GEOMETRY);
    out.extend_from_slice(payload);
    out
}

/// The bytes of a stream that holds this message about motion, as
/// [`crate::motion::message::MotionMessage::encode`] made it.
pub fn encode_motion(payload: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(1 + payload.len());
    out.push(KIND_MOTION);
    out.extend_from_slice(payload);
    out
}

/// The bytes of a stream that holds this picture.
pub fn encode_picture(header: PictureHeader, access_unit: &[u8]) -> Vec<u8> {
    assert!(access_unit.len() <= MAX_ACCESS_UNIT_BYTES, "access unit of {} bytes", access_unit.len());
    let mut out = Vec::with_capacity(18 + access_unit.len());
    out.push(KIND_PICTURE);
    out.extend_from_slice(&header.update.0.to_le_bytes());
    out.extend_from_slice(&header.time.0.to_le_bytes());
    out.push(u8::from(header.is_refresh));
    out.extend_from_slice(&(access_unit.len() as u32).to_le_bytes());
    out.extend_from_slice(access_unit);
    out
}

/// Tells what a complete unidirectional stream holds.
pub fn parse_stream(bytes: &[u8]) -> Result<StreamMessage<'_>, WireError> {
    let mut reader = Reader::new("a stream's kind", bytes);
    match reader.u8()? {
        KIND_GEOMETRY => {
            let payload = reader.rest();
            check_count("a delta's length in bytes", payload.len(), MAX_DELTA_BYTES)?;
            Ok(StreamMessage::Geometry { head: peek_delta(payload)?, payload })
        }
        KIND_PICTURE => parse_picture(reader),
        KIND_MOTION => {
            let payload = reader.rest();
            check_count("the length in bytes of a message about motion", payload.len(), MAX_MOTION_BYTES)?;
            Ok(StreamMessage::Motion(payload))
        }
        kind => {
            let reason = format!("{kind} is none of geometry (1), a picture (2), motion (3)");
            Err(invalid("a stream's kind", reason))
        }
    }
}

fn parse_picture(mut reader: Reader<'_>) -> Result<StreamMessage<'_>, WireError> {
    reader.what = "a picture";
    let frame = UpdateId(reader.u32()?);
    let time = ServerTime(reader.i64()?);
    let is_refresh = match reader.u8()? {
        flag @ 0..=1 => flag == 1,
        flag => return Err(invalid("a picture's refresh flag", format!("{flag} is neither 0 nor 1"))),
    };
    let length = reader.u32()? as usize;
    check_count("an access unit's length in bytes", length, MAX_ACCESS_UNIT_BYTES)?;
    let access_unit = reader.take(length)?;
    reader.finish()?;
    Ok(StreamMessage::Picture { header: PictureHeader { update: frame, time, is_refresh }, access_unit })
}

/// A control message with its length before it, as it goes on the control stream.
///
/// # Panics
/// If the message is longer than `MAX_CONTROL_BYTES`.
pub fn frame_control(message: &[u8]) -> Vec<u8> {
    assert!(message.len() <= MAX_CONTROL_BYTES, "control message of {} bytes", message.len());
    let mut out = Vec::with_capacity(CONTROL_PREFIX + message.len());
    out.extend_from_slice(&(message.len() as u32).to_le_bytes());
    out.extend_from_slice(message);
    out
}

/// Cuts the control stream, which arrives in arbitrary pieces, into messages. Holds at most one unfinished message, and
/// moves each byte once.
#[derive(Clone, Debug, Default)]
pub struct ControlReader {
    /// The beginning of the message under way, its length included.
    pending: Vec<u8>,
    empty_messages: usize,
}

impl ControlReader {
    /// Takes the next bytes of the stream; gives the messages that are now whole. Empty messages only open the stream: they
    /// are left out, and no more than `MAX_EMPTY_CONTROL_MESSAGES` are taken. After an error the stream has lost its framing
    /// and is of no further use.
    pub fn push(&mut self, mut bytes: &[u8]) -> Result<Vec<Vec<u8>>, WireError> {
        let mut messages = Vec::new();
        while let Some(message) = self.next(&mut bytes)? {
            if message.is_empty() {
                self.empty_messages += 1;
                let what = "the number of empty control messages";
                check_count(what, self.empty_messages, MAX_EMPTY_CONTROL_MESSAGES)?;
            } else {
                messages.push(message);
            }
        }
        Ok(messages)
    }

    /// The next whole message; `None` where `bytes`, which are then used up, do not suffice.
    fn next(&mut self, bytes: &mut &[u8]) -> Result<Option<Vec<u8>>, WireError> {
        self.fill(bytes, CONTROL_PREFIX);
        let Some((prefix, _)) = self.pending.split_first_chunk() else { return Ok(None) };
        let length = u32::from_le_bytes(*prefix) as usize;
        check_count("a control message's length in bytes", length, MAX_CONTROL_BYTES)?;
        self.fill(bytes, CONTROL_PREFIX + length);
        if self.pending.len() < CONTROL_PREFIX + length {
            return Ok(None);
        }
        let message = self.pending.split_off(CONTROL_PREFIX);
        self.pending.clear();
        Ok(Some(message))
    }

    /// Moves bytes over until `target` are pending, or none are left.
    fn fill(&mut self, bytes: &mut &[u8], target: usize) {
        let wanted = target.saturating_sub(self.pending.len()).min(bytes.len());
        let (now, later) = bytes.split_at(wanted);
        self.pending.extend_from_slice(now);
        *bytes = later;
    }
}

/// An [`WireError::Invalid`].
pub(crate) fn invalid(what: &'static str, reason: impl Into<String>) -> WireError {
    WireError::Invalid { what, reason: reason.into() }
}

/// `value` where it is within `limit`.
pub(crate) fn check_count(what: &'static str, value: usize, limit: usize) -> Result<usize, WireError> {
    if value > limit {
        return Err(WireError::TooMany { what, value: value as u64, limit: limit as u64 });
    }
    Ok(value)
}

/// Reads little-endian values from the front of a slice; every method is total.
#[derive(Clone, Debug)]
pub(crate) struct Reader<'a> {
    /// What is being read, for errors.
    pub(crate) what: &'static str,
    bytes: &'a [u8],
}

impl<'a> Reader<'a> {
    pub(crate) fn new(what: &'static str, bytes: &'a [u8]) -> Self {
        Self { what, bytes }
    }

    pub(crate) fn left(&self) -> usize {
        self.bytes.len()
    }

    /// Everything that is left.
    pub(crate) fn rest(&mut self) -> &'a [u8] {
        std::mem::take(&mut self.bytes)
    }

    pub(crate) fn take(&mut self, count: usize) -> Result<&'a [u8], WireError> {
        let left = self.bytes.len();
        let Some((taken, rest)) = self.bytes.split_at_checked(count) else {
            return Err(WireError::Truncated { what: self.what, needed: count - left, left });
        };
        self.bytes = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], WireError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    pub(crate) fn u8(&mut self) -> Result<u8, WireError> {
        Ok(self.array::<1>()?[0])
    }

    pub(crate) fn u32(&mut self) -> Result<u32, WireError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    pub(crate) fn i64(&mut self) -> Result<i64, WireError> {
        Ok(i64::from_le_bytes(self.array()?))
    }

    pub(crate) fn f32(&mut self) -> Result<f32, WireError> {
        Ok(f32::from_le_bytes(self.array()?))
    }

    /// A number of at most 32 bits in groups of seven, lowest first.
    pub(crate) fn varint(&mut self) -> Result<u32, WireError> {
        let mut value = 0u32;
        for shift in (0..35).step_by(7) {
            let byte = self.u8()?;
            let bits = u32::from(byte & 0x7f);
            if shift == 28 && byte > 0x0f {
                return Err(invalid(self.what, "a number has more than 32 bits"));
            }
            value |= bits << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(invalid(self.what, "a number does not end"))
    }

    /// A signed number, small magnitudes short.
    pub(crate) fn zigzag(&mut self) -> Result<i32, WireError> {
        Ok(unzigzag(self.varint()?))
    }

    /// A count that is within `limit`, and for which at least `min_bytes` are left per item.
    pub(crate) fn count(&mut self, limit: usize, min_bytes: usize) -> Result<usize, WireError> {
        let count = check_count(self.what, self.varint()? as usize, limit)?;
        let needed = count * min_bytes;
        if needed > self.left() {
            return Err(WireError::Truncated {
                what: self.what,
                needed: needed - self.left(),
                left: self.left(),
            });
        }
        Ok(count)
    }

    /// Nothing may be left.
    pub(crate) fn finish(self) -> Result<(), WireError> {
        match self.bytes.len() {
            0 => Ok(()),
            left => Err(WireError::Trailing { what: self.what, left }),
        }
    }
}

/// Appends a number in groups of seven bits, lowest first.
pub(crate) fn put_varint(out: &mut Vec<u8>, mut value: u32) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Appends a signed number, small magnitudes short.
pub(crate) fn put_zigzag(out: &mut Vec<u8>, value: i32) {
    put_varint(out, zigzag(value));
}

/// 0, -1, 1, -2 .. to 0, 1, 2, 3 ..
pub(crate) fn zigzag(value: i32) -> u32 {
    (value as u32) << 1 ^ (value >> 31) as u32
}

/// The inverse of [`zigzag`].
pub(crate) fn unzigzag(value: u32) -> i32 {
    (value >> 1) as i32 ^ -((value & 1) as i32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::delta::DeltaEncoder;
    use crate::geometry::GeometryDelta;
    use crate::testing::{Dice, damaged};

    const HEADER: PictureHeader =
        PictureHeader { update: UpdateId(77), time: ServerTime(-12_345), is_refresh: true };

    #[test]
    fn streams_come_back_as_what_they_were() {
        let picture = encode_picture(HEADER, b"coded");
        assert_eq!(
            parse_stream(&picture),
            Ok(StreamMessage::Picture { header: HEADER, access_unit: b"coded" })
        );
        let delta = GeometryDelta { update: UpdateId(9), ..Default::default() };
        let payload = DeltaEncoder::new(1, 1).encode(&delta.into()).bytes;
        let stream = encode_geometry(&payload);
        assert_eq!(
            parse_stream(&stream),
            Ok(StreamMessage::Geometry {
                head: DeltaHead { sequence: 0, update: UpdateId(9), is_update: true },
                payload: &payload
            })
        );
    }

    #[test]
    fn damaged_streams_give_values_or_errors() {
        let picture = encode_picture(HEADER, &[7; 100]);
        damaged(&picture, 1, 5000, |bytes| drop(parse_stream(bytes)));
        (0..picture.len()).for_each(|length| assert!(parse_stream(&picture[..length]).is_err()));
        let longer = [picture, vec![0]].concat();
        assert_eq!(parse_stream(&longer), Err(WireError::Trailing { what: "a picture", left: 1 }));
        assert!(parse_stream(&[]).is_err() && parse_stream(&[4]).is_err());
    }

    #[test]
    fn the_control_stream_is_cut_right_in_whatever_pieces_it_comes() {
        for seed in 0..50 {
            let mut dice = Dice::new(seed);
            let messages: Vec<Vec<u8>> =
                (0..20).map(|i| vec![i; dice.below(300) as usize + 1]).chain([vec![7; 70_000]]).collect();
            let framed = messages.iter().flat_map(|message| frame_control(message));
            let stream: Vec<u8> = frame_control(&[]).into_iter().chain(framed).collect();
            let (mut reader, mut rest, mut got) = (ControlReader::default(), &stream[..], Vec::new());
            while !rest.is_empty() {
                let (piece, later) = rest.split_at((dice.below(400) as usize + 1).min(rest.len()));
                got.extend(reader.push(piece).unwrap());
                rest = later;
            }
            assert_eq!(got, messages, "seed {seed}");
        }
    }

    #[test]
    fn empty_messages_are_bounded() {
        let flood = vec![0; 15 << 20];
        let mut reader = ControlReader::default();
        assert!(matches!(reader.push(&flood), Err(WireError::TooMany { .. })));
        assert_eq!(reader.empty_messages, MAX_EMPTY_CONTROL_MESSAGES + 1);
        let mut reader = ControlReader::default();
        let opening = frame_control(&[]).repeat(MAX_EMPTY_CONTROL_MESSAGES);
        assert_eq!(reader.push(&opening), Ok(Vec::new()));
        assert!(
            reader.push(&frame_control(&[])).is_err(),
            "counted over the whole stream, not over one push"
        );
    }

    #[test]
    fn every_byte_is_moved_once_however_many_messages_a_push_brings() {
        // 15 MB of the smallest messages: a reader that moves the rest for each of them moves 23 TB.
        let flood = frame_control(b"x").repeat(3 << 20);
        let (mut reader, mut rest, mut moved, mut messages) = (ControlReader::default(), &flood[..], 0, 0);
        loop {
            let (before, held) = (rest.len(), reader.pending.len());
            let message = reader.next(&mut rest).unwrap();
            moved += before - rest.len();
            assert!(held + before - rest.len() <= CONTROL_PREFIX + 1, "a call takes one message and no more");
            let Some(message) = message else { break };
            assert_eq!(message, b"x");
            messages += 1;
        }
        assert_eq!((moved, messages), (flood.len(), 3 << 20));
    }

    #[test]
    fn an_oversized_control_message_is_refused_by_length() {
        let length = (MAX_CONTROL_BYTES as u32 + 1).to_le_bytes();
        assert!(matches!(ControlReader::default().push(&length), Err(WireError::TooMany { .. })));
    }

    #[test]
    fn numbers_of_all_sizes_come_back() {
        for shift in 0..32 {
            for value in [1u32 << shift, (1 << shift) - 1, u32::MAX >> shift] {
                let mut bytes = Vec::new();
                put_varint(&mut bytes, value);
                put_zigzag(&mut bytes, value as i32);
                let mut reader = Reader::new("numbers", &bytes);
                assert_eq!((reader.varint(), reader.zigzag()), (Ok(value), Ok(value as i32)));
                assert_eq!(reader.finish(), Ok(()));
            }
        }
        for endless in [[0xff; 5], [0x80; 5], [0x80, 0x80, 0x80, 0x80, 0x10]] {
            assert!(Reader::new("numbers", &endless).varint().is_err());
        }
    }
}

//! How finely one client's pictures are quantised. Pure: sizes and times of what was made come in, the next quantiser comes out.
//!
//! Quantisation of fine texture is what costs most of a picture's quality, and its bits are known only when they are there. So each
//! picture says how the next is coded: coarser at once where it was too large or took too long, finer at once where it left room. A
//! picture in which nothing moves takes no bits, so that what stands still gets finer with each update until it is as good as it
//! gets; an encoder takes nothing back when a later picture is coded more coarsely. Pictures have what geometry and motion leave; what all of
//! them took too much, or left, the next second's make good.
//!
//! What is left over is for more texels (`density`).

use crate::pacing::density::Spare;
use crate::pacing::share::{USUAL_MBIT_S, bytes_s, picture_bytes, spare_at};
use shadecast_protocol::message::Codec;
use std::fmt;

/// The quantisation parameter used unless told otherwise.
pub const DEFAULT_QP: u8 = 22;

/// What all of a client's streams may take together where a number is wanted and none is given, Mbit/s; what [`QualityOptions::Auto`] begins
/// with.
pub const DEFAULT_BITRATE_MBIT_S: f64 = USUAL_MBIT_S;
/// What [`QualityOptions::Auto`] takes at most, Mbit/s: what Wi-Fi at home carries beside others.
pub const MOST_BITRATE_MBIT_S: f64 = 100.0;

/// No picture is coded more finely: what is gained below is not seen.
const FINEST_QP: u8 = 13;
/// The next coarser one that is worth its bits. Between both, the step of a mean of chroma is a third to a half of a step of a decoded
/// texel: it is coded with each picture anew, rounds to nothing, and leaves surfaces off by up to half a step (docs/decisions.md).
const NEXT_QP: u8 = 17;
/// Or more coarsely: fewer updates show more.
const COARSEST_QP: u8 = 34;
/// Bits of the same picture double from one quantiser to the one this far below.
const QP_OF_TWICE_THE_BITS: f64 = 6.0;
/// A picture that takes less than this part of what it may is followed by one so much finer that it would take this part: a step takes
/// an eighth more bits, and pictures differ.
const ROOM: f64 = 0.9;
/// The same before the finest, which takes 1.6 times the bits of the next: so that it lasts where what was left of the last seconds is
/// spent.
const ROOM_FOR_FINEST: f64 = 0.5;
/// No picture is finer than the one before by more, which is 2.8 times the bits: one in which little moves would be followed by a
/// burst.
const MOST_FINER: u8 = 9;
/// Of the time from one update to the next an encoder may take this part; one that takes longer is given nothing finer than
/// [`DEFAULT_QP`].
const ENCODER_SHARE: f64 = 0.8;
/// What goes for geometry and motion is their mean over about so many seconds.
const OTHERS_S: f64 = 1.0;
/// What was left of the last seconds' bytes, or taken too much of them, is made good over this long.
const BALANCE_S: f64 = 1.0;
/// It counts up to this many seconds' bytes: what a still scene leaves is no reason for a burst when it moves, and what arrived at the
/// start none to starve what follows.
const LARGEST_BALANCE_S: f64 = 0.2;

/// What a person asks for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum QualityOptions {
    /// The same quantiser for all pictures, 0 (finest) to 51.
    Constant(u8),
    /// As fine as the streams of one client take no more than so many Mbit/s together.
    Bitrate(f64),
    /// As fine as the link carries, up to [`MOST_BITRATE_MBIT_S`].
    Auto,
}

impl Default for QualityOptions {
    fn default() -> Self {
        Self::Bitrate(DEFAULT_BITRATE_MBIT_S)
    }
}

impl QualityOptions {
    /// The same for pictures of a codec: those that are sent as they are take what they take.
    pub fn of_codec(self, codec: Codec) -> Self {
        match codec {
            Codec::H264 => self,
            Codec::Raw => Self::Constant(DEFAULT_QP),
        }
    }

    /// The quantiser of the first picture.
    pub fn first_qp(self) -> u8 {
        match self {
            Self::Constant(qp) => qp,
            Self::Bitrate(_) | Self::Auto => DEFAULT_QP,
        }
    }
}

impl fmt::Display for QualityOptions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Constant(qp) => write!(f, "--qp {qp}"),
            Self::Bitrate(mbit_s) => write!(f, "--bitrate {mbit_s}"),
            Self::Auto => write!(f, "--bitrate auto"),
        }
    }
}

/// A picture that was encoded and handed to the transport.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SentPicture {
    /// Bytes of its stream.
    pub stream_bytes: usize,
    /// It needs no other.
    pub is_refresh: bool,
    /// How long the encoder worked on it, seconds.
    pub encode_s: f64,
}

/// One client's.
#[derive(Clone, Debug)]
pub(crate) struct Quality {
    options: QualityOptions,
    period_s: f64,
    qp: u8,
    /// Bytes a second of all that are no pictures.
    others_bytes_s: f64,
    /// Bytes that were not taken though they might have been; negative: too much was.
    balance_bytes: f64,
    /// Up to when both are known, nanoseconds.
    known_ns: Option<i64>,
    /// What all streams may take of the link, bytes a second.
    link_bytes_s: Option<f64>,
    /// The last update took too long, or its picture.
    is_slow: [bool; 2],
    /// A picture has told what pictures take.
    is_told: bool,
}

impl Quality {
    /// For updates that are wanted once in `period_ns`.
    pub(crate) fn new(options: QualityOptions, period_ns: i64) -> Self {
        Self {
            options,
            period_s: period_ns.max(1) as f64 * 1e-9,
            qp: options.first_qp(),
            others_bytes_s: 0.0,
            balance_bytes: 0.0,
            known_ns: None,
            link_bytes_s: None,
            is_slow: [false; 2],
            is_told: false,
        }
    }

    /// Of the next picture.
    pub(crate) fn qp(&self) -> u8 {
        self.qp
    }

    /// What all streams may take of the link, bytes a second, where that is known.
    pub(crate) fn note_link(&mut self, bytes_s: Option<f64>) {
        self.link_bytes_s = bytes_s;
    }

    /// So many bytes that are no picture were sent.
    pub(crate) fn note_other(&mut self, bytes: usize, now_ns: i64) {
        let Some(bytes_s) = self.bytes_s() else { return };
        self.pass_to(now_ns, bytes_s);
        self.others_bytes_s += bytes as f64 / OTHERS_S;
        self.balance(-(bytes as f64), bytes_s);
    }

    /// Time passes: so many more bytes a second may be taken, and what went for others before counts less.
    fn pass_to(&mut self, now_ns: i64, bytes_s: f64) {
        let passed_s = (now_ns - self.known_ns.unwrap_or(now_ns)).max(0) as f64 * 1e-9;
        self.known_ns = self.known_ns.max(Some(now_ns));
        self.others_bytes_s *= (-passed_s / OTHERS_S).exp();
        self.balance(bytes_s * passed_s, bytes_s);
    }

    fn balance(&mut self, more_bytes: f64, bytes_s: f64) {
        let largest_bytes = LARGEST_BALANCE_S * bytes_s;
        self.balance_bytes = (self.balance_bytes + more_bytes).clamp(-largest_bytes, largest_bytes);
    }

    /// An update took the device so long, seconds; its share of the device is counted.
    pub(crate) fn note_update(&mut self, took_s: f64) {
        self.is_slow[0] = took_s > ENCODER_SHARE * self.period_s;
    }

    /// Whether bits and time are left over.
    pub(crate) fn spare(&self) -> Spare {
        match self.options {
            _ if self.is_slow.contains(&true) => Spare::Short,
            QualityOptions::Constant(_) => Spare::Room,
            _ if self.is_told => spare_at(self.qp),
            _ => Spare::Short,
        }
    }

    /// Of the next picture where it must need no other, and of those after it: all of it costs bits anew, which what stands still
    /// cost once.
    pub(crate) fn refresh_qp(&mut self) -> u8 {
        if !matches!(self.options, QualityOptions::Constant(_)) {
            self.qp = self.qp.max(DEFAULT_QP);
        }
        self.qp
    }

    /// A picture is on its way. One that needs no other says nothing of those that do.
    pub(crate) fn note_picture(&mut self, picture: SentPicture, now_ns: i64) {
        let is_slow = picture.encode_s > ENCODER_SHARE * self.period_s;
        self.is_slow[1] = is_slow;
        let Some(bytes_s) = self.bytes_s() else { return };
        self.pass_to(now_ns, bytes_s);
        if picture.is_refresh {
            return;
        }
        self.is_told = true;
        let used = picture.stream_bytes as f64 / self.picture_bytes(bytes_s);
        self.balance(-(picture.stream_bytes as f64), bytes_s);
        let qp = match used {
            used if used > 1.0 => self.qp.saturating_add(quantisers_between(1.0, used).ceil() as u8),
            _ if is_slow && self.qp <= DEFAULT_QP => (self.qp + 1).min(DEFAULT_QP),
            used if self.qp == NEXT_QP => {
                if used < ROOM_FOR_FINEST {
                    FINEST_QP
                } else {
                    NEXT_QP
                }
            }
            used if used < ROOM => self.qp - (quantisers_between(used, ROOM) as u8).clamp(1, MOST_FINER),
            _ => self.qp,
        };
        self.qp = if qp <= FINEST_QP { FINEST_QP } else { qp.clamp(NEXT_QP, COARSEST_QP) };
    }

    /// What a picture may take, bytes, where all streams together may take so many a second.
    fn picture_bytes(&self, bytes_s: f64) -> f64 {
        let others_bytes_s = self.others_bytes_s - self.balance_bytes / BALANCE_S;
        picture_bytes(bytes_s, others_bytes_s, self.period_s, self.shortness())
    }

    /// What all streams together may take, bytes a second; `None`: what they take.
    fn bytes_s(&self) -> Option<f64> {
        let (usual, most) = (bytes_s(DEFAULT_BITRATE_MBIT_S), bytes_s(MOST_BITRATE_MBIT_S));
        match self.options {
            QualityOptions::Constant(_) => None,
            QualityOptions::Bitrate(mbit_s) => {
                Some(self.link_bytes_s.unwrap_or(f64::MAX).min(bytes_s(mbit_s)))
            }
            QualityOptions::Auto => Some(self.link_bytes_s.unwrap_or(usual).min(most)),
        }
    }

    /// How many times less the link carries than a stream usually takes, or was asked to take; 1: no less.
    fn shortness(&self) -> f64 {
        let asked_mbit_s = match self.options {
            QualityOptions::Bitrate(mbit_s) => mbit_s,
            QualityOptions::Constant(_) | QualityOptions::Auto => DEFAULT_BITRATE_MBIT_S,
        };
        self.link_bytes_s.map_or(1.0, |link| (bytes_s(asked_mbit_s) / link).max(1.0))
    }
}

/// How many quantisers finer a picture is that takes `more` bits instead of `fewer`.
fn quantisers_between(fewer: f64, more: f64) -> f64 {
    QP_OF_TWICE_THE_BITS * (more / fewer).log2()
}

#[cfg(test)]
mod tests;

//! How finely one client's pictures are quantised. Pure: sizes and times of what was made come in, the next quantiser comes out.
//!
//! Quantisation of fine texture is what costs most of a picture's quality, and its bits are known only when they are there. So each
//! picture says how the next is coded: coarser at once where it was too large or took too long, a step finer where there is room. A
//! picture in which nothing moves takes no bits, so that what stands still gets finer with each update until it is as good as it
//! gets; an encoder takes nothing back when a later picture is coded more coarsely. Pictures have what geometry and motion leave; what all of
//! them took too much, or left, the next second's make good.
//!
//! What is left over is for more texels (`density`).

use crate::pacing::density::Spare;
use shadecast_protocol::message::Codec;

/// The quantisation parameter used unless told otherwise.
pub const DEFAULT_QP: u8 = 22;

/// What all of a client's streams may take together unless told otherwise, Mbit/s.
pub const DEFAULT_BITRATE_MBIT_S: f64 = 20.0;

/// No picture is coded more finely: what is gained below is not seen.
const FINEST_QP: u8 = 10;
/// Or more coarsely: fewer updates show more.
const COARSEST_QP: u8 = 34;
/// Bits of the same picture double from one quantiser to the one this far below.
const QP_OF_TWICE_THE_BITS: f64 = 6.0;
/// A picture that takes less than this part of what it may is followed by a finer one: a step takes an eighth more bits, and
/// pictures differ.
const ROOM: f64 = 0.75;
/// Of the time from one update to the next an encoder may take this part; one that takes longer is given nothing finer than
/// [`DEFAULT_QP`].
const ENCODER_SHARE: f64 = 0.8;
/// With this quantiser, or a finer one, there are bits for more texels; with that, or a coarser one, too few for those there are.
const QP_WITH_ROOM: u8 = 20;
const QP_WITHOUT: u8 = 28;
/// Of what a slow link carries, this part is used.
const LINK_SHARE: f64 = 0.8;
/// Pictures have at least this part of the bits, however many geometry takes.
const LEAST_PICTURE_SHARE: f64 = 0.25;
/// Over a link that carries little there are fewer updates rather than worse ones, down to so many a second.
const SLOW_UPDATES_HZ: f64 = 10.0;
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
            Self::Bitrate(_) => DEFAULT_QP,
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
pub struct Quality {
    options: QualityOptions,
    period_s: f64,
    qp: u8,
    /// Bytes a second of all that are no pictures.
    others_bytes_s: f64,
    /// Bytes that were not taken though they might have been; negative: too much was.
    balance_bytes: f64,
    /// Up to when both are known, nanoseconds.
    known_ns: Option<i64>,
    /// What a slow link carries, bytes a second.
    link_bytes_s: Option<f64>,
    /// The last update took too long, or its picture.
    is_slow: [bool; 2],
    /// A picture has told what pictures take.
    is_told: bool,
}

impl Quality {
    /// For updates that are wanted once in `period_ns`.
    pub fn new(options: QualityOptions, period_ns: i64) -> Self {
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
    pub fn qp(&self) -> u8 {
        self.qp
    }

    /// What the link carries, bytes a second, where it is known to be slow.
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
    pub fn note_update(&mut self, took_s: f64) {
        self.is_slow[0] = took_s > ENCODER_SHARE * self.period_s;
    }

    /// Whether bits and time are left over.
    pub fn spare(&self) -> Spare {
        let is_constant = matches!(self.options, QualityOptions::Constant(_));
        let has_bits = |qp: u8| is_constant || self.is_told && self.qp <= qp;
        match self.is_slow.contains(&true) {
            true => Spare::Short,
            false if has_bits(QP_WITH_ROOM) => Spare::Room,
            false if has_bits(QP_WITHOUT - 1) => Spare::Enough,
            false => Spare::Short,
        }
    }

    /// Of the next picture where it must need no other, and of those after it: all of it costs bits anew, which what stands still
    /// cost once.
    pub(crate) fn refresh_qp(&mut self) -> u8 {
        if matches!(self.options, QualityOptions::Bitrate(_)) {
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
        self.qp = match used {
            used if used > 1.0 => self.qp.saturating_add((QP_OF_TWICE_THE_BITS * used.log2()).ceil() as u8),
            _ if is_slow && self.qp <= DEFAULT_QP => (self.qp + 1).min(DEFAULT_QP),
            used if used < ROOM => self.qp - 1,
            _ => self.qp,
        }
        .clamp(FINEST_QP, COARSEST_QP);
    }

    /// What a picture may take, bytes, where all streams together may take so many a second.
    fn picture_bytes(&self, bytes_s: f64) -> f64 {
        let left_bytes_s = bytes_s - self.others_bytes_s + self.balance_bytes / BALANCE_S;
        let period_s =
            if self.is_link_short() { self.period_s.max(1.0 / SLOW_UPDATES_HZ) } else { self.period_s };
        left_bytes_s.max(LEAST_PICTURE_SHARE * bytes_s) * period_s
    }

    /// What all streams together may take, bytes a second; `None`: what they take.
    fn bytes_s(&self) -> Option<f64> {
        let asked_bytes_s = self.asked_bytes_s()?;
        Some(self.link_share_bytes_s().map_or(asked_bytes_s, |link| link.min(asked_bytes_s)))
    }

    fn asked_bytes_s(&self) -> Option<f64> {
        match self.options {
            QualityOptions::Bitrate(mbit_s) => Some(mbit_s * 1e6 / 8.0),
            QualityOptions::Constant(_) => None,
        }
    }

    fn link_share_bytes_s(&self) -> Option<f64> {
        self.link_bytes_s.map(|bytes_s| bytes_s * LINK_SHARE)
    }

    /// Whether the link carries less than was asked for.
    fn is_link_short(&self) -> bool {
        self.link_share_bytes_s().zip(self.asked_bytes_s()).is_some_and(|(link, asked)| link < asked)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NS: i64 = 33_333_333;

    /// An encoder of pictures of which so many bytes change at quantiser 22; what stands still costs bits once.
    struct Scene {
        moving_bytes: f64,
        still_bytes: f64,
        still_qp: u8,
    }

    impl Scene {
        fn new(moving_bytes: f64, still_bytes: f64) -> Self {
            Self { moving_bytes, still_bytes, still_qp: 51 }
        }

        fn picture(&mut self, qp: u8) -> usize {
            let at = |bytes: f64, qp: u8| bytes * 2f64.powf((22.0 - f64::from(qp)) / 6.0);
            let still = (at(self.still_bytes, qp) - at(self.still_bytes, self.still_qp)).max(0.0);
            self.still_qp = self.still_qp.min(qp);
            (at(self.moving_bytes, qp) + still) as usize
        }
    }

    fn sent(stream_bytes: usize, encode_s: f64) -> SentPicture {
        SentPicture { stream_bytes, is_refresh: false, encode_s }
    }

    /// Bytes and quantiser of each picture of a scene, one an update.
    fn run(quality: &mut Quality, scene: &mut Scene, pictures: usize) -> Vec<(usize, u8)> {
        let picture = |_| {
            let qp = quality.qp();
            let bytes = scene.picture(qp);
            note(quality, sent(bytes, 0.0));
            (bytes, qp)
        };
        (0..pictures).map(picture).collect()
    }

    /// A picture a period after what is known.
    fn note(quality: &mut Quality, picture: SentPicture) {
        quality.note_picture(picture, quality.known_ns.unwrap_or(0) + PERIOD_NS);
    }

    fn quality() -> Quality {
        Quality::new(QualityOptions::default(), PERIOD_NS)
    }

    /// Mbit/s of the last second.
    fn last_mbit_s(pictures: &[(usize, u8)]) -> f64 {
        pictures[pictures.len() - 30..].iter().map(|(bytes, _)| *bytes as f64 * 8e-6).sum()
    }

    #[test]
    fn what_stands_still_gets_as_fine_as_it_gets_and_then_costs_nothing() {
        let pictures = run(&mut quality(), &mut Scene::new(0.0, 50_000.0), 60);
        assert_eq!(pictures[59], (0, FINEST_QP));
        assert!(pictures[2..].iter().all(|(bytes, _)| *bytes < 83_333));
    }

    #[test]
    fn what_moves_takes_what_was_asked_for_and_swings_by_no_more_than_a_step() {
        for bytes in [20_000.0, 40_000.0, 83_000.0, 200_000.0] {
            let pictures = run(&mut quality(), &mut Scene::new(bytes, 0.0), 90);
            let mbit_s = last_mbit_s(&pictures);
            assert!((18.0..=20.2).contains(&mbit_s), "{bytes}: {mbit_s} Mbit/s");
            let last: Vec<u8> = pictures[60..].iter().map(|(_, qp)| *qp).collect();
            assert!(last.iter().max() <= last.iter().min().map(|qp| qp + 1).as_ref(), "{bytes}: {last:?}");
        }
    }

    #[test]
    fn a_scene_that_begins_to_move_is_coded_coarsely_enough_with_its_second_picture() {
        let (mut quality, mut scene) = (quality(), Scene::new(0.0, 50_000.0));
        run(&mut quality, &mut scene, 60);
        scene.moving_bytes = 60_000.0;
        let pictures = run(&mut quality, &mut scene, 3);
        // A fifth more than a period has: nothing was taken before.
        assert!(pictures[0].0 > 150_000 && pictures[1].0 <= 100_000, "{pictures:?}");
    }

    #[test]
    fn geometry_and_motion_take_of_the_same_bits() {
        let (mut quality, mut scene) = (quality(), Scene::new(40_000.0, 0.0));
        let mut mbit = Vec::new();
        for update in 0..300 {
            // Nothing in the first second, then 5 to 15 Mbit/s, in turns of a second.
            let others = if update < 30 { 0 } else { 20_833 + 41_667 * usize::from(update / 30 % 2 == 0) };
            quality.note_other(others, update * PERIOD_NS);
            let bytes = others + run(&mut quality, &mut scene, 1)[0].0;
            mbit.push(bytes as f64 * 8e-6);
        }
        let seconds: Vec<f64> = mbit.chunks(30).map(|second| second.iter().sum()).collect();
        assert!(seconds.iter().all(|mbit| (13.0..=25.0).contains(mbit)), "{seconds:?}");
        let mean = seconds[1..].iter().sum::<f64>() / 9.0;
        assert!((18.5..=20.2).contains(&mean), "{seconds:?}");
    }

    #[test]
    fn what_a_still_scene_leaves_makes_no_burst_and_a_flood_starves_nothing_for_long() {
        let (mut quality, mut scene) = (quality(), Scene::new(0.0, 50_000.0));
        run(&mut quality, &mut scene, 300);
        scene.moving_bytes = 40_000.0;
        let pictures = run(&mut quality, &mut scene, 30);
        assert!(last_mbit_s(&pictures) < 25.0, "{pictures:?}");
        quality.note_other(5_000_000, quality.known_ns.unwrap_or(0));
        let pictures = run(&mut quality, &mut scene, 90);
        assert!(pictures.iter().all(|(bytes, _)| *bytes > 10_000), "{pictures:?}");
        assert!(last_mbit_s(&pictures) > 16.0, "{pictures:?}");
    }

    #[test]
    fn a_slow_link_has_less_and_a_slow_encoder_is_given_nothing_finer() {
        let (mut quality, mut scene) = (quality(), Scene::new(10_000.0, 0.0));
        quality.note_link(Some(125_000.0)); // 1 Mbit/s
        let (bytes, _) = run(&mut quality, &mut scene, 60)[59];
        assert!((7_000..=10_000).contains(&bytes), "{bytes}: ten pictures a second");
        let mut quality = Quality::new(QualityOptions::default(), PERIOD_NS);
        (0..4).for_each(|_| note(&mut quality, sent(10, 0.01)));
        assert_eq!(quality.qp(), DEFAULT_QP - 4);
        (0..30).for_each(|_| note(&mut quality, sent(10, 0.03)));
        assert_eq!(quality.qp(), DEFAULT_QP);
    }

    #[test]
    fn bits_are_left_over_where_pictures_are_fine_and_time_where_updates_are_quick() {
        let mut quality = quality();
        note(&mut quality, SentPicture { is_refresh: true, ..sent(10, 0.0) });
        assert_eq!(quality.spare(), Spare::Short, "nothing is known of pictures that follow another");
        note(&mut quality, sent(10, 0.0));
        assert_eq!(quality.spare(), Spare::Enough);
        run(&mut quality, &mut Scene::new(10_000.0, 0.0), 30);
        assert_eq!(quality.spare(), Spare::Room);
        quality.note_update(0.03);
        assert_eq!(quality.spare(), Spare::Short, "updates take too long");
        quality.note_update(0.01);
        assert_eq!(quality.spare(), Spare::Room);
        run(&mut quality, &mut Scene::new(300_000.0, 0.0), 30);
        assert_eq!(quality.spare(), Spare::Short);
    }

    #[test]
    fn a_constant_quantiser_stays_and_a_refresh_says_nothing() {
        let mut constant = Quality::new(QualityOptions::Constant(7), PERIOD_NS);
        run(&mut constant, &mut Scene::new(1e6, 0.0), 10);
        assert_eq!(constant.qp(), 7);
        let mut quality = quality();
        note(&mut quality, SentPicture { is_refresh: true, ..sent(10_000_000, 0.0) });
        assert_eq!(quality.qp(), DEFAULT_QP);
    }

    #[test]
    fn a_refresh_begins_as_the_first_picture_did_and_then_gets_finer_by_the_same_steps() {
        let (mut quality, mut scene) = (quality(), Scene::new(0.0, 50_000.0));
        run(&mut quality, &mut scene, 60);
        assert_eq!(quality.qp(), FINEST_QP);
        assert_eq!(quality.refresh_qp(), DEFAULT_QP);
        scene.still_qp = 51;
        let bytes = scene.picture(DEFAULT_QP);
        assert!(bytes <= 50_000, "{bytes}");
        note(&mut quality, SentPicture { is_refresh: true, ..sent(bytes, 0.0) });
        let pictures = run(&mut quality, &mut scene, 30);
        assert_eq!(pictures[0].1, DEFAULT_QP);
        assert!(pictures.windows(2).all(|pair| pair[1].1 == pair[0].1.saturating_sub(1).max(FINEST_QP)));
        assert_eq!(pictures[29], (0, FINEST_QP));
        let mut coarse = Quality { qp: COARSEST_QP, ..quality };
        assert_eq!(coarse.refresh_qp(), COARSEST_QP, "no finer than it is");
        let mut constant = Quality::new(QualityOptions::Constant(7), PERIOD_NS);
        assert_eq!(constant.refresh_qp(), 7);
    }
}

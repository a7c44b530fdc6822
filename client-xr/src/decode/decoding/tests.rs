use super::*;
use shadecast_protocol::picture::I420;
use shadecast_protocol::wire::encode_geometry;

const MS: i64 = 1_000_000;

/// A unit that no decoder of this headset takes, though it is a refresh.
const UNDECODABLE: u8 = 255;

/// Decodes a unit of one byte to that byte; 0 is broken, an even one needs the one before, an odd one is a refresh.
#[derive(Default)]
struct Toy {
    last: Option<u8>,
    done: VecDeque<Result<Picture, DecodeError>>,
    /// Pictures that it keeps back until later units come.
    kept_back: usize,
}

impl Toy {
    fn decode(&mut self, unit: u8) -> Result<Picture, DecodeError> {
        let is_refresh = unit % 2 == 1;
        if unit == UNDECODABLE {
            self.last = None;
            return Err(DecodeError::Platform { doing: "setting the decoder up", reason: "no".into() });
        }
        if unit == 0 {
            self.last = None;
            return Err(DecodeError::Corrupt { state: 1 });
        }
        if !is_refresh && self.last.is_none() {
            return Err(DecodeError::NeedsRefresh);
        }
        self.last = Some(unit);
        Ok(Picture::Planes(I420::new([2, 2], vec![unit; 6]).expect("a picture")))
    }
}

impl Decoder for Toy {
    fn submit(&mut self, access_unit: &[u8]) {
        let result = self.decode(access_unit[0]);
        self.done.push_back(result);
    }

    fn poll(&mut self, _: Duration) -> Option<Result<Picture, DecodeError>> {
        if self.done.len() > self.kept_back { self.done.pop_front() } else { None }
    }

    fn recycle(&mut self, _: Picture) {}

    fn unit_lost(&mut self) {
        self.last = None;
    }

    fn needs_refresh(&self) -> bool {
        self.last.is_none()
    }
}

fn shown(decoded: &Decoded) -> (u32, u8) {
    let Picture::Planes(picture) = &decoded.picture else { panic!("another kind of picture") };
    (decoded.update.0, picture.bytes()[0])
}

struct Bench {
    decoding: Decoding,
    seen: Vec<(u32, u8)>,
}

impl Bench {
    fn new(delay_ms: i64) -> Self {
        let timing = DecodeTiming::Virtual { delay_ns: delay_ms * MS };
        Self { decoding: Decoding::new(Box::<Toy>::default(), timing), seen: Vec::new() }
    }

    fn add(&mut self, frame: u32, unit: u8, at_ms: i64) {
        let header =
            PictureHeader { update: UpdateId(frame), time: ServerTime(0), is_refresh: unit % 2 == 1 };
        self.decoding.add(header, vec![unit], ClientTime(at_ms * MS));
    }

    fn advance(&mut self, at_ms: i64) {
        let seen = &mut self.seen;
        self.decoding.advance(ClientTime(at_ms * MS), |d| seen.push(shown(&d)));
    }

    fn asks(&mut self, at_ms: i64) -> bool {
        self.decoding.refresh_request(ClientTime(at_ms * MS)).is_some()
    }
}

#[test]
fn a_pictures_frame_is_told_from_the_head_of_its_stream() {
    let header = PictureHeader { update: UpdateId(0x0403_0201), time: ServerTime(9), is_refresh: true };
    let stream = encode_picture(header, &[1, 2, 3]);
    assert_eq!(frame_of_head(&stream[..5]), Some(UpdateId(0x0403_0201)));
    assert_eq!(frame_of_head(&stream[..4]), None);
    assert_eq!(frame_of_head(&encode_geometry(&[0; 8])), None);
}

#[test]
fn pictures_that_overtake_are_decoded_in_order() {
    let mut bench = Bench::new(0);
    bench.add(0, 1, 0);
    bench.add(2, 4, 1);
    bench.add(1, 2, 2);
    bench.advance(2);
    assert_eq!(bench.seen, [(0, 1), (1, 2), (2, 4)]);
    assert!(!bench.asks(2));
}

#[test]
fn decoding_takes_its_time_one_picture_after_the_other() {
    let mut bench = Bench::new(6);
    bench.add(0, 1, 0);
    bench.add(1, 2, 1);
    bench.advance(5);
    assert_eq!(bench.seen, []);
    bench.advance(6);
    assert_eq!(bench.seen, [(0, 1)]);
    bench.advance(12);
    assert_eq!(bench.seen, [(0, 1), (1, 2)]);
}

#[test]
fn an_abandoned_picture_requests_a_refresh() {
    let mut bench = Bench::new(0);
    bench.add(0, 1, 0);
    bench.add(2, 4, 1);
    bench.decoding.given_up(Some(UpdateId(1)));
    bench.advance(2);
    assert_eq!(bench.seen, [(0, 1)]);
    assert!(bench.asks(2) && !bench.asks(3));
    assert!(bench.asks(502), "asked again where none came");
    bench.add(3, 7, 510);
    bench.add(4, 8, 520);
    bench.advance(520);
    assert_eq!(bench.seen, [(0, 1), (3, 7), (4, 8)]);
    assert!(!bench.asks(5000));
    assert_eq!(bench.decoding.take_lost(), 2);
}

#[test]
fn a_refresh_does_not_wait_for_what_is_missing_before_it() {
    let mut bench = Bench::new(0);
    bench.add(0, 1, 0);
    bench.add(3, 7, 1);
    bench.add(1, 2, 2);
    bench.advance(2);
    assert_eq!(bench.seen, [(0, 1), (3, 7)]);
    assert!(!bench.asks(2));
}

#[test]
fn the_picture_of_the_largest_number_is_shown_once() {
    let mut bench = Bench::new(0);
    bench.add(u32::MAX - 1, 1, 0);
    (0..2).for_each(|_| bench.add(u32::MAX, 3, 1));
    bench.advance(2);
    assert_eq!(bench.seen, [(u32::MAX - 1, 1), (u32::MAX, 3)]);
}

#[test]
fn a_picture_that_never_comes_is_given_up_in_the_end() {
    let mut bench = Bench::new(0);
    bench.add(0, 1, 0);
    bench.add(2, 4, 10);
    bench.advance(600);
    assert!(!bench.asks(600));
    bench.advance(611);
    assert!(bench.asks(611));
}

#[test]
fn over_a_long_way_a_picture_is_waited_for_until_its_third_repair() {
    let mut bench = Bench::new(0);
    bench.decoding.set_round_trip(220 * MS);
    bench.add(0, 1, 0);
    bench.add(2, 4, 10);
    bench.advance(1300);
    assert!(!bench.asks(1300));
    bench.advance(1370);
    assert!(bench.asks(1370));
}

#[test]
fn a_broken_picture_asks_for_a_refresh() {
    let mut bench = Bench::new(0);
    bench.add(0, 1, 0);
    bench.add(1, 0, 1);
    bench.advance(1);
    assert_eq!(bench.decoding.refresh_request(ClientTime(MS)), Some(Some(UpdateId(0))));
}

#[test]
fn a_decoder_failing_with_each_refresh_is_reported_once() {
    let mut bench = Bench::new(0);
    let mut update = 0..;
    let mut fail = |bench: &mut Bench| {
        // What needs the refresh that failed is no failure of its own.
        for unit in [UNDECODABLE, 2, 2] {
            bench.add(update.next().expect("another"), unit, 0);
        }
        bench.advance(0);
        bench.decoding.take_trouble()
    };
    for _ in 1..MOST_FAILURES {
        assert_eq!(fail(&mut bench), None);
    }
    let text = fail(&mut bench).expect("it is of no use");
    assert!(text.contains("pictures cannot be shown") && text.contains("setting the decoder up"), "{text}");
    assert_eq!(fail(&mut bench), None, "once");
}

#[test]
fn a_picture_between_failures_makes_up_for_them() {
    let mut bench = Bench::new(0);
    for round in 0..4 * MOST_FAILURES {
        bench.add(2 * round, UNDECODABLE, 0);
        bench.add(2 * round + 1, 1, 0);
        bench.advance(0);
    }
    assert_eq!((bench.decoding.take_trouble(), bench.seen.len()), (None, 4 * MOST_FAILURES as usize));
}

#[test]
fn a_picture_of_the_far_future_costs_one_step() {
    for far in [4_000_000_000, u32::MAX] {
        let mut bench = Bench::new(0);
        bench.add(0, 1, 0);
        bench.add(far, 4, 1);
        bench.advance(700);
        bench.add(far, 6, 701);
        bench.advance(1400);
        assert_eq!(bench.seen, [(0, 1)], "it needs one that never came");
        assert!(bench.asks(1400));
        assert!(bench.decoding.take_lost() >= far - 1);
    }
}

#[test]
fn pictures_that_wait_are_bounded_in_bytes_and_number() {
    let mut decoding = Decoding::new(Box::<Toy>::default(), DecodeTiming::Virtual { delay_ns: 0 });
    let mut add = |frame: u32, bytes: usize| {
        let header = PictureHeader { update: UpdateId(frame), time: ServerTime(0), is_refresh: false };
        decoding.add(header, vec![4; bytes], ClientTime(0));
        (decoding.waiting_bytes(), decoding.order.waiting.len())
    };
    for frame in 0..30 {
        let (bytes, count) = add(2 + 2 * frame, MAX_ACCESS_UNIT_BYTES);
        assert!(bytes <= MAX_WAITING_BYTES && count <= 8, "{bytes} bytes in {count}");
    }
    for frame in 0..1000 {
        assert!(add(1000 + 2 * frame, 1).1 <= MAX_WAITING);
    }
}

#[test]
fn a_decoder_that_keeps_pictures_back_is_waited_for() {
    let timing = DecodeTiming::Virtual { delay_ns: 0 };
    let toy = Toy { kept_back: 2, ..Toy::default() };
    let mut bench = Bench { decoding: Decoding::new(Box::new(toy), timing), seen: Vec::new() };
    for (frame, unit) in [(0, 1), (1, 2), (2, 4), (3, 6)] {
        bench.add(frame, unit, frame.into());
        bench.advance(frame.into());
    }
    assert_eq!(bench.seen, [(0, 1), (1, 2)]);
}

#[test]
fn the_thread_decodes_the_same() {
    assert_eq!(seen_of_thread(Toy::default()), [(0, 1), (1, 2), (2, 4)]);
}

#[test]
fn a_holding_decoder_still_gets_later_units() {
    assert_eq!(seen_of_thread(Toy { kept_back: 1, ..Toy::default() }), [(0, 1), (1, 2), (2, 4)]);
}

/// The first three of four pictures.
fn seen_of_thread(toy: Toy) -> Vec<(u32, u8)> {
    let mut decoding = Decoding::new(Box::new(toy), DecodeTiming::Thread { now: || ClientTime(7) });
    for (frame, unit) in [(0, 1), (1, 2), (2, 4), (3, 6)] {
        let header =
            PictureHeader { update: UpdateId(frame), time: ServerTime(0), is_refresh: unit % 2 == 1 };
        decoding.add(header, vec![unit], ClientTime(0));
    }
    let mut seen = Vec::new();
    while seen.len() < 3 {
        decoding.advance(ClientTime(0), |d| seen.push(shown(&d)));
        std::thread::yield_now();
    }
    seen.truncate(3);
    seen
}

#[test]
fn blocks_that_cannot_settle_are_told_with_the_update_before_them() {
    let mut bench = Bench::new(0);
    (0..5).for_each(|frame| bench.add(frame, if frame == 0 { 1 } else { 2 }, 0));
    bench.advance(1);
    bench.decoding.note_unsettled(UpdateId(3));
    bench.decoding.note_unsettled(UpdateId(2));
    let request = |bench: &mut Bench, at_ms: i64| bench.decoding.refresh_request(ClientTime(at_ms * MS));
    assert_eq!(request(&mut bench, 1), Some(Some(UpdateId(1))));
    bench.decoding.note_unsettled(UpdateId(4));
    assert_eq!(request(&mut bench, 2), None, "the server forgets all that it had sent");
    bench.add(5, 2, 3);
    bench.decoding.note_unsettled(UpdateId(5));
    assert_eq!(request(&mut bench, 3), Some(Some(UpdateId(4))), "it had sent this one perhaps later");
    bench.add(9, 1, 4);
    bench.decoding.note_unsettled(UpdateId(8));
    assert_eq!(request(&mut bench, 4), None, "the answer came after it");
    bench.decoding.note_unsettled(UpdateId(0));
    assert_eq!(request(&mut bench, 5), Some(None));
}

use super::*;
use crate::delta::{Delta, DeltaEncoder};
use crate::geometry::{GeometryDelta, Motion, NewVertex};
use crate::ids::ClipId;
use crate::ids::{InstanceId, VertexSlot};
use crate::limits::MAX_DELTA_BYTES;
use crate::motion::clip::ClipChunk;
use crate::motion::keys::{ChunkTrack, TrackKind};
use crate::testing::{Dice, damaged, displayed, head, hello, offer};

/// Both ends, with what the client has been sent and has not yet been given.
struct Pair {
    client: ClientSession,
    server: ServerSession,
    /// The server's sending half, once it has said yes.
    sender: Option<DeltaSender>,
    streams: Vec<Vec<u8>>,
}

const NOW: ClientTime = ClientTime(1_000);

/// A delta that says nothing.
fn encoded(update: UpdateId) -> EncodedDelta {
    let encoder = DeltaEncoder::new(1, 1);
    encoder.from_delta(update.0).encode(&GeometryDelta { update, ..Default::default() }.into())
}

impl Pair {
    fn new() -> Self {
        Self {
            client: ClientSession::start(hello(), NOW),
            server: ServerSession::new(offer()),
            sender: None,
            streams: Vec::new(),
        }
    }

    fn connected() -> Self {
        let mut pair = Self::new();
        pair.carry(ServerTime(0));
        pair.accept();
        pair.carry(ServerTime(0));
        assert!(matches!(pair.client.poll_event(), Some(ClientEvent::Welcome(_))));
        pair
    }

    #[track_caller]
    fn accept(&mut self) {
        assert!(matches!(self.server.poll_event(), Some(ServerEvent::Asked { .. })));
        self.sender = self.server.accept();
    }

    /// Carries control messages and datagrams both ways until none are left; keeps streams back.
    fn carry(&mut self, now: ServerTime) {
        loop {
            if let Some(out) = self.client.poll_out() {
                match out {
                    Out::Control(bytes) => self.server.on_control(&bytes),
                    Out::Datagram(bytes) => self.server.on_datagram(&bytes, now),
                    Out::Stream { .. } => panic!("a client sends no streams"),
                }
            } else if let Some(out) = self.server.poll_out(now) {
                match out {
                    Out::Control(bytes) => self.client.on_control(&bytes),
                    Out::Datagram(bytes) => self.client.on_datagram(&bytes, NOW),
                    Out::Stream { bytes, .. } => self.streams.push(bytes),
                }
            } else {
                return;
            }
        }
    }

    fn send_delta(&mut self) {
        let sender = self.sender.as_mut().unwrap();
        let out = sender.stream(&encoded(sender.next_update()));
        self.keep(out);
    }

    fn send_picture(&mut self, frame: u32) {
        let out = picture_stream(picture(frame), b"coded").unwrap();
        self.keep(out);
    }

    fn keep(&mut self, out: Out) {
        let Out::Stream { bytes, .. } = out else { panic!("{out:?}") };
        self.streams.push(bytes);
    }

    fn client_events(&mut self) -> Vec<ClientEvent> {
        std::iter::from_fn(|| self.client.poll_event()).collect()
    }
}

fn picture(frame: u32) -> PictureHeader {
    PictureHeader { update: UpdateId(frame), time: ServerTime(1), is_refresh: frame == 0 }
}

#[test]
fn deltas_come_out_in_order_however_their_streams_arrive() {
    for seed in 0..50 {
        let (mut pair, mut dice) = (Pair::connected(), Dice::new(seed));
        (0..40).for_each(|_| pair.send_delta());
        pair.carry(ServerTime(0));
        while !pair.streams.is_empty() {
            let next = dice.below(pair.streams.len() as u64) as usize;
            pair.client.on_stream(&pair.streams.swap_remove(next));
        }
        let frames: Vec<_> = pair
            .client_events()
            .into_iter()
            .map(|event| match event {
                ClientEvent::Delta(delta) => delta.geometry.update.0,
                other => panic!("seed {seed}: {other:?}"),
            })
            .collect();
        assert_eq!(frames, (0..40).collect::<Vec<_>>(), "seed {seed}");
        assert_eq!(pair.client.waiting.bytes, 0);
    }
}

#[test]
fn pictures_come_out_at_once_though_a_delta_is_late() {
    let mut pair = Pair::connected();
    pair.send_delta();
    pair.send_picture(0);
    pair.carry(ServerTime(0));
    pair.client.on_stream(&pair.streams[1]);
    let expected = ClientEvent::Picture { header: picture(0), access_unit: b"coded".to_vec() };
    assert_eq!(pair.client_events(), [expected]);
}

#[test]
fn streams_that_overtake_the_welcome_wait_for_it() {
    let mut pair = Pair::new();
    let Some(Out::Control(hello)) = pair.client.poll_out() else { panic!("no hello") };
    pair.server.on_control(&hello);
    pair.accept();
    let Some(Out::Control(welcome)) = pair.server.poll_out(ServerTime(0)) else { panic!("no welcome") };
    pair.send_delta();
    pair.send_picture(0);
    pair.carry(ServerTime(0));
    pair.streams.clone().iter().for_each(|stream| pair.client.on_stream(stream));
    assert_eq!(pair.client_events(), []);
    pair.client.on_control(&welcome);
    let events = pair.client_events();
    assert!(matches!(events[0], ClientEvent::Welcome(_)), "{events:?}");
    assert_eq!(events.len(), 3);
    assert_eq!(pair.client.waiting.bytes, 0);
}

#[test]
fn a_mismatch_of_versions_tells_the_user_what_to_update() {
    let mut pair = Pair::new();
    pair.server.offer.protocol_version = 8;
    pair.server.offer.min_protocol_version = 7;
    pair.carry(ServerTime(0));
    let events = pair.client_events();
    let [ClientEvent::Refused(refused)] = &events[..] else { panic!("{events:?}") };
    assert_eq!(refused.remedy, "update the client to one that speaks protocol 7");
    assert!(!pair.client.is_alive() && !pair.server.is_alive());
}

#[test]
fn a_hello_of_the_far_future_is_refused_by_its_versions_alone() {
    let mut server = ServerSession::new(offer());
    let hello = [vec![0, 40, 39, 3], b"9.0".to_vec(), vec![0xee; 30]].concat();
    server.on_control(&hello);
    let Some(ServerEvent::Refused(refused)) = server.poll_event() else { panic!("not refused") };
    assert_eq!(refused.remedy, "update the server to one that speaks protocol 39");
}

#[test]
fn pings_make_the_clocks_agree() {
    let mut pair = Pair::connected();
    let later = NOW.plus_ns(QUICK_PING_NS);
    assert_eq!(pair.client.next_tick(), Some(later));
    pair.client.on_tick(NOW.plus_ns(1));
    assert_eq!(pair.client.poll_out(), None, "not yet due");
    pair.client.on_tick(later);
    pair.carry(ServerTime(QUICK_PING_NS));
    assert_eq!(pair.client.next_tick(), Some(later.plus_ns(QUICK_PING_NS)));
}

#[test]
fn the_clocks_agree_when_the_welcome_comes() {
    let mut pair = Pair::new();
    pair.carry(ServerTime(5_000_000));
    pair.accept();
    pair.carry(ServerTime(5_000_000));
    let events = pair.client_events();
    assert!(matches!(events[..], [ClientEvent::Welcome(_)]), "{events:?}");
    assert_eq!(pair.client.clock().server_time(NOW), Some(ServerTime(5_000_000)));
}

#[test]
fn a_ping_that_overtakes_the_hello_is_answered() {
    let mut server = ServerSession::new(offer());
    server.on_datagram(&ClientDatagram::ClockPing { client_send: NOW }.encode(), ServerTime(7));
    assert!(matches!(server.poll_out(ServerTime(7)), Some(Out::Datagram(_))));
}

#[test]
fn a_pong_says_when_the_ping_came_and_when_the_pong_left() {
    let mut pair = Pair::connected();
    let ping = ClientDatagram::ClockPing { client_send: NOW }.encode();
    pair.server.on_datagram(&ping, ServerTime(1_000));
    // The driver was held up.
    let Some(Out::Datagram(pong)) = pair.server.poll_out(ServerTime(9_000)) else { panic!("no pong") };
    let expected = ServerDatagram::ClockPong {
        client_send: NOW,
        server_receive: ServerTime(1_000),
        server_send: ServerTime(9_000),
    };
    assert_eq!(ServerDatagram::decode(&pong), Ok(expected));
}

#[test]
fn few_pings_are_answered_before_the_hello_and_all_after_it() {
    let mut pair = Pair::new();
    let answered = |server: &mut ServerSession| {
        let ping = |n| ClientDatagram::ClockPing { client_send: ClientTime(n) }.encode();
        let pongs = (0..10_000).filter_map(|n| {
            server.on_datagram(&ping(n), ServerTime(n));
            server.poll_out(ServerTime(n))
        });
        pongs.filter(|out| matches!(out, Out::Datagram(_))).count()
    };
    assert_eq!(answered(&mut pair.server), PINGS_BEFORE_HELLO as usize);
    assert_eq!(answered(&mut Pair::connected().server), 10_000);
}

#[test]
fn a_server_that_answers_no_pings_is_left_after_two_seconds() {
    let mut pair = Pair::connected();
    let ticks = |pair: &mut Pair, from: i64, to: i64| {
        (from..to).for_each(|i| pair.client.on_tick(NOW.plus_ns(i * PING_NS)));
        pair.client.is_alive()
    };
    pair.client.note_alive(NOW);
    let silent = SILENCE_NS / PING_NS;
    assert!(ticks(&mut pair, 1, 2 * silent), "a network that carries nothing");
    let lives = |pair: &mut Pair, from: i64, to: i64| {
        (from..to).all(|i| {
            pair.client.note_alive(NOW.plus_ns(i * PING_NS));
            ticks(pair, i, i + 1)
        })
    };
    assert!(lives(&mut pair, 2 * silent, 3 * silent), "what was asked before says nothing");
    assert!(!lives(&mut pair, 3 * silent, 3 * silent + 3), "a connection that lives");
    let events: Vec<_> = std::iter::from_fn(|| pair.client.poll_event()).collect();
    assert_eq!(events.last(), Some(&ClientEvent::Silent));
}

#[test]
fn a_client_that_slept_hears_what_came_before_it_gives_the_server_up() {
    let mut pair = Pair::connected();
    pair.client.on_tick(NOW.plus_ns(PING_NS));
    let awake = NOW.plus_ns(3_600_000_000_000);
    pair.client.note_alive(awake);
    (0..i64::from(SILENCE_PINGS) - 2).for_each(|i| pair.client.on_tick(awake.plus_ns(i * PING_NS)));
    assert!(pair.client.is_alive());
    let (server_receive, server_send) = (ServerTime(5), ServerTime(6));
    let client_send = *pair.client.outstanding.back().expect("pinged");
    let pong = ServerDatagram::ClockPong { client_send, server_receive, server_send };
    pair.client.on_datagram(&pong.encode(), awake.plus_ns(300_000_000));
    pair.client.note_alive(awake.plus_ns(300_000_000));
    (0..40).for_each(|i| pair.client.on_tick(awake.plus_ns(300_000_000 + i * PING_NS)));
    assert!(pair.client.is_alive());
}

#[test]
fn after_an_outage_the_server_has_its_two_seconds_again_and_meanwhile_nothing_is_said() {
    for outage_ns in [2_500_000_000, 59_000_000_000] {
        let mut pair = Pair::connected();
        pair.client.note_alive(NOW);
        let mut said = 0;
        for i in 1..outage_ns / PING_NS {
            let now = NOW.plus_ns(i * PING_NS);
            pair.client.on_tick(now);
            pair.client.send_pose(head(i as u32));
            said += std::iter::from_fn(|| pair.client.poll_out()).count();
        }
        assert!(said <= 2 * (ALIVE_NS / PING_NS) as usize + 2, "{said} datagrams in a quiet connection");
        let back = NOW.plus_ns(outage_ns);
        pair.client.note_alive(back);
        pair.client.on_tick(back);
        assert!(pair.client.is_alive() && !pair.client.is_quiet());
        assert_eq!(std::iter::from_fn(|| pair.client.poll_out()).count(), 1, "a ping at once");
    }
}

#[test]
fn pings_that_nobody_answers_are_dropped_oldest_first() {
    let mut server = Pair::connected().server;
    for n in 0..1000 {
        let ping = ClientDatagram::ClockPing { client_send: ClientTime(n) };
        server.on_datagram(&ping.encode(), ServerTime(n));
    }
    assert_eq!(server.pings.len(), MAX_WAITING_PINGS);
    assert_eq!(server.pings.back(), Some(&(ClientTime(999), ServerTime(999))));
}

#[test]
fn late_poses_are_left_out_also_when_the_sequence_wraps() {
    let mut pair = Pair::connected();
    let mut seen = Vec::new();
    for sequence in [u32::MAX - 1, u32::MAX, 1, 0, u32::MAX, 2] {
        pair.client.send_pose(head(sequence));
        pair.carry(ServerTime(0));
        seen.extend(pair.server.poll_event().map(|event| match event {
            ServerEvent::Head(head) => head.sequence,
            other => panic!("{other:?}"),
        }));
    }
    assert_eq!(seen, [u32::MAX - 1, u32::MAX, 1, 2]);
}

#[test]
fn reports_and_requests_reach_the_server() {
    let mut pair = Pair::connected();
    pair.send_delta();
    pair.client.send_displayed(displayed(0));
    pair.client.request_refresh(Some(UpdateId(0)));
    pair.client.report_watching(false);
    pair.client.goodbye();
    pair.carry(ServerTime(0));
    let events: Vec<_> = std::iter::from_fn(|| pair.server.poll_event()).collect();
    let expected = [
        ServerEvent::Displayed(displayed(0)),
        ServerEvent::RefreshRequest { after: Some(UpdateId(0)) },
        ServerEvent::Watching(false),
        ServerEvent::Goodbye,
    ];
    assert_eq!(events, expected);
    assert!(!pair.server.is_alive());
}

#[test]
fn of_several_refresh_requests_the_earliest_counts() {
    let mut pair = Pair::connected();
    (0..3).for_each(|_| pair.send_delta());
    for after in [Some(UpdateId(1)), Some(UpdateId(0)), Some(UpdateId(2))] {
        pair.client.request_refresh(after);
    }
    pair.carry(ServerTime(0));
    let events: Vec<_> = std::iter::from_fn(|| pair.server.poll_event()).collect();
    assert_eq!(events, [ServerEvent::RefreshRequest { after: Some(UpdateId(0)) }]);
}

#[track_caller]
fn assert_failed(pair: &mut Pair, words: &str) {
    let events = pair.client_events();
    let Some(ClientEvent::Failed(error)) = events.last() else { panic!("{events:?}") };
    assert!(error.to_string().contains(words), "{error}");
    assert!(!pair.client.is_alive());
}

#[test]
fn a_delta_that_comes_twice_ends_the_session() {
    let mut pair = Pair::connected();
    pair.send_delta();
    pair.carry(ServerTime(0));
    (0..2).for_each(|_| pair.client.on_stream(&pair.streams[0]));
    assert_failed(&mut pair, "a second time");
}

#[test]
fn frames_far_ahead_end_the_session_and_near_ones_do_not() {
    let mut pair = Pair::connected();
    pair.client.on_stream(&encode_picture(picture(MAX_FRAMES_AHEAD), b"coded"));
    assert!(pair.client.is_alive());
    for far in [MAX_FRAMES_AHEAD + 1, 4_000_000_000, u32::MAX] {
        let mut pair = Pair::connected();
        pair.client.on_stream(&encode_picture(picture(far), b"coded"));
        assert_failed(&mut pair, "more than 256 after frame 0");
        let mut pair = Pair::connected();
        pair.client.on_stream(&encode_geometry(&encoded(UpdateId(far)).bytes));
        assert_failed(&mut pair, "too far after 0");
    }
}

#[test]
fn the_last_frame_that_there_can_be_overflows_nothing() {
    let mut pair = Pair::connected();
    (pair.client.next_update, pair.client.next_delta) = (UpdateId(u32::MAX - 1), u32::MAX - 1);
    for frame in [u32::MAX - 1, u32::MAX] {
        pair.client.on_stream(&encode_geometry(&encoded(UpdateId(frame)).bytes));
        pair.client.on_stream(&encode_picture(picture(frame), b"coded"));
    }
    assert_eq!(pair.client_events().len(), 4);
}

#[test]
fn deltas_wait_while_what_came_before_is_too_much_for_one_turn() {
    let mut pair = Pair::connected();
    pair.client.hold_back(true);
    pair.client.on_tick(NOW);
    (0..10).for_each(|_| pair.send_delta());
    pair.carry(ServerTime(0));
    pair.streams.clone().iter().for_each(|stream| pair.client.on_stream(stream));
    assert_eq!((pair.client_events().len(), pair.client.waiting_bytes() > 0), (0, true));
    pair.client.hold_back(false);
    pair.client.on_tick(NOW.plus_ns(1));
    assert_eq!((pair.client_events().len(), pair.client.waiting_bytes()), (10, 0));
}

/// A chunk of four words.
fn chunk(sequence: u32) -> Vec<u8> {
    let (times_s, values) = (vec![0.0], vec![[0.5; 4]]);
    let track = ChunkTrack { kind: TrackKind::Step, times_s, values, tangents: Vec::new() };
    let chunk = ClipChunk { clip: ClipId(0), index: 0, first_word: 0, tracks: vec![track] };
    assert_eq!(chunk.words(), 4);
    encode_motion(&MotionMessage { sequence, news: MotionNews::Chunk(chunk) }.encode())
}

#[test]
fn motion_messages_wait_for_room_in_the_arena() {
    let mut pair = Pair::connected();
    (pair.client.motion_words, pair.client.motion_words_left) = (10, 10);
    pair.client_events();
    (0..7).for_each(|sequence| pair.client.on_stream(&chunk(sequence)));
    assert_eq!(pair.client_events().len(), 3, "ten words: two chunks and a whole third one");
    pair.client.hold_back(true);
    pair.client.on_tick(NOW);
    assert_eq!(pair.client_events().len(), 0, "what came before has not been taken in");
    pair.client.hold_back(false);
    pair.client.on_tick(NOW);
    let numbers = pair.client_events().into_iter().map(|event| match event {
        ClientEvent::Motion(message) => message.sequence,
        other => panic!("{other:?}"),
    });
    assert_eq!(numbers.collect::<Vec<_>>(), [3, 4, 5], "in order of arrival");
    pair.client.on_tick(NOW);
    assert_eq!((pair.client_events().len(), pair.client.waiting_bytes()), (1, 0));
}

#[test]
fn a_flood_of_news_of_motion_ends_the_session() {
    let mut pair = Pair::connected();
    pair.client_events();
    pair.client.motion_words_left = 0;
    let chunk = chunk(0);
    let most = MAX_QUEUED_STREAM_BYTES / MOTION_OVERHEAD_BYTES;
    let sent = (0..most).take_while(|_| {
        pair.client.on_stream(&chunk);
        pair.client.is_alive()
    });
    assert!(sent.count() > 1000, "more than streams of other kinds may wait");
    assert!(!pair.client.is_alive());
    assert_eq!(pair.client.waiting_bytes(), 0);
}

#[test]
fn a_turn_takes_in_so_many_records_and_a_delta_always_whole() {
    let mut pair = Pair::connected();
    pair.client.records_left = 3;
    let mut encoder = DeltaEncoder::new(600, 300);
    for frame in 0..4 {
        let vertex = |slot| NewVertex {
            slot: VertexSlot(slot),
            instance: InstanceId(0),
            number: slot,
            motion: Motion::Static { position: glam::Vec3::ONE },
        };
        let new_vertices = (frame * 2..frame * 2 + 2).map(vertex).collect();
        let delta =
            Delta::from(GeometryDelta { update: UpdateId(frame), new_vertices, ..Default::default() });
        let out = pair.sender.as_mut().unwrap().stream(&encoder.encode(&delta));
        pair.keep(out);
    }
    pair.carry(ServerTime(0));
    pair.streams.clone().iter().for_each(|stream| pair.client.on_stream(stream));
    assert_eq!(pair.client_events().len(), 2, "three records: one delta and a whole second one");
    pair.client.on_tick(NOW);
    assert_eq!(pair.client_events().len(), 2);
}

#[test]
fn unrequested_and_second_answers_do_not_count() {
    let mut pair = Pair::connected();
    let pong = |client_send, server_ns| {
        let server = ServerTime(server_ns);
        let (server_receive, server_send) = (server, server);
        ServerDatagram::ClockPong { client_send, server_receive, server_send }.encode()
    };
    let known = pair.client.clock().server_time(NOW).expect("the hello's ping was answered");
    let flood = |pair: &mut Pair, at: ClientTime| {
        for i in 1..1000 {
            pair.client.on_datagram(&pong(at.plus_ns(-i), 77_000_000), at.plus_ns(i));
            pair.client.on_datagram(&pong(NOW, 77_000_000), at.plus_ns(i));
        }
    };
    flood(&mut pair, NOW);
    let later = NOW.plus_ns(PING_NS);
    pair.client.on_tick(later);
    assert_eq!(pair.client.clock().server_time(NOW), Some(known));
    // The one that was asked counts, and counts once.
    pair.client.on_datagram(&pong(later, later.0 - NOW.0), later);
    let asked = pair.client.outstanding.len();
    flood(&mut pair, later);
    pair.client.on_tick(later.plus_ns(PING_NS));
    assert_eq!((asked, pair.client.outstanding.len()), (0, 1));
    let seen = pair.client.clock().server_time(NOW).expect("known");
    assert!(seen.since(known).abs() < 1_000_000, "{seen:?} instead of {known:?}");
}

#[test]
fn a_stamp_counts_once_the_clock_is_known_and_with_the_next_turn() {
    let stamp = |server_ns| match clock_stamp(ServerTime(server_ns)) {
        Out::Datagram(bytes) => bytes,
        other => panic!("{other:?}"),
    };
    let mut fresh = ClientSession::start(hello(), NOW);
    fresh.on_datagram(&stamp(1), NOW);
    fresh.on_tick(NOW);
    assert_eq!(fresh.clock().server_time(NOW), None, "there may be any way between");
    let mut pair = Pair::connected();
    let before = pair.client.clock().error_bound_ns(NOW).expect("known");
    pair.client.on_datagram(&stamp(-1_000_000_000), NOW);
    pair.client.on_tick(NOW);
    assert_eq!(pair.client.clock().error_bound_ns(NOW), Some(before), "a second late: it tells nothing");
}

/// When the pings left that wait to be carried.
fn pings(client: &mut ClientSession) -> Vec<ClientTime> {
    let out = std::iter::from_fn(|| client.poll_out());
    let sent = out.filter_map(|out| match out {
        Out::Datagram(bytes) => match ClientDatagram::decode(&bytes) {
            Ok(ClientDatagram::ClockPing { client_send }) => Some(client_send),
            _ => None,
        },
        _ => None,
    });
    sent.collect()
}

#[test]
fn a_ping_that_is_nearly_due_leaves_with_a_head_state() {
    let mut pair = Pair::connected();
    let early = NOW.plus_ns(QUICK_PING_NS - QUICK_EARLY_NS);
    pair.client.on_tick(early);
    assert_eq!(pings(&mut pair.client), [], "nothing leaves that it could join");
    pair.client.send_pose(head(0));
    pair.client.on_tick(early);
    assert_eq!(pings(&mut pair.client), [early]);
    pair.client.send_pose(head(1));
    pair.client.on_tick(early.plus_ns(1_000_000));
    assert_eq!(pings(&mut pair.client), [], "the last one has just left");
}

#[test]
fn a_stamp_is_answered_by_a_ping_and_a_flood_of_stamps_by_few() {
    let mut pair = Pair::connected();
    let Out::Datagram(stamp) = clock_stamp(ServerTime(0)) else { panic!("a stamp is a datagram") };
    let soon = NOW.plus_ns(STAMP_PING_NS);
    pair.client.on_datagram(&stamp, NOW.plus_ns(STAMP_PING_NS - 1));
    assert_eq!(pings(&mut pair.client), [], "one has just left");
    pair.client.on_datagram(&stamp, soon);
    assert_eq!(pings(&mut pair.client), [soon]);
    (0..10_000).for_each(|i| pair.client.on_datagram(&stamp, soon.plus_ns(i * 10_000)));
    let sent = pings(&mut pair.client).len();
    assert!(sent <= 25, "{sent} in 100 ms");
}

#[test]
fn however_many_answers_come_the_clock_is_fitted_once_a_turn() {
    let mut pair = Pair::connected();
    let ping = |pair: &mut Pair, i: i64| pair.client.on_tick(NOW.plus_ns(i * PING_NS));
    (0..4).for_each(|i| ping(&mut pair, i));
    let sent: Vec<_> = pair.client.outstanding.iter().copied().collect();
    let far = NOW.plus_ns(4 * PING_NS);
    let seen: Vec<_> = sent
        .iter()
        .zip([9_000_000, 2_000_000, 1_000_000, 3_000_000])
        .map(|(client_send, off_ns)| {
            let server = ServerTime(client_send.0 + off_ns);
            let (server_receive, server_send, client_send) = (server, server, *client_send);
            let pong = ServerDatagram::ClockPong { client_send, server_receive, server_send };
            pair.client.on_datagram(&pong.encode(), client_send.plus_ns(10_000_000));
            pair.client.clock().server_time(far)
        })
        .collect();
    assert!(seen.iter().all(|time| *time == seen[0]), "only the first counts at once: {seen:?}");
    ping(&mut pair, 4);
    assert_ne!(pair.client.clock().server_time(far.plus_ns(1_000_000_000)), seen[0]);
    assert!(pair.client.clock().server_time(far) < seen[0].map(|t| t.plus_ns(1)));
}

#[test]
fn pings_without_answers_are_remembered_up_to_a_bound() {
    let mut pair = Pair::new();
    // A client is patient until it is welcomed.
    (0..10_000).for_each(|i| pair.client.on_tick(NOW.plus_ns(i * PING_NS)));
    assert_eq!(pair.client.outstanding.len(), MAX_OUTSTANDING_PINGS);
}

#[test]
fn a_missing_delta_cannot_fill_the_clients_memory() {
    let mut pair = Pair::connected();
    (0..=MAX_QUEUED_STREAMS + 1).for_each(|_| pair.send_delta());
    pair.carry(ServerTime(0));
    pair.streams[1..].iter().for_each(|stream| pair.client.on_stream(stream));
    assert_failed(&mut pair, "above the limit of 128");

    let mut waiting = Waiting::default();
    assert!(waiting.admit(MAX_DELTA_BYTES).is_ok() && waiting.admit(MAX_DELTA_BYTES).is_ok());
    assert!(waiting.admit(1).is_err());
}

#[test]
fn a_codec_that_was_not_announced_ends_the_session() {
    let mut pair = Pair::new();
    let welcome = Welcome { codec: Codec::Raw, ..crate::testing::welcome() };
    pair.client.on_control(&ServerMessage::Welcome(welcome).encode());
    assert_failed(&mut pair, "was not announced");
}

#[test]
fn more_memory_of_motion_than_was_announced_ends_the_session() {
    let welcomed = |motion| {
        let mut pair = Pair::new();
        let welcome = Welcome { motion, ..crate::testing::welcome() };
        pair.client.on_control(&ServerMessage::Welcome(welcome).encode());
        pair
    };
    let announced = hello().capabilities.motion;
    assert!(welcomed(announced).client.is_alive());
    let longer = MotionMemory { sample_ring: 64, ..announced };
    assert_failed(&mut welcomed(longer), "sample_ring: 32 } was announced");
    let larger = MotionMemory { arena_words: announced.arena_words + 1, ..announced };
    assert_failed(&mut welcomed(larger), "the memory of motion of a welcome");
}

#[test]
fn showing_a_frame_that_was_never_sent_ends_the_session() {
    let mut pair = Pair::connected();
    pair.client.send_displayed(displayed(0));
    pair.carry(ServerTime(0));
    let event = pair.server.poll_event();
    assert!(matches!(event, Some(ServerEvent::Failed(_))), "{event:?}");
}

#[test]
fn nothing_is_taken_in_after_the_end() {
    let mut pair = Pair::connected();
    pair.server.goodbye();
    pair.carry(ServerTime(0));
    assert_eq!(pair.client_events(), [ClientEvent::Goodbye]);
    pair.client.on_control(b"anything");
    pair.client.on_stream(b"anything");
    pair.client.on_tick(NOW);
    assert_eq!((pair.client.poll_event(), pair.client.poll_out()), (None, None));
}

#[test]
fn what_a_client_says_faster_than_it_is_heard_coalesces() {
    let mut pair = Pair::connected();
    (0..3).for_each(|_| pair.send_delta());
    for round in 0..10_000 {
        let frame = displayed(u32::min(round, 2)).update;
        pair.client.send_displayed(Displayed { update: frame, display_frames: 1, ..displayed(0) });
        pair.client.request_refresh(None);
        pair.client.steer(Steer::GoOn);
        pair.client.steer(Steer::Step);
        pair.client.send_pose(head(round));
        pair.client.on_tick(NOW.plus_ns(i64::from(round) * PING_NS));
        while let Some(out) = pair.client.poll_out() {
            match out {
                Out::Control(message) => pair.server.on_control(&message),
                Out::Datagram(bytes) => pair.server.on_datagram(&bytes, ServerTime(0)),
                Out::Stream { .. } => panic!("a client sends no streams"),
            }
        }
    }
    assert!(pair.server.pings.len() <= MAX_WAITING_PINGS && pair.server.control.is_empty());
    assert!(pair.server.understood() > 3 * 10_000);
    let events: Vec<_> = std::iter::from_fn(|| pair.server.poll_event()).collect();
    let [
        ServerEvent::Displayed(shown),
        ServerEvent::RefreshRequest { .. },
        ServerEvent::Steer(steering),
        ServerEvent::Head(pose),
    ] = events[..]
    else {
        panic!("{events:?}")
    };
    assert_eq!((shown.update, shown.display_frames, pose.sequence), (UpdateId(2), 10_000, 9_999));
    assert_eq!(steering, Steering::from(Steer::GoOn).then(Steer::Step.into()));
}

#[test]
fn updates_go_in_order_delta_before_picture() {
    let order: Vec<i32> = [(0, 1), (0, 0), (1, 1), (1, 0), (9, 1), (u32::MAX - 1, 0)]
        .map(|(frame, urgency)| priority(UpdateId(frame), urgency))
        .to_vec();
    assert!(order.windows(2).all(|pair| pair[0] > pair[1]), "{order:?}");
    assert!(order[0] < i32::MAX, "control goes before all");
}

#[test]
fn an_oversized_picture_is_an_error() {
    let error = picture_stream(picture(0), &vec![0; MAX_ACCESS_UNIT_BYTES + 1]);
    assert!(matches!(error, Err(WireError::TooMany { .. })));
}

#[test]
fn asking_and_served_clients_can_be_refused() {
    let refused = Refused::new("another client is being served", "try again later");
    for is_served in [false, true] {
        let mut pair = Pair::new();
        pair.carry(ServerTime(0));
        if is_served {
            pair.accept();
            pair.carry(ServerTime(0));
            assert!(matches!(pair.client.poll_event(), Some(ClientEvent::Welcome(_))));
        }
        pair.server.refuse(refused.clone());
        pair.carry(ServerTime(0));
        assert_eq!(pair.client_events(), [ClientEvent::Refused(refused.clone())]);
        assert!(!pair.server.is_alive());
    }
}

#[test]
fn a_hello_that_cannot_be_served_is_refused_with_its_fault() {
    let mut bad = hello();
    bad.capabilities.eye_extent_pixels = [8192, 8192];
    let mut pair = Pair { client: ClientSession::start(bad, NOW), ..Pair::new() };
    pair.carry(ServerTime(0));
    let events = pair.client_events();
    let [ClientEvent::Refused(refused)] = &events[..] else { panic!("{events:?}") };
    assert!(refused.reason.contains("number of pixels"), "{refused:?}");
    assert!(matches!(pair.server.poll_event(), Some(ServerEvent::Refused(_))));
}

#[test]
fn damaged_traffic_ends_sessions_and_nothing_worse() {
    let mut pair = Pair::new();
    let Some(Out::Control(greeting)) = pair.client.poll_out() else { panic!("no hello") };
    damaged(&greeting, 1, 3000, |bytes| ServerSession::new(offer()).on_control(bytes));
    pair.server.on_control(&greeting);
    pair.accept();
    let Some(Out::Control(welcome)) = pair.server.poll_out(ServerTime(0)) else { panic!("no welcome") };
    damaged(&welcome, 2, 1000, |bytes| ClientSession::start(hello(), NOW).on_control(bytes));
    pair.client.on_control(&welcome);
    let Some(Out::Control(padding)) = pair.server.poll_out(ServerTime(0)) else { panic!("no padding") };
    pair.client.on_control(&padding);
    let ping = ClientDatagram::ClockPing { client_send: NOW }.encode();
    damaged(&ping, 3, 1000, |bytes| pair.server.on_datagram(bytes, ServerTime(0)));
    pair.server.on_datagram(&ping, ServerTime(0));
    while let Some(out) = pair.server.poll_out(ServerTime(0)) {
        let Out::Datagram(pong) = out else { panic!("only pongs") };
        damaged(&pong, 4, 10, |bytes| pair.client.on_datagram(bytes, NOW));
    }
    assert!(pair.client.is_alive() && pair.server.is_alive(), "a damaged datagram is only dropped");
}

const OFFER: ClientPairing = ClientPairing::Offer { element: [1; 32] };
const PROOF: ClientPairing = ClientPairing::Proof { proof: [4; 32] };

/// A client that the server wants to be paired first.
fn stranger() -> Pair {
    let mut pair = Pair::new();
    pair.carry(ServerTime(0));
    assert!(matches!(pair.server.poll_event(), Some(ServerEvent::Asked { .. })));
    pair.server.ask_to_pair(60_000);
    pair.carry(ServerTime(0));
    assert_eq!(pair.client_events(), [ClientEvent::PairingNeeded { patience_ms: 60_000 }]);
    pair
}

/// The steps up to the server's answer.
fn answered() -> Pair {
    let mut pair = stranger();
    pair.client.pair(OFFER);
    pair.carry(ServerTime(0));
    assert_eq!(pair.server.poll_event(), Some(ServerEvent::Pairing(OFFER)));
    pair.server.answer_pairing([2; 32], [3; 32]);
    pair.carry(ServerTime(0));
    let answer = ClientEvent::PairingAnswer { element: [2; 32], proof: [3; 32] };
    assert_eq!(pair.client_events(), [answer]);
    pair
}

#[test]
fn a_paired_client_is_welcomed_and_pinged_as_any_other() {
    let mut pair = answered();
    pair.client.pair(PROOF);
    pair.carry(ServerTime(0));
    assert_eq!(pair.server.poll_event(), Some(ServerEvent::Pairing(PROOF)));
    pair.sender = pair.server.accept();
    pair.carry(ServerTime(0));
    assert!(matches!(pair.client_events()[..], [ClientEvent::Welcome(_)]));
    pair.send_delta();
    pair.client.note_alive(NOW.plus_ns(60_000_000_000));
    pair.client.on_tick(NOW.plus_ns(60_000_000_000));
    assert_eq!(pair.client_events(), [], "a minute of pairing is no silence");
    assert!(pair.client.poll_out().is_some(), "it pings");
}

#[test]
fn a_client_that_is_being_paired_asks_for_nothing_else() {
    let mut pair = stranger();
    for second in 1..60 {
        pair.client.on_tick(NOW.plus_ns(second * 1_000_000_000));
    }
    pair.client.send_pose(head(0));
    assert_eq!(pair.client.poll_out(), None);
    assert!(pair.client.is_alive());
}

#[test]
fn steps_of_pairing_that_come_out_of_turn_end_the_session() {
    let of_client = |step| ClientMessage::Pairing(step).encode();
    let is_failed = |mut server: ServerSession, messages: &[Vec<u8>]| {
        messages.iter().for_each(|message| server.on_control(message));
        std::iter::from_fn(|| server.poll_event()).any(|event| matches!(event, ServerEvent::Failed(_)))
    };
    let displayed = ClientMessage::Displayed(Displayed::default()).encode();
    let steer = ClientMessage::Steer(Steer::Halt).encode();
    for early in [of_client(PROOF), of_client(ClientPairing::WrongCode), displayed, steer] {
        assert!(is_failed(stranger().server, &[early]));
    }
    assert!(is_failed(stranger().server, &[of_client(OFFER), of_client(OFFER)]));
    assert!(is_failed(stranger().server, &[of_client(OFFER), of_client(PROOF)]), "no code was typed");
    assert!(is_failed(answered().server, &[of_client(PROOF), of_client(PROOF)]));
    assert!(is_failed(Pair::connected().server, &[of_client(OFFER)]), "nobody has asked");
}

#[test]
fn a_server_cannot_leave_out_the_pairing_that_it_has_asked_for() {
    let welcome = ServerMessage::Welcome(crate::testing::welcome()).encode();
    for mut pair in [stranger(), answered()] {
        pair.client.on_control(&welcome);
        assert_failed(&mut pair, "before the pairing is over");
    }
    let answer = ServerPairing::Answer { element: [0; 32], proof: [0; 32] };
    let mut pair = stranger();
    pair.client.on_control(&ServerMessage::Pairing(answer).encode());
    assert_failed(&mut pair, "out of turn");
    let mut pair = Pair::connected();
    pair.client.on_control(&ServerMessage::Pairing(ServerPairing::Needed { patience_ms: 1 }).encode());
    assert_failed(&mut pair, "out of turn");
}

#[test]
fn a_client_says_no_step_of_pairing_out_of_turn() {
    for pair in [&mut Pair::new(), &mut Pair::connected(), &mut stranger()] {
        while pair.client.poll_out().is_some() {}
        pair.client.pair(PROOF);
        assert_eq!(pair.client.poll_out(), None);
    }
}

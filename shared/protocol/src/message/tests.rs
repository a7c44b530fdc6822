use super::*;
use crate::pose::Fov;
use crate::testing::{Dice, damaged, displayed, head, hello, offer, welcome};

fn client_messages() -> Vec<ClientMessage> {
    vec![
        ClientMessage::Hello(hello()),
        ClientMessage::Displayed(displayed(300)),
        ClientMessage::RefreshRequest { after: None },
        ClientMessage::RefreshRequest { after: Some(UpdateId(u32::MAX)) },
        ClientMessage::Goodbye,
        ClientMessage::Pairing(ClientPairing::Offer { element: [7; 32] }),
        ClientMessage::Pairing(ClientPairing::WrongCode),
    ]
}

fn server_messages() -> Vec<ServerMessage> {
    let refused = Refused::new("the scene has gone", "choose another");
    vec![
        ServerMessage::Welcome(welcome()),
        ServerMessage::Refused(refused),
        ServerMessage::Goodbye,
        ServerMessage::Pairing(ServerPairing::Needed { patience_ms: 60_000 }),
        ServerMessage::Pairing(ServerPairing::Answer { element: [7; 32], proof: [200; 32] }),
        ServerMessage::Padding(vec![0; 3]),
    ]
}

fn client_datagrams() -> Vec<ClientDatagram> {
    vec![
        ClientDatagram::Pose(head(u32::MAX)),
        ClientDatagram::ClockPing { client_send: ClientTime(i64::MIN) },
    ]
}

fn pong() -> ServerDatagram {
    ServerDatagram::ClockPong {
        client_send: ClientTime(i64::MAX),
        server_receive: ServerTime(-1),
        server_send: ServerTime(1 << 40),
    }
}

#[test]
fn every_message_comes_back() {
    client_messages().iter().for_each(|m| assert_eq!(ClientMessage::decode(&m.encode()).as_ref(), Ok(m)));
    server_messages().iter().for_each(|m| assert_eq!(ServerMessage::decode(&m.encode()).as_ref(), Ok(m)));
    client_datagrams().iter().for_each(|m| assert_eq!(ClientDatagram::decode(&m.encode()).as_ref(), Ok(m)));
    let stamp = ServerDatagram::ClockStamp { server_send: ServerTime(i64::MIN) };
    [pong(), stamp].iter().for_each(|m| assert_eq!(ServerDatagram::decode(&m.encode()).as_ref(), Ok(m)));
}

#[test]
fn datagrams_fit_every_path() {
    for datagram in client_datagrams() {
        assert!(datagram.encode().len() <= MAX_DATAGRAM_BYTES, "{datagram:?}");
    }
}

/// Damaged bytes that still are a message are a valid one: it can be sent on and comes back.
#[test]
fn damaged_messages_give_valid_messages_or_errors() {
    for message in client_messages() {
        damaged(&message.encode(), 1, 5000, |bytes| {
            if let Ok(message) = ClientMessage::decode(bytes) {
                assert!(ClientMessage::decode(&message.encode()).is_ok(), "{message:?}");
            }
            ClientMessage::peek_versions(bytes);
        });
    }
    for message in server_messages() {
        damaged(&message.encode(), 2, 5000, |bytes| {
            if let Ok(message) = ServerMessage::decode(bytes) {
                assert!(ServerMessage::decode(&message.encode()).is_ok(), "{message:?}");
            }
        });
    }
    for datagram in client_datagrams() {
        damaged(&datagram.encode(), 3, 5000, |bytes| {
            if let Ok(datagram) = ClientDatagram::decode(bytes) {
                assert!(ClientDatagram::decode(&datagram.encode()).is_ok(), "{datagram:?}");
            }
        });
    }
    damaged(&pong().encode(), 4, 5000, |bytes| drop(ServerDatagram::decode(bytes).map(|pong| pong.encode())));
}

#[test]
fn no_prefix_and_no_extension_of_a_message_is_one() {
    for bytes in client_messages().iter().map(ClientMessage::encode) {
        (0..bytes.len()).for_each(|length| assert!(ClientMessage::decode(&bytes[..length]).is_err()));
        let error = ClientMessage::decode(&[bytes, vec![0]].concat()).unwrap_err();
        assert_eq!(error, WireError::Trailing { what: "a client's message", left: 1 });
    }
}

#[track_caller]
fn assert_pose_refused(change: impl Fn(&mut HeadState), words: &str) {
    let mut state = head(0);
    change(&mut state);
    let error = ClientDatagram::decode(&ClientDatagram::Pose(state).encode()).unwrap_err().to_string();
    assert!(error.contains(words), "{error}");
}

#[test]
fn heads_that_cannot_be_are_refused() {
    assert_pose_refused(|head| head.world_from_head.position.y = f32::NAN, "a head's pose");
    assert_pose_refused(|head| head.world_from_head.position.y = 2e6, "a head's pose");
    assert_pose_refused(|head| head.world_from_head.orientation.w = 0.0, "a head's pose");
    assert_pose_refused(|head| head.linear_velocity.x = f32::INFINITY, "a head's velocity");
    assert_pose_refused(|head| head.angular_velocity.x = 1e5, "a head's velocity");
    assert_pose_refused(|head| head.eyes[1].fov.left = 1.0, "an eye's field of view");
    assert_pose_refused(|head| head.eyes[0].fov.up = f32::NAN, "an eye's field of view");
    assert_pose_refused(|head| head.eyes[0].head_from_eye.position.z = f32::NAN, "an eye's pose");
}

#[track_caller]
fn assert_hello_refused(change: impl Fn(&mut ClientHello), words: &str) {
    let mut hello = hello();
    change(&mut hello);
    let error = ClientMessage::decode(&ClientMessage::Hello(hello).encode()).unwrap_err().to_string();
    assert!(error.contains(words), "{error}");
}

/// Lengths that a ring of samples cannot have.
const NO_RINGS: [u32; 8] = [0, 1, 4, 7, 24, 128, 1000, u32::MAX];

#[test]
fn hellos_that_cannot_be_are_refused() {
    assert_hello_refused(|hello| hello.min_protocol_version = 2, "protocol versions");
    assert_hello_refused(|hello| hello.app_version = "x".repeat(MAX_TEXT_BYTES + 1), "program version");
    assert_hello_refused(|hello| hello.capabilities.codecs = vec![Codec::H264; MAX_CODECS + 1], "codecs");
    assert_hello_refused(|hello| hello.capabilities.max_vertex_slots = 0, "vertex slots");
    assert_hello_refused(|hello| hello.capabilities.max_patch_slots = MAX_PATCH_SLOTS + 1, "patch slots");
    assert_hello_refused(|hello| hello.capabilities.max_triangles = 0, "triangles");
    assert_hello_refused(|hello| hello.capabilities.max_triangles = MAX_TRIANGLES + 1, "triangles");
    assert_hello_refused(|hello| hello.capabilities.eye_extent_pixels[1] = 0, "extent in pixels");
    assert_hello_refused(|hello| hello.capabilities.eye_extent_pixels = [8192, 8192], "number of pixels");
    assert_hello_refused(|hello| hello.capabilities.display_period_ns = 0, "display period");
    for period_ns in [i64::MIN, 0, 13_888_888, i64::MAX] {
        assert!(check_period("a period", sayable_period_ns(period_ns)).is_ok(), "{period_ns}");
    }
    assert_eq!(sayable_period_ns(13_888_888), 13_888_888);
    for ring in NO_RINGS {
        let name = format!(
            "the ring of samples of a client is not valid: {ring} is not a power of two within 8..=64"
        );
        assert_hello_refused(|hello| hello.capabilities.motion.sample_ring = ring, &name);
    }
}

#[test]
fn views_that_no_pipeline_can_be_made_for_are_refused() {
    let fov = |left, right, up, down| Fov { left, right, up, down };
    let tiny = f32::MIN_POSITIVE / 2.0;
    let bad = [
        fov(-tiny, tiny, tiny, -tiny),
        fov(-0.0005, 0.0005, 0.0005, -0.0005),
        fov(1.1, 1.56, 0.5, -0.5),
        fov(-1.56, 0.5, 0.5, -0.5),
        fov(-0.5, 0.5, 1.56, 1.1),
        fov(-0.5, 0.5, -1.1, -1.56),
        fov(1.5, 1.52, 0.5, -0.5),
        fov(-0.5, 0.5, 1e-3, 0.0),
        fov(0.5, -0.5, 0.5, -0.5),
        fov(-0.5, 0.5, -0.5, 0.5),
        fov(f32::NEG_INFINITY, 0.5, 0.5, -0.5),
    ];
    for fov in bad {
        assert_hello_refused(|hello| hello.capabilities.eyes[1].fov = fov, "an eye's field of view");
    }
    for fov in [fov(-0.02, 0.02, 0.02, -0.02), fov(1.1, 1.5, 0.5, -0.5), fov(-1.55, 1.55, 1.55, -1.55)] {
        let mut good = hello();
        good.capabilities.eyes = good.capabilities.eyes.map(|eye| Eye { fov, ..eye });
        assert_eq!(good.check(), Ok(()), "{fov:?}");
    }
}

#[test]
fn display_reports_merge_into_the_later_with_summed_counts() {
    let (early, late) = (displayed(3), Displayed { display_time: ServerTime(9), ..displayed(4) });
    let both = Displayed {
        update: UpdateId(4),
        display_time: ServerTime(9),
        display_frames: 144,
        frames_without_bundle: 2,
        frozen_vertices: 400,
        withheld_patches: 6,
        ..late
    };
    assert_eq!((early.merged(late), late.merged(early)), (both, both));
}

#[test]
fn a_secret_is_not_logged() {
    assert_eq!(format!("{:?}", ResumeSecret([7; 16])), "ResumeSecret(..)");
}

#[track_caller]
fn assert_welcome_refused(change: impl Fn(&mut Welcome), words: &str) {
    let mut welcome = welcome();
    change(&mut welcome);
    let error = ServerMessage::decode(&ServerMessage::Welcome(welcome).encode()).unwrap_err().to_string();
    assert!(error.contains(words), "{error}");
}

#[test]
fn welcomes_that_cannot_be_are_refused() {
    assert_welcome_refused(|welcome| welcome.grid.spacing_ns = 0, "grid");
    assert_welcome_refused(|welcome| welcome.update_period_ns = i64::MAX, "update period");
    assert_welcome_refused(|welcome| welcome.vertex_slots = MAX_VERTEX_SLOTS + 1, "vertex slots");
    let many = |welcome: &mut Welcome| {
        (welcome.vertex_slots, welcome.motion.sample_ring) = (MAX_VERTEX_SLOTS, MAX_SAMPLE_RING);
    };
    assert_welcome_refused(many, "samples of a session");
    assert_welcome_refused(|welcome| welcome.environment.nadir[2] = -1.0, "environment");
    assert_welcome_refused(|welcome| welcome.world_from_stage.position.x = f32::NAN, "stage");
    for ring in NO_RINGS {
        let name = format!(
            "the ring of samples of a client is not valid: {ring} is not a power of two within 8..=64"
        );
        assert_welcome_refused(|welcome| welcome.motion.sample_ring = ring, &name);
    }
}

/// A server of another make may say it all the same: its bytes are not a welcome.
#[test]
fn a_welcome_with_an_atlas_that_cannot_be_is_refused() {
    let bytes = ServerMessage::Welcome(welcome()).encode();
    let extent = postcard::to_stdvec(&AtlasExtent::DEFAULT).unwrap();
    let at = bytes.windows(extent.len()).position(|window| window == extent).unwrap();
    for sides in [[1536u32, 1536], [2000, 2048], [2048, 4096]] {
        let sides = postcard::to_stdvec(&sides).unwrap();
        let forged = [&bytes[..at], &sides, &bytes[at + extent.len()..]].concat();
        let error = ServerMessage::decode(&forged).unwrap_err().to_string();
        assert!(error.contains("outside its range"), "{error}");
    }
}

#[test]
fn negotiation_takes_the_smaller_of_both_capacities() {
    let welcome = welcome();
    assert_eq!((welcome.vertex_slots, welcome.patch_slots), (600, 300));
    assert_eq!(welcome.atlas_extent_texels, AtlasExtent::DEFAULT);
    let mut small = hello();
    small.capabilities.max_atlas_extent = [4096, 1500];
    assert_eq!(negotiate(&small, &offer()).unwrap().atlas_extent_texels.texels(), [2048, 1024]);
    small.capabilities.max_atlas_extent = [256, 256];
    assert!(negotiate(&small, &offer()).unwrap_err().reason.contains("256x256"));
    small = hello();
    small.capabilities.codecs = vec![Codec::Raw];
    assert!(negotiate(&small, &offer()).is_err(), "a server that was not asked to offers it not");
    let raw = ServerOffer { codecs: vec![Codec::Raw, Codec::H264], ..offer() };
    assert_eq!(negotiate(&small, &raw).unwrap().codec, Codec::Raw);
    small.capabilities.codecs.clear();
    assert!(negotiate(&small, &offer()).unwrap_err().remedy.contains("codec"));
}

#[test]
fn many_vertices_and_a_long_ring_are_not_had_together() {
    let mut hello = hello();
    hello.capabilities.max_vertex_slots = MAX_VERTEX_SLOTS;
    let agreed = |hello: &ClientHello, ring| {
        let motion = MotionMemory { sample_ring: ring, ..MotionMemory::MAX };
        let offer = ServerOffer { vertex_slots: MAX_VERTEX_SLOTS, motion, unsampled: None, ..offer() };
        let welcome = negotiate(hello, &offer).unwrap();
        assert_eq!(welcome.check(), Ok(()));
        welcome.vertex_slots
    };
    hello.capabilities.motion = MotionMemory::MAX;
    for ring in [MIN_SAMPLE_RING, DEFAULT_SAMPLE_RING] {
        assert_eq!(agreed(&hello, ring), MAX_SAMPLED_SLOTS, "samples of all fit into one delta");
    }
    assert_eq!(agreed(&hello, MAX_SAMPLE_RING), MAX_SAMPLED_SLOTS / 2);
    let unsampled = ServerOffer {
        vertex_slots: MAX_VERTEX_SLOTS,
        motion: MotionMemory::MAX,
        unsampled: Some(MotionMemory::LEAST),
        ..offer()
    };
    let welcome = negotiate(&hello, &unsampled).unwrap();
    assert_eq!((welcome.vertex_slots, welcome.check()), (MAX_VERTEX_SLOTS, Ok(())));
    hello.capabilities.max_vertex_slots = 150_000;
    assert_eq!(agreed(&hello, DEFAULT_SAMPLE_RING), 150_000, "as many as it asked for");
}

/// Whatever both may say, the ring is one that both can keep, and the shortest where nothing is sampled.
#[test]
fn the_ring_has_the_needed_size_within_the_clients() {
    let mut dice = Dice::new(7);
    let [mut least, mut sampled] = [0; 2];
    for _ in 0..2000 {
        let mut memory = || MotionMemory {
            arena_words: dice.below(4) as u32,
            rest_vertices: dice.below(4) as u32,
            pose_places: dice.below(4) as u32,
            sample_ring: 8 << dice.below(4),
        };
        let [capable, motion, unsampled] = [memory(), memory(), memory()];
        let unsampled = MotionMemory { sample_ring: MIN_SAMPLE_RING, ..unsampled };
        let unsampled = Some(unsampled).filter(|_| !dice.once_in(4));
        let mut hello = hello();
        hello.capabilities.motion = capable;
        let agreed = negotiate(&hello, &ServerOffer { motion, unsampled, ..offer() }).unwrap();
        assert_eq!(agreed.check(), Ok(()));
        assert!(capable.holds(agreed.motion) && motion.holds(agreed.motion));
        let both = capable.min(motion);
        let is_enough = |least: MotionMemory| both.holds(least);
        let expected = if unsampled.is_some_and(is_enough) { 8 } else { both.sample_ring };
        *(if expected == 8 { &mut least } else { &mut sampled }) += 1;
        assert_eq!(agreed.motion, MotionMemory { sample_ring: expected, ..both });
    }
    assert!(least > 100 && sampled > 100, "{least} and {sampled}");
}

#[test]
fn overlapping_versions_agree_on_the_newest() {
    let offer = ServerOffer { protocol_version: 5, min_protocol_version: 3, ..offer() };
    let negotiated = |newest, oldest| negotiate_version(newest, oldest, "0.9", &offer);
    assert_eq!(negotiated(4, 1), Ok(4));
    assert_eq!(negotiated(9, 5), Ok(5));
    assert_eq!(negotiated(2, 1).unwrap_err().remedy, "update the client to one that speaks protocol 3");
    assert_eq!(negotiated(7, 6).unwrap_err().remedy, "update the server to one that speaks protocol 6");
    let reason = negotiated(2, 1).unwrap_err().reason;
    assert_eq!(reason, "the client (0.9) speaks protocol 1 to 2, the server (0.1.0) speaks protocol 3 to 5");
}

#[test]
fn a_later_hello_may_say_more_and_still_be_understood() {
    let later = ClientHello { protocol_version: PROTOCOL_VERSION + 1, ..hello() };
    let bytes = [ClientMessage::Hello(later.clone()).encode(), b"fields of the future".to_vec()].concat();
    assert_eq!(ClientMessage::decode(&bytes), Ok(ClientMessage::Hello(later)));
    let versions = ClientMessage::peek_versions(&bytes[..12]).unwrap();
    assert_eq!(versions.protocol_version, PROTOCOL_VERSION + 1);
}

#[test]
fn a_refusal_is_cut_to_what_is_shown() {
    let refused = Refused::new(&"ä".repeat(MAX_TEXT_BYTES), "");
    assert!(refused.reason.len() <= MAX_TEXT_BYTES && refused.reason.ends_with('…'), "{}", refused.reason);
    let message = ServerMessage::Refused(refused);
    assert_eq!(ServerMessage::decode(&message.encode()), Ok(message));
}

/// What a stranger wrote is harmless as soon as it has been read.
#[test]
fn texts_of_peers_come_in_printable() {
    let raw = "\x1b]0;owned\x07\r\n\u{202e}".to_owned();
    let refused = Refused { reason: raw.clone(), remedy: raw.clone() };
    let refused = ServerMessage::decode(&ServerMessage::Refused(refused).encode()).unwrap();
    let ServerMessage::Refused(refused) = refused else { panic!("{refused:?}") };
    let hello = ClientMessage::Hello(ClientHello { app_version: raw.clone(), ..hello() }).encode();
    let versions = ClientMessage::peek_versions(&hello).unwrap();
    let ClientMessage::Hello(hello) = ClientMessage::decode(&hello).unwrap() else { panic!("a hello") };
    for text in [refused.reason, refused.remedy, hello.app_version, versions.app_version] {
        assert_eq!(text, printable(&raw));
    }
}

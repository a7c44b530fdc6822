use super::*;
use crate::arrivals::Network;
use crate::event::{Binding, PeerId};
use crate::identity::Fingerprint;

const S: i64 = 1_000_000_000;
const HEADSET: PeerId = PeerId(1);
const OTHER: PeerId = PeerId(2);
const HOME: Network = Network::V4([192, 168, 1]);
const NEXT_DOOR: Network = Network::V4([192, 168, 2]);

fn ends() -> Ends {
    Ends { client: Fingerprint([1; 32]), server: Fingerprint([2; 32]), binding: Binding([3; 32]) }
}

fn random(byte: u8) -> [u8; 64] {
    [byte; 64]
}

/// Another code than this one.
fn other(code: Code) -> Code {
    let digits: u32 = code.digits().parse().unwrap();
    format!("{:06}", (digits + 1) % 1_000_000).parse().unwrap()
}

/// A code is shown by `panel`, whose end sees `client_ends`, and offered to `desk`, whose end sees `server_ends`.
fn shown(panel: &mut Panel, desk: &mut Desk, [client_ends, server_ends]: [Ends; 2], now_ns: i64) -> Code {
    desk.begin(HEADSET, HOME, server_ends, now_ns).expect("its turn");
    let (code, element) = panel.begin(client_ends, &random(7), now_ns).expect("open");
    desk.offered(HEADSET, element).expect("asked");
    code
}

#[track_caller]
fn typed(desk: &mut Desk, code: Code, now_ns: i64) -> Answer {
    let (peer, answer) = desk.typed(code, &random(8), now_ns).expect("somebody waits");
    assert_eq!(peer, HEADSET);
    answer.expect("the element is one")
}

/// One code too many.
fn fail(desk: &mut Desk, now_ns: i64) {
    let mut panel = Panel::new();
    let code = shown(&mut panel, desk, [ends(); 2], now_ns);
    let answer = typed(desk, other(code), now_ns);
    assert_eq!(panel.answered(&answer, now_ns), Err(AnswerError::Wrong(WrongCode)));
    desk.denied(HEADSET, now_ns).expect("its turn");
}

#[test]
fn the_typed_code_pairs_both_sides() {
    let (mut panel, mut desk) = (Panel::new(), Desk::new());
    let code = shown(&mut panel, &mut desk, [ends(); 2], 0);
    let answer = typed(&mut desk, code.to_string().parse().unwrap(), S);
    let proof = panel.answered(&answer, S).expect("the server has the code");
    assert_eq!(desk.proved(HEADSET, &proof, S), Ok(Judgement::Paired(ends().client)));
    assert_eq!(desk.turn(), None);
}

#[test]
fn a_wrong_code_is_known_on_both_sides_and_used_up() {
    let (mut panel, mut desk) = (Panel::new(), Desk::new());
    let code = shown(&mut panel, &mut desk, [ends(); 2], 0);
    let answer = typed(&mut desk, other(code), S);
    assert_eq!(desk.typed(code, &random(8), S).unwrap_err(), TypingError::Typed, "one guess a code");
    assert_eq!(panel.answered(&answer, S), Err(AnswerError::Wrong(WrongCode)));
    assert_eq!(panel.answered(&answer, S), Err(AnswerError::Unasked), "the code is gone");
    assert_eq!(desk.denied(HEADSET, S), Ok(()));
    assert_eq!(desk.typed(code, &random(8), S).unwrap_err(), TypingError::Nobody);
}

#[test]
fn a_client_that_does_not_have_the_code_proves_nothing() {
    let (mut panel, mut desk) = (Panel::new(), Desk::new());
    let code = shown(&mut panel, &mut desk, [ends(); 2], 0);
    let answer = typed(&mut desk, code, S);
    for byte in [0, 32, 255] {
        let mut desk = Desk::new();
        let code = shown(&mut Panel::new(), &mut desk, [ends(); 2], 0);
        typed(&mut desk, code, S);
        assert_eq!(desk.proved(HEADSET, &[byte; 32], S), Ok(Judgement::Wrong(WrongCode)));
    }
    // The server's own proof is none of the client's.
    assert_eq!(desk.proved(HEADSET, &answer.proof, S), Ok(Judgement::Wrong(WrongCode)));
}

#[test]
fn somebody_between_the_ends_has_two_exporters_and_pairs_with_neither() {
    let between = Ends { binding: Binding([4; 32]), ..ends() };
    let (mut panel, mut desk) = (Panel::new(), Desk::new());
    let code = shown(&mut panel, &mut desk, [ends(), between], 0);
    let answer = typed(&mut desk, code, S);
    assert_eq!(panel.answered(&answer, S), Err(AnswerError::Wrong(WrongCode)));
}

#[test]
fn a_key_that_is_not_the_ends_own_pairs_with_nobody() {
    let impostors =
        [Ends { client: Fingerprint([9; 32]), ..ends() }, Ends { server: Fingerprint([9; 32]), ..ends() }];
    for impostor in impostors {
        let (mut panel, mut desk) = (Panel::new(), Desk::new());
        let code = shown(&mut panel, &mut desk, [ends(), impostor], 0);
        let answer = typed(&mut desk, code, S);
        assert!(panel.answered(&answer, S).is_err(), "{impostor:?}");
    }
}

#[test]
fn what_was_recorded_pairs_nobody_again() {
    let (mut panel, mut desk) = (Panel::new(), Desk::new());
    let code = shown(&mut panel, &mut desk, [ends(); 2], 0);
    let answer = typed(&mut desk, code, S);
    let proof = panel.answered(&answer, S).expect("right");
    desk.proved(HEADSET, &proof, S).expect("its turn");
    assert_eq!(desk.proved(HEADSET, &proof, S), Err(Unasked), "a proof serves once");
    // The same code once more, and the same random bytes at the client; the server's are new.
    let again = shown(&mut panel, &mut desk, [ends(); 2], 2 * S);
    assert_eq!(again, code);
    let (_, fresh) = desk.typed(again, &random(9), 2 * S).expect("somebody waits");
    assert_ne!(fresh, Ok(answer));
    assert_eq!(desk.proved(HEADSET, &proof, 2 * S), Ok(Judgement::Wrong(WrongCode)));
    // And the recorded answer on a new connection.
    let later = Ends { binding: Binding([5; 32]), ..ends() };
    panel.begin(later, &random(7), 3 * S).expect("open");
    assert_eq!(panel.answered(&answer, 3 * S), Err(AnswerError::Wrong(WrongCode)));
}

#[test]
fn steps_out_of_turn_lead_nowhere() {
    let mut desk = Desk::new();
    assert_eq!(desk.offered(HEADSET, [0; 32]), Err(Unasked));
    desk.begin(HEADSET, HOME, ends(), 0).expect("its turn");
    let code = "000000".parse().unwrap();
    assert_eq!(desk.typed(code, &random(1), 0).unwrap_err(), TypingError::Nobody, "nothing is shown yet");
    assert_eq!(desk.proved(HEADSET, &[0; 32], 0), Err(Unasked), "no proof without a code");
    assert_eq!(desk.denied(HEADSET, 0), Err(Unasked));
    assert_eq!(desk.offered(OTHER, [0; 32]), Err(Unasked), "whose turn it is not");
    let (_, element) = Panel::new().begin(ends(), &random(7), 0).unwrap();
    desk.offered(HEADSET, element).expect("asked");
    assert_eq!(desk.offered(HEADSET, element), Err(Unasked), "once");
    typed(&mut desk, code, 0);
    assert_eq!(desk.proved(OTHER, &[0; 32], 0), Err(Unasked));
    assert_eq!(desk.turn(), Some(HEADSET), "it is still its turn");
}

#[test]
fn three_failures_close_pairing_at_the_server() {
    let mut desk = Desk::new();
    (0..3).for_each(|_| fail(&mut desk, 0));
    let closed = Closed { wait_s: 60, failures: 3 };
    assert_eq!(desk.begin(HEADSET, HOME, ends(), 0), Err(TurnedAway::Closed(closed)));
    assert_eq!(desk.begin(OTHER, NEXT_DOOR, ends(), 60 * S - 1).map_err(TurnedAway::wait_s), Err(1));
    fail(&mut desk, 60 * S);
    assert_eq!(desk.begin(HEADSET, HOME, ends(), 60 * S).map_err(TurnedAway::wait_s), Err(120));
}

#[test]
fn three_failures_close_pairing_at_the_client() {
    let mut panel = Panel::new();
    for guess in 0..3 {
        panel.begin(ends(), &random(guess), 0).expect("open");
        let answer = Answer { element: [guess; 32], proof: [0; 32] };
        assert_eq!(panel.answered(&answer, 0), Err(AnswerError::Wrong(WrongCode)));
    }
    assert_eq!(panel.begin(ends(), &random(4), 0), Err(Closed { wait_s: 60, failures: 3 }));
    assert!(!panel.is_shown());
    assert!(panel.begin(ends(), &random(4), 60 * S).is_ok());
}

#[test]
fn whoever_leaves_after_the_answer_has_guessed() {
    let mut desk = Desk::new();
    for _ in 0..2 {
        let code = shown(&mut Panel::new(), &mut desk, [ends(); 2], 0);
        typed(&mut desk, code, 0);
        desk.gone(HEADSET, 0);
    }
    let code = shown(&mut Panel::new(), &mut desk, [ends(); 2], 0);
    typed(&mut desk, code, 0);
    assert_eq!(desk.overdue(PROOF_NS - 1), None);
    assert_eq!(desk.overdue(PROOF_NS), Some((HEADSET, Overdue::Unproved)));
    assert!(matches!(desk.begin(HEADSET, HOME, ends(), PROOF_NS), Err(TurnedAway::Closed(_))));
}

#[test]
fn a_turn_without_a_code_ends_after_a_minute_and_is_no_failure() {
    let mut desk = Desk::new();
    for turn in 0..9 {
        let now_ns = turn * 2 * PATIENCE_NS;
        shown(&mut Panel::new(), &mut desk, [ends(); 2], now_ns);
        assert_eq!(desk.overdue(now_ns + PATIENCE_NS - 1), None);
        assert_eq!(desk.overdue(now_ns + PATIENCE_NS), Some((HEADSET, Overdue::Untyped)));
    }
    assert_eq!(desk.begin(HEADSET, HOME, ends(), 100 * PATIENCE_NS), Ok(()));
}

#[test]
fn one_device_is_paired_at_a_time_and_others_are_told_when() {
    let mut desk = Desk::new();
    desk.begin(HEADSET, HOME, ends(), 0).expect("its turn");
    let busy = TurnedAway::Busy { wait_s: 51 };
    assert_eq!(desk.begin(OTHER, NEXT_DOOR, ends(), 10 * S), Err(busy));
    desk.gone(OTHER, 10 * S);
    assert_eq!(desk.turn(), Some(HEADSET));
}

#[test]
fn a_network_that_keeps_coming_back_leaves_a_turn_to_others() {
    let mut desk = Desk::new();
    desk.begin(HEADSET, HOME, ends(), 0).expect("its turn");
    assert!(desk.begin(OTHER, NEXT_DOOR, ends(), 59 * S).is_err());
    assert_eq!(desk.overdue(60 * S), Some((HEADSET, Overdue::Untyped)));
    assert!(matches!(desk.begin(HEADSET, HOME, ends(), 60 * S), Err(TurnedAway::Busy { .. })));
    assert_eq!(desk.begin(OTHER, NEXT_DOOR, ends(), 61 * S), Ok(()));
    desk.gone(OTHER, 62 * S);
    assert_eq!(desk.begin(HEADSET, HOME, ends(), 62 * S), Ok(()));
    desk.gone(HEADSET, 63 * S);
    assert_eq!(desk.begin(HEADSET, HOME, ends(), 63 * S), Ok(()), "nobody else has asked");
}

#[test]
fn no_bytes_of_a_stranger_are_more_than_a_wrong_code() {
    for seed in 0..200_u8 {
        let element = crate::rng::bytes32(u64::from(seed), 1);
        let mut panel = Panel::new();
        panel.begin(ends(), &random(seed), 0).expect("open");
        assert!(panel.answered(&Answer { element, proof: element }, 0).is_err());
        let mut desk = Desk::new();
        desk.begin(HEADSET, HOME, ends(), 0).expect("its turn");
        desk.offered(HEADSET, element).expect("asked");
        let (_, answer) = desk.typed("123456".parse().unwrap(), &random(seed), 0).expect("somebody waits");
        if answer.is_ok() {
            assert_eq!(desk.proved(HEADSET, &element, 0), Ok(Judgement::Wrong(WrongCode)));
        }
        assert_eq!(desk.turn(), None);
    }
}

#[test]
fn a_code_reads_back_as_it_is_written_and_in_all_usual_ways() {
    let code: Code = "012345".parse().unwrap();
    assert_eq!(code.to_string(), "012 345");
    for text in ["012 345", "012-345", " 012345\r\n", "0 1 2 3 4 5"] {
        assert_eq!(text.parse(), Ok(code), "{text}");
    }
    for text in ["", "12345", "1234567", "12345a", "+12345", "١٢٣٤٥٦"] {
        assert_eq!(text.parse::<Code>(), Err(CodeError), "{text}");
    }
    assert!(!format!("{code:?}").contains("345"), "no code in a log");
}

#[test]
fn codes_of_random_bytes_are_spread_over_all_of_them() {
    let mut thousands = [0_u32; 1000];
    for n in 0..100_000_u64 {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&crate::rng::bytes32(n, 6)[..8]);
        let digits: usize = Code::from_random(bytes).digits().parse().unwrap();
        thousands[digits / 1000] += 1;
    }
    let (least, most) = (thousands.iter().min(), thousands.iter().max());
    assert!(least > Some(&50) && most < Some(&160), "100 are expected of each: {least:?} to {most:?}");
}

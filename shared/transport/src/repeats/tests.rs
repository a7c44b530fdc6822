use super::*;

const MS: i64 = 1_000_000;
const PACKET_BYTES: usize = 1200;
const TARGET_BYTES_S: Option<f64> = Some(4e6);

fn address(port: u16) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, 2], port))
}

fn packet() -> Transmit {
    Transmit { to: address(1), from_ip: None, bytes: vec![7; PACKET_BYTES], segment_size: None, ecn: None }
}

/// Sends a packet each millisecond until `end_ms` over a path that loses each `lost_of`th; packets and copies that left.
fn play(repeats: &mut Repeats, end_ms: i64, lost_of: u64, target: Option<f64>) -> (u64, u64) {
    let (mut sent, mut copies) = (0, 0);
    for at_ns in (0..end_ms).map(|ms| ms * MS) {
        sent += 1;
        repeats.note(at_ns, address(1), [sent, sent / lost_of]);
        repeats.sent(at_ns, &packet(), target);
        copies += std::iter::from_fn(|| repeats.take_due(at_ns)).count() as u64;
    }
    (sent, copies)
}

#[test]
fn a_path_that_loses_one_in_a_hundred_has_its_packets_twice() {
    let (sent, copies) = play(&mut Repeats::default(), 5000, 100, TARGET_BYTES_S);
    assert!(copies as f64 > 0.9 * sent as f64 && copies as f64 <= 1.1 * sent as f64, "{copies} of {sent}");
}

#[test]
fn a_path_that_loses_one_in_twenty_has_its_packets_three_times_where_there_is_room() {
    let (sent, copies) = play(&mut Repeats::default(), 5000, 20, Some(8e6));
    assert!(copies as f64 > 1.8 * sent as f64 && copies as f64 <= 2.2 * sent as f64, "{copies} of {sent}");
    for target in [3.5e6, 4.0e6] {
        let (sent, copies) = play(&mut Repeats::default(), 5000, 20, Some(target));
        let bytes_s = ((sent + copies) as usize * PACKET_BYTES) as f64 / 5.0;
        assert!(copies as f64 > 0.9 * sent as f64, "{copies} of {sent}");
        assert!(bytes_s <= OF_TARGET * target * 1.05, "{bytes_s} of {target}");
    }
}

#[test]
fn a_path_that_loses_one_in_a_thousand_has_none_twice() {
    assert_eq!(play(&mut Repeats::default(), 5000, 1000, TARGET_BYTES_S).1, 0);
}

#[test]
fn packets_and_copies_take_no_more_than_their_part_of_the_target() {
    for target in [1.0e6, 1.3e6, 1.8e6, 2.2e6] {
        let (sent, copies) = play(&mut Repeats::default(), 5000, 100, Some(target));
        let bytes_s = ((sent + copies) as usize * PACKET_BYTES) as f64 / 5.0;
        let packets_bytes_s = sent as f64 * PACKET_BYTES as f64 / 5.0;
        assert!(bytes_s <= (OF_TARGET * target * 1.05).max(packets_bytes_s), "{bytes_s} of {target}");
    }
    assert_eq!(play(&mut Repeats::default(), 5000, 100, None).1, 0, "no target, no copies");
}

#[test]
fn copies_end_some_seconds_after_the_last_loss() {
    let mut repeats = Repeats::default();
    let mut is_repeated = |at_ms: i64, sent: u64, lost: u64| {
        let at_ns = at_ms * MS;
        repeats.note(at_ns, address(1), [sent, lost]);
        repeats.sent(at_ns, &packet(), TARGET_BYTES_S);
        std::iter::from_fn(|| repeats.next_ns().and_then(|at_ns| repeats.take_due(at_ns))).count() > 0
    };
    assert!(!is_repeated(1000, 100, 0));
    assert!(is_repeated(1100, 200, 4));
    assert!(is_repeated(11_000, 3000, 4));
    assert!(!is_repeated(11_200, 3010, 4), "ten seconds later");
}

#[test]
fn what_was_lost_has_two_copies() {
    let mut repeats = Repeats::default();
    repeats.note(1000 * MS, address(1), [100, 2]);
    repeats.note(1500 * MS, address(1), [200, 3]);
    let mut left_ms = Vec::new();
    (0..3).for_each(|_| repeats.sent(2000 * MS, &packet(), TARGET_BYTES_S));
    while let Some(at_ns) = repeats.next_ns() {
        assert!(repeats.take_due(at_ns - 1).is_none(), "not before its time");
        left_ms.extend(repeats.take_due(at_ns).map(|_| at_ns / MS));
    }
    assert_eq!(left_ms, [2010, 2010, 2010, 2020, 2020]);
    assert_eq!(repeats.repeated_bytes(), 5 * PACKET_BYTES as u64);
}

#[test]
fn another_address_is_another_path() {
    let mut repeats = Repeats::default();
    repeats.note(1000 * MS, address(1), [100, 4]);
    repeats.sent(1000 * MS, &packet(), TARGET_BYTES_S);
    assert!(repeats.next_ns().is_some());
    repeats.note(1001 * MS, address(2), [101, 4]);
    assert_eq!(repeats.next_ns(), None, "what waited was for the old one");
    repeats.sent(1001 * MS, &packet(), TARGET_BYTES_S);
    assert_eq!(repeats.next_ns(), None, "nothing was lost to the new one");
}

#[test]
fn copies_that_wait_are_bounded() {
    let mut repeats = Repeats::default();
    repeats.note(1000 * MS, address(1), [100, 4]);
    (0..1000).for_each(|_| repeats.sent(1000 * MS, &packet(), Some(1e9)));
    let waiting = std::iter::from_fn(|| repeats.take_due(1000 * MS + DELAY_NS)).count();
    assert_eq!(waiting, MAX_WAITING_BYTES / PACKET_BYTES);
}

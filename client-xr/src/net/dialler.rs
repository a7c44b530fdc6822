//! Order and times of the attempts to reach one server's addresses. Time is an argument; the module knows no socket.

use shadecast_protocol::time::ClientTime;
use std::net::SocketAddr;

/// An address that has not answered for this long is not waited for any more: the next one is tried beside it.
const PATIENCE_NS: i64 = 500_000_000;
/// Shortest time from one round to the second; each further round waits twice as long as the one before.
const FIRST_BACK_OFF_NS: i64 = 250_000_000;
/// Longest time from one round to the next.
const LONGEST_BACK_OFF_NS: i64 = 4_000_000_000;

/// Attempts at a server that has served us which may wait for their answers at once, for one more to be made. It is asked anew each
/// [`PATIENCE_NS`], so that it has its client back as soon as it runs again: QUIC repeats its first words ever more seldom.
const MAX_UNDER_WAY: usize = 8;

/// Tries a server's addresses in order, each a little after the one before, and then around again.
#[derive(Clone, Debug)]
pub(super) struct Dialler {
    /// At least one; the one that answered last is the first.
    addresses: Vec<SocketAddr>,
    /// Which one is next; their number where the round is over.
    next: usize,
    not_before: ClientTime,
    /// When the next round may begin.
    next_round: ClientTime,
    back_off_ns: i64,
    /// It has served us, and has not sent us away since.
    is_known: bool,
}

impl Dialler {
    /// For a server with these addresses; without any it never dials.
    pub(super) fn new(addresses: Vec<SocketAddr>) -> Self {
        let long_ago = ClientTime(i64::MIN);
        Self {
            addresses,
            next: 0,
            not_before: long_ago,
            next_round: long_ago,
            back_off_ns: FIRST_BACK_OFF_NS,
            is_known: false,
        }
    }

    /// The address to try now, if it is time for one while `under_way` others have not answered yet.
    pub(super) fn dial(&mut self, now: ClientTime, under_way: usize) -> Option<SocketAddr> {
        let is_asked_anew = self.is_known && now >= self.not_before && under_way < MAX_UNDER_WAY;
        if self.next >= self.addresses.len() && (under_way == 0 || is_asked_anew) {
            self.next = 0;
            self.not_before = self.next_round;
        }
        if now < self.not_before {
            return None;
        }
        let address = *self.addresses.get(self.next)?;
        if self.next == 0 {
            self.next_round = now.plus_ns(self.back_off_ns);
            let longest_ns = if self.is_known { PATIENCE_NS } else { LONGEST_BACK_OFF_NS };
            self.back_off_ns = (self.back_off_ns * 2).min(longest_ns);
        }
        self.next += 1;
        self.not_before = now.plus_ns(PATIENCE_NS);
        Some(address)
    }

    /// An address said no: the next one of the round need not wait.
    pub(super) fn failed(&mut self, now: ClientTime) {
        self.not_before = self.not_before.min(now);
    }

    /// An address answered: the next round begins with it.
    pub(super) fn answered(&mut self, address: SocketAddr) {
        if let Some(place) = self.addresses.iter().position(|known| *known == address) {
            self.addresses[..=place].rotate_right(1);
        }
    }

    /// The session stands: should it break, the next round need not wait.
    pub(super) fn succeeded(&mut self) {
        self.is_known = true;
        self.back_off_ns = FIRST_BACK_OFF_NS;
    }

    /// The connection broke: a new round, as soon as one may begin.
    pub(super) fn lost(&mut self) {
        self.next = self.addresses.len();
    }

    /// The server was reached and wants nothing to do with us: a new round, but not at once.
    pub(super) fn refused(&mut self, now: ClientTime) {
        self.is_known = false;
        self.next_round = now.plus_ns(self.back_off_ns);
        self.lost();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    fn address(port: u16) -> SocketAddr {
        SocketAddr::from(([127, 0, 0, 1], port))
    }

    fn dialler(count: u16) -> Dialler {
        Dialler::new((1..=count).map(address).collect())
    }

    fn at(ns: i64) -> ClientTime {
        ClientTime(ns)
    }

    #[test]
    fn a_silent_address_is_joined_by_the_next_after_half_a_second() {
        let mut dialler = dialler(2);
        assert_eq!(dialler.dial(at(0), 0), Some(address(1)));
        assert_eq!(dialler.dial(at(S / 2 - 1), 1), None);
        assert_eq!(dialler.dial(at(S / 2), 1), Some(address(2)));
        assert_eq!(dialler.dial(at(2 * S), 2), None, "both are still being waited for");
        assert_eq!(dialler.dial(at(4 * S), 0), Some(address(1)), "and around again");
    }

    #[test]
    fn an_address_that_says_no_makes_the_next_one_due_at_once() {
        let mut dialler = dialler(3);
        dialler.dial(at(0), 0);
        dialler.failed(at(1));
        assert_eq!(dialler.dial(at(1), 0), Some(address(2)));
        dialler.failed(at(2));
        assert_eq!(dialler.dial(at(2), 0), Some(address(3)));
        dialler.failed(at(3));
        assert_eq!(dialler.dial(at(3), 0), None, "a round that failed at once is not repeated at once");
        assert_eq!(dialler.dial(at(S / 4), 0), Some(address(1)));
    }

    #[test]
    fn rounds_come_ever_more_slowly_up_to_a_limit() {
        let mut dialler = dialler(1);
        let (mut now, mut starts) = (0, Vec::new());
        while starts.len() < 8 {
            if dialler.dial(at(now), 0).is_some() {
                dialler.failed(at(now));
                starts.push(now);
            }
            now += S / 100;
        }
        let waits: Vec<i64> = starts.windows(2).map(|pair| (pair[1] - pair[0]) / (S / 100)).collect();
        assert_eq!(waits, [25, 50, 100, 200, 400, 400, 400]);
    }

    #[test]
    fn after_a_break_the_last_answering_address_is_first() {
        let mut dialler = dialler(3);
        for second in [0, 1] {
            dialler.dial(at(second * S), 1);
        }
        dialler.answered(address(2));
        dialler.succeeded();
        dialler.lost();
        assert_eq!(dialler.dial(at(9 * S), 0), Some(address(2)));
        assert_eq!(dialler.dial(at(10 * S), 1), Some(address(1)), "the others keep their order");
        assert_eq!(dialler.dial(at(11 * S), 2), Some(address(3)));
    }

    #[test]
    fn a_server_that_has_served_us_is_asked_twice_a_second_until_it_runs_again() {
        let mut dialler = dialler(1);
        dialler.dial(at(0), 0);
        dialler.answered(address(1));
        dialler.succeeded();
        dialler.lost();
        // An attempt is given up after three seconds.
        let (mut dialled, start) = (Vec::new(), 60 * S);
        for tenth in 0..200 {
            let now = start + tenth * S / 10;
            let under_way = dialled.iter().filter(|&&at_ns| now - at_ns < 3 * S).count();
            if dialler.dial(at(now), under_way).is_some() {
                dialled.push(now);
            }
        }
        assert_eq!(dialled.first(), Some(&start), "at once");
        assert!(dialled.windows(2).all(|pair| pair[1] - pair[0] == S / 2), "{dialled:?}");
    }

    #[test]
    fn a_server_that_refuses_is_left_alone_for_a_while() {
        let mut dialler = dialler(2);
        dialler.dial(at(0), 0);
        dialler.answered(address(1));
        dialler.refused(at(10 * S));
        assert_eq!(dialler.dial(at(10 * S), 0), None);
        assert_eq!(dialler.dial(at(10 * S + S / 2), 0), Some(address(1)));
    }

    #[test]
    fn a_name_without_addresses_is_never_dialled() {
        assert_eq!(dialler(0).dial(at(0), 0), None);
    }
}

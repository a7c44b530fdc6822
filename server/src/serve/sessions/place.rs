//! Who may come in, and who holds a place. Pure: time is an argument.
//!
//! A connection alone holds nothing: it has a short time for its hello. A place is taken by a hello that was judged good,
//! kept by messages that make sense, and kept for a while for a client that was served and vanished: it comes back with the
//! secret of its last welcome, and before others do.

use shadecast_protocol::message::{Refused, ResumeSecret};
use shadecast_transport::{Network, PeerId, crowded};
use std::collections::VecDeque;

/// How long after its connection a client may take for its hello, nanoseconds.
pub(super) const HELLO_DEADLINE_NS: i64 = 2_000_000_000;
/// A client that was served keeps its place for so long after it was last understood, nanoseconds, whether it is connected
/// or not.
pub(super) const KEPT_NS: i64 = 5_000_000_000;
/// One that has shown nothing yet keeps it for so long: whoever only takes places shall not keep others out.
const UNPROVEN_NS: i64 = 3_000_000_000;
/// Connections without a hello. When another one comes, the oldest goes of the network that has most. Fewer than the transport allows peers.
pub(super) const MAX_GREETING: usize = 6;

/// Sessions that the machines of one network may begin within [`STARTS_NS`]: each costs the other viewers a part of an update.
const MAX_STARTS: usize = 4;
const STARTS_NS: i64 = 1_000_000_000;

/// When sessions were begun, from old to new.
#[derive(Debug, Default)]
pub(super) struct Starts {
    begun: VecDeque<(Network, i64)>,
}

impl Starts {
    /// Whether a machine of this network may begin a session now.
    ///
    /// # Errors
    /// Its network has begun many: when to try again.
    pub(super) fn ask(&mut self, network: Network, now_ns: i64) -> Result<(), Refused> {
        while self.begun.pop_front_if(|(_, begun_ns)| now_ns - *begun_ns >= STARTS_NS).is_some() {}
        let of_network: Vec<i64> =
            self.begun.iter().filter(|(other, _)| *other == network).map(|(_, begun_ns)| *begun_ns).collect();
        let Some(first_ns) = of_network.first().filter(|_| of_network.len() >= MAX_STARTS) else {
            return Ok(());
        };
        let wait_s = (first_ns + STARTS_NS - now_ns) / 1_000_000_000 + 1;
        let reason = "many sessions were begun from this network a moment ago";
        Err(Refused::new(reason, &format!("try again in {wait_s} s")))
    }

    /// A session was begun.
    pub(super) fn began(&mut self, network: Network, now_ns: i64) {
        self.begun.push_back((network, now_ns));
    }
}

/// Connections whose hello is awaited.
#[derive(Debug, Default)]
pub(super) struct Greeting {
    since: VecDeque<(PeerId, Network, i64)>,
}

impl Greeting {
    /// A peer has connected; gives the one that must go for it.
    pub(super) fn connected(&mut self, peer: PeerId, network: Network, now_ns: i64) -> Option<PeerId> {
        self.since.push_back((peer, network, now_ns));
        if self.since.len() <= MAX_GREETING {
            return None;
        }
        let (oldest, _) = crowded(self.since.iter().map(|(peer, network, _)| (*peer, *network)))?;
        self.done(oldest);
        Some(oldest)
    }

    /// A peer has said its hello, or has gone.
    pub(super) fn done(&mut self, peer: PeerId) {
        self.since.retain(|(other, ..)| *other != peer);
    }

    /// A peer that took too long.
    pub(super) fn overdue(&mut self, now_ns: i64) -> Option<PeerId> {
        let (peer, ..) =
            self.since.pop_front_if(|(_, _, since_ns)| now_ns - *since_ns > HELLO_DEADLINE_NS)?;
        Some(peer)
    }
}

/// The places.
#[derive(Debug)]
pub(super) struct Places {
    most: usize,
    holders: Vec<Holder>,
}

#[derive(Debug)]
struct Holder {
    /// `None` while the client is away.
    peer: Option<PeerId>,
    secret: ResumeSecret,
    heard_ns: i64,
    /// It has shown something: what never did is not waited for.
    has_shown: bool,
    /// It is connected, and nothing is heard of it.
    is_away: bool,
}

/// A place is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Taken {
    /// Whose place it was until now.
    pub(super) displaced: Option<PeerId>,
}

impl Places {
    /// As many as that, at least one.
    pub(super) fn new(most: usize) -> Self {
        Self { most: most.max(1), holders: Vec::new() }
    }

    /// Gives a place to `peer`, whose next secret will be `secret`: its own, a free one, or that of who was silent for too long.
    ///
    /// # Errors
    /// All are others': why, and when to try again.
    pub(super) fn ask(
        &mut self,
        peer: PeerId,
        resume: Option<ResumeSecret>,
        secret: ResumeSecret,
        now_ns: i64,
    ) -> Result<Taken, Refused> {
        let own = self.holders.iter().position(|holder| resume == Some(holder.secret));
        let silent = || self.holders.iter().position(|holder| now_ns >= holder.kept_until_ns());
        let next = Holder { peer: Some(peer), secret, heard_ns: now_ns, has_shown: false, is_away: false };
        match own.or_else(|| if self.holders.len() < self.most { None } else { silent() }) {
            Some(place) => {
                let displaced = std::mem::replace(&mut self.holders[place], next).peer;
                Ok(Taken { displaced })
            }
            None if self.holders.len() < self.most => {
                self.holders.push(next);
                Ok(Taken { displaced: None })
            }
            None => Err(self.refusal(now_ns)),
        }
    }

    fn refusal(&self, now_ns: i64) -> Refused {
        let kept = self.holders.iter().filter(|holder| holder.peer.is_none() || holder.is_away);
        match kept.map(Holder::kept_until_ns).min() {
            Some(until_ns) => {
                let wait_s = (until_ns - now_ns).max(0) / 1_000_000_000 + 1;
                let reason = "the place is kept for a client that was served until a moment ago";
                Refused::new(reason, &format!("try again in {wait_s} s"))
            }
            None if self.most == 1 => {
                Refused::new("another client is being served", "try again when it has left")
            }
            None => {
                let reason = format!("{} other clients are being served, and more are not", self.most);
                Refused::new(&reason, "try again when one has left, or start the server with --viewers")
            }
        }
    }

    /// `peer` has said something that makes sense.
    pub(super) fn heard(&mut self, peer: PeerId, now_ns: i64) {
        if let Some(holder) = self.of(peer) {
            holder.heard_ns = holder.heard_ns.max(now_ns);
        }
    }

    /// `peer` shows what it was sent.
    pub(super) fn shown(&mut self, peer: PeerId) {
        if let Some(holder) = self.of(peer) {
            holder.has_shown = true;
        }
    }

    /// The way to `peer` carries nothing, or does again. True where its place is kept for it: it has one, and has made use of it.
    pub(super) fn away(&mut self, peer: PeerId, is_away: bool) -> bool {
        let Some(holder) = self.of(peer).filter(|holder| holder.has_shown) else { return false };
        holder.is_away = is_away;
        true
    }

    /// The connection of `peer` has gone. Its place is kept for a while, if it ever made use of it.
    pub(super) fn lost(&mut self, peer: PeerId) {
        match self.of(peer) {
            Some(holder) if holder.has_shown => holder.peer = None,
            Some(_) => self.left(peer),
            None => {}
        }
    }

    /// `peer` has left, or cannot be served: its place is free.
    pub(super) fn left(&mut self, peer: PeerId) {
        self.holders.retain(|holder| holder.peer != Some(peer));
    }

    /// Whether `peer` is served.
    pub(super) fn has(&self, peer: PeerId) -> bool {
        self.served().any(|served| served == peer)
    }

    /// Who is served.
    pub(super) fn served(&self) -> impl Iterator<Item = PeerId> + '_ {
        self.holders.iter().filter_map(|holder| holder.peer)
    }

    fn of(&mut self, peer: PeerId) -> Option<&mut Holder> {
        self.holders.iter_mut().find(|holder| holder.peer == Some(peer))
    }
}

impl Holder {
    /// When its place is free for others, unless it is heard again before.
    fn kept_until_ns(&self) -> i64 {
        self.heard_ns + if self.has_shown { KEPT_NS } else { UNPROVEN_NS }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: i64 = 1_000_000_000;
    const FIRST: PeerId = PeerId(1);
    const OTHER: PeerId = PeerId(2);
    const BACK: PeerId = PeerId(3);
    const CROWD: Network = Network::V4([10, 0, 1]);

    fn secret(of: u8) -> ResumeSecret {
        ResumeSecret([of; 16])
    }

    /// The first client was served and has shown something, all at time 0.
    fn served() -> Places {
        let mut place = Places::new(1);
        assert_eq!(place.ask(FIRST, None, secret(1), 0), Ok(Taken { displaced: None }));
        place.shown(FIRST);
        place
    }

    #[test]
    fn a_stranger_waits_while_the_client_is_heard() {
        let mut place = served();
        for second in 1..20 {
            place.heard(FIRST, second * SECOND);
            let refused = place.ask(OTHER, None, secret(2), second * SECOND + SECOND / 2).expect_err("taken");
            assert_eq!(refused.reason, "another client is being served");
        }
        assert!(place.has(FIRST));
    }

    #[test]
    fn several_are_served_and_who_comes_back_takes_over_from_itself_alone() {
        let mut places = Places::new(2);
        let taken = Ok(Taken { displaced: None });
        assert_eq!(places.ask(FIRST, None, secret(1), 0), taken);
        assert_eq!(places.ask(OTHER, None, secret(2), 0), taken);
        [FIRST, OTHER].into_iter().for_each(|peer| places.shown(peer));
        let refused = places.ask(BACK, None, secret(3), SECOND).expect_err("both are taken");
        assert!(refused.reason.contains("2 other clients") && refused.remedy.contains("--viewers"));
        assert_eq!(
            places.ask(BACK, Some(secret(2)), secret(3), SECOND),
            Ok(Taken { displaced: Some(OTHER) })
        );
        assert_eq!(places.served().collect::<Vec<_>>(), [FIRST, BACK]);
        places.heard(FIRST, KEPT_NS);
        let silent = places.ask(OTHER, None, secret(4), KEPT_NS + SECOND);
        assert_eq!(silent, Ok(Taken { displaced: Some(BACK) }), "the one that was heard keeps its place");
        places.left(FIRST);
        assert_eq!(places.ask(FIRST, None, secret(5), KEPT_NS + SECOND), taken);
    }

    #[test]
    fn a_client_that_is_not_understood_loses_its_place_to_whoever_comes_after_the_idle_time() {
        let mut place = served();
        assert!(place.ask(OTHER, None, secret(2), KEPT_NS - 1).is_err());
        assert_eq!(place.ask(OTHER, None, secret(2), KEPT_NS), Ok(Taken { displaced: Some(FIRST) }));
        let late = KEPT_NS + UNPROVEN_NS;
        assert!(place.ask(BACK, None, secret(3), late - 1).is_err());
        assert!(place.ask(BACK, None, secret(3), late).is_ok(), "the other one has shown nothing");
    }

    #[test]
    fn a_client_that_comes_back_with_its_secret_takes_over_from_itself_at_once() {
        let mut place = served();
        assert!(place.ask(BACK, Some(secret(9)), secret(3), SECOND).is_err(), "a secret that is not its own");
        let taken = place.ask(BACK, Some(secret(1)), secret(3), SECOND);
        assert_eq!(taken, Ok(Taken { displaced: Some(FIRST) }));
        assert!(place.ask(OTHER, Some(secret(1)), secret(4), SECOND).is_err(), "a secret serves once");
    }

    #[test]
    fn a_lost_client_finds_its_place_kept_and_strangers_learn_when_to_try_again() {
        let mut place = served();
        place.lost(FIRST);
        assert_eq!(place.served().next(), None);
        let refused = place.ask(OTHER, None, secret(2), 2 * SECOND).expect_err("kept");
        assert_eq!(refused.remedy, "try again in 4 s");
        assert_eq!(place.ask(BACK, Some(secret(1)), secret(3), 3 * SECOND), Ok(Taken { displaced: None }));
        place.lost(BACK);
        assert_eq!(
            place.ask(OTHER, None, secret(2), 3 * SECOND),
            Ok(Taken { displaced: None }),
            "it never showed"
        );
    }

    #[test]
    fn a_kept_place_is_free_after_a_while_and_a_left_one_at_once() {
        let mut place = served();
        place.lost(FIRST);
        assert!(place.ask(OTHER, None, secret(2), KEPT_NS).is_ok());
        let mut place = served();
        place.left(FIRST);
        assert!(place.ask(OTHER, None, secret(2), 1).is_ok());
        place.left(FIRST);
        assert!(place.has(OTHER), "what another leaves does not matter");
    }

    #[test]
    fn connections_without_a_hello_are_few_and_their_time_is_short() {
        let mut greeting = Greeting::default();
        let peers = MAX_GREETING as u64;
        for peer in 0..peers {
            assert_eq!(greeting.connected(PeerId(peer), CROWD, peer as i64), None);
        }
        assert_eq!(greeting.connected(PeerId(peers), CROWD, 9), Some(PeerId(0)), "the oldest goes");
        greeting.done(PeerId(2));
        assert_eq!(greeting.overdue(HELLO_DEADLINE_NS + 1), None);
        let overdue: Vec<_> = std::iter::from_fn(|| greeting.overdue(HELLO_DEADLINE_NS + 4)).collect();
        assert_eq!(overdue, [PeerId(1), PeerId(3)]);
    }

    #[test]
    fn a_network_that_begins_many_sessions_waits_and_others_do_not() {
        let mut starts = Starts::default();
        for n in 0..MAX_STARTS as i64 {
            assert_eq!(starts.ask(CROWD, n), Ok(()));
            starts.began(CROWD, n);
        }
        let refused = starts.ask(CROWD, SECOND / 2).expect_err("too many");
        assert_eq!(refused.remedy, "try again in 1 s");
        assert_eq!(starts.ask(Network::V4([10, 0, 2]), SECOND / 2), Ok(()));
        assert_eq!(starts.ask(CROWD, STARTS_NS), Ok(()), "the first is forgotten");
        starts.began(CROWD, STARTS_NS);
        assert!(starts.ask(CROWD, STARTS_NS).is_err(), "the second is not");
        assert_eq!(starts.begun.len(), MAX_STARTS);
    }

    #[test]
    fn a_crowd_of_one_network_does_not_push_out_another() {
        let mut greeting = Greeting::default();
        assert_eq!(greeting.connected(FIRST, Network::V4([10, 0, 2]), 0), None);
        let gone = (0..100).filter_map(|n| greeting.connected(PeerId(10 + n), CROWD, n as i64));
        assert_eq!(gone.filter(|peer| *peer == FIRST).count(), 0);
    }
}

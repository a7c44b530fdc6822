//! The known servers, by the rounds of a search, and the choice of one. Pure. Datagrams get lost, so a single round does not
//! prove absence.

use shadecast_transport::discovery::FoundServer;
use shadecast_transport::{Fingerprint, KnownServers};

/// A server that is not heard for so many rounds in a row is gone.
const ROUNDS_KEPT: u32 = 3;
/// Rounds that must have heard a server before it is taken without a question.
const ROUNDS_AGREED: u32 = 2;

/// Who was heard lately.
#[derive(Debug, Default)]
pub(super) struct Heard {
    entries: Vec<Entry>,
    /// Rounds that were taken in.
    rounds: u32,
}

#[derive(Clone, Debug)]
struct Entry {
    server: FoundServer,
    /// Rounds that heard it.
    rounds: u32,
    /// Rounds since.
    missed: u32,
}

/// What is known beside what was heard.
#[derive(Clone, Copy)]
pub(super) struct Wish<'a> {
    /// The only key that will do, if the user named one.
    pub(super) required: Option<Fingerprint>,
    /// The server that is taken whoever else is there: the one that was connected last, or that the user took.
    pub(super) preferred: Option<&'a FoundServer>,
    /// The one that was found before and turned to. Whoever else comes is for the user to take.
    pub(super) current: Option<&'a FoundServer>,
    /// Those that were met before.
    pub(super) known: &'a KnownServers,
    /// The user is choosing.
    pub(super) is_listed: bool,
}

/// Which server to connect to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Choice {
    /// There is none.
    Nobody,
    /// Not to be said yet: others may have been missed.
    Unsure,
    /// This one.
    One(FoundServer),
    /// That is for the user to say.
    Several(Vec<FoundServer>),
}

impl Heard {
    /// Takes in who was heard in a round.
    pub(super) fn take(&mut self, round: Vec<FoundServer>) {
        self.rounds = self.rounds.saturating_add(1);
        self.entries.iter_mut().for_each(|entry| entry.missed += 1);
        for server in round {
            match self.entries.iter_mut().find(|entry| entry.server.is_same(&server)) {
                Some(entry) => *entry = Entry { server, rounds: entry.rounds + 1, missed: 0 },
                None => self.entries.push(Entry { server, rounds: 1, missed: 0 }),
            }
        }
        self.entries.retain(|entry| entry.missed < ROUNDS_KEPT);
    }

    /// Which of them to connect to.
    pub(super) fn choose(&self, wish: &Wish<'_>) -> Choice {
        let is_meant = |entry: &&Entry| wish.required.is_none() || entry.server.fingerprint == wish.required;
        let there: Vec<&Entry> = self.entries.iter().filter(is_meant).collect();
        let all = || there.iter().map(|entry| entry.server.clone()).collect();
        if let Some(server) = wish.named(&there) {
            return Choice::One(server.clone());
        }
        if wish.is_listed && !there.is_empty() {
            return Choice::Several(all());
        }
        let is_current = |entry: &&Entry| wish.current.is_none_or(|current| current.is_same(&entry.server));
        if !there.is_empty() && !there.iter().any(is_current) && self.rounds < ROUNDS_AGREED {
            return Choice::Unsure; // it may have been missed, or is about to be back
        }
        let known: Vec<&Entry> = there.iter().copied().filter(|entry| wish.knows(&entry.server)).collect();
        let likely = if known.is_empty() { &there } else { &known };
        match likely[..] {
            [] => Choice::Nobody,
            // A known server may be silent for a moment; a stranger in its place is for the user to take.
            [one] if known.is_empty() && wish.preferred.is_some() => {
                if one.rounds >= ROUNDS_AGREED {
                    Choice::Several(all())
                } else {
                    Choice::Unsure
                }
            }
            [one] if is_current(&one) => wish.take_once_sure(one, !known.is_empty()),
            _ => Choice::Several(all()),
        }
    }
}

impl Wish<'_> {
    /// The one that the user has named in one way or another.
    fn named<'a>(&self, there: &[&'a Entry]) -> Option<&'a FoundServer> {
        let servers = || there.iter().map(|entry| &entry.server);
        if self.required.is_some() {
            return servers().next();
        }
        let preferred = self.preferred?;
        servers().find(|server| server.is_same(preferred)).or_else(|| {
            servers()
                .find(|server| server.fingerprint.is_some() && server.fingerprint == preferred.fingerprint)
        })
    }

    fn knows(&self, server: &FoundServer) -> bool {
        server.fingerprint.is_some_and(|fingerprint| self.known.knows(fingerprint))
    }

    /// A stranger may be the one of two whose answer was not lost; a known server, the one of two known ones. Where no
    /// other one is preferred, a known one is as good as any.
    fn take_once_sure(&self, one: &Entry, is_known: bool) -> Choice {
        let is_sure = one.rounds >= ROUNDS_AGREED || (is_known && self.preferred.is_none());
        if is_sure { Choice::One(one.server.clone()) } else { Choice::Unsure }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A server of this name at 192.168.1.KEY.
    pub(in crate::net) fn server(name: &str, key: u8) -> FoundServer {
        let address = format!("192.168.1.{key}:7400").parse().expect("an address");
        let fingerprint = format!("{key:02x}").repeat(32).parse().ok();
        FoundServer { name: name.into(), addresses: vec![address], fingerprint }
    }

    /// A client that knows these servers.
    pub(in crate::net) fn knowing(folder: &tempfile::TempDir, servers: &[&FoundServer]) -> KnownServers {
        let mut known = KnownServers::load(folder.path()).expect("a list");
        for server in servers {
            let key = server.fingerprint.expect("a key");
            known.remember(&server.name, server.addresses[0], key).expect("pinned");
        }
        known
    }

    fn wish(known: &KnownServers) -> Wish<'_> {
        Wish { required: None, preferred: None, current: None, known, is_listed: false }
    }

    fn heard<'a>(rounds: impl IntoIterator<Item = Vec<&'a FoundServer>>) -> Heard {
        let mut heard = Heard::default();
        rounds.into_iter().for_each(|round| heard.take(round.into_iter().cloned().collect()));
        heard
    }

    #[test]
    fn the_only_stranger_is_taken_when_a_second_round_agrees() {
        let folder = tempfile::tempdir().expect("a folder");
        let (known, desk) = (knowing(&folder, &[]), server("desk", 1));
        assert_eq!(heard([vec![]]).choose(&wish(&known)), Choice::Nobody);
        assert_eq!(heard([vec![&desk]]).choose(&wish(&known)), Choice::Unsure);
        assert_eq!(heard([vec![&desk], vec![&desk]]).choose(&wish(&known)), Choice::One(desk));
    }

    #[test]
    fn a_stranger_is_not_taken_for_a_known_server_that_is_silent() {
        let folder = tempfile::tempdir().expect("a folder");
        let [desk, stranger] = [server("desk", 1), server("stranger", 2)];
        let known = knowing(&folder, &[&desk]);
        let wish = Wish { preferred: Some(&desk), ..wish(&known) };
        assert_eq!(heard([vec![&stranger]]).choose(&wish), Choice::Unsure);
        let long = heard((0..9).map(|_| vec![&stranger]));
        assert_eq!(long.choose(&wish), Choice::Several(vec![stranger.clone()]), "it is for the user to take");
        let back = heard([vec![&stranger], vec![&stranger], vec![&desk, &stranger]]);
        assert_eq!(back.choose(&wish), Choice::One(desk.clone()));
        let taken = Wish { preferred: Some(&stranger), ..wish };
        assert_eq!(heard([vec![&stranger]]).choose(&taken), Choice::One(stranger.clone()));
    }

    #[test]
    fn of_two_strangers_a_lost_answer_chooses_neither() {
        let folder = tempfile::tempdir().expect("a folder");
        let (known, [desk, attic]) = (knowing(&folder, &[]), [server("desk", 1), server("attic", 2)]);
        let both = Choice::Several(vec![desk.clone(), attic.clone()]);
        for rounds in [vec![vec![&desk, &attic]], vec![vec![&desk], vec![&attic]]] {
            assert_eq!(heard(rounds).choose(&wish(&known)), both);
        }
        let lost = heard([vec![&desk, &attic], vec![&desk], vec![&desk]]);
        assert_eq!(lost.choose(&wish(&known)), both, "for some rounds it is not gone");
        let gone = heard([vec![&desk, &attic], vec![&desk], vec![&desk], vec![&desk]]);
        assert_eq!(gone.choose(&wish(&known)), Choice::One(desk.clone()));
        let choosing = Wish { is_listed: true, ..wish(&known) };
        assert_eq!(gone.choose(&choosing), Choice::Several(vec![desk]), "the list does not choose by itself");
    }

    #[test]
    fn the_last_server_is_taken_at_once_among_known_ones() {
        let folder = tempfile::tempdir().expect("a folder");
        let [desk, attic, shed] = [server("desk", 1), server("attic", 2), server("shed", 3)];
        let known = knowing(&folder, &[&desk, &attic]);
        let all = heard([vec![&shed, &attic, &desk]]);
        assert_eq!(all.choose(&wish(&known)), Choice::Several(vec![shed, attic.clone(), desk.clone()]));
        for (preferred, is_listed) in [(&desk, false), (&attic, false), (&attic, true)] {
            let wish = Wish { preferred: Some(preferred), is_listed, ..wish(&known) };
            assert_eq!(all.choose(&wish), Choice::One(preferred.clone()));
        }
        let renamed = FoundServer { name: "desk of today".into(), ..desk.clone() };
        let wish = Wish { preferred: Some(&desk), ..wish(&known) };
        assert_eq!(heard([vec![&attic, &renamed]]).choose(&wish), Choice::One(renamed), "its key counts");
    }

    #[test]
    fn another_known_server_waits_a_round_for_the_last_one() {
        let folder = tempfile::tempdir().expect("a folder");
        let [desk, attic, stranger] = [server("desk", 1), server("attic", 2), server("shed", 3)];
        let known = knowing(&folder, &[&desk, &attic]);
        let once = heard([vec![&stranger, &attic]]);
        assert_eq!(
            once.choose(&wish(&known)),
            Choice::One(attic.clone()),
            "an old list tells of no last one"
        );
        let wish = Wish { preferred: Some(&desk), ..wish(&known) };
        assert_eq!(once.choose(&wish), Choice::Unsure);
        let twice = heard([vec![&attic, &stranger], vec![&attic]]);
        assert_eq!(twice.choose(&wish), Choice::One(attic));
    }

    #[test]
    fn with_a_key_that_is_demanded_nobody_else_counts() {
        let folder = tempfile::tempdir().expect("a folder");
        let [desk, attic] = [server("desk", 1), server("attic", 2)];
        let (known, both) = (knowing(&folder, &[&attic]), heard([vec![&desk, &attic]]));
        let demands = |required| Wish { required, preferred: Some(&attic), ..wish(&known) };
        assert_eq!(both.choose(&demands(desk.fingerprint)), Choice::One(desk));
        assert_eq!(both.choose(&demands(server("", 9).fingerprint)), Choice::Nobody);
    }

    #[test]
    fn a_vanished_server_is_not_replaced_without_asking() {
        let folder = tempfile::tempdir().expect("a folder");
        let [desk, attic] = [server("desk", 1), server("attic", 2)];
        for known in [knowing(&folder, &[]), knowing(&folder, &[&desk, &attic])] {
            let wish = Wish { current: Some(&desk), ..wish(&known) };
            let rounds = |server| heard([vec![server], vec![server], vec![server]]);
            assert_eq!(heard([vec![&attic]]).choose(&wish), Choice::Unsure, "it may be back soon");
            assert_eq!(rounds(&attic).choose(&wish), Choice::Several(vec![attic.clone()]));
            assert_eq!(rounds(&desk).choose(&wish), Choice::One(desk.clone()));
        }
    }
}

//! Servers that announce themselves, looked for on a thread of its own until one is chosen.

use crate::display::Presses;
use shadecast_transport::discovery::FoundServer;
use shadecast_transport::discovery::search::search;
use shadecast_transport::{Fingerprint, KnownServers};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

/// How long answers are waited for before it is asked again.
const ROUND: Duration = Duration::from_millis(1500);

/// Asks round after round for as long as it lives.
pub(super) struct Finder {
    rounds: Receiver<Vec<FoundServer>>,
}

/// Which server to connect to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Choice {
    /// There is none.
    Nobody,
    /// This one.
    One(FoundServer),
    /// That is for the user to say.
    Several(Vec<FoundServer>),
}

/// Several servers, of which the user takes one.
#[derive(Default)]
pub(super) struct List {
    servers: Vec<FoundServer>,
    marked: usize,
    seen: Presses,
}

/// Entries that are shown at once: what a headset's text has room for beside what it says about them.
const SHOWN: usize = 4;

impl List {
    /// These are there now. The one that was marked stays so.
    pub(super) fn refill(&mut self, mut servers: Vec<FoundServer>) {
        servers.sort_by(|a, b| (&a.name, &a.addresses).cmp(&(&b.name, &b.addresses)));
        let marked = self.servers.get(self.marked);
        self.marked = servers.iter().position(|server| Some(server) == marked).unwrap_or(0);
        self.servers = servers;
    }

    /// Whether the user has done anything since.
    pub(super) fn has_news(&self, presses: Presses) -> bool {
        presses != self.seen
    }

    /// What the user has done by now: the server that was taken, if one was.
    pub(super) fn pick(&mut self, presses: Presses) -> Option<FoundServer> {
        let before = std::mem::replace(&mut self.seen, presses);
        let nexts = presses.nexts.wrapping_sub(before.nexts) as usize;
        self.marked = (self.marked + nexts).checked_rem(self.servers.len()).unwrap_or(0);
        if presses.takes == before.takes { None } else { self.servers.get(self.marked).cloned() }
    }

    /// What the headset says of them, and whether there is anything to say.
    pub(super) fn text(&self) -> Option<String> {
        let first = (self.marked + 1).saturating_sub(SHOWN);
        let shown = self.servers.iter().enumerate().skip(first).take(SHOWN).map(|(number, server)| {
            let mark = if number == self.marked { '>' } else { ' ' };
            format!("{mark} {}\n", described(server))
        });
        let shown: String = shown.collect();
        let count = self.servers.len();
        (count > 0).then(|| {
            format!("{count} servers answer. Next: B or N\nTake the marked one: trigger or Enter\n{shown}")
        })
    }
}

/// Its name, and where it is.
pub(super) fn described(server: &FoundServer) -> String {
    let address = server.addresses.first().map_or(String::new(), |address| format!(" at {address}"));
    format!("{}{address}", server.name)
}

/// Names for a log.
pub(super) fn names(servers: &[FoundServer]) -> String {
    servers.iter().map(described).collect::<Vec<_>>().join(", ")
}

impl Finder {
    /// Begins to ask.
    pub(super) fn start() -> Self {
        let (to, rounds) = channel();
        std::thread::spawn(move || {
            loop {
                let found = search(ROUND).unwrap_or_else(|error| {
                    tracing::debug!("searching for servers: {error}");
                    std::thread::sleep(ROUND); // a network that is not there yet
                    Vec::new()
                });
                if to.send(found).is_err() {
                    break;
                }
            }
        });
        Self { rounds }
    }

    /// Who has answered in the last round that is over, if one is.
    pub(super) fn newest(&self) -> Option<Vec<FoundServer>> {
        self.rounds.try_iter().last()
    }
}

/// The one that was met before, or the only one there is. With `required` nobody else counts.
pub(super) fn choose(
    mut found: Vec<FoundServer>,
    known: &KnownServers,
    required: Option<Fingerprint>,
) -> Choice {
    found.retain(|server| required.is_none() || server.fingerprint == required);
    if found.iter().any(|server| is_known(server, known)) {
        found.retain(|server| is_known(server, known));
    }
    match found.len() {
        0 => Choice::Nobody,
        1 => Choice::One(found.remove(0)),
        _ => Choice::Several(found),
    }
}

fn is_known(server: &FoundServer, known: &KnownServers) -> bool {
    server.fingerprint.is_some_and(|fingerprint| known.knows(fingerprint))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn server(name: &str, key: u8) -> FoundServer {
        let address = format!("192.168.1.{key}:7400").parse().expect("an address");
        let fingerprint = format!("{key:02x}").repeat(32).parse().ok();
        FoundServer { name: name.into(), addresses: vec![address], fingerprint }
    }

    #[test]
    fn the_only_server_is_taken_and_of_several_the_one_that_was_met_before() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut known = KnownServers::load(folder.path()).expect("an empty list");
        let [desk, attic] = [server("desk", 1), server("attic", 2)];
        assert_eq!(choose(vec![], &known, None), Choice::Nobody);
        assert_eq!(choose(vec![desk.clone()], &known, None), Choice::One(desk.clone()));
        let both = vec![desk.clone(), attic.clone()];
        let Choice::Several(strangers) = choose(both.clone(), &known, None) else { panic!("two strangers") };
        assert_eq!(names(&strangers), "desk at 192.168.1.1:7400, attic at 192.168.1.2:7400");
        let key = attic.fingerprint.expect("a key");
        known.remember("somewhere:7400", "10.0.0.1:7400".parse().expect("an address"), key).expect("pinned");
        assert_eq!(choose(both.clone(), &known, None), Choice::One(attic.clone()));
        assert_eq!(choose(both.clone(), &known, desk.fingerprint), Choice::One(desk));
        assert_eq!(choose(both, &known, server("", 9).fingerprint), Choice::Nobody);
    }

    #[test]
    fn of_several_the_user_takes_one_and_those_that_come_and_go_do_not_move_the_mark() {
        let presses = |nexts, takes| Presses { nexts, takes, ..Presses::default() };
        let mut list = List::default();
        assert_eq!((list.pick(presses(2, 1)), list.text()), (None, None), "nothing was there to take");
        let [attic, desk, shed] = [server("attic", 2), server("desk", 1), server("shed", 3)];
        list.refill(vec![shed.clone(), attic.clone()]);
        let text = list.text().expect("two servers");
        assert_eq!(
            text.lines().collect::<Vec<_>>(),
            [
                "2 servers answer. Next: B or N",
                "Take the marked one: trigger or Enter",
                "> attic at 192.168.1.2:7400",
                "  shed at 192.168.1.3:7400"
            ]
        );
        assert_eq!(list.pick(presses(3, 1)), None);
        list.refill(vec![desk.clone(), shed.clone(), attic.clone()]);
        assert_eq!(list.pick(presses(3, 2)), Some(shed.clone()));
        assert_eq!(list.pick(presses(4, 3)), Some(attic.clone()), "after the last comes the first");
        list.refill(vec![desk.clone()]);
        assert_eq!(list.pick(presses(4, 4)), Some(desk));
    }

    #[test]
    fn of_many_servers_those_around_the_marked_one_are_shown() {
        let mut list = List::default();
        list.refill((1..=9).map(|number| server(&format!("server {number}"), number)).collect());
        for nexts in 0..9 {
            list.pick(Presses { nexts, ..Presses::default() });
            let text = list.text().expect("nine servers");
            assert_eq!(text.lines().count(), 2 + SHOWN);
            assert!(text.contains(&format!("> server {}", nexts + 1)), "{text}");
        }
    }
}

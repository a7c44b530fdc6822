//! Servers that announce themselves, looked for on a thread of its own until one is chosen.

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
    /// That is for the user to say: these names, each with an address.
    Several(Vec<String>),
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
        _ => Choice::Several(
            found.iter().map(|server| format!("{} at {}", server.name, server.addresses[0])).collect(),
        ),
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
        let Choice::Several(names) = choose(both.clone(), &known, None) else { panic!("two strangers") };
        assert_eq!(names, ["desk at 192.168.1.1:7400", "attic at 192.168.1.2:7400"]);
        let key = attic.fingerprint.expect("a key");
        known.remember("somewhere:7400", "10.0.0.1:7400".parse().expect("an address"), key).expect("pinned");
        assert_eq!(choose(both.clone(), &known, None), Choice::One(attic.clone()));
        assert_eq!(choose(both.clone(), &known, desk.fingerprint), Choice::One(desk));
        assert_eq!(choose(both, &known, server("", 9).fingerprint), Choice::Nobody);
    }
}

//! A server's address as written by the user, and the machines of its name. A name server may be slow or unreachable, so a
//! thread asks repeatedly.

use super::RunError;
use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

/// How long is waited before a name that nobody knew is asked for again.
const ASK_AGAIN: Duration = Duration::from_secs(2);

/// `host:port`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Address {
    /// Of one machine.
    Of(SocketAddr),
    /// A name that the network has to know.
    Named(String),
}

/// What a name leads to, in the system's order, or why to nothing.
pub(super) type Answer = Result<Vec<SocketAddr>, String>;

/// Asks for a name until it leads somewhere, for as long as it lives.
pub(super) struct Resolver {
    answers: Receiver<Answer>,
}

impl Address {
    /// Whether the network knows the name is not asked here: only whether it can be one.
    ///
    /// # Errors
    /// It is not `host:port`.
    pub(super) fn parse(text: &str) -> Result<Self, RunError> {
        let wrong = |reason: &str| RunError::Address { address: text.to_owned(), reason: reason.to_owned() };
        if let Ok(address) = text.parse::<SocketAddr>() {
            return match address.port() {
                0 => Err(wrong("port 0 is not allowed")),
                _ => Ok(Self::Of(address)),
            };
        }
        let (host, port) = text.rsplit_once(':').ok_or_else(|| wrong("it has no port"))?;
        match port.parse::<u16>() {
            Ok(0) => return Err(wrong("port 0 is not allowed")),
            Ok(_) => {}
            Err(_) => return Err(wrong("the part after the last colon is not a port")),
        }
        if host.is_empty() {
            return Err(wrong("it names no machine"));
        }
        if host.contains([':', '[', ']']) {
            return Err(wrong("it is neither a host name nor an address; IPv6 is written [ADDRESS]:PORT"));
        }
        Ok(Self::Named(text.to_owned()))
    }
}

impl Resolver {
    /// Begins to ask.
    pub(super) fn start(name: String) -> Self {
        Self::asking(move || lookup(&name), ASK_AGAIN)
    }

    /// The same with another way to ask.
    pub(super) fn asking(ask: impl Fn() -> Answer + Send + 'static, wait: Duration) -> Self {
        let (to, answers) = channel();
        std::thread::spawn(move || {
            loop {
                let answer = ask();
                let is_last = answer.is_ok();
                if to.send(answer).is_err() || is_last {
                    break;
                }
                std::thread::sleep(wait);
            }
        });
        Self { answers }
    }

    /// The next answer, if there is one; after one that leads somewhere there are no more.
    pub(super) fn poll(&self) -> Option<Answer> {
        self.answers.try_recv().ok()
    }
}

fn lookup(name: &str) -> Answer {
    let addresses = name.to_socket_addrs().map_err(|error| error.to_string())?;
    let mut found: Vec<SocketAddr> = Vec::new();
    for address in addresses {
        if !found.contains(&address) {
            found.push(address);
        }
    }
    if found.is_empty() { Err("it names no machine".to_owned()) } else { Ok(found) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU32, Ordering};
    use std::time::Instant;

    #[test]
    fn what_is_no_address_is_refused_at_once_with_an_example() {
        for text in
            ["192.168.1.5", "nonsense", "desk:", "desk:x", "desk:70000", "desk:0", "127.0.0.1:0", ":7400"]
        {
            let error = Address::parse(text).expect_err(text).to_string();
            assert!(error.contains(&format!("\"{text}\"")) && error.contains("192.168.1.5:7400"), "{error}");
        }
        let bare = Address::parse("fe80::1:x:7400").expect_err("no brackets").to_string();
        assert!(bare.contains("[ADDRESS]:PORT"), "{bare}");
    }

    #[test]
    fn addresses_lead_to_one_machine_and_names_are_asked_for() {
        for text in ["127.0.0.1:7400", "[::1]:7400"] {
            assert_eq!(Address::parse(text).ok(), text.parse().ok().map(Address::Of));
        }
        assert_eq!(Address::parse("desk.local:7400").ok(), Some(Address::Named("desk.local:7400".into())));
        assert_eq!(lookup("127.0.0.1:7400"), Ok(vec![SocketAddr::from(([127, 0, 0, 1], 7400))]));
    }

    #[test]
    fn a_name_that_nobody_knows_is_asked_for_until_somebody_does() {
        let asked = AtomicU32::new(0);
        let there = SocketAddr::from(([127, 0, 0, 1], 7400));
        let ask = move || match asked.fetch_add(1, Ordering::Relaxed) {
            0 | 1 => Err("unknown".to_owned()),
            _ => Ok(vec![there]),
        };
        let resolver = Resolver::asking(ask, Duration::from_millis(1));
        let (mut answers, deadline) = (Vec::new(), Instant::now() + Duration::from_secs(60));
        while !matches!(answers.last(), Some(Ok(_))) {
            answers.extend(resolver.poll());
            assert!(Instant::now() < deadline, "{answers:?}");
            std::thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(answers, [Err("unknown".to_owned()), Err("unknown".to_owned()), Ok(vec![there])]);
    }
}

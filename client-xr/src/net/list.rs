//! The list of servers in the headset, for the user's choice.

use crate::display::Presses;
use shadecast_transport::discovery::FoundServer;

/// Entries that are shown at once: what a headset's text has room for beside what it says about them.
const SHOWN: usize = 4;

/// Servers, of which the user takes one.
#[derive(Default)]
pub(super) struct List {
    servers: Vec<FoundServer>,
    marked: usize,
    seen: Presses,
}

impl List {
    /// These are there now. The one that was marked stays so.
    pub(super) fn refill(&mut self, mut servers: Vec<FoundServer>) {
        servers.sort_by(|a, b| (&a.name, &a.addresses).cmp(&(&b.name, &b.addresses)));
        let marked = self.servers.get(self.marked);
        let is_marked = |server: &FoundServer| marked.is_some_and(|marked| marked.is_same(server));
        self.marked = servers.iter().position(is_marked).unwrap_or(0);
        self.servers = servers;
    }

    /// There is nothing to choose from any more.
    pub(super) fn clear(&mut self) {
        self.refill(Vec::new());
    }

    /// Whether there is something to choose from.
    pub(super) fn is_shown(&self) -> bool {
        !self.servers.is_empty()
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
        let answer = match self.servers.len() {
            1 => "1 server answers".to_owned(),
            count => format!("{count} servers answer"),
        };
        self.is_shown()
            .then(|| format!("{answer}. Next: B or N\nTake the marked one: trigger or Enter\n{shown}"))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::heard::tests::server;

    #[test]
    fn changing_server_lists_do_not_move_the_mark() {
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
        let mut moved = shed.clone();
        moved.addresses.push("10.0.0.3:7400".parse().expect("an address"));
        list.refill(vec![desk.clone(), moved.clone(), attic.clone()]);
        assert_eq!(list.pick(presses(3, 2)), Some(moved), "it has got another address");
        assert_eq!(list.pick(presses(4, 3)), Some(attic), "after the last comes the first");
        list.refill(vec![desk.clone()]);
        assert_eq!(list.pick(presses(4, 4)), Some(desk));
    }

    #[test]
    fn a_list_that_was_left_does_not_take_by_presses_of_before() {
        let takes = |takes| Presses { takes, ..Presses::default() };
        let mut list = List::default();
        list.refill(vec![server("desk", 1)]);
        assert!(list.pick(takes(3)).is_some());
        list.clear();
        assert!(!list.is_shown() && list.text().is_none());
        list.refill(vec![server("attic", 2)]);
        assert!(!list.has_news(takes(3)) && list.pick(takes(3)).is_none());
        assert!(list.text().is_some_and(|text| text.starts_with("1 server answers.")));
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

//! Whose turn it is where the device is slower than all updates together: who has had least of it. Pure: times come in.
//!
//! Fair queueing by start times (Goyal, Vin and Cheng, 1996), with one device and equal weights: a client that asks for
//! larger eyes gets fewer updates, not more of the device.

/// Who was away, or has just come, may have so much at once before others have their turn, nanoseconds.
const CREDIT_NS: i64 = 50_000_000;
/// An update counts as at least so long, nanoseconds.
const LEAST_NS: i64 = 1_000_000;

/// What a client has had of the device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Share {
    spent_ns: i64,
}

/// See the module.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Turns {
    /// What the last one to be served had had before.
    at_ns: i64,
}

impl Turns {
    /// Of one who comes.
    pub(super) fn join(&self) -> Share {
        Share { spent_ns: self.at_ns }
    }

    /// The least is next.
    pub(super) fn order(&self, share: Share) -> i64 {
        share.spent_ns.max(self.at_ns - CREDIT_NS)
    }

    /// A client's update has taken so long.
    pub(super) fn served(&mut self, share: &mut Share, took_ns: i64) {
        let before_ns = self.order(*share);
        self.at_ns = self.at_ns.max(before_ns);
        share.spent_ns = before_ns + took_ns.max(LEAST_NS);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// What each has had after so many turns, if all always want one; a client is its share and what an update takes.
    fn play(turns: &mut Turns, clients: &mut [(Share, i64)], count: usize) -> Vec<i64> {
        let mut had_ns = vec![0; clients.len()];
        for _ in 0..count {
            let next =
                (0..clients.len()).min_by_key(|index| turns.order(clients[*index].0)).expect("clients");
            let (share, took_ns) = &mut clients[next];
            turns.served(share, *took_ns);
            had_ns[next] += *took_ns;
        }
        had_ns
    }

    #[test]
    fn all_get_the_same_time_whatever_their_updates_take() {
        let mut turns = Turns::default();
        let mut clients = [10 * MS, 10 * MS, 80 * MS].map(|took_ns| (turns.join(), took_ns));
        let had_ns = play(&mut turns, &mut clients, 1000);
        let (least, most) = (had_ns.iter().min().expect("some"), had_ns.iter().max().expect("some"));
        assert!(most - least <= 2 * 80 * MS, "{had_ns:?}");
    }

    #[test]
    fn who_was_away_does_not_catch_up_at_the_cost_of_others() {
        let mut turns = Turns::default();
        let away = turns.join();
        let mut others = [(turns.join(), 10 * MS), (turns.join(), 10 * MS)];
        play(&mut turns, &mut others, 1000);
        let mut all = [(away, 10 * MS), others[0], others[1]];
        let had_ns = play(&mut turns, &mut all, 30);
        assert!(had_ns[0] <= 100 * MS + CREDIT_NS && had_ns[1] >= 60 * MS, "{had_ns:?}");
        let newcomer = turns.join();
        assert!(turns.order(newcomer) >= turns.order(all[0].0) - 20 * MS, "one who comes has no more");
    }

    #[test]
    fn updates_that_take_nothing_are_made_in_turn() {
        let mut turns = Turns::default();
        let mut clients = [(turns.join(), 0), (turns.join(), 0)];
        for _ in 0..10 {
            let before = clients.map(|(share, _)| turns.order(share));
            play(&mut turns, &mut clients, 2);
            let after = clients.map(|(share, _)| turns.order(share));
            assert!(after[0] > before[0] && after[1] > before[1]);
        }
    }
}

//! The numbers of a viewer's updates, and their times until the client reports their display. Pure.

use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::ServerTime;
use std::collections::VecDeque;

/// Updates remembered until their display is reported.
const REMEMBERED_UPDATES: usize = 256;

/// See the module.
pub(crate) struct UpdateNumbers {
    next: UpdateId,
    made: VecDeque<(UpdateId, ServerTime)>,
}

impl UpdateNumbers {
    /// Before the first update.
    pub(crate) fn new() -> Self {
        Self { next: UpdateId(0), made: VecDeque::new() }
    }

    /// The update that is made next, or is being made.
    pub(crate) fn next(&self) -> UpdateId {
        self.next
    }

    /// That update is placed; it was begun at `begun`.
    pub(crate) fn placed(&mut self, begun: ServerTime) {
        self.made.push_back((self.next, begun));
        self.next = self.next.next();
        if self.made.len() > REMEMBERED_UPDATES {
            self.made.pop_front();
        }
    }

    /// The client shows an update. Returns when it was begun, at the first report of it.
    pub(crate) fn displayed(&mut self, update: UpdateId) -> Option<ServerTime> {
        while self.made.front().is_some_and(|(made, _)| *made < update) {
            self.made.pop_front();
        }
        let (_, begun) = self.made.front().copied().filter(|(made, _)| *made == update)?;
        self.made.pop_front();
        Some(begun)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_update_tells_its_begin_at_the_first_report_of_its_display() {
        let mut numbers = UpdateNumbers::new();
        (0..3).for_each(|number| numbers.placed(ServerTime(number * 10)));
        assert_eq!(numbers.next(), UpdateId(3));
        assert_eq!(numbers.displayed(UpdateId(1)), Some(ServerTime(10)));
        assert_eq!(numbers.displayed(UpdateId(1)), None);
        assert_eq!(numbers.displayed(UpdateId(0)), None);
        assert_eq!(numbers.displayed(UpdateId(2)), Some(ServerTime(20)));
    }
}

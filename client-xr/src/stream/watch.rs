//! Whether somebody watches. A headset that was taken off, or shows something else, needs no updates. Brief states are not
//! reported.

use shadecast_protocol::time::ClientTime;

/// The server is told that nobody looks once no frame was seen for this long.
pub const UNWATCHED_AFTER_NS: i64 = 250_000_000;

/// What the server has been told, and since when nothing was seen.
#[derive(Clone, Copy, Debug, Default)]
pub struct Watch {
    unseen_since: Option<ClientTime>,
    is_unwatched: bool,
}

impl Watch {
    /// A new session: its server takes it that somebody looks.
    pub fn begin_session(&mut self) {
        self.is_unwatched = false;
    }

    /// A turn of the runtime whose frame is seen, or not. Gives what the server must be told, if anything.
    pub fn turn(&mut self, is_seen: bool, now: ClientTime) -> Option<bool> {
        let is_unwatched = if is_seen {
            self.unseen_since = None;
            false
        } else {
            let since = *self.unseen_since.get_or_insert(now);
            self.is_unwatched || now.since(since) >= UNWATCHED_AFTER_NS
        };
        let changes = std::mem::replace(&mut self.is_unwatched, is_unwatched) != is_unwatched;
        changes.then_some(!is_unwatched)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn turn(watch: &mut Watch, is_seen: bool, at_ms: i64) -> Option<bool> {
        watch.turn(is_seen, ClientTime(at_ms * MS))
    }

    #[test]
    fn watching_is_reported_at_once_and_its_end_once() {
        let mut watch = Watch::default();
        assert_eq!(turn(&mut watch, true, 1000), None);
        assert_eq!(turn(&mut watch, false, 1010), None);
        assert_eq!(turn(&mut watch, false, 1259), None);
        assert_eq!(turn(&mut watch, false, 1260), Some(false));
        assert_eq!(turn(&mut watch, false, 90_000), None);
        assert_eq!(turn(&mut watch, true, 90_001), Some(true));
        assert_eq!(turn(&mut watch, true, 90_002), None);
    }

    #[test]
    fn a_short_absence_is_not_told() {
        let mut watch = Watch::default();
        for second in 0..10 {
            assert_eq!(turn(&mut watch, false, second * 1000), None);
            assert_eq!(turn(&mut watch, false, second * 1000 + 200), None);
            assert_eq!(turn(&mut watch, true, second * 1000 + 210), None);
        }
    }

    #[test]
    fn a_new_server_is_told_of_an_absence_that_goes_on() {
        let mut watch = Watch::default();
        turn(&mut watch, false, 0);
        assert_eq!(turn(&mut watch, false, 300), Some(false));
        watch.begin_session();
        assert_eq!(turn(&mut watch, false, 310), Some(false));
    }
}

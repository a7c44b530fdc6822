//! The user's word for a server that another app has named: any app can start this one with an address in its intent. Until it
//! is given nobody is dialled. Pure.

use crate::display::Presses;

/// See the module.
pub(super) struct Consent {
    is_lacking: bool,
    /// Presses that were there when it was first asked for.
    before: Option<Presses>,
}

impl Consent {
    /// `is_asked`: it takes a press of the trigger.
    pub(super) fn new(is_asked: bool) -> Self {
        Self { is_lacking: is_asked, before: None }
    }

    /// Whether the question stands.
    pub(super) fn is_lacking(&self) -> bool {
        self.is_lacking
    }

    /// Whether it is given just now. `is_known`: the server was met before, and is pinned.
    pub(super) fn is_given(&mut self, is_known: bool, presses: Presses) -> bool {
        if !self.is_lacking {
            return false;
        }
        let before = *self.before.get_or_insert(presses);
        self.is_lacking = !is_known && presses.takes == before.takes;
        !self.is_lacking
    }
}

/// What the headset asks.
pub(super) fn question(server: &str) -> String {
    format!("Another app asks to connect to {server}, which is not known here.\nConnect: trigger or Enter")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_press_after_the_question_gives_it_once_and_no_other_press_does() {
        let presses = |takes, nexts| Presses { takes, nexts, ..Presses::default() };
        let mut consent = Consent::new(true);
        assert!(!consent.is_given(false, presses(3, 0)), "those of before are no answer");
        assert!(!consent.is_given(false, presses(3, 5)));
        assert!(consent.is_lacking());
        assert!(consent.is_given(false, presses(4, 5)) && !consent.is_lacking());
        assert!(!consent.is_given(false, presses(5, 5)), "once");
    }

    #[test]
    fn a_known_server_needs_none_and_who_was_not_named_by_others_neither() {
        let mut consent = Consent::new(true);
        assert!(consent.is_given(true, Presses::default()) && !consent.is_lacking());
        assert!(!Consent::new(false).is_lacking());
    }
}

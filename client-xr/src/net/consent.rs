//! The user's word for a server that another app has named: any app can start this one with an address in its intent. Until it
//! is given nobody is dialled. It covers the server that answers then: nothing is asked twice. Pure.

use crate::display::Presses;

/// See the module.
pub(super) struct Consent {
    is_lacking: bool,
    /// Presses that were there when it was first asked for.
    before: Option<Presses>,
    /// The user has agreed, and no server has served us since.
    is_unused: bool,
}

impl Consent {
    /// `is_asked`: it takes a press of the trigger.
    pub(super) fn new(is_asked: bool) -> Self {
        Self { is_lacking: is_asked, before: None, is_unused: false }
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
        let is_pressed = presses.takes != before.takes;
        self.is_lacking = !is_known && !is_pressed;
        self.is_unused = !is_known && is_pressed;
        !self.is_lacking
    }

    /// A server would serve us: whether the user has agreed to it, which covers one server once.
    pub(super) fn use_up(&mut self) -> bool {
        std::mem::take(&mut self.is_unused)
    }
}

/// What the headset asks.
pub(super) fn question(server: &str) -> String {
    format!(
        "Another app asks to connect to {server}, which is not known here: whoever answers may not be yours.\n\
         Connect and take it: trigger or Enter"
    )
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
        assert!(consent.use_up() && !consent.use_up(), "it covers one server");
    }

    #[test]
    fn a_known_server_needs_none_and_who_was_not_named_by_others_neither() {
        let mut consent = Consent::new(true);
        assert!(consent.is_given(true, Presses::default()) && !consent.is_lacking());
        assert!(!consent.use_up(), "nobody has agreed");
        assert!(!Consent::new(false).is_lacking() && !Consent::new(false).use_up());
    }
}

//! At which of its predicted times an update looks at the scene. Pure.
//!
//! What is seen is held for some updates, so that those that follow each other see for each other: see `docs/decisions.md` for what
//! fewer looks find and cost.

use crate::support::named::{UnknownName, named};
use crate::time::VIEW_TIMES;

/// See the module.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ViewPlan {
    /// At each of them
    #[default]
    Every,
    /// At the first and the last
    Ends,
    /// At two, in turn
    TwoInTurn,
    /// At the first and the last, in turn
    EndsInTurn,
    /// At one, in turn
    OneInTurn,
    /// At the middle, with a wider view
    WideMiddle,
    /// At the middle alone
    Middle,
}

impl ViewPlan {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::Every,
        Self::Ends,
        Self::TwoInTurn,
        Self::EndsInTurn,
        Self::OneInTurn,
        Self::WideMiddle,
        Self::Middle,
    ];

    /// Its name, as a person writes it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Every => "every",
            Self::Ends => "ends",
            Self::TwoInTurn => "two-in-turn",
            Self::EndsInTurn => "ends-in-turn",
            Self::OneInTurn => "one-in-turn",
            Self::WideMiddle => "wide-middle",
            Self::Middle => "middle",
        }
    }

    /// Which times the update of this number looks at.
    pub(crate) fn times(self, update: u32) -> [bool; VIEW_TIMES] {
        let turn = update as usize % VIEW_TIMES;
        std::array::from_fn(|time| match self {
            Self::Every => true,
            Self::Ends => time != VIEW_TIMES / 2,
            Self::TwoInTurn => time != turn,
            Self::EndsInTurn => time == if update.is_multiple_of(2) { 0 } else { VIEW_TIMES - 1 },
            Self::OneInTurn => time == turn,
            Self::WideMiddle | Self::Middle => time == VIEW_TIMES / 2,
        })
    }

    /// What is added to each side of the field of view beside the usual margin, radians.
    pub(crate) fn margin(self) -> f32 {
        if self == Self::WideMiddle { 0.087 } else { 0.0 }
    }
}

impl std::fmt::Display for ViewPlan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

impl std::str::FromStr for ViewPlan {
    type Err = UnknownName;

    fn from_str(text: &str) -> Result<Self, UnknownName> {
        named("the times that an update looks at", text, &Self::ALL, Self::name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::visibility::holding::HOLD_UPDATES;

    #[test]
    fn every_update_looks_and_what_is_in_turn_comes_round_before_what_was_seen_is_given_up() {
        for plan in ViewPlan::ALL {
            let looks = |time: usize| (0..HOLD_UPDATES / 2).any(|update| plan.times(update)[time]);
            let middle_alone = matches!(plan, ViewPlan::Middle | ViewPlan::WideMiddle);
            assert!(middle_alone || looks(0) && looks(VIEW_TIMES - 1), "{plan:?}");
            assert!((0..20).all(|update| plan.times(update).contains(&true)), "{plan:?}");
        }
    }
}

//! When a step of coarseness rises and falls with what must fit. Pure.
//!
//! Pressure rises at once. It eases once there has been room for a while, to the finest step with room. The time after that is a
//! trial: pressure that rises again during it should not have eased, and the owner asks for more room the next time. What a step
//! is, and what fits, the owner knows.

/// Pressure eases after there was room for this many updates.
pub(crate) const RECOVER_AFTER_UPDATES: u32 = 15;
/// Pressure that rises within this many updates after it eased should not have eased.
pub(crate) const TRIAL_UPDATES: u32 = 60;

/// A step of coarseness.
pub(crate) trait Coarseness: Copy + PartialEq {
    /// One step finer; `None` where nothing presses.
    fn finer(self) -> Option<Self>;
}

/// A step, and when it may become finer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pressure<L> {
    step: L,
    /// For how many updates in a row a finer step would have had room.
    roomy_updates: u32,
    /// The update in which it eased last, as long as that may prove wrong.
    eased: Option<u32>,
}

impl<L: Coarseness> Pressure<L> {
    /// At a step.
    pub(crate) fn new(step: L) -> Self {
        Self { step, roomy_updates: 0, eased: None }
    }

    /// The step now.
    pub(crate) fn step(&self) -> L {
        self.step
    }

    /// An update begins. Eases to the finest step with room where there has been room for a while; whether it did.
    pub(crate) fn recover(&mut self, update: u32, has_room: impl Fn(L) -> bool) -> bool {
        let mut roomy = self.step;
        while let Some(finer) = roomy.finer().filter(|finer| has_room(*finer)) {
            roomy = finer;
        }
        self.roomy_updates = if roomy == self.step { 0 } else { self.roomy_updates + 1 };
        let eases = self.roomy_updates >= RECOVER_AFTER_UPDATES;
        if eases {
            *self = Self { step: roomy, roomy_updates: 0, eased: Some(update) };
        }
        eases
    }

    /// Rises to a coarser step; whether that is within the trial of the last ease. The updates with room so far still count.
    pub(crate) fn rise(&mut self, update: u32, step: L) -> bool {
        self.step = step;
        self.eased.is_some_and(|eased| update - eased <= TRIAL_UPDATES)
    }

    /// Waits for room from the start, and ends the trial.
    pub(crate) fn start_over(&mut self) {
        (self.roomy_updates, self.eased) = (0, None);
    }

    /// Ends a trial that has passed; whether there was one.
    pub(crate) fn has_passed(&mut self, update: u32) -> bool {
        let has_passed = self.eased.is_some_and(|eased| update - eased > TRIAL_UPDATES);
        self.eased = self.eased.filter(|_| !has_passed);
        has_passed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Coarseness for u8 {
        fn finer(self) -> Option<Self> {
            self.checked_sub(1)
        }
    }

    /// Updates from `first` on until pressure has eased.
    fn updates_until_ease(pressure: &mut Pressure<u8>, first: u32, has_room: impl Fn(u8) -> bool) -> u32 {
        (first..first + 1000).take_while(|update| !pressure.recover(*update, &has_room)).count() as u32 + 1
    }

    #[test]
    fn pressure_eases_to_the_finest_step_with_room_after_a_while() {
        let mut pressure = Pressure::new(9);
        assert_eq!(updates_until_ease(&mut pressure, 1, |step| step >= 4), RECOVER_AFTER_UPDATES);
        assert_eq!(pressure.step(), 4);
        assert!((100..200).all(|update| !pressure.recover(update, |step| step >= 4)));
    }

    #[test]
    fn an_update_without_room_starts_the_wait_anew() {
        let mut pressure = Pressure::new(3);
        (1..RECOVER_AFTER_UPDATES).for_each(|update| assert!(!pressure.recover(update, |_| true)));
        assert!(!pressure.recover(RECOVER_AFTER_UPDATES, |_| false));
        assert_eq!(updates_until_ease(&mut pressure, 50, |_| true), RECOVER_AFTER_UPDATES);
    }

    #[test]
    fn a_rise_keeps_the_updates_with_room_until_the_owner_starts_over() {
        let mut pressure = Pressure::new(3);
        (1..RECOVER_AFTER_UPDATES).for_each(|update| assert!(!pressure.recover(update, |_| true)));
        pressure.rise(20, 5);
        let mut kept = pressure;
        assert!(kept.recover(21, |_| true));
        pressure.start_over();
        assert_eq!(updates_until_ease(&mut pressure, 21, |_| true), RECOVER_AFTER_UPDATES);
    }

    #[test]
    fn a_rise_within_the_trial_is_told_from_a_later_one() {
        let mut pressure = Pressure::new(3);
        assert!(!pressure.rise(1, 4), "it has never eased");
        let eased = 10 + updates_until_ease(&mut pressure, 11, |_| true);
        assert!(pressure.rise(eased + TRIAL_UPDATES, 1));
        assert!(!pressure.rise(eased + TRIAL_UPDATES + 1, 1));
    }

    #[test]
    fn a_trial_passes_once() {
        let mut pressure = Pressure::new(3);
        let eased = 10 + updates_until_ease(&mut pressure, 11, |_| true);
        assert!(!pressure.has_passed(eased + TRIAL_UPDATES));
        assert!(pressure.has_passed(eased + TRIAL_UPDATES + 1));
        assert!(!pressure.has_passed(eased + TRIAL_UPDATES + 2));
    }
}

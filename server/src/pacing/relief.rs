//! Measures that make updates faster, on a device too slow for eight updates a second, or for seven where the head is still. Pure: the time
//! of each update comes in, and the head's states. The measures in force come out.
//!
//! Measures are taken in the order of [`Measure::ALL`], from the least visible on, while updates take too long. A device that is slow
//! at its rehearsal begins with all of them, and gives them up one by one, the last first. The worth of each is measured so: the time of
//! updates before and after. Before a measure is given up as worthless, it is taken and timed once more: other programs make times vary.
//! It then stays given up for a while. The last measure ends when its time would fit again.

use shadecast_protocol::message::HeadState;
use shadecast_protocol::time::ServerTime;

/// Updates a second below which measures are taken: of a head that moves, and of one that is still and sees every detail.
const LEAST_RATE_HZ: f64 = 8.0;
const LEAST_RATE_STILL_HZ: f64 = 7.0;
/// A head is still that has not been faster than this for so long.
const STILL_M_S: f32 = 0.1;
const STILL_RAD_S: f32 = 0.1;
const STILL_AFTER_NS: i64 = 1_000_000_000;
/// Updates after a change until their time counts: the budget of shading follows its own speed, other LODs come one after the other.
const SETTLE_UPDATES: u32 = 2;
const SETTLE_SHADING_UPDATES: u32 = 6;
const SETTLE_LODS_UPDATES: u32 = 32;
/// Updates whose time is then compared.
const MEASURED_UPDATES: u32 = 6;
/// So many updates in a row that are late are judged at once: they take longer than this, and longer by a part than those before. While
/// LODs change some are late in any case: all blocks of an instance are new.
const LATE_UPDATES: u32 = 2;
const LATE_LODS_UPDATES: u32 = 4;
const LATE_S: f64 = 1.0 / 6.0;
const LATER_PART: f64 = 0.1;
/// The last measure of unknown worth is given up once in so many updates, to see. First when first blocks have grown.
const TRY_EVERY_UPDATES: u32 = 8;
const FIRST_TRY_UPDATE: u32 = 24;
/// See [`Measure::expected_worth`].
const EXPECTED_WORTH_OF_ONE_TIME: f64 = 0.35;
const EXPECTED_WORTH_OF_LODS: f64 = 0.45;
/// A measure must save this part of an update's time.
const LEAST_WORTH: f64 = 0.04;
/// A rehearsal's update is of few pixels: one that takes this part of what is allowed says that a viewer's will take more than that.
const REHEARSED_PART: f64 = 0.25;
/// More is not believed of a measure.
const MOST_WORTH: f64 = 0.9;
/// A measure ends when updates without it would take this part of the time that is allowed.
const ROOMY: f64 = 0.9;
/// So many updates with room end a measure, at first and at most. A measure that had to come back doubles the wait.
const FIRST_WAIT_UPDATES: u32 = 15;
const LONGEST_WAIT_UPDATES: u32 = 960;
/// The part of the texels that are shaded again where that is a measure.
const LESS_SHADING: u64 = 3;
/// The part of them that blocks of another size are on a slow device.
const RESIZED_PART: u64 = 4;
/// A measure without worth is tried again after so many updates.
const FORGET_UPDATES: u32 = 600;

/// Something that an update can do without.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Measure {
    /// No look at the surroundings of the head.
    NoSurround,
    /// A third of the texels that are shaded again beside what is new.
    LessShading,
    /// One sample a texel, not four, where textures are finer than a pixel.
    OneSample,
    /// Visibility at one of the three predicted times, in turn.
    OneTime,
    /// Levels of detail with twice the error, and shadows of no finer ones.
    TwiceTheError,
    /// Twice as much again.
    FourTimesTheError,
    /// Half the ID buffer's width and height.
    FewerIds,
    /// Half the texels of each block.
    FewerTexels,
    /// Four times as much again.
    SixteenTimesTheError,
}

impl Measure {
    /// In the order in which they are taken.
    pub const ALL: [Self; 9] = [
        Self::NoSurround,
        Self::LessShading,
        Self::OneSample,
        Self::OneTime,
        Self::TwiceTheError,
        Self::FourTimesTheError,
        Self::FewerIds,
        Self::FewerTexels,
        Self::SixteenTimesTheError,
    ];

    /// Factor on the error of levels of detail.
    pub(crate) fn error(self) -> f32 {
        match self {
            Self::TwiceTheError | Self::FourTimesTheError => 2.0,
            Self::SixteenTimesTheError => 4.0,
            _ => 1.0,
        }
    }

    /// The part of an update's time that it is taken to save until it was tried. One that has such is not given up just to see: with other
    /// levels of detail all blocks are new, and again after; at three times an update takes half as long again.
    fn expected_worth(self) -> Option<f64> {
        match self {
            Self::OneTime => Some(EXPECTED_WORTH_OF_ONE_TIME),
            Self::TwiceTheError | Self::FourTimesTheError => Some(EXPECTED_WORTH_OF_LODS),
            _ => None,
        }
    }

    /// Updates until it is in force, or given up, for all that is shown.
    fn settle_updates(self) -> u32 {
        match self {
            Self::LessShading => SETTLE_SHADING_UPDATES,
            _ if self.error() > 1.0 => SETTLE_LODS_UPDATES,
            _ => SETTLE_UPDATES,
        }
    }
}

/// The measures in force.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Measures([bool; Measure::ALL.len()]);

impl Measures {
    /// All in force.
    pub(crate) const ALL: Self = Self([true; Measure::ALL.len()]);

    /// The first so many of [`Measure::ALL`] in force.
    pub fn first(count: usize) -> Self {
        Self(std::array::from_fn(|measure| measure < count))
    }

    /// One in force.
    pub fn only(measure: Measure) -> Self {
        Self(Measure::ALL.map(|other| other == measure))
    }

    /// Whether any is in force.
    pub fn are_some(self) -> bool {
        self != Self::default()
    }

    /// Factor on the error of levels of detail.
    pub(crate) fn error(self) -> f32 {
        Measure::ALL.iter().filter(|measure| self.has(**measure)).map(|measure| measure.error()).product()
    }

    /// How many texels are shaded again where a device has the time for so many; all where it has for all.
    pub(crate) fn shaded_again(self, most_texels: u64) -> u64 {
        let is_less = self.has(Measure::LessShading) && most_texels != u64::MAX;
        if is_less { most_texels / LESS_SHADING } else { most_texels }
    }

    /// How many texels the blocks have together that are given another size in turn: on a slow device a part of what is shaded again,
    /// whether or not that is less. More is allowed the slower updates are, and new sizes make them slower.
    pub(crate) fn resized(self, most_texels: u64) -> u64 {
        if self.are_some() { most_texels / RESIZED_PART } else { u64::MAX }
    }

    /// Whether a measure is in force.
    pub fn has(self, measure: Measure) -> bool {
        self.0[measure as usize]
    }
}

/// What is being tried: a measure, and the time of updates before it was taken, or given up.
#[derive(Clone, Copy, Debug)]
struct Trial {
    measure: usize,
    before_s: f64,
    is_taken: bool,
    /// It was given up just before, and seemed to have saved this part.
    given_up: Option<f64>,
}

/// One viewer's.
#[derive(Clone, Debug)]
pub(crate) struct Relief {
    period_s: f64,
    allowed_s: f64,
    /// When the head moved last.
    moved: Option<ServerTime>,
    measures: Measures,
    /// The part of an update's time that a measure saved when it was tried last, and the update of that.
    worth: [Option<(f64, u32)>; Measure::ALL.len()],
    trial: Option<Trial>,
    update: u32,
    /// The update at which something was tried last.
    tried: u32,
    /// Updates until their time counts, those that count, and the sum of their times.
    settles: u32,
    counted: u32,
    sum_s: f64,
    /// The mean of those that were counted before.
    before_s: f64,
    /// Updates in a row that were late, and the sum of their times.
    late: u32,
    late_sum_s: f64,
    roomy_updates: u32,
    wait_updates: u32,
}

impl Relief {
    /// For updates that are wanted once in `period_s`. Where even the rehearsal's took longer than is allowed, a first picture is made
    /// with all measures, and soon.
    pub(crate) fn new(period_s: f64, rehearsed_s: Option<f64>) -> Self {
        let allowed_s = period_s.max(1.0 / LEAST_RATE_HZ);
        let is_slow = rehearsed_s.is_some_and(|rehearsed_s| rehearsed_s > REHEARSED_PART * allowed_s);
        Self {
            period_s,
            allowed_s,
            moved: None,
            measures: if is_slow { Measures::ALL } else { Measures::default() },
            worth: Measure::ALL.map(|measure| measure.expected_worth().map(|worth| (worth, 0))),
            trial: None,
            update: 0,
            tried: FIRST_TRY_UPDATE - TRY_EVERY_UPDATES,
            settles: SETTLE_UPDATES,
            counted: 0,
            sum_s: 0.0,
            before_s: 0.0,
            late: 0,
            late_sum_s: 0.0,
            roomy_updates: 0,
            wait_updates: FIRST_WAIT_UPDATES,
        }
    }

    /// The measures for the next update.
    pub(crate) fn measures(&self) -> Measures {
        self.measures
    }

    /// The newest state of the viewer's head.
    pub(crate) fn head(&mut self, state: &HeadState) {
        let moves =
            state.linear_velocity.length() > STILL_M_S || state.angular_velocity.length() > STILL_RAD_S;
        self.moved = if moves { Some(state.time) } else { self.moved };
        let is_still = self.moved.is_none_or(|moved| state.time.since(moved) > STILL_AFTER_NS);
        let least_hz = if is_still { LEAST_RATE_STILL_HZ } else { LEAST_RATE_HZ };
        self.allowed_s = self.period_s.max(1.0 / least_hz);
    }

    /// An update took so long, from the one before where this machine is the bound.
    pub(crate) fn note(&mut self, took_s: f64) {
        self.update += 1;
        let Some(mean_s) = self.late_mean_s(took_s).or_else(|| self.settled_mean_s(took_s)) else { return };
        (self.counted, self.sum_s, self.before_s) = (0, 0.0, mean_s);
        if self.ends_trial(mean_s) {
            return;
        }
        let is_too_slow = mean_s > self.allowed_s;
        if is_too_slow {
            self.roomy_updates = 0;
        }
        let begins_trial = is_too_slow && self.take_next(mean_s) || self.give_up_unknown(mean_s);
        if !begins_trial && !is_too_slow {
            self.end_last(mean_s);
        }
    }

    /// The mean of updates that are late, where there are enough of them to act. A measure just taken is given time: LODs come as new blocks.
    fn late_mean_s(&mut self, took_s: f64) -> Option<f64> {
        let is_taking = self.trial.is_some_and(|trial| trial.is_taken);
        let usual_s = self.trial.map_or(self.before_s, |trial| trial.before_s);
        if is_taking || usual_s == 0.0 || took_s <= LATE_S.max(usual_s * (1.0 + LATER_PART)) {
            (self.late, self.late_sum_s) = (0, 0.0);
            return None;
        }
        self.late += 1;
        self.late_sum_s += took_s;
        let lods_change = self.trial.is_some_and(|trial| Measure::ALL[trial.measure].error() > 1.0);
        if self.late < if lods_change && self.settles > 0 { LATE_LODS_UPDATES } else { LATE_UPDATES } {
            return None;
        }
        self.settles = 0;
        Some(std::mem::take(&mut self.late_sum_s) / f64::from(std::mem::take(&mut self.late)))
    }

    /// The mean of updates since the last change has settled, where there are enough of them.
    fn settled_mean_s(&mut self, took_s: f64) -> Option<f64> {
        if self.settles > 0 {
            self.settles -= 1;
            return None;
        }
        self.counted += 1;
        self.sum_s += took_s;
        (self.counted == MEASURED_UPDATES).then(|| self.sum_s / f64::from(MEASURED_UPDATES))
    }

    /// Judges what was tried. True where that changes the measures.
    fn ends_trial(&mut self, mean_s: f64) -> bool {
        let Some(Trial { measure, before_s, is_taken, given_up }) = self.trial.take() else { return false };
        let (with_s, without_s) = if is_taken { (mean_s, before_s) } else { (before_s, mean_s) };
        let now_part = 1.0 - with_s / without_s;
        let is_needed = without_s > ROOMY * self.allowed_s;
        if !is_taken && is_needed && now_part < LEAST_WORTH {
            let given_up = Some(now_part);
            self.begin_trial(Trial { measure, before_s: mean_s, is_taken: true, given_up });
            return true;
        }
        let saved_part = given_up.map_or(now_part, |part| (part + now_part) / 2.0);
        self.worth[measure] = Some((saved_part, self.update));
        let is_wanted = saved_part >= LEAST_WORTH && is_needed;
        if is_wanted != is_taken {
            self.set(measure, is_wanted);
        }
        is_wanted != is_taken
    }

    /// Takes the next measure that may be worth it, if there is one.
    fn take_next(&mut self, mean_s: f64) -> bool {
        let is_worthless = |measure: usize| {
            self.worth[measure].is_some_and(|(saved_part, update)| {
                saved_part < LEAST_WORTH && self.update - update < FORGET_UPDATES
            })
        };
        let next = (0..Measure::ALL.len()).find(|at| !self.measures.0[*at] && !is_worthless(*at));
        let Some(measure) = next else { return false };
        if self.worth[measure].is_some_and(|(saved_part, _)| saved_part >= LEAST_WORTH) {
            self.wait_updates = (2 * self.wait_updates).min(LONGEST_WAIT_UPDATES);
        }
        self.begin_trial(Trial { measure, before_s: mean_s, is_taken: true, given_up: None });
        true
    }

    /// Gives up the last measure of unknown worth, if there is one, to see.
    fn give_up_unknown(&mut self, mean_s: f64) -> bool {
        let is_unknown = |at: &usize| self.measures.0[*at] && self.worth[*at].is_none();
        let last = (0..Measure::ALL.len()).rev().find(is_unknown);
        let Some(measure) = last.filter(|_| self.update >= self.tried + TRY_EVERY_UPDATES) else {
            return false;
        };
        self.begin_trial(Trial { measure, before_s: mean_s, is_taken: false, given_up: None });
        true
    }

    fn begin_trial(&mut self, trial: Trial) {
        self.tried = self.update;
        self.trial = Some(trial);
        self.set(trial.measure, trial.is_taken);
    }

    /// Ends the last measure once there was room for a while.
    fn end_last(&mut self, mean_s: f64) {
        let Some(last) = (0..Measure::ALL.len()).rev().find(|at| self.measures.0[*at]) else { return };
        let saved_part = self.worth[last].map_or(0.0, |(saved_part, _)| saved_part.clamp(0.0, MOST_WORTH));
        let has_room = mean_s / (1.0 - saved_part) <= ROOMY * self.allowed_s;
        self.roomy_updates = if has_room { self.roomy_updates + MEASURED_UPDATES } else { 0 };
        if self.roomy_updates >= self.wait_updates {
            self.roomy_updates = 0;
            self.begin_trial(Trial { measure: last, before_s: mean_s, is_taken: false, given_up: None });
        }
    }

    fn set(&mut self, measure: usize, is_in_force: bool) {
        tracing::debug!("{:?} is {}", Measure::ALL[measure], if is_in_force { "taken" } else { "given up" });
        self.measures.0[measure] = is_in_force;
        (self.settles, self.counted, self.sum_s) = (Measure::ALL[measure].settle_updates(), 0, 0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use shadecast_protocol::ids::DiscontinuityId;
    use shadecast_protocol::pose::{Eye, Fov, Pose};

    /// A device whose updates take `base_s`, less for each measure in force.
    fn took_s(relief: &Relief, base_s: f64, saves: [f64; 9]) -> f64 {
        let in_force = Measure::ALL.iter().zip(saves).filter(|(measure, _)| relief.measures().has(**measure));
        base_s * (1.0 - in_force.map(|(_, part)| part).sum::<f64>())
    }

    fn after(relief: &mut Relief, updates: u32, base_s: f64, saves: [f64; 9]) -> [bool; 9] {
        (0..updates).for_each(|_| relief.note(took_s(relief, base_s, saves)));
        relief.measures.0
    }

    fn fast() -> Relief {
        Relief::new(1.0 / 30.0, Some(0.01))
    }

    const SAVES: [f64; 9] = [0.1, 0.15, 0.05, 0.15, 0.1, 0.1, 0.05, 0.1, 0.1];

    #[test]
    fn a_device_that_makes_eight_updates_a_second_gives_nothing_up() {
        assert_eq!(after(&mut fast(), 1000, 0.12, SAVES), [false; 9]);
    }

    #[test]
    fn a_slow_device_takes_measures_in_order_until_updates_are_fast_enough() {
        assert_eq!(
            after(&mut fast(), 60, 0.2, SAVES),
            [true, true, true, true, false, false, false, false, false]
        );
        assert_eq!(after(&mut fast(), 200, 1.0, SAVES), [true; 9]);
    }

    #[test]
    fn a_device_that_is_slow_at_its_rehearsal_begins_with_all_measures_and_keeps_those_of_worth() {
        let slow = || Relief::new(1.0 / 30.0, Some(0.2));
        assert_eq!(slow().measures(), Measures::ALL);
        assert_eq!(after(&mut slow(), 300, 1.0, SAVES), [true; 9]);
        let some = [0.1, 0.0, 0.0, 0.3, 0.1, 0.1, 0.0, 0.0, 0.2];
        assert_eq!(
            after(&mut slow(), 400, 1.0, some),
            [true, false, false, true, true, true, false, false, true]
        );
        assert_eq!(after(&mut slow(), 1000, 0.05, SAVES), [false; 9], "it was not slow after all");
    }

    #[test]
    fn a_measure_of_worth_is_not_lost_to_another_program_that_ends_as_it_is_tried() {
        let mut relief = Relief::new(1.0 / 30.0, Some(0.2));
        let mut moments = 0;
        for _ in 0..400 {
            let before = relief.measures().has(Measure::LessShading);
            // Until it was given up for the first time, a program takes a quarter of the device.
            let base_s = if moments == 0 { 1.25 } else { 1.0 };
            relief.note(took_s(&relief, base_s, SAVES));
            moments += u32::from(before && !relief.measures().has(Measure::LessShading));
        }
        assert!(moments > 0 && relief.measures().has(Measure::LessShading));
    }

    #[test]
    fn the_first_measures_are_those_that_are_taken_first() {
        assert_eq!(Measures::first(0), Measures::default());
        assert_eq!(Measures::first(9), Measures::ALL);
        assert!(Measures::first(4).has(Measure::OneTime) && !Measures::first(4).has(Measure::TwiceTheError));
    }

    #[test]
    fn a_measure_without_worth_is_given_up() {
        let some = [0.1, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!(
            after(&mut fast(), 300, 1.0, some),
            [true, false, false, true, false, false, false, false, false]
        );
        assert_eq!(after(&mut fast(), 320, 0.7, [0.0; 9]), [false; 9], "nothing helps: nothing is given up");
    }

    #[test]
    fn a_head_that_moves_is_shown_more_updates_than_a_still_one() {
        let head = |at_s: i64, speed_m_s: f32| HeadState {
            sequence: 0,
            time: ServerTime(at_s * 1_000_000_000),
            world_from_head: Pose::IDENTITY,
            linear_velocity: Vec3::X * speed_m_s,
            angular_velocity: Vec3::ZERO,
            eyes: [Eye { head_from_eye: Pose::IDENTITY, fov: Fov::symmetric_degrees(90.0) }; 2],
            discontinuity: DiscontinuityId(0),
        };
        let mut relief = fast();
        relief.head(&head(0, 0.01));
        assert_eq!(after(&mut relief, 100, 0.135, SAVES), [false; 9]);
        relief.head(&head(1, 1.0));
        assert_ne!(after(&mut relief, 20, 0.135, SAVES), [false; 9]);
        [2, 3].iter().for_each(|at_s| relief.head(&head(*at_s, 0.0)));
        assert_eq!(after(&mut relief, 200, 0.1, SAVES), [false; 9]);
    }

    #[test]
    fn a_measure_is_taken_back_after_two_late_updates_and_of_lods_after_four() {
        let updates_without = |measure: Measure| {
            let mut saves = [0.0; 9];
            saves[measure as usize] = 0.4;
            let mut relief = Relief::new(1.0 / 30.0, Some(0.2));
            let mut has = [true; 200];
            for has in &mut has {
                relief.note(took_s(&relief, 0.25, saves));
                *has = relief.measures().has(measure);
            }
            let given_up = has.iter().position(|has| !has).unwrap();
            has[given_up..].iter().position(|has| *has).unwrap() as u32
        };
        assert_eq!(updates_without(Measure::FewerTexels), LATE_UPDATES, "given up once, to see");
        assert_eq!(updates_without(Measure::SixteenTimesTheError), LATE_LODS_UPDATES);
    }

    #[test]
    fn measures_end_when_there_is_room() {
        let mut relief = fast();
        after(&mut relief, 200, 1.0, SAVES);
        assert_eq!(after(&mut relief, 1200, 0.05, SAVES), [false; 9]);
    }

    #[test]
    fn a_device_at_the_edge_changes_seldom() {
        let (mut relief, mut changes) = (fast(), 0);
        for update in 0..8 * 600u32 {
            let before = relief.measures();
            let base_s = if update / 40 % 2 == 0 { 0.11 } else { 0.135 };
            relief.note(took_s(&relief, base_s, SAVES));
            changes += u32::from(relief.measures() != before);
        }
        assert!(changes < 60, "{changes} changes in ten minutes");
    }
}

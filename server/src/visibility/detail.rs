//! Which level of detail each instance is shown at, for one viewer. Pure.
//!
//! A level will do while its error, as large as the nearest predicted eye sees it, stays within so many pixels, which follow from
//! what bits and time there are (`density`). It is given up at once when it does not, and a coarser one is taken only when
//! there is room to spare. Where what is seen would not fit the client, the error that is allowed grows for all: in steps, which are
//! taken back one after the other once there has been room for a while. Which patches of a level will be seen is only known once
//! it was looked at; until then as large a part of them is taken to be seen as of the level that is shown.

use crate::pacing::pressure::{Level, Pressure};
use crate::pacing::room::Room;
use crate::visibility::culling::Needed;
use crate::visibility::lod_set::Levels;

/// Pixels of the client's display that a level's error may have unless asked otherwise; see `docs/decisions.md`.
pub const DEFAULT_DETAIL_PIXELS: f32 = 0.5;
/// A coarser level is taken when its error is below this part of what is allowed.
const COARSER_BELOW: f32 = 0.7;
/// Under pressure the allowed error grows by this factor with every step.
const STEP: f32 = 1.25;
/// More steps than any scene needs: with them an error a million times as large is allowed.
const MOST_STEPS: u32 = 62;
/// Part of the client's slots that the estimate may fill: what enters and leaves overlaps.
const FILL: f32 = 0.8;
/// Part of the triangles that a client draws that the estimate may fill.
const FILL_TRIANGLES: f32 = 0.9;
/// A step is taken back when the estimate with one less leaves what is needed below this part of what may be filled.
const ROOMY: f32 = 0.8;
/// A step that had to be taken again soon after makes the next try wait for that much more room.
const MORE_ROOM: f32 = 0.85;
const MOST_ROOM: f32 = 0.3;
/// Part of a level's patches that is taken to be seen of what was never looked at: more than half of a closed surface is rare.
const UNKNOWN_SHARE: f32 = 0.6;
/// Vertices at the rim of what is seen, as a factor.
const RIM: f32 = 1.1;
/// Levels change in one of so many updates alone: in these the scene is looked at twice.
const CHANGE_EVERY_UPDATES: u32 = 4;

/// A level of detail of an instance, the finest first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LevelCost {
    /// Error of its surface, metres of the model.
    pub error_m: f32,
    /// Patches.
    pub patches: u32,
    /// Vertices.
    pub vertices: u32,
    /// Triangles that are drawn, of two sides twice.
    pub triangles: u32,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct Detail {
    asked_pixels: f32,
    /// So many times as much is allowed where nothing presses.
    error: f32,
    /// By instance.
    costs: Vec<Vec<LevelCost>>,
    states: Vec<State>,
    pressure: Pressure<Steps>,
    /// What [`ROOMY`] has come to.
    roomy: f32,
    update: u32,
}

#[derive(Clone, Copy, Debug)]
struct State {
    is_needed: bool,
    /// What the client shows, once the instance was needed.
    shown: Option<usize>,
    wanted: usize,
    /// Part of the patches of the level that is shown that were seen.
    share: f32,
    /// Pixels of a metre of the model, as near as any predicted eye comes.
    pixels_per_metre: f32,
}

impl State {
    /// The level to want when so many pixels of error are allowed: the one that was, where it will do and no coarser one
    /// would do with room to spare.
    fn level(&self, costs: &[LevelCost], allowed_pixels: f32) -> usize {
        let coarsest = |pixels: f32| {
            costs.iter().rposition(|cost| cost.error_m * self.pixels_per_metre <= pixels).unwrap_or(0)
        };
        self.wanted.clamp(coarsest(COARSER_BELOW * allowed_pixels), coarsest(allowed_pixels))
    }
}

/// How many times the allowed error has grown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Steps(u32);

impl Level for Steps {
    fn finer(self) -> Option<Self> {
        self.0.checked_sub(1).map(Self)
    }
}

/// What is seen, about.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Seen {
    patches: f32,
    vertices: f32,
    triangles: f32,
}

impl Seen {
    fn of(cost: LevelCost, share: f32) -> Self {
        Self {
            patches: cost.patches as f32 * share,
            vertices: cost.vertices as f32 * (share * RIM).min(1.0),
            triangles: cost.triangles as f32 * share,
        }
    }
}

impl Detail {
    /// Levels with an error of so many pixels; with 0 everything is shown in full detail, whether there is room for it or not.
    /// `costs`: the levels by instance, one at least.
    pub fn new(asked_pixels: f32, costs: Vec<Vec<LevelCost>>) -> Self {
        let state =
            State { is_needed: false, shown: None, wanted: 0, share: UNKNOWN_SHARE, pixels_per_metre: 0.0 };
        Self {
            asked_pixels,
            error: 1.0,
            states: vec![state; costs.len()],
            costs,
            pressure: Pressure::new(Steps(0)),
            roomy: ROOMY,
            update: 0,
        }
    }

    /// An update begins for a client with this room, which needs some instances and sees a metre of each of their models with so many pixels at most. Levels may
    /// err by so many times as much as was asked for.
    pub fn begin(&mut self, room: Room, needed: &Needed, pixels_per_metre: &[f32], error: f32) {
        self.error = error;
        self.update += 1;
        for (instance, state) in self.states.iter_mut().enumerate() {
            (state.is_needed, state.pixels_per_metre) = (needed.has(instance), pixels_per_metre[instance]);
            if !state.is_needed {
                (state.shown, state.share) = (None, UNKNOWN_SHARE);
            }
        }
        if self.asked_pixels > 0.0 {
            self.relieve(room);
            let is_tight = !self.fits(room, self.steps());
            if is_tight {
                self.press(room);
            }
            let may_change = is_tight || self.update % CHANGE_EVERY_UPDATES == 1;
            self.want(|state| may_change || state.shown.is_none());
        }
        // What is not on display is not missed.
        for state in self.states.iter_mut().filter(|state| state.is_needed) {
            let on_display = state.shown.filter(|_| state.share > 0.0);
            state.shown = Some(on_display.unwrap_or(state.wanted));
        }
    }

    /// The levels of all instances in their order; `None` for what is not needed.
    pub fn levels(&self) -> impl Iterator<Item = Option<Levels>> + '_ {
        self.states.iter().map(|state| {
            let shown = state.shown?;
            Some(Levels { shown, next: (state.wanted != shown).then_some(state.wanted) })
        })
    }

    /// By instance the finest level that is looked at.
    pub fn finest(&self) -> impl Iterator<Item = usize> + '_ {
        self.levels()
            .map(|levels| levels.map_or(0, |levels| levels.next.unwrap_or(levels.shown).min(levels.shown)))
    }

    /// The client shows an instance's next level from this update on.
    pub fn switched(&mut self, instance: usize) {
        let state = &mut self.states[instance];
        state.shown = Some(state.wanted);
    }

    /// So many patches of what an instance shows were seen lately.
    pub fn measured(&mut self, instance: usize, patches: u32) {
        let state = &mut self.states[instance];
        let Some(level) = state.shown else { return };
        state.share = (patches as f32 / self.costs[instance][level].patches.max(1) as f32).min(1.0);
    }

    /// What was measured does not fit: coarser levels are wanted. False where there are none.
    pub(crate) fn tighten(&mut self, room: Room) -> bool {
        let wanted = |states: &[State]| states.iter().map(|state| state.wanted).collect::<Vec<_>>();
        let before = wanted(&self.states);
        while self.asked_pixels > 0.0 && wanted(&self.states) == before {
            if self.is_coarsest(self.steps()) {
                return false;
            }
            self.press(room);
            self.want(|_| true);
        }
        self.asked_pixels > 0.0
    }

    /// Pixels of error that are allowed now.
    pub(crate) fn allowed_pixels(&self) -> f32 {
        self.allowed(self.steps())
    }

    fn steps(&self) -> u32 {
        self.pressure.level().0
    }

    fn allowed(&self, steps: u32) -> f32 {
        self.asked_pixels * self.error * STEP.powi(steps as i32)
    }

    fn want(&mut self, may_change: impl Fn(&State) -> bool) {
        let allowed = self.allowed_pixels();
        for (state, costs) in self.states.iter_mut().zip(&self.costs).filter(|(state, _)| may_change(state)) {
            state.wanted = state.level(costs, allowed);
        }
    }

    /// Steps until what is seen fits, one at least.
    fn press(&mut self, room: Room) {
        let mut steps = (self.steps() + 1).min(MOST_STEPS);
        while !self.fits(room, steps) && !self.is_coarsest(steps) {
            steps += 1;
        }
        if self.pressure.rise(self.update, Steps(steps)) {
            self.roomy = (self.roomy * MORE_ROOM).max(MOST_ROOM);
        }
        self.pressure.start_over();
    }

    /// Takes steps back once there has been room for a while.
    fn relieve(&mut self, room: Room) {
        let mut pressure = self.pressure;
        if pressure.has_passed(self.update) {
            self.roomy = ROOMY;
        }
        pressure.recover(self.update, |Steps(steps)| self.need(room, steps) <= self.roomy);
        self.pressure = pressure;
    }

    /// Whether everything is at its coarsest with so many steps.
    fn is_coarsest(&self, steps: u32) -> bool {
        let allowed = self.allowed(steps);
        let mut needed = self.states.iter().zip(&self.costs).filter(|(state, _)| state.is_needed);
        steps == MOST_STEPS || needed.all(|(state, costs)| state.level(costs, allowed) + 1 == costs.len())
    }

    fn fits(&self, room: Room, steps: u32) -> bool {
        self.need(room, steps) <= 1.0
    }

    /// What would be seen with so many steps, as a part of what may be filled.
    fn need(&self, room: Room, steps: u32) -> f32 {
        let allowed = self.allowed(steps);
        let (mut all, mut most) = (Seen::default(), Seen::default());
        for (state, costs) in self.states.iter().zip(&self.costs).filter(|(state, _)| state.is_needed) {
            let seen = Seen::of(costs[state.level(costs, allowed)], state.share);
            all.patches += seen.patches;
            all.vertices += seen.vertices;
            all.triangles += seen.triangles;
            most.patches = most.patches.max(seen.patches);
            most.vertices = most.vertices.max(seen.vertices);
        }
        // While an instance changes its level, the client's memory holds both.
        let slots = |all: f32, most: f32, room: u32| (all + most) / (FILL * room as f32);
        slots(all.patches, most.patches, room.patches)
            .max(slots(all.vertices, most.vertices, room.vertices))
            .max(all.triangles / (FILL_TRIANGLES * room.triangles as f32))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pacing::pressure::RECOVER_AFTER_UPDATES;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    const ROOM: Room = Room { patches: 131_072, vertices: 131_072, triangles: 786_432 };

    /// Levels of which each has half the triangles of the one before, and twice its error.
    fn chain(patches: u32, error_m: f32, levels: u32) -> Vec<LevelCost> {
        let cost = |level: u32| LevelCost {
            error_m: if level == 0 { 0.0 } else { error_m * (1 << level) as f32 },
            patches: (patches >> level).max(1),
            vertices: ((patches + patches / 10) >> level).max(3),
            triangles: ((2 * patches) >> level).max(1),
        };
        (0..levels).map(cost).collect()
    }

    fn shown(detail: &Detail) -> Vec<usize> {
        detail.levels().flatten().map(|levels| levels.next.unwrap_or(levels.shown)).collect()
    }

    /// An update after which everything that is wanted is shown, and `share` of its patches was seen.
    fn update(detail: &mut Detail, pixels_per_metre: &[f32], share: f32) -> Vec<usize> {
        update_in(ROOM, detail, pixels_per_metre, share)
    }

    fn update_in(room: Room, detail: &mut Detail, pixels_per_metre: &[f32], share: f32) -> Vec<usize> {
        detail.begin(room, &Needed::all(pixels_per_metre.len()), pixels_per_metre, 1.0);
        let levels = shown(detail);
        for (instance, level) in levels.iter().enumerate() {
            detail.switched(instance);
            let seen = detail.costs[instance][*level].patches as f32 * share;
            detail.measured(instance, seen as u32);
        }
        levels
    }

    #[test]
    fn the_error_that_is_seen_is_within_what_is_allowed_and_grows_with_distance() {
        let mut rng = SmallRng::seed_from_u64(5);
        for case in 0..300 {
            let costs = chain(rng.random_range(100..5000), rng.random_range(0.001..0.1), 6);
            let mut detail = Detail::new(1.0, vec![costs.clone(); 8]);
            let mut near = rng.random_range(20.0..2000.0f32);
            let pixels: Vec<f32> = (0..8)
                .map(|_| {
                    near *= rng.random_range(0.3..1.0);
                    near
                })
                .collect();
            let levels = update(&mut detail, &pixels, 0.5);
            assert!(levels.is_sorted(), "seed 5, case {case}: {levels:?} at {pixels:?}");
            for (level, pixels) in levels.iter().zip(&pixels) {
                assert!(costs[*level].error_m * pixels <= 1.0, "seed 5, case {case}");
                let coarser = costs.get(level + 1).map(|cost| cost.error_m * pixels);
                assert!(coarser.is_none_or(|error| error > COARSER_BELOW), "seed 5, case {case}");
            }
        }
    }

    #[test]
    fn a_distance_that_trembles_by_a_tenth_does_not_change_the_level() {
        let mut detail = Detail::new(1.0, vec![chain(1000, 0.01, 6)]);
        let mut changes = 0;
        for middle in [3.0f32, 12.0, 45.0, 49.0, 51.0, 70.0, 100.0] {
            (0..8).for_each(|_| drop(update(&mut detail, &[middle * 1.05], 0.5)));
            let mut before = update(&mut detail, &[middle * 1.05], 0.5);
            for step in 0..40 {
                let tremble = if step % 8 < 4 { 0.95 } else { 1.05 };
                let now = update(&mut detail, &[middle * tremble], 0.5);
                changes += usize::from(now != before);
                before = now;
            }
        }
        assert_eq!(changes, 0);
    }

    #[test]
    fn levels_may_err_by_as_many_times_what_was_asked_for_as_they_are_told() {
        let level = |asked_pixels: f32, error: f32| {
            let mut detail = Detail::new(asked_pixels, vec![chain(1000, 0.01, 6)]);
            detail.begin(ROOM, &Needed::all(1), &[20.0], error);
            (shown(&detail), detail.allowed_pixels())
        };
        let [fine, asked, coarse] = [0.5, 1.0, 2.0].map(|error| level(1.0, error));
        assert!(fine.0 < asked.0 && asked.0 < coarse.0, "{fine:?} {asked:?} {coarse:?}");
        assert_eq!((fine, coarse), (level(0.5, 1.0), level(2.0, 1.0)));
    }

    #[test]
    fn without_an_allowed_error_everything_has_full_detail() {
        let room = Room { patches: 10, vertices: 10, triangles: 10 };
        let mut detail = Detail::new(0.0, vec![chain(1000, 0.01, 6); 3]);
        assert_eq!(update_in(room, &mut detail, &[0.001; 3], 1.0), [0; 3]);
        assert!(!detail.tighten(room));
    }

    #[test]
    fn what_does_not_fit_becomes_coarser_until_it_does_and_then_stays_as_it_is() {
        let mut rng = SmallRng::seed_from_u64(17);
        for case in 0..100 {
            let count = rng.random_range(1..60);
            let costs: Vec<_> = (0..count)
                .map(|_| chain(rng.random_range(200..5000), rng.random_range(0.001..0.05), 7))
                .collect();
            let coarsest: u32 = costs.iter().map(|costs| costs[6].patches).sum();
            let room = coarsest * rng.random_range(4..40);
            let room = Room { patches: room, vertices: 2 * room, triangles: 4 * room };
            let share = rng.random_range(0.2..0.9);
            let mut detail = Detail::new(1.0, costs.clone());
            let pixels: Vec<f32> = (0..count).map(|_| rng.random_range(1.0..500.0)).collect();
            let history: Vec<Vec<usize>> =
                (0..400).map(|_| update_in(room, &mut detail, &pixels, share)).collect();
            for (number, levels) in history.iter().enumerate().skip(1) {
                let seen: f32 = levels
                    .iter()
                    .zip(&costs)
                    .map(|(level, costs)| costs[*level].patches as f32 * share)
                    .sum();
                assert!(
                    seen <= FILL * room.patches as f32,
                    "seed 17, case {case}, update {number}: {seen} of {room:?}"
                );
            }
            assert!(
                history[250..].iter().all(|levels| *levels == history[250]),
                "seed 17, case {case} swings"
            );
        }
    }

    #[test]
    fn the_error_that_is_allowed_shrinks_again_when_there_is_room() {
        let room = Room { patches: 3000, ..ROOM };
        let mut detail = Detail::new(1.0, vec![chain(1000, 0.01, 6); 20]);
        let near = update_in(room, &mut detail, &[100.0; 20], 0.5);
        assert!(detail.allowed_pixels() > 1.0 && near[0] > 0);
        // All but two go.
        let few: Needed = (0..20).map(|instance| instance < 2).collect();
        for _ in 0..2 * RECOVER_AFTER_UPDATES {
            detail.begin(room, &few, &[100.0; 20], 1.0);
            for instance in [0, 1] {
                detail.switched(instance);
                let level = shown(&detail)[instance];
                detail.measured(instance, detail.costs[instance][level].patches / 2);
            }
        }
        assert_eq!((detail.allowed_pixels(), shown(&detail)), (1.0, vec![0, 0]));
    }

    #[test]
    fn what_is_measured_not_to_fit_is_made_coarser_in_the_same_update() {
        let room = Room { patches: 100_000, ..ROOM };
        let mut detail = Detail::new(1.0, vec![chain(1000, 0.01, 3); 4]);
        update_in(room, &mut detail, &[100.0; 4], 0.5);
        assert_eq!(shown(&detail), [0; 4]);
        assert!(detail.tighten(room) && shown(&detail).iter().all(|level| *level > 0));
        assert!(detail.tighten(room) && shown(&detail) == [2; 4]);
        assert!(!detail.tighten(room), "there is nothing coarser");
    }

    #[test]
    fn a_level_is_shown_once_it_was_brought_unless_nothing_of_the_other_is_seen() {
        let mut detail = Detail::new(1.0, vec![chain(1000, 0.01, 6); 2]);
        update(&mut detail, &[1.0; 2], 0.5);
        let coarse = shown(&detail);
        for _ in 0..CHANGE_EVERY_UPDATES {
            detail.begin(ROOM, &Needed::all(2), &[1000.0; 2], 1.0);
            detail.measured(0, 5);
            detail.measured(1, 0);
        }
        detail.begin(ROOM, &Needed::all(2), &[1000.0; 2], 1.0);
        let levels: Vec<_> = detail.levels().flatten().collect();
        assert_eq!(levels[0], Levels { shown: coarse[0], next: Some(0) });
        assert_eq!(levels[1], Levels { shown: 0, next: None });
    }
}

//! The LOD of each instance, for one viewer. Pure.
//!
//! An LOD is good enough while its error, seen by the nearest predicted eye, stays within the allowed pixels. These follow from the
//! bits and the time there are (`density`). An LOD with a larger error is replaced at once. A coarser one is taken only with room
//! to spare. Where the visible patches would not fit the client, the allowed error grows for all instances, in steps. The steps are
//! taken back one by one once there has been room for a while. The visible share of a new LOD is unknown before its first
//! visibility pass: until then it is taken to be that of the shown LOD.
//!
//! An update brings a bounded number of bytes. Whatever comes into view enters whole: at an LOD that fits these bytes, by the same
//! error for all. Bytes that are left refine first what is near, in the middle of the view, or moves. Finer LODs follow, each whole.

use crate::pacing::pressure::{Coarseness, Pressure};
use crate::pacing::room::Room;
use crate::visibility::culling::Needed;
use crate::visibility::lod_set::LodChoice;
use crate::visibility::nearness::Nearness;

/// Pixels of the client's display that an LOD's error may have unless asked otherwise; see `docs/decisions.md`.
pub const DEFAULT_DETAIL_PIXELS: f32 = 0.5;
/// Measures of a slow device make LODs err by no more than this angle, radians: 17 pixels of a window with 800 rows. More of a small
/// picture would break its shapes.
const MOST_ERROR_RAD: f32 = 0.024;
/// They take no LOD of fewer patches: it saves no time, and each of its blocks is large, and shaded whole where a shadow moves over it.
const LEAST_PATCHES: u32 = 1000;
/// A coarser LOD is taken when its error is below this part of what is allowed.
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
/// Assumed visible share of an LOD without a visibility pass: more than half of a closed surface is rare.
const UNKNOWN_SHARE: f32 = 0.6;
/// Vertices at the rim of what is seen, as a factor.
const RIM: f32 = 1.1;
/// LODs change in one of so many updates only: these need a second ID buffer.
const CHANGE_EVERY_UPDATES: u32 = 4;
/// On a slow device LODs change in one of so many, for this part of what is seen, or for one instance.
const GRADUAL_EVERY_UPDATES: u32 = 8;
const GRADUAL_PART: f32 = 0.25;

/// Factors on the error that LODs may have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ErrorFactors {
    /// By bits and time to spare.
    pub density: f32,
    /// By the measures of a slow device.
    pub measures: f32,
}

/// Pixels of error that LODs may have.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Allowed {
    pixels: f32,
    /// Without the measures of a slow device.
    unmeasured_pixels: f32,
}

/// An LOD of an instance, the finest first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct LodCost {
    /// Error of its surface, metres of the model.
    pub error_m: f32,
    /// Patches.
    pub patches: u32,
    /// Vertices.
    pub vertices: u32,
    /// Triangles that are drawn, of two sides twice.
    pub triangles: u32,
    /// About what all of it takes on the wire.
    pub bytes: u32,
}

/// See the module.
#[derive(Clone, Debug)]
pub(crate) struct Detail {
    asked_pixels: f32,
    /// [`MOST_ERROR_RAD`] as pixels of the client's display.
    most_pixels: f32,
    /// So many times as much is allowed where nothing presses.
    error: ErrorFactors,
    /// By instance.
    costs: Vec<Vec<LodCost>>,
    states: Vec<State>,
    pressure: Pressure<Steps>,
    /// What [`ROOMY`] has come to.
    roomy: f32,
    update: u32,
    /// Bytes of geometry that the update may bring.
    bytes: usize,
    /// The device is slow: LODs change one after the other.
    is_gradual: bool,
}

#[derive(Clone, Copy, Debug)]
struct State {
    is_needed: bool,
    /// What the client shows, once the instance was needed.
    shown: Option<usize>,
    wanted: usize,
    /// What it would want if an update could bring any number of bytes.
    aim: usize,
    /// Part of the patches of the LOD that is shown that were seen.
    share: f32,
    /// Pixels of a metre of the model, as near as any predicted eye comes.
    pixels_per_metre: f32,
    /// How much a person looks at it: [`Nearness::attention`].
    attention: f32,
    /// Bytes have made its LOD coarser: a finer one is wanted with the next update.
    is_hurried: bool,
}

impl State {
    /// The LOD to want when so many pixels of error are allowed: the one that was, where it will do and no coarser one
    /// would do with room to spare.
    fn lod(&self, costs: &[LodCost], allowed: Allowed) -> usize {
        let coarsest = |pixels: f32| {
            costs.iter().rposition(|cost| cost.error_m * self.pixels_per_metre <= pixels).unwrap_or(0)
        };
        let lod = |pixels: f32| self.aim.clamp(coarsest(COARSER_BELOW * pixels), coarsest(pixels));
        let of_worth = costs.iter().rposition(|cost| cost.patches >= LEAST_PATCHES).unwrap_or(0);
        lod(allowed.pixels).min(of_worth.max(lod(allowed.unmeasured_pixels)))
    }

    fn is_on_display(&self) -> bool {
        self.shown.is_some() && self.share > 0.0
    }

    /// Whether it comes into view with this update.
    fn enters(&self) -> bool {
        self.is_needed && !self.is_on_display()
    }

    /// Bytes of what is seen of an LOD of which the client has nothing.
    fn bytes(&self, cost: LodCost) -> usize {
        (cost.bytes as f32 * (self.share * RIM).min(1.0)) as usize
    }
}

/// How many times the allowed error has grown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Steps(u32);

impl Coarseness for Steps {
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
    fn of(cost: LodCost, share: f32) -> Self {
        Self {
            patches: cost.patches as f32 * share,
            vertices: cost.vertices as f32 * (share * RIM).min(1.0),
            triangles: cost.triangles as f32 * share,
        }
    }
}

impl Detail {
    /// LODs with an error of so many pixels, of which a radian has so many; with 0 everything is shown in full detail, whether there
    /// is room for it or not. `costs`: the LODs by instance, one at least.
    pub(crate) fn new(asked_pixels: f32, pixels_per_radian: f32, costs: Vec<Vec<LodCost>>) -> Self {
        let state = State {
            is_needed: false,
            shown: None,
            wanted: 0,
            aim: 0,
            share: UNKNOWN_SHARE,
            pixels_per_metre: 0.0,
            attention: 0.0,
            is_hurried: false,
        };
        Self {
            asked_pixels,
            most_pixels: MOST_ERROR_RAD * pixels_per_radian,
            error: ErrorFactors { density: 1.0, measures: 1.0 },
            states: vec![state; costs.len()],
            costs,
            pressure: Pressure::new(Steps(0)),
            roomy: ROOMY,
            update: 0,
            bytes: usize::MAX,
            is_gradual: false,
        }
    }

    /// An update begins for a client with this room, which needs some instances and sees each from so near. It may bring so
    /// many bytes of geometry. LODs may err by `error` times as much as was asked for.
    pub(crate) fn begin(
        &mut self,
        (room, bytes): (Room, usize),
        needed: &Needed,
        nearness: &[Nearness],
        error: ErrorFactors,
    ) {
        (self.error, self.bytes) = (error, bytes);
        self.update += 1;
        for (instance, state) in self.states.iter_mut().enumerate() {
            state.is_needed = needed.has(instance);
            (state.pixels_per_metre, state.attention) =
                (nearness[instance].pixels_per_metre, nearness[instance].attention);
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
            let every = if self.is_gradual { GRADUAL_EVERY_UPDATES } else { CHANGE_EVERY_UPDATES };
            let may_change = is_tight || self.update % every == 1;
            self.want(|state| may_change || state.is_hurried || state.shown.is_none());
            if self.is_gradual && !is_tight {
                self.change_a_few();
            }
            self.enter_whole();
        }
        // What is not on display is not missed.
        for state in self.states.iter_mut().filter(|state| state.is_needed) {
            let on_display = state.shown.filter(|_| state.share > 0.0);
            state.shown = Some(on_display.unwrap_or(state.wanted));
        }
    }

    /// Whether LODs change one after the other: a device is slow. All blocks of another LOD are new, and both LODs are looked for.
    pub(crate) fn change_gradually(&mut self, is_gradual: bool) {
        self.is_gradual = is_gradual;
    }

    /// Of what is on display, only what is most looked at wants another LOD.
    fn change_a_few(&mut self) {
        let seen = |state: &State, costs: &[LodCost], lod: usize| state.share * costs[lod].patches as f32;
        let of_all = self.states.iter().zip(&self.costs);
        let shown = of_all.filter_map(|(state, costs)| Some(seen(state, costs, state.shown?)));
        let all: f32 = shown.sum();
        let mut changing: Vec<_> = self.states.iter_mut().zip(&self.costs).collect();
        changing.retain(|(state, _)| state.is_on_display() && state.shown != Some(state.wanted));
        changing.sort_by(|(a, _), (b, _)| b.attention.total_cmp(&a.attention));
        let mut changed = 0.0;
        for (state, costs) in changing {
            if changed < GRADUAL_PART * all {
                changed += seen(state, costs, state.wanted);
            } else {
                state.wanted = state.shown.unwrap_or(state.wanted);
            }
        }
    }

    /// What comes into view takes the finest LODs of one error that an update can bring, and what is most looked at finer ones.
    fn enter_whole(&mut self) {
        let steps = (self.steps()..MOST_STEPS).find(|steps| self.entering_bytes(*steps) <= self.bytes);
        let steps = steps.unwrap_or(MOST_STEPS);
        if steps == self.steps() {
            return;
        }
        let (allowed, mut left) =
            (self.allowed(steps), self.bytes.saturating_sub(self.entering_bytes(steps)));
        let mut entering: Vec<(&mut State, &Vec<LodCost>)> =
            self.states.iter_mut().zip(&self.costs).collect();
        entering.retain(|(state, _)| state.enters());
        // What is most looked at is refined first, by what bytes are left.
        entering.sort_by(|(a, _), (b, _)| b.attention.total_cmp(&a.attention));
        for (state, costs) in entering {
            let fits = state.lod(costs, allowed).max(state.wanted);
            let bytes = |lod: usize| state.bytes(costs[lod]);
            let finer = (state.wanted..=fits).find(|lod| bytes(*lod) <= bytes(fits) + left).unwrap_or(fits);
            left -= bytes(finer).saturating_sub(bytes(fits));
            state.is_hurried = finer > state.wanted;
            state.wanted = finer;
        }
    }

    /// Bytes of all that comes into view with so many steps.
    fn entering_bytes(&self, steps: u32) -> usize {
        let allowed = self.allowed(steps);
        let entering = self.states.iter().zip(&self.costs).filter(|(state, _)| state.enters());
        entering.map(|(state, costs)| state.bytes(costs[state.lod(costs, allowed)])).sum()
    }

    /// What instances show lacks so many bytes, by instance: more than the update may bring. They show coarser LODs at once that
    /// it can bring whole. False where none of them has one that takes less.
    pub(crate) fn give_way(&mut self, lacking: &[(usize, usize)]) -> bool {
        let all: usize = lacking.iter().map(|(_, bytes)| bytes).sum();
        let mut has_changed = false;
        for (instance, lacking_bytes) in lacking.iter().copied() {
            let (state, costs) = (&mut self.states[instance], &self.costs[instance]);
            let Some(shown) = state.shown.filter(|_| self.asked_pixels > 0.0) else { continue };
            let part = (self.bytes as f64 * lacking_bytes as f64 / all.max(1) as f64) as usize;
            let fits = |lod: &usize| state.bytes(costs[*lod]) <= part;
            let coarser = (shown + 1..costs.len()).find(fits).unwrap_or(costs.len() - 1);
            if coarser > shown && state.bytes(costs[coarser]) < lacking_bytes {
                (state.shown, state.wanted, state.is_hurried) = (Some(coarser), coarser, true);
                has_changed = true;
            }
        }
        has_changed
    }

    /// The LODs of all instances in their order; `None` for what is not needed.
    pub(crate) fn lods(&self) -> impl Iterator<Item = Option<LodChoice>> + '_ {
        self.states.iter().map(|state| {
            let shown = state.shown?;
            Some(LodChoice { shown, next: (state.wanted != shown).then_some(state.wanted) })
        })
    }

    /// The finest LOD in the LOD set, by instance.
    pub(crate) fn finest(&self) -> impl Iterator<Item = usize> + '_ {
        self.lods().map(|lods| lods.map_or(0, |lods| lods.next.unwrap_or(lods.shown).min(lods.shown)))
    }

    /// The client shows an instance's next LOD from this update on.
    pub(crate) fn switched(&mut self, instance: usize) {
        let state = &mut self.states[instance];
        state.shown = Some(state.wanted);
    }

    /// So many patches of what an instance shows were seen lately.
    pub(crate) fn measured(&mut self, instance: usize, patches: u32) {
        let state = &mut self.states[instance];
        let Some(lod) = state.shown else { return };
        state.share = (patches as f32 / self.costs[instance][lod].patches.max(1) as f32).min(1.0);
    }

    /// What was measured does not fit: coarser LODs are wanted. False where there are none.
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

    /// The largest error of what is on display, pixels of the nearest eye.
    pub(crate) fn shown_error_pixels(&self) -> f32 {
        let on_display = self.states.iter().zip(&self.costs).filter(|(state, _)| state.is_on_display());
        let error = |(state, costs): (&State, &Vec<LodCost>)| {
            Some(costs[state.shown?].error_m * state.pixels_per_metre)
        };
        on_display.filter_map(error).fold(0.0, f32::max)
    }

    /// Pixels of error that are allowed now.
    pub(crate) fn allowed_pixels(&self) -> f32 {
        self.allowed(self.steps()).pixels
    }

    fn steps(&self) -> u32 {
        self.pressure.step().0
    }

    fn allowed(&self, steps: u32) -> Allowed {
        let pixels = |error: f32| {
            let pixels = (self.asked_pixels * error).min(self.most_pixels.max(self.asked_pixels));
            pixels * STEP.powi(steps as i32)
        };
        let ErrorFactors { density, measures } = self.error;
        Allowed { pixels: pixels(density * measures), unmeasured_pixels: pixels(density) }
    }

    fn want(&mut self, may_change: impl Fn(&State) -> bool) {
        let allowed = self.allowed(self.steps());
        for (state, costs) in self.states.iter_mut().zip(&self.costs).filter(|(state, _)| may_change(state)) {
            state.aim = state.lod(costs, allowed);
            state.wanted = state.aim;
            state.is_hurried = false;
            // On the way to it stand LODs that one update can bring.
            let Some(shown) = state.shown.filter(|shown| state.is_on_display() && state.wanted < *shown)
            else {
                continue;
            };
            let fits = |lod: &usize| state.bytes(costs[*lod]) <= self.bytes;
            let next = (state.wanted..shown).find(fits).unwrap_or(shown - 1);
            state.is_hurried = next != state.wanted;
            state.wanted = next;
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
        steps == MOST_STEPS || needed.all(|(state, costs)| state.lod(costs, allowed) + 1 == costs.len())
    }

    fn fits(&self, room: Room, steps: u32) -> bool {
        self.need(room, steps) <= 1.0
    }

    /// What would be seen with so many steps, as a part of what may be filled.
    fn need(&self, room: Room, steps: u32) -> f32 {
        let allowed = self.allowed(steps);
        let (mut all, mut most) = (Seen::default(), Seen::default());
        for (state, costs) in self.states.iter().zip(&self.costs).filter(|(state, _)| state.is_needed) {
            let seen = Seen::of(costs[state.lod(costs, allowed)], state.share);
            all.patches += seen.patches;
            all.vertices += seen.vertices;
            all.triangles += seen.triangles;
            most.patches = most.patches.max(seen.patches);
            most.vertices = most.vertices.max(seen.vertices);
        }
        // While an instance changes its LOD, the client's memory holds both.
        let slots = |all: f32, most: f32, room: u32| (all + most) / (FILL * room as f32);
        slots(all.patches, most.patches, room.patches)
            .max(slots(all.vertices, most.vertices, room.vertices))
            .max(all.triangles / (FILL_TRIANGLES * room.triangles as f32))
    }
}

#[cfg(test)]
mod tests;

//! Where the headset will look from while an update is on display. Pure: state, measurements and time in, views out.

use crate::time::VIEW_TIMES;
use crate::time::view_time::ViewTime;
use crate::visibility::frusta::{self, MIN_MARGIN};
use glam::{Quat, Vec3};
use shadecast_protocol::message::HeadState;
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::time::{Grid, ServerTime, WorldTime};
use shadecast_protocol::world_clock::WorldClock;
use std::collections::VecDeque;

/// Start values until displays are reported: from an update's start to its first and last moment on display.
const START_FIRST_NS: i64 = 50_000_000;
const START_LAST_NS: i64 = 100_000_000;
/// Reports remembered for the horizon.
const REPORTS: usize = 64;
/// The field of view is widened by at most this on each side, radians (20 degrees).
const MAX_MARGIN: f32 = 0.35;
/// Velocities beyond these are tracking errors, not heads.
const MAX_SPEED_M_S: f32 = 10.0;
const MAX_TURN_RAD_S: f32 = 20.0;
/// A head that differs by no more than this from where it was, and is no faster, stands still: what is in view must not change
/// with the last digits of its pose.
const STILL_M: f32 = 5e-5;
const STILL_RAD: f32 = 5e-5;
const STILL_M_S: f32 = 2e-3;
const STILL_RAD_S: f32 = 2e-3;
/// A head is never predicted farther than this, whatever its path looks like.
const MAX_HORIZON_NS: i64 = 400_000_000;
/// A turning head may stop at once or turn on. Beyond the horizon the first view of an update comes back to where the head looks now,
/// and the last shows where it looks if it turns on for so long: between them is what a turn brings into view.
const MAX_TURN_HORIZON_NS: i64 = 2 * MAX_HORIZON_NS;
/// The world is predicted farther, since its clips are known: up to this, for updates that take long and stay long.
const MAX_DELAY_NS: i64 = 4_000_000_000;

/// An update stays on display no longer than so many usual ones.
const MOST_USUAL_DELAYS: i64 = 2;

/// One predicted eye.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Takes eye coordinates to the world's.
    pub world_from_eye: Pose,
    /// Widened by the margin.
    pub fov: Fov,
}

/// What an update is made for.
#[derive(Clone, Debug, PartialEq)]
pub struct PredictedViews {
    /// The world's time when the update is begun.
    pub begun: WorldTime,
    /// Of the world, spread over the interval in which the update will be on display: points of the time grid, and its middle; may
    /// repeat, and do while the world stands.
    pub times: [ViewTime; VIEW_TIMES],
    /// What its picture is shaded for: the middle of that interval, or its last frame where the client blends from one picture to the next.
    pub shaded: ViewTime,
    /// Left and right eye at each time.
    pub eyes: [[View; 2]; VIEW_TIMES],
    /// The head in the middle of the interval; shading looks from there.
    pub world_from_head: Pose,
    /// What was added to each side of the field of view, radians.
    pub margin: f32,
}

/// When a client shows what.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct DisplayTiming {
    /// From one display frame to the next.
    pub period_ns: i64,
    /// Whether colours go from one picture to the next while that is on display.
    pub blends: bool,
}

/// The head as reported, and how well past predictions came true.
#[derive(Clone, Debug, Default)]
pub(crate) struct HeadTrack {
    latest: Option<HeadState>,
    /// What was predicted, to be compared when the time has come.
    promised: VecDeque<(ServerTime, Pose)>,
    /// Recent prediction errors in radians of the view direction, newest last.
    errors: VecDeque<f32>,
    first_delays: VecDeque<i64>,
    last_delays: VecDeque<i64>,
    on_display: Option<(ServerTime, ServerTime)>,
    /// What an update takes, as far as is known, nanoseconds: before displays are reported, no update is on display sooner, and none
    /// for less.
    update_ns: i64,
    /// When its client shows what.
    display: DisplayTiming,
}

impl HeadTrack {
    /// Of a client with this display.
    pub(crate) fn new(display: DisplayTiming) -> Self {
        Self { display, ..Self::default() }
    }

    /// A newer head state; older ones, which datagrams may bring late, are ignored.
    pub(crate) fn head(&mut self, state: HeadState) {
        if let Some(latest) = &self.latest {
            if (state.sequence.wrapping_sub(latest.sequence) as i32) <= 0 {
                return;
            }
            if state.discontinuity != latest.discontinuity {
                self.promised.clear();
            }
        }
        while self.promised.front().is_some_and(|(time, _)| *time <= state.time) {
            if let Some((time, pose)) = self.promised.pop_front() {
                let error = view_error(pose, extrapolate(&state, time));
                push_bounded(&mut self.errors, error);
            }
        }
        self.latest =
            Some(self.latest.filter(|latest| stands_still(latest, &state)).map_or(state, |latest| {
                let (linear_velocity, angular_velocity) = (Vec3::ZERO, Vec3::ZERO);
                HeadState {
                    sequence: state.sequence,
                    time: state.time,
                    linear_velocity,
                    angular_velocity,
                    ..latest
                }
            }));
    }

    /// An update made at `update` was first on display at `displayed`, both on the server's clock.
    pub(crate) fn displayed(&mut self, update: ServerTime, displayed: ServerTime) {
        // A client may report any time; no delay beyond the bound is believed.
        let delay_ns = |begun| displayed.since(begun).clamp(-MAX_DELAY_NS, MAX_DELAY_NS);
        if let Some((previous, _)) = self.on_display {
            // What was on display until now stayed until this moment.
            push_bounded(&mut self.last_delays, delay_ns(previous));
        }
        push_bounded(&mut self.first_delays, delay_ns(update));
        self.on_display = Some((update, displayed));
    }

    /// An update takes about so long, nanoseconds.
    pub(crate) fn note_update(&mut self, took_ns: i64) {
        self.update_ns = took_ns;
    }

    /// Updates pause, or go on after a pause: what was promised, and how long the last update stays, count no more.
    pub(crate) fn interrupted(&mut self) {
        self.promised.clear();
        self.on_display = None;
    }

    /// From an update's start to its first and last moment on display, by what was reported: the 10th percentile of
    /// the first, the 95th of the last.
    pub(crate) fn delays_ns(&self) -> [i64; 2] {
        let first = percentile(&self.first_delays, 0.10).unwrap_or(START_FIRST_NS.max(self.update_ns));
        let stays_ns = (START_LAST_NS - START_FIRST_NS).max(self.update_ns);
        let last = percentile(&self.last_delays, 0.95).unwrap_or(first + stays_ns);
        // Of a link that pauses now and then, few updates stay as long as the pause.
        let usual = percentile(&self.last_delays, 0.5).unwrap_or(last);
        let last = last.min((MOST_USUAL_DELAYS * usual).max(MAX_HORIZON_NS));
        let first = first.clamp(0, MAX_DELAY_NS);
        [first, last.clamp(first, MAX_DELAY_NS)]
    }

    /// From an update's start to the middle of its time on display, as it usually is. The last of its frames is shown a display
    /// period before the first of the next update.
    fn middle_delay_ns(&self) -> i64 {
        let [first_ns, last_ns] = self.usual_delays_ns();
        ((first_ns + last_ns) / 2).clamp(0, MAX_DELAY_NS)
    }

    /// From an update's start to what its picture is shaded for. A client that blends shows it unmixed with its last frame.
    fn shaded_delay_ns(&self) -> i64 {
        if !self.display.blends {
            return self.middle_delay_ns();
        }
        let [_, last_ns] = self.usual_delays_ns();
        last_ns.clamp(0, MAX_DELAY_NS)
    }

    /// From an update's start to its first and its last frame, as they usually are.
    fn usual_delays_ns(&self) -> [i64; 2] {
        let [first_ns, next_ns] = self.delays_ns();
        let first_ns = percentile(&self.first_delays, 0.5).unwrap_or(first_ns);
        let next_ns = percentile(&self.last_delays, 0.5).unwrap_or(next_ns);
        [first_ns, next_ns - self.display.period_ns]
    }

    /// The views for an update that starts at `now` in a world of this clock, by so much wider than usual; `None` before the first
    /// head state.
    pub(crate) fn predict(
        &mut self,
        now: ServerTime,
        clock: &WorldClock,
        grid: Grid,
        wider: f32,
    ) -> Option<PredictedViews> {
        let state = self.latest?;
        let [first_ns, last_ns] = self.delays_ns();
        let (first, last) = (now.plus_ns(first_ns), now.plus_ns(last_ns));
        let middle = now.plus_ns(self.middle_delay_ns());
        let margin = self.margin() + wider;
        let shown = [first, middle, last];
        let [world_first, world_middle, world_last] = shown.map(|at| clock.world_time(at));
        let times = [
            grid.floor(world_first).into(),
            ViewTime::nearest(grid, world_middle),
            grid.ceil(world_last).into(),
        ];
        let shaded = ViewTime::nearest(grid, clock.world_time(now.plus_ns(self.shaded_delay_ns())));
        let eyes = std::array::from_fn(|number| {
            // The head goes on while the world stands.
            let moved_ns = times[number].time(grid).since(clock.world_time(shown[number]));
            let at = shown[number].plus_ns(moved_ns);
            let head = extrapolate_within(&state, at, turn_horizon_ns(number, at.since(state.time)));
            state.eyes.map(|eye| view(head, eye, margin))
        });
        let world_from_head = extrapolate(&state, middle);
        if self.promised.len() < REPORTS {
            self.promised.push_back((middle, world_from_head));
        }
        Some(PredictedViews { begun: clock.world_time(now), times, shaded, eyes, world_from_head, margin })
    }

    /// The views of a server that predicts nothing, for measurements: where the head was at its last report, and the world as it is at
    /// `now`.
    pub(crate) fn unpredicted(
        &self,
        now: ServerTime,
        clock: &WorldClock,
        grid: Grid,
    ) -> Option<PredictedViews> {
        let state = self.latest?;
        let begun = clock.world_time(now);
        let shaded = ViewTime::nearest(grid, begun);
        let eyes = state.eyes.map(|eye| view(state.world_from_head, eye, MIN_MARGIN));
        Some(PredictedViews {
            begun,
            times: [grid.floor(begun).into(), shaded, grid.ceil(begun).into()],
            shaded,
            eyes: [eyes; VIEW_TIMES],
            world_from_head: state.world_from_head,
            margin: MIN_MARGIN,
        })
    }

    /// The 95th percentile of recent prediction errors, within bounds.
    fn margin(&self) -> f32 {
        let mut errors = [0.0; REPORTS];
        let errors = copied(&self.errors, &mut errors);
        errors.sort_unstable_by(f32::total_cmp);
        let error = errors.get(errors.len().saturating_sub(1) * 95 / 100).copied().unwrap_or(0.0);
        (MIN_MARGIN + error).min(MAX_MARGIN)
    }
}

/// Whether a head is where it was, with the eyes that it had, as far as anybody could see.
fn stands_still(before: &HeadState, now: &HeadState) -> bool {
    let is_there = |a: Pose, b: Pose| {
        // The sine of half the angle: its cosine says nothing of so small ones.
        let half = (a.orientation.inverse() * b.orientation).xyz().length();
        a.position.distance(b.position) <= STILL_M && 2.0 * half <= STILL_RAD
    };
    let mut eyes = before.eyes.iter().zip(&now.eyes);
    before.discontinuity == now.discontinuity
        && now.linear_velocity.length() <= STILL_M_S
        && now.angular_velocity.length() <= STILL_RAD_S
        && is_there(before.world_from_head, now.world_from_head)
        && eyes.all(|(a, b)| a.fov == b.fov && is_there(a.head_from_eye, b.head_from_eye))
}

fn push_bounded<T>(queue: &mut VecDeque<T>, value: T) {
    if queue.len() == REPORTS {
        queue.pop_front();
    }
    queue.push_back(value);
}

fn percentile(values: &VecDeque<i64>, share: f64) -> Option<i64> {
    let mut sorted = [0; REPORTS];
    let sorted = copied(values, &mut sorted);
    sorted.sort_unstable();
    let last = sorted.len().checked_sub(1)?;
    sorted.get((last as f64 * share).round() as usize).copied()
}

/// What a queue of at most [`REPORTS`] holds, in memory that is at hand.
fn copied<'a, T: Copy>(queue: &VecDeque<T>, memory: &'a mut [T; REPORTS]) -> &'a mut [T] {
    let count = memory.iter_mut().zip(queue).map(|(place, value)| *place = *value).count();
    &mut memory[..count]
}

fn view(world_from_head: Pose, eye: Eye, margin: f32) -> View {
    View { world_from_eye: world_from_head.then(eye.head_from_eye), fov: frusta::widened(eye.fov, margin) }
}

/// The head at `time`, by constant linear and angular velocity.
pub fn extrapolate(state: &HeadState, time: ServerTime) -> Pose {
    extrapolate_within(state, time, MAX_HORIZON_NS)
}

/// The same of a head that turns no longer than so many nanoseconds.
fn extrapolate_within(state: &HeadState, time: ServerTime, turn_horizon_ns: i64) -> Pose {
    let seconds = |most_ns: i64| time.since(state.time).clamp(-most_ns, most_ns) as f32 * 1e-9;
    let turn = state.angular_velocity.clamp_length_max(MAX_TURN_RAD_S) * seconds(turn_horizon_ns);
    let step: Vec3 = state.linear_velocity.clamp_length_max(MAX_SPEED_M_S) * seconds(MAX_HORIZON_NS);
    let pose = state.world_from_head;
    Pose {
        position: pose.position + step,
        orientation: (Quat::from_scaled_axis(turn) * pose.orientation).normalize(),
    }
}

/// How long a head is taken to turn for this view of an update that is on display so much later than the head was reported.
fn turn_horizon_ns(view: usize, later_ns: i64) -> i64 {
    match view {
        0 => (MAX_TURN_HORIZON_NS - later_ns).clamp(0, MAX_HORIZON_NS),
        view if view + 1 == VIEW_TIMES => MAX_TURN_HORIZON_NS,
        _ => MAX_HORIZON_NS,
    }
}

/// Angle between two view directions plus what a shift means for something 2 m away, radians.
fn view_error(a: Pose, b: Pose) -> f32 {
    a.orientation.angle_between(b.orientation) + a.position.distance(b.position) / 2.0
}

#[cfg(test)]
mod tests;

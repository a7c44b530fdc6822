//! State of every instance at every time: the scene's events, an application's changes at run time, and the course of world
//! time. Pure.
//!
//! Sampled times never change: a change takes effect after the latest sampled time, whatever the application requests. So no
//! sent sample is ever contradicted.

use crate::support::lock::lock;
use shadecast_protocol::motion::playback::{Playing, Schedule};
use shadecast_protocol::text::printable;
use shadecast_protocol::time::{ServerTime, WorldTime};
use shadecast_protocol::world_clock::{Steering, WorldClock};
use shadecast_scene::animation::bounds::Reach;
use shadecast_scene::animation::played::live_reach_m;
use shadecast_scene::animation::playing;
use shadecast_scene::timeline::{Change, ClipIndex};
use shadecast_scene::{Model, Scene, Trs};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

/// Longest fade that an application may ask for, nanoseconds.
pub(crate) const MAX_FADE_NS: i64 = 60_000_000_000;
/// Live poses kept of an instance; the oldest goes first.
pub(crate) const MAX_LIVE_POSES: usize = 512;
/// How long what is over is remembered: far longer than samples are kept, nanoseconds.
const MEMORY_NS: i64 = 10_000_000_000;
/// How long halts of the world are remembered that are over: longer than any display is behind, nanoseconds.
const CLOCK_MEMORY_NS: i64 = 2_000_000_000;
/// Times are within this of the scene's start, nanoseconds: a hundred years.
const MAX_TIME_NS: i64 = 3_000_000_000_000_000_000;

/// Why a change of the world was not made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TimelineError {
    /// No such instance.
    #[error("the scene has no instance {instance}; it has {count}, numbered from 0")]
    NoInstance {
        /// What was asked for.
        instance: usize,
        /// How many there are.
        count: usize,
    },
    /// The clip is not among those for which the scene was prepared.
    #[error(
        "instance \"{}\" cannot play clip {clip:?}: no event of the scene names it; name it in an event, or set \
         live = true on the instance",
        printable(name)
    )]
    NotPlayable {
        /// The instance.
        name: String,
        /// Index into its model's clips.
        clip: ClipIndex,
    },
    /// It takes what only a live instance may do.
    #[error("instance \"{}\" cannot {what} at run time; set live = true on the instance", printable(name))]
    NotLive {
        /// The instance.
        name: String,
        /// What was asked for.
        what: &'static str,
    },
    /// A number that is none, or out of range.
    #[error("instance \"{}\" cannot be changed: {problem}", printable(name))]
    Value {
        /// The instance.
        name: String,
        /// What is wrong, and what is accepted.
        problem: String,
    },
}

/// What an instance shows at a time.
#[derive(Clone, Debug, PartialEq)]
pub enum Shown {
    /// A clip, or two amid a fade.
    Clips(Playing<ClipIndex>),
    /// What an application says: the local transform of each bone.
    Live(Vec<Trs>),
}

/// See the module.
#[derive(Clone, Debug)]
pub struct Timeline {
    instances: Vec<OfInstance>,
    sampled_until: Option<WorldTime>,
    clock: WorldClock,
    /// Viewers have been told what the clock will say until then.
    clock_told_until: Option<ServerTime>,
}

#[derive(Clone, Debug)]
struct OfInstance {
    name: String,
    schedule: Schedule<ClipIndex>,
    playable: Vec<ClipIndex>,
    /// Where an application may pose it.
    live: Option<Live>,
}

/// The poses of a live instance.
#[derive(Clone, Debug)]
struct Live {
    reach: Arc<Reach>,
    most_m: f32,
    /// By rising times; apart from the last, each has ended.
    runs: VecDeque<LiveRun>,
}

/// Poses from a first one until they are released.
#[derive(Clone, Debug)]
struct LiveRun {
    from: WorldTime,
    until: Option<WorldTime>,
    /// For when the last pose was meant.
    meant: WorldTime,
    /// By rising times from `from` on, never empty.
    poses: VecDeque<(WorldTime, Vec<Trs>)>,
}

/// A timeline that the world reads and an application changes.
#[derive(Clone, Debug)]
pub struct SharedTimeline(Arc<Mutex<Timeline>>);

impl SharedTimeline {
    /// What a scene says of itself.
    pub fn new(scene: &Scene) -> Self {
        Self(Arc::new(Mutex::new(Timeline::new(scene))))
    }

    /// The timeline, until it is dropped; the world waits meanwhile.
    pub fn lock(&self) -> MutexGuard<'_, Timeline> {
        // Every change is checked before it is made: whoever panics leaves a whole timeline behind.
        lock(&self.0)
    }
}

impl Timeline {
    /// What a scene says of itself.
    pub(crate) fn new(scene: &Scene) -> Self {
        let mut reaches: Vec<Option<(Arc<Reach>, f32)>> = vec![None; scene.models.len()];
        let mut live = |model: usize| {
            let (reach, most_m) = reaches[model].get_or_insert_with(|| prepare(&scene.models[model]));
            Live { reach: reach.clone(), most_m: *most_m, runs: VecDeque::new() }
        };
        let of = |(index, schedule): (usize, Schedule<ClipIndex>)| {
            let instance = &scene.instances[index];
            OfInstance {
                name: instance.name.clone(),
                schedule,
                playable: scene.playable(index),
                live: instance.live.then(|| live(instance.model)),
            }
        };
        Self {
            instances: scene.schedules().into_iter().enumerate().map(of).collect(),
            sampled_until: None,
            clock: WorldClock::default(),
            clock_told_until: None,
        }
    }

    /// How the world's time follows the server's clock.
    pub(crate) fn clock(&self) -> &WorldClock {
        &self.clock
    }

    /// A viewer counts on the clock as it is until a time, since it would not hear of a change before.
    pub(crate) fn clock_told(&mut self, until: ServerTime) {
        self.clock_told_until = self.clock_told_until.max(Some(until));
    }

    /// Lets the world stand, or go on, for all who look: at `now`, or when no viewer counts on anything else. Gives when.
    pub fn steer(&mut self, wanted: impl Into<Steering>, now: ServerTime) -> ServerTime {
        let at = self.clock_told_until.map_or(now, |until| now.max(until.plus_ns(1)));
        self.clock.forget_before(now.plus_ns(-CLOCK_MEMORY_NS));
        self.clock.steer(wanted, at);
        at
    }

    /// What an instance plays, and will, where it is not posed.
    pub(crate) fn schedule(&self, instance: usize) -> &Schedule<ClipIndex> {
        &self.instances[instance].schedule
    }

    /// What an instance shows at a time.
    pub fn at(&self, instance: usize, time: WorldTime) -> Shown {
        let OfInstance { schedule, live, .. } = &self.instances[instance];
        let posed = live.as_ref().and_then(|live| live.at(time));
        posed.map_or_else(|| Shown::Clips(schedule.at(time)), Shown::Live)
    }

    /// The local transforms of all bones of an instance, whose model is given, by the source curves or as it is posed.
    pub(crate) fn source_pose(&self, model: &Model, instance: usize, time: WorldTime) -> Vec<Trs> {
        match self.at(instance, time) {
            Shown::Clips(playing) => playing::source_pose(model, &playing),
            Shown::Live(pose) => pose,
        }
    }

    /// The latest time that was sampled: changes take effect after it. `None` before the first sample.
    pub fn sampled_until(&self) -> Option<WorldTime> {
        self.sampled_until
    }

    /// A time was sampled: nothing changes any more of what is shown until then.
    pub(crate) fn sampled(&mut self, time: WorldTime) {
        self.sampled_until = self.sampled_until.max(Some(time));
    }

    /// Changes what an instance plays, in place of all that was to come, not before `earliest`. Gives when it takes effect.
    ///
    /// # Errors
    /// The scene was not prepared for it, or it is out of range; nothing has changed then.
    pub fn set_playback(
        &mut self,
        instance: usize,
        change: Change,
        earliest: WorldTime,
    ) -> Result<WorldTime, TimelineError> {
        let at = self.free(earliest);
        let forgotten = at.plus_ns(-MEMORY_NS);
        let own = self.instance(instance)?;
        own.check(&change, earliest)?;
        own.schedule.forget_before(forgotten);
        Ok(change.apply(&mut own.schedule, at))
    }

    /// Poses a live instance: the local transform of each bone in the model's order, at a time after that of its last pose.
    /// From its first pose on it ignores its clip; between two poses it goes as a cross-fade does, and after the last it stands.
    /// Where that was sampled, it still stands when another pose comes. Gives when the pose is reached: at its time, or after
    /// what was sampled.
    ///
    /// # Errors
    /// The instance is not live, or the pose is not one of its model that stays within its room; nothing has changed then.
    pub fn set_pose(
        &mut self,
        instance: usize,
        time: WorldTime,
        mut pose: Vec<Trs>,
    ) -> Result<WorldTime, TimelineError> {
        let (seen, sampled_until) = (self.free(time), self.sampled_until);
        let own = self.instance(instance)?;
        own.check_time(time)?;
        own.check_pose(&pose)?;
        pose.iter_mut().for_each(|bone| bone.rotation = bone.rotation.normalize());
        let live = own.live("be posed")?;
        match live.open_run() {
            Some(run) if run.meant >= time => {
                let problem = "a pose must be later than the one before; give its time on the world's clock";
                return Err(own.value(problem.into()));
            }
            Some(run) => run.add(time, seen, sampled_until, pose),
            None => live.begin(time, seen, pose),
        }
        Ok(seen)
    }

    /// Lets a live instance play its clip again, not before `earliest`. Gives when.
    ///
    /// # Errors
    /// The instance is not live.
    pub fn release_pose(&mut self, instance: usize, earliest: WorldTime) -> Result<WorldTime, TimelineError> {
        let at = self.free(earliest);
        let live = self.instance(instance)?.live("be posed")?;
        if let Some(run) = live.open_run() {
            run.until = Some(at.max(run.from));
        }
        Ok(at)
    }

    /// The first time, not before `earliest`, that is still open.
    fn free(&self, earliest: WorldTime) -> WorldTime {
        self.sampled_until.map_or(earliest, |until| earliest.max(until.plus_ns(1)))
    }

    fn instance(&mut self, instance: usize) -> Result<&mut OfInstance, TimelineError> {
        let count = self.instances.len();
        self.instances.get_mut(instance).ok_or(TimelineError::NoInstance { instance, count })
    }
}

fn prepare(model: &Model) -> (Arc<Reach>, f32) {
    let reach = Reach::new(model);
    let most_m = live_reach_m(model, &reach);
    (Arc::new(reach), most_m)
}

impl OfInstance {
    fn check(&self, change: &Change, earliest: WorldTime) -> Result<(), TimelineError> {
        let Change { clip, local_s, speed, fade_ns, .. } = *change;
        if let Some(clip) = clip.filter(|clip| !self.playable.contains(clip)) {
            return Err(TimelineError::NotPlayable { name: self.name.clone(), clip });
        }
        if fade_ns != 0 && self.live.is_none() {
            return Err(TimelineError::NotLive { name: self.name.clone(), what: "fade from clip to clip" });
        }
        if !(0..=MAX_FADE_NS).contains(&fade_ns) {
            return Err(self.value(format!("a fade takes from 0 to {} s", MAX_FADE_NS / 1_000_000_000)));
        }
        if !local_s.into_iter().chain(speed).all(f64::is_finite) {
            return Err(self.value("local time and speed must be finite".into()));
        }
        self.check_time(earliest)
    }

    fn check_time(&self, time: WorldTime) -> Result<(), TimelineError> {
        match (-MAX_TIME_NS..=MAX_TIME_NS).contains(&time.0) {
            true => Ok(()),
            false => Err(self.value(format!("{} ns is no time on the world's clock", time.0))),
        }
    }

    fn check_pose(&mut self, pose: &[Trs]) -> Result<(), TimelineError> {
        let Live { reach, most_m, .. } = self.live("be posed")?;
        let (reach, most_m) = (reach.clone(), *most_m);
        if pose.len() != reach.bone_count() {
            let problem = format!("the pose has {} bones, its model {}", pose.len(), reach.bone_count());
            return Err(self.value(problem));
        }
        let is_sound = |bone: &Trs| {
            let length = bone.rotation.length();
            bone.translation.is_finite() && bone.scale.is_finite() && (0.5..2.0).contains(&length)
        };
        if let Some(bone) = pose.iter().position(|bone| !is_sound(bone)) {
            return Err(
                self.value(format!("bone {bone} of the pose is not finite, or its rotation has no length"))
            );
        }
        let own_m = reach.of_pose_m(pose);
        if own_m <= most_m {
            return Ok(());
        }
        Err(self.value(format!(
            "the pose may reach {own_m:.3} m from the model's origin, but only {most_m:.3} m are reserved; move \
             bones less far"
        )))
    }

    fn live(&mut self, what: &'static str) -> Result<&mut Live, TimelineError> {
        self.live.as_mut().ok_or_else(|| TimelineError::NotLive { name: self.name.clone(), what })
    }

    fn value(&self, problem: String) -> TimelineError {
        TimelineError::Value { name: self.name.clone(), problem }
    }
}

impl Live {
    /// The run that is not over.
    fn open_run(&mut self) -> Option<&mut LiveRun> {
        self.runs.back_mut().filter(|run| run.until.is_none())
    }

    /// A new run from a time on, of a pose that was meant for `meant`.
    fn begin(&mut self, meant: WorldTime, from: WorldTime, pose: Vec<Trs>) {
        self.runs.retain(|run| run.until.is_none_or(|until| from.since(until) <= MEMORY_NS));
        self.runs.push_back(LiveRun { from, until: None, meant, poses: VecDeque::from([(from, pose)]) });
    }

    fn at(&self, time: WorldTime) -> Option<Vec<Trs>> {
        let is_on = |run: &&LiveRun| run.from <= time && run.until.is_none_or(|until| time < until);
        self.runs.iter().find(is_on).map(|run| run.at(time))
    }
}

impl LiveRun {
    /// A later pose, which is reached at `seen`.
    fn add(&mut self, meant: WorldTime, seen: WorldTime, sampled_until: Option<WorldTime>, pose: Vec<Trs>) {
        self.meant = meant;
        let (last, standing) = self.poses.back_mut().expect("a run begins with a pose");
        if *last == seen {
            // Both came too late for their times: the newer one counts.
            *standing = pose;
            return;
        }
        // It was sampled as it stands: it goes on from there.
        let stood = sampled_until.filter(|until| *until > *last).map(|until| (until, standing.clone()));
        self.poses.extend(stood.into_iter().chain([(seen, pose)]));
        self.poses.drain(..self.poses.len().saturating_sub(MAX_LIVE_POSES));
    }

    fn at(&self, time: WorldTime) -> Vec<Trs> {
        let after = self.poses.partition_point(|(at, _)| *at <= time);
        let Some(before) = after.checked_sub(1) else { return self.poses[0].1.clone() };
        let (from, pose) = &self.poses[before];
        let Some((to, next)) = self.poses.get(after) else { return pose.clone() };
        let share = (time.since(*from) as f64 / to.since(*from) as f64) as f32;
        pose.iter().zip(next).map(|(now, next)| playing::mix(*now, *next, share)).collect()
    }
}

#[cfg(test)]
mod tests;

//! Schedules sent to one client, and their changes since: approaching events, and an application's changes at run time.

use crate::animation::timeline::Timeline;
use crate::scene::SceneGpu;
use shadecast_protocol::ids::InstanceId;
use shadecast_protocol::limits::MAX_SCHEDULE;
use shadecast_protocol::motion::message::NewSchedule;
use shadecast_protocol::motion::playback::{Playing, Schedule};
use shadecast_protocol::motion::skeleton::{ClipRef, PoseSource, SkinnedInstance};
use shadecast_protocol::time::WorldTime;

/// What is over for so long is of no use to anybody, nanoseconds: longer than any display is behind.
const OVER_NS: i64 = 2_000_000_000;

/// See the module.
#[derive(Debug, Default)]
pub(crate) struct Schedules {
    sent: Vec<SentSchedule>,
}

#[derive(Debug)]
struct SentSchedule {
    instance: usize,
    path: Option<Schedule<ClipRef>>,
    /// `None`: its poses are sent instead.
    schedule: Option<Schedule<ClipRef>>,
}

impl Schedules {
    /// The client is told of an instance with what it plays as of `now`, as far as that is known, and will.
    pub(crate) fn announce(
        &mut self,
        scene: &SceneGpu,
        timeline: &Timeline,
        now: Option<WorldTime>,
        told: &mut SkinnedInstance,
    ) {
        let instance = told.instance.index();
        told.schedule = current(scene, timeline, now, instance);
        let schedule = (told.source == PoseSource::Clips).then(|| told.schedule.clone());
        self.sent.push(SentSchedule { instance, path: told.path.clone(), schedule });
    }

    /// Whether any instance plays clips on the client.
    pub(crate) fn plays_any(&self) -> bool {
        self.sent.iter().any(|told| told.schedule.is_some())
    }

    /// What has changed of what was told. It counts as told from now on.
    pub(crate) fn changes(
        &mut self,
        scene: &SceneGpu,
        timeline: &Timeline,
        now: WorldTime,
    ) -> Vec<NewSchedule> {
        let mut changes = Vec::new();
        for SentSchedule { instance, schedule, .. } in &mut self.sent {
            let Some(known) = schedule else { continue };
            let schedule = current(scene, timeline, Some(now), *instance);
            known.forget_before(now.plus_ns(-OVER_NS));
            if *known != schedule {
                *known = schedule.clone();
                changes.push(NewSchedule { instance: InstanceId(*instance as u16), schedule });
            }
        }
        changes
    }

    /// What is evaluated on the client at a time: of paths and of instances.
    pub(crate) fn playing(&self, at: WorldTime) -> impl Iterator<Item = Playing<ClipRef>> + '_ {
        let all = self.sent.iter().flat_map(|told| told.path.iter().chain(&told.schedule));
        all.map(move |schedule| schedule.at(at))
    }
}

/// What an instance plays and will, as much of it as a client takes at once.
fn current(
    scene: &SceneGpu,
    timeline: &Timeline,
    now: Option<WorldTime>,
    instance: usize,
) -> Schedule<ClipRef> {
    let mut schedule = timeline.schedule(instance).clone();
    if let Some(now) = now {
        schedule.forget_before(now.plus_ns(-OVER_NS));
    }
    if schedule.entries().len() > MAX_SCHEDULE {
        let first = schedule.entries()[..MAX_SCHEDULE].to_vec();
        schedule = Schedule::of(first).expect("a beginning of what was in order");
    }
    let model = scene.scene.instances[instance].model;
    scene.motion.schedule(&scene.animation.manager, model, &schedule)
}

//! Playback of instances over time: the scene's initial state, and its events.
//!
//! An event, or an application at run time, gives only the changes. Both become entries of a [`Schedule`], which alone
//! determines the playback at a time.

use crate::{Instance, Repetition, Scene};
use shadecast_model::playback::{Playback, Schedule};
use shadecast_model::time::WorldTime;

/// What a model's instance plays: an index into the model's clips, `None` for the rest pose.
pub type ClipIndex = Option<usize>;

/// A change of what an instance plays, at a time of the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Event {
    /// When, on the scene's clock; positive.
    pub at: WorldTime,
    /// Index into [`Scene::instances`].
    pub instance: usize,
    /// What changes.
    pub change: Change,
}

/// What changes of what is played. What is `None` stays as it is.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Change {
    /// Another clip, or the same one again: from its start, unless `local_s` says otherwise.
    pub clip: Option<ClipIndex>,
    /// Where in the clip, seconds of its local time.
    pub local_s: Option<f64>,
    /// Seconds of the clip in a second; 0 stands still, negative plays backwards.
    pub speed: Option<f64>,
    /// What the clip does outside its duration.
    pub repetition: Option<Repetition>,
    /// How long what was played before is faded out, nanoseconds, not negative.
    pub fade_ns: i64,
}

impl Change {
    /// Adds the change to a schedule, in place of all that was to come at `at` or later. Gives when it takes effect: at `at`,
    /// or when the fade that `at` falls into is over.
    pub fn apply(&self, schedule: &mut Schedule<ClipIndex>, at: WorldTime) -> WorldTime {
        // What the change goes on from is known once it is known when it takes effect.
        let mut probe = schedule.clone();
        let from = probe.change(Playback { from: at, ..*schedule.entry(at) });
        let [.., before, _] = probe.entries() else { unreachable!("a change follows what was there") };
        let start_s = match self.clip {
            Some(_) => 0.0,
            None => before.local_s(from),
        };
        schedule.change(Playback {
            from,
            clip: self.clip.unwrap_or(before.clip),
            start_s: self.local_s.unwrap_or(start_s),
            speed: self.speed.unwrap_or(before.speed),
            repetition: self.repetition.unwrap_or(before.repetition),
            fade_ns: self.fade_ns,
        })
    }
}

impl Instance {
    /// What it plays before any event: the shift is added to the scene's time first, then the speed scales.
    pub fn playback(&self) -> Playback<ClipIndex> {
        let speed = f64::from(self.speed);
        Playback {
            from: WorldTime(0),
            clip: self.clip,
            start_s: f64::from(self.time_shift_s) * speed,
            speed,
            repetition: self.repetition,
            fade_ns: 0,
        }
    }
}

impl Scene {
    /// By instance: what it plays, its events included.
    pub fn schedules(&self) -> Vec<Schedule<ClipIndex>> {
        let first = |instance: &Instance| Schedule::new(instance.playback());
        let mut schedules: Vec<_> = self.instances.iter().map(first).collect();
        let mut events: Vec<&Event> = self.events.iter().collect();
        events.sort_by_key(|event| event.at);
        for Event { at, instance, change } in events {
            change.apply(&mut schedules[*instance], *at);
        }
        schedules
    }

    /// The clips that an instance can ever play, ascending: its own, those of its events, and where it is
    /// [`live`](Instance::live) the rest pose and all clips of its model.
    pub fn playable(&self, instance: usize) -> Vec<ClipIndex> {
        let Instance { model, clip, live, .. } = self.instances[instance];
        let own = self.events.iter().filter(|event| event.instance == instance);
        let mut clips: Vec<ClipIndex> = own.filter_map(|event| event.change.clip).chain([clip]).collect();
        if live {
            clips.extend((0..self.models[model].clips.len()).map(Some).chain([None]));
        }
        clips.sort_unstable();
        clips.dedup();
        clips
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::load::{SceneSource, load_scene};

    fn ms(ms: i64) -> WorldTime {
        WorldTime(ms * 1_000_000)
    }

    fn scene(events: Vec<Event>) -> Scene {
        let mut scene = load_scene(&SceneSource::Dragons(2)).expect("built in");
        (scene.instances[0].time_shift_s, scene.instances[0].speed) = (0.5, 2.0);
        Scene { events, ..scene }
    }

    fn event(at_ms: i64, change: Change) -> Event {
        Event { at: ms(at_ms), instance: 0, change }
    }

    #[test]
    fn a_scene_without_events_plays_what_its_instances_say() {
        let scene = scene(Vec::new());
        let schedules = scene.schedules();
        assert_eq!(schedules.len(), scene.instances.len());
        let playing = schedules[0].at(ms(1000));
        assert_eq!((playing.now.clip, playing.now.local_s, playing.fading), (Some(0), 3.0, None));
    }

    #[test]
    fn the_phase_is_to_the_bit_what_shift_and_time_give() {
        let scene = load_scene(&SceneSource::Dragons(9)).expect("built in");
        for (instance, schedule) in scene.instances.iter().zip(scene.schedules()) {
            for time in (0..2000).map(|step| WorldTime(step * 33_333_333)) {
                let expected = time.seconds() + f64::from(instance.time_shift_s);
                assert_eq!(schedule.at(time).now.local_s.to_bits(), expected.to_bits(), "{time:?}");
            }
        }
    }

    #[test]
    fn a_pause_keeps_the_phase_and_going_on_starts_from_there() {
        let pause = event(1000, Change { speed: Some(0.0), ..Change::default() });
        let on = event(3000, Change { speed: Some(-1.0), ..Change::default() });
        // Their order in the scene does not matter.
        let schedule = &scene(vec![on, pause]).schedules()[0];
        let local_s = [999, 1000, 2000, 2999, 3000, 3500].map(|at| schedule.at(ms(at)).now.local_s);
        assert_eq!(local_s, [2.998, 3.0, 3.0, 3.0, 3.0, 2.5]);
    }

    #[test]
    fn another_clip_starts_at_its_start_unless_it_is_sought_elsewhere() {
        let rest = Change { clip: Some(None), fade_ns: 200_000_000, ..Change::default() };
        let back = Change { clip: Some(Some(0)), local_s: Some(1.5), ..Change::default() };
        let once = Change { repetition: Some(Repetition::Once), ..Change::default() };
        let scene = scene(vec![event(1000, rest), event(2000, back), event(2500, once)]);
        let schedule = &scene.schedules()[0];
        let middle = schedule.at(ms(1100));
        assert_eq!((middle.now.clip, middle.now.local_s), (None, 0.2), "the speed stays");
        let (fading, share) = middle.fading.expect("a fade");
        assert_eq!((fading.clip, fading.local_s, share), (Some(0), 3.2, 0.5));
        assert_eq!((schedule.at(ms(2250)).now.clip, schedule.at(ms(2250)).now.local_s), (Some(0), 2.0));
        let last = schedule.at(ms(2500)).now;
        assert_eq!((last.local_s, last.repetition), (2.5, Repetition::Once));
        assert_eq!(scene.playable(0), [None, Some(0)]);
        assert_eq!(scene.playable(1), [Some(0)]);
    }

    #[test]
    fn a_change_amid_a_fade_continues_from_the_fades_end() {
        let mut schedule = scene(Vec::new()).schedules().swap_remove(0);
        let fade = Change { clip: Some(Some(0)), fade_ns: 400_000_000, ..Change::default() };
        assert_eq!(fade.apply(&mut schedule, ms(1000)), ms(1000));
        let pause = Change { speed: Some(0.0), ..Change::default() };
        assert_eq!(pause.apply(&mut schedule, ms(1100)), ms(1400));
        assert_eq!(schedule.at(ms(1400)).now.local_s, 0.8);
    }
}

//! The playing clip of an instance, and its phase: sent as motion over time.
//!
//! A clip's *local time* runs on for ever; its *phase* lies within the clip. Both sides compute every phase here, so they
//! cannot disagree.

use crate::time::WorldTime;
use serde::{Deserialize, Serialize};

/// What a clip does outside its own duration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Repetition {
    /// Plays once and holds its end (and, before its start, its start).
    Once,
    /// Starts again.
    #[default]
    Loop,
    /// Plays forwards, backwards, forwards.
    PingPong,
}

/// What an instance plays from a time on. `C` names a clip.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Playback<C> {
    /// When it takes effect.
    pub from: WorldTime,
    /// The clip.
    pub clip: C,
    /// Local time of the clip at `from`, seconds.
    pub start_s: f64,
    /// Seconds of the clip in a second; 0 stands still, negative plays backwards.
    pub speed: f64,
    /// What the clip does outside its duration.
    pub repetition: Repetition,
    /// How long, from `from` on, what was played before is faded out, nanoseconds.
    pub fade_ns: i64,
}

/// What an instance plays, and what it will: never empty, by rising times.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Schedule<C>(Vec<Playback<C>>);

/// A clip at a local time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct At<C> {
    /// The clip.
    pub clip: C,
    /// Local time, seconds.
    pub local_s: f64,
    /// See [`Playback::repetition`].
    pub repetition: Repetition,
}

/// What is to be seen at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Playing<C> {
    /// What is played.
    pub now: At<C>,
    /// What is faded out, and its share, above 0 and at most 1. Local transforms are blended: translations, scales and morph
    /// weights linearly, rotations linearly along the shorter arc and then made unit length.
    pub fading: Option<(At<C>, f64)>,
}

impl<C: Copy> Playback<C> {
    /// Local time of the clip at a time, seconds.
    pub fn local_s(&self, time: WorldTime) -> f64 {
        self.start_s + time.since(self.from) as f64 * 1e-9 * self.speed
    }

    /// When all of what was played before has been faded out.
    pub fn faded(&self) -> WorldTime {
        self.from.plus_ns(self.fade_ns)
    }

    /// The same of another clip's name.
    pub fn with_clip<D>(&self, clip: D) -> Playback<D> {
        let Self { from, start_s, speed, repetition, fade_ns, .. } = *self;
        Playback { from, clip, start_s, speed, repetition, fade_ns }
    }

    fn at(&self, time: WorldTime) -> At<C> {
        At { clip: self.clip, local_s: self.local_s(time), repetition: self.repetition }
    }
}

impl<C: Copy> Schedule<C> {
    /// That plays one thing for ever, before its time too.
    pub fn new(first: Playback<C>) -> Self {
        Self(vec![first])
    }

    /// Of these, the first of which plays before its time too; `None` where there are none, or times do not rise.
    pub fn of(entries: Vec<Playback<C>>) -> Option<Self> {
        (!entries.is_empty() && entries.is_sorted_by(|a, b| a.from < b.from)).then_some(Self(entries))
    }

    /// Its entries.
    pub fn entries(&self) -> &[Playback<C>] {
        &self.0
    }

    /// Adds a change, in place of all that were to come at its time or later. A change amid a fade waits for the fade's end, so
    /// that there are never more than two clips to be evaluated. Gives when it takes effect.
    pub fn change(&mut self, mut next: Playback<C>) -> WorldTime {
        let keep = self.0.partition_point(|entry| entry.from < next.from).max(1);
        self.0.truncate(keep);
        let last = self.0[keep - 1];
        next.from = next.from.max(last.from.plus_ns(1)).max(last.faded());
        self.0.push(next);
        next.from
    }

    /// The entry in effect at a time.
    pub fn entry(&self, time: WorldTime) -> &Playback<C> {
        &self.0[self.index(time)]
    }

    /// What is to be seen at a time.
    pub fn at(&self, time: WorldTime) -> Playing<C> {
        let index = self.index(time);
        let entry = &self.0[index];
        let left_ns = entry.faded().since(time);
        let before = index.checked_sub(1).map(|before| self.0[before]);
        let fading = before.filter(|_| left_ns > 0 && entry.fade_ns > 0).map(|before| {
            let share = left_ns as f64 / entry.fade_ns as f64;
            (before.at(time), share.min(1.0))
        });
        Playing { now: entry.at(time), fading }
    }

    /// Forgets what is over at `time`, and at all later times.
    pub fn forget_before(&mut self, time: WorldTime) {
        let index = self.index(time);
        let first = if self.0[index].faded() <= time { index } else { index.saturating_sub(1) };
        self.0.drain(..first);
    }

    fn index(&self, time: WorldTime) -> usize {
        self.0.partition_point(|entry| entry.from <= time).saturating_sub(1)
    }
}

impl<C> At<C> {
    /// How far into its clip it is, seconds, where the clip lasts so long.
    pub fn phase_s(&self, duration_s: f32) -> f64 {
        phase_s(self.local_s, duration_s, self.repetition)
    }
}

/// Local time brought into `0..=duration_s`; 0 for a clip without duration. A loop never stands at its very end, which is its
/// start. Double precision, because a session may last for days and a phase must still be right to the microsecond.
pub fn phase_s(local_s: f64, duration_s: f32, repetition: Repetition) -> f64 {
    let duration_s = f64::from(duration_s);
    if duration_s <= 0.0 || !local_s.is_finite() {
        return 0.0;
    }
    let wrapped = |period_s: f64| {
        let phase = local_s.rem_euclid(period_s);
        // A tiny negative time rounds up to the period itself.
        if phase < period_s { phase } else { 0.0 }
    };
    match repetition {
        Repetition::Once => local_s.clamp(0.0, duration_s),
        Repetition::Loop => wrapped(duration_s),
        Repetition::PingPong => {
            let phase = wrapped(2.0 * duration_s);
            if phase <= duration_s { phase } else { 2.0 * duration_s - phase }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn playback(from_ms: i64, clip: char, fade_ms: i64) -> Playback<char> {
        Playback {
            from: ms(from_ms),
            clip,
            start_s: 1.0,
            speed: 2.0,
            repetition: Repetition::Loop,
            fade_ns: fade_ms * 1_000_000,
        }
    }

    fn ms(ms: i64) -> WorldTime {
        WorldTime(ms * 1_000_000)
    }

    #[test]
    fn local_time_runs_at_its_speed_from_its_start() {
        let playback = playback(500, 'a', 0);
        assert_eq!([500, 1500, 0].map(|at| playback.local_s(ms(at))), [1.0, 3.0, 0.0]);
    }

    #[test]
    fn a_change_fades_from_what_was_played_to_what_is() {
        let mut schedule = Schedule::new(playback(0, 'a', 0));
        assert_eq!(schedule.change(playback(1000, 'b', 400)), ms(1000));
        assert_eq!(schedule.at(ms(999)).now.clip, 'a');
        let middle = schedule.at(ms(1100));
        assert_eq!((middle.now.clip, middle.now.local_s), ('b', 1.2));
        let (fading, share) = middle.fading.unwrap();
        assert_eq!((fading.clip, fading.local_s, share), ('a', 1.0 + 2.0 * 1.1, 0.75));
        assert_eq!(schedule.at(ms(1400)).fading, None);
        assert_eq!(schedule.at(ms(-5)).now.clip, 'a', "the first plays before its time too");
    }

    #[test]
    fn a_change_amid_a_fade_waits_and_takes_the_place_of_later_ones() {
        let mut schedule = Schedule::new(playback(0, 'a', 0));
        schedule.change(playback(1000, 'b', 400));
        schedule.change(playback(3000, 'c', 0));
        assert_eq!(schedule.change(playback(1200, 'd', 100)), ms(1400));
        let clips: Vec<char> = schedule.entries().iter().map(|entry| entry.clip).collect();
        assert_eq!(clips, ['a', 'b', 'd']);
        assert!(schedule.entries().is_sorted_by(|a, b| a.from < b.from));
        assert_eq!(schedule.at(ms(1400)).now.local_s, 1.0, "it starts where it was to start, later");
    }

    #[test]
    fn past_entries_are_dropped_without_effect() {
        let mut schedule = Schedule::new(playback(0, 'a', 0));
        schedule.change(playback(1000, 'b', 400));
        schedule.change(playback(3000, 'c', 400));
        for now in [0, 999, 1000, 1399, 1400, 3100, 3400, 9000] {
            let mut later = schedule.clone();
            later.forget_before(ms(now));
            for at in (now..9000).step_by(37) {
                assert_eq!(later.at(ms(at)), schedule.at(ms(at)), "{at} as of {now}");
            }
        }
        schedule.forget_before(ms(9000));
        assert_eq!(schedule.entries().len(), 1);
    }

    #[test]
    fn repetitions_bring_local_time_into_the_clip() {
        let at = |local_s, repetition| phase_s(local_s, 4.0, repetition);
        assert_eq!([-1.0, 1.0, 9.0].map(|t| at(t, Repetition::Once)), [0.0, 1.0, 4.0]);
        let there_and_back = [1.0, 4.0, 5.0, 9.0, -1.0].map(|t| at(t, Repetition::PingPong));
        assert_eq!(there_and_back, [1.0, 4.0, 3.0, 1.0, 1.0]);
    }

    #[test]
    fn phase_wraps_and_stays_exact_after_a_week() {
        let at = |local_s, duration_s| phase_s(local_s, duration_s, Repetition::Loop);
        assert_eq!([9.0, -1.0, 4.0, -1e-20, f64::NAN].map(|t| at(t, 4.0)), [1.0, 3.0, 0.0, 0.0, 0.0]);
        assert_eq!(at(5.0, 0.0), 0.0);
        assert!((at(604_800.0 + 1.25, 4.0) - 1.25).abs() < 1e-6);
    }
}

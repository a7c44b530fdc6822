//! Source curves in double precision, written from the glTF specification and from nothing else of this project: the judge of
//! the renderer's sampling and skinning must not share their code.
//!
//! Outside its keys a curve keeps its end value. Sections are those of glTF 2.0.

use glam::{DAffine3, DQuat, DVec3, DVec4, Quat, Vec3};
use shadecast_scene::timeline::Event;
use shadecast_scene::{
    Instance, Interpolation, Model, MorphTrack, Path, Repetition, Scene, Track, TrackValues, Trs,
};

/// A bone's local transform.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Local {
    /// Metres.
    pub translation: DVec3,
    /// Unit length.
    pub rotation: DQuat,
    /// By axis.
    pub scale: DVec3,
}

impl Local {
    /// Changes nothing.
    pub const IDENTITY: Self =
        Self { translation: DVec3::ZERO, rotation: DQuat::IDENTITY, scale: DVec3::ONE };

    /// `translate * rotate * scale`.
    pub fn affine(self) -> DAffine3 {
        DAffine3::from_scale_rotation_translation(self.scale, self.rotation.normalize(), self.translation)
    }

    /// Takes over what `track` says at a time.
    pub fn apply(&mut self, track: &Track, t_s: f64) {
        let at = Between::find(&track.times_s, t_s);
        match &track.values {
            TrackValues::Translation(keys) => self.translation = vector(keys, track.interpolation, &at),
            TrackValues::Scale(keys) => self.scale = vector(keys, track.interpolation, &at),
            TrackValues::Rotation(keys) => self.rotation = rotation(keys, track.interpolation, &at),
        }
    }
}

impl Local {
    /// Amid a cross-fade, where so much is left of what was before: translations and scales on the straight line between
    /// both, rotations on the straight line between quaternions of one hemisphere, then of unit length.
    pub fn faded(self, before: Self, left: f64) -> Self {
        let mean = |now: DVec3, then: DVec3| now * (1.0 - left) + then * left;
        let (now, mut then) = (DVec4::from(self.rotation), DVec4::from(before.rotation));
        if now.dot(then) < 0.0 {
            then = -then;
        }
        let turned = (now * (1.0 - left) + then * left).try_normalize().unwrap_or(now);
        Self {
            translation: mean(self.translation, before.translation),
            rotation: DQuat::from_vec4(turned),
            scale: mean(self.scale, before.scale),
        }
    }
}

impl From<Trs> for Local {
    fn from(rest: Trs) -> Self {
        Self {
            translation: rest.translation.as_dvec3(),
            rotation: rest.rotation.as_dquat(),
            scale: rest.scale.as_dvec3(),
        }
    }
}

/// Two keys around a time.
struct Between {
    before: usize,
    after: usize,
    /// Of the way from one to the other, 0..=1.
    part: f64,
    span_s: f64,
}

impl Between {
    fn find(times_s: &[f32], t_s: f64) -> Self {
        let last = times_s.len() - 1;
        if t_s <= f64::from(times_s[0]) {
            return Self { before: 0, after: 0, part: 0.0, span_s: 0.0 };
        }
        if t_s >= f64::from(times_s[last]) {
            return Self { before: last, after: last, part: 0.0, span_s: 0.0 };
        }
        let after = times_s.iter().position(|key_s| f64::from(*key_s) > t_s).unwrap_or(last);
        let (from_s, to_s) = (f64::from(times_s[after - 1]), f64::from(times_s[after]));
        Self { before: after - 1, after, part: (t_s - from_s) / (to_s - from_s), span_s: to_s - from_s }
    }

    /// Appendix C.5. A key is in-tangent, value, out-tangent; `value` gives entry `part` of a key.
    fn cubic(&self, value: impl Fn(usize, usize) -> DVec4) -> DVec4 {
        let t = self.part;
        let start = value(self.before, 1);
        let end = value(self.after, 1);
        let leaving = value(self.before, 2) * self.span_s;
        let arriving = value(self.after, 0) * self.span_s;
        let t2 = t * t;
        let t3 = t2 * t;
        (2.0 * t3 - 3.0 * t2 + 1.0) * start
            + (t3 - 2.0 * t2 + t) * leaving
            + (-2.0 * t3 + 3.0 * t2) * end
            + (t3 - t2) * arriving
    }
}

fn vector(keys: &[Vec3], interpolation: Interpolation, at: &Between) -> DVec3 {
    let key = |index: usize| keys[index].as_dvec3();
    match interpolation {
        Interpolation::Step => key(at.before),
        Interpolation::Linear => key(at.before) + (key(at.after) - key(at.before)) * at.part,
        Interpolation::CubicSpline => at.cubic(|k, entry| key(3 * k + entry).extend(0.0)).truncate(),
    }
}

fn rotation(keys: &[Quat], interpolation: Interpolation, at: &Between) -> DQuat {
    let key = |index: usize| DVec4::from(keys[index].as_dquat());
    let found = match interpolation {
        Interpolation::Step => key(at.before),
        Interpolation::Linear => slerp(key(at.before).normalize(), key(at.after).normalize(), at.part),
        Interpolation::CubicSpline => at.cubic(|k, entry| key(3 * k + entry)),
    };
    match found.try_normalize() {
        Some(unit) => DQuat::from_vec4(unit),
        None => DQuat::IDENTITY,
    }
}

/// Appendix C.4: along the shorter arc.
fn slerp(from: DVec4, to: DVec4, part: f64) -> DVec4 {
    let dot = from.dot(to);
    let to = if dot < 0.0 { -to } else { to };
    // By the half chord: exact for small angles, where the cosine says nothing.
    let angle = 2.0 * ((to - from).length() * 0.5).clamp(0.0, 1.0).asin();
    if angle < 1e-9 {
        return from + (to - from) * part;
    }
    (from * ((1.0 - part) * angle).sin() + to * (part * angle).sin()) / angle.sin()
}

/// A morph target's weight.
pub fn weight(track: &MorphTrack, morph: usize, t_s: f64) -> f64 {
    let at = Between::find(&track.times_s, t_s);
    let count = track.morph_count as usize;
    let stored = |entry: usize| f64::from(track.weights[entry * count + morph]);
    match track.interpolation {
        Interpolation::Step => stored(at.before),
        Interpolation::Linear => stored(at.before) + (stored(at.after) - stored(at.before)) * at.part,
        Interpolation::CubicSpline => at.cubic(|k, entry| DVec4::splat(stored(3 * k + entry))).x,
    }
}

/// How far into a clip of this duration something is that plays it shifted, at a speed, and again and again.
fn phase_s(time_s: f64, shift_s: f32, speed: f32, duration_s: f32, repetition: Repetition) -> f64 {
    within_clip((time_s + f64::from(shift_s)) * f64::from(speed), duration_s, repetition)
}

fn within_clip(played_s: f64, duration_s: f32, repetition: Repetition) -> f64 {
    let duration_s = f64::from(duration_s);
    if duration_s <= 0.0 {
        return 0.0;
    }
    let rounds = played_s / duration_s;
    match repetition {
        Repetition::Once => played_s.clamp(0.0, duration_s),
        Repetition::Loop => played_s - rounds.floor() * duration_s,
        Repetition::PingPong => {
            let within_s = played_s - (rounds * 0.5).floor() * 2.0 * duration_s;
            duration_s - (within_s - duration_s).abs()
        }
    }
}

/// A clip of a model, and how far into it something is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InClip {
    /// Index into the model's clips; `None` for the rest pose.
    pub clip: Option<usize>,
    /// Seconds.
    pub phase_s: f64,
}

/// What an instance shows at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shown {
    /// What it plays.
    pub now: InClip,
    /// What it played before, and how much of that is left, above 0 and at most 1.
    pub before: Option<(InClip, f64)>,
}

/// What is played from one event to the next.
#[derive(Clone, Copy)]
struct Stretch {
    clip: Option<usize>,
    /// When the clip's local time is `local_s`.
    from_s: f64,
    local_s: f64,
    speed: f64,
    repetition: Repetition,
}

impl Stretch {
    fn of(instance: &Instance) -> Self {
        let (from_s, speed) = (-f64::from(instance.time_shift_s), f64::from(instance.speed));
        Self { clip: instance.clip, from_s, local_s: 0.0, speed, repetition: instance.repetition }
    }

    fn played_s(&self, time_s: f64) -> f64 {
        self.local_s + (time_s - self.from_s) * self.speed
    }

    fn then(&self, event: &Event) -> Self {
        let (at_s, change) = (event.at.0 as f64 * 1e-9, &event.change);
        let goes_on_s = if change.clip.is_some() { 0.0 } else { self.played_s(at_s) };
        Self {
            clip: change.clip.unwrap_or(self.clip),
            from_s: at_s,
            local_s: change.local_s.unwrap_or(goes_on_s),
            speed: change.speed.unwrap_or(self.speed),
            repetition: change.repetition.unwrap_or(self.repetition),
        }
    }

    fn at(&self, model: &Model, time_s: f64) -> InClip {
        let duration_s = self.clip.map_or(0.0, |clip| model.clips[clip].duration_s);
        InClip { clip: self.clip, phase_s: within_clip(self.played_s(time_s), duration_s, self.repetition) }
    }
}

/// What an instance shows at a time, by the events that have come until then.
pub fn shown(scene: &Scene, instance: usize, time_s: f64) -> Shown {
    let placed = &scene.instances[instance];
    let model = &scene.models[placed.model];
    let is_over = |event: &&Event| event.instance == instance && event.at.0 as f64 * 1e-9 <= time_s;
    let mut events: Vec<&Event> = scene.events.iter().filter(is_over).collect();
    events.sort_by_key(|event| event.at);
    let mut now = Stretch::of(placed);
    let mut before = None;
    for event in events {
        let passed_s = time_s - event.at.0 as f64 * 1e-9;
        let left = 1.0 - passed_s / (event.change.fade_ns as f64 * 1e-9);
        before = (event.change.fade_ns > 0 && left > 0.0).then(|| (now.at(model, time_s), left));
        now = now.then(event);
    }
    Shown { now: now.at(model, time_s), before }
}

/// Where a path takes what it moves.
pub fn path_transform(path: &Path, time_s: f64) -> DAffine3 {
    let t_s = phase_s(time_s, path.time_shift_s, path.speed, path.clip.duration_s, path.repetition);
    let mut local = Local::IDENTITY;
    path.clip.tracks.iter().for_each(|track| local.apply(track, t_s));
    local.affine()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn track(interpolation: Interpolation, times_s: Vec<f32>, values: TrackValues) -> Track {
        Track { bone: 0, times_s, interpolation, values }
    }

    fn at(track: &Track, t_s: f64) -> Local {
        let mut local = Local::IDENTITY;
        local.apply(track, t_s);
        local
    }

    #[test]
    fn step_holds_linear_halves_and_ends_stay() {
        let values = || TrackValues::Translation(vec![Vec3::ZERO, Vec3::new(2.0, 4.0, 6.0)]);
        let step = track(Interpolation::Step, vec![1.0, 2.0], values());
        assert_eq!(at(&step, 1.999).translation, DVec3::ZERO);
        let linear = track(Interpolation::Linear, vec![1.0, 2.0], values());
        assert_eq!(at(&linear, 1.5).translation, DVec3::new(1.0, 2.0, 3.0));
        assert_eq!(at(&linear, 0.0).translation, DVec3::ZERO);
        assert_eq!(at(&linear, 9.0).translation, DVec3::new(2.0, 4.0, 6.0));
    }

    #[test]
    fn cubic_spline_with_true_slopes_is_the_cubic() {
        let (x, slope) = (|t: f64| t * t * t - t, |t: f64| 3.0 * t * t - 1.0);
        let times_s = vec![0.0f32, 0.5, 2.0];
        let keys = times_s.iter().flat_map(|t| {
            let t = f64::from(*t);
            [slope(t), x(t), slope(t)].map(|v| Vec3::splat(v as f32))
        });
        let keys = keys.collect();
        let spline = track(Interpolation::CubicSpline, times_s, TrackValues::Scale(keys));
        for step in 0..=40 {
            let t = f64::from(step) * 0.05;
            assert!((at(&spline, t).scale.y - x(t)).abs() < 1e-6, "at {t}");
        }
    }

    #[test]
    fn rotations_turn_evenly_along_the_shorter_arc() {
        for sign in [1.0, -1.0] {
            let keys = vec![Quat::from_rotation_y(0.2), Quat::from_rotation_y(1.0) * sign];
            let turn = track(Interpolation::Linear, vec![0.0, 1.0], TrackValues::Rotation(keys));
            let off = at(&turn, 0.25).rotation.angle_between(DQuat::from_rotation_y(0.4));
            assert!(off < 1e-6, "{off}");
        }
    }

    #[test]
    fn repetitions_bring_time_into_the_clip() {
        let at = |time_s, repetition| phase_s(time_s, 1.0, 2.0, 4.0, repetition);
        assert_eq!([0.0, 0.5, 1.5, -3.0].map(|t| at(t, Repetition::Loop)), [2.0, 3.0, 1.0, 0.0]);
        assert_eq!([0.0, 1.5, 3.5, -1.5].map(|t| at(t, Repetition::PingPong)), [2.0, 3.0, 1.0, 1.0]);
        assert_eq!([0.0, 9.0, -9.0].map(|t| at(t, Repetition::Once)), [2.0, 4.0, 0.0]);
        assert_eq!(phase_s(3.0, 0.0, 1.0, 0.0, Repetition::Loop), 0.0);
    }

    #[test]
    fn weights_of_morphs_stand_beside_each_other_in_a_key() {
        let weights = vec![0.0, 10.0, 1.0, 20.0];
        let track = MorphTrack {
            first_morph: 0,
            morph_count: 2,
            times_s: vec![0.0, 1.0],
            interpolation: Interpolation::Linear,
            weights,
        };
        assert_eq!([0, 1].map(|morph| weight(&track, morph, 0.5)), [0.5, 15.0]);
    }
}

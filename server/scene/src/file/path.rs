//! Keyframed transforms of a scene file: a user's list of keys becomes the same curves as a clip's. Smooth paths get their
//! tangents here, so later modules know no further interpolation.

use super::fields::Fields;
use super::transform::{read_quaternion, read_scale, rotation_of};
use crate::limits::MAX_DURATION_S;
use crate::{Clip, Interpolation, Path, Repetition, SceneError, Track, TrackValues};
use glam::{Quat, Vec3, Vec4};

/// Most keys of one path.
pub const MAX_PATH_KEYS: usize = 4096;
/// Latest key of a path, seconds.
pub const MAX_PATH_DURATION_S: f32 = MAX_DURATION_S;
/// Largest factor of a path's scale.
const MAX_PATH_SCALE: f32 = 1000.0;
/// Most degrees from key to key about one axis: keys are joined along the shorter arc, and beyond this it is hardly
/// the one that was meant.
const MAX_TURN_DEG: f32 = 179.0;
/// A loop whose first and last keys differ by less than this is closed: it runs on through its start.
const CLOSED: f32 = 1e-4;

/// What a `[[path]]` has beside its name, and a path inside an instance altogether.
pub(super) const CURVE_KEYS: [&str; 5] = ["interpolation", "repetition", "time_shift_s", "speed", "key"];
const TRANSFORM_KEYS: [&str; 4] = ["translation", "rotation_euler_deg", "rotation_quaternion", "scale"];

/// Words for [`Repetition`].
pub(super) const REPETITIONS: [(&str, Repetition); 3] =
    [("once", Repetition::Once), ("loop", Repetition::Loop), ("ping-pong", Repetition::PingPong)];

/// How a path goes from key to key.
#[derive(Clone, Copy, PartialEq)]
enum Way {
    Step,
    Linear,
    Cubic,
}

const WAYS: [(&str, Way); 3] = [("step", Way::Step), ("linear", Way::Linear), ("cubic", Way::Cubic)];

/// One key; a channel that it does not mention goes on between the keys that do.
pub(super) struct Key {
    pub(super) time_s: f32,
    pub(super) translation: Option<Vec3>,
    pub(super) rotation: Option<Quat>,
    /// The angles that the rotation was given as.
    pub(super) euler_deg: Option<[f32; 3]>,
    pub(super) scale: Option<Vec3>,
    pub(super) line: usize,
}

/// All `[[path]]`, by name.
pub(super) fn read_paths(root: &Fields) -> Result<Vec<(String, Path)>, SceneError> {
    let known = [&["name"][..], &CURVE_KEYS].concat();
    let mut paths: Vec<(String, Path)> = Vec::new();
    for fields in root.tables("path", &known)? {
        let name = fields.unique_name("paths", paths.iter().map(|(name, _)| name.as_str()))?;
        let path = read_transform_path(&fields, &name)?;
        paths.push((name, path));
    }
    Ok(paths)
}

/// A path of an instance: keys of translation, rotation and scale.
pub(super) fn read_transform_path(fields: &Fields, name: &str) -> Result<Path, SceneError> {
    let keys = read_key_times(fields, &TRANSFORM_KEYS, read_transform_key)?;
    let path = read_path(fields, name, &keys)?;
    let (least, _) = path.scale_range();
    if least <= 0.0 {
        let problem = format!("between its keys the path's scale falls to {least}; use linear interpolation");
        return Err(fields.error("interpolation", problem));
    }
    Ok(path)
}

fn read_transform_key(fields: &Fields, time_s: f32) -> Result<Key, SceneError> {
    fields.only_one_of(&["rotation_euler_deg", "rotation_quaternion"])?;
    let euler_deg = fields.numbers::<3>("rotation_euler_deg")?;
    let rotation = euler_deg.map(rotation_of).or(read_quaternion(fields)?);
    let scale = if fields.has("scale") { Some(read_scale(fields)?) } else { None };
    if scale.is_some_and(|scale| scale.min_element() <= 0.0 || scale.max_element() > MAX_PATH_SCALE) {
        let problem = format!("\"scale\" of a path must be above 0 and at most {MAX_PATH_SCALE}");
        return Err(fields.error("scale", problem));
    }
    let translation = fields.vector_m("translation")?;
    Ok(Key { time_s, translation, rotation, euler_deg, scale, line: fields.line })
}

/// The `[[key]]` tables of a path: times rise, and each key is read by `read`.
pub(super) fn read_key_times(
    fields: &Fields,
    channels: &[&str],
    read: impl Fn(&Fields, f32) -> Result<Key, SceneError>,
) -> Result<Vec<Key>, SceneError> {
    let known = [&["time_s"], channels].concat();
    let tables = fields.tables("key", &known)?;
    if tables.is_empty() || tables.len() > MAX_PATH_KEYS {
        let problem = format!(
            "{} has {} keys; it needs [[{0}.key]] from 1 to {MAX_PATH_KEYS} times",
            fields.what,
            tables.len()
        );
        return Err(fields.source.error(fields.line, problem));
    }
    let mut keys: Vec<Key> = Vec::with_capacity(tables.len());
    for table in &tables {
        let time_s = table.number_within("time_s", 0.0..=MAX_PATH_DURATION_S, "seconds")?;
        let time_s = table.required("time_s", time_s)?;
        if let Some(before) = keys.last().filter(|before| before.time_s >= time_s) {
            let problem = format!("time {time_s} s is not after {} s; sort the keys", before.time_s);
            return Err(table.error("time_s", problem));
        }
        if table.first_of(channels).is_none() {
            let problem = format!("key has only a time; give it {}", channels.join(", "));
            return Err(table.source.error(table.line, problem));
        }
        keys.push(read(table, time_s)?);
    }
    Ok(keys)
}

/// The path of these keys, with its repetition and timing.
pub(super) fn read_path(fields: &Fields, name: &str, keys: &[Key]) -> Result<Path, SceneError> {
    let way = fields.choice("interpolation", &WAYS)?.unwrap_or(Way::Linear);
    let repetition = fields.choice("repetition", &REPETITIONS)?.unwrap_or_default();
    if way != Way::Step {
        check_turns(fields, keys)?;
    }
    let duration_s = keys.last().map_or(0.0, |key| key.time_s);
    let curve = Curve { way, closes_at_s: (repetition == Repetition::Loop).then_some(duration_s) };
    let channels = [Channel::Translation, Channel::Rotation, Channel::Scale];
    let tracks = channels.into_iter().filter_map(|channel| curve.track(keys, channel)).collect();
    Ok(Path {
        clip: Clip { name: name.to_owned(), duration_s, tracks, morph_tracks: Vec::new() },
        repetition,
        time_shift_s: fields.number("time_shift_s")?.unwrap_or(0.0),
        speed: fields.number("speed")?.unwrap_or(1.0),
    })
}

/// A turn that is given in degrees and goes the long way round would be shown the short way round.
fn check_turns(fields: &Fields, keys: &[Key]) -> Result<(), SceneError> {
    let turned: Vec<&Key> = keys.iter().filter(|key| key.rotation.is_some()).collect();
    for pair in turned.windows(2) {
        let (Some(before), Some(after)) = (pair[0].euler_deg, pair[1].euler_deg) else { continue };
        let turn_deg = (0..3).map(|axis| (after[axis] - before[axis]).abs()).fold(0.0, f32::max);
        if turn_deg > MAX_TURN_DEG {
            let problem = format!(
                "turns by {turn_deg} degrees in one step, which is shown along the shorter arc; put keys \
                 between, at most {MAX_TURN_DEG} degrees apart"
            );
            return Err(fields.source.error(pair[1].line, problem));
        }
    }
    Ok(())
}

/// What a curve moves.
#[derive(Clone, Copy, PartialEq)]
enum Channel {
    Translation,
    Rotation,
    Scale,
}

impl Channel {
    fn of(self, key: &Key) -> Option<Vec4> {
        match self {
            Self::Translation => key.translation.map(|translation| translation.extend(0.0)),
            Self::Rotation => key.rotation.map(Vec4::from),
            Self::Scale => key.scale.map(|scale| scale.extend(0.0)),
        }
    }

    fn values(self, points: Vec<Vec4>) -> TrackValues {
        let vectors = |points: Vec<Vec4>| points.into_iter().map(Vec4::truncate).collect();
        match self {
            Self::Translation => TrackValues::Translation(vectors(points)),
            Self::Rotation => TrackValues::Rotation(points.into_iter().map(Quat::from_vec4).collect()),
            Self::Scale => TrackValues::Scale(vectors(points)),
        }
    }
}

/// How the keys of each channel become a curve.
struct Curve {
    way: Way,
    /// The end of a path that is a loop.
    closes_at_s: Option<f32>,
}

impl Curve {
    /// The curve of one channel; `None` where no key mentions it.
    fn track(&self, keys: &[Key], channel: Channel) -> Option<Track> {
        let found = keys.iter().filter_map(|key| Some((key.time_s, channel.of(key)?)));
        let (times_s, mut points): (Vec<f32>, Vec<Vec4>) = found.unzip();
        if points.is_empty() {
            return None;
        }
        if channel == Channel::Rotation {
            take_shorter_arcs(&mut points);
        }
        let (interpolation, points) = match self.way {
            Way::Step => (Interpolation::Step, points),
            Way::Linear => (Interpolation::Linear, points),
            Way::Cubic => (Interpolation::CubicSpline, self.with_tangents(&times_s, &points, channel)),
        };
        Some(Track { bone: 0, times_s, interpolation, values: channel.values(points) })
    }

    /// In-tangent, value and out-tangent of each point. Tangents are those of the parabola through a point and its
    /// neighbours (Catmull-Rom, for keys that need not be evenly spaced); at an open end the slope of the last span.
    fn with_tangents(&self, times_s: &[f32], points: &[Vec4], channel: Channel) -> Vec<Vec4> {
        let last = points.len() - 1;
        let span = |from: usize| {
            let span_s = times_s[from + 1] - times_s[from];
            (span_s, (points[from + 1] - points[from]) / span_s)
        };
        let across = self.sign_across_the_seam(times_s, points, channel);
        let around = |from: usize| across.map(|sign| (span(from).0, span(from).1 * sign));
        let tangent = |point: usize| {
            let before = if point > 0 { Some(span(point - 1)) } else { around(last.saturating_sub(1)) };
            let after = if point < last { Some(span(point)) } else { around(0) };
            match (before, after) {
                (Some((before_s, rise)), Some((after_s, fall))) => {
                    (rise * after_s + fall * before_s) / (before_s + after_s)
                }
                (Some((_, slope)), None) | (None, Some((_, slope))) => slope,
                (None, None) => Vec4::ZERO,
            }
        };
        let triple = |(point, value): (usize, &Vec4)| [tangent(point), *value, tangent(point)];
        points.iter().enumerate().flat_map(triple).collect()
    }

    /// For a loop that ends where it starts: the sign that takes a value at its end to the one at its start, which
    /// is -1 for a rotation that has become its own negative on the way.
    fn sign_across_the_seam(&self, times_s: &[f32], points: &[Vec4], channel: Channel) -> Option<f32> {
        let (first, last) = (points.first()?, points.last()?);
        let spans_the_loop =
            points.len() > 1 && times_s.first() == Some(&0.0) && times_s.last().copied() == self.closes_at_s;
        let sign = if channel == Channel::Rotation && first.dot(*last) < 0.0 { -1.0 } else { 1.0 };
        (spans_the_loop && first.abs_diff_eq(*last * sign, CLOSED)).then_some(sign)
    }
}

/// Signs of quaternions such that neighbours lie in one hemisphere.
fn take_shorter_arcs(rotations: &mut [Vec4]) {
    for index in 1..rotations.len() {
        if rotations[index - 1].dot(rotations[index]) < 0.0 {
            rotations[index] = -rotations[index];
        }
    }
}

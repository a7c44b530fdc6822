//! A still head that suddenly moves at full speed, in a room full of unseen geometry: the share of holes meanwhile, and the
//! time until the picture is whole again.

use super::run::{comparer, into_probe, mock_config};
use crate::image::Rgb8Image;
use crate::measure::compare::{Comparer, Shown};
use crate::session::options::{Head, RunOptions};
use crate::session::{Lab, START_NS};
use anyhow::{Context, ensure};
use serde::{Deserialize, Serialize};
use shadecast_client::client::Step;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_mock_runtime::head_path::COLUMNS;
use shadecast_mock_runtime::record::{Side, picture_path, read_frames};
use shadecast_protocol::pose::Fov;
use std::fmt;
use std::fmt::Write as _;

/// The head stands still for so long, seconds: everything in view has arrived.
const STILL_S: f64 = 2.5;
/// Then it moves for so long, seconds.
const MOVING_S: f64 = 1.2;
/// Pictures of the last moments of standing still are looked at, too, seconds.
const SETTLED_S: f64 = 0.1;
/// How fast it turns to the left, degrees per second, and goes to the right, metres per second.
const TURN_DEG_S: f64 = 90.0;
const SPEED_M_S: f64 = 1.0;
/// A picture is whole while no more of it is missing: what is missing of one that has settled, and some.
const WHOLE: f64 = 0.01;
/// A picture is sharp while its FLIP is no more than so many times that of later ones: what is in view changes all the time.
const SHARP: f64 = 1.25;

/// How it went.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AbruptReport {
    /// Display frames from the start of the head until its picture was whole and stayed so, seconds.
    pub whole_after_s: f64,
    /// The largest share of a picture that was missing.
    pub worst_hole_fraction: f64,
    /// The same of the pictures while the head still stood, the mean.
    pub still_hole_fraction: f64,
    /// From when the client began to connect to its first picture, seconds of virtual time.
    pub first_picture_s: f64,
    /// From the start of the head until the picture was as sharp as later on, and stayed so, seconds.
    pub sharp_after_s: f64,
    /// FLIP of what `sharp_after_s` calls sharp, the median of the second half of the frames.
    pub settled_flip: f64,
    /// Of each display frame from the start of the head on: seconds since, share that is missing.
    pub holes: Vec<[f64; 2]>,
    /// The same with FLIP at 67 pixels a degree, 0 is identical.
    pub flips: Vec<[f64; 2]>,
}

impl fmt::Display for AbruptReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { whole_after_s, worst_hole_fraction, still_hole_fraction, first_picture_s, .. } = self;
        let Self { sharp_after_s, settled_flip, .. } = self;
        write!(
            f,
            "  abrupt start    whole after {whole_after_s:.3} s, {:.1} % missing at worst ({:.2} % while still), \
             sharp after {sharp_after_s:.3} s (FLIP {settled_flip:.4}), first picture after {first_picture_s:.3} s",
            worst_hole_fraction * 100.0,
            still_hole_fraction * 100.0,
        )
    }
}

/// Runs `options` in virtual time along a path that starts abruptly. To be called where [`crate::experiments::run::run`] may be.
///
/// # Errors
/// Anything that keeps the run from going on.
pub fn measure(options: &RunOptions) -> anyhow::Result<AbruptReport> {
    std::fs::create_dir_all(&options.out).with_context(|| format!("making {}", options.out.display()))?;
    let head = options.out.join("abrupt.csv");
    std::fs::write(&head, head_csv()).with_context(|| format!("writing {}", head.display()))?;
    let options = RunOptions { head: Head::File(head), seconds: STILL_S + MOVING_S, ..options.clone() };
    let config = MockConfig { seconds: 0.0, ..mock_config(&options, ClockKind::Virtual, 1)? };
    // SAFETY: the caller's promise, as for `run`.
    let mut lab = unsafe { Lab::open(&options, &config) }?;
    let mut comparer = comparer(&lab.server, &options)?;
    let mut report = AbruptReport::default();
    let mut still = Vec::new();
    let mut first_ns = None;
    while let Step::Frame(shown) = lab.step()? {
        let at_ns = shown.display_time.0 - START_NS;
        if shown.update.is_some() {
            first_ns.get_or_insert(at_ns);
        }
        let since_s = at_ns as f64 * 1e-9 - STILL_S;
        if since_s > MOVING_S {
            break;
        }
        if since_s < -SETTLED_S {
            continue;
        }
        ensure!(shown.update.is_some(), "no picture {since_s:.3} s after the start of the head");
        let (missing, flip) = looked_at(&options, &mut lab, &mut comparer)?;
        if since_s < 0.0 {
            still.push(missing);
        } else {
            report.holes.push([since_s, missing]);
            report.flips.push([since_s, flip]);
        }
    }
    report.first_picture_s = first_ns.context("no picture")? as f64 * 1e-9;
    report.still_hole_fraction = still.iter().sum::<f64>() / still.len().max(1) as f64;
    report.judge();
    Ok(report)
}

impl AbruptReport {
    fn judge(&mut self) {
        self.worst_hole_fraction = self.holes.iter().map(|[_, missing]| *missing).fold(0.0, f64::max);
        self.whole_after_s = within_after_s(&self.holes, WHOLE);
        let mut late: Vec<f64> = self.flips[self.flips.len() / 2..].iter().map(|[_, flip]| *flip).collect();
        late.sort_by(f64::total_cmp);
        self.settled_flip = late.get(late.len() / 2).copied().unwrap_or(0.0);
        self.sharp_after_s = within_after_s(&self.flips, SHARP * self.settled_flip);
    }
}

/// From when on the second number of each row is within `most`; the last row's first where none is.
fn within_after_s(rows: &[[f64; 2]], most: f64) -> f64 {
    let last = rows.iter().rposition(|[_, value]| *value > most);
    let within = last.map_or(0, |last| last + 1).min(rows.len().saturating_sub(1));
    rows.get(within).map_or(0.0, |[since_s, _]| *since_s)
}

/// The share of what both eyes should see that is missing, and FLIP of what both see.
fn looked_at(options: &RunOptions, lab: &mut Lab, comparer: &mut Comparer) -> anyhow::Result<(f64, f64)> {
    let capture = options.out.join("capture");
    let records = read_frames(&capture).context("reading the runtime's frame log")?;
    let record = records.last().context("no frame was captured")?;
    let probes = lab.client.presenter.probe()?.map(into_probe);
    let world_from_stage = lab.server.scene.scene.world_from_stage;
    let (mut missing, mut flip) = (0.0, 0.0);
    for (eye, side) in [Side::Left, Side::Right].into_iter().enumerate() {
        let view = record.views.get(eye).context("a captured frame has two views")?;
        let fov: Fov = view.frustum();
        let picture = Rgb8Image::read_png(&picture_path(&capture, record.frame, side))?;
        let (_, metrics) = comparer.measure(&Shown {
            world_from_eye: world_from_stage.then(view.stage_pose.into()),
            fov,
            time: lab.server.world_time(record.predicted_display_time_ns),
            picture: &picture,
            probe: Some(&probes[eye]),
        })?;
        missing += metrics.holes.strict / 2.0;
        flip += metrics.picture.context("the room fills every view")?.flip / 2.0;
    }
    Ok((missing, flip))
}

/// Rows a thousandth of a second apart around the start, so that it is abrupt.
fn head_csv() -> String {
    let mut text = format!("{COLUMNS}\n");
    let end_s = STILL_S + MOVING_S + 1.0;
    let times = [0.0, STILL_S].into_iter().chain((1..).map(|step| STILL_S + f64::from(step) * 0.01));
    for t_s in times.take_while(|t_s| *t_s <= end_s) {
        let moving_s = (t_s - STILL_S).max(0.0);
        let (sin, cos) = (0.5 * (moving_s * TURN_DEG_S).to_radians()).sin_cos();
        let _ = writeln!(text, "{t_s:.6},{:.6},1.6,0,0,{sin:.9},0,{cos:.9}", moving_s * SPEED_M_S);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_mock_runtime::head_path::HeadPath;

    #[test]
    fn the_head_stands_and_then_has_its_full_speed_at_once() {
        let path = HeadPath::parse(&head_csv(), "abrupt.csv").expect("valid");
        let speed = |t_s: f64| {
            let [before, after] = [path.pose_at(t_s - 0.02), path.pose_at(t_s + 0.02)];
            let turned = before.orientation.angle_between(after.orientation).to_degrees();
            [turned / 0.04, before.position.distance(after.position) / 0.04]
        };
        assert_eq!(speed(STILL_S - 0.021), [0.0; 2]);
        let [turn, go] = speed(STILL_S + 0.021);
        assert!((turn - 90.0).abs() < 1.0 && (go - 1.0).abs() < 0.01, "{turn} {go}");
    }

    #[test]
    fn whole_is_when_nothing_is_missing_any_more() {
        let holes = vec![[0.0, 0.0], [0.1, 0.3], [0.2, 0.005], [0.3, 0.02], [0.4, 0.0], [0.5, 0.0]];
        let mut report = AbruptReport { holes, ..AbruptReport::default() };
        report.judge();
        assert_eq!((report.whole_after_s, report.worst_hole_fraction), (0.4, 0.3));
        report.holes.push([0.6, 0.5]);
        report.judge();
        assert_eq!(report.whole_after_s, 0.6, "never whole counts to the end");
    }

    #[test]
    fn sharp_is_when_pictures_are_as_they_are_later_on() {
        let flips = [0.09, 0.06, 0.038, 0.03, 0.03, 0.031, 0.029, 0.03];
        let flips = (0..).zip(flips).map(|(frame, flip)| [f64::from(frame) * 0.1, flip]).collect();
        let mut report = AbruptReport { flips, ..AbruptReport::default() };
        report.judge();
        assert_eq!((report.sharp_after_s, report.settled_flip), (f64::from(3) * 0.1, 0.03));
    }
}

//! Figures for the viewer: a few lines, renewed twice a second.

use super::stats::{Counters, so_far};
use crate::report::FrameReport;
use shadecast_protocol::time::{ClientTime, WorldTime};
use std::fmt::{self, Write as _};

/// How often they change: readable, and fresh.
const EVERY_NS: i64 = 500_000_000;

/// All that there can be, and bytes of one.
const MOST_LINES: usize = 12;
const LINE_BYTES: usize = 256;

/// What was counted when the figures were last made.
#[derive(Clone, Copy, Debug, Default)]
struct Counted {
    frames: u64,
    bundles: u64,
    atlas_bytes: u64,
    geometry_bytes: u64,
    lost_pictures: u64,
    repeated_frames: u64,
}

/// Makes figures.
#[derive(Debug, Default)]
pub(crate) struct Figures {
    last: Option<(ClientTime, Counted)>,
    /// From the arrival of the newest picture to its display.
    latency_ns: Option<i64>,
    /// The world's time in the last display frame.
    world: Option<WorldTime>,
    lines: Lines,
}

/// Lines whose memory is taken once, since the thread that draws writes them.
#[derive(Debug)]
struct Lines {
    lines: [String; MOST_LINES],
    written: usize,
}

impl Figures {
    /// Nobody has seen any; the next ones are of the time from then on.
    pub(crate) fn begin_anew(&mut self) {
        (self.last, self.latency_ns, self.world) = (None, None, None);
        self.lines.begin();
    }

    /// Takes in a display frame whose picture, where it is a new one, had `arrived`. Gives the lines where they are new.
    pub(crate) fn note(
        &mut self,
        counters: &Counters,
        frame: &FrameReport,
        arrived: Option<ClientTime>,
    ) -> Option<&[String]> {
        let now = frame.display_time;
        let stands = frame.world_time.is_some() && self.world == frame.world_time;
        self.world = frame.world_time;
        self.latency_ns = arrived.map(|arrived| now.since(arrived)).or(self.latency_ns);
        let counted = Counted::of(counters);
        let (since, before) = *self.last.get_or_insert((now, counted));
        let passed_ns = now.since(since);
        if passed_ns < EVERY_NS && !self.lines.written().is_empty() {
            return None;
        }
        self.last = Some((now, counted));
        let per_s = |count: u64| if passed_ns > 0 { count as f64 * 1e9 / passed_ns as f64 } else { 0.0 };
        let mbit = |bytes: u64| per_s(bytes) * 8e-6;
        let Counted { frames, bundles, atlas_bytes, geometry_bytes, lost_pictures, repeated_frames } =
            counted.since(before);
        let lines = &mut self.lines;
        lines.begin();
        lines.add(format_args!("{}", counters.device));
        lines.add(format_args!("{:.1} frames/s, {:.1} updates/s", per_s(frames), per_s(bundles)));
        let (pictures, geometry) = (mbit(atlas_bytes), mbit(geometry_bytes));
        lines.add(format_args!("{pictures:.2} Mbit/s of pictures, {geometry:.2} of geometry"));
        lines.add(format_args!("{} ms from arrival to display", Ms(self.latency_ns)));
        lines.add(format_args!("{} ms clock error at most", Ms(frame.clock_error_bound_ns)));
        if stands {
            lines.add(format_args!("the world is halted"));
        }
        let faults = [
            (u64::from(frame.held_vertices), "vertices held"),
            (u64::from(frame.frozen_vertices), "vertices frozen"),
            (u64::from(frame.withheld_vertices), "vertices withheld"),
            (u64::from(frame.withheld_patches), "patches withheld"),
            (lost_pictures, "pictures lost"),
            (repeated_frames, "frames repeated: the device is behind"),
        ];
        for (count, what) in faults.iter().filter(|(count, _)| *count > 0) {
            lines.add(format_args!("{count} {what}"));
        }
        Some(self.lines.written())
    }
}

/// Milliseconds, where they are known.
struct Ms(Option<i64>);

impl fmt::Display for Ms {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(ns) => write!(f, "{:.1}", ns as f64 * 1e-6),
            None => f.write_str("-"),
        }
    }
}

impl Default for Lines {
    fn default() -> Self {
        Self { lines: std::array::from_fn(|_| String::with_capacity(LINE_BYTES)), written: 0 }
    }
}

impl Lines {
    fn begin(&mut self) {
        self.written = 0;
    }

    fn add(&mut self, line: fmt::Arguments<'_>) {
        let into = &mut self.lines[self.written];
        into.clear();
        // A string takes whatever is written.
        let _ = into.write_fmt(line);
        self.written += 1;
    }

    fn written(&self) -> &[String] {
        &self.lines[..self.written]
    }
}

impl Counted {
    fn of(counters: &Counters) -> Self {
        let Counters { frames, bundles, repeated_frames, arrived, .. } = counters;
        Self {
            frames: frames - repeated_frames,
            bundles: *bundles,
            atlas_bytes: so_far(&arrived.atlas_bytes),
            geometry_bytes: so_far(&arrived.geometry_bytes),
            lost_pictures: so_far(&arrived.lost_pictures),
            repeated_frames: *repeated_frames,
        }
    }

    fn since(self, before: Self) -> Self {
        Self {
            frames: self.frames - before.frames,
            bundles: self.bundles - before.bundles,
            atlas_bytes: self.atlas_bytes - before.atlas_bytes,
            geometry_bytes: self.geometry_bytes - before.geometry_bytes,
            lost_pictures: self.lost_pictures - before.lost_pictures,
            repeated_frames: self.repeated_frames - before.repeated_frames,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::Ordering;

    const MS: i64 = 1_000_000;

    fn frame(ms: i64) -> FrameReport {
        FrameReport { is_new: ms % 100 == 0, ..FrameReport::rendered_at(ClientTime(ms * MS)) }
    }

    #[test]
    fn rates_are_those_of_the_last_half_second() {
        let (mut figures, mut counters) = (Figures::default(), Counters::default());
        let arrived = counters.arrived.clone();
        let mut told = Vec::new();
        for ms in (0..=1500).step_by(20) {
            counters.count(&frame(ms));
            arrived.atlas_bytes.fetch_add(2500, Ordering::Relaxed);
            let arrived = frame(ms).is_new.then(|| ClientTime((ms - 7) * MS));
            if let Some(lines) = figures.note(&counters, &frame(ms), arrived) {
                told.push((ms, lines.to_vec()));
            }
        }
        let times: Vec<i64> = told.iter().map(|(ms, _)| *ms).collect();
        assert_eq!(times, [0, 500, 1000, 1500], "twice a second, and at once");
        let text = told[2].1.join("; ");
        for part in ["50.0 frames/s", "10.0 updates/s", "1.00 Mbit/s of pictures", "7.0 ms from arrival"] {
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(!text.contains("held"), "what does not happen is not told: {text}");
        let world_time = Some(WorldTime(7));
        figures.note(&counters, &FrameReport { world_time, ..frame(1510) }, None);
        let halted = FrameReport { world_time, ..frame(2000) };
        let lines = figures.note(&counters, &halted, None).expect("half a second later").join("; ");
        assert!(lines.contains("the world is halted") && !text.contains("halted"), "{lines}");
        let late = FrameReport { held_vertices: 3, ..frame(2500) };
        let lines = figures.note(&counters, &late, None).expect("half a second later").join("; ");
        assert!(lines.contains("3 vertices held"), "{lines}");
    }
}

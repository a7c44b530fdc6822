//! The largest scale of a path over time.

use crate::animation::clip::{TrackValue, evaluate_track};
use crate::{Interpolation, Path, Track, TrackValues};

/// Moments within each span of a smooth curve that are looked at.
const MOMENTS_PER_SPAN: usize = 16;

impl Path {
    /// Smallest and largest factor of the path's scale over all axes and times; (1, 1) where it does not scale.
    /// Smooth curves, which may leave the range of their keys, are looked at between them too.
    pub fn scale_range(&self) -> (f32, f32) {
        let scales = self.clip.tracks.iter().filter(|track| matches!(track.values, TrackValues::Scale(_)));
        let factors = scales.flat_map(|track| {
            moments(track).into_iter().filter_map(|t_s| match evaluate_track(track, t_s) {
                TrackValue::Scale(scale) => Some((scale.min_element(), scale.max_element())),
                _ => None,
            })
        });
        let wider = |a: (f32, f32), b: (f32, f32)| (a.0.min(b.0), a.1.max(b.1));
        factors.reduce(wider).unwrap_or((1.0, 1.0))
    }
}

/// The keys, and for smooth curves moments between them.
fn moments(track: &Track) -> Vec<f64> {
    let mut moments: Vec<f64> = track.times_s.iter().map(|time_s| f64::from(*time_s)).collect();
    if track.interpolation == Interpolation::CubicSpline {
        let span = |span: &[f32]| {
            let [from, to] = [span[0], span[1]].map(f64::from);
            (1..MOMENTS_PER_SPAN).map(move |i| from + (to - from) * i as f64 / MOMENTS_PER_SPAN as f64)
        };
        moments.extend(track.times_s.windows(2).flat_map(span));
    }
    moments
}

//! Smooth curves through a few hand-placed points.

use std::f32::consts::PI;

/// Uniform Catmull-Rom spline through `rows`; `t` counts rows from 0 and is clamped to their range.
pub(crate) fn catmull_rom<const N: usize>(rows: &[[f32; N]], t: f32) -> [f32; N] {
    let last = rows.len() - 1;
    let t = t.clamp(0.0, last as f32);
    let i = (t as usize).min(last.saturating_sub(1));
    let f = t - i as f32;
    let (before, after) = (i.saturating_sub(1), (i + 2).min(last));
    std::array::from_fn(|k| {
        let (p0, p1, p2, p3) = (rows[before][k], rows[i][k], rows[(i + 1).min(last)][k], rows[after][k]);
        let linear = p2 - p0;
        let square = 2.0 * p0 - 5.0 * p1 + 4.0 * p2 - p3;
        let cube = 3.0 * (p1 - p2) + p3 - p0;
        p1 + 0.5 * f * (linear + f * (square + f * cube))
    })
}

/// 0 below `low`, 1 above `high`, smooth between them.
pub(crate) fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// `a` at 0, `b` at 1.
pub(crate) fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// 0 at both ends of `0..=1`, 1 in the middle.
pub(crate) fn arch(t: f32) -> f32 {
    (PI * t.clamp(0.0, 1.0)).sin()
}

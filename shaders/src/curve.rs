//! The curve of a vertex through its samples, as in `client_interpolate.comp`. It serves estimates of its error.

/// Lagrange's polynomial through samples at -1, 0, 1, 2, at `f` in 0..=1.
pub fn cubic_weights(f: f32) -> [f32; 4] {
    [
        -f * (f - 1.0) * (f - 2.0) / 6.0,
        (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0,
        -(f + 1.0) * f * (f - 2.0) / 2.0,
        (f + 1.0) * f * (f - 1.0) / 6.0,
    ]
}

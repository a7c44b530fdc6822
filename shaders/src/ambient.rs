//! As `ambient.glsl` has it: the sky's light on a surface.

use glam::{Vec3, Vec4};

/// The sky's three colours, linear radiance.
#[derive(Clone, Copy, Debug)]
pub struct Sky {
    /// Straight up.
    pub zenith: Vec3,
    /// All around.
    pub horizon: Vec3,
    /// Straight down.
    pub nadir: Vec3,
}

impl Sky {
    fn mean(&self, of_zenith: f32, of_nadir: f32) -> Vec3 {
        self.zenith * of_zenith + self.nadir * of_nadir + self.horizon * (1.0 - of_zenith - of_nadir)
    }

    /// Irradiance divided by pi on a surface whose unit normal has the height `up`.
    pub fn irradiance(&self, up: f32) -> Vec3 {
        self.mean(zenith_in_irradiance(up), zenith_in_irradiance(-up))
    }

    /// Mean radiance over the lobe of a surface of this roughness whose reflection has the height `up`.
    pub fn reflection(&self, up: f32, roughness: f32) -> Vec3 {
        self.mean(zenith_in_reflection(up, roughness), zenith_in_reflection(-up, roughness))
    }
}

fn zenith_in_irradiance(up: f32) -> f32 {
    let square = up * up;
    (0.3055 + 0.4 * up + square * (0.0695 + 0.0235 * square)).max(0.0)
}

fn zenith_in_reflection(up: f32, roughness: f32) -> f32 {
    let r2 = roughness * roughness;
    let r4 = r2 * r2;
    let r = Vec3::new(r2, r2 * roughness, r4);
    let (width_even, width_odd) = (1.3968 * r2 - 0.0745 * r4, 2.4789 * r2 - 1.2259 * r4);
    let root = |width: f32| (up * up + width * width + 1e-12).sqrt().sqrt();
    let weight = r.dot(Vec3::new(-0.02108, -0.70798, 1.2977))
        + root(width_even) * (0.5 + r.dot(Vec3::new(0.0963, -0.76306, -0.06494)))
        + up / root(width_odd) * (0.5 + r.dot(Vec3::new(0.03796, 0.54777, -1.11835)))
        + up * (r.dot(Vec3::new(-0.24412, 0.14341, 0.52646))
            + up * r.dot(Vec3::new(0.07422, 0.2719, -0.2196)));
    weight.max(0.0)
}

/// Share of the light from where a surface reflects that it gives on.
pub fn ambient_brdf(f0: Vec3, roughness: f32, n_dot_v: f32) -> Vec3 {
    let r = roughness * Vec4::new(-1.0, -0.0275, -0.572, 0.022) + Vec4::new(1.0, 0.0425, 1.04, -0.04);
    let a004 = (r.x * r.x).min((-9.28 * n_dot_v).exp2()) * r.x + r.y;
    f0 * (-1.04 * a004 + r.z) + (1.04 * a004 + r.w)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::PI;

    /// The zenith's weight in the sky itself.
    fn zenith_seen(up: f64) -> f64 {
        up.max(0.0).sqrt()
    }

    /// The height of a direction at an angle to one of height `up`, turned around it.
    fn height(up: f64, cosine: f64, turn: f64) -> f64 {
        up * cosine + (1.0 - up * up).max(0.0).sqrt() * (1.0 - cosine * cosine).max(0.0).sqrt() * turn.cos()
    }

    /// Mean over a half turn (the other is alike) of the zenith's weight around a direction.
    fn around(up: f64, cosine: f64) -> f64 {
        const STEPS: usize = 400;
        let turn = |step: usize| (step as f64 + 0.5) / STEPS as f64 * PI;
        (0..STEPS).map(|step| zenith_seen(height(up, cosine, turn(step)))).sum::<f64>() / STEPS as f64
    }

    /// Over the hemisphere around the normal, by equal steps of the cosine: equal solid angles.
    fn irradiance_by_steps(up: f64) -> f64 {
        const STEPS: usize = 400;
        let cosine = |step: usize| (step as f64 + 0.5) / STEPS as f64;
        (0..STEPS).map(|step| 2.0 * cosine(step) * around(up, cosine(step))).sum::<f64>() / STEPS as f64
    }

    /// Karis (2014), `PrefilterEnvMap`: half vectors by the density of GGX, each reflection by its cosine.
    fn reflection_by_steps(up: f64, roughness: f64) -> f64 {
        const STEPS: usize = 400;
        let a2 = (roughness * roughness).max(1e-3).powi(2);
        let (mut sum, mut weights) = (0.0, 0.0);
        for step in 0..STEPS {
            let share = (step as f64 + 0.5) / STEPS as f64;
            let half_cosine_squared = (1.0 - share) / (1.0 + (a2 - 1.0) * share);
            let cosine = 2.0 * half_cosine_squared - 1.0;
            if cosine > 0.0 {
                sum += cosine * around(up, cosine);
                weights += cosine;
            }
        }
        sum / weights
    }

    /// From straight down to straight up, closest where the sky has its edge.
    fn heights() -> impl Iterator<Item = f64> {
        (-20..=20).map(|step| f64::from(step) / 20.0).map(|x: f64| 0.3 * x + 0.7 * x.powi(3))
    }

    #[test]
    fn irradiance_is_the_hemisphere_integral_within_0_2_percent() {
        for up in heights() {
            let [found, expected] = [f64::from(zenith_in_irradiance(up as f32)), irradiance_by_steps(up)];
            assert!((found - expected).abs() < 0.002, "{up}: {found}, not {expected}");
        }
    }

    #[test]
    fn a_reflection_is_the_prefiltered_sky_within_four_thousandths() {
        for roughness in [0.04, 0.08, 0.12, 0.17, 0.23, 0.3, 0.38, 0.47, 0.57, 0.68, 0.8, 0.92, 1.0] {
            for up in heights() {
                let found = f64::from(zenith_in_reflection(up as f32, roughness as f32));
                let expected = reflection_by_steps(up, roughness);
                let what = format!("roughness {roughness}, height {up}: {found}, not {expected}");
                assert!((found - expected).abs() < 0.004, "{what}");
            }
        }
    }

    #[test]
    fn a_polished_surface_mirrors_the_sky() {
        for up in heights() {
            let found = f64::from(zenith_in_reflection(up as f32, 0.04));
            // Beside the horizon even this lobe sees both sides of the sky's edge.
            let bound = if up.abs() < 0.01 { 0.04 } else { 0.004 };
            assert!((found - zenith_seen(up)).abs() < bound, "{up}: {found}");
        }
    }

    /// What a white metal gives on of a white sky by one bounce off GGX, with the visibility of `pbr.glsl`.
    fn kept_by_steps(n_v: f64, roughness: f64) -> f64 {
        const STEPS: usize = 300;
        let a2 = (roughness * roughness).max(1e-3).powi(2);
        let side = (1.0 - n_v * n_v).sqrt();
        let at = |step: usize| (step as f64 + 0.5) / STEPS as f64;
        let bounce = |half_cosine: f64, turn: f64| {
            let v_h = n_v * half_cosine + side * (1.0 - half_cosine * half_cosine).sqrt() * turn.cos();
            let n_l = 2.0 * v_h * half_cosine - n_v;
            if v_h <= 0.0 || n_l <= 0.0 {
                return 0.0;
            }
            let masked = |of: f64, by: f64| of * (by * by * (1.0 - a2) + a2).sqrt();
            let visibility = 0.5 / (masked(n_l, n_v) + masked(n_v, n_l));
            4.0 * visibility * n_l * v_h / half_cosine
        };
        let row = |half_cosine: f64| (0..STEPS).map(|step| bounce(half_cosine, at(step) * PI)).sum::<f64>();
        let half_cosine = |share: f64| ((1.0 - share) / (1.0 + (a2 - 1.0) * share)).sqrt();
        (0..STEPS).map(|step| row(half_cosine(at(step)))).sum::<f64>() / (STEPS * STEPS) as f64
    }

    #[test]
    fn in_a_white_furnace_diffuse_and_lobe_are_white() {
        let sky = Sky { zenith: Vec3::ONE, horizon: Vec3::ONE, nadir: Vec3::ONE };
        for up in heights().map(|up| up as f32) {
            assert!(sky.irradiance(up).abs_diff_eq(Vec3::ONE, 1e-6));
            for roughness in [0.04, 0.3, 0.6, 1.0] {
                assert!(sky.reflection(up, roughness).abs_diff_eq(Vec3::ONE, 1e-6));
            }
        }
    }

    #[test]
    fn a_white_metal_in_a_furnace_loses_what_one_bounce_loses() {
        for roughness in [0.04, 0.2, 0.4, 0.6, 0.8, 1.0] {
            for n_v in [0.2, 0.4, 0.6, 0.8, 1.0] {
                let found = ambient_brdf(Vec3::ONE, roughness as f32, n_v as f32).x;
                let expected = kept_by_steps(n_v, roughness);
                let what = format!("roughness {roughness}, cosine {n_v}: {found}, not {expected}");
                assert!((f64::from(found) - expected).abs() < 0.2, "{what}");
            }
        }
    }
}

//! As `reflected` in `pbr.glsl` has it: what a surface reflects of a light.

use glam::Vec3;
use std::f32::consts::PI;

/// What light falls on.
#[derive(Clone, Copy, Debug)]
pub struct Finish {
    /// Albedo of what is scattered.
    pub diffuse: Vec3,
    /// Reflectance at normal incidence.
    pub f0: Vec3,
    /// 0..1.
    pub roughness: f32,
}

/// Radiance towards `v` for an irradiance of 1 on a surface that faces `l`; unit vectors.
pub fn reflected(n: Vec3, v: Vec3, l: Vec3, Finish { diffuse, f0, roughness }: Finish) -> Vec3 {
    let h = (l + v).normalize_or(n);
    let (n_l, n_v) = (n.dot(l).max(0.0), n.dot(v).max(1e-3));
    let (n_h, v_h) = (n.dot(h).max(0.0), v.dot(h).max(0.0));
    let a = (roughness * roughness).max(1e-3);
    let a2 = a * a;
    let d = n_h * n_h * (a2 - 1.0) + 1.0;
    let distribution = a2 / (PI * d * d);
    let visibility = 0.5
        / (n_l * (n_v * n_v * (1.0 - a2) + a2).sqrt() + n_v * (n_l * n_l * (1.0 - a2) + a2).sqrt() + 1e-5);
    let grazing = 1.0 - v_h;
    let fresnel = f0 + (1.0 - f0) * (grazing * grazing) * (grazing * grazing) * grazing;
    ((1.0 - fresnel) * diffuse / PI + fresnel * distribution * visibility) * n_l
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    #[test]
    fn a_matt_surface_scatters_a_pi_th_and_a_smooth_one_shines_where_it_mirrors() {
        let matt = Finish { diffuse: Vec3::ONE, f0: Vec3::ZERO, roughness: 1.0 };
        let l = Vec3::new(0.6, 0.8, 0.0);
        assert!((reflected(Vec3::Y, Vec3::Y, l, matt) - 0.8 / PI).abs().max_element() < 0.01);
        let smooth = Finish { diffuse: Vec3::ZERO, f0: Vec3::splat(0.5), roughness: 0.3 };
        let towards = |degrees: f32| {
            let v = Quat::from_rotation_z(degrees.to_radians()) * Vec3::new(-0.6, 0.8, 0.0);
            reflected(Vec3::Y, v, l, smooth).x
        };
        assert!(towards(0.0) > 4.0 * towards(20.0) && towards(0.0) > 4.0 * towards(-20.0));
        assert_eq!(reflected(Vec3::Y, Vec3::Y, -l, smooth), Vec3::ZERO, "from behind");
    }

    /// Part of the light from all directions that a white metal gives on towards `v`.
    fn given_on(roughness: f32, v: Vec3) -> f32 {
        let metal = Finish { diffuse: Vec3::ZERO, f0: Vec3::ONE, roughness };
        // Equal steps of height are equal solid angles.
        let light = |height: usize, turn: usize| {
            let (up, turn) = ((height as f32 + 0.5) / 200.0, (turn as f32 + 0.5) / 100.0 * PI);
            let aside = (1.0 - up * up).sqrt();
            Vec3::new(aside * turn.cos(), up, aside * turn.sin())
        };
        let all = (0..200).flat_map(|height| (0..200).map(move |turn| (height, turn)));
        let sum: f32 = all.map(|(height, turn)| reflected(Vec3::Y, v, light(height, turn), metal).x).sum();
        sum * 2.0 * PI / 40_000.0
    }

    #[test]
    fn no_more_is_reflected_than_falls_on_it() {
        for roughness in [0.3, 0.6, 1.0] {
            assert!(
                given_on(roughness, Vec3::Y) < 1.03 && given_on(roughness, Vec3::new(0.6, 0.8, 0.0)) < 1.03
            );
        }
        // The integral of u / (1 + u): where the roughness is 1, the distribution is flat and the visibility 0.5 / (n_l + n_v).
        assert!((given_on(1.0, Vec3::Y) - (1.0 - std::f32::consts::LN_2)).abs() < 1e-3);
    }
}

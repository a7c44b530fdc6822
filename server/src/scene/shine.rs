//! How much the light of a flat surface changes with the eye, evaluated where [`Gloss`](crate::scene::gloss::Gloss) only bounds it: for copies in the store. Pure.
//!
//! The bound holds for any sky and any light. What a rough surface mirrors of a smooth sky changes many times less, and it is most of
//! what there is. Normals within [`TILT_RAD`] stand for normal maps, smooth shading and the extent of a patch.

use glam::Vec3;
use shadecast_shaders::ambient::{Sky, ambient_brdf};
use shadecast_shaders::pbr::{Finish, reflected};

/// The least roughness that is evaluated: highlights of smoother surfaces are smaller than the tilts tell apart.
pub(crate) const LEAST_ROUGHNESS: f32 = 0.4;
/// By how much the normals differ that are tried, radians.
const TILT_RAD: f32 = 0.2;
/// A patch that extends over more than twice this angle from its middle is not evaluated.
const MOST_TILT_RAD: f32 = 0.4;
/// Nor is one whose normal has a smaller cosine towards the eye: what grazes it is mirrored more and more.
const LEAST_FACING: f32 = 0.25;

/// The light of a scene that stays.
#[derive(Clone, Copy, Debug)]
pub struct StillLight {
    /// The sky's.
    pub sky: Sky,
    /// Unit, towards the sun.
    pub to_sun: Vec3,
    /// Of the sun, where it is not in shadow.
    pub irradiance: Vec3,
}

/// How a material reflects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shine {
    /// [`LEAST_ROUGHNESS`]..=1, of the smoothest part that counts.
    pub roughness: f32,
    /// At normal incidence, of the brightest channel.
    pub reflectance: f32,
    /// Albedo of what is scattered, of the brightest channel.
    pub diffuse: f32,
}

/// A flat part of a surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Facet {
    /// Its middle.
    pub centre: Vec3,
    /// Of a ball around it, metres.
    pub radius_m: f32,
    /// Unit.
    pub normal: Vec3,
}

impl Shine {
    /// Largest change of radiance between two eyes, of the channel that changes most; `None` where the facet is so near that its parts
    /// are seen from too many sides, or seen edge on.
    pub(crate) fn change(&self, light: &StillLight, facet: &Facet, eyes: [Vec3; 2]) -> Option<f32> {
        let ways = eyes.map(|eye| eye - facet.centre);
        let nearest_m = ways[0].length().min(ways[1].length());
        let tilt_rad = TILT_RAD.max(0.5 * facet.radius_m / nearest_m.max(1e-3));
        if tilt_rad > MOST_TILT_RAD {
            return None;
        }
        let [then, now] = ways.map(|way| way / way.length());
        let normal = if facet.normal.dot(then) < 0.0 { -facet.normal } else { facet.normal };
        if normal.dot(then).min(normal.dot(now)) < LEAST_FACING {
            return None;
        }
        let (aside, along) = normal.any_orthonormal_pair();
        let tilts = [Vec3::ZERO, aside, -aside, along, -along];
        let change = |tilt: Vec3| {
            let normal = (normal + tilt * tilt_rad.tan()).normalize();
            (self.radiance(light, normal, now) - self.radiance(light, normal, then)).abs().max_element()
        };
        Some(tilts.into_iter().map(change).fold(0.0, f32::max))
    }

    /// What depends on the eye of the radiance towards `v`: what is mirrored, and what is scattered of the sun's.
    fn radiance(&self, light: &StillLight, n: Vec3, v: Vec3) -> Vec3 {
        let f0 = Vec3::splat(self.reflectance);
        let mirrored_up = 2.0 * n.dot(v) * n.y - v.y;
        let mirrored = light.sky.reflection(mirrored_up, self.roughness);
        let finish = Finish { diffuse: Vec3::splat(self.diffuse), f0, roughness: self.roughness };
        let of_sun = match n.dot(light.to_sun) > 0.0 {
            true => light.irradiance * reflected(n, v, light.to_sun, finish),
            false => Vec3::ZERO,
        };
        of_sun + mirrored * ambient_brdf(f0, self.roughness, n.dot(v).max(1e-3))
    }
}

#[cfg(test)]
mod tests;

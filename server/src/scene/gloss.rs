//! How much the colour of a surface can change by where it is seen from, in steps of an 8-bit display value. Pure.
//!
//! Three things depend on the eye: the highlight of a light, the mirrored sky, and what a pixel of the display covers of a texture.

use crate::scene::shine::{Facet, LEAST_ROUGHNESS, Shine, StillLight};
use glam::Vec3;
use shadecast_protocol::pose::{NEAR_M, Pose};
use shadecast_scene::{Material, Texture, TextureSlot};
use shadecast_shaders::constants::EDGE_COSINE;

/// Steps of the display for a change of radiance by 1, where a surface is as dark as most are: 255 times the slope of tone map and
/// sRGB curve at 0.15.
const STEPS_BY_RADIANCE: f32 = 470.0;
/// The steepest slope of a highlight for an irradiance and a reflectance of 1, over the cube of the squared roughness: of
/// `reflected` in `pbr.glsl`, whose half vector turns by half the angle that the eye does.
const HIGHLIGHT_SLOPE: f32 = 0.041;
/// The same of the mirrored sky over the squared roughness, for a sky of radiance 1 above and none below: twice the angle.
const SKY_SLOPE: f32 = 0.5;
/// Steps by which a texture's colour changes as a pixel covers twice as much of it: a quarter of what two neighbouring levels of busy
/// textures differ by at most. A block that is filtered anew costs bits, and blurs others.
const TEXTURE_STEPS_BY_OCTAVE: f32 = 6.0;
/// What is seen more edge on than this cosine is filtered as if it were not.
const GRAZING_COSINE: f32 = 0.03;
/// The part of a texture's texels that may be glossier than what is counted with.
const LEFT_OUT: f32 = 0.1;

/// What of a material depends on the eye.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Gloss {
    /// Most steps for a radian by which the eye goes around a place of the surface.
    pub steps_by_radian: f32,
    /// Most steps for a doubling of what a pixel covers.
    pub steps_by_octave: f32,
    /// The part of lamps in `steps_by_radian`.
    pub lamp_steps_by_radian: f32,
    /// Light falls on it: shadows and lamps change it.
    pub is_lit: bool,
    /// How it reflects, where that can be evaluated.
    pub shine: Option<Shine>,
}

/// The light that a scene has at most.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Brightness {
    /// Of sun and lamps, irradiance of the brightest channel.
    pub direct: f32,
    /// Of lamps alone.
    pub lamps: f32,
    /// Of the sky, radiance of the brightest channel.
    pub sky: f32,
}

impl Gloss {
    /// Of a material with its model's textures.
    pub(crate) fn of(material: &Material, textures: &[Texture], light: Brightness) -> Self {
        let is_textured = material.texture_slots().iter().any(Option::is_some);
        let steps_by_octave = if is_textured { TEXTURE_STEPS_BY_OCTAVE } else { 0.0 };
        if material.unlit {
            return Self { steps_by_octave, ..Self::default() };
        }
        let rough_metal = material.metallic_roughness_texture;
        let roughness = material.roughness * rough_metal.map_or(1.0, |slot| low_value(textures, slot, 1));
        let metallic =
            material.metallic * rough_metal.map_or(1.0, |slot| 1.0 - low_value_inverted(textures, slot, 2));
        let reflectance = reflectance(material, metallic);
        let of_lamps = Brightness { direct: light.lamps, sky: 0.0, ..light };
        let [r, g, b, _] = material.base_color;
        let diffuse = r.max(g).max(b).clamp(0.0, 1.0) * (1.0 - metallic.clamp(0.0, 1.0));
        Self {
            steps_by_radian: slope(roughness, reflectance, light),
            steps_by_octave,
            lamp_steps_by_radian: slope(roughness, reflectance, of_lamps),
            is_lit: true,
            shine: (roughness >= LEAST_ROUGHNESS).then_some(Shine { roughness, reflectance, diffuse }),
        }
    }

    /// Most steps by which what a place of a surface mirrors looks different from another head.
    pub(crate) fn mirrored_steps(&self, then: &Seen, now: &Seen, moved_m: f32) -> f32 {
        self.steps_by_radian * radians(then, now, moved_m)
    }

    /// The same between two eyes by what it mirrors in this light; `None` where that cannot be evaluated.
    pub(crate) fn evaluated_steps(
        &self,
        light: &StillLight,
        facet: &Facet,
        eyes: [Vec3; 2],
        radians: f32,
    ) -> Option<f32> {
        let change = self.shine?.change(light, facet, eyes)?;
        Some(STEPS_BY_RADIANCE * change + self.lamp_steps_by_radian * radians)
    }

    /// Most steps by which its texture looks different from another head.
    pub(crate) fn filtered_steps(&self, then: &Seen, now: &Seen) -> f32 {
        let octaves = |a: f32, b: f32| (a / b).log2().abs();
        let footprint = octaves(then.distance_m, now.distance_m)
            + 2.0 * octaves(then.axis_cosine, now.axis_cosine)
            + octaves(then.facing_cosine, now.facing_cosine);
        self.steps_by_octave * footprint
    }
}

/// By how much an eye goes around a place at most, radians.
pub(crate) fn radians(then: &Seen, now: &Seen, moved_m: f32) -> f32 {
    moved_m / then.distance_m.min(now.distance_m)
}

/// How a place of a surface is seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Seen {
    distance_m: f32,
    /// Of the angle from the middle of the view.
    axis_cosine: f32,
    /// Of the angle from its normal.
    facing_cosine: f32,
}

impl Seen {
    /// The nearest place of a ball, with a normal where there is one.
    pub(crate) fn from(world_from_head: Pose, centre: Vec3, radius_m: f32, normal: Option<Vec3>) -> Self {
        let way = centre - world_from_head.position;
        let length_m = way.length().max(NEAR_M);
        let axis = world_from_head.orientation * Vec3::NEG_Z;
        let facing = normal.map_or(1.0, |normal| (normal.dot(way) / length_m).abs());
        Self {
            distance_m: (length_m - radius_m).max(NEAR_M),
            axis_cosine: (axis.dot(way) / length_m).max(EDGE_COSINE),
            facing_cosine: facing.max(GRAZING_COSINE),
        }
    }
}

/// Steps of the display for a radian.
fn slope(roughness: f32, reflectance: f32, light: Brightness) -> f32 {
    let squared = roughness.clamp(0.04, 1.0).powi(2);
    let highlight = light.direct * HIGHLIGHT_SLOPE / squared.powi(3);
    let sky = light.sky * SKY_SLOPE / squared.max(0.1);
    reflectance * STEPS_BY_RADIANCE * (highlight + sky)
}

/// At normal incidence, of the brightest channel.
fn reflectance(material: &Material, metallic: f32) -> f32 {
    let [r, g, b, _] = material.base_color;
    let metal = r.max(g).max(b).clamp(0.0, 1.0);
    0.04 + (metal - 0.04).max(0.0) * metallic.clamp(0.0, 1.0)
}

/// What all but a few texels of a channel exceed, 0..1.
fn low_value(textures: &[Texture], slot: TextureSlot, channel: usize) -> f32 {
    quantile(textures, slot, |texel| texel[channel])
}

/// The same of what the channel lacks to 1.
fn low_value_inverted(textures: &[Texture], slot: TextureSlot, channel: usize) -> f32 {
    quantile(textures, slot, |texel| 255 - texel[channel])
}

fn quantile(textures: &[Texture], slot: TextureSlot, value: impl Fn(&[u8]) -> u8) -> f32 {
    let Some(texture) = textures.get(slot.texture as usize) else { return 0.0 };
    let mut counts = [0u64; 256];
    texture.rgba8.chunks_exact(4).for_each(|texel| counts[usize::from(value(texel))] += 1);
    let mut left = (counts.iter().sum::<u64>() as f64 * f64::from(LEFT_OUT)) as u64;
    let found = counts.iter().position(|count| {
        let is_it = *count > left;
        left = left.saturating_sub(*count);
        is_it
    });
    found.unwrap_or(0) as f32 / 255.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use shadecast_scene::Wrap;

    const LIGHT: Brightness = Brightness { direct: 3.0, lamps: 0.0, sky: 1.0 };

    fn material(roughness: f32, metallic: f32) -> Material {
        Material { roughness, metallic, ..Material::default() }
    }

    fn slope_of(material: &Material, textures: &[Texture]) -> f32 {
        Gloss::of(material, textures, LIGHT).steps_by_radian
    }

    #[test]
    fn what_is_smoother_or_more_of_a_metal_changes_faster() {
        let slopes = [1.0, 0.7, 0.4, 0.2].map(|roughness| slope_of(&material(roughness, 0.0), &[]));
        assert!(slopes.is_sorted_by(|a, b| a < b), "{slopes:?}");
        assert!(slope_of(&material(0.5, 1.0), &[]) > 10.0 * slope_of(&material(0.5, 0.0), &[]));
    }

    /// The highlight's radiance for an irradiance and a reflectance of 1 where the eye is `angle` from the mirrored light, as
    /// `reflected` in `pbr.glsl` has it for light along the normal.
    fn highlight(roughness: f32, angle: f32) -> f32 {
        let a = roughness * roughness;
        let (n_h, n_v) = ((0.5 * angle).cos(), angle.cos().max(1e-3));
        let d = n_h * n_h * (a * a - 1.0) + 1.0;
        let visibility = 0.5 / ((n_v * n_v * (1.0 - a * a) + a * a).sqrt() + n_v);
        a * a / (std::f32::consts::PI * d * d) * visibility
    }

    #[test]
    fn no_highlight_is_steeper_than_the_bound() {
        for roughness in [0.2f32, 0.35, 0.5, 0.7, 0.85, 1.0] {
            let step = 1e-3;
            let angles = (0..1200).map(|at| at as f32 * step);
            let steepest = angles
                .map(|angle| (highlight(roughness, angle) - highlight(roughness, angle + step)).abs() / step)
                .fold(0.0, f32::max);
            let bound = HIGHLIGHT_SLOPE / roughness.powi(6) + SKY_SLOPE / roughness.powi(2).max(0.1);
            assert!(steepest <= bound * 1.05, "{roughness}: {steepest} of {bound}");
        }
    }

    #[test]
    fn what_is_unlit_depends_on_the_eye_by_its_texture_alone() {
        let unlit = Material { unlit: true, ..material(0.1, 1.0) };
        assert_eq!(Gloss::of(&unlit, &[], LIGHT), Gloss::default());
        let painted = Material { base_color_texture: Some(0.into()), ..unlit };
        assert_eq!(Gloss::of(&painted, &[], LIGHT).steps_by_octave, TEXTURE_STEPS_BY_OCTAVE);
    }

    #[test]
    fn a_texture_says_how_rough_and_how_much_of_a_metal_most_of_it_is() {
        // A few texels are smooth metal, the rest is rough and none.
        let texel = |at: usize| if at < 5 { [0, 20, 255, 255] } else { [0, 200, 0, 255] };
        let texture = Texture {
            name: "t".into(),
            extent_texels: [10, 10],
            rgba8: (0..100).flat_map(texel).collect(),
            srgb: false,
            wrap: [Wrap::Repeat; 2],
        };
        let textured = Material { metallic_roughness_texture: Some(0.into()), ..material(1.0, 1.0) };
        let plain = slope_of(&material(200.0 / 255.0, 0.0), &[]);
        assert!((slope_of(&textured, &[texture]) - plain).abs() < 1e-3 * plain);
        assert!(slope_of(&textured, &[]).is_finite(), "a texture that is not there");
    }

    #[test]
    fn steps_grow_with_the_way_aside_the_distance_and_the_angle() {
        let gloss = Gloss { steps_by_radian: 100.0, steps_by_octave: 10.0, ..Gloss::default() };
        let at = |x: f32, z: f32, yaw: f32| Pose {
            position: Vec3::new(x, 0.0, z),
            orientation: Quat::from_rotation_y(yaw),
        };
        let steps = |a: Pose, b: Pose| {
            let seen = |head| Seen::from(head, Vec3::ZERO, 0.0, Some(Vec3::Z));
            let moved_m = a.position.distance(b.position);
            gloss.mirrored_steps(&seen(a), &seen(b), moved_m) + gloss.filtered_steps(&seen(a), &seen(b))
        };
        let from = at(0.0, 2.0, 0.0);
        assert_eq!(steps(from, from), 0.0);
        let aside = [0.01, 0.05, 0.2].map(|x| steps(from, at(x, 2.0, 0.0)));
        assert!(aside.is_sorted_by(|a, b| a < b) && aside[0] > 0.4, "{aside:?}");
        assert!(steps(from, at(0.0, 4.0, 0.0)) >= 10.0, "half as large");
        assert!(steps(from, at(0.0, 2.0, 0.5)) > 1.0, "a pixel beside the middle covers less");
        assert!(steps(from, at(0.0, 0.0, 0.0)).is_finite() && steps(from, at(0.0, -2.0, 0.0)).is_finite());
    }
}

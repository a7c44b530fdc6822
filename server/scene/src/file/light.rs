//! Sun, sky and placed lights of a scene file.

use super::fields::Fields;
use super::transform::turned_to;
use crate::{Environment, Light, LightKind, PlacedLight, SceneError, Sun};
use glam::{Affine3A, Vec3};
use shadecast_model::limits::MAX_LIGHTS;

/// Half angle of a spot light's cone where none is given, degrees.
const DEFAULT_OUTER_CONE_DEG: f32 = 45.0;
/// Longest reach of a light, metres.
const MAX_RANGE_M: f32 = 1e4;
/// Largest intensity.
const MAX_INTENSITY: f32 = 1e6;

/// Sun and sky of scenes that do not set their own.
pub fn default_light() -> (Sun, Environment) {
    let sun = Sun {
        // High, from behind the user's left shoulder: what faces the user is lit, and shapes show.
        to_sun: Vec3::new(-0.45, 0.75, 0.5).normalize(),
        irradiance: Vec3::new(2.9, 2.7, 2.4),
        casts_shadows: true,
    };
    let environment = Environment {
        zenith: Vec3::new(0.22, 0.38, 0.68),
        horizon: Vec3::new(0.66, 0.74, 0.82),
        nadir: Vec3::new(0.24, 0.23, 0.21),
    };
    (sun, environment)
}

pub(super) fn read_sun(root: &Fields) -> Result<Sun, SceneError> {
    let (default, _) = default_light();
    let keys = ["direction", "irradiance", "shadows"];
    let Some(fields) = root.table("sun", &keys)? else { return Ok(default) };
    Ok(Sun {
        to_sun: fields.direction("direction", "the vector towards the sun")?.unwrap_or(default.to_sun),
        irradiance: fields.colour("irradiance")?.unwrap_or(default.irradiance),
        casts_shadows: fields.flag("shadows")?.unwrap_or(default.casts_shadows),
    })
}

pub(super) fn read_environment(root: &Fields) -> Result<Environment, SceneError> {
    let (_, default) = default_light();
    let keys = ["zenith", "horizon", "nadir"];
    let Some(fields) = root.table_by_either_name("sky", "environment", &keys)? else { return Ok(default) };
    Ok(Environment {
        zenith: fields.colour("zenith")?.unwrap_or(default.zenith),
        horizon: fields.colour("horizon")?.unwrap_or(default.horizon),
        nadir: fields.colour("nadir")?.unwrap_or(default.nadir),
    })
}

/// What a `[[light]]` can have.
const LIGHT_KEYS: [&str; 10] = [
    "name",
    "kind",
    "color",
    "intensity",
    "range_m",
    "inner_cone_deg",
    "outer_cone_deg",
    "position",
    "direction",
    "target",
];

/// Words for the kinds.
const KINDS: [(&str, Kind); 3] =
    [("point", Kind::Point), ("spot", Kind::Spot), ("directional", Kind::Directional)];

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Point,
    Spot,
    Directional,
}

impl Kind {
    fn name(self) -> &'static str {
        KINDS.iter().find(|(_, kind)| *kind == self).map_or("", |(name, _)| name)
    }

    /// Keys that mean nothing for the kind.
    fn meaningless(self) -> &'static [&'static str] {
        match self {
            Self::Point => &["inner_cone_deg", "outer_cone_deg", "direction", "target"],
            Self::Spot => &[],
            Self::Directional => &["inner_cone_deg", "outer_cone_deg", "position", "range_m", "target"],
        }
    }
}

pub(super) fn read_lights(root: &Fields) -> Result<Vec<PlacedLight>, SceneError> {
    let tables = root.tables("light", &LIGHT_KEYS)?;
    if let Some(fields) = tables.get(MAX_LIGHTS as usize) {
        let problem = format!("there are {} lights; a scene can have {MAX_LIGHTS}", tables.len());
        return Err(fields.source.error(fields.line, problem));
    }
    tables.iter().enumerate().map(|(index, fields)| read_light(fields, index)).collect()
}

fn read_light(fields: &Fields, index: usize) -> Result<PlacedLight, SceneError> {
    let kind = fields.required("kind", fields.choice("kind", &KINDS)?)?;
    if let Some(key) = fields.first_of(kind.meaningless()) {
        let problem = format!("a {} light has no \"{key}\"; remove it", kind.name());
        return Err(fields.error(key, problem));
    }
    let color = fields.colour("color")?.unwrap_or(Vec3::ONE);
    let intensity = fields.number_within("intensity", 0.0..=MAX_INTENSITY, "(linear)")?.unwrap_or(1.0);
    let name = fields.string("name")?.map(|(name, _)| name);
    Ok(PlacedLight {
        world_from_light: read_place(fields, kind)?,
        light: Light {
            name: name.unwrap_or_else(|| format!("{} light {index}", kind.name())),
            kind: read_kind(fields, kind)?,
            intensity: color * intensity,
            range_m: fields.number_within("range_m", 0.01..=MAX_RANGE_M, "metres")?,
        },
    })
}

fn read_kind(fields: &Fields, kind: Kind) -> Result<LightKind, SceneError> {
    if kind != Kind::Spot {
        return Ok(if kind == Kind::Point { LightKind::Point } else { LightKind::Directional });
    }
    let angle = |key| fields.number_within(key, 0.0..=90.0, "degrees from the axis");
    let outer_deg = angle("outer_cone_deg")?.unwrap_or(DEFAULT_OUTER_CONE_DEG);
    let inner_deg = angle("inner_cone_deg")?.unwrap_or(0.0);
    if inner_deg >= outer_deg {
        let key = fields.first_of(&["inner_cone_deg", "outer_cone_deg"]).unwrap_or("kind");
        let problem = format!(
            "the inner cone of {inner_deg} degrees must be narrower than the outer one of {outer_deg}"
        );
        return Err(fields.error(key, problem));
    }
    Ok(LightKind::Spot { inner_cone_rad: inner_deg.to_radians(), outer_cone_rad: outer_deg.to_radians() })
}

/// Where it is and which way its -z points; what has no direction keeps the world's axes.
fn read_place(fields: &Fields, kind: Kind) -> Result<Affine3A, SceneError> {
    fields.only_one_of(&["direction", "target"])?;
    let position = fields.vector_m("position")?;
    let position =
        if kind == Kind::Directional { Vec3::ZERO } else { fields.required("position", position)? };
    let along = match fields.vector_m("target")? {
        Some(target) => Some((target - position).try_normalize().ok_or_else(|| {
            fields.error("target", "\"target\" is the position of the light itself; move it to a lit point")
        })?),
        None => fields.direction("direction", "the way the light shines")?,
    };
    let along = if kind == Kind::Point { Vec3::NEG_Z } else { fields.required("direction", along)? };
    Ok(Affine3A::from_rotation_translation(turned_to(along), position))
}

//! `KHR_lights_punctual`: lights of nodes.

use super::extensions::{self, LIGHTS};
use super::{label, node_label};
use crate::error::Fault;
use crate::{Light, LightKind, ModelLight};
use glam::Vec3;
use serde::Deserialize;
use shadecast_model::text::printable;
use std::f32::consts::{FRAC_PI_2, FRAC_PI_4};

/// Narrowest edge of a spot light's beam, radians: the inner angle stays below the outer one, as shading divides by
/// what lies between them.
const MIN_EDGE_RAD: f32 = 1e-3;

#[derive(Deserialize)]
struct List {
    lights: Vec<Source>,
}

#[derive(Deserialize)]
struct Source {
    name: Option<String>,
    #[serde(default = "white")]
    color: [f32; 3],
    #[serde(default = "one")]
    intensity: f32,
    range: Option<f32>,
    #[serde(rename = "type")]
    kind: Kind,
    #[serde(default)]
    spot: Cone,
}

#[derive(Deserialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Directional,
    Point,
    Spot,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase", default)]
struct Cone {
    inner_cone_angle: f32,
    outer_cone_angle: f32,
}

impl Default for Cone {
    fn default() -> Self {
        Self { inner_cone_angle: 0.0, outer_cone_angle: FRAC_PI_4 }
    }
}

#[derive(Deserialize)]
struct Reference {
    light: usize,
}

fn white() -> [f32; 3] {
    [1.0; 3]
}

fn one() -> f32 {
    1.0
}

/// The lights that a document defines, in its order.
pub(super) fn read_all(document: &::gltf::Document) -> Result<Vec<Light>, Fault> {
    let list: Option<List> = extensions::read(document.extensions(), LIGHTS, "document")?;
    let sources = list.map(|list| list.lights).unwrap_or_default();
    sources.into_iter().enumerate().map(|(index, source)| convert(index, source)).collect()
}

/// The light that hangs on a node, if one does.
pub(super) fn of_node(node: &::gltf::Node, bone: u32, lights: &[Light]) -> Result<Option<ModelLight>, Fault> {
    let element = node_label(node);
    let Some(Reference { light }) = extensions::read(node.extensions(), LIGHTS, &element)? else {
        return Ok(None);
    };
    match lights.get(light) {
        Some(light) => Ok(Some(ModelLight { bone, light: light.clone() })),
        None => {
            Err(Fault::new(element, format!("shows light {light}, but the file defines {}", lights.len())))
        }
    }
}

fn convert(index: usize, source: Source) -> Result<Light, Fault> {
    let fault = |problem: &str| Err(Fault::new(label("light", index, source.name.as_deref()), problem));
    let intensity = Vec3::from_array(source.color) * source.intensity;
    if !(intensity.is_finite() && intensity.min_element() >= 0.0) {
        return fault("colour times intensity must be finite and not negative");
    }
    if source.range.is_some_and(|range| !(range.is_finite() && range > 0.0)) {
        return fault("its range must be a positive number; leave it out for a light without end");
    }
    let kind = match source.kind {
        Kind::Directional => LightKind::Directional,
        Kind::Point => LightKind::Point,
        Kind::Spot => match cone(&source.spot) {
            Some(kind) => kind,
            None => return fault("innerConeAngle must be at least 0 and less than outerConeAngle"),
        },
    };
    let range_m = source.range.filter(|_| kind != LightKind::Directional);
    let name = source.name.map_or_else(|| format!("light {index}"), |name| printable(&name));
    Ok(Light { name, kind, intensity, range_m })
}

/// The beam, its outer angle limited to the right angle that the extension allows.
fn cone(cone: &Cone) -> Option<LightKind> {
    let (inner, outer) = (cone.inner_cone_angle, cone.outer_cone_angle);
    let is_sound = inner >= 0.0 && inner < outer && outer.is_finite();
    let outer_cone_rad = outer.clamp(MIN_EDGE_RAD, FRAC_PI_2);
    let inner_cone_rad = inner.min(outer_cone_rad - MIN_EDGE_RAD);
    is_sound.then_some(LightKind::Spot { inner_cone_rad, outer_cone_rad })
}

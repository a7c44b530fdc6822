//! Nodes to bones, parents first; their visibility; lights.

use super::convert::{self, rotation, vec3};
use crate::error::Fault;
use crate::import::Warnings;
use crate::{Bone, Light, LightKind, ModelLight, Trs};
use glam::{Quat, Vec3};
use shadecast_model::text::printable;

/// All nodes of a file as bones, the file's own root included, which carries what could not be converted otherwise.
pub(super) struct Hierarchy {
    pub(super) bones: Vec<Bone>,
    /// By the node's `typed_id`.
    bone_of_node: Vec<u32>,
    /// The node of each bone, by `typed_id`.
    node_of_bone: Vec<u32>,
    /// For each bone whether its meshes are to be seen.
    visible: Vec<bool>,
}

impl Hierarchy {
    pub(super) fn read(scene: &ufbx::Scene) -> Result<Self, Fault> {
        let count = scene.nodes.count;
        let mut hierarchy = Self {
            bones: Vec::with_capacity(count),
            bone_of_node: vec![0; count],
            node_of_bone: Vec::with_capacity(count),
            visible: Vec::with_capacity(count),
        };
        let mut pending: Vec<(&ufbx::Node, Option<u32>, bool)> = vec![(&*scene.root_node, None, true)];
        while let Some((node, parent, shown)) = pending.pop() {
            let bone = hierarchy.bones.len() as u32;
            hierarchy.bones.push(Bone {
                name: convert::name("node", &node.element),
                parent,
                rest: rest(node)?,
            });
            hierarchy.bone_of_node[node.element.typed_id as usize] = bone;
            hierarchy.node_of_bone.push(node.element.typed_id);
            let visible = shown && node.visible;
            hierarchy.visible.push(visible);
            // Of a group of levels of detail the first, which is the finest.
            let is_level_group = node.attrib_type == ufbx::ElementType::LodGroup;
            let children = node.children.as_ref().iter().enumerate().rev();
            pending.extend(
                children
                    .map(|(index, child)| (&**child, Some(bone), visible && !(is_level_group && index > 0))),
            );
        }
        Ok(hierarchy)
    }

    /// The bone of a node of the scene that this was read from.
    pub(super) fn bone(&self, node: &ufbx::Node) -> u32 {
        self.bone_of_node[node.element.typed_id as usize]
    }

    /// The bone of the node with this `typed_id`.
    pub(super) fn bone_of(&self, typed_id: u32) -> u32 {
        self.bone_of_node[typed_id as usize]
    }

    /// Nodes whose meshes are to be seen, in the order of the bones.
    pub(super) fn shown<'a>(&'a self, scene: &'a ufbx::Scene) -> impl Iterator<Item = &'a ufbx::Node> {
        let nodes = self.node_of_bone.iter().zip(&self.visible);
        nodes.filter(|(_, visible)| **visible).map(|(node, _)| &scene.nodes[*node as usize])
    }

    /// The lights of all shown nodes. Each hangs on a bone of its own, which is counted after the hierarchy's: FBX
    /// lights shine along another axis than ours.
    pub(super) fn lights(
        &self,
        scene: &ufbx::Scene,
        warnings: &mut Warnings,
    ) -> (Vec<Bone>, Vec<ModelLight>) {
        let (mut bones, mut lights) = (Vec::new(), Vec::new());
        for node in self.shown(scene) {
            let Some(source) = node.light.as_deref().filter(|light| light.cast_light) else { continue };
            let Some((light, turn)) = light(source, warnings) else { continue };
            let geometry = node.geometry_transform;
            let Some(geometry_rotation) = rotation(geometry.rotation) else { continue };
            let rest = Trs {
                translation: vec3(geometry.translation),
                rotation: geometry_rotation * turn,
                scale: Vec3::ONE,
            };
            if !rest.translation.is_finite() {
                continue;
            }
            let bone = (self.bones.len() + bones.len()) as u32;
            bones.push(Bone { name: light.name.clone(), parent: Some(self.bone(node)), rest });
            lights.push(ModelLight { bone, light });
        }
        (bones, lights)
    }
}

/// `node 3 'x'`.
pub(super) fn label(node: &ufbx::Node) -> String {
    format!("node {} '{}'", node.element.typed_id, printable(&node.element.name))
}

fn rest(node: &ufbx::Node) -> Result<Trs, Fault> {
    let transform = node.local_transform;
    let (translation, scale) = (vec3(transform.translation), vec3(transform.scale));
    match rotation(transform.rotation) {
        Some(rotation) if translation.is_finite() && scale.is_finite() => {
            Ok(Trs { translation, rotation, scale })
        }
        _ => Err(Fault::new(label(node), "its transform is not finite; freeze or reset it")),
    }
}

/// The light, and the rotation that takes -z to where it shines. FBX has no photometric units: an intensity of 100 %
/// lights a white surface white, which is an irradiance of pi; of point and spot lights at 1 m.
fn light(source: &ufbx::Light, warnings: &mut Warnings) -> Option<(Light, Quat)> {
    let kind = match source.type_ {
        ufbx::LightType::Directional => LightKind::Directional,
        ufbx::LightType::Point => LightKind::Point,
        ufbx::LightType::Spot => spot(source),
        _ => {
            warnings.insert("area and volume lights are ignored".into());
            return None;
        }
    };
    let intensity = vec3(source.color) * (source.intensity as f32 * std::f32::consts::PI);
    let towards = vec3(source.local_direction).try_normalize().unwrap_or(Vec3::NEG_Y);
    if !(intensity.is_finite() && intensity.min_element() >= 0.0) {
        warnings.insert(format!(
            "{} is ignored: its intensity is not finite, or negative",
            convert::label("light", &source.element)
        ));
        return None;
    }
    let name = convert::name("light", &source.element);
    Some((Light { name, kind, intensity, range_m: None }, Quat::from_rotation_arc(Vec3::NEG_Z, towards)))
}

/// FBX gives the whole angles of the cones, in degrees.
fn spot(source: &ufbx::Light) -> LightKind {
    let half = |degrees: f64, otherwise: f32| {
        let angle = (degrees as f32 * 0.5).to_radians();
        if angle.is_finite() && angle > 0.0 { angle } else { otherwise }
    };
    let outer_cone_rad =
        half(source.outer_angle, std::f32::consts::FRAC_PI_8).clamp(1e-3, std::f32::consts::FRAC_PI_2);
    LightKind::Spot {
        inner_cone_rad: half(source.inner_angle, 0.0).min(outer_cone_rad * 0.999),
        outer_cone_rad,
    }
}

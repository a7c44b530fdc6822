//! glTF 2.0 importer: `.glb` and `.gltf` to a [`Model`].
//!
//! Files come from strangers. The result is a model with every index in range and every number finite, or an error that names
//! the file and the element; the tests mutate files to verify that. Each omission (cameras, blending, unknown extensions) costs
//! one warning. A required extension that this importer lacks is an error.

mod accessor;
mod animation;
mod buffer;
mod compression;
mod container;
mod extensions;
mod light;
pub(crate) mod material;
pub(crate) mod mesh;
mod shape;
#[cfg(test)]
mod tests;

use super::error::{Fault, SceneError};
use super::import::{Surroundings, Warnings, label};
use super::limits::{MAX_DELTAS, MAX_MORPHS, MAX_PALETTE, MAX_VERTICES};
use super::{Bone, Light, Model, Morph, MorphDelta, PaletteEntry, Primitive, Trs};
use ::gltf::Semantic;
use ::gltf::accessor::Dimensions;
use accessor::Reader;
use glam::{Affine3A, Mat4, Quat, Vec3};
use material::Materials;
use mesh::Part;
use serde::Deserialize;
use shadecast_model::text::printable;
use std::collections::HashMap;
use std::ops::Range;
use std::path::Path;
use std::rc::Rc;

/// Loads a file; buffers and images beside it are found relative to it.
pub fn load(path: &Path) -> Result<Model, SceneError> {
    super::import::load(path, import)
}

/// Loads an asset that lies in memory and refers to no other file. `name` stands for the file in messages.
pub fn from_slice(bytes: &[u8], name: &str) -> Result<Model, SceneError> {
    super::import::from_slice(bytes, name, import)
}

pub(crate) fn import(bytes: &[u8], name: &str, around: &Surroundings) -> Result<(Model, Warnings), Fault> {
    let mut warnings = Warnings::new();
    let container = container::open(bytes, around, &mut warnings)?;
    let container::Container { document, buffers, data_bytes, decoded } = &container;
    let reader = Reader { document, buffers, data_bytes: *data_bytes, decoded };
    let hierarchy = Hierarchy::read(document, &mut warnings)?;
    let lights = light::read_all(document)?;
    let mut assembly = Assembly::new(reader, around, hierarchy, lights, warnings);
    for node in scene_nodes(document) {
        assembly.add_node(&node)?;
    }
    assembly.add_clips()?;
    let (mut model, warnings) = assembly.into_model();
    model.name = name.to_owned();
    Ok((model, warnings))
}

fn node_label(node: &::gltf::Node) -> String {
    let name = node.name().map(|name| format!(" '{}'", printable(name))).unwrap_or_default();
    format!("node {}{name}", node.index())
}

/// The nodes of the default (or first) scene with all their descendants, parents first; all nodes if there is no
/// scene. The hierarchy has been checked to be a forest.
fn scene_nodes(document: &::gltf::Document) -> Vec<::gltf::Node<'_>> {
    let Some(scene) = document.default_scene().or_else(|| document.scenes().next()) else {
        return document.nodes().collect();
    };
    let mut pending: Vec<::gltf::Node> = scene.nodes().collect();
    pending.reverse();
    let (mut nodes, mut seen) = (Vec::new(), vec![false; document.nodes().len()]);
    while let Some(node) = pending.pop() {
        if std::mem::replace(&mut seen[node.index()], true) {
            continue;
        }
        let children: Vec<_> = node.children().collect();
        pending.extend(children.into_iter().rev());
        nodes.push(node);
    }
    nodes
}

/// All nodes of a file as bones, parents first.
struct Hierarchy {
    bones: Vec<Bone>,
    bone_of_node: Vec<u32>,
    /// Whether the node's rest transform, ancestors included, mirrors.
    mirrored: Vec<bool>,
}

impl Hierarchy {
    fn read(document: &::gltf::Document, warnings: &mut Warnings) -> Result<Self, Fault> {
        let parents = parents(document)?;
        let nodes: Vec<::gltf::Node> = document.nodes().collect();
        let order = parents_first(&nodes, &parents)?;
        let mut bone_of_node = vec![0; nodes.len()];
        for (bone, node) in order.iter().enumerate() {
            bone_of_node[*node] = bone as u32;
        }
        let (mut bones, mut mirrored) = (Vec::with_capacity(nodes.len()), vec![false; nodes.len()]);
        for index in order {
            let node = &nodes[index];
            let rest = rest_transform(node, warnings)?;
            let name = node.name().map_or_else(|| format!("node {index}"), printable);
            bones.push(Bone { name, parent: parents[index].map(|parent| bone_of_node[parent]), rest });
            let flips = rest.scale.x * rest.scale.y * rest.scale.z < 0.0;
            mirrored[index] = flips ^ parents[index].is_some_and(|parent| mirrored[parent]);
        }
        Ok(Self { bones, bone_of_node, mirrored })
    }
}

fn parents(document: &::gltf::Document) -> Result<Vec<Option<usize>>, Fault> {
    let mut parents: Vec<Option<usize>> = vec![None; document.nodes().len()];
    for node in document.nodes() {
        for child in node.children() {
            if let Some(other) = parents[child.index()].replace(node.index()) {
                let problem = format!("is a child of node {other} and of node {}", node.index());
                return Err(Fault::new(node_label(&child), problem));
            }
        }
    }
    Ok(parents)
}

/// Depth first from the roots. With one parent each, nodes that are not reached lie on or below a cycle.
fn parents_first(nodes: &[::gltf::Node], parents: &[Option<usize>]) -> Result<Vec<usize>, Fault> {
    let mut pending: Vec<usize> = (0..nodes.len()).rev().filter(|node| parents[*node].is_none()).collect();
    let (mut order, mut reached) = (Vec::with_capacity(nodes.len()), vec![false; nodes.len()]);
    while let Some(node) = pending.pop() {
        order.push(node);
        reached[node] = true;
        let children: Vec<usize> = nodes[node].children().map(|child| child.index()).collect();
        pending.extend(children.into_iter().rev());
    }
    match reached.iter().position(|reached| !reached) {
        Some(lost) => {
            Err(Fault::new(node_label(&nodes[lost]), "is its own ancestor, or below a node that is"))
        }
        None => Ok(order),
    }
}

fn rest_transform(node: &::gltf::Node, warnings: &mut Warnings) -> Result<Trs, Fault> {
    let fault = |problem: &str| Fault::new(node_label(node), problem);
    let rest = match node.transform() {
        ::gltf::scene::Transform::Matrix { matrix } => {
            let matrix = Mat4::from_cols_array_2d(&matrix);
            let (scale, rotation, translation) = matrix.to_scale_rotation_translation();
            let rest = Trs { translation, rotation, scale };
            if !matrix.abs_diff_eq(rest.affine().into(), 1e-3 * (1.0 + scale.abs().max_element())) {
                warnings.insert("matrices with shear are replaced by the nearest without".into());
            }
            rest
        }
        ::gltf::scene::Transform::Decomposed { translation, rotation, scale } => Trs {
            translation: Vec3::from_array(translation),
            rotation: Quat::from_array(rotation),
            scale: Vec3::from_array(scale),
        },
    };
    let length = rest.rotation.length();
    if !(rest.translation.is_finite() && rest.scale.is_finite() && length.is_finite()) {
        return Err(fault(
            "its transform is not finite, or a matrix that cannot be split into rotation and scale",
        ));
    }
    if length < 1e-6 {
        return Err(fault("its rotation is a quaternion without length"));
    }
    Ok(Trs { rotation: rest.rotation / length, ..rest })
}

/// The model under construction.
struct Assembly<'a> {
    reader: Reader<'a>,
    around: &'a Surroundings,
    hierarchy: Hierarchy,
    /// All that the file defines.
    lights: Vec<Light>,
    warnings: Warnings,
    materials: Materials<'a>,
    model: Model,
    /// By glTF node index, where the node shows a mesh with morph targets.
    morphs_of_node: HashMap<usize, Range<u32>>,
    delta_count: usize,
    /// By glTF mesh index, by primitive: a mesh that several nodes show is read once.
    parts: HashMap<usize, Rc<Vec<Option<Part>>>>,
    /// By glTF skin index: its first palette entry and their number.
    skins: HashMap<usize, (usize, usize)>,
}

impl<'a> Assembly<'a> {
    fn new(
        reader: Reader<'a>,
        around: &'a Surroundings,
        hierarchy: Hierarchy,
        lights: Vec<Light>,
        warnings: Warnings,
    ) -> Self {
        Self {
            reader,
            around,
            hierarchy,
            lights,
            warnings,
            materials: Materials::new(reader, around),
            model: Model::default(),
            morphs_of_node: HashMap::new(),
            delta_count: 0,
            parts: HashMap::new(),
            skins: HashMap::new(),
        }
    }

    fn into_model(self) -> (Model, Warnings) {
        let Self { mut model, materials, hierarchy, warnings, .. } = self;
        model.bones = hierarchy.bones;
        (model.materials, model.textures) = (materials.materials, materials.textures);
        (model, warnings)
    }

    fn add_node(&mut self, node: &::gltf::Node) -> Result<(), Fault> {
        if node.camera().is_some() {
            self.warnings.insert("cameras are ignored; the scene file can define some".into());
        }
        let bone = self.hierarchy.bone_of_node[node.index()];
        self.model.lights.extend(light::of_node(node, bone, &self.lights)?);
        let Some(mesh) = node.mesh() else { return Ok(()) };
        let parts = self.parts_of(&mesh)?;
        let binding = self.binding(node)?;
        let first_morph = self.add_morphs(node, &mesh)?;
        for (primitive, part) in mesh.primitives().zip(parts.iter()) {
            let Some(part) = part else { continue };
            let element =
                format!("{} primitive {}", label("mesh", mesh.index(), mesh.name()), primitive.index());
            let material = self.materials.index(&primitive.material(), &mut self.warnings)?;
            self.append_deltas(part, first_morph, &element)?;
            self.append(part, &binding, material, &element, node)?;
        }
        Ok(())
    }

    fn add_clips(&mut self) -> Result<(), Fault> {
        let moved = animation::Moved {
            bone_of_node: &self.hierarchy.bone_of_node,
            morphs_of_node: &self.morphs_of_node,
        };
        self.model.clips = animation::read_all(self.reader, moved, &self.around.cancel, &mut self.warnings)?;
        Ok(())
    }

    /// Morphs without deltas for a node that shows `mesh`: weights belong to nodes. Returns the index of the first.
    fn add_morphs(&mut self, node: &::gltf::Node, mesh: &::gltf::Mesh) -> Result<usize, Fault> {
        let first = self.model.morphs.len();
        let element = label("mesh", mesh.index(), mesh.name());
        let count = target_count(mesh).map_err(|problem| Fault::new(&*element, problem))?;
        if count == 0 {
            return Ok(first);
        }
        if first + count > MAX_MORPHS {
            let problem = format!("brings the asset over {MAX_MORPHS} morph targets; reduce it");
            return Err(Fault::new(element, problem));
        }
        let weights = node.weights().or_else(|| mesh.weights()).unwrap_or_default();
        if weights.iter().any(|weight| !weight.is_finite()) {
            return Err(Fault::new(node_label(node), "has a weight that is not a finite number"));
        }
        let names = target_names(mesh);
        self.model.morphs.extend((0..count).map(|at| Morph {
            name: names.get(at).map(|name| printable(name)).unwrap_or_else(|| format!("morph {at}")),
            rest_weight: weights.get(at).copied().unwrap_or(0.0),
            deltas: Vec::new(),
        }));
        self.morphs_of_node.insert(node.index(), first as u32..(first + count) as u32);
        Ok(first)
    }

    /// Moves vertices that `append` is about to add.
    fn append_deltas(&mut self, part: &Part, first_morph: usize, element: &str) -> Result<(), Fault> {
        self.delta_count += part.targets.iter().map(Vec::len).sum::<usize>();
        if self.delta_count > MAX_DELTAS {
            let problem = format!("brings the morph targets over {MAX_DELTAS} deltas; reduce them");
            return Err(Fault::new(element, problem));
        }
        let base = self.model.vertices.len() as u32;
        for (morph, target) in self.model.morphs[first_morph..].iter_mut().zip(&part.targets) {
            let place = |delta: &MorphDelta| MorphDelta { vertex: base + delta.vertex, ..*delta };
            morph.deltas.extend(target.iter().map(place));
        }
        Ok(())
    }

    fn parts_of(&mut self, mesh: &::gltf::Mesh) -> Result<Rc<Vec<Option<Part>>>, Fault> {
        if let Some(parts) = self.parts.get(&mesh.index()) {
            return Ok(Rc::clone(parts));
        }
        let (mut parts, mut vertices) = (Vec::new(), 0);
        for primitive in mesh.primitives() {
            self.around.cancel.check()?;
            let element =
                format!("{} primitive {}", label("mesh", mesh.index(), mesh.name()), primitive.index());
            // Before it is read: many primitives may share one large accessor.
            vertices += primitive.get(&Semantic::Positions).map_or(0, |accessor| accessor.count());
            if vertices > MAX_VERTICES {
                let problem = format!("brings its mesh over {MAX_VERTICES} vertices; reduce it");
                return Err(Fault::new(element, problem));
            }
            parts.push(mesh::read(self.reader, &primitive, &element, &mut self.warnings)?);
        }
        let parts = Rc::new(parts);
        self.parts.insert(mesh.index(), Rc::clone(&parts));
        Ok(parts)
    }

    /// What the vertices of a mesh follow when this node shows it.
    fn binding(&mut self, node: &::gltf::Node) -> Result<Binding, Fault> {
        if let Some(skin) = node.skin() {
            let (first, count) = self.skin_entries(&skin)?;
            return Ok(Binding::Skin { first, count });
        }
        let bone = self.hierarchy.bone_of_node[node.index()];
        let entry = self.push_entries(vec![PaletteEntry { bone, bone_from_mesh: Affine3A::IDENTITY }])?;
        Ok(Binding::Node { entry, mirrored: self.hierarchy.mirrored[node.index()] })
    }

    fn skin_entries(&mut self, skin: &::gltf::Skin) -> Result<(usize, usize), Fault> {
        if let Some(known) = self.skins.get(&skin.index()) {
            return Ok(*known);
        }
        let element = label("skin", skin.index(), skin.name());
        let bones: Vec<u32> = skin.joints().map(|joint| self.hierarchy.bone_of_node[joint.index()]).collect();
        if bones.is_empty() {
            return Err(Fault::new(element, "has no joints"));
        }
        let matrices = self.inverse_bind_matrices(skin, bones.len(), &element)?;
        let entry = |(bone, bone_from_mesh)| PaletteEntry { bone, bone_from_mesh };
        let count = bones.len();
        let first = self.push_entries(bones.into_iter().zip(matrices).map(entry).collect())?;
        self.skins.insert(skin.index(), (first, count));
        Ok((first, count))
    }

    fn inverse_bind_matrices(
        &self,
        skin: &::gltf::Skin,
        joints: usize,
        element: &str,
    ) -> Result<Vec<Affine3A>, Fault> {
        let Some(accessor) = skin.inverse_bind_matrices() else {
            return Ok(vec![Affine3A::IDENTITY; joints]);
        };
        let element = format!("{element} inverse bind matrices (accessor {})", accessor.index());
        let matrices = self.reader.floats::<16>(&accessor, Dimensions::Mat4, &element)?;
        if matrices.len() < joints {
            return Err(Fault::new(element, format!("has {} matrices for {joints} joints", matrices.len())));
        }
        Ok(matrices
            .iter()
            .take(joints)
            .map(|matrix| Affine3A::from_mat4(Mat4::from_cols_array(matrix)))
            .collect())
    }

    /// Returns the index of the first.
    fn push_entries(&mut self, entries: Vec<PaletteEntry>) -> Result<usize, Fault> {
        let first = self.model.palette.len();
        if first + entries.len() > MAX_PALETTE {
            let problem = format!("need more than {MAX_PALETTE} bone matrices in total; reduce them");
            return Err(Fault::new("skins and mesh nodes", problem));
        }
        self.model.palette.extend(entries);
        Ok(first)
    }

    fn append(
        &mut self,
        part: &Part,
        binding: &Binding,
        material: u32,
        element: &str,
        node: &::gltf::Node,
    ) -> Result<(), Fault> {
        let (base, first_index) = (self.model.vertices.len(), self.model.indices.len());
        if base + part.vertices.len() > MAX_VERTICES || first_index + part.indices.len() > MAX_VERTICES {
            let problem = format!("brings the model over {MAX_VERTICES} vertices or indices; reduce it");
            return Err(Fault::new(format!("{element} on {}", node_label(node)), problem));
        }
        let fault = |problem: String| Fault::new(format!("{element} on {}", node_label(node)), problem);
        if matches!(binding, Binding::Skin { .. }) && !part.has_influences {
            return Err(fault("has no JOINTS_0, though the node has a skin".into()));
        }
        for vertex in &part.vertices {
            self.model.vertices.push(binding.bind(*vertex).map_err(fault)?);
        }
        let indices = part.indices.iter().map(|index| base as u32 + index);
        self.model.indices.extend(indices);
        if binding.is_mirrored() {
            let added = &mut self.model.indices[first_index..];
            added.chunks_exact_mut(3).for_each(|triangle| triangle.swap(1, 2));
        }
        let index_count = part.indices.len() as u32;
        self.model.primitives.push(Primitive { first_index: first_index as u32, index_count, material });
        Ok(())
    }
}

/// The number of morph targets, which all primitives of a mesh share.
fn target_count(mesh: &::gltf::Mesh) -> Result<usize, String> {
    let mut counts = mesh.primitives().map(|primitive| primitive.morph_targets().len());
    let first = counts.next().unwrap_or(0);
    match counts.find(|count| *count != first) {
        Some(other) => Err(format!("one primitive has {first} morph targets and another {other}")),
        None => Ok(first),
    }
}

/// From `extras.targetNames`, a convention that all exporters share; empty where there is none.
fn target_names(mesh: &::gltf::Mesh) -> Vec<String> {
    #[derive(Default, Deserialize)]
    #[serde(rename_all = "camelCase", default)]
    struct Extras {
        target_names: Vec<String>,
    }
    let extras = mesh.extras().as_ref().and_then(|text| serde_json::from_str::<Extras>(text.get()).ok());
    extras.unwrap_or_default().target_names
}

/// What the vertices of a placed mesh follow.
enum Binding {
    /// One palette entry for all. Where its rest transform mirrors, glTF 2.0 section 3.7.4 reverses the winding.
    Node { entry: usize, mirrored: bool },
    /// The entries of a skin; the node's own transform does not count.
    Skin { first: usize, count: usize },
}

impl Binding {
    fn is_mirrored(&self) -> bool {
        matches!(self, Self::Node { mirrored: true, .. })
    }

    fn bind(&self, mut vertex: super::Vertex) -> Result<super::Vertex, String> {
        match *self {
            Self::Node { entry, mirrored } => {
                // In range: push_entries keeps the palette within 16 bits.
                vertex.joints = [entry as u16; 4];
                vertex.weights = [1.0, 0.0, 0.0, 0.0];
                if mirrored {
                    vertex.tangent[3] = -vertex.tangent[3];
                }
            }
            Self::Skin { first, count } => {
                // Unused slots repeat a used joint, so that one check covers all four.
                if let Some(joint) = vertex.joints.iter().find(|joint| usize::from(**joint) >= count) {
                    return Err(format!("follows joint {joint}, but its skin has {count}"));
                }
                vertex.joints = vertex.joints.map(|joint| (first + usize::from(joint)) as u16);
            }
        }
        Ok(vertex)
    }
}

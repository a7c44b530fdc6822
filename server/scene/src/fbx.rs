//! FBX importer, by `ufbx`: binary and ASCII files of any version that it reads to a [`Model`].
//!
//! `ufbx` opens no file by itself: it gets bytes, and loading external files is off. It parses, converts axes and units, and
//! bakes FBX's layered Euler curves to keys. This module turns its scene into the renderers' form, and enforces the rules of a
//! model. Files come from strangers: the result is a sound model, or an error that names the file and the element. Each
//! omission costs one warning: cameras, NURBS, vertex caches, constraints not baked into curves, subdivision, blending, bump
//! maps. Dual quaternion skins are skinned linearly.

mod animation;
mod convert;
mod curve;
mod hierarchy;
mod material;
mod mesh;
mod morph;
mod part;
mod skeleton;
mod skin;
#[cfg(test)]
mod tests;

use super::error::{Fault, SceneError};
use super::import::{self, Surroundings, Warnings};
use super::limits::{MAX_FBX_DEPTH, MAX_FBX_MEMORY_BYTES, MAX_PALETTE, MAX_VERTICES};
use super::{Cancel, Cancelled, Model, PaletteEntry, Primitive};
use convert::affine;
use hierarchy::Hierarchy;
use material::Materials;
use morph::Morphs;
use part::Part;
use shadecast_model::text::printable;
use skin::Binding;
use std::collections::HashSet;
use std::path::Path;

/// Loads a file; images beside it are found relative to it.
pub fn load(path: &Path) -> Result<Model, SceneError> {
    import::load(path, import)
}

/// Loads an asset that lies in memory and refers to no other file. `name` stands for the file in messages.
pub fn from_slice(bytes: &[u8], name: &str) -> Result<Model, SceneError> {
    import::from_slice(bytes, name, import)
}

pub(crate) fn import(bytes: &[u8], name: &str, around: &Surroundings) -> Result<(Model, Warnings), Fault> {
    let scene = parse(bytes, &around.cancel)?;
    let mut warnings = Warnings::new();
    note_what_is_left_out(&scene, &mut warnings);
    let hierarchy = Hierarchy::read(&scene)?;
    let mut assembly = Assembly {
        hierarchy: &hierarchy,
        materials: Materials::new(around),
        morphs: Morphs::default(),
        model: Model { name: name.to_owned(), ..Model::default() },
        shown_skins: HashSet::new(),
        warnings,
    };
    for node in hierarchy.shown(&scene) {
        around.cancel.check()?;
        assembly.add_node(node)?;
    }
    let Assembly { mut model, materials, morphs, mut warnings, .. } = assembly;
    let (light_bones, lights) = hierarchy.lights(&scene, &mut warnings);
    model.lights = lights;
    model.clips = animation::read_all(&scene, &hierarchy, &morphs, &around.cancel)?;
    model.morphs = morphs.morphs;
    (model.materials, model.textures) = (materials.materials, materials.textures);
    if model.indices.is_empty() && skeleton::add(&scene, &hierarchy, &mut model) {
        warnings.insert("has no meshes; the bones of its skeleton are shown instead".into());
    }
    model.bones = [hierarchy.bones, light_bones].concat();
    Ok((model, warnings))
}

/// Everything in metres, y up, right-handed. Unit scales go into the geometry, so that mesh space is in metres too;
/// nodes that do not inherit scale as others do are compensated, or get helper nodes where that is not exact; geometry
/// transforms stay and become part of the palette.
fn parse(bytes: &[u8], cancel: &Cancel) -> Result<ufbx::SceneRoot, Fault> {
    let go_on = |_: &ufbx::Progress| match cancel.is_asked() {
        true => ufbx::ProgressResult::Cancel,
        false => ufbx::ProgressResult::Continue,
    };
    let axes = ufbx::CoordinateAxes {
        right: ufbx::CoordinateAxis::PositiveX,
        up: ufbx::CoordinateAxis::PositiveY,
        front: ufbx::CoordinateAxis::PositiveZ,
    };
    let options = ufbx::LoadOpts {
        temp_allocator: allocator(),
        result_allocator: allocator(),
        progress_cb: ufbx::ProgressCb::Ref(&go_on),
        file_format: ufbx::FileFormat::Fbx,
        node_depth_limit: MAX_FBX_DEPTH,
        clean_skin_weights: true,
        use_blender_pbr_material: true,
        generate_missing_normals: true,
        inherit_mode_handling: ufbx::InheritModeHandling::Compensate,
        space_conversion: ufbx::SpaceConversion::ModifyGeometry,
        handedness_conversion_axis: ufbx::MirrorAxis::X,
        target_axes: axes,
        target_unit_meters: 1.0,
        ..ufbx::LoadOpts::default()
    };
    ufbx::load_memory(bytes, options).map_err(|error| match error.type_ {
        ufbx::ErrorType::Cancelled => Cancelled.into(),
        _ => Fault::new("FBX document", describe(&error)),
    })
}

/// The C library's own allocator with limits. (The binding's default would panic at sizes that Rust's cannot have.)
fn allocator() -> ufbx::AllocatorOpts {
    ufbx::AllocatorOpts {
        allocator: ufbx::Allocator::Libc,
        memory_limit: MAX_FBX_MEMORY_BYTES,
        ..ufbx::AllocatorOpts::default()
    }
}

/// The library's one-line reason, and what to do about it.
fn describe(error: &ufbx::Error) -> String {
    let mut text = [0; 512];
    let length = ufbx::format_error(&mut text, error).min(text.len());
    let text = String::from_utf8_lossy(&text[..length]);
    let reason = text.lines().next().unwrap_or_default().rsplit("error: ").next().unwrap_or_default();
    let remedy = match error.type_ {
        ufbx::ErrorType::MemoryLimit | ufbx::ErrorType::AllocationLimit => {
            "; it needs more memory than any asset should, reduce it"
        }
        _ => "; export it again as FBX 2014 or later",
    };
    format!("{}{remedy}", printable(if reason.is_empty() { error.description.as_ref() } else { reason }))
}

fn note_what_is_left_out(scene: &ufbx::Scene, warnings: &mut Warnings) {
    let kinds = [
        (
            scene.nurbs_surfaces.count + scene.nurbs_curves.count,
            "NURBS are not drawn; convert them to polygons",
        ),
        (scene.line_curves.count, "lines are not drawn"),
        (scene.cache_deformers.count, "vertex caches are ignored; meshes keep the shape they have without"),
        (scene.constraints.count, "constraints are ignored; bake them into curves"),
    ];
    for (count, sentence) in kinds {
        if count > 0 {
            warnings.insert(sentence.to_owned());
        }
    }
    for warning in &*scene.metadata.warnings {
        warnings.insert(printable(&warning.description));
    }
}

/// The model under construction.
struct Assembly<'a> {
    hierarchy: &'a Hierarchy,
    materials: Materials<'a>,
    morphs: Morphs,
    model: Model,
    /// Meshes with skins, by id, that have been added: all their nodes show them at one place.
    shown_skins: HashSet<u32>,
    warnings: Warnings,
}

impl Assembly<'_> {
    fn add_node(&mut self, node: &ufbx::Node) -> Result<(), Fault> {
        let Some(mesh) = node.mesh.as_deref().filter(|mesh| mesh.num_triangles > 0) else { return Ok(()) };
        if mesh.skin_deformers.count > 0 && !self.shown_skins.insert(mesh.element.element_id) {
            return Ok(());
        }
        let element = format!("{} on {}", convert::label("mesh", &mesh.element), hierarchy::label(node));
        mesh::note_what_is_left_out(mesh, &mut self.warnings);
        // Before anything is built of it.
        if self.model.indices.len() + 3 * mesh.num_triangles > MAX_VERTICES {
            return Err(Fault::new(
                element,
                format!("brings the model over {MAX_VERTICES} indices; reduce it"),
            ));
        }
        let (binding, entries) = self.binding(node, mesh, &element)?;
        self.model.palette.extend(entries);
        let shapes = self.morphs.register(mesh, &mut self.warnings)?;
        for part in &*mesh.material_parts {
            // The node's materials, since instances may differ; the mesh's where it has none.
            let slot = part.index as usize;
            let of_node = node.materials.as_ref().get(slot).or_else(|| mesh.materials.as_ref().get(slot));
            let material =
                self.materials.index(of_node.map(|material| &**material), mesh, &mut self.warnings)?;
            let normal_map = self.materials.materials[material as usize].normal_texture;
            let source = mesh::Source { mesh, part, binding: &binding, shapes: &shapes, element: &element };
            let part = source.read(normal_map.as_ref(), &mut self.warnings)?;
            self.append(&part, &shapes, material, &element)?;
        }
        Ok(())
    }

    /// What the vertices of a mesh follow when this node shows it, with the palette entries that this needs.
    fn binding(
        &self,
        node: &ufbx::Node,
        mesh: &ufbx::Mesh,
        element: &str,
    ) -> Result<(Binding, Vec<PaletteEntry>), Fault> {
        let first = self.model.palette.len();
        let fault = |problem: String| Fault::new(element, problem);
        let bone_from_mesh = affine(&node.geometry_to_node)
            .ok_or_else(|| fault("its geometry transform is not finite".into()))?;
        let rigid = PaletteEntry { bone: self.hierarchy.bone(node), bone_from_mesh };
        let (binding, entries) =
            skin::bind(mesh, node, rigid, first, |bone| self.hierarchy.bone(bone)).map_err(fault)?;
        if first + entries.len() > MAX_PALETTE {
            return Err(fault(format!(
                "brings the model over {MAX_PALETTE} bone matrices; merge its meshes"
            )));
        }
        Ok((binding, entries))
    }

    fn append(
        &mut self,
        part: &Part,
        shapes: &morph::Shapes,
        material: u32,
        element: &str,
    ) -> Result<(), Fault> {
        if part.indices.is_empty() {
            return Ok(());
        }
        let (base, first_index) = (self.model.vertices.len(), self.model.indices.len());
        self.model.vertices.extend_from_slice(&part.vertices);
        self.model.indices.extend(part.indices.iter().map(|index| base as u32 + index));
        self.model.primitives.push(Primitive {
            first_index: first_index as u32,
            index_count: part.indices.len() as u32,
            material,
        });
        self.morphs.append(part, shapes, base as u32).map_err(|problem| Fault::new(element, problem))
    }
}

//! Influences on the control points of a mesh: the clusters of its skin, or its node.

use super::convert::affine;
use crate::PaletteEntry;
use crate::import::Warnings;
use crate::influences::{FourInfluences, reduce_to_four};
use std::collections::HashMap;

/// The influences of every control point, by palette index.
pub(super) struct Binding {
    /// By control point; empty where all follow `whole`.
    of_point: Vec<FourInfluences>,
    whole: FourInfluences,
    /// Whether the rest pose shows the mesh mirrored, so that its triangles must be turned over.
    pub(super) mirrored: bool,
}

impl Binding {
    pub(super) fn at(&self, control_point: u32) -> FourInfluences {
        self.of_point.get(control_point as usize).copied().unwrap_or(self.whole)
    }
}

pub(super) fn note_what_is_approximate(mesh: &ufbx::Mesh, warnings: &mut Warnings) {
    if mesh.skin_deformers.count > 1 {
        warnings.insert("a mesh has several skins; only the first is used".into());
    }
    let method = mesh.skin_deformers.as_ref().first().map(|skin| skin.skinning_method);
    if matches!(method, Some(ufbx::SkinningMethod::DualQuaternion | ufbx::SkinningMethod::BlendedDqLinear)) {
        warnings.insert("dual quaternion skinning is replaced by linear skinning".into());
    }
}

/// The binding of a mesh, and the palette entries for it, of which the first gets the index `first`. Only clusters that
/// some control point follows get one; control points that follow none get `rigid`, the node's own.
pub(super) fn bind(
    mesh: &ufbx::Mesh,
    node: &ufbx::Node,
    rigid: PaletteEntry,
    first: usize,
    bone_of: impl Fn(&ufbx::Node) -> u32,
) -> Result<(Binding, Vec<PaletteEntry>), String> {
    let Some(skin) = mesh.skin_deformers.as_ref().first() else {
        let mirrored = ufbx::matrix_determinant(&node.geometry_to_world) < 0.0;
        let whole = ([entry_index(first)?; 4], [1.0, 0.0, 0.0, 0.0]);
        return Ok((Binding { of_point: Vec::new(), whole, mirrored }, vec![rigid]));
    };
    let mut palette = SkinPalette { skin, rigid, first, bone_of, entries: Vec::new(), known: HashMap::new() };
    let points = skin.vertices.iter().take(mesh.num_vertices);
    let of_point = points.map(|point| palette.influences(point)).collect::<Result<Vec<_>, _>>()?;
    // Control points that the skin does not list.
    let whole = if of_point.len() < mesh.num_vertices {
        palette.all_on(None)?
    } else {
        ([0; 4], [1.0, 0.0, 0.0, 0.0])
    };
    let mirrored = palette.is_mirrored();
    Ok((Binding { of_point, whole, mirrored }, palette.entries))
}

struct SkinPalette<'a, F> {
    skin: &'a ufbx::SkinDeformer,
    rigid: PaletteEntry,
    first: usize,
    bone_of: F,
    entries: Vec<PaletteEntry>,
    /// By cluster; `None` is the node that shows the mesh.
    known: HashMap<Option<u16>, u16>,
}

impl<F: Fn(&ufbx::Node) -> u32> SkinPalette<'_, F> {
    fn influences(&mut self, point: &ufbx::SkinVertex) -> Result<FourInfluences, String> {
        let begin = point.weight_begin as usize;
        let weights = self.skin.weights.get(begin..begin + point.num_weights as usize).unwrap_or_default();
        // Clusters beyond 16 bits cannot be named; they are beyond what the palette may hold.
        let numbered = |weight: &ufbx::SkinWeight| {
            let cluster =
                u16::try_from(weight.cluster_index).map_err(|_| "has more than 65536 clusters".to_owned());
            cluster.map(|cluster| (cluster, weight.weight as f32))
        };
        let pairs = weights.iter().map(numbered).collect::<Result<Vec<_>, _>>()?;
        let Some((clusters, weights)) = reduce_to_four(pairs) else { return self.all_on(None) };
        let mut joints = [0; 4];
        for (joint, cluster) in joints.iter_mut().zip(clusters) {
            *joint = self.entry(Some(cluster))?;
        }
        Ok((joints, weights))
    }

    fn all_on(&mut self, cluster: Option<u16>) -> Result<FourInfluences, String> {
        Ok(([self.entry(cluster)?; 4], [1.0, 0.0, 0.0, 0.0]))
    }

    fn entry(&mut self, cluster: Option<u16>) -> Result<u16, String> {
        if let Some(known) = self.known.get(&cluster) {
            return Ok(*known);
        }
        let entry = match cluster.and_then(|index| self.skin.clusters.as_ref().get(usize::from(index))) {
            None => self.rigid,
            Some(cluster) => {
                let bone_from_mesh = affine(&cluster.geometry_to_bone).ok_or_else(|| {
                    format!("the bind pose of cluster '{}' is not finite", cluster.element.name)
                })?;
                let node = cluster.bone_node.as_deref();
                node.map_or(self.rigid, |node| PaletteEntry { bone: (self.bone_of)(node), bone_from_mesh })
            }
        };
        let index = entry_index(self.first + self.entries.len())?;
        self.entries.push(entry);
        self.known.insert(cluster, index);
        Ok(index)
    }

    /// By any cluster that is used: a skin that mirrors some of them only has no outside anyway.
    fn is_mirrored(&self) -> bool {
        let clusters = self.skin.clusters.as_ref();
        let mut used = self.known.keys().filter_map(|cluster| clusters.get(usize::from((*cluster)?)));
        used.all(|cluster| ufbx::matrix_determinant(&cluster.geometry_to_world) < 0.0)
            && self.known.keys().any(Option::is_some)
    }
}

fn entry_index(index: usize) -> Result<u16, String> {
    u16::try_from(index).map_err(|_| "brings the model over 65536 bone matrices; merge its meshes".to_owned())
}

//! Patches: groups of 1 to 3 adjacent triangles of one material, each mapped to a rectangle of the atlas.
//!
//! They are built once per model and LOD, so that few blocks of few texels show the triangles well. `grouping.rs` decides which
//! triangles may share a patch, and the costs. `matching.rs` finds a cheap division.

mod grouping;
mod matching;
mod quality;

pub use quality::PatchReport;

use crate::{Cancel, Cancelled, Material, Model, Primitive, Vertex};
use grouping::Grouping;
use serde::{Deserialize, Serialize};
use shadecast_model::patch::PatchKind;
use std::borrow::Cow;

/// One patch of a model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patch {
    /// Indices into the model's vertices; entries that the kind does not use repeat the first.
    pub vertices: [u32; 5],
    /// Number and arrangement of triangles.
    pub kind: PatchKind,
    /// Index into the model's materials.
    pub material: u32,
    /// Seen from behind too, as its material says.
    pub double_sided: bool,
}

impl Patch {
    /// Triangles that are drawn for it: those of two sides twice.
    pub fn drawn_triangles(&self) -> u32 {
        self.kind.triangle_count() as u32 * if self.double_sided { 2 } else { 1 }
    }
}

/// All patches of one level of detail of a model.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Patches {
    /// In the order of their first triangle.
    #[serde(with = "rows")]
    pub patches: Vec<Patch>,
    /// For each triangle of the level's index list the patch that holds it.
    #[serde(with = "crate::bulk")]
    pub patch_of_triangle: Vec<u32>,
}

/// What patches are built of: the triangles of one level of detail.
#[derive(Clone, Copy, Debug)]
pub struct Triangles<'a> {
    /// The model's.
    pub vertices: &'a [Vertex],
    /// Three per triangle, all in range.
    pub indices: &'a [u32],
    /// Ranges of `indices`.
    pub primitives: &'a [Primitive],
    /// The model's.
    pub materials: &'a [Material],
}

/// Patches as rows of words, for [`crate::bulk`].
mod rows {
    use super::{Patch, PatchKind};
    use crate::bulk;
    use serde::de::{Deserializer, Error};
    use serde::ser::Serializer;

    pub fn serialize<S: Serializer>(patches: &[Patch], serializer: S) -> Result<S::Ok, S::Error> {
        let row = |p: &Patch| {
            let [a, b, c, d, e] = p.vertices;
            [a, b, c, d, e, p.kind as u32, p.material, u32::from(p.double_sided)]
        };
        bulk::serialize(&patches.iter().map(row).collect::<Vec<[u32; 8]>>(), serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Patch>, D::Error> {
        let patch = |[a, b, c, d, e, kind, material, double_sided]: [u32; 8]| {
            let kind = u8::try_from(kind).ok().and_then(PatchKind::from_triangle_count);
            let kind = kind.ok_or_else(|| D::Error::custom("unknown kind of patch"))?;
            Ok(Patch { vertices: [a, b, c, d, e], kind, material, double_sided: double_sided != 0 })
        };
        bulk::deserialize::<[u32; 8], D>(deserializer)?.into_iter().map(patch).collect()
    }
}

impl Patches {
    /// Groups the triangles of one level of detail.
    ///
    /// # Errors
    /// Somebody asked to end.
    pub fn build(triangles: Triangles, cancel: &Cancel) -> Result<Self, Cancelled> {
        Grouping::new(triangles).patches(cancel)
    }
}

impl Model {
    /// The patches of a level of detail: those made at load, or made now for a model that did not come through it.
    pub fn patches_of(&self, level: usize) -> Cow<'_, Patches> {
        match self.patches.get(level) {
            Some(patches) => Cow::Borrowed(patches),
            None => {
                let patches = Patches::build(self.triangles(level), &Cancel::default());
                Cow::Owned(patches.expect("nobody asks to end"))
            }
        }
    }

    /// The triangles of a level of detail: 0 is the full one, `n` is `lods[n - 1]`.
    pub fn triangles(&self, level: usize) -> Triangles<'_> {
        let (indices, primitives) = match level.checked_sub(1).map(|lod| &self.lods[lod]) {
            None => (&self.indices, &self.primitives),
            Some(lod) => (&lod.indices, &lod.primitives),
        };
        Triangles { vertices: &self.vertices, indices, primitives, materials: &self.materials }
    }
}

#[cfg(test)]
mod tests;

//! Geometry as one stream of coded bits. Probabilities, what is known of meshes and the atlas's twin are the same on both
//! sides, because deltas come in order and none is left out.

use super::Part;
use super::entering::{Entered, Entering, Scene};
use super::known::Known;
use super::placing::{Placed, Placing};
use super::slots::{Gaps, Slots};
use crate::atlas::AtlasExtent;
use crate::geometry::GeometryDelta;
use crate::ids::{PatchSlot, VertexSlot};
use crate::memory::ClientMemory;
use crate::range::Coder;
use crate::wire::WireError;

/// See the module. Sized at connection.
#[derive(Clone, Debug)]
pub(super) struct GeometryCoding {
    known: Known,
    entering: Entering,
    placing: Placing,
    /// Slots that are taken.
    patches: Slots,
    vertices: Slots,
    evictions: [Gaps; 2],
    /// Of one delta, kept for its memory.
    placed: Vec<Placed>,
}

impl GeometryCoding {
    pub(super) fn new(vertex_slots: u32, patch_slots: u32) -> Self {
        Self {
            known: Known::new(vertex_slots, patch_slots),
            entering: Entering::new(),
            placing: Placing::new(patch_slots),
            patches: Slots::none(patch_slots),
            vertices: Slots::none(vertex_slots),
            evictions: Default::default(),
            placed: Vec::new(),
        }
    }

    /// With blocks in an atlas of this extent.
    pub(super) fn with_atlas(mut self, extent: AtlasExtent) -> Self {
        self.placing = self.placing.with_atlas(extent);
        self
    }

    /// Evictions, what enters, and placements, of a delta that follows those before, into `geometry`, which says nothing yet. `memory` is
    /// as before it. An encoder is told the delta, a decoder an empty one.
    pub(super) fn code<C: Coder>(
        &mut self,
        coder: &mut C,
        memory: &ClientMemory,
        told: &GeometryDelta,
        geometry: &mut GeometryDelta,
    ) -> Result<(), WireError> {
        let Self { known, entering, placing, patches, vertices, evictions, placed } = self;
        coder.count_for(Part::Evicted as usize);
        let slots = told.evicted_patches.iter().map(|slot| slot.0);
        evictions[0].code(coder, (patches.these(), patches.count()), slots, |_, slot| {
            placing.release(memory, PatchSlot(slot));
            geometry.evicted_patches.push(PatchSlot(slot));
            Ok(())
        })?;
        geometry.evicted_patches.iter().for_each(|slot| patches.remove(slot.0));
        let slots = told.evicted_vertices.iter().map(|slot| slot.0);
        evictions[1].code(coder, (vertices.these(), vertices.count()), slots, |_, slot| {
            known.leave(slot);
            geometry.evicted_vertices.push(VertexSlot(slot));
            Ok(())
        })?;
        geometry.evicted_vertices.iter().for_each(|slot| vertices.remove(slot.0));
        placed.clear();
        placing.stay(coder, (memory, patches), &told.placements, placed)?;
        let mut scene = Scene { known, patches, vertices, told, out: Entered::into_lists_of(geometry) };
        entering.code(coder, &mut scene)?;
        (geometry.new_patches, geometry.new_vertices) = (scene.out.patches, scene.out.vertices);
        let slots = geometry.new_patches.iter().map(|patch| patch.slot);
        placing.enter(coder, known, slots, &told.placements, placed)?;
        placing.addresses(coder, known, placed)?;
        geometry.placements.extend(placed.iter().map(|placed| (placed.slot, placed.block)));
        geometry.placements.sort_unstable_by_key(|(slot, _)| *slot);
        Ok(())
    }
}

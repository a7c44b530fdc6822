//! What the one draw of a display frame reads: corners and indices of every patch that has a block.

use crate::motion::Motion;
use shadecast_protocol::ids::PatchSlot;
use shadecast_protocol::limits::PATCH_MAX_VERTICES;
use shadecast_protocol::memory::{Patches, ResidentPatch};
use shadecast_protocol::time::GridIndex;
use shadecast_shaders::constants::IS_MASKED;
use shadecast_shaders::generated::CornerGpu;

/// Corners of a patch of three triangles, and its indices.
pub const MAX_CORNERS_PER_PATCH: usize = PATCH_MAX_VERTICES as usize;
/// Indices of a patch of three triangles, both sides.
pub const MAX_INDICES_PER_PATCH: usize = 18;

/// What a draw list holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DrawList {
    /// Corners written.
    pub corners: u32,
    /// Indices of patches that can be drawn at any display time from now on.
    pub indices: u32,
    /// Of all indices, how many from the first on are of patches that cover all of their block; `u32::MAX` where all are.
    pub opaque_indices: u32,
    /// Patches of `indices`.
    pub patches: u32,
    /// The first grid step at which all of `indices` can be drawn.
    pub ready: GridIndex,
    /// Patches whose vertices have no samples before a grid step, in order of it: step, and indices up to the patch's
    /// end. They lie behind `indices`.
    pub late: Vec<(GridIndex, u32)>,
}

impl Default for DrawList {
    fn default() -> Self {
        let ready = GridIndex(i32::MIN);
        Self { corners: 0, indices: 0, opaque_indices: u32::MAX, patches: 0, ready, late: Vec::new() }
    }
}

impl DrawList {
    /// Indices to draw, and patches withheld, when the last grid step at or before the display time is `grid`.
    pub fn at(&self, grid: GridIndex) -> (u32, u32) {
        let ready = self.late.partition_point(|(first, _)| *first <= grid);
        let indices = self.late[..ready].last().map_or(self.indices, |(_, end)| *end);
        (indices, (self.late.len() - ready) as u32)
    }
}

/// Memory for the lists of one scene.
#[derive(Debug)]
pub struct ListScratch {
    late: Vec<(GridIndex, PatchSlot)>,
    masked: Vec<PatchSlot>,
}

impl ListScratch {
    /// For so many patches.
    pub fn new(patch_slots: u32) -> Self {
        let slots = patch_slots as usize;
        Self { late: Vec::with_capacity(slots), masked: Vec::with_capacity(slots) }
    }
}

impl DrawList {
    /// Writes what `patches` draw: those that can be drawn from grid step `step` on, cutouts last, then the others in the order of the
    /// steps from which they can. The slices hold what all patch slots can need. Tells `motion` what is on display.
    pub fn write(
        &mut self,
        patches: &Patches,
        motion: &mut Motion,
        step: GridIndex,
        (corners, indices): (&mut [CornerGpu], &mut [u32]),
        scratch: &mut ListScratch,
    ) {
        let mut writer = ListWriter::new(corners, indices);
        let mut users = motion.begin_list();
        scratch.late.clear();
        scratch.masked.clear();
        let mut has_masked = false;
        (self.patches, self.ready) = (0, GridIndex(i32::MIN));
        for (slot, patch) in patches.iter().filter(|(_, patch)| patch.block.is_some()) {
            let first = users.note(&patch.vertices[..patch.kind.vertex_count()]);
            has_masked |= patch.is_masked;
            if first <= step {
                if patch.is_masked {
                    scratch.masked.push(slot);
                } else {
                    writer.write(patch);
                }
                self.patches += 1;
                self.ready = self.ready.max(first);
            } else {
                scratch.late.push((first, slot));
            }
        }
        users.end(self.ready);
        self.opaque_indices = if has_masked { writer.index_count() } else { u32::MAX };
        scratch.masked.iter().filter_map(|slot| patches.get(*slot)).for_each(|patch| writer.write(patch));
        self.indices = writer.index_count();
        scratch.late.sort_unstable();
        self.late.clear();
        for (first, slot) in &scratch.late {
            if let Some(patch) = patches.get(*slot) {
                writer.write(patch);
                self.late.push((*first, writer.index_count as u32));
            }
        }
        self.corners = writer.corner_count as u32;
    }
}

/// Writes patches one behind the other.
pub struct ListWriter<'a> {
    corners: &'a mut [CornerGpu],
    indices: &'a mut [u32],
    corner_count: usize,
    index_count: usize,
}

impl<'a> ListWriter<'a> {
    /// Into memory for as many patches as will be written.
    pub fn new(corners: &'a mut [CornerGpu], indices: &'a mut [u32]) -> Self {
        Self { corners, indices, corner_count: 0, index_count: 0 }
    }

    /// Indices written so far.
    pub fn index_count(&self) -> u32 {
        self.index_count as u32
    }

    /// Adds a patch, if it has a block.
    pub fn write(&mut self, patch: &ResidentPatch) {
        let Some(block) = patch.block else { return };
        let [left, top, right, bottom] = block.lookup_rect_texels();
        let [first_x, first_y, end_x, end_y] = block.rect_texels();
        let flag = if patch.is_masked { IS_MASKED } else { 0 };
        let base = self.corner_count as u32;
        for (uv, slot) in patch.kind.corner_uv().iter().zip(patch.vertices) {
            self.corners[self.corner_count] = CornerGpu {
                vertex_slot: slot.0,
                instance: u32::from(patch.instance.0),
                atlas_texel: [left + (right - left) * uv[0], top + (bottom - top) * uv[1]],
                block: [first_x | first_y << 16 | flag, end_x | end_y << 16],
            };
            self.corner_count += 1;
        }
        for [a, b, c] in patch.kind.triangles() {
            self.write_triangle(base, [*a, *b, *c]);
            // Back faces are culled, so that one draw serves both kinds: what has two sides is there twice.
            if patch.double_sided {
                self.write_triangle(base, [*a, *c, *b]);
            }
        }
    }

    fn write_triangle(&mut self, base: u32, corners: [u8; 3]) {
        for corner in corners {
            self.indices[self.index_count] = base + u32::from(corner);
            self.index_count += 1;
        }
    }
}

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

/// Indices of patches that can be drawn from the same grid step on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Group {
    first: GridIndex,
    /// Exclusive, from the list's first index on.
    end_index: u32,
    patches: u32,
}

/// What a draw list holds: what covers all of its block, then cutouts; of both what waits for no samples, then the others in the
/// order of the steps from which all their vertices have some.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DrawList {
    /// Corners written.
    pub corners: u32,
    opaque: Vec<Group>,
    cutouts: Vec<Group>,
}

/// What of a list can be drawn at a time: indices.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Drawable {
    /// Of patches that cover all of their block, from the list's first on.
    pub opaque: u32,
    /// The first of a cutout, and how many there are.
    pub cutouts: [u32; 2],
    /// Patches that have to wait for their samples.
    pub withheld_patches: u32,
}

impl Drawable {
    /// Both ranges: first and count.
    pub fn ranges(&self) -> [[u32; 2]; 2] {
        [[0, self.opaque], self.cutouts]
    }

    /// All indices.
    pub fn index_count(&self) -> u32 {
        self.opaque + self.cutouts[1]
    }
}

impl DrawList {
    /// With room for so many patches.
    pub fn of_capacity(patch_slots: u32) -> Self {
        let room = || Vec::with_capacity(patch_slots as usize + 1);
        Self { corners: 0, opaque: room(), cutouts: room() }
    }

    /// What can be drawn when the last grid step at or before the display time is `step`.
    pub fn at(&self, step: GridIndex) -> Drawable {
        let until = |groups: &[Group]| groups.partition_point(|group| group.first <= step);
        let end = |groups: &[Group], base: u32| groups.last().map_or(base, |group| group.end_index);
        let (opaque, cutouts) = (until(&self.opaque), until(&self.cutouts));
        let base = end(&self.opaque, 0);
        let late = self.opaque[opaque..].iter().chain(&self.cutouts[cutouts..]);
        Drawable {
            opaque: end(&self.opaque[..opaque], 0),
            cutouts: [base, end(&self.cutouts[..cutouts], base) - base],
            withheld_patches: late.map(|group| group.patches).sum(),
        }
    }

    /// Whether some of it waits for samples, so that time alone changes it.
    pub fn waits(&self) -> bool {
        let last = |groups: &[Group]| groups.last().is_some_and(|group| group.first > GridIndex(i32::MIN));
        last(&self.opaque) || last(&self.cutouts)
    }

    /// The first step at which all can be drawn that can be at `step`.
    pub fn ready_at(&self, step: GridIndex) -> GridIndex {
        let firsts = self.opaque.iter().chain(&self.cutouts).map(|group| group.first);
        firsts.filter(|first| *first <= step).max().unwrap_or(GridIndex(i32::MIN))
    }
}

/// Memory for the lists of one scene.
#[derive(Debug)]
pub struct ListScratch {
    /// By kind, and in it by the step from which they can be drawn: cutouts, and all that wait for samples.
    later: Vec<(bool, GridIndex, PatchSlot)>,
}

impl ListScratch {
    /// For so many patches.
    pub fn new(patch_slots: u32) -> Self {
        Self { later: Vec::with_capacity(patch_slots as usize) }
    }
}

impl DrawList {
    /// Writes what `patches` draw. The slices hold what all patch slots can need. Tells `motion` that the list comes on display.
    pub fn write(
        &mut self,
        patches: &Patches,
        motion: &mut Motion,
        (corners, indices): (&mut [CornerGpu], &mut [u32]),
        scratch: &mut ListScratch,
    ) {
        let mut writer = ListWriter::new(corners, indices);
        let mut users = motion.begin_list();
        let later = &mut scratch.later;
        later.clear();
        self.opaque.clear();
        self.cutouts.clear();
        let at_once = GridIndex(i32::MIN);
        for (slot, patch) in patches.iter().filter(|(_, patch)| patch.block.is_some()) {
            let first = users.note(&patch.vertices[..patch.kind.vertex_count()]);
            if first > at_once || patch.is_masked {
                later.push((patch.is_masked, first, slot));
            } else {
                writer.write(patch);
                extend(&mut self.opaque, at_once, &writer);
            }
        }
        users.end();
        later.sort_unstable();
        for (is_cutout, first, slot) in later.iter() {
            if let Some(patch) = patches.get(*slot) {
                writer.write(patch);
                let groups = if *is_cutout { &mut self.cutouts } else { &mut self.opaque };
                extend(groups, *first, &writer);
            }
        }
        self.corners = writer.corner_count as u32;
    }
}

/// The patch that was written last belongs to the group of `first`.
fn extend(groups: &mut Vec<Group>, first: GridIndex, writer: &ListWriter<'_>) {
    let end_index = writer.index_count();
    match groups.last_mut().filter(|group| group.first == first) {
        Some(group) => (group.end_index, group.patches) = (end_index, group.patches + 1),
        None => groups.push(Group { first, end_index, patches: 1 }),
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

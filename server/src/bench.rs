//! What the benchmarks of placement reach: layout and residency of a scene without a device. Only with the feature `bench`.

use crate::atlas::layout::{Layout, Visible};
use crate::atlas::placement::PlacementChange;
use crate::motion::delta::UpdateStamp;
use crate::pacing::room::Room;
use crate::residency::Residency;
use crate::scene::geometry::Geometry;
use crate::scene::numbering::{InstanceSize, Numbering, ScenePatch, SceneVertex};
use crate::visibility::lod_set::{LodChoice, LodSet};
use glam::Vec3;
use shadecast_protocol::atlas::{AtlasExtent, PatchKind};
use shadecast_protocol::ids::{MeshId, UpdateId};
use shadecast_protocol::time::WorldTime;
use shadecast_scene::patches::Patch;
use shadecast_shaders::generated::SeenGpu;

/// Quads along a side of the grid.
const SIDE: u32 = 216;
/// Patches of the scene.
pub const PATCHES: u32 = SIDE * SIDE;
const VERTICES: u32 = (SIDE + 1) * (SIDE + 1);
/// Of all patches a half is in view; with each update a hundredth of all comes into view, and as many leave it.
const IN_VIEW: u32 = PATCHES / 2;
const COMES: u32 = PATCHES / 100;
const UPDATE_NS: i64 = 33_333_333;

/// One still instance: a grid of quads.
struct Quads;

impl Geometry for Quads {
    fn instance_of_patch(&self, _: ScenePatch) -> u16 {
        0
    }
    fn first_vertex(&self, _: u16) -> SceneVertex {
        SceneVertex(0)
    }
    fn mesh_of(&self, _: u16) -> (MeshId, ScenePatch) {
        (MeshId(0), ScenePatch(0))
    }
    fn patch(&self, patch: ScenePatch) -> Patch {
        let first = patch.0 / SIDE * (SIDE + 1) + patch.0 % SIDE;
        let vertices = [first, first + 1, first + SIDE + 2, first + SIDE + 1, first];
        Patch { vertices, kind: PatchKind::Two, material: 0, double_sided: false }
    }
    fn static_position(&self, vertex: SceneVertex) -> Option<Vec3> {
        Some(Vec3::new(vertex.0 as f32 * 0.01, 0.0, 0.0))
    }
    fn is_masked(&self, _: ScenePatch) -> bool {
        false
    }
    fn vertex_count(&self) -> usize {
        VERTICES as usize
    }
}

/// A viewer's placement while its head turns.
pub struct Placing {
    layout: Layout,
    residency: Residency,
    lods: LodSet,
    seen: Vec<SeenGpu>,
    changes: Vec<PlacementChange>,
    update: u32,
}

impl Default for Placing {
    fn default() -> Self {
        let extent = AtlasExtent::new(4096, 2048).expect("an atlas");
        let size = InstanceSize { patches: vec![PATCHES], ..InstanceSize::default() };
        let shown = LodChoice { shown: 0, next: None };
        Self {
            layout: Layout::new(extent, PATCHES as usize),
            residency: Residency::new([PATCHES, VERTICES], PATCHES, VERTICES).with_atlas(extent),
            lods: LodSet::new(&Numbering::new(&[size]), [Some(shown)]),
            seen: Vec::new(),
            changes: Vec::new(),
            update: 0,
        }
    }
}

impl Placing {
    /// A viewer who has looked for some updates.
    pub fn settled() -> Self {
        let mut placing = Self::default();
        for _ in 0..20 {
            placing.see();
            placing.lay_out();
            placing.tell();
        }
        placing
    }

    /// What the next update sees: patches of 3 to 12 texels a side.
    pub fn see(&mut self) {
        self.update += 1;
        let first = self.update * COMES;
        self.seen.clear();
        self.seen.extend(
            (0..PATCHES).filter(|patch| (patch + PATCHES - first % PATCHES) % PATCHES < IN_VIEW).map(
                |entry| {
                    let random = entry.wrapping_mul(747_796_405) >> 16;
                    let side = |random: u32| 3 + random % 10;
                    SeenGpu { entry, extent_texels: side(random) | side(random / 16) << 16 }
                },
            ),
        );
    }

    /// Chooses sizes and places of blocks. Gives how many changed.
    pub fn lay_out(&mut self) -> usize {
        let room = Room { patches: PATCHES, vertices: VERTICES, triangles: 2 * PATCHES };
        self.layout.begin(1.0);
        self.layout.see(Visible { lods: &self.lods, seen: &self.seen });
        self.layout.place(&Quads, &self.lods, (room, UpdateId(self.update)), &mut self.changes);
        self.changes.len()
    }

    /// Gives slots of the client to what changed, and codes it. Gives the bytes.
    pub fn tell(&mut self) -> usize {
        let time = WorldTime(i64::from(self.update) * UPDATE_NS);
        let stamp = UpdateStamp { update: UpdateId(self.update), time };
        let delta = self.residency.update(&Quads, &self.changes, stamp);
        let bytes = self.residency.encode(&delta).bytes.len();
        self.residency.recycle(delta);
        self.residency.displayed(UpdateId(self.update));
        bytes
    }

    /// Goes once over what was seen and over what is placed: less cannot be done.
    pub fn floor(&self) -> u64 {
        let seen = self.seen.iter().map(|seen| u64::from(seen.extent_texels & 0xffff)).sum::<u64>();
        seen + self.layout.live().map(|(_, block)| u64::from(block.size.texels())).sum::<u64>()
    }
}

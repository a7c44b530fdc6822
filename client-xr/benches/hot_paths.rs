//! What the client's draw list costs on the thread that takes deltas in, beside its floor: `cargo bench -p shadecast-client`.
//!
//! A scene of 46,656 patches of two triangles, of which an update gives a hundredth other blocks. The floor is a copy of as many bytes
//! as change: five corners a patch.

use divan::counter::{BytesCount, ItemsCount};
use divan::{Bencher, black_box};
use shadecast_client::draw::draw_list::{MAX_CORNERS_PER_PATCH, MAX_INDICES_PER_PATCH, NewestList};
use shadecast_client::motion::Motion;
use shadecast_protocol::atlas::{Block, BlockAddress, BlockSize, PatchKind};
use shadecast_protocol::geometry::{self, NewPatch, NewVertex};
use shadecast_protocol::ids::{InstanceId, MeshId, PatchSlot, UpdateId, VertexSlot};
use shadecast_protocol::memory::Patches;
use shadecast_protocol::message::MotionMemory;
use shadecast_shaders::generated::CornerGpu;

const PATCHES: u32 = 46_656;
const VERTICES: u32 = 48_000;
const CHANGED: u32 = PATCHES / 100;

fn main() {
    divan::main();
}

fn block(number: u32) -> Block {
    let [x, y] = [number % 1024, number / 1024 % 512].map(|place| 4 * place as u16);
    Block { address: BlockAddress { page: 0, x, y }, size: BlockSize::new(2, 2).expect("a size") }
}

/// What a client keeps, and the list of all of it.
struct Scene {
    patches: Patches,
    motion: Motion,
    list: NewestList,
    changed: Vec<PatchSlot>,
    moves: u32,
}

impl Scene {
    fn new() -> Self {
        let mut motion = Motion::new(VERTICES, MotionMemory::DEFAULT.into());
        let vertex = |slot: u32| NewVertex {
            slot: VertexSlot(slot),
            instance: InstanceId(0),
            number: slot,
            motion: geometry::Motion::Static { position: glam::Vec3::ZERO },
        };
        let vertices: Vec<NewVertex> = (0..VERTICES).map(vertex).collect();
        motion.take(UpdateId(0), &vertices, Vec::new(), true);
        let mut patches = Patches::new(PATCHES);
        let patch = |slot: u32| NewPatch {
            slot: PatchSlot(slot),
            instance: InstanceId(0),
            mesh: MeshId(0),
            number: slot,
            kind: PatchKind::Two,
            vertices: [0, 1, 2, 3, 0].map(|corner| VertexSlot(slot + corner)),
            double_sided: false,
        };
        let all: Vec<NewPatch> = (0..PATCHES).map(patch).collect();
        patches.insert(&all).expect("free slots");
        let placed: Vec<_> = (0..PATCHES).map(|slot| (PatchSlot(slot), Some(block(slot)))).collect();
        patches.place(&placed).expect("patches that are there");
        let mut list = NewestList::new(PATCHES, 1, true);
        let slots: Vec<PatchSlot> = (0..PATCHES).map(PatchSlot).collect();
        list.update(&patches, &slots, &mut motion);
        let changed = (0..CHANGED).map(|number| PatchSlot(number * (PATCHES / CHANGED))).collect();
        Self { patches, motion, list, changed, moves: 0 }
    }

    /// Other blocks for a hundredth of the patches.
    fn change(&mut self) {
        self.moves += 1;
        let moves = self.moves;
        let placed: Vec<_> =
            self.changed.iter().map(|slot| (*slot, Some(block(slot.0 + 7 * moves)))).collect();
        self.patches.place(&placed).expect("patches that are there");
    }
}

/// With the placement in the client's memory.
#[divan::bench]
fn draw_list_update(bencher: Bencher) {
    let mut scene = Scene::new();
    bencher.counter(ItemsCount::new(CHANGED)).bench_local(|| {
        scene.change();
        scene.list.update(&scene.patches, &scene.changed, &mut scene.motion);
    });
}

/// The same, and its copy to the memory of a bundle.
#[divan::bench]
fn draw_list_update_and_copy(bencher: Bencher) {
    let mut scene = Scene::new();
    let mut corners: Vec<CornerGpu> =
        vec![bytemuck::Zeroable::zeroed(); PATCHES as usize * MAX_CORNERS_PER_PATCH];
    let mut indices = vec![0; PATCHES as usize * MAX_INDICES_PER_PATCH];
    scene.list.copy_to(0, (&mut corners, &mut indices));
    bencher.counter(ItemsCount::new(CHANGED)).bench_local(|| {
        scene.change();
        scene.list.update(&scene.patches, &scene.changed, &mut scene.motion);
        scene.list.copy_to(0, (&mut corners, &mut indices))
    });
}

#[divan::bench]
fn draw_list_floor(bencher: Bencher) {
    let bytes = CHANGED as usize * MAX_CORNERS_PER_PATCH * size_of::<CornerGpu>();
    let (from, mut to) = (vec![1u8; bytes], vec![0u8; bytes]);
    bencher.counter(BytesCount::new(bytes)).bench_local(|| to.copy_from_slice(black_box(&from)));
}

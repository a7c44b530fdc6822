//! What the wire's hot paths cost, each beside its floor: `cargo bench -p shadecast-protocol`.
//!
//! Deltas are of nine instances of one mesh, a grid of quads, with an allocator as the server has it: 46,656 patches. An update gives
//! a hundredth of them other blocks, or takes them away. The floor of coding is a copy of the same records in memory.

use divan::counter::{BytesCount, ItemsCount};
use divan::{Bencher, black_box};
use shadecast_protocol::atlas::allocator::Atlas;
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockSize, PatchKind};
use shadecast_protocol::clock::ClockEstimator;
use shadecast_protocol::delta::{DeltaDecoder, DeltaEncoder};
use shadecast_protocol::geometry::{GeometryDelta, Motion, NewPatch, NewVertex};
use shadecast_protocol::ids::{InstanceId, MeshId, PatchSlot, UpdateId, VertexSlot};

use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_protocol::wire::{ControlReader, PictureHeader, encode_picture, frame_control, parse_stream};

const INSTANCES: u32 = 9;
/// Quads along a side of the mesh.
const SIDE: u32 = 72;
const PATCHES: u32 = SIDE * SIDE;
const VERTICES: u32 = (SIDE + 1) * (SIDE + 1);

/// The server: numbers of patches and vertices over all instances are their slots.
struct Scene {
    atlas: Atlas,
    blocks: Vec<Option<Block>>,
    encoder: DeltaEncoder,
    decoder: DeltaDecoder,
}

fn main() {
    divan::main();
}

/// Patches that change with an update, of a thousand.
const CHURNED: u32 = 10;
/// A coded picture of 20 Mbit/s at 30 Hz.
const PICTURE_BYTES: usize = 83_000;
const CONTROL_BYTES: usize = 64;

/// A scene that entered at once, and the update after that.
fn entered() -> (Scene, GeometryDelta) {
    let mut scene = Scene::new();
    let whole = scene.whole();
    let coded = scene.encoder.encode_update(&whole);
    scene.decoder.decode(&coded.bytes).expect("what was encoded");
    let next = scene.churn(1, CHURNED);
    (scene, GeometryDelta { update: UpdateId(1), ..next })
}

#[divan::bench]
fn delta_encode(bencher: Bencher) {
    let (scene, delta) = entered();
    let bencher = bencher.counter(ItemsCount::new(delta.records()));
    bencher.with_inputs(|| scene.encoder.clone()).bench_refs(|encoder| encoder.encode_update(&delta));
}

#[divan::bench]
fn delta_decode(bencher: Bencher) {
    let (mut scene, delta) = entered();
    let coded = scene.encoder.encode_update(&delta);
    let bencher = bencher.counter(ItemsCount::new(delta.records()));
    bencher.with_inputs(|| scene.decoder.clone()).bench_refs(|decoder| decoder.decode(&coded.bytes));
}

#[divan::bench]
fn delta_floor(bencher: Bencher) {
    let (_, delta) = entered();
    bencher.counter(ItemsCount::new(delta.records())).bench(|| black_box(&delta).clone());
}

#[divan::bench]
fn whole_scene_encode(bencher: Bencher) {
    let mut scene = Scene::new();
    let whole = scene.whole();
    let bencher = bencher.counter(ItemsCount::new(whole.records()));
    bencher.with_inputs(|| Scene::new().encoder).bench_refs(|encoder| encoder.encode_update(&whole));
}

#[divan::bench]
fn whole_scene_decode(bencher: Bencher) {
    let mut scene = Scene::new();
    let whole = scene.whole();
    let coded = scene.encoder.encode_update(&whole);
    let bencher = bencher.counter(ItemsCount::new(whole.records()));
    bencher.with_inputs(|| Scene::new().decoder).bench_refs(|decoder| decoder.decode(&coded.bytes));
}

#[divan::bench]
fn whole_scene_floor(bencher: Bencher) {
    let whole = Scene::new().whole();
    bencher.counter(ItemsCount::new(whole.records())).bench(|| black_box(&whole).clone());
}

#[divan::bench]
fn picture_frame(bencher: Bencher) {
    let unit = vec![7; PICTURE_BYTES];
    let header = PictureHeader { update: UpdateId(1), time: ServerTime(1), is_refresh: false };
    bencher.counter(BytesCount::new(PICTURE_BYTES)).bench(|| encode_picture(header, black_box(&unit)));
}

#[divan::bench]
fn picture_parse(bencher: Bencher) {
    let header = PictureHeader { update: UpdateId(1), time: ServerTime(1), is_refresh: false };
    let bytes = encode_picture(header, &vec![7; PICTURE_BYTES]);
    bencher.bench(|| parse_stream(black_box(&bytes)).is_ok());
}

#[divan::bench]
fn picture_floor(bencher: Bencher) {
    let unit = vec![7u8; PICTURE_BYTES];
    bencher.counter(BytesCount::new(PICTURE_BYTES)).bench(|| black_box(&unit).clone());
}

#[divan::bench]
fn control_reader(bencher: Bencher) {
    let message = frame_control(&[7; CONTROL_BYTES]);
    let bencher = bencher.counter(BytesCount::new(message.len()));
    bencher.with_inputs(ControlReader::default).bench_refs(|reader| reader.push(black_box(&message)));
}

#[divan::bench]
fn control_floor(bencher: Bencher) {
    let message = [7u8; CONTROL_BYTES];
    bencher.counter(BytesCount::new(CONTROL_BYTES)).bench(|| black_box(&message).to_vec());
}

/// An exchange of clocks: it arrives, and the estimate follows. Ways of 20 to 30 ms.
#[divan::bench]
fn clock_exchange(bencher: Bencher) {
    let exchange = |clock: &mut ClockEstimator, number: i64| {
        let sent_ns = number * 50_000_000;
        let way_ns = |salt: i64| 20_000_000 + (number * 7_919 + salt).rem_euclid(100) * 100_000;
        let arrives_ns = sent_ns + way_ns(0) + 5_000_000_000;
        let back_ns = arrives_ns - 5_000_000_000 + way_ns(37);
        clock.on_pong(
            ClientTime(sent_ns),
            ServerTime(arrives_ns),
            ServerTime(arrives_ns),
            ClientTime(back_ns),
        );
    };
    let mut clock = ClockEstimator::new();
    (0..300).for_each(|number| exchange(&mut clock, number));
    bencher.with_inputs(|| clock.clone()).bench_refs(|clock| exchange(clock, 300));
}

impl Scene {
    fn new() -> Self {
        let extent = AtlasExtent::new(4096, 2048).expect("an atlas");
        let slots = (INSTANCES * VERTICES, INSTANCES * PATCHES);
        Self {
            atlas: Atlas::new(extent),
            blocks: vec![None; slots.1 as usize],
            encoder: DeltaEncoder::new(slots.0, slots.1).with_atlas(extent),
            decoder: DeltaDecoder::new(slots.0, slots.1).with_atlas(extent),
        }
    }

    fn whole(&mut self) -> GeometryDelta {
        let all: Vec<u32> = (0..INSTANCES * PATCHES).collect();
        let vertex = |slot| NewVertex {
            slot: VertexSlot(slot),
            instance: InstanceId((slot / VERTICES) as u16),
            number: slot % VERTICES,
            motion: Motion::Predicted,
        };
        let placements = self.place(&all, 0);
        GeometryDelta {
            new_vertices: (0..INSTANCES * VERTICES).map(vertex).collect(),
            new_patches: all.into_iter().map(new_patch).collect(),
            placements,
            ..GeometryDelta::default()
        }
    }

    fn churn(&mut self, update: u32, per_mille: u32) -> GeometryDelta {
        let changes =
            |slot: &u32| (slot / 8).wrapping_mul(2_654_435_761).rotate_left(update) % 1000 < per_mille;
        let changed: Vec<u32> = (0..INSTANCES * PATCHES).filter(changes).collect();
        GeometryDelta { placements: self.place(&changed, update), ..GeometryDelta::default() }
    }

    /// One in five of those that had a block loses it. The others get another: freed together, then allocated large ones first.
    fn place(&mut self, patches: &[u32], update: u32) -> Vec<(PatchSlot, Option<Block>)> {
        let mut sizes = Vec::new();
        for &patch in patches {
            let old = self.blocks[patch as usize].take();
            old.into_iter().for_each(|block| self.atlas.free(block));
            let random = patch.wrapping_mul(747_796_405).wrapping_add(update).wrapping_mul(277_803_737) >> 20;
            let side = |random: u32| [2, 3, 3, 3, 3, 4][random as usize % 6];
            let size = BlockSize::new(side(random), side(random / 6));
            sizes.extend(
                size.filter(|_| old.is_none() || !random.is_multiple_of(5)).map(|size| (size, patch)),
            );
        }
        sizes.sort_unstable_by_key(|(size, patch)| (size.allocation_order(), *patch));
        for (size, patch) in sizes {
            self.blocks[patch as usize] = self.atlas.allocate(size);
        }
        patches.iter().map(|patch| (PatchSlot(*patch), self.blocks[*patch as usize])).collect()
    }
}

/// By its number over all instances.
fn new_patch(slot: u32) -> NewPatch {
    let (instance, number) = (slot / PATCHES, slot % PATCHES);
    let first = instance * VERTICES + number / SIDE * (SIDE + 1) + number % SIDE;
    NewPatch {
        slot: PatchSlot(slot),
        instance: InstanceId(instance as u16),
        mesh: MeshId(0),
        number,
        kind: PatchKind::Two,
        vertices: [first, first + 1, first + SIDE + 2, first + SIDE + 1, first].map(VertexSlot),
        double_sided: false,
    }
}

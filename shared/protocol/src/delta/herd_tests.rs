//! Instances of one mesh that come, change and leave, as a server with an allocator of its own tells them.

use super::*;
use crate::atlas::allocator::Atlas;
use crate::atlas::{Block, BlockSize, PatchKind};
use crate::geometry::{Motion, NewPatch, NewVertex};
use crate::ids::{InstanceId, MeshId, PatchSlot, RestId, VertexSlot};
use crate::testing::Dice;
use std::collections::BTreeMap;

/// Patches of the mesh: a strip of quads.
const MESH: u32 = 400;
const SLOTS: u32 = 2000;
const VERTEX_SLOTS: u32 = 2 * SLOTS;
const INSTANCES: u16 = 4;

/// What a client is told, without the checks of its memory: those of skinning need a skeleton.
struct Client {
    coding: GeometryCoding,
    memory: ClientMemory,
}

struct Herd {
    dice: Dice,
    atlas: Atlas,
    encoder: Client,
    decoder: Client,
    /// By instance and number: slot and block.
    patches: BTreeMap<(u16, u32), (u32, Option<Block>)>,
    vertices: BTreeMap<(u16, u32), u32>,
}

impl Client {
    fn new() -> Self {
        let coding = GeometryCoding::new(VERTEX_SLOTS, SLOTS).with_atlas(AtlasExtent::MIN);
        Self { coding, memory: ClientMemory::new(VERTEX_SLOTS, SLOTS) }
    }

    fn apply(&mut self, delta: &GeometryDelta) {
        let mut checked = delta.clone();
        checked.new_vertices.iter_mut().for_each(|vertex| vertex.motion = Motion::Predicted);
        self.memory.apply(&checked).expect("lawful");
    }
}

fn size(log2: u8) -> BlockSize {
    BlockSize { width_log2: log2, height_log2: log2 }
}

fn free_slot(taken: impl Iterator<Item = u32>) -> u32 {
    let taken: Vec<u32> = taken.collect();
    (0..).find(|slot| !taken.contains(slot)).expect("there are enough")
}

impl Herd {
    fn new(seed: u64) -> Self {
        Self {
            dice: Dice::new(seed),
            atlas: Atlas::new(AtlasExtent::MIN),
            encoder: Client::new(),
            decoder: Client::new(),
            patches: BTreeMap::new(),
            vertices: BTreeMap::new(),
        }
    }

    /// Patches of an instance that enter, in ascending slots.
    fn enter(&mut self, delta: &mut GeometryDelta, instance: u16, numbers: std::ops::Range<u32>) {
        for number in numbers.filter(|number| *number < MESH) {
            if self.patches.contains_key(&(instance, number)) {
                continue;
            }
            let slot = free_slot(self.patches.values().map(|(slot, _)| *slot));
            let corners = [2 * number, 2 * number + 1, 2 * number + 3, 2 * number + 2, 2 * number];
            let vertices = corners.map(|corner| self.vertex(delta, instance, corner));
            self.patches.insert((instance, number), (slot, None));
            delta.new_patches.push(NewPatch {
                slot: PatchSlot(slot),
                instance: InstanceId(instance),
                mesh: MeshId(5),
                number,
                kind: PatchKind::Two,
                vertices,
                double_sided: false,
            });
        }
        delta.new_patches.sort_by_key(|patch| patch.slot);
        delta.new_vertices.sort_by_key(|vertex| vertex.slot);
    }

    fn vertex(&mut self, delta: &mut GeometryDelta, instance: u16, number: u32) -> VertexSlot {
        let free = free_slot(self.vertices.values().copied());
        let slot = *self.vertices.entry((instance, number)).or_insert(free);
        if slot == free {
            let motion = Motion::Skinned { rest: RestId(number + 30) };
            let (slot, instance) = (VertexSlot(slot), InstanceId(instance));
            delta.new_vertices.push(NewVertex { slot, instance, number, motion });
        }
        VertexSlot(slot)
    }

    /// Patches get blocks of these sizes: the old ones are freed first, then large ones are allocated first.
    fn place(&mut self, delta: &mut GeometryDelta, sizes: &BTreeMap<(u16, u32), Option<BlockSize>>) {
        for key in sizes.keys() {
            let (_, block) = self.patches.get_mut(key).expect("it is there");
            block.take().into_iter().for_each(|block| self.atlas.free(block));
        }
        let mut order: Vec<_> = sizes.iter().filter_map(|(key, size)| Some(((*size)?, *key))).collect();
        order.sort_by_key(|(size, key)| (size.allocation_order(), *key));
        for (size, key) in order {
            self.patches.get_mut(&key).expect("it is there").1 = self.atlas.allocate(size);
        }
        delta.placements.extend(sizes.keys().map(|key| {
            let (slot, block) = self.patches[key];
            (PatchSlot(slot), block)
        }));
        delta.placements.sort_by_key(|(slot, _)| *slot);
    }

    fn leave(&mut self, delta: &mut GeometryDelta, instance: u16) {
        for (_, (slot, block)) in self.patches.extract_if(.., |key, _| key.0 == instance) {
            delta.evicted_patches.push(PatchSlot(slot));
            block.into_iter().for_each(|block| self.atlas.free(block));
        }
        let gone = self.vertices.extract_if(.., |key, _| key.0 == instance);
        delta.evicted_vertices.extend(gone.map(|(_, slot)| VertexSlot(slot)));
        delta.evicted_patches.sort();
        delta.evicted_vertices.sort();
    }

    /// Tells a delta, and checks that it arrives; gives the bytes by part.
    #[track_caller]
    fn tell(&mut self, delta: &GeometryDelta) -> PartBytes {
        let (mut sections, mut bits): ([Vec<u8>; SECTIONS], _) = (Default::default(), [0; Part::ALL.len()]);
        let mut coder = RangeEncoder::new(&mut sections[4], &mut bits);
        let mut told = GeometryDelta::default();
        self.encoder.coding.code(&mut coder, &self.encoder.memory, delta, &mut told).expect("lawful");
        assert!(has_same_lists(&told, delta));
        coder.finish();
        let mut coder = RangeDecoder::new(&sections[4]);
        let (silent, mut decoded) = (GeometryDelta::default(), GeometryDelta::default());
        self.decoder.coding.code(&mut coder, &self.decoder.memory, &silent, &mut decoded).expect("valid");
        assert!(has_same_lists(&decoded, delta));
        coder.finish("a test").expect("all of it");
        self.encoder.apply(delta);
        self.decoder.apply(delta);
        part_bytes(&sections, sections[4].len(), bits)
    }

    /// An instance enters with blocks of one size.
    fn show(&mut self, instance: u16, log2: u8) -> PartBytes {
        let mut delta = GeometryDelta::default();
        self.enter(&mut delta, instance, 0..MESH);
        self.place(&mut delta, &(0..MESH).map(|number| ((instance, number), Some(size(log2)))).collect());
        self.tell(&delta)
    }

    fn step(&mut self) {
        let mut delta = GeometryDelta::default();
        if self.dice.once_in(4) {
            let instance = self.dice.below(INSTANCES.into()) as u16;
            self.leave(&mut delta, instance);
            self.tell(&delta);
            return;
        }
        for _ in 0..self.dice.below(3) {
            let (instance, first) =
                (self.dice.below(INSTANCES.into()) as u16, self.dice.below(MESH.into()) as u32);
            self.enter(&mut delta, instance, first..first + 30);
        }
        // Blocks that the client is not told of, now and then of the same size.
        let (hidden_size, hidden) = (size(2 + self.dice.below(3) as u8), self.dice.below(6));
        let hidden: Vec<Block> = (0..hidden).filter_map(|_| self.atlas.allocate(hidden_size)).collect();
        let mut sizes = BTreeMap::new();
        for key in self.patches.keys() {
            if self.dice.once_in(6) {
                let [width_log2, height_log2] = [(); 2].map(|()| 2 + self.dice.below(3) as u8);
                let block = BlockSize { width_log2, height_log2 };
                sizes.insert(*key, (!self.dice.once_in(5)).then_some(block));
            }
        }
        self.place(&mut delta, &sizes);
        self.tell(&delta);
        hidden.into_iter().for_each(|block| self.atlas.free(block));
    }
}

#[test]
fn both_sides_stay_in_step_while_instances_come_and_go() {
    for seed in 0..20 {
        let mut herd = Herd::new(seed);
        (0..40).for_each(|_| herd.step());
        assert!(herd.encoder.memory == herd.decoder.memory, "seed {seed}");
    }
}

#[test]
fn corners_are_told_once_for_all_instances_of_a_mesh() {
    let mut herd = Herd::new(0);
    let first = herd.show(0, 2);
    assert!(first.of(Part::Corners) > u64::from(MESH) / 8, "{first:?}");
    let second = herd.show(1, 2);
    assert_eq!(second.of(Part::Corners), 0);
    assert!(second.total() < u64::from(MESH) / 8, "{second:?}: a bit a patch");
    // What has left is known still.
    let mut leaves = GeometryDelta::default();
    herd.leave(&mut leaves, 0);
    herd.tell(&leaves);
    assert_eq!(herd.show(0, 2).of(Part::Corners), 0);
}

#[test]
fn addresses_that_the_allocator_gives_take_a_fraction_of_a_bit() {
    let mut herd = Herd::new(0);
    herd.show(0, 2);
    let mut delta = GeometryDelta::default();
    herd.place(&mut delta, &(0..MESH).map(|number| ((0, number), Some(size(3)))).collect());
    let blocks = herd.tell(&delta).of(Part::Blocks);
    assert!(blocks < u64::from(MESH) / 16, "{blocks} bytes, addresses and sizes");
}

#[test]
fn blocks_unknown_to_the_client_are_skipped() {
    let mut herd = Herd::new(0);
    herd.show(0, 2);
    let hidden = (0..5).filter_map(|_| herd.atlas.allocate(size(3))).count();
    let blocks = herd.show(1, 3).of(Part::Blocks);
    assert!(hidden == 5 && blocks < u64::from(MESH) / 4, "{blocks} bytes");
}

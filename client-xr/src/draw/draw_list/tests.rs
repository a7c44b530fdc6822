//! Lists updated by differences, against newly made lists.

use super::*;
use rand::{Rng, SeedableRng, rngs::StdRng};
use shadecast_protocol::atlas::{Block, BlockAddress, BlockSize, PatchKind};
use shadecast_protocol::coverage::Coverage;
use shadecast_protocol::geometry::{self, NewPatch, NewVertex};
use shadecast_protocol::ids::{InstanceId, MeshId, UpdateId};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::PositionBatch;
use std::collections::BTreeMap;

const PATCHES: u32 = 300;
const VERTICES: u32 = 400;
const BUNDLES: usize = 3;

/// Vertices of which every third has samples.
fn motion() -> Motion {
    let mut motion = Motion::new(VERTICES, MotionMemory::DEFAULT.into());
    let vertex = |slot: u32| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(0),
        number: slot,
        motion: match slot % 3 {
            0 => geometry::Motion::Sampled,
            _ => geometry::Motion::Static { position: glam::Vec3::ZERO },
        },
    };
    let vertices: Vec<NewVertex> = (0..VERTICES).map(vertex).collect();
    motion.take(UpdateId(0), &vertices, Vec::new(), true);
    motion
}

fn new_patch(rng: &mut StdRng, slot: u32) -> NewPatch {
    let kind = [PatchKind::One, PatchKind::Two, PatchKind::Three][rng.random_range(0..3)];
    // Vertices of one third or the other: most patches wait for no samples.
    let waits = rng.random_range(0..5) == 0;
    let first = rng.random_range(0..VERTICES / 3 - 8) * 3;
    let vertex = |corner: u32| VertexSlot(first + corner * 3 + u32::from(!waits));
    let count = kind.vertex_count() as u32;
    let vertices = [0, 1, 2, 3, 4].map(|corner| vertex(if corner < count { corner } else { 0 }));
    NewPatch {
        slot: PatchSlot(slot),
        instance: InstanceId(0),
        mesh: MeshId(0),
        number: slot,
        kind,
        vertices,
        double_sided: rng.random(),
    }
}

fn block(rng: &mut StdRng) -> Block {
    let [x, y] = [0; 2].map(|_: u32| rng.random_range(0..200u16) * 4);
    Block { address: BlockAddress { page: 0, x, y }, size: BlockSize::new(2, 2).expect("a size") }
}

/// What a list shows at a time: of each patch that is drawn its corners' numbers, in the order of its indices.
fn shown(
    (corners, indices): (&[CornerGpu], &[u32]),
    ranges: [[u32; 2]; 2],
) -> [BTreeMap<usize, Vec<Vec<u8>>>; 2] {
    ranges.map(|[first, count]| {
        let mut patches = BTreeMap::<usize, Vec<Vec<u8>>>::new();
        let whole = indices[first as usize..][..count as usize].chunks(3).filter(|t| t[0] != t[1]);
        for triangle in whole {
            let of = patches.entry(triangle[0] as usize / MAX_CORNERS_PER_PATCH).or_default();
            let corner = |index: &u32| bytemuck::bytes_of(&corners[*index as usize]).to_vec();
            of.extend(triangle.iter().map(corner));
        }
        patches
    })
}

/// The same of patches as they are, made anew.
fn expected(patches: &Patches, motion: &Motion, step: GridIndex) -> [BTreeMap<usize, Vec<Vec<u8>>>; 2] {
    [false, true].map(|is_masked| {
        let drawn = patches.iter().filter(|(_, patch)| patch.block.is_some() && patch.is_masked == is_masked);
        let drawn =
            drawn.filter(|(_, patch)| motion.ready(&patch.vertices[..patch.kind.vertex_count()]) <= step);
        let of = |(slot, patch): (PatchSlot, &ResidentPatch)| {
            let corners = corners_of(patch);
            let corner = |index: &u32| bytemuck::bytes_of(&corners[*index as usize]).to_vec();
            (slot.index(), indices_of(patch, 0).iter().map(corner).collect())
        };
        drawn.map(of).collect()
    })
}

#[test]
fn an_updated_list_equals_a_new_one() {
    for seed in 0..12 {
        let mut rng = StdRng::seed_from_u64(seed);
        let (mut motion, mut patches) = (motion(), Patches::new(PATCHES));
        let mut newest = NewestList::new(PATCHES, BUNDLES, false);
        let (corners, indices) = (newest.corners.len(), newest.indices.len());
        let mut memory = vec![(vec![bytemuck::Zeroable::zeroed(); corners], vec![7; indices]); BUNDLES];
        let mut most = 0;
        for update in 0..150 {
            // Samples come, so that some patches can be drawn that could not be.
            let slot = VertexSlot(rng.random_range(0..VERTICES / 3) * 3);
            let positions = vec![(slot, glam::Vec3::ONE)];
            motion.take(
                UpdateId(update + 1),
                &[],
                vec![PositionBatch { grid: GridIndex(update as i32), positions }],
                true,
            );
            let mut changed = Vec::new();
            let busy = rng.random_range(0..4) == 0;
            for _ in 0..rng.random_range(0..if busy { 200 } else { 12 }) {
                let slot = PatchSlot(rng.random_range(0..PATCHES));
                match patches.get(slot).map(|patch| patch.block.is_some()) {
                    None => patches.insert(&[new_patch(&mut rng, slot.0)]).expect("free"),
                    Some(true) if rng.random() => patches.place(&[(slot, None)]).expect("there"),
                    Some(_) if rng.random_range(0..3) == 0 => {
                        patches.place(&[(slot, None)]).expect("there");
                        patches.evict(&[slot]).expect("there");
                    }
                    Some(_) => {
                        patches.place(&[(slot, Some(block(&mut rng)))]).expect("there");
                        if rng.random_range(0..4) == 0 {
                            let coverage = Coverage::from_fn(16, |texel| texel % 2 == 0);
                            patches.cover(&[(slot, coverage)]).expect("it has a block");
                        }
                    }
                }
                changed.push(slot);
            }
            newest.update(&patches, &changed, &mut motion);
            let bundle = rng.random_range(0..BUNDLES);
            let (corners, indices) = &mut memory[bundle];
            most = most.max(newest.copy_to(bundle, (corners, indices)));
            assert_eq!(newest.copy_to(bundle, (corners, indices)), 0, "nothing has changed since");
            for step in [GridIndex(i32::MIN), GridIndex(update as i32 / 2), GridIndex(i32::MAX - 1)] {
                let drawn = newest.list().at(step);
                let seen = shown((corners, indices), drawn.ranges());
                assert_eq!(seen, expected(&patches, &motion, step), "seed {seed}, update {update}, {step:?}");
            }
        }
        assert!(most > 0);
    }
}

/// What is copied to a bundle is what has changed since it was written last, in whole chunks.
#[test]
fn bytes_that_are_copied_follow_what_has_changed() {
    let mut rng = StdRng::seed_from_u64(1);
    let slots = 20_000;
    let (mut motion, mut patches) = (motion(), Patches::new(slots));
    let all: Vec<NewPatch> = (0..slots)
        .map(|slot| {
            let patch = new_patch(&mut rng, slot);
            NewPatch { vertices: patch.vertices.map(|vertex| VertexSlot(vertex.0 / 3 * 3 + 1)), ..patch }
        })
        .collect();
    patches.insert(&all).expect("free");
    let blocks: Vec<_> = all.iter().map(|patch| (patch.slot, Some(block(&mut rng)))).collect();
    patches.place(&blocks).expect("there");
    let mut newest = NewestList::new(slots, 1, false);
    let every: Vec<PatchSlot> = all.iter().map(|patch| patch.slot).collect();
    newest.update(&patches, &every, &mut motion);
    let mut memory = (newest.corners.clone(), newest.indices.clone());
    let whole = newest.copy_to(0, (&mut memory.0, &mut memory.1));
    let mut moved = |count: usize| {
        let moved: Vec<_> = (0..count).map(|number| (every[number * 7], Some(block(&mut rng)))).collect();
        patches.place(&moved).expect("there");
        let changed: Vec<PatchSlot> = moved.iter().map(|(slot, _)| *slot).collect();
        newest.update(&patches, &changed, &mut motion);
        newest.copy_to(0, (&mut memory.0, &mut memory.1))
    };
    assert_eq!(moved(0), 0);
    let (few, more) = (moved(20), moved(400));
    assert!(few > 0 && few < whole / 50, "{few} of {whole}");
    assert!(more > few && more < whole / 3, "{more} of {whole}");
}

/// By update: every block is new once, and kept from the next list on until it changes.
#[test]
fn a_block_is_kept_from_the_list_after_its_first_on() {
    let mut rng = StdRng::seed_from_u64(3);
    let (mut motion, mut patches) = (motion(), Patches::new(PATCHES));
    let mut newest = NewestList::new(PATCHES, 1, true);
    let mut memory: (Vec<CornerGpu>, Vec<u32>) =
        (vec![bytemuck::Zeroable::zeroed(); newest.corners.len()], vec![0; newest.indices.len()]);
    let (mut kept, mut new) = (0, 0);
    for _ in 0..200 {
        let mut changed = std::collections::BTreeSet::new();
        for _ in 0..rng.random_range(0..6) {
            let slot = PatchSlot(rng.random_range(0..PATCHES));
            match patches.get(slot).map(|patch| patch.block.is_some()) {
                None => patches.insert(&[new_patch(&mut rng, slot.0)]).expect("free"),
                Some(true) if rng.random() => patches.place(&[(slot, None)]).expect("there"),
                Some(_) => patches.place(&[(slot, Some(block(&mut rng)))]).expect("there"),
            }
            changed.insert(slot);
        }
        let list: Vec<_> = changed.iter().copied().collect();
        newest.update(&patches, &list, &mut motion);
        newest.copy_to(0, (&mut memory.0, &mut memory.1));
        for (slot, patch) in patches.iter().filter(|(_, patch)| patch.block.is_some()) {
            let corners = &memory.0[slot.index() * MAX_CORNERS_PER_PATCH..][..patch.kind.vertex_count()];
            let is_kept = !changed.contains(&slot);
            assert!(corners.iter().all(|corner| (corner.block[0] & IS_KEPT != 0) == is_kept), "{slot:?}");
            *if is_kept { &mut kept } else { &mut new } += 1;
        }
        assert_eq!(
            newest.has_fresh(),
            list.iter().any(|slot| patches.get(*slot).is_some_and(|p| p.block.is_some()))
        );
    }
    assert!(kept > 100 && new > 100, "{kept} kept, {new} new");
}

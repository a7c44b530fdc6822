use super::*;
use crate::motion::sampled::SampleWindow;
use crate::scene::numbering::SceneVertex;
use glam::Vec3;
use shadecast_protocol::atlas::{BlockSize, PatchKind};
use shadecast_protocol::delta::{Delta, DeltaDecoder};
use shadecast_protocol::ids::MeshId;
use shadecast_protocol::memory::ClientMemory;
use shadecast_protocol::time::{GridIndex, WorldTime};
use shadecast_scene::patches::Patch;
use std::collections::{BTreeMap, BTreeSet, HashMap};

const PATCHES: u32 = 400;
/// Patches and vertices.
const COUNTS: [u32; 2] = [PATCHES, 2 * (PATCHES + 2)];
const SEED: u64 = 23;

/// A strip of quads; the first half of the patches belongs to a static instance, the rest to a moving one.
struct Strip;

impl Geometry for Strip {
    fn instance_of_patch(&self, patch: ScenePatch) -> u16 {
        u16::from(patch.0 >= PATCHES / 2)
    }
    fn first_vertex(&self, instance: u16) -> SceneVertex {
        SceneVertex(u32::from(instance) * (PATCHES + 2))
    }
    fn mesh_of(&self, instance: u16) -> (MeshId, ScenePatch) {
        (MeshId(instance.into()), ScenePatch(u32::from(instance) * PATCHES / 2))
    }
    fn patch(&self, patch: ScenePatch) -> Patch {
        let v = 2 * (patch.0 % (PATCHES / 2));
        Patch {
            vertices: [v, v + 1, v + 3, v + 2, v],
            kind: PatchKind::Two,
            material: 0,
            double_sided: false,
        }
    }
    fn static_position(&self, vertex: SceneVertex) -> Option<Vec3> {
        (vertex.0 < PATCHES + 2).then(|| Vec3::new(vertex.0 as f32, 0.0, 0.0))
    }
    fn is_masked(&self, patch: ScenePatch) -> bool {
        patch.0.is_multiple_of(3)
    }
    fn vertex_count(&self) -> usize {
        2 * (PATCHES as usize + 2)
    }
}

fn position(grid: GridIndex, vertex: SceneVertex) -> Vec3 {
    Vec3::new(vertex.0 as f32 * 0.01, (grid.0 as f32 * 0.2).sin(), 1.0)
}

/// What a client is told: its memory, and of each vertex the samples.
struct Mirror {
    memory: ClientMemory,
    samples: HashMap<VertexSlot, BTreeSet<i32>>,
}

impl Mirror {
    fn apply(&mut self, Delta { geometry, samples, .. }: &Delta) {
        let entered = self.memory.apply(geometry).expect("what the server sends is valid");
        for slot in &geometry.evicted_vertices {
            let is_used = self.memory.patches().iter().any(|(_, patch)| patch.vertices.contains(slot));
            let is_given_anew = geometry.new_vertices.iter().any(|vertex| vertex.slot == *slot);
            assert!(!is_used || is_given_anew, "{slot:?} is still in use");
            self.samples.remove(slot);
        }
        entered.sampled.iter().for_each(|slot| drop(self.samples.insert(*slot, BTreeSet::new())));
        for batch in samples {
            for (slot, _) in &batch.values {
                self.samples.get_mut(slot).expect("an animated vertex").insert(batch.grid.0);
            }
        }
    }
}

fn change(patch: u32, block: Option<Block>) -> PlacementChange {
    PlacementChange { patch: ScenePatch(patch), block }
}

fn block(patch: u32) -> Option<Block> {
    Some(Block::unpack(patch % 64).expect("in the atlas"))
}

struct Run {
    residency: Residency,
    decoder: DeltaDecoder,
    mirror: Mirror,
    live: BTreeSet<u32>,
    random: u64,
    frame: u32,
}

impl Run {
    fn new() -> Self {
        Self {
            residency: Residency::new(COUNTS, 1024, 1024),
            decoder: DeltaDecoder::new(1024, 1024),
            mirror: Mirror { memory: ClientMemory::new(1024, 1024), samples: HashMap::new() },
            live: BTreeSet::new(),
            random: SEED,
            frame: 0,
        }
    }

    fn below(&mut self, n: u64) -> u64 {
        self.random = self.random.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.random >> 33) % n
    }

    /// Takes in what travels over the wire's coding.
    fn decode(&mut self, coded: &EncodedDelta) -> Delta {
        let decoded = self.decoder.decode(&coded.bytes).expect("what the server sends is valid");
        self.mirror.apply(&decoded);
        let coder = lock(self.residency.coder());
        assert!(self.mirror.memory == *coder.encoder().memory(), "seed {SEED}, frame {}", self.frame);
        decoded
    }

    /// Random patches come and go, then samples follow.
    fn step(&mut self) -> Delta {
        let mut changes: BTreeMap<u32, Option<Block>> = BTreeMap::new();
        for _ in 0..20 {
            let patch = self.below(u64::from(PATCHES)) as u32;
            let comes = self.live.insert(patch) || {
                self.live.remove(&patch);
                false
            };
            changes.insert(patch, if comes { block(patch) } else { None });
        }
        let changes: Vec<_> = changes.into_iter().map(|(patch, block)| change(patch, block)).collect();
        let delta = self.residency.update(&Strip, &changes, stamp(self.frame));
        let coded = self.residency.encode(&delta);
        let decoded = self.decode(&coded);
        assert_eq!(decoded.geometry, delta.geometry, "seed {SEED}, frame {}", self.frame);
        let now = GridIndex(self.frame as i32);
        let window = SampleWindow { first: now, oldest: now.plus(-5), horizon: now.plus(5) };
        let samples = lock(self.residency.coder()).samples(window, usize::MAX, position);
        samples.iter().for_each(|samples| drop(self.decode(samples)));
        self.frame += 1;
        decoded
    }
}

#[test]
fn the_client_holds_every_live_patch_with_its_block_and_vertices() {
    let mut run = Run::new();
    for _ in 0..200 {
        run.step();
        let patches = run.mirror.memory.patches();
        let blocks = patches.iter().filter(|(_, patch)| patch.block.is_some()).count();
        assert_eq!(blocks, run.live.len(), "seed {SEED}, frame {}", run.frame);
        for patch in &run.live {
            let slot = run.residency.slot_of_patch[*patch as usize];
            let lies_there = slot.and_then(|slot| patches.get(slot));
            let lies_there = lies_there.expect("the index says so");
            assert_eq!(
                lies_there.instance.0,
                Strip.instance_of_patch(ScenePatch(*patch)),
                "seed {SEED}: {patch}"
            );
            assert_eq!(lies_there.block, block(*patch), "seed {SEED}: {patch}");
        }
        run.residency.displayed(UpdateId(run.frame - 1));
    }
    assert_eq!(run.residency.waiting(), 0);
}

#[test]
fn coverage_is_sent_with_blocks_of_cutouts_only() {
    let mut residency = Residency::new(COUNTS, 8192, 8192);
    let all: Vec<_> = (0..30).map(|patch| change(patch, block(patch))).collect();
    for frame in 0..2 {
        let delta = residency.update(&Strip, &all, stamp(frame));
        let slot = |patch: u32| residency.slot_of_patch[patch as usize].expect("there is room");
        let cutouts = (0..30).filter(|patch| Strip.is_masked(ScenePatch(*patch)));
        let mut expected: Vec<_> =
            cutouts.map(|patch| (slot(patch), block(patch).expect("a block"))).collect();
        expected.sort_unstable();
        assert_eq!(delta.masked, expected, "update {frame}: new patches, then placements anew");
    }
}

#[test]
fn every_animated_vertex_has_all_samples_of_its_window() {
    let mut run = Run::new();
    for _ in 0..100 {
        run.step();
        let now = run.frame as i32 - 1;
        assert!(!run.mirror.samples.is_empty());
        for (slot, samples) in &run.mirror.samples {
            let complete = (now..=now + 5).all(|g| samples.contains(&g));
            assert!(complete, "seed {SEED}, frame {now}: {slot:?} has {samples:?}");
        }
        run.residency.displayed(UpdateId(run.frame - 1));
    }
}

#[test]
fn a_freed_slot_waits_for_the_display_of_its_update() {
    let mut run = Run::new();
    let mut freed: HashMap<VertexSlot, u32> = HashMap::new();
    let mut displayed = 0;
    for _ in 0..120 {
        let frame = run.frame;
        let delta = run.step().geometry;
        for vertex in &delta.new_vertices {
            let since = freed.remove(&vertex.slot);
            assert!(since.is_none_or(|since| since <= displayed), "frame {frame}: {:?}", vertex.slot);
        }
        freed.extend(delta.evicted_vertices.iter().map(|slot| (*slot, frame)));
        if frame % 7 == 6 {
            displayed = frame - 3;
            run.residency.displayed(UpdateId(displayed));
        }
    }
}

#[test]
fn deferred_patches_get_the_remaining_budget() {
    let mut residency = Residency::new(COUNTS, 1024, 1024);
    residency.put_behind((0..10).map(ScenePatch));
    let bytes = |patches: usize| patches * (PATCH_BYTES + 4 * STATIC_VERTEX_BYTES);
    residency.set_budget(Budget { geometry_bytes: bytes(14), ..Budget::UNLIMITED });
    let changes: Vec<_> = (0..20).map(|patch| change(2 * patch % 40, block(patch))).collect();
    let behind = changes.iter().filter(|change| change.patch.0 < 10).count();
    assert_eq!((behind, changes.len()), (5, 20));
    let first = residency.update(&Strip, &changes, stamp(0));
    assert_eq!((first.geometry.new_patches.len(), residency.held_back(), residency.waiting()), (14, 1, 0));
    assert!((0..10).all(|patch| residency.slot_of_patch[patch].is_none()));
    let mut brings = |update: u32| {
        let delta = residency.update(&Strip, &[], stamp(update));
        (delta.geometry.new_patches.len(), residency.held_back(), residency.waiting())
    };
    // 13 are left for them, of which they take a part.
    assert_eq!([brings(1), brings(2), brings(3)], [(1 + 3, 0, 0), (2, 0, 0), (0, 0, 0)]);
}

#[test]
fn what_is_put_behind_leaves_slots_free() {
    let mut residency = Residency::new(COUNTS, 64, 1024);
    let changes: Vec<_> = (0..80).map(|patch| change(patch, block(patch))).collect();
    residency.put_behind((0..80).map(ScenePatch));
    residency.update(&Strip, &changes, stamp(0));
    assert_eq!((residency.patch_slots.free.count(), residency.waiting()), (64 / AHEAD_WATER, 0));
}

#[test]
fn hidden_static_geometry_stays_and_returns_free() {
    let mut residency = Residency::new(COUNTS, 8192, 8192);
    let change = |block| [change(3, block)];
    residency.update(&Strip, &change(block(3)), stamp(0));
    let lost = residency.update(&Strip, &change(None), stamp(1)).geometry;
    assert!(lost.evicted_patches.is_empty() && lost.placements.len() == 1);
    let back = residency.update(&Strip, &change(block(3)), stamp(2)).geometry;
    assert!(back.new_patches.is_empty() && back.new_vertices.is_empty() && back.placements.len() == 1);
}

/// Steps that an instance is told on the way, and the largest distance of a decoded sample from where its vertex was, in steps.
fn walk(wanted_m: &[f32]) -> (Vec<f32>, f32) {
    let mut residency = Residency::new(COUNTS, 1024, 1024);
    let mut decoder = DeltaDecoder::new(1024, 1024);
    let (mut told_m, mut worst) = (Vec::new(), 0f32);
    for (frame, wanted_m) in (0..).zip(wanted_m) {
        residency.want_steps([*wanted_m; 2]);
        let changes = [change(210 + frame, block(3)), change(20, block(4))];
        let delta = residency.update(&Strip, &changes, stamp(frame));
        told_m.extend(delta.geometry.instances.iter().map(|info| info.step_m));
        assert!(delta.geometry.instances.iter().all(|info| info.instance == InstanceId(1)));
        decoder.decode(&residency.encode(&delta).bytes).expect("what the server sends is valid");
        let now = GridIndex(2 * frame as i32);
        let window = SampleWindow { first: now, oldest: now, horizon: now.plus(4) };
        let coded = lock(residency.coder()).samples(window, usize::MAX, position);
        let vertices: HashMap<VertexSlot, SceneVertex> = residency.moving().collect();
        for coded in coded {
            let received = decoder.receive(&coded.bytes).expect("what the server sends is valid");
            for (grid, (slot, shown)) in received
                .positions
                .iter()
                .flat_map(|batch| batch.positions.iter().map(move |position| (batch.grid, position)))
            {
                let error = (*shown - position(grid, vertices[slot])).abs().max_element();
                worst = worst.max(error / told_m.last().expect("told before its samples"));
            }
        }
    }
    (told_m, worst)
}

#[test]
fn samples_are_rounded_to_the_announced_step() {
    let (fine, usual) = (1.0 / 8192.0, 1.0 / 2048.0);
    let (told_m, worst) = walk(&[usual, usual, fine, fine, usual, usual * 0.9, fine]);
    assert_eq!(told_m, [usual, fine, usual, usual / 2.0, fine]);
    assert!((0.3..=0.51).contains(&worst), "{worst} steps");
}

fn stamp(frame: u32) -> UpdateStamp {
    UpdateStamp { update: UpdateId(frame), time: WorldTime(i64::from(frame) * 33) }
}

fn sized(patch: u32, log2: u8) -> PlacementChange {
    let size = BlockSize::new(log2, log2).expect("in range");
    change(patch, Some(Block { size, ..block(patch).expect("a block") }))
}

#[test]
fn a_full_client_memory_takes_the_largest_blocks() {
    let mut residency = Residency::new(COUNTS, 8, 8);
    let changes: Vec<_> = (0..50).map(|patch| sized(patch, if patch == 40 { 8 } else { 2 })).collect();
    let delta = residency.update(&Strip, &changes, stamp(0)).geometry;
    assert!(delta.new_vertices.len() <= 8 && residency.waiting() == 50 - delta.new_patches.len());
    assert!(residency.slot_of_patch[40].is_some(), "the largest is there");
    let gone: Vec<_> = changes.iter().map(|c| PlacementChange { block: None, ..*c }).collect();
    residency.update(&Strip, &gone, stamp(1));
    assert_eq!(residency.waiting(), 0, "what lost its block waits no longer");
}

#[test]
fn limited_updates_bring_the_largest_blocks_first() {
    let mut residency = Residency::new(COUNTS, 8192, 8192);
    let changes: Vec<_> = (0..PATCHES).map(|patch| sized(patch, if patch >= 390 { 8 } else { 2 })).collect();
    residency.set_budget(Budget { geometry_bytes: 1200, ..Budget::UNLIMITED });
    let first = residency.update(&Strip, &changes, stamp(0));
    let bytes = residency.encode(&first).bytes.len();
    let first = first.geometry;
    assert!(first.new_patches.len() >= 10 && residency.held_back() > 300 && residency.waiting() == 0);
    assert!((390..400).all(|patch| residency.slot_of_patch[patch].is_some()), "the largest are there");
    assert!(bytes < 2 * 1200);
    let mut updates = 1;
    while residency.held_back() > 0 {
        let next = residency.update(&Strip, &[], stamp(updates)).geometry;
        assert!(!next.new_patches.is_empty() && next.new_patches.len() == next.placements.len());
        updates += 1;
    }
    assert!((5..200).contains(&updates), "{updates}");
    assert!(residency.slot_of_patch.iter().all(Option::is_some));
}

#[test]
fn reserved_patches_come_with_the_next_update() {
    for (geometry_bytes, slots) in [(400, 8192), (usize::MAX, 60)] {
        let mut residency = Residency::new(COUNTS, slots, slots);
        residency.set_budget(Budget { geometry_bytes, ..Budget::UNLIMITED });
        let level = |first: u32, count: u32| (first..first + count).map(ScenePatch);
        let mut left = Allowance::default();
        residency.allow(&mut left);
        assert!(residency.reserve(&Strip, level(0, 12), &mut left));
        assert!(!residency.reserve(&Strip, level(20, 100), &mut left), "so many do not fit");
        assert!(residency.reserve(&Strip, level(140, 8), &mut left), "what was refused takes nothing");
        assert_eq!(residency.lacking(&level(0, 12).collect::<Vec<_>>()), 12);
        let changes: Vec<_> = (0..12).chain(140..148).map(|patch| sized(patch, 4)).collect();
        let delta = residency.update(&Strip, &changes, stamp(0)).geometry;
        assert_eq!((delta.new_patches.len(), delta.placements.len()), (20, 20));
        assert_eq!((residency.waiting(), residency.held_back()), (0, 0));
    }
}

#[test]
fn prefetched_patches_arrive_without_blocks_and_stay() {
    let mut residency = Residency::new(COUNTS, 1024, 1024);
    residency.set_budget(Budget { geometry_bytes: 200, ..Budget::UNLIMITED });
    let ahead: Vec<ScenePatch> = (0..60).map(ScenePatch).collect();
    let (mut updates, mut came) = (0, 0);
    while residency.lacking(&ahead) > 0 {
        residency.bring_ahead(&ahead);
        let delta = residency.update(&Strip, &[], stamp(updates)).geometry;
        assert!(delta.placements.is_empty() && delta.evicted_patches.is_empty());
        assert!(!delta.new_patches.is_empty(), "each update brings some");
        (came, updates) = (came + delta.new_patches.len(), updates + 1);
    }
    assert!(came == 60 && (3..30).contains(&updates), "{came} in {updates}");
    let mut left = Allowance::default();
    residency.allow(&mut left);
    assert!(residency.reserve(&Strip, ahead.iter().copied(), &mut left), "all is there");
    let changes: Vec<_> = (0..60).map(|patch| sized(patch, 2)).collect();
    let shown = residency.update(&Strip, &changes, stamp(updates)).geometry;
    assert!(shown.new_patches.is_empty() && shown.placements.len() == 60);
}

#[test]
fn a_pause_ends_with_the_samples_that_fit_the_budget() {
    let moving: Vec<_> = (200..400).map(|patch| sized(patch, 4)).collect();
    let after_a_pause = |budget_bytes| {
        let mut residency = Residency::new(COUNTS, 8192, 8192);
        let delta = residency.update(&Strip, &moving, stamp(0));
        let mut decoder = DeltaDecoder::new(8192, 8192);
        decoder.decode(&residency.encode(&delta).bytes).expect("what the server sends is valid");
        let mut sent = |window, budget_bytes| {
            let coded = lock(residency.coder()).samples(window, budget_bytes, position);
            let decoded = coded.iter().map(|coded| decoder.decode(&coded.bytes).expect("valid").samples);
            decoded.flatten().map(|batch| batch.grid.0).collect::<Vec<_>>()
        };
        let first = SampleWindow { first: GridIndex(0), oldest: GridIndex(0), horizon: GridIndex(3) };
        assert_eq!(sent(first, usize::MAX), [0, 1, 2, 3]);
        let later = SampleWindow { first: GridIndex(25), oldest: GridIndex(15), horizon: GridIndex(30) };
        sent(later, budget_bytes)
    };
    assert_eq!(after_a_pause(usize::MAX), (15..=30).collect::<Vec<_>>());
    assert_eq!(after_a_pause(100), [29, 30]);
    let step_bytes = (PATCHES as usize + 2) * 2;
    assert_eq!(after_a_pause(5 * step_bytes), [26, 27, 28, 29, 30]);
}

#[test]
fn waiting_patches_enter_as_soon_as_slots_are_free() {
    let mut residency = Residency::new(COUNTS, 8, 8);
    residency.update(&Strip, &[sized(0, 4), sized(1, 4), sized(2, 4)], stamp(0));
    residency.update(&Strip, &[sized(10, 4)], stamp(1));
    assert_eq!(residency.waiting(), 1, "three quads side by side take eight vertices");
    let lost = [0, 1, 2].map(|patch| change(patch, None));
    let mut came = residency.update(&Strip, &lost, stamp(2)).geometry;
    for frame in 3..8 {
        assert!(came.new_patches.is_empty() || frame > 3);
        residency.displayed(UpdateId(frame - 1));
        came = residency.update(&Strip, &[], stamp(frame)).geometry;
        if !came.new_patches.is_empty() {
            break;
        }
    }
    assert_eq!((came.new_patches.len(), came.placements.len(), residency.waiting()), (1, 1, 0));
}

//! A small server with a slot allocator, a network that reorders and drops, and a client that must always display exactly one
//! update.

use super::*;
use crate::draw::draw_list::{DrawList, Drawable, MAX_CORNERS_PER_PATCH, MAX_INDICES_PER_PATCH, NewestList};
use crate::draw::stages::atlas_draw::BUNDLES;
use crate::draw::stages::interpolate::{Interpolation, Slots, push};
use crate::motion::Motion;
use crate::motion::pace::{GridTime, Pace, Span};
use crate::motion::state::Motionless;
use glam::Vec3;
use shadecast_protocol::atlas::{BlockAddress, BlockSize, PatchKind, PixelTexels};
use shadecast_protocol::delta::ReceivedDelta;
use shadecast_protocol::geometry::{self, NewVertex};
use shadecast_protocol::ids::{InstanceId, MeshId, VertexSlot};
use shadecast_protocol::message::MotionMemory;
use shadecast_protocol::motion::PositionBatch;
use shadecast_protocol::time::{DEFAULT_GRID, GridIndex, ServerTime, WorldTime};
use shadecast_shaders::constants::IS_MASKED;
use shadecast_shaders::generated::CornerGpu;
use shadecast_shaders::records::tag;
use shadecast_shaders::twin::interpolate::VertexMemory;
use std::collections::BTreeMap;

const VERTEX_SLOTS: u32 = 40;
const PATCH_SLOTS: u32 = 12;
const INSTANCES: u16 = 3;

/// SplitMix64 (Steele, Lea and Flood 2014).
struct Dice(u64);

impl Dice {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, limit: u64) -> u64 {
        self.next() % limit
    }

    fn once_in(&mut self, times: u64) -> bool {
        self.below(times) == 0
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct ModelVertex {
    /// Unlike every other vertex that ever was; its x in the world.
    identity: i32,
    instance: u16,
    is_sampled: bool,
}

#[derive(Clone, Debug, PartialEq)]
struct ModelPatch {
    instance: u16,
    kind: PatchKind,
    slots: Vec<u32>,
    block: Option<Block>,
}

/// What should be seen: of each drawn patch its instance, its vertices' identities, its block's corner.
type Seen = Vec<(u32, Vec<i32>, [f32; 2])>;

#[derive(Default)]
struct Server {
    next_frame: u32,
    identities: i32,
    grid: i32,
    vertices: BTreeMap<u32, ModelVertex>,
    patches: BTreeMap<u32, ModelPatch>,
    /// Freed slots by the frame that freed them.
    freed_vertices: Vec<(u32, u32)>,
    freed_patches: Vec<(u32, u32)>,
    acknowledged: Option<u32>,
    seen_at: BTreeMap<u32, Seen>,
}

impl Server {
    fn free_slot(
        used: impl Fn(u32) -> bool,
        freed: &[(u32, u32)],
        slots: u32,
        acknowledged: Option<u32>,
    ) -> Option<u32> {
        let is_blocked = |slot| {
            freed
                .iter()
                .any(|(frame, freed)| *freed == slot && acknowledged.is_none_or(|shown| shown < *frame))
        };
        (0..slots).find(|slot| !used(*slot) && !is_blocked(*slot))
    }

    fn update(&mut self, dice: &mut Dice) -> ReceivedDelta {
        let frame = self.next_frame;
        self.next_frame += 1;
        let mut delta = GeometryDelta { update: UpdateId(frame), ..GeometryDelta::default() };
        self.evict(dice, &mut delta);
        self.grid += 1;
        let entering = (0..dice.below(3)).filter_map(|_| self.enter(dice, &mut delta)).collect::<Vec<_>>();
        self.place(dice, &mut delta);
        let positions = self.sample(&entering.concat());
        self.seen_at.insert(frame, self.seen());
        ReceivedDelta { geometry: delta, is_update: true, positions, rests: Vec::new() }
    }

    fn evict(&mut self, dice: &mut Dice, delta: &mut GeometryDelta) {
        let leaving: Vec<_> = self.patches.keys().copied().filter(|_| dice.once_in(5)).collect();
        for slot in leaving {
            self.patches.remove(&slot);
            self.freed_patches.push((delta.update.0, slot));
            delta.evicted_patches.push(PatchSlot(slot));
        }
        let is_used = |slot: &u32| self.patches.values().any(|patch| patch.slots.contains(slot));
        let idle: Vec<_> = self.vertices.keys().copied().filter(|slot| !is_used(slot)).collect();
        for slot in idle {
            self.vertices.remove(&slot);
            self.freed_vertices.push((delta.update.0, slot));
            delta.evicted_vertices.push(VertexSlot(slot));
        }
    }

    /// A patch with new vertices enters. Gives their slots.
    fn enter(&mut self, dice: &mut Dice, delta: &mut GeometryDelta) -> Option<Vec<u32>> {
        let known = |slot| self.patches.contains_key(&slot);
        let patch_slot = Self::free_slot(known, &self.freed_patches, PATCH_SLOTS, self.acknowledged)?;
        let kind = PatchKind::ALL[dice.below(3) as usize];
        let instance = dice.below(u64::from(INSTANCES)) as u16;
        let mut slots = Vec::new();
        for _ in 0..kind.vertex_count() {
            let used = |slot| self.vertices.contains_key(&slot) || slots.contains(&slot);
            slots.push(Self::free_slot(used, &self.freed_vertices, VERTEX_SLOTS, self.acknowledged)?);
        }
        for slot in &slots {
            self.identities += 1;
            let vertex = ModelVertex { identity: self.identities, instance, is_sampled: instance == 0 };
            self.vertices.insert(*slot, vertex);
            let motion = match vertex.is_sampled {
                true => geometry::Motion::Sampled,
                false => geometry::Motion::Static { position: Vec3::new(self.identities as f32, 0.0, 0.0) },
            };
            delta.new_vertices.push(NewVertex {
                slot: VertexSlot(*slot),
                instance: InstanceId(instance),
                number: *slot,
                motion,
            });
        }
        let vertices = std::array::from_fn(|i| VertexSlot(*slots.get(i).unwrap_or(&slots[0])));
        let new = NewPatch {
            slot: PatchSlot(patch_slot),
            instance: InstanceId(instance),
            mesh: MeshId(0),
            number: patch_slot,
            kind,
            vertices,
            double_sided: false,
        };
        delta.new_patches.push(new);
        self.patches.insert(patch_slot, ModelPatch { instance, kind, slots: slots.clone(), block: None });
        Some(slots)
    }

    fn place(&mut self, dice: &mut Dice, delta: &mut GeometryDelta) {
        for (slot, patch) in &mut self.patches {
            if patch.block.is_none() || dice.once_in(4) {
                let address =
                    BlockAddress { page: 0, x: dice.below(64) as u16 * 4, y: dice.below(64) as u16 * 4 };
                let size = BlockSize::new(2, 3).expect("a size");
                patch.block = (!dice.once_in(6)).then_some(Block { address, size });
                delta.placements.push((PatchSlot(*slot), patch.block));
            }
        }
    }

    /// Every animated vertex gets the next step; one that enters gets the three before it too.
    fn sample(&self, entering: &[u32]) -> Vec<PositionBatch> {
        let batch = |grid: i32| {
            let sampled = self.vertices.iter().filter(|(_, vertex)| vertex.is_sampled);
            let due = sampled.filter(|(slot, _)| grid == self.grid || entering.contains(slot));
            let position = |v: &ModelVertex| Vec3::new(v.identity as f32, grid as f32, 0.0);
            let positions = due.map(|(slot, v)| (VertexSlot(*slot), position(v))).collect();
            PositionBatch { grid: GridIndex(grid), positions }
        };
        (self.grid - 3..=self.grid).map(batch).collect()
    }

    fn seen(&self) -> Seen {
        let placed = self.patches.values().filter_map(|patch| Some((patch, patch.block?)));
        let mut seen: Seen = placed
            .map(|(patch, block)| {
                let identities = patch.slots.iter().map(|slot| self.vertices[slot].identity).collect();
                let [left, top, _, _] = block.lookup_rect_texels();
                (u32::from(patch.instance), identities, [left, top])
            })
            .collect();
        seen.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
        seen
    }
}

/// Of a list.
const INDICES: u32 = PATCH_SLOTS * MAX_INDICES_PER_PATCH as u32;

struct Bench {
    seed: u64,
    bundler: Bundler<u32>,
    motion: Motion,
    memory: VertexMemory,
    /// The same memory, with positions at the times of display.
    moved: VertexMemory,
    pace: Pace,
    now: WorldTime,
    frozen_frames: usize,
    /// Of the bundle on display.
    corners: Vec<CornerGpu>,
    indices: Vec<u32>,
    list: DrawList,
    newest: NewestList,
    /// The memory of bundles that are not on display.
    others: Vec<(Vec<CornerGpu>, Vec<u32>)>,
    /// Which bundle is on display.
    bundle: usize,
    ready: GridIndex,
}

impl Bench {
    /// Seeds have rings of different lengths.
    fn new(seed: u64) -> Self {
        let sample_ring = [32, 8, 64][seed as usize % 3];
        Self {
            seed,
            bundler: Bundler::new(PATCH_SLOTS, AtlasExtent::DEFAULT),
            motion: Motion::new(VERTEX_SLOTS, MotionMemory { sample_ring, ..MotionMemory::NONE }.into()),
            memory: VertexMemory::new(VERTEX_SLOTS, sample_ring),
            moved: VertexMemory::new(VERTEX_SLOTS, sample_ring),
            pace: Pace::default(),
            now: WorldTime(i64::MIN),
            frozen_frames: 0,
            corners: vec![bytemuck::Zeroable::zeroed(); PATCH_SLOTS as usize * MAX_CORNERS_PER_PATCH],
            indices: vec![0; PATCH_SLOTS as usize * MAX_INDICES_PER_PATCH],
            list: DrawList::of_capacity(PATCH_SLOTS),
            newest: NewestList::new(PATCH_SLOTS, BUNDLES, false),
            others: vec![
                (
                    vec![bytemuck::Zeroable::zeroed(); PATCH_SLOTS as usize * MAX_CORNERS_PER_PATCH],
                    vec![0; PATCH_SLOTS as usize * MAX_INDICES_PER_PATCH]
                );
                BUNDLES
            ],
            bundle: 0,
            ready: GridIndex(i32::MIN),
        }
    }

    fn add_delta(&mut self, mut delta: ReceivedDelta) {
        self.motion.take_delta(&mut delta);
        self.bundler.add_delta(delta.geometry);
    }

    /// One display frame with room for `records` vertex records. Gives the frame on display.
    fn display(&mut self, records: usize, grid: i32) -> Option<UpdateId> {
        let mut staging = vec![bytemuck::Zeroable::zeroed(); records];
        let mut ranges = Vec::new();
        self.motion.writes().drain_into(&mut staging, |range| ranges.push(range));
        for range in ranges {
            let range = range.start as usize..range.end as usize;
            self.memory.scatter(&staging[range.clone()]);
            self.moved.scatter(&staging[range]);
        }
        let complete = self.motion.complete();
        let newest = complete.and_then(|complete| self.bundler.take_newest_complete(complete, |_| {}));
        if let Some((frame, picture)) = newest {
            assert_eq!(frame.0, picture, "seed {}: the picture of another frame", self.seed);
            let (changed, patches) = self.bundler.take_changed();
            self.newest.update(patches, changed.as_slice(), &mut self.motion);
            // Any bundle may be free: its memory is of some update before.
            self.others[self.bundle] = (std::mem::take(&mut self.corners), std::mem::take(&mut self.indices));
            self.bundle = (self.bundle + 1 + frame.0 as usize % 2) % BUNDLES;
            (self.corners, self.indices) = std::mem::take(&mut self.others[self.bundle]);
            self.newest.copy_to(self.bundle, (&mut self.corners, &mut self.indices));
            self.list.copy(self.newest.list());
            self.ready = self.list.ready_at(GridIndex(grid));
        }
        assert_eq!(self.motion.take_contradiction(), None, "seed {}", self.seed);
        self.bundler.current
    }

    /// The same with vertices moved to a time within step `grid`, as the scene does it.
    fn display_moving(&mut self, records: usize, grid: i32, fraction: f64) -> Option<UpdateId> {
        let before = self.bundler.current;
        let shown = self.display(records, grid)?;
        let into_step_ns = (fraction * DEFAULT_GRID.spacing_ns as f64) as i64;
        self.now = self.now.max(DEFAULT_GRID.time_of(GridIndex(grid)).plus_ns(into_step_ns));
        let now = (ServerTime(self.now.0), self.now);
        let Span { first, last } = self.motion.state().span;
        let (span, has_switched) = (Span { first: first.max(self.ready), last }, before != Some(shown));
        let evaluation = self.pace.advance(DEFAULT_GRID, now, span, has_switched);
        let step = GridTime::of(DEFAULT_GRID, self.pace.shown().expect("shown")).step;
        self.ready = if has_switched { self.list.ready_at(step) } else { self.ready };
        self.frozen_frames += usize::from(evaluation.is_none());
        if let Some(evaluation) = evaluation {
            let (vertex_slots, sample_ring) = (VERTEX_SLOTS, self.moved.sample_ring);
            let slots = Slots { vertex_count: VERTEX_SLOTS, vertex_slots, sample_ring };
            self.moved.interpolate(&push(DEFAULT_GRID, evaluation, slots, Interpolation::Cubic));
        }
        self.assert_whole();
        Some(shown)
    }

    /// Every vertex drawn has a position that is a number, and those of a triangle are of one time: y is the grid step.
    #[track_caller]
    fn assert_whole(&self) {
        let step = GridTime::of(DEFAULT_GRID, self.pace.shown().expect("shown")).step;
        for triangle in self.triangles(self.list.at(step)) {
            let slots = [0, 1, 2].map(|i| self.corners[triangle[i] as usize].vertex_slot as usize);
            let positions = slots.map(|slot| self.moved.positions[slot]);
            let drawable = positions.iter().all(|p| p[3] > 0.0 && p.iter().all(|c| c.is_finite()));
            assert!(drawable, "seed {}: {slots:?} at {positions:?}", self.seed);
            let is_sampled = |slot: usize| self.moved.blends[slot][3] >= 0.0;
            let steps = slots.iter().zip(positions).filter(|(slot, _)| is_sampled(**slot)).map(|(_, p)| p[1]);
            let [low, high] = steps.fold([f32::MAX, f32::MIN], |[l, h], y| [l.min(y), h.max(y)]);
            assert!(high - low < 1e-2 || high < low, "seed {}: torn from {low} to {high}", self.seed);
        }
    }

    /// The triangles of a part of the list, without those that stand for holes.
    fn triangles(&self, drawn: Drawable) -> impl Iterator<Item = &[u32]> {
        let ranges = drawn.ranges().map(|[first, count]| &self.indices[first as usize..][..count as usize]);
        ranges.into_iter().flat_map(|indices| indices.chunks(3)).filter(|triangle| triangle[0] != triangle[1])
    }

    /// What the draw list shows, by what the vertex memory holds now.
    fn seen(&self) -> Seen {
        let mut ends = BTreeMap::<usize, usize>::new();
        for index in self.triangles(self.list.at(GridIndex(i32::MAX))).flatten() {
            let end = ends.entry(*index as usize / MAX_CORNERS_PER_PATCH).or_default();
            *end = (*end).max(*index as usize + 1);
        }
        let of = |(slot, end): (usize, usize)| {
            let corners = &self.corners[slot * MAX_CORNERS_PER_PATCH..end];
            let identities = corners.iter().map(|corner| self.identity(corner.vertex_slot)).collect();
            (corners[0].instance, identities, corners[0].atlas_texel)
        };
        let mut seen: Seen = ends.into_iter().map(of).collect();
        seen.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
        seen
    }

    /// The identity that the vertex memory gives a slot.
    fn identity(&self, slot: u32) -> i32 {
        let [x, _, _, state] = self.memory.positions[slot as usize];
        if state != 0.0 {
            return x as i32;
        }
        let ring = (0..self.memory.sample_ring)
            .map(|ring| self.memory.samples[(ring * VERTEX_SLOTS + slot) as usize]);
        let mut known: Vec<_> = ring.filter(|sample| sample[3] != 0).collect();
        known.sort_by_key(|sample| sample[3]);
        known.dedup_by_key(|sample| sample[0]);
        assert_eq!(known.len(), 1, "seed {}: slot {slot} mixes vertices: {known:?}", self.seed);
        f32::from_bits(known[0][0]) as i32
    }
}

/// Deltas in order, pictures in any order and with losses, display frames in between. Gives the patches seen, summed over
/// display frames.
fn run(seed: u64) -> usize {
    let (mut dice, mut server, mut bench) = (Dice(seed), Server::default(), Bench::new(seed));
    let mut deltas = VecDeque::new();
    let mut pictures = Vec::new();
    let mut patches_seen = 0;
    for _ in 0..400 {
        match dice.below(5) {
            0 => {
                let delta = server.update(&mut dice);
                pictures.push(delta.geometry.update);
                deltas.push_back(delta);
            }
            1 | 2 => deltas.pop_front().into_iter().for_each(|delta| bench.add_delta(delta)),
            3 if !pictures.is_empty() => {
                let frame = pictures.swap_remove(dice.below(pictures.len() as u64) as usize);
                if !dice.once_in(4) {
                    bench.bundler.add_picture(frame, frame.0);
                }
            }
            _ => {
                let records = 1 + dice.below(40) as usize;
                check(&mut bench, &mut server, records);
                patches_seen += bench.seen().len();
            }
        }
    }
    deltas.into_iter().for_each(|delta| bench.add_delta(delta));
    let last = server.update(&mut dice);
    let frame = last.geometry.update;
    bench.add_delta(last);
    bench.bundler.add_picture(frame, frame.0);
    assert_eq!(
        check(&mut bench, &mut server, 100_000),
        Some(frame),
        "seed {seed}: the newest wins in the end"
    );
    patches_seen
}

fn check(bench: &mut Bench, server: &mut Server, records: usize) -> Option<UpdateId> {
    let before = bench.bundler.current;
    let shown = bench.display(records, server.grid);
    assert!(shown >= before, "seed {}: back from {before:?} to {shown:?}", bench.seed);
    if let Some(frame) = shown {
        assert_eq!(bench.seen(), server.seen_at[&frame.0], "seed {}, frame {}", bench.seed, frame.0);
        server.acknowledged = Some(frame.0);
    }
    shown
}

/// Updates at a tenth of the display's rate, pictures that come late or never: the draw list on display is older than the
/// samples, and some of its vertices get none any more. Gives the frames that stood still.
fn run_slowly(seed: u64) -> usize {
    let (mut dice, mut server, mut bench) = (Dice(seed), Server::default(), Bench::new(seed));
    let mut pictures = VecDeque::new();
    for frame in 0..400 {
        if frame % 10 == 0 {
            let delta = server.update(&mut dice);
            pictures.push_back((frame + dice.below(25), delta.geometry.update));
            bench.add_delta(delta);
        }
        while pictures.front().is_some_and(|(at, _)| *at <= frame) {
            let (_, id) = pictures.pop_front().expect("there is one");
            if !dice.once_in(4) {
                bench.bundler.add_picture(id, id.0);
            }
        }
        // The newest samples reach a step beyond the display.
        let (step, fraction) = (frame as i32 / 10, (frame % 10) as f64 / 10.0);
        server.acknowledged = bench.display_moving(1000, step, fraction).map(|frame| frame.0);
    }
    bench.frozen_frames
}

#[test]
fn no_triangle_has_corners_of_two_times() {
    let frozen: usize = (0..200).map(run_slowly).sum();
    assert!(frozen > 1000, "{frozen}: samples never ran short");
}

#[test]
fn a_slot_given_anew_while_it_is_on_display_is_told() {
    let mut bench = Bench::new(0);
    bench.add_delta(triangle(0, 0..=4));
    bench.bundler.add_picture(UpdateId(0), 0);
    bench.display(100, 1);
    bench.add_delta(triangle(1, 0..=4));
    assert_eq!(bench.motion.take_contradiction(), Some(VertexSlot(0)));
}

#[test]
fn waiting_patch_changes_are_bounded() {
    let mut bundler = Bundler::<u32>::new(DEFAULT_PATCH_SLOTS, AtlasExtent::DEFAULT);
    let all = || (0..DEFAULT_PATCH_SLOTS).map(PatchSlot);
    let enters = |slot| NewPatch { slot, ..one_triangle() };
    bundler.add_delta(GeometryDelta { new_patches: all().map(enters).collect(), ..delta(0).geometry });
    let placements: Vec<_> = all().map(|slot| (slot, None)).collect();
    for frame in 1..20 {
        bundler.add_delta(GeometryDelta { placements: placements.clone(), ..delta(frame).geometry });
        assert!(bundler.pending_records <= MAX_PENDING_RECORDS, "{}", bundler.pending_records);
    }
    assert!(bundler.pending.len() >= 3);
}

#[test]
fn a_drawn_bundle_is_always_one_update() {
    let patches_seen: usize = (0..300).map(run).sum();
    assert!(patches_seen > 50_000, "{patches_seen}: the scenes are too empty to show anything");
}

fn delta(frame: u32) -> ReceivedDelta {
    let geometry = GeometryDelta { update: UpdateId(frame), ..GeometryDelta::default() };
    ReceivedDelta { geometry, is_update: true, ..ReceivedDelta::default() }
}

/// A patch of sampled vertices 0, 1, 2.
fn one_triangle() -> NewPatch {
    NewPatch {
        slot: PatchSlot(0),
        instance: InstanceId(0),
        mesh: MeshId(0),
        number: 0,
        kind: PatchKind::One,
        vertices: [0, 1, 2, 0, 0].map(VertexSlot),
        double_sided: false,
    }
}

/// The same, placed, with its vertices.
fn triangle(frame: u32, steps: std::ops::RangeInclusive<i32>) -> ReceivedDelta {
    let vertex = |slot| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(0),
        number: slot,
        motion: geometry::Motion::Sampled,
    };
    let block =
        Block { address: BlockAddress { page: 0, x: 8, y: 4 }, size: BlockSize::new(3, 2).expect("a size") };
    let batch = |grid| PositionBatch {
        grid: GridIndex(grid),
        positions: (0..3).map(|slot| (VertexSlot(slot), Vec3::new(0.5, 1.0, 1.5))).collect(),
    };
    let geometry = GeometryDelta {
        new_vertices: (0..3).map(vertex).collect(),
        new_patches: vec![one_triangle()],
        placements: vec![(PatchSlot(0), Some(block))],
        ..delta(frame).geometry
    };
    ReceivedDelta { geometry, is_update: true, positions: steps.map(batch).collect(), rests: Vec::new() }
}

#[test]
fn neither_picture_nor_delta_is_drawn_alone() {
    let mut bench = Bench::new(0);
    bench.bundler.add_picture(UpdateId(0), 0);
    assert_eq!(bench.display(100, 0), None);
    bench.add_delta(delta(0));
    bench.add_delta(delta(1));
    assert_eq!(bench.display(100, 0), Some(UpdateId(0)));
    assert_eq!(bench.display(100, 0), Some(UpdateId(0)), "frame 1 has no picture");
    bench.bundler.add_picture(UpdateId(1), 1);
    assert_eq!(bench.display(100, 0), Some(UpdateId(1)));
}

#[test]
fn a_picture_older_than_the_displayed_is_returned() {
    let mut bench = Bench::new(0);
    (0..2).for_each(|frame| bench.add_delta(delta(frame)));
    assert_eq!(bench.bundler.add_picture(UpdateId(1), 1), None);
    bench.display(100, 0);
    assert_eq!(bench.bundler.add_picture(UpdateId(0), 0), Some(0));
}

#[test]
fn corners_lie_in_the_blocks_lookup_rectangle() {
    let mut bench = Bench::new(0);
    bench.add_delta(triangle(0, 0..=4));
    bench.bundler.add_picture(UpdateId(0), 0);
    bench.display(100, 1);
    let drawn = bench.list.at(GridIndex(1));
    assert_eq!((drawn.ranges(), drawn.withheld_patches), ([[0, 3], [INDICES, 0]], 0));
    let texels: Vec<_> = bench.corners[..3].iter().map(|corner| corner.atlas_texel).collect();
    assert_eq!(texels, [[8.5, 4.5], [15.5, 4.5], [8.5, 7.5]]);
    assert_eq!(bench.indices[..3], [0, 1, 2]);
    assert_eq!(bench.corners[2].vertex_slot, 2);
}

/// The triangle with every second texel of its block, or all of them.
fn cutout(frame: u32, is_covered: fn(u32) -> bool) -> ReceivedDelta {
    let mut delta = triangle(frame, 0..=4);
    delta.geometry.coverage = vec![(PatchSlot(0), Coverage::from_fn(32, is_covered))];
    delta
}

#[test]
fn coverage_comes_on_display_with_its_updates_picture() {
    let mut bench = Bench::new(0);
    bench.add_delta(cutout(0, |texel| texel % 2 == 0));
    assert!(bench.bundler.coverage().words().is_empty(), "the picture is on its way");
    bench.bundler.add_picture(UpdateId(0), 0);
    bench.display(100, 1);
    let extent = AtlasExtent::DEFAULT;
    let bit = |bundler: &Bundler<u32>, x: u32, y: u32| {
        let at = y * extent.width() + x;
        bundler.coverage().words()[1 + at as usize / 32] >> (at % 32) & 1
    };
    assert_eq!(bench.bundler.coverage().words()[0], extent.width());
    let row: Vec<u32> = (7..17).map(|x| bit(&bench.bundler, x, 5)).collect();
    assert_eq!(row, [0, 1, 0, 1, 0, 1, 0, 1, 0, 0], "the block begins at texel 8");
    let moved = triangle(1, 0..=0).geometry.placements;
    let coverage = vec![(PatchSlot(0), Coverage::from_fn(32, |_| false))];
    let next = GeometryDelta { placements: moved, coverage, ..delta(1).geometry };
    bench.add_delta(ReceivedDelta { geometry: next, is_update: true, ..ReceivedDelta::default() });
    bench.display(100, 1);
    assert_eq!(bit(&bench.bundler, 8, 5), 1, "the next picture is on its way");
    bench.bundler.add_picture(UpdateId(1), 1);
    bench.display(100, 1);
    assert_eq!(bit(&bench.bundler, 8, 5), 0);
}

#[test]
fn cutouts_are_drawn_last_by_the_pipeline_that_discards() {
    let mut bench = Bench::new(0);
    bench.add_delta(triangle(0, 0..=4));
    bench.bundler.add_picture(UpdateId(0), 0);
    bench.display(100, 1);
    assert_eq!((bench.list.at(GridIndex(1)).opaque, bench.corners[0].block[0] & IS_MASKED), (3, 0));
    let mut bench = Bench::new(0);
    let mut both = cutout(0, |texel| texel > 3);
    both.geometry.new_patches.push(NewPatch { slot: PatchSlot(1), ..one_triangle() });
    let block = both.geometry.placements[0].1;
    both.geometry.placements.push((PatchSlot(1), block));
    bench.add_delta(both);
    bench.bundler.add_picture(UpdateId(0), 0);
    bench.display(100, 1);
    let drawn = bench.list.at(GridIndex(1));
    assert_eq!((drawn.opaque, drawn.cutouts), (3, [INDICES - 3, 3]));
    let masked = |index: u32| bench.corners[bench.indices[index as usize] as usize].block[0] & IS_MASKED != 0;
    assert_eq!([0, 1, 2].map(masked), [false; 3]);
    assert_eq!([3, 2, 1].map(|back| masked(INDICES - back)), [true; 3]);
}

#[test]
fn an_update_that_changes_no_patch_leaves_lists_as_they_are() {
    let mut bench = Bench::new(0);
    let mut show = |delta: ReceivedDelta| {
        let update = delta.geometry.update;
        bench.add_delta(delta);
        bench.bundler.add_picture(update, update.0);
        assert_eq!(bench.display(100, 1), Some(update));
        (bench.bundler.revision(), bench.list.waits())
    };
    let (first, waits) = show(cutout(0, |texel| texel % 2 == 0));
    assert!(waits, "its vertices have samples");
    assert_eq!(show(delta(1)).0, first);
    let moved = triangle(2, 0..=0).geometry.placements;
    let moved = GeometryDelta { placements: moved, ..delta(2).geometry };
    let moved = ReceivedDelta { geometry: moved, is_update: true, ..ReceivedDelta::default() };
    let (second, _) = show(moved);
    assert_eq!(second, Revision { patches: first.patches + 1, ..first });
    assert_eq!(first, Revision { patches: 1, coverage: 1 });
}

#[test]
fn samples_are_in_metres_and_count_before_the_picture_is_there() {
    let mut bench = Bench::new(0);
    bench.add_delta(triangle(0, 0..=4));
    bench.display(100, 0);
    let [x, y, z, known] = bench.memory.samples[(4 * VERTEX_SLOTS) as usize];
    assert_eq!(([x, y, z].map(f32::from_bits), known), ([0.5, 1.0, 1.5], tag(GridIndex(4))));
}

#[test]
fn a_patch_waits_for_a_step_of_all_its_vertices() {
    let mut bench = Bench::new(0);
    bench.add_delta(triangle(0, 5..=8));
    bench.bundler.add_picture(UpdateId(0), 0);
    bench.display(100, 3);
    let at = |step| {
        let drawn = bench.list.at(GridIndex(step));
        (drawn.opaque, drawn.withheld_patches)
    };
    assert_eq!([at(4), at(5)], [(0, 1), (3, 0)]);
}

#[test]
fn vertices_past_their_last_sample_freeze_after_one_step() {
    let mut bench = Bench::new(0);
    bench.add_delta(triangle(0, 0..=4));
    bench.bundler.add_picture(UpdateId(0), 0);
    bench.display(100, 0);
    let state = bench.motion.state();
    let at = |step| state.motionless(DEFAULT_GRID, DEFAULT_GRID.time_of(GridIndex(step)));
    assert_eq!(at(3), Motionless::default());
    assert_eq!(at(4), Motionless { held: 3, frozen: 0 });
    assert_eq!(at(5), Motionless { held: 0, frozen: 3 });
}

#[test]
fn pictures_that_never_come_do_not_pile_up_deltas() {
    let mut bench = Bench::new(0);
    (0..1000).for_each(|frame| bench.add_delta(delta(frame)));
    assert!(bench.bundler.pending.len() <= MAX_PENDING);
    bench.bundler.add_picture(UpdateId(1), 1);
    assert_eq!(bench.display(100, 0), None, "too late for it");
    bench.bundler.add_picture(UpdateId(999), 999);
    assert_eq!(bench.display(100, 0), Some(UpdateId(999)));
}

#[test]
fn a_bundle_waits_until_its_vertices_are_in_the_gpus_memory() {
    let mut bench = Bench::new(0);
    bench.add_delta(triangle(0, 0..=4));
    bench.bundler.add_picture(UpdateId(0), 0);
    assert_eq!(bench.display(10, 0), None);
    assert_eq!(bench.display(10, 0), Some(UpdateId(0)), "3 entries and 15 samples");
}

#[test]
fn a_picture_that_is_there_before_its_vertices_waits_for_them() {
    let mut bundler = Bundler::<u32>::new(PATCH_SLOTS, AtlasExtent::DEFAULT);
    let take = |bundler: &mut Bundler<u32>, complete: u32| {
        bundler.take_newest_complete(UpdateId(complete), |picture| panic!("{picture} is dropped"))
    };
    let delta = |update| GeometryDelta { update: UpdateId(update), ..GeometryDelta::default() };
    bundler.add_delta(delta(0));
    bundler.add_picture(UpdateId(0), 7);
    assert_eq!(take(&mut bundler, 0), Some((UpdateId(0), 7)));
    bundler.add_delta(delta(1));
    bundler.add_picture(UpdateId(1), 8);
    assert_eq!([take(&mut bundler, 0), take(&mut bundler, 0)], [None, None]);
    assert_eq!(take(&mut bundler, 1), Some((UpdateId(1), 8)));
}

/// The triangle's block settles with an update, at the same place in page 1.
fn settling(frame: u32) -> GeometryDelta {
    let address = BlockAddress { page: 1, x: 8, y: 4 };
    let to = Block { address, size: BlockSize::new(3, 2).expect("a size") };
    let settled = vec![Settled { slot: PatchSlot(0), to, pixel: PixelTexels::new([2.0, 4.0]) }];
    GeometryDelta { settled, ..delta(frame).geometry }
}

/// Takes what is complete, and gives the updates taken and dropped, with the number of blocks that settle.
fn take_all(bundler: &mut Bundler<u32>) -> (Vec<(u32, usize)>, Vec<u32>) {
    let (mut taken, mut dropped) = (Vec::new(), Vec::new());
    while let Some((update, _)) = bundler.take_newest_complete(UpdateId(100), |picture| dropped.push(picture))
    {
        taken.push((update.0, bundler.settled().len()));
    }
    (taken, dropped)
}

#[test]
fn no_picture_with_settled_blocks_is_passed_over() {
    let mut bundler = Bundler::new(PATCH_SLOTS, AtlasExtent::DEFAULT);
    bundler.add_delta(triangle(0, 0..=4).geometry);
    [delta(1).geometry, settling(2), delta(3).geometry]
        .into_iter()
        .for_each(|delta| bundler.add_delta(delta));
    (1..4).for_each(|update| assert_eq!(bundler.add_picture(UpdateId(update), update), None));
    assert!(bundler.has_complete(UpdateId(1)) && !bundler.has_complete(UpdateId(0)));
    assert_eq!(take_all(&mut bundler), (vec![(2, 1), (3, 0)], vec![1]));
    assert_eq!(bundler.take_unsettled(), None);
}

#[test]
fn blocks_settle_from_where_their_own_update_has_them() {
    let mut bundler = Bundler::new(PATCH_SLOTS, AtlasExtent::DEFAULT);
    bundler.add_delta(triangle(0, 0..=4).geometry);
    let stored = settling(1).settled[0].to;
    let there = Block { address: BlockAddress { page: 0, x: 40, y: 80 }, ..stored };
    let placements = vec![(PatchSlot(0), Some(there))];
    bundler.add_delta(GeometryDelta { placements, ..settling(1) });
    bundler.add_delta(GeometryDelta { placements: vec![(PatchSlot(0), Some(stored))], ..delta(2).geometry });
    (1..3).for_each(|update| assert_eq!(bundler.add_picture(UpdateId(update), update), None));
    bundler.take_newest_complete(UpdateId(2), |_| {});
    assert_eq!(bundler.settled(), [(there, stored)]);
}

#[test]
fn a_copy_is_drawn_with_what_it_is_filtered_for() {
    let mut bundler = Bundler::new(PATCH_SLOTS, AtlasExtent::DEFAULT);
    bundler.add_delta(triangle(0, 0..=4).geometry);
    let pixel_now = |bundler: &Bundler<u32>| bundler.patches.get(PatchSlot(0)).expect("a patch").pixel;
    for (update, texels) in [(1, [2.0, 4.0]), (3, [8.0, 1.0])] {
        let mut settles = settling(update);
        settles.settled[0].pixel = PixelTexels::new(texels);
        let to = settles.settled[0].to;
        let from = Block { address: BlockAddress { page: 0, x: 40, y: 80 }, ..to };
        let [in_atlas, stored] = [from, to].map(|block| (PatchSlot(0), Some(block)));
        bundler.add_delta(GeometryDelta { placements: vec![in_atlas], ..settles });
        bundler.add_delta(GeometryDelta { placements: vec![stored], ..delta(update + 1).geometry });
        bundler.add_picture(UpdateId(update), update);
        bundler.take_newest_complete(UpdateId(update), |_| {});
        assert_eq!(pixel_now(&bundler), PixelTexels::default(), "it is in the atlas");
        bundler.add_picture(UpdateId(update + 1), update + 1);
        bundler.take_newest_complete(UpdateId(update + 1), |_| {});
        assert_eq!(pixel_now(&bundler), PixelTexels::new(texels));
    }
}

#[test]
fn the_first_update_whose_blocks_cannot_settle_is_told_once() {
    let mut bundler = Bundler::new(PATCH_SLOTS, AtlasExtent::DEFAULT);
    bundler.add_delta(triangle(0, 0..=4).geometry);
    [settling(1), settling(2), settling(3)].into_iter().for_each(|delta| bundler.add_delta(delta));
    bundler.add_picture(UpdateId(3), 3);
    assert_eq!(bundler.take_unsettled(), None, "their pictures may come");
    assert_eq!(take_all(&mut bundler).0, [(3, 1)]);
    assert_eq!(bundler.take_unsettled(), Some(UpdateId(1)));
    assert_eq!(bundler.take_unsettled(), None);
}

#[test]
fn pictures_without_settled_blocks_go_first() {
    let mut bundler = Bundler::new(PATCH_SLOTS, AtlasExtent::DEFAULT);
    bundler.add_delta(triangle(0, 0..=4).geometry);
    [settling(1), delta(2).geometry, settling(3), settling(4), settling(5)]
        .into_iter()
        .for_each(|delta| bundler.add_delta(delta));
    let dropped: Vec<_> = (1..6).filter_map(|update| bundler.add_picture(UpdateId(update), update)).collect();
    assert_eq!(dropped, [2, 1], "all others settle something: the oldest is lost");
    assert_eq!(take_all(&mut bundler).0, [(3, 1), (4, 1), (5, 1)]);
    assert_eq!(bundler.take_unsettled(), Some(UpdateId(1)));
}

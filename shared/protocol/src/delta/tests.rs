use super::sections::put_slots;
use super::*;
use crate::atlas::{Block, BlockAddress, BlockSize, PatchKind, PixelTexels};
use crate::coverage::Coverage;
use crate::geometry::{InstanceInfo, Motion, NewPatch, NewVertex, Settled, on_static_grid};
use crate::ids::{InstanceId, MeshId, PatchSlot, VertexSlot};
use crate::limits::{MAX_INSTANCES, MAX_NEW_SAMPLE_GRIDS, STATIC_STEPS_PER_M};
use crate::motion::predicted::{PredictedVertex, Prediction};
use crate::testing::{Dice, damaged};
use crate::time::GridIndex;
use glam::Vec3;
use std::collections::BTreeMap;

const VERTEX_SLOTS: u32 = 600;
const PATCH_SLOTS: u32 = 300;
const STORE_PAGES: u32 = 2;
/// The section of coded bits.
const CODED: usize = 4;

/// The section of a delta that says nothing else.
fn coded(geometry: &GeometryDelta) -> Vec<u8> {
    let mut section = Vec::new();
    DeltaEncoder::new(VERTEX_SLOTS, PATCH_SLOTS).encode_geometry(geometry, &mut section);
    section
}

fn encoder() -> DeltaEncoder {
    let encoder = DeltaEncoder::new(VERTEX_SLOTS, PATCH_SLOTS).with_store(STORE_PAGES);
    encoder.with_atlas(AtlasExtent::DEFAULT)
}

fn decoder() -> DeltaDecoder {
    let decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS).with_store(STORE_PAGES);
    decoder.with_atlas(AtlasExtent::DEFAULT)
}

/// A server that does random but lawful things, and so makes deltas of every kind.
struct Chaos {
    dice: Dice,
    frame: u32,
    grid: i32,
    instances: Vec<InstanceId>,
    vertices: BTreeMap<u32, Motion>,
    patches: BTreeMap<u32, NewPatch>,
    curve: BTreeMap<u32, ([f64; 3], [f64; 3])>,
}

impl Chaos {
    fn new(seed: u64) -> Self {
        Self {
            dice: Dice::new(seed),
            frame: 0,
            grid: -5,
            instances: Vec::new(),
            vertices: BTreeMap::new(),
            patches: BTreeMap::new(),
            curve: BTreeMap::new(),
        }
    }

    fn delta(&mut self) -> Delta {
        let mut delta = GeometryDelta {
            update: UpdateId(self.frame),
            time: WorldTime(i64::from(self.frame) * 33_333_333 - 7),
            ..GeometryDelta::default()
        };
        self.frame += 1;
        self.evict(&mut delta);
        self.announce(&mut delta);
        self.add_vertices(&mut delta);
        self.add_patches(&mut delta);
        self.place(&mut delta);
        self.predict(&mut delta);
        let samples = self.sample(&delta);
        Delta { geometry: delta, is_update: true, samples }
    }

    fn evict(&mut self, delta: &mut GeometryDelta) {
        let gone: Vec<u32> = self.patches.keys().copied().filter(|_| self.dice.once_in(9)).collect();
        self.patches.retain(|slot, _| !gone.contains(slot));
        delta.evicted_patches = gone.into_iter().map(PatchSlot).collect();
        let used: Vec<u32> =
            self.patches.values().flat_map(|patch| patch.vertices).map(|slot| slot.0).collect();
        let unused = self.vertices.keys().copied().filter(|slot| !used.contains(slot));
        let gone: Vec<u32> = unused.filter(|_| self.dice.once_in(3)).collect();
        for slot in &gone {
            self.vertices.remove(slot);
            self.curve.remove(slot);
        }
        delta.evicted_vertices = gone.into_iter().map(VertexSlot).collect();
    }

    fn announce(&mut self, delta: &mut GeometryDelta) {
        if self.instances.is_empty() || self.dice.once_in(4) {
            let instance = InstanceId(self.dice.below(u64::from(MAX_INSTANCES)) as u16);
            self.instances.push(instance);
            let step_m = 0.0001 * (1 + self.dice.below(20)) as f32;
            delta.instances.push(InstanceInfo { instance, step_m });
        }
        if self.dice.once_in(7) {
            let instance = self.instances[self.dice.below(self.instances.len() as u64) as usize];
            delta.instances.push(InstanceInfo { instance, step_m: 0.003 });
        }
    }

    fn add_vertices(&mut self, delta: &mut GeometryDelta) {
        let first = self.dice.below(u64::from(VERTEX_SLOTS)) as u32;
        let last = (first + self.dice.below(90) as u32).min(VERTEX_SLOTS);
        let instance = self.instances[self.dice.below(self.instances.len() as u64) as usize];
        for slot in first..last {
            if self.vertices.contains_key(&slot) || self.dice.once_in(10) {
                continue;
            }
            let mut at = || self.dice.signed_unit() * 3.0;
            let (position, velocity) = ([at(), at(), at()], [at(), at(), at()]);
            let motion = if self.dice.once_in(3) {
                Motion::Static { position: Vec3::from_array(position.map(|c| c as f32)) }
            } else if self.dice.once_in(4) {
                Motion::Predicted
            } else {
                self.curve.insert(slot, (position, velocity));
                Motion::Sampled
            };
            self.vertices.insert(slot, motion);
            delta.new_vertices.push(NewVertex { slot: VertexSlot(slot), instance, number: slot, motion });
        }
    }

    fn add_patches(&mut self, delta: &mut GeometryDelta) {
        let vertices: Vec<u32> = self.vertices.keys().copied().collect();
        for _ in 0..self.dice.below(20) {
            let slot = self.dice.below(u64::from(PATCH_SLOTS)) as u32;
            if vertices.is_empty() || self.patches.contains_key(&slot) {
                continue;
            }
            let kind = PatchKind::ALL[self.dice.below(3) as usize];
            let mut any = || VertexSlot(vertices[self.dice.below(vertices.len() as u64) as usize]);
            let mut corners = [any(), any(), any(), any(), any()];
            let first = corners[0];
            corners[kind.vertex_count()..].fill(first);
            let instance = self.instances[self.dice.below(self.instances.len() as u64) as usize];
            let double_sided = self.dice.once_in(3);
            let (mesh, number) = (MeshId(u32::from(instance.0) % 3), self.dice.below(40) as u32);
            let (slot, vertices) = (PatchSlot(slot), corners);
            let patch = NewPatch { slot, instance, mesh, number, kind, vertices, double_sided };
            self.patches.insert(slot.0, patch);
            delta.new_patches.push(patch);
        }
        delta.new_patches.sort_unstable_by_key(|patch| patch.slot);
    }

    fn predict(&mut self, delta: &mut GeometryDelta) {
        let predicted = self.vertices.iter().filter(|(_, motion)| **motion == Motion::Predicted);
        for slot in predicted.map(|(slot, _)| VertexSlot(*slot)) {
            let mut since_update_s = 0.0;
            let predictions = std::array::from_fn(|_| {
                since_update_s += 0.01 * (1 + self.dice.below(20)) as f32;
                Prediction { position_m: Vec3::splat(self.dice.signed_unit() as f32), since_update_s }
            });
            if !self.dice.once_in(5) {
                delta.predictions.push(PredictedVertex { slot, predictions });
            }
        }
    }

    fn place(&mut self, delta: &mut GeometryDelta) {
        for &slot in self.patches.keys() {
            if self.dice.once_in(2) {
                let page =
                    if self.dice.once_in(3) { 1 + self.dice.below(STORE_PAGES.into()) as u8 } else { 0 };
                let [x, y] = [480, 300].map(|end| self.dice.below(end) as u16 * 4);
                let address = BlockAddress { page, x, y };
                let (width_log2, height_log2) = (2 + self.dice.below(6) as u8, 2 + self.dice.below(6) as u8);
                let block = Block { address, size: BlockSize { width_log2, height_log2 } };
                let block = (!self.dice.once_in(5)).then_some(block);
                delta.placements.push((PatchSlot(slot), block));
                if let Some(block) = block.filter(|block| !block.is_stored() && self.dice.once_in(3)) {
                    let to = Block { address: BlockAddress { page: 2, x: 64, y: 32 }, ..block };
                    let pixel = PixelTexels::from_bits(self.dice.below(256) as u8);
                    delta.settled.push(Settled { slot: PatchSlot(slot), to, pixel });
                }
                if let Some(block) = block.filter(|_| self.dice.once_in(3)) {
                    let often = 2 + self.dice.below(30);
                    let coverage = Coverage::from_fn(block.size.texels(), |_| self.dice.once_in(often));
                    delta.coverage.push((PatchSlot(slot), coverage));
                }
            }
        }
    }

    fn sample(&mut self, delta: &GeometryDelta) -> Vec<SampleBatch> {
        let mut samples = Vec::new();
        let fresh: Vec<u32> = delta.new_vertices.iter().map(|vertex| vertex.slot.0).collect();
        let is_fresh = |slot: &u32| fresh.contains(slot);
        let earlier = self.grid - self.dice.below(4) as i32;
        (earlier..self.grid).for_each(|grid| self.batch(&mut samples, grid, is_fresh));
        if self.dice.once_in(6) {
            // The future changed for some: a few steps are sent again.
            let odd = self.dice.below(5) as u32;
            (self.grid - 2..self.grid)
                .for_each(|grid| self.batch(&mut samples, grid, |slot| slot % 5 == odd));
        }
        if self.dice.once_in(8) {
            self.grid += 1; // A step that nobody gets.
        }
        (0..self.dice.below(3)).for_each(|_| {
            self.batch(&mut samples, self.grid, |_| true);
            self.grid += 1;
        });
        samples
    }

    fn batch(&mut self, samples: &mut Vec<SampleBatch>, grid: i32, wanted: impl Fn(&u32) -> bool) {
        let dice = &mut self.dice;
        let mut value =
            |c: f64, v: f64| ((c + v * f64::from(grid) * 0.033) * 2000.0) as i32 + dice.below(3) as i32;
        let values = self
            .curve
            .iter()
            .filter(|(slot, _)| wanted(slot))
            .map(|(slot, (c, v))| (VertexSlot(*slot), std::array::from_fn(|axis| value(c[axis], v[axis]))))
            .collect();
        samples.push(SampleBatch { grid: GridIndex(grid), values });
    }
}

#[test]
fn both_sides_stay_in_step_through_random_sessions() {
    for seed in 0..30 {
        let mut chaos = Chaos::new(seed);
        let mut coder = encoder();
        let mut decoder = decoder();
        for _ in 0..60 {
            let delta = chaos.delta();
            let encoded = coder.encode(&delta);
            assert_eq!(peek_delta(&encoded.bytes).map(|head| head.update), Ok(delta.geometry.update));
            assert_eq!(decoder.decode(&encoded.bytes).as_ref(), Ok(&delta), "seed {seed}");
            assert!(coder.memory() == decoder.memory(), "seed {seed}");
            assert_eq!(encoded.sizes.total_bytes, encoded.bytes.len());
            assert_eq!(encoded.sizes.parts.total(), encoded.bytes.len() as u64, "seed {seed}");
        }
    }
}

#[test]
fn bytes_count_for_the_part_that_they_tell() {
    const COUNT: u32 = 100;
    let patch = |slot: u32| {
        let kind = PatchKind::ALL[(slot * slot) as usize % 3];
        let vertex = |corner| VertexSlot(slot + if corner < kind.vertex_count() as u32 { corner } else { 0 });
        NewPatch {
            slot: PatchSlot(slot),
            instance: InstanceId(0),
            mesh: MeshId(0),
            number: 7 * slot,
            kind,
            vertices: [0, 1, 2, 3, 4].map(vertex),
            double_sided: false,
        }
    };
    let size = BlockSize { width_log2: 2, height_log2: 2 };
    let block = |slot: u32| Block { address: BlockAddress { page: 0, x: 8 * slot as u16, y: 8 }, size };
    let to = Block { address: BlockAddress { page: 1, x: 64, y: 32 }, size };
    let every = || (0..COUNT).step_by(2).map(PatchSlot);
    let enters = GeometryDelta {
        new_vertices: (0..COUNT + 4).map(static_vertex).collect(),
        new_patches: (0..COUNT).map(patch).collect(),
        ..Default::default()
    };
    let placements = every().map(|slot| (slot, Some(block(slot.0)))).collect();
    let placed = GeometryDelta { placements, ..Default::default() };
    let settled = vec![Settled { slot: PatchSlot(0), to, pixel: PixelTexels::default() }];
    let settles = GeometryDelta { settled, ..Default::default() };
    let evicted_patches = (0..COUNT).filter(|slot| slot % 7 < 3).map(PatchSlot).collect();
    let leaves = GeometryDelta { evicted_patches, ..Default::default() };
    let mut coder = DeltaEncoder::new(COUNT + 4, COUNT).with_store(1);
    let mut parts = |delta: GeometryDelta| coder.encode_update(&delta).sizes.parts;
    let empty = parts(GeometryDelta::default());
    let mut grown = |delta, expected: &[Part]| {
        let bytes = parts(delta);
        let more = |part: &Part| *part != Part::Head && bytes.of(*part) > empty.of(*part) + 1;
        assert_eq!(Part::ALL.into_iter().filter(more).collect::<Vec<_>>(), expected);
    };
    // Each patch that enters is said to have no block.
    let told = [Part::Vertices, Part::PatchSlots, Part::PatchKinds, Part::Corners, Part::PlacedSlots];
    grown(enters, &told);
    grown(placed, &[Part::PlacedSlots, Part::Blocks]);
    grown(settles, &[Part::Settled]);
    grown(leaves, &[Part::Evicted]);
}

#[test]
fn damaged_deltas_give_values_or_errors() {
    for seed in 0..4 {
        let mut chaos = Chaos::new(seed);
        let mut coder = encoder();
        let mut decoder = decoder();
        for _ in 0..5 {
            let bytes = coder.encode(&chaos.delta()).bytes;
            damaged(&bytes, seed, 400, |bytes| {
                let mut victim = decoder.clone();
                if victim.decode(bytes).is_err() {
                    assert!(victim.decode(bytes).is_err(), "a broken decoder stays so");
                }
            });
            for length in 0..bytes.len() {
                assert!(decoder.clone().decode(&bytes[..length]).is_err(), "{length} of {}", bytes.len());
            }
            decoder.decode(&bytes).unwrap();
        }
    }
}

fn bytes_of(delta: impl Into<Delta>) -> Vec<u8> {
    // A coder that allows more than the decoder under test.
    let mut coder = DeltaEncoder::new(4 * VERTEX_SLOTS, 4 * PATCH_SLOTS);
    coder.encode(&delta.into()).bytes
}

#[track_caller]
fn assert_refused(bytes: &[u8], words: &str) {
    let error = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS).decode(bytes).unwrap_err().to_string();
    assert!(error.contains(words), "{error}");
}

fn static_vertex(slot: u32) -> NewVertex {
    let motion = Motion::Static { position: Vec3::ONE };
    NewVertex { slot: VertexSlot(slot), instance: InstanceId(0), number: slot, motion }
}

#[test]
fn slots_beyond_the_agreed_capacity_are_refused() {
    let vertex = GeometryDelta { new_vertices: vec![static_vertex(VERTEX_SLOTS)], ..Default::default() };
    assert_refused(&bytes_of(vertex), "slot 600 of 600 does not exist");
    let patch = NewPatch {
        slot: PatchSlot(PATCH_SLOTS),
        instance: InstanceId(0),
        mesh: MeshId(0),
        number: 0,
        kind: PatchKind::One,
        vertices: [VertexSlot(0); 5],
        double_sided: false,
    };
    let delta = GeometryDelta {
        new_vertices: vec![static_vertex(0)],
        new_patches: vec![patch],
        ..GeometryDelta::default()
    };
    assert_refused(&bytes_of(delta), "slot 300 of 300 does not exist");
}

#[test]
fn slots_that_are_not_taken_cannot_be_left() {
    let enters = GeometryDelta { new_vertices: vec![static_vertex(7)], ..Default::default() };
    let leaves = GeometryDelta { evicted_vertices: vec![VertexSlot(7)], ..Default::default() };
    let mut coder = DeltaEncoder::new(VERTEX_SLOTS, PATCH_SLOTS);
    let [enters, leaves] = [enters, leaves].map(|delta| coder.encode(&delta.into()).bytes);
    assert_refused(&leaves, "a slot is not valid");
    let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
    assert!(decoder.decode(&enters).is_ok() && decoder.decode(&leaves).is_ok());
}

#[test]
fn zero_bit_samples_stay_within_the_agreed_memory() {
    let new_vertices: Vec<_> = (0..VERTEX_SLOTS)
        .map(|slot| NewVertex {
            slot: VertexSlot(slot),
            instance: InstanceId(0),
            number: slot,
            motion: Motion::Sampled,
        })
        .collect();
    let instances = vec![InstanceInfo { instance: InstanceId(0), step_m: 0.001 }];
    let batch = |grid| SampleBatch {
        grid: GridIndex(grid),
        values: (0..VERTEX_SLOTS).map(|slot| (VertexSlot(slot), [0; 3])).collect(),
    };
    let with = |steps: u32| Delta {
        is_update: true,
        geometry: GeometryDelta {
            instances: instances.clone(),
            new_vertices: new_vertices.clone(),
            ..GeometryDelta::default()
        },
        samples: (0..steps as i32).map(batch).collect(),
    };
    let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
    assert!(decoder.decode(&bytes_of(with(MAX_NEW_SAMPLE_GRIDS))).is_ok());
    assert_refused(&bytes_of(with(MAX_NEW_SAMPLE_GRIDS + 1)), "samples of a delta is 5400");
}

/// Those of a delta that says nothing.
fn empty_sections() -> [Vec<u8>; SECTIONS] {
    let mut sections: [Vec<u8>; SECTIONS] = std::array::from_fn(|_| vec![0]);
    sections[1] = vec![0; 3];
    sections[CODED].clear();
    sections
}

#[test]
fn predictions_of_vertices_that_are_not_predicted_are_refused() {
    let predicted = |slot, times: [f32; 3]| PredictedVertex {
        slot: VertexSlot(slot),
        predictions: times.map(|since_update_s| Prediction { position_m: Vec3::ONE, since_update_s }),
    };
    let header = |slot, motion, predictions: &[PredictedVertex]| {
        let vertex = NewVertex { slot: VertexSlot(slot), instance: InstanceId(0), number: slot, motion };
        let header = GeometryDelta::default();
        let mut sections = empty_sections();
        sections[CODED] = coded(&GeometryDelta { new_vertices: vec![vertex], ..Default::default() });
        sections[5].clear();
        put_predictions(&mut sections[5], predictions);
        put_header_and([0, 1], &header, &sections)
    };
    let (rising, falling) = (predicted(4, [0.1, 0.2, 0.3]), predicted(4, [0.1, 0.3, 0.2]));
    let still = Motion::Static { position: Vec3::ONE };
    let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
    let decoded = decoder.decode(&header(4, Motion::Predicted, &[rising])).unwrap();
    assert_eq!(decoded.geometry.predictions, [rising]);
    assert_refused(&header(4, still, &[rising]), "no vertex of slot 4 is predicted");
    assert_refused(&header(5, Motion::Predicted, &[rising]), "no vertex of slot 4 is predicted");
    assert_refused(&header(4, Motion::Predicted, &[falling]), "do not rise");
}

#[test]
fn huge_counts_are_refused_before_anything_is_allocated() {
    for (section, words) in [
        (0, "instances"),
        (1, "skeletons and what they move"),
        (2, "rest vertices"),
        (3, "batches of samples"),
        (5, "predictions"),
        (6, "coverage of blocks"),
    ] {
        let mut sections = empty_sections();
        sections[section] = vec![0xff, 0xff, 0xff, 0xff, 0x0f];
        assert_refused(&put_header_and([0, 1], &GeometryDelta::default(), &sections), words);
    }
}

/// A delta's bytes that place one patch of 4 x 4 texels and tell coverage of some slot, with so much of it.
fn covering(slot: u32, coverage: &[u8]) -> Vec<u8> {
    let vertex = |slot| {
        let motion = Motion::Static { position: Vec3::ZERO };
        NewVertex { slot: VertexSlot(slot), instance: InstanceId(0), number: slot, motion }
    };
    let vertices = [0, 1, 2, 0, 0].map(VertexSlot);
    let (instance, kind) = (InstanceId(0), PatchKind::One);
    let patch = |number| NewPatch {
        slot: PatchSlot(number),
        instance,
        mesh: MeshId(0),
        number,
        kind,
        vertices,
        double_sided: false,
    };
    let size = BlockSize { width_log2: 2, height_log2: 2 };
    let block = Block { address: BlockAddress::default(), size };
    let mut sections = empty_sections();
    sections[CODED] = coded(&GeometryDelta {
        new_vertices: vec![vertex(0), vertex(1), vertex(2)],
        new_patches: vec![patch(0), patch(1)],
        placements: vec![(PatchSlot(0), Some(block)), (PatchSlot(1), None)],
        ..Default::default()
    });
    sections[6].clear();
    put_slots(&mut sections[6], std::iter::once(slot));
    sections[6].extend_from_slice(coverage);
    put_header_and([0, 1], &GeometryDelta::default(), &sections)
}

#[test]
fn coverage_is_that_of_a_block_that_the_same_delta_places() {
    let decode = |bytes: &[u8]| DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS).decode(bytes);
    let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
    decoder.decode(&covering(0, &[0, 3, 13])).expect("a hole of three texels");
    let is_masked = |slot| decoder.memory().patches().get(PatchSlot(slot)).map(|patch| patch.is_masked);
    assert_eq!((is_masked(0), is_masked(1)), (Some(true), Some(false)));
    for (slot, words) in [(1, "gets no block"), (2, "gets no block")] {
        assert_refused(&covering(slot, &[0, 3, 13]), words);
    }
    assert_refused(&covering(0, &[0, 3, 14]), "a run of a block's coverage");
    assert!(decode(&covering(0, &[0, 3, 13, 0])).is_err(), "something follows");
    assert!(decode(&covering(0, &[0, 3])).is_err(), "something lacks");
}

#[test]
fn blocks_settle_from_the_atlas_into_pages_that_were_agreed() {
    let block = |page, height_log2| Block {
        address: BlockAddress { page, x: 8, y: 8 },
        size: BlockSize { width_log2: 2, height_log2 },
    };
    let refused = |settled: Settled, placement: Block| {
        let mut memory = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS).with_store(2);
        memory.decode(&covering(0, &[0, 3, 13])).expect("a patch");
        let placements = vec![(PatchSlot(0), Some(placement))];
        let delta = GeometryDelta { placements, settled: vec![settled], ..Default::default() };
        memory.memory().clone().apply(&delta).err().map(|error| error.to_string())
    };
    let to = |to| Settled { slot: PatchSlot(0), to, pixel: PixelTexels::default() };
    assert_eq!(refused(to(block(2, 3)), block(0, 3)), None);
    for (settled, placement, words) in [
        (to(block(2, 4)), block(0, 3), "no block of this size"),
        (to(block(0, 3)), block(0, 3), "no block of this size"),
        (to(block(2, 3)), block(1, 3), "no block of this size"),
        (Settled { slot: PatchSlot(2), ..to(block(2, 3)) }, block(0, 3), "no block of this size"),
        (to(block(3, 3)), block(0, 3), "page 3 of 2"),
        (to(block(2, 3)), block(3, 3), "page 3 of 2"),
    ] {
        let said = refused(settled, placement).expect("refused");
        assert!(said.contains(words), "{said}");
    }
}

#[test]
fn a_new_placement_takes_coverage_away() {
    let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS);
    decoder.decode(&covering(0, &[0, 3, 13])).expect("covered");
    let mut memory = decoder.memory().clone();
    let size = BlockSize { width_log2: 2, height_log2: 3 };
    let block = Some(Block { address: BlockAddress::default(), size });
    let placed = GeometryDelta { placements: vec![(PatchSlot(0), block)], ..Default::default() };
    memory.apply(&placed).expect("lawful");
    assert!(!memory.patches().get(PatchSlot(0)).expect("it stays").is_masked);
}

#[test]
fn positions_that_are_no_numbers_are_refused() {
    for bad in [f32::NAN, f32::INFINITY, -2e6] {
        let motion = Motion::Static { position: Vec3::new(0.0, bad, 0.0) };
        let vertex = NewVertex { slot: VertexSlot(0), instance: InstanceId(0), number: 0, motion };
        let delta = GeometryDelta { new_vertices: vec![vertex], ..Default::default() };
        let (mut sections, mut bits) = (empty_sections(), [0; Part::ALL.len()]);
        let mut coder = RangeEncoder::new(&mut sections[CODED], &mut bits);
        let memory = ClientMemory::new(VERTEX_SLOTS, PATCH_SLOTS);
        // A server refuses to say so, after it has.
        let (mut coding, mut out) =
            (GeometryCoding::new(VERTEX_SLOTS, PATCH_SLOTS), GeometryDelta::default());
        assert!(coding.code(&mut coder, &memory, &delta, &mut out).is_err());
        coder.finish();
        let bytes = put_header_and([0, 1], &GeometryDelta::default(), &sections);
        assert_refused(&bytes, "a vertex's position is not valid");
    }
}

#[test]
fn static_vertices_on_the_grid_take_few_bytes_and_others_come_as_they_are() {
    let line = |apart_m: f32, place: fn(Vec3) -> Vec3| {
        let vertex = |slot: u32| {
            let position =
                place(Vec3::new(3.1, 1.7, -4.0) + Vec3::new(1.0, 0.3, -0.6) * slot as f32 * apart_m);
            NewVertex { motion: Motion::Static { position }, ..static_vertex(slot) }
        };
        let delta = GeometryDelta { new_vertices: (0..500).map(vertex).collect(), ..Default::default() };
        let encoded = DeltaEncoder::new(600, 1).encode(&delta.clone().into());
        let decoded = DeltaDecoder::new(600, 1).decode(&encoded.bytes).unwrap();
        assert_eq!(decoded.geometry, delta);
        encoded.sizes.vertex_bytes as f32 / 500.0
    };
    let [near, far] = [0.01, 0.3].map(|apart_m| line(apart_m, on_static_grid));
    assert!(near < 4.5 && far < 6.5, "{near} and {far} bytes a vertex");
    assert!(line(0.01, |place| place) > 11.9, "beside the grid");
    let rounded_to_zero = on_static_grid(Vec3::new(-1e-6, -0.0, 1.0));
    assert_eq!(rounded_to_zero.to_array().map(f32::to_bits), Vec3::Z.to_array().map(f32::to_bits));
    // Far out, on an axis, and the zero that has a sign.
    for place in [Vec3::splat(9e5), Vec3::new(0.0, -0.0, 1.0), Vec3::new(1023.9, -1023.9, 0.3)] {
        let position = on_static_grid(place);
        assert!((position - place).abs().max_element() <= 0.5 / STATIC_STEPS_PER_M, "{place}");
        let vertex = NewVertex { motion: Motion::Static { position }, ..static_vertex(0) };
        let bytes = bytes_of(GeometryDelta { new_vertices: vec![vertex], ..Default::default() });
        let decoded = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS).decode(&bytes).unwrap();
        let Motion::Static { position: told } = decoded.geometry.new_vertices[0].motion else {
            unreachable!()
        };
        assert_eq!(told.to_array().map(f32::to_bits), position.to_array().map(f32::to_bits), "{place}");
    }
}

#[test]
fn runs_of_slots_cost_nothing_per_vertex() {
    let new_vertices = (0..1000)
        .map(|slot| NewVertex {
            slot: VertexSlot(slot),
            instance: InstanceId(0),
            number: slot,
            motion: Motion::Sampled,
        })
        .collect();
    let instances = vec![InstanceInfo { instance: InstanceId(0), step_m: 0.001 }];
    let mut coder = DeltaEncoder::new(1000, 1);
    let encoded = coder.encode(&GeometryDelta { instances, new_vertices, ..Default::default() }.into());
    assert!(encoded.sizes.vertex_bytes < 20, "{:?}", encoded.sizes);
}

#[test]
#[should_panic(expected = "contradict the memory")]
fn a_server_that_contradicts_itself_is_a_bug() {
    bytes_of(GeometryDelta { evicted_vertices: vec![VertexSlot(9)], ..Default::default() });
}

//! A draw list that changes by what has changed, against one that is made anew: as many patches as `docs/budget.md` counts, of
//! which a part gets another block with each update. Memory is the CPU's own: what a bundle's costs is up to the device.
//! `cargo run --release -p shadecast-client --example list_cost -- [ROUNDS]`

use shadecast_client::draw::draw_list::{
    ListWriter, MAX_CORNERS_PER_PATCH, MAX_INDICES_PER_PATCH, NewestList,
};
use shadecast_client::motion::Motion;
use shadecast_protocol::atlas::{Block, BlockAddress, BlockSize, PatchKind};
use shadecast_protocol::geometry::{self, NewPatch, NewVertex};
use shadecast_protocol::ids::{InstanceId, MeshId, PatchSlot, UpdateId, VertexSlot};
use shadecast_protocol::memory::Patches;
use shadecast_protocol::message::MotionMemory;
use shadecast_shaders::generated::CornerGpu;
use std::time::Instant;

const PATCHES: u32 = 48_000;
const VERTICES: u32 = 110_000;
const SLOTS: u32 = 60_000;
/// Of all patches, per mille.
const CHANGED: [u32; 4] = [2, 20, 100, 1000];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let rounds: u32 = std::env::args().nth(1).map_or(Ok(101), |argument| argument.parse())?;
    println!("{PATCHES} patches, {VERTICES} vertices, {rounds} rounds, medians");
    let mut bench = Bench::new();
    let slots: Vec<PatchSlot> = (0..PATCHES).map(patch_slot).collect();
    let mut anew = (bench.corners.clone(), bench.indices.clone());
    // Both ways in each round.
    for per_mille in CHANGED {
        let (mut rows, mut bytes) = (Vec::new(), 0);
        for round in 0..rounds {
            let changed: Vec<PatchSlot> = slots
                .iter()
                .copied()
                .filter(|slot| {
                    (slot.0.wrapping_mul(2_654_435_761) >> 8).wrapping_add(round * 37) % 1000 < per_mille
                })
                .collect();
            bench
                .patches
                .place(&changed.iter().map(|slot| (*slot, Some(block(round)))).collect::<Vec<_>>())?;
            let began = Instant::now();
            bytes = bench.update(&changed);
            let by_change_s = began.elapsed().as_secs_f64();
            let began = Instant::now();
            let mut writer = ListWriter::new(&mut anew.0, &mut anew.1);
            bench.patches.iter().for_each(|(_, patch)| writer.write(patch));
            let anew_s = began.elapsed().as_secs_f64();
            let bytes_anew =
                writer.corner_count() * size_of::<CornerGpu>() + writer.index_count() as usize * 4;
            rows.push([by_change_s, anew_s, anew_s / by_change_s, bytes_anew as f64]);
        }
        let median = |column: usize| {
            let mut values: Vec<f64> = rows.iter().map(|row| row[column]).collect();
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        println!(
            "{:5.1} % changed: {:7.3} ms and {:9} bytes; anew {:7.3} ms, {:.2} times that in the same round, and {:9} bytes",
            f64::from(per_mille) / 10.0,
            median(0) * 1e3,
            bytes,
            median(1) * 1e3,
            median(2),
            median(3)
        );
    }
    Ok(())
}

struct Bench {
    patches: Patches,
    motion: Motion,
    newest: NewestList,
    corners: Vec<CornerGpu>,
    indices: Vec<u32>,
}

/// Slots are given to patches as they come: those of a model lie together.
fn patch_slot(number: u32) -> PatchSlot {
    PatchSlot(number * 5 / 4)
}

fn block(round: u32) -> Block {
    let side = (round % 400) as u16 * 4;
    Block { address: BlockAddress { page: 0, x: side, y: side }, size: BlockSize::new(2, 3).expect("a size") }
}

/// Vertices that wait for no samples.
fn moved() -> Motion {
    let mut motion = Motion::new(VERTICES, MotionMemory::NONE.into());
    let vertex = |slot| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(0),
        number: slot,
        motion: geometry::Motion::Static { position: glam::Vec3::ZERO },
    };
    motion.take(UpdateId(0), &(0..VERTICES).map(vertex).collect::<Vec<_>>(), Vec::new(), true);
    motion
}

impl Bench {
    fn new() -> Self {
        let mut patches = Patches::new(SLOTS);
        let patch = |number: u32| NewPatch {
            slot: patch_slot(number),
            mesh: MeshId(0),
            number,
            instance: InstanceId(0),
            kind: if number.is_multiple_of(8) { PatchKind::Three } else { PatchKind::Two },
            vertices: [0, 1, 2, 3, 4].map(|corner| VertexSlot((number * 2 + corner) % VERTICES)),
            double_sided: false,
        };
        patches.insert(&(0..PATCHES).map(patch).collect::<Vec<_>>()).expect("free");
        let all: Vec<_> = (0..PATCHES).map(|number| (patch_slot(number), Some(block(0)))).collect();
        patches.place(&all).expect("there");
        let slots = SLOTS as usize;
        let mut bench = Self {
            patches,
            motion: moved(),
            newest: NewestList::new(SLOTS, 1, true),
            corners: vec![bytemuck::Zeroable::zeroed(); slots * MAX_CORNERS_PER_PATCH],
            indices: vec![0; slots * MAX_INDICES_PER_PATCH],
        };
        bench.update(&all.iter().map(|(slot, _)| *slot).collect::<Vec<_>>());
        bench
    }

    /// Bytes written to a bundle's memory.
    fn update(&mut self, changed: &[PatchSlot]) -> usize {
        self.newest.update(&self.patches, changed, &mut self.motion);
        self.newest.copy_to(0, (&mut self.corners, &mut self.indices))
    }
}

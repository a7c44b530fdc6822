//! Bytes and time of deltas: a scene that enters at once, then updates in which a part of it gets other blocks, loses them or enters.
//! Instances of one mesh, a grid of quads, with an allocator as the server has it.
//! `cargo run --release -p shadecast-protocol --example delta_cost -- [UPDATES]`

use shadecast_protocol::atlas::allocator::Atlas;
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockSize, PatchKind};
use shadecast_protocol::delta::{DeltaDecoder, DeltaEncoder, Part};
use shadecast_protocol::geometry::{GeometryDelta, Motion, NewPatch, NewVertex};
use shadecast_protocol::ids::{InstanceId, MeshId, PatchSlot, UpdateId, VertexSlot};
use std::time::Instant;

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
    updates: u32,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let updates: u32 = std::env::args().nth(1).map_or(Ok(100), |argument| argument.parse())?;
    let extent = AtlasExtent::new(4096, 2048)?;
    let slots = (INSTANCES * VERTICES, INSTANCES * PATCHES);
    let mut scene = Scene {
        atlas: Atlas::new(extent),
        blocks: vec![None; slots.1 as usize],
        encoder: DeltaEncoder::new(slots.0, slots.1).with_atlas(extent),
        decoder: DeltaDecoder::new(slots.0, slots.1).with_atlas(extent),
        updates: 0,
    };
    let whole = scene.whole();
    scene.tell("all at once", &[whole])?;
    for per_mille in [10, 100] {
        let deltas: Vec<_> = (0..updates).map(|update| scene.churn(update, per_mille)).collect();
        scene.tell(&format!("{per_mille} per mille"), &deltas)?;
    }
    Ok(())
}

impl Scene {
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

    fn tell(&mut self, what: &str, deltas: &[GeometryDelta]) -> Result<(), Box<dyn std::error::Error>> {
        let (mut encoded_s, mut decoded_s, mut worst_s) = (0.0, 0.0, 0.0f64);
        let (mut bytes, mut records, mut parts) = (0, 0, shadecast_protocol::delta::PartBytes::default());
        for delta in deltas {
            let delta = GeometryDelta { update: UpdateId(self.updates), ..delta.clone() };
            self.updates += 1;
            let began = Instant::now();
            let encoded = self.encoder.encode_update(&delta);
            encoded_s += began.elapsed().as_secs_f64();
            let began = Instant::now();
            let decoded = self.decoder.decode(&encoded.bytes)?;
            let decode_s = began.elapsed().as_secs_f64();
            (decoded_s, worst_s) = (decoded_s + decode_s, worst_s.max(decode_s));
            assert_eq!(decoded.geometry, delta);
            (bytes, records) = (bytes + encoded.bytes.len(), records + delta.records());
            parts += encoded.sizes.parts;
        }
        let each = 1.0 / records as f64;
        println!(
            "{what}: {} updates, {records} records, {:.3} bytes a record, encoded in {:.3} us and decoded in {:.3} us a record, the slowest decoded in {:.1} ms",
            deltas.len(),
            bytes as f64 * each,
            encoded_s * 1e6 * each,
            decoded_s * 1e6 * each,
            worst_s * 1e3,
        );
        for part in Part::ALL.into_iter().filter(|part| parts.of(*part) > 0) {
            println!("  {}: {} bytes", part.name(), parts.of(part));
        }
        Ok(())
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

//! Sequences of geometry deltas: whatever decodes can be encoded again by a coder with the same past, and is the same.

use crate::script::steps;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::delta::{DeltaDecoder, DeltaEncoder};
use shadecast_protocol::limits::{MAX_SAMPLE_BATCHES, MAX_SAMPLES_PER_DELTA};

/// Slots of the client whose traffic was recorded: few, so that a run is short.
pub const VERTEX_SLOTS: u32 = 4096;
/// See [`VERTEX_SLOTS`].
pub const PATCH_SLOTS: u32 = 4096;
/// The same for pages of its store.
const STORE_PAGES: u32 = 4;
/// The atlas of the recorded session.
const ATLAS: AtlasExtent = AtlasExtent::MIN;
/// The operation of a step that holds a delta.
pub const DELTA: u8 = 0;

/// The number of deltas that decoded.
pub fn check(script: &[u8]) -> usize {
    let mut decoder = DeltaDecoder::new(VERTEX_SLOTS, PATCH_SLOTS).with_store(STORE_PAGES).with_atlas(ATLAS);
    let mut again = decoder.clone();
    let mut encoder = DeltaEncoder::new(VERTEX_SLOTS, PATCH_SLOTS).with_store(STORE_PAGES).with_atlas(ATLAS);
    let mut decoded = 0;
    for step in steps(script) {
        let Ok(delta) = decoder.decode(step.bytes) else {
            assert!(decoder.decode(step.bytes).is_err(), "a decoder that has lost its way goes on");
            break;
        };
        let samples: usize = delta.samples.iter().map(|batch| batch.values.len()).sum();
        assert!(
            samples <= MAX_SAMPLES_PER_DELTA as usize && delta.samples.len() <= MAX_SAMPLE_BATCHES as usize
        );
        for (slot, position) in
            decoder.memory().positions(delta.samples.clone()).into_iter().flat_map(|batch| batch.positions)
        {
            assert!(position.is_finite(), "{slot:?} {position}");
        }
        let bytes = encoder.encode(&delta).bytes;
        assert_eq!(again.decode(&bytes).as_ref(), Ok(&delta));
        decoded += 1;
    }
    decoded
}

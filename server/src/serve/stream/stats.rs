//! The figures of a run.

use crate::serve::cause_bits::CauseBits;
use serde::Serialize;
use shadecast_gpu::Timings;
use std::collections::BTreeMap;

/// How a run went.
#[derive(Clone, Debug, Default, Serialize)]
pub struct StreamStats {
    /// The Vulkan device.
    pub device: String,
    /// Nanoseconds of the monotonic clock at server time 0.
    pub epoch_monotonic_ns: i64,
    /// Updates sent.
    pub updates: u64,
    /// From the first to the last update.
    pub seconds: f64,
    /// Updates per second.
    pub server_fps: f64,
    /// Bytes of access units.
    pub atlas_bytes: u64,
    /// Where the bits of access units went; none without `--trace`.
    pub bits_by_cause: Option<CauseBits>,
    /// Mean quantiser of all pictures, 0 (finest) to 51.
    pub mean_qp: Option<f64>,
    /// Bytes of geometry deltas.
    pub geometry_bytes: u64,
    /// Bytes of predictions in them.
    pub prediction_bytes: u64,
    /// Bytes of motion between updates: clips and samples.
    pub motion_bytes: u64,
    /// Bytes of vertex samples, headers and first samples included.
    pub sample_bytes: u64,
    /// Vertex samples.
    pub samples: u64,
    /// How often the atlas was full.
    pub coarsened: u32,
    /// Patches in view that were not shown for want of room, summed over the updates for the last client.
    pub dropped_patches: u64,
    /// Each client that was served, in the order in which they went.
    pub viewers: Vec<ViewerStats>,
    /// Clients accepted.
    pub clients: u32,
    /// Sessions that were ended because their pipeline could not be made or failed.
    pub refused: u32,
    /// Encoders that failed and were made anew.
    pub encoder_restarts: u32,
    /// How often the device was lost and opened again.
    pub devices_lost: u32,
    /// Mean milliseconds per update by GPU stage.
    pub gpu_ms: BTreeMap<String, f64>,
    /// Vulkan validation warnings and errors; none with validation off.
    pub validation_messages: Option<u32>,
}

impl StreamStats {
    /// Adds what an update's stages took on the device.
    pub(super) fn add_gpu(&mut self, timings: &Timings) {
        for (stage, ms) in timings.iter() {
            *self.gpu_ms.entry(stage.to_owned()).or_default() += ms;
        }
    }
}

/// How it went for one client.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ViewerStats {
    /// Its number, in the order in which clients came; the first is 1.
    pub viewer: u32,
    /// How long it was served.
    pub seconds: f64,
    /// Updates sent.
    pub updates: u64,
    /// Updates per second.
    pub server_fps: f64,
    /// How long the pipeline worked for it, seconds: its share of the device.
    pub busy_s: f64,
    /// Bytes of access units.
    pub atlas_bytes: u64,
    /// Bytes of geometry deltas.
    pub geometry_bytes: u64,
    /// How often its atlas was full.
    pub coarsened: u32,
    /// Patches in its view that were not shown for want of room, summed over its updates.
    pub dropped_patches: u64,
    /// Triangles that its last update shows, of two sides twice.
    pub triangles: u32,
    /// Levels of detail in it, of the instances that were needed.
    pub levels: Vec<usize>,
    /// Pixels of its display that they may err by; more than was asked for where the client would not have room.
    pub detail_pixels: f32,
    /// Texels that its last update asked for along a pixel.
    pub texels_per_pixel: f32,
    /// Part of its blocks' texels that was not shaded again, over all updates.
    pub reused_share: f32,
}

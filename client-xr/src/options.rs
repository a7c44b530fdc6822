//! Options of a client.

use crate::decode::decoding::DecodeTiming;
use crate::draw::stages::atlas_draw::{Colours, Lookup};
use crate::draw::stages::interpolate::Interpolation;
use crate::platform::{self, MakeDecoder};
use shadecast_gpu::Gpu;
use shadecast_protocol::limits::{DEFAULT_PATCH_SLOTS, DEFAULT_TRIANGLES, DEFAULT_VERTEX_SLOTS};
use shadecast_protocol::message::{Codec, MotionMemory};

/// How a client behaves.
#[derive(Clone, Copy, Debug)]
pub struct ClientOptions {
    /// How positions between samples are found.
    pub interpolation: Interpolation,
    /// Samples per pixel: 1, 2 or 4. `None`: [`USUAL_MSAA`], and 1 without a GPU.
    pub msaa: Option<u32>,
    /// How the atlas is looked up.
    pub lookup: Lookup,
    /// How decoding takes time.
    pub decoding: DecodeTiming,
    /// What is announced to the server, best first.
    pub codecs: &'static [Codec],
    /// Makes a decoder for what was agreed.
    pub decoder: MakeDecoder,
    /// Vertices that the client offers to keep.
    pub max_vertex_slots: u32,
    /// Patches that the client offers to keep.
    pub max_patch_slots: u32,
    /// Triangles that the client offers to draw for each eye, those of two sides twice.
    pub max_triangles: u32,
    /// What the client offers to keep to skin by itself.
    pub motion: MotionMemory,
    /// Pages of settled blocks that the client offers to keep, 22 MB each; 0 is no store. `None`: [`USUAL_STORE_PAGES`], and none without
    /// a GPU.
    pub store_pages: Option<u32>,
    /// Whether colours go from one picture to the next while that is on display. `None`: with a GPU.
    pub blends: Option<bool>,
}

/// Samples per pixel of a device with a GPU, unless another number is asked for.
pub const USUAL_MSAA: u32 = 4;
/// Pages of the store of a device with a GPU, unless another number is asked for: 134 MB.
pub const USUAL_STORE_PAGES: u32 = 6;

impl Default for ClientOptions {
    fn default() -> Self {
        Self {
            interpolation: Interpolation::Cubic,
            msaa: None,
            lookup: Lookup::default(),
            decoding: DecodeTiming::Thread { now: platform::CLOCK },
            codecs: &[Codec::H264],
            decoder: platform::decoder,
            max_vertex_slots: DEFAULT_VERTEX_SLOTS,
            max_patch_slots: DEFAULT_PATCH_SLOTS,
            max_triangles: DEFAULT_TRIANGLES,
            motion: MotionMemory::DEFAULT,
            store_pages: None,
            blends: None,
        }
    }
}

impl ClientOptions {
    /// Samples per pixel on a device. Without a GPU each costs as much as a pixel.
    pub(crate) fn msaa_on(&self, gpu: &Gpu) -> u32 {
        self.msaa.unwrap_or(if gpu.is_cpu() { 1 } else { USUAL_MSAA })
    }

    /// The same with what depends on the device. Without a GPU, the copies and lookups of a store, and lookups in two pictures, take
    /// the time of updates.
    pub(crate) fn resolved_on(self, gpu: &Gpu) -> Self {
        let store_pages = self.store_pages.unwrap_or(if gpu.is_cpu() { 0 } else { USUAL_STORE_PAGES });
        let blends = self.blends.unwrap_or(!gpu.is_cpu());
        Self { store_pages: Some(store_pages), blends: Some(blends), ..self }
    }

    /// What lookups in blocks have to find, of resolved options.
    pub(crate) fn colours(&self) -> Colours {
        let Self { lookup, store_pages, blends, .. } = self;
        Colours { lookup: *lookup, has_store: store_pages.unwrap_or(0) > 0, blends: blends.unwrap_or(false) }
    }
}

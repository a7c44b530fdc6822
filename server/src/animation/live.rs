//! Live poses on their way to the GPU. The GPU evaluates them as tracks of one key.

use super::buffers::AnimationBuffers;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Memory, Recorder};
use std::sync::Arc;

/// Bytes of a key.
const KEY_BYTES: usize = 16;

/// Poses that wait for the next recording.
pub(crate) struct LivePoses {
    /// A mirror of the part of the keys that is live.
    upload: Buffer,
    /// First key that is live.
    first_key: u32,
    /// Ranges of keys, first and count.
    fresh: Vec<(u32, u32)>,
}

impl LivePoses {
    /// For what is live among the keys of a scene.
    pub(crate) fn new(gpu: &Arc<Gpu>, animation: &AnimationBuffers) -> Result<Self, GpuError> {
        let keys = animation.manager.live_key_range();
        let upload = Buffer::new(gpu, "live poses", keys.len() as u64 * KEY_BYTES as u64, Memory::Upload)?;
        Ok(Self { upload, first_key: keys.start, fresh: Vec::new() })
    }

    /// Takes the keys of a pose, which belong to the key of this number and those after it.
    pub(crate) fn add(&mut self, (first, keys): (u32, Vec<[f32; 4]>)) {
        self.upload.write((first - self.first_key) as usize * KEY_BYTES, bytemuck::cast_slice(&keys));
        self.fresh.push((first, keys.len() as u32));
    }

    /// Brings what was taken to the keys. Nothing recorded before still reads what it takes the place of.
    pub(crate) fn record(&mut self, recorder: &mut Recorder, animation: &AnimationBuffers) {
        if self.fresh.is_empty() {
            return;
        }
        recorder.barrier(Access::COMPUTE_READ, Access::COPY_WRITE);
        for (first, count) in self.fresh.drain(..) {
            let [from, to, size] =
                [first - self.first_key, first, count].map(|keys| u64::from(keys) * KEY_BYTES as u64);
            recorder.copy_buffer(&self.upload, from, &animation.keys, to, size);
        }
        recorder.barrier(Access::COPY_WRITE, Access::COMPUTE_READ);
    }
}

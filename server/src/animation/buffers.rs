//! Skeletons and clips on the GPU.

use super::manager::AnimationManager;
use crate::support::upload;
use shadecast_gpu::{Bind, Buffer, Gpu, GpuError};
use std::sync::Arc;

/// The animation manager with its arrays on the GPU.
pub struct AnimationBuffers {
    /// Skeletons, clips and who uses them; its arrays are empty, the GPU has them.
    pub manager: AnimationManager,
    /// Bytes of the arrays.
    pub bytes: u64,
    pub(crate) level_starts: Buffer,
    parents: Buffer,
    tracks: Buffer,
    /// Of clips, and of live poses.
    pub(super) keys: Buffer,
    key_times: Buffer,
    entries: Buffer,
}

impl AnimationBuffers {
    /// Brings the arrays to the device.
    pub(crate) fn new(gpu: &Arc<Gpu>, mut manager: AnimationManager) -> Result<Self, GpuError> {
        let arrays = std::mem::take(&mut manager.arrays);
        Ok(Self {
            manager,
            bytes: arrays.bytes(),
            level_starts: upload::array(gpu, "bone levels", &arrays.level_starts)?,
            parents: upload::array(gpu, "bone parents", &arrays.parents)?,
            tracks: upload::array(gpu, "animation meta", &arrays.tracks)?,
            keys: upload::array(gpu, "keyframes", &arrays.keys)?,
            key_times: upload::array(gpu, "keyframe times", &arrays.key_times)?,
            entries: upload::array(gpu, "inverse bind matrices", &arrays.entries)?,
        })
    }

    /// What evaluates a bone.
    pub(crate) fn binds(&self) -> Vec<(&'static str, Bind<'_>)> {
        vec![
            ("Parents", Bind::Buffer(&self.parents)),
            ("Tracks", Bind::Buffer(&self.tracks)),
            ("Keys", Bind::Buffer(&self.keys)),
            ("KeyTimes", Bind::Buffer(&self.key_times)),
            ("Entries", Bind::Buffer(&self.entries)),
        ]
    }
}

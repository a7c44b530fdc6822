//! The device's queues. A server has two lanes, for work that goes on side by side: two queues where the device has them, one for both
//! elsewhere. A client has one, its runtime's.

use crate::{Doing, GpuError};
use ash::vk;
use std::sync::atomic::{AtomicU64, Ordering};

/// Queues that are asked for, of one family.
pub(crate) const LANES: usize = 2;

/// What a recording is submitted to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Lane {
    /// All that has no reason to be elsewhere.
    Main,
    /// What may run beside it.
    Beside,
}

/// The queues, with how far each lane has come.
pub(crate) struct Lanes {
    queues: [vk::Queue; LANES],
    /// Timeline semaphores whose values are serials; none where there is one lane.
    done: Option<[vk::Semaphore; LANES]>,
    /// The last serial of each that the CPU knows to be done.
    completed: [AtomicU64; LANES],
}

impl Lanes {
    /// Of a device with `queues` queues of a family: one or two.
    pub(crate) fn new(
        device: &ash::Device,
        family: u32,
        queues: u32,
        is_server: bool,
    ) -> Result<Self, GpuError> {
        // SAFETY: so many queues of the family were asked for in the device's creation.
        let queue = |index: u32| unsafe { device.get_device_queue(family, index.min(queues - 1)) };
        let done = is_server.then(|| -> Result<_, GpuError> { Ok([timeline(device)?, timeline(device)?]) });
        Ok(Self { queues: [queue(0), queue(1)], done: done.transpose()?, completed: Default::default() })
    }

    /// The queue of what has no reason to be elsewhere.
    pub(crate) fn main(&self) -> vk::Queue {
        self.queues[Lane::Main as usize]
    }

    /// Submits what `info` holds. It sees what all recordings wrote that are known to be done by now, and those before it in its lane.
    /// The caller lets nobody else submit meanwhile, and gives ascending serials.
    pub(crate) fn submit(
        &self,
        device: &ash::Device,
        lane: Lane,
        serial: u64,
        info: vk::SubmitInfo<'_>,
        fence: vk::Fence,
    ) -> Result<(), GpuError> {
        let this = lane as usize;
        let other = LANES - 1 - this;
        // SAFETY: the buffers are recorded, the fence is unsignalled, and the queue is only used by the caller and,
        // for a client, by the OpenXR runtime inside calls made from the same thread.
        let submit = |info| unsafe { device.queue_submit(self.queues[this], &[info], fence) };
        let Some(done) = self.done else { return submit(info).doing("submitting") };
        let (waits, signals, stages) = ([done[other]], [done[this]], [vk::PipelineStageFlags::ALL_COMMANDS]);
        let (seen, signalled) = ([self.completed[other].load(Ordering::Acquire)], [serial]);
        let mut values = vk::TimelineSemaphoreSubmitInfo::default()
            .wait_semaphore_values(&seen)
            .signal_semaphore_values(&signalled);
        let info = info.wait_semaphores(&waits).wait_dst_stage_mask(&stages).signal_semaphores(&signals);
        submit(info.push_next(&mut values)).doing("submitting")
    }

    /// A recording is known to be done.
    pub(crate) fn note(&self, lane: Lane, serial: u64) {
        self.completed[lane as usize].fetch_max(serial, Ordering::AcqRel);
    }

    pub(crate) fn destroy(&self, device: &ash::Device) {
        for semaphore in self.done.into_iter().flatten() {
            // SAFETY: called with the device idle.
            unsafe { device.destroy_semaphore(semaphore, None) };
        }
    }
}

fn timeline(device: &ash::Device) -> Result<vk::Semaphore, GpuError> {
    let mut kind = vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
    let info = vk::SemaphoreCreateInfo::default().push_next(&mut kind);
    // SAFETY: the device is alive; servers ask for the feature.
    unsafe { device.create_semaphore(&info, None) }.doing("creating a semaphore")
}

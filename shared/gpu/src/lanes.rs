//! The device's queues. A server has two lanes for parallel work: two queues where the device has them, else one for both. A
//! client has one, its runtime's.

use crate::{Doing, GpuError};
use ash::vk;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

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

/// What a recording waits for and signals beside its lane: a window's semaphores, which have no values.
#[derive(Clone, Copy, Default)]
pub(crate) struct Between {
    /// Waited for before colour is written.
    pub(crate) before: Option<vk::Semaphore>,
    /// Signalled after all of it.
    pub(crate) after: Option<vk::Semaphore>,
}

/// The queues, with how far each lane has come.
pub(crate) struct Lanes {
    queues: [vk::Queue; LANES],
    /// Timeline semaphores whose values are serials; none where there is one lane.
    done: Option<[vk::Semaphore; LANES]>,
    /// The last serial of each that the CPU knows to be done.
    completed: [AtomicU64; LANES],
    turn: Turn,
}

/// Who may use the queues: Vulkan wants one thread at a time.
enum Turn {
    /// A server's threads, which wait for each other.
    Several(Mutex<()>),
    /// A client's one thread, which waits for nobody. Its queue is the runtime's too, inside the calls that this thread makes.
    One(AtomicBool),
}

impl Turn {
    fn take<R>(&self, body: impl FnOnce() -> R) -> R {
        match self {
            Self::Several(turn) => {
                let _turn = turn.lock().expect("not poisoned");
                body()
            }
            Self::One(is_taken) => {
                let was_taken = is_taken.swap(true, Ordering::Acquire);
                assert!(!was_taken, "a second thread uses the queue of a client");
                let result = body();
                is_taken.store(false, Ordering::Release);
                result
            }
        }
    }
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
        let turn = if is_server { Turn::Several(Mutex::default()) } else { Turn::One(AtomicBool::default()) };
        Ok(Self {
            queues: [queue(0), queue(1)],
            done: done.transpose()?,
            completed: Default::default(),
            turn,
        })
    }

    /// Uses the queues while no other thread does.
    pub(crate) fn in_turn<R>(&self, body: impl FnOnce() -> R) -> R {
        self.turn.take(body)
    }

    #[cfg(feature = "window")]
    /// The queue of what has no reason to be elsewhere.
    pub(crate) fn main(&self) -> vk::Queue {
        self.queues[Lane::Main as usize]
    }

    /// Submits a recording. It sees what all recordings wrote that are known to be done by now, and those before it in its lane.
    /// To be called [`Self::in_turn`], with ascending serials.
    pub(crate) fn submit(
        &self,
        device: &ash::Device,
        lane: Lane,
        serial: u64,
        commands: vk::CommandBuffer,
        between: Between,
        fence: vk::Fence,
    ) -> Result<(), GpuError> {
        let (this, commands) = (lane as usize, [commands]);
        let other = LANES - 1 - this;
        let [own_wait, own_signal] =
            self.done.map_or_else(Default::default, |done| [done[other], done[this]]);
        // Lists begin with the lane's own, where it has one; they end with the window's, which have no values.
        let waits = [own_wait, between.before.unwrap_or_default()];
        let signals = [own_signal, between.after.unwrap_or_default()];
        let first = usize::from(self.done.is_none());
        let waited = first..1 + usize::from(between.before.is_some());
        let signalled = first..1 + usize::from(between.after.is_some());
        let values_before = [self.completed[other].load(Ordering::Acquire), 0];
        let values_after = [serial, 0];
        let stages = [vk::PipelineStageFlags::ALL_COMMANDS, vk::PipelineStageFlags::COLOR_ATTACHMENT_OUTPUT];
        let mut values = vk::TimelineSemaphoreSubmitInfo::default()
            .wait_semaphore_values(&values_before[waited.clone()])
            .signal_semaphore_values(&values_after[signalled.clone()]);
        let mut info = vk::SubmitInfo::default()
            .command_buffers(&commands)
            .wait_semaphores(&waits[waited.clone()])
            .wait_dst_stage_mask(&stages[waited])
            .signal_semaphores(&signals[signalled]);
        if self.done.is_some() {
            info = info.push_next(&mut values);
        }
        // SAFETY: the buffers are recorded, the fence is unsignalled, and the queue is only used by the caller and,
        // for a client, by the OpenXR runtime inside calls made from the same thread.
        unsafe { device.queue_submit(self.queues[this], &[info], fence) }.doing("submitting")
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn threads_of_a_server_wait_for_their_turn() {
        let turn = Turn::Several(Mutex::default());
        let inside = AtomicU64::new(0);
        let uses = || {
            for _ in 0..1000 {
                turn.take(|| {
                    assert_eq!(inside.fetch_add(1, Ordering::AcqRel), 0, "alone");
                    inside.fetch_sub(1, Ordering::AcqRel);
                });
            }
        };
        std::thread::scope(|scope| (0..3).for_each(|_| drop(scope.spawn(uses))));
    }

    #[test]
    #[should_panic(expected = "a second thread uses the queue of a client")]
    fn a_client_has_one_thread_that_submits() {
        let turn = Turn::One(AtomicBool::default());
        turn.take(|| turn.take(|| ()));
    }
}

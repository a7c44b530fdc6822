//! The runtime's state behind one lock: one instance, at most one session in it, and the state that outlives a lost instance.

use std::collections::{HashMap, VecDeque};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use openxr_sys as xr;
use xr::Handle as _;

use crate::actions::Actions;
use crate::clock::Grid;
use crate::config::{ClockKind, EventKind, MockConfig};
use crate::debug_utils::{Labels, Messenger, ObjectNames};
use crate::fault::{CallResult, Fault};
use crate::frame::FrameLoop;
use crate::gpu::Gpu;
use crate::head_path::HeadPath;
use crate::paths::Paths;
use crate::profiles::KnownProfile;
use crate::record;
use crate::record::{Recorder, Summary};
use crate::session::SessionState;
use crate::space::Space;
use crate::swapchain::Swapchain;
use crate::vulkan::Vulkan;
use shadecast_protocol::pose::Pose;

/// The runtime's memory.
#[derive(Default)]
pub(crate) struct Runtime {
    pub(crate) instance: Option<InstanceState>,
    /// Where the world stood when an instance was lost, for the instance that follows it.
    pub(crate) resume: Option<Resume>,
    handles: u64,
}

/// What goes on behind the loss of an instance, or of a session whose instance goes with it: the next instance of the same configuration continues the frame numbers, the
/// virtual clock, the head path, the log and the counts, so that scripted events do not happen again.
pub(crate) struct Resume {
    pub(crate) config: MockConfig,
    pub(crate) timeline: Timeline,
    pub(crate) tally: Tally,
}

pub(crate) struct InstanceState {
    pub(crate) core: Core,
    pub(crate) session: Option<Session>,
}

/// What belongs to the instance.
pub(crate) struct Core {
    pub(crate) handle: u64,
    pub(crate) extensions: Extensions,
    pub(crate) config: MockConfig,
    pub(crate) head_path: HeadPath,
    pub(crate) timeline: Timeline,
    pub(crate) tally: Tally,
    pub(crate) recorder: Option<Recorder>,
    pub(crate) events: VecDeque<Event>,
    /// From when on the stage has which origin, in the frame of the head path.
    pub(crate) path_from_stage: Vec<(i64, Pose)>,
    pub(crate) paths: Paths,
    pub(crate) actions: Actions,
    pub(crate) messengers: Vec<Messenger>,
    pub(crate) object_names: ObjectNames,
    pub(crate) vulkan: Option<Vulkan>,
    pub(crate) requirements_asked: bool,
    /// `XrTime` in nanoseconds from which on every call answers INSTANCE_LOST.
    pub(crate) loss_time_ns: Option<i64>,
    pub(crate) lost: bool,
    /// Its last session was lost, and none has come after it.
    pub(crate) lost_session: bool,
}

/// The extensions that the application enabled.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Extensions {
    pub(crate) vulkan_enable2: bool,
    pub(crate) convert_time: bool,
    pub(crate) refresh_rate: bool,
    pub(crate) performance: bool,
    pub(crate) debug_utils: bool,
    pub(crate) foveation: bool,
    pub(crate) foveation_configuration: bool,
    pub(crate) swapchain_update_state: bool,
    pub(crate) foveation_vulkan: bool,
}

/// What belongs to the session.
pub(crate) struct Session {
    pub(crate) handle: u64,
    pub(crate) state: SessionState,
    pub(crate) frames: FrameLoop,
    /// Swapchain and release of both views that the last frame showed.
    pub(crate) shown: Option<[(u64, u64); 2]>,
    /// Pictures were due of a frame that showed the one before again: of the next picture they are.
    pub(crate) capture_is_due: bool,
    /// When a session that rests is READY again, nanoseconds of `XrTime`.
    pub(crate) ready_ns: Option<i64>,
    /// `XrTime` in nanoseconds from which on every call answers SESSION_LOST.
    pub(crate) loss_time_ns: Option<i64>,
    pub(crate) lost: bool,
    pub(crate) gpu: Gpu,
    pub(crate) swapchains: HashMap<u64, Swapchain>,
    /// The level of each profile.
    pub(crate) foveation_profiles: HashMap<u64, i32>,
    pub(crate) spaces: HashMap<u64, Space>,
    pub(crate) action_sets_attached: bool,
    /// What the application knows of the controllers' profile.
    pub(crate) profile: Option<KnownProfile>,
    pub(crate) labels: Labels,
}

/// An event that waits for `xrPollEvent`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Event {
    SessionState { session: u64, state: xr::SessionState, time_ns: i64 },
    InstanceLossPending { loss_time_ns: i64 },
    InteractionProfile { session: u64 },
    RefreshRate { from_hz: f32, to_hz: f32 },
    SpaceChange { session: u64, space: xr::ReferenceSpaceType, change_time_ns: i64, previous_from_new: Pose },
}

impl Event {
    /// Whether it is about a session, which has to be there when it is told.
    pub(crate) fn is_of(&self, this: u64) -> bool {
        match self {
            Self::SessionState { session, .. }
            | Self::SpaceChange { session, .. }
            | Self::InteractionProfile { session } => *session == this,
            Self::InstanceLossPending { .. } | Self::RefreshRate { .. } => false,
        }
    }
}

/// How far the display's clock has come.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Timeline {
    /// `XrTime` of the first `xrWaitFrame` in nanoseconds; the head path's time 0.
    pub(crate) origin_ns: Option<i64>,
    /// Display periods, once they are of another length than the configuration says.
    pub(crate) grid: Option<Grid>,
    /// Display period of the last frame.
    pub(crate) last_period: Option<u64>,
    /// Index of the next frame.
    pub(crate) next_frame: u64,
}

/// What is counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Tally {
    pub(crate) errors: u64,
    /// What was last asked of processor and graphics processor; 0 before.
    pub(crate) performance_levels: [i32; 2],
    /// What foveation was asked for last; 0 before.
    pub(crate) foveation_level: i32,
    pub(crate) missed_frames: u64,
    pub(crate) empty_frames: u64,
    pub(crate) repeated_frames: u64,
    pub(crate) discarded_frames: u64,
    pub(crate) captured_frames: u64,
    pub(crate) other_display_times: u64,
}

static RUNTIME: Mutex<Option<Runtime>> = Mutex::new(None);
static FRAME_BEGUN: Condvar = Condvar::new();

/// The lock, held.
pub(crate) struct Locked(MutexGuard<'static, Option<Runtime>>);

/// Takes the lock. A thread that panicked with the lock held leaves state that is still consistent enough to end on.
pub(crate) fn lock() -> Locked {
    let mut guard = RUNTIME.lock().unwrap_or_else(PoisonError::into_inner);
    guard.get_or_insert_with(Runtime::default);
    Locked(guard)
}

impl std::ops::Deref for Locked {
    type Target = Runtime;

    fn deref(&self) -> &Runtime {
        self.0.as_ref().expect("lock() fills it")
    }
}

impl std::ops::DerefMut for Locked {
    fn deref_mut(&mut self) -> &mut Runtime {
        self.0.as_mut().expect("lock() fills it")
    }
}

impl Locked {
    /// Lets go of the lock until a frame is begun or abandoned, at most for `patience`.
    pub(crate) fn wait_for_frame_begun(self, patience: std::time::Duration) -> Self {
        let (guard, _) = FRAME_BEGUN.wait_timeout(self.0, patience).unwrap_or_else(PoisonError::into_inner);
        Self(guard)
    }
}

/// Wakes threads in `xrWaitFrame` that wait for the frame before theirs.
pub(crate) fn notify_frame_begun() {
    FRAME_BEGUN.notify_all();
}

impl Runtime {
    /// A handle or other id that was never given out before, never 0.
    pub(crate) fn new_handle(&mut self) -> u64 {
        self.handles += 1;
        // The high bits make a handle unlike any index or pointer that might be passed by mistake.
        0x5dc0_0000_0000_0000 | self.handles
    }

    /// The instance of `handle`, lost or not.
    pub(crate) fn instance_even_lost(&mut self, handle: xr::Instance) -> CallResult<&mut InstanceState> {
        let raw = handle.into_raw();
        self.instance.as_mut().filter(|i| i.core.handle == raw).ok_or_else(|| Fault::handle("instance"))
    }

    /// Those of the session that there is.
    pub(crate) fn labels(&self) -> Labels {
        let session = self.instance.as_ref().and_then(|instance| instance.session.as_ref());
        session.map_or_else(Labels::default, |session| session.labels.clone())
    }

    /// The instance of `handle`; a lost one is refused.
    pub(crate) fn core(&mut self, handle: xr::Instance) -> CallResult<&mut Core> {
        let core = &mut self.instance_even_lost(handle)?.core;
        core.present()?;
        Ok(core)
    }

    /// The instance, for the use of `handle`, a handle below it; a lost one is refused.
    pub(crate) fn core_of_child(&mut self, kind: &str) -> CallResult<&mut Core> {
        let core = &mut self.instance.as_mut().ok_or_else(|| Fault::handle(kind))?.core;
        core.present()?;
        Ok(core)
    }

    /// The session of `handle` and its instance; a lost one is refused.
    pub(crate) fn session(&mut self, handle: xr::Session) -> CallResult<(&mut Core, &mut Session)> {
        let raw = handle.into_raw();
        self.session_where("session", |session| session.handle == raw)
    }

    /// The session that owns the swapchain of `handle`, and the instance; a lost one is refused.
    pub(crate) fn session_of_swapchain(
        &mut self,
        handle: xr::Swapchain,
    ) -> CallResult<(&mut Core, &mut Session)> {
        let raw = handle.into_raw();
        self.session_where("swapchain", |session| session.swapchains.contains_key(&raw))
    }

    /// The session that owns the space of `handle`, and the instance; a lost one is refused.
    pub(crate) fn session_of_space(&mut self, handle: xr::Space) -> CallResult<(&mut Core, &mut Session)> {
        let raw = handle.into_raw();
        self.session_where("space", |session| session.spaces.contains_key(&raw))
    }

    fn session_where(
        &mut self,
        kind: &str,
        is_it: impl Fn(&Session) -> bool,
    ) -> CallResult<(&mut Core, &mut Session)> {
        let found = self.instance.as_mut().and_then(|InstanceState { core, session }| {
            session.as_mut().filter(|session| is_it(session)).map(|session| (core, session))
        });
        let (core, session) = found.ok_or_else(|| Fault::handle(kind))?;
        core.present()?;
        session.present()?;
        Ok((core, session))
    }
}

impl Session {
    /// Whether it is lost, or about to be.
    pub(crate) fn loses(&self) -> bool {
        self.lost || self.loss_time_ns.is_some()
    }

    fn present(&self) -> CallResult<()> {
        match self.lost {
            true => Err(Fault::quiet(xr::Result::ERROR_SESSION_LOST)),
            false => Ok(()),
        }
    }
}

impl Core {
    fn present(&self) -> CallResult<()> {
        match self.lost {
            true => Err(Fault::quiet(xr::Result::ERROR_INSTANCE_LOST)),
            false => Ok(()),
        }
    }

    /// Now, in nanoseconds of `XrTime`: on the virtual clock the begin of the period of the last `xrWaitFrame`.
    pub(crate) fn now_ns(&self) -> i64 {
        match self.config.clock {
            ClockKind::Real => shadecast_system::monotonic_now_ns(),
            ClockKind::Virtual => self.grid().begin_ns(self.timeline.last_period.unwrap_or(0)),
        }
    }

    /// The display periods.
    pub(crate) fn grid(&self) -> Grid {
        let base_ns = self.timeline.origin_ns.unwrap_or(self.config.virtual_start_ns);
        self.timeline.grid.unwrap_or(Grid { base_ns, base_period: 0, hz: self.config.refresh_hz })
    }

    /// One period without a frame, on the virtual clock; the real one needs no help.
    pub(crate) fn let_period_pass(&mut self) {
        if self.config.clock == ClockKind::Virtual {
            self.timeline.last_period = Some(self.timeline.last_period.map_or(0, |last| last + 1));
        }
    }

    /// Seconds on the head path at `time_ns`. Before the first `xrWaitFrame` the path has not begun: its time is 0.
    pub(crate) fn path_time_s(&self, time_ns: i64) -> f64 {
        self.timeline.origin_ns.map_or(0.0, |origin_ns| time_ns.saturating_sub(origin_ns) as f64 * 1e-9)
    }

    /// What happens at frame `frame`, by the script.
    pub(crate) fn scripted(&self, frame: u64) -> Vec<EventKind> {
        self.config.events.iter().filter(|event| event.frame == frame).map(|event| event.kind).collect()
    }

    /// Writes the summary where there is a capture folder.
    pub(crate) fn write_summary(&self) {
        let Some(recorder) = &self.recorder else { return };
        let periods = self.timeline.last_period.unwrap_or(0);
        let summary = Summary {
            frames: self.timeline.next_frame,
            seconds: self.path_time_s(self.grid().begin_ns(periods)),
            errors: self.tally.errors,
            performance_levels: self.tally.performance_levels,
            foveation_level: self.tally.foveation_level,
            missed_frames: self.tally.missed_frames,
            empty_frames: self.tally.empty_frames,
            repeated_frames: self.tally.repeated_frames,
            discarded_frames: self.tally.discarded_frames,
            captured_frames: self.tally.captured_frames,
            other_display_times: self.tally.other_display_times,
        };
        if let Err(error) = recorder.summary(&summary) {
            eprintln!(
                "shadecast-mock-runtime: cannot write {} into the capture folder: {error}",
                record::SUMMARY_NAME
            );
        }
    }
}

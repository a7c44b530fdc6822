//! The frame loop: `xrWaitFrame` paces, `xrBeginFrame` and `xrEndFrame` bracket the rendering. The end of a frame is checked,
//! logged and captured.

use std::time::Duration;

use openxr_sys as xr;

use crate::capture;
use crate::clock;
use crate::config::{ClockKind, EventKind};
use crate::fault::{CallResult, Fault};
use crate::ffi::entry;
use crate::layers;
use crate::runtime::{self, Core, Locked, Session};
use crate::session;

/// One frame between its `xrWaitFrame` and its `xrEndFrame`. Times in nanoseconds of `XrTime`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Frame {
    pub(crate) index: u64,
    pub(crate) wait_time_ns: i64,
    pub(crate) display_time_ns: i64,
}

/// Which frames are on their way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct FrameLoop {
    /// A thread is in `xrWaitFrame`, asleep until its period begins.
    sleeping: bool,
    waited: Option<Frame>,
    begun: Option<Frame>,
}

/// How long `xrWaitFrame` waits for the `xrBeginFrame` of the frame before. The specification says for ever; a
/// single-threaded application that forgot the call would then hang without a word.
const BEGIN_PATIENCE: Duration = Duration::from_secs(5);

entry! {
    wait_frame: WaitFrame = "xrWaitFrame"(
        session: value xr::Session,
        frame_wait_info: optional xr::FrameWaitInfo,
        frame_state: output xr::FrameState,
    ) {
        let _ = frame_wait_info;
        let mut runtime = turn_to_wait(session)?;
        let (core, this) = runtime.session(session)?;
        let period = start_waiting(core, this);
        let begin_ns = begin_of_period(core, period);
        if core.config.clock == ClockKind::Real {
            drop(runtime);
            sleep_until(begin_ns);
            runtime = runtime::lock();
        }
        let (core, this) = runtime.session(session)?;
        this.frames.sleeping = false;
        this.state.check_running()?;
        let frame = start_frame(core, this, period);
        this.frames.waited = Some(frame);
        frame_state.predicted_display_time = xr::Time::from_nanos(frame.display_time_ns);
        frame_state.predicted_display_period = xr::Duration::from_nanos(clock::period_ns(core.grid().hz));
        frame_state.should_render = this.state.should_render().into();
        Ok(xr::Result::SUCCESS)
    }
}

/// Takes the lock once the frame before has begun.
fn turn_to_wait(session: xr::Session) -> CallResult<Locked> {
    let give_up = std::time::Instant::now() + BEGIN_PATIENCE;
    let mut runtime = runtime::lock();
    loop {
        let (_, this) = runtime.session(session)?;
        this.state.check_running()?;
        if !this.frames.sleeping && this.frames.waited.is_none() {
            return Ok(runtime);
        }
        let patience = give_up.saturating_duration_since(std::time::Instant::now());
        if patience.is_zero() {
            return Err(Fault::order("the frame before was waited for and, 5 seconds later, has not begun"));
        }
        runtime = runtime.wait_for_frame_begun(patience);
    }
}

/// The display period of the next frame, and the start of the display's clock at the first.
fn start_waiting(core: &mut Core, session: &mut Session) -> u64 {
    session.frames.sleeping = true;
    let virtual_start_ns = core.config.virtual_start_ns;
    let last = core.timeline.last_period;
    match core.config.clock {
        ClockKind::Virtual => {
            core.timeline.origin_ns.get_or_insert(virtual_start_ns);
            last.map_or(0, |last| last + 1)
        }
        ClockKind::Real => {
            let now_ns = shadecast_system::monotonic_now_ns();
            core.timeline.origin_ns.get_or_insert(now_ns);
            core.grid().next_real(last, now_ns)
        }
    }
}

fn begin_of_period(core: &Core, period: u64) -> i64 {
    core.grid().begin_ns(period)
}

fn sleep_until(time_ns: i64) {
    while let Ok(rest_ns @ 1..) = u64::try_from(time_ns - shadecast_system::monotonic_now_ns()) {
        std::thread::sleep(Duration::from_nanos(rest_ns));
    }
}

/// Advances the display's clock to `period`, and lets happen what happens at this frame.
fn start_frame(core: &mut Core, session: &mut Session, period: u64) -> Frame {
    let index = core.timeline.next_frame;
    let skipped = core.timeline.last_period.map_or(0, |last| period - last - 1);
    core.tally.missed_frames += skipped;
    core.timeline.last_period = Some(period);
    core.timeline.next_frame += 1;
    for kind in core.scripted(index) {
        session::happen(core, session, kind);
    }
    let begin_ns = begin_of_period(core, period);
    let since_origin_s = core.path_time_s(begin_ns);
    if core.config.seconds > 0.0 && since_origin_s >= core.config.seconds {
        session::happen(core, session, EventKind::Stop);
    }
    let is_over =
        |loss_time_ns: Option<i64>| loss_time_ns.is_some_and(|loss_time_ns| begin_ns >= loss_time_ns);
    core.lost |= is_over(core.loss_time_ns);
    session.lost |= is_over(session.loss_time_ns);
    Frame { index, wait_time_ns: core.now_ns(), display_time_ns: begin_of_period(core, period + 1) }
}

entry! {
    begin_frame: BeginFrame = "xrBeginFrame"(
        session: value xr::Session,
        frame_begin_info: optional xr::FrameBeginInfo,
    ) {
        let _ = frame_begin_info;
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        session.state.check_running()?;
        let Some(frame) = session.frames.waited.take() else {
            return Err(Fault::order("no frame was waited for; call xrWaitFrame first"));
        };
        runtime::notify_frame_begun();
        let Some(discarded) = session.frames.begun.replace(frame) else { return Ok(xr::Result::SUCCESS) };
        core.tally.discarded_frames += 1;
        capture::log_discarded(core, &discarded)?;
        Ok(xr::Result::FRAME_DISCARDED)
    }
}

entry! {
    end_frame: EndFrame = "xrEndFrame"(
        session: value xr::Session,
        frame_end_info: input xr::FrameEndInfo,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        session.state.check_running()?;
        let Some(frame) = session.frames.begun else {
            return Err(Fault::order("no frame was begun; call xrBeginFrame first"));
        };
        let submitted = layers::check(core, session, frame_end_info, &frame)?;
        session.frames.begun = None;
        // Allowed, and in the application's own interest not to do.
        core.tally.other_display_times +=
            u64::from(frame_end_info.display_time.as_nanos() != frame.display_time_ns);
        capture::log_and_capture(core, session, &frame, submitted.as_ref())?;
        let states = session.state.frame_ended();
        session::announce(core, session.handle, states);
        Ok(xr::Result::SUCCESS)
    }
}

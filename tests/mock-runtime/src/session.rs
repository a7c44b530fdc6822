//! The session: its life from READY to EXITING, and its creation on the application's Vulkan device.

use openxr_sys as xr;
use xr::Handle as _;

use crate::config::EventKind;
use crate::debug_utils::Labels;
use crate::fault::{CallResult, Fault};
use crate::ffi::{self, entry};
use crate::frame::FrameLoop;
use crate::gpu::Gpu;
use crate::instance::{check_system, check_view_configuration};
use crate::runtime::{self, Core, Event, Session};
use crate::{refresh_rate, space};

type State = xr::SessionState;

/// Where the session stands. Every method that moves it gives the states that it passes through, to be announced.
///
/// IDLE and READY are announced at creation. SYNCHRONIZED, VISIBLE and FOCUSED follow the first `xrEndFrame`, so the
/// first frame is never rendered. A stop passes VISIBLE, SYNCHRONIZED and STOPPING; `xrEndSession` leads to EXITING, or in
/// a pause to IDLE and, when it is over, to READY. From LOSS_PENDING nothing leads on: the application destroys the session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SessionState {
    current: State,
    running: bool,
    /// False while something else has the focus.
    focus: bool,
    /// False while something else is shown.
    shown: bool,
    /// Milliseconds that the session rests once it is ended, where it is to go on after that.
    pause_ms: Option<u32>,
}

impl SessionState {
    pub(crate) fn new() -> (Self, Vec<State>) {
        let state = Self { current: State::READY, running: false, focus: true, shown: true, pause_ms: None };
        (state, vec![State::IDLE, State::READY])
    }

    fn pass(&mut self, states: &[State]) -> Vec<State> {
        self.current = states.last().copied().unwrap_or(self.current);
        states.to_vec()
    }

    /// Refuses a session that has not begun.
    pub(crate) fn check_running(&self) -> CallResult<()> {
        match self.running {
            true => Ok(()),
            false => Err(Fault::application(
                xr::Result::ERROR_SESSION_NOT_RUNNING,
                "the session has not begun (or has ended); call xrBeginSession at READY",
            )),
        }
    }

    /// True while frames are seen.
    pub(crate) fn should_render(&self) -> bool {
        self.current == State::VISIBLE || self.current == State::FOCUSED
    }

    /// True while the session has input.
    pub(crate) fn is_focused(&self) -> bool {
        self.current == State::FOCUSED
    }

    fn begin(&mut self) -> CallResult<()> {
        if self.running {
            return Err(Fault::application(
                xr::Result::ERROR_SESSION_RUNNING,
                "the session has begun already",
            ));
        }
        if self.current != State::READY {
            let message = format!("the session is {:?}; wait for READY", self.current);
            return Err(Fault::application(xr::Result::ERROR_SESSION_NOT_READY, message));
        }
        self.running = true;
        Ok(())
    }

    fn end(&mut self) -> CallResult<Vec<State>> {
        self.check_running()?;
        if self.current != State::STOPPING {
            let message =
                format!("the session is {:?}; call xrRequestExitSession, wait for STOPPING", self.current);
            return Err(Fault::application(xr::Result::ERROR_SESSION_NOT_STOPPING, message));
        }
        self.running = false;
        match self.pause_ms {
            Some(_) => Ok(self.pass(&[State::IDLE])),
            None => Ok(self.pass(&[State::IDLE, State::EXITING])),
        }
    }

    /// The rest is over.
    fn resume(&mut self) -> Vec<State> {
        self.pause_ms = None;
        self.pass(&[State::READY])
    }

    pub(crate) fn frame_ended(&mut self) -> Vec<State> {
        match self.current {
            State::READY => self.pass(&[&[State::SYNCHRONIZED], self.seen()].concat()),
            _ => Vec::new(),
        }
    }

    /// The states that a synchronised session passes.
    fn seen(&self) -> &'static [State] {
        match (self.shown, self.focus) {
            (false, _) => &[],
            (true, false) => &[State::VISIBLE],
            (true, true) => &[State::VISIBLE, State::FOCUSED],
        }
    }

    fn set_shown(&mut self, shown: bool) -> Vec<State> {
        self.shown = shown;
        match (self.current, shown) {
            (State::FOCUSED, false) => self.pass(&[State::VISIBLE, State::SYNCHRONIZED]),
            (State::VISIBLE, false) => self.pass(&[State::SYNCHRONIZED]),
            (State::SYNCHRONIZED, true) => self.pass(self.seen()),
            _ => Vec::new(),
        }
    }

    /// A stop after which the session goes on.
    fn pause(&mut self, ms: u32) -> Vec<State> {
        let states = self.stop();
        if !states.is_empty() {
            self.pause_ms = Some(ms);
        }
        states
    }

    /// The session is about to be lost, unless it is to stop anyway.
    fn lose(&mut self) -> Vec<State> {
        match self.current {
            State::READY | State::SYNCHRONIZED | State::VISIBLE | State::FOCUSED => {
                self.pass(&[State::LOSS_PENDING])
            }
            _ => Vec::new(),
        }
    }

    fn set_focus(&mut self, focus: bool) -> Vec<State> {
        self.focus = focus;
        match (self.current, focus) {
            (State::FOCUSED, false) => self.pass(&[State::VISIBLE]),
            (State::VISIBLE, true) => self.pass(&[State::FOCUSED]),
            _ => Vec::new(),
        }
    }

    pub(crate) fn stop(&mut self) -> Vec<State> {
        match self.current {
            State::READY => self.pass(&[State::SYNCHRONIZED, State::STOPPING]),
            State::SYNCHRONIZED => self.pass(&[State::STOPPING]),
            State::VISIBLE => self.pass(&[State::SYNCHRONIZED, State::STOPPING]),
            State::FOCUSED => self.pass(&[State::VISIBLE, State::SYNCHRONIZED, State::STOPPING]),
            _ => Vec::new(),
        }
    }
}

/// Puts state changes into the event queue.
pub(crate) fn announce(core: &mut Core, session: u64, states: Vec<State>) {
    let time_ns = core.now_ns();
    let events = states.into_iter().map(|state| Event::SessionState { session, state, time_ns });
    core.events.extend(events);
}

/// How long before the loss of an instance or of a session its announcement comes, nanoseconds.
const LOSS_NOTICE_NS: i64 = 1_000_000_000;

/// Lets a scripted event happen.
pub(crate) fn happen(core: &mut Core, session: &mut Session, kind: EventKind) {
    let states = match kind {
        EventKind::FocusLoss => session.state.set_focus(false),
        EventKind::FocusGain => session.state.set_focus(true),
        EventKind::Hide => session.state.set_shown(false),
        EventKind::Show => session.state.set_shown(true),
        EventKind::Pause { ms } => session.state.pause(ms),
        EventKind::Recentre { x_mm, z_mm, yaw_degrees } => {
            space::recentre(core, session.handle, [x_mm, z_mm], yaw_degrees);
            Vec::new()
        }
        EventKind::RefreshRate { hz } => {
            let rates = core.config.rates_hz();
            rates
                .into_iter()
                .find(|rate| *rate as u32 == hz)
                .into_iter()
                .for_each(|rate| refresh_rate::change(core, rate));
            Vec::new()
        }
        EventKind::Stop => session.state.stop(),
        EventKind::InstanceLoss => {
            let loss_time_ns = core.now_ns() + LOSS_NOTICE_NS;
            core.loss_time_ns = Some(loss_time_ns);
            core.events.push_back(Event::InstanceLossPending { loss_time_ns });
            Vec::new()
        }
        EventKind::SessionLoss => {
            let states = session.state.lose();
            if !states.is_empty() {
                session.loss_time_ns = Some(core.now_ns() + LOSS_NOTICE_NS);
            }
            states
        }
        EventKind::SuddenSessionLoss => {
            session.lost = true;
            Vec::new()
        }
    };
    announce(core, session.handle, states);
}

/// While a session rests, time passes: on the virtual clock one period, since no frame moves it on. READY is announced when
/// the rest is over.
pub(crate) fn rest(core: &mut Core, session: &mut Session) {
    let Some(ready_ns) = session.ready_ns else { return };
    if core.now_ns() < ready_ns {
        core.let_period_pass();
        return;
    }
    session.ready_ns = None;
    let states = session.state.resume();
    announce(core, session.handle, states);
}

/// Destroys a session with everything in it.
pub(crate) fn close(session: Option<Session>) {
    let Some(mut session) = session else { return };
    for (_, swapchain) in session.swapchains.drain() {
        swapchain.destroy(&session.gpu);
    }
    runtime::notify_frame_begun();
}

/// The device of a session. Its order is the conformance suite's: that there is no binding is said before that a call is missing.
fn new_gpu(core: &Core, create_info: &xr::SessionCreateInfo) -> CallResult<Gpu> {
    let invalid = |message: &str| Fault::application(xr::Result::ERROR_GRAPHICS_DEVICE_INVALID, message);
    // SAFETY: the chain of a structure that the application passes in.
    let binding = unsafe { ffi::chained_input::<xr::GraphicsBindingVulkanKHR>(create_info.next) };
    let binding =
        binding.ok_or_else(|| invalid("chain an XrGraphicsBindingVulkan2KHR to XrSessionCreateInfo"))?;
    if !core.requirements_asked {
        let message = "call xrGetVulkanGraphicsRequirements2KHR before xrCreateSession";
        return Err(Fault::application(xr::Result::ERROR_GRAPHICS_REQUIREMENTS_CALL_MISSING, message));
    }
    let vulkan = core.vulkan.as_ref();
    let vulkan = vulkan.ok_or_else(|| invalid("make the Vulkan instance by xrCreateVulkanInstanceKHR"))?;
    Gpu::new(vulkan, binding)
}

entry! {
    create_session: CreateSession = "xrCreateSession"(
        instance: value xr::Instance,
        create_info: input xr::SessionCreateInfo,
        session: slot xr::Session,
    ) {
        let mut runtime = runtime::lock();
        check_system(create_info.system_id)?;
        let handle = runtime.new_handle();
        let core = runtime.core(instance)?;
        let gpu = new_gpu(core, create_info)?;
        let (state, states) = SessionState::new();
        let state_of_instance = runtime.instance_even_lost(instance)?;
        state_of_instance.core.lost_session = false;
        if state_of_instance.session.is_some() {
            let message = "a session exists; destroy it before creating another";
            return Err(Fault::application(xr::Result::ERROR_LIMIT_REACHED, message));
        }
        announce(&mut state_of_instance.core, handle, states);
        state_of_instance.session = Some(Session {
            handle,
            state,
            frames: FrameLoop::default(),
            shown: None,
            capture_is_due: false,
            ready_ns: None,
            loss_time_ns: None,
            lost: false,
            gpu,
            swapchains: Default::default(),
            foveation_profiles: Default::default(),
            spaces: Default::default(),
            action_sets_attached: false,
            profile: None,
            labels: Labels::default(),
        });
        *session = xr::Session::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    destroy_session: DestroySession = "xrDestroySession"(session: value xr::Session) {
        let mut runtime = runtime::lock();
        let raw = session.into_raw();
        let state = runtime.instance.as_mut().ok_or_else(|| Fault::handle("session"))?;
        let removed = state.session.take_if(|session| session.handle == raw);
        if removed.is_none() {
            return Err(Fault::handle("session"));
        }
        state.core.lost_session = removed.as_ref().is_some_and(Session::loses);
        close(removed);
        state.core.events.retain(|event| !event.is_of(raw));
        state.core.actions.detach();
        state.core.write_summary();
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    begin_session: BeginSession = "xrBeginSession"(
        session: value xr::Session,
        begin_info: input xr::SessionBeginInfo,
    ) {
        let mut runtime = runtime::lock();
        let (_, session) = runtime.session(session)?;
        check_view_configuration(begin_info.primary_view_configuration_type)?;
        session.state.begin()?;
        session.frames = FrameLoop::default();
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    end_session: EndSession = "xrEndSession"(session: value xr::Session) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        let states = session.state.end()?;
        session.ready_ns = session.state.pause_ms.map(|ms| core.now_ns() + i64::from(ms) * 1_000_000);
        session.frames = FrameLoop::default();
        announce(core, session.handle, states);
        core.write_summary();
        runtime::notify_frame_begun();
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    request_exit_session: RequestExitSession = "xrRequestExitSession"(session: value xr::Session) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        session.state.check_running()?;
        let states = session.state.stop();
        announce(core, session.handle, states);
        Ok(xr::Result::SUCCESS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn focused() -> SessionState {
        let (mut state, _) = SessionState::new();
        state.begin().expect("READY");
        state.frame_ended();
        state
    }

    #[track_caller]
    fn code<T: std::fmt::Debug>(outcome: CallResult<T>) -> xr::Result {
        outcome.expect_err("must be refused").code
    }

    #[test]
    fn a_session_is_focused_after_its_first_frame() {
        let (mut state, announced) = SessionState::new();
        assert_eq!(announced, [State::IDLE, State::READY]);
        state.begin().expect("READY");
        assert!(!state.should_render());
        assert_eq!(state.frame_ended(), [State::SYNCHRONIZED, State::VISIBLE, State::FOCUSED]);
        assert!(state.should_render() && state.is_focused());
        assert_eq!(state.frame_ended(), []);
    }

    #[test]
    fn a_stopped_session_passes_every_state_and_exits_once_ended() {
        let mut state = focused();
        assert_eq!(state.stop(), [State::VISIBLE, State::SYNCHRONIZED, State::STOPPING]);
        assert_eq!(state.stop(), [], "a second stop changes nothing");
        assert_eq!(state.end().expect("STOPPING"), [State::IDLE, State::EXITING]);
        assert_eq!(code(state.begin()), xr::Result::ERROR_SESSION_NOT_READY);
    }

    #[test]
    fn a_hidden_session_is_synchronised_and_not_to_be_rendered() {
        let mut state = focused();
        assert_eq!(state.set_shown(false), [State::VISIBLE, State::SYNCHRONIZED]);
        assert!(!state.should_render());
        assert_eq!(state.frame_ended(), []);
        assert_eq!(state.set_shown(true), [State::VISIBLE, State::FOCUSED]);
        assert!(state.should_render());
    }

    #[test]
    fn a_paused_session_is_ready_again_and_begins_anew() {
        let mut state = focused();
        assert_eq!(state.pause(500), [State::VISIBLE, State::SYNCHRONIZED, State::STOPPING]);
        assert_eq!(state.end().expect("STOPPING"), [State::IDLE]);
        assert_eq!(code(state.begin()), xr::Result::ERROR_SESSION_NOT_READY);
        assert_eq!(state.resume(), [State::READY]);
        state.begin().expect("READY");
        assert_eq!(state.frame_ended(), [State::SYNCHRONIZED, State::VISIBLE, State::FOCUSED]);
        assert_eq!(state.stop(), [State::VISIBLE, State::SYNCHRONIZED, State::STOPPING]);
        assert_eq!(state.end().expect("STOPPING"), [State::IDLE, State::EXITING]);
    }

    #[test]
    fn a_session_that_is_about_to_be_lost_has_nothing_before_it() {
        let mut state = focused();
        assert_eq!(state.lose(), [State::LOSS_PENDING]);
        assert!(!state.should_render() && !state.is_focused());
        assert_eq!([state.lose(), state.stop(), state.set_focus(false), state.frame_ended()], [[]; 4]);
        assert_eq!(code(state.end()), xr::Result::ERROR_SESSION_NOT_STOPPING);
    }

    #[test]
    fn a_session_that_is_to_stop_is_not_about_to_be_lost() {
        let mut state = focused();
        state.stop();
        assert_eq!(state.lose(), []);
        assert_eq!(state.end().expect("STOPPING"), [State::IDLE, State::EXITING]);
    }

    #[test]
    fn begin_and_end_out_of_order_are_refused() {
        let (mut state, _) = SessionState::new();
        assert_eq!(code(state.end()), xr::Result::ERROR_SESSION_NOT_RUNNING);
        state.begin().expect("READY");
        assert_eq!(code(state.begin()), xr::Result::ERROR_SESSION_RUNNING);
        assert_eq!(code(state.end()), xr::Result::ERROR_SESSION_NOT_STOPPING);
    }

    #[test]
    fn focus_that_is_lost_before_the_first_frame_stays_lost() {
        let (mut state, _) = SessionState::new();
        state.begin().expect("READY");
        assert_eq!(state.set_focus(false), []);
        assert_eq!(state.frame_ended(), [State::SYNCHRONIZED, State::VISIBLE]);
        assert_eq!(state.set_focus(true), [State::FOCUSED]);
    }
}

//! The client in real time: threads, sockets and the clock, and reconnection.
//!
//! Datagrams enter, a server's address and the user's choice. Datagrams leave, and notices for the user. Nothing here knows
//! messages and the GPU.
//!
//! When the server disappears, its last bundle stays on display. When the headset disappears, it is opened again.

mod address;
mod connector;
mod consent;
mod dialler;
mod finder;
mod heard;
mod lines;
mod list;
pub mod traced;
mod trust;
mod wording;

use crate::client::{ClientError, ClientOptions, FrameReport, Step, halves};
use crate::display::rest::rest_ns;
use crate::display::{Display, DisplayError};
use crate::platform::monotonic_now;
use crate::present::presenter::Presenter;
use crate::present::stats::ClientStats;
use crate::stream::intake::Intake;
use crate::stream::taking::Taking;
use address::Address;
use connector::Connector;
use shadecast_protocol::time::ClientTime;
use shadecast_system::clock::thread_cpu_ns;
use shadecast_trace::{Trace, TraceError};
use shadecast_transport::mio::DriverError;
use shadecast_transport::{Fingerprint, IdentityError};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;
use traced::Traced;

/// How long it is tried to open the headset again after it was lost, and how long to wait in between.
const REOPEN_S: i64 = 30;
const REOPEN_WAIT_NS: i64 = 1_000_000_000;
/// How long to sleep where the headset wants no frames.
const IDLE_WAIT: Duration = Duration::from_millis(10);
/// How long to sleep at most without looking whether the user wants to leave.
const LOOK_UP: Duration = Duration::from_millis(50);
/// How long the runtime may take to end a session that was asked to end.
const LEAVE_PATIENCE_NS: i64 = 5_000_000_000;

/// In the names of files that keep compiled pipelines.
const PROGRAM: &str = "client";

/// What `--connect` says for [`Server::Found`].
pub const FIND: &str = "find";

/// Which server to connect to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Server {
    /// As the user writes it: `host:port`.
    At(String),
    /// One that announces itself on this network: the one that was connected last, another that was met before, or the only one.
    Found,
}

impl Server {
    /// Whether it can be a server at all. Whether there is one only the network can say.
    ///
    /// # Errors
    /// It is no address.
    fn check(&self) -> Result<(), RunError> {
        match self {
            Self::At(text) => Address::parse(text).map(|_| ()),
            Self::Found => Ok(()),
        }
    }
}

impl From<&str> for Server {
    fn from(text: &str) -> Self {
        if text == FIND { Self::Found } else { Self::At(text.to_owned()) }
    }
}

/// What to run.
#[derive(Clone, Debug)]
pub struct RunOptions {
    /// The server.
    pub server: Server,
    /// The only identity that the server may have; `None`: the one that is known, or any at the first meeting.
    pub fingerprint: Option<Fingerprint>,
    /// Another app has named the server, or its identity: an unknown one is dialled once the user agrees.
    pub asks_first: bool,
    /// Where the fingerprints of known servers are kept.
    pub identity_dir: PathBuf,
    /// What makes this client forget the servers that it knows, where its user cannot edit their list: a part of a sentence.
    pub forgetting: Option<&'static str>,
    /// What the headset says at first, such as what was wrong with the user's settings.
    pub notice: Option<String>,
    /// How the client behaves.
    pub client: ClientOptions,
    /// Seconds from the start at which the session is asked to end; 0: never.
    pub seconds: f64,
    /// Folder that keeps compiled pipelines for the next start; `None`: each start compiles.
    pub pipelines: Option<PathBuf>,
    /// Writes there what happens when, for Perfetto.
    pub trace: Option<PathBuf>,
}

/// How a run went, and how it ended.
#[derive(Debug)]
pub struct RunOutcome {
    /// What was counted, over all headset sessions of the run; there also where the run failed.
    pub stats: ClientStats,
    /// The run's end.
    pub ended: Result<(), RunError>,
}

/// What ends a run.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The server's address cannot be understood.
    #[error(
        "the server's address \"{address}\" cannot be used: {reason}; write host:port, such as 192.168.1.5:7400"
    )]
    Address {
        /// What was given.
        address: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The list of known servers.
    #[error(transparent)]
    Identity(#[from] IdentityError),
    /// The trace.
    #[error(transparent)]
    Trace(#[from] TraceError),
    /// The socket.
    #[error(transparent)]
    Driver(#[from] DriverError),
    /// Display or device.
    #[error(transparent)]
    Client(#[from] ClientError),
    /// The thread that takes in what arrives.
    #[error("a thread could not be started: {0}; end other programs, or raise the limit of threads")]
    Thread(std::io::Error),
}

impl From<DisplayError> for RunError {
    fn from(error: DisplayError) -> Self {
        Self::Client(error.into())
    }
}

/// Opens the display; once more after it was lost.
pub type Opener<'a> = dyn FnMut() -> Result<Box<dyn Display>, DisplayError> + 'a;

/// Who watches a run: called after each display frame.
pub type Observer<'a> = dyn FnMut(&mut Presenter, &FrameReport) -> Result<(), ClientError> + 'a;

/// Runs until the display's session ends, `stop` is set, the time is over, or something fails for good. A lost display is
/// opened anew; what was counted before counts on.
pub fn run(
    open: &mut Opener<'_>,
    options: &RunOptions,
    stop: &AtomicBool,
    observe: &mut Observer<'_>,
) -> RunOutcome {
    let until = (options.seconds > 0.0).then(|| monotonic_now().plus_ns((options.seconds * 1e9) as i64));
    let mut run = Run { options, stop, until, stats: ClientStats::default() };
    let ended = run.play_out(open, observe);
    RunOutcome { stats: run.stats, ended }
}

/// A run under way.
struct Run<'a> {
    options: &'a RunOptions,
    stop: &'a AtomicBool,
    /// When it is to end by itself.
    until: Option<ClientTime>,
    /// Of the headset sessions that are over.
    stats: ClientStats,
}

impl Run<'_> {
    fn is_over(&self) -> bool {
        self.stop.load(Ordering::Relaxed) || self.until.is_some_and(|until| monotonic_now() >= until)
    }

    fn play_out(&mut self, open: &mut Opener<'_>, observe: &mut Observer<'_>) -> Result<(), RunError> {
        self.options.server.check()?;
        let trace = self.options.trace.as_deref().map(Trace::create).transpose()?;
        let mut opened = Some(open()?);
        while let Some(display) = opened.take() {
            let error = match self.show(display, trace.as_ref(), observe) {
                Err(RunError::Client(error)) if error.is_lost() => error,
                ended => return ended,
            };
            tracing::warn!("{error}; the headset is gone; trying again for {REOPEN_S} s");
            opened = self.reopen(open)?;
        }
        Ok(())
    }

    /// The display, once it can be opened again; `None` where the run is over before.
    fn reopen(&self, open: &mut Opener<'_>) -> Result<Option<Box<dyn Display>>, RunError> {
        let give_up = monotonic_now().plus_ns(REOPEN_S * 1_000_000_000);
        while !self.is_over() {
            match open() {
                Ok(display) => return Ok(Some(display)),
                Err(error) if monotonic_now() >= give_up => return Err(error.into()),
                Err(error) => tracing::debug!("{error}"),
            }
            let next = monotonic_now().plus_ns(REOPEN_WAIT_NS);
            while monotonic_now() < next && !self.is_over() {
                std::thread::sleep(LOOK_UP);
            }
        }
        Ok(None)
    }

    /// One headset session, from its first frame to its end.
    fn show(
        &mut self,
        display: Box<dyn Display>,
        trace: Option<&Trace>,
        observe: &mut Observer<'_>,
    ) -> Result<(), RunError> {
        let (mut presenter, intake) = self.rehearsed(display)?;
        let traced = Traced::new(trace);
        let connector = Connector::new(self.options, traced.clone())?;
        presenter.set_status(&connector.first_status());
        let mut taking = Taking::start(intake, connector).map_err(RunError::Thread)?;
        taking.thread().cloned().into_iter().for_each(|thread| presenter.wake(thread));
        let ended = self.frames(&mut presenter, &mut taking, traced, observe);
        drop(taking);
        self.stats = std::mem::take(&mut self.stats).and(presenter.stats());
        ended
    }

    /// The halves of a client that has compiled all pipelines.
    fn rehearsed(&self, display: Box<dyn Display>) -> Result<(Presenter, Intake), RunError> {
        let began = monotonic_now();
        tracing::info!("Compiling pipelines");
        let folder = self.options.pipelines.iter();
        folder.for_each(|folder| display.gpu().load_pipelines(folder, PROGRAM));
        let (mut presenter, intake) = halves(display, self.options.client)?;
        presenter.rehearse()?;
        tracing::info!("Pipelines are ready after {:.1} s", monotonic_now().since(began) as f64 * 1e-9);
        Ok((presenter, intake))
    }

    fn frames(
        &self,
        presenter: &mut Presenter,
        taking: &mut Taking,
        mut traced: Traced,
        observe: &mut Observer<'_>,
    ) -> Result<(), RunError> {
        let mut leaving_since = None;
        loop {
            let turn = presenter.wait_turn()?;
            let (began, began_cpu_ns) = (monotonic_now(), thread_cpu_ns());
            match presenter.present(turn, None)? {
                Step::Frame(report) => {
                    let cpu_ns = thread_cpu_ns() - began_cpu_ns;
                    traced.ended([began, monotonic_now()], Some(cpu_ns), &report);
                    observe(presenter, &report)?;
                    if report.is_rendered && presenter.leaves_cores() {
                        presenter.wait_for_frame()?;
                        let took_ns = monotonic_now().since(began).max(0);
                        std::thread::sleep(Duration::from_nanos(rest_ns(took_ns) as u64));
                    }
                }
                Step::Idle => std::thread::sleep(IDLE_WAIT),
                Step::Exit => return Ok(()),
            }
            taking.assert_alive();
            match leaving_since {
                None if self.is_over() => {
                    presenter.request_exit();
                    leaving_since = Some(monotonic_now());
                }
                Some(since) if monotonic_now().since(since) > LEAVE_PATIENCE_NS => {
                    tracing::warn!("the OpenXR runtime does not end the session; exiting anyway");
                    return Ok(());
                }
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_address_ends_a_run_before_anything_is_opened() {
        let options = RunOptions {
            server: "nonsense".into(),
            fingerprint: None,
            asks_first: false,
            identity_dir: PathBuf::new(),
            forgetting: None,
            notice: None,
            client: ClientOptions::default(),
            seconds: 0.0,
            pipelines: None,
            trace: None,
        };
        let mut open = || panic!("the headset was opened");
        let outcome = run(&mut open, &options, &AtomicBool::new(false), &mut |_, _| Ok(()));
        assert!(matches!(outcome.ended, Err(RunError::Address { .. })), "{:?}", outcome.ended);
    }
}

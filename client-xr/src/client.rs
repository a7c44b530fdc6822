//! The client without I/O: bytes and time enter, bytes leave, and each display frame is one [`Client::step`].
//!
//! It has two halves: [`crate::stream::intake`] takes in arrivals, [`crate::present::presenter`] displays them. [`crate::net`]
//! runs each half on its own thread, with a socket and the real clock. The lab steps both on one thread in virtual time, beside
//! a server. The halves know neither sockets nor threads.

pub use crate::options::ClientOptions;
pub use crate::report::{ClientError, DecodedIn, FrameReport, Notice, Step};

use crate::display::Display;
use crate::handover;
use crate::present::presenter::Presenter;
use crate::stream::intake::Intake;

/// Both halves of a client on one thread.
pub struct Client {
    /// What shows.
    pub presenter: Presenter,
    /// What takes in.
    pub intake: Intake,
}

/// The two halves of a client on an open display, not connected.
///
/// # Errors
/// The device cannot draw.
pub fn halves(display: Box<dyn Display>, options: ClientOptions) -> Result<(Presenter, Intake), ClientError> {
    let (of_presenter, of_intake) = handover::ends();
    let options = options.resolved_on(display.gpu());
    let presenter = Presenter::new(display, &options, of_presenter)?;
    presenter.gpu().leave_retired(); // to the intake: destroying takes time that a display frame does not have
    let intake = Intake::new(of_intake, options, presenter.picture_ways(), presenter.eye_extent_pixels());
    Ok((presenter, intake))
}

impl Client {
    /// A client on an open display, not connected.
    pub fn new(display: Box<dyn Display>, options: ClientOptions) -> Result<Self, ClientError> {
        let (presenter, intake) = halves(display, options)?;
        Ok(Self { presenter, intake })
    }

    /// One display frame, without anything arriving meanwhile.
    pub fn step(&mut self) -> Result<Step, ClientError> {
        self.step_with(|_| {})
    }

    /// One display frame. `poll_inbox` hands in what has arrived, after the wait for the frame's turn, so that the newest
    /// counts; it calls [`Intake::advance`] last.
    pub fn step_with(&mut self, poll_inbox: impl FnOnce(&mut Intake)) -> Result<Step, ClientError> {
        let Self { presenter, intake } = self;
        let turn = presenter.wait_turn()?;
        poll_inbox(intake);
        let step = presenter.present(turn, Some(intake))?;
        intake.take_presented();
        Ok(step)
    }
}

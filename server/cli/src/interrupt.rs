//! Signals: the first one requests the end, the second one ends the program at once.

use anyhow::Context;
use shadecast_scene::{Cancel, Cancelled};
use shadecast_system::process::end_at_once;

/// Effect of the first signal.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum FirstSignal {
    /// Requests the end, so that begun work is finished or undone. The second signal ends the program.
    Asks,
    /// Ends the program. It has nothing to finish.
    Ends,
}

/// Routes signals (Ctrl-C and SIGTERM) to the returned [`Cancel`].
///
/// # Errors
/// The system refuses the handler.
pub(crate) fn install(first: FirstSignal) -> anyhow::Result<Cancel> {
    let cancel = Cancel::default();
    let asked = cancel.clone();
    let on_signal = move || {
        if first == FirstSignal::Ends || asked.is_asked() {
            end_at_once();
        }
        asked.ask();
    };
    ctrlc::set_handler(on_signal).context("catching signals")?;
    Ok(cancel)
}

/// Whether the error is only a requested end.
pub(crate) fn is_interruption(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| cause.is::<Cancelled>())
}

//! Signals: the first asks to end, the second ends at once.

use anyhow::Context;
use shadecast_scene::{Cancel, Cancelled};
use shadecast_system::process::end_at_once;

/// What the first signal does.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum FirstSignal {
    /// Asks, so that what was begun is finished or taken back; the next one ends the program.
    Asks,
    /// Ends the program, which has nothing to finish.
    Ends,
}

/// From now on signals (Ctrl-C, and the systems' wishes to end) ask through what is returned.
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

/// Whether this is no failure: somebody asked to end, and so it did.
pub(crate) fn is_interruption(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| cause.is::<Cancelled>())
}

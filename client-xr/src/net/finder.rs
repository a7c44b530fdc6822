//! Repeated search for announced servers, on its own thread.

use shadecast_transport::discovery::FoundServer;
use shadecast_transport::discovery::search::search;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

/// How long answers are waited for before it is asked again.
const ROUND: Duration = Duration::from_millis(1500);

/// Asks round after round for as long as it lives.
pub(super) struct Finder {
    rounds: Receiver<Vec<FoundServer>>,
}

impl Finder {
    /// Begins to ask.
    pub(super) fn start() -> Self {
        let (to, rounds) = channel();
        std::thread::spawn(move || {
            loop {
                let found = search(ROUND).unwrap_or_else(|error| {
                    tracing::debug!("searching for servers: {error}");
                    std::thread::sleep(ROUND); // a network that is not there yet
                    Vec::new()
                });
                if to.send(found).is_err() {
                    break;
                }
            }
        });
        Self { rounds }
    }

    /// Asks nobody: rounds come from a test.
    #[cfg(test)]
    pub(super) fn silent() -> Self {
        Self { rounds: channel().1 }
    }

    /// Who has answered in the next round that is over, if one is.
    pub(super) fn poll(&self) -> Option<Vec<FoundServer>> {
        self.rounds.try_recv().ok()
    }
}

//! The thread of motion: once each step of the time grid every client is sent what its motion needs. It waits for no update, and
//! holds what a client's pipeline needs only for as long as that takes.

use super::outlet::Outlet;
use crate::lock::lock;
use crate::motion::sender::SharedMotion;
use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};
use shadecast_transport::PeerId;
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::time::Duration;

/// Who is sent motion: the pipeline says who is served.
#[derive(Default)]
pub(super) struct Cadence {
    clients: Mutex<BTreeMap<PeerId, SharedMotion>>,
}

impl Cadence {
    /// A client is served from now on.
    pub(super) fn join(&self, peer: PeerId, motion: SharedMotion) {
        lock(&self.clients).insert(peer, motion);
    }

    /// A client has gone.
    pub(super) fn leave(&self, peer: PeerId) {
        lock(&self.clients).remove(&peer);
    }

    /// Sends what is due. What cannot be sent is the pipeline's to notice: its next delta cannot be either.
    pub(super) fn step(&self, outlet: &dyn Outlet, now: ServerTime) {
        let clients: Vec<_> =
            lock(&self.clients).iter().map(|(peer, motion)| (*peer, motion.clone())).collect();
        for (peer, motion) in clients {
            let way = outlet.way(peer);
            let due = lock(&motion).tick(now, way.as_ref());
            for out in due {
                if let Err(error) = outlet.send(peer, out) {
                    tracing::debug!("motion could not be sent: {error}");
                }
            }
        }
    }

    /// From `now` to the next step of the grid.
    pub(super) fn wait(now: ServerTime) -> Duration {
        let next = DEFAULT_GRID.time_of(DEFAULT_GRID.floor(now).plus(1));
        Duration::from_nanos(next.since(now).max(0) as u64)
    }
}

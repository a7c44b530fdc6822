//! The thread of motion: once each step of the time grid every client is sent what its motion needs. It waits for no update, and
//! holds what a client's pipeline needs only for as long as that takes.

use super::encoder::refused_by;
use super::outlet::Outlet;
use crate::motion::sender::SharedMotion;
use crate::support::lock::lock;
use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};
use shadecast_transport::PeerId;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
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
            if !guarded(outlet, peer, || send_due(outlet, peer, &motion, now)) {
                self.leave(peer);
            }
        }
    }

    /// From `now` to the next step of the grid.
    pub(super) fn wait(now: ServerTime) -> Duration {
        let passed_ns = now.0.rem_euclid(DEFAULT_GRID.spacing_ns);
        Duration::from_nanos((DEFAULT_GRID.spacing_ns - passed_ns) as u64)
    }
}

fn send_due(outlet: &dyn Outlet, peer: PeerId, motion: &SharedMotion, now: ServerTime) {
    let way = outlet.way(peer);
    let due = lock(motion).tick(now, way.as_ref());
    for out in due {
        if let Err(error) = outlet.send(peer, out) {
            tracing::debug!("motion could not be sent: {error}");
        }
    }
}

/// Runs `body`; a panic in it ends the session of this client alone. False after one.
fn guarded(outlet: &dyn Outlet, peer: PeerId, body: impl FnOnce()) -> bool {
    // What a panic leaves behind belongs to the client, which is sent away.
    let ended = catch_unwind(AssertUnwindSafe(body));
    if let Err(panic) = &ended {
        outlet.refuse(peer, refused_by(panic.as_ref()));
    }
    ended.is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pacing::gate::WayState;
    use shadecast_protocol::message::Refused;
    use shadecast_protocol::session::Out;
    use shadecast_transport::SendError;

    #[derive(Default)]
    struct Refusals(Mutex<Vec<(PeerId, String)>>);

    impl Outlet for Refusals {
        fn send(&self, _: PeerId, _: Out) -> Result<(), SendError> {
            Ok(())
        }

        fn way(&self, _: PeerId) -> Option<WayState> {
            None
        }

        fn refuse(&self, peer: PeerId, refused: Refused) {
            lock(&self.0).push((peer, refused.reason));
        }
    }

    #[test]
    fn a_panic_amid_a_clients_motion_ends_its_session_and_not_the_thread() {
        let outlet = Refusals::default();
        assert!(guarded(&outlet, PeerId(1), || {}));
        assert!(!guarded(&outlet, PeerId(2), || panic!("on purpose")));
        assert_eq!(*lock(&outlet.0), [(PeerId(2), "a fault of the program: on purpose".to_owned())]);
    }

    #[test]
    fn steps_are_as_far_apart_as_those_of_the_grid() {
        let spacing_ns = DEFAULT_GRID.spacing_ns;
        let step = ServerTime(150 * spacing_ns);
        for (after_ns, wait_ns) in [(0, spacing_ns), (1, spacing_ns - 1), (spacing_ns - 1, 1)] {
            assert_eq!(Cadence::wait(step.plus_ns(after_ns)), Duration::from_nanos(wait_ns as u64));
        }
    }
}

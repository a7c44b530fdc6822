//! The thread of motion: once each step of the time grid every client is sent what its motion needs. It waits for no update, and
//! holds what a client's pipeline needs only for as long as that takes.

use super::encoder::refused_by;
use super::outlet::Outlet;
use crate::motion::sender::SharedMotion;
use crate::support::lock::lock;
use shadecast_protocol::message::Refused;
use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};
use shadecast_transport::{PeerId, SendError};
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

    /// Sends what is due.
    pub(super) fn step(&self, outlet: &dyn Outlet, now: ServerTime) {
        let clients: Vec<_> =
            lock(&self.clients).iter().map(|(peer, motion)| (*peer, motion.clone())).collect();
        for (peer, motion) in clients {
            let sent = guarded(outlet, peer, || send_due(outlet, peer, &motion, now));
            if !goes_on(outlet, peer, sent) {
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

fn send_due(
    outlet: &dyn Outlet,
    peer: PeerId,
    motion: &SharedMotion,
    now: ServerTime,
) -> Result<(), SendError> {
    let way = outlet.way(peer);
    let due = lock(motion).tick(now, way.as_ref());
    due.into_iter().try_for_each(|out| outlet.send(peer, out))
}

/// Whether a client is sent motion again after `sent`. What was not sent counts as told, so that the client would show a wrong world
/// from then on: its session ends.
fn goes_on(outlet: &dyn Outlet, peer: PeerId, sent: Option<Result<(), SendError>>) -> bool {
    match sent {
        Some(Ok(()) | Err(SendError::NotConnected)) => true,
        Some(Err(error)) => {
            outlet.refuse(peer, unsent(&error));
            false
        }
        None => false,
    }
}

/// Why a session ends whose client does not take what moves.
fn unsent(error: &SendError) -> Refused {
    let reason = format!("what moves could not be sent: {error}");
    Refused::new(&reason, "connect again; a faster link, or fewer instances that change at once, helps")
}

/// Runs `body`; a panic in it ends the session of this client alone. `None` after one.
fn guarded<T>(outlet: &dyn Outlet, peer: PeerId, body: impl FnOnce() -> T) -> Option<T> {
    // What a panic leaves behind belongs to the client, which is sent away.
    catch_unwind(AssertUnwindSafe(body))
        .inspect_err(|panic| outlet.refuse(peer, refused_by(panic.as_ref())))
        .ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pacing::share::WayState;
    use shadecast_protocol::session::Out;

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
        assert_eq!(guarded(&outlet, PeerId(1), || 1), Some(1));
        assert_eq!(guarded(&outlet, PeerId(2), || panic!("on purpose")), None::<()>);
        assert_eq!(*lock(&outlet.0), [(PeerId(2), "a fault of the program: on purpose".to_owned())]);
    }

    #[test]
    fn motion_that_cannot_be_sent_ends_the_session_whose_it_is() {
        let outlet = Refusals::default();
        assert!(goes_on(&outlet, PeerId(1), Some(Ok(()))));
        assert!(goes_on(&outlet, PeerId(2), Some(Err(SendError::NotConnected))), "its end is told elsewhere");
        assert!(!goes_on(&outlet, PeerId(3), Some(Err(SendError::QueueFull))));
        let [(peer, reason)] = &lock(&outlet.0)[..] else { panic!("one session ends") };
        assert_eq!((*peer, reason.contains("what moves could not be sent")), (PeerId(3), true), "{reason}");
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

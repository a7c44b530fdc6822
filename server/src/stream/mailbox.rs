//! What the network tells the pipeline: at most one of a kind, the newest, so that a client cannot make it grow and a
//! pipeline that was busy is never behind.

use shadecast_protocol::message::{Capabilities, Displayed, HeadState, Welcome};
use shadecast_protocol::session::DeltaSender;
use shadecast_transport::PeerId;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// A client that was welcomed.
#[derive(Debug)]
pub struct Accepted {
    /// Its connection.
    pub peer: PeerId,
    /// What was agreed.
    pub welcome: Welcome,
    /// What it has told of itself.
    pub capabilities: Capabilities,
    /// The sending half of its session.
    pub sender: DeltaSender,
}

/// Who is to be served.
#[derive(Debug, Default)]
pub enum Client {
    /// Whoever was.
    #[default]
    Unchanged,
    /// Nobody.
    Gone,
    /// This one, and nobody else any more.
    Accepted(Box<Accepted>),
}

/// All that has happened since the pipeline looked last.
#[derive(Debug, Default)]
pub struct News {
    /// Who is to be served. The rest is that client's.
    pub client: Client,
    /// The newest head state.
    pub pose: Option<HeadState>,
    /// What is on display.
    pub displayed: Option<Displayed>,
    /// A picture that needs no other is wanted.
    pub refresh: bool,
    /// Whether somebody looks, where that was told.
    pub watching: Option<bool>,
}

/// From the network's thread to the pipeline's.
#[derive(Debug, Default)]
pub struct Mailbox {
    news: Mutex<News>,
    arrived: Condvar,
}

impl Mailbox {
    /// A client was welcomed: what came from an earlier one is void.
    pub fn accepted(&self, accepted: Accepted) {
        self.put(|news| *news = News { client: Client::Accepted(Box::new(accepted)), ..News::default() });
    }

    /// The client has gone, or what served it is to be forgotten.
    pub fn gone(&self) {
        self.put(|news| *news = News { client: Client::Gone, ..News::default() });
    }

    /// Where the head is.
    pub fn pose(&self, pose: HeadState) {
        self.put(|news| news.pose = Some(pose));
    }

    /// What is on display.
    pub fn displayed(&self, report: Displayed) {
        self.put(|news| {
            let earlier = news.displayed.take();
            news.displayed = Some(earlier.map_or(report, |earlier| earlier.merged(report)));
        });
    }

    /// A picture that needs no other is wanted.
    pub fn refresh(&self) {
        self.put(|news| news.refresh = true);
    }

    /// Whether somebody looks.
    pub fn watching(&self, is_watched: bool) {
        self.put(|news| news.watching = Some(is_watched));
    }

    /// All that is new, without waiting.
    pub fn take(&self) -> News {
        std::mem::take(&mut *self.lock())
    }

    /// Waits until something is new, at most so long.
    pub fn wait(&self, at_most: Duration) {
        let guard = self.lock();
        // Woken, timed out or poisoned: the caller looks in any case.
        drop(self.arrived.wait_timeout(guard, at_most));
    }

    fn put(&self, change: impl FnOnce(&mut News)) {
        change(&mut self.lock());
        self.arrived.notify_one();
    }

    fn lock(&self) -> MutexGuard<'_, News> {
        // News is whole after every statement: a thread that panicked leaves nothing half done.
        self.news.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stream::testing::{accepted, head};
    use shadecast_protocol::ids::FrameId;
    use std::sync::Arc;

    #[test]
    fn of_many_clients_that_come_and_go_only_the_newest_is_told_of() {
        let mailbox = Mailbox::default();
        for peer in 0..300 {
            mailbox.accepted(accepted(PeerId(peer)));
            mailbox.pose(head(peer as u32));
            if peer % 2 == 0 {
                mailbox.gone();
            }
        }
        let news = mailbox.take();
        assert!(matches!(&news.client, Client::Accepted(last) if last.peer == PeerId(299)), "{news:?}");
        assert_eq!(news.pose.map(|pose| pose.sequence), Some(299));
        mailbox.gone();
        assert!(matches!(mailbox.take(), News { client: Client::Gone, pose: None, .. }));
    }

    #[test]
    fn reports_are_one_report() {
        let mailbox = Mailbox::default();
        for frame in 0..1000 {
            let counted = Displayed { frame: FrameId(frame), display_frames: 2, ..Displayed::default() };
            mailbox.displayed(counted);
            mailbox.refresh();
        }
        let news = mailbox.take();
        let report = news.displayed.expect("one");
        assert_eq!((report.frame, report.display_frames, news.refresh), (FrameId(999), 2000, true));
        assert!(mailbox.take().displayed.is_none());
    }

    #[test]
    fn a_lock_that_a_panic_has_poisoned_is_taken_over() {
        let mailbox = Arc::new(Mailbox::default());
        let poisoner = mailbox.clone();
        let panicked = std::thread::spawn(move || poisoner.put(|_| panic!("while holding the lock"))).join();
        assert!(panicked.is_err());
        mailbox.refresh();
        assert!(mailbox.take().refresh);
    }
}

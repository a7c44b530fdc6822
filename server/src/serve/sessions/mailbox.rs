//! What the network tells the pipeline: of each client at most one of a kind, the newest, so that no client can make it grow
//! and a pipeline that was busy is never behind.

use crate::serve::viewer::Reported;
use crate::support::lock::lock;
use shadecast_protocol::message::{Capabilities, Welcome};
use shadecast_protocol::session::{DeltaSender, ServerEvent};
use shadecast_transport::PeerId;
use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex};
use std::time::Duration;

/// A client that was welcomed.
#[derive(Debug)]
pub struct Accepted {
    /// What was agreed.
    pub welcome: Welcome,
    /// What it has told of itself.
    pub capabilities: Capabilities,
    /// The sending half of its session.
    pub sender: DeltaSender,
}

/// Whether a client is to be served.
#[derive(Debug, Default)]
pub enum Client {
    /// As before.
    #[default]
    Unchanged,
    /// No longer.
    Gone,
    /// From now on.
    Accepted(Box<Accepted>),
}

/// All that has happened to a client since the pipeline looked last.
#[derive(Debug, Default)]
pub struct News {
    /// Whether it is to be served.
    pub client: Client,
    /// What it has told.
    pub reported: Reported,
}

/// From the network's thread to the pipeline's.
#[derive(Debug, Default)]
pub struct Mailbox {
    news: Mutex<BTreeMap<PeerId, News>>,
    arrived: Condvar,
}

impl Mailbox {
    /// A client was welcomed.
    pub(crate) fn accepted(&self, peer: PeerId, accepted: Accepted) {
        let client = Client::Accepted(Box::new(accepted));
        self.put(|news| drop(news.insert(peer, News { client, reported: Reported::default() })));
    }

    /// A client has gone, or what served it is to be forgotten.
    pub(crate) fn gone(&self, peer: PeerId) {
        self.put(|news| match news.remove(&peer) {
            // The pipeline has never heard of it.
            Some(News { client: Client::Accepted(_), .. }) => {}
            _ => drop(news.insert(peer, News { client: Client::Gone, reported: Reported::default() })),
        });
    }

    /// A client that is served has said something.
    pub(crate) fn reported(&self, peer: PeerId, event: ServerEvent) {
        // What is no viewer's affair does not come here.
        self.put(|news| drop(news.entry(peer).or_default().reported.take(event)));
    }

    /// The way to a client that is served carries nothing, or does again.
    pub(crate) fn away(&self, peer: PeerId, is_away: bool) {
        self.put(|news| news.entry(peer).or_default().reported.away = Some(is_away));
    }

    /// All that is new, without waiting.
    pub fn take(&self) -> BTreeMap<PeerId, News> {
        std::mem::take(&mut *lock(&self.news))
    }

    /// Waits until something is new, at most so long.
    pub(crate) fn wait(&self, at_most: Duration) {
        let guard = lock(&self.news);
        // Woken, timed out or poisoned: the caller looks in any case.
        drop(self.arrived.wait_timeout(guard, at_most));
    }

    fn put(&self, change: impl FnOnce(&mut BTreeMap<PeerId, News>)) {
        change(&mut lock(&self.news));
        self.arrived.notify_one();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::serve::sessions::testing::accepted;
    use shadecast_protocol::ids::UpdateId;
    use shadecast_protocol::message::Displayed;
    use shadecast_protocol::time::ServerTime;
    use shadecast_test_support::peers::head;
    use std::sync::Arc;

    #[test]
    fn of_clients_that_come_and_go_before_the_pipeline_looks_nothing_is_told() {
        let mailbox = Mailbox::default();
        for peer in 0..300 {
            mailbox.accepted(PeerId(peer), accepted());
            mailbox.reported(PeerId(peer), ServerEvent::Head(head(peer as u32, ServerTime(0))));
            if peer < 298 {
                mailbox.gone(PeerId(peer));
            }
        }
        let news = mailbox.take();
        assert_eq!(news.keys().copied().collect::<Vec<_>>(), [PeerId(298), PeerId(299)]);
        assert!(matches!(news[&PeerId(299)].client, Client::Accepted(_)), "{news:?}");
        assert_eq!(news[&PeerId(299)].reported.head.map(|head| head.sequence), Some(299));
        mailbox.gone(PeerId(299));
        assert!(matches!(mailbox.take()[&PeerId(299)], News { client: Client::Gone, .. }));
    }

    #[test]
    fn reports_are_one_report() {
        let mailbox = Mailbox::default();
        for frame in 0..1000 {
            let counted = Displayed { update: UpdateId(frame), display_frames: 2, ..Displayed::default() };
            mailbox.reported(PeerId(1), ServerEvent::Displayed(counted));
            mailbox.reported(PeerId(1), ServerEvent::RefreshRequest { after: None });
        }
        let reported = mailbox.take()[&PeerId(1)].reported;
        let report = reported.displayed.expect("one");
        assert_eq!(
            (report.update, report.display_frames, reported.refresh),
            (UpdateId(999), 2000, Some(None))
        );
        assert!(mailbox.take().is_empty());
    }

    #[test]
    fn a_lock_that_a_panic_has_poisoned_is_taken_over() {
        let mailbox = Arc::new(Mailbox::default());
        let poisoner = mailbox.clone();
        let panicked = std::thread::spawn(move || poisoner.put(|_| panic!("while holding the lock"))).join();
        assert!(panicked.is_err());
        mailbox.gone(PeerId(1));
        assert_eq!(mailbox.take().len(), 1);
    }
}

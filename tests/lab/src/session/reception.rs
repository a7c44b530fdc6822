//! The server's [`Sessions`] on the virtual clock: one for all links, as in the program.

use super::SERVER_EPOCH_NS;
use shadecast_protocol::close::CloseCode;
use shadecast_protocol::message::{ResumeSecret, ServerOffer};
use shadecast_protocol::session::Out;
use shadecast_server::serve::sessions::mailbox::{Mailbox, News};
use shadecast_server::serve::sessions::{Carrier, Sessions, Surroundings, Verdicts};
use shadecast_transport::{Event, PeerId, SendError};
use std::cell::RefCell;
use std::collections::{BTreeMap, VecDeque};

/// Peers of one link differ in these bits; the bits above tell the link.
const LINK_SHIFT: u32 = 32;

/// A client's name among those of all links.
pub(super) fn peer_of(line: usize, peer: PeerId) -> PeerId {
    PeerId((line as u64) << LINK_SHIFT | peer.0)
}

/// The link that a client is on.
pub(super) fn line_of(peer: PeerId) -> usize {
    (peer.0 >> LINK_SHIFT) as usize
}

/// See the module.
pub(super) struct Reception {
    sessions: Sessions,
    carrier: Kept,
    mailbox: Mailbox,
    verdicts: Verdicts,
    /// In the order in which it came.
    news: Vec<(PeerId, News)>,
}

/// What sessions have to say by link, and why the server has sent a client away.
#[derive(Default)]
struct Kept {
    out: RefCell<BTreeMap<usize, VecDeque<Out>>>,
    ended: RefCell<BTreeMap<usize, String>>,
}

impl Carrier for Kept {
    fn send(&self, peer: PeerId, out: Out) -> Result<(), SendError> {
        self.out.borrow_mut().entry(line_of(peer)).or_default().push_back(out);
        Ok(())
    }

    fn close(&self, peer: PeerId, code: CloseCode, reason: &str) {
        if code != CloseCode::Leaving {
            self.ended.borrow_mut().insert(line_of(peer), reason.to_owned());
        }
    }
}

impl Reception {
    /// Serves so many viewers at once.
    pub(super) fn new(terms: ServerOffer, viewers: usize) -> Self {
        let offer = move |session: u64| {
            let mut resume = ResumeSecret([0; 16]);
            resume.0[..8].copy_from_slice(&session.to_le_bytes());
            ServerOffer { session, resume, ..terms.clone() }
        };
        Self {
            sessions: Sessions::new(Box::new(offer), viewers, SERVER_EPOCH_NS),
            carrier: Kept::default(),
            mailbox: Mailbox::default(),
            verdicts: Verdicts::default(),
            news: Vec::new(),
        }
    }

    /// Takes an event of the server's end of a link.
    pub(super) fn take(&mut self, line: usize, event: Event, now_ns: i64) {
        let Self { sessions, carrier, mailbox, verdicts, .. } = self;
        let around = Surroundings { carrier, mailbox, verdicts, say: &|_| {} };
        sessions.take(on_line(line, event), now_ns, &around);
        sessions.tick(now_ns, &around);
        self.news.extend(mailbox.take());
    }

    /// What is new of the clients of a link.
    pub(super) fn news_of(&mut self, line: usize) -> Vec<(PeerId, News)> {
        self.news.extract_if(.., |(peer, _)| line_of(*peer) == line).collect()
    }

    /// Why the server has sent the client of a link away, if it has.
    pub(super) fn ended(&mut self, line: usize) -> Option<String> {
        self.carrier.ended.get_mut().remove(&line)
    }

    /// What the sessions of a link have to say.
    pub(super) fn poll_out(&mut self, line: usize) -> Option<Out> {
        self.carrier.out.get_mut().get_mut(&line)?.pop_front()
    }
}

/// The same event of a client's name among those of all links.
fn on_line(line: usize, mut event: Event) -> Event {
    let (Event::Connected { peer, .. }
    | Event::Control { peer, .. }
    | Event::Stream { peer, .. }
    | Event::StreamReset { peer, .. }
    | Event::Datagram { peer, .. }
    | Event::Away { peer, .. }
    | Event::Back { peer, .. }
    | Event::Closed { peer, .. }) = &mut event;
    *peer = peer_of(line, *peer);
    event
}

//! Messages of peers before the application takes them: counted in bytes per peer, and handed out in turn.
//!
//! The endpoint fills it; the application empties it, possibly on another thread. Each peer has its own bound. Beyond it the
//! peer's streams are not read, its flow control makes it wait, and no other peer notices. The messages of a disconnected peer
//! are dropped.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Condvar, Mutex, MutexGuard, OnceLock, PoisonError};
use std::thread::Thread;
use std::time::Duration;

use crate::event::{Event, PeerId};

/// Received datagrams of one peer that wait for the application; the oldest are dropped.
pub(crate) const MAX_WAITING_DATAGRAMS: usize = 256;
/// What an event costs beside the bytes of its message, so that small ones count too. Bytes.
const EVENT_BYTES: usize = 64;

/// The events of all peers; see the module.
pub(crate) struct Inbox {
    queue: Mutex<Queue>,
    arrived: Condvar,
    /// Who does not wait for `arrived`, but is to be woken all the same.
    woken: OnceLock<Thread>,
    max_bytes_per_peer: usize,
    /// True on a server: what a peer said before it went is dropped with it. A client keeps its server's last words, which
    /// say why there is no session.
    forgets_the_gone: bool,
}

#[derive(Default)]
struct Queue {
    peers: BTreeMap<PeerId, Waiting>,
    /// The least number of the peer whose turn it is, so that one with much to say does not keep the others waiting.
    next_turn: u64,
    /// Reading stopped for want of room.
    held_back: bool,
    /// Nothing will be put in any more.
    is_ended: bool,
    /// Nothing will be taken any more.
    is_abandoned: bool,
}

/// The events of one peer in the order in which they happened, the datagrams apart, so that the oldest can be dropped.
#[derive(Default)]
struct Waiting {
    events: VecDeque<(u64, Event)>,
    datagrams: VecDeque<(u64, Event)>,
    sequence: u64,
    /// Of `events`.
    bytes: usize,
}

/// What came of a wait.
pub(crate) enum Next {
    Event { event: Event, makes_room: bool },
    Nothing,
    Ended,
}

fn cost_bytes(event: &Event) -> usize {
    let message = match event {
        Event::Control { message, .. } => message.len(),
        Event::Stream { bytes, .. } => bytes.len(),
        _ => 0,
    };
    EVENT_BYTES + message
}

impl Waiting {
    fn push(&mut self, event: Event) {
        self.sequence += 1;
        if matches!(event, Event::Datagram { .. }) {
            self.datagrams.push_back((self.sequence, event));
        } else {
            self.bytes += cost_bytes(&event);
            self.events.push_back((self.sequence, event));
        }
    }

    fn pop(&mut self) -> Option<Event> {
        let number = |queue: &VecDeque<(u64, Event)>| queue.front().map_or(u64::MAX, |(number, _)| *number);
        if number(&self.datagrams) < number(&self.events) {
            return self.datagrams.pop_front().map(|(_, event)| event);
        }
        let (_, event) = self.events.pop_front()?;
        self.bytes -= cost_bytes(&event);
        Some(event)
    }

    fn is_empty(&self) -> bool {
        self.events.is_empty() && self.datagrams.is_empty()
    }
}

impl Queue {
    /// The oldest event of the peer whose turn it is.
    fn pop(&mut self) -> Option<Event> {
        let turn = PeerId(self.next_turn);
        let peer = *self.peers.range(turn..).chain(self.peers.range(..turn)).next()?.0;
        let waiting = self.peers.get_mut(&peer)?;
        let event = waiting.pop();
        if waiting.is_empty() {
            self.peers.remove(&peer);
        }
        self.next_turn = peer.0 + 1;
        event
    }
}

impl Inbox {
    /// For a server's or a client's endpoint, with the bytes that may wait for each peer.
    pub(crate) fn new(is_server: bool, max_bytes_per_peer: usize) -> Self {
        Self {
            queue: Mutex::default(),
            arrived: Condvar::new(),
            woken: OnceLock::new(),
            max_bytes_per_peer,
            forgets_the_gone: is_server,
        }
    }

    /// Unparks a thread with each event from now on. The first that is named counts.
    pub(crate) fn wake(&self, thread: Thread) {
        let _ = self.woken.set(thread);
    }

    fn notify(&self) {
        self.arrived.notify_all();
        self.woken.get().into_iter().for_each(Thread::unpark);
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds what a peer brought; `false` where its oldest datagram had to go for it.
    pub(crate) fn push(&self, peer: PeerId, event: Event) -> bool {
        let mut queue = self.lock();
        let waiting = queue.peers.entry(peer).or_default();
        waiting.push(event);
        let fits = waiting.datagrams.len() <= MAX_WAITING_DATAGRAMS;
        if !fits {
            waiting.datagrams.pop_front();
        }
        drop(queue);
        self.notify();
        fits
    }

    /// Adds the last event of a peer. On a server, one that came and went unseen is not told at all.
    pub(crate) fn close(&self, peer: PeerId, event: Event) {
        if self.forgets_the_gone
            && let Some(gone) = self.lock().peers.remove(&peer)
            && gone.events.iter().any(|(_, event)| matches!(event, Event::Connected { .. }))
        {
            return;
        }
        self.push(peer, event);
    }

    /// Whether a peer's streams may be read on. After a no, [`Next::Event`] tells when there is room again.
    pub(crate) fn has_room(&self, peer: PeerId) -> bool {
        let mut queue = self.lock();
        let bytes = queue.peers.get(&peer).map_or(0, |waiting| waiting.bytes);
        let has_room = bytes < self.max_bytes_per_peer;
        queue.held_back |= !has_room;
        has_room
    }

    /// Peers of which something waits.
    pub(crate) fn waiting_peers(&self) -> usize {
        self.lock().peers.len()
    }

    /// The next event, if there is one.
    pub(crate) fn pop(&self) -> Option<Event> {
        self.lock().pop()
    }

    /// The next event, waiting up to `timeout` for it.
    pub(crate) fn wait(&self, timeout: Duration) -> Next {
        let has_nothing = |queue: &mut Queue| queue.peers.is_empty() && !queue.is_ended;
        let (mut queue, _) = self
            .arrived
            .wait_timeout_while(self.lock(), timeout, has_nothing)
            .unwrap_or_else(PoisonError::into_inner);
        match queue.pop() {
            Some(event) => Next::Event { event, makes_room: std::mem::take(&mut queue.held_back) },
            None if queue.is_ended => Next::Ended,
            None => Next::Nothing,
        }
    }

    /// Nothing more will be put in.
    pub(crate) fn end(&self) {
        self.lock().is_ended = true;
        self.notify();
    }

    /// Nothing more will be taken out.
    pub(crate) fn abandon(&self) {
        self.lock().is_abandoned = true;
    }

    pub(crate) fn is_abandoned(&self) -> bool {
        self.lock().is_abandoned
    }

    /// What waits of one peer.
    #[cfg(test)]
    pub(crate) fn waiting_bytes(&self, peer: PeerId) -> usize {
        self.lock().peers.get(&peer).map_or(0, |waiting| waiting.bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::CloseKind;

    const LIMIT: usize = 10_000;

    fn control(peer: u64, message: &[u8]) -> (PeerId, Event) {
        let peer = PeerId(peer);
        (peer, Event::Control { peer, message: message.to_vec(), at_ns: 0 })
    }

    fn datagram(peer: u64, n: usize) -> (PeerId, Event) {
        let peer = PeerId(peer);
        (peer, Event::Datagram { peer, bytes: n.to_le_bytes().to_vec(), at_ns: 0 })
    }

    fn closed(peer: u64) -> (PeerId, Event) {
        let peer = PeerId(peer);
        (peer, Event::Closed { peer, kind: CloseKind::TimedOut, reason: String::new() })
    }

    fn put(inbox: &Inbox, (peer, event): (PeerId, Event)) {
        inbox.push(peer, event);
    }

    fn drain(inbox: &Inbox) -> Vec<Event> {
        std::iter::from_fn(|| inbox.pop()).collect()
    }

    #[test]
    fn a_flood_of_one_peer_delays_another_by_one_event_at_most() {
        let inbox = Inbox::new(true, LIMIT);
        (0..1000).for_each(|_| put(&inbox, control(1, b"flood")));
        put(&inbox, control(2, b"lawful"));
        put(&inbox, datagram(2, 7));
        let first: Vec<Event> = (0..4).filter_map(|_| inbox.pop()).collect();
        assert!(first.contains(&control(2, b"lawful").1) && first.contains(&datagram(2, 7).1), "{first:?}");
    }

    #[test]
    fn room_is_counted_in_bytes_and_by_peer() {
        let inbox = Inbox::new(true, LIMIT);
        put(&inbox, control(1, &[0; LIMIT]));
        assert!(!inbox.has_room(PeerId(1)) && inbox.has_room(PeerId(2)));
        // Small messages have their price, too.
        (0..LIMIT / EVENT_BYTES).for_each(|_| put(&inbox, control(2, b"x")));
        assert!(!inbox.has_room(PeerId(2)));
        drain(&inbox);
        assert!(inbox.has_room(PeerId(1)) && inbox.has_room(PeerId(2)));
    }

    #[test]
    fn of_a_peer_that_has_gone_only_its_end_remains() {
        let inbox = Inbox::new(true, LIMIT);
        (0..100).for_each(|n| put(&inbox, datagram(1, n)));
        (0..100).for_each(|_| put(&inbox, control(1, b"flood")));
        put(&inbox, control(2, b"lawful"));
        let (peer, event) = closed(1);
        inbox.close(peer, event);
        assert_eq!(drain(&inbox), [closed(1).1, control(2, b"lawful").1]);
    }

    #[test]
    fn who_came_and_went_unseen_is_not_told_to_a_server() {
        let inbox = Inbox::new(true, LIMIT);
        let (peer, remote) = (PeerId(1), "10.0.0.1:1".parse().unwrap());
        let binding = crate::event::Binding([0; 32]);
        inbox.push(peer, Event::Connected { peer, remote, fingerprint: None, binding });
        put(&inbox, control(1, b"hello"));
        inbox.close(peer, closed(1).1);
        assert_eq!(drain(&inbox), []);
    }

    #[test]
    fn a_client_is_told_its_servers_last_words() {
        let inbox = Inbox::new(false, LIMIT);
        put(&inbox, control(1, b"refused"));
        inbox.close(PeerId(1), closed(1).1);
        assert_eq!(drain(&inbox), [control(1, b"refused").1, closed(1).1]);
    }

    #[test]
    fn the_newest_datagrams_stay() {
        let inbox = Inbox::new(true, LIMIT);
        let dropped =
            (0..MAX_WAITING_DATAGRAMS + 5).filter(|&n| !inbox.push(PeerId(1), datagram(1, n).1)).count();
        assert_eq!(dropped, 5);
        let left = drain(&inbox);
        assert_eq!((left.len(), &left[0]), (MAX_WAITING_DATAGRAMS, &datagram(1, 5).1));
    }

    #[test]
    fn taking_an_event_tells_that_there_is_room_again_once() {
        let inbox = Inbox::new(true, LIMIT);
        (0..2).for_each(|_| put(&inbox, control(1, &[0; LIMIT])));
        assert!(!inbox.has_room(PeerId(1)));
        let told: Vec<bool> = (0..2)
            .map(|_| match inbox.wait(Duration::ZERO) {
                Next::Event { makes_room, .. } => makes_room,
                Next::Nothing | Next::Ended => panic!("two events wait"),
            })
            .collect();
        assert_eq!(told, [true, false]);
        assert!(matches!(inbox.wait(Duration::ZERO), Next::Nothing));
        inbox.end();
        assert!(matches!(inbox.wait(Duration::ZERO), Next::Ended));
    }
}

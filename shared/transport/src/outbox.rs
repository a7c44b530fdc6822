//! Commands of the application before the network thread takes them: counted in bytes per peer, and handed out in turn.
//!
//! Any thread fills it; the network thread empties it. Each peer has a bound of its own: what waits for one can neither refuse nor
//! delay more than one message of another. Datagrams wait apart, and the oldest are dropped. A close is never refused; what follows
//! it is.

use std::collections::{BTreeMap, VecDeque};
use std::net::SocketAddr;
use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::event::{PeerId, SendError, StreamId};
use crate::identity::ExpectedIdentity;

/// Messages and streams of one peer that wait for the network thread, bytes. A message may come even then, up to
/// [`CONTROL_BYTES`] more: it says why a session ends.
const MAX_BYTES: usize = 64 << 20;
const CONTROL_BYTES: usize = 1 << 20;
/// What a message costs beside its bytes, so that small ones count too. Bytes.
const COMMAND_BYTES: usize = 64;
/// Datagrams of one peer that wait.
pub(crate) const MAX_WAITING_DATAGRAMS: usize = 256;

/// What the application asks of the network thread, for one peer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Command {
    Connect { remote: SocketAddr, expected: ExpectedIdentity },
    Control(Vec<u8>),
    Stream { stream: StreamId, bytes: Vec<u8>, priority: i32 },
    Cancel(StreamId),
    Datagram(Vec<u8>),
    Close { code: u32, reason: String },
}

impl Command {
    /// What it takes of its peer's bound, bytes.
    fn cost_bytes(&self) -> usize {
        let message = match self {
            Self::Control(message) => message.len(),
            Self::Stream { bytes, .. } => bytes.len(),
            _ => 0,
        };
        COMMAND_BYTES + message
    }

    /// What it adds to a peer's queue.
    fn load(&self) -> Load {
        match self {
            Self::Control(message) => Load { bytes: message.len() as u64, ..Load::default() },
            Self::Stream { bytes, .. } => {
                let bytes = bytes.len() as u64;
                Load { bytes, stream_bytes: bytes, streams: 1 }
            }
            _ => Load::default(),
        }
    }
}

/// Messages and streams of one peer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Load {
    pub(crate) bytes: u64,
    /// Of these, those of streams.
    pub(crate) stream_bytes: u64,
    pub(crate) streams: u64,
}

impl Load {
    fn add(&mut self, other: Self) {
        self.bytes += other.bytes;
        self.stream_bytes += other.stream_bytes;
        self.streams += other.streams;
    }

    fn remove(&mut self, other: Self) {
        self.bytes -= other.bytes;
        self.stream_bytes -= other.stream_bytes;
        self.streams -= other.streams;
    }
}

/// The commands of all peers; see the module.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    queue: Mutex<Queue>,
}

#[derive(Debug, Default)]
struct Queue {
    peers: BTreeMap<PeerId, Waiting>,
    /// The least number of the peer whose turn it is.
    next_turn: u64,
    datagrams_dropped: u64,
    /// Nothing will be taken any more.
    is_ended: bool,
    /// Nothing will be put in any more.
    is_abandoned: bool,
}

/// The commands of one peer in their order, the datagrams apart.
#[derive(Debug, Default)]
struct Waiting {
    commands: VecDeque<Command>,
    datagrams: VecDeque<Vec<u8>>,
    cost_bytes: usize,
    load: Load,
    /// Taken by the network thread since it last said what it knows.
    taken: Load,
    is_closing: bool,
}

impl Waiting {
    fn push(&mut self, command: Command) -> Result<u64, SendError> {
        if self.is_closing {
            return Err(SendError::NotConnected);
        }
        let room = match &command {
            Command::Datagram(_) | Command::Close { .. } => usize::MAX,
            Command::Control(_) => MAX_BYTES + CONTROL_BYTES,
            _ => MAX_BYTES,
        };
        if self.cost_bytes + command.cost_bytes() > room {
            return Err(SendError::QueueFull);
        }
        if let Command::Datagram(bytes) = command {
            self.datagrams.push_back(bytes);
            let is_too_many = self.datagrams.len() > MAX_WAITING_DATAGRAMS;
            return Ok(u64::from(is_too_many && self.datagrams.pop_front().is_some()));
        }
        self.is_closing = matches!(command, Command::Close { .. });
        self.cost_bytes += command.cost_bytes();
        self.load.add(command.load());
        self.commands.push_back(command);
        Ok(0)
    }

    /// Datagrams first: they age.
    fn pop(&mut self) -> Option<Command> {
        if let Some(bytes) = self.datagrams.pop_front() {
            return Some(Command::Datagram(bytes));
        }
        let command = self.commands.pop_front()?;
        self.cost_bytes -= command.cost_bytes();
        self.taken.add(command.load());
        Some(command)
    }

    fn has_commands(&self) -> bool {
        !self.commands.is_empty() || !self.datagrams.is_empty()
    }
}

impl Outbox {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a command. What it loads counts from now on: a count is never short.
    ///
    /// # Errors
    /// The network thread has ended, the peer is being closed, or its bytes are too many.
    pub(crate) fn push(&self, peer: PeerId, command: Command) -> Result<(), SendError> {
        let mut queue = self.lock();
        if queue.is_ended {
            return Err(SendError::Stopped);
        }
        let dropped = queue.peers.entry(peer).or_default().push(command)?;
        queue.datagrams_dropped += dropped;
        Ok(())
    }

    /// The next command of the peer whose turn it is.
    pub(crate) fn pop(&self) -> Option<(PeerId, Command)> {
        let mut queue = self.lock();
        let turn = PeerId(queue.next_turn);
        let in_turn = queue.peers.range(turn..).chain(queue.peers.range(..turn));
        let peer = *in_turn.filter(|(_, waiting)| waiting.has_commands()).map(|(peer, _)| peer).next()?;
        queue.next_turn = peer.0 + 1;
        let command = queue.peers.get_mut(&peer)?.pop()?;
        Some((peer, command))
    }

    /// What waits for a peer, and what was taken and not yet told.
    pub(crate) fn load(&self, peer: PeerId) -> Load {
        self.lock().peers.get(&peer).map_or(Load::default(), |waiting| waiting.load)
    }

    /// The network thread's own counts contain from now on what it has taken. Peers of which nothing waits are forgotten.
    pub(crate) fn told(&self) {
        self.lock().peers.retain(|_, waiting| {
            let taken = std::mem::take(&mut waiting.taken);
            waiting.load.remove(taken);
            waiting.has_commands()
        });
    }

    /// Datagrams that were dropped because the network thread did not take them.
    pub(crate) fn datagrams_dropped(&self) -> u64 {
        self.lock().datagrams_dropped
    }

    /// Nothing will be taken any more.
    pub(crate) fn end(&self) {
        let mut queue = self.lock();
        queue.is_ended = true;
        queue.peers.clear();
    }

    /// Nothing will be put in any more.
    pub(crate) fn abandon(&self) {
        self.lock().is_abandoned = true;
    }

    /// Nothing waits, and nothing will.
    pub(crate) fn is_done(&self) -> bool {
        let queue = self.lock();
        queue.is_abandoned && !queue.peers.values().any(Waiting::has_commands)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stream(bytes: usize) -> Command {
        Command::Stream { stream: StreamId(0), bytes: vec![0; bytes], priority: 0 }
    }

    fn close() -> Command {
        Command::Close { code: 3, reason: "over".into() }
    }

    /// Fills the queue of a peer until it refuses.
    fn fill(outbox: &Outbox, peer: PeerId, bytes: usize) -> usize {
        (0..).take_while(|_| outbox.push(peer, stream(bytes)).is_ok()).count()
    }

    #[test]
    fn a_full_queue_of_one_peer_refuses_and_delays_nothing_of_another() {
        let outbox = Outbox::default();
        let (greedy, lawful) = (PeerId(1), PeerId(2));
        fill(&outbox, greedy, 1 << 20);
        assert_eq!(outbox.push(greedy, stream(1 << 20)), Err(SendError::QueueFull));
        outbox.push(lawful, stream(1000)).expect("room of its own");
        let first: Vec<PeerId> = (0..2).filter_map(|_| outbox.pop()).map(|(peer, _)| peer).collect();
        assert!(first.contains(&lawful), "{first:?}");
    }

    #[test]
    fn small_messages_have_their_price() {
        let outbox = Outbox::default();
        let count = fill(&outbox, PeerId(1), 1);
        assert!(count <= MAX_BYTES / COMMAND_BYTES, "{count}");
    }

    #[test]
    fn a_full_queue_still_takes_the_reason_and_the_close() {
        let (outbox, peer) = (Outbox::default(), PeerId(1));
        fill(&outbox, peer, 1 << 20);
        outbox.push(peer, Command::Control(b"refused".to_vec())).expect("a reason");
        outbox.push(peer, close()).expect("a close");
        assert_eq!(outbox.push(peer, stream(1)), Err(SendError::NotConnected));
        assert_eq!(outbox.push(peer, Command::Datagram(vec![1])), Err(SendError::NotConnected));
        let last: Vec<Command> = std::iter::from_fn(|| outbox.pop()).map(|(_, command)| command).collect();
        assert_eq!(last[last.len() - 2..], [Command::Control(b"refused".to_vec()), close()]);
    }

    #[test]
    fn a_flood_of_datagrams_drops_the_oldest_and_counts_them() {
        let (outbox, peer) = (Outbox::default(), PeerId(1));
        for n in 0..MAX_WAITING_DATAGRAMS + 3 {
            outbox.push(peer, Command::Datagram(n.to_le_bytes().to_vec())).expect("never refused");
        }
        assert_eq!(outbox.datagrams_dropped(), 3);
        let first = Command::Datagram(3_usize.to_le_bytes().to_vec());
        assert_eq!(outbox.pop(), Some((peer, first)));
    }

    #[test]
    fn a_load_counts_from_the_push_until_the_thread_has_told() {
        let (outbox, peer) = (Outbox::default(), PeerId(1));
        outbox.push(peer, stream(10)).expect("room");
        outbox.push(peer, Command::Control(vec![0; 5])).expect("room");
        let load = |bytes, stream_bytes, streams| Load { bytes, stream_bytes, streams };
        assert_eq!(outbox.load(peer), load(15, 10, 1));
        outbox.pop().expect("the stream");
        assert_eq!(outbox.load(peer), load(15, 10, 1));
        outbox.told();
        assert_eq!(outbox.load(peer), load(5, 0, 0));
        outbox.pop().expect("the message");
        outbox.told();
        assert_eq!(outbox.load(peer), Load::default());
        assert!(outbox.lock().peers.is_empty());
    }

    #[test]
    fn what_was_asked_before_the_last_handle_went_is_still_done() {
        let outbox = Outbox::default();
        outbox.push(PeerId(1), close()).expect("open");
        outbox.abandon();
        assert!(!outbox.is_done());
        outbox.pop().expect("the close");
        assert!(outbox.is_done());
        outbox.end();
        assert_eq!(outbox.push(PeerId(1), close()), Err(SendError::Stopped));
    }
}

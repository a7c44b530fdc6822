//! Somebody else behind the bottleneck of a pair, in virtual time: another viewer, or a download.
//!
//! A neighbour has two endpoints of its own, whose datagrams take the same link. A download is a greedy connection with quinn's Cubic
//! (RFC 9438), as TCP has it. A viewer is a stream of pictures that follows the target as an encoder does.

use std::net::SocketAddr;
use std::time::Duration;

use shadecast_protocol::limits::PADDING_BYTES;

use crate::endpoint::{Congestion, Endpoint, EndpointConfig};
use crate::event::{Event, PeerId, SendError};
use crate::identity::{ExpectedIdentity, IdentityError, ServerIdentity};

/// Streams of a download, bytes; so many bytes wait for the window at least.
const DOWNLOAD_BYTES: usize = 128 << 10;
const DOWNLOAD_AHEAD_BYTES: u64 = 512 << 10;
/// From one picture to the next, nanoseconds.
const PICTURE_PERIOD_NS: i64 = 33_333_333;
/// A picture before anything is known, bytes.
const FIRST_PICTURE_BYTES: usize = 1000;
/// No picture is made where what is under way takes so long, seconds, and a round trip: as the server does it.
const MOST_WAIT_S: f64 = 0.25;

/// What a neighbour takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Traffic {
    /// As much as Cubic gives it.
    Download,
    /// Pictures of the target, up to so many Mbit/s.
    Pictures(f64),
}

/// See the module.
pub struct Neighbour {
    pub(crate) server: Endpoint,
    pub(crate) client: Endpoint,
    traffic: Traffic,
    begin_ns: i64,
    end_ns: i64,
    next_picture_ns: i64,
    is_connecting: bool,
    peer: Option<PeerId>,
    arrived_bytes: u64,
    pub(crate) delivered_bytes: u64,
}

impl Neighbour {
    /// One that comes at `begin_ns` of the pair's time.
    ///
    /// # Errors
    /// No identity can be made.
    pub fn new(traffic: Traffic, begin_ns: i64, seed: u64) -> Result<Self, IdentityError> {
        let congestion = match traffic {
            Traffic::Download => Congestion::Cubic,
            Traffic::Pictures(_) => Congestion::Steady,
        };
        let config =
            |salt| EndpointConfig { seed: Some(seed ^ salt), congestion, ..EndpointConfig::default() };
        Ok(Self {
            server: Endpoint::server(&ServerIdentity::from_seed(seed)?, config(5))?,
            client: Endpoint::client(config(6)),
            traffic,
            begin_ns,
            end_ns: i64::MAX,
            next_picture_ns: i64::MAX,
            is_connecting: false,
            peer: None,
            arrived_bytes: 0,
            delivered_bytes: 0,
        })
    }

    /// Takes nothing more from `end_ns` on.
    #[must_use]
    pub fn until(self, end_ns: i64) -> Self {
        Self { end_ns, ..self }
    }

    /// Bytes of streams that have arrived whole.
    pub fn arrived_bytes(&self) -> u64 {
        self.arrived_bytes
    }

    /// Bytes of datagrams that the link has delivered to its client.
    pub fn delivered_bytes(&self) -> u64 {
        self.delivered_bytes
    }

    /// When something happens next by itself, nanoseconds.
    pub(crate) fn next_event_ns(&mut self) -> Option<i64> {
        if !self.is_connecting {
            return Some(self.begin_ns);
        }
        let of_ends = [self.server.poll_timeout(), self.client.poll_timeout()];
        of_ends.into_iter().flatten().chain([self.next_picture_ns]).min()
    }

    /// Handles what is due now; its server has the address `server_addr`.
    pub(crate) fn step(&mut self, now_ns: i64, server_addr: SocketAddr) {
        if !self.is_connecting && now_ns >= self.begin_ns {
            self.is_connecting = true;
            self.client.connect(now_ns, server_addr, ExpectedIdentity::TrustOnFirstUse);
        }
        self.server.handle_timeout(now_ns);
        self.client.handle_timeout(now_ns);
        while let Some(event) = self.server.poll_event() {
            if let Event::Connected { peer, .. } = event {
                (self.peer, self.next_picture_ns) = (Some(peer), now_ns);
                // As the server begins: a train tells what the path carries.
                let _ = self.server.send_control(peer, &[0; PADDING_BYTES]);
            }
        }
        while let Some(event) = self.client.poll_event() {
            if let Event::Stream { bytes, .. } = event {
                self.arrived_bytes += bytes.len() as u64;
            }
        }
        if now_ns >= self.end_ns {
            self.next_picture_ns = i64::MAX;
        } else if let Some(peer) = self.peer {
            // Without room it goes on when there is some.
            let _ = self.feed(peer, now_ns);
        }
    }

    fn feed(&mut self, peer: PeerId, now_ns: i64) -> Result<(), SendError> {
        let most_mbit_s = match self.traffic {
            Traffic::Pictures(mbit_s) => mbit_s,
            Traffic::Download => {
                self.next_picture_ns = i64::MAX;
                while let Some(stats) = self.server.stats(peer)
                    && stats.unacknowledged_bytes < stats.window_bytes + DOWNLOAD_AHEAD_BYTES
                {
                    self.server.send_stream(peer, vec![0; DOWNLOAD_BYTES], 0)?;
                }
                return Ok(());
            }
        };
        if now_ns < self.next_picture_ns {
            return Ok(());
        }
        self.next_picture_ns = now_ns + PICTURE_PERIOD_NS;
        let Some(stats) = self.server.stats(peer) else { return Ok(()) };
        let target_bytes_s = (stats.target_bit_per_s as f64).min(most_mbit_s * 1e6) / 8.0;
        let wait_s = Duration::from_secs_f64(MOST_WAIT_S) + stats.min_rtt;
        if stats.target_bit_per_s > 0
            && stats.unacknowledged_bytes as f64 > target_bytes_s * wait_s.as_secs_f64()
        {
            return Ok(());
        }
        let picture_bytes = (target_bytes_s * PICTURE_PERIOD_NS as f64 * 1e-9) as usize;
        self.server.send_stream(peer, vec![0; picture_bytes.max(FIRST_PICTURE_BYTES)], 0).map(drop)
    }
}

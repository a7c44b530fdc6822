//! Whole handshakes in great number, each left without a word as soon as it is done.

use super::{Effort, HANDSHAKE_PATIENCE, MAX_CONNECTIONS, Target};
use crate::hostile::stranger::Stranger;
use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

/// Handshakes begun a second; fewer where this machine cannot do more.
const RATE_HZ: f64 = 1000.0;
/// Handshakes under way at once.
const AT_ONCE: usize = 64;
/// Addresses of the loopback network that they come from.
const ADDRESSES: u64 = 64;

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    let mut effort = Effort::default();
    let mut under_way: Vec<(Stranger, Instant)> = Vec::new();
    let start = Instant::now();
    while !target.is_over() {
        let due = (start.elapsed().as_secs_f64() * RATE_HZ) as u64;
        if under_way.len() < AT_ONCE && effort.connections < due.min(MAX_CONNECTIONS) {
            let from = Ipv4Addr::new(127, 0, 2, 1 + (effort.connections % ADDRESSES) as u8);
            under_way.push((Stranger::connect_from(target.server, from)?, Instant::now()));
            effort.connections += 1;
        }
        under_way.iter_mut().try_for_each(|(stranger, _)| stranger.pump())?;
        under_way.retain(|(stranger, since)| {
            let is_done = stranger.was_connected() || stranger.ended().is_some();
            let is_over = is_done || since.elapsed() > HANDSHAKE_PATIENCE;
            if is_over {
                effort.note(stranger);
            }
            !is_over
        });
        target.sleep(Duration::from_micros(50));
    }
    under_way.iter().for_each(|(stranger, _)| effort.note(stranger));
    Ok(effort)
}

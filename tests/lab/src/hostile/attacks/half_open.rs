//! Unfinished handshakes from many addresses.

use super::{Effort, Target};
use crate::hostile::stranger::Stranger;
use std::net::Ipv4Addr;
use std::time::{Duration, Instant};

/// Handshakes a second.
const RATE_HZ: u32 = 200;
/// Addresses of the loopback network that they come from.
const ADDRESSES: u64 = 64;

/// From addresses that may be invented.
pub(super) fn unproven(target: &Target) -> anyhow::Result<Effort> {
    flood(target, false)
}

/// From addresses at which the server's first answer arrives.
pub(super) fn proven(target: &Target) -> anyhow::Result<Effort> {
    flood(target, true)
}

fn flood(target: &Target, proves_address: bool) -> anyhow::Result<Effort> {
    let mut effort = Effort::default();
    let start = Instant::now();
    while !target.is_over() {
        let due = start + Duration::from_secs(1) / RATE_HZ * effort.connections as u32;
        target.sleep(due.saturating_duration_since(Instant::now()));
        let from = Ipv4Addr::new(127, 0, 1, 1 + (effort.connections % ADDRESSES) as u8);
        let mut stranger = Stranger::connect_from(target.server, from)?;
        effort.datagrams += stranger.begin_only(proves_address)?;
        effort.connections += 1;
    }
    Ok(effort)
}

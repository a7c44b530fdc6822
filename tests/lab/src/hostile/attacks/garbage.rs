//! Datagrams that are not QUIC, some with the first bytes of it.

use super::{Effort, Target};
use crate::hostile::stranger::raw_socket;
use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

/// Datagrams in one go.
const BURST: usize = 32;
/// Different ones.
const BURSTS: usize = 64;
/// From one burst to the next: some 6,000 datagrams a second.
const INTERVAL: Duration = Duration::from_millis(5);
/// The largest datagram, bytes.
const LARGEST: usize = 1452;

/// How datagrams begin: like nothing, an Initial of version 1, a handshake, a version that does not exist, a Retry, a
/// packet of a connection.
const BEGINNINGS: [&[u8]; 6] = [
    &[],
    &[0xc0, 0, 0, 0, 1, 8],
    &[0xe0, 0, 0, 0, 1, 8],
    &[0xc0, 0x1a, 0x2a, 0x3a, 0x4a, 20],
    &[0xf0, 0, 0, 0, 1, 8],
    &[0x40],
];

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    flood(target, INTERVAL)
}

pub(super) fn unpaced(target: &Target) -> anyhow::Result<Effort> {
    flood(target, Duration::ZERO)
}

fn flood(target: &Target, interval: Duration) -> anyhow::Result<Effort> {
    let socket = raw_socket(IpAddr::V4(Ipv4Addr::LOCALHOST))?;
    let mut effort = Effort::default();
    let mut state = 1;
    // Made before, so that sending is all that takes time.
    let made: Vec<_> = (0..BURST * BURSTS).map(|_| datagram(&mut state)).collect();
    let mut bursts = made.chunks(BURST).cycle();
    while !target.is_over() {
        for datagram in bursts.next().into_iter().flatten() {
            if socket.send_to(datagram, target.server).is_ok() {
                effort.datagrams += 1;
                effort.bytes += datagram.len() as u64;
            }
        }
        target.sleep(interval);
    }
    Ok(effort)
}

fn datagram(state: &mut u64) -> Vec<u8> {
    let beginning = BEGINNINGS[next(state) as usize % BEGINNINGS.len()];
    let length = next(state) as usize % LARGEST + 1;
    let mut bytes: Vec<u8> = (0..length).map(|_| next(state) as u8).collect();
    let shared = beginning.len().min(length);
    bytes[..shared].copy_from_slice(&beginning[..shared]);
    bytes
}

/// Xorshift: the datagrams are the same in every run.
fn next(state: &mut u64) -> u64 {
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    *state
}

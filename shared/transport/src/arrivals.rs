//! Strangers by the network that they come from: what the machines of one network begin can cost others their share only.
//! Pure: time is an argument.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::net::IpAddr;

use crate::allowance::Allowance;
use crate::event::PeerId;

/// Connections a second that the machines of one network may begin: far more than any that are meant, and few enough to be answered.
const PER_NETWORK_S: u32 = 400;
/// Handshakes under way at once: with one address, with one network, and at all.
const MOST_OF_ADDRESS: usize = 8;
const MOST_OF_NETWORK: usize = 32;
const MOST: usize = 64;
/// Networks that are remembered; those that have begun nothing within a second are forgotten.
const MAX_NETWORKS: usize = 4096;

/// The machines that one person is likely to have: the first 24 bits of an IPv4 address, or the first 64 of an IPv6 address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Network {
    /// The first bytes of an IPv4 address.
    V4([u8; 3]),
    /// The first bytes of an IPv6 address.
    V6([u8; 8]),
}

impl Network {
    /// Where `address` is. IPv4 addresses in IPv6 clothes count as IPv4.
    pub fn of(address: IpAddr) -> Self {
        match address.to_canonical() {
            IpAddr::V4(address) => {
                let [a, b, c, _] = address.octets();
                Self::V4([a, b, c])
            }
            IpAddr::V6(address) => {
                let [a, b, c, d, e, f, g, h, ..] = address.octets();
                Self::V6([a, b, c, d, e, f, g, h])
            }
        }
    }
}

/// How many connections each network may still begin.
#[derive(Debug, Default)]
pub(crate) struct Arrivals {
    networks: BTreeMap<Network, Allowance>,
}

impl Arrivals {
    /// Whether a machine of this network may begin a connection now. Its address must have been shown to be its own: others could use up
    /// what is not theirs.
    pub(crate) fn take(&mut self, network: Network, now_ns: i64) -> bool {
        if self.networks.len() >= MAX_NETWORKS && !self.networks.contains_key(&network) {
            self.networks.retain(|_, allowance| !allowance.is_full(now_ns));
            if self.networks.len() >= MAX_NETWORKS {
                return false;
            }
        }
        let allowance = self.networks.entry(network).or_insert_with(|| Allowance::new(PER_NETWORK_S, now_ns));
        allowance.take(now_ns)
    }
}

/// The oldest member of the largest crowd, and how many are in it. `peers` come with their crowd, from old to new.
pub fn crowded<K: Ord>(peers: impl Iterator<Item = (PeerId, K)>) -> Option<(PeerId, usize)> {
    let mut crowds: BTreeMap<K, (usize, PeerId)> = BTreeMap::new();
    peers.for_each(|(peer, crowd)| crowds.entry(crowd).or_insert((0, peer)).0 += 1);
    let (count, oldest) = crowds.into_values().max_by_key(|(count, oldest)| (*count, Reverse(*oldest)))?;
    Some((oldest, count))
}

/// The handshake that is given up for a newcomer's, if there are too many: a lawful one needs a round trip and no more. It is the oldest of
/// the newcomer's own address or network where these have too many, otherwise of the network that has most. `half_open` from old to new.
pub(crate) fn given_up_for(newcomer: IpAddr, half_open: &[(PeerId, IpAddr)]) -> Option<PeerId> {
    let oldest = |most: usize, is_counted: &dyn Fn(IpAddr) -> bool| {
        let mut counted = half_open.iter().filter(|(_, address)| is_counted(*address));
        let is_full = counted.clone().count() >= most;
        counted.next().filter(|_| is_full).map(|(peer, _)| *peer)
    };
    let by_network = || half_open.iter().map(|(peer, address)| (*peer, Network::of(*address)));
    oldest(MOST_OF_ADDRESS, &|address| address == newcomer)
        .or_else(|| oldest(MOST_OF_NETWORK, &|address| Network::of(address) == Network::of(newcomer)))
        .or_else(|| if half_open.len() < MOST { None } else { crowded(by_network()).map(|(peer, _)| peer) })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network(address: &str) -> Network {
        Network::of(address.parse().expect("an address"))
    }

    #[test]
    fn machines_of_one_network_are_told_from_others() {
        assert_eq!(network("192.168.1.5"), network("192.168.1.77"));
        assert_eq!(network("192.168.1.5"), network("::ffff:192.168.1.6"));
        assert_ne!(network("192.168.1.5"), network("192.168.2.5"));
        assert_eq!(network("fd00:1:2:3::1"), network("fd00:1:2:3:4:5:6:7"));
        assert_ne!(network("fd00:1:2:3::1"), network("fd00:1:2:4::1"));
    }

    #[test]
    fn a_network_that_begins_too_much_keeps_out_itself_alone() {
        let mut arrivals = Arrivals::default();
        let (greedy, other) = (network("10.0.0.1"), network("10.0.1.1"));
        let begun = (0..5000).filter(|n| arrivals.take(greedy, n * 1_000_000)).count();
        assert!((2300..2500).contains(&begun), "400 at once and 400 in each of five seconds: {begun}");
        assert!(arrivals.take(other, 5_000_000_000));
    }

    #[test]
    fn networks_of_a_moment_ago_are_forgotten() {
        let mut arrivals = Arrivals::default();
        let many =
            (0..MAX_NETWORKS as u32 + 10).map(|n| Network::V4([(n >> 16) as u8, (n >> 8) as u8, n as u8]));
        let begun = many.filter(|network| arrivals.take(*network, 0)).count();
        assert_eq!(begun, MAX_NETWORKS);
        assert!(arrivals.take(network("10.9.9.9"), 2_000_000_000));
        assert_eq!(arrivals.networks.len(), 1);
    }

    /// Peers of these addresses, numbered from 0.
    fn peers(addresses: impl IntoIterator<Item = String>) -> Vec<(PeerId, IpAddr)> {
        let parsed = addresses.into_iter().map(|address| address.parse().expect("an address"));
        parsed.enumerate().map(|(n, address)| (PeerId(n as u64), address)).collect()
    }

    #[test]
    fn a_handshake_is_given_up_for_a_newcomer_where_its_crowd_is_too_large() {
        let given_up = |newcomer: &str, half_open| {
            given_up_for(newcomer.parse().expect("an address"), &peers(half_open)).map(|peer| peer.0)
        };
        let of_one = |count: usize| (0..count).map(|_| "10.0.0.1".to_owned()).collect::<Vec<_>>();
        assert_eq!(given_up("10.0.0.1", of_one(7)), None);
        assert_eq!(given_up("10.0.0.1", of_one(8)), Some(0));
        assert_eq!(given_up("10.0.0.2", of_one(8)), None, "another address of that network");
        let of_network = |count: usize| (0..count).map(|n| format!("10.0.0.{n}")).collect::<Vec<_>>();
        assert_eq!(given_up("10.0.0.99", of_network(31)), None);
        assert_eq!(given_up("10.0.0.99", of_network(32)), Some(0));
        assert_eq!(given_up("10.0.1.99", of_network(32)), None, "another network");
        let few_then_many = || (0..64).map(|n| format!("10.0.{}.{n}", n / 30));
        assert_eq!(given_up("10.9.9.9", few_then_many().take(63).collect()), None);
        assert_eq!(given_up("10.9.9.9", few_then_many().collect()), Some(0));
        let one_first = std::iter::once("10.1.1.1".to_owned()).chain(of_network(63));
        assert_eq!(given_up("10.9.9.9", one_first.collect()), Some(1), "the crowd pays, not the oldest");
    }
}

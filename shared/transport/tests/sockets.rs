//! The whole crate on real sockets: two programs on one machine, with threads, restarts and noise.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use shadecast_transport::mio::{DriverError, Stopped};
use shadecast_transport::{
    CloseKind, Direction, Driver, Endpoint, EndpointConfig, Event, Events, ExpectedIdentity, Handle,
    KnownServers, LinkProfile, PeerId, ServerIdentity, spawn,
};

/// Nothing here takes that long unless it is broken.
const PATIENCE: Duration = Duration::from_secs(30);
const ANY: SocketAddr = SocketAddr::new(std::net::IpAddr::V4(Ipv4Addr::LOCALHOST), 0);

fn server_driver(identity: &ServerIdentity, address: SocketAddr) -> Driver {
    let endpoint = Endpoint::server(identity, EndpointConfig::default()).unwrap();
    Driver::bind(endpoint, address).unwrap()
}

fn client_driver() -> Driver {
    Driver::bind(Endpoint::client(EndpointConfig::default()), ANY).unwrap()
}

/// A program: its network thread and the events it has seen.
struct Program {
    handle: Handle,
    events: Events,
}

impl Program {
    fn start(driver: Driver) -> Self {
        let (handle, events) = spawn(driver).unwrap();
        Self { handle, events }
    }

    fn server(seed: u64) -> Self {
        Self::start(server_driver(&ServerIdentity::from_seed(seed).unwrap(), ANY))
    }

    #[track_caller]
    fn next(&self) -> Event {
        match self.events.next_timeout(PATIENCE) {
            Ok(Some(event)) => event,
            other => panic!("no event: {other:?}"),
        }
    }

    /// Waits for a connection, whatever else comes before.
    #[track_caller]
    fn wait_connected(&self) -> PeerId {
        loop {
            match self.next() {
                Event::Connected { peer, .. } => return peer,
                Event::Closed { reason, .. } => panic!("not connected: {reason}"),
                _ => {}
            }
        }
    }

    /// Waits for the end of a connection, whatever else comes before.
    #[track_caller]
    fn wait_closed(&self) -> (CloseKind, String) {
        loop {
            if let Event::Closed { kind, reason, .. } = self.next() {
                return (kind, reason);
            }
        }
    }
}

/// A server and a client that are connected.
struct Both {
    server: Program,
    client: Program,
    on_server: PeerId,
    on_client: PeerId,
}

#[track_caller]
fn connect(server: Program, client: Program) -> Both {
    let on_client =
        client.handle.connect(server.handle.local_addr(), ExpectedIdentity::TrustOnFirstUse).unwrap();
    let on_server = server.wait_connected();
    assert_eq!(client.wait_connected(), on_client);
    Both { server, client, on_server, on_client }
}

fn pattern(size: usize, salt: usize) -> Vec<u8> {
    (0..size).map(|i| (i.wrapping_mul(31) ^ (i >> 8) ^ salt) as u8).collect()
}

/// Receives a control message of each size and the first `count` streams, and checks that each is as it was sent.
#[track_caller]
fn receive_all(program: &Program, sizes: &[usize], count: usize) {
    let (mut control, mut streams) = (0, 0);
    while control < sizes.len() || streams < count {
        match program.next() {
            Event::Control { message, .. } => {
                assert!(
                    message == pattern(sizes[control].min(1 << 20), control),
                    "control message {control}"
                );
                control += 1;
            }
            Event::Stream { bytes, .. } => {
                let salt = sizes.iter().position(|&size| size == bytes.len()).expect("a size that was sent");
                assert!(bytes == pattern(bytes.len(), salt), "stream {salt}");
                streams += 1;
            }
            other => panic!("{other:?}"),
        }
    }
}

#[track_caller]
fn exchange_all_sizes(both: &Both) {
    let sizes = [1, 2, 100, 1199, 1200, 1201, 65_536, 500_000, 2_000_000];
    for (program, peer) in [(&both.server, both.on_server), (&both.client, both.on_client)] {
        for (salt, &size) in sizes.iter().enumerate() {
            program.handle.send_control(peer, pattern(size.min(1 << 20), salt)).unwrap();
        }
    }
    for (salt, &size) in sizes.iter().enumerate() {
        both.server.handle.send_stream(both.on_server, pattern(size, salt), 0).unwrap();
    }
    receive_all(&both.client, &sizes, sizes.len());
    receive_all(&both.server, &sizes, 0);
}

#[test]
fn messages_of_all_sizes_arrive_whole_both_ways() {
    exchange_all_sizes(&connect(Program::server(1), Program::start(client_driver())));
}

#[test]
fn everything_arrives_through_a_lossy_link_on_real_sockets() {
    let link: LinkProfile = "latency=5ms,jitter=2ms,loss=1%,rate=200mbit".parse().unwrap();
    let driver = server_driver(&ServerIdentity::from_seed(2).unwrap(), ANY).with_link(link, 2);
    let both = connect(Program::start(driver), Program::start(client_driver()));
    exchange_all_sizes(&both);
    // The counters are published now and then.
    std::thread::sleep(Duration::from_millis(300));
    let counts = both.server.handle.link_counts(Direction::ToClient).unwrap();
    assert!(counts.lost > 0 && counts.delivered > 1000, "{counts:?}");
    let stats = both.server.handle.stats(both.on_server).unwrap();
    assert!(stats.min_rtt >= Duration::from_millis(6), "the link's delay shows: {stats:?}");
}

#[test]
fn datagrams_arrive_beside_a_bulk_stream() {
    let both = connect(Program::server(3), Program::start(client_driver()));
    for _ in 0..20 {
        both.server.handle.send_stream(both.on_server, vec![7; 1 << 20], 0).unwrap();
    }
    for n in 0..100_u32 {
        both.client.handle.send_datagram(both.on_client, n.to_le_bytes().to_vec()).unwrap();
        std::thread::sleep(Duration::from_millis(1));
    }
    let mut streams = 0;
    while streams < 20 {
        streams += usize::from(matches!(both.client.next(), Event::Stream { .. }));
    }
    let received =
        std::iter::from_fn(|| both.server.events.next_timeout(Duration::from_millis(500)).unwrap())
            .filter(|event| matches!(event, Event::Datagram { bytes, .. } if bytes.len() == 4))
            .count();
    assert!(received >= 50, "{received} of 100 on loopback");
}

#[test]
fn a_killed_client_is_noticed_and_the_next_one_is_served() {
    let server = Program::server(4);
    let mut victim = client_driver();
    let address = server.handle.local_addr();
    let now_ns = shadecast_system::monotonic_now_ns();
    victim.endpoint().connect(now_ns, address, ExpectedIdentity::TrustOnFirstUse);
    let deadline = Instant::now() + PATIENCE;
    while !matches!(victim.endpoint().poll_event(), Some(Event::Connected { .. })) {
        assert!(Instant::now() < deadline, "no connection");
        victim.poll(Duration::from_millis(10)).unwrap();
    }
    server.wait_connected();
    // A driver that is dropped says nothing, like a killed program.
    drop(victim);
    assert!(matches!(server.next(), Event::Away { .. }));
    connect(server, Program::start(client_driver()));
}

#[test]
fn a_client_finds_its_restarted_server_and_refuses_another() {
    let dir = tempfile::tempdir().unwrap();
    let identity = ServerIdentity::load_or_create(&dir.path().join("server")).unwrap();
    let mut known = KnownServers::load(&dir.path().join("client")).unwrap();
    let mut server = server_driver(&identity, ANY);
    let address = server.local_addr().unwrap();
    let client = Program::start(client_driver());

    // Two lives of one server. The first ends without a word.
    for life in 0..2 {
        client.handle.connect(address, known.expected(&address.to_string(), address)).unwrap();
        let deadline = Instant::now() + PATIENCE;
        while !matches!(server.endpoint().poll_event(), Some(Event::Connected { .. })) {
            assert!(Instant::now() < deadline, "no connection in life {life}");
            server.poll(Duration::from_millis(10)).unwrap();
        }
        let Event::Connected { fingerprint: Some(fingerprint), .. } = client.next() else {
            panic!("the client does not know the server");
        };
        known.remember(&address.to_string(), address, fingerprint).unwrap();
        drop(server);
        let identity = ServerIdentity::load_or_create(&dir.path().join("server")).unwrap();
        server = server_driver(&identity, address);
        let deadline = Instant::now() + PATIENCE;
        let closed = loop {
            server.poll(Duration::from_millis(10)).unwrap();
            if let Some(event) = client.events.try_next() {
                break event;
            }
            assert!(Instant::now() < deadline, "the restart of life {life} was not noticed");
        };
        assert!(matches!(closed, Event::Closed { kind: CloseKind::Restarted, .. }), "{closed:?}");
    }

    drop(server);
    let impostor = server_driver(&ServerIdentity::generate().unwrap(), address);
    let _impostor = Program::start(impostor);
    let known = KnownServers::load(&dir.path().join("client")).unwrap();
    client.handle.connect(address, known.expected(&address.to_string(), address)).unwrap();
    let (kind, reason) = client.wait_closed();
    assert_eq!(kind, CloseKind::IdentityChanged);
    for word in ["another identity", "delete the line", &address.to_string(), "known_servers.toml"] {
        assert!(reason.contains(word), "\"{word}\" is not in: {reason}");
    }
}

#[test]
fn dropping_the_handle_ends_the_thread_and_tells_the_peer() {
    let both = connect(Program::server(6), Program::start(client_driver()));
    let Program { handle, events } = both.client;
    drop(handle);
    while events.next_timeout(PATIENCE) != Err(Stopped) {}
    let (kind, reason) = both.server.wait_closed();
    assert_eq!(kind, CloseKind::Peer(0), "{reason}");
}

#[test]
fn an_application_that_is_slow_to_take_events_loses_none() {
    let config = EndpointConfig { control_per_s: u32::MAX, ..EndpointConfig::default() };
    let client = Driver::bind(Endpoint::client(config), ANY).unwrap();
    let both = connect(Program::server(7), Program::start(client));
    let count = 6000_u32;
    for n in 0..count {
        while both.server.handle.send_control(both.on_server, n.to_le_bytes().to_vec()).is_err() {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    std::thread::sleep(Duration::from_millis(300));
    for n in 0..count {
        let event = both.client.next();
        assert!(
            matches!(&event, Event::Control { message, .. } if message[..] == n.to_le_bytes()),
            "{n}: {event:?}"
        );
    }
}

#[test]
fn random_datagrams_at_the_port_do_no_harm() {
    let both = connect(Program::server(8), Program::start(client_driver()));
    let stranger = UdpSocket::bind(ANY).unwrap();
    for program in [&both.server, &both.client] {
        for n in 0..2000_usize {
            let mut bytes = pattern(n % 1400, n.wrapping_mul(7919));
            if n % 3 == 0 && bytes.len() > 8 {
                bytes[..5].copy_from_slice(&[0xc0, 0, 0, 0, 1]);
            }
            stranger.send_to(&bytes, program.handle.local_addr()).unwrap();
        }
    }
    exchange_all_sizes(&both);
}

#[test]
fn a_port_in_use_is_named_with_a_hint() {
    let taken = UdpSocket::bind(ANY).unwrap();
    let address = taken.local_addr().unwrap();
    let Err(error @ DriverError::Bind { .. }) =
        Driver::bind(Endpoint::client(EndpointConfig::default()), address)
    else {
        panic!("bound twice");
    };
    let message = error.to_string();
    assert!(message.contains(&address.to_string()) && message.contains("--listen"), "{message}");
}

#[test]
fn a_second_life_of_the_client_needs_no_new_thread() {
    let both = connect(Program::server(9), Program::start(client_driver()));
    both.client.handle.close(both.on_client, 5, "switching").unwrap();
    assert_eq!(both.client.wait_closed().0, CloseKind::Local);
    let (kind, reason) = both.server.wait_closed();
    assert_eq!(kind, CloseKind::Peer(5));
    assert!(reason.contains("switching"), "{reason}");
    exchange_all_sizes(&connect(both.server, both.client));
}

#[test]
fn what_waits_to_be_sent_is_known_the_moment_it_is_handed_over() {
    let link: LinkProfile = "latency=100ms".parse().unwrap();
    let driver = server_driver(&ServerIdentity::from_seed(10).unwrap(), ANY).with_link(link, 10);
    let both = connect(Program::start(driver), Program::start(client_driver()));
    let stats = || both.server.handle.stats(both.on_server);
    let deadline = Instant::now() + PATIENCE;
    while stats().is_none() {
        assert!(Instant::now() < deadline, "nothing was published");
        std::thread::sleep(Duration::from_millis(1));
    }
    // A round trip is 200 ms, so that nothing is acknowledged while this is handed over.
    for n in 1..=3 {
        both.server.handle.send_stream(both.on_server, vec![0; 1000], 0).unwrap();
        let stats = stats().expect("connected");
        assert_eq!((stats.streams_under_way, stats.unacknowledged_bytes), (n, n * 1000));
    }
    while stats().is_some_and(|stats| stats.streams_under_way > 0 || stats.unacknowledged_bytes > 0) {
        assert!(Instant::now() < deadline, "never acknowledged: {:?}", stats());
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(stats().is_some_and(|stats| stats.queued_bytes == 0), "{:?}", stats());
}

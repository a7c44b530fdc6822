//! Two sessions over a simulated link, without pictures and GPUs: the number of round trips before the first picture.

use shadecast_protocol::delta::DeltaEncoder;
use shadecast_protocol::geometry::GeometryDelta;
use shadecast_protocol::session::{
    ClientEvent, ClientSession, DeltaSender, Out, ServerEvent, ServerSession, picture_stream,
};
use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_protocol::wire::PictureHeader;
use shadecast_test_support::peers::{head, hello, offer};
use shadecast_transport::pair::SERVER_ADDR;
use shadecast_transport::{
    Direction, Endpoint, EndpointConfig, Event, ExpectedIdentity, LinkProfile, Pair, PeerId, ServerIdentity,
};

const MS: i64 = 1_000_000;
/// A large first picture, bytes.
const PICTURE_BYTES: usize = 900_000;

/// Both ends of a session and the network between them.
struct Play {
    pair: Pair,
    on_client: PeerId,
    on_server: Option<PeerId>,
    client: Option<ClientSession>,
    server: ServerSession,
    sender: Option<DeltaSender>,
    /// The first update's streams.
    update: Vec<Out>,
    /// The welcome is here and the head was not told yet.
    wants_head: bool,
}

impl Play {
    fn new(link: &str) -> Self {
        let profile: LinkProfile = link.parse().unwrap();
        let config = || EndpointConfig { seed: Some(1), ..EndpointConfig::default() };
        let server = Endpoint::server(&ServerIdentity::from_seed(1).unwrap(), config()).unwrap();
        let mut pair = Pair::new(server, Endpoint::client(config()), profile, 1);
        let on_client = pair.client.connect(0, SERVER_ADDR, ExpectedIdentity::TrustOnFirstUse);
        let server = ServerSession::new(offer());
        Self {
            pair,
            on_client,
            on_server: None,
            client: None,
            server,
            sender: None,
            update: Vec::new(),
            wants_head: false,
        }
    }

    /// Milliseconds until the client has the first update's geometry and picture; nothing takes time but the network.
    fn first_picture_ms(&mut self) -> i64 {
        let (mut has_delta, mut has_picture) = (false, false);
        while !(has_delta && has_picture) {
            let seen = self.pair.step_to_events(20_000 * MS);
            assert!(!seen.is_empty(), "nothing comes any more");
            for (end, event) in seen {
                match end {
                    Direction::ToServer => self.server_event(event),
                    Direction::ToClient => self.client_event(event),
                }
            }
            while let Some(event) = self.client.as_mut().and_then(ClientSession::poll_event) {
                self.wants_head |= matches!(event, ClientEvent::Welcome(_));
                has_delta |= matches!(event, ClientEvent::Delta(_));
                has_picture |= matches!(event, ClientEvent::Picture { .. });
            }
            self.report_head();
            self.answer();
            self.flush();
        }
        self.pair.now_ns() / MS
    }

    fn client_event(&mut self, event: Event) {
        let now = ClientTime(self.pair.now_ns());
        match (event, &mut self.client) {
            (Event::Connected { .. }, client) => *client = Some(ClientSession::start(hello(), now)),
            (Event::Control { message, .. }, Some(client)) => client.on_control(&message),
            (Event::Datagram { bytes, .. }, Some(client)) => client.on_datagram(&bytes, now),
            (Event::Stream { bytes, .. }, Some(client)) => client.on_stream(&bytes),
            (event, _) => panic!("{event:?}"),
        }
    }

    fn server_event(&mut self, event: Event) {
        match event {
            Event::Connected { peer, .. } => self.on_server = Some(peer),
            Event::Control { message, .. } => self.server.on_control(&message),
            Event::Datagram { bytes, at_ns, .. } => self.server.on_datagram(&bytes, ServerTime(at_ns)),
            event => panic!("{event:?}"),
        }
    }

    /// The head is told as soon as the server's clock is known, which is what its time is on.
    fn report_head(&mut self) {
        let Some(client) = self.client.as_mut().filter(|_| self.wants_head) else { return };
        let Some(time) = client.clock().server_time(ClientTime(self.pair.now_ns())) else { return };
        client.send_pose(head(0, time));
        self.wants_head = false;
    }

    /// The first update follows the first pose.
    fn answer(&mut self) {
        while let Some(event) = self.server.poll_event() {
            match (event, &mut self.sender) {
                (ServerEvent::Asked { .. }, sender) => *sender = self.server.accept(),
                (ServerEvent::Head(_), Some(sender)) => {
                    let frame = sender.next_update();
                    let delta = GeometryDelta { update: frame, ..Default::default() };
                    let header = PictureHeader { update: frame, time: ServerTime(0), is_refresh: true };
                    self.update.push(
                        sender.stream(&DeltaEncoder::new(1, 1).from_delta(frame.0).encode(&delta.into())),
                    );
                    self.update.push(picture_stream(header, &vec![7; PICTURE_BYTES]).unwrap());
                }
                (event, _) => panic!("{event:?}"),
            }
        }
    }

    fn flush(&mut self) {
        while let Some(out) = self.client.as_mut().and_then(ClientSession::poll_out) {
            match out {
                Out::Control(message) => self.pair.client.send_control(self.on_client, &message).unwrap(),
                Out::Datagram(bytes) => assert!(self.pair.client.send_datagram(self.on_client, &bytes)),
                Out::Stream { .. } => panic!("clients send no streams"),
            }
        }
        let (now, Some(peer)) = (ServerTime(self.pair.now_ns()), self.on_server) else { return };
        let update = std::mem::take(&mut self.update);
        for out in std::iter::from_fn(|| self.server.poll_out(now)).chain(update) {
            match out {
                Out::Control(message) => self.pair.server.send_control(peer, &message).unwrap(),
                Out::Datagram(bytes) => assert!(self.pair.server.send_datagram(peer, &bytes)),
                Out::Stream { bytes, priority } => {
                    self.pair.server.send_stream(peer, bytes, priority).unwrap();
                }
            }
        }
    }
}

#[test]
fn a_first_picture_comes_after_three_round_trips_however_large() {
    // Handshake, hello and welcome, pose and picture. A fourth would make it 880 ms.
    for link in ["latency=110ms", "latency=110ms,rate=1gbit"] {
        let ms = Play::new(link).first_picture_ms();
        assert!((660..660 + 50).contains(&ms), "{link}: {ms} ms");
    }
}

#[test]
fn jitter_costs_a_first_picture_no_more_than_itself() {
    let ms = Play::new("latency=110ms,jitter=10ms").first_picture_ms();
    assert!(ms < 660 + 6 * 10 + 50, "{ms} ms");
}

//! Two sessions over a link with an outage, without pictures and GPUs: the client's memory is the server's model of it after any
//! outage, without a new session and without anything sent twice.

use glam::Vec3;
use shadecast_protocol::delta::DeltaEncoder;
use shadecast_protocol::geometry::{GeometryDelta, InstanceInfo, Motion, NewVertex};
use shadecast_protocol::ids::{InstanceId, VertexSlot};
use shadecast_protocol::motion::message::{MotionMessage, MotionNews};
use shadecast_protocol::session::{
    ClientEvent, ClientSession, DeltaSender, Out, ServerEvent, ServerSession, motion_stream,
};
use shadecast_protocol::time::{ClientTime, ServerTime};
use shadecast_test_support::peers::{head, hello, offer};
use shadecast_transport::pair::SERVER_ADDR;
use shadecast_transport::{
    Direction, Endpoint, EndpointConfig, Event, ExpectedIdentity, LinkProfile, LinkSchedule, Pair, PeerId,
    ServerIdentity,
};

const MS: i64 = 1_000_000;
const S: i64 = 1000 * MS;
const FRAME_NS: i64 = 14 * MS;
const UPDATE_NS: i64 = 33 * MS;
const OUTAGE_AT_NS: i64 = 3 * S;
const SLOTS: u32 = 1000;

/// Random numbers from a seed (splitmix64).
struct Dice(u64);

impl Dice {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        (mixed ^ (mixed >> 27)) % end
    }
}

/// A server that changes its client's memory at random, 30 times a second, while the client is not away.
struct Server {
    session: ServerSession,
    sender: Option<DeltaSender>,
    encoder: DeltaEncoder,
    on_client: Vec<VertexSlot>,
    dice: Dice,
    motion_sent: u32,
    is_away: bool,
    heard_head_ns: i64,
}

impl Server {
    /// The streams of the next update: some vertices leave, others enter their slots, and a word about motion.
    fn update(&mut self) -> Vec<Out> {
        let Some(sender) = self.sender.as_mut().filter(|_| !self.is_away) else { return Vec::new() };
        let mut delta = GeometryDelta { update: sender.next_update(), ..GeometryDelta::default() };
        if delta.update.0 == 0 {
            delta.instances = vec![InstanceInfo { instance: InstanceId(1), step_m: 0.001 }];
        }
        for _ in 0..self.dice.below(40).min(self.on_client.len() as u64) {
            let place = self.dice.below(self.on_client.len() as u64) as usize;
            delta.evicted_vertices.push(self.on_client.swap_remove(place));
        }
        for _ in 0..self.dice.below(60) {
            let slot = VertexSlot(self.dice.below(SLOTS.into()) as u32);
            if self.on_client.contains(&slot) {
                continue;
            }
            let at = self.dice.below(1000) as f32;
            let motion = [Motion::Static { position: Vec3::splat(at) }, Motion::Sampled];
            let motion = motion[self.dice.below(2) as usize];
            delta.new_vertices.push(NewVertex { slot, instance: InstanceId(1), number: slot.0, motion });
            self.on_client.push(slot);
        }
        delta.evicted_vertices.sort_unstable();
        delta.new_vertices.sort_unstable_by_key(|vertex| vertex.slot);
        let news = MotionNews::Clock(Box::default());
        let message = MotionMessage { sequence: self.motion_sent, news };
        self.motion_sent += 1;
        vec![sender.stream(&self.encoder.encode_update(&delta)), motion_stream(&message, None)]
    }

    fn take(&mut self, event: Event) {
        match event {
            Event::Control { message, .. } => self.session.on_control(&message),
            Event::Datagram { bytes, at_ns, .. } => self.session.on_datagram(&bytes, ServerTime(at_ns)),
            Event::Away { .. } => self.is_away = true,
            Event::Back { .. } => self.is_away = false,
            event => panic!("{event:?}"),
        }
        while let Some(event) = self.session.poll_event() {
            match event {
                ServerEvent::Asked { welcome, .. } => {
                    let encoder = DeltaEncoder::new(welcome.vertex_slots, welcome.patch_slots);
                    self.encoder = encoder.with_motion(welcome.motion).with_store(welcome.store_pages);
                    self.sender = self.session.accept();
                }
                ServerEvent::Head(head) => self.heard_head_ns = head.time.0,
                event => panic!("{event:?}"),
            }
        }
    }
}

/// Both ends of a session and the network between them.
struct Play {
    pair: Pair,
    peers: [PeerId; 2],
    client: ClientSession,
    server: Server,
    motion_came: Vec<u32>,
    next_ns: [i64; 2],
    poses: u32,
}

impl Play {
    fn new(outage_ns: i64, seed: u64) -> Self {
        let usual: LinkProfile = "latency=20ms,jitter=5ms,loss=1%,rate=50mbit".parse().unwrap();
        let schedule = LinkSchedule::interrupted(usual, OUTAGE_AT_NS, outage_ns);
        let config = |salt| EndpointConfig { seed: Some(seed + salt), ..EndpointConfig::default() };
        let server = Endpoint::server(&ServerIdentity::from_seed(1).unwrap(), config(0)).unwrap();
        let mut pair = Pair::new(server, Endpoint::client(config(100)), schedule, seed);
        let on_client = pair.client.connect(0, SERVER_ADDR, ExpectedIdentity::TrustOnFirstUse);
        let on_server = loop {
            let seen = pair.step_to_events(S);
            let connected = seen.into_iter().find_map(|(end, event)| match (end, event) {
                (Direction::ToServer, Event::Connected { peer, .. }) => Some(peer),
                _ => None,
            });
            if let Some(peer) = connected {
                break peer;
            }
        };
        let now_ns = pair.now_ns();
        let server = Server {
            session: ServerSession::new(offer()),
            sender: None,
            encoder: DeltaEncoder::new(SLOTS, SLOTS),
            on_client: Vec::new(),
            dice: Dice(seed),
            motion_sent: 0,
            is_away: false,
            heard_head_ns: 0,
        };
        let client = ClientSession::start(hello(), ClientTime(now_ns));
        let peers = [on_server, on_client];
        Self { pair, peers, client, server, motion_came: Vec::new(), next_ns: [now_ns; 2], poses: 0 }
    }

    fn play_until(&mut self, end_ns: i64, makes_updates: bool) {
        while self.pair.now_ns() < end_ns {
            let next_ns = self.next_ns[0].min(self.next_ns[1]).min(end_ns);
            for (end, event) in self.pair.step_to_events(next_ns) {
                match end {
                    Direction::ToServer => self.server.take(event),
                    Direction::ToClient => self.hear(event),
                }
            }
            let now_ns = self.pair.now_ns();
            if now_ns >= self.next_ns[0] {
                self.next_ns[0] += FRAME_NS;
                self.client.on_tick(ClientTime(now_ns));
                self.poses += 1;
                self.client.send_pose(head(self.poses, ServerTime(now_ns)));
            }
            let mut streams = Vec::new();
            if now_ns >= self.next_ns[1] {
                self.next_ns[1] += UPDATE_NS;
                streams = if makes_updates { self.server.update() } else { Vec::new() };
            }
            self.flush(streams);
        }
    }

    fn hear(&mut self, event: Event) {
        let now = ClientTime(self.pair.now_ns());
        match event {
            Event::Control { message, .. } => self.client.on_control(&message),
            Event::Datagram { bytes, .. } => self.client.on_datagram(&bytes, now),
            Event::Stream { bytes, .. } => self.client.on_stream(&bytes),
            Event::Connected { .. } | Event::Away { .. } | Event::Back { .. } => {}
            event => panic!("{event:?}"),
        }
        self.client.note_alive(now);
        while let Some(event) = self.client.poll_event() {
            match event {
                ClientEvent::Motion(message) => self.motion_came.push(message.sequence),
                ClientEvent::Welcome(_) | ClientEvent::Delta(_) => {}
                event => panic!("{event:?}"),
            }
        }
    }

    fn flush(&mut self, streams: Vec<Out>) {
        let [on_server, on_client] = self.peers;
        while let Some(out) = self.client.poll_out() {
            match out {
                Out::Control(message) => self.pair.client.send_control(on_client, &message).unwrap(),
                Out::Datagram(bytes) => drop(self.pair.client.send_datagram(on_client, &bytes)),
                Out::Stream { .. } => panic!("clients send no streams"),
            }
        }
        let now = ServerTime(self.pair.now_ns());
        for out in std::iter::from_fn(|| self.server.session.poll_out(now)).chain(streams) {
            match out {
                Out::Control(message) => self.pair.server.send_control(on_server, &message).unwrap(),
                Out::Datagram(bytes) => drop(self.pair.server.send_datagram(on_server, &bytes)),
                Out::Stream { bytes, priority } => {
                    self.pair.server.send_stream(on_server, bytes, priority).unwrap();
                }
            }
        }
    }
}

#[test]
fn memories_are_equal_on_both_sides_after_outages_of_1_to_59_seconds() {
    for outage_s in (1..=59).step_by(2) {
        let mut dice = Dice(outage_s as u64);
        let outage_ns = outage_s * S + dice.below(1000) as i64 * MS - 500 * MS;
        let mut play = Play::new(outage_ns, outage_s as u64);
        play.play_until(OUTAGE_AT_NS, true);
        let before = play.server.sender.as_ref().expect("welcomed").next_update().0;
        play.play_until(OUTAGE_AT_NS + outage_ns, true);
        let during = play.server.sender.as_ref().expect("welcomed").next_update().0;
        assert!(during - before <= 100, "{outage_s} s: updates pause while nothing comes");
        play.play_until(OUTAGE_AT_NS + outage_ns + 300 * MS, true);
        let back_ns = play.pair.now_ns();
        assert!(back_ns - play.server.heard_head_ns < 60 * MS, "{outage_s} s: the head is told again");
        play.play_until(back_ns + S, true);
        // The last updates arrive.
        play.play_until(back_ns + 2 * S, false);
        let after = play.server.sender.as_ref().expect("welcomed").next_update().0;
        assert!(after > during + 20, "{outage_s} s: updates go on");
        let held = play.client.memory().expect("welcomed");
        assert!(held == play.server.encoder.memory(), "{outage_s} s, seed {outage_s}");
        let mut came = play.motion_came.clone();
        came.sort_unstable();
        assert_eq!(came, (0..play.server.motion_sent).collect::<Vec<_>>(), "{outage_s} s: each once");
    }
}

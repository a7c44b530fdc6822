//! A server that greets a client correctly, and then breaks the protocol. It uses the project's own transport, which carries
//! any streams and datagrams. It keeps one identity, so the client takes it for the same server when it behaves.

use anyhow::Context;
use glam::{Quat, Vec3};
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockAddress, BlockSize, PatchKind};
use shadecast_protocol::delta::{Delta, DeltaEncoder};
use shadecast_protocol::geometry::{GeometryDelta, InstanceInfo, Motion, NewPatch, NewVertex};
use shadecast_protocol::ids::{InstanceId, MeshId, PatchSlot, UpdateId, VertexSlot};
use shadecast_protocol::limits::{MAX_NEW_SAMPLE_GRIDS, MAX_PATCH_SLOTS, MAX_VERTEX_SLOTS};
use shadecast_protocol::message::{
    Codec, Environment, MotionMemory, ResumeSecret, ServerDatagram, ServerOffer, Welcome,
};
use shadecast_protocol::motion::SampleBatch;
use shadecast_protocol::picture::I420;
use shadecast_protocol::pose::Pose;
use shadecast_protocol::session::{DeltaSender, Out, ServerEvent, ServerSession, picture_stream};
use shadecast_protocol::time::{ClientTime, DEFAULT_GRID, GridIndex, ServerTime, WorldTime};
use shadecast_protocol::wire::{PictureHeader, encode_geometry, encode_picture};
use shadecast_server::encode::openh264::{EncoderSettings, OpenH264Encoder};
use shadecast_server::encode::{Source, encode_one};
use shadecast_system::monotonic_now_ns;
use shadecast_transport::{
    Driver, Endpoint, EndpointConfig, Event, Events, Handle, PeerId, ServerIdentity, spawn,
};
use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// From one turn to the next.
const TURN: Duration = Duration::from_millis(2);
/// Turns between two lawful updates.
const UPDATE_TURNS: u64 = 50;
/// Where the frame's number stands in the bytes of a delta: after the four bytes of its mark.
const FRAME_AT: std::ops::Range<usize> = 4..8;
/// Deltas without content on one connection.
const HOLLOW_DELTAS: u32 = 250;
/// Bytes that may wait to be sent before more is added.
const MAX_QUEUED_BYTES: u64 = 4 << 20;
/// Pongs in one turn: some 30,000 a second.
const PONGS: i64 = 64;

/// What a rogue sends after its welcome.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Conduct {
    /// Nothing.
    Silent,
    /// Updates that can be shown.
    Lawful,
    /// Pictures of a frame that is four thousand million ahead.
    FarPictures,
    /// Pictures of the last frame that there is, and of the first.
    LastPictures,
    /// Deltas with as many samples as there may be, each of no bits.
    HollowDeltas,
    /// Answers to pings that were never sent.
    Pongs,
    /// Streams and pictures that are cut, of no kind, or as large as may be.
    BrokenUnits,
}

/// A rogue on threads of its own.
pub(crate) struct Rogue {
    /// Where it listens.
    pub(crate) address: SocketAddr,
    stop: Arc<AtomicBool>,
    shared: Arc<Mutex<Shared>>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    conduct: Conduct,
    /// When the client said that it shows a frame of a lawful session.
    displayed: Vec<Instant>,
    welcomes: u64,
    /// Streams and datagrams sent against the rules.
    sent: u64,
}

impl Rogue {
    pub(crate) fn start(identity: &Path) -> anyhow::Result<Self> {
        let identity = ServerIdentity::load_or_create(identity)?;
        let endpoint = Endpoint::server(&identity, EndpointConfig::default())?;
        let driver = Driver::bind(endpoint, SocketAddr::from((Ipv4Addr::LOCALHOST, 0)))?;
        let (handle, events) = spawn(driver)?;
        let shared = Shared { conduct: Conduct::Silent, displayed: Vec::new(), welcomes: 0, sent: 0 };
        let (stop, shared) = (Arc::new(AtomicBool::new(false)), Arc::new(Mutex::new(shared)));
        let address = handle.local_addr();
        let run = Run { handle, shared: shared.clone(), conduct: Conduct::Silent, client: None };
        let flag = stop.clone();
        let thread = std::thread::Builder::new().name("rogue".into()).spawn(move || run.run(&events, &flag));
        Ok(Self { address, stop, shared, thread: Some(thread.context("starting a rogue")?) })
    }

    /// Changes what is sent. A client that is connected is sent away, and comes back.
    pub(crate) fn behave(&self, conduct: Conduct) {
        self.shared().conduct = conduct;
    }

    /// When the client first said, at `from` or later, that it shows what is lawful.
    pub(crate) fn wait_displayed(&self, from: Instant, patience: Duration) -> Option<Instant> {
        let deadline = Instant::now() + patience;
        loop {
            let found = self.shared().displayed.iter().copied().find(|at| *at >= from);
            if found.is_some() || Instant::now() >= deadline {
                return found;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Sessions that stood so far.
    pub(crate) fn welcomes(&self) -> u64 {
        self.shared().welcomes
    }

    /// Streams and datagrams sent against the rules so far.
    pub(crate) fn sent(&self) -> u64 {
        self.shared().sent
    }

    fn shared(&self) -> MutexGuard<'_, Shared> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Rogue {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join(); // its panic was reported already
        }
    }
}

struct Run {
    handle: Handle,
    shared: Arc<Mutex<Shared>>,
    conduct: Conduct,
    client: Option<Client>,
}

/// The client that is connected.
struct Client {
    peer: PeerId,
    session: ServerSession,
    welcome: Option<Welcome>,
    sender: Option<DeltaSender>,
    deltas: DeltaEncoder,
    /// Turns since the welcome.
    turn: u64,
    encoder: Option<OpenH264Encoder>,
    hollow: Option<[Vec<u8>; 2]>,
}

impl Run {
    fn run(mut self, events: &Events, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            match events.next_timeout(TURN) {
                Ok(Some(event)) => self.take(event),
                Ok(None) => self.turn(),
                Err(_) => return,
            }
        }
    }

    fn shared(&self) -> MutexGuard<'_, Shared> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take(&mut self, event: Event) {
        match event {
            Event::Connected { peer, .. } => {
                let session = ServerSession::new(offer());
                let client = Client {
                    peer,
                    session,
                    welcome: None,
                    sender: None,
                    deltas: DeltaEncoder::new(3, 1).with_atlas(AtlasExtent::MIN),
                    turn: 0,
                    encoder: None,
                    hollow: None,
                };
                self.client = Some(client);
            }
            Event::Control { peer, message, .. } => self.with(peer, |session| session.on_control(&message)),
            Event::Datagram { peer, bytes, at_ns } => {
                self.with(peer, |session| session.on_datagram(&bytes, ServerTime(at_ns)));
            }
            Event::Away { peer, .. } | Event::Closed { peer, .. } => {
                drop(self.client.take_if(|client| client.peer == peer))
            }
            Event::Stream { .. } | Event::StreamReset { .. } | Event::Back { .. } => {}
        }
    }

    fn with(&mut self, peer: PeerId, act: impl FnOnce(&mut ServerSession)) {
        let Some(client) = self.client.as_mut().filter(|client| client.peer == peer) else { return };
        act(&mut client.session);
        let mut shared = self.shared.lock().unwrap_or_else(PoisonError::into_inner);
        while let Some(event) = client.session.poll_event() {
            match event {
                ServerEvent::Asked { welcome, .. } => {
                    client.sender = client.session.accept();
                    client.welcome = Some(*welcome);
                    shared.welcomes += 1;
                }
                ServerEvent::Displayed(_) if self.conduct == Conduct::Lawful => {
                    shared.displayed.push(Instant::now());
                }
                _ => {}
            }
        }
        drop(shared);
        self.flush();
    }

    fn flush(&mut self) {
        let Some(client) = &mut self.client else { return };
        while let Some(out) = client.session.poll_out(ServerTime(monotonic_now_ns())) {
            carry(&self.handle, client.peer, out);
        }
    }

    fn turn(&mut self) {
        let conduct = self.shared().conduct;
        if std::mem::replace(&mut self.conduct, conduct) != conduct
            && let Some(client) = self.client.take()
        {
            let _ = self.handle.close(client.peer, 2, "another conduct");
        }
        let Some(client) = self.client.as_mut().filter(|client| client.welcome.is_some()) else { return };
        let queued = self.handle.stats(client.peer).map_or(0, |stats| stats.queued_bytes);
        let turn = client.turn;
        client.turn += 1;
        if conduct == Conduct::Lawful && turn.is_multiple_of(UPDATE_TURNS) {
            match client.update() {
                Ok(update) => update.into_iter().for_each(|out| carry(&self.handle, client.peer, out)),
                Err(error) => tracing::error!("a lawful update could not be made: {error:#}"),
            }
        }
        let (streams, datagrams) =
            if queued < MAX_QUEUED_BYTES { client.mischief(conduct, turn) } else { Default::default() };
        let peer = client.peer;
        self.shared().sent += (streams.len() + datagrams.len()) as u64;
        for bytes in streams {
            let _ = self.handle.send_stream(peer, bytes, 0);
        }
        for bytes in datagrams {
            let _ = self.handle.send_datagram(peer, bytes);
        }
        self.flush();
    }
}

/// Hands bytes to the network thread; what it does not take is lost.
fn carry(handle: &Handle, peer: PeerId, out: Out) {
    let _ = match out {
        Out::Control(bytes) => handle.send_control(peer, bytes),
        Out::Stream { bytes, priority } => handle.send_stream(peer, bytes, priority).map(|_| ()),
        Out::Datagram(bytes) => handle.send_datagram(peer, bytes),
    };
}

impl Client {
    /// An update that can be shown: one triangle before the stage, and a grey picture for it.
    fn update(&mut self) -> anyhow::Result<[Out; 2]> {
        let time = ServerTime(monotonic_now_ns());
        let sender = self.sender.as_mut().context("nobody is accepted")?;
        let frame = sender.next_update();
        let geometry = if frame.0 == 0 { triangle() } else { GeometryDelta::default() };
        let geometry =
            self.deltas.encode(&GeometryDelta { update: frame, time: WorldTime(time.0), ..geometry }.into());
        let geometry = sender.stream(&geometry);
        let encoder = match &mut self.encoder {
            Some(encoder) => encoder,
            none => none.insert(OpenH264Encoder::new(EncoderSettings::new(AtlasExtent::MIN.texels()))?),
        };
        let extent_texels = AtlasExtent::MIN.texels();
        let grey = I420::new(extent_texels, vec![128; I420::byte_count(extent_texels) as usize])?;
        let unit = encode_one(encoder, Source::Planes(grey), time.0, frame.0 == 0)?;
        let header = PictureHeader { update: frame, time, is_refresh: unit.is_refresh };
        Ok([geometry, picture_stream(header, &unit.bytes)?])
    }

    /// Streams and datagrams that break the rules.
    fn mischief(&mut self, conduct: Conduct, turn: u64) -> (Vec<Vec<u8>>, Vec<Vec<u8>>) {
        match conduct {
            Conduct::Silent | Conduct::Lawful => Default::default(),
            Conduct::FarPictures => {
                let frame = 4_000_000_000 + (turn as u32 % 1000) * 100;
                (vec![picture(frame, turn.is_multiple_of(16))], Vec::new())
            }
            Conduct::LastPictures => {
                let frames = [(u32::MAX, true), (u32::MAX, false), (0, true), (u32::MAX - 1, true)];
                let (frame, is_refresh) = frames[turn as usize % frames.len()];
                (vec![picture(frame, is_refresh)], Vec::new())
            }
            Conduct::HollowDeltas if turn < u64::from(HOLLOW_DELTAS) => {
                (vec![self.hollow(turn as u32)], Vec::new())
            }
            Conduct::HollowDeltas => Default::default(),
            Conduct::Pongs => (Vec::new(), pongs(turn)),
            Conduct::BrokenUnits => (vec![broken(turn)], Vec::new()),
        }
    }

    /// The first holds all vertices; of the others only the frame's number differs.
    fn hollow(&mut self, frame: u32) -> Vec<u8> {
        let slots = self.welcome.as_ref().map_or(0, |welcome| welcome.vertex_slots);
        let [first, other] = self.hollow.get_or_insert_with(|| hollow_deltas(slots));
        let mut bytes = if frame == 0 { first.clone() } else { other.clone() };
        bytes[FRAME_AT].copy_from_slice(&frame.to_le_bytes());
        encode_geometry(&bytes)
    }
}

fn offer() -> ServerOffer {
    ServerOffer {
        protocol_version: PROTOCOL_VERSION,
        min_protocol_version: PROTOCOL_VERSION,
        app_version: "rogue".to_owned(),
        session: 1,
        grid: DEFAULT_GRID,
        atlas_extent_texels: AtlasExtent::MIN,
        vertex_slots: MAX_VERTEX_SLOTS,
        patch_slots: MAX_PATCH_SLOTS,
        motion: MotionMemory::DEFAULT,
        unsampled: None,
        store_pages: 0,
        codecs: vec![Codec::H264],
        environment: Environment { zenith: [0.2; 3], horizon: [0.3; 3], nadir: [0.1; 3] },
        world_from_stage: Pose { position: Vec3::ZERO, orientation: Quat::IDENTITY },
        update_period_ns: TURN.as_nanos() as i64 * UPDATE_TURNS as i64,
        resume: ResumeSecret([0x5a; 16]),
    }
}

fn triangle() -> GeometryDelta {
    let corners = [[-1.0, 0.5, -2.0], [1.0, 0.5, -2.0], [0.0, 2.5, -2.0]];
    let slots = [0, 1, 2, 0, 0].map(VertexSlot);
    let block = BlockSize::new(6, 6).map(|size| Block { address: BlockAddress::default(), size });
    let vertex = |(slot, position)| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(0),
        number: slot,
        motion: Motion::Static { position: Vec3::from_array(position) },
    };
    GeometryDelta {
        new_vertices: (0..).zip(corners).map(vertex).collect(),
        new_patches: PatchKind::from_triangle_count(1)
            .map(|kind| NewPatch {
                slot: PatchSlot(0),
                instance: InstanceId(0),
                mesh: MeshId(0),
                number: 0,
                kind,
                vertices: slots,
                double_sided: true,
            })
            .into_iter()
            .collect(),
        placements: vec![(PatchSlot(0), block)],
        ..GeometryDelta::default()
    }
}

/// As many animated vertices as there may be, all in one place for as many grid steps as there may be: the samples have
/// no bits. The second delta says the same again.
fn hollow_deltas(slots: u32) -> [Vec<u8>; 2] {
    let mut coder = DeltaEncoder::new(slots, 1);
    let values: Vec<_> = (0..slots).map(|slot| (VertexSlot(slot), [0; 3])).collect();
    let samples: Vec<_> = (0..MAX_NEW_SAMPLE_GRIDS as i32)
        .map(|grid| SampleBatch { grid: GridIndex(grid), values: values.clone() })
        .collect();
    let vertex = |slot| NewVertex {
        slot: VertexSlot(slot),
        instance: InstanceId(0),
        number: slot,
        motion: Motion::Sampled,
    };
    let first = GeometryDelta {
        instances: vec![InstanceInfo { instance: InstanceId(0), step_m: 1e-3 }],
        new_vertices: (0..slots).map(vertex).collect(),
        ..GeometryDelta::default()
    };
    let first = Delta { geometry: first, is_update: true, samples: samples.clone() };
    let update = GeometryDelta { update: UpdateId(1), ..GeometryDelta::default() };
    let other = Delta { geometry: update, is_update: true, samples };
    [coder.encode(&first).bytes, coder.encode(&other).bytes]
}

fn picture(frame: u32, is_refresh: bool) -> Vec<u8> {
    let header = PictureHeader { update: UpdateId(frame), time: ServerTime(0), is_refresh };
    encode_picture(header, &[0, 0, 0, 1, 0x65, 0x88, 0x84])
}

/// Answers to pings that might have left a moment ago, by a clock that runs as it likes.
fn pongs(turn: u64) -> Vec<Vec<u8>> {
    let now_ns = monotonic_now_ns();
    let pong = |n: i64| {
        let server = ServerTime(now_ns / 2 + n * 7_919 + turn as i64 * 100_003);
        let client_send = ClientTime(now_ns - n * 50_000);
        ServerDatagram::ClockPong { client_send, server_receive: server, server_send: server }.encode()
    };
    (0..PONGS).map(pong).collect()
}

/// One of several streams that are none.
fn broken(turn: u64) -> Vec<u8> {
    let whole = picture(turn as u32, true);
    match turn % 6 {
        0 => whole[..whole.len() / 2].to_vec(),
        1 => vec![0xff; 100],
        2 => Vec::new(),
        // An access unit of start codes, as long as a slow decoder would like it least.
        3 => {
            let header =
                PictureHeader { update: UpdateId(turn as u32), time: ServerTime(0), is_refresh: true };
            encode_picture(header, &[0, 0, 1, 0x67].repeat(1 << 18))
        }
        4 => encode_geometry(&[b"SCG1", &[0xff; 60][..]].concat()),
        _ => encode_geometry(b"SCG1"),
    }
}

//! The client's session: whatever a server sends, and whenever.

use crate::script::{number, steps};
use shadecast_client::motion::Motion;
use shadecast_client::motion::arena::ArenaCopy;
use shadecast_client::motion::skinned::{PoseQuery, SkinCapacity, Skinned};
use shadecast_protocol::ids::{UpdateId, VertexSlot};
use shadecast_protocol::limits::MAX_INSTANCES;
use shadecast_protocol::message::{
    ClientDatagram, ClientHello, ClientMessage, Displayed, ServerDatagram, Welcome,
};
use shadecast_protocol::pairing::ClientPairing;
use shadecast_protocol::session::{ClientEvent, ClientSession, Out};
use shadecast_protocol::time::{ClientTime, Grid, ServerTime};
use shadecast_shaders::constants::POSE_READY;
use shadecast_shaders::generated::PlacedPoseGpu;
use shadecast_shaders::twin::pose::Arena;

/// The hello that this client said; only as the first step.
pub const HELLO: u8 = 0;
/// A control message of the server.
pub const CONTROL: u8 = 1;
/// A unidirectional stream of the server.
pub const STREAM: u8 = 2;
/// A datagram of the server.
pub const DATAGRAM: u8 = 3;
/// A datagram that this client sent: a head, or nothing of interest.
pub const OWN_DATAGRAM: u8 = 4;
/// A control message that this client said: a report, or a request.
pub const OWN_MESSAGE: u8 = 5;
/// The newest ping is answered, this many microseconds after it left: a recorded answer would belong to another clock.
pub const PONG: u8 = 6;
/// Time passes: microseconds, at most ten seconds.
pub const WAIT: u8 = 7;

/// From one operation to the next, nanoseconds.
const STEP_NS: i64 = 500_000;
/// Bytes of the arena, and records of vertices, that a display frame writes: few, so that what has not arrived is met.
const STAGING_BYTES: usize = 32 << 10;
const STAGING_RECORDS: usize = 1 << 14;
/// Where the client's clock begins; recorded pongs belong to it only by chance.
const START_NS: i64 = 1 << 40;

/// The number of deltas, pictures and news of motion that the session handed on.
pub fn check(script: &[u8]) -> usize {
    let mut steps = steps(script);
    let Some(hello) = steps.next().filter(|step| step.operation == HELLO) else { return 0 };
    let Ok(ClientMessage::Hello(hello)) = ClientMessage::decode(hello.bytes) else { return 0 };
    let mut run = Run::new(hello);
    for step in steps {
        run.step(step.operation, step.bytes);
        run.settle();
    }
    run.handed_on
}

/// What moves vertices, and the memory that a GPU would have of it.
struct Moved {
    motion: Motion,
    /// All vertices that the list uses.
    used: Vec<VertexSlot>,
    capacity: SkinCapacity,
    grid: Grid,
    arena: Vec<[u32; 4]>,
    poses: Vec<PlacedPoseGpu>,
    /// What the thread that draws knows of instances.
    tables: Skinned,
}

impl Moved {
    fn new(welcome: &Welcome) -> Self {
        let capacity = SkinCapacity::from(welcome.motion);
        Self {
            motion: Motion::new(welcome.vertex_slots, capacity),
            used: Vec::new(),
            capacity,
            grid: welcome.grid,
            arena: vec![[0; 4]; capacity.arena_words as usize],
            poses: vec![bytemuck::Zeroable::zeroed(); MAX_INSTANCES as usize],
            tables: Skinned::default(),
        }
    }

    /// A display frame: a part of what waits is written, and every instance is posed. What a GPU would do beyond its buffers
    /// panics.
    fn evaluate(&mut self, time: ServerTime) {
        let (mut staging, mut copies) = (vec![0; STAGING_BYTES], Vec::new());
        self.motion.arena().drain_into(&mut staging, |copy| copies.push(copy));
        let arena: &mut [u8] = bytemuck::cast_slice_mut(&mut self.arena);
        for ArenaCopy { staged, arena_byte } in copies {
            let bytes = &staging[staged.start as usize..staged.end as usize];
            arena[arena_byte as usize..][..bytes.len()].copy_from_slice(bytes);
        }
        let mut records = vec![bytemuck::Zeroable::zeroed(); STAGING_RECORDS];
        self.motion.writes().drain_into(&mut records, |_| {});
        let mut changes = Vec::new();
        self.motion.take_changes(&mut changes);
        changes.into_iter().for_each(|change| self.tables.apply(change));
        let time = self.motion.world_clock().world_time(time);
        let state = self.motion.state();
        let slots: Vec<_> = (0..state.vertex_count).map(VertexSlot).collect();
        let before = std::mem::replace(&mut self.used, slots);
        let mut users = self.motion.users();
        users.remove(&before);
        users.add(&self.used);
        users.end();
        self.motion.state().motionless(self.grid, time);
        let moment = PoseQuery { time, grid: self.grid, written: state.written };
        let counts = self.tables.poses(moment, self.motion.drawn(), &mut self.poses);
        for pose in &self.poses[..counts.instances as usize] {
            let posed = Arena(&self.arena).pose(pose);
            let palette_end =
                pose.pose.palette_base as usize + posed.palette.len().max(posed.morph_weights.len());
            assert!(palette_end <= self.capacity.palette_entries as usize, "a palette up to {palette_end}");
            if pose.flags & POSE_READY != 0 {
                let bone_end = pose.pose.global_base + Arena(&self.arena).bone_count(&pose.pose);
                assert!(bone_end <= self.capacity.bones, "bones up to {bone_end}");
            }
        }
    }
}

struct Run {
    session: ClientSession,
    now: ClientTime,
    newest_ping: Option<ClientTime>,
    next_delta: UpdateId,
    moved: Option<Moved>,
    welcomed: bool,
    ended: bool,
    handed_on: usize,
}

impl Run {
    fn new(hello: ClientHello) -> Self {
        // A peer may say less than it can hold; many slots would only make each run slow.
        let mut hello = hello;
        let capabilities = &mut hello.capabilities;
        capabilities.max_vertex_slots = capabilities.max_vertex_slots.min(crate::deltas::VERTEX_SLOTS);
        capabilities.max_patch_slots = capabilities.max_patch_slots.min(crate::deltas::PATCH_SLOTS);
        let now = ClientTime(START_NS);
        Self {
            session: ClientSession::start(hello, now),
            now,
            newest_ping: None,
            next_delta: UpdateId(0),
            moved: None,
            welcomed: false,
            ended: false,
            handed_on: 0,
        }
    }

    fn step(&mut self, operation: u8, bytes: &[u8]) {
        self.now = self.now.plus_ns(STEP_NS);
        let session = &mut self.session;
        match operation {
            CONTROL => session.on_control(bytes),
            STREAM => session.on_stream(bytes),
            DATAGRAM => session.on_datagram(bytes, self.now),
            OWN_DATAGRAM => {
                if let Ok(ClientDatagram::Pose(head)) = ClientDatagram::decode(bytes) {
                    session.send_pose(head);
                }
            }
            OWN_MESSAGE => match ClientMessage::decode(bytes) {
                Ok(ClientMessage::Displayed(displayed)) => session.send_displayed(displayed),
                Ok(ClientMessage::RefreshRequest { after }) => session.request_refresh(after),
                Ok(ClientMessage::Goodbye) => session.goodbye(),
                _ => session.send_displayed(Displayed::default()),
            },
            PONG => self.answer(number(bytes) % 100_000),
            _ => self.now = self.now.plus_ns((number(bytes) % 10_000_000) as i64 * 1000),
        }
        self.session.on_tick(self.now);
    }

    fn answer(&mut self, after_us: u64) {
        let Some(client_send) = self.newest_ping else { return };
        let server_receive = ServerTime(client_send.0 / 2 + after_us as i64 * 300);
        let server_send = ServerTime(server_receive.0 + 1000);
        let pong = ServerDatagram::ClockPong { client_send, server_receive, server_send };
        self.session.on_datagram(&pong.encode(), client_send.plus_ns(after_us as i64 * 1000));
    }

    /// Takes what came out, and holds it against what a client relies on.
    fn settle(&mut self) {
        while let Some(event) = self.session.poll_event() {
            assert!(!self.ended, "after the end: {event:?}");
            match event {
                ClientEvent::Welcome(welcome) => {
                    assert!(!std::mem::replace(&mut self.welcomed, true), "welcome twice");
                    welcome.check().expect("a welcome is checked");
                    self.moved = Some(Moved::new(&welcome));
                }
                ClientEvent::Delta(mut delta) => {
                    let update = delta.geometry.update;
                    assert!(self.welcomed && (!delta.is_update || update == self.next_delta), "{update:?}");
                    self.moved.iter_mut().for_each(|moved| moved.motion.take_delta(&mut delta));
                    if delta.is_update {
                        self.next_delta = self.next_delta.next();
                    }
                    self.handed_on += 1;
                }
                ClientEvent::Motion(message) => {
                    assert!(self.welcomed, "motion before the welcome");
                    self.moved.iter_mut().for_each(|moved| moved.motion.take_motion(message.clone()));
                    self.handed_on += 1;
                }
                ClientEvent::Picture { .. } => {
                    assert!(self.welcomed, "a picture before the welcome");
                    self.handed_on += 1;
                }
                ClientEvent::PairingNeeded { .. } => {
                    self.session.pair(ClientPairing::Offer { element: [0; 32] });
                }
                ClientEvent::PairingAnswer { proof, .. } => {
                    self.session.pair(ClientPairing::Proof { proof });
                }
                ClientEvent::Refused(_)
                | ClientEvent::Goodbye
                | ClientEvent::Silent
                | ClientEvent::Failed(_) => {
                    self.ended = true;
                    assert!(!self.session.is_alive());
                }
            }
        }
        while let Some(out) = self.session.poll_out() {
            match out {
                Out::Control(message) => drop(ClientMessage::decode(&message).expect("it is well-formed")),
                Out::Datagram(datagram) => {
                    let datagram = ClientDatagram::decode(&datagram).expect("it is well-formed");
                    if let ClientDatagram::ClockPing { client_send } = datagram {
                        self.newest_ping = Some(client_send);
                    }
                }
                Out::Stream { .. } => panic!("a client sends no streams"),
            }
        }
        if let Some(moved) = &mut self.moved {
            moved.evaluate(ServerTime(self.now.0 - START_NS));
        }
        if let Some(time) = self.session.clock().server_time(self.now) {
            let later = self.session.clock().server_time(self.now.plus_ns(1_000_000_000));
            assert!(later.is_some_and(|later| later.0 > time.0), "the server's clock runs backwards");
        }
    }
}

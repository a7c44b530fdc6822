//! The server's session: whatever a client sends, and whenever.

use crate::script::{number, steps};
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::delta::DeltaEncoder;
use shadecast_protocol::geometry::GeometryDelta;
use shadecast_protocol::message::{ServerDatagram, ServerMessage, ServerOffer, Welcome};
use shadecast_protocol::session::{DeltaSender, Out, ServerEvent, ServerSession, picture_stream};
use shadecast_protocol::time::{ServerTime, WorldTime};
use shadecast_protocol::wire::{PictureHeader, parse_stream};

/// The welcome that this server said, as the terms to offer; only as the first step.
pub const WELCOME: u8 = 0;
/// A control message of the client.
pub const CONTROL: u8 = 1;
/// A datagram of the client.
pub const DATAGRAM: u8 = 2;
/// The server sends an update: an empty delta, and these bytes as its picture.
pub const UPDATE: u8 = 3;
/// The server says goodbye.
pub const GOODBYE: u8 = 4;
/// Time passes: microseconds, at most ten seconds.
pub const WAIT: u8 = 5;

/// From one operation to the next, nanoseconds.
const STEP_NS: i64 = 500_000;
/// Events of one message or datagram: more would grow without bound.
const MAX_EVENTS: usize = 5;

/// The number of events of an accepted client.
pub fn check(script: &[u8]) -> usize {
    let mut steps = steps(script);
    let Some(welcome) = steps.next().filter(|step| step.operation == WELCOME) else { return 0 };
    let Ok(ServerMessage::Welcome(welcome)) = ServerMessage::decode(welcome.bytes) else { return 0 };
    let mut run = Run::new(welcome);
    for step in steps {
        run.step(step.operation, step.bytes);
        run.settle();
    }
    run.events
}

struct Run {
    session: ServerSession,
    /// Once a client was accepted.
    sender: Option<DeltaSender>,
    now: ServerTime,
    newest_pose: Option<u32>,
    ended: bool,
    events: usize,
}

fn offer(welcome: Welcome) -> ServerOffer {
    ServerOffer {
        protocol_version: PROTOCOL_VERSION,
        min_protocol_version: PROTOCOL_VERSION,
        app_version: "fuzzed".to_owned(),
        session: welcome.session,
        resume: welcome.resume,
        grid: welcome.grid,
        atlas_extent_texels: welcome.atlas_extent_texels,
        // Many slots would only make each run slow.
        vertex_slots: welcome.vertex_slots.min(crate::deltas::VERTEX_SLOTS),
        patch_slots: welcome.patch_slots.min(crate::deltas::PATCH_SLOTS),
        motion: welcome.motion,
        unsampled: None,
        store_pages: welcome.store_pages,
        codecs: vec![welcome.codec],
        environment: welcome.environment,
        world_from_stage: welcome.world_from_stage,
        update_period_ns: welcome.update_period_ns,
    }
}

impl Run {
    fn new(welcome: Welcome) -> Self {
        Self {
            session: ServerSession::new(offer(welcome)),
            sender: None,
            now: ServerTime(0),
            newest_pose: None,
            ended: false,
            events: 0,
        }
    }

    fn step(&mut self, operation: u8, bytes: &[u8]) {
        self.now = ServerTime(self.now.0 + STEP_NS);
        match operation {
            CONTROL => self.session.on_control(bytes),
            DATAGRAM => self.session.on_datagram(bytes, self.now),
            UPDATE => self.update(bytes),
            GOODBYE => self.session.goodbye(),
            _ => self.now = ServerTime(self.now.0 + (number(bytes) % 10_000_000) as i64 * 1000),
        }
    }

    fn update(&mut self, access_unit: &[u8]) {
        let Some(sender) = &mut self.sender else { return };
        let frame = sender.next_update();
        let delta = GeometryDelta { update: frame, time: WorldTime(self.now.0), ..GeometryDelta::default() };
        let header = PictureHeader { update: frame, time: self.now, is_refresh: frame.0 == 0 };
        let geometry = sender.stream(&DeltaEncoder::new(1, 1).from_delta(frame.0).encode(&delta.into()));
        let picture = picture_stream(header, access_unit).expect("scripts are shorter than a picture may be");
        for out in [geometry, picture] {
            let Out::Stream { bytes, .. } = out else { panic!("{out:?} is no stream") };
            parse_stream(&bytes).expect("it is well-formed");
        }
    }

    /// Takes what came out, and holds it against what a server relies on.
    fn settle(&mut self) {
        let mut events = 0;
        while let Some(event) = self.session.poll_event() {
            assert!(!self.ended, "after the end: {event:?}");
            events += 1;
            self.events += usize::from(self.sender.is_some());
            self.take(event);
        }
        assert!(events <= MAX_EVENTS, "{events} events of one operation");
        while let Some(out) = self.session.poll_out(self.now) {
            match out {
                Out::Control(message) => drop(ServerMessage::decode(&message).expect("it is well-formed")),
                Out::Datagram(datagram) => {
                    let datagram = ServerDatagram::decode(&datagram).expect("it is well-formed");
                    let ServerDatagram::ClockPong { server_receive, server_send, .. } = datagram else {
                        panic!("a session stamps nothing: {datagram:?}");
                    };
                    assert!(server_receive <= server_send);
                }
                Out::Stream { .. } => panic!("a session has no streams of its own"),
            }
        }
    }

    fn take(&mut self, event: ServerEvent) {
        match event {
            ServerEvent::Asked { hello, welcome } => {
                hello.check().expect("a hello is checked");
                welcome.check().expect("a welcome is sound");
                assert!(self.sender.is_none(), "asked twice");
                self.sender = self.session.accept();
                assert!(self.sender.is_some(), "who asks can be accepted");
            }
            ServerEvent::Head(head) => {
                head.check().expect("a head is checked");
                let is_newer =
                    self.newest_pose.is_none_or(|newest| head.sequence.wrapping_sub(newest) as i32 > 0);
                assert!(self.sender.is_some() && is_newer, "{} after {:?}", head.sequence, self.newest_pose);
                self.newest_pose = Some(head.sequence);
            }
            ServerEvent::Displayed(displayed) => {
                let sent = self.sender.as_ref().map(DeltaSender::next_update);
                assert!(sent > Some(displayed.update), "{displayed:?} of {sent:?}");
            }
            ServerEvent::Pairing(_) => panic!("a step of pairing that nobody has asked for"),
            ServerEvent::RefreshRequest { .. } | ServerEvent::Watching(_) | ServerEvent::Steer(_) => {
                assert!(self.sender.is_some())
            }
            ServerEvent::Refused(_) | ServerEvent::Goodbye | ServerEvent::Failed(_) => {
                self.ended = true;
                assert!(!self.session.is_alive());
            }
        }
    }
}

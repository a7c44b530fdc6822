//! A client and a server's terms for this module's tests.

use super::mailbox::Accepted;
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::message::{
    Capabilities, ClientHello, ClientMessage, Codec, Environment, HeadState, ResumeSecret, ServerOffer,
};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::session::{ServerEvent, ServerSession};
use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};

fn eyes() -> [Eye; 2] {
    [Eye { head_from_eye: Pose::IDENTITY, fov: Fov::symmetric_degrees(90.0) }; 2]
}

pub(super) fn hello() -> ClientHello {
    ClientHello {
        protocol_version: PROTOCOL_VERSION,
        min_protocol_version: PROTOCOL_VERSION,
        app_version: "test".into(),
        capabilities: Capabilities {
            max_atlas_extent: [512, 512],
            max_vertex_slots: 100,
            max_patch_slots: 100,
            codecs: vec![Codec::H264],
            eyes: eyes(),
            eye_extent_pixels: [64, 64],
            display_period_ns: 13_888_888,
        },
        resume: None,
    }
}

pub(super) fn offer() -> ServerOffer {
    ServerOffer {
        protocol_version: PROTOCOL_VERSION,
        min_protocol_version: PROTOCOL_VERSION,
        app_version: "test".into(),
        session: 1,
        grid: DEFAULT_GRID,
        atlas_extent_texels: AtlasExtent::MIN,
        vertex_slots: 100,
        patch_slots: 100,
        codecs: vec![Codec::H264],
        environment: Environment { zenith: [0.0; 3], horizon: [0.0; 3], nadir: [0.0; 3] },
        world_from_stage: Pose::IDENTITY,
        update_period_ns: 33_333_333,
        resume: ResumeSecret([0; 16]),
    }
}

pub(super) fn head(sequence: u32) -> HeadState {
    HeadState {
        sequence,
        time: ServerTime(0),
        world_from_head: Pose::IDENTITY,
        linear_velocity: glam::Vec3::ZERO,
        angular_velocity: glam::Vec3::ZERO,
        eyes: eyes(),
        discontinuity: DiscontinuityId(0),
    }
}

/// A client whose session has just been accepted.
pub(super) fn accepted() -> Accepted {
    let mut session = ServerSession::new(offer());
    session.on_control(&ClientMessage::Hello(hello()).encode());
    let Some(ServerEvent::Asked { hello, welcome }) = session.poll_event() else { panic!("not asked") };
    let sender = session.accept().expect("it asks");
    Accepted { welcome, capabilities: hello.capabilities, sender }
}

//! What a client and a server say of themselves first; tests change what matters to them.

use glam::Vec3;
use shadecast_protocol::PROTOCOL_VERSION;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::message::{
    Capabilities, ClientHello, Codec, Environment, HeadState, MotionMemory, ResumeSecret, ServerOffer,
};
use shadecast_protocol::pose::{Eye, Fov, Pose};
use shadecast_protocol::time::{DEFAULT_GRID, ServerTime};

/// The eyes of a headset of 64 mm between the pupils.
pub fn eyes() -> [Eye; 2] {
    [-0.032, 0.032].map(|x| Eye {
        head_from_eye: Pose { position: Vec3::new(x, 0.0, 0.0), ..Pose::IDENTITY },
        fov: Fov::symmetric_degrees(90.0),
    })
}

/// Of a client with a small display that takes the largest atlas.
pub fn hello() -> ClientHello {
    let capabilities = Capabilities {
        max_vertex_slots: 1000,
        max_patch_slots: 1000,
        max_triangles: 6000,
        ..Capabilities::most(eyes(), [64, 64], 13_888_888)
    };
    ClientHello::new("test", capabilities)
}

/// Of a server with the smallest atlas, at 30 updates a second.
pub fn offer() -> ServerOffer {
    ServerOffer {
        protocol_version: PROTOCOL_VERSION,
        min_protocol_version: PROTOCOL_VERSION,
        app_version: "test".into(),
        session: 1,
        grid: DEFAULT_GRID,
        atlas_extent_texels: AtlasExtent::MIN,
        vertex_slots: 1000,
        patch_slots: 1000,
        motion: MotionMemory::DEFAULT,
        unsampled: None,
        store_pages: 0,
        codecs: vec![Codec::H264],
        environment: Environment { zenith: [0.5; 3], horizon: [0.5; 3], nadir: [0.5; 3] },
        world_from_stage: Pose::IDENTITY,
        update_period_ns: 33_333_333,
        resume: ResumeSecret([0; 16]),
    }
}

/// A head that stands still.
pub fn head(sequence: u32, time: ServerTime) -> HeadState {
    HeadState {
        sequence,
        time,
        world_from_head: Pose::IDENTITY,
        linear_velocity: Vec3::ZERO,
        angular_velocity: Vec3::ZERO,
        eyes: eyes(),
        discontinuity: DiscontinuityId(0),
    }
}

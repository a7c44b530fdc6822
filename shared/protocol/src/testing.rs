//! Seeded randomness, mutation of bytes and fixed messages, for this crate's tests.

use crate::atlas::AtlasExtent;
use crate::ids::{DiscontinuityId, UpdateId};
use crate::message::{
    Capabilities, ClientHello, Codec, Displayed, Environment, HeadState, MotionMemory, ResumeSecret,
    ServerOffer, Welcome, negotiate,
};
use crate::pose::{Eye, Fov, Pose};
use crate::time::{DEFAULT_GRID, ServerTime};
use glam::{Quat, Vec3};

/// The eyes of a headset of 64 mm between the pupils.
pub(crate) fn eyes() -> [Eye; 2] {
    [-0.032, 0.032].map(|x| Eye {
        head_from_eye: Pose { position: Vec3::new(x, 0.0, 0.0), orientation: Quat::IDENTITY },
        fov: Fov { left: -0.75, right: 0.75, up: 0.5, down: -0.875 },
    })
}

pub(crate) fn hello() -> ClientHello {
    ClientHello {
        protocol_version: 1,
        min_protocol_version: 1,
        app_version: "0.1.0".to_owned(),
        capabilities: Capabilities {
            max_atlas_extent: [4096, 4096],
            max_vertex_slots: 600,
            max_patch_slots: 300,
            max_triangles: 900,
            motion: MotionMemory::DEFAULT,
            store_pages: 6,
            blends: true,
            codecs: vec![Codec::H264],
            eyes: eyes(),
            eye_extent_pixels: [1832, 1920],
            display_period_ns: 13_888_888,
        },
        resume: Some(ResumeSecret([9; 16])),
    }
}

pub(crate) fn offer() -> ServerOffer {
    ServerOffer {
        protocol_version: 1,
        min_protocol_version: 1,
        app_version: "0.1.0".to_owned(),
        session: 0x0123_4567_89ab_cdef,
        grid: DEFAULT_GRID,
        atlas_extent_texels: AtlasExtent::DEFAULT,
        vertex_slots: 131_072,
        patch_slots: 131_072,
        motion: MotionMemory { arena_words: 5000, rest_vertices: 900, pose_places: 200, sample_ring: 32 },
        unsampled: Some(MotionMemory { arena_words: 3000, ..MotionMemory::LEAST }),
        store_pages: 4,
        codecs: vec![Codec::H264],
        environment: Environment { zenith: [0.25, 0.5, 1.0], horizon: [0.5, 0.75, 1.0], nadir: [0.125; 3] },
        world_from_stage: Pose { position: Vec3::new(0.0, 0.0, 3.5), orientation: Quat::IDENTITY },
        update_period_ns: 33_333_333,
        resume: ResumeSecret(std::array::from_fn(|i| i as u8)),
    }
}

pub(crate) fn welcome() -> Welcome {
    negotiate(&hello(), &offer()).unwrap()
}

pub(crate) fn head(sequence: u32) -> HeadState {
    HeadState {
        sequence,
        time: ServerTime(1_000_000_007),
        world_from_head: Pose {
            position: Vec3::new(0.5, 1.625, -2.0),
            orientation: Quat::from_xyzw(0.6, 0.0, 0.0, 0.8),
        },
        linear_velocity: Vec3::new(0.25, 0.0, -1.5),
        angular_velocity: Vec3::new(0.0, 2.5, 0.0),
        eyes: eyes(),
        discontinuity: DiscontinuityId(3),
    }
}

pub(crate) fn displayed(frame: u32) -> Displayed {
    Displayed {
        update: UpdateId(frame),
        display_time: ServerTime(-5),
        display_frames: 72,
        frames_without_bundle: 1,
        frozen_vertices: 200,
        withheld_patches: 3,
        lost_pictures: 0,
        decode_to_display_ns: 9_000_000,
    }
}

/// SplitMix64: small, seeded, and the same everywhere. Source: Steele, Lea and Flood 2014.
pub(crate) struct Dice(u64);

impl Dice {
    pub(crate) fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    /// 0..limit; the limit must not be 0.
    pub(crate) fn below(&mut self, limit: u64) -> u64 {
        self.next() % limit
    }

    /// True once in `times`.
    pub(crate) fn once_in(&mut self, times: u64) -> bool {
        self.below(times) == 0
    }

    /// -1 to 1.
    pub(crate) fn signed_unit(&mut self) -> f64 {
        self.next() as f64 / u64::MAX as f64 * 2.0 - 1.0
    }
}

/// Calls `check` with every prefix of `valid` (long ones at some thousand places), with bytes appended, and with
/// `mutations` seeded damages of one to four kinds.
pub(crate) fn damaged(valid: &[u8], seed: u64, mutations: usize, mut check: impl FnMut(&[u8])) {
    let step = valid.len() / 4000 + 1;
    (0..valid.len()).step_by(step).for_each(|length| check(&valid[..length]));
    let mut dice = Dice::new(seed);
    for _ in 0..mutations {
        let mut bytes = valid.to_vec();
        for _ in 0..=dice.below(4) {
            damage(&mut bytes, &mut dice);
        }
        check(&bytes);
    }
}

fn damage(bytes: &mut Vec<u8>, dice: &mut Dice) {
    if bytes.is_empty() {
        return bytes.push(dice.next() as u8);
    }
    let at = dice.below(bytes.len() as u64) as usize;
    match dice.below(6) {
        0 => bytes[at] ^= 1 << dice.below(8),
        1 => bytes[at] = dice.next() as u8,
        2 => bytes[at] = [0, 1, 0x7f, 0x80, 0xff][dice.below(5) as usize],
        3 => bytes.insert(at, dice.next() as u8),
        4 => drop(bytes.remove(at)),
        _ => {
            let end = (at + 4).min(bytes.len());
            bytes[at..end].fill(0xff);
        }
    }
}

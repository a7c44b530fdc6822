//! Hellos, and heads after a valid hello, with finite and well-framed numbers that cannot be served: too large, negative, or
//! nowhere.

use super::{Effort, Target, Then, hello_bytes, one_after_the_other};
use crate::hostile::lawful;
use glam::{Quat, Vec3};
use shadecast_protocol::limits::{MAX_COORDINATE_M, MAX_SPEED, MAX_TEXT_BYTES};
use shadecast_protocol::message::{ClientDatagram, ClientHello, HeadState};
use shadecast_protocol::pose::Fov;
use shadecast_protocol::time::ServerTime;
use std::time::{Duration, Instant};

/// How long each is left to work.
const LIFE: Duration = Duration::from_millis(150);
/// Heads that follow a hello.
const HEADS: u32 = 20;

/// Fields of view that no display has.
const VIEWS: &[Fov] = &[
    Fov { left: -0.0005, right: 0.0005, up: 0.0005, down: -0.0005 },
    Fov { left: -1e-40, right: 1e-40, up: 1e-40, down: -1e-40 },
    Fov { left: 1.1, right: 1.3, up: 0.5, down: -0.5 },
    Fov { left: -0.5, right: 0.5, up: -1.1, down: -1.3 },
    Fov { left: 0.5, right: -0.5, up: -0.5, down: 0.5 },
    Fov { left: 0.0, right: 0.0, up: 0.0, down: 0.0 },
    Fov { left: -1.55, right: 1.55, up: 1.55, down: -1.55 },
    Fov { left: 1.553, right: 1.5533, up: 1.553, down: 1.5529 },
    Fov { left: f32::NAN, right: 0.5, up: 0.5, down: -0.5 },
    Fov { left: -0.5, right: f32::INFINITY, up: 0.5, down: -0.5 },
    Fov { left: -1e30, right: 1e30, up: 1e30, down: -1e30 },
];

type Change = fn(&mut ClientHello);

/// Other numbers of a hello.
const CHANGES: &[Change] = &[
    |hello| hello.capabilities.eye_extent_pixels = [8192, 8192],
    |hello| hello.capabilities.eye_extent_pixels = [8192, 1],
    |hello| hello.capabilities.eye_extent_pixels = [u32::MAX, u32::MAX],
    |hello| hello.capabilities.eye_extent_pixels = [0, 128],
    |hello| hello.capabilities.max_vertex_slots = 1,
    |hello| hello.capabilities.max_patch_slots = 1,
    |hello| hello.capabilities.max_triangles = 1,
    |hello| hello.capabilities.max_vertex_slots = u32::MAX,
    |hello| hello.capabilities.max_atlas_extent = [0, u32::MAX],
    |hello| hello.capabilities.max_atlas_extent = [512, 1 << 31],
    |hello| hello.capabilities.codecs.clear(),
    |hello| hello.capabilities.display_period_ns = i64::MIN,
    |hello| hello.capabilities.display_period_ns = 1_000_000,
    |hello| hello.capabilities.eyes[1].head_from_eye.position = Vec3::splat(MAX_COORDINATE_M),
    |hello| hello.capabilities.eyes[0].head_from_eye.position.x = f32::NAN,
    |hello| hello.capabilities.eyes[0].head_from_eye.orientation = Quat::from_xyzw(0.0, 0.0, 0.0, 0.0),
    |hello| hello.protocol_version = u32::MAX,
    |hello| hello.min_protocol_version = u32::MAX,
    |hello| hello.app_version = "\u{1b}[2J\u{7}\r\n\u{202e}".repeat(50),
    |hello| hello.app_version = "x".repeat(MAX_TEXT_BYTES + 1),
];

/// What is sent on one connection: a hello, and the heads after it.
struct Attempt {
    hello: Vec<u8>,
    heads: Vec<HeadState>,
}

pub(super) fn attack(target: &Target) -> anyhow::Result<Effort> {
    let attempts = attempts();
    let mut number = 0;
    one_after_the_other(target, || {
        let attempt = &attempts[number % attempts.len()];
        number += 1;
        let (begun, mut sent, mut said_hello) = (Instant::now(), 0, false);
        move |stranger| {
            let mut bytes = 0;
            if !std::mem::replace(&mut said_hello, true) {
                bytes += stranger.write_control(&attempt.hello) as u64;
            }
            if !stranger.heard().is_empty() && sent < HEADS {
                let head = HeadState { sequence: sent, ..attempt.heads[sent as usize % attempt.heads.len()] };
                let datagram = ClientDatagram::Pose(head).encode();
                bytes += datagram.len() as u64 * u64::from(stranger.send_datagram(&datagram));
                sent += 1;
            }
            (if begun.elapsed() < LIFE { Then::GoOn } else { Then::Leave }, bytes)
        }
    })
}

fn attempts() -> Vec<Attempt> {
    let lawful = || vec![lawful::head(0, 0.0)];
    let mut attempts = Vec::new();
    for &view in VIEWS {
        for extent_pixels in [[8192, 8192], [128, 128]] {
            let hello = hello_bytes(|hello| {
                hello.capabilities.eye_extent_pixels = extent_pixels;
                hello.capabilities.eyes.iter_mut().for_each(|eye| eye.fov = view);
            });
            attempts.push(Attempt { hello, heads: lawful() });
        }
        let head = with_view(view);
        attempts.push(Attempt { hello: hello_bytes(|_| {}), heads: vec![head] });
    }
    attempts.extend(CHANGES.iter().map(|change| Attempt { hello: hello_bytes(change), heads: lawful() }));
    attempts.push(Attempt { hello: hello_bytes(|_| {}), heads: heads() });
    attempts
}

fn with_view(view: Fov) -> HeadState {
    let mut head = lawful::head(0, 0.0);
    head.eyes.iter_mut().for_each(|eye| eye.fov = view);
    head
}

/// Heads that are nowhere, faster than anything, or at no time.
fn heads() -> Vec<HeadState> {
    let lawful = lawful::head(0, 0.0);
    let mut far = lawful;
    far.world_from_head.position = Vec3::splat(MAX_COORDINATE_M);
    let mut nan = lawful;
    nan.world_from_head.position = Vec3::NAN;
    vec![
        far,
        nan,
        HeadState { linear_velocity: Vec3::splat(MAX_SPEED * 0.5), ..lawful },
        HeadState { angular_velocity: Vec3::splat(MAX_SPEED * 0.5), ..lawful },
        HeadState { time: ServerTime(i64::MAX), ..lawful },
        HeadState { time: ServerTime(i64::MIN), ..lawful },
    ]
}

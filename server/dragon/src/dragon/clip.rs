//! The clip: hovering flight that repeats after four seconds.
//!
//! Every motion is a sine whose frequency divides into the loop and stays at or below the 1 Hz of the wings.

use super::rig::{Leg, Rig, Wing};
use glam::{Quat, Vec3};
use std::f32::consts::TAU;

/// Length of the loop, seconds.
pub(super) const DURATION_S: f32 = 4.0;
/// Key spacing: 60 Hz.
pub(super) const KEYS_PER_S: usize = 60;
/// Keys of every curve, the last one equal to the first.
pub(super) const KEYS: usize = DURATION_S as usize * KEYS_PER_S + 1;

/// Swing of the wings' roots to either side, degrees.
const FLAP_DEG: f32 = 40.0;
/// Height of the hover above the standing pose, and how far it goes up and down, metres.
const HOVER_M: f32 = 0.155;
const BOB_M: f32 = 0.040;

/// What moves a joint away from the pose in which the skin was made; in the model's axes, about the joint.
#[derive(Clone, Copy, Debug)]
pub(super) struct Motion {
    pub turn: Quat,
    pub shift_m: Vec3,
    /// Along the joint's own axes.
    pub scale: Vec3,
}

impl Motion {
    pub const NONE: Self = Self { turn: Quat::IDENTITY, shift_m: Vec3::ZERO, scale: Vec3::ONE };
}

/// Motions of all joints at a key. The last key is the first.
pub(super) fn pose(rig: &Rig, key: usize) -> Vec<Motion> {
    let clock = Clock { t_s: (key % (KEYS - 1)) as f32 / KEYS_PER_S as f32 };
    let mut motions = vec![Motion::NONE; rig.joints.len()];
    trunk(rig, clock, &mut motions);
    head(rig, clock, &mut motions);
    tail(rig, clock, &mut motions);
    for (i, leg) in rig.legs.iter().enumerate() {
        limb(leg, i, clock, &mut motions);
    }
    wing(&rig.wings[0], 1.0, clock, &mut motions);
    wing(&rig.wings[1], -1.0, clock, &mut motions);
    motions
}

#[derive(Clone, Copy)]
struct Clock {
    t_s: f32,
}

impl Clock {
    /// Sine of a frequency (Hz), late by `lag` of its period.
    fn wave(self, hz: f32, lag: f32) -> f32 {
        (TAU * (hz * self.t_s - lag)).sin()
    }
}

/// Rotations about the model's axes, degrees. Pitch raises what is in front, yaw turns to the left.
fn turn(pitch: f32, yaw: f32, roll: f32) -> Quat {
    let [pitch, yaw, roll] = [pitch, yaw, roll].map(f32::to_radians);
    Quat::from_rotation_y(yaw) * Quat::from_rotation_x(-pitch) * Quat::from_rotation_z(roll)
}

fn trunk(rig: &Rig, clock: Clock, motions: &mut [Motion]) {
    // The down stroke (fastest half a beat after the up stroke) pushes the body up: lowest there.
    let bob = HOVER_M + BOB_M * clock.wave(1.0, -0.25);
    let drift = 0.02 * clock.wave(0.25, 0.1);
    motions[rig.root].shift_m = Vec3::new(drift, bob, 0.012 * clock.wave(0.5, 0.2));
    motions[rig.root].turn =
        turn(2.0 * clock.wave(1.0, -0.2), 1.5 * clock.wave(0.25, 0.0), 2.0 * clock.wave(0.25, 0.15));
    motions[rig.pelvis].turn = turn(1.2 * clock.wave(1.0, 0.1), 1.5 * clock.wave(0.5, 0.0), 0.0);
    for (i, &joint) in rig.spine.iter().enumerate() {
        let lag = 0.06 * i as f32;
        motions[joint].turn = turn(1.0 * clock.wave(1.0, lag), -0.9 * clock.wave(0.5, lag), 0.0);
    }
    motions[rig.chest].turn = turn(1.5 * clock.wave(1.0, 0.1), 0.0, 1.0 * clock.wave(0.5, 0.3));
    let breath = clock.wave(0.5, 0.0);
    motions[rig.ribs].scale = Vec3::new(1.0 + 0.045 * breath, 1.0 + 0.012 * breath, 1.0 + 0.040 * breath);
}

fn head(rig: &Rig, clock: Clock, motions: &mut [Motion]) {
    for (i, &joint) in rig.neck.iter().enumerate() {
        let lag = 0.045 * i as f32;
        let pitch = 1.7 * clock.wave(0.5, lag) - 0.5 * clock.wave(1.0, lag);
        motions[joint].turn = turn(pitch, 2.2 * clock.wave(0.25, lag), 0.0);
    }
    // The head keeps looking about where it looks.
    let pitch = -9.0 * clock.wave(0.5, 0.25) + 2.0 * clock.wave(1.0, 0.3);
    motions[rig.head].turn = turn(pitch, -12.0 * clock.wave(0.25, 0.22), 3.0 * clock.wave(0.25, 0.4));
    motions[rig.jaw[0]].turn = turn(2.5 - 4.5 * clock.wave(0.5, 0.3), 0.0, 0.0);
    motions[rig.jaw[1]].turn = turn(-0.8 * clock.wave(0.5, 0.35), 0.0, 0.0);
    motions[rig.tongue[0]].turn = turn(3.0 * clock.wave(1.0, 0.0), 3.0 * clock.wave(0.5, 0.0), 0.0);
    motions[rig.tongue[0]].shift_m = Vec3::Z * (0.008 + 0.008 * clock.wave(0.5, 0.3));
    motions[rig.tongue[1]].turn = turn(7.0 * clock.wave(1.0, 0.15), 5.0 * clock.wave(0.5, 0.1), 0.0);
    for (side, sign) in [(0, 1.0), (1, -1.0)] {
        motions[rig.eyes[side]].turn = turn(2.0 * clock.wave(0.5, 0.5), 7.0 * clock.wave(0.25, 0.4), 0.0);
        let flutter = sign * (6.0 + 8.0 * clock.wave(1.0, 0.2));
        motions[rig.ears[side]].turn = turn(3.0 * clock.wave(0.5, 0.1), flutter, 0.0);
    }
}

/// A wave that runs from the hips to the spade.
fn tail(rig: &Rig, clock: Clock, motions: &mut [Motion]) {
    for (i, &joint) in rig.tail.iter().enumerate() {
        let share = i as f32 / rig.tail.len() as f32;
        let yaw = (1.6 + 2.6 * share) * clock.wave(0.5, 0.85 * share);
        let pitch = 1.1 * clock.wave(1.0, 0.1 + 0.7 * share) + 0.8 * clock.wave(0.25, 0.6 * share) - 0.6;
        motions[joint].turn = turn(pitch, yaw, 1.0 * clock.wave(0.5, 0.2 + share));
    }
}

/// Legs paddle; diagonal ones go together.
fn limb(leg: &Leg, index: usize, clock: Clock, motions: &mut [Motion]) {
    let hind = index >= 2;
    let right = index % 2 == 1;
    let lag = if hind == right { 0.0 } else { 0.5 };
    let outwards = if right { -1.0 } else { 1.0 };
    let bend = if hind { 1.0 } else { -1.0 };
    let [upper, lower, ankle, foot] = leg.bones;
    // A leg hangs down: raising what is in front of the joint swings the foot backwards.
    motions[upper].turn =
        turn(7.0 * clock.wave(0.5, lag), 0.0, outwards * (2.0 + 1.5 * clock.wave(1.0, lag)));
    motions[lower].turn = turn(bend * (4.0 + 6.0 * clock.wave(0.5, lag + 0.15)), 0.0, 0.0);
    motions[ankle].turn = turn(-bend * (5.0 + 6.0 * clock.wave(0.5, lag + 0.2)), 0.0, 0.0);
    motions[foot].turn = turn(-6.0 + 5.0 * clock.wave(0.5, lag + 0.25), 0.0, 0.0);
    for (i, [first, second]) in leg.toes.iter().enumerate() {
        let curl = -5.0 + 5.0 * clock.wave(0.5, lag + 0.3 + 0.04 * i as f32);
        let curl = if i == 3 { -curl } else { curl };
        motions[*first].turn = turn(curl, 0.0, 0.0);
        motions[*second].turn = turn(1.4 * curl, 0.0, 0.0);
    }
}

/// The root beats; everything farther out follows late. `side` is 1 on the left, -1 on the right.
fn wing(wing: &Wing, side: f32, clock: Clock, motions: &mut [Motion]) {
    let raise = |degrees: f32| turn(0.0, 0.0, side * degrees);
    let sweep = |degrees: f32| turn(0.0, side * degrees, 0.0);
    motions[wing.root].turn = raise(FLAP_DEG * clock.wave(1.0, 0.0));
    let twist = turn(4.0 * clock.wave(1.0, 0.25), 0.0, 0.0);
    motions[wing.upper].turn = sweep(5.0 * clock.wave(1.0, 0.2)) * twist;
    motions[wing.fore].turn = sweep(-6.0 * clock.wave(1.0, 0.25)) * raise(3.0 * clock.wave(1.0, 0.12));
    motions[wing.hand].turn = sweep(4.0 * clock.wave(1.0, 0.3)) * raise(3.5 * clock.wave(1.0, 0.2));
    for (i, finger) in wing.fingers.iter().enumerate() {
        let spread = (i as f32 - 1.5) * 1.6 * clock.wave(1.0, 0.25);
        for (bone, &joint) in finger.iter().enumerate() {
            let curl = 2.4 * clock.wave(1.0, 0.22 + 0.05 * bone as f32);
            let spread = if bone == 0 { spread } else { 0.0 };
            motions[joint].turn = sweep(spread) * raise(curl);
        }
    }
}

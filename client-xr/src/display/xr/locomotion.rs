//! The place of the user's room in the world. Thumb sticks move and turn it. Pure; times are arguments.
//!
//! The runtime locates head and eyes in its own stage, the room. The client reports and draws them in the server's stage,
//! through which the room moves. A turn is a jump: poses before and after it belong to no common motion.

use crate::display::Views;
use glam::{Quat, Vec2, Vec3};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ClientTime;

/// How fast a stick that is pushed all the way walks, metres a second: a brisk pace.
pub const WALK_M_S: f32 = 1.6;
/// How far one flick of the stick turns, radians.
pub const TURN_RAD: f32 = std::f32::consts::PI / 6.0;
/// A stick that is pushed less than this rests: no two come to rest at the same place.
const REST: f32 = 0.15;
/// From where on a flick counts, and where the stick has to have been since the last.
const FLICK: [f32; 2] = [0.7, 0.3];
/// After a longer gap between two frames nobody walks meanwhile, seconds: the program was held up, or nobody looked.
const MAX_STEP_S: f32 = 0.1;

/// What a person wants, by the controllers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Wish {
    /// To the right and ahead of where the head looks, each -1 to 1.
    pub walk: Vec2,
    /// To the right, -1 to 1.
    pub turn: f32,
}

/// See the module.
#[derive(Clone, Copy, Debug)]
pub struct Locomotion {
    stage_from_room: Pose,
    /// Metres a second through the stage.
    velocity: Vec3,
    last: Option<ClientTime>,
    /// The stick has not been let go since it turned.
    is_flicked: bool,
    turns: u32,
}

impl Default for Locomotion {
    fn default() -> Self {
        Self {
            stage_from_room: Pose::IDENTITY,
            velocity: Vec3::ZERO,
            last: None,
            is_flicked: false,
            turns: 0,
        }
    }
}

impl Locomotion {
    /// Moves until a frame's display time, which never goes back, by what is wanted since the frame before; the head was at
    /// `room_from_head` then.
    pub fn step(&mut self, wish: Wish, room_from_head: Pose, time: ClientTime) {
        let passed_s = self.last.map_or(0.0, |last| time.since(last) as f32 * 1e-9);
        self.last = Some(time);
        self.turn(wish.turn, room_from_head);
        let stage_from_head = self.stage_from_room.then(room_from_head);
        self.velocity = heading(stage_from_head.orientation) * ground(wish.walk) * WALK_M_S;
        if (0.0..=MAX_STEP_S).contains(&passed_s) {
            self.stage_from_room.position += self.velocity * passed_s;
        }
    }

    /// Turns the room about the head, where the stick was flicked.
    fn turn(&mut self, turn: f32, room_from_head: Pose) {
        let [begins, ends] = FLICK;
        if turn.abs() < ends {
            self.is_flicked = false;
        } else if turn.abs() > begins && !self.is_flicked {
            self.is_flicked = true;
            self.turns = self.turns.wrapping_add(1);
            let Pose { position, orientation } = self.stage_from_room;
            let head = position + orientation * room_from_head.position;
            let turned = Quat::from_rotation_y(-TURN_RAD * turn.signum());
            self.stage_from_room = Pose {
                position: head + turned * (position - head),
                orientation: (turned * orientation).normalize(),
            };
        }
    }

    /// What is seen in the room, as it is in the stage.
    pub fn apply(&self, in_room: &Views) -> Views {
        let Pose { orientation, .. } = self.stage_from_room;
        Views {
            stage_from_head: self.stage_from_room.then(in_room.stage_from_head),
            linear_velocity: orientation * in_room.linear_velocity + self.velocity,
            angular_velocity: orientation * in_room.angular_velocity,
            stage_from_eye: in_room
                .stage_from_eye
                .map(|room_from_eye| self.stage_from_room.then(room_from_eye)),
            fov: in_room.fov,
            stage_from_hand: in_room
                .stage_from_hand
                .map(|hand| hand.map(|hand| self.stage_from_room.then(hand))),
            jumps: in_room.jumps.wrapping_add(self.turns),
        }
    }
}

/// A stick's push as a direction on the ground, whose length is how far it is pushed beyond rest, 0 to 1.
fn ground(stick: Vec2) -> Vec3 {
    let pushed = ((stick.length() - REST) / (1.0 - REST)).clamp(0.0, 1.0);
    let Vec2 { x, y } = stick.normalize_or_zero() * pushed;
    Vec3::new(x, 0.0, -y)
}

/// The turn about the vertical alone; of a head that looks straight up or down, the one of its top or its chin.
fn heading(orientation: Quat) -> Quat {
    let ahead = orientation * Vec3::NEG_Z;
    let up = orientation * Vec3::Y;
    let Vec3 { x, z, .. } = if ahead.y.abs() < 0.99 { ahead } else { up * -ahead.y.signum() };
    Quat::from_rotation_y((-x).atan2(-z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_protocol::pose::Fov;
    use std::f32::consts::FRAC_PI_2;

    const PERIOD_NS: i64 = 13_888_889;

    fn head(yaw: f32, pitch: f32) -> Pose {
        let orientation = Quat::from_rotation_y(yaw) * Quat::from_rotation_x(pitch);
        Pose { position: Vec3::new(0.3, 1.6, -0.2), orientation }
    }

    /// So many frames with one wish.
    fn walked(wish: Wish, head: Pose, frames: i64) -> Locomotion {
        let mut locomotion = Locomotion::default();
        (0..=frames).for_each(|frame| locomotion.step(wish, head, ClientTime(frame * PERIOD_NS)));
        locomotion
    }

    fn views(room_from_head: Pose) -> Views {
        Views {
            stage_from_head: room_from_head,
            linear_velocity: Vec3::X,
            angular_velocity: Vec3::Y,
            stage_from_eye: [room_from_head; 2],
            fov: [Fov::symmetric_degrees(90.0); 2],
            stage_from_hand: [None; 2],
            jumps: 5,
        }
    }

    #[test]
    fn a_stick_walks_in_the_heads_direction() {
        for (yaw, pitch, ahead) in [
            (0.0, 0.0, Vec3::NEG_Z),
            (FRAC_PI_2, -0.9, Vec3::NEG_X),
            (0.0, 1.57, Vec3::NEG_Z),
            (0.0, -1.57, Vec3::NEG_Z),
        ] {
            let head = head(yaw, pitch);
            let wish = Wish { walk: Vec2::Y, ..Wish::default() };
            let walked = walked(wish, head, 72);
            let seen = walked.apply(&views(head));
            let moved = seen.stage_from_head.position - head.position;
            let expected = ahead * WALK_M_S;
            assert!(moved.abs_diff_eq(expected, 1e-3), "{yaw} {pitch}: {moved}");
            assert!((seen.linear_velocity - Vec3::X).abs_diff_eq(expected, 1e-4), "{}", seen.linear_velocity);
            assert_eq!((seen.jumps, seen.stage_from_eye[0]), (5, seen.stage_from_head));
        }
    }

    #[test]
    fn a_stick_at_rest_and_frames_that_were_held_up_move_nobody() {
        let wish = Wish { walk: Vec2::new(0.1, 0.1), turn: 0.2 };
        assert_eq!(walked(wish, head(0.0, 0.0), 72).stage_from_room, Pose::IDENTITY);
        let mut locomotion = Locomotion::default();
        let wish = Wish { walk: Vec2::X, ..Wish::default() };
        for second in 0..10 {
            locomotion.step(wish, head(0.0, 0.0), ClientTime(second * 1_000_000_000));
        }
        assert_eq!(locomotion.stage_from_room, Pose::IDENTITY);
        let most = walked(Wish { walk: Vec2::new(1.0, 1.0), ..Wish::default() }, head(0.0, 0.0), 72);
        assert!((most.stage_from_room.position.length() - WALK_M_S).abs() < 1e-3, "no faster across corners");
    }

    #[test]
    fn a_flick_turns_once_about_the_head_and_is_a_jump() {
        let head = head(0.4, 0.0);
        let mut locomotion = Locomotion::default();
        let pushes = [0.5, 0.8, 1.0, 0.5, 0.9, 0.1, -0.9, 0.0];
        let turns = pushes.map(|turn| {
            locomotion.step(Wish { turn, ..Wish::default() }, head, ClientTime(0));
            locomotion.turns
        });
        assert_eq!(turns, [0, 1, 1, 1, 1, 1, 2, 2]);
        assert!(locomotion.stage_from_room.orientation.abs_diff_eq(Quat::IDENTITY, 1e-6), "there and back");
        locomotion.step(Wish { turn: 1.0, ..Wish::default() }, head, ClientTime(0));
        let seen = locomotion.apply(&views(head));
        assert!(seen.stage_from_head.position.abs_diff_eq(head.position, 1e-6), "the head stays where it is");
        let ahead = |pose: Pose| pose.orientation * Vec3::NEG_Z;
        let to_right = ahead(head).cross(ahead(seen.stage_from_head)).dot(Vec3::NEG_Y);
        assert!((to_right - TURN_RAD.sin()).abs() < 1e-5, "{to_right}");
        assert_eq!(seen.jumps, 8);
        assert!(seen.linear_velocity.abs_diff_eq(Quat::from_rotation_y(-TURN_RAD) * Vec3::X, 1e-6));
    }
}

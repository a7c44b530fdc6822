//! A head moved by keys and pointer, and its eyes. Pure; times are arguments.

use crate::display::{ASSUMED_EYE_HEIGHT_M, Views};
use glam::{Quat, Vec3};
use shadecast_desktop::camera::{Mode, ViewCamera, fov_of_picture};
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ClientTime;

/// From the middle of the head to either eye, metres: half of what is usual between two.
const EYE_OFFSET_M: f32 = 0.0315;
/// To what the head circles around where it orbits, metres.
const ORBIT_M: f32 = 3.0;
/// After a longer gap between two frames nothing moves meanwhile, seconds: the program was held up.
const MAX_STEP_S: f32 = 0.5;

/// The head.
#[derive(Clone, Copy, Debug)]
pub(super) struct Head {
    pub(super) camera: ViewCamera,
    last: Option<(ClientTime, Pose)>,
    jumps: u32,
}

impl Head {
    /// Stands where the stage begins, looks ahead, and sees `fov_deg` degrees from top to bottom.
    pub(super) fn new(fov_deg: f32) -> Self {
        let at = Vec3::new(0.0, ASSUMED_EYE_HEIGHT_M, 0.0);
        let camera = ViewCamera { mode: Mode::Fly, ..ViewCamera::new(at, 0.0, 0.0, ORBIT_M, fov_deg) };
        Self { camera, last: None, jumps: 0 }
    }

    /// Goes back to where it began.
    pub(super) fn reset(&mut self) {
        self.camera = Self::new(self.camera.fov_deg).camera;
        self.last = None;
        self.jumps = self.jumps.wrapping_add(1);
    }

    /// Walks along `axes` until `time`, which never goes back, and looks at pictures of `extent_pixels`: with both eyes, or with one
    /// in the middle, which both are then.
    pub(super) fn views(
        &mut self,
        time: ClientTime,
        axes: Vec3,
        extent_pixels: [u32; 2],
        both_eyes: bool,
    ) -> Views {
        let passed_s = self.last.map_or(0.0, |(last, _)| time.since(last) as f32 * 1e-9);
        let is_held_up = passed_s > MAX_STEP_S;
        self.camera.walk(axes, if is_held_up { 0.0 } else { passed_s });
        let head = self.camera.pose();
        let moved = self.last.filter(|_| passed_s > 0.0 && !is_held_up);
        let (linear_velocity, angular_velocity) = moved.map_or((Vec3::ZERO, Vec3::ZERO), |(_, before)| {
            let turned = shortest(head.orientation * before.orientation.inverse()).to_scaled_axis();
            ((head.position - before.position) / passed_s, turned / passed_s)
        });
        self.last = Some((time, head));
        let offset_m = if both_eyes { EYE_OFFSET_M } else { 0.0 };
        let eye = |side: f32| head.then(Pose { position: Vec3::X * side, orientation: Quat::IDENTITY });
        Views {
            stage_from_head: head,
            linear_velocity,
            angular_velocity,
            stage_from_eye: [eye(-offset_m), eye(offset_m)],
            fov: [fov_of_picture(self.camera.fov_deg, extent_pixels); 2],
            stage_from_hand: [None; 2],
            jumps: self.jumps,
        }
    }
}

/// The same turn, by no more than half a circle.
fn shortest(turn: Quat) -> Quat {
    if turn.w < 0.0 { -turn } else { turn }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn a_walking_head_says_how_fast_it_walks() {
        let mut head = Head::new(60.0);
        let still = head.views(ClientTime(0), Vec3::Z, [640, 480], true);
        assert_eq!((still.linear_velocity, still.stage_from_head.position.z), (Vec3::ZERO, 0.0));
        let walking = head.views(ClientTime(20 * MS), Vec3::Z, [640, 480], true);
        let speed = Vec3::NEG_Z * head.camera.speed_m_s;
        assert!(walking.linear_velocity.abs_diff_eq(speed, 1e-4), "{}", walking.linear_velocity);
        assert!(walking.stage_from_head.position.abs_diff_eq(Vec3::Y * 1.6 + speed * 0.02, 1e-6));
        let [left, right] = walking.stage_from_eye.map(|eye| eye.position);
        assert!((right - left).abs_diff_eq(Vec3::X * 0.063, 1e-6));
        assert!(walking.is_valid());
        let [left, right] = head.views(ClientTime(40 * MS), Vec3::Z, [640, 480], false).eyes();
        assert_eq!(left, right, "one eye is two that are the same");
    }

    #[test]
    fn a_turning_head_says_how_fast_it_turns_the_short_way() {
        let mut head = Head::new(60.0);
        head.camera.yaw = 3.1;
        head.views(ClientTime(0), Vec3::ZERO, [640, 480], true);
        head.camera.yaw = -3.1;
        let turned = head.views(ClientTime(100 * MS), Vec3::ZERO, [640, 480], true);
        let expected = Vec3::Y * (std::f32::consts::TAU - 6.2) / 0.1;
        assert!(turned.angular_velocity.abs_diff_eq(expected, 1e-3), "{}", turned.angular_velocity);
    }

    #[test]
    fn a_stalled_program_does_not_throw_the_head() {
        let mut head = Head::new(60.0);
        head.views(ClientTime(0), Vec3::Z, [640, 480], true);
        let late = head.views(ClientTime(10_000 * MS), Vec3::Z, [640, 480], true);
        assert_eq!((late.stage_from_head.position.z, late.linear_velocity), (0.0, Vec3::ZERO));
    }

    #[test]
    fn going_back_to_the_start_is_a_jump_and_no_motion() {
        let mut head = Head::new(60.0);
        head.views(ClientTime(0), Vec3::Z, [640, 480], true);
        head.views(ClientTime(100 * MS), Vec3::Z, [640, 480], true);
        head.reset();
        let back = head.views(ClientTime(110 * MS), Vec3::ZERO, [640, 480], true);
        assert_eq!((back.jumps, back.linear_velocity), (1, Vec3::ZERO));
        assert_eq!(back.stage_from_head.position, Vec3::Y * ASSUMED_EYE_HEIGHT_M);
    }
}

//! The window's camera: its place, and its motion by dragging, wheel and keys. Pure; time steps are arguments.

use glam::{EulerRot, Quat, Vec3};
use shadecast_protocol::pose::{Fov, Pose};

/// Radians that a drag over one pixel turns.
const DRAG_RAD: f32 = 0.005;
/// How far up or down the camera looks at most: a little less than straight.
const MAX_PITCH_RAD: f32 = 1.55;
/// Factor of a notch of the wheel.
const NOTCH: f32 = 0.88;
/// Walking speed of the keys at first, metres per second.
const SPEED_M_S: f32 = 2.0;

/// What dragging and the wheel do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Around a point: drag turns about it, the wheel goes nearer.
    Orbit,
    /// From a point: drag looks around, the wheel makes the keys faster.
    Fly,
}

/// A camera in the stage.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ViewCamera {
    /// What dragging does.
    pub mode: Mode,
    /// Metres.
    pub position: Vec3,
    /// Turned left, radians.
    pub yaw: f32,
    /// Turned up, radians.
    pub pitch: f32,
    /// To what it orbits around, straight ahead, metres.
    pub distance_m: f32,
    /// Of the keys, metres per second.
    pub speed_m_s: f32,
    /// Vertical field of view, degrees.
    pub fov_deg: f32,
}

impl ViewCamera {
    /// At a place, orbiting.
    pub fn new(position: Vec3, yaw: f32, pitch: f32, distance_m: f32, fov_deg: f32) -> Self {
        Self { mode: Mode::Orbit, position, yaw, pitch, distance_m, speed_m_s: SPEED_M_S, fov_deg }
    }

    /// The same camera at another place, looking another way; roll is dropped.
    pub fn moved_to(self, pose: Pose, fov_deg: f32) -> Self {
        let (yaw, pitch, _) = pose.orientation.to_euler(EulerRot::YXZ);
        Self { position: pose.position, yaw, pitch, fov_deg, ..self }
    }

    /// `stage_from_eye`.
    pub fn pose(&self) -> Pose {
        let orientation = Quat::from_euler(EulerRot::YXZ, self.yaw, self.pitch, 0.0);
        Pose { position: self.position, orientation }
    }

    /// The other mode.
    pub fn switch(&mut self) {
        self.mode = if self.mode == Mode::Orbit { Mode::Fly } else { Mode::Orbit };
    }

    /// The pointer was dragged by so many pixels, to the right and down.
    pub fn drag(&mut self, pixels: [f32; 2]) {
        let pivot = self.pivot();
        // Orbiting, the scene follows the pointer; flying, the view does.
        let sign = if self.mode == Mode::Orbit { -1.0 } else { 1.0 };
        self.yaw += sign * pixels[0] * DRAG_RAD;
        self.pitch = (self.pitch + sign * pixels[1] * DRAG_RAD).clamp(-MAX_PITCH_RAD, MAX_PITCH_RAD);
        if self.mode == Mode::Orbit {
            self.position = pivot - self.ahead() * self.distance_m;
        }
    }

    /// The wheel was turned away by so many notches.
    pub fn wheel(&mut self, notches: f32) {
        let factor = NOTCH.powf(notches);
        match self.mode {
            Mode::Fly => self.speed_m_s = (self.speed_m_s / factor).clamp(0.05, 100.0),
            Mode::Orbit => {
                let pivot = self.pivot();
                self.distance_m = (self.distance_m * factor).clamp(0.1, 500.0);
                self.position = pivot - self.ahead() * self.distance_m;
            }
        }
    }

    /// Keys held for `seconds`: each axis -1 to 1, to the right, up, ahead.
    pub fn walk(&mut self, axes: Vec3, seconds: f32) {
        let along = self.pose().orientation * Vec3::new(axes.x, 0.0, -axes.z) + Vec3::Y * axes.y;
        self.position += along * self.speed_m_s * seconds;
    }

    fn ahead(&self) -> Vec3 {
        self.pose().orientation * Vec3::NEG_Z
    }

    fn pivot(&self) -> Vec3 {
        self.position + self.ahead() * self.distance_m
    }
}

/// The frustum of a picture with square pixels and this vertical field of view.
pub fn fov_of_picture(vertical_degrees: f32, [width, height]: [u32; 2]) -> Fov {
    let up = (vertical_degrees.to_radians() * 0.5).min(1.55);
    let right = (up.tan() * width as f32 / height.max(1) as f32).atan();
    Fov { left: -right, right, up, down: -up }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> ViewCamera {
        ViewCamera::new(Vec3::new(1.0, 1.6, 0.5), 0.3, -0.2, 3.0, 60.0)
    }

    #[test]
    fn orbiting_keeps_what_it_turns_about_in_place_and_ahead() {
        let mut camera = camera();
        let pivot = camera.pivot();
        camera.drag([120.0, -35.0]);
        camera.wheel(2.5);
        assert!(camera.pivot().abs_diff_eq(pivot, 1e-4));
        assert!(camera.position.distance(pivot) < 2.9, "the wheel goes nearer");
        assert!(!camera.position.abs_diff_eq(self::camera().position, 0.1));
    }

    #[test]
    fn flying_looks_around_from_where_it_stands() {
        let mut camera = camera();
        camera.switch();
        camera.drag([50.0, 10.0]);
        assert_eq!(camera.position, self::camera().position);
        assert!(camera.yaw > 0.3 && camera.pitch > -0.2);
    }

    #[test]
    fn keys_walk_where_the_camera_looks() {
        let mut camera = ViewCamera::new(Vec3::ZERO, std::f32::consts::FRAC_PI_2, 0.0, 1.0, 60.0);
        camera.walk(Vec3::Z, 0.5);
        assert!(camera.position.abs_diff_eq(Vec3::NEG_X, 1e-5), "turned left: {}", camera.position);
    }

    #[test]
    fn no_drag_turns_the_camera_over() {
        let mut camera = camera();
        camera.drag([0.0, 1e6]);
        assert!((camera.pose().orientation * Vec3::Y).y > 0.0);
    }

    #[test]
    fn camera_of_the_scene_is_taken_over() {
        let pose = Pose { position: Vec3::X, orientation: Quat::from_euler(EulerRot::YXZ, -0.7, 0.4, 0.0) };
        let moved = camera().moved_to(pose, 35.0);
        assert!(moved.pose().orientation.angle_between(pose.orientation) < 1e-3);
        assert_eq!((moved.position, moved.fov_deg), (Vec3::X, 35.0));
    }

    #[test]
    fn pixels_are_square() {
        let fov = fov_of_picture(60.0, [200, 100]);
        assert!((fov.right.tan() / fov.up.tan() - 2.0).abs() < 1e-5 && fov.left == -fov.right);
        let square = fov_of_picture(90.0, [300, 300]);
        assert!((square.right - Fov::symmetric_degrees(90.0).right).abs() < 1e-6);
    }
}

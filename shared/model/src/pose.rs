//! Poses, fields of view and motion, in the frames of reference that their names carry.

use glam::{Affine3A, Mat4, Quat, Vec3};
use serde::{Deserialize, Serialize};

/// A rigid transform: rotate, then translate. `world_from_head: Pose` takes head coordinates to the world's.
/// Metres; y up, -z forward, right-handed. The rotation is of unit length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// Translation in metres.
    pub position: Vec3,
    /// Unit quaternion.
    pub orientation: Quat,
}

/// Angles of a view frustum's sides in radians, as OpenXR has them: left and down are usually negative.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Fov {
    /// Left side, usually negative.
    pub left: f32,
    /// Right side.
    pub right: f32,
    /// Upper side.
    pub up: f32,
    /// Lower side, usually negative.
    pub down: f32,
}

/// One eye: where it sits in the head, and what it sees.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Eye {
    /// Takes eye coordinates to the head's.
    pub head_from_eye: Pose,
    /// The eye's frustum.
    pub fov: Fov,
}

/// Narrowest field of view in radians, 2 degrees: what is narrower is no display, and its density has no bound.
pub const MIN_VIEW_SPAN: f32 = 0.034_906_585;
/// Angle to a side up to which views are rendered, radians: 89 degrees. One projection cannot show what is beside the eye.
pub const MAX_VIEW_ANGLE: f32 = 1.553_343;

/// Near plane in metres, the same for server, client and ground truth.
pub const NEAR_M: f32 = 0.05;

impl Pose {
    /// No rotation, no translation.
    pub const IDENTITY: Self = Self { position: Vec3::ZERO, orientation: Quat::IDENTITY };

    /// `a_from_b.then(b_from_c)` is `a_from_c`.
    pub fn then(self, inner: Self) -> Self {
        Self {
            position: self.position + self.orientation * inner.position,
            orientation: (self.orientation * inner.orientation).normalize(),
        }
    }

    /// `a_from_b` to `b_from_a`.
    pub fn inverse(self) -> Self {
        let orientation = self.orientation.conjugate();
        Self { position: orientation * -self.position, orientation }
    }

    /// As a matrix.
    pub fn matrix(self) -> Mat4 {
        Mat4::from_rotation_translation(self.orientation, self.position)
    }

    /// As an affine transform.
    pub fn affine(self) -> Affine3A {
        Affine3A::from_rotation_translation(self.orientation, self.position)
    }

    /// True where every number is finite and the rotation is of unit length, within 1 %.
    pub fn is_valid(self) -> bool {
        self.position.is_finite()
            && self.orientation.is_finite()
            && (self.orientation.length_squared() - 1.0).abs() < 0.02
    }
}

impl Fov {
    /// A symmetric frustum of `degrees` in both directions.
    pub fn symmetric_degrees(degrees: f32) -> Self {
        let half = degrees.to_radians() * 0.5;
        Self { left: -half, right: half, up: half, down: -half }
    }

    /// Widened by `margin` radians on each side, kept within `most` radians ([`MAX_VIEW_ANGLE`] or less) to each, and no narrower
    /// than [`MIN_VIEW_SPAN`].
    pub fn widened(self, margin: f32, most: f32) -> Self {
        let low = |angle: f32| (angle - margin).clamp(-most, most - MIN_VIEW_SPAN);
        let high = |angle: f32, low: f32| (angle + margin).min(most).max(low + MIN_VIEW_SPAN);
        let (left, down) = (low(self.left), low(self.down));
        Self { left, right: high(self.right, left), up: high(self.up, down), down }
    }

    /// Clip from eye: reversed depth (1 at [`NEAR_M`], 0 at infinity), Vulkan's y down.
    /// Source: the infinite reversed projection of Upchurch and Desbrun 2012, off-centre as in the OpenXR samples.
    pub fn clip_from_eye(self) -> Mat4 {
        let (l, r) = (self.left.tan(), self.right.tan());
        let (u, d) = (self.up.tan(), self.down.tan());
        let (w, h) = (r - l, d - u);
        Mat4::from_cols_array(&[
            2.0 / w,
            0.0,
            0.0,
            0.0, //
            0.0,
            2.0 / h,
            0.0,
            0.0, //
            (r + l) / w,
            (u + d) / h,
            0.0,
            -1.0, //
            0.0,
            0.0,
            NEAR_M,
            0.0,
        ])
    }

    /// True where the four angles are finite, within [`MAX_VIEW_ANGLE`], and span at least [`MIN_VIEW_SPAN`] in both directions.
    pub fn is_valid(self) -> bool {
        [self.left, self.right, self.up, self.down].iter().all(|angle| angle.abs() <= MAX_VIEW_ANGLE)
            && self.right - self.left >= MIN_VIEW_SPAN
            && self.up - self.down >= MIN_VIEW_SPAN
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec4;

    #[test]
    fn projection_puts_the_frustum_corner_at_the_clip_corner() {
        let fov = Fov { left: -0.7, right: 0.5, up: 0.6, down: -0.8 };
        let corner = fov.clip_from_eye() * Vec4::new(0.5f32.tan() * 3.0, 0.6f32.tan() * 3.0, -3.0, 1.0);
        assert!((corner.x / corner.w - 1.0).abs() < 1e-5, "{corner}");
        assert!((corner.y / corner.w + 1.0).abs() < 1e-5, "up is -1 in Vulkan: {corner}");
        assert!((corner.z / corner.w - NEAR_M / 3.0).abs() < 1e-6);
    }

    #[test]
    fn a_widened_view_is_never_turned_inside_out() {
        let angles = [-1.55, -1.2, -0.9, -1e-40, 0.0, 1e-40, 0.01, 0.9, 1.2, 1.55];
        for (left, right) in angles.into_iter().flat_map(|left| angles.map(|right| (left, right))) {
            for margin in [0.0, 0.052, 0.35] {
                let wide = Fov { left, right, up: right, down: left }.widened(margin, MAX_VIEW_ANGLE);
                let span = wide.right - wide.left;
                assert!(
                    (0.99 * MIN_VIEW_SPAN..=2.0 * MAX_VIEW_ANGLE).contains(&span),
                    "{left} {right}: {wide:?}"
                );
                assert!(wide.clip_from_eye().is_finite());
            }
        }
    }

    #[test]
    fn pose_times_its_inverse_is_the_identity() {
        let pose = Pose { position: Vec3::new(1.0, 2.0, 3.0), orientation: Quat::from_rotation_y(0.4) };
        let id = pose.then(pose.inverse());
        assert!(id.position.length() < 1e-6 && id.orientation.angle_between(Quat::IDENTITY) < 1e-3);
    }
}

//! Scales and rotations of instances, paths, lights and views in a scene file.

use super::fields::Fields;
use crate::SceneError;
use glam::{EulerRot, Mat3, Quat, Vec3};

/// One number for all axes, or three.
pub(super) fn read_scale(fields: &Fields) -> Result<Vec3, SceneError> {
    match fields.get("scale") {
        Some(value) if value.is_array() => Ok(Vec3::from_array(fields.numbers("scale")?.unwrap_or([1.0; 3]))),
        _ => Ok(Vec3::splat(fields.number("scale")?.unwrap_or(1.0))),
    }
}

/// `rotation_quaternion = [x, y, z, w]` of about unit length.
pub(super) fn read_quaternion(fields: &Fields) -> Result<Option<Quat>, SceneError> {
    const KEY: &str = "rotation_quaternion";
    let Some(rotation) = fields.numbers::<4>(KEY)?.map(Quat::from_array) else { return Ok(None) };
    let length = rotation.length();
    if (length - 1.0).abs() > 0.01 {
        let problem = format!("\"{KEY}\" has length {length:.4}; it is x, y, z, w of length 1");
        return Err(fields.error(KEY, problem));
    }
    Ok(Some(rotation.normalize()))
}

/// Degrees about x, y and z: about y first, then x, then z of the turned axes (yaw, pitch, roll).
pub(super) fn rotation_of(degrees: [f32; 3]) -> Quat {
    let [x, y, z] = degrees.map(f32::to_radians);
    Quat::from_euler(EulerRot::YXZ, y, x, z)
}

/// The rotation that takes -z to a unit vector and keeps +y as far up as it can.
pub(super) fn turned_to(along: Vec3) -> Quat {
    let back = -along;
    // Straight up or down no side is the right one; x stays where it is.
    let side = Vec3::Y.cross(back).try_normalize().unwrap_or(Vec3::X);
    Quat::from_mat3(&Mat3::from_cols(side, back.cross(side), back)).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turning_to_a_direction_looks_along_it_with_the_head_up() {
        for along in [Vec3::X, Vec3::Z, Vec3::NEG_Z, Vec3::Y, Vec3::NEG_Y, Vec3::new(1.0, -2.0, 0.5)] {
            let along = along.normalize();
            let rotation = turned_to(along);
            assert!((rotation * Vec3::NEG_Z).abs_diff_eq(along, 1e-5), "{along}");
            assert!((rotation * Vec3::Y).y > -1e-5, "{along}");
        }
    }
}

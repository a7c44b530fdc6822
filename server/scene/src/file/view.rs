//! Viewpoints of a scene file: the stage, cameras and head paths. Cameras and heads stand in the stage and look along their -z.

use super::fields::Fields;
use super::path::{CURVE_KEYS, Key, read_key_times, read_path};
use super::transform::{read_quaternion, rotation_of, turned_to};
use crate::{Camera, HeadPath, SceneError};
use glam::{Quat, Vec3};
use shadecast_model::pose::Pose;

/// Vertical field of view of a camera that does not say its own, degrees.
pub const DEFAULT_FOV_DEG: f32 = 90.0;
/// Least and most that a camera may see from bottom to top, degrees.
pub const FOV_RANGE_DEG: std::ops::RangeInclusive<f32> = 1.0..=150.0;

/// A pose is given by these.
const POSE_KEYS: [&str; 6] =
    ["position", "yaw_deg", "pitch_deg", "roll_deg", "look_at", "rotation_quaternion"];

pub(super) fn read_stage(root: &Fields) -> Result<Pose, SceneError> {
    let Some(fields) = root.table("stage", &["position", "yaw_deg"])? else { return Ok(Pose::IDENTITY) };
    let yaw = fields.number("yaw_deg")?.unwrap_or(0.0).to_radians();
    Ok(Pose {
        position: fields.vector_m("position")?.unwrap_or_default(),
        orientation: Quat::from_rotation_y(yaw),
    })
}

pub(super) fn read_cameras(root: &Fields) -> Result<Vec<Camera>, SceneError> {
    if root.get("camera").is_some_and(|value| value.is_table()) {
        let problem = "where the user starts is now called [stage]; a camera to make pictures with is a \
                       [[camera]], in double brackets";
        return Err(root.error("camera", problem));
    }
    let known = [&["name", "fov_deg"][..], &POSE_KEYS].concat();
    let mut cameras: Vec<Camera> = Vec::new();
    for fields in root.tables("camera", &known)? {
        let name = fields.unique_name("cameras", cameras.iter().map(|camera| camera.name.as_str()))?;
        let (position, turn) = read_pose(&fields)?;
        let fov_deg = fields.number_within("fov_deg", FOV_RANGE_DEG, "degrees")?;
        let stage_from_eye = Pose {
            position: fields.required("position", position)?,
            orientation: turn.map_or(Quat::IDENTITY, Turn::rotation),
        };
        cameras.push(Camera { name, stage_from_eye, fov_deg: fov_deg.unwrap_or(DEFAULT_FOV_DEG) });
    }
    Ok(cameras)
}

pub(super) fn read_head_paths(root: &Fields) -> Result<Vec<HeadPath>, SceneError> {
    let known = [&["name"][..], &CURVE_KEYS].concat();
    let mut head_paths: Vec<HeadPath> = Vec::new();
    for fields in root.tables("head_path", &known)? {
        let name = fields.unique_name("head paths", head_paths.iter().map(|path| path.name.as_str()))?;
        let keys = read_key_times(&fields, &POSE_KEYS, read_head_key)?;
        if keys.iter().all(|key| key.translation.is_none()) {
            let problem = format!("head path \"{name}\" has no position; give its keys a \"position\"");
            return Err(fields.source.error(fields.line, problem));
        }
        let path = read_path(&fields, &name, &keys)?;
        head_paths.push(HeadPath { name, path });
    }
    Ok(head_paths)
}

fn read_head_key(fields: &Fields, time_s: f32) -> Result<Key, SceneError> {
    let (translation, turn) = read_pose(fields)?;
    let euler_deg = match turn {
        Some(Turn::Angles(angles)) => Some(angles),
        _ => None,
    };
    Ok(Key {
        time_s,
        translation,
        rotation: turn.map(Turn::rotation),
        euler_deg,
        scale: None,
        line: fields.line,
    })
}

/// Which way something looks, as the file says it.
#[derive(Clone, Copy)]
enum Turn {
    /// Pitch, yaw and roll in degrees.
    Angles([f32; 3]),
    /// All at once.
    Rotation(Quat),
}

impl Turn {
    fn rotation(self) -> Quat {
        match self {
            Self::Angles(angles_deg) => rotation_of(angles_deg),
            Self::Rotation(rotation) => rotation,
        }
    }
}

/// Position and direction; `None` where nothing is said of them.
fn read_pose(fields: &Fields) -> Result<(Option<Vec3>, Option<Turn>), SceneError> {
    const ANGLES: [&str; 3] = ["pitch_deg", "yaw_deg", "roll_deg"];
    for angle in ANGLES {
        fields.only_one_of(&[angle, "look_at", "rotation_quaternion"])?;
    }
    let position = fields.vector_m("position")?;
    let turn = match (fields.vector_m("look_at")?, read_quaternion(fields)?) {
        (Some(target), _) => Some(Turn::Rotation(look_at(fields, position, target)?)),
        (None, Some(rotation)) => Some(Turn::Rotation(rotation)),
        (None, None) if fields.first_of(&ANGLES).is_none() => None,
        (None, None) => {
            let mut angles = [0.0; 3];
            for (angle, key) in angles.iter_mut().zip(ANGLES) {
                *angle = fields.number(key)?.unwrap_or(0.0);
            }
            Some(Turn::Angles(angles))
        }
    };
    Ok((position, turn))
}

fn look_at(fields: &Fields, position: Option<Vec3>, target: Vec3) -> Result<Quat, SceneError> {
    let position =
        position.ok_or_else(|| fields.error("look_at", "\"look_at\" needs \"position\"; add it"))?;
    let along = (target - position).try_normalize();
    let fault = || fields.error("look_at", "\"look_at\" equals the position; give a point to look at");
    along.map(turned_to).ok_or_else(fault)
}

//! Cameras and head paths by name: viewpoints for measurements and pictures.

use crate::suggest::did_you_mean_or_list;
use crate::{Camera, HeadPath, Scene, SceneError};
use shadecast_model::pose::{Fov, Pose};

impl Scene {
    /// The camera of this name.
    ///
    /// # Errors
    /// There is none; the message names the ones there are.
    pub fn camera(&self, name: &str) -> Result<&Camera, SceneError> {
        let names = self.cameras.iter().map(|camera| camera.name.as_str());
        self.cameras.iter().find(|camera| camera.name == name).ok_or_else(|| unknown("camera", name, names))
    }

    /// The head path of this name.
    ///
    /// # Errors
    /// There is none; the message names the ones there are.
    pub fn head_path(&self, name: &str) -> Result<&HeadPath, SceneError> {
        find_head_path(&self.head_paths, name)
    }
}

/// The head path of this name in a list.
///
/// # Errors
/// There is none; the message names the ones there are.
pub(crate) fn find_head_path<'a>(head_paths: &'a [HeadPath], name: &str) -> Result<&'a HeadPath, SceneError> {
    let names = head_paths.iter().map(|path| path.name.as_str());
    head_paths.iter().find(|path| path.name == name).ok_or_else(|| unknown("head path", name, names))
}

fn unknown<'a>(what: &'static str, name: &str, known: impl Iterator<Item = &'a str> + Clone) -> SceneError {
    let hint = did_you_mean_or_list(name, known, "it has");
    SceneError::UnknownName { what, name: name.to_owned(), hint }
}

impl Camera {
    /// The frustum of a picture that is `aspect` times as wide as it is high.
    pub fn fov(&self, aspect: f32) -> Fov {
        let up = (self.fov_deg * 0.5).to_radians();
        let right = (up.tan() * aspect).atan();
        Fov { left: -right, right, up, down: -up }
    }
}

impl HeadPath {
    /// Where the head is `time_s` seconds into the scene.
    pub fn stage_from_head(&self, time_s: f64) -> Pose {
        let (_, orientation, position) = self.path.transform(time_s).to_scale_rotation_translation();
        Pose { position, orientation: orientation.normalize() }
    }
}

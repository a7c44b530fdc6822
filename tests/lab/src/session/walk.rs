//! Where head and eyes are in a run that no client draws: as the mock runtime would move them.

use super::START_NS;
use anyhow::Context;
use glam::{Quat, Vec3};
use shadecast_mock_runtime::config::MockConfig;
use shadecast_mock_runtime::head_path::HeadPath;
use shadecast_protocol::pose::{Eye, Fov, Pose};

/// Velocities are differences over so much before and after, nanoseconds, as the mock runtime's are.
const DIFFERENCE_NS: i64 = 5_000_000;

/// A head path in the world.
pub struct Walk {
    path: HeadPath,
    world_from_stage: Pose,
    ipd_m: f32,
    fov: Fov,
}

impl Walk {
    /// Of what the mock runtime would be given.
    ///
    /// # Errors
    /// The path cannot be read, or is none.
    pub fn new(config: &MockConfig, world_from_stage: Pose, fov_degrees: f32) -> anyhow::Result<Self> {
        let path = config.head_path.as_ref().context("a run has a head path")?;
        let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
        Ok(Self {
            path: HeadPath::parse(&text, &path.display().to_string())?,
            world_from_stage,
            ipd_m: config.ipd_m,
            fov: Fov::symmetric_degrees(fov_degrees),
        })
    }

    /// The head at a time of the virtual clock.
    pub fn world_from_head(&self, at_ns: i64) -> Pose {
        self.world_from_stage.then(self.path.pose_at((at_ns - START_NS) as f64 * 1e-9))
    }

    /// Metres and radians a second, in the world.
    pub fn velocities(&self, at_ns: i64) -> [Vec3; 2] {
        let [before, after] =
            [-DIFFERENCE_NS, DIFFERENCE_NS].map(|by_ns| self.world_from_head(at_ns + by_ns));
        let seconds = 2.0 * DIFFERENCE_NS as f32 * 1e-9;
        let turn = after.orientation * before.orientation.conjugate();
        [(after.position - before.position) / seconds, turn.to_scaled_axis() / seconds]
    }

    /// Left and right.
    pub fn eyes(&self) -> [Eye; 2] {
        [-0.5, 0.5].map(|side| {
            let head_from_eye = Pose { position: Vec3::X * side * self.ipd_m, orientation: Quat::IDENTITY };
            Eye { head_from_eye, fov: self.fov }
        })
    }
}

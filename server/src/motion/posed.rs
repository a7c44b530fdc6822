//! Poses on the time grid for one client: of instances with bones moved by an application, or of all instances on request.

use super::sampled::SampleWindow;
use crate::animation::timeline::SharedTimeline;
use crate::scene::SceneGpu;
use shadecast_protocol::ids::InstanceId;
use shadecast_protocol::motion::poses::{BonePose, GridPose, pose_bytes};
use shadecast_protocol::time::{DEFAULT_GRID, GridIndex};

/// The instances that one client is sent poses of, and how far they were sent.
#[derive(Debug, Default)]
pub(crate) struct PosedInstances {
    instances: Vec<Posed>,
}

#[derive(Debug)]
struct Posed {
    instance: usize,
    /// A pose's on the wire, about.
    bytes: usize,
    sent_until: Option<GridIndex>,
}

impl PosedInstances {
    /// The client has been told of an instance.
    pub(crate) fn announce(&mut self, scene: &SceneGpu, instance: usize) {
        let model = &scene.scene.models[scene.scene.instances[instance].model];
        let bytes = pose_bytes(model.bones.len() as u32, model.morphs.len() as u32);
        self.instances.push(Posed { instance, bytes, sent_until: None });
    }

    /// Bytes of the poses of one step, about.
    pub(crate) fn step_bytes(&self) -> usize {
        self.instances.iter().map(|posed| posed.bytes).sum()
    }

    /// Which poses of a window were not sent, by rising times, as far as they take no more than so many bytes, about: the last
    /// ones, since after a pause the first are those of the pause. They count as sent from now on.
    pub(crate) fn due(&mut self, window: SampleWindow, budget_bytes: usize) -> Vec<(GridIndex, usize)> {
        let steps = budget_bytes / self.step_bytes().max(1);
        if steps == 0 {
            return Vec::new();
        }
        let most = (window.horizon.0 - window.oldest.0).max(0) as usize + 1;
        let oldest = window.oldest.max(window.horizon.plus(1 - steps.min(most) as i32));
        let mut due = Vec::new();
        for Posed { instance, sent_until, .. } in &mut self.instances {
            let first = sent_until.map_or(window.first, |until| until.plus(1)).max(oldest);
            due.extend((first.0..=window.horizon.0).map(|grid| (GridIndex(grid), *instance)));
            *sent_until = (*sent_until).max(Some(window.horizon));
        }
        due.sort_unstable();
        due
    }
}

/// An instance at a grid step, by the sampled clips or as it is posed: what the server's own pictures show.
pub(crate) fn pose(
    scene: &SceneGpu,
    timeline: &SharedTimeline,
    grid: GridIndex,
    instance: usize,
) -> GridPose {
    let (manager, model) = (&scene.animation.manager, scene.scene.instances[instance].model);
    let shown = timeline.lock().at(instance, DEFAULT_GRID.time_of(grid));
    let local = manager.local_pose(model, &shown);
    let bone = |old: &u32| {
        let bone = local[*old as usize];
        BonePose {
            translation: bone.translation.to_array(),
            rotation: bone.rotation.to_array(),
            scale: bone.scale.to_array(),
        }
    };
    GridPose {
        instance: InstanceId(instance as u16),
        grid,
        bones: scene.motion.bone_order(model).iter().map(bone).collect(),
        weights: manager.morph_weights(manager.pose_key(model, instance, &shown)).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two() -> PosedInstances {
        let posed = |instance| Posed { instance, bytes: 50, sent_until: None };
        PosedInstances { instances: vec![posed(3), posed(8)] }
    }

    fn window(now: i32) -> SampleWindow {
        let grid = |ahead| GridIndex(now + ahead);
        SampleWindow { first: grid(-2), oldest: grid(-20), horizon: grid(4) }
    }

    #[test]
    fn every_step_is_sent_once_and_newcomers_get_the_displayed() {
        let mut posed = two();
        posed.instances[1].sent_until = Some(GridIndex(13));
        let due = posed.due(window(10), usize::MAX);
        let of = |instance| due.iter().filter(move |(_, of)| *of == instance).map(|(grid, _)| grid.0);
        assert_eq!(of(3).collect::<Vec<_>>(), (8..=14).collect::<Vec<_>>());
        assert_eq!(of(8).collect::<Vec<_>>(), [14]);
        assert!(due.is_sorted());
        assert_eq!(posed.due(window(10), usize::MAX), []);
        assert_eq!(posed.due(window(11), usize::MAX), [(GridIndex(15), 3), (GridIndex(15), 8)]);
    }

    #[test]
    fn a_slow_link_gets_the_last_steps() {
        let mut posed = two();
        assert_eq!(posed.due(window(10), 99), [], "none can be paid for");
        let due = posed.due(window(10), 250);
        assert_eq!(due.iter().map(|(grid, _)| grid.0).collect::<Vec<_>>(), [13, 13, 14, 14]);
        assert_eq!(posed.due(window(10), 250), []);
    }
}

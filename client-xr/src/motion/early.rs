//! Poses of unknown instances. Messages about motion wait for no update, and may overtake the update that brings the instance.
//! The poses are kept until it arrives, within the client's needs.

use shadecast_protocol::ids::InstanceId;
use shadecast_protocol::motion::poses::GridPose;
use shadecast_protocol::motion::skeleton::grid_words;
use std::collections::BTreeMap;

/// See the module. In all they take no more words than the arena has, since that is where they would go.
#[derive(Debug)]
pub(super) struct EarlyPoses {
    sample_ring: u32,
    /// By instance and place in its ring.
    poses: BTreeMap<(InstanceId, i32), GridPose>,
    words: u32,
}

impl EarlyPoses {
    /// Of instances that keep so many steps of the time grid.
    pub(super) fn new(sample_ring: u32) -> Self {
        Self { sample_ring, poses: BTreeMap::new(), words: 0 }
    }

    /// Keeps a pose, unless a later one has its place or there is no room.
    pub(super) fn keep(&mut self, pose: GridPose, arena_words: u32) {
        let key = (pose.instance, pose.grid.0.rem_euclid(self.sample_ring as i32));
        let known = self.poses.get(&key);
        if known.is_some_and(|known| known.grid > pose.grid) {
            return;
        }
        let words = self.words - known.map_or(0, words) + words(&pose);
        if words > arena_words {
            tracing::debug!("poses of instance {} arrived too early and are dropped", pose.instance.0);
            return;
        }
        self.words = words;
        self.poses.insert(key, pose);
    }

    /// The poses of an instance that is known now.
    pub(super) fn take(&mut self, id: InstanceId) -> Vec<GridPose> {
        let own: Vec<_> = self.poses.range((id, 0)..=(id, i32::MAX)).map(|(key, _)| *key).collect();
        let poses: Vec<GridPose> = own.iter().filter_map(|key| self.poses.remove(key)).collect();
        self.words -= poses.iter().map(words).sum::<u32>();
        poses
    }
}

/// At least one, since a pose of nothing takes room too.
fn words(pose: &GridPose) -> u32 {
    grid_words(pose.bones.len() as u32, pose.weights.len() as u32).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shadecast_protocol::time::GridIndex;

    const FOX: InstanceId = InstanceId(3);
    const RING: u32 = 32;

    fn pose(instance: InstanceId, grid: i32) -> GridPose {
        GridPose { instance, grid: GridIndex(grid), bones: Vec::new(), weights: vec![0.5; 16] }
    }

    fn grids(early: &mut EarlyPoses, id: InstanceId) -> Vec<i32> {
        let mut grids: Vec<i32> = early.take(id).iter().map(|pose| pose.grid.0).collect();
        grids.sort_unstable();
        grids
    }

    #[test]
    fn poses_wait_for_their_instance_and_the_last_one_has_the_place() {
        let mut early = EarlyPoses::new(RING);
        for grid in [-1, 40, 8, 9] {
            early.keep(pose(FOX, grid), 1000);
        }
        early.keep(pose(InstanceId(4), 9), 1000);
        assert_eq!(grids(&mut early, FOX), [-1, 9, 40], "8 lies where 40 does");
        assert!(grids(&mut early, FOX).is_empty());
        assert_eq!(grids(&mut early, InstanceId(4)), [9]);
        assert_eq!(early.words, 0);
    }

    #[test]
    fn what_comes_early_takes_no_more_than_the_arena_would() {
        let mut early = EarlyPoses::new(RING);
        (0..RING as i32).for_each(|grid| early.keep(pose(FOX, grid), 12));
        assert_eq!(grids(&mut early, FOX), [0, 1, 2], "four words each");
        early.keep(pose(FOX, 7), 12);
        assert_eq!(grids(&mut early, FOX), [7]);
        for instance in (0..100).map(InstanceId) {
            early.keep(GridPose { weights: Vec::new(), ..pose(instance, 0) }, 12);
        }
        assert_eq!(early.poses.len(), 12, "poses of nothing");
    }
}

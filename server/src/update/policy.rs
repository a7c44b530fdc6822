//! The policy of a viewer's updates. The product has the default. A measurement changes one rule at a time, to say what each
//! cause of error costs. The steps ask the policy; they know no measurement.

use crate::pacing::relief::{Measure, Measures};
use crate::shading::filter::Filter;
use crate::time::view_time::ViewTime;
use crate::time::{RingPlace, VIEW_TIMES};
use crate::visibility::clusters::Clusters;
use crate::visibility::view_plan::ViewPlan;
use crate::world::World;
use shadecast_gpu::Recorder;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::time::WorldTime;
use std::collections::BTreeMap;

/// The first of an update's times alone.
pub(crate) const ONLY_THE_FIRST: [bool; VIEW_TIMES] = [true, false, false];

/// See the module.
#[derive(Clone, Debug, PartialEq)]
pub struct UpdatePolicy {
    /// Texels that blocks get for a pixel of the display, in an atlas with room.
    pub texels_per_pixel: f32,
    /// What textures are filtered for.
    pub filter: Filter,
    /// Blocks whose inputs have not changed are not shaded again.
    pub reuse: bool,
    /// Still views of a still scene are drawn once an update, not at each of its times.
    pub one_pass_when_still: bool,
    /// Of static instances, only clusters in sight are drawn.
    pub clusters: bool,
    /// For when exactly updates are shaded, where that is known ahead; others as [`PredictedViews::shaded`](crate::visibility::predict::PredictedViews::shaded) says.
    pub shading_times: BTreeMap<UpdateId, WorldTime>,
    /// Head and world are predicted for when updates will be on display.
    pub predicts: bool,
    /// The times at which an update has a visibility pass.
    pub views: ViewPlan,
    /// Measures in force throughout, instead of those that the time of updates asks for.
    pub measures: Option<Measures>,
}

impl Default for UpdatePolicy {
    fn default() -> Self {
        Self {
            texels_per_pixel: 1.0,
            filter: Filter::default(),
            reuse: true,
            one_pass_when_still: true,
            clusters: true,
            shading_times: BTreeMap::new(),
            predicts: true,
            views: ViewPlan::default(),
            measures: None,
        }
    }
}

impl UpdatePolicy {
    /// The times of an update's visibility passes: one where head and scene stand still, fewer where a measure says so. The first
    /// update looks at all of them, since no other has looked before it.
    pub(super) fn pass_times(
        &self,
        update: UpdateId,
        measures: Measures,
        stands: impl FnOnce() -> bool,
    ) -> [bool; VIEW_TIMES] {
        if self.one_pass_when_still && stands() {
            return ONLY_THE_FIRST;
        }
        let plan = match self.views {
            ViewPlan::Every if measures.has(Measure::OneTime) && update.0 > 0 => ViewPlan::OneInTurn,
            plan => plan,
        };
        plan.times(update.0)
    }

    /// The clusters of static instances that are culled; an instance without any is drawn whole.
    pub(super) fn clusters<'a>(&self, world: &'a World) -> &'a Clusters {
        if self.clusters { world.clusters() } else { Clusters::NONE }
    }

    /// Records light, shadow map and tangents for an update that is shaded for `at`, sampled into `place`. Returns the time
    /// of its shading.
    pub(super) fn light(
        &self,
        world: &mut World,
        recorder: &mut Recorder,
        update: UpdateId,
        (at, place): (ViewTime, RingPlace),
    ) -> WorldTime {
        if let Some(time) = self.shading_times.get(&update) {
            world.light_at(recorder, place, *time);
            return *time;
        }
        world.light(recorder, at, place);
        at.time(world.grid())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn with_one_view_time_in_turn_the_first_update_still_looks_at_all() {
        let policy = UpdatePolicy::default();
        let times = |update: u32| policy.pass_times(UpdateId(update), Measures::ALL, || false);
        assert_eq!(times(0), [true; VIEW_TIMES]);
        let looks = |update: u32| times(update).into_iter().filter(|looks| *looks).count();
        assert!((1..10).all(|update| looks(update) == 1));
    }
}

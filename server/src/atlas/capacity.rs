//! Which patches are shown where the client's memory or the atlas cannot hold all that are in view: those that matter
//! most on screen. Pure; what is left out is counted, and told when it begins and when it ends.

use crate::pacing::room::Room;
use crate::scene::geometry::{Geometry, MAX_CORNERS, vertices_of_patch};
use crate::scene::numbering::{ScenePatch, SceneVertex};
use std::cmp::Reverse;

/// A patch that is shown counts as so many times larger than it is, so that two of about the same size do not take
/// turns.
const SHOWN_BONUS: u64 = 2;
/// A shortage is over when nothing was missing for so many updates.
const OVER_AFTER_UPDATES: u32 = 30;

/// Triangles that are drawn for a patch at most: three of two sides.
const MAX_TRIANGLES: usize = 6;

/// A patch that could be shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Candidate {
    /// The patch.
    pub patch: ScenePatch,
    /// Whether a view shows it, or did so a moment ago. Those go before what is only held.
    pub is_in_view: bool,
    /// Its projected extent: width times height in texels.
    pub area_texels: u32,
    /// Whether the last choice has it.
    pub is_shown: bool,
}

impl Candidate {
    /// Ascending from what matters most; ties go in patch order.
    pub(crate) fn rank(&self) -> (bool, Reverse<u64>, ScenePatch) {
        let bonus = if self.is_shown { SHOWN_BONUS } else { 1 };
        (!self.is_in_view, Reverse(u64::from(self.area_texels) * bonus), self.patch)
    }
}

/// Makes the choice, update after update.
#[derive(Clone, Debug, Default)]
pub(crate) struct Chooser {
    /// By scene-wide vertex number: the last count that met it.
    counted: Vec<u32>,
    count: u32,
}

impl Chooser {
    /// What of the room these patches leave.
    pub(crate) fn left_beside(
        &mut self,
        geometry: &impl Geometry,
        room: Room,
        patches: impl Iterator<Item = ScenePatch>,
    ) -> Room {
        let mut left = room;
        self.start_count(geometry);
        for patch in patches {
            let drawn = geometry.patch(patch).drawn_triangles();
            left.patches = left.patches.saturating_sub(1);
            left.vertices = left.vertices.saturating_sub(self.count_vertices(geometry, patch));
            left.triangles = left.triangles.saturating_sub(drawn);
        }
        left
    }

    /// Leaves all `candidates`, or those that matter most of them and have room: in patch order, as they came.
    pub(crate) fn choose(&mut self, geometry: &impl Geometry, room: Room, candidates: &mut Vec<Candidate>) {
        if self.all_fit(geometry, room, candidates.iter().map(|candidate| candidate.patch)) {
            return;
        }
        candidates.sort_unstable_by_key(Candidate::rank);
        let Room { mut patches, mut vertices, mut triangles } = room;
        self.start_count(geometry);
        candidates.retain(|candidate| {
            let cost = self.uncounted(geometry, candidate.patch);
            let drawn = geometry.patch(candidate.patch).drawn_triangles();
            let fits = patches > 0 && cost <= vertices && drawn <= triangles;
            if fits {
                (patches, vertices, triangles) = (patches - 1, vertices - cost, triangles - drawn);
                self.count_vertices(geometry, candidate.patch);
            }
            fits
        });
        candidates.sort_unstable_by_key(|candidate| candidate.patch);
    }

    /// Whether there is room for all of these patches.
    pub(crate) fn all_fit(
        &mut self,
        geometry: &impl Geometry,
        room: Room,
        patches: impl Iterator<Item = ScenePatch> + Clone,
    ) -> bool {
        let count = patches.clone().count();
        let most = |of_each: usize, room: u32| count * of_each <= room as usize;
        if !most(1, room.patches) {
            return false;
        }
        let has_triangles =
            || patches.clone().map(|patch| geometry.patch(patch).drawn_triangles()).sum::<u32>();
        if !most(MAX_TRIANGLES, room.triangles) && has_triangles() > room.triangles {
            return false;
        }
        if most(MAX_CORNERS, room.vertices) {
            return true; // without counting
        }
        self.start_count(geometry);
        patches.map(|patch| self.count_vertices(geometry, patch)).sum::<u32>() <= room.vertices
    }

    fn start_count(&mut self, geometry: &impl Geometry) {
        self.counted.resize(geometry.vertex_count(), 0);
        self.count += 1;
    }

    /// Vertices of a patch that this count has not met.
    fn uncounted(&self, geometry: &impl Geometry, patch: ScenePatch) -> u32 {
        vertices_of_patch(geometry, patch).filter(|v| self.counted[v.index()] != self.count).count() as u32
    }

    /// Meets the vertices of a patch; how many were new.
    fn count_vertices(&mut self, geometry: &impl Geometry, patch: ScenePatch) -> u32 {
        let count = self.count;
        let mut is_new =
            |vertex: SceneVertex| std::mem::replace(&mut self.counted[vertex.index()], count) != count;
        vertices_of_patch(geometry, patch).map(|vertex| u32::from(is_new(vertex))).sum()
    }
}

/// What there is to say about patches that are missing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Notice {
    /// From now on some are missing: so many at first.
    Begins(usize),
    /// None has been missing for a while; so many were in the worst update.
    Ends(usize),
}

/// Watches how many patches are missing, update after update.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Shortage {
    total: u64,
    /// The worst update since the shortage began that goes on, if one does, and updates since the last that had one.
    now: Option<(usize, u32)>,
}

impl Shortage {
    /// Takes the number of patches in view that one update does not show; says when a shortage begins and when it ends.
    pub(crate) fn update(&mut self, missing: usize) -> Option<Notice> {
        self.total += missing as u64;
        match (&mut self.now, missing) {
            (None, 0) => None,
            (None, _) => {
                self.now = Some((missing, 0));
                Some(Notice::Begins(missing))
            }
            (Some((worst, quiet)), 0) => {
                *quiet += 1;
                let (worst, is_over) = (*worst, *quiet >= OVER_AFTER_UPDATES);
                self.now = self.now.filter(|_| !is_over);
                is_over.then_some(Notice::Ends(worst))
            }
            (Some((worst, quiet)), _) => {
                (*worst, *quiet) = ((*worst).max(missing), 0);
                None
            }
        }
    }

    /// Patches in view that were not shown, summed over all updates.
    pub(crate) fn total(&self) -> u64 {
        self.total
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::geometry::test_geometry::Fan;

    fn candidate(patch: u32, area_texels: u32) -> Candidate {
        Candidate { patch: ScenePatch(patch), is_in_view: true, area_texels, is_shown: false }
    }

    fn chosen(room: Room, candidates: &[Candidate]) -> Vec<u32> {
        let mut chosen = candidates.to_vec();
        Chooser::default().choose(&Fan { patches: 100 }, room, &mut chosen);
        chosen.iter().map(|candidate| candidate.patch.0).collect()
    }

    #[test]
    fn the_large_patch_near_the_viewer_stays_while_tiny_far_ones_go() {
        let room = Room { patches: 10, vertices: 1000, triangles: 1000 };
        let ground = candidate(0, 300 * 200);
        let candidates: Vec<_> =
            [ground].into_iter().chain((1..100).map(|patch| candidate(patch, patch))).collect();
        assert_eq!(chosen(room, &candidates), [0, 91, 92, 93, 94, 95, 96, 97, 98, 99]);
    }

    #[test]
    fn vertices_that_patches_share_count_once() {
        // A fan of n triangles has n + 2 vertices.
        let all: Vec<_> = (0..20).map(|patch| candidate(patch, 5)).collect();
        let room = Room { patches: 100, vertices: 22, triangles: 1000 };
        assert_eq!(chosen(room, &all).len(), 20);
        let room = Room { patches: 100, vertices: 21, triangles: 1000 };
        assert_eq!(chosen(room, &all), (0..19).collect::<Vec<_>>());
    }

    #[test]
    fn no_more_triangles_are_drawn_than_the_client_draws() {
        let all: Vec<_> = (0..20).map(|patch| candidate(patch, 5)).collect();
        let room = Room { patches: 100, vertices: 100, triangles: 20 };
        assert_eq!(chosen(room, &all).len(), 20);
        let room = Room { triangles: 19, ..room };
        assert_eq!(chosen(room, &all), (0..19).collect::<Vec<_>>());
    }

    #[test]
    fn what_is_in_view_goes_before_what_is_only_held() {
        let held = Candidate { is_in_view: false, is_shown: true, ..candidate(0, 5000) };
        let room = Room { patches: 1, vertices: 100, triangles: 1000 };
        assert_eq!(chosen(room, &[held, candidate(1, 1)]), [1]);
    }

    #[test]
    fn sizes_that_tremble_do_not_change_the_choice_and_a_real_change_does() {
        let room = Room { patches: 30, vertices: 1000, triangles: 1000 };
        let mut shown = Vec::new();
        let mut areas: Vec<u32> = (0..100).map(|patch| 1000 + 3 * patch).collect();
        for update in 0..40u32 {
            let tremble = |patch: u32| (patch * 7 + update * 13) % 100;
            let candidates: Vec<_> = (0..100)
                .map(|patch| Candidate {
                    is_shown: shown.contains(&patch),
                    ..candidate(patch, areas[patch as usize] + tremble(patch))
                })
                .collect();
            let now = chosen(room, &candidates);
            assert!(update == 0 || now == shown, "update {update}");
            shown = now;
        }
        areas[0] = 9000;
        let candidates: Vec<_> = (0..100)
            .map(|patch| Candidate {
                is_shown: shown.contains(&patch),
                ..candidate(patch, areas[patch as usize])
            })
            .collect();
        assert!(!shown.contains(&0) && chosen(room, &candidates).contains(&0));
    }

    #[test]
    fn a_shortage_is_told_when_it_begins_and_once_it_is_over() {
        let mut shortage = Shortage::default();
        let (mut told, mut sum) = (Vec::new(), 0);
        for update in 0..400 {
            // Two spells; within one, every other update misses something.
            let spell = update < 50 || (200..230).contains(&update);
            let missing = if spell && update % 2 == 0 { 5 + update % 9 } else { 0 };
            sum += missing as u64;
            told.extend(shortage.update(missing));
        }
        assert_eq!(told, [Notice::Begins(5), Notice::Ends(13), Notice::Begins(7), Notice::Ends(13)]);
        assert_eq!(shortage.total(), sum);
    }
}

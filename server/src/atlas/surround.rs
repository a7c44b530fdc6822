//! What no predicted view sees, but a head could see before an update arrives that knows of it: kept with small blocks, so that
//! no turn of the head shows emptiness. Pure.
//!
//! `Sweep` finds it. What is largest on screen, and so what is near, comes first, until what the surround
//! may take is used up: a share of all that the client and the atlas hold, and half of what is left beside what is in view.

use crate::atlas::capacity::{Candidate, Chooser};
use crate::pacing::room::Room;
use crate::scene::geometry::Geometry;
use crate::scene::numbering::ScenePatch;
use crate::support::merged::merged;
use crate::visibility::sweep::ROUND_UPDATES;

/// Part of the client's slots and of the atlas that the surround may take unless asked otherwise; see `docs/decisions.md`.
pub const DEFAULT_SURROUND: f32 = 0.25;
/// Texels to a pixel of the display.
pub(crate) const SURROUND_DENSITY: f32 = 0.125;
/// Updates until all of it was shaded again.
pub(crate) const SHADED_EVERY_UPDATES: u32 = 16;
/// Of what is left, as much stays free for what comes into view.
const LEFT_FREE: f32 = 0.5;

/// A patch that could be kept.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Kept {
    /// The patch, and how much it matters.
    pub candidate: Candidate,
    /// Texels of its block.
    pub texels: u64,
}

/// A patch that a glance saw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Seen {
    /// The patch.
    pub patch: ScenePatch,
    /// Width and height in texels at density 1: the largest of this round of the sweep and of the last, which look from several
    /// places, so that blocks do not change with each of them.
    pub extent: [u16; 2],
    /// The update in which it was seen last.
    pub update: u32,
    /// The largest of this round alone.
    in_this_round: [u16; 2],
}

impl Seen {
    /// The same after a glance of `update` saw it so large, and `before` it.
    fn again(self, before: &Self) -> Self {
        let largest = |a: [u16; 2], b: [u16; 2]| [a[0].max(b[0]), a[1].max(b[1])];
        let [now, then] = [self.update, before.update].map(|update| update / ROUND_UPDATES);
        let (last_round, this_round) = match now - then {
            0 => (before.extent, before.in_this_round),
            _ => (before.in_this_round, [0; 2]),
        };
        let in_this_round = largest(this_round, self.extent);
        Self { extent: largest(last_round, in_this_round), in_this_round, ..self }
    }
}

/// See the module.
#[derive(Clone, Debug)]
pub(crate) struct Surround {
    share: f32,
    chooser: Chooser,
    /// What was seen within a round of the sweep, ascending.
    seen: Vec<Seen>,
    /// Lists of one update, kept for their memory.
    before: Vec<Seen>,
    chosen: Vec<Candidate>,
}

impl Surround {
    /// With a share of a client's room, 0..1.
    pub(crate) fn new(share: f32) -> Self {
        Self { share, chooser: Chooser::default(), seen: Vec::new(), before: Vec::new(), chosen: Vec::new() }
    }

    /// Whether there is any.
    pub(crate) fn is_kept(&self) -> bool {
        self.share > 0.0
    }

    /// A glance of `update` saw these, ascending.
    pub(crate) fn see(&mut self, update: u32, now: impl Iterator<Item = (ScenePatch, [u16; 2])>) {
        std::mem::swap(&mut self.seen, &mut self.before);
        self.seen.clear();
        let before = &self.before;
        let found = |(patch, extent)| {
            let first = Seen { patch, extent, update, in_this_round: extent };
            let known = before.binary_search_by_key(&patch, |seen| seen.patch);
            known.map_or(first, |at| first.again(&before[at]))
        };
        let held = before.iter().copied().filter(|held| update - held.update <= ROUND_UPDATES);
        self.seen.extend(merged(held, now.map(found), |a, b| a.patch.cmp(&b.patch)));
    }

    /// What was seen within a round, ascending.
    pub(crate) fn seen(&self) -> &[Seen] {
        &self.seen
    }

    /// Those of `kept` that fit what may be taken, of a client that has of its `room` so much `left`, and an atlas of so many texels;
    /// ascending.
    pub(crate) fn choose(
        &mut self,
        geometry: &impl Geometry,
        kept: &mut [Kept],
        room: Room,
        left: Room,
        atlas_texels: u64,
    ) -> &[Candidate] {
        let mut texels = (atlas_texels as f64 * f64::from(self.share)) as u64;
        kept.sort_unstable_by_key(|kept| kept.candidate.rank());
        let fits = |kept: &&Kept| match texels.checked_sub(kept.texels) {
            Some(left) => {
                texels = left;
                true
            }
            None => false,
        };
        let allowed = self.allowed(room, left);
        self.chosen.clear();
        self.chosen.extend(kept.iter().take_while(fits).map(|kept| kept.candidate));
        self.chosen.sort_unstable_by_key(|candidate| candidate.patch);
        self.chooser.choose(geometry, allowed, &mut self.chosen);
        &self.chosen
    }

    fn allowed(&self, room: Room, left: Room) -> Room {
        let of = |all: u32, left: u32| {
            ((all as f32 * self.share) as u32).min((left as f32 * (1.0 - LEFT_FREE)) as u32)
        };
        Room {
            patches: of(room.patches, left.patches),
            vertices: of(room.vertices, left.vertices),
            triangles: of(room.triangles, left.triangles),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::geometry::test_geometry::Loose;

    const ROOM: Room = Room { patches: 100, vertices: 300, triangles: 100 };
    const ATLAS_TEXELS: u64 = 100 * 16;

    fn kept(patch: u32, area_texels: u32) -> Kept {
        let candidate =
            Candidate { patch: ScenePatch(patch), is_in_view: false, area_texels, is_shown: false };
        Kept { candidate, texels: 16 }
    }

    /// How many, and which of 200 patches of which each is larger than the one before.
    fn chosen(share: f32, left: Room, atlas_texels: u64) -> Vec<u32> {
        let mut all: Vec<Kept> = (0..200).map(|patch| kept(patch, 10 + patch)).collect();
        let geometry = Loose { patches: 200 };
        let mut surround = Surround::new(share);
        let chosen = surround.choose(&geometry, &mut all, ROOM, left, atlas_texels);
        chosen.iter().map(|chosen| chosen.patch.0).collect()
    }

    #[test]
    fn no_more_than_its_share_is_taken_of_anything_and_the_largest_come_first() {
        let last = |count: u32| (200 - count..200).collect::<Vec<_>>();
        assert_eq!(chosen(0.25, ROOM, ATLAS_TEXELS), last(25));
        assert_eq!(chosen(0.25, ROOM, ATLAS_TEXELS / 5), last(5), "texels");
        for room in
            [Room { patches: 20, ..ROOM }, Room { vertices: 60, ..ROOM }, Room { triangles: 20, ..ROOM }]
        {
            let mut all: Vec<Kept> = (0..200).map(|patch| kept(patch, 10 + patch)).collect();
            let mut surround = Surround::new(0.25);
            let chosen = surround.choose(&Loose { patches: 200 }, &mut all, room, ROOM, ATLAS_TEXELS);
            assert_eq!(chosen.len(), 5, "{room:?}");
        }
    }

    #[test]
    fn half_of_what_is_left_beside_what_is_in_view_stays_free() {
        for left in
            [Room { patches: 20, ..ROOM }, Room { vertices: 60, ..ROOM }, Room { triangles: 20, ..ROOM }]
        {
            assert_eq!(chosen(0.25, left, ATLAS_TEXELS).len(), 10, "{left:?}");
        }
        assert!(chosen(0.25, Room { patches: 0, ..ROOM }, ATLAS_TEXELS).is_empty());
    }

    #[test]
    fn without_a_share_nothing_is_kept() {
        assert!(chosen(0.0, ROOM, ATLAS_TEXELS).is_empty());
        assert!(!Surround::new(0.0).is_kept());
    }

    #[test]
    fn what_was_seen_is_known_for_a_round_of_the_sweep() {
        let mut surround = Surround::new(0.25);
        let mut see = |update: u32, patches: &[u32]| {
            surround.see(update, patches.iter().map(|patch| (ScenePatch(*patch), [5; 2])));
            surround.seen().iter().map(|seen| seen.patch.0).collect::<Vec<_>>()
        };
        assert_eq!(see(1, &[2, 5]), [2, 5]);
        assert_eq!(see(3, &[3, 5]), [2, 3, 5]);
        assert_eq!(see(1 + ROUND_UPDATES, &[]), [2, 3, 5]);
        assert_eq!(see(2 + ROUND_UPDATES, &[9]), [3, 5, 9]);
    }

    #[test]
    fn an_extent_is_the_largest_of_a_round_so_that_places_of_the_eye_do_not_change_it() {
        let mut surround = Surround::new(0.25);
        let mut extents = |updates: std::ops::Range<u32>, scale: u16| {
            let mut see = |update: u32| {
                let extent = [scale * (10 + (update % ROUND_UPDATES) as u16 % 7), scale * 9];
                surround.see(update, [(ScenePatch(4), extent)].into_iter());
                surround.seen()[0].extent
            };
            updates.map(&mut see).collect::<Vec<_>>()
        };
        extents(0..ROUND_UPDATES, 2);
        assert!(extents(ROUND_UPDATES..5 * ROUND_UPDATES, 2).iter().all(|extent| *extent == [32, 18]));
        let smaller = extents(5 * ROUND_UPDATES..8 * ROUND_UPDATES, 1);
        assert_eq!(smaller[2 * ROUND_UPDATES as usize..], [[16, 9]; ROUND_UPDATES as usize]);
    }
}

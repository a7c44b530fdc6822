//! What an update shows: instances at LODs, and where each of their patches has its entry in `visible`. Pure.
//!
//! Entries are numbered anew with each update, over what is looked at alone: what the CPU reads of them grows with what is drawn,
//! not with the scene.

use crate::scene::numbering::{Numbering, PatchRange, ScenePatch};
use std::ops::Range;

/// The LODs of an instance in an update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LodChoice {
    /// What the client shows.
    pub shown: usize,
    /// What it is to show instead as soon as all of it is there that is seen.
    pub next: Option<usize>,
}

/// An instance at an LOD.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LodInstance {
    /// Number of the instance in the scene.
    pub instance: usize,
    /// The LOD.
    pub lod: usize,
    /// Its patches.
    pub patches: PatchRange,
    /// Entry of the first of them.
    pub first_entry: u32,
    /// Whether the client shows this LOD with this update; if not, it is to be the next.
    pub is_shown: bool,
}

impl LodInstance {
    /// Entries of its patches.
    pub(crate) fn entries(&self) -> Range<usize> {
        let first = self.first_entry as usize;
        first..first + self.patches.count as usize
    }
}

/// All LODs of one update.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LodSet {
    /// Ascending by instance and LOD, and so by patch.
    lods: Vec<LodInstance>,
}

impl LodSet {
    /// The instances that have LODs, given in their order.
    pub fn new(numbering: &Numbering, choices: impl IntoIterator<Item = Option<LodChoice>>) -> Self {
        let mut lods = Self::default();
        lods.refill(numbering, choices);
        lods
    }

    /// The same in the memory of another update's.
    pub(crate) fn refill(
        &mut self,
        numbering: &Numbering,
        choices: impl IntoIterator<Item = Option<LodChoice>>,
    ) {
        self.lods.clear();
        for (instance, LodChoice { shown, next }) in
            choices.into_iter().enumerate().filter_map(|(instance, choice)| Some((instance, choice?)))
        {
            let mut both = [Some((shown, true)), next.map(|next| (next, false))];
            both.sort_unstable();
            for (lod, is_shown) in both.into_iter().flatten() {
                if let Some(patches) = numbering.patches(instance, lod) {
                    self.add(instance, lod, patches, is_shown);
                }
            }
        }
    }

    /// All patches of one instance of one LOD.
    #[cfg(test)]
    pub(crate) fn of_one(patches: u32) -> Self {
        let mut lods = Self::default();
        lods.add(0, 0, PatchRange { first: ScenePatch(0), count: patches }, true);
        lods
    }

    fn add(&mut self, instance: usize, lod: usize, patches: PatchRange, is_shown: bool) {
        let first_entry = self.entries() as u32;
        self.lods.push(LodInstance { instance, lod, patches, first_entry, is_shown });
    }

    /// All of them, ascending by patch.
    pub fn all(&self) -> &[LodInstance] {
        &self.lods
    }

    /// How many entries there are.
    pub fn entries(&self) -> usize {
        self.lods.last().map_or(0, |last| last.entries().end)
    }

    /// The LODs that the client shows, ascending.
    pub(crate) fn shown(&self) -> impl Iterator<Item = &LodInstance> + Clone {
        self.lods.iter().filter(|lod| lod.is_shown)
    }

    /// The LODs that are to be shown next, where these are others.
    pub(crate) fn next(&self) -> impl Iterator<Item = &LodInstance> + Clone {
        self.lods.iter().filter(|lod| !lod.is_shown)
    }

    /// Of these those that are coarser than what is shown of their instance, or where nothing is.
    pub(crate) fn coarser(&self) -> impl Iterator<Item = &LodInstance> {
        self.next().filter(|lod| self.lod_shown(lod.instance) < Some(lod.lod))
    }

    fn lod_shown(&self, instance: usize) -> Option<usize> {
        let first = self.lods.partition_point(|lod| lod.instance < instance);
        let mut lods = self.lods[first..].iter().take_while(|lod| lod.instance == instance);
        lods.find(|lod| lod.is_shown).map(|lod| lod.lod)
    }

    /// The scene as the client shows it, and, where that differs, as it is to be next: each of them one LOD an instance, of those
    /// that are drawn. The second is empty where it does not differ.
    pub(crate) fn scenes(&self, [now, next]: &mut [Vec<LodInstance>; 2], is_drawn: impl Fn(usize) -> bool) {
        let drawn = |lod: &&LodInstance| is_drawn(lod.instance);
        now.clear();
        next.clear();
        now.extend(self.shown().filter(drawn));
        if !self.next().any(|lod| drawn(&lod)) {
            return;
        }
        next.extend_from_slice(now);
        for lod in self.next().filter(drawn) {
            match next.binary_search_by_key(&lod.instance, |lod| lod.instance) {
                Ok(at) => next[at] = *lod,
                Err(at) => next.insert(at, *lod),
            }
        }
    }

    /// The client shows the next LOD of an instance from this update on.
    pub(crate) fn switch(&mut self, instance: usize) {
        self.lods.iter_mut().filter(|lod| lod.instance == instance).for_each(|lod| lod.is_shown ^= true);
    }

    /// The patches among `sorted` ones that the client shows, with their instance.
    pub(crate) fn shown_of<'a>(
        &'a self,
        sorted: &'a [ScenePatch],
    ) -> impl Iterator<Item = (usize, ScenePatch)> + Clone + 'a {
        self.shown_among(sorted.iter().copied(), |patch| *patch)
    }

    /// The same of what is known of patches, ascending by these.
    pub(crate) fn shown_among<T>(
        &self,
        sorted: impl Iterator<Item = T> + Clone,
        patch_of: impl Fn(&T) -> ScenePatch + Clone,
    ) -> impl Iterator<Item = (usize, T)> + Clone {
        let mut shown = self.shown().peekable();
        sorted.filter_map(move |item| {
            let patch = patch_of(&item);
            while shown.next_if(|lod| lod.patches.end() <= patch.0).is_some() {}
            let lod = shown.peek()?;
            lod.patches.has(patch).then_some((lod.instance, item))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::numbering::InstanceSize;

    fn scene() -> Numbering {
        let size = |patches: &[u32]| InstanceSize { patches: patches.to_vec(), ..InstanceSize::default() };
        Numbering::new(&[size(&[50, 20, 10]), size(&[0]), size(&[7]), size(&[50, 20, 10])])
    }

    fn choice(shown: usize, next: Option<usize>) -> Option<LodChoice> {
        Some(LodChoice { shown, next })
    }

    #[test]
    fn entries_of_the_lod_set_have_no_gaps() {
        let scene = scene();
        let lods = LodSet::new(&scene, [choice(1, None), choice(0, None), None, choice(2, Some(1))]);
        let entries: Vec<_> = lods.all().iter().map(|lod| (lod.instance, lod.lod, lod.entries())).collect();
        assert_eq!(entries, [(0, 1, 0..20), (3, 1, 20..40), (3, 2, 40..50)]);
        assert_eq!(lods.entries(), 50);
        assert!(lods.entries() <= scene.totals.in_lod_set as usize);
    }

    #[test]
    fn next_lods_are_drawn_in_a_second_scene() {
        let scene = scene();
        let drawn = |lods: &LodSet, is_drawn: &dyn Fn(usize) -> bool| -> Vec<Vec<(usize, usize)>> {
            let plain = |lods: &Vec<LodInstance>| lods.iter().map(|lod| (lod.instance, lod.lod)).collect();
            let mut scenes = [Vec::new(), Vec::new()];
            lods.scenes(&mut scenes, is_drawn);
            scenes.iter().filter(|lods| !lods.is_empty()).map(plain).collect()
        };
        let of = |lods: &LodSet| drawn(lods, &|_| true);
        let mut lods = LodSet::new(&scene, [choice(1, None), None, choice(0, None), choice(2, Some(0))]);
        assert_eq!(drawn(&lods, &|instance| instance != 3), [[(0, 1), (2, 0)]], "nothing else comes");
        assert_eq!(of(&lods), [[(0, 1), (2, 0), (3, 2)], [(0, 1), (2, 0), (3, 0)]]);
        lods.switch(3);
        assert_eq!(lods.shown().map(|lod| lod.lod).collect::<Vec<_>>(), [1, 0, 0]);
        let lods = LodSet::new(&scene, [choice(1, None), None, None, None]);
        assert_eq!(of(&lods), [[(0, 1)]]);
    }

    #[test]
    fn coarser_lods_are_distinguished_from_finer() {
        let lods = LodSet::new(&scene(), [choice(1, Some(0)), None, choice(0, None), choice(0, Some(2))]);
        let coarser: Vec<_> = lods.coarser().map(|lod| (lod.instance, lod.lod)).collect();
        assert_eq!(coarser, [(3, 2)]);
        let lods = LodSet::new(&scene(), [None, choice(0, Some(0)), choice(1, Some(0)), None]);
        assert_eq!(lods.coarser().map(|lod| lod.instance).collect::<Vec<_>>(), [2], "nothing was shown");
    }

    #[test]
    fn patches_of_lods_that_are_not_shown_are_left_out() {
        let lods = LodSet::new(&scene(), [choice(1, Some(0)), None, None, choice(2, None)]);
        let patches: Vec<_> = (0..167).map(ScenePatch).collect();
        let shown: Vec<_> = lods.shown_of(&patches).collect();
        let expected = (50..70).map(|patch| (0, ScenePatch(patch)));
        assert!(shown.into_iter().eq(expected.chain((157..167).map(|patch| (3, ScenePatch(patch))))));
    }
}

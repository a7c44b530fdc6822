//! What an update looks at: instances at levels of detail, and where each of their patches has its entry in `visible`. Pure.
//!
//! Entries are numbered anew with each update, over what is looked at alone: what the CPU reads of them grows with what is drawn,
//! not with the scene.

use crate::scene::numbering::{Numbering, PatchRange, ScenePatch};
use std::ops::Range;

/// The levels of an instance that an update looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Levels {
    /// What the client shows.
    pub shown: usize,
    /// What it is to show instead as soon as all of it is there that is seen.
    pub next: Option<usize>,
}

/// An instance at a level of detail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Look {
    /// Number of the instance in the scene.
    pub instance: usize,
    /// The level of detail.
    pub level: usize,
    /// Its patches.
    pub patches: PatchRange,
    /// Entry of the first of them.
    pub first_entry: u32,
    /// Whether the client shows this level with this update; if not, it is to be the next.
    pub is_shown: bool,
}

impl Look {
    /// Entries of its patches.
    pub fn entries(&self) -> Range<usize> {
        let first = self.first_entry as usize;
        first..first + self.patches.count as usize
    }
}

/// All that one update looks at.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Looks {
    /// Ascending by instance and level, and so by patch.
    looks: Vec<Look>,
}

impl Looks {
    /// The instances that have levels, given in their order.
    pub fn new(numbering: &Numbering, levels: impl IntoIterator<Item = Option<Levels>>) -> Self {
        let mut looks = Self::default();
        looks.refill(numbering, levels);
        looks
    }

    /// The same in the memory of another update's.
    pub(crate) fn refill(&mut self, numbering: &Numbering, levels: impl IntoIterator<Item = Option<Levels>>) {
        self.looks.clear();
        for (instance, Levels { shown, next }) in
            levels.into_iter().enumerate().filter_map(|(instance, levels)| Some((instance, levels?)))
        {
            let mut both = [Some((shown, true)), next.map(|next| (next, false))];
            both.sort_unstable();
            for (level, is_shown) in both.into_iter().flatten() {
                if let Some(patches) = numbering.patches(instance, level) {
                    self.add(instance, level, patches, is_shown);
                }
            }
        }
    }

    /// All patches of one instance of one level.
    #[cfg(test)]
    pub(crate) fn of_one(patches: u32) -> Self {
        let mut looks = Self::default();
        looks.add(0, 0, PatchRange { first: ScenePatch(0), count: patches }, true);
        looks
    }

    fn add(&mut self, instance: usize, level: usize, patches: PatchRange, is_shown: bool) {
        let first_entry = self.entries() as u32;
        self.looks.push(Look { instance, level, patches, first_entry, is_shown });
    }

    /// All of them, ascending by patch.
    pub fn all(&self) -> &[Look] {
        &self.looks
    }

    /// How many entries there are.
    pub fn entries(&self) -> usize {
        self.looks.last().map_or(0, |last| last.entries().end)
    }

    /// The levels that the client shows, ascending.
    pub fn shown(&self) -> impl Iterator<Item = &Look> + Clone {
        self.looks.iter().filter(|look| look.is_shown)
    }

    /// The levels that are to be shown next, where these are others.
    pub fn next(&self) -> impl Iterator<Item = &Look> + Clone {
        self.looks.iter().filter(|look| !look.is_shown)
    }

    /// Of these those that are coarser than what is shown of their instance, or where nothing is.
    pub fn coarser(&self) -> impl Iterator<Item = &Look> {
        self.next().filter(|look| self.level_shown(look.instance) < Some(look.level))
    }

    fn level_shown(&self, instance: usize) -> Option<usize> {
        let first = self.looks.partition_point(|look| look.instance < instance);
        let mut levels = self.looks[first..].iter().take_while(|look| look.instance == instance);
        levels.find(|look| look.is_shown).map(|look| look.level)
    }

    /// The scene as the client shows it, and, where that differs, as it is to be next: each of them one look an instance, of those
    /// that are drawn. The second is empty where it does not differ.
    pub fn scenes(&self, [now, next]: &mut [Vec<Look>; 2], is_drawn: impl Fn(usize) -> bool) {
        let drawn = |look: &&Look| is_drawn(look.instance);
        now.clear();
        next.clear();
        now.extend(self.shown().filter(drawn));
        if !self.next().any(|look| drawn(&look)) {
            return;
        }
        next.extend_from_slice(now);
        for look in self.next().filter(drawn) {
            match next.binary_search_by_key(&look.instance, |look| look.instance) {
                Ok(at) => next[at] = *look,
                Err(at) => next.insert(at, *look),
            }
        }
    }

    /// The client shows the next level of an instance from this update on.
    pub fn switch(&mut self, instance: usize) {
        self.looks.iter_mut().filter(|look| look.instance == instance).for_each(|look| look.is_shown ^= true);
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
            while shown.next_if(|look| look.patches.end() <= patch.0).is_some() {}
            let look = shown.peek()?;
            look.patches.has(patch).then_some((look.instance, item))
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

    fn levels(shown: usize, next: Option<usize>) -> Option<Levels> {
        Some(Levels { shown, next })
    }

    #[test]
    fn entries_are_those_of_what_is_looked_at_without_gaps() {
        let scene = scene();
        let looks = Looks::new(&scene, [levels(1, None), levels(0, None), None, levels(2, Some(1))]);
        let entries: Vec<_> =
            looks.all().iter().map(|look| (look.instance, look.level, look.entries())).collect();
        assert_eq!(entries, [(0, 1, 0..20), (3, 1, 20..40), (3, 2, 40..50)]);
        assert_eq!(looks.entries(), 50);
        assert!(looks.entries() <= scene.totals.looked_at as usize);
    }

    #[test]
    fn what_is_to_be_shown_next_is_looked_at_in_a_scene_of_its_own() {
        let scene = scene();
        let drawn = |looks: &Looks, is_drawn: &dyn Fn(usize) -> bool| -> Vec<Vec<(usize, usize)>> {
            let plain = |looks: &Vec<Look>| looks.iter().map(|look| (look.instance, look.level)).collect();
            let mut scenes = [Vec::new(), Vec::new()];
            looks.scenes(&mut scenes, is_drawn);
            scenes.iter().filter(|looks| !looks.is_empty()).map(plain).collect()
        };
        let of = |looks: &Looks| drawn(looks, &|_| true);
        let mut looks = Looks::new(&scene, [levels(1, None), None, levels(0, None), levels(2, Some(0))]);
        assert_eq!(drawn(&looks, &|instance| instance != 3), [[(0, 1), (2, 0)]], "nothing else comes");
        assert_eq!(of(&looks), [[(0, 1), (2, 0), (3, 2)], [(0, 1), (2, 0), (3, 0)]]);
        looks.switch(3);
        assert_eq!(looks.shown().map(|look| look.level).collect::<Vec<_>>(), [1, 0, 0]);
        let looks = Looks::new(&scene, [levels(1, None), None, None, None]);
        assert_eq!(of(&looks), [[(0, 1)]]);
    }

    #[test]
    fn what_is_to_be_coarser_is_told_from_what_is_to_be_finer() {
        let looks = Looks::new(&scene(), [levels(1, Some(0)), None, levels(0, None), levels(0, Some(2))]);
        let coarser: Vec<_> = looks.coarser().map(|look| (look.instance, look.level)).collect();
        assert_eq!(coarser, [(3, 2)]);
        let looks = Looks::new(&scene(), [None, levels(0, Some(0)), levels(1, Some(0)), None]);
        assert_eq!(looks.coarser().map(|look| look.instance).collect::<Vec<_>>(), [2], "nothing was shown");
    }

    #[test]
    fn patches_of_levels_that_are_not_shown_are_left_out() {
        let looks = Looks::new(&scene(), [levels(1, Some(0)), None, None, levels(2, None)]);
        let patches: Vec<_> = (0..167).map(ScenePatch).collect();
        let shown: Vec<_> = looks.shown_of(&patches).collect();
        let expected = (50..70).map(|patch| (0, ScenePatch(patch)));
        assert!(shown.into_iter().eq(expected.chain((157..167).map(|patch| (3, ScenePatch(patch))))));
    }
}

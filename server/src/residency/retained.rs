//! Patches in a client's memory without a block, by the update of the loss. Pure.

use crate::scene::numbering::ScenePatch;
use shadecast_protocol::ids::UpdateId;
use std::collections::VecDeque;

/// See the module.
#[derive(Debug)]
pub(crate) struct Retained {
    /// By [`ScenePatch`]; `None`: it is not retained.
    since: Vec<Option<UpdateId>>,
    /// All of them, the oldest first, and some that are not retained any more, or since later.
    queue: VecDeque<(UpdateId, ScenePatch)>,
}

impl Retained {
    /// None of so many.
    pub(crate) fn new(patches: usize) -> Self {
        Self { since: vec![None; patches], queue: VecDeque::new() }
    }

    /// It is retained since this update, which is no earlier than those before.
    pub(crate) fn insert(&mut self, patch: ScenePatch, update: UpdateId) {
        if self.since[patch.index()].replace(update) != Some(update) {
            self.queue.push_back((update, patch));
        }
    }

    /// The same, if it is retained.
    pub(crate) fn renew(&mut self, patch: ScenePatch, update: UpdateId) {
        if self.since[patch.index()].is_some() {
            self.insert(patch, update);
        }
    }

    /// It is not retained any more, if it was.
    pub(crate) fn remove(&mut self, patch: ScenePatch) {
        self.since[patch.index()] = None;
    }

    /// Takes out one that is retained since before this update.
    pub(crate) fn pop_before(&mut self, update: UpdateId) -> Option<ScenePatch> {
        while let Some((since, patch)) = self.queue.pop_front_if(|(since, _)| *since < update) {
            let known = &mut self.since[patch.index()];
            if *known == Some(since) {
                *known = None;
                return Some(patch);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};
    use std::collections::BTreeMap;

    #[test]
    fn it_holds_what_a_map_holds() {
        const PATCHES: u32 = 20;
        let mut rng = SmallRng::seed_from_u64(5);
        let (mut retained, mut map) = (Retained::new(PATCHES as usize), BTreeMap::new());
        for update in (0..3000).map(UpdateId) {
            for _ in 0..rng.random_range(0..4) {
                let patch = ScenePatch(rng.random_range(0..PATCHES));
                match rng.random_range(0..3) {
                    0 => {
                        retained.insert(patch, update);
                        map.insert(patch, update);
                    }
                    1 => {
                        retained.remove(patch);
                        map.remove(&patch);
                    }
                    _ => {
                        retained.renew(patch, update);
                        map.get_mut(&patch).into_iter().for_each(|since| *since = update);
                    }
                }
            }
            let before = UpdateId(update.0.saturating_sub(rng.random_range(0..9)));
            let mut old: Vec<_> = std::iter::from_fn(|| retained.pop_before(before)).collect();
            old.sort_unstable();
            let expected: Vec<_> =
                map.extract_if(.., |_, since| *since < before).map(|(patch, _)| patch).collect();
            assert_eq!(old, expected, "update {}", update.0);
        }
    }
}

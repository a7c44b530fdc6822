//! How large a block is to be: from the extent of its patch and the texels that are asked for a pixel, with hysteresis. Pure.
//!
//! Texels for a pixel change for all blocks at once, blocks only a few at a time: each follows what was asked for when it was its
//! turn, and meanwhile changes by itself only where both that and what is asked for now would have it so.

use crate::scene::numbering::ScenePatch;
use crate::support::least::sort_while;
use shadecast_protocol::atlas::BlockSize;
use shadecast_protocol::limits::{BLOCK_INSET_TEXELS, BLOCK_MAX_LOG2, BLOCK_MIN_LOG2};

/// A block grows only when the extent is larger by this factor than what its size is chosen for.
const GROW_BEYOND: f32 = 1.05;
/// A block shrinks only when the extent has fallen under this part of what the next smaller size is chosen for.
const SHRINK_BELOW: f32 = 0.8;
/// Part of all blocks in view that change their size in one update, those included that do so by themselves.
const CHANGED_SHARE: f32 = 0.04;
/// As many have their turn at least, whatever changes by itself.
const LEAST_TURNS_SHARE: f32 = 0.01;

/// The block for a patch of `extent` texels, whose sides are rounded up to powers of two. A block that the patch has already
/// changes its size only when the extent is clearly larger or smaller than what that size is for.
pub(crate) fn wanted_size(extent: [f32; 2], current: Option<BlockSize>) -> BlockSize {
    let side = |texels: f32, current: Option<u8>| {
        let needed = texels + 2.0 * BLOCK_INSET_TEXELS;
        match current {
            Some(now)
                if side_log2(needed / GROW_BEYOND) <= now && now <= side_log2(needed / SHRINK_BELOW) =>
            {
                now
            }
            _ => side_log2(needed),
        }
    };
    BlockSize {
        width_log2: side(extent[0], current.map(|c| c.width_log2)),
        height_log2: side(extent[1], current.map(|c| c.height_log2)),
    }
}

/// The exponent of the side for so many texels, inset included.
fn side_log2(needed_texels: f32) -> u8 {
    // The least power of two that is no smaller, read from the bits of the number: a logarithm takes a tenth of placing all blocks.
    let bits = needed_texels.max(1.0).to_bits();
    let (exponent, is_power) = ((bits >> 23) - 127, bits & ((1 << 23) - 1) == 0);
    (exponent + u32::from(!is_power)).clamp(BLOCK_MIN_LOG2, BLOCK_MAX_LOG2) as u8
}

/// What a patch's views show, and the block that it has.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shape {
    /// Width and height in texels, at so many texels for a pixel.
    pub extent: [u16; 2],
    /// Texels for a pixel of that extent.
    pub extent_density: f32,
    /// Its block in view, and the texels for a pixel that it follows.
    pub block: Option<(BlockSize, f32)>,
}

/// What becomes of the block of a patch in view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Turn {
    /// The patch.
    pub patch: ScenePatch,
    /// Its size until now; `None`: it was not in view.
    pub now: Option<BlockSize>,
    /// What it is to be before its turn.
    pub before: BlockSize,
    /// What it is to be from its turn on.
    pub after: BlockSize,
    /// What would do after its turn at the least.
    pub least: BlockSize,
    /// Texels of its extent, for who comes first.
    pub area_texels: u32,
}

impl Shape {
    /// The extent at so many texels for a pixel.
    pub(crate) fn extent_at(&self, density: f32) -> [f32; 2] {
        self.extent.map(|side| f32::from(side) * density / self.extent_density)
    }

    /// What becomes of its block where so many texels are asked for a pixel. A new one begins with this part of them.
    pub(crate) fn turn(&self, patch: ScenePatch, density: f32, new_part: f32) -> Turn {
        let exact = wanted_size(self.extent_at(density), None);
        let area_texels = u32::from(self.extent[0]) * u32::from(self.extent[1]);
        let Some((now, follows)) = self.block else {
            let before = wanted_size(self.extent_at(density * new_part), None);
            return Turn { patch, now: None, before, after: exact, least: before, area_texels };
        };
        let at = |density: f32, more: f32| {
            let extent = self.extent_at(density).map(|side| (side + more).max(0.0));
            wanted_size(extent, Some(now))
        };
        // Extents are rounded up, at either density another way: a texel less or more is no reason to change.
        let slack =
            if follows == density { 0.0 } else { (density.max(follows) / self.extent_density).max(1.0) };
        let (low, high) = (at(follows.min(density), -slack), at(follows.max(density), slack));
        let before = sides(now, |now, side| now.clamp(side(low), side(high).max(side(low))));
        let least = sides(before, |before, side| before.min(side(exact)));
        let after = if density < follows { least } else { at(density, 0.0) };
        Turn { patch, now: Some(now), before, after, least, area_texels }
    }
}

impl Turn {
    /// Whether its block changes before its turn.
    pub(crate) fn changes_by_itself(&self) -> bool {
        self.now.is_some_and(|now| now != self.before)
    }

    /// Texels that it gives up where it must do with the least.
    pub(crate) fn spare_texels(&self) -> u64 {
        u64::from(self.before.texels() - self.least.texels())
    }
}

/// The same for both sides of a size.
fn sides(size: BlockSize, of: impl Fn(u8, &dyn Fn(BlockSize) -> u8) -> u8) -> BlockSize {
    BlockSize {
        width_log2: of(size.width_log2, &|size: BlockSize| size.width_log2),
        height_log2: of(size.height_log2, &|size: BlockSize| size.height_log2),
    }
}

/// `chosen` becomes those of all that wait for their turn that have it with this update, ascending; gives whether these are all: so
/// many that no more than 4 % change, who gives up texels before who gets some, and the nearest first. They have no more than
/// `most_texels` together, or are one.
pub(crate) fn have_their_turn(turns: &[Turn], most_texels: u64, chosen: &mut Vec<Turn>) -> bool {
    chosen.clear();
    chosen.extend(turns.iter().filter(|turn| turn.now.is_some() && turn.before != turn.after));
    let by_themselves = turns.iter().filter(|turn| turn.changes_by_itself()).count();
    let most = ((turns.len() as f32 * CHANGED_SHARE) as usize).saturating_sub(by_themselves);
    let most = most.max(least_turns(turns.len()));
    let grows = |turn: &Turn| turn.after.texels() > turn.before.texels();
    let (mut left, mut texels) = (most, 0);
    let fits = |turn: &Turn| {
        let is_first = texels == 0;
        texels += u64::from(turn.after.texels());
        let has_turn = left > 0 && (is_first || texels <= most_texels);
        left = left.saturating_sub(1);
        has_turn
    };
    let rank = |turn: &Turn| (grows(turn), std::cmp::Reverse(turn.area_texels), turn.patch);
    let have_it = sort_while(chosen, rank, fits);
    let are_all = chosen.len() <= have_it;
    chosen.truncate(have_it);
    chosen.sort_unstable_by_key(|turn| turn.patch);
    are_all
}

/// Of so many blocks.
pub(crate) fn least_turns(blocks: usize) -> usize {
    ((blocks as f32 * LEAST_TURNS_SHARE) as usize).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_side_has_as_many_texels_as_it_needs_inset_included() {
        for log2 in 3..9u8 {
            let side = (1u32 << log2) as f32;
            assert_eq!((side_log2(side), side_log2(side + 0.5)), (log2, (log2 + 1).min(9)));
        }
    }

    fn size(side: f32) -> BlockSize {
        wanted_size([side; 2], None)
    }

    /// Of a patch of so many texels at density 1, which has a block for `follows`.
    fn turn(side: u16, follows: f32, density: f32) -> Turn {
        let block = Some((size(f32::from(side) * follows), follows));
        Shape { extent: [side; 2], extent_density: 1.0, block }.turn(ScenePatch(3), density, 1.0)
    }

    #[test]
    fn a_block_waits_for_its_turn_and_then_has_what_is_asked_for() {
        for side in 5..100 {
            for (follows, density) in [(1.0, 2.0), (2.0, 1.0), (1.0, 1.414), (1.0, 0.92)] {
                let turn = turn(side, follows, density);
                assert!(!turn.changes_by_itself(), "{turn:?}");
                let asked = size(f32::from(side) * density).width_log2;
                let grown = asked..=asked + u8::from(density > follows);
                assert!(
                    grown.contains(&turn.after.width_log2) || turn.after.width_log2 + 1 == asked,
                    "{turn:?}"
                );
                assert!(density > follows || turn.after == size(f32::from(side) * density), "{turn:?}");
            }
        }
    }

    #[test]
    fn a_new_block_may_begin_small_and_then_waits_for_its_turn() {
        let shape = |block| Shape { extent: [50; 2], extent_density: 1.0, block };
        let new = shape(None).turn(ScenePatch(3), 1.0, 0.5);
        assert_eq!((new.before, new.after), (size(25.0), size(50.0)));
        let mut chosen = Vec::new();
        assert!(have_their_turn(&[new], u64::MAX, &mut chosen) && chosen.is_empty(), "not at once");
        let next = shape(Some((new.before, 0.5))).turn(ScenePatch(3), 1.0, 0.5);
        assert_eq!((next.before, next.after), (size(25.0), size(50.0)));
        assert!(have_their_turn(&[next], u64::MAX, &mut chosen) && chosen == [next]);
    }

    #[test]
    fn an_extent_that_changes_by_itself_waits_for_no_turn() {
        let of = |extent: u16, density: f32| {
            let block = Some((size(20.0), 1.0));
            Shape { extent: [extent; 2], extent_density: 1.0, block }.turn(ScenePatch(3), density, 1.0).before
        };
        assert_eq!([of(20, 2.0), of(20, 0.5)], [size(20.0); 2]);
        assert_eq!([of(60, 2.0), of(5, 0.5)], [size(60.0), size(5.0)], "by what it follows");
        assert_eq!([of(60, 0.25), of(5, 4.0)], [size(20.0); 2], "what is asked for has it otherwise");
    }

    #[test]
    fn few_have_their_turn_at_a_time_the_nearest_first_and_what_gives_up_texels_before() {
        let all: Vec<Turn> = (0..100u16)
            .map(|patch| {
                let side = if patch < 50 { 20 } else { 20 + patch % 8 };
                let (follows, density) = if patch < 3 { (4.0, 2.0) } else { (1.0, 2.0) };
                Turn { patch: ScenePatch(patch.into()), ..turn(side, follows, density) }
            })
            .collect();
        let chosen = |turns: &[Turn]| {
            let mut chosen = Vec::new();
            let are_all = have_their_turn(turns, u64::MAX, &mut chosen);
            (chosen.iter().map(|turn| turn.patch.0).collect::<Vec<_>>(), are_all)
        };
        assert_eq!(chosen(&all), (vec![0, 1, 2, 55], false));
        let mut changing = all.clone();
        changing[90..].iter_mut().for_each(|turn| turn.now = Some(size(200.0)));
        assert_eq!(chosen(&changing).0, [0], "others change by themselves");
    }

    #[test]
    fn blocks_that_change_have_few_texels_together_or_are_one() {
        let gives_up = Turn { patch: ScenePatch(0), ..turn(20, 4.0, 2.0) };
        let grows = (1..100u16).map(|patch| Turn { patch: ScenePatch(patch.into()), ..turn(20, 1.0, 2.0) });
        let all: Vec<Turn> = std::iter::once(gives_up).chain(grows).collect();
        let [first, each] = [&all[0], &all[1]].map(|turn| u64::from(turn.after.texels()));
        let most = [0, first, first + each, first + 2 * each, first + 3 * each - 1, u64::MAX];
        for (most_texels, count) in most.into_iter().zip([1, 1, 2, 3, 3, 4]) {
            let mut chosen = Vec::new();
            assert!(!have_their_turn(&all, most_texels, &mut chosen), "{most_texels}");
            assert_eq!((chosen[0], chosen.len()), (gives_up, count), "{most_texels}");
        }
    }
}

//! Level selection's second half: from projected extents to block sizes, with hysteresis, and the placement of the
//! resulting blocks in the atlas. Pure and total: a full atlas coarsens, it never fails.

use crate::atlas::Atlas;
use shadecast_protocol::atlas::{AtlasExtent, Block, BlockSize};
use shadecast_protocol::limits::{BLOCK_INSET_TEXELS, BLOCK_MAX_LOG2, BLOCK_MIN_LOG2, MAX_PATCH_SLOTS};

/// A patch that was seen stays for this many updates, so that what flickers at the limit of the ID buffer's sampling
/// does not flicker on the client.
pub const HOLD_UPDATES: u32 = 10;
/// A block shrinks only when the extent has fallen under this part of the next smaller size.
const SHRINK_BELOW: f32 = 0.8;
/// Sizes round up to a power of two only beyond this part of the way: a block may be a quarter smaller than its extent
/// before the next size, twice the texels, is taken. ARCHITECTURE.md has the measurement.
const ROUNDING: f32 = 0.8;
/// A full atlas multiplies texel density by this and tries again.
const COARSEN: f32 = 0.84;
/// With room to spare, density recovers by this per update.
const RECOVER: f32 = 1.01;
/// Room to spare: less than this part of the atlas in use.
const RECOVER_BELOW: f32 = 0.7;

/// A block that changed with this update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PlacementChange {
    /// Scene-wide patch number.
    pub patch: u32,
    /// Its block now; `None`: it has none any more.
    pub block: Option<Block>,
}

/// Which patch has which block.
#[derive(Clone, Debug)]
pub struct Layout {
    atlas: Atlas,
    states: Vec<State>,
    /// Patches with a block, ascending.
    live: Vec<u32>,
    density: f32,
    update: u32,
    coarsened: u32,
    dropped: u64,
}

#[derive(Clone, Copy, Debug, Default)]
struct State {
    block: Option<Block>,
    last_seen: u32,
    /// The latest extents, width and height in texels at density 1.
    extent: [u16; 2],
}

impl Layout {
    /// For `patches` patches in an empty atlas.
    pub fn new(atlas_extent: AtlasExtent, patches: usize) -> Self {
        Self {
            atlas: Atlas::new(atlas_extent),
            states: vec![State::default(); patches],
            live: Vec::new(),
            density: 1.0,
            update: 0,
            coarsened: 0,
            dropped: 0,
        }
    }

    /// Places the patches whose packed extents (see `level_selection.comp`) are not 0, and those seen within the last
    /// [`HOLD_UPDATES`]. Returns what changed, in patch order.
    pub fn place(&mut self, extents: &[u32]) -> Vec<PlacementChange> {
        assert_eq!(extents.len(), self.states.len(), "one extent per patch");
        self.update += 1;
        let before: Vec<u32> = std::mem::take(&mut self.live);
        let before: Vec<(u32, Option<Block>)> =
            before.into_iter().map(|patch| (patch, self.states[patch as usize].block)).collect();
        self.see(extents);
        self.release_unseen(&before);
        if self.used_share() < RECOVER_BELOW {
            self.density = (self.density * RECOVER).min(1.0);
        }
        while !self.try_place() {
            self.density *= COARSEN;
            self.coarsened += 1;
        }
        self.changes(&before)
    }

    fn see(&mut self, extents: &[u32]) {
        // At the coarsest every block is of the smallest size; more patches than that cannot have one.
        let [width, height] = self.atlas.extent_texels();
        let capacity = ((width * height) >> (2 * BLOCK_MIN_LOG2)).min(MAX_PATCH_SLOTS) as usize;
        for (patch, packed) in extents.iter().enumerate() {
            let state = &mut self.states[patch];
            if *packed != 0 {
                state.last_seen = self.update;
                state.extent = [*packed as u16, (packed >> 16) as u16];
            }
            let held = state.last_seen > 0 && self.update - state.last_seen <= HOLD_UPDATES;
            if held && self.live.len() < capacity {
                self.live.push(patch as u32);
            } else if held {
                self.dropped += 1;
            }
        }
    }

    fn release_unseen(&mut self, before: &[(u32, Option<Block>)]) {
        for (patch, block) in before {
            if self.live.binary_search(patch).is_err() {
                self.states[*patch as usize].block = None;
                block.iter().for_each(|b| self.atlas.free(*b));
            }
        }
    }

    /// One try at the current density: resizes what must be resized, then fills in what has no block.
    fn try_place(&mut self) -> bool {
        let mut waiting = Vec::new();
        for patch in &self.live {
            let state = &mut self.states[*patch as usize];
            let size = wanted_size(state.extent, state.block.map(|b| b.size), self.density);
            if state.block.is_none_or(|b| b.size != size) {
                state.block.take().into_iter().for_each(|b| self.atlas.free(b));
                waiting.push((*patch, size));
            }
        }
        // Large ones first: they are the hardest to place. Ties go in patch order, neighbours side by side.
        waiting.sort_by_key(|(patch, size)| (std::cmp::Reverse(size.texels()), *size, *patch));
        for (patch, size) in waiting {
            match self.atlas.allocate(size) {
                Some(block) => self.states[patch as usize].block = Some(block),
                None => return false,
            }
        }
        true
    }

    fn changes(&self, before: &[(u32, Option<Block>)]) -> Vec<PlacementChange> {
        let old = |patch: u32| {
            before.binary_search_by_key(&patch, |(p, _)| *p).ok().and_then(|index| before[index].1)
        };
        let gone = before
            .iter()
            .filter(|(patch, _)| self.live.binary_search(patch).is_err())
            .map(|(patch, _)| PlacementChange { patch: *patch, block: None });
        let moved = self
            .live
            .iter()
            .map(|patch| PlacementChange { patch: *patch, block: self.states[*patch as usize].block })
            .filter(|change| old(change.patch) != change.block);
        let mut changes: Vec<_> = gone.chain(moved).collect();
        changes.sort_by_key(|change| change.patch);
        changes
    }

    /// Patches with their blocks, ascending.
    pub fn live(&self) -> impl Iterator<Item = (u32, Block)> + '_ {
        self.live.iter().filter_map(|patch| Some((*patch, self.states[*patch as usize].block?)))
    }

    /// Patches with a block.
    pub fn live_count(&self) -> usize {
        self.live.len()
    }

    /// Part of the atlas inside blocks, 0..1.
    pub fn used_share(&self) -> f32 {
        let [width, height] = self.atlas.extent_texels();
        self.atlas.used_texels() as f32 / (width * height) as f32
    }

    /// Texels per pixel that blocks are sized for; below 1 under pressure.
    pub fn density(&self) -> f32 {
        self.density
    }

    /// How often the atlas was full and everything became coarser.
    pub fn coarsened(&self) -> u32 {
        self.coarsened
    }

    /// Patches not placed because the client's slots are too few, summed over all updates.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }
}

/// The block for a patch of `extent` texels: the next power of two that holds it inside the inset. A block that is
/// already larger shrinks only when the extent has become clearly smaller.
fn wanted_size(extent: [u16; 2], current: Option<BlockSize>, density: f32) -> BlockSize {
    let side = |texels: u16, current: Option<u8>| {
        let needed = f32::from(texels) * density + 2.0 * BLOCK_INSET_TEXELS as f32;
        let exact = log2_up(needed * ROUNDING);
        match current {
            // Pressure (density below 1) beats hysteresis: what must shrink, shrinks.
            Some(now)
                if density >= 1.0 && exact < now && log2_up(needed * ROUNDING / SHRINK_BELOW) >= now =>
            {
                now
            }
            _ => exact,
        }
    };
    BlockSize {
        width_log2: side(extent[0], current.map(|c| c.width_log2)),
        height_log2: side(extent[1], current.map(|c| c.height_log2)),
    }
}

fn log2_up(texels: f32) -> u8 {
    (texels.max(1.0).log2().ceil() as u8).clamp(BLOCK_MIN_LOG2 as u8, BLOCK_MAX_LOG2 as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pack(width: u32, height: u32) -> u32 {
        width | height << 16
    }

    fn random_extents(seed: u64, patches: usize, largest: u64) -> Vec<u32> {
        let mut state = seed;
        (0..patches)
            .map(|_| {
                state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
                let visible = state >> 60 > 4;
                let side = |shift: u32| (1 + (state >> shift) % largest) as u32;
                if visible { pack(side(20), side(36)) } else { 0 }
            })
            .collect()
    }

    fn assert_sound(layout: &Layout, extents: &[u32]) {
        let blocks: Vec<_> = layout.live().collect();
        assert_eq!(blocks.len(), layout.live_count(), "every live patch has a block");
        for (patch, packed) in extents.iter().enumerate() {
            let has = blocks.binary_search_by_key(&(patch as u32), |(p, _)| *p).is_ok();
            assert!(*packed == 0 || has, "patch {patch} is visible and has no block");
        }
        let used: u64 = blocks.iter().map(|(_, b)| u64::from(b.size.texels())).sum();
        assert_eq!(used, layout.atlas.used_texels());
    }

    #[test]
    fn unchanged_patch_and_level_keep_their_block() {
        let mut layout = Layout::new(AtlasExtent::MIN, 200);
        let mut extents = random_extents(3, 200, 20);
        layout.place(&extents);
        let before: Vec<_> = layout.live().filter(|(patch, _)| *patch != 7).collect();
        extents[7] = pack(60, 3);
        layout.place(&extents);
        assert!(before.iter().all(|b| layout.live().any(|now| now == *b)));
    }

    #[test]
    fn a_full_atlas_coarsens_and_places_everything_that_is_visible() {
        let mut layout = Layout::new(AtlasExtent::MIN, 3000);
        for seed in 0..12 {
            let extents = random_extents(seed, 3000, 90);
            layout.place(&extents);
            assert_sound(&layout, &extents);
        }
        assert!(layout.coarsened() > 0 && layout.density() < 1.0);
    }

    #[test]
    fn the_first_forced_coarsening_finds_the_atlas_well_used() {
        let mut layout = Layout::new(AtlasExtent::new(1024, 1024).unwrap(), 4000);
        let mut share = 0.0;
        for count in (100..4000).step_by(100) {
            let mut extents = random_extents(5, 4000, 40);
            extents[count..].fill(0);
            layout.place(&extents);
            if layout.coarsened() > 0 {
                break;
            }
            share = layout.used_share();
        }
        println!("atlas use before the first coarsening: {:.1} %", share * 100.0);
        assert!(layout.coarsened() > 0 && share >= 0.85, "{share}");
    }

    #[test]
    fn a_patch_out_of_sight_stays_for_the_hold_and_then_goes() {
        let mut layout = Layout::new(AtlasExtent::MIN, 3);
        layout.place(&[pack(9, 9), 0, 0]);
        for _ in 0..HOLD_UPDATES {
            assert!(layout.place(&[0, 0, 0]).is_empty());
        }
        assert_eq!(layout.place(&[0, 0, 0]), [PlacementChange { patch: 0, block: None }]);
        assert_eq!(layout.live_count(), 0);
    }

    #[test]
    fn an_extent_that_trembles_at_a_power_of_two_does_not_change_its_block() {
        let mut layout = Layout::new(AtlasExtent::MIN, 1);
        layout.place(&[pack(14, 15)]);
        for step in 0..20 {
            let extent = if step % 2 == 0 { 14 } else { 13 };
            assert!(layout.place(&[pack(extent, 15 - step % 3)]).is_empty());
        }
        assert_eq!(layout.place(&[pack(4, 4)]).len(), 1, "clearly smaller shrinks");
    }

    #[test]
    fn what_changed_is_exactly_what_the_blocks_say() {
        let mut layout = Layout::new(AtlasExtent::MIN, 1500);
        let mut mirror: std::collections::BTreeMap<u32, Block> = Default::default();
        for seed in 0..40 {
            for change in layout.place(&random_extents(seed, 1500, 60)) {
                match change.block {
                    Some(block) => mirror.insert(change.patch, block),
                    None => mirror.remove(&change.patch),
                };
            }
            assert!(layout.live().eq(mirror.iter().map(|(p, b)| (*p, *b))), "seed {seed}");
        }
    }
}

//! The texel density of the layout: it falls when blocks fill the atlas, and rises once there has been room for a while.

use super::Layout;
use crate::atlas::sizing::wanted_size;
use crate::pacing::pressure::Coarseness;
use crate::scene::numbering::ScenePatch;

/// Densities under pressure: each is this part of the one above.
const COARSEN: f32 = 0.96;
/// Blocks in view may take this part of the atlas: beyond it density falls.
const WELL_FILLED: f32 = 0.9;
/// A higher density must leave the blocks at most this part of what found no place when density fell. Far enough from
/// 1 that extents which tremble by a few percent stay on one density.
const ROOMY: f32 = 0.85;
/// What found no place because free texels were scattered says little: it counts as at least this part of the atlas.
const LEAST_OVERFLOW_SHARE: f32 = 0.8;

/// Of the texels for a pixel that are asked for, a part.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct DensityStep(pub f32);

impl DensityStep {
    pub(super) fn coarser(self) -> Self {
        Self(self.0 * COARSEN)
    }
}

impl Coarseness for DensityStep {
    fn finer(self) -> Option<Self> {
        (self.0 < 1.0).then(|| Self((self.0 / COARSEN).min(1.0)))
    }
}

/// Whether a block keeps its size while that will do, or takes the size that its extent alone asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sizes {
    Kept,
    Exact,
}

impl Layout {
    /// Part of the atlas that what is in view may take.
    pub(super) fn limit(&self) -> f32 {
        1.0 - self.share(self.around.iter().map(|(_, size)| u64::from(size.texels())).sum())
    }

    /// Of that, what density is chosen for.
    pub(super) fn well_filled(&self) -> f32 {
        self.limit().min(WELL_FILLED)
    }

    /// Part of the atlas inside blocks of what is in view.
    pub(super) fn in_view_share(&self) -> f32 {
        let block = |patch: &ScenePatch| self.states[patch.index()].block;
        self.share(self.live.iter().filter_map(block).map(|block| u64::from(block.size.texels())).sum())
    }

    /// Takes the highest density that leaves room, once there has been room for a higher one for a while.
    pub(super) fn recover(&mut self) {
        let mut pressure = self.pressure;
        if pressure.recover(self.update, |density| self.is_roomy(density)) {
            self.share_at_rise = self.share_at(pressure.step(), Sizes::Kept);
        }
        self.pressure = pressure;
    }

    fn is_roomy(&self, density: DensityStep) -> bool {
        let allowed = ROOMY * self.overflow_share.min(self.well_filled());
        let fits = |sizes| self.share_at(density, sizes) <= allowed;
        // Blocks that keep their size now may still grow to the exact one.
        self.in_view_share() <= allowed && fits(Sizes::Kept) && fits(Sizes::Exact)
    }

    /// Part of the atlas that what is in view would take at a density.
    pub(super) fn share_at(&self, density: DensityStep, sizes: Sizes) -> f32 {
        let texels = |patch: &ScenePatch| {
            let shape = self.shape(*patch);
            let now = shape.block.filter(|_| sizes == Sizes::Kept).map(|(size, _)| size);
            u64::from(wanted_size(shape.extent_at(self.asked * density.0), now).texels())
        };
        self.share(self.live.iter().map(texels).sum())
    }

    /// Density falls; sizes follow in turn.
    pub(super) fn fall(&mut self, share: f32) {
        self.coarsened += 1;
        let is_within_trial = self.pressure.rise(self.update, self.pressure.step().coarser());
        self.overflow_share = share.clamp(LEAST_OVERFLOW_SHARE, 1.0);
        if is_within_trial {
            self.overflow_share = self.overflow_share.min(self.share_at_rise);
        }
    }
}

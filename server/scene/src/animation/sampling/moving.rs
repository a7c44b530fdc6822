//! A moving curve in several fits, and the choice of error-bounded sampling for it.

use super::SampledTrack;
use super::curve::Curve;
use super::fit::fit;

/// How far each curve alone may move a vertex, in parts of the bound, in its several fits; the last is as good as
/// exact.
const LEVELS: [f32; 10] = [1.5, 0.95, 0.6, 0.38, 0.24, 0.15, 0.09, 0.05, 0.02, 0.001];

/// Which curve of the clip.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Place {
    /// A bone's translation (0), rotation (1) or scale (2).
    Bone(usize, usize),
    Morph(usize),
}

/// A curve that moves.
pub(super) struct Moving {
    pub place: Place,
    /// Times at which the curve was looked at, seconds.
    pub times_s: Vec<f32>,
    /// From the coarsest to the finest: each takes more bytes than the one before.
    pub fits: Vec<Fit>,
    /// Which of them is used.
    pub chosen: usize,
    arm_m: f32,
}

/// One fit of a curve, which nowhere errs by more than its tolerance.
pub(super) struct Fit {
    pub tolerance: f32,
    pub byte_count: f32,
    pub track: SampledTrack,
}

impl Moving {
    /// `arm_m`: metres that a vertex moves at most per unit of error; `ceiling`: the largest tolerance in any case.
    pub fn new(place: Place, curve: Curve, arm_m: f32, bound_m: f32, ceiling: f32) -> Self {
        let mut fits: Vec<Fit> = Vec::new();
        for level in LEVELS {
            let tolerance = (level * bound_m / arm_m.max(1e-12)).min(ceiling);
            if fits.last().is_none_or(|fit| fit.tolerance != tolerance) {
                let track = fit(&curve, tolerance);
                let byte_count = track.byte_count() as f32;
                // What errs more and takes as much is of no use.
                while fits.pop_if(|coarser| coarser.byte_count >= byte_count).is_some() {}
                fits.push(Fit { tolerance, byte_count, track });
            }
        }
        Self { place, times_s: curve.times_s, fits, chosen: 0, arm_m }
    }

    /// The coarsest fit that alone moves no vertex by more than this.
    pub fn start_at(&mut self, error_m: f32) {
        let fine = self.fits.iter().position(|fit| fit.tolerance * self.arm_m <= error_m);
        self.chosen = fine.unwrap_or(self.fits.len() - 1);
    }

    /// Bytes that the next coarser fit saves for each metre that it may err more; `None` for the coarsest.
    pub fn saving(&self) -> Option<f32> {
        let (now, coarser) = (&self.fits[self.chosen], &self.fits[self.chosen.checked_sub(1)?]);
        let error_m = (coarser.tolerance - now.tolerance) * self.arm_m;
        Some((now.byte_count - coarser.byte_count) / error_m.max(1e-12))
    }

    /// Takes the fit of which bytes, and what is charged per unit of error, are least.
    pub fn choose(&mut self, charge: f32) {
        let cost = |index: &usize| self.fits[*index].byte_count + charge * self.fits[*index].tolerance;
        let best = (0..self.fits.len()).min_by(|a, b| cost(a).total_cmp(&cost(b)));
        self.chosen = best.expect("there is at least one level");
    }

    /// What the chosen fit errs at most.
    pub fn tolerance(&self) -> f32 {
        self.fits[self.chosen].tolerance
    }

    /// What the next finer fit errs less for each byte more; `None` for the finest.
    pub fn gain(&self) -> Option<f32> {
        let (now, finer) = (&self.fits[self.chosen], self.fits.get(self.chosen + 1)?);
        Some((now.tolerance - finer.tolerance) / (finer.byte_count - now.byte_count).max(1.0))
    }
}

//! Possible changes of the sun's shadows since the previous update: the area that moving casters can darken, as seen from the
//! sun. Pure.
//!
//! A coarse grid over the sun's view stores the smallest distance of any moving caster from the sun per cell. Deeper surfaces
//! may be darker or lighter than before. A query costs the cells under a patch, however many casters move.

use crate::scene::lights::SunView;
use glam::{Vec2, Vec3, Vec3Swizzles};

/// Cells of a side of the sun's view.
const CELLS: usize = 64;
/// Texels of the shadow map by which a place of a surface looks aside: 3.33 along its normal, 2.5 by the filter, and half of one
/// that casters are rounded by; see `shadow.glsl`.
const FILTER_TEXELS: f32 = 6.5;

/// A box as the sun sees it: x and y 0 to 1 over the map, z 1 nearest to the sun.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct SunBox {
    low: Vec3,
    high: Vec3,
}

impl SunBox {
    /// Around points of the world; `None` around nothing.
    pub(crate) fn around(sun: &SunView, points: impl IntoIterator<Item = Vec3>) -> Option<Self> {
        let seen = points.into_iter().map(|point| sun.map_from_world.transform_point3(point));
        let nothing = Self { low: Vec3::INFINITY, high: Vec3::NEG_INFINITY };
        let all = seen.fold(nothing, |all, p| Self { low: all.low.min(p), high: all.high.max(p) });
        all.low.cmple(all.high).all().then_some(all)
    }

    /// Larger by what a lookup of the shadow map reaches beyond a surface.
    #[must_use]
    pub(crate) fn as_looked_up(self, sun: &SunView) -> Self {
        let depth_by_m = sun.map_from_world.row(2).truncate().length();
        let aside = FILTER_TEXELS / sun.extent_texels as f32;
        let margin = Vec3::new(aside, aside, FILTER_TEXELS * sun.texel_m * depth_by_m);
        Self { low: self.low - margin, high: self.high + margin }
    }

    /// Larger on each side by a part of its extent.
    #[must_use]
    pub(crate) fn stretched(self, share: f32) -> Self {
        let margin = (self.high - self.low) * share;
        Self { low: self.low - margin, high: self.high + margin }
    }

    /// The cells that it covers, first and last of columns and rows; `None` beside the map, where all is lit.
    fn cells(&self) -> Option<[[usize; 2]; 2]> {
        let is_beside = self.high.xy().cmplt(Vec2::ZERO).any() || self.low.xy().cmpgt(Vec2::ONE).any();
        let cell = |at: f32| ((at * CELLS as f32) as usize).min(CELLS - 1); // what is below 0 becomes 0
        let along = |axis: usize| [cell(self.low[axis]), cell(self.high[axis])];
        (!is_beside).then(|| [along(0), along(1)])
    }
}

/// See the module.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ShadowChange {
    /// By cell in rows: the largest z of what moved above it, negative infinity where nothing did.
    nearest: Vec<f32>,
    is_any: bool,
}

impl Default for ShadowChange {
    fn default() -> Self {
        Self { nearest: vec![f32::NEG_INFINITY; CELLS * CELLS], is_any: false }
    }
}

impl ShadowChange {
    /// Nothing has moved.
    pub(crate) fn clear(&mut self) {
        if std::mem::take(&mut self.is_any) {
            self.nearest.fill(f32::NEG_INFINITY);
        }
    }

    /// Something has moved.
    pub(crate) fn is_any(&self) -> bool {
        self.is_any
    }

    /// A caster came into this box, or left it.
    pub(crate) fn add(&mut self, caster: SunBox) {
        let Some([columns, rows]) = caster.cells() else { return };
        self.is_any = true;
        for row in rows[0]..=rows[1] {
            let cells = &mut self.nearest[row * CELLS + columns[0]..=row * CELLS + columns[1]];
            cells.iter_mut().for_each(|nearest| *nearest = nearest.max(caster.high.z));
        }
    }

    /// Whether the light may have changed of a surface within a box, as it is looked up.
    pub(crate) fn reaches(&self, surface: &SunBox) -> bool {
        let Some([columns, rows]) = surface.cells().filter(|_| self.is_any) else { return false };
        (rows[0]..=rows[1]).any(|row| {
            let cells = &self.nearest[row * CELLS + columns[0]..=row * CELLS + columns[1]];
            cells.iter().any(|nearest| *nearest >= surface.low.z)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::lights::SHADOW_EXTENT_TEXELS;
    use rand::{Rng, SeedableRng, rngs::SmallRng};
    use shadecast_scene::animation::bounds::Bounds;

    const WORLD: Bounds = Bounds { low: Vec3::splat(-5.0), high: Vec3::splat(5.0) };

    fn sun(to_sun: Vec3) -> SunView {
        SunView::around(to_sun.normalize(), [WORLD].into_iter(), SHADOW_EXTENT_TEXELS).expect("casters")
    }

    fn cube(at: Vec3, side_m: f32) -> Bounds {
        Bounds { low: at, high: at }.grown(side_m * 0.5)
    }

    fn seen(sun: &SunView, bounds: Bounds) -> SunBox {
        SunBox::around(sun, bounds.corners()).expect("a box")
    }

    #[test]
    fn whatever_a_ray_to_the_sun_crosses_of_what_moved_is_reached() {
        let mut random = SmallRng::seed_from_u64(4);
        for _ in 0..2000 {
            let mut place = |reach: f32| {
                Vec3::from(std::array::from_fn::<f32, 3, _>(|_| random.random_range(-reach..reach)))
            };
            let (to_sun, caster, down) =
                (place(1.0) + Vec3::Y * 1.5, cube(place(3.0), 0.7), place(2.0).x.abs());
            let sun = sun(to_sun);
            let inside = caster.low + (caster.high - caster.low) * (place(0.5) + 0.5);
            let surface = inside - to_sun.normalize() * down;
            let mut change = ShadowChange::default();
            change.add(seen(&sun, caster));
            let receiver = SunBox::around(&sun, [surface]).expect("a box").as_looked_up(&sun);
            assert!(change.reaches(&receiver), "{to_sun}: {caster:?} above {surface}");
        }
    }

    #[test]
    fn what_is_far_aside_or_nearer_to_the_sun_is_not_reached() {
        let sun = sun(Vec3::Y);
        let mut change = ShadowChange::default();
        change.add(seen(&sun, cube(Vec3::ZERO, 1.0)));
        let reached = |at: Vec3| change.reaches(&seen(&sun, cube(at, 0.2)).as_looked_up(&sun));
        assert!(reached(Vec3::new(0.0, -3.0, 0.0)), "below");
        assert!(!reached(Vec3::new(2.0, -3.0, 0.0)), "aside");
        assert!(!reached(Vec3::new(0.0, 3.0, 0.0)), "above");
        assert!(!reached(Vec3::new(40.0, -3.0, 0.0)), "beside the map");
    }

    #[test]
    fn nothing_is_reached_where_nothing_moved() {
        let sun = sun(Vec3::new(0.3, 1.0, 0.2));
        let mut change = ShadowChange::default();
        let floor = seen(&sun, WORLD);
        assert!(!change.reaches(&floor) && !change.is_any());
        change.add(floor);
        assert!(change.reaches(&floor));
        change.clear();
        assert_eq!(change, ShadowChange::default());
    }

    #[test]
    fn nothing_has_no_box() {
        assert_eq!(SunBox::around(&sun(Vec3::Y), []), None);
    }
}

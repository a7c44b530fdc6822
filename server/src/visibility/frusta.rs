//! How an eye is looked at that sees more than one projection can show well: in several frusta, each turned about the eye. Pure.
//!
//! Pixels of one projection grow with its tangents: of 150 degrees it has seven times as many as of 60, most of them at its
//! border, and none beside the eye. Turned frusta of 90 degrees and less have about as many wherever they look.

use glam::{Quat, Vec2, Vec3, Vec3Swizzles};
use shadecast_protocol::pose::{Fov, MAX_VIEW_ANGLE};
use shadecast_shaders::constants::MAX_FRUSTA;
use std::f32::consts::{FRAC_PI_2, FRAC_PI_3};

/// The field of view is widened by at least this on each side (radians, 3 degrees), for what lies between the view times.
pub(crate) const MIN_MARGIN: f32 = 0.052;
/// An eye of which no side is looked at farther from its axis than this has one frustum that is not turned, radians: 60 degrees.
const MAX_PLAIN_ANGLE: f32 = FRAC_PI_3;
/// What is turned spans no more along the axis that it is split along, radians: 90 degrees. So turned, it stays below
/// [`MAX_PLAIN_ANGLE`] along the other one.
const MAX_TURNED_SPAN: f32 = FRAC_PI_2;
/// A pixel of what is turned is at most so many of the display wide and high.
const COARSEST_PIXELS: f32 = 4.0;
/// Places along an axis at which the display's pixels are compared with those of a frustum.
const COMPARED_PLACES: u32 = 9;

/// A part of what an eye sees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Frustum {
    /// Turns directions of the frustum, which looks along -z, to the eye's.
    pub eye_from_frustum: Quat,
    /// Its sides, in its own frame.
    pub fov: Fov,
}

/// The frusta of an eye; there is one at least.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Frusta {
    all: [Frustum; MAX_FRUSTA as usize],
    count: usize,
}

#[derive(Clone, Copy)]
enum Axis {
    X,
    Y,
}

/// What is looked at of an eye that shows `fov`, with so much more on each side, radians.
pub(crate) fn widened(fov: Fov, margin: f32) -> Fov {
    let least = fov.widened(MIN_MARGIN, MAX_VIEW_ANGLE);
    let is_plain = [Axis::X, Axis::Y].iter().all(|axis| is_plain(least, *axis));
    fov.widened(margin, if is_plain { MAX_PLAIN_ANGLE } else { MAX_VIEW_ANGLE })
}

impl Frusta {
    /// Of a [`widened`] field of view: every direction within it lies in one of them.
    pub(crate) fn of(widened: Fov) -> Self {
        let whole = Frustum { eye_from_frustum: Quat::IDENTITY, fov: widened };
        let all = Self { all: [whole; MAX_FRUSTA as usize], count: 1 };
        // What is turned along one axis is wider along the other.
        all.split(Axis::X).split(Axis::Y).split(Axis::X)
    }

    /// All of them.
    pub(crate) fn all(&self) -> &[Frustum] {
        &self.all[..self.count]
    }

    /// How many of them are turned: all, or none.
    pub(crate) fn turned(&self) -> usize {
        if self.all().iter().any(Frustum::is_turned) { self.count } else { 0 }
    }

    /// That of this number; the last one where there are fewer.
    pub(crate) fn at(&self, number: usize) -> Frustum {
        self.all[number.min(self.count - 1)]
    }

    fn split(self, axis: Axis) -> Self {
        let mut split = Self { count: 0, ..self };
        for frustum in self.all() {
            for part in frustum.parts(axis).into_iter().flatten() {
                split.all[split.count] = part;
                split.count += 1;
            }
        }
        split
    }
}

impl Frustum {
    /// Itself where it reaches not too far along an axis; else one or two that do not.
    fn parts(self, axis: Axis) -> [Option<Self>; 2] {
        let [low, high] = along(self.fov, axis);
        if is_plain(self.fov, axis) {
            return [Some(self), None];
        }
        if high - low <= MAX_TURNED_SPAN {
            return [Some(self.turned(axis, [low, high])), None];
        }
        let middle = 0.5 * (low + high);
        [[low, middle], [middle, high]].map(|part| Some(self.turned(axis, part)))
    }

    /// What of it lies between two angles along an axis, looked at straight.
    fn turned(self, axis: Axis, [low, high]: [f32; 2]) -> Self {
        let (middle, half) = (0.5 * (low + high), 0.5 * (high - low));
        // A plane across, at tangent 1 in the old frame, is at these in the new one, at either end.
        let ratios = [low, high].map(|angle| angle.cos() / half.cos());
        let across = along(self.fov, axis.other()).map(|side| ratios.map(|ratio| side.tan() * ratio));
        let across = [across[0][0].min(across[0][1]), across[1][0].max(across[1][1])].map(f32::atan);
        let (turn, [left, right], [down, up]) = match axis {
            Axis::X => (Quat::from_rotation_y(-middle), [-half, half], across),
            Axis::Y => (Quat::from_rotation_x(middle), across, [-half, half]),
        };
        let eye_from_frustum = (self.eye_from_frustum * turn).normalize();
        Self { eye_from_frustum, fov: Fov { left, right, up, down } }
    }

    /// Pixels that an image of it has for an eye that shows `shown` with so many pixels of its display along x and y for a tangent
    /// of 1: as dense as the display in the frustum's middle, and nowhere much less.
    pub(crate) fn extent_pixels(&self, shown: Fov, pixels_per_tangent: [f32; 2]) -> [f32; 2] {
        let low = Vec2::new(self.fov.left.tan(), self.fov.down.tan());
        let high = Vec2::new(self.fov.right.tan(), self.fov.up.tan());
        let density = |at: Vec2| self.display_pixels(at, shown, pixels_per_tangent);
        let middle = if self.is_turned() { 0.5 * (low + high) } else { Vec2::ZERO };
        let places = (0..COMPARED_PLACES * COMPARED_PLACES).map(|place| {
            let share = Vec2::new((place % COMPARED_PLACES) as f32, (place / COMPARED_PLACES) as f32);
            low + (high - low) * share / (COMPARED_PLACES - 1) as f32
        });
        let densest = places.map(|at| density(at) / COARSEST_PIXELS).fold(density(middle), Vec2::max);
        (densest * (high - low)).to_array()
    }

    fn is_turned(&self) -> bool {
        self.eye_from_frustum != Quat::IDENTITY
    }

    /// Pixels of the display that a step by a tangent of 1 along x and y crosses at this place of the frustum, or, beside what is
    /// shown, at the display's border next to it.
    fn display_pixels(&self, tangents: Vec2, shown: Fov, pixels_per_tangent: [f32; 2]) -> Vec2 {
        let of_eye = self.eye_from_frustum * tangents.extend(-1.0);
        let low = Vec2::new(shown.left.tan(), shown.down.tan());
        let high = Vec2::new(shown.right.tan(), shown.up.tan());
        let at = (of_eye.xy() / (-of_eye.z).max(f32::MIN_POSITIVE)).max(low).min(high);
        let ahead = -(self.eye_from_frustum.inverse() * at.extend(-1.0)).z;
        let step = |side: Vec3| {
            let side = self.eye_from_frustum * side;
            ((side.xy() + at * side.z) * ahead * Vec2::from(pixels_per_tangent)).length()
        };
        Vec2::new(step(Vec3::X), step(Vec3::Y))
    }
}

impl Axis {
    fn other(self) -> Self {
        match self {
            Self::X => Self::Y,
            Self::Y => Self::X,
        }
    }
}

/// The two sides along an axis, radians, the lower first.
fn along(fov: Fov, axis: Axis) -> [f32; 2] {
    match axis {
        Axis::X => [fov.left, fov.right],
        Axis::Y => [fov.down, fov.up],
    }
}

/// What is no number is not split either.
fn is_plain(fov: Fov, axis: Axis) -> bool {
    !along(fov, axis).iter().any(|side| side.abs() > MAX_PLAIN_ANGLE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    const PIXELS: f32 = 1000.0;

    /// Eyes of 40 to 175 degrees each way, every other one with sides of its own.
    fn eyes() -> impl Iterator<Item = Fov> {
        let mut rng = SmallRng::seed_from_u64(12);
        (0..400).map(move |case| {
            let mut axis = || {
                let span = rng.random_range(40f32..175.0).to_radians();
                let most = MAX_VIEW_ANGLE.min(span);
                let high = rng.random_range(span - most..most);
                if case % 2 == 0 { [-0.5 * span, 0.5 * span] } else { [high - span, high] }
            };
            let ([left, right], [down, up]) = (axis(), axis());
            Fov { left, right, up, down }
        })
    }

    fn is_in(fov: Fov, direction: Vec3, slack: f32) -> bool {
        let within = |at: f32, low: f32, high: f32| {
            let slack = slack * (1.0 + at.abs());
            at >= low.tan() - slack && at <= high.tan() + slack
        };
        let tangents = direction.xy() / -direction.z;
        direction.z < 0.0 && within(tangents.x, fov.left, fov.right) && within(tangents.y, fov.down, fov.up)
    }

    fn pixels_per_tangent(fov: Fov) -> [f32; 2] {
        [PIXELS / (fov.right.tan() - fov.left.tan()), PIXELS / (fov.up.tan() - fov.down.tan())]
    }

    /// Directions within a field of view, to its corners.
    fn directions(fov: Fov) -> impl Iterator<Item = Vec3> {
        let side = |low: f32, high: f32, place: u32| (low + (high - low) * place as f32 / 20.0).tan();
        (0..=20).flat_map(move |x| {
            (0..=20).map(move |y| Vec3::new(side(fov.left, fov.right, x), side(fov.down, fov.up, y), -1.0))
        })
    }

    #[test]
    fn every_direction_lies_in_a_frustum_of_at_most_120_degrees() {
        for (case, eye) in eyes().enumerate() {
            for margin in [MIN_MARGIN, 0.35] {
                let seen = widened(eye, margin);
                let frusta = Frusta::of(seen);
                for frustum in frusta.all() {
                    for [low, high] in [Axis::X, Axis::Y].map(|axis| along(frustum.fov, axis)) {
                        let degrees = (high - low).to_degrees();
                        assert!(degrees > 0.0 && degrees < 120.01, "case {case}: {degrees} of {eye:?}");
                    }
                    assert!(frustum.fov.clip_from_eye().is_finite());
                }
                let is_seen = |direction: Vec3| {
                    let turned = |frustum: &Frustum| frustum.eye_from_frustum.inverse() * direction;
                    frusta.all().iter().any(|frustum| is_in(frustum.fov, turned(frustum), 2e-4))
                };
                let missed = directions(seen).find(|direction| !is_seen(*direction));
                assert_eq!(missed, None, "case {case}: {eye:?} {frusta:?}");
                assert!(directions(eye).all(|direction| is_in(seen, direction, 1e-3)), "case {case}");
            }
        }
    }

    #[test]
    fn an_eye_has_no_more_frusta_than_it_needs() {
        let count = |x: [f32; 2], y: [f32; 2]| {
            let [left, right, down, up] = [x[0], x[1], y[0], y[1]].map(f32::to_radians);
            Frusta::of(widened(Fov { left, right, up, down }, MIN_MARGIN)).all().len()
        };
        assert_eq!(count([-56.0, 56.0], [-56.0, 56.0]), 1);
        assert_eq!(count([-70.0, 10.0], [-45.0, 45.0]), 1, "canted: turned, and one");
        assert_eq!(count([-65.0, 65.0], [-45.0, 45.0]), 2);
        assert_eq!(count([-85.0, 45.0], [-45.0, 45.0]), 2);
        assert_eq!(count([-80.0, 80.0], [-70.0, 70.0]), 4);
    }

    #[test]
    fn a_usual_eye_is_looked_at_as_it_is() {
        let fov = Fov { left: -0.9, right: 0.7, up: 0.8, down: -0.85 };
        for margin in [MIN_MARGIN, 0.2, 0.35] {
            let seen = widened(fov, margin);
            assert_eq!(seen, fov.widened(margin, MAX_PLAIN_ANGLE));
            let frusta = Frusta::of(seen);
            assert_eq!(frusta.all(), [Frustum { eye_from_frustum: Quat::IDENTITY, fov: seen }]);
            let [width, height] = frusta.at(0).extent_pixels(fov, pixels_per_tangent(fov));
            let spans = [seen.right.tan() - seen.left.tan(), seen.up.tan() - seen.down.tan()];
            let [x, y] = pixels_per_tangent(fov);
            assert_eq!([width, height], [x * spans[0], y * spans[1]]);
        }
    }

    #[test]
    fn no_pixel_is_wider_than_four_of_the_display() {
        for (case, eye) in eyes().enumerate() {
            let density = pixels_per_tangent(eye);
            for frustum in Frusta::of(widened(eye, MIN_MARGIN)).all() {
                let extent = Vec2::from(frustum.extent_pixels(eye, density));
                let spans = Vec2::new(
                    frustum.fov.right.tan() - frustum.fov.left.tan(),
                    frustum.fov.up.tan() - frustum.fov.down.tan(),
                );
                let step = spans / extent;
                let place = |tangents: Vec2| {
                    let of_eye = frustum.eye_from_frustum * tangents.extend(-1.0);
                    of_eye.xy() / -of_eye.z * Vec2::from(density)
                };
                let here =
                    directions(frustum.fov).filter(|at| is_in(eye, frustum.eye_from_frustum * *at, 0.0));
                for at in here.map(|at| at.xy()) {
                    for side in [Vec2::X, Vec2::Y] {
                        // A hundredth of a pixel: it is the way that is measured, not its bend.
                        let crossed = place(at + side * step * 0.01).distance(place(at)) * 100.0;
                        assert!(crossed < 4.4, "case {case}: {crossed} pixels of {eye:?} at {at}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_wide_headset_has_no_more_than_three_times_the_pixels_of_its_display() {
        let of_headset = Fov { left: -75f32.to_radians(), right: 75f32.to_radians(), up: 0.8, down: -0.8 };
        let pixels = |frustum: &Frustum| -> f32 {
            frustum.extent_pixels(of_headset, pixels_per_tangent(of_headset)).iter().product()
        };
        let all: f32 = Frusta::of(widened(of_headset, MIN_MARGIN)).all().iter().map(pixels).sum();
        assert!(all < 3.0 * PIXELS * PIXELS, "{all}");
    }
}

//! Which instances an update needs at all. Pure.
//!
//! An instance is needed if the box that it never leaves, or what that box can shade, reaches a predicted view; and for
//! some updates after that, since the layout holds what was seen. What is not needed is neither posed nor skinned nor
//! drawn.

use crate::scene::lights::caster_reach;
use crate::visibility::holding::HOLD_UPDATES;
use crate::visibility::predict::View;
use glam::{Vec3, Vec4};
use shadecast_protocol::limits::MAX_VIEWS;
use shadecast_protocol::pose::MAX_VIEW_ANGLE;
use shadecast_scene::animation::bounds::Bounds;

/// How far beside the middle of a border's pixel its sample may lie, radians, whatever the picture's size.
const BESIDE_MIDDLE_RAD: f32 = 0.01;

/// Remembers when each instance was last in view.
#[derive(Clone, Debug)]
pub(crate) struct Culling {
    /// By instance: points whose hull holds it and its shadow; none for what shows nothing.
    reach: Vec<Vec<Vec3>>,
    /// By instance: the update that needed it last; 0: none.
    last_needed: Vec<u32>,
    /// By the last update.
    needed: Needed,
    update: u32,
}

/// The instances that an update needs, or that several do, each with the finest LOD that is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Needed(Vec<Option<usize>>);

impl FromIterator<bool> for Needed {
    fn from_iter<T: IntoIterator<Item = bool>>(by_instance: T) -> Self {
        Self(by_instance.into_iter().map(|has| has.then_some(0)).collect())
    }
}

impl Needed {
    /// None of so many instances.
    pub(crate) fn none(instances: usize) -> Self {
        Self(vec![None; instances])
    }

    /// All of them in full detail.
    pub(crate) fn all(instances: usize) -> Self {
        Self(vec![Some(0); instances])
    }

    /// Whether an instance is needed.
    pub(crate) fn has(&self, instance: usize) -> bool {
        self.0[instance].is_some()
    }

    /// The finest LOD of an instance that is needed.
    pub(crate) fn lod(&self, instance: usize) -> Option<usize> {
        self.0[instance]
    }

    /// Becomes what others need, in the memory that it has.
    pub(crate) fn copy(&mut self, others: &Self) {
        self.0.clone_from(&others.0);
    }

    /// Nothing is needed any more.
    pub(crate) fn clear(&mut self) {
        self.0.fill(None);
    }

    /// Of what is needed no finer LOD than these, by instance, is.
    pub(crate) fn set_lods(&mut self, lods: impl IntoIterator<Item = usize>) {
        for (has, lod) in self.0.iter_mut().zip(lods) {
            *has = has.map(|_| lod);
        }
    }

    /// Of what is needed no coarser LOD than these, by instance, is.
    pub(crate) fn refine(&mut self, lods: impl IntoIterator<Item = usize>) {
        for (has, lod) in self.0.iter_mut().zip(lods) {
            *has = has.map(|has| has.min(lod));
        }
    }

    /// Adds what others need.
    pub(crate) fn add(&mut self, others: &Self) {
        for (has, other) in self.0.iter_mut().zip(&others.0) {
            *has = has.iter().chain(other).min().copied();
        }
    }

    /// Whether all that others need is needed here, however finely.
    pub(crate) fn has_all(&self, others: &Self) -> bool {
        self.0.iter().zip(&others.0).all(|(has, other)| has.is_some() || other.is_none())
    }

    /// Whether all that others need is needed here, as finely.
    pub(crate) fn covers(&self, others: &Self) -> bool {
        let covers = |has: &Option<usize>, other: usize| has.is_some_and(|has| has <= other);
        self.0.iter().zip(&others.0).all(|(has, other)| other.is_none_or(|other| covers(has, other)))
    }
}

impl Culling {
    /// `bounds` and `casts_shadow` by instance; `to_sun` is `None` where the sun casts no shadows.
    pub(crate) fn new(bounds: &[Bounds], casts_shadow: impl Fn(usize) -> bool, to_sun: Option<Vec3>) -> Self {
        let all = bounds.iter().copied().fold(Bounds::EMPTY, Bounds::union);
        let reach = |(index, bounds): (usize, &Bounds)| match to_sun {
            _ if bounds.is_empty() => Vec::new(),
            Some(to_sun) if casts_shadow(index) => caster_reach(*bounds, to_sun, all).to_vec(),
            _ => bounds.corners().to_vec(),
        };
        Self {
            reach: bounds.iter().enumerate().map(reach).collect(),
            last_needed: vec![0; bounds.len()],
            needed: Needed::none(bounds.len()),
            update: 0,
        }
    }

    /// What the next update needs, with these views.
    pub(crate) fn needs(&mut self, views: impl Iterator<Item = View> + Clone) -> &Needed {
        self.update += 1;
        for (index, reach) in self.reach.iter().enumerate() {
            if views.clone().any(|view| is_in_view(reach, &view)) {
                self.last_needed[index] = self.update;
            }
            let last = self.last_needed[index];
            // One update more than the layout holds a patch: it decides after this.
            self.needed.0[index] = (last > 0 && self.update - last <= HOLD_UPDATES + 1).then_some(0);
        }
        &self.needed
    }

    /// What the last update needs.
    pub(crate) fn needed(&self) -> &Needed {
        &self.needed
    }
}

/// What some views can see, in the world.
#[derive(Clone, Debug, Default)]
pub struct Sight {
    /// Of each view; positive inside.
    planes: [[Vec4; 5]; MAX_VIEWS as usize],
    views: usize,
}

impl Sight {
    /// Of views whose samples lie beside the middles of pixels; no more than an update has.
    pub fn of<'a>(views: impl Iterator<Item = &'a View>) -> Self {
        let mut sight = Self::default();
        for view in views {
            let wider = View { fov: view.fov.widened(BESIDE_MIDDLE_RAD, MAX_VIEW_ANGLE), ..*view };
            let to_planes = view.world_from_eye.inverse().matrix().transpose();
            sight.planes[sight.views] = side_planes(&wider).map(|plane| to_planes * plane);
            sight.views += 1;
        }
        sight
    }

    /// Conservative: false only if all of a box lies on the far side of a plane of each view.
    pub(crate) fn reaches(&self, bounds: Bounds) -> bool {
        let (middle, half) = ((bounds.low + bounds.high) * 0.5, (bounds.high - bounds.low) * 0.5);
        let is_inside =
            |plane: &Vec4| plane.dot(middle.extend(1.0)) + plane.truncate().abs().dot(half) >= 0.0;
        self.planes[..self.views].iter().any(|of_view| of_view.iter().all(is_inside))
    }
}

/// Conservative: outside only if all points lie on the far side of one of the view's planes.
fn is_in_view(points: &[Vec3], view: &View) -> bool {
    let eye_from_world = view.world_from_eye.inverse().matrix();
    side_planes(view).iter().all(|plane| {
        points.iter().any(|point| plane.dot(eye_from_world.transform_point3(*point).extend(1.0)) >= 0.0)
    })
}

/// The planes of a view through the eye, and the one behind it, in the eye's frame (looking along -z); positive inside.
fn side_planes(view: &View) -> [Vec4; 5] {
    let (l, r, u, d) = (view.fov.left.tan(), view.fov.right.tan(), view.fov.up.tan(), view.fov.down.tan());
    [
        Vec4::new(1.0, 0.0, l, 0.0),
        Vec4::new(-1.0, 0.0, -r, 0.0),
        Vec4::new(0.0, 1.0, d, 0.0),
        Vec4::new(0.0, -1.0, -u, 0.0),
        Vec4::new(0.0, 0.0, -1.0, 0.0),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use rand::{Rng, SeedableRng, rngs::SmallRng};
    use shadecast_protocol::pose::{Fov, Pose};

    fn view(position: Vec3, yaw: f32) -> View {
        wide_view(position, yaw, Fov { left: -0.6, right: 0.9, up: 0.5, down: -0.8 })
    }

    fn wide_view(position: Vec3, yaw: f32, fov: Fov) -> View {
        View { world_from_eye: Pose { position, orientation: Quat::from_rotation_y(yaw) }, fov }
    }

    fn cube(middle: Vec3) -> Bounds {
        Bounds { low: middle - 0.5, high: middle + 0.5 }
    }

    #[test]
    fn what_projects_into_a_view_is_needed() {
        let mut rng = SmallRng::seed_from_u64(31);
        let mut outside = 0;
        for case in 0..500 {
            let mut number = |reach: f32| rng.random_range(-reach..reach);
            let (position, yaw) = (Vec3::new(number(3.0), number(1.0), number(3.0)), number(3.1));
            let view = match case % 2 {
                0 => view(position, yaw),
                // Up to what one projection can show at all.
                _ => wide_view(position, yaw, Fov::symmetric_degrees(150.0 + number(28.0))),
            };
            let bounds = cube(Vec3::new(number(8.0), number(4.0), number(8.0)));
            let clip = view.fov.clip_from_eye() * view.world_from_eye.inverse().matrix();
            let visible = (0..100).any(|_| {
                let mut within = || rng.random_range(0.0f32..1.0);
                let p = bounds.low + Vec3::new(within(), within(), within()) * (bounds.high - bounds.low);
                let at = clip * p.extend(1.0);
                at.w > 0.1 && at.x.abs() <= at.w && at.y.abs() <= at.w
            });
            let needed = Culling::new(&[bounds], |_| false, None).needs([view].into_iter()).has(0);
            assert!(needed || !visible, "seed 31, case {case}");
            outside += u32::from(!needed);
        }
        assert!(outside > 150, "culls nothing: {outside} of 500");
    }

    #[test]
    fn a_caster_behind_the_user_is_needed_where_its_shadow_falls_into_view() {
        // The sun stands behind the user and low; the far box makes the scene long enough for the shadow.
        let bounds = [cube(Vec3::new(0.0, 3.0, 6.0)), cube(Vec3::new(0.0, 0.0, -30.0))];
        let to_sun = Vec3::new(0.0, 0.3, 1.0).normalize();
        let needed = |sun| {
            let mut culling = Culling::new(&bounds, |index| index == 0, sun);
            culling.needs([view(Vec3::new(0.0, 1.6, 0.0), 0.0)].into_iter()).has(0)
        };
        assert!(needed(Some(to_sun)));
        assert!(!needed(None));
        assert!(!needed(Some(-to_sun)), "the shadow falls to the other side");
    }

    #[test]
    fn what_leaves_the_view_is_needed_as_long_as_the_layout_may_hold_it() {
        let mut culling = Culling::new(&[cube(Vec3::new(0.0, 0.0, -5.0))], |_| false, None);
        let (towards, away) = (view(Vec3::ZERO, 0.0), view(Vec3::ZERO, 3.1));
        assert!(culling.needs([towards].into_iter()).has(0));
        let after = (0..20).take_while(|_| culling.needs([away].into_iter()).has(0)).count();
        assert_eq!(after as u32, HOLD_UPDATES + 1);
        assert!(!culling.needs([away].into_iter()).has(0));
        assert!(!Culling::new(&[Bounds::EMPTY], |_| false, None).needs([towards].into_iter()).has(0));
    }
}

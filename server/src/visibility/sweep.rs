//! The sweep around the head, two opposite directions of a cube at a time. It finds what an abrupt turn would show. Pure.

use crate::visibility::predict::View;
use glam::{Quat, Vec3};
use shadecast_protocol::pose::{Fov, Pose};
use std::f32::consts::{FRAC_PI_2, PI};

/// One in so many updates looks around.
const EVERY_UPDATES: u32 = 2;
/// Pairs of directions: ahead and back, left and right, up and down of the world.
const PAIRS: u32 = 3;
/// Places of the eye, one after the other: the corners of a cube around the head.
const PLACES: u32 = 8;
/// Updates until every direction was seen from every place.
pub(crate) const ROUND_UPDATES: u32 = EVERY_UPDATES * PAIRS * PLACES;
/// How far from the head these places are, metres: what it may go until an update arrives that knows of it.
const ASIDE_M: f32 = 0.15;
/// Across a view; the sides of a cube, with something to spare.
const FOV_DEGREES: f32 = 92.0;

/// Two views that look around.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Glance {
    /// In opposite directions.
    pub views: [View; 2],
    /// The glances before this one.
    pub number: u32,
}

/// Which direction is next.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Sweep {
    updates: u32,
}

impl Sweep {
    /// Where the next update looks besides, if it does.
    pub(crate) fn next(&mut self, world_from_head: Pose) -> Option<Glance> {
        let update = self.updates;
        self.updates = self.updates.wrapping_add(1);
        update.is_multiple_of(EVERY_UPDATES).then(|| glance(update / EVERY_UPDATES, world_from_head))
    }
}

fn glance(number: u32, world_from_head: Pose) -> Glance {
    let turns = match number % PAIRS {
        0 => [Quat::IDENTITY, Quat::from_rotation_y(PI)],
        1 => [FRAC_PI_2, -FRAC_PI_2].map(Quat::from_rotation_y),
        _ => [FRAC_PI_2, -FRAC_PI_2].map(Quat::from_rotation_x),
    };
    let place = number / PAIRS % PLACES;
    let side = |axis: u32| if place >> axis & 1 == 0 { 1.0 } else { -1.0 };
    let aside = Vec3::new(side(0), side(1), side(2)).normalize() * ASIDE_M;
    let position = world_from_head.position + aside;
    let view = |orientation: Quat| View {
        world_from_eye: Pose { position, orientation },
        fov: Fov::symmetric_degrees(FOV_DEGREES),
    };
    Glance { views: turns.map(view), number }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn round() -> Vec<Glance> {
        let mut sweep = Sweep::default();
        let head = Pose { position: Vec3::new(3.0, 1.6, -2.0), orientation: Quat::from_rotation_y(0.7) };
        (0..ROUND_UPDATES).filter_map(|_| sweep.next(head)).collect()
    }

    #[test]
    fn every_direction_is_seen_within_six_updates() {
        let views: Vec<View> = round().iter().take(PAIRS as usize).flat_map(|glance| glance.views).collect();
        assert_eq!(EVERY_UPDATES * PAIRS, 6);
        for (x, y, z) in (-4..=4).flat_map(|x| (-4..=4).flat_map(move |y| (-4..=4).map(move |z| (x, y, z)))) {
            let direction = Vec3::new(x as f32, y as f32, z as f32);
            let is_seen = |view: &View| {
                let of_eye = view.world_from_eye.orientation.inverse() * direction;
                of_eye.z < 0.0 && of_eye.x.abs().max(of_eye.y.abs()) <= -of_eye.z * view.fov.right.tan()
            };
            assert!(direction == Vec3::ZERO || views.iter().any(is_seen), "{direction}");
        }
    }

    #[test]
    fn a_round_looks_from_all_sides_of_the_head_and_not_from_far() {
        let places: Vec<Vec3> = round()
            .iter()
            .map(|glance| glance.views[0].world_from_eye.position - Vec3::new(3.0, 1.6, -2.0))
            .collect();
        assert!(places.iter().all(|place| (place.length() - ASIDE_M).abs() < 1e-5));
        assert!(places.iter().sum::<Vec3>().length() < 1e-4, "evenly");
    }
}

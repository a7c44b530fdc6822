//! Bone weights: which joints move a place, and how much.

use super::loft::Loft;
use crate::curve::smoothstep;
use glam::{Vec3, Vec4};

/// Joints with their shares. Shares need not sum to 1 until [`Weights::strongest`] makes them.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Weights(Vec<(usize, f32)>);

impl Weights {
    pub fn one(joint: usize) -> Self {
        Self(vec![(joint, 1.0)])
    }

    /// `a` at 0, `b` at 1.
    pub fn mix(a: &Self, b: &Self, t: f32) -> Self {
        let mut sum = Self::default();
        sum.add(a, 1.0 - t);
        sum.add(b, t);
        sum
    }

    pub fn add(&mut self, other: &Self, share: f32) {
        for &(joint, weight) in &other.0 {
            match self.0.iter_mut().find(|entry| entry.0 == joint) {
                Some(entry) => entry.1 += share * weight,
                None => self.0.push((joint, share * weight)),
            }
        }
    }

    pub fn mapped(&self, joint: &dyn Fn(usize) -> usize) -> Self {
        Self(self.0.iter().map(|&(index, weight)| (joint(index), weight)).collect())
    }

    /// At most four influences that sum to 1; unused ones are joint 0 with weight 0, as glTF asks.
    pub fn strongest(&self) -> ([u8; 4], [f32; 4]) {
        const LEAST: f32 = 0.004;
        let mut order = self.0.clone();
        order.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        order.truncate(4);
        order.retain(|entry| entry.1 >= LEAST);
        let sum: f32 = order.iter().map(|entry| entry.1).sum();
        let (mut joints, mut weights) = ([0; 4], [0.0; 4]);
        for (slot, (joint, weight)) in order.iter().enumerate() {
            joints[slot] = *joint as u8;
            weights[slot] = weight / sum;
        }
        // The strongest takes the rounding error.
        weights[0] = 1.0 - weights[1..].iter().sum::<f32>();
        (joints, weights)
    }
}

/// Joints one after the other along a curve.
#[derive(Clone, Debug)]
pub(super) struct Chain {
    /// Where each joint's stretch begins, and the end of the last: one more than joints, rising, metres.
    pub bounds_m: Vec<f32>,
    pub joints: Vec<usize>,
    /// How far, as a share of the shorter of two neighbouring stretches, one blends into the other to either side.
    pub softness: f32,
}

impl Chain {
    /// Weights at a length along the curve.
    pub fn weights(&self, s_m: f32) -> Weights {
        let last = self.joints.len() - 1;
        // Share of everything from joint i on; the first has all of it.
        let from = |i: usize| match i {
            0 => 1.0,
            i if i > last => 0.0,
            i => {
                let at = self.bounds_m[i];
                let reach = self.softness * (at - self.bounds_m[i - 1]).min(self.bounds_m[i + 1] - at);
                smoothstep(at - reach, at + reach, s_m)
            }
        };
        let share = |i: usize| (self.joints[i], from(i) - from(i + 1));
        Weights((0..=last).map(share).filter(|entry| entry.1 > 1e-4).collect())
    }
}

/// A tube that moves with a chain of joints.
#[derive(Clone, Debug)]
pub(super) struct Limb {
    pub loft: Loft,
    pub chain: Chain,
    /// A joint that breathes: share of it at a length along the curve, as (joint, centre m, reach m, most).
    pub breath: Option<(usize, f32, f32, f32)>,
    pub shading: Shading,
}

/// How ventral a limb is painted: scale and offset on how far below its curve a place is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Shading {
    pub scale: f32,
    pub offset: f32,
}

impl Shading {
    /// From back to belly.
    pub const TRUNK: Self = Self { scale: 1.0, offset: 0.0 };
    /// Legs have neither back nor belly.
    pub const LEG: Self = Self { scale: 0.25, offset: 0.27 };
    /// Dark all around.
    pub const WING: Self = Self { scale: 0.2, offset: 0.0 };

    /// Paint for hide (see `Skin::Hide`) at a length along the limb (m) and an angle from its top (radians).
    pub fn hide_paint(self, s_m: f32, angle: f32, grain: f32, mouth: f32) -> Vec4 {
        Vec4::new(self.of(0.5 - 0.5 * angle.cos()), s_m, grain, mouth)
    }

    /// What the painter gets for a place; 0 above the curve, 1 below it.
    fn of(self, ventral: f32) -> f32 {
        self.scale * ventral + self.offset
    }
}

impl Limb {
    pub fn new(loft: Loft, chain: Chain, shading: Shading) -> Self {
        Self { loft, chain, breath: None, shading }
    }

    /// How ventral the limb is painted at a place.
    pub fn ventral(&self, point: Vec3) -> f32 {
        self.shading.of(self.loft.ventral(point))
    }

    /// Weights at the place of the curve nearest to a point.
    pub fn weights(&self, point: Vec3) -> Weights {
        self.weights_at(self.loft.nearest_m(point))
    }

    /// Weights at a length along the curve, metres.
    pub fn weights_at(&self, s_m: f32) -> Weights {
        let chain = self.chain.weights(s_m);
        let Some((joint, centre_m, reach_m, most)) = self.breath else { return chain };
        let share = most * (1.0 - smoothstep(0.0, reach_m, (s_m - centre_m).abs()));
        if share <= 0.0 { chain } else { Weights::mix(&chain, &Weights::one(joint), share) }
    }
}

//! Bone weights: which joints move a place, and how much.

use super::curve::smoothstep;
use super::loft::Loft;
use glam::Vec3;

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
}

impl Limb {
    pub fn new(loft: Loft, chain: Chain) -> Self {
        Self { loft, chain, breath: None }
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

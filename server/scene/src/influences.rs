//! Reduction of any number of skin influences to the four that a [`Vertex`](super::Vertex) holds.

/// Four joints and their weights, as a vertex holds them.
pub type FourInfluences = ([u16; 4], [f32; 4]);

/// Keeps the four largest influences and scales them to sum 1, in whole units of 1/65,535, so that the GPU can hold
/// them in 16 bits and still blend with exactly the weights that the CPU has. A joint that occurs twice counts once, with the sum of
/// its weights. `None` where all weights are zero, or one is negative or not finite.
///
/// The result does not depend on the order of the input, ties included: vertices of two triangles that meet at a
/// seam must be reduced alike, or the seam opens under animation.
pub fn reduce_to_four(influences: impl IntoIterator<Item = (u16, f32)>) -> Option<FourInfluences> {
    // In f64, so that weights near f32::MAX have finite sums.
    let mut merged: Vec<(u16, f64)> = Vec::with_capacity(8);
    for (joint, weight) in influences {
        if !weight.is_finite() || weight < 0.0 {
            return None;
        }
        match merged.iter_mut().find(|(known, _)| *known == joint) {
            Some((_, sum)) => *sum += f64::from(weight),
            None if weight > 0.0 => merged.push((joint, f64::from(weight))),
            None => {}
        }
    }
    merged.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
    merged.truncate(4);
    normalised(&merged)
}

fn normalised(largest_first: &[(u16, f64)]) -> Option<FourInfluences> {
    let sum: f64 = largest_first.iter().map(|(_, weight)| *weight).sum();
    let first = largest_first.first()?;
    // Unused slots name a joint that is used anyway: its matrix is loaded already, and it is always in range.
    let (mut joints, mut units) = ([first.0; 4], [0; 4]);
    for (slot, (joint, weight)) in largest_first.iter().enumerate().skip(1) {
        units[slot] = (*weight / sum * f64::from(u16::MAX)).round() as u16;
        joints[slot] = if units[slot] > 0 { *joint } else { first.0 };
    }
    // At most three times the half of a unit too many: the largest of four weights is above that.
    units[0] = u16::MAX - units[1..].iter().sum::<u16>();
    Some((joints, units.map(weight_of_units)))
}

/// The weight that so many of 65,535 units stand for.
pub fn weight_of_units(units: u16) -> f32 {
    f32::from(units) / f32::from(u16::MAX)
}

/// The units of a weight, exactly for those that [`reduce_to_four`] gives.
pub fn units_of_weight(weight: f32) -> u16 {
    (weight * f32::from(u16::MAX)).round() as u16
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::SmallRng, seq::SliceRandom};

    #[test]
    fn weights_sum_to_one_and_keep_their_ratios_after_reduction() {
        let mut rng = SmallRng::seed_from_u64(11);
        for case in 0..500 {
            let count = rng.random_range(1..=16);
            let input: Vec<(u16, f32)> = (0..count).map(|j| (j, rng.random_range(0.01..1.0))).collect();
            let (joints, weights) = reduce_to_four(input.clone()).expect("positive weights");
            let sum: f32 = weights.iter().sum();
            assert!((sum - 1.0).abs() < 1e-6, "seed 11, case {case}: sum {sum}");
            let units: u32 = weights.map(|w| u32::from(units_of_weight(w))).iter().sum();
            assert_eq!(units, 65_535, "seed 11, case {case}");
            assert_eq!(weights, weights.map(|w| weight_of_units(units_of_weight(w))), "seed 11, case {case}");
            let kept = input.len().min(4);
            for slot in 1..kept {
                let (first, other) = (input[joints[0] as usize].1, input[joints[slot] as usize].1);
                assert!((weights[slot] * first - weights[0] * other).abs() < 4e-5, "seed 11, case {case}");
            }
        }
    }

    #[test]
    fn the_four_largest_are_kept_whatever_the_order() {
        let mut rng = SmallRng::seed_from_u64(12);
        let mut input = vec![(1, 0.1), (2, 0.4), (3, 0.05), (4, 0.2), (5, 0.2), (6, 0.05)];
        let expected = reduce_to_four(input.clone()).expect("positive weights");
        assert_eq!(expected.0, [2, 4, 5, 1]);
        for _ in 0..50 {
            input.shuffle(&mut rng);
            assert_eq!(reduce_to_four(input.clone()), Some(expected), "seed 12");
        }
    }

    #[test]
    fn a_joint_named_twice_counts_once() {
        let (joints, weights) = reduce_to_four([(7, 0.25), (3, 0.5), (7, 0.25)]).expect("positive weights");
        assert_eq!((joints[0], joints[1]), (3, 7));
        assert_eq!((units_of_weight(weights[0]), units_of_weight(weights[1])), (32_767, 32_768));
    }

    #[test]
    fn enormous_weights_are_scaled_too() {
        let (joints, weights) =
            reduce_to_four([(7, f32::MAX), (3, f32::MAX), (7, f32::MAX)]).expect("positive weights");
        assert_eq!((joints[0], joints[1]), (7, 3));
        assert!((weights[0] - 2.0 / 3.0).abs() < 1e-5 && (weights[1] - 1.0 / 3.0).abs() < 1e-5);
    }

    #[test]
    fn no_weight_at_all_is_refused() {
        assert_eq!(reduce_to_four([]), None);
        assert_eq!(reduce_to_four([(0, 0.0), (1, 0.0)]), None);
        assert_eq!(reduce_to_four([(0, f32::NAN)]), None);
        assert_eq!(reduce_to_four([(0, 1.0), (1, -0.5)]), None);
    }
}

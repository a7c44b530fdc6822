//! Growth of a cost with how much there is. Pure.

/// The exponent `k` of `cost = c * amount^k` that fits best: the slope of the line through the logarithms, least squares. `None`
/// of fewer than two amounts, or of costs that are not above 0.
pub fn exponent(points: &[(f64, f64)]) -> Option<f64> {
    if points.iter().any(|(amount, cost)| *amount <= 0.0 || *cost <= 0.0 || !cost.is_finite()) {
        return None;
    }
    let logs: Vec<(f64, f64)> = points.iter().map(|(amount, cost)| (amount.ln(), cost.ln())).collect();
    let mean = |of: fn(&(f64, f64)) -> f64| logs.iter().map(of).sum::<f64>() / logs.len() as f64;
    let (x, y) = (mean(|log| log.0), mean(|log| log.1));
    let spread: f64 = logs.iter().map(|log| (log.0 - x).powi(2)).sum();
    let together: f64 = logs.iter().map(|log| (log.0 - x) * (log.1 - y)).sum();
    (spread > 1e-12).then(|| together / spread)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_power_is_found_whatever_its_factor() {
        for power in [-0.5, 0.0, 0.6, 1.0, 2.3] {
            for factor in [0.01, 1.0, 300.0] {
                let points = [9.0f64, 25.0, 49.0, 81.0, 121.0, 169.0].map(|n| (n, factor * n.powf(power)));
                let found = exponent(&points).expect("points");
                assert!((found - power).abs() < 1e-9, "{factor} n^{power}: {found}");
            }
        }
    }

    #[test]
    fn a_constant_part_makes_it_smaller_and_noise_little_else() {
        let points = [9.0f64, 25.0, 49.0, 81.0, 121.0, 169.0].map(|n| (n, 40.0 + n));
        let found = exponent(&points).expect("points");
        assert!((0.3..0.9).contains(&found), "{found}");
        let noisy = [(9.0, 9.3), (25.0, 24.1), (49.0, 50.6), (81.0, 80.0), (121.0, 126.0), (169.0, 166.0)];
        assert!((exponent(&noisy).expect("points") - 1.0).abs() < 0.02);
    }

    #[test]
    fn what_cannot_be_fitted_has_none() {
        assert_eq!(exponent(&[]), None);
        assert_eq!(exponent(&[(9.0, 1.0)]), None);
        assert_eq!(exponent(&[(9.0, 1.0), (9.0, 2.0)]), None);
        assert_eq!(exponent(&[(9.0, 0.0), (25.0, 2.0)]), None);
        assert_eq!(exponent(&[(9.0, f64::NAN), (25.0, 2.0)]), None);
    }
}

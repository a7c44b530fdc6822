//! Percentiles of more numbers than memory should hold.

/// The least number that is told from nothing.
const LEAST: f64 = 1e-6;
/// Bins in each doubling: a percentile is at most 1.1 % too large.
const BINS_PER_OCTAVE: f64 = 64.0;
/// Up to a hundred million.
const BINS: usize = 64 * 47;

/// Numbers that are not negative, in bins by their logarithm; the largest exactly.
#[derive(Clone, Debug)]
pub struct Percentiles {
    bins: Vec<u64>,
    count: u64,
    largest: f64,
}

impl Default for Percentiles {
    fn default() -> Self {
        Self { bins: vec![0; BINS], count: 0, largest: 0.0 }
    }
}

impl Percentiles {
    /// Takes a number in.
    pub fn add(&mut self, value: f64) {
        let bin = ((value / LEAST).log2() * BINS_PER_OCTAVE).ceil().clamp(0.0, (BINS - 1) as f64);
        self.bins[bin as usize] += 1;
        self.count += 1;
        self.largest = self.largest.max(value);
    }

    /// The largest; `None` without numbers.
    pub fn largest(&self) -> Option<f64> {
        (self.count > 0).then_some(self.largest)
    }

    /// So many percent are no larger, to 1.1 % of itself; `None` without numbers.
    pub fn at(&self, percent: f64) -> Option<f64> {
        let wanted = (self.count as f64 * percent / 100.0).ceil() as u64;
        let mut passed = 0;
        let within = |bin: &u64| {
            passed += bin;
            passed >= wanted
        };
        let bin = self.bins.iter().position(within)?;
        (self.count > 0).then(|| (LEAST * (bin as f64 / BINS_PER_OCTAVE).exp2()).min(self.largest))
    }
}

/// The middle of some numbers; 0 of none.
pub fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_of_a_thousand_numbers_are_theirs() {
        let mut numbers = Percentiles::default();
        assert_eq!((numbers.largest(), numbers.at(99.0)), (None, None));
        (1..=1000).for_each(|number| numbers.add(f64::from(number) * 0.01));
        assert_eq!(numbers.largest(), Some(10.0));
        for (percent, exact) in [(50.0, 5.0), (99.0, 9.9), (100.0, 10.0)] {
            let found = numbers.at(percent).expect("numbers");
            assert!((exact..=exact * 1.011).contains(&found), "{percent} %: {found} instead of {exact}");
        }
    }

    #[test]
    fn nothing_and_the_absurd_have_their_bins() {
        let mut numbers = Percentiles::default();
        numbers.add(0.0);
        numbers.add(1e30);
        assert_eq!(numbers.largest(), Some(1e30));
        assert!(numbers.at(50.0).is_some_and(|half| half <= 1e-6));
    }
}

//! A set of small numbers, of which the lowest is asked for: a bit each, so that nothing is allocated while it changes.

/// Numbers below an end.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BitSet {
    words: Vec<u64>,
    count: usize,
    /// No word before this one has a bit set.
    first_word: usize,
}

impl BitSet {
    /// None of the numbers below `end`.
    pub fn none(end: usize) -> Self {
        Self { words: vec![0; end.div_ceil(64)], count: 0, first_word: 0 }
    }

    /// All numbers below `end`.
    pub fn all(end: usize) -> Self {
        let mut set = Self::none(end);
        for number in 0..end {
            set.insert(number);
        }
        set
    }

    /// How many numbers are in it.
    pub fn count(&self) -> usize {
        self.count
    }

    /// The bits of 64 numbers, the first of which is 64 times as large as `at`.
    pub(crate) fn word(&self, at: usize) -> u64 {
        self.words[at]
    }

    /// Whether a number is in it.
    pub fn contains(&self, number: usize) -> bool {
        self.words[number / 64] >> (number % 64) & 1 != 0
    }

    /// Adds a number; false where it was there.
    pub fn insert(&mut self, number: usize) -> bool {
        let is_new = !self.contains(number);
        self.words[number / 64] |= 1 << (number % 64);
        self.count += usize::from(is_new);
        self.first_word = self.first_word.min(number / 64);
        is_new
    }

    /// Takes a number out; false where it was not there.
    pub fn remove(&mut self, number: usize) -> bool {
        let was_there = self.contains(number);
        self.words[number / 64] &= !(1 << (number % 64));
        self.count -= usize::from(was_there);
        was_there
    }

    /// All of them, ascending.
    pub fn iter(&self) -> impl Iterator<Item = usize> + '_ {
        let words = self.words.iter().enumerate().skip(self.first_word);
        words.flat_map(|(at, word)| {
            let mut left = *word;
            std::iter::from_fn(move || {
                let lowest = (left != 0).then(|| left.trailing_zeros() as usize)?;
                left &= left - 1;
                Some(at * 64 + lowest)
            })
        })
    }

    /// The lowest number.
    pub fn first(&mut self) -> Option<usize> {
        let after = self.words[self.first_word.min(self.words.len())..].iter().position(|word| *word != 0);
        self.first_word = after.map_or(self.words.len(), |after| self.first_word + after);
        let word = self.words.get(self.first_word)?;
        Some(self.first_word * 64 + word.trailing_zeros() as usize)
    }

    /// Takes the lowest number out.
    pub fn pop_first(&mut self) -> Option<usize> {
        let first = self.first()?;
        self.remove(first);
        Some(first)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::Dice;
    use std::collections::BTreeSet;

    #[test]
    fn it_holds_what_a_tree_holds() {
        let mut dice = Dice::new(3);
        for count in [1, 63, 64, 65, 1000] {
            let (mut set, mut tree) = (BitSet::all(count), (0..count).collect::<BTreeSet<_>>());
            for step in 0..2000 {
                let number = dice.below(count as u64) as usize;
                match dice.below(5) {
                    0 => assert_eq!(set.insert(number), tree.insert(number)),
                    1 | 2 => assert_eq!(set.remove(number), tree.remove(&number)),
                    3 => assert_eq!(set.pop_first(), tree.pop_first()),
                    _ => assert_eq!(set.contains(number), tree.contains(&number)),
                }
                assert!(set.iter().eq(tree.iter().copied()), "{count}, step {step}");
                assert_eq!(
                    (set.first(), set.count()),
                    (tree.first().copied(), tree.len()),
                    "{count}, step {step}"
                );
            }
        }
    }

    #[test]
    fn a_set_of_nothing_has_no_lowest() {
        let mut set = BitSet::none(0);
        assert_eq!((set.first(), set.pop_first(), set.count()), (None, None, 0));
    }
}

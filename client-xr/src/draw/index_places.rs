//! Places of patches among the indices of a draw list. Each patch keeps its place while it is drawn, so a list changes by
//! differences. A removed patch leaves a hole for the next patch with as many indices. Pure.

/// How many indices a patch can have: one to three triangles, with one side or two.
const SIZES: [u32; 5] = [3, 6, 9, 12, 18];

/// Holes are drawn as triangles without area: no more of them than one part in so many of what is drawn, and some.
const MOST_HOLES_PART: u32 = 4;
const MOST_HOLES: u32 = 3 * 256;

/// See the module. Counts and places are of indices.
#[derive(Clone, Debug, Default)]
pub struct IndexPlaces {
    end: u32,
    holes: [Vec<u32>; SIZES.len()],
    hole_count: u32,
}

fn size_class(count: u32) -> usize {
    SIZES.iter().position(|size| *size == count).expect("whole triangles of a patch")
}

impl IndexPlaces {
    /// A place for so many indices.
    pub fn take(&mut self, count: u32) -> u32 {
        if let Some(place) = self.holes[size_class(count)].pop() {
            self.hole_count -= count;
            return place;
        }
        let place = self.end;
        self.end += count;
        place
    }

    /// A place is free.
    pub fn give(&mut self, place: u32, count: u32) {
        self.holes[size_class(count)].push(place);
        self.hole_count += count;
    }

    /// Indices from the first place to the end of the last, holes included.
    pub fn end(&self) -> u32 {
        self.end
    }

    /// Whether so much of it is holes that it is better to place all anew.
    pub fn is_sparse(&self) -> bool {
        self.hole_count > MOST_HOLES + (self.end - self.hole_count) / MOST_HOLES_PART
    }

    /// Nothing has a place.
    pub fn clear(&mut self) {
        (self.end, self.hole_count) = (0, 0);
        self.holes.iter_mut().for_each(Vec::clear);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng, rngs::StdRng};

    #[test]
    fn no_place_is_given_twice_and_holes_are_taken_again() {
        for seed in 0..20 {
            let mut rng = StdRng::seed_from_u64(seed);
            let (mut places, mut held) = (IndexPlaces::default(), Vec::<(u32, u32)>::new());
            for _ in 0..2000 {
                if held.is_empty() || rng.random_range(0..100) < 52 {
                    let count = SIZES[rng.random_range(0..SIZES.len())];
                    let place = places.take(count);
                    assert!(place + count <= places.end());
                    let is_free = |(at, size): &(u32, u32)| place + count <= *at || at + size <= place;
                    assert!(held.iter().all(is_free), "seed {seed}: {place}");
                    held.push((place, count));
                } else {
                    let (place, count) = held.swap_remove(rng.random_range(0..held.len()));
                    places.give(place, count);
                }
                let live: u32 = held.iter().map(|(_, count)| count).sum();
                assert_eq!(live + places.hole_count, places.end());
            }
        }
    }

    #[test]
    fn what_is_mostly_holes_is_sparse_and_what_is_small_is_not() {
        let mut places = IndexPlaces::default();
        let all: Vec<u32> = (0..1000).map(|_| places.take(6)).collect();
        assert!(!places.is_sparse());
        all.iter().take(200).for_each(|place| places.give(*place, 6));
        assert!(!places.is_sparse(), "{places:?}");
        all.iter().skip(200).take(300).for_each(|place| places.give(*place, 6));
        assert!(places.is_sparse());
        places.clear();
        assert!(!places.is_sparse() && places.end() == 0);
    }
}

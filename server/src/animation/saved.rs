//! Places of the skinned vertices: one for instances at rest, one per needed sample time for the others. Pure.
//!
//! Vertices are numbered through all buffers. Every device can bind a buffer of [`CHUNK_VERTICES`]; an instance lies in one
//! buffer.

use super::packing::SAVED_BYTES;
use crate::time::RingPlace;
use shadecast_shaders::constants::{CHUNK_VERTICES, SAVED_CHUNKS};
use std::ops::Range;

/// Vertices of all buffers.
const MOST_VERTICES: u32 = SAVED_CHUNKS * CHUNK_VERTICES;
/// Sample times that are kept at least: those of one update, what it is shaded for among them, and what the last update is shaded for meanwhile.
pub(crate) const LEAST_PLACES: u32 = crate::time::VIEW_TIMES as u32 + 2;
/// Sample times that are kept at most: those of a few viewers.
pub const MOST_PLACES: u32 = 16;
const _: () = assert!(CHUNK_VERTICES as u64 * SAVED_BYTES <= 128 << 20);

/// An instance that has vertices.
#[derive(Clone, Copy, Debug)]
pub struct InstanceVertices {
    /// How many.
    pub count: u32,
    /// Whether any of them moves.
    pub moves: bool,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct Saved {
    instances: Vec<InstanceVertices>,
    /// By instance: its first vertex, where it stands still.
    still: Vec<u32>,
    places: Vec<Place>,
    /// By place, then by instance: its first vertex.
    bases: Vec<Option<u32>>,
    end: u32,
}

/// Room for a sample time.
#[derive(Clone, Debug)]
struct Place {
    room: Range<u32>,
    /// What is free begins here.
    next: u32,
}

impl Saved {
    /// For these instances, and so many sample times. `None` where what stands still alone is more than all buffers hold.
    pub fn new(instances: Vec<InstanceVertices>, places: u32) -> Option<Self> {
        let mut end = 0;
        let mut place_still = |instance: &InstanceVertices| {
            let base = if instance.moves { end } else { run(end, instance.count)? };
            end = if instance.moves { end } else { base + instance.count };
            (end <= MOST_VERTICES).then_some(base)
        };
        let still = instances.iter().map(&mut place_still).collect::<Option<Vec<u32>>>()?;
        let share = (MOST_VERTICES - end) / places.max(1);
        let moving = || instances.iter().filter(|instance| instance.moves).map(|instance| instance.count);
        let (all, largest) = (moving().map(u64::from).sum::<u64>(), moving().max().unwrap_or(0));
        let mut place = |_| {
            let room = end..room_end(end, all, largest).min(u64::from(end + share)) as u32;
            end = room.end;
            Place { next: room.start, room }
        };
        let places: Vec<Place> = (0..places).map(&mut place).collect();
        let bases = vec![None; places.len() * instances.len()];
        Some(Self { still, places, bases, end, instances })
    }

    /// How many sample times of these instances are worth their memory: as many as lie in one buffer.
    pub fn places_for(instances: &[InstanceVertices]) -> u32 {
        let of = |moves: bool| -> u64 {
            instances.iter().filter(|instance| instance.moves == moves).map(|i| u64::from(i.count)).sum()
        };
        let left = u64::from(CHUNK_VERTICES).saturating_sub(of(false));
        (left / of(true).max(1)).clamp(u64::from(LEAST_PLACES), u64::from(MOST_PLACES)) as u32
    }

    /// How many vertices each buffer holds: one at least, all but the last [`CHUNK_VERTICES`].
    pub fn chunks(&self) -> Vec<u32> {
        let chunk = |first: u32| (self.end - first).min(CHUNK_VERTICES);
        let chunks: Vec<u32> = (0..self.end).step_by(CHUNK_VERTICES as usize).map(chunk).collect();
        if chunks.is_empty() { vec![1] } else { chunks }
    }

    /// A place holds another time from now on: nothing yet.
    pub(crate) fn begin(&mut self, place: RingPlace) {
        let of_place = &mut self.places[place.index()];
        of_place.next = of_place.room.start;
        let count = self.instances.len();
        self.bases[place.index() * count..][..count].fill(None);
    }

    /// Makes room for an instance in a place, unless it has; gives its first vertex. `None` where the place is full.
    pub(crate) fn keep(&mut self, instance: usize, place: RingPlace) -> Option<u32> {
        if let Some(base) = self.base(instance, place) {
            return Some(base);
        }
        let (count, of_place) = (self.instances[instance].count, &mut self.places[place.index()]);
        let base = run(of_place.next, count).filter(|base| base + count <= of_place.room.end)?;
        of_place.next = base + count;
        self.bases[place.index() * self.instances.len() + instance] = Some(base);
        Some(base)
    }

    /// The first vertex of an instance in a place; `None` where it is not there.
    pub(crate) fn base(&self, instance: usize, place: RingPlace) -> Option<u32> {
        match self.instances[instance].moves {
            true => self.bases[place.index() * self.instances.len() + instance],
            false => Some(self.still[instance]),
        }
    }
}

/// Where the room ends that begins at `start` and that so many vertices have in any order, in runs of the `largest` at most: what
/// would lie across the end of a buffer begins in the next.
fn room_end(start: u32, vertices: u64, largest: u32) -> u64 {
    let chunk = u64::from(CHUNK_VERTICES);
    let mut end = u64::from(start) + vertices;
    while end <= u64::from(MOST_VERTICES) {
        let crossed = end.div_ceil(chunk) - (u64::from(start) / chunk + 1).min(end.div_ceil(chunk));
        let wanted = u64::from(start) + vertices + crossed * u64::from(largest);
        if wanted <= end {
            break;
        }
        end = wanted;
    }
    end
}

/// Where so many vertices begin, at `next` or later, that lie in one buffer. `None` where none holds as many.
fn run(next: u32, count: u32) -> Option<u32> {
    let left = CHUNK_VERTICES - next % CHUNK_VERTICES;
    let base = if count <= left { next } else { next + left };
    (count <= CHUNK_VERTICES).then_some(base)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::seq::SliceRandom;
    use rand::{Rng, SeedableRng, rngs::SmallRng};

    fn saved(instances: &[InstanceVertices], places: u32) -> Saved {
        Saved::new(instances.to_vec(), places).expect("it fits")
    }

    fn some(count: u32, moves: bool, times: usize) -> Vec<InstanceVertices> {
        vec![InstanceVertices { count, moves }; times]
    }

    #[test]
    fn no_two_vertices_share_a_place() {
        let mut rng = SmallRng::seed_from_u64(31);
        for case in 0..200 {
            let largest = [50, 40_000, 1_200_000][case % 3];
            let instance = |_| InstanceVertices { count: rng.random_range(1..largest), moves: rng.random() };
            let instances: Vec<_> = (0..20).map(instance).collect();
            let mut saved = saved(&instances, LEAST_PLACES);
            let mut runs = Vec::new();
            let mut order: Vec<usize> = (0..20).collect();
            for place in (0..LEAST_PLACES).map(RingPlace) {
                order.shuffle(&mut rng);
                saved.begin(place);
                for instance in order.iter().copied() {
                    let base = saved.keep(instance, place);
                    let base = base.unwrap_or_else(|| panic!("seed 31, case {case}: no room for {instance}"));
                    assert_eq!(saved.base(instance, place), Some(base));
                    let count = instances[instance].count;
                    assert_eq!(base / CHUNK_VERTICES, (base + count - 1) / CHUNK_VERTICES);
                    runs.push((base, base + count, instance));
                }
            }
            runs.sort_unstable();
            runs.dedup();
            let apart = |pair: &[(u32, u32, usize)]| pair[0].1 <= pair[1].0;
            assert!(runs.windows(2).all(apart), "seed 31, case {case}");
            let last = runs.last().expect("twenty").1;
            assert!(u64::from(last) <= saved.chunks().iter().map(|count| u64::from(*count)).sum::<u64>());
        }
    }

    #[test]
    fn a_hundred_and_sixty_nine_dragons_lie_in_two_buffers() {
        let dragons = some(22_000, true, 169);
        assert_eq!(Saved::places_for(&dragons), LEAST_PLACES);
        assert_eq!(saved(&dragons, LEAST_PLACES).chunks().len(), 2);
        assert_eq!(Saved::places_for(&some(22_000, true, 9)), MOST_PLACES);
    }

    #[test]
    fn a_place_that_begins_anew_has_all_its_room_again() {
        let mut saved = saved(&some(10, true, 3), 2);
        for _ in 0..1000 {
            saved.begin(RingPlace(1));
            assert!((0..3).all(|instance| saved.base(instance, RingPlace(1)).is_none()));
            assert!((0..3).all(|instance| saved.keep(instance, RingPlace(1)).is_some()));
        }
        assert!(saved.base(0, RingPlace(0)).is_none(), "the other place is another");
    }

    #[test]
    fn the_first_vertices_have_room_in_full_buffers() {
        let dragons = some(22_000, true, 2000);
        let mut saved = saved(&dragons, LEAST_PLACES);
        assert_eq!(saved.chunks().len() as u32, SAVED_CHUNKS);
        let kept = (0..2000).take_while(|instance| saved.keep(*instance, RingPlace(3)).is_some()).count();
        assert!((560..660).contains(&kept), "{kept}");
        assert_eq!(saved.keep(1999, RingPlace(3)), None);
        assert!(Saved::new(some(22_000, false, 4000), 4).is_none(), "what stands still has no other place");
        assert!(Saved::new(some(CHUNK_VERTICES + 1, false, 1), 4).is_none());
    }

    #[test]
    fn a_scene_without_vertices_has_a_buffer_all_the_same() {
        assert_eq!(saved(&[], LEAST_PLACES).chunks(), [1]);
    }
}

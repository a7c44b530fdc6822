//! The blocks to shade with an update: those with changed inputs. Pure.
//!
//! A block is remembered with the head that it was shaded for. Due are moving patches, patches in moving shadows or light, and
//! patches that the head sees differently by more than `SEEN_STEPS`. Where the budget is too small, new blocks go first,
//! because their places hold nothing. Next come blocks that have waited too long; then the largest, most changed and longest
//! waiting ones.

use crate::atlas::placement::Placed;
use crate::atlas::surround::SHADED_EVERY_UPDATES;
use crate::scene::gloss::{Gloss, Seen};
use crate::scene::numbering::ScenePatch;
use crate::shading::shadow_change::{ShadowChange, SunBox};
use glam::Vec3;
use shadecast_protocol::atlas::Block;
use shadecast_protocol::pose::Pose;
use std::cmp::Reverse;

/// Steps of an 8-bit display value by which a block may look different from where the head is now.
pub(crate) const SEEN_STEPS: f32 = 1.5;
/// Updates after which a block that waits goes before all others but new ones.
pub(crate) const PATIENCE_UPDATES: u32 = 8;
/// Part of what an update may shade that is left to what waits, however much is new.
pub(crate) const LEAST_OLD_SHARE: f32 = 0.25;
/// What it counts that something moved, or that its light changed, in steps: no bound is known.
const CHANGED_STEPS: f32 = 32.0;

/// Why a block is shaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// The patch had no block, or another one.
    New,
    /// Its surface has moved.
    Moved,
    /// A lamp that reaches it has changed.
    Lamp,
    /// A shadow may have moved over it.
    Shadow,
    /// It looks different from where the head is now.
    Seen,
}

/// How many causes there are.
pub const CAUSES: usize = 5;

/// A lamp at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lamp {
    /// All that shading knows of it.
    pub words: [f32; 16],
    /// Where it is in the world.
    pub position: Vec3,
    /// How far it reaches, metres; infinity for one without an end.
    pub range_m: f32,
}

/// What shading depends on at a time; `S` tells one stance of an instance from another.
#[derive(Clone, Debug, Default)]
pub struct Moment<S> {
    /// By instance.
    pub stances: Vec<S>,
    /// By instance, the box of one that casts a shadow.
    pub casters: Vec<Option<SunBox>>,
    /// All of them.
    pub lamps: Vec<Lamp>,
}

/// A patch as light and eye find it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Receiver {
    /// Of a ball that holds it.
    pub centre: Vec3,
    /// Of that ball, metres.
    pub radius_m: f32,
    /// Unit; of a patch that is nearly flat.
    pub normal: Option<Vec3>,
    /// Where the sun casts shadows, as they are looked up.
    pub in_sun: Option<SunBox>,
    /// What its material makes of it.
    pub gloss: Gloss,
}

/// The surfaces of a scene, as they are now.
pub trait Surfaces {
    /// Which instance a patch belongs to.
    fn instance(&self, patch: ScenePatch) -> usize;
    /// Whether an instance can be shaded now: what cannot keeps its colours, and is as new when it can.
    fn is_there(&self, instance: usize) -> bool;
    /// A patch, gutter of its block included.
    fn receiver(&self, patch: ScenePatch, block: Block) -> Receiver;
    /// How far an eye may go until it sees the other side of a patch that has two, metres.
    fn turns_after_m(&self, patch: ScenePatch, eye: Vec3) -> f32;
}

/// A block to be shaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Due {
    /// The patch.
    pub patch: ScenePatch,
    /// Its block.
    pub block: Block,
    /// Why.
    pub cause: Cause,
}

/// What an update shaded, and what it did not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Reused {
    /// Blocks with a patch.
    pub blocks: u32,
    /// Of those, the ones that were shaded, by [`Cause`].
    pub shaded: [u32; CAUSES],
    /// Those that were due and had to wait.
    pub waiting: u32,
    /// Texels of all these blocks.
    pub texels: u64,
    /// Texels of the blocks that were shaded.
    pub shaded_texels: u64,
}

impl Reused {
    /// Part of the texels that was not shaded, 0..1.
    pub fn share(&self) -> f32 {
        1.0 - self.shaded_texels as f32 / self.texels.max(1) as f32
    }

    /// Blocks that were shaded.
    pub fn shaded_blocks(&self) -> u32 {
        self.shaded.iter().sum()
    }
}

/// A block as it was shaded.
#[derive(Clone, Copy, Debug)]
struct Record {
    patch: ScenePatch,
    block: Block,
    instance: u32,
    world_from_head: Pose,
    turns_after_m: f32,
    receiver: Option<Receiver>,
    /// What is due, and since which update; what is not does not wait.
    waits: Option<(Cause, u32)>,
    /// By how much it looks different, steps of the display.
    steps: f32,
    is_around: bool,
}

/// See the module.
#[derive(Clone, Debug)]
pub struct Reuse<S> {
    is_on: bool,
    /// Of the last update and of the one before; `None` before the first.
    moments: Option<[Moment<S>; 2]>,
    moved: Vec<bool>,
    shadows: ShadowChange,
    /// Lamps that changed, as they were and as they are.
    lamps: Vec<Lamp>,
    /// Ascending by patch.
    records: Vec<Record>,
    before: Vec<Record>,
    order: Vec<u32>,
    due: Vec<Due>,
    update: u32,
    reused: Reused,
    /// Texels of all updates: of all blocks, and of those that were shaded.
    total_texels: [u64; 2],
}

impl<S: PartialEq + Default> Reuse<S> {
    /// Before the first update. If it is off, all in view is due with each update.
    pub fn new(is_on: bool) -> Self {
        Self {
            is_on,
            moments: None,
            moved: Vec::new(),
            shadows: ShadowChange::default(),
            lamps: Vec::new(),
            records: Vec::new(),
            before: Vec::new(),
            order: Vec::new(),
            due: Vec::new(),
            update: 0,
            reused: Reused::default(),
            total_texels: [0; 2],
        }
    }

    /// What is due with the next update, ascending: of the blocks that there are now, given ascending by patch, seen by a head at a
    /// moment, which is written over an old one. `budget_texels` is what may be shaded beside new blocks. All of it counts as shaded.
    pub fn due(
        &mut self,
        moment: impl FnOnce(&mut Moment<S>),
        world_from_head: Pose,
        placed: impl Iterator<Item = Placed>,
        surfaces: &impl Surfaces,
        budget_texels: u64,
    ) -> &[Due] {
        self.update += 1;
        self.compare(moment);
        self.follow(placed, world_from_head, surfaces);
        for at in 0..self.records.len() {
            self.judge(at, world_from_head, surfaces);
        }
        self.choose(budget_texels);
        self.shade(world_from_head, surfaces);
        &self.due
    }

    /// What the last update shaded and did not.
    pub fn reused(&self) -> Reused {
        self.reused
    }

    /// Part of the texels that was not shaded, over all updates, 0..1.
    pub(crate) fn total_share(&self) -> f32 {
        let [all, shaded] = self.total_texels.map(|texels| texels as f64);
        (1.0 - shaded / all.max(1.0)) as f32
    }

    /// What has changed since the last moment.
    fn compare(&mut self, moment: impl FnOnce(&mut Moment<S>)) {
        self.moved.clear();
        self.shadows.clear();
        self.lamps.clear();
        let is_first = self.moments.is_none();
        let [now, last] = self.moments.get_or_insert_default();
        std::mem::swap(now, last);
        moment(now);
        if is_first {
            self.moved.resize(now.stances.len(), true);
            return;
        }
        self.moved.extend(last.stances.iter().zip(&now.stances).map(|(last, now)| last != now));
        for ((last, now), has_moved) in last.casters.iter().zip(&now.casters).zip(&self.moved) {
            if *has_moved || last != now {
                [last, now].into_iter().flatten().for_each(|caster| self.shadows.add(*caster));
            }
        }
        let most = last.lamps.len().max(now.lamps.len());
        for (last, now) in (0..most).map(|lamp| (last.lamps.get(lamp), now.lamps.get(lamp))) {
            if last != now {
                self.lamps.extend([last, now].into_iter().flatten());
            }
        }
    }

    /// Takes in which patch has which block now.
    fn follow(
        &mut self,
        placed: impl Iterator<Item = Placed>,
        world_from_head: Pose,
        surfaces: &impl Surfaces,
    ) {
        std::mem::swap(&mut self.records, &mut self.before);
        self.records.clear();
        let mut before = self.before.iter().peekable();
        for Placed { patch, block, is_around } in placed {
            while before.next_if(|record| record.patch < patch).is_some() {}
            let known = before.next_if(|record| record.patch == patch && record.block == block);
            let new = || Record {
                patch,
                block,
                instance: surfaces.instance(patch) as u32,
                world_from_head,
                turns_after_m: f32::INFINITY,
                receiver: None,
                waits: Some((Cause::New, self.update)),
                steps: 0.0,
                is_around,
            };
            let record = known.map_or_else(new, |known| Record { is_around, ..*known });
            if surfaces.is_there(record.instance as usize) {
                self.records.push(record);
            }
        }
    }

    /// Whether a block is due, and by how much it looks different.
    fn judge(&mut self, at: usize, world_from_head: Pose, surfaces: &impl Surfaces) {
        let record = &mut self.records[at];
        if self.moved[record.instance as usize] {
            record.receiver = None;
        }
        let is_new = matches!(record.waits, Some((Cause::New, _)));
        if is_new {
            return;
        }
        let light = if !self.is_on || self.moved[record.instance as usize] {
            Some(Cause::Moved)
        } else if self.lamps.is_empty() && !self.shadows.is_any() {
            None
        } else {
            let (patch, block) = (record.patch, record.block);
            let receiver = record.receiver.get_or_insert_with(|| surfaces.receiver(patch, block));
            let lit = || receiver.gloss.is_lit;
            let is_lamp = lit() && self.lamps.iter().any(|lamp| receiver.is_in_reach(lamp));
            let is_shadow = || lit() && receiver.in_sun.is_some_and(|own| self.shadows.reaches(&own));
            is_lamp.then_some(Cause::Lamp).or_else(|| is_shadow().then_some(Cause::Shadow))
        };
        let earlier = record.waits.filter(|(cause, _)| *cause != Cause::Seen).map(|(cause, _)| cause);
        let lasting = light.into_iter().chain(earlier).min();
        record.steps =
            if lasting.is_some() { CHANGED_STEPS } else { record.seen_steps(world_from_head, surfaces) };
        let cause = lasting.or_else(|| (record.steps > SEEN_STEPS).then_some(Cause::Seen));
        record.waits = cause.map(|cause| (cause, record.waits.map_or(self.update, |(_, since)| since)));
    }

    /// Lists what is shaded of what is due.
    fn choose(&mut self, budget_texels: u64) {
        let (records, update) = (&self.records, self.update);
        let turn = update % SHADED_EVERY_UPDATES;
        let may_be = |record: &Record| match record.waits {
            Some((Cause::New, _)) => true,
            Some(_) => !record.is_around || record.patch.0 % SHADED_EVERY_UPDATES == turn,
            None => false,
        };
        let order = &mut self.order;
        order.clear();
        order.extend((0..records.len() as u32).filter(|at| may_be(&records[*at as usize])));
        let texels = |at: &u32| u64::from(records[*at as usize].block.size.texels());
        let (due, new) = (order.iter().map(texels).sum::<u64>(), |at: &&u32| records[**at as usize].is_new());
        let new_texels: u64 = order.iter().filter(new).map(texels).sum();
        self.reused.waiting = 0;
        if due > budget_texels {
            order.sort_unstable_by_key(|at| records[*at as usize].rank(update));
            let least = (budget_texels as f64 * f64::from(LEAST_OLD_SHARE)) as u64;
            let allowed = new_texels + budget_texels.saturating_sub(new_texels).max(least);
            let mut taken = 0;
            let fits = |at: &&u32| {
                let is_first_old = taken == new_texels;
                taken += texels(at);
                records[**at as usize].is_new() || is_first_old || taken <= allowed
            };
            let count = order.iter().take_while(fits).count();
            self.reused.waiting = (order.len() - count) as u32;
            order.truncate(count);
            order.sort_unstable();
        }
    }

    /// What was chosen is as it is to be.
    fn shade(&mut self, world_from_head: Pose, surfaces: &impl Surfaces) {
        self.due.clear();
        let texels: u64 = self.records.iter().map(|record| u64::from(record.block.size.texels())).sum();
        self.reused = Reused {
            blocks: self.records.len() as u32,
            texels,
            waiting: self.reused.waiting,
            ..Reused::default()
        };
        for at in &self.order {
            let record = &mut self.records[*at as usize];
            let Some((cause, _)) = record.waits.take() else { continue };
            record.world_from_head = world_from_head;
            record.turns_after_m = surfaces.turns_after_m(record.patch, world_from_head.position);
            record.steps = 0.0;
            self.reused.shaded[cause as usize] += 1;
            self.reused.shaded_texels += u64::from(record.block.size.texels());
            self.due.push(Due { patch: record.patch, block: record.block, cause });
        }
        self.total_texels[0] += texels;
        self.total_texels[1] += self.reused.shaded_texels;
    }
}

impl Record {
    fn is_new(&self) -> bool {
        matches!(self.waits, Some((Cause::New, _)))
    }

    /// Whose turn is first, ascending; no two are alike.
    fn rank(&self, update: u32) -> (bool, Reverse<u32>, Reverse<u64>, ScenePatch) {
        let waited = self.waits.map_or(0, |(_, since)| update - since);
        let late = if waited >= PATIENCE_UPDATES { waited } else { 0 };
        let side = (self.block.size.texels() as f32).sqrt();
        let need = (side * self.steps * (1 + waited) as f32) as u64;
        (!self.is_new(), Reverse(late), Reverse(need), self.patch)
    }

    /// By how much it looks different from a head than from that it was shaded for, steps of the display.
    fn seen_steps(&mut self, world_from_head: Pose, surfaces: &impl Surfaces) -> f32 {
        if self.world_from_head == world_from_head {
            return 0.0;
        }
        let moved_m = self.world_from_head.position.distance(world_from_head.position);
        if moved_m >= self.turns_after_m {
            return CHANGED_STEPS;
        }
        let (patch, block) = (self.patch, self.block);
        let receiver = self.receiver.get_or_insert_with(|| surfaces.receiver(patch, block));
        let seen = |head: Pose| Seen::from(head, receiver.centre, receiver.radius_m, receiver.normal);
        receiver.gloss.steps(&seen(self.world_from_head), &seen(world_from_head), moved_m)
    }
}

impl Receiver {
    fn is_in_reach(&self, lamp: &Lamp) -> bool {
        self.centre.distance(lamp.position) <= self.radius_m + lamp.range_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::lights::{SHADOW_EXTENT_TEXELS, SunView};
    use glam::Quat;
    use rand::{Rng, SeedableRng, rngs::SmallRng};
    use shadecast_protocol::atlas::{BlockAddress, BlockSize};
    use shadecast_scene::animation::bounds::Bounds;

    /// Ten patches an instance in a row along x, 1 m apart, under a sun in the zenith; the last instance has no light on it.
    struct Row {
        sun: SunView,
        absent: Option<usize>,
    }

    const PATCHES: u32 = 10;
    const INSTANCES: usize = 4;
    const GLOSS: Gloss = Gloss { steps_by_radian: 50.0, steps_by_octave: 0.0, is_lit: true };

    fn row() -> Row {
        let world = Bounds { low: Vec3::new(-1.0, -1.0, -1.0), high: Vec3::new(41.0, 3.0, 1.0) };
        let sun = SunView::around(Vec3::Y, [world].into_iter(), SHADOW_EXTENT_TEXELS).expect("casters");
        Row { sun, absent: None }
    }

    impl Row {
        fn at(patch: u32) -> Vec3 {
            Vec3::X * patch as f32
        }

        fn caster(&self, above: u32) -> Option<SunBox> {
            let middle = Self::at(above) + Vec3::Y;
            SunBox::around(&self.sun, Bounds { low: middle, high: middle }.grown(0.2).corners())
        }

        fn moment(&self, stances: [u32; INSTANCES]) -> Moment<u32> {
            Moment { stances: stances.to_vec(), casters: vec![None; INSTANCES], lamps: Vec::new() }
        }
    }

    impl Surfaces for Row {
        fn instance(&self, patch: ScenePatch) -> usize {
            (patch.0 / PATCHES) as usize
        }

        fn is_there(&self, instance: usize) -> bool {
            self.absent != Some(instance)
        }

        fn receiver(&self, patch: ScenePatch, _: Block) -> Receiver {
            let centre = Self::at(patch.0);
            let in_sun = SunBox::around(&self.sun, [centre]).map(|own| own.as_looked_up(&self.sun));
            let gloss = if self.instance(patch) + 1 < INSTANCES { GLOSS } else { Gloss::default() };
            Receiver { centre, radius_m: 0.1, normal: None, in_sun, gloss }
        }

        fn turns_after_m(&self, patch: ScenePatch, _: Vec3) -> f32 {
            if patch.0 == 3 { 0.0 } else { f32::INFINITY }
        }
    }

    fn block(x: u16, side_log2: u8) -> Block {
        Block {
            address: BlockAddress { x, y: 0 },
            size: BlockSize::new(side_log2, side_log2).expect("a size"),
        }
    }

    /// All patches with blocks of 8x8 texels.
    fn all() -> Vec<Placed> {
        let placed = |patch: u32| Placed {
            patch: ScenePatch(patch),
            block: block(8 * patch as u16, 3),
            is_around: false,
        };
        (0..PATCHES * INSTANCES as u32).map(placed).collect()
    }

    const HEAD: Pose = Pose { position: Vec3::new(0.0, 1.0, 5.0), orientation: Quat::IDENTITY };

    fn due(reuse: &mut Reuse<u32>, row: &Row, moment: Moment<u32>, placed: &[Placed]) -> Vec<(u32, Cause)> {
        let due = reuse.due(|now| *now = moment, HEAD, placed.iter().copied(), row, u64::MAX);
        due.iter().map(|due| (due.patch.0, due.cause)).collect()
    }

    fn of(cause: Cause, patches: impl Iterator<Item = u32>) -> Vec<(u32, Cause)> {
        patches.map(|patch| (patch, cause)).collect()
    }

    #[test]
    fn all_is_new_at_first_and_nothing_is_due_while_nothing_changes() {
        let (row, mut reuse) = (row(), Reuse::new(true));
        assert_eq!(due(&mut reuse, &row, row.moment([0; 4]), &all()), of(Cause::New, 0..40));
        for _ in 0..20 {
            assert_eq!(due(&mut reuse, &row, row.moment([0; 4]), &all()), []);
        }
        let reused = reuse.reused();
        assert_eq!((reused.blocks, reused.texels, reused.share()), (40, 40 * 64, 1.0));
    }

    #[test]
    fn moved_resized_and_returning_blocks_are_new() {
        let (row, mut reuse) = (row(), Reuse::new(true));
        due(&mut reuse, &row, row.moment([0; 4]), &all());
        let mut placed = all();
        (placed[4].block, placed[7].block) = (block(1000, 3), block(8 * 7, 2));
        assert_eq!(due(&mut reuse, &row, row.moment([0; 4]), &placed), of(Cause::New, [4, 7].into_iter()));
        placed.remove(20);
        assert_eq!(due(&mut reuse, &row, row.moment([0; 4]), &placed), []);
        let mut back = placed.clone();
        back.insert(20, all()[20]);
        assert_eq!(due(&mut reuse, &row, row.moment([0; 4]), &back), of(Cause::New, 20..21));
    }

    #[test]
    fn only_moving_patches_are_due() {
        let (row, mut reuse) = (row(), Reuse::new(true));
        due(&mut reuse, &row, row.moment([0; 4]), &all());
        assert_eq!(due(&mut reuse, &row, row.moment([0, 1, 0, 0]), &all()), of(Cause::Moved, 10..20));
        assert_eq!(due(&mut reuse, &row, row.moment([0, 1, 0, 0]), &all()), []);
    }

    #[test]
    fn a_moving_shadow_makes_old_and_new_places_due() {
        let (row, mut reuse) = (row(), Reuse::new(true));
        let above = |patch: u32| {
            let mut moment = row.moment([0; 4]);
            moment.casters[0] = row.caster(patch);
            moment
        };
        due(&mut reuse, &row, above(5), &all());
        assert_eq!(due(&mut reuse, &row, above(5), &all()), []);
        let found = due(&mut reuse, &row, above(22), &all());
        let is_shadow = |patch: u32| found.contains(&(patch, Cause::Shadow));
        assert!(is_shadow(5) && is_shadow(22), "{found:?}");
        assert!(found.len() < 10 && !is_shadow(12), "{found:?}");
        due(&mut reuse, &row, above(35), &all());
        assert_eq!(
            due(&mut reuse, &row, row.moment([0; 4]), &all()),
            [],
            "no light falls on the last instance"
        );
    }

    #[test]
    fn a_lamp_that_changes_is_due_as_far_as_it_reaches() {
        let (row, mut reuse) = (row(), Reuse::new(true));
        let lit = |strength: f32, range_m: f32| {
            let lamp = Lamp { words: [strength; 16], position: Row::at(6), range_m };
            Moment { lamps: vec![lamp], ..row.moment([0; 4]) }
        };
        due(&mut reuse, &row, lit(1.0, 2.5), &all());
        assert_eq!(due(&mut reuse, &row, lit(1.0, 2.5), &all()), []);
        assert_eq!(due(&mut reuse, &row, lit(2.0, 2.5), &all()), of(Cause::Lamp, 4..9));
        assert_eq!(due(&mut reuse, &row, row.moment([0; 4]), &all()), of(Cause::Lamp, 4..9), "it is gone");
        assert_eq!(due(&mut reuse, &row, lit(1.0, f32::INFINITY), &all()), of(Cause::Lamp, 0..30));
    }

    #[test]
    fn a_sidestep_shades_near_blocks_again() {
        let (row, mut reuse) = (row(), Reuse::new(true));
        let mut shaded_from = [HEAD.position; 40];
        for step in 0..60 {
            let head = Pose { position: HEAD.position + Vec3::X * 0.03 * step as f32, ..HEAD };
            let placed = all();
            let due =
                reuse.due(|now| *now = row.moment([0; 4]), head, placed.iter().copied(), &row, u64::MAX);
            due.iter().for_each(|due| shaded_from[due.patch.index()] = head.position);
            assert!(step == 0 || due.len() < 30, "step {step}: {}", due.len());
            assert!(step == 0 || due.iter().any(|due| due.patch.0 == 3), "its other side may be seen");
            for (patch, from) in shaded_from.iter().enumerate().take(30) {
                let distance_m = Row::at(patch as u32).distance(head.position) - 0.1;
                let steps = GLOSS.steps_by_radian * from.distance(head.position) / distance_m;
                assert!(steps <= SEEN_STEPS * 1.2, "step {step}: {steps} of {patch}");
            }
        }
        assert!(
            shaded_from[30..].iter().all(|from| *from == HEAD.position),
            "nothing of it depends on the eye"
        );
    }

    #[test]
    fn without_reuse_all_is_due_and_the_surround_in_turn() {
        let (row, mut reuse) = (row(), Reuse::new(false));
        let mut placed = all();
        placed[20..].iter_mut().for_each(|placed| placed.is_around = true);
        due(&mut reuse, &row, row.moment([0; 4]), &placed);
        let mut around = [0; 20];
        for _ in 0..SHADED_EVERY_UPDATES {
            let found = due(&mut reuse, &row, row.moment([0; 4]), &placed);
            assert_eq!(found[..20], of(Cause::Moved, 0..20));
            found[20..].iter().for_each(|(patch, _)| around[*patch as usize - 20] += 1);
        }
        assert_eq!(around, [1; 20]);
    }

    #[test]
    fn what_is_not_there_is_new_when_it_is() {
        let (mut row, mut reuse) = (row(), Reuse::new(true));
        due(&mut reuse, &row, row.moment([0; 4]), &all());
        row.absent = Some(1);
        assert_eq!(due(&mut reuse, &row, row.moment([0, 1, 0, 0]), &all()), []);
        row.absent = None;
        assert_eq!(due(&mut reuse, &row, row.moment([0, 1, 0, 0]), &all()), of(Cause::New, 10..20));
    }

    #[test]
    fn a_budget_is_kept_and_nothing_waits_for_ever() {
        let (row, mut random) = (row(), SmallRng::seed_from_u64(9));
        for round in 0..40 {
            let mut reuse = Reuse::new(true);
            let budget: u64 = random.random_range(1..1500);
            let new_share = random.random_range(0.0..0.3);
            let mut placed = all();
            let mut shaded = [0u32; 40];
            // Every update leaves this much to those that wait longest, or a block.
            let least = ((budget as f32 * LEAST_OLD_SHARE) as u64 / 256).max(1);
            let most = PATIENCE_UPDATES + 40u32.div_ceil(least as u32) + 1;
            for update in 1..200u32 {
                for placed in &mut placed {
                    if random.random_bool(new_share) {
                        placed.block = block(placed.block.address.x, random.random_range(2..=4));
                    }
                }
                let due = reuse
                    .due(|now| *now = row.moment([update; 4]), HEAD, placed.iter().copied(), &row, budget)
                    .to_vec();
                assert!(due.is_sorted_by_key(|due| due.patch));
                due.iter().for_each(|due| shaded[due.patch.index()] = update);
                let texels = |is_new: bool| -> u64 {
                    let of = due.iter().filter(|due| (due.cause == Cause::New) == is_new);
                    of.map(|due| u64::from(due.block.size.texels())).sum()
                };
                let allowed =
                    budget.saturating_sub(texels(true)).max((budget as f32 * LEAST_OLD_SHARE) as u64);
                assert!(texels(false) <= allowed.max(256), "round {round}: {} of {allowed}", texels(false));
                let oldest = shaded.iter().map(|last| update - last).max().unwrap_or(0);
                assert!(
                    oldest <= most,
                    "round {round}, update {update}: {oldest} of {most}, budget {budget}"
                );
                let all_of = |placed: &Placed| reuse_is_of(&reuse, placed);
                assert!(placed.iter().all(all_of), "what is new is never left as it was");
            }
            assert_eq!(reuse.reused().waiting + reuse.reused().shaded_blocks(), 40);
        }
    }

    fn reuse_is_of(reuse: &Reuse<u32>, placed: &Placed) -> bool {
        let record = reuse.records.iter().find(|record| record.patch == placed.patch);
        record.is_some_and(|record| record.block == placed.block && !record.is_new())
    }

    #[test]
    fn of_what_waits_alike_the_largest_is_first() {
        let (row, mut reuse) = (row(), Reuse::new(true));
        let mut placed = all();
        placed[17].block = block(8 * 17, 6);
        due(&mut reuse, &row, row.moment([0; 4]), &placed);
        let first = reuse
            .due(|now| *now = row.moment([1; 4]), HEAD, placed.iter().copied(), &row, 64 * 64 + 64)
            .to_vec();
        assert_eq!(first.iter().map(|due| due.patch.0).collect::<Vec<_>>(), [0, 17]);
    }
}

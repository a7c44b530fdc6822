//! The blocks to shade with an update: those with changed inputs. Pure.
//!
//! A block is remembered with the head that it was shaded for. Due are moving patches, patches in moving shadows or light, and
//! patches that the head sees differently by more than `SEEN_STEPS`. Where the budget is too small, new blocks go first,
//! because their places hold nothing. Next come blocks that have waited too long; then the largest, most changed and longest
//! waiting ones.

use crate::atlas::placement::Placed;
use crate::atlas::surround::SHADED_EVERY_UPDATES;
use crate::scene::gloss::{Gloss, Seen, radians};
use crate::scene::numbering::ScenePatch;
use crate::scene::shine::{Facet, StillLight};
use crate::shading::shadow_change::{ShadowChange, SunBox};
use crate::support::least::sort_while;
use glam::Vec3;
use shadecast_protocol::atlas::Block;
use shadecast_protocol::pose::Pose;
use std::cmp::Reverse;

/// Steps of an 8-bit display value by which a block may look different from where the head is now.
pub(crate) const SEEN_STEPS: f32 = 1.5;
/// A copy in the store may differ by more where pictures are coded coarsely: with a quantiser beyond this one, twice as much for each so many
/// of its steps, up to this many times.
const FINE_QP: u8 = 22;
const QP_OF_TWICE: f32 = 3.0;
const MOST_TIMES: f32 = 16.0;
/// Up to this part of it what a copy mirrors is bounded; beyond, it is evaluated.
const BOUNDED_PART: f32 = 0.4;
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

/// What the bits of a block are spent for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reason {
    /// It has come into view, or into the surround.
    Entering,
    /// It has another size, or another place.
    Resized,
    /// A pixel of the display covers more or less of its texture.
    Refiltered,
    /// Light, shadow or reflection on it has changed.
    Relit,
    /// It has moved.
    Moving,
}

/// How many reasons there are.
pub(crate) const REASONS: usize = 5;

/// How many causes there are.
pub(crate) const CAUSES: usize = 5;

/// A lamp at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Lamp {
    /// All that shading knows of it.
    pub words: [f32; 16],
    /// Where it is in the world.
    pub position: Vec3,
    /// How far it reaches, metres; infinity for one without an end.
    pub range_m: f32,
}

/// What shading depends on at a time; `S` tells one stance of an instance from another.
#[derive(Clone, Debug, Default)]
pub(crate) struct Moment<S> {
    /// By instance.
    pub stances: Vec<S>,
    /// By instance, the box of one that casts a shadow.
    pub casters: Vec<Option<SunBox>>,
    /// All of them.
    pub lamps: Vec<Lamp>,
}

/// A patch as light and eye find it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Receiver {
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
pub(crate) trait Surfaces {
    /// Which instance a patch belongs to.
    fn instance(&self, patch: ScenePatch) -> usize;
    /// Whether an instance can be shaded now: what cannot keeps its colours, and is as new when it can.
    fn is_there(&self, instance: usize) -> bool;
    /// A patch, gutter of its block included.
    fn receiver(&self, patch: ScenePatch, block: Block) -> Receiver;
    /// How far an eye may go until it sees the other side of a patch that has two, metres.
    fn turns_after_m(&self, patch: ScenePatch, eye: Vec3) -> f32;
    /// The light that stays.
    fn still_light(&self) -> &StillLight;
}

/// A block to be shaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Due {
    /// The patch.
    pub patch: ScenePatch,
    /// Its block.
    pub block: Block,
    /// Why.
    pub cause: Cause,
    /// What its bits are spent for.
    pub reason: Reason,
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
    /// Where what it mirrors was evaluated for last, and by how many steps it was different.
    evaluated: Option<(Pose, f32)>,
    /// What is due, and since which update; what is not does not wait.
    waits: Option<(Cause, u32)>,
    /// Of what is due.
    reason: Reason,
    /// By how much it looks different, steps of the display.
    steps: f32,
    is_around: bool,
    is_hidden: bool,
}

/// Whose turn is first, ascending; no two are alike.
type Rank = (bool, Reverse<u32>, Reverse<u64>, ScenePatch);

/// See the module.
#[derive(Clone, Debug)]
pub(crate) struct Reuse<S> {
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
    ranked: Vec<(Rank, u32)>,
    due: Vec<Due>,
    update: u32,
    /// Steps by which a copy in the store may differ.
    stored_steps: f32,
    reused: Reused,
    /// Texels of all updates: of all blocks, and of those that were shaded.
    total_texels: [u64; 2],
}

impl<S: PartialEq + Default> Reuse<S> {
    /// Before the first update. If it is off, all in view is due with each update.
    pub(crate) fn new(is_on: bool) -> Self {
        Self {
            is_on,
            moments: None,
            moved: Vec::new(),
            shadows: ShadowChange::default(),
            lamps: Vec::new(),
            records: Vec::new(),
            before: Vec::new(),
            order: Vec::new(),
            ranked: Vec::new(),
            due: Vec::new(),
            update: 0,
            stored_steps: SEEN_STEPS,
            reused: Reused::default(),
            total_texels: [0; 2],
        }
    }

    /// What is due with the next update, ascending: of the blocks that there are now, given ascending by patch, seen by a head at a
    /// moment, which is written over an old one. `budget_texels` is what may be shaded beside new blocks. All of it counts as shaded.
    pub(crate) fn due(
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

    /// Pictures are coded with this quantiser.
    pub(crate) fn coded(&mut self, qp: u8) {
        let coarser = f32::from(qp.saturating_sub(FINE_QP)) / QP_OF_TWICE;
        self.stored_steps = SEEN_STEPS * coarser.exp2().min(MOST_TIMES);
    }

    /// What the last update shaded, ascending.
    pub(crate) fn shaded(&self) -> &[Due] {
        &self.due
    }

    /// Copies in the store that are not what their patches look like any more.
    pub(crate) fn stale(&self) -> impl Iterator<Item = ScenePatch> + '_ {
        let is_stale = |record: &&Record| record.block.is_stored() && record.waits.is_some();
        self.records.iter().filter(is_stale).map(|record| record.patch)
    }

    /// What the last update shaded and did not.
    pub(crate) fn reused(&self) -> Reused {
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
        for Placed { patch, block, is_around, is_hidden } in placed {
            while before.next_if(|record| record.patch < patch).is_some() {}
            let last = before.next_if(|record| record.patch == patch);
            let known = last.filter(|record| record.has_become(block));
            let new = || Record {
                patch,
                block,
                instance: surfaces.instance(patch) as u32,
                world_from_head,
                turns_after_m: f32::INFINITY,
                receiver: None,
                evaluated: None,
                waits: Some((Cause::New, self.update)),
                reason: last.map_or(Reason::Entering, |last| last.reason_to_replace(is_around)),
                steps: 0.0,
                is_around,
                is_hidden,
            };
            let record = known.map_or_else(new, |known| Record { block, is_around, is_hidden, ..*known });
            if block.is_stored() || surfaces.is_there(record.instance as usize) {
                self.records.push(record);
            }
        }
    }

    /// Whether a block is due, and by how much it looks different.
    fn judge(&mut self, at: usize, world_from_head: Pose, surfaces: &impl Surfaces) {
        let record = &mut self.records[at];
        let allowed_steps = if record.block.is_stored() { self.stored_steps } else { SEEN_STEPS };
        if self.moved[record.instance as usize] {
            (record.receiver, record.evaluated) = (None, None);
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
        let [lit, filtered] = if lasting.is_some() {
            [CHANGED_STEPS, 0.0]
        } else {
            record.seen_steps(world_from_head, surfaces, allowed_steps)
        };
        record.steps = lit + filtered;
        let cause = lasting.or_else(|| (record.steps > allowed_steps).then_some(Cause::Seen));
        record.reason = match cause {
            Some(Cause::Moved) => Reason::Moving,
            Some(Cause::Seen) if filtered > lit => Reason::Refiltered,
            _ => Reason::Relit,
        };
        record.waits = cause.map(|cause| (cause, record.waits.map_or(self.update, |(_, since)| since)));
    }

    /// Lists what is shaded of what is due.
    fn choose(&mut self, budget_texels: u64) {
        let (records, update) = (&self.records, self.update);
        let turn = update % SHADED_EVERY_UPDATES;
        let may_be = |record: &Record| match record.waits {
            _ if record.block.is_stored() => false,
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
            let ranked = &mut self.ranked;
            ranked.clear();
            ranked.extend(order.iter().map(|at| (records[*at as usize].rank(update), *at)));
            let least = (budget_texels as f64 * f64::from(LEAST_OLD_SHARE)) as u64;
            let allowed = new_texels + budget_texels.saturating_sub(new_texels).max(least);
            let mut taken = 0;
            let fits = |(_, at): &(Rank, u32)| {
                let is_first_old = taken == new_texels;
                taken += texels(at);
                records[*at as usize].is_new() || is_first_old || taken <= allowed
            };
            let count = sort_while(ranked, |(rank, _)| *rank, fits);
            self.reused.waiting = (order.len() - count) as u32;
            order.clear();
            order.extend(ranked[..count].iter().map(|(_, at)| *at));
            order.sort_unstable();
        }
    }

    /// What was chosen is as it is to be.
    fn shade(&mut self, world_from_head: Pose, surfaces: &impl Surfaces) {
        self.due.clear();
        let in_atlas = self.records.iter().filter(|record| !record.block.is_stored());
        let (blocks, texels) = in_atlas.fold((0, 0), |(blocks, texels), record| {
            (blocks + 1, texels + u64::from(record.block.size.texels()))
        });
        self.reused = Reused { blocks, texels, waiting: self.reused.waiting, ..Reused::default() };
        for at in &self.order {
            let record = &mut self.records[*at as usize];
            let Some((cause, _)) = record.waits.take() else { continue };
            record.world_from_head = world_from_head;
            record.turns_after_m = surfaces.turns_after_m(record.patch, world_from_head.position);
            (record.steps, record.evaluated) = (0.0, None);
            self.reused.shaded[cause as usize] += 1;
            self.reused.shaded_texels += u64::from(record.block.size.texels());
            let Record { patch, block, reason, .. } = *record;
            self.due.push(Due { patch, block, cause, reason });
        }
        self.total_texels[0] += texels;
        self.total_texels[1] += self.reused.shaded_texels;
    }
}

impl Record {
    fn is_new(&self) -> bool {
        matches!(self.waits, Some((Cause::New, _)))
    }

    /// Whether a block holds what this one did: the same, or its copy in the store.
    fn has_become(&self, block: Block) -> bool {
        let has_settled = block.is_stored() && !self.block.is_stored() && self.block.size == block.size;
        self.block == block || has_settled
    }

    /// Why another block takes its place, in view or around it.
    fn reason_to_replace(&self, is_around: bool) -> Reason {
        let is_stale = self.block.is_stored() && self.waits.is_some();
        match (is_stale, self.is_around && !is_around) {
            (true, _) => self.reason,
            (false, true) => Reason::Entering,
            (false, false) => Reason::Resized,
        }
    }

    fn rank(&self, update: u32) -> Rank {
        let waited = self.waits.map_or(0, |(_, since)| update - since);
        let late = if waited >= PATIENCE_UPDATES { waited } else { 0 };
        let side = (self.block.size.texels() as f32).sqrt();
        let need = (side * self.steps * (1 + waited) as f32) as u64;
        (!self.is_new(), Reverse(late), Reverse(need), self.patch)
    }

    /// By how much it looks different from a head than from that it was shaded for, steps of the display: by what it reflects, and
    /// by what a pixel covers. Beyond `allowed_steps` a bound will do. A copy in the store that nobody sees is looked at when it is seen.
    fn seen_steps(
        &mut self,
        world_from_head: Pose,
        surfaces: &impl Surfaces,
        allowed_steps: f32,
    ) -> [f32; 2] {
        let is_kept = self.is_around && self.block.is_stored();
        if self.is_hidden || is_kept || self.world_from_head == world_from_head {
            return [0.0; 2];
        }
        let moved_m = self.world_from_head.position.distance(world_from_head.position);
        if moved_m >= self.turns_after_m {
            return [CHANGED_STEPS, 0.0];
        }
        let (patch, block) = (self.patch, self.block);
        let receiver = self.receiver.get_or_insert_with(|| surfaces.receiver(patch, block));
        let receiver = *receiver;
        let seen = |head: Pose| Seen::from(head, receiver.centre, receiver.radius_m, receiver.normal);
        let (then, now) = (seen(self.world_from_head), seen(world_from_head));
        // A copy has mip levels for larger pixels; for smaller ones a larger block will take its place.
        let filtered = if block.is_stored() { 0.0 } else { receiver.gloss.filtered_steps(&then, &now) };
        if filtered > allowed_steps {
            return [0.0, filtered];
        }
        let bounded_steps = if block.is_stored() { BOUNDED_PART * allowed_steps } else { allowed_steps };
        let light = surfaces.still_light();
        let mirrored = self.mirrored_steps(&receiver, (&then, &now), world_from_head, light, bounded_steps);
        [mirrored, filtered]
    }

    /// The same of what it mirrors: the bound; of a copy in the store, where that is beyond `bounded_steps`, evaluated, which holds until the
    /// bound from there is, too.
    fn mirrored_steps(
        &mut self,
        receiver: &Receiver,
        (then, now): (&Seen, &Seen),
        world_from_head: Pose,
        light: &StillLight,
        bounded_steps: f32,
    ) -> f32 {
        let gloss = &receiver.gloss;
        let way_m = |head: Pose| head.position.distance(world_from_head.position);
        let bound = gloss.mirrored_steps(then, now, way_m(self.world_from_head));
        if bound <= bounded_steps || !self.block.is_stored() {
            return bound;
        }
        if let Some((at, steps)) = self.evaluated {
            let seen_there = Seen::from(at, receiver.centre, receiver.radius_m, receiver.normal);
            let since = steps + gloss.mirrored_steps(&seen_there, now, way_m(at));
            if since <= bounded_steps {
                return since.min(bound);
            }
        }
        let Some(normal) = receiver.normal else { return bound };
        let facet = Facet { centre: receiver.centre, radius_m: receiver.radius_m, normal };
        let eyes = [self.world_from_head.position, world_from_head.position];
        let radians = radians(then, now, way_m(self.world_from_head));
        let Some(steps) = gloss.evaluated_steps(light, &facet, eyes, radians) else { return bound };
        self.evaluated = Some((world_from_head, steps));
        steps.min(bound)
    }
}

impl Receiver {
    fn is_in_reach(&self, lamp: &Lamp) -> bool {
        self.centre.distance(lamp.position) <= self.radius_m + lamp.range_m
    }
}

#[cfg(test)]
mod tests;

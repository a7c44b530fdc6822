use super::*;
use crate::scene::lights::{SHADOW_EXTENT_TEXELS, SunView};
use crate::scene::shine::Shine;
use glam::Quat;
use rand::{Rng, SeedableRng, rngs::SmallRng};
use shadecast_protocol::atlas::{BlockAddress, BlockSize};
use shadecast_scene::animation::bounds::Bounds;
use shadecast_shaders::ambient::Sky;

/// Ten patches an instance in a row along x, 1 m apart, under a sun in the zenith; the last instance has no light on it.
struct Row {
    sun: SunView,
    absent: Option<usize>,
    gloss: Gloss,
}

const PATCHES: u32 = 10;
const INSTANCES: usize = 4;
const GLOSS: Gloss = Gloss {
    steps_by_radian: 50.0,
    steps_by_octave: 0.0,
    lamp_steps_by_radian: 0.0,
    is_lit: true,
    shine: None,
};
const DARK: Sky = Sky { zenith: Vec3::ZERO, horizon: Vec3::ZERO, nadir: Vec3::ZERO };
const NO_LIGHT: StillLight = StillLight { sky: DARK, to_sun: Vec3::Y, irradiance: Vec3::ZERO };

fn row() -> Row {
    let world = Bounds { low: Vec3::new(-1.0, -1.0, -1.0), high: Vec3::new(41.0, 3.0, 1.0) };
    let sun = SunView::around(Vec3::Y, [world].into_iter(), SHADOW_EXTENT_TEXELS).expect("casters");
    Row { sun, absent: None, gloss: GLOSS }
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
        let gloss = if self.instance(patch) + 1 < INSTANCES { self.gloss } else { Gloss::default() };
        Receiver { centre, radius_m: 0.1, normal: Some(Vec3::Z), in_sun, gloss }
    }

    fn turns_after_m(&self, patch: ScenePatch, _: Vec3) -> f32 {
        if patch.0 == 3 { 0.0 } else { f32::INFINITY }
    }

    fn still_light(&self) -> &StillLight {
        &NO_LIGHT
    }
}

fn block(x: u16, side_log2: u8) -> Block {
    Block {
        address: BlockAddress { page: 0, x, y: 0 },
        size: BlockSize::new(side_log2, side_log2).expect("a size"),
    }
}

/// All patches with blocks of 8x8 texels.
fn all() -> Vec<Placed> {
    let placed = |patch: u32| Placed {
        patch: ScenePatch(patch),
        block: block(8 * patch as u16, 3),
        is_around: false,
        is_hidden: false,
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
    assert_eq!(due(&mut reuse, &row, row.moment([0; 4]), &all()), [], "no light falls on the last instance");
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
        let due = reuse.due(|now| *now = row.moment([0; 4]), head, placed.iter().copied(), &row, u64::MAX);
        due.iter().for_each(|due| shaded_from[due.patch.index()] = head.position);
        assert!(step == 0 || due.len() < 30, "step {step}: {}", due.len());
        assert!(step == 0 || due.iter().any(|due| due.patch.0 == 3), "its other side may be seen");
        for (patch, from) in shaded_from.iter().enumerate().take(30) {
            let distance_m = Row::at(patch as u32).distance(head.position) - 0.1;
            let steps = GLOSS.steps_by_radian * from.distance(head.position) / distance_m;
            assert!(steps <= SEEN_STEPS * 1.2, "step {step}: {steps} of {patch}");
        }
    }
    assert!(shaded_from[30..].iter().all(|from| *from == HEAD.position), "nothing of it depends on the eye");
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
            let allowed = budget.saturating_sub(texels(true)).max((budget as f32 * LEAST_OLD_SHARE) as u64);
            assert!(texels(false) <= allowed.max(256), "round {round}: {} of {allowed}", texels(false));
            let oldest = shaded.iter().map(|last| update - last).max().unwrap_or(0);
            assert!(oldest <= most, "round {round}, update {update}: {oldest} of {most}, budget {budget}");
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
    let first =
        reuse.due(|now| *now = row.moment([1; 4]), HEAD, placed.iter().copied(), &row, 64 * 64 + 64).to_vec();
    assert_eq!(first.iter().map(|due| due.patch.0).collect::<Vec<_>>(), [0, 17]);
}

/// All patches, the second instance's in the store.
fn settled(is_hidden: bool) -> Vec<Placed> {
    let mut placed = all();
    for placed in &mut placed[10..20] {
        placed.block.address.page = 1;
        placed.is_hidden = is_hidden;
    }
    placed
}

fn stale(reuse: &Reuse<u32>) -> Vec<u32> {
    reuse.stale().map(|patch| patch.0).collect()
}

#[test]
fn a_copy_in_the_store_is_what_its_block_was() {
    let (row, mut reuse) = (row(), Reuse::new(true));
    due(&mut reuse, &row, row.moment([0; 4]), &all());
    assert_eq!(due(&mut reuse, &row, row.moment([0; 4]), &settled(false)), []);
    assert_eq!((stale(&reuse), reuse.reused().blocks), (vec![], 30));
    assert_eq!(
        due(&mut reuse, &row, row.moment([0; 4]), &all()),
        of(Cause::New, 10..20),
        "in the atlas again"
    );
}

#[test]
fn a_copy_in_the_store_is_never_shaded_and_stale_when_its_light_changes() {
    for is_hidden in [false, true] {
        let (row, mut reuse) = (row(), Reuse::new(true));
        due(&mut reuse, &row, row.moment([0; 4]), &all());
        let mut lit = row.moment([0; 4]);
        lit.lamps = vec![Lamp { words: [1.0; 16], position: Row::at(15), range_m: 2.5 }];
        assert_eq!(due(&mut reuse, &row, lit, &settled(is_hidden)), []);
        assert_eq!(stale(&reuse), [13, 14, 15, 16, 17]);
        due(&mut reuse, &row, row.moment([0, 1, 0, 0]), &settled(is_hidden));
        assert_eq!(stale(&reuse).len(), 10, "it moved");
    }
}

#[test]
fn a_copy_that_is_not_shown_is_not_stale_for_a_head_that_moves() {
    for is_hidden in [false, true] {
        let (row, mut reuse) = (row(), Reuse::new(true));
        due(&mut reuse, &row, row.moment([0; 4]), &all());
        let head = Pose { position: HEAD.position + Vec3::X * 2.0, ..HEAD };
        let placed = settled(is_hidden);
        let moment = row.moment([0; 4]);
        reuse.due(|now| *now = moment, head, placed.into_iter(), &row, u64::MAX);
        assert_eq!(stale(&reuse).is_empty(), is_hidden);
    }
}

#[test]
fn a_copy_is_not_stale_for_pixels_of_another_size() {
    let textured = Gloss { steps_by_radian: 1.0, steps_by_octave: 50.0, ..GLOSS };
    let (row, mut reuse) = (Row { gloss: textured, ..row() }, Reuse::new(true));
    due(&mut reuse, &row, row.moment([0; 4]), &all());
    let near = Pose { position: HEAD.position - Vec3::Z, ..HEAD };
    let moment = row.moment([0; 4]);
    let filtered = reuse.due(|now| *now = moment, near, settled(false).into_iter(), &row, u64::MAX).len();
    assert_eq!((filtered, stale(&reuse)), (20, vec![]), "blocks of the atlas are filtered anew");
}

#[test]
fn a_copy_may_differ_by_more_where_pictures_are_coded_coarsely_and_a_block_may_not() {
    let moves = |qp: u8, placed: Vec<Placed>| {
        let (row, mut reuse) = (row(), Reuse::new(true));
        due(&mut reuse, &row, row.moment([0; 4]), &all());
        reuse.coded(qp);
        let head = Pose { position: HEAD.position + Vec3::X * 0.5, ..HEAD };
        let moment = row.moment([0; 4]);
        let due = reuse.due(|now| *now = moment, head, placed.into_iter(), &row, u64::MAX);
        let blocks = due.iter().filter(|due| (10..20).contains(&due.patch.0)).count();
        (blocks, stale(&reuse).len())
    };
    assert_eq!([10, 22, 34].map(|qp| moves(qp, settled(false))), [(0, 7), (0, 7), (0, 0)]);
    assert_eq!([10, 34].map(|qp| moves(qp, all())), [(7, 0); 2]);
}

#[test]
fn a_copy_out_of_view_is_judged_when_it_is_seen() {
    let (row, mut reuse) = (row(), Reuse::new(true));
    due(&mut reuse, &row, row.moment([0; 4]), &all());
    let head = Pose { position: HEAD.position + Vec3::X * 2.0, ..HEAD };
    for (is_around, count) in [(true, 0), (false, 10)] {
        let placed = settled(false).into_iter().map(|placed| Placed { is_around, ..placed });
        let moment = row.moment([0; 4]);
        reuse.due(|now| *now = moment, head, placed, &row, u64::MAX);
        assert_eq!(stale(&reuse).len(), count);
    }
}

#[test]
fn a_rough_copy_is_stale_by_what_it_mirrors_and_not_by_its_bound() {
    // In the dark: by its bound each of them looks different, by what it mirrors none.
    let shine = Shine { roughness: 0.8, reflectance: 0.04, diffuse: 0.5 };
    for (shine, is_stored, count) in [(None, true, 10), (Some(shine), true, 0), (Some(shine), false, 10)] {
        let row = Row { gloss: Gloss { shine, ..GLOSS }, ..row() };
        let mut reuse = Reuse::new(true);
        let far = Pose { position: HEAD.position + Vec3::Z * 60.0, ..HEAD };
        let mut seen = |head: Pose, placed: Vec<Placed>| {
            let due = reuse.due(|now| *now = row.moment([0; 4]), head, placed.into_iter(), &row, u64::MAX);
            let due = due.iter().filter(|due| due.cause == Cause::Seen).map(|due| due.patch.0);
            let due = due.filter(|patch| (10..20).contains(patch)).count();
            due + reuse.stale().count()
        };
        seen(far, all());
        let placed = || if is_stored { settled(false) } else { all() };
        seen(far, placed());
        let found = seen(Pose { position: far.position + Vec3::X * 10.0, ..far }, placed());
        assert_eq!(found, count, "stored: {is_stored}");
    }
}

/// Why blocks are shaded, by patch.
fn reasons(
    reuse: &mut Reuse<u32>,
    row: &Row,
    moment: Moment<u32>,
    head: Pose,
    placed: &[Placed],
) -> Vec<(u32, Reason)> {
    let due = reuse.due(|now| *now = moment, head, placed.iter().copied(), row, u64::MAX);
    due.iter().map(|due| (due.patch.0, due.reason)).collect()
}

#[test]
fn each_block_is_shaded_for_its_reason() {
    let (row, mut reuse) = (row(), Reuse::new(true));
    let mut placed = all();
    let of = |patches: std::ops::Range<u32>, reason| patches.map(|patch| (patch, reason)).collect::<Vec<_>>();
    assert_eq!(reasons(&mut reuse, &row, row.moment([0; 4]), HEAD, &placed), of(0..40, Reason::Entering));
    placed[5].block = block(400, 4);
    let found = reasons(&mut reuse, &row, row.moment([0, 0, 0, 1]), HEAD, &placed);
    assert_eq!(found, [of(5..6, Reason::Resized), of(30..40, Reason::Moving)].concat());
    let lit = Moment {
        lamps: vec![Lamp { words: [0.0; 16], position: Row::at(1), range_m: 0.5 }],
        ..row.moment([0, 0, 0, 1])
    };
    assert_eq!(reasons(&mut reuse, &row, lit, HEAD, &placed), of(1..2, Reason::Relit));
}

#[test]
fn a_head_that_moves_changes_reflections_or_the_size_of_pixels() {
    let near = Pose { position: HEAD.position - Vec3::Z, ..HEAD };
    for (steps_by_radian, steps_by_octave, reason) in
        [(50.0, 1.0, Reason::Relit), (1.0, 50.0, Reason::Refiltered)]
    {
        let row = Row { gloss: Gloss { steps_by_radian, steps_by_octave, ..GLOSS }, ..row() };
        let mut reuse = Reuse::new(true);
        reasons(&mut reuse, &row, row.moment([0; 4]), HEAD, &all());
        let found = reasons(&mut reuse, &row, row.moment([0; 4]), near, &all());
        assert!(found.contains(&(0, reason)) && found.contains(&(8, reason)), "{found:?}");
    }
}

#[test]
fn blocks_of_the_surround_that_come_into_view_enter_it() {
    let (row, mut reuse) = (row(), Reuse::new(true));
    let mut placed = all();
    placed[7].is_around = true;
    reasons(&mut reuse, &row, row.moment([0; 4]), HEAD, &placed);
    placed[7] = Placed { is_around: false, block: block(400, 4), ..placed[7] };
    assert_eq!(reasons(&mut reuse, &row, row.moment([0; 4]), HEAD, &placed), [(7, Reason::Entering)]);
}

#[test]
fn a_stale_copy_comes_back_for_what_made_it_stale() {
    let (row, mut reuse) = (row(), Reuse::new(true));
    let mut placed = all();
    reasons(&mut reuse, &row, row.moment([0; 4]), HEAD, &placed);
    placed[5].block.address.page = 1;
    assert_eq!(reasons(&mut reuse, &row, row.moment([0; 4]), HEAD, &placed), []);
    assert_eq!(reasons(&mut reuse, &row, row.moment([1, 0, 0, 0]), HEAD, &placed).len(), 9, "not the copy");
    placed[5].block = block(400, 3);
    assert_eq!(reasons(&mut reuse, &row, row.moment([1, 0, 0, 0]), HEAD, &placed), [(5, Reason::Moving)]);
}

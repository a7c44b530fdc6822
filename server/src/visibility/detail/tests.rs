use super::*;
use crate::pacing::pressure::RECOVER_AFTER_UPDATES;
use crate::visibility::nearness::Nearness;
use rand::{Rng, SeedableRng, rngs::SmallRng};

/// Of a display that limits no error.
const PIXELS_PER_RADIAN: f32 = 1e6;
const AS_ASKED: ErrorFactors = ErrorFactors { density: 1.0, measures: 1.0 };
const ROOM: Room = Room { patches: 131_072, vertices: 131_072, triangles: 786_432 };

/// LODs of which each has half the triangles of the one before, and twice its error.
fn chain(patches: u32, error_m: f32, lods: u32) -> Vec<LodCost> {
    let cost = |lod: u32| LodCost {
        error_m: if lod == 0 { 0.0 } else { error_m * (1 << lod) as f32 },
        patches: (patches >> lod).max(1),
        vertices: ((patches + patches / 10) >> lod).max(3),
        triangles: ((2 * patches) >> lod).max(1),
        bytes: 26 * (patches >> lod).max(1),
    };
    (0..lods).map(cost).collect()
}

/// Instances so near, in the middle of the view and still.
fn at(pixels_per_metre: &[f32]) -> Vec<Nearness> {
    pixels_per_metre.iter().map(|&pixels| Nearness { pixels_per_metre: pixels, attention: pixels }).collect()
}

fn shown(detail: &Detail) -> Vec<usize> {
    detail.lods().flatten().map(|lods| lods.next.unwrap_or(lods.shown)).collect()
}

/// An update after which everything that is wanted is shown, and `share` of its patches was seen.
fn update(detail: &mut Detail, pixels_per_metre: &[f32], share: f32) -> Vec<usize> {
    update_in(ROOM, detail, pixels_per_metre, share)
}

fn update_in(room: Room, detail: &mut Detail, pixels_per_metre: &[f32], share: f32) -> Vec<usize> {
    detail.begin((room, usize::MAX), &Needed::all(pixels_per_metre.len()), &at(pixels_per_metre), AS_ASKED);
    let lods = shown(detail);
    for (instance, lod) in lods.iter().enumerate() {
        detail.switched(instance);
        let seen = detail.costs[instance][*lod].patches as f32 * share;
        detail.measured(instance, seen as u32);
    }
    lods
}

#[test]
fn the_error_that_is_seen_is_within_what_is_allowed_and_grows_with_distance() {
    let mut rng = SmallRng::seed_from_u64(5);
    for case in 0..300 {
        let costs = chain(rng.random_range(100..5000), rng.random_range(0.001..0.1), 6);
        let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![costs.clone(); 8]);
        let mut near = rng.random_range(20.0..2000.0f32);
        let pixels: Vec<f32> = (0..8)
            .map(|_| {
                near *= rng.random_range(0.3..1.0);
                near
            })
            .collect();
        let lods = update(&mut detail, &pixels, 0.5);
        assert!(lods.is_sorted(), "seed 5, case {case}: {lods:?} at {pixels:?}");
        for (lod, pixels) in lods.iter().zip(&pixels) {
            assert!(costs[*lod].error_m * pixels <= 1.0, "seed 5, case {case}");
            let coarser = costs.get(lod + 1).map(|cost| cost.error_m * pixels);
            assert!(coarser.is_none_or(|error| error > COARSER_BELOW), "seed 5, case {case}");
        }
    }
}

#[test]
fn a_distance_that_trembles_by_a_tenth_does_not_change_the_lod() {
    let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(1000, 0.01, 6)]);
    let mut changes = 0;
    for middle in [3.0f32, 12.0, 45.0, 49.0, 51.0, 70.0, 100.0] {
        (0..8).for_each(|_| drop(update(&mut detail, &[middle * 1.05], 0.5)));
        let mut before = update(&mut detail, &[middle * 1.05], 0.5);
        for step in 0..40 {
            let tremble = if step % 8 < 4 { 0.95 } else { 1.05 };
            let now = update(&mut detail, &[middle * tremble], 0.5);
            changes += usize::from(now != before);
            before = now;
        }
    }
    assert_eq!(changes, 0);
}

#[test]
fn lods_may_err_by_as_many_times_what_was_asked_for_as_they_are_told() {
    let lod = |asked_pixels: f32, error: f32| {
        let mut detail = Detail::new(asked_pixels, PIXELS_PER_RADIAN, vec![chain(1000, 0.01, 6)]);
        detail.begin(
            (ROOM, usize::MAX),
            &Needed::all(1),
            &at(&[20.0]),
            ErrorFactors { density: error, measures: 1.0 },
        );
        (shown(&detail), detail.allowed_pixels())
    };
    let [fine, asked, coarse] = [0.5, 1.0, 2.0].map(|error| lod(1.0, error));
    assert!(fine.0 < asked.0 && asked.0 < coarse.0, "{fine:?} {asked:?} {coarse:?}");
    assert_eq!((fine, coarse), (lod(0.5, 1.0), lod(2.0, 1.0)));
}

#[test]
fn a_small_picture_keeps_its_shapes_however_much_error_is_allowed() {
    let allowed = |pixels_per_radian: f32, error: f32| {
        let mut detail = Detail::new(0.5, pixels_per_radian, vec![chain(1000, 0.01, 6)]);
        detail.begin(
            (ROOM, usize::MAX),
            &Needed::all(1),
            &at(&[20.0]),
            ErrorFactors { density: error, measures: 1.0 },
        );
        detail.allowed_pixels()
    };
    assert_eq!([700.0, 64.0, 1.0].map(|density| allowed(density, 32.0)), [16.0, MOST_ERROR_RAD * 64.0, 0.5]);
    assert_eq!(allowed(64.0, 2.0), 1.0, "usual errors are as they were");
}

#[test]
fn measures_take_no_lod_of_so_few_patches_that_each_is_large() {
    let lod = |patches: u32, density: f32, measures: f32| {
        let mut detail = Detail::new(0.5, PIXELS_PER_RADIAN, vec![chain(patches, 0.01, 6)]);
        detail.begin((ROOM, usize::MAX), &Needed::all(1), &at(&[10.0]), ErrorFactors { density, measures });
        shown(&detail)[0]
    };
    assert_eq!([lod(100_000, 1.0, 1.0), lod(100_000, 1.0, 16.0)], [1, 5], "many patches");
    assert_eq!([lod(1000, 1.0, 1.0), lod(1000, 1.0, 16.0)], [1, 1], "few patches");
    assert_eq!(lod(1000, 2.0, 16.0), lod(1000, 2.0, 1.0), "density counts as ever");
}

#[test]
fn without_an_allowed_error_everything_has_full_detail() {
    let room = Room { patches: 10, vertices: 10, triangles: 10 };
    let mut detail = Detail::new(0.0, PIXELS_PER_RADIAN, vec![chain(1000, 0.01, 6); 3]);
    assert_eq!(update_in(room, &mut detail, &[0.001; 3], 1.0), [0; 3]);
    assert!(!detail.tighten(room));
}

#[test]
fn what_does_not_fit_becomes_coarser_until_it_does_and_then_stays_as_it_is() {
    let mut rng = SmallRng::seed_from_u64(17);
    for case in 0..100 {
        let count = rng.random_range(1..60);
        let costs: Vec<_> = (0..count)
            .map(|_| chain(rng.random_range(200..5000), rng.random_range(0.001..0.05), 7))
            .collect();
        let coarsest: u32 = costs.iter().map(|costs| costs[6].patches).sum();
        let room = coarsest * rng.random_range(4..40);
        let room = Room { patches: room, vertices: 2 * room, triangles: 4 * room };
        let share = rng.random_range(0.2..0.9);
        let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, costs.clone());
        let pixels: Vec<f32> = (0..count).map(|_| rng.random_range(1.0..500.0)).collect();
        let history: Vec<Vec<usize>> =
            (0..400).map(|_| update_in(room, &mut detail, &pixels, share)).collect();
        for (number, lods) in history.iter().enumerate().skip(1) {
            let seen: f32 =
                lods.iter().zip(&costs).map(|(lod, costs)| costs[*lod].patches as f32 * share).sum();
            assert!(
                seen <= FILL * room.patches as f32,
                "seed 17, case {case}, update {number}: {seen} of {room:?}"
            );
        }
        assert!(history[250..].iter().all(|lods| *lods == history[250]), "seed 17, case {case} swings");
    }
}

#[test]
fn the_error_that_is_allowed_shrinks_again_when_there_is_room() {
    let room = Room { patches: 3000, ..ROOM };
    let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(1000, 0.01, 6); 20]);
    let near = update_in(room, &mut detail, &[100.0; 20], 0.5);
    assert!(detail.allowed_pixels() > 1.0 && near[0] > 0);
    // All but two go.
    let few: Needed = (0..20).map(|instance| instance < 2).collect();
    for _ in 0..2 * RECOVER_AFTER_UPDATES {
        detail.begin((room, usize::MAX), &few, &at(&[100.0; 20]), AS_ASKED);
        for instance in [0, 1] {
            detail.switched(instance);
            let lod = shown(&detail)[instance];
            detail.measured(instance, detail.costs[instance][lod].patches / 2);
        }
    }
    assert_eq!((detail.allowed_pixels(), shown(&detail)), (1.0, vec![0, 0]));
}

#[test]
fn on_a_slow_device_lods_change_one_after_the_other_and_all_do() {
    for (instances, most) in [(3, 1), (40, 10)] {
        let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(1000, 0.01, 6); instances]);
        let far = update(&mut detail, &vec![10.0; instances], 0.5);
        detail.change_gradually(true);
        let mut before = far.clone();
        let mut updates = 0;
        while before != vec![0; instances] {
            let lods = update(&mut detail, &vec![100.0; instances], 0.5);
            let changed = lods.iter().zip(&before).filter(|(now, before)| now != before).count();
            assert!(changed <= most, "{changed} of {instances} in an update");
            (before, updates) = (lods, updates + 1);
            assert!(
                updates <= 4 * GRADUAL_EVERY_UPDATES as usize * instances.div_ceil(most),
                "not all change"
            );
        }
        assert!(updates > 4, "{far:?}");
    }
}

#[test]
fn what_is_measured_not_to_fit_is_made_coarser_in_the_same_update() {
    let room = Room { patches: 100_000, ..ROOM };
    let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(1000, 0.01, 3); 4]);
    update_in(room, &mut detail, &[100.0; 4], 0.5);
    assert_eq!(shown(&detail), [0; 4]);
    assert!(detail.tighten(room) && shown(&detail).iter().all(|lod| *lod > 0));
    assert!(detail.tighten(room) && shown(&detail) == [2; 4]);
    assert!(!detail.tighten(room), "there is nothing coarser");
}

#[test]
fn a_lod_is_shown_once_it_was_brought_unless_nothing_of_the_other_is_seen() {
    let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(1000, 0.01, 6); 2]);
    update(&mut detail, &[1.0; 2], 0.5);
    let coarse = shown(&detail);
    for _ in 0..CHANGE_EVERY_UPDATES {
        detail.begin((ROOM, usize::MAX), &Needed::all(2), &at(&[1000.0; 2]), AS_ASKED);
        detail.measured(0, 5);
        detail.measured(1, 0);
    }
    detail.begin((ROOM, usize::MAX), &Needed::all(2), &at(&[1000.0; 2]), AS_ASKED);
    let lods: Vec<_> = detail.lods().flatten().collect();
    assert_eq!(lods[0], LodChoice { shown: coarse[0], next: Some(0) });
    assert_eq!(lods[1], LodChoice { shown: 0, next: None });
}

/// An update that may bring so many bytes, after which `share` of all patches was seen.
fn update_with_bytes(
    detail: &mut Detail,
    bytes: usize,
    pixels_per_metre: &[f32],
    share: f32,
) -> Vec<LodChoice> {
    detail.begin((ROOM, bytes), &Needed::all(pixels_per_metre.len()), &at(pixels_per_metre), AS_ASKED);
    let lods: Vec<LodChoice> = detail.lods().flatten().collect();
    for (instance, lod) in lods.iter().enumerate() {
        let seen = detail.costs[instance][lod.shown].patches as f32 * share;
        detail.measured(instance, seen as u32);
    }
    lods
}

#[test]
fn what_comes_into_view_enters_whole_within_the_bytes_and_gets_finer() {
    const BYTES: usize = 40_000;
    let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(4000, 0.002, 7); 4]);
    let pixels = [1000.0, 600.0, 400.0, 200.0];
    let first = update_with_bytes(&mut detail, BYTES, &pixels, UNKNOWN_SHARE);
    let bytes: usize = first
        .iter()
        .enumerate()
        .map(|(instance, lod)| detail.states[instance].bytes(detail.costs[instance][lod.shown]))
        .sum();
    assert!(bytes <= BYTES && 4 * bytes > BYTES, "{bytes} bytes, {first:?}");
    assert!(first.iter().all(|lod| lod.next.is_none()), "one LOD each: {first:?}");
    assert!(first.is_sorted_by_key(|lod| lod.shown), "what is near is finer: {first:?}");
    let second = update_with_bytes(&mut detail, usize::MAX, &pixels, UNKNOWN_SHARE);
    assert!(second.iter().all(|lod| lod.next.is_some_and(|next| next < lod.shown)), "{second:?}");
}

#[test]
fn what_is_looked_at_is_refined_first_among_what_is_as_near() {
    for most in 0..4 {
        let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(4000, 0.002, 7); 4]);
        let mut nearness = at(&[1000.0; 4]);
        nearness[most].attention *= 2.0;
        let least: Vec<usize> = (1..40)
            .map(|kilobytes| {
                detail.begin((ROOM, 1000 * kilobytes), &Needed::all(4), &nearness, AS_ASKED);
                let lods: Vec<usize> = detail.lods().flatten().map(|lod| lod.shown).collect();
                detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(4000, 0.002, 7); 4]);
                lods
            })
            .inspect(|lods| assert!(lods.iter().all(|lod| lods[most] <= *lod), "{most}: {lods:?}"))
            .map(|lods| lods.iter().filter(|lod| **lod > lods[most]).count())
            .collect();
        assert!(least.contains(&3), "it alone is finer at some of these bytes: {least:?}");
    }
}

#[test]
fn a_finer_lod_that_one_update_cannot_bring_comes_by_those_between() {
    const BYTES: usize = 10_000;
    let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(4000, 0.002, 7)]);
    let mut shown = update_with_bytes(&mut detail, BYTES, &[1000.0], UNKNOWN_SHARE)[0].shown;
    let mut path = vec![shown];
    for _ in 0..40 {
        if let Some(next) = update_with_bytes(&mut detail, BYTES, &[1000.0], UNKNOWN_SHARE)[0].next {
            assert!(
                next < shown && (shown - next == 1 || detail.states[0].bytes(detail.costs[0][next]) <= BYTES)
            );
            detail.switched(0);
            shown = next;
            path.push(shown);
        }
    }
    assert_eq!(shown, 0, "{path:?}");
    assert!(path.len() > 2, "{path:?}");
}

#[test]
fn what_lacks_more_than_an_update_brings_gives_way_at_once() {
    let mut detail = Detail::new(1.0, PIXELS_PER_RADIAN, vec![chain(4000, 0.002, 7); 2]);
    update_with_bytes(&mut detail, usize::MAX, &[1000.0, 1000.0], 0.5);
    let fine: Vec<_> = update_with_bytes(&mut detail, 20_000, &[1000.0, 1000.0], 0.5);
    assert!(detail.give_way(&[(1, 60_000)]));
    let lods: Vec<LodChoice> = detail.lods().flatten().collect();
    assert_eq!(lods[0].shown, fine[0].shown, "what lacks nothing stays");
    assert!(lods[1].shown > fine[1].shown && lods[1].next.is_none(), "{lods:?}");
    assert!(detail.states[1].bytes(detail.costs[1][lods[1].shown]) <= 20_000);
    assert!(!detail.give_way(&[(1, 10)]), "a coarser LOD would take more than is lacking");
}

use super::*;
use crate::atlas::sizing::wanted_size;
use crate::pacing::pressure::RECOVER_AFTER_UPDATES;
use crate::scene::geometry::test_geometry::Loose;
use crate::scene::numbering::{InstanceSize, Numbering};
use crate::visibility::lod_set::LodChoice;
use std::collections::BTreeMap;

const ROOM: Room = Room { patches: 100_000, vertices: 100_000, triangles: 600_000 };

fn layout([width, height]: [u32; 2], patches: usize) -> Layout {
    Layout::new(AtlasExtent::new(width, height).expect("an atlas"), patches)
}

fn placed(layout: &mut Layout, geometry: &impl Geometry, lods: &LodSet) -> Vec<PlacementChange> {
    let [width, height] = layout.atlas.extent_texels();
    let patches = ROOM.patches.min((width * height) >> (2 * BLOCK_MIN_LOG2));
    placed_in(Room { patches, ..ROOM }, layout, geometry, lods)
}

fn placed_in(
    room: Room,
    layout: &mut Layout,
    geometry: &impl Geometry,
    lods: &LodSet,
) -> Vec<PlacementChange> {
    let mut changes = Vec::new();
    layout.place(geometry, lods, (room, UpdateId(layout.update)), &mut changes);
    changes
}

fn place(layout: &mut Layout, extents: &[u32]) -> Vec<PlacementChange> {
    let lods = LodSet::of_one(extents.len() as u32);
    layout.begin(1.0);
    layout.see(Visible { lods: &lods, seen: &seen(extents) });
    placed(layout, &Loose { patches: extents.len() as u32 }, &lods)
}

/// By entry an extent, 0 where it is not visible.
fn seen(extents: &[u32]) -> Vec<SeenGpu> {
    let all = (0..).zip(extents.iter().copied());
    let visible = all.filter(|(_, extent)| *extent != 0);
    visible.map(|(entry, extent_texels)| SeenGpu { entry, extent_texels }).collect()
}

fn pack(width: u32, height: u32) -> u32 {
    width | height << 16
}

fn random_extents(seed: u64, patches: usize, largest: u64) -> Vec<u32> {
    let mut state = seed;
    (0..patches)
        .map(|_| {
            state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
            let visible = state >> 60 > 4;
            let side = |shift: u32| (1 + (state >> shift) % largest) as u32;
            if visible { pack(side(20), side(36)) } else { 0 }
        })
        .collect()
}

fn assert_sound(layout: &Layout, extents: &[u32]) {
    let blocks: Vec<_> = layout.live().collect();
    assert_eq!(blocks.len(), layout.live_count(), "every live patch has a block");
    for (patch, packed) in extents.iter().enumerate() {
        let has = blocks.binary_search_by_key(&ScenePatch(patch as u32), |(p, _)| *p).is_ok();
        assert!(*packed == 0 || has, "patch {patch} is visible and has no block");
    }
    let used: u64 = blocks.iter().map(|(_, b)| u64::from(b.size.texels())).sum();
    assert_eq!(used, layout.atlas.used_texels());
}

#[test]
fn unchanged_patch_and_lod_keep_their_block() {
    let mut layout = layout([512, 512], 200);
    let mut extents = random_extents(3, 200, 20);
    place(&mut layout, &extents);
    let before: Vec<_> = layout.live().filter(|(patch, _)| *patch != ScenePatch(7)).collect();
    extents[7] = pack(60, 3);
    place(&mut layout, &extents);
    assert!(before.iter().all(|b| layout.live().any(|now| now == *b)));
}

/// An instance of two LODs: 40 patches, of which it shows those, and then 20 more.
fn two_lods(shown: usize, next: Option<usize>) -> LodSet {
    let size = InstanceSize { patches: vec![40, 20], ..InstanceSize::default() };
    LodSet::new(&Numbering::new(&[size]), [Some(LodChoice { shown, next })])
}

fn live(layout: &Layout) -> Vec<u32> {
    layout.live().map(|(patch, _)| patch.0).collect()
}

#[test]
fn lods_take_turns_with_one_update_and_never_lie_beside_each_other() {
    let (mut layout, geometry) = (layout([512, 512], 60), Loose { patches: 60 });
    let mut update = |lods: &mut LodSet, switches: bool| {
        layout.begin(1.0);
        let extents = vec![pack(9, 9); lods.entries()];
        layout.see(Visible { lods, seen: &seen(&extents) });
        if switches {
            lods.switch(0);
        }
        let changes = placed(&mut layout, &geometry, lods);
        (live(&layout), changes.len())
    };
    let (fine, coarse): (Vec<u32>, Vec<u32>) = ((0..40).collect(), (40..60).collect());
    assert_eq!(update(&mut two_lods(0, None), false), (fine.clone(), 40));
    assert_eq!(update(&mut two_lods(0, Some(1)), false), (fine.clone(), 0), "it is not shown yet");
    assert_eq!(update(&mut two_lods(0, Some(1)), true), (coarse.clone(), 60), "all at once");
    assert_eq!(update(&mut two_lods(1, None), false), (coarse, 0), "nothing is held of the other");
    assert_eq!(update(&mut two_lods(1, Some(0)), true), (fine, 60));
}

#[test]
fn a_lod_that_is_not_shown_yet_gathers_what_several_updates_see() {
    let (mut layout, geometry) = (layout([512, 512], 60), Loose { patches: 60 });
    let lods = two_lods(0, Some(1));
    for patch in 0..3 {
        layout.begin(1.0);
        let mut extents = vec![pack(9, 9); 60];
        extents[40..].fill(0);
        extents[45 + patch] = pack(5, 5);
        layout.see(Visible { lods: &lods, seen: &seen(&extents) });
        placed(&mut layout, &geometry, &lods);
    }
    let next = lods.next().next().expect("the other LOD");
    assert_eq!(layout.seen_of(next), [45, 46, 47].map(ScenePatch));
    assert!(layout.has_room(&geometry, &lods, ROOM));
}

#[test]
fn a_full_atlas_coarsens_and_places_everything_that_is_visible() {
    let mut layout = layout([512, 512], 3000);
    for seed in 0..12 {
        let extents = random_extents(seed, 3000, 90);
        place(&mut layout, &extents);
        assert_sound(&layout, &extents);
    }
    assert!(layout.coarsened() > 0 && layout.density() < 1.0);
}

#[test]
fn the_first_forced_coarsening_finds_the_atlas_well_used() {
    let mut layout = layout([1024, 1024], 4000);
    let mut share = 0.0;
    for count in (100..4000).step_by(20) {
        let mut extents = random_extents(5, 4000, 40);
        extents[count..].fill(0);
        place(&mut layout, &extents);
        if layout.coarsened() > 0 {
            break;
        }
        share = layout.used_share();
    }
    println!("atlas use before the first coarsening: {:.1} %", share * 100.0);
    assert!(layout.coarsened() > 0 && share >= 0.85, "{share}");
}

#[test]
fn a_patch_out_of_sight_stays_for_the_hold_and_then_goes() {
    let mut layout = layout([512, 512], 3);
    place(&mut layout, &[pack(9, 9), 0, 0]);
    for _ in 0..HOLD_UPDATES {
        assert!(place(&mut layout, &[0, 0, 0]).is_empty());
    }
    assert_eq!(place(&mut layout, &[0, 0, 0]), [PlacementChange { patch: ScenePatch(0), block: None }]);
    assert_eq!(layout.live_count(), 0);
}

#[test]
fn an_extent_that_trembles_at_a_power_of_two_does_not_change_its_block() {
    let mut layout = layout([512, 512], 1);
    place(&mut layout, &[pack(14, 15)]);
    for step in 0..20 {
        let extent = if step % 2 == 0 { 14 } else { 13 };
        assert!(place(&mut layout, &[pack(extent, 15 - step % 3)]).is_empty());
    }
    assert_eq!(place(&mut layout, &[pack(4, 4)]).len(), 1, "clearly smaller shrinks");
}

#[test]
fn what_changed_is_exactly_what_the_blocks_say() {
    let mut layout = layout([512, 512], 1500);
    let mut mirror: BTreeMap<ScenePatch, Block> = Default::default();
    for seed in 0..40 {
        for change in place(&mut layout, &random_extents(seed, 1500, 60)) {
            match change.block {
                Some(block) => mirror.insert(change.patch, block),
                None => mirror.remove(&change.patch),
            };
        }
        assert!(layout.live().eq(mirror.iter().map(|(p, b)| (*p, *b))), "seed {seed}");
    }
}

/// Extents that differ from `base` by at most 4 %, each patch in its own rhythm.
fn trembling(base: &[u32], update: usize) -> Vec<u32> {
    let side = |texels: u32, phase: usize| {
        let swing = (((update + phase) % 7) as f32 - 3.0) / 3.0;
        (texels as f32 * (1.0 + 0.04 * swing)).round().max(1.0) as u32
    };
    let one = |(patch, packed): (usize, &u32)| match packed {
        0 => 0,
        _ => pack(side(packed & 0xffff, 3 * patch), side(packed >> 16, 5 * patch + 1)),
    };
    base.iter().enumerate().map(one).collect()
}

fn sizes(layout: &Layout) -> Vec<(ScenePatch, Block)> {
    layout.live().collect()
}

#[test]
fn under_pressure_extents_that_tremble_change_no_block() {
    for (seed, largest) in [(1, 90), (2, 60), (3, 150), (4, 30)] {
        let (mut layout, base) = (layout([512, 512], 3000), random_extents(seed, 3000, largest));
        // Two rounds of the rhythm, so that each extent was at its largest, and the wait for room after that.
        let settled = 14 + RECOVER_AFTER_UPDATES as usize;
        let mut last = Vec::new();
        for update in 0..300 {
            let extents = trembling(&base, update);
            let changes = place(&mut layout, &extents);
            assert_sound(&layout, &extents);
            if update > settled {
                assert_eq!(changes, [], "seed {seed}, update {update}, density {}", layout.density());
                assert_eq!(sizes(&layout), last);
            }
            last = sizes(&layout);
        }
        assert!(layout.density() < 1.0, "seed {seed}: there is pressure");
        assert!(layout.used_share() > 0.6, "seed {seed}: {}", layout.used_share());
    }
}

#[test]
fn under_pressure_a_real_change_changes_its_block_and_few_others() {
    let (mut layout, mut base) = (layout([512, 512], 3000), random_extents(6, 3000, 60));
    for update in 0..40 {
        place(&mut layout, &trembling(&base, update));
    }
    let (patch, _) = layout.live().next().expect("some are live");
    let before = layout.states[patch.index()].block.expect("it is live").size;
    base[patch.index()] = pack(1, 400);
    let changes = place(&mut layout, &trembling(&base, 40));
    let after = layout.states[patch.index()].block.expect("it is live").size;
    assert!(layout.density() < 1.0 && after.height() > before.height(), "{before:?} {after:?}");
    assert!(changes.iter().any(|change| change.patch == patch));
}

#[test]
fn density_falls_at_once_rises_after_a_while_and_does_not_swing() {
    for seed in 8..14 {
        let (mut layout, base) = (layout([1024, 1024], 3000), random_extents(seed, 3000, 90));
        place(&mut layout, &base);
        let crowded = layout.density();
        assert!(crowded < 0.8, "seed {seed}: at once, {crowded}");
        // Three quarters of the patches go for good.
        let mut fewer = base.clone();
        fewer.iter_mut().enumerate().filter(|(i, _)| i % 4 > 0).for_each(|(_, extent)| *extent = 0);
        let mut densities = vec![crowded];
        for update in 0..200 {
            place(&mut layout, &trembling(&fewer, update));
            densities.push(layout.density());
        }
        println!("seed {seed}: {crowded} to {}, {} used", layout.density(), layout.used_share());
        assert!(densities[200] > 1.3 * crowded, "seed {seed}: {densities:?}");
        let changes = densities.windows(2).filter(|pair| pair[0] != pair[1]).count();
        assert!(changes <= 4, "seed {seed}: {densities:?}");
        assert!(densities[120..].iter().all(|density| *density == densities[120]), "seed {seed}");
    }
}

#[test]
fn coarsening_moves_no_block_that_keeps_its_size() {
    let mut layout = layout([512, 512], 3000);
    let mut coarsened = 0;
    for seed in 0..30 {
        let before = sizes(&layout);
        place(&mut layout, &random_extents(seed, 3000, 20 + 4 * seed));
        for (patch, block) in before {
            let now = layout.states[patch.index()].block;
            assert!(now.is_none_or(|now| now.size != block.size || now == block), "seed {seed}");
        }
        coarsened = layout.coarsened();
    }
    assert!(coarsened > 1);
}

#[test]
fn the_same_extents_give_the_same_blocks() {
    let run = || {
        let mut layout = layout([512, 512], 3000);
        (0..30).map(|seed| place(&mut layout, &random_extents(seed, 3000, 90))).collect::<Vec<_>>()
    };
    assert_eq!(run(), run());
}

/// An update in which views see some patches, and a glance others.
fn place_both(layout: &mut Layout, in_view: &[u32], around: &[u32]) -> Vec<PlacementChange> {
    let lods = LodSet::of_one(in_view.len() as u32);
    layout.begin(1.0);
    layout.see(Visible { lods: &lods, seen: &seen(in_view) });
    layout.see_around(Visible { lods: &lods, seen: &seen(around) }, |_| true);
    placed(layout, &Loose { patches: in_view.len() as u32 }, &lods)
}

#[test]
fn what_is_around_has_small_blocks_until_it_is_in_view() {
    let mut layout = layout([512, 512], 20).with_surround(0.25);
    let (mut in_view, around) = (vec![0; 20], vec![pack(60, 60); 20]);
    in_view[3] = pack(60, 60);
    place_both(&mut layout, &in_view, &around);
    assert!(layout.live().map(|(patch, _)| patch.0).eq([3]));
    let small: Vec<_> = layout.around().collect();
    assert_eq!(small.len(), 19);
    assert!(small.iter().all(|(patch, block)| patch.0 != 3 && block.size.width() == 16));
    in_view[4] = pack(60, 60);
    let changes = place_both(&mut layout, &in_view, &around);
    assert!(
        matches!(changes[..], [PlacementChange { patch: ScenePatch(4), block: Some(block) }] if block.size.width() == 64)
    );
    assert_eq!((layout.live_count(), layout.around().count()), (2, 18));
    let used: u64 = layout.live().chain(layout.around()).map(|(_, b)| u64::from(b.size.texels())).sum();
    assert_eq!(used, layout.atlas.used_texels());
}

#[test]
fn what_is_in_view_loses_no_more_than_the_share_to_what_is_around() {
    for seed in 40..44 {
        let alone = random_extents(seed, 3000, 90);
        let in_view: Vec<u32> = alone
            .iter()
            .enumerate()
            .map(|(patch, extent)| if patch % 2 == 0 { *extent } else { 0 })
            .collect();
        let around: Vec<u32> = vec![pack(200, 200); 3000];
        let (mut without, mut with) =
            (layout([512, 512], 3000), layout([512, 512], 3000).with_surround(0.25));
        for _ in 0..60 {
            place(&mut without, &in_view);
            place_both(&mut with, &in_view, &around);
            assert!(
                in_view
                    .iter()
                    .enumerate()
                    .all(|(patch, extent)| *extent == 0 || with.states[patch].block.is_some()),
                "seed {seed}"
            );
        }
        let texels: u64 = with.around().map(|(_, block)| u64::from(block.size.texels())).sum();
        assert!(texels > 0 && texels <= 512 * 512 / 4, "seed {seed}: {texels}");
        // Sides go by powers of two, and densities by steps.
        assert!(
            with.density() > 0.75 * without.density(),
            "seed {seed}: {} {}",
            with.density(),
            without.density()
        );
    }
}

#[test]
fn what_is_around_moves_only_where_what_is_in_view_takes_its_place() {
    let mut layout = layout([512, 512], 3000).with_surround(0.25);
    let (mut stayed, mut moved) = (0, 0);
    for seed in 0..120 {
        let mut in_view = random_extents(seed / 4, 3000, 60);
        in_view.iter_mut().step_by(2).for_each(|extent| *extent = 0);
        let before: BTreeMap<ScenePatch, Block> = layout.around().collect();
        place_both(&mut layout, &in_view, &vec![pack(200, 200); 3000]);
        for (patch, block) in layout.around() {
            if let Some(was) = before.get(&patch).filter(|was| was.size == block.size) {
                (stayed, moved) = (stayed + usize::from(*was == block), moved + usize::from(*was != block));
            }
        }
    }
    println!("{stayed} stayed, {moved} moved");
    assert!(20 * moved < stayed, "{stayed} stayed, {moved} moved");
}

#[test]
fn a_surround_of_patches_that_are_not_of_the_shown_lod_has_no_blocks() {
    let size = InstanceSize { patches: vec![20, 10], ..InstanceSize::default() };
    let numbering = Numbering::new(&[size]);
    let mut layout = layout([512, 512], 30).with_surround(0.25);
    let mut show = |lod: usize| {
        let lods = LodSet::new(&numbering, [Some(LodChoice { shown: lod, next: None })]);
        layout.begin(1.0);
        layout.see(Visible { lods: &lods, seen: &[] });
        layout.see_around(Visible { lods: &lods, seen: &seen(&vec![pack(9, 9); lods.entries()]) }, |_| true);
        placed(&mut layout, &Loose { patches: 30 }, &lods);
        layout.around().map(|(patch, _)| patch.0).collect::<Vec<_>>()
    };
    assert_eq!(show(0), (0..20).collect::<Vec<_>>());
    assert_eq!(show(1), (20..30).collect::<Vec<_>>());
}

#[test]
fn with_too_little_room_the_ground_near_the_viewer_stays_and_what_is_missing_is_counted() {
    let mut layout = Layout::new(AtlasExtent::MIN, 100);
    let room = Room { patches: 20, vertices: 1000, triangles: 1000 };
    let place = |layout: &mut Layout, extents: &[u32]| {
        let lods = LodSet::of_one(extents.len() as u32);
        layout.begin(1.0);
        layout.see(Visible { lods: &lods, seen: &seen(extents) });
        placed_in(room, layout, &Loose { patches: 100 }, &lods)
    };
    let mut extents: Vec<u32> = (0..100).map(|patch| pack(3 + patch / 20, 3)).collect();
    extents[0] = pack(300, 200);
    place(&mut layout, &extents);
    assert_eq!((layout.live_count(), layout.dropped()), (20, 80));
    assert!(layout.live().any(|(patch, _)| patch.0 == 0) && !layout.live().any(|(patch, _)| patch.0 == 1));
    place(&mut layout, &[vec![extents[0]], vec![0; 99]].concat());
    assert_eq!(layout.dropped(), 0);
}

/// Patches all around at 3 m and more, towards which a head walks with 1 m/s: extents of an update, at so many texels for a
/// pixel.
fn walking(base: &[u32], update: usize, texels_per_pixel: f32) -> Vec<u32> {
    let one = |(patch, packed): (usize, &u32)| {
        let distance_m = 3.0 + (patch * 37 % 100) as f32 / 20.0 + 40.0 / 30.0;
        let nearer = distance_m / (distance_m - update as f32 / 30.0) * texels_per_pixel;
        // Not all a whole number of texels at the same moment.
        let part = (patch * 61 % 97) as f32 / 97.0;
        let side = |texels: u32| ((texels as f32 - part) * nearer).ceil().max(1.0) as u32;
        if *packed == 0 { 0 } else { pack(side(packed & 0xffff), side(packed >> 16)) }
    };
    base.iter().enumerate().map(one).collect()
}

/// An update of these extents, and the part of the blocks that stay in view of which the size changes.
fn changed_share(layout: &mut Layout, extents: &[u32], asked: f32) -> f32 {
    let before: BTreeMap<ScenePatch, Block> = layout.live().collect();
    let lods = LodSet::of_one(extents.len() as u32);
    layout.begin(asked);
    layout.see(Visible { lods: &lods, seen: &seen(extents) });
    placed(layout, &Loose { patches: extents.len() as u32 }, &lods);
    assert_sound(layout, extents);
    let stayed: Vec<_> = layout.live().filter_map(|(patch, now)| Some((now, *before.get(&patch)?))).collect();
    assert!(stayed.iter().all(|(now, before)| now.size != before.size || now == before), "it has moved");
    stayed.iter().filter(|(now, before)| now.size != before.size).count() as f32 / stayed.len().max(1) as f32
}

#[test]
fn few_blocks_change_their_size_in_an_update_while_walking_whatever_is_asked_and_however_full_the_atlas_is() {
    for (side, largest, is_full) in [(512, 60, true), (512, 90, true), (1024, 60, true), (2048, 20, false)] {
        let (mut layout, base) = (layout([side, side], 3000), random_extents(21, 3000, largest));
        let mut shares = Vec::new();
        for update in 0..40 {
            let asked = if (10..25).contains(&update) { std::f32::consts::SQRT_2 } else { 1.0 };
            shares.push(changed_share(&mut layout, &walking(&base, update, asked), asked));
        }
        let (mean, worst) =
            (shares[1..].iter().sum::<f32>() / 39.0, shares[1..].iter().fold(0.0f32, |a, b| a.max(*b)));
        let (density, used) = (layout.density(), layout.used_share());
        println!(
            "{side}, {largest}: mean {:.2} %, worst {:.2} %, density {density}, {used} used",
            100.0 * mean,
            100.0 * worst
        );
        assert!(worst <= 0.05, "{side}, {largest}: {shares:?}");
        assert_eq!(density < 1.0, is_full, "{side}, {largest}: {density}");
    }
}

#[test]
fn what_is_asked_for_is_there_after_a_while() {
    let (mut layout, base) = (layout([2048, 2048], 1000), random_extents(22, 1000, 40));
    let finer: Vec<u32> = base.iter().map(|packed| 2 * packed).collect();
    changed_share(&mut layout, &base, 1.0);
    let coarse_share = layout.used_share();
    let first = changed_share(&mut layout, &finer, 2.0);
    assert!(first > 0.0 && first <= 0.05, "{first}");
    let settled = layout.settled_share();
    assert!(settled > 2.5 * coarse_share, "it says at once what it will come to");
    for _ in 0..40 {
        changed_share(&mut layout, &finer, 2.0);
    }
    assert_eq!(layout.used_share(), settled);
    let stays = |(patch, block): (ScenePatch, Block)| {
        let packed = finer[patch.index()];
        let extent = [packed & 0xffff, packed >> 16].map(|side| side as f32);
        wanted_size(extent, Some(block.size)) == block.size
    };
    assert!(layout.live().all(stays));
}

#[test]
fn a_surround_gives_way_where_what_is_in_view_takes_all_blocks_of_the_smallest_size() {
    let patches = Layout::most_blocks(AtlasExtent::MIN) as usize;
    let mut layout = layout([512, 512], patches).with_surround(0.25);
    let (mut in_view, around) = (vec![pack(1, 1); patches], vec![pack(500, 500); patches]);
    in_view[patches * 9 / 10..].fill(0);
    for _ in 0..3 {
        place_both(&mut layout, &in_view, &around);
    }
    assert_eq!(layout.live_count(), patches * 9 / 10);
    assert!(layout.live().count() == layout.live_count(), "each has a block");
}

#[test]
fn what_was_shaded_out_of_view_does_not_settle() {
    let mut layout = layout([512, 512], 2).with_store(1);
    let settled = |layout: &mut Layout, extents: [u32; 2], shaded: &[u32]| {
        place_both(layout, &extents, &[0, 0]);
        let now = UpdateId(layout.update);
        shaded.iter().for_each(|patch| layout.store_mut().shaded(ScenePatch(*patch), now));
        layout.store_mut().coded(now, 20);
        let mut put = Vec::new();
        layout.settle((now, usize::MAX), |_| true, |patch, _, _| put.push(patch));
        put
    };
    assert_eq!(settled(&mut layout, [pack(8, 8); 2], &[]), [], "they are not coded yet");
    // The second is out of view, held, and shaded there.
    assert_eq!(settled(&mut layout, [pack(8, 8), 0], &[1]), [ScenePatch(0)]);
    assert_eq!(settled(&mut layout, [pack(8, 8), 0], &[]), []);
    assert_eq!(settled(&mut layout, [pack(8, 8); 2], &[1]), []);
    assert_eq!(settled(&mut layout, [pack(8, 8); 2], &[]), [ScenePatch(1)]);
}

#[test]
fn what_leaves_the_store_has_a_block_in_the_atlas_whether_in_view_or_around() {
    const PATCHES: u64 = 100;
    let mut layout = layout([1024, 512], PATCHES as usize).with_surround(0.4).with_store(1);
    let (mut stale_around, mut cleared) = (0, 0);
    for update in 0..300u64 {
        // The view turns over a quarter of all patches, to and fro; the rest is around.
        let first = (update % 100).min(100 - update % 100) * 3 / 2;
        let is_in_view = |patch: u64| (first..first + PATCHES / 4).contains(&patch);
        let extents = |in_view: bool| -> Vec<u32> {
            (0..PATCHES).map(|patch| if is_in_view(patch) == in_view { pack(2, 2) } else { 0 }).collect()
        };
        place_both(&mut layout, &extents(true), &extents(false));
        for (patch, block) in layout.live().chain(layout.around()) {
            assert!(!block.is_stored(), "update {update}: {patch:?} has {block:?}");
            let is_grey = layout.cleared().iter().any(|cleared| cleared.overlaps(block));
            assert!(!is_grey, "update {update}: {block:?} of {patch:?} becomes grey");
        }
        cleared += layout.cleared().len();
        let now = UpdateId(layout.update);
        layout.store_mut().coded(now, 20);
        layout.settle((now, usize::MAX), |_| true, |_, _, _| {});
        layout.store_mut().displayed(UpdateId(now.0.saturating_sub(3)));
        let stored_around = layout.served.iter().find(|placed| placed.is_around).map(|placed| placed.patch);
        stored_around.into_iter().for_each(|patch| layout.store_mut().stale(patch));
        stale_around += u32::from(stored_around.is_some());
    }
    assert!(stale_around > 50 && cleared > 100, "{stale_around}, {cleared}");
}

use super::*;

const PATCHES: usize = 5000;

fn store(pages: u32) -> Store {
    Store::new(pages, PATCHES, AtlasExtent::new(4096, 2048).expect("an atlas"))
}

fn block(number: u32, log2: u8) -> Block {
    let address = BlockAddress { page: 0, x: (number % 512 * 8) as u16, y: (number / 512 * 8) as u16 };
    Block { address, size: BlockSize::new(log2, log2).expect("a size") }
}

/// All that settle with an update, of patches that have blocks of this size.
fn settled(store: &mut Store, update: u32, patches: std::ops::Range<u32>, log2: u8) -> Vec<(u32, Block)> {
    few_settled(store, (update, usize::MAX), patches, log2)
}

/// The same of so many blocks at most.
fn few_settled(
    store: &mut Store,
    (update, most_blocks): (u32, usize),
    patches: std::ops::Range<u32>,
    log2: u8,
) -> Vec<(u32, Block)> {
    let mut settled = Vec::new();
    let live = patches.map(|patch| Settling {
        patch: ScenePatch(patch),
        block: block(patch, log2),
        pixels: pixels([log2; 2]),
        seen: UpdateId(update),
    });
    store.settle((UpdateId(update), most_blocks, 1.0), live, |patch, to| settled.push((patch.0, to)));
    settled
}

fn shade(store: &mut Store, patches: std::ops::Range<u32>, update: u32) {
    patches.for_each(|patch| store.shaded(ScenePatch(patch), UpdateId(update)));
    (update..update + SETTLES_AFTER_UPDATES).for_each(|update| store.coded(UpdateId(update), 18));
}

/// An extent for which a block has these sides, at a texel for a pixel.
fn pixels(log2: [u8; 2]) -> [f32; 2] {
    log2.map(|log2| f32::from(1u16 << log2) - 3.0)
}

/// Where an extent of no pixels is shown from.
fn serves(store: &mut Store, patch: u32, update: u32) -> Option<Block> {
    serves_to(store, patch, update, [0.0; 2])
}

fn serves_to(store: &mut Store, patch: u32, update: u32, pixels: [f32; 2]) -> Option<Block> {
    match store.serve(ScenePatch(patch), (UpdateId(update), 1.0), pixels, || true) {
        Served::Copy(block) => Some(block),
        Served::Atlas(_) => None,
    }
}

#[test]
fn a_block_settles_when_it_has_not_changed_and_is_shown_from_the_next_update_on() {
    let mut store = store(1);
    shade(&mut store, 0..3, 10);
    store.begin(UpdateId(1));
    assert!(settled(&mut store, 10 + SETTLES_AFTER_UPDATES - 1, 0..3, 4).is_empty());
    let now = 10 + SETTLES_AFTER_UPDATES;
    let copies = settled(&mut store, now, 0..3, 4);
    assert_eq!(copies.iter().map(|(patch, _)| *patch).collect::<Vec<_>>(), [0, 1, 2]);
    assert!(copies.iter().all(|(_, to)| to.is_stored() && to.size == block(0, 4).size));
    assert_eq!(serves(&mut store, 1, now), None, "the client copies it with this update");
    assert_eq!(serves(&mut store, 1, now + 1), Some(copies[1].1));
    assert!(settled(&mut store, now + 1, 0..3, 4).is_empty(), "each once");
    assert!(settled(&mut store, now + 1, 7..8, 4).is_empty(), "it was never shaded");
}

#[test]
fn of_many_blocks_few_settle_at_a_time_until_all_have() {
    let mut store = store(1);
    shade(&mut store, 0..7, 10);
    let now = 10 + SETTLES_AFTER_UPDATES;
    let turns = [3, 0, 3, 3].map(|most| few_settled(&mut store, (now, most), 0..7, 4));
    let patches = turns.map(|turn| turn.iter().map(|(patch, _)| *patch).collect::<Vec<_>>());
    assert_eq!(patches, [vec![0, 1, 2], vec![], vec![3, 4, 5], vec![6]]);
}

#[test]
fn a_block_that_is_larger_than_what_may_settle_settles_alone() {
    let mut store = Store::new(1, PATCHES, AtlasExtent::new(1024, 512).expect("an atlas"));
    shade(&mut store, 0..2, 0);
    let patches =
        |settled: Vec<(u32, Block)>| settled.into_iter().map(|(patch, _)| patch).collect::<Vec<_>>();
    assert_eq!(patches(settled(&mut store, 1, 0..2, 8)), [0]);
    assert_eq!(patches(settled(&mut store, 2, 0..2, 8)), [1]);
}

#[test]
fn a_place_is_given_to_another_copy_once_no_update_on_display_names_it() {
    let mut store = store(1);
    shade(&mut store, 0..2, 0);
    let copies = settled(&mut store, 20, 0..1, 9);
    store.begin(UpdateId(1));
    assert!(serves(&mut store, 0, 21).is_some());
    store.give_up(ScenePatch(0));
    assert_eq!(serves(&mut store, 0, 22), None);
    store.displayed(UpdateId(21));
    let other = settled(&mut store, 22, 1..2, 9);
    assert!(!other[0].1.overlaps(copies[0].1), "update 21 shows it still");
    store.displayed(UpdateId(22));
    shade(&mut store, 2..3, 0);
    assert!(settled(&mut store, 30, 2..3, 9)[0].1.overlaps(copies[0].1));
}

#[test]
fn a_full_store_gives_up_what_was_not_shown_for_longest() {
    let mut store = store(1);
    // A page has 16 blocks of 512 texels a side.
    shade(&mut store, 0..20, 0);
    let mut update = 20;
    for patch in 0..16 {
        assert_eq!(settled(&mut store, update, patch..patch + 1, 9).len(), 1);
        update += 1;
    }
    store.begin(UpdateId(1));
    for patch in 8..16 {
        assert!(serves(&mut store, patch, update).is_some());
    }
    assert!(settled(&mut store, update, 16..17, 9).is_empty(), "there is no place yet");
    store.displayed(UpdateId(update + 1));
    assert_eq!(settled(&mut store, update + 2, 16..17, 9).len(), 1);
    assert!((8..16).all(|patch| store.has(ScenePatch(patch))), "these were shown");
}

#[test]
fn copies_of_lost_pictures_are_forgotten_and_older_ones_stay() {
    let mut store = store(1);
    shade(&mut store, 0..2, 0);
    settled(&mut store, 20, 0..1, 4);
    settled(&mut store, 21, 1..2, 4);
    store.lost_after(Some(UpdateId(20)));
    assert!(store.has(ScenePatch(0)) && !store.has(ScenePatch(1)));
    store.lost_after(None);
    assert!(!store.has(ScenePatch(0)));
}

#[test]
fn a_copy_too_coarse_or_coded_coarsely_is_made_anew_a_few_with_each_update() {
    let mut store = store(2);
    shade(&mut store, 0..200, 0);
    (0..20).for_each(|update| store.coded(UpdateId(6 + update), 30));
    let count = (0..40).map(|update| settled(&mut store, 30 + update, 0..200, 6).len()).sum::<usize>();
    assert_eq!(count, 200);
    store.begin(UpdateId(1));
    let [wider, larger, smaller] = [[7, 6], [7, 7], [4, 4]].map(pixels);
    assert!(serves_to(&mut store, 199, 99, smaller).is_some(), "a finer one will do");
    assert!(serves_to(&mut store, 199, 99, wider).is_some(), "a step of one side will do");
    let given_up = (0..200).filter(|patch| serves_to(&mut store, *patch, 100, larger).is_none()).count();
    let most = 4096 * 2048 / MOST_RENEWED_PART / 128u64.pow(2);
    assert_eq!(given_up as u64, most);
}

#[test]
fn a_copy_made_anew_is_for_all_views_that_were_seen() {
    let mut store = store(1);
    shade(&mut store, 0..1, 0);
    settled(&mut store, 20, 0..1, 5);
    store.begin(UpdateId(21));
    assert!(serves_to(&mut store, 0, 21, pixels([3, 5])).is_some());
    let seen = store.serve(ScenePatch(0), (UpdateId(22), 1.0), pixels([3, 6]), || true);
    let [across, down] = [pixels([5; 2])[0], pixels([6; 2])[1]];
    assert_eq!(seen, Served::Atlas(Some([across, down])), "other views need its width");
}

#[test]
fn blocks_have_as_many_texels_as_the_store_can_hold_of_what_was_shown_lately() {
    let mut store = store(1);
    let follow = |store: &mut Store, update: u32| {
        (0..20).for_each(|_| store.follow(UpdateId(update)));
        store.most_density()
    };
    assert_eq!(follow(&mut store, 8), f32::INFINITY, "nothing settles");
    shade(&mut store, 0..16, 0);
    // Of 16 places of 512 texels a side.
    (0..2).for_each(|patch| assert_eq!(settled(&mut store, 20, patch..patch + 1, 9).len(), 1));
    store.follow(UpdateId(20));
    assert_eq!(store.most_density(), 1.0, "that would soon be too much, if it went on so");
    assert_eq!(follow(&mut store, 21), f32::INFINITY, "an eighth is there, and nothing comes");
    (2..16).for_each(|patch| assert_eq!(settled(&mut store, 20, patch..patch + 1, 9).len(), 1));
    assert!((0.7..0.9).contains(&follow(&mut store, 20)), "all of it is too much");
    assert_eq!(follow(&mut store, 20 + RECENT_UPDATES + 1), f32::INFINITY, "that was long ago");
}

#[test]
fn copies_with_more_texels_than_are_asked_for_go_first() {
    let mut store = store(1);
    shade(&mut store, 0..17, 0);
    (0..16).for_each(|patch| assert_eq!(settled(&mut store, 20, patch..patch + 1, 9).len(), 1));
    (8..12).for_each(|patch| store.copies.get_mut(&ScenePatch(patch)).expect("a copy").pixels = [100.0; 2]);
    store.begin(UpdateId(30));
    (8..16).for_each(|patch| assert!(store.show(ScenePatch(patch), UpdateId(30)).is_some()));
    assert!(settled(&mut store, 31, 16..17, 9).is_empty(), "there is no place yet");
    let stay: Vec<u32> = store.copies().map(|(patch, _)| patch.0).collect();
    assert_eq!(stay, [0, 1, 2, 3, 4, 5, 6, 7, 12, 13, 14, 15], "though they were shown last");
}

#[test]
fn what_finds_no_room_in_an_update_is_first_in_the_next() {
    let mut store = store(2);
    shade(&mut store, 0..400, 0);
    // A twentieth of the atlas has 102 blocks of 64 texels a side.
    let order: Vec<u32> = (0..4)
        .flat_map(|update| settled(&mut store, 30 + update, 0..400, 6).into_iter().map(|(patch, _)| patch))
        .collect();
    assert_eq!(order, (0..400).collect::<Vec<_>>());
    (0..400).for_each(|patch| store.give_up(ScenePatch(patch)));
    shade(&mut store, 0..200, 40);
    assert_eq!(settled(&mut store, 50, 0..200, 6)[0].0, 0);
    shade(&mut store, 0..102, 50);
    assert_eq!(settled(&mut store, 51, 0..200, 6)[0].0, 102, "it had no room before");
}

#[test]
fn what_keeps_changing_settles_ever_later() {
    let mut store = store(1);
    let mut update = 0;
    for wait in [1, 2, 4].map(|times| times * SETTLES_AFTER_UPDATES) {
        shade(&mut store, 0..1, update);
        assert!(settled(&mut store, update + wait - 1, 0..1, 4).is_empty());
        assert_eq!(settled(&mut store, update + wait, 0..1, 4).len(), 1);
        store.stale(ScenePatch(0));
        update += wait + 1;
    }
}

#[test]
fn a_store_of_no_pages_does_nothing() {
    let mut store = store(0);
    shade(&mut store, 0..5, 0);
    assert!(settled(&mut store, 50, 0..5, 4).is_empty());
    assert_eq!((store.count(), store.texels(), serves(&mut store, 1, 51)), (0, 0, None));
}

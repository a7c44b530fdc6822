//! Chunk, phase, fade and readiness of an instance at a time.

use super::*;
use crate::motion::arena::ArenaWrites;
use shadecast_protocol::motion::playback::Repetition;

const GRID: Grid = Grid { spacing_ns: 100_000_000 };
const DANCE: ClipId = ClipId(3);
const WALK: ClipId = ClipId(4);
const PATH: ClipId = ClipId(5);
const FOX: InstanceId = InstanceId(7);
const CLIP_S: f32 = 1.7;
/// Of eight bones and two morphs.
const TRACKS: u32 = 3 * 8 + 2;

fn ms(ms: i64) -> WorldTime {
    WorldTime(ms * 1_000_000)
}

fn playback(from_ms: i64, clip: ClipId, start_s: f64, fade_ms: i64) -> Playback<ClipRef> {
    let (from, fade_ns) = (ms(from_ms), fade_ms * 1_000_000);
    let clip = ClipRef { clip, duration_s: CLIP_S };
    Playback { from, clip, start_s, speed: 1.0, repetition: Repetition::Loop, fade_ns }
}

fn fox(source: Source) -> SkinnedInstance {
    SkinnedInstance {
        skeleton: SkeletonId(1),
        placement: [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        path: None,
        palette_base: 30,
        global_base: 40,
        source,
    }
}

/// A fox that dances, all chunks of 1.7 s there, and clips that it could go on with: chunk `c` of clip `n` begins at word
/// `100 n + 2 c`.
fn dancing() -> Skinned {
    let mut tables = Skinned::default();
    let place = SkeletonPlace { entry_count: 9, bone_count: 8, morph_count: 2, ..SkeletonPlace::default() };
    tables.set_skeleton(SkeletonId(1), place);
    for clip in [DANCE, WALK, PATH] {
        (0..4)
            .for_each(|c| tables.set_chunk((clip, c), 100 * clip.0 + 2 * c, TRACKS, ArenaSerial::default()));
    }
    let schedule = Schedule::new(playback(0, DANCE, 0.0, 0));
    tables.set_instance(FOX, fox(Source::Clips(schedule))).expect("its skeleton is known");
    tables
}

fn moment(time_ms: i64) -> PoseQuery {
    PoseQuery { time: ms(time_ms), grid: GRID, written: ArenaSerial::default() }
}

/// The fox, with 10 vertices, at a time.
fn pose(tables: &mut Skinned, time_ms: i64) -> (PlacedPoseGpu, SkinnedCounts) {
    let mut out = [bytemuck::Zeroable::zeroed()];
    let counts = tables.poses(moment(time_ms), &[Drawn { instance: FOX, vertices: 10 }], &mut out);
    (out[0], counts)
}

fn phase_s(pose: &PlacedPoseGpu) -> f64 {
    f64::from(pose.pose.phase_s) + f64::from(pose.pose.phase_low_s)
}

fn is_ready(pose: &PlacedPoseGpu) -> bool {
    pose.flags & POSE_READY != 0
}

#[test]
fn a_clip_is_evaluated_in_the_chunk_of_its_phase() {
    let mut tables = dancing();
    let base = |tables: &mut Skinned, at| pose(tables, at).0.pose.track_base;
    let bases = [0, 499, 500, 1499, 1500, 1699, 1701].map(|at| base(&mut tables, at));
    assert_eq!(bases, [150, 150, 151, 152, 153, 153, 150]);
}

#[test]
fn the_end_of_a_clip_that_holds_it_is_in_its_last_chunk() {
    for (duration_s, chunk) in [(1.5, 2), (1.4999, 2), (0.0, 0), (0.2, 0)] {
        let mut tables = dancing();
        let clip = ClipRef { clip: DANCE, duration_s };
        let once = Playback { clip, repetition: Repetition::Once, ..playback(0, DANCE, 0.0, 0) };
        tables.set_schedule(FOX, Schedule::new(once));
        let (pose, counts) = pose(&mut tables, 9000);
        assert_eq!((pose.pose.track_base, counts.withheld_vertices), (150 + chunk, 0), "{duration_s} s");
    }
}

#[test]
fn a_phase_is_exact_to_less_than_a_nanosecond_after_a_week() {
    let mut tables = dancing();
    let week_ms = 7 * 24 * 3600 * 1000;
    let (pose, _) = pose(&mut tables, week_ms + 123);
    let expected = (week_ms as f64 * 1e-3 + 0.123).rem_euclid(f64::from(1.7f32));
    assert!((phase_s(&pose) - expected).abs() < 1e-9, "{} for {expected}", phase_s(&pose));
    assert!(pose.pose.phase_low_s != 0.0);
}

#[test]
fn time_independent_data_is_the_skeletons_and_the_instances() {
    let mut tables = dancing();
    let (placed, counts) = pose(&mut tables, 0);
    assert_eq!([placed.pose.entry_count, placed.pose.palette_base, placed.pose.global_base], [9, 30, 40]);
    assert_eq!((placed.morph_count, placed.flags, placed.placement[0][3]), (2, POSE_READY, 5.0));
    assert_eq!(counts, SkinnedCounts { instances: 1, ..SkinnedCounts::default() });
}

#[test]
fn an_instance_without_its_chunk_is_withheld_and_reported() {
    let mut tables = dancing();
    tables.forget_chunk((DANCE, 1));
    for (at, ready) in [(499, true), (500, false), (999, false), (1000, true)] {
        let (pose, counts) = pose(&mut tables, at);
        assert_eq!((is_ready(&pose), counts.instances), (ready, 1), "{at} ms");
        assert_eq!(counts.withheld_vertices, if ready { 0 } else { 10 });
        assert_eq!(pose.pose.entry_count, 9, "the palette to be cleared");
    }
}

#[test]
fn words_on_their_way_are_not_evaluated() {
    let mut arena = ArenaWrites::new(16);
    let late = arena.push(0, &[0; 16]);
    let mut tables = dancing();
    tables.set_chunk((DANCE, 1), 10, TRACKS, late);
    assert!(!is_ready(&pose(&mut tables, 600).0));
    arena.drain_into(&mut [0; 16], |_| {});
    let mut out = [bytemuck::Zeroable::zeroed()];
    let there = PoseQuery { written: arena.written(), ..moment(600) };
    tables.poses(there, &[Drawn { instance: FOX, vertices: 10 }], &mut out);
    assert!(is_ready(&out[0]));
    let late = arena.push(0, &[0; 16]);
    tables.set_skeleton(SkeletonId(1), SkeletonPlace { written: late, ..SkeletonPlace::default() });
    let clip = Schedule::new(playback(0, DANCE, 0.0, 0));
    tables.set_instance(FOX, fox(Source::Clips(clip))).expect("its skeleton is known");
    assert!(!is_ready(&pose(&mut tables, 0).0), "a skeleton is words too");
}

#[test]
fn a_fade_needs_both_clips_and_weighs_what_was_before() {
    let mut tables = dancing();
    let mut schedule = Schedule::new(playback(0, DANCE, 0.0, 0));
    schedule.change(playback(1000, WALK, 0.25, 400));
    tables.set_schedule(FOX, schedule);
    let (faded, _) = pose(&mut tables, 1100);
    assert_eq!([faded.pose.track_base, faded.pose.fading_track_base], [200, 152]);
    assert_eq!((faded.pose.phase_s, faded.pose.fading_phase_s, faded.pose.fading), (0.35, 1.1, 0.75));
    assert_eq!(pose(&mut tables, 1400).0.pose.fading, 0.0);
    tables.forget_chunk((DANCE, 2));
    assert!(!is_ready(&pose(&mut tables, 1100).0), "what is faded out is missing");
    assert!(is_ready(&pose(&mut tables, 1400).0), "it is not needed any more");
}

#[test]
fn a_path_has_its_own_phase_and_is_waited_for() {
    let mut tables = dancing();
    let clip = Schedule::new(playback(0, DANCE, 0.0, 0));
    let path = Some(Schedule::new(Playback { speed: 0.5, ..playback(0, PATH, 0.0, 0) }));
    tables.set_instance(FOX, SkinnedInstance { path, ..fox(Source::Clips(clip)) }).expect("known");
    let (moved, _) = pose(&mut tables, 1200);
    assert_eq!(moved.flags, POSE_READY | POSE_HAS_PATH);
    assert_eq!((moved.path_track_base, moved.path_phase_s, moved.pose.track_base), (251, 0.6, 152));
    tables.forget_chunk((PATH, 1));
    assert!(!is_ready(&pose(&mut tables, 1200).0));
}

#[test]
fn a_change_in_time_is_followed_to_the_letter() {
    let mut tables = dancing();
    pose(&mut tables, 900);
    let mut schedule = Schedule::new(playback(0, DANCE, 0.0, 0));
    schedule.change(playback(1000, WALK, 0.0, 0));
    tables.set_schedule(FOX, schedule);
    assert_eq!(pose(&mut tables, 999).0.pose.track_base, 151);
    let (changed, _) = pose(&mut tables, 1000);
    assert_eq!((changed.pose.track_base, changed.pose.fading), (200, 0.0));
}

#[test]
fn a_late_change_is_blended_within_the_blending_time() {
    let mut tables = dancing();
    pose(&mut tables, 900);
    let mut schedule = Schedule::new(playback(0, DANCE, 0.0, 0));
    schedule.change(playback(600, WALK, 0.0, 0));
    tables.set_schedule(FOX, schedule);
    let blend_ms = BLEND_NS / 1_000_000;
    for (after, share) in [(0, 1.0), (blend_ms / 4, 0.75), (blend_ms, 0.0), (400, 0.0)] {
        let (blended, _) = pose(&mut tables, 900 + after);
        assert!((f64::from(blended.pose.fading) - share).abs() < 1e-6, "{after} ms: {}", blended.pose.fading);
        let walked_s = (300 + after) as f64 * 1e-3;
        assert!((phase_s(&blended) - walked_s).abs() < 1e-9, "where it would be had it come in time");
        if share > 0.0 {
            let danced_s = (900 + after) as f64 * 1e-3;
            assert!((f64::from(blended.pose.fading_phase_s) - danced_s).abs() < 1e-6, "no jump");
        }
    }
}

#[test]
fn what_is_told_again_disturbs_no_blend_and_later_changes_count() {
    let mut tables = dancing();
    pose(&mut tables, 900);
    let mut schedule = Schedule::new(playback(0, DANCE, 0.0, 0));
    schedule.change(playback(600, WALK, 0.0, 0));
    tables.set_schedule(FOX, schedule.clone());
    pose(&mut tables, 950);
    // The same with its past forgotten, and with something to come.
    schedule.forget_before(ms(950));
    schedule.change(playback(2000, DANCE, 0.0, 0));
    tables.set_schedule(FOX, schedule);
    assert!((f64::from(pose(&mut tables, 1000).0.pose.fading) - 0.5).abs() < 1e-6);
    assert_eq!(pose(&mut tables, 2100).0.pose.track_base, 150);
}

#[test]
fn playback_before_its_start_continues_until_a_change() {
    let mut tables = dancing();
    tables.set_schedule(FOX, Schedule::new(playback(1000, DANCE, 1.0, 0)));
    pose(&mut tables, 700);
    // The same from an earlier time on, and something to come.
    let mut schedule = Schedule::new(playback(500, DANCE, 0.5, 0));
    schedule.change(playback(2000, WALK, 0.0, 0));
    tables.set_schedule(FOX, schedule);
    assert_eq!(pose(&mut tables, 800).0.pose.track_base, 151, "DANCE");
    assert_eq!(pose(&mut tables, 2100).0.pose.track_base, 200, "WALK");
}

#[test]
fn a_blend_is_over_when_the_next_change_takes_effect() {
    let mut tables = dancing();
    pose(&mut tables, 900);
    let mut schedule = Schedule::new(playback(0, DANCE, 0.0, 0));
    schedule.change(playback(600, WALK, 0.0, 0));
    schedule.change(playback(950, PATH, 0.0, 0));
    tables.set_schedule(FOX, schedule);
    assert!((f64::from(pose(&mut tables, 925).0.pose.fading) - 0.5).abs() < 1e-6);
    assert_eq!(pose(&mut tables, 949).0.pose.track_base, 200, "WALK");
    let (next, _) = pose(&mut tables, 950);
    assert_eq!((next.pose.track_base, next.pose.fading), (250, 0.0));
}

#[test]
fn instances_that_are_unknown_or_too_many_are_withheld() {
    let mut tables = dancing();
    let drawn = [6, 7, 7].map(|id| Drawn { instance: InstanceId(id), vertices: 10 });
    let mut out = [bytemuck::Zeroable::zeroed()];
    let counts = tables.poses(moment(0), &drawn, &mut out);
    assert_eq!((counts.instances, counts.withheld_vertices), (1, 20));
    assert!(!tables.is_empty() && Skinned::default().is_empty());
}

#[test]
fn an_instance_of_an_unknown_skeleton_is_refused() {
    let unknown =
        SkinnedInstance { skeleton: SkeletonId(2), ..fox(Source::Grid { first_word: 0, steps: 4 }) };
    assert_eq!(dancing().set_instance(FOX, unknown), Err(UnknownSkeleton(FOX, SkeletonId(2))));
}

#[test]
fn a_chunk_with_too_few_tracks_is_not_evaluated() {
    for (tracks, ready) in [(TRACKS - 1, false), (TRACKS, true), (TRACKS + 1, true)] {
        let mut tables = dancing();
        tables.set_chunk((DANCE, 0), 0, tracks, ArenaSerial::default());
        assert_eq!(is_ready(&pose(&mut tables, 0).0), ready, "{tracks} tracks");
    }
}

#[test]
fn a_path_needs_the_tracks_of_one_bone() {
    for (tracks, ready) in [(2, false), (3, true)] {
        let mut tables = dancing();
        tables.set_chunk((PATH, 0), 0, tracks, ArenaSerial::default());
        let path = Some(Schedule::new(playback(0, PATH, 0.0, 0)));
        let clip = Schedule::new(playback(0, DANCE, 0.0, 0));
        tables.set_instance(FOX, SkinnedInstance { path, ..fox(Source::Clips(clip)) }).expect("known");
        assert_eq!(is_ready(&pose(&mut tables, 0).0), ready, "{tracks} tracks");
    }
}

fn on_grid(steps: &[i32]) -> Skinned {
    let mut tables = dancing();
    tables.set_instance(FOX, fox(Source::Grid { first_word: 1000, steps: 8 })).expect("known");
    steps.iter().for_each(|step| tables.set_grid_step(FOX, GridIndex(*step), ArenaSerial::default()));
    tables
}

/// The word of a place in the ring.
fn word(place: u32) -> u32 {
    1000 + place * grid_words(8, 2)
}

#[test]
fn grid_poses_use_four_steps_where_present() {
    let (pose, _) = pose(&mut on_grid(&[6, 7, 8, 9]), 725);
    assert_eq!(pose.flags, POSE_READY | POSE_FROM_GRID);
    assert_eq!(pose.grid_words, [6, 7, 0, 1].map(word));
    let expected = cubic_weights(0.25);
    assert!(pose.grid_weights.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6));
}

#[test]
fn grid_poses_without_an_outer_step_are_linear() {
    for steps in [&[7, 8][..], &[6, 7, 8], &[7, 8, 9]] {
        let (pose, counts) = pose(&mut on_grid(steps), 725);
        assert_eq!(pose.grid_weights, [0.0, 0.75, 0.25, 0.0], "{steps:?}");
        assert_eq!([pose.grid_words[1], pose.grid_words[2]], [7, 0].map(word));
        let has = |words: &[u32]| words.iter().all(|w| steps.iter().any(|s| word(*s as u32 % 8) == *w));
        assert!(has(&pose.grid_words), "{steps:?}: {:?}", pose.grid_words);
        assert_eq!(counts, SkinnedCounts { instances: 1, ..SkinnedCounts::default() });
    }
}

#[test]
fn past_the_last_grid_pose_an_instance_extrapolates_one_step() {
    let mut tables = on_grid(&[6, 7]);
    let weights = |tables: &mut Skinned, at| pose(tables, at).0.grid_weights;
    assert_eq!(weights(&mut tables, 750), [-0.5, 1.5, 0.0, 0.0]);
    assert_eq!(weights(&mut tables, 850), [-1.0, 2.0, 0.0, 0.0]);
    assert_eq!(weights(&mut on_grid(&[7]), 750), [0.0, 1.0, 0.0, 0.0]);
    let counts = [750, 850].map(|at| pose(&mut tables, at).1);
    assert_eq!(counts.map(|c| [c.held_vertices, c.frozen_vertices]), [[10, 0], [0, 10]]);
    assert!(!is_ready(&pose(&mut tables, 550).0), "before the first");
}

#[test]
fn a_step_that_took_the_place_of_another_is_not_taken_for_it() {
    let mut tables = on_grid(&[6, 7, 8, 9]);
    tables.set_grid_step(FOX, GridIndex(14), ArenaSerial::default());
    let (pose, _) = pose(&mut tables, 725);
    assert_eq!(pose.grid_weights, [0.0, 0.75, 0.25, 0.0], "14 lies where 6 was");
}

#[test]
fn a_draw_list_has_each_instance_once_with_its_vertices() {
    let mut drawn = DrawnInstances::default();
    for list in [[5, 0, 5, 9, 0, 5], [0, 0, 9, 9, 5, 0]] {
        list.iter().for_each(|id| drawn.add_vertex(InstanceId(*id)));
        for id in [0, 5, 9] {
            let expected = list.iter().filter(|other| **other == id).count() as u32;
            let found: Vec<_> = drawn.all().iter().filter(|drawn| drawn.instance.0 == id).collect();
            assert_eq!(found, [&Drawn { instance: InstanceId(id), vertices: expected }]);
        }
        list.iter().for_each(|id| drawn.remove_vertex(InstanceId(*id)));
        assert!(drawn.all().is_empty(), "{:?}", drawn.all());
    }
}

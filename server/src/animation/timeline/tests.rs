use super::*;
use glam::{Quat, Vec3};
use shadecast_scene::load::{SceneSource, load_scene};

fn ms(ms: i64) -> WorldTime {
    WorldTime(ms * 1_000_000)
}

/// Two dragons, the second of them live, and the ground.
fn scene() -> Scene {
    let mut scene = load_scene(&SceneSource::Dragons(2)).expect("built in");
    scene.instances[1].live = true;
    scene
}

fn rest(scene: &Scene) -> Vec<Trs> {
    scene.models[0].bones.iter().map(|bone| bone.rest).collect()
}

fn faster() -> Change {
    Change { speed: Some(3.0), ..Change::default() }
}

#[test]
fn a_change_never_precedes_sampled_times() {
    let mut timeline = Timeline::new(&scene());
    assert_eq!(timeline.set_playback(0, faster(), ms(700)), Ok(ms(700)));
    timeline.sampled(ms(900));
    timeline.sampled(ms(800));
    let before = timeline.at(0, ms(900));
    let change = Change { clip: Some(Some(0)), ..faster() };
    assert_eq!(timeline.set_playback(0, change, ms(850)), Ok(WorldTime(ms(900).0 + 1)));
    assert_eq!(timeline.at(0, ms(900)), before);
    assert_eq!(timeline.set_playback(0, faster(), ms(950)), Ok(ms(950)));
}

#[test]
fn unprepared_changes_are_refused_without_effect() {
    let scene = scene();
    let mut timeline = Timeline::new(&scene);
    let before = timeline.schedule(0).clone();
    let mut refused =
        |instance, change| timeline.set_playback(instance, change, ms(10)).expect_err("refused").to_string();
    let rest = Change { clip: Some(None), ..Change::default() };
    let not_playable = "instance \"dragon 0\" cannot play clip None: no event of the scene names it; name it in \
         an event, or set live = true on the instance";
    assert_eq!(refused(0, rest), not_playable);
    let not_live = "instance \"dragon 0\" cannot fade from clip to clip at run time; set live = true on \
         the instance";
    assert_eq!(refused(0, Change { clip: Some(Some(0)), fade_ns: 1, ..Change::default() }), not_live);
    assert_eq!(refused(9, rest), "the scene has no instance 9; it has 3, numbered from 0");
    let out_of_range = [
        Change { speed: Some(f64::NAN), ..Change::default() },
        Change { local_s: Some(f64::INFINITY), ..Change::default() },
        Change { fade_ns: -1, ..Change::default() },
        Change { fade_ns: MAX_FADE_NS + 1, ..Change::default() },
    ];
    out_of_range.into_iter().for_each(|change| assert!(refused(1, change).contains("cannot be changed")));
    assert_eq!(timeline.schedule(0), &before);
    let fade = Change { fade_ns: MAX_FADE_NS, ..rest };
    assert_eq!(timeline.set_playback(1, fade, ms(10)), Ok(ms(10)), "a live one may play all and fade");
}

#[test]
fn a_live_instance_moves_linearly_between_poses() {
    let scene = scene();
    let mut timeline = Timeline::new(&scene);
    let (from, mut to) = (rest(&scene), rest(&scene));
    to[0].scale = from[0].scale * 0.5;
    timeline.set_pose(1, ms(1000), from.clone()).expect("a pose");
    timeline.set_pose(1, ms(1200), to.clone()).expect("a pose");
    let scale = |at| match timeline.at(1, at) {
        Shown::Live(pose) => pose[0].scale.x / from[0].scale.x,
        Shown::Clips(_) => f32::NAN,
    };
    assert!(scale(ms(999)).is_nan(), "its clip until the first pose");
    assert_eq!([1000, 1100, 1200, 5000].map(|at| scale(ms(at))), [1.0, 0.75, 0.5, 0.5]);
}

#[test]
fn a_released_instance_plays_its_clip_again() {
    let scene = scene();
    let mut timeline = Timeline::new(&scene);
    timeline.set_pose(1, ms(1000), rest(&scene)).expect("a pose");
    timeline.sampled(ms(1500));
    assert_eq!(timeline.release_pose(1, ms(0)), Ok(WorldTime(ms(1500).0 + 1)));
    assert_eq!(timeline.release_pose(1, ms(0)), Ok(WorldTime(ms(1500).0 + 1)), "twice is no fault");
    let seen = timeline.set_pose(1, ms(2000), rest(&scene)).expect("a pose");
    assert_eq!(seen, ms(2000));
    let is_live = |at| matches!(timeline.at(1, ms(at)), Shown::Live(_));
    assert_eq!([999, 1000, 1500, 1501, 1999, 2000].map(is_live), [false, true, true, false, false, true]);
}

#[test]
fn a_pose_that_comes_late_is_seen_after_what_was_sampled() {
    let scene = scene();
    let mut timeline = Timeline::new(&scene);
    timeline.sampled(ms(1500));
    assert_eq!(timeline.set_pose(1, ms(1000), rest(&scene)), Ok(WorldTime(ms(1500).0 + 1)));
    assert!(matches!(timeline.at(1, ms(1500)), Shown::Clips(_)), "that was sampled as its clip has it");
    assert!(matches!(timeline.at(1, ms(1501)), Shown::Live(_)));
}

#[test]
fn a_pose_changes_nothing_that_was_sampled_whenever_it_comes() {
    let scene = scene();
    let mut timeline = Timeline::new(&scene);
    let (whole, mut half) = (rest(&scene), rest(&scene));
    half[0].scale = whole[0].scale * 0.5;
    let scales = |timeline: &Timeline, at: &[i64]| -> Vec<f32> {
        let scale = |at: &i64| match timeline.at(1, ms(*at)) {
            Shown::Live(pose) => pose[0].scale.x / whole[0].scale.x,
            Shown::Clips(_) => f32::NAN,
        };
        at.iter().map(scale).collect()
    };
    timeline.set_pose(1, ms(1000), whole.clone()).expect("a pose");
    timeline.sampled(ms(1500));
    assert_eq!(timeline.set_pose(1, ms(2000), half.clone()), Ok(ms(2000)));
    assert_eq!(scales(&timeline, &[1000, 1250, 1500, 1750, 2000]), [1.0, 1.0, 1.0, 0.75, 0.5]);
    timeline.sampled(ms(2500));
    let after = Ok(WorldTime(ms(2500).0 + 1));
    assert_eq!(timeline.set_pose(1, ms(2100), half), after);
    assert_eq!(
        timeline.set_pose(1, ms(2200), whole.clone()),
        after,
        "of two that are late the newer one counts"
    );
    assert_eq!(scales(&timeline, &[2000, 2100, 2500, 2501]), [0.5, 0.5, 0.5, 1.0]);
}

#[test]
fn poses_that_are_none_are_refused() {
    let scene = scene();
    let mut timeline = Timeline::new(&scene);
    let mut refused =
        |instance, time, pose| timeline.set_pose(instance, time, pose).expect_err("refused").to_string();
    let with = |bone: Trs| rest(&scene).into_iter().map(|_| bone).collect::<Vec<_>>();
    assert!(refused(0, ms(1), rest(&scene)).contains("cannot be posed at run time"));
    assert!(refused(1, ms(1), Vec::new()).contains("the pose has 0 bones"));
    let none = Quat::from_xyzw(0.0, 0.0, 0.0, 0.0);
    assert!(refused(1, ms(1), with(Trs { rotation: none, ..Trs::IDENTITY })).contains("has no length"));
    let nowhere = Vec3::splat(f32::NAN);
    assert!(refused(1, ms(1), with(Trs { translation: nowhere, ..Trs::IDENTITY })).contains("not finite"));
    let far = with(Trs { translation: Vec3::X * 10.0, ..Trs::IDENTITY });
    assert!(refused(1, ms(1), far).contains("m are reserved"));
    assert!(refused(1, WorldTime(i64::MIN), rest(&scene)).contains("is no time"));
    timeline.set_pose(1, ms(5), rest(&scene)).expect("a pose");
    assert!(timeline.set_pose(1, ms(5), rest(&scene)).is_err(), "not later than the one before");
}

#[test]
fn poses_and_changes_without_end_take_no_memory_without_end() {
    let scene = scene();
    let mut timeline = Timeline::new(&scene);
    for step in 0..3000 {
        let at = ms(step * 100);
        timeline.set_pose(1, at, rest(&scene)).expect("a pose");
        timeline.set_playback(0, faster(), at).expect("a change");
        if step % 7 == 0 {
            timeline.sampled(at);
            timeline.release_pose(1, at).expect("it is live");
        }
    }
    let live = timeline.instances[1].live.as_ref().expect("it is");
    assert!(live.runs.len() < 30 && timeline.schedule(0).entries().len() < 130);
}

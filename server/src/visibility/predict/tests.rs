use super::*;
use shadecast_protocol::ids::DiscontinuityId;
use shadecast_protocol::time::DEFAULT_GRID;
use shadecast_protocol::world_clock::Steer;
use std::f32::consts::FRAC_PI_2;

fn state(sequence: u32, seconds: f64, x: f32, turn_rad_s: f32) -> HeadState {
    let eye = |x| Eye {
        head_from_eye: Pose { position: Vec3::new(x, 0.0, 0.0), orientation: Quat::IDENTITY },
        fov: Fov::symmetric_degrees(90.0),
    };
    HeadState {
        sequence,
        time: ServerTime((seconds * 1e9) as i64),
        world_from_head: Pose {
            position: Vec3::new(x, 1.6, 0.0),
            orientation: Quat::from_rotation_y(turn_rad_s * seconds as f32),
        },
        linear_velocity: Vec3::new(1.0, 0.0, 0.0),
        angular_velocity: Vec3::new(0.0, turn_rad_s, 0.0),
        eyes: [eye(-0.0315), eye(0.0315)],
        discontinuity: DiscontinuityId(0),
    }
}

#[test]
fn a_steady_head_is_predicted_where_it_will_be() {
    let pose = extrapolate(&state(0, 1.0, 5.0, 0.8), ServerTime(1_100_000_000));
    assert!((pose.position.x - 5.1).abs() < 1e-5);
    assert!(pose.orientation.angle_between(Quat::from_rotation_y(0.88)) < 1e-3);
}

#[test]
fn without_prediction_views_are_those_of_the_last_report_and_the_world_of_now() {
    let mut track = HeadTrack::default();
    assert!(track.unpredicted(ServerTime(1), &WorldClock::default(), DEFAULT_GRID).is_none());
    track.head(state(0, 1.0, 5.0, 0.8));
    track.displayed(ServerTime(0), ServerTime(70_000_000));
    let now = ServerTime(1_200_000_000);
    let views = track.unpredicted(now, &WorldClock::default(), DEFAULT_GRID).expect("a head is known");
    assert_eq!(views.world_from_head, state(0, 1.0, 5.0, 0.8).world_from_head);
    let [first, shaded, last] = views.times.map(|at| at.time(DEFAULT_GRID));
    assert!(first <= views.begun && views.begun <= last && views.begun == WorldTime(now.0));
    assert!((shaded.0 - now.0).abs() <= DEFAULT_GRID.spacing_ns, "{shaded:?}");
}

#[test]
fn view_times_cover_the_time_on_display() {
    let mut track = HeadTrack::default();
    track.head(state(0, 1.0, 0.0, 0.0));
    for update in 0..20 {
        let start = ServerTime(update * 33_000_000);
        track.displayed(start, start.plus_ns(70_000_000));
    }
    let now = ServerTime(1_000_000_000);
    let views = track.predict(now, &WorldClock::default(), DEFAULT_GRID, 0.0).unwrap();
    let [first, last] = track.delays_ns();
    assert_eq!((first, last), (70_000_000, 103_000_000), "on display until the next one comes");
    assert!(views.times[0].time(DEFAULT_GRID) <= WorldTime(now.0 + first));
    assert!(views.times[2].time(DEFAULT_GRID) >= WorldTime(now.0 + last));
}

#[test]
fn in_a_world_that_stands_the_head_goes_on() {
    let mut track = HeadTrack::default();
    track.head(state(0, 1.0, 0.0, 0.8));
    let mut clock = WorldClock::default();
    clock.steer(Steer::Halt, ServerTime(1_000_000_000));
    let now = ServerTime(1_200_000_000);
    let [goes, stands] = [WorldClock::default(), clock]
        .map(|clock| track.predict(now, &clock, DEFAULT_GRID, 0.0).expect("known"));
    let times = stands.times.map(|at| at.time(DEFAULT_GRID).0);
    assert!(times.iter().all(|at| (at - 1_000_000_000).abs() <= DEFAULT_GRID.spacing_ns), "{times:?}");
    assert_eq!(stands.world_from_head, goes.world_from_head);
    assert_eq!((stands.begun.0, goes.begun.0), (1_000_000_000, now.0));
    for (stands, goes) in stands.eyes.iter().flatten().zip(goes.eyes.iter().flatten()) {
        let turned = stands.world_from_eye.orientation.angle_between(goes.world_from_eye.orientation);
        assert!(turned <= 0.8 * 0.04, "{turned} rad: no more than a grid step's");
    }
}

#[test]
fn shading_is_for_the_middle_of_the_frames_that_show_it() {
    const FRAME_NS: i64 = 13_888_889;
    let mut track = HeadTrack::new(DisplayTiming { period_ns: FRAME_NS, blends: false });
    track.head(state(0, 1.0, 0.0, 0.0));
    // On display for three frames each, at 41.7, 55.6 and 69.4 ms after its start.
    for update in 0..20 {
        let start = ServerTime(update * 3 * FRAME_NS);
        track.displayed(start, start.plus_ns(3 * FRAME_NS));
    }
    for phase in 0..8 {
        let now = ServerTime(1_000_000_000 + phase * 5_000_000);
        let views = track.predict(now, &WorldClock::default(), DEFAULT_GRID, 0.0).unwrap();
        let apart_ns = (views.times[1].time(DEFAULT_GRID).0 - now.plus_ns(4 * FRAME_NS).0).abs();
        assert!(apart_ns <= DEFAULT_GRID.spacing_ns / 8 + 2, "{apart_ns} ns");
    }
}

#[test]
fn a_head_that_stands_still_is_predicted_at_one_place_and_one_that_goes_slowly_is_not() {
    let of = |sequence: u32, x: f32, turn: f32| HeadState {
        linear_velocity: Vec3::new(1e-4, 0.0, 0.0),
        angular_velocity: Vec3::new(0.0, 1e-4, 0.0),
        world_from_head: Pose {
            position: Vec3::new(x, 1.6, 0.0),
            orientation: Quat::from_rotation_y(0.7 + turn),
        },
        ..state(sequence, 1.0 + f64::from(sequence) * 0.01, x, 0.0)
    };
    let mut track = HeadTrack::default();
    let mut views = |state: HeadState| {
        let now = state.time;
        track.head(state);
        track
            .predict(now, &WorldClock::default(), DEFAULT_GRID, 0.0)
            .expect("it is known")
            .eyes
            .map(|pair| pair.map(|eye| eye.world_from_eye))
    };
    views(of(0, 0.0, 0.0));
    let still = views(of(1, 0.0, 0.0));
    for (number, noise) in (2..).zip([1e-6, -1e-6, 2e-5, -2e-5]) {
        assert_eq!(views(of(number, noise, noise)), still, "{noise}");
    }
    assert_ne!(views(of(6, 2e-4, 0.0)), still, "it is somewhere else");
    let there = views(of(7, 2e-4, 0.0));
    assert_ne!(views(of(8, 2e-4, 1e-3)), there, "it has turned");
    let mut x = 0.0;
    for number in 9..400 {
        x += 2e-5;
        let [[left, _], ..] = views(of(number, x, 0.0));
        assert!((left.position.x - views_x(x)).abs() < 1e-4, "{number}");
    }
}

/// Where the left eye of a head at `x` is that has turned by 0.7.
fn views_x(x: f32) -> f32 {
    x + (Quat::from_rotation_y(0.7) * Vec3::new(-0.0315, 0.0, 0.0)).x
}

#[test]
fn states_out_of_order_are_ignored_and_a_jump_forgets_what_was_promised() {
    let mut track = HeadTrack::default();
    track.head(state(5, 1.0, 1.0, 0.0));
    track.head(state(4, 0.9, 0.0, 0.0));
    assert_eq!(track.latest.unwrap().sequence, 5);
    track.predict(ServerTime(1_000_000_000), &WorldClock::default(), DEFAULT_GRID, 0.0);
    let jumped = HeadState { discontinuity: DiscontinuityId(1), ..state(6, 2.0, 50.0, 0.0) };
    track.head(jumped);
    assert!(track.errors.is_empty() && track.promised.is_empty());
}

#[test]
fn a_jump_is_no_error_of_the_prediction() {
    let margin_after = |jump: DiscontinuityId| {
        let mut track = HeadTrack::default();
        track.head(state(0, 1.0, 0.0, 0.0));
        track.predict(ServerTime(1_000_000_000), &WorldClock::default(), DEFAULT_GRID, 0.0);
        track.head(HeadState { discontinuity: jump, ..state(1, 1.5, 50.0, 0.0) });
        track.margin()
    };
    assert!(margin_after(DiscontinuityId(0)) > MIN_MARGIN);
    assert_eq!(margin_after(DiscontinuityId(1)), MIN_MARGIN);
}

#[test]
fn a_pause_does_not_count_as_time_on_display() {
    let mut track = HeadTrack::default();
    let shown = |track: &mut HeadTrack, update_ms: i64| {
        let start = ServerTime(update_ms * 1_000_000);
        track.displayed(start, start.plus_ns(70_000_000));
    };
    (0..5).for_each(|update| shown(&mut track, update * 33));
    track.interrupted();
    (0..5).for_each(|update| shown(&mut track, 20_000 + update * 33));
    assert_eq!(track.delays_ns(), [70_000_000, 103_000_000]);
}

#[test]
fn the_margin_grows_with_the_error_and_stays_bounded() {
    let mut track = HeadTrack::default();
    let steady = track.margin();
    for i in 0..40 {
        let turn = if i % 2 == 0 { 3.0 } else { -3.0 };
        track.head(state(i, 1.0 + f64::from(i) * 0.1, 0.0, turn));
        track.predict(
            ServerTime(1_000_000_000 + i64::from(i) * 100_000_000),
            &WorldClock::default(),
            DEFAULT_GRID,
            0.0,
        );
    }
    assert_eq!(steady, MIN_MARGIN);
    assert!(track.margin() > steady && track.margin() <= MAX_MARGIN);
}

#[test]
fn a_late_update_predicts_the_world_as_far_and_the_head_no_farther_than_it_can_be() {
    let mut track = HeadTrack::default();
    track.head(state(0, 1.0, 0.0, 0.0));
    let (start, delay_ns) = (ServerTime(1_000_000_000), 1_500_000_000);
    (0..3).for_each(|update| {
        let start = start.plus_ns(update * delay_ns);
        track.displayed(start, start.plus_ns(delay_ns));
    });
    track.head(HeadState { linear_velocity: Vec3::X, ..state(1, 1.0, 0.0, 0.0) });
    let views = track.predict(start, &WorldClock::default(), DEFAULT_GRID, 0.0).expect("a head is known");
    let last = views.times[VIEW_TIMES - 1].time(DEFAULT_GRID);
    assert!(last.since(views.begun) >= 2 * delay_ns, "{:?}", views.times);
    assert!((views.world_from_head.position.x - MAX_HORIZON_NS as f32 * 1e-9).abs() < 1e-3);
}

#[test]
fn views_of_an_update_that_stays_long_reach_from_a_head_that_stops_to_one_that_turns_on() {
    let turned_degrees = |delay_ns: i64| {
        let mut track = HeadTrack::default();
        let begun = ServerTime(1_000_000_000);
        (0..3).for_each(|update| {
            let start = begun.plus_ns(update * delay_ns);
            track.displayed(start, start.plus_ns(delay_ns));
        });
        let now = state(1, 1.0, 0.0, FRAC_PI_2);
        track.head(now);
        let views = track.predict(begun, &WorldClock::default(), DEFAULT_GRID, 0.0).expect("a head is known");
        let from = now.world_from_head.orientation;
        views.eyes.map(|[left, _]| left.world_from_eye.orientation.angle_between(from).to_degrees().round())
    };
    assert_eq!(turned_degrees(1_000_000_000), [0.0, 36.0, 72.0]);
    assert_eq!(turned_degrees(500_000_000), [27.0, 36.0, 72.0]);
    // Soon enough on display, it is predicted as it turns.
    let [first, middle, last] = turned_degrees(100_000_000);
    assert!(
        (6.0..=9.0).contains(&first) && first < middle && middle < last && (18.0..=21.0).contains(&last),
        "{first} {middle} {last}"
    );
}

#[test]
fn any_reported_time_of_display_is_taken_without_harm() {
    for reported in [i64::MIN, i64::MIN + 1, -1, 0, i64::MAX - 1, i64::MAX] {
        let mut track = HeadTrack::default();
        track.head(state(0, 1.0, 0.0, 0.0));
        (0..5).for_each(|update| track.displayed(ServerTime(update), ServerTime(reported)));
        let [first_ns, last_ns] = track.delays_ns();
        assert!(0 <= first_ns && first_ns <= last_ns && last_ns <= MAX_DELAY_NS, "{reported}");
        assert!(track.predict(ServerTime(1), &WorldClock::default(), DEFAULT_GRID, 0.0).is_some());
    }
}

#[test]
fn a_link_that_pauses_now_and_then_does_not_move_the_usual_horizon() {
    let mut track = HeadTrack::default();
    let mut at = ServerTime(0);
    for update in 0..40 {
        let stays_ns = if update % 8 == 0 { 2_000_000_000 } else { 50_000_000 };
        track.displayed(at, at.plus_ns(30_000_000));
        at = at.plus_ns(stays_ns);
    }
    assert!(track.delays_ns()[1] <= MAX_HORIZON_NS, "{:?}", track.delays_ns());
}

#[test]
fn before_displays_are_reported_an_update_lies_ahead_by_what_it_takes() {
    let mut track = HeadTrack::default();
    track.note_update(12_000_000);
    assert_eq!(track.delays_ns(), [START_FIRST_NS, START_LAST_NS]);
    track.note_update(700_000_000);
    assert_eq!(track.delays_ns(), [700_000_000, 1_400_000_000]);
}

use super::*;
use crate::constants::NOT_DRAWABLE;
use crate::records::{
    MAX_MORPH_WORDS, Rest, RestId, predicted_entry, prediction_time, prediction_write, rest_writes,
    sample_write, sampled_entry, skinned_entry, static_entry, tag,
};
use shadecast_protocol::limits::{MAX_SAMPLE_RING, MIN_SAMPLE_RING};
use shadecast_protocol::time::{GridIndex, WorldTime};

const STEP_S: f64 = 1.0 / 30.0;
const RING: u32 = 32;

fn push(grid: i32, fraction: f32, cubic: bool) -> InterpolatePush {
    InterpolatePush {
        vertex_count: 1,
        vertex_slots: 1,
        sample_ring: RING,
        tag: tag(GridIndex(grid)),
        fraction,
        tag_before: tag(GridIndex(grid)),
        fraction_before: fraction,
        blend_step: 0.0,
        cubic: u32::from(cubic),
        now: 0,
    }
}

/// What an update of this time says of slot 0: it moves by 1 m in 10 ms, and is at 0 m at `start_ms`.
fn predictions(update_ms: i64, start_ms: i64) -> Vec<VertexWriteGpu> {
    let write = |number: u32| {
        let ms = update_ms + 30 * (i64::from(number) + 1);
        prediction_write(0, number, WorldTime(ms * 1_000_000), [(ms - start_ms) as f32 * 0.1, 0.0, 0.0])
    };
    (0..PREDICTIONS).map(write).collect()
}

fn at_ms(memory: &mut VertexMemory, ms: i64) -> [f32; 4] {
    let now = prediction_time(WorldTime(ms * 1_000_000));
    memory.interpolate(&InterpolatePush { now, ..push(0, 0.0, true) });
    memory.positions[0]
}

#[test]
fn a_predicted_vertex_is_linear_and_stays_at_the_ends() {
    // The second time: tags begin anew between the first and the last. Every ring has room for predictions.
    let all = [1000, (1 << 26) / 20 - 45]
        .map(|update_ms| [MIN_SAMPLE_RING, MAX_SAMPLE_RING].map(|ring| (update_ms, ring)));
    for (update_ms, ring) in all.into_iter().flatten() {
        let mut memory = VertexMemory::new(1, ring);
        memory.scatter(&[predicted_entry(0)]);
        assert_eq!(at_ms(&mut memory, update_ms)[3], NOT_DRAWABLE, "nothing was said of it");
        memory.scatter(&predictions(update_ms, update_ms));
        let mut off = |ms: i64| {
            let [x, _, _, state] = at_ms(&mut memory, update_ms + ms);
            (x * 10.0, state)
        };
        for (ms, expected, expected_state) in [
            (-400, 30.0, ON_CURVE),
            (30, 30.0, ON_CURVE),
            (40, 40.0, ON_CURVE),
            (60, 60.0, ON_CURVE),
            (81, 81.0, ON_CURVE),
            (90, 90.0, ON_CURVE),
            (91, 90.0, PAST_THE_END),
            (5000, 90.0, PAST_THE_END),
        ] {
            let (found, state) = off(ms);
            assert!((found - expected).abs() < 1e-3 && state == expected_state, "{ms}: {found}, {state}");
        }
    }
}

#[test]
fn the_newest_update_alone_says_where_a_predicted_vertex_is() {
    let mut memory = VertexMemory::new(1, RING);
    memory.scatter(&[predicted_entry(0)]);
    memory.scatter(&predictions(1000, 0));
    assert_eq!(at_ms(&mut memory, 1090), [109.0, 0.0, 0.0, ON_CURVE]);
    memory.scatter(&predictions(1070, 0));
    assert_eq!(at_ms(&mut memory, 1090), [110.0, 0.0, 0.0, ON_CURVE], "its first, held");
    memory.scatter(&[sampled_entry(0)]);
    assert_eq!(at_ms(&mut memory, 1090)[3], NOT_DRAWABLE);
}

fn with_samples(grids: std::ops::RangeInclusive<i32>, at: impl Fn(i32) -> f32) -> VertexMemory {
    let mut memory = VertexMemory::new(1, RING);
    memory.scatter(&[sampled_entry(0)]);
    let writes: Vec<_> = grids.map(|g| sample_write(0, GridIndex(g), [at(g), 0.0, 0.0])).collect();
    memory.scatter(&writes);
    memory
}

/// The largest error for a sine of 1 Hz, as a share of its range.
fn sine_error(cubic: bool) -> f64 {
    let sine = |g: f64| (g * STEP_S * std::f64::consts::TAU).sin();
    let mut worst = 0f64;
    for grid in 0..30 {
        let mut memory = with_samples(grid - 2..=grid + 3, |g| sine(f64::from(g)) as f32);
        for step in 0..64 {
            let fraction = step as f32 / 64.0;
            memory.interpolate(&push(grid, fraction, cubic));
            let error = f64::from(memory.positions[0][0]) - sine(f64::from(grid) + f64::from(fraction));
            worst = worst.max(error.abs() / 2.0);
        }
    }
    worst
}

#[test]
fn cubic_follows_a_1_hz_sine_within_1e_4() {
    let error = sine_error(true);
    assert!(error < 1e-4, "{error}");
}

#[test]
fn after_a_gap_a_vertex_follows_its_new_samples() {
    let at = |g: i32| 0.1 * g as f32;
    let mut memory = with_samples(25..=30, at);
    memory.interpolate(&push(31, 0.0, true));
    assert_eq!(memory.positions[0][3], PAST_THE_END);
    // A ring of samples later the last of these takes the place of 29.
    let later = RING as i32;
    let steps = 22 + later..=29 + later;
    let writes: Vec<_> = steps.map(|g| sample_write(0, GridIndex(g), [at(g), 0.0, 0.0])).collect();
    memory.scatter(&writes);
    memory.interpolate(&InterpolatePush {
        tag_before: tag(GridIndex(31)),
        fraction_before: 0.0,
        ..push(23 + later, 0.0, true)
    });
    assert!((memory.positions[0][0] - at(23 + later)).abs() < 1e-5, "{:?}", memory.positions[0]);
}

#[test]
fn linear_misses_a_sine_of_one_hertz_by_a_quarter_of_a_percent() {
    let error = sine_error(false);
    assert!((0.0025..0.0029).contains(&error), "{error}");
}

#[test]
fn without_an_outer_sample_it_is_linear() {
    let mut memory = with_samples(5..=7, |g| (g * g) as f32);
    memory.interpolate(&push(5, 0.5, true));
    assert_eq!(memory.positions[0], [30.5, 0.0, 0.0, ON_CURVE]);
}

#[test]
fn past_the_last_sample_a_vertex_extrapolates_one_step() {
    let mut memory = with_samples(0..=7, |g| (2 * g) as f32);
    for (grid, fraction, expected) in [(7, 0.5, 15.0), (7, 1.0, 16.0), (8, 0.25, 16.0), (5000, 0.5, 16.0)] {
        memory.interpolate(&push(grid, fraction, true));
        assert_eq!(memory.positions[0], [expected, 0.0, 0.0, PAST_THE_END], "{grid} + {fraction}");
    }
}

#[test]
fn before_its_first_sample_it_is_not_drawable() {
    let mut memory = with_samples(4..=7, |g| g as f32);
    memory.interpolate(&push(3, 0.9, true));
    assert_eq!(memory.positions[0][3], NOT_DRAWABLE);
    memory.interpolate(&push(4, 0.0, true));
    assert_eq!(memory.positions[0], [4.0, 0.0, 0.0, ON_CURVE]);
}

#[test]
fn a_vertex_never_uses_its_slots_earlier_samples() {
    let mut memory = with_samples(0..=9, |_| 100.0);
    memory.scatter(&[sampled_entry(0)]);
    memory.scatter(&[5, 6].map(|g| sample_write(0, GridIndex(g), [g as f32, 0.0, 0.0])));
    memory.interpolate(&push(5, 0.5, true));
    assert_eq!(memory.positions[0], [5.5, 0.0, 0.0, ON_CURVE]);
    memory.interpolate(&push(4, 0.5, true));
    assert_eq!(memory.positions[0][3], NOT_DRAWABLE);
}

#[test]
fn a_static_vertex_stays_where_it_is() {
    let mut memory = with_samples(0..=9, |_| 100.0);
    memory.scatter(&[static_entry(0, [1.0, 2.0, 3.0])]);
    memory.interpolate(&push(5, 0.5, true));
    assert_eq!(memory.positions[0], [1.0, 2.0, 3.0, ON_CURVE]);
}

#[test]
fn only_skinning_moves_a_skinned_vertex() {
    let mut memory = with_samples(0..=9, |_| 100.0);
    memory.scatter(&[skinned_entry(0, RestId(4), 17)]);
    memory.interpolate(&push(5, 0.5, true));
    assert_eq!((memory.positions[0], memory.skins[0]), ([0.0; 4], [5, 17]));
    for entry in [static_entry(0, [1.0, 2.0, 3.0]), sampled_entry(0)] {
        memory.scatter(&[skinned_entry(0, RestId(4), 17), entry]);
        assert_eq!(memory.skins[0][0], NO_REST);
    }
}

#[test]
fn a_rest_is_written_in_halves_and_disturbs_no_vertex() {
    let rest = Rest {
        position_m: [1.0, -2.0, 0.5],
        joints: [1, 2, 3, 0xffff],
        weights: [4, 5, 6, 7],
        first_delta: MAX_MORPH_WORDS - 1,
        delta_count: 255,
    };
    let mut memory = with_samples(0..=9, |_| 100.0);
    let before = memory.clone();
    memory.scatter(&rest_writes(RestId(0), &rest));
    assert_eq!(memory.rests[0], rest.gpu());
    assert_eq!(VertexMemory { rests: before.rests.clone(), ..memory.clone() }, before);
    memory.scatter(&rest_writes(RestId(1), &rest));
    assert_eq!(memory.rests, [rest.gpu()], "a number that there is no place for");
    let RestGpu { position_joints, influences } = rest.gpu();
    assert_eq!(position_joints, [1f32.to_bits(), (-2f32).to_bits(), 0.5f32.to_bits(), 0x0002_0001]);
    assert_eq!(influences, [0xffff_0003, 0x0005_0004, 0x0007_0006, u32::MAX]);
}

#[test]
fn grid_steps_before_zero_and_across_it_are_in_order() {
    let mut memory = with_samples(-3..=3, |g| g as f32);
    for (grid, fraction) in [(-2, 0.5), (-1, 0.5), (0, 0.5)] {
        memory.interpolate(&push(grid, fraction, true));
        assert!(
            (memory.positions[0][0] - (grid as f32 + fraction)).abs() < 1e-6,
            "{:?}",
            memory.positions[0]
        );
    }
}

/// Runs display frames of a tenth of a step, with late samples, and gives the largest movement between two.
#[test]
fn after_a_freeze_a_vertex_blends_back_without_a_jump() {
    let mut memory = with_samples(0..=4, |g| g as f32);
    let (mut worst, mut last) = (0f32, None);
    for frame in 40..200 {
        let fraction = |frame: i32| (frame % 10) as f32 / 10.0;
        let late = if frame == 80 { 5..=20 } else { 21..=22 };
        if frame == 80 || frame == 150 {
            let writes: Vec<_> = late.map(|g| sample_write(0, GridIndex(g), [g as f32, 0.0, 0.0])).collect();
            memory.scatter(&writes);
        }
        let before = frame - 1;
        memory.interpolate(&InterpolatePush {
            tag_before: tag(GridIndex(before / 10)),
            fraction_before: fraction(before),
            blend_step: 1.0 / 60.0,
            ..push(frame / 10, fraction(frame), true)
        });
        let [x, _, _, _] = memory.positions[0];
        if let Some(last) = last.replace(x) {
            worst = worst.max((x - last).abs());
        }
    }
    assert!(worst < 0.2, "moved by {worst} in one frame, where the curve moves by 0.1");
    assert!((last.unwrap() - 19.9).abs() < 1e-4, "back on the curve: {last:?}");
}

#[test]
fn a_changed_future_is_blended_to() {
    let mut memory = with_samples(0..=9, |_| 0.0);
    memory.interpolate(&push(4, 0.0, true));
    memory.scatter(&(3..=9).map(|g| sample_write(0, GridIndex(g), [1.0, 0.0, 0.0])).collect::<Vec<_>>());
    let mut positions = Vec::new();
    for _ in 0..5 {
        memory.interpolate(&InterpolatePush { blend_step: 0.25, ..push(4, 0.0, true) });
        positions.push(memory.positions[0][0]);
    }
    assert_eq!(positions, [0.25, 0.5, 0.75, 1.0, 1.0]);
}

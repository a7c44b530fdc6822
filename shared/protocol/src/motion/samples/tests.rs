use super::*;
use crate::testing::{Dice, damaged};

const STEP_M: f32 = 0.0005;

fn batch(grid: i32, slots: &[VertexSlot], values: &[[i32; 3]]) -> SampleBatch {
    SampleBatch { grid: GridIndex(grid), values: slots.iter().copied().zip(values.iter().copied()).collect() }
}

/// Rest positions in metres of a rough wing of 1 m by 0.5 m: vertices in rows of 100 along the chord, each up to
/// 5 mm off the smooth surface.
fn wing(vertices: usize) -> Vec<[f64; 3]> {
    let mut dice = Dice::new(1);
    let mut rough = |metres: f64| metres + 0.005 * dice.signed_unit();
    (0..vertices)
        .map(|i| {
            let span = (i / 100 * 100) as f64 / vertices as f64;
            let chord = (i % 100) as f64 * 0.005;
            [rough(span), rough(0.02 * (chord * 12.0).sin()), rough(chord)]
        })
        .collect()
}

/// The wing when it beats at 1 Hz by +-40 degrees about the z axis while its owner walks.
fn beat(wing: &[[f64; 3]], time_s: f64) -> Vec<[i32; 3]> {
    let angle = 40f64.to_radians() * (std::f64::consts::TAU * time_s).sin();
    let (sin, cos) = angle.sin_cos();
    wing.iter()
        .map(|[x, y, z]| {
            let world = [1.3 + x * cos - y * sin, 1.5 + x * sin + y * cos, z - 2.0 + 0.8 * time_s];
            world.map(|metres| (metres / f64::from(STEP_M)).round() as i32)
        })
        .collect()
}

#[derive(Default)]
struct Cost {
    first_bytes: usize,
    later_bytes: usize,
    encode: std::time::Duration,
    decode: std::time::Duration,
}

/// Codes two seconds of the motion and checks that it comes back.
fn cost_of_two_seconds(wing: &[[f64; 3]]) -> Cost {
    let slots: Vec<_> = (0..wing.len() as u32).map(VertexSlot).collect();
    let (mut ours, mut theirs) =
        (SampleHistory::new(slots.len() as u32), SampleHistory::new(slots.len() as u32));
    let mut encoder = SampleEncoder::new();
    let mut cost = Cost::default();
    for step in 0..60 {
        let (grid, values) = (GridIndex(step), beat(wing, f64::from(step) / 30.0));
        let (batch, mut bytes) = (batch(step, &slots, &values), Vec::new());
        let start = std::time::Instant::now();
        encoder.encode_batch(&batch, &mut ours, &mut bytes);
        cost.encode += start.elapsed();
        let start = std::time::Instant::now();
        let (decoded, used) = decode_batch(grid, &mut theirs, &slots, &bytes).unwrap();
        cost.decode += start.elapsed();
        assert_eq!(used, bytes.len());
        assert!(decoded.iter().zip(&values).all(|(got, sent)| got.1 == *sent), "grid step {step}");
        *(if step == 0 { &mut cost.first_bytes } else { &mut cost.later_bytes }) += bytes.len();
    }
    cost
}

#[track_caller]
fn assert_cost(name: &str, wing: &[[f64; 3]], limit: f64) {
    let cost = cost_of_two_seconds(wing);
    let samples = (wing.len() * 60) as f64;
    let per_sample = (cost.first_bytes + cost.later_bytes) as f64 / samples;
    let first = cost.first_bytes as f64 / wing.len() as f64;
    let ns = [cost.encode, cost.decode].map(|time| time.as_nanos() as f64 / samples);
    println!(
        "{name}: {per_sample:.2} bytes per vertex and sample (the first {first:.2}), {:.0} ns to encode, {:.0} to decode",
        ns[0], ns[1]
    );
    assert!(per_sample <= limit, "{per_sample} bytes");
}

#[test]
fn a_beating_wing_costs_under_2_5_bytes_a_sample() {
    assert_cost("rough wing, neighbours in order", &wing(20_000), 2.5);
}

#[test]
fn a_wing_in_scattered_slots_costs_under_2_5_bytes() {
    let (mut wing, mut dice) = (wing(20_000), Dice::new(2));
    (1..wing.len()).rev().for_each(|i| wing.swap(i, dice.below(i as u64 + 1) as usize));
    assert_cost("rough wing, slots at random", &wing, 2.5);
}

#[test]
fn extreme_values_come_back_whatever_the_past() {
    let slots: Vec<_> = (0..100).map(VertexSlot).collect();
    let (mut ours, mut theirs) = (SampleHistory::new(100), SampleHistory::new(100));
    let (mut encoder, mut dice) = (SampleEncoder::new(), Dice::new(3));
    for step in 0..200 {
        let extremes = [i32::MIN, i32::MIN + 1, -(1 << 30), -1, 0, 1, 1 << 30, i32::MAX];
        let mut value = || match dice.below(3) {
            0 => dice.next() as i32,
            _ => extremes[dice.below(8) as usize],
        };
        let values: Vec<[i32; 3]> = slots.iter().map(|_| [value(), value(), value()]).collect();
        let mut bytes = Vec::new();
        encoder.encode_batch(&batch(step, &slots, &values), &mut ours, &mut bytes);
        assert!(bytes.len() <= 13 * slots.len(), "limits.rs counts on at most 13 bytes a sample");
        let (decoded, _) = decode_batch(GridIndex(step), &mut theirs, &slots, &bytes).unwrap();
        assert!(decoded.iter().zip(&values).all(|(got, sent)| got.1 == *sent), "step {step}");
    }
}

#[test]
fn uniform_motion_costs_only_the_headers_of_groups() {
    let slots: Vec<_> = (0..3200).map(VertexSlot).collect();
    let (mut history, mut encoder) = (SampleHistory::new(3200), SampleEncoder::new());
    for step in 0..4 {
        let values: Vec<_> = (0..3200).map(|i| [i * 7 % 113 + step * 9, i % 31 - step * 5, i % 17]).collect();
        let mut bytes = Vec::new();
        encoder.encode_batch(&batch(step, &slots, &values), &mut history, &mut bytes);
        if step >= 2 {
            assert_eq!(bytes.len(), 100 * (2 + 3 * 10) / 8, "step {step}");
        }
    }
}

#[test]
fn a_missing_grid_step_lowers_the_order() {
    let mut past = Past::default();
    [(0, 10), (1, 20), (2, 30)].into_iter().for_each(|(grid, x)| past.push(GridIndex(grid), [x; 3]));
    assert_eq!(past.order(GridIndex(3)), 3);
    assert_eq!(past.order(GridIndex(4)), 1, "a gap before the new one");
    past.push(GridIndex(4), [50; 3]);
    assert_eq!(past.order(GridIndex(6)), 2, "equal gaps, then a smaller one");
    assert_eq!(past.expect(GridIndex(6), 3, [0; 3]), [70; 3]);
}

#[test]
fn a_sample_sent_again_replaces_what_came_after_it() {
    let mut past = Past::default();
    [(0, 10), (1, 20), (2, 30)].into_iter().for_each(|(grid, x)| past.push(GridIndex(grid), [x; 3]));
    past.rewind(GridIndex(1));
    assert_eq!((past.count, past.grids[0], past.values[0]), (1, 0, [10; 3]));
}

#[test]
fn damaged_batches_give_values_or_errors() {
    let slots: Vec<_> = (0..300).map(VertexSlot).collect();
    let (mut history, mut encoder) = (SampleHistory::new(300), SampleEncoder::new());
    let wing = wing(300);
    for step in 0..4 {
        let before = history.clone();
        let mut bytes = Vec::new();
        let values = beat(&wing, f64::from(step) / 30.0);
        encoder.encode_batch(&batch(step, &slots, &values), &mut history, &mut bytes);
        damaged(&bytes, step as u64, 1000, |bytes| {
            let result = decode_batch(GridIndex(step), &mut before.clone(), &slots, bytes);
            assert!(result.is_err() || result.is_ok_and(|(values, _)| values.len() == slots.len()));
        });
        for length in 0..bytes.len() {
            let cut = decode_batch(GridIndex(step), &mut before.clone(), &slots, &bytes[..length]);
            assert!(matches!(cut, Err(WireError::Truncated { .. })), "{length} of {}", bytes.len());
        }
    }
}

#[test]
fn a_new_step_rescales_the_history() {
    let mut history = SampleHistory::new(2);
    (0..2).for_each(|slot| history.past[slot].push(GridIndex(0), [1000, -1001, i32::MAX]));
    let entered =
        Entered { sampled: vec![VertexSlot(0)], rescaled: vec![(VertexSlot(0), 2.0), (VertexSlot(1), 2.0)] };
    history.follow(&entered);
    assert_eq!(history.past[1].values[0], [2000, -2002, i32::MAX]);
    assert_eq!(history.past[0].count, 0);
}

//! Predicted positions, as the paper sends them: every update carries, for each visible animated vertex, its positions at
//! [`PREDICTIONS`] times ("For our test, we compute three view predictions that are 33 ms in the future, generating 100 ms time
//! frame", section 4). Nothing is packed and nothing is kept between updates: this is the baseline for the other kinds.

use crate::ids::VertexSlot;
use crate::limits::{MAX_COORDINATE_M, PREDICTIONS};
use crate::time::WorldTime;
use crate::wire::{Reader, WireError, check_count, invalid, put_varint};
use glam::Vec3;

/// From one prediction to the next, and from the update to the first, seconds: the three reach 100 ms ahead.
pub const PREDICTION_SPACING_S: f32 = 0.1 / PREDICTIONS as f32;
/// Predictions are for at most so long after their update, seconds.
pub const MAX_PREDICTION_S: f32 = 1.0;
/// Bytes of a vertex: for each prediction three coordinates and a time, which makes 48.
pub const PREDICTED_BYTES: usize = PREDICTIONS as usize * 16;

/// Where a vertex will be, as an update says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PredictedVertex {
    /// The vertex.
    pub slot: VertexSlot,
    /// In the order of their times.
    pub predictions: [Prediction; PREDICTIONS as usize],
}

/// Where a vertex will be at one time.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Prediction {
    /// In the world, metres.
    pub position_m: Vec3,
    /// Since the update's own time, seconds, 0 to [`MAX_PREDICTION_S`].
    pub since_update_s: f32,
}

impl Prediction {
    /// When that is, for an update of this time.
    pub fn time(&self, update: WorldTime) -> WorldTime {
        update.plus_ns((f64::from(self.since_update_s) * 1e9).round() as i64)
    }

    fn take(reader: &mut Reader<'_>) -> Result<Self, WireError> {
        let position_m = Vec3::new(reader.f32()?, reader.f32()?, reader.f32()?);
        let since_update_s = reader.f32()?;
        // Written so that a NaN fails too.
        let is_near = position_m.to_array().iter().all(|c| c.abs() <= MAX_COORDINATE_M);
        if is_near && (0.0..=MAX_PREDICTION_S).contains(&since_update_s) {
            return Ok(Self { position_m, since_update_s });
        }
        let reason = format!("{position_m} after {since_update_s} s is out of range");
        Err(invalid("a prediction", reason))
    }
}

/// True where `next` can join the run that ends with `last`.
fn continues(last: &PredictedVertex, next: &PredictedVertex) -> bool {
    next.slot.0 == last.slot.0.wrapping_add(1)
}

/// Appends them: runs of slots as the slots left out before them and a length, then positions and times. In ascending order of
/// slots.
pub(crate) fn put_predictions(out: &mut Vec<u8>, vertices: &[PredictedVertex]) {
    put_varint(out, vertices.len() as u32);
    let mut next_slot = 0;
    for run in vertices.chunk_by(continues) {
        assert!(run[0].slot.0 >= next_slot, "predictions are not in the order of slots");
        put_varint(out, run[0].slot.0 - next_slot);
        put_varint(out, run.len() as u32 - 1);
        next_slot = run[run.len() - 1].slot.0 + 1;
        for prediction in run.iter().flat_map(|vertex| vertex.predictions) {
            let numbers = prediction.position_m.extend(prediction.since_update_s).to_array();
            numbers.iter().for_each(|number| out.extend_from_slice(&number.to_le_bytes()));
        }
    }
}

/// The vertices of these bytes, ascending by slots.
pub(crate) fn take_predictions(
    section: &[u8],
    vertex_slots: usize,
) -> Result<Vec<PredictedVertex>, WireError> {
    let mut reader = Reader::new("predictions", section);
    let count = reader.count(vertex_slots, PREDICTED_BYTES)?;
    let mut vertices: Vec<PredictedVertex> = Vec::with_capacity(count);
    let mut next_slot = 0;
    while vertices.len() < count {
        let first = next_slot + reader.varint()? as usize;
        let length = reader.varint()? as usize + 1;
        check_count("a run of predictions", length, count - vertices.len())?;
        next_slot = check_count("the end of a run of predictions", first + length, vertex_slots)?;
        for slot in first..next_slot {
            let mut predictions = [Prediction::default(); PREDICTIONS as usize];
            for prediction in &mut predictions {
                *prediction = Prediction::take(&mut reader)?;
            }
            vertices.push(PredictedVertex { slot: VertexSlot(slot as u32), predictions });
        }
    }
    reader.finish()?;
    Ok(vertices)
}

/// That these are of vertices which are told so, each with times that rise.
///
/// # Errors
/// One is not.
pub(crate) fn check_predictions(
    vertices: &[PredictedVertex],
    is_predicted: impl Fn(VertexSlot) -> bool,
) -> Result<(), WireError> {
    for PredictedVertex { slot, predictions } in vertices {
        if !is_predicted(*slot) {
            return Err(invalid("predictions", format!("no vertex of slot {} is predicted", slot.0)));
        }
        if !predictions.is_sorted_by(|a, b| a.since_update_s < b.since_update_s) {
            return Err(invalid("predictions", format!("the times of slot {} do not rise", slot.0)));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::damaged;

    const SLOTS: usize = 100;

    fn vertex(slot: u32) -> PredictedVertex {
        let prediction = |number: usize| Prediction {
            position_m: Vec3::new(slot as f32, -1.5, 0.25 * number as f32),
            since_update_s: PREDICTION_SPACING_S * (number + 1) as f32,
        };
        PredictedVertex { slot: VertexSlot(slot), predictions: std::array::from_fn(prediction) }
    }

    fn coded(vertices: &[PredictedVertex]) -> Vec<u8> {
        let mut out = Vec::new();
        put_predictions(&mut out, vertices);
        out
    }

    #[test]
    fn predictions_round_trip_at_48_bytes_a_vertex() {
        let vertices: Vec<_> = [0, 1, 2, 40, 41, 99].map(vertex).to_vec();
        assert_eq!(take_predictions(&coded(&vertices), SLOTS), Ok(vertices.clone()));
        let run: Vec<_> = (10..90).map(vertex).collect();
        assert_eq!(coded(&run).len(), 3 + 80 * 48);
        assert_eq!(take_predictions(&coded(&[]), SLOTS), Ok(Vec::new()));
    }

    #[test]
    fn the_last_prediction_is_100_ms_after_its_update() {
        let times = vertex(0).predictions.map(|prediction| prediction.time(WorldTime(5_000_000_000)).0);
        let off_ns = times.map(|time| time - 5_000_000_000);
        for (off_ns, expected_ns) in off_ns.into_iter().zip([33_333_333, 66_666_667, 100_000_000]) {
            assert!((off_ns - expected_ns).abs() < 100, "{off_ns}");
        }
    }

    #[test]
    fn damaged_predictions_give_values_or_errors() {
        let bytes = coded(&[3, 4, 70].map(vertex));
        damaged(&bytes, 5, 5000, |bytes| drop(take_predictions(bytes, SLOTS)));
        (0..bytes.len()).for_each(|length| assert!(take_predictions(&bytes[..length], SLOTS).is_err()));
    }

    #[test]
    fn slots_and_numbers_that_make_no_sense_are_refused() {
        assert!(take_predictions(&coded(&[vertex(99)]), 99).is_err(), "no such slot");
        assert!(take_predictions(&[1, 0xff, 0xff, 0xff, 0xff, 0x0f, 0], SLOTS).is_err(), "far beyond");
        let spoiled = |spoil: fn(&mut Prediction)| {
            let mut spoiled = vertex(3);
            spoil(&mut spoiled.predictions[1]);
            take_predictions(&coded(&[spoiled]), SLOTS)
        };
        assert!(spoiled(|_| {}).is_ok());
        assert!(spoiled(|prediction| prediction.position_m.y = f32::NAN).is_err());
        assert!(spoiled(|prediction| prediction.position_m.x = -2e6).is_err());
        assert!(spoiled(|prediction| prediction.since_update_s = f32::INFINITY).is_err());
        assert!(spoiled(|prediction| prediction.since_update_s = -0.1).is_err());
    }
}

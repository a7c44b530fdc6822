//! How long a client rests after a frame on a device without a GPU: a server may need the same cores. Pure.

/// A frame that took longer says nothing about the next one.
pub(crate) const MAX_FRAME_NS: i64 = 250_000_000;
/// The part of a frame's time that is left to others after it, and what lies between frames where these are enough.
const LEAST_PART: f64 = 0.3;
const ENOUGH_PERIOD_NS: i64 = 1_000_000_000 / 14;

/// How long nothing is drawn after a frame that took so long: as long again, or until enough frames are drawn; for a part of it at least.
pub(crate) fn rest_ns(took_ns: i64) -> i64 {
    let took_ns = took_ns.min(MAX_FRAME_NS);
    let least_ns = (took_ns as f64 * LEAST_PART) as i64;
    least_ns.max(took_ns.min(ENOUGH_PERIOD_NS - took_ns))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cores_are_left_to_others_for_a_part_of_the_time() {
        const MS: i64 = 1_000_000;
        assert_eq!(rest_ns(80 * MS), 24 * MS, "a part at least");
        assert_eq!(rest_ns(50 * MS), ENOUGH_PERIOD_NS - 50 * MS, "then fourteen frames a second");
        assert_eq!(rest_ns(30 * MS), 30 * MS, "half of the time at most");
        assert_eq!(rest_ns(3_600_000 * MS), 75 * MS, "of a program that was asleep");
    }
}

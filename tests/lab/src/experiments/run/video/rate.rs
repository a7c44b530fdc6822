//! Keeps a video at a bit rate by its quantiser, as finely as the rate allows. Pure.

/// Quantisers that a picture may have.
const FINEST_QP: f64 = 8.0;
const COARSEST_QP: f64 = 51.0;
/// Steps of the quantiser that halve the bits of a picture.
const STEPS_OF_HALF: f64 = 6.0;
/// Steps finer or coarser from one picture to the next at most.
const MOST_FINER: f64 = 1.0;
const MOST_COARSER: f64 = 4.0;
/// What was not taken, or taken too much, counts so many pictures long.
const BALANCE_PICTURES: f64 = 8.0;

/// The state of the control.
#[derive(Clone, Debug)]
pub(super) struct Rate {
    picture_bytes: f64,
    balance_bytes: f64,
    qp: f64,
}

impl Rate {
    /// For so many megabits and pictures a second.
    pub(super) fn new(mbit_per_s: f64, rate_hz: f64, first_qp: u8) -> Self {
        Self { picture_bytes: mbit_per_s * 1e6 / 8.0 / rate_hz, balance_bytes: 0.0, qp: f64::from(first_qp) }
    }

    /// Of the next picture.
    pub(super) fn qp(&self) -> u8 {
        self.qp.round() as u8
    }

    /// A picture took so many bytes. A first one, which follows no other, says nothing of those after it.
    pub(super) fn note(&mut self, bytes: usize, is_refresh: bool) {
        if is_refresh {
            return;
        }
        let most = BALANCE_PICTURES * self.picture_bytes;
        self.balance_bytes = (self.balance_bytes + self.picture_bytes - bytes as f64).clamp(-most, most);
        let wanted =
            (self.picture_bytes + self.balance_bytes / BALANCE_PICTURES).max(0.1 * self.picture_bytes);
        let steps = STEPS_OF_HALF * (bytes.max(1) as f64 / wanted).log2();
        self.qp = (self.qp + steps.clamp(-MOST_FINER, MOST_COARSER)).clamp(FINEST_QP, COARSEST_QP);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_of_any_detail_come_to_the_rate() {
        for (detail, mbit_per_s) in [(1e5, 20.0), (1e6, 20.0), (4e5, 5.0)] {
            let mut rate = Rate::new(mbit_per_s, 30.0, 26);
            let mut bytes = 0.0;
            for picture in 0..150 {
                // What moves changes from picture to picture.
                let now =
                    detail * (1.0 + 0.3 * f64::from(picture % 7)) * 2f64.powf(-f64::from(rate.qp()) / 6.0);
                rate.note(now as usize, false);
                bytes += if picture >= 30 { now } else { 0.0 };
            }
            let found = bytes * 8e-6 * 30.0 / 120.0;
            assert!((found / mbit_per_s - 1.0).abs() < 0.1, "{found} for {mbit_per_s} Mbit/s");
        }
    }

    #[test]
    fn a_first_picture_changes_nothing() {
        let mut rate = Rate::new(20.0, 30.0, 26);
        rate.note(1_000_000, true);
        assert_eq!(rate.qp(), 26);
    }
}

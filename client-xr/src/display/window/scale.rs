//! The scale at which a window's pictures are drawn: smaller where drawing takes too long, and drawing less helps. Pure.

/// Sides as parts of the whole, about half the pixels for every two steps.
const SCALES: [f32; 8] = [1.0, 0.84, 0.71, 0.59, 0.5, 0.42, 0.35, 0.3];
/// Without a GPU drawing begins with so many pixels at most.
const FIRST_PIXELS: f32 = 300e3;
/// Frames that take longer are too slow, nanoseconds.
const SLOW_NS: f64 = 64e6;
/// Frames at the next larger scale should take no longer than this, nanoseconds.
const ROOMY_NS: f64 = 45e6;
/// Frames whose time counts together, and frames before them, after a change.
const COUNTED_FRAMES: u32 = 8;
const SETTLE_FRAMES: u32 = 2;
/// A smaller scale must save this part of a frame's time.
const LEAST_WORTH: f64 = 0.05;
/// Rounds of counted frames after which what did not help is tried again, and those with room before the scale grows, at first and at
/// most.
const FORGET_ROUNDS: u32 = 15;
const FIRST_WAIT_ROUNDS: u32 = 3;
const LONGEST_WAIT_ROUNDS: u32 = 100;

/// See the module.
#[derive(Clone, Debug)]
pub(super) struct Scale {
    step: usize,
    /// What frames took before the newest step, until it is known whether it helped.
    trial: Option<f64>,
    frames: u32,
    sum_ns: f64,
    /// Rounds until smaller scales are tried again.
    useless_rounds: u32,
    roomy_rounds: u32,
    wait_rounds: u32,
}

impl Default for Scale {
    fn default() -> Self {
        Self {
            step: 0,
            trial: None,
            frames: 0,
            sum_ns: 0.0,
            useless_rounds: 0,
            roomy_rounds: 0,
            wait_rounds: FIRST_WAIT_ROUNDS,
        }
    }
}

impl Scale {
    /// Of a device without a GPU, for an image of `extent`: it begins with no more pixels than such devices draw in time.
    pub(super) fn without_gpu([width, height]: [u32; 2]) -> Self {
        let pixels = width as f32 * height as f32;
        let fits = SCALES.iter().position(|side| pixels * side * side <= FIRST_PIXELS);
        Self { step: fits.unwrap_or(SCALES.len() - 1), ..Self::default() }
    }

    /// Width and height in pixels of what is drawn into an image of `extent`.
    pub(super) fn of(&self, extent: [u32; 2]) -> [u32; 2] {
        extent.map(|side| ((side as f32 * SCALES[self.step]).round() as u32).max(1))
    }

    /// A frame took so long, nanoseconds.
    pub(super) fn note(&mut self, frame_ns: i64) {
        self.frames += 1;
        if self.frames <= SETTLE_FRAMES {
            return;
        }
        self.sum_ns += frame_ns as f64;
        if self.frames < SETTLE_FRAMES + COUNTED_FRAMES {
            return;
        }
        let mean_ns = self.sum_ns / f64::from(COUNTED_FRAMES);
        (self.frames, self.sum_ns) = (SETTLE_FRAMES, 0.0);
        self.useless_rounds = self.useless_rounds.saturating_sub(1);
        if let Some(before_ns) = self.trial.take()
            && mean_ns > before_ns * (1.0 - LEAST_WORTH)
        {
            self.useless_rounds = FORGET_ROUNDS;
            return self.set(self.step - 1);
        }
        if mean_ns > SLOW_NS {
            self.shrink(mean_ns);
        } else {
            self.grow(mean_ns);
        }
    }

    fn shrink(&mut self, mean_ns: f64) {
        if self.step + 1 < SCALES.len() && self.useless_rounds == 0 {
            if self.roomy_rounds == u32::MAX {
                self.wait_rounds = (2 * self.wait_rounds).min(LONGEST_WAIT_ROUNDS);
            }
            self.trial = Some(mean_ns);
            self.set(self.step + 1);
        }
        self.roomy_rounds = 0;
    }

    fn grow(&mut self, mean_ns: f64) {
        let Some(larger) = self.step.checked_sub(1) else { return };
        let more = f64::from(SCALES[larger] / SCALES[self.step]).powi(2);
        if mean_ns * more > ROOMY_NS {
            self.roomy_rounds = 0;
            return;
        }
        self.roomy_rounds = self.roomy_rounds.saturating_add(1);
        if self.roomy_rounds >= self.wait_rounds {
            self.set(larger);
            // A scale that has to come back waits longer the next time.
            self.roomy_rounds = u32::MAX;
        }
    }

    fn set(&mut self, step: usize) {
        self.step = step;
        self.frames = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: f64 = 1e6;

    /// Frames that take a fixed time, and some for each pixel of the whole.
    fn after(scale: &mut Scale, frames: u32, fixed_ms: f64, pixels_ms: f64) -> [u32; 2] {
        for _ in 0..frames {
            let part = f64::from(SCALES[scale.step]).powi(2);
            scale.note(((fixed_ms + pixels_ms * part) * MS) as i64);
        }
        scale.of([1000, 500])
    }

    #[test]
    fn a_fast_device_draws_all_pixels() {
        assert_eq!(after(&mut Scale::default(), 1000, 5.0, 40.0), [1000, 500]);
    }

    #[test]
    fn a_slow_device_draws_as_many_as_it_can() {
        let [width, _] = after(&mut Scale::default(), 200, 20.0, 170.0);
        assert_eq!(width, 500, "20 ms and a quarter of 170 ms");
    }

    #[test]
    fn a_device_without_a_gpu_begins_small_and_grows_where_it_is_fast() {
        assert_eq!(Scale::without_gpu([1280, 800]).of([1280, 800]), [640, 400]);
        assert_eq!(Scale::without_gpu([192, 144]).of([192, 144]), [192, 144]);
        assert_eq!(after(&mut Scale::without_gpu([1280, 800]), 400, 5.0, 20.0), [1000, 500]);
    }

    #[test]
    fn where_pixels_cost_nothing_all_are_drawn() {
        let mut scale = Scale::default();
        after(&mut scale, 100, 300.0, 0.0);
        assert_eq!(scale.of([1000, 500]), [1000, 500]);
    }

    #[test]
    fn the_scale_grows_when_there_is_time_and_does_not_swing() {
        let mut scale = Scale::default();
        after(&mut scale, 200, 20.0, 200.0);
        assert_eq!(after(&mut scale, 400, 5.0, 20.0), [1000, 500]);
        let (mut scale, mut changes) = (Scale::default(), 0);
        for frame in 0..6000 {
            let before = scale.step;
            let pixels_ms = if frame / 100 % 2 == 0 { 60.0 } else { 90.0 };
            after(&mut scale, 1, 5.0, pixels_ms);
            changes += u32::from(scale.step != before);
        }
        assert!(changes < 30, "{changes} changes in 6000 frames");
    }
}

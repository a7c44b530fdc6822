//! How many texels blocks are asked to have for a pixel of the display. Pure.
//!
//! Sides are rounded up to powers of two, so that blocks have more than are asked for. More still make a finer picture, and cost time
//! of shading, room in the atlas and bits: they are asked for where all of these were to spare for a while, and no longer where one
//! is short. Every block that changes is coded anew, a few with each update ([`crate::sizing`]); what had to be taken back is tried
//! again later each time.

/// Texels along a pixel, from what is asked for at first to what is asked for where there is room: each step doubles those of an area.
const STEPS: [f32; 3] = [1.0, std::f32::consts::SQRT_2, 2.0];
/// Part of the atlas that blocks may have come to when texels grow.
const MOST_SHARE: f32 = 0.8;
/// So many updates in a row with room make texels grow, at first and at most.
const FIRST_WAIT_UPDATES: u32 = 15;
const LONGEST_WAIT_UPDATES: u32 = 1800;
/// So many in a row without end it.
const SHORT_UPDATES: u32 = 8;

/// How bits and time suffice for what is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Spare {
    /// There is room for more.
    Room,
    /// For this, and no more.
    Enough,
    /// Not for this.
    Short,
}

/// One viewer's.
#[derive(Clone, Debug)]
pub struct Density {
    step: usize,
    /// Updates in a row with room for the next step, and without it for this one.
    roomy_updates: u32,
    short_updates: u32,
    wait_updates: u32,
}

impl Default for Density {
    fn default() -> Self {
        Self { step: 0, roomy_updates: 0, short_updates: 0, wait_updates: FIRST_WAIT_UPDATES }
    }
}

impl Density {
    /// Texels for a pixel of the next update.
    pub fn texels_per_pixel(&self) -> f32 {
        STEPS[self.step]
    }

    /// An update was placed: blocks come to this part of the atlas, with fewer texels than were asked for if it is full.
    pub fn note(&mut self, spare: Spare, used_share: f32, is_full: bool) {
        let has_room = !is_full && spare == Spare::Room && 2.0 * used_share <= MOST_SHARE;
        let is_short = is_full || spare == Spare::Short;
        self.roomy_updates = if has_room { self.roomy_updates + 1 } else { 0 };
        self.short_updates = if is_short { self.short_updates + 1 } else { 0 };
        if self.step > 0 && self.short_updates >= SHORT_UPDATES {
            self.step -= 1;
            self.short_updates = 0;
            self.wait_updates = (self.wait_updates * 2).min(LONGEST_WAIT_UPDATES);
        }
        if self.step + 1 < STEPS.len() && self.roomy_updates >= self.wait_updates {
            self.step += 1;
            self.roomy_updates = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Texels a pixel after so many updates that are all the same.
    fn after(density: &mut Density, updates: u32, spare: Spare, used_share: f32, is_full: bool) -> f32 {
        (0..updates).for_each(|_| density.note(spare, used_share, is_full));
        density.texels_per_pixel()
    }

    #[test]
    fn texels_grow_where_bits_time_and_atlas_have_room_for_half_a_second() {
        for (spare, share, grows) in [
            (Spare::Room, 0.3, true),
            (Spare::Room, 0.45, false),
            (Spare::Enough, 0.1, false),
            (Spare::Short, 0.1, false),
        ] {
            let mut density = Density::default();
            assert_eq!(after(&mut density, 14, spare, share, false), STEPS[0]);
            assert_eq!(after(&mut density, 1, spare, share, false), STEPS[usize::from(grows)]);
            let found = after(&mut density, 200, spare, share, false);
            assert_eq!(found, if grows { STEPS[2] } else { STEPS[0] }, "{spare:?}, {share}");
        }
    }

    #[test]
    fn what_is_there_stays_while_it_will_do_and_goes_when_anything_is_short() {
        for (spare, is_full) in [(Spare::Short, false), (Spare::Room, true)] {
            let mut density = Density::default();
            after(&mut density, 30, Spare::Room, 0.3, false);
            assert_eq!(after(&mut density, 500, Spare::Enough, 0.95, false), STEPS[2]);
            assert_eq!(after(&mut density, 7, spare, 0.95, is_full), STEPS[2]);
            assert_eq!(after(&mut density, 1, Spare::Room, 0.95, false), STEPS[2], "a moment");
            assert_eq!(after(&mut density, 8, spare, 0.95, is_full), STEPS[1]);
            assert_eq!(after(&mut density, 8, spare, 0.95, is_full), STEPS[0]);
        }
    }

    #[test]
    fn what_had_to_be_taken_back_is_tried_ever_later() {
        let mut density = Density::default();
        let mut changes = 0;
        for _ in 0..30 * 600 {
            let before = density.texels_per_pixel();
            let spare = if before > 1.0 { Spare::Short } else { Spare::Room };
            density.note(spare, 0.1, false);
            changes += u32::from(density.texels_per_pixel() != before);
        }
        assert!((10..40).contains(&changes), "{changes} changes in ten minutes");
    }
}

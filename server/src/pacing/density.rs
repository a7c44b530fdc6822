//! How many texels blocks are asked to have for a pixel of the display, and how much levels of detail may err. Pure.
//!
//! Sides are rounded up to powers of two, so that blocks have more than are asked for. More still, and finer levels of detail, make a
//! better picture, and cost time, room in the atlas and bits: they are asked for where all of these were to spare for a while, and
//! no longer where one is short. Levels are coarser than asked for at first, and where bits or time are short. Every block that
//! changes is coded anew, a few with each update ([`crate::atlas::sizing`]); what had to be taken back is tried again later each time.

/// What is asked for.
struct Step {
    /// Texels along a pixel.
    texels_per_pixel: f32,
    /// Of the error that a level of detail may have, so many times as much.
    error: f32,
}

/// From what is asked for at first to what is asked for where there is room.
const STEPS: [Step; 4] = [
    Step { texels_per_pixel: 1.0, error: 2.0 },
    Step { texels_per_pixel: 1.0, error: 1.0 },
    Step { texels_per_pixel: std::f32::consts::SQRT_2, error: std::f32::consts::FRAC_1_SQRT_2 },
    Step { texels_per_pixel: 2.0, error: 0.5 },
];
/// Part of the atlas that blocks may have come to when texels grow.
const MOST_SHARE: f32 = 0.8;
/// So many updates in a row with room for the next step make it, at first and at most.
const FIRST_WAIT_UPDATES: u32 = 8;
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

/// How far blocks fill what they lie in.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Filled {
    /// Part of the atlas that blocks come to.
    pub share: f32,
    /// Blocks have fewer texels than were asked for.
    pub is_full: bool,
    /// For so many times the texels along a pixel the store has room.
    pub most_growth: f32,
}

/// One viewer's.
#[derive(Clone, Debug)]
pub(crate) struct Density {
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
    pub(crate) fn texels_per_pixel(&self) -> f32 {
        STEPS[self.step].texels_per_pixel
    }

    /// So many times as much as was asked for may its levels of detail err.
    pub(crate) fn error(&self) -> f32 {
        STEPS[self.step].error
    }

    /// An update was placed.
    pub(crate) fn note(&mut self, spare: Spare, Filled { share, is_full, most_growth }: Filled) {
        let now = &STEPS[self.step];
        let has_room = match STEPS.get(self.step + 1) {
            None => false,
            Some(next) if next.texels_per_pixel == now.texels_per_pixel => spare != Spare::Short,
            Some(next) => {
                let growth = next.texels_per_pixel / now.texels_per_pixel;
                let fits = growth.powi(2) * share <= MOST_SHARE && growth <= most_growth;
                spare == Spare::Room && !is_full && fits
            }
        };
        let is_short = spare == Spare::Short || is_full && now.texels_per_pixel > 1.0;
        self.roomy_updates = if has_room { self.roomy_updates + 1 } else { 0 };
        self.short_updates = if is_short { self.short_updates + 1 } else { 0 };
        if self.step > 0 && self.short_updates >= SHORT_UPDATES {
            self.step -= 1;
            self.short_updates = 0;
            self.wait_updates = (self.wait_updates * 2).min(LONGEST_WAIT_UPDATES);
        }
        if self.roomy_updates >= self.wait_updates {
            self.step += 1;
            self.roomy_updates = 0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The step after so many updates that are all the same.
    fn after(density: &mut Density, updates: u32, spare: Spare, share: f32, is_full: bool) -> usize {
        let filled = Filled { share, is_full, most_growth: 10.0 };
        (0..updates).for_each(|_| density.note(spare, filled));
        density.step
    }

    #[test]
    fn levels_get_finer_where_nothing_is_short_and_texels_grow_where_there_is_room_a_quarter_of_a_second_each()
     {
        for (spare, share, found) in
            [(Spare::Room, 0.3, 3), (Spare::Room, 0.45, 1), (Spare::Enough, 0.1, 1), (Spare::Short, 0.1, 0)]
        {
            let mut density = Density::default();
            let each: Vec<usize> = (0..5).map(|_| after(&mut density, 8, spare, share, false)).collect();
            assert_eq!(each, [1, 2, 3, 3, 3].map(|step| found.min(step)), "{spare:?}, {share}");
        }
        let mut density = Density::default();
        assert_eq!(
            after(&mut density, 100, Spare::Room, 0.95, true),
            1,
            "a full atlas is no reason for coarser levels"
        );
    }

    #[test]
    fn what_is_there_stays_while_it_will_do_and_goes_when_anything_is_short() {
        for (spare, is_full, last) in [(Spare::Short, false, 0), (Spare::Room, true, 1)] {
            let mut density = Density::default();
            after(&mut density, 30, Spare::Room, 0.3, false);
            assert_eq!(after(&mut density, 500, Spare::Enough, 0.95, false), 3);
            assert_eq!(after(&mut density, 7, spare, 0.95, is_full), 3);
            assert_eq!(after(&mut density, 1, Spare::Room, 0.95, false), 3, "a moment");
            assert_eq!(after(&mut density, 8, spare, 0.95, is_full), 2);
            assert_eq!(after(&mut density, 8, spare, 0.95, is_full), 1);
            assert_eq!(after(&mut density, 8, spare, 0.95, is_full), last);
        }
    }

    #[test]
    fn what_had_to_be_taken_back_is_tried_ever_later() {
        for most in [0, 1] {
            let (mut density, mut changes) = (Density::default(), 0);
            for _ in 0..30 * 600 {
                let before = density.step;
                let filled = Filled { share: 0.1, is_full: false, most_growth: 10.0 };
                density.note(if before > most { Spare::Short } else { Spare::Room }, filled);
                changes += u32::from(density.step != before);
            }
            assert!((10..40).contains(&changes), "{changes} changes in ten minutes");
        }
    }
}

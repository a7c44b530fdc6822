//! The paper's own numbers: its Table 1, plotted in its Figure 4. 1300x1300 pixels, 90 degrees, server and client on one
//! GeForce RTX 2080 Super.

use super::cell::Column;

/// Frames a second for a number of dragons: first without an animation system, then with one and nothing that moves, then with
/// all dragons in motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PaperRow {
    /// Dragons in view.
    pub dragons: u32,
    /// Updates a second.
    pub server_fps: [u32; 3],
    /// Display frames a second.
    pub client_fps: [u32; 3],
}

const fn row(dragons: u32, server_fps: [u32; 3], client_fps: [u32; 3]) -> PaperRow {
    PaperRow { dragons, server_fps, client_fps }
}

/// Its six scenes.
pub const PAPER: [PaperRow; 6] = [
    row(9, [138, 98, 38], [370, 355, 370]),
    row(25, [129, 73, 20], [322, 341, 330]),
    row(49, [108, 86, 11], [266, 302, 255]),
    row(81, [86, 70, 7], [239, 220, 230]),
    row(121, [69, 49, 5], [67, 60, 190]),
    row(169, [52, 49, 3], [47, 38, 150]),
];

impl PaperRow {
    /// Of server and client in a column.
    pub fn fps(&self, column: Column) -> [f64; 2] {
        let place = column as usize;
        [self.server_fps[place], self.client_fps[place]].map(f64::from)
    }
}

/// The paper's row for so many dragons, where it has one.
pub fn paper_row(dragons: u32) -> Option<PaperRow> {
    PAPER.into_iter().find(|row| row.dragons == dragons)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_animation_costs_three_quarters_of_its_rate() {
        let kept = PAPER.map(|row| row.fps(Column::Animated)[0] / row.fps(Column::Off)[0]);
        assert!((kept[0] - 0.28).abs() < 0.005 && (kept[5] - 0.06).abs() < 0.005, "{kept:?}");
        assert_eq!(paper_row(49).map(|row| row.fps(Column::Static)), Some([86.0, 302.0]));
        assert_eq!(paper_row(10), None);
    }
}

//! Figures in the headset: a panel that a button toggles, ahead of the head and below the notices.

use super::stillness::is_ahead;
use crate::draw::stages::text::{Text, panel_ahead};
use glam::Vec3;
use shadecast_protocol::pose::Pose;

/// How far below the head's height the panel's middle is, metres: the notice stays free.
const BELOW_M: f32 = 0.45;

/// See the module.
#[derive(Debug, Default)]
pub(crate) struct FiguresPanel {
    /// What it says; `None` while nobody wants to see it.
    text: Option<Text>,
    stage_from_panel: Option<Pose>,
}

impl FiguresPanel {
    /// Says these from now on. The first, the device, is left out: who wears a headset knows it, and lines are few.
    pub(crate) fn write(&mut self, lines: &[String]) {
        self.text = Some(Text::of(lines.iter().skip(1).map(String::as_str)));
    }

    /// Nobody wants to see it any more.
    pub(crate) fn hide(&mut self) {
        *self = Self::default();
    }

    /// Takes in where the head is: the panel stays where it is until the head has turned away from it.
    pub(crate) fn note(&mut self, stage_from_head: Pose) {
        let in_view = self.stage_from_panel.filter(|panel| is_ahead(*panel, stage_from_head));
        let anew = || {
            let Pose { position, orientation } = panel_ahead(stage_from_head);
            Pose { position: position - Vec3::Y * BELOW_M, orientation }
        };
        self.stage_from_panel = self.text.as_ref().map(|_| in_view.unwrap_or_else(anew));
    }

    /// Where it is in the stage, and what it says; `None` where it is not seen.
    pub(crate) fn shown(&self) -> Option<(Pose, &Text)> {
        self.stage_from_panel.zip(self.text.as_ref())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;

    fn head(yaw: f32) -> Pose {
        Pose { position: Vec3::new(0.0, 1.6, 0.0), orientation: Quat::from_rotation_y(yaw) }
    }

    fn lines(of: &[&str]) -> Vec<String> {
        of.iter().map(|line| (*line).to_owned()).collect()
    }

    #[test]
    fn it_is_seen_from_its_first_figures_on_until_it_is_hidden() {
        let mut panel = FiguresPanel::default();
        panel.note(head(0.0));
        assert_eq!(panel.shown(), None);
        panel.write(&lines(&["a device", "72.0 frames/s", "7.0 ms"]));
        panel.note(head(0.0));
        let (pose, text) = panel.shown().expect("it is wanted");
        assert_eq!(*text, Text::new("72.0 frames/s\n7.0 ms"));
        assert!((pose.position.y - (1.6 - BELOW_M)).abs() < 1e-6 && pose.position.z < -1.0, "{pose:?}");
        panel.hide();
        panel.note(head(0.0));
        assert_eq!(panel.shown(), None);
        panel.write(&[]);
        panel.note(head(0.0));
        assert_eq!(panel.shown().map(|(_, text)| text), Some(&Text::new("")), "no lines are no fault");
    }

    #[test]
    fn it_stays_where_it_is_until_the_head_turns_away() {
        let mut panel = FiguresPanel::default();
        let mut seen_at = |yaw: f32| {
            panel.write(&lines(&["a device", "72.0 frames/s"]));
            panel.note(head(yaw));
            panel.shown().expect("it is wanted").0
        };
        let first = seen_at(0.0);
        assert_eq!(seen_at(0.5), first);
        let turned = seen_at(1.5);
        assert!(turned.position.x < -1.0, "{turned:?}");
        assert_eq!(seen_at(1.2), turned);
    }
}

//! The notice of a world at rest, and its place. Without it a vanished server is a world in which nothing moves, without
//! explanation.

use crate::draw::stages::text::panel_ahead;
use crate::report::FrameReport;
use glam::Vec3;
use shadecast_protocol::pose::Pose;
use shadecast_protocol::time::ClientTime;

/// A world without a new picture for this long stands still: updates come many times a second.
const STILL_AFTER_NS: i64 = 2_000_000_000;
/// After a longer gap between two display frames stillness is counted anew: nobody looked meanwhile.
const GAP_NS: i64 = 1_000_000_000;
/// Cosine of the angle from which on the panel is placed anew: it must not be lost behind the user.
const FOLLOW_COS: f32 = 0.7;

/// Watches display frames for news.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stillness {
    last: ClientTime,
    /// The last display frame that showed something new, or that nobody saw.
    fresh: ClientTime,
    stage_from_panel: Option<Pose>,
}

impl Default for Stillness {
    fn default() -> Self {
        let long_ago = ClientTime(i64::MIN);
        Self { last: long_ago, fresh: long_ago, stage_from_panel: None }
    }
}

impl Stillness {
    /// Takes in a display frame.
    pub(crate) fn note(&mut self, frame: &FrameReport, stage_from_head: Pose) {
        let now = frame.display_time;
        let was_away = now.since(self.last) > GAP_NS;
        self.last = now;
        if was_away || !frame.is_seen() || frame.is_new || frame.update.is_none() {
            self.fresh = now;
        }
        let is_still = now.since(self.fresh) >= STILL_AFTER_NS;
        let in_view = self.stage_from_panel.filter(|panel| is_ahead(*panel, stage_from_head));
        self.stage_from_panel = is_still.then(|| in_view.unwrap_or_else(|| panel_ahead(stage_from_head)));
    }

    /// For how long nothing new has come, whole seconds.
    pub(crate) fn seconds(&self) -> i64 {
        self.last.since(self.fresh) / 1_000_000_000
    }

    /// Where the words belong, in the stage; `None` while the world moves.
    pub(crate) fn panel(&self) -> Option<Pose> {
        self.stage_from_panel
    }
}

/// Whether a panel is not lost behind a head, or far beside it.
pub(crate) fn is_ahead(stage_from_panel: Pose, stage_from_head: Pose) -> bool {
    let level = |direction: Vec3| Vec3::new(direction.x, 0.0, direction.z).normalize_or_zero();
    let to_panel = level(stage_from_panel.position - stage_from_head.position);
    to_panel.dot(level(stage_from_head.orientation * Vec3::NEG_Z)) >= FOLLOW_COS
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Quat;
    use shadecast_protocol::ids::UpdateId;

    const MS: i64 = 1_000_000;

    fn shown(ms: i64, is_new: bool) -> FrameReport {
        let update = Some(UpdateId(0));
        FrameReport { is_new, update, ..FrameReport::rendered_at(ClientTime(ms * MS)) }
    }

    #[test]
    fn a_world_at_rest_is_reported_after_two_seconds() {
        let mut stillness = Stillness::default();
        for ms in (0..2000).step_by(10) {
            stillness.note(&shown(ms, ms == 0), Pose::IDENTITY);
            assert!(stillness.panel().is_none(), "{ms} ms");
        }
        stillness.note(&shown(2000, false), Pose::IDENTITY);
        assert!(stillness.panel().is_some() && stillness.seconds() == 2);
        stillness.note(&shown(2010, true), Pose::IDENTITY);
        assert!(stillness.panel().is_none());
    }

    #[test]
    fn who_puts_the_headset_on_again_is_not_told_of_the_time_before() {
        let mut stillness = Stillness::default();
        stillness.note(&shown(0, true), Pose::IDENTITY);
        stillness.note(&shown(60_000, false), Pose::IDENTITY);
        assert!(stillness.panel().is_none(), "no frames meanwhile");
        for ms in (60_000..90_000).step_by(10) {
            stillness.note(&FrameReport { is_rendered: false, ..shown(ms, false) }, Pose::IDENTITY);
        }
        stillness.note(&shown(90_000, false), Pose::IDENTITY);
        assert!(stillness.panel().is_none(), "nobody saw the frames");
    }

    #[test]
    fn in_the_waiting_room_there_is_a_text_already() {
        let mut stillness = Stillness::default();
        for ms in (0..5000).step_by(10) {
            stillness.note(&FrameReport { update: None, ..shown(ms, false) }, Pose::IDENTITY);
        }
        assert!(stillness.panel().is_none());
    }

    #[test]
    fn the_words_stay_where_they_are_until_the_head_turns_away() {
        let turned = |angle| Pose { position: Vec3::ZERO, orientation: Quat::from_rotation_y(angle) };
        let mut stillness = Stillness::default();
        for ms in (0..2010).step_by(10) {
            stillness.note(&shown(ms, false), turned(0.0));
        }
        let first = stillness.panel().expect("a panel");
        stillness.note(&shown(2010, false), turned(0.5));
        assert_eq!(stillness.panel(), Some(first));
        stillness.note(&shown(2020, false), turned(1.5));
        let second = stillness.panel().expect("a panel");
        assert!(is_ahead(second, turned(1.5)) && !is_ahead(first, turned(1.5)));
    }
}

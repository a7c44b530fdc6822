//! What the controllers' inputs are: those of the configuration's script, read when the application synchronises its actions.

use crate::config::ScriptedInput;
use openxr_sys as xr;

/// A value above this is a press, where an action asks for no more.
const PRESSED: f32 = 0.5;

/// What an action says of its sources, as of the last `xrSyncActions`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Reading {
    pub(crate) is_active: bool,
    /// A number, or x and y; a press is 1.
    pub(crate) value: [f32; 2],
    pub(crate) has_changed: bool,
    /// When it changed last, nanoseconds of `XrTime`; 0: never.
    pub(crate) changed_ns: i64,
}

impl Reading {
    /// The next one, at this time; `None`: nothing is bound, or it is not asked for. What was not active counts as 0.
    pub(crate) fn next(self, value: Option<[f32; 2]>, time_ns: i64) -> Self {
        let Some(value) = value else { return Self::default() };
        let has_changed = value != self.value;
        let changed_ns = if has_changed { time_ns } else { self.changed_ns };
        Self { is_active: true, value, has_changed, changed_ns }
    }
}

/// What a source says to an action of this type, at a frame: one of the paths that the profile has, with its component or without.
pub(crate) fn value_of(inputs: &[ScriptedInput], frame: u64, source: &str, ty: xr::ActionType) -> [f32; 2] {
    let of = |component: &str| {
        let is_it = |input: &&ScriptedInput| {
            let below = input.path.strip_prefix(source).map(|rest| rest.trim_start_matches('/'));
            input.frame <= frame && below == Some(component)
        };
        inputs.iter().filter(is_it).max_by_key(|input| input.frame).map(|input| input.value)
    };
    let first = |components: &[&str]| components.iter().find_map(|component| of(component)).unwrap_or(0.0);
    match ty {
        xr::ActionType::BOOLEAN_INPUT => {
            [f32::from(u8::from(first(&["", "click", "value", "force"]) > PRESSED)), 0.0]
        }
        xr::ActionType::VECTOR2F_INPUT => [first(&["x"]), first(&["y"])],
        _ => [first(&["", "value", "force"]), 0.0],
    }
}

/// Of what several sources say the strongest, as the specification has it: the longest, the farthest from 0, any press.
pub(crate) fn strongest(values: impl Iterator<Item = [f32; 2]>) -> Option<[f32; 2]> {
    let length = |[x, y]: [f32; 2]| x.hypot(y);
    values.reduce(|best, value| if length(value) > length(best) { value } else { best })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn input(frame: u64, path: &str, value: f32) -> ScriptedInput {
        ScriptedInput { frame, path: path.into(), value }
    }

    #[test]
    fn the_newest_value_counts_for_each_kind_of_action() {
        let (stick, trigger) = ("/user/hand/left/input/thumbstick", "/user/hand/left/input/trigger");
        let script = [
            input(5, "/user/hand/left/input/thumbstick/x", 0.25),
            input(3, "/user/hand/left/input/thumbstick/x", -1.0),
            input(3, "/user/hand/left/input/thumbstick/y", 0.5),
            input(4, "/user/hand/left/input/trigger/value", 0.75),
        ];
        let at = |frame, source, ty| value_of(&script, frame, source, ty);
        assert_eq!(at(2, stick, xr::ActionType::VECTOR2F_INPUT), [0.0, 0.0]);
        assert_eq!(at(3, stick, xr::ActionType::VECTOR2F_INPUT), [-1.0, 0.5]);
        assert_eq!(at(9, stick, xr::ActionType::VECTOR2F_INPUT), [0.25, 0.5]);
        assert_eq!(at(4, trigger, xr::ActionType::FLOAT_INPUT), [0.75, 0.0]);
        assert_eq!(at(4, trigger, xr::ActionType::BOOLEAN_INPUT), [1.0, 0.0]);
        assert_eq!(at(3, trigger, xr::ActionType::BOOLEAN_INPUT), [0.0, 0.0]);
        assert_eq!(at(9, "/user/hand/left/input/thumbstick/x", xr::ActionType::FLOAT_INPUT), [0.25, 0.0]);
    }

    #[test]
    fn what_changes_is_told_with_its_time_and_what_is_not_bound_is_not_active() {
        let rest = Reading::default().next(Some([0.0, 0.0]), 10);
        assert_eq!((rest.is_active, rest.has_changed, rest.changed_ns), (true, false, 0));
        let pressed = rest.next(Some([1.0, 0.0]), 20);
        assert_eq!((pressed.has_changed, pressed.changed_ns), (true, 20));
        let held = pressed.next(Some([1.0, 0.0]), 30);
        assert_eq!((held.has_changed, held.changed_ns), (false, 20));
        assert_eq!(held.next(None, 40), Reading::default());
        assert_eq!(strongest([[0.5, 0.0], [0.0, -0.75]].into_iter()), Some([0.0, -0.75]));
        assert_eq!(strongest(std::iter::empty()), None);
    }
}

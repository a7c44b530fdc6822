//! Inputs of the controllers, by the configuration's script, read when the application synchronises its actions.

use crate::config::ScriptedInput;
use crate::profiles::Reads;

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
    /// The next one, at this time; `None`: nothing is bound, or it is not asked for. What was not active before has not changed.
    pub(crate) fn next(self, value: Option<[f32; 2]>, time_ns: i64) -> Self {
        let Some(value) = value else { return Self::default() };
        let differs = value != self.value;
        let changed_ns = if differs { time_ns } else { self.changed_ns };
        Self { is_active: true, value, has_changed: differs && self.is_active, changed_ns }
    }
}

/// What is read at a frame.
pub(crate) fn value_of(inputs: &[ScriptedInput], frame: u64, reads: &Reads) -> [f32; 2] {
    let of = |component: &str| {
        let said = inputs.iter().filter(|input| input.frame <= frame && input.path == component);
        said.max_by_key(|input| input.frame).map_or(0.0, |input| input.value)
    };
    match reads {
        Reads::Number(component) => [of(component), 0.0],
        Reads::Press(component) => [f32::from(u8::from(of(component) > PRESSED)), 0.0],
        Reads::Pair([x, y]) => [of(x), of(y)],
        Reads::Presence => [0.0, 0.0],
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
    fn the_newest_value_counts_as_a_number_as_a_press_and_in_a_pair() {
        let path = |name: &str| format!("/user/hand/left/input/{name}");
        let script = [
            input(5, &path("thumbstick/x"), 0.25),
            input(3, &path("thumbstick/x"), -1.0),
            input(3, &path("thumbstick/y"), 0.5),
            input(4, &path("trigger/value"), 0.75),
        ];
        let stick = Reads::Pair([path("thumbstick/x"), path("thumbstick/y")]);
        let (pull, pulled) = (Reads::Number(path("trigger/value")), Reads::Press(path("trigger/value")));
        let at = |frame, reads: &Reads| value_of(&script, frame, reads);
        assert_eq!([at(2, &stick), at(3, &stick), at(9, &stick)], [[0.0, 0.0], [-1.0, 0.5], [0.25, 0.5]]);
        assert_eq!([at(3, &pull), at(4, &pull)], [[0.0, 0.0], [0.75, 0.0]]);
        assert_eq!([at(3, &pulled), at(4, &pulled)], [[0.0, 0.0], [1.0, 0.0]]);
    }

    #[test]
    fn changed_inputs_have_times_and_unbound_ones_are_inactive() {
        let rest = Reading::default().next(Some([0.0, 0.0]), 10);
        assert_eq!((rest.is_active, rest.has_changed, rest.changed_ns), (true, false, 0));
        let pressed = rest.next(Some([1.0, 0.0]), 20);
        assert_eq!((pressed.has_changed, pressed.changed_ns), (true, 20));
        let held = pressed.next(Some([1.0, 0.0]), 30);
        assert_eq!((held.has_changed, held.changed_ns), (false, 20));
        assert_eq!(held.next(None, 40), Reading::default());
        let found = Reading::default().next(Some([1.0, 0.0]), 50);
        assert_eq!((found.has_changed, found.changed_ns), (false, 50), "held when it becomes active");
        assert_eq!(strongest([[0.5, 0.0], [0.0, -0.75]].into_iter()), Some([0.0, -0.75]));
        assert_eq!(strongest(std::iter::empty()), None);
    }
}

//! Interaction profiles: their bindable paths, by the tables of OpenXR 1.0. Paths of extensions are absent, because the mock
//! runtime has no such extension.

use crate::fault::{CallResult, Fault};
use openxr_sys as xr;

/// Paths below one or several top-level paths: identifiers with their components, those of no component by themselves.
struct Part {
    users: &'static [&'static str],
    inputs: &'static [(&'static str, &'static [&'static str])],
}

struct Profile {
    path: &'static str,
    parts: &'static [Part],
}

const LEFT: &str = "/user/hand/left";
const RIGHT: &str = "/user/hand/right";
const HANDS: &[&str] = &[LEFT, RIGHT];

const CLICK: &[&str] = &["click"];
const VALUE: &[&str] = &["value"];
const POSE: &[&str] = &["pose"];
const TOUCHED: &[&str] = &["click", "touch"];
const STICK: &[&str] = &["x", "y", "click"];
const TOUCHED_STICK: &[&str] = &["x", "y", "click", "touch"];
const GRIP: (&str, &[&str]) = ("input/grip", POSE);
const AIM: (&str, &[&str]) = ("input/aim", POSE);
const MENU: (&str, &[&str]) = ("input/menu", CLICK);
const SYSTEM: (&str, &[&str]) = ("input/system", CLICK);
const TRACKPAD: (&str, &[&str]) = ("input/trackpad", TOUCHED_STICK);
const HAPTIC: (&str, &[&str]) = ("output/haptic", &[]);

const PROFILES: [Profile; 9] = [
    Profile {
        path: "/interaction_profiles/khr/simple_controller",
        parts: &[Part { users: HANDS, inputs: &[("input/select", CLICK), MENU, GRIP, AIM, HAPTIC] }],
    },
    Profile {
        path: "/interaction_profiles/google/daydream_controller",
        parts: &[Part { users: HANDS, inputs: &[("input/select", CLICK), TRACKPAD, GRIP, AIM] }],
    },
    Profile {
        path: "/interaction_profiles/htc/vive_controller",
        parts: &[Part {
            users: HANDS,
            inputs: &[
                SYSTEM,
                ("input/squeeze", CLICK),
                MENU,
                ("input/trigger", &["click", "value"]),
                TRACKPAD,
                GRIP,
                AIM,
                HAPTIC,
            ],
        }],
    },
    Profile {
        path: "/interaction_profiles/htc/vive_pro",
        parts: &[Part {
            users: &["/user/head"],
            inputs: &[
                SYSTEM,
                ("input/volume_up", CLICK),
                ("input/volume_down", CLICK),
                ("input/mute_mic", CLICK),
            ],
        }],
    },
    Profile {
        path: "/interaction_profiles/microsoft/motion_controller",
        parts: &[Part {
            users: HANDS,
            inputs: &[
                MENU,
                ("input/squeeze", CLICK),
                ("input/trigger", VALUE),
                ("input/thumbstick", STICK),
                TRACKPAD,
                GRIP,
                AIM,
                HAPTIC,
            ],
        }],
    },
    Profile {
        path: "/interaction_profiles/microsoft/xbox_controller",
        parts: &[Part {
            users: &["/user/gamepad"],
            inputs: &[
                MENU,
                ("input/view", CLICK),
                ("input/a", CLICK),
                ("input/b", CLICK),
                ("input/x", CLICK),
                ("input/y", CLICK),
                ("input/dpad_down", CLICK),
                ("input/dpad_right", CLICK),
                ("input/dpad_up", CLICK),
                ("input/dpad_left", CLICK),
                ("input/shoulder_left", CLICK),
                ("input/shoulder_right", CLICK),
                ("input/thumbstick_left", STICK),
                ("input/thumbstick_right", STICK),
                ("input/trigger_left", VALUE),
                ("input/trigger_right", VALUE),
                ("output/haptic_left", &[]),
                ("output/haptic_right", &[]),
                ("output/haptic_left_trigger", &[]),
                ("output/haptic_right_trigger", &[]),
            ],
        }],
    },
    Profile {
        path: "/interaction_profiles/oculus/go_controller",
        parts: &[Part {
            users: HANDS,
            inputs: &[SYSTEM, ("input/trigger", CLICK), ("input/back", CLICK), TRACKPAD, GRIP, AIM],
        }],
    },
    Profile {
        path: "/interaction_profiles/oculus/touch_controller",
        parts: &[
            Part { users: &[LEFT], inputs: &[("input/x", TOUCHED), ("input/y", TOUCHED), MENU] },
            Part { users: &[RIGHT], inputs: &[("input/a", TOUCHED), ("input/b", TOUCHED), SYSTEM] },
            Part {
                users: HANDS,
                inputs: &[
                    ("input/squeeze", VALUE),
                    ("input/trigger", &["value", "touch"]),
                    ("input/thumbstick", TOUCHED_STICK),
                    ("input/thumbrest", &["touch"]),
                    GRIP,
                    AIM,
                    HAPTIC,
                ],
            },
        ],
    },
    Profile {
        path: "/interaction_profiles/valve/index_controller",
        parts: &[Part {
            users: HANDS,
            inputs: &[
                ("input/system", TOUCHED),
                ("input/a", TOUCHED),
                ("input/b", TOUCHED),
                ("input/squeeze", &["value", "force"]),
                ("input/trigger", &["click", "value", "touch"]),
                ("input/thumbstick", TOUCHED_STICK),
                ("input/trackpad", &["x", "y", "force", "touch"]),
                GRIP,
                AIM,
                HAPTIC,
            ],
        }],
    },
];

/// What an action reads at a binding.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Reads {
    /// The number of a component.
    Number(String),
    /// Whether a component is pressed: a press itself, or a number that is large enough.
    Press(String),
    /// Those of the components x and y.
    Pair([String; 2]),
    /// Nothing but that it is there: a pose, or something that vibrates.
    Presence,
}

/// Whether any profile has such an input or output.
pub(crate) fn is_source(path: &str) -> bool {
    PROFILES.iter().flat_map(|profile| profile.parts).any(|part| part.has(path))
}

/// A profile that bindings may be suggested for. Applications try profiles in turn: an unknown one is not a mistake.
#[derive(Clone, Copy)]
pub(crate) struct KnownProfile(&'static Profile);

impl PartialEq for KnownProfile {
    fn eq(&self, other: &Self) -> bool {
        self.0.path == other.0.path
    }
}

impl KnownProfile {
    pub(crate) fn named(path: &str) -> CallResult<Self> {
        let known = PROFILES.iter().find(|profile| profile.path == path);
        known.map(Self).ok_or_else(|| Fault::quiet(xr::Result::ERROR_PATH_UNSUPPORTED))
    }

    /// Its path.
    pub(crate) fn path(self) -> &'static str {
        self.0.path
    }

    /// Whether this is one of its inputs' components.
    pub(crate) fn has_component(self, path: &str) -> bool {
        self.component(path).is_some()
    }

    /// An input with the component that this path names.
    fn component(self, path: &str) -> Option<(&str, &str)> {
        let has = |path: &str| self.0.parts.iter().any(|part| part.has(path));
        path.rsplit_once('/').filter(|(input, _)| has(path) && has(input))
    }

    /// Whether it has anything below a top-level path.
    pub(crate) fn has_user(self, top_level: &str) -> bool {
        self.0.parts.iter().any(|part| part.users.contains(&top_level))
    }

    /// The input or output of a binding. Bindings of two of its components are bindings of the same.
    pub(crate) fn source(self, binding: &str) -> &str {
        self.component(binding).map_or(binding, |(input, _)| input)
    }

    /// What an action of this type reads at a binding, by the specification's rules for suggested bindings; what it leaves to the
    /// runtime is not bound. None: nothing that could be made a value of that type.
    pub(crate) fn reads(self, binding: &str, ty: xr::ActionType) -> Option<Reads> {
        let component = self.component(binding).map(|(_, component)| component);
        let below =
            |component: &str| Some(format!("{binding}/{component}")).filter(|path| self.has_component(path));
        let itself = || binding.to_owned();
        match (ty, component) {
            (xr::ActionType::BOOLEAN_INPUT, None) => {
                below("click").or_else(|| below("value")).map(Reads::Press)
            }
            (xr::ActionType::BOOLEAN_INPUT, Some("pose")) => None,
            (xr::ActionType::BOOLEAN_INPUT, Some(_)) => Some(Reads::Press(itself())),
            (xr::ActionType::FLOAT_INPUT, None) => {
                below("value").map(Reads::Number).or_else(|| below("click").map(Reads::Press))
            }
            (xr::ActionType::FLOAT_INPUT, Some("pose")) => None,
            (xr::ActionType::FLOAT_INPUT, Some("click" | "touch")) => Some(Reads::Press(itself())),
            (xr::ActionType::FLOAT_INPUT, Some(_)) => Some(Reads::Number(itself())),
            (xr::ActionType::VECTOR2F_INPUT, None) => Some(Reads::Pair([below("x")?, below("y")?])),
            (xr::ActionType::POSE_INPUT, None) => below("pose").map(|_| Reads::Presence),
            (xr::ActionType::POSE_INPUT, Some("pose")) => Some(Reads::Presence),
            (xr::ActionType::VIBRATION_OUTPUT, None) => {
                binding.contains("/output/").then_some(Reads::Presence)
            }
            _ => None,
        }
    }

    /// Refuses a path that the profile does not have. One without a component leaves the choice to the runtime.
    pub(crate) fn check(self, binding: &str) -> CallResult<()> {
        let is_there = self.0.parts.iter().any(|part| part.has(binding));
        if is_there {
            return Ok(());
        }
        let message = format!("{} has no {binding}", self.0.path);
        Err(Fault::application(xr::Result::ERROR_PATH_UNSUPPORTED, message))
    }
}

impl Part {
    fn has(&self, binding: &str) -> bool {
        let below = |user: &&str| binding.strip_prefix(*user).and_then(|rest| rest.strip_prefix('/'));
        let is_one = |rest: &str, (input, components): &(&str, &[&str])| match rest.strip_prefix(*input) {
            Some("") => true,
            Some(component) => component.strip_prefix('/').is_some_and(|one| components.contains(&one)),
            None => false,
        };
        self.users
            .iter()
            .find_map(below)
            .is_some_and(|rest| self.inputs.iter().any(|input| is_one(rest, input)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn assert_has(profile: &str, has: &[&str], lacks: &[&str]) {
        let Ok(profile) = KnownProfile::named(&format!("/interaction_profiles/{profile}")) else {
            panic!("{profile} is known");
        };
        has.iter().for_each(|path| assert!(profile.check(path).is_ok(), "{path}"));
        lacks.iter().for_each(|path| assert!(profile.check(path).is_err(), "{path}"));
    }

    #[test]
    fn a_profile_has_what_its_table_says_on_the_side_where_it_is() {
        assert_has(
            "oculus/touch_controller",
            &[
                "/user/hand/left/input/x/click",
                "/user/hand/right/input/a/touch",
                "/user/hand/left/input/thumbstick",
                "/user/hand/right/input/thumbstick/x",
                "/user/hand/right/output/haptic",
            ],
            &[
                "/user/hand/right/input/x/click",
                "/user/hand/left/input/a/touch",
                "/user/hand/left/input/thumbstick/z",
                "/user/hand/left/input/thumbsticks",
                "/user/hand/left/output/haptic/x",
                "/user/hand/left/input/palm_ext/pose",
                "/user/hand/left",
                "/user/gamepad/input/a/click",
            ],
        );
        assert_has(
            "microsoft/xbox_controller",
            &["/user/gamepad/input/a/click", "/user/gamepad/output/haptic_left_trigger"],
            &["/user/hand/left/input/a/click", "/user/gamepad/input/a/touch"],
        );
        assert!(KnownProfile::named("/interaction_profiles/acme/glove").is_err());
    }

    #[test]
    fn a_binding_of_a_component_is_of_its_input() {
        let touch = KnownProfile::named("/interaction_profiles/oculus/touch_controller").expect("known");
        let source = |binding| touch.source(binding);
        assert_eq!(source("/user/hand/left/input/trigger/touch"), "/user/hand/left/input/trigger");
        assert_eq!(source("/user/hand/left/input/trigger"), "/user/hand/left/input/trigger");
        assert_eq!(source("/user/hand/left/input/x"), "/user/hand/left/input/x", "a button, no component");
        assert!(is_source("/user/gamepad/input/a") && is_source("/user/hand/left/output/haptic"));
        assert!(!is_source("/user/hand/left") && !is_source("/user/hand/right/input/elbow"));
    }

    /// What actions read: a boolean one, a float, a pair of them, a pose.
    fn read_by_each(binding: &str) -> [Option<Reads>; 4] {
        type Type = xr::ActionType;
        let index = KnownProfile::named("/interaction_profiles/valve/index_controller").expect("known");
        [Type::BOOLEAN_INPUT, Type::FLOAT_INPUT, Type::VECTOR2F_INPUT, Type::POSE_INPUT]
            .map(|ty| index.reads(&format!("/user/hand/left/{binding}"), ty))
    }

    #[test]
    fn presses_and_numbers_convert_into_each_other_only() {
        let path = |component: &str| format!("/user/hand/left/input/{component}");
        let (press, number) = (|name| Some(Reads::Press(path(name))), |name| Some(Reads::Number(path(name))));
        let pair = Some(Reads::Pair([path("thumbstick/x"), path("thumbstick/y")]));
        for (binding, read) in [
            ("input/trigger/click", [press("trigger/click"), press("trigger/click"), None, None]),
            ("input/trigger/value", [press("trigger/value"), number("trigger/value"), None, None]),
            ("input/thumbstick/x", [press("thumbstick/x"), number("thumbstick/x"), None, None]),
            ("input/trigger", [press("trigger/click"), number("trigger/value"), None, None]),
            ("input/squeeze", [press("squeeze/value"), number("squeeze/value"), None, None]),
            ("input/a", [press("a/click"), press("a/click"), None, None]),
            ("input/thumbstick", [press("thumbstick/click"), press("thumbstick/click"), pair, None]),
            ("input/grip", [None, None, None, Some(Reads::Presence)]),
            ("input/grip/pose", [None, None, None, Some(Reads::Presence)]),
            ("output/haptic", [None, None, None, None]),
        ] {
            assert_eq!(read_by_each(binding), read, "{binding}");
        }
    }
}

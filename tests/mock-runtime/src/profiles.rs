//! What an interaction profile has: the paths that actions can be bound to, by the specification's tables of OpenXR 1.0. What an
//! extension adds is not there, since the mock runtime has none that does.

use crate::fault::{Fault, Outcome};
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

/// A profile that bindings may be suggested for. Applications try profiles in turn: an unknown one is not a mistake.
#[derive(Clone, Copy)]
pub(crate) struct KnownProfile(&'static Profile);

impl PartialEq for KnownProfile {
    fn eq(&self, other: &Self) -> bool {
        self.0.path == other.0.path
    }
}

impl KnownProfile {
    pub(crate) fn named(path: &str) -> Outcome<Self> {
        let known = PROFILES.iter().find(|profile| profile.path == path);
        known.map(Self).ok_or_else(|| Fault::quiet(xr::Result::ERROR_PATH_UNSUPPORTED))
    }

    /// Its path.
    pub(crate) fn path(self) -> &'static str {
        self.0.path
    }

    /// Whether this is one of its inputs' components.
    pub(crate) fn has_component(self, path: &str) -> bool {
        path.rsplit_once('/')
            .is_some_and(|(input, _)| self.0.parts.iter().any(|part| part.has(path) && part.has(input)))
    }

    /// Refuses a path that the profile does not have. One without a component leaves the choice to the runtime.
    pub(crate) fn check(self, binding: &str) -> Outcome<()> {
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
}

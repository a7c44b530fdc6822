//! The controllers: the meaning of their inputs, for each kind of controller.

use super::error::{Doing, XrError};
use super::locomotion::Wish;
use super::pose_of;
use glam::Vec2;
use openxr::sys;
use shadecast_protocol::pose::Pose;

/// How far a button pushes that stands for a stick.
const PUSHED: f32 = 1.0;

/// What a person does with the controllers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Asked {
    /// To walk and to turn.
    pub(super) wish: Wish,
    /// To leave.
    pub(super) leaves: bool,
    /// To show the figures, or to hide them: said once for each press.
    pub(super) toggles_figures: bool,
    /// To go to the next entry of a list: likewise.
    pub(super) goes_to_next: bool,
    /// To take the one that is marked: likewise.
    pub(super) takes: bool,
    /// To halt the world, or to let it go on: likewise.
    pub(super) halts: bool,
    /// To let a halted world go on by a step: likewise.
    pub(super) steps: bool,
}

/// The client's actions, bound for all controllers that it knows.
pub(super) struct Actions {
    set: openxr::ActionSet,
    walk: openxr::Action<openxr::Vector2f>,
    turn: openxr::Action<openxr::Vector2f>,
    walk_ahead: openxr::Action<bool>,
    turn_right: openxr::Action<bool>,
    leave: openxr::Action<bool>,
    figures: openxr::Action<bool>,
    next: openxr::Action<bool>,
    take: openxr::Action<bool>,
    halt: openxr::Action<bool>,
    step: openxr::Action<bool>,
    /// Where both hands hold their controllers.
    hands: [openxr::Space; 2],
    grip: openxr::Action<openxr::Posef>,
}

/// What a controller's inputs are for.
enum Use {
    Walk,
    Turn,
    WalkAhead,
    TurnRight,
    Leave,
    Figures,
    Next,
    Take,
    Halt,
    Step,
}

/// A controller's profile, and its inputs.
type Controller = (&'static str, &'static [(Use, &'static str)]);

const WALK: (Use, &str) = (Use::Walk, "/user/hand/left/input/thumbstick");
const TURN: (Use, &str) = (Use::Turn, "/user/hand/right/input/thumbstick");
const MENU: (Use, &str) = (Use::Leave, "/user/hand/left/input/menu/click");
const A: (Use, &str) = (Use::Figures, "/user/hand/right/input/a/click");

const B: (Use, &str) = (Use::Next, "/user/hand/right/input/b/click");
/// There is nothing to halt while there is a list.
const TAKE: (Use, &str) = (Use::Take, "/user/hand/right/input/trigger/value");
const HALT: (Use, &str) = (Use::Halt, "/user/hand/right/input/trigger/value");
const STEP: (Use, &str) = (Use::Step, "/user/hand/left/input/trigger/value");

/// Left and right.
const HANDS: [&str; 2] = ["/user/hand/left", "/user/hand/right"];

const CONTROLLERS: [Controller; 4] = [
    ("/interaction_profiles/oculus/touch_controller", &[WALK, TURN, MENU, A, B, TAKE, HALT, STEP]),
    ("/interaction_profiles/bytedance/pico4_controller", &[WALK, TURN, MENU, A, B, TAKE, HALT, STEP]),
    // It has no menu button but the system's own.
    (
        "/interaction_profiles/valve/index_controller",
        &[WALK, TURN, (Use::Leave, "/user/hand/left/input/b/click"), A, B, TAKE, HALT, STEP],
    ),
    // It has no button left for the figures, nor for the world's time. There is nowhere to walk to while there is a list.
    (
        "/interaction_profiles/khr/simple_controller",
        &[
            (Use::WalkAhead, "/user/hand/left/input/select/click"),
            (Use::Next, "/user/hand/left/input/select/click"),
            (Use::TurnRight, "/user/hand/right/input/select/click"),
            (Use::Take, "/user/hand/right/input/select/click"),
            MENU,
        ],
    ),
];

impl Actions {
    /// Makes them, and attaches them to a session that has none yet.
    pub(super) fn open(
        instance: &openxr::Instance,
        session: &openxr::Session<openxr::Vulkan>,
    ) -> Result<Self, XrError> {
        let set = instance.create_action_set("play", "Moving about", 0).doing("making the action set")?;
        let doing = "making an action";
        let both = [path_of(instance, HANDS[0])?, path_of(instance, HANDS[1])?];
        let grip = set.create_action::<openxr::Posef>("grip", "Hold", &both).doing(doing)?;
        let held = |hand| {
            let space = grip.create_space(session, hand, openxr::Posef::IDENTITY);
            space.doing("making a hand's space")
        };
        let actions = Self {
            walk: set.create_action("walk", "Walk", &[]).doing(doing)?,
            turn: set.create_action("turn", "Turn", &[]).doing(doing)?,
            walk_ahead: set.create_action("walk_ahead", "Walk ahead", &[]).doing(doing)?,
            turn_right: set.create_action("turn_right", "Turn to the right", &[]).doing(doing)?,
            leave: set.create_action("leave", "Leave", &[]).doing(doing)?,
            figures: set.create_action("figures", "Show or hide the figures", &[]).doing(doing)?,
            next: set.create_action("next", "Next of a list", &[]).doing(doing)?,
            take: set.create_action("take", "Take from a list", &[]).doing(doing)?,
            halt: set.create_action("halt", "Halt the world, or let it go on", &[]).doing(doing)?,
            step: set.create_action("step", "A step of the halted world", &[]).doing(doing)?,
            hands: [held(both[0])?, held(both[1])?],
            grip,
            set,
        };
        for (profile, inputs) in CONTROLLERS {
            actions.suggest(instance, profile, inputs)?;
        }
        session.attach_action_sets(&[&actions.set]).doing("attaching the actions")?;
        Ok(actions)
    }

    /// A runtime that does not know a controller has none of them.
    fn suggest(
        &self,
        instance: &openxr::Instance,
        profile: &str,
        inputs: &[(Use, &str)],
    ) -> Result<(), XrError> {
        let path = |text: &str| path_of(instance, text);
        let bind = |(means, input): &(Use, &str)| {
            let input = path(input)?;
            Ok(match means {
                Use::Walk => openxr::Binding::new(&self.walk, input),
                Use::Turn => openxr::Binding::new(&self.turn, input),
                Use::WalkAhead => openxr::Binding::new(&self.walk_ahead, input),
                Use::TurnRight => openxr::Binding::new(&self.turn_right, input),
                Use::Leave => openxr::Binding::new(&self.leave, input),
                Use::Figures => openxr::Binding::new(&self.figures, input),
                Use::Next => openxr::Binding::new(&self.next, input),
                Use::Take => openxr::Binding::new(&self.take, input),
                Use::Halt => openxr::Binding::new(&self.halt, input),
                Use::Step => openxr::Binding::new(&self.step, input),
            })
        };
        let mut bindings = inputs.iter().map(bind).collect::<Result<Vec<_>, XrError>>()?;
        for hand in HANDS {
            let grip = path(&format!("{hand}/input/grip/pose"))?;
            bindings.push(openxr::Binding::new(&self.grip, grip));
        }
        match instance.suggest_interaction_profile_bindings(path(profile)?, &bindings) {
            Err(sys::Result::ERROR_PATH_UNSUPPORTED) => {
                tracing::debug!("the runtime does not know {profile}");
                Ok(())
            }
            suggested => suggested.doing("binding actions to a controller"),
        }
    }

    /// What is asked now: nothing while the session has no input.
    pub(super) fn asked(&self, session: &openxr::Session<openxr::Vulkan>) -> Result<Asked, XrError> {
        let doing = "reading the controllers";
        session.sync_actions(&[openxr::ActiveActionSet::new(&self.set)]).doing(doing)?;
        let stick = |action: &openxr::Action<openxr::Vector2f>| {
            let state = action.state(session, openxr::Path::NULL).doing(doing)?;
            let openxr::Vector2f { x, y } = state.current_state;
            let pushed = Vec2::new(x, y);
            Ok::<_, XrError>(if state.is_active && pushed.is_finite() { pushed } else { Vec2::ZERO })
        };
        let button = |action: &openxr::Action<bool>| {
            let state = action.state(session, openxr::Path::NULL).doing(doing)?;
            Ok::<_, XrError>(state.is_active && state.current_state)
        };
        let pushed = |is_pressed: bool| if is_pressed { PUSHED } else { 0.0 };
        let wish = Wish {
            walk: stick(&self.walk)? + Vec2::Y * pushed(button(&self.walk_ahead)?),
            turn: stick(&self.turn)?.x + pushed(button(&self.turn_right)?),
        };
        let pressed = |action: &openxr::Action<bool>| {
            let state = action.state(session, openxr::Path::NULL).doing(doing)?;
            Ok::<_, XrError>(state.is_active && state.changed_since_last_sync && state.current_state)
        };
        Ok(Asked {
            wish,
            leaves: button(&self.leave)?,
            toggles_figures: pressed(&self.figures)?,
            goes_to_next: pressed(&self.next)?,
            takes: pressed(&self.take)?,
            halts: pressed(&self.halt)?,
            steps: pressed(&self.step)?,
        })
    }

    /// Where the hands hold their controllers in `base` at a time, left and right, as far as that is known.
    pub(super) fn locate_hands(
        &self,
        base: &openxr::Space,
        time: openxr::Time,
    ) -> Result<[Option<Pose>; 2], XrError> {
        let known =
            openxr::SpaceLocationFlags::POSITION_VALID | openxr::SpaceLocationFlags::ORIENTATION_VALID;
        let locate = |hand: &openxr::Space| {
            let location = hand.locate(base, time).doing("locating a controller")?;
            let pose = pose_of(location.pose);
            Ok::<_, XrError>((location.location_flags.contains(known) && pose.is_valid()).then_some(pose))
        };
        Ok([locate(&self.hands[0])?, locate(&self.hands[1])?])
    }
}

fn path_of(instance: &openxr::Instance, text: &str) -> Result<openxr::Path, XrError> {
    instance.string_to_path(text).doing("naming a controller's input")
}

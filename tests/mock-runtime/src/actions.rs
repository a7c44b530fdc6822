//! Actions: everything an application sets up is checked and kept. Without controllers in the configuration every state is
//! inactive; with them it is what the script says ([`crate::inputs`]).

use std::collections::{HashMap, HashSet};
use std::ffi::c_char;

use openxr_sys as xr;
use xr::Handle as _;

use crate::fault::{Fault, Outcome};
use crate::ffi::{self, entry};
use crate::inputs::{Reading, strongest, value_of};
use crate::paths::is_path_byte;
use crate::profiles::KnownProfile;
use crate::runtime::{self, Core, Event, Session};

/// The action sets and actions of one instance.
#[derive(Default)]
pub(crate) struct Actions {
    sets: HashMap<u64, ActionSet>,
    actions: HashMap<u64, Action>,
}

struct ActionSet {
    name: String,
    localized_name: String,
    attached: bool,
    /// Attached once, a set stays as it is, also after its session.
    frozen: bool,
}

struct Action {
    set: u64,
    name: String,
    localized_name: String,
    ty: xr::ActionType,
    /// Those that it can be asked for one by one.
    subaction_paths: Vec<xr::Path>,
    /// Its sources, by profile.
    bindings: Vec<(KnownProfile, String)>,
    /// What it says for all sources, at [`xr::Path::NULL`], and for each of its subaction paths.
    readings: HashMap<xr::Path, Reading>,
}

/// Paths that an action can be told apart by: those that the specification reserves.
const TOP_LEVEL_USER_PATHS: [&str; 5] =
    ["/user/hand/left", "/user/hand/right", "/user/head", "/user/gamepad", "/user/treadmill"];

impl Actions {
    fn set(&self, handle: xr::ActionSet) -> Outcome<&ActionSet> {
        self.sets.get(&handle.into_raw()).ok_or_else(|| Fault::handle("action set"))
    }

    fn action(&self, handle: xr::Action) -> Outcome<&Action> {
        self.actions.get(&handle.into_raw()).ok_or_else(|| Fault::handle("action"))
    }

    /// Refuses an action that does not exist or has another type.
    pub(crate) fn check_type(&self, action: xr::Action, needed: xr::ActionType) -> Outcome<()> {
        let action = self.action(action)?;
        if action.ty == needed {
            return Ok(());
        }
        let message = format!("action {:?} is of type {:?}, not {needed:?}", action.name, action.ty);
        Err(Fault::application(xr::Result::ERROR_ACTION_TYPE_MISMATCH, message))
    }

    /// Whether an action of poses had a source at the last `xrSyncActions`, of this path or of any.
    pub(crate) fn is_active(&self, action: xr::Action, path: xr::Path) -> bool {
        let action = self.actions.get(&action.into_raw());
        action.and_then(|action| action.readings.get(&path)).is_some_and(|reading| reading.is_active)
    }

    /// Refuses an action whose set is not attached to the session.
    fn check_attached(&self, action: xr::Action) -> Outcome<()> {
        let action = self.action(action)?;
        match self.sets.get(&action.set).is_some_and(|set| set.attached) {
            true => Ok(()),
            false => Err(not_attached(&format!("the set of action {:?}", action.name))),
        }
    }

    /// Refuses a path that was not given at the action's creation. None asks for all of them.
    pub(crate) fn check_subaction_path(&self, action: xr::Action, path: xr::Path) -> Outcome<()> {
        let action = self.action(action)?;
        if path == xr::Path::NULL || action.subaction_paths.contains(&path) {
            return Ok(());
        }
        let message = format!("action {:?} was created without this subaction path", action.name);
        Err(Fault::application(xr::Result::ERROR_PATH_UNSUPPORTED, message))
    }

    fn is_frozen(&self, action: xr::Action) -> Outcome<bool> {
        let action = self.action(action)?;
        Ok(self.sets.get(&action.set).is_some_and(|set| set.frozen))
    }

    /// The session is gone, and with it its attachments.
    pub(crate) fn detach(&mut self) {
        for set in self.sets.values_mut() {
            set.attached = false;
        }
    }
}

fn not_attached(what: &str) -> Fault {
    let message = format!("{what} is not attached to the session; call xrAttachSessionActionSets first");
    Fault::application(xr::Result::ERROR_ACTIONSET_NOT_ATTACHED, message)
}

fn already_attached(what: &str) -> Fault {
    Fault::application(
        xr::Result::ERROR_ACTIONSETS_ALREADY_ATTACHED,
        format!("{what}, which cannot change any more"),
    )
}

/// Checks a name and its localized name against those in use.
fn check_names<'a>(
    name: &str,
    localized_name: &str,
    mut in_use: impl Iterator<Item = (&'a str, &'a str)> + Clone,
) -> Outcome<()> {
    let refused = |code, why: &str| Err(Fault::application(code, format!("name {name:?} {why}")));
    if name.is_empty() {
        return refused(xr::Result::ERROR_NAME_INVALID, "is empty");
    }
    if localized_name.is_empty() {
        return refused(xr::Result::ERROR_LOCALIZED_NAME_INVALID, "has an empty localized name");
    }
    if !name.bytes().all(is_path_byte) {
        return refused(
            xr::Result::ERROR_PATH_FORMAT_INVALID,
            "has characters other than a-z, 0-9, '-', '_', '.'",
        );
    }
    if in_use.clone().any(|(used, _)| used == name) {
        return refused(xr::Result::ERROR_NAME_DUPLICATED, "is taken");
    }
    if in_use.any(|(_, used)| used == localized_name) {
        return refused(xr::Result::ERROR_LOCALIZED_NAME_DUPLICATED, "has a localized name that is taken");
    }
    Ok(())
}

entry! {
    create_action_set: CreateActionSet = "xrCreateActionSet"(
        instance: value xr::Instance,
        create_info: input xr::ActionSetCreateInfo,
        action_set: slot xr::ActionSet,
    ) {
        let mut runtime = runtime::lock();
        let handle = runtime.new_handle();
        let actions = &mut runtime.core(instance)?.actions;
        let name = ffi::fixed_text(&create_info.action_set_name, "actionSetName")?;
        let localized_name = ffi::fixed_text(&create_info.localized_action_set_name, "localizedActionSetName")?;
        let in_use = actions.sets.values().map(|set| (set.name.as_str(), set.localized_name.as_str()));
        check_names(&name, &localized_name, in_use)?;
        actions.sets.insert(handle, ActionSet { name, localized_name, attached: false, frozen: false });
        *action_set = xr::ActionSet::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    destroy_action_set: DestroyActionSet = "xrDestroyActionSet"(action_set: value xr::ActionSet) {
        let mut runtime = runtime::lock();
        let instance = runtime.instance.as_mut().ok_or_else(|| Fault::handle("action set"))?;
        let actions = &mut instance.core.actions;
        let raw = action_set.into_raw();
        actions.sets.remove(&raw).ok_or_else(|| Fault::handle("action set"))?;
        actions.actions.retain(|_, action| action.set != raw);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    create_action: CreateAction = "xrCreateAction"(
        action_set: value xr::ActionSet,
        create_info: input xr::ActionCreateInfo,
        action: slot xr::Action,
    ) {
        let mut runtime = runtime::lock();
        let handle = runtime.new_handle();
        let core = runtime.core_of_child("action set")?;
        if core.actions.set(action_set)?.frozen {
            return Err(already_attached("the action set is attached"));
        }
        let subaction_paths = subaction_paths(core, create_info)?;
        let name = ffi::fixed_text(&create_info.action_name, "actionName")?;
        let localized_name = ffi::fixed_text(&create_info.localized_action_name, "localizedActionName")?;
        let set = action_set.into_raw();
        let siblings = core.actions.actions.values().filter(|action| action.set == set);
        check_names(&name, &localized_name, siblings.map(|a| (a.name.as_str(), a.localized_name.as_str())))?;
        let ty = create_info.action_type;
        core.actions.actions.insert(handle, Action {
            set,
            name,
            localized_name,
            ty,
            subaction_paths,
            bindings: Vec::new(),
            readings: HashMap::new(),
        });
        *action = xr::Action::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

fn subaction_paths(core: &Core, info: &xr::ActionCreateInfo) -> Outcome<Vec<xr::Path>> {
    // SAFETY: the paths are an array of the length that the application says.
    let paths = unsafe { ffi::array(info.subaction_paths, info.count_subaction_paths, "subactionPaths") }?;
    let mut seen = HashSet::new();
    for path in paths {
        let text = core.paths.text(*path)?;
        if !TOP_LEVEL_USER_PATHS.contains(&text) {
            let message = format!("subaction path {text} is not one of {}", TOP_LEVEL_USER_PATHS.join(", "));
            return Err(Fault::application(xr::Result::ERROR_PATH_UNSUPPORTED, message));
        }
        if !seen.insert(*path) {
            let message = format!("subaction path {text} is there twice");
            return Err(Fault::application(xr::Result::ERROR_PATH_UNSUPPORTED, message));
        }
    }
    Ok(paths.to_vec())
}

entry! {
    destroy_action: DestroyAction = "xrDestroyAction"(action: value xr::Action) {
        let mut runtime = runtime::lock();
        let instance = runtime.instance.as_mut().ok_or_else(|| Fault::handle("action"))?;
        let removed = instance.core.actions.actions.remove(&action.into_raw());
        removed.map(|_| xr::Result::SUCCESS).ok_or_else(|| Fault::handle("action"))
    }
}

entry! {
    suggest_bindings: SuggestInteractionProfileBindings = "xrSuggestInteractionProfileBindings"(
        instance: value xr::Instance,
        suggested: input xr::InteractionProfileSuggestedBinding,
    ) {
        let mut runtime = runtime::lock();
        let core = runtime.core(instance)?;
        let profile = KnownProfile::named(core.paths.text(suggested.interaction_profile)?)?;
        if suggested.count_suggested_bindings == 0 {
            return Err(Fault::usage("there are no bindings"));
        }
        // SAFETY: the bindings are an array of the length that the application says.
        let bindings = unsafe {
            ffi::array(suggested.suggested_bindings, suggested.count_suggested_bindings, "suggestedBindings")
        }?;
        for binding in bindings {
            profile.check(core.paths.text(binding.binding)?)?;
            if core.actions.is_frozen(binding.action)? {
                return Err(already_attached("a bound action's set is attached"));
            }
        }
        // What was suggested for this profile before counts no more.
        core.actions.actions.values_mut().for_each(|action| action.bindings.retain(|(of, _)| *of != profile));
        for binding in bindings {
            let source = core.paths.text(binding.binding)?.to_owned();
            if let Some(action) = core.actions.actions.get_mut(&binding.action.into_raw()) {
                action.bindings.push((profile, source));
            }
        }
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    attach_action_sets: AttachSessionActionSets = "xrAttachSessionActionSets"(
        session: value xr::Session,
        attach_info: input xr::SessionActionSetsAttachInfo,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        if attach_info.count_action_sets == 0 {
            return Err(Fault::usage("there are no action sets"));
        }
        // SAFETY: the sets are an array of the length that the application says.
        let sets = unsafe { ffi::array(attach_info.action_sets, attach_info.count_action_sets, "actionSets") }?;
        if session.action_sets_attached {
            return Err(already_attached("the session has its action sets"));
        }
        sets.iter().try_for_each(|set| core.actions.set(*set).map(|_| ()))?;
        for set in sets {
            if let Some(set) = core.actions.sets.get_mut(&set.into_raw()) {
                (set.attached, set.frozen) = (true, true);
            }
        }
        session.action_sets_attached = true;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    sync_actions: SyncActions = "xrSyncActions"(
        session: value xr::Session,
        sync_info: input xr::ActionsSyncInfo,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        // SAFETY: the sets are an array of the length that the application says.
        let active = unsafe {
            ffi::array(sync_info.active_action_sets, sync_info.count_active_action_sets, "activeActionSets")
        }?;
        for set in active {
            if !core.actions.set(set.action_set)?.attached {
                return Err(not_attached("an active action set"));
            }
        }
        let is_focused = session.state.is_focused();
        find_profile(core, session);
        read_inputs(core, session.profile.filter(|_| is_focused), active)?;
        Ok(if is_focused { xr::Result::SUCCESS } else { xr::Result::SESSION_NOT_FOCUSED })
    }
}

/// Tells the application of the controllers, once it has suggested bindings for them.
fn find_profile(core: &mut Core, session: &mut Session) {
    let there = core.config.controllers.as_deref().and_then(|path| KnownProfile::named(path).ok());
    let bindings = || core.actions.actions.values().flat_map(|action| &action.bindings);
    let profile = there.filter(|profile| bindings().any(|(of, _)| of == profile));
    if session.profile != profile {
        session.profile = profile;
        core.events.push_back(Event::InteractionProfile { session: session.handle });
    }
}

/// What each action of the active sets says now; all others say nothing.
fn read_inputs(
    core: &mut Core,
    profile: Option<KnownProfile>,
    active: &[xr::ActiveActionSet],
) -> Outcome<()> {
    let (time_ns, frame) = (core.now_ns(), core.timeline.next_frame.saturating_sub(1));
    let Core { actions, paths, config, .. } = core;
    for action in actions.actions.values_mut() {
        let Action { set, ty, subaction_paths, bindings, readings, .. } = action;
        for path in subaction_paths.iter().copied().chain([xr::Path::NULL]) {
            let user = if path == xr::Path::NULL { "" } else { paths.text(path)? };
            let asks = |asked: &xr::ActiveActionSet| {
                let is_of = asked.subaction_path == xr::Path::NULL || asked.subaction_path == path;
                asked.action_set.into_raw() == *set && is_of
            };
            let is_asked = active.iter().any(asks);
            let sources = bindings.iter().filter(|(of, source)| {
                is_asked && profile.is_some_and(|profile| *of == profile) && source.starts_with(user)
            });
            let values = sources.map(|(_, source)| value_of(&config.inputs, frame, source, *ty));
            let reading = readings.entry(path).or_default();
            *reading = reading.next(strongest(values), time_ns);
        }
    }
    Ok(())
}

entry! {
    get_current_interaction_profile: GetCurrentInteractionProfile = "xrGetCurrentInteractionProfile"(
        session: value xr::Session,
        top_level_user_path: value xr::Path,
        interaction_profile: output xr::InteractionProfileState,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        core.paths.text(top_level_user_path)?;
        if !session.action_sets_attached {
            return Err(not_attached("no action set"));
        }
        let profile = session.profile.map(|profile| core.paths.intern(profile.path())).transpose()?;
        interaction_profile.interaction_profile = profile.unwrap_or(xr::Path::NULL);
        Ok(xr::Result::SUCCESS)
    }
}

/// What an action of this type says, if it may be asked.
fn reading(session: xr::Session, info: &xr::ActionStateGetInfo, ty: xr::ActionType) -> Outcome<Reading> {
    let mut runtime = runtime::lock();
    let (core, _) = runtime.session(session)?;
    check_use(core, info.action, ty, info.subaction_path)?;
    Ok(core.actions.action(info.action)?.readings.get(&info.subaction_path).copied().unwrap_or_default())
}

/// Checks that an action of a type can be asked or set off now, for a path or for all.
fn check_use(core: &Core, action: xr::Action, ty: xr::ActionType, path: xr::Path) -> Outcome<()> {
    core.actions.check_type(action, ty)?;
    if path != xr::Path::NULL {
        core.paths.text(path)?;
    }
    core.actions.check_attached(action)?;
    core.actions.check_subaction_path(action, path)
}

entry! {
    get_action_state_boolean: GetActionStateBoolean = "xrGetActionStateBoolean"(
        session: value xr::Session,
        get_info: input xr::ActionStateGetInfo,
        state: output xr::ActionStateBoolean,
    ) {
        let reading = reading(session, get_info, xr::ActionType::BOOLEAN_INPUT)?;
        state.current_state = (reading.value[0] != 0.0).into();
        state.changed_since_last_sync = reading.has_changed.into();
        state.last_change_time = xr::Time::from_nanos(reading.changed_ns);
        state.is_active = reading.is_active.into();
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    get_action_state_float: GetActionStateFloat = "xrGetActionStateFloat"(
        session: value xr::Session,
        get_info: input xr::ActionStateGetInfo,
        state: output xr::ActionStateFloat,
    ) {
        let reading = reading(session, get_info, xr::ActionType::FLOAT_INPUT)?;
        state.current_state = reading.value[0];
        state.changed_since_last_sync = reading.has_changed.into();
        state.last_change_time = xr::Time::from_nanos(reading.changed_ns);
        state.is_active = reading.is_active.into();
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    get_action_state_vector2f: GetActionStateVector2f = "xrGetActionStateVector2f"(
        session: value xr::Session,
        get_info: input xr::ActionStateGetInfo,
        state: output xr::ActionStateVector2f,
    ) {
        let reading = reading(session, get_info, xr::ActionType::VECTOR2F_INPUT)?;
        let [x, y] = reading.value;
        state.current_state = xr::Vector2f { x, y };
        state.changed_since_last_sync = reading.has_changed.into();
        state.last_change_time = xr::Time::from_nanos(reading.changed_ns);
        state.is_active = reading.is_active.into();
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    get_action_state_pose: GetActionStatePose = "xrGetActionStatePose"(
        session: value xr::Session,
        get_info: input xr::ActionStateGetInfo,
        state: output xr::ActionStatePose,
    ) {
        state.is_active = reading(session, get_info, xr::ActionType::POSE_INPUT)?.is_active.into();
        Ok(xr::Result::SUCCESS)
    }
}

/// Checks a haptic call. Whether there is something that vibrates is not the application's concern.
fn check_haptic(session: xr::Session, info: &xr::HapticActionInfo) -> Outcome {
    let mut runtime = runtime::lock();
    let (core, session) = runtime.session(session)?;
    check_use(core, info.action, xr::ActionType::VIBRATION_OUTPUT, info.subaction_path)?;
    match session.state.is_focused() {
        true => Ok(xr::Result::SUCCESS),
        false => Ok(xr::Result::SESSION_NOT_FOCUSED),
    }
}

entry! {
    apply_haptic_feedback: ApplyHapticFeedback = "xrApplyHapticFeedback"(
        session: value xr::Session,
        haptic_action_info: input xr::HapticActionInfo,
        haptic_feedback: raw_in xr::HapticBaseHeader,
    ) {
        if haptic_feedback.is_null() {
            return Err(Fault::usage("haptic_feedback is null"));
        }
        check_haptic(session, haptic_action_info)
    }
}

entry! {
    stop_haptic_feedback: StopHapticFeedback = "xrStopHapticFeedback"(
        session: value xr::Session,
        haptic_action_info: input xr::HapticActionInfo,
    ) {
        check_haptic(session, haptic_action_info)
    }
}

entry! {
    enumerate_bound_sources: EnumerateBoundSourcesForAction = "xrEnumerateBoundSourcesForAction"(
        session: value xr::Session,
        enumerate_info: input xr::BoundSourcesForActionEnumerateInfo,
        capacity: value u32,
        count: raw_out u32,
        sources: raw_out xr::Path,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        core.actions.check_attached(enumerate_info.action)?;
        let Core { actions, paths, .. } = core;
        let bindings = &actions.action(enumerate_info.action)?.bindings;
        let bound = bindings.iter().filter(|(of, _)| session.profile == Some(*of));
        let bound: Vec<xr::Path> = bound.map(|(_, source)| paths.intern(source)).collect::<Outcome<_>>()?;
        // SAFETY: count and sources are the caller's, of the capacity it says.
        unsafe { ffi::enumerate((capacity, count, sources), &bound, |place, path| *place = *path) }
    }
}

entry! {
    get_input_source_localized_name: GetInputSourceLocalizedName = "xrGetInputSourceLocalizedName"(
        session: value xr::Session,
        get_info: input xr::InputSourceLocalizedNameGetInfo,
        capacity: value u32,
        count: raw_out u32,
        buffer: raw_out c_char,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        if get_info.which_components.is_empty() {
            return Err(Fault::usage("whichComponents is 0"));
        }
        let source = core.paths.text(get_info.source_path)?;
        if !session.action_sets_attached {
            return Err(not_attached("no action set"));
        }
        // The best name that there is of any path is the path.
        // SAFETY: count and buffer are the caller's, of the capacity it says.
        unsafe { ffi::enumerate_text((capacity, count, buffer), source) }
    }
}

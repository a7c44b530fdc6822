//! Actions: everything that an application sets up is checked and kept. Without controllers in the configuration every state is
//! inactive; with them the script gives it ([`crate::inputs`]).

use std::collections::{HashMap, HashSet};
use std::ffi::c_char;

use openxr_sys as xr;
use xr::Handle as _;

use crate::fault::{CallResult, Fault};
use crate::ffi::{self, entry};
use crate::inputs::{Reading, strongest, value_of};
use crate::paths::{Paths, is_path_byte};
use crate::profiles::{self, KnownProfile, Reads};
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
    /// Of several active sets that share a source the one of the highest has it.
    priority: u32,
    attached: bool,
    /// Attached once, a set stays as it is, also after its session.
    frozen: bool,
    /// Its handle is gone; spaces of its actions stay where they are until the next `xrSyncActions`.
    destroyed: bool,
}

struct Action {
    set: u64,
    name: String,
    localized_name: String,
    ty: xr::ActionType,
    /// Those that it can be asked for one by one.
    subaction_paths: Vec<xr::Path>,
    bindings: Vec<Binding>,
    /// What it says for all sources, at [`xr::Path::NULL`], and for each of its subaction paths.
    readings: HashMap<xr::Path, Reading>,
    /// The sources that it had at the last `xrSyncActions`.
    sources: Vec<String>,
    /// Its handle is gone. Its spaces are still located, and its sources still have its set's priority.
    destroyed: bool,
}

/// A binding that the application has suggested.
struct Binding {
    profile: KnownProfile,
    path: String,
    /// None where it cannot be: an action of that type finds nothing there.
    reads: Option<Reads>,
}

/// What the application wants of `xrSyncActions`: sets, each with the top-level path below which it is active; an empty one: anywhere.
type Asked<'a> = [(u64, &'a str)];

impl Binding {
    fn source(&self) -> &str {
        self.profile.source(&self.path)
    }

    /// Whether it is in use, for an action of this set.
    fn is_asked(&self, set: u64, profile: Option<KnownProfile>, asked: &Asked<'_>) -> bool {
        let is_here = |(of, user): &(u64, &str)| *of == set && self.path.starts_with(user);
        self.reads.is_some() && Some(self.profile) == profile && asked.iter().any(is_here)
    }
}

/// Paths that an action can be told apart by: those that the specification reserves.
const TOP_LEVEL_USER_PATHS: [&str; 5] =
    ["/user/hand/left", "/user/hand/right", "/user/head", "/user/gamepad", "/user/treadmill"];

impl Actions {
    fn set(&self, handle: xr::ActionSet) -> CallResult<&ActionSet> {
        let set = self.sets.get(&handle.into_raw()).filter(|set| !set.destroyed);
        set.ok_or_else(|| Fault::handle("action set"))
    }

    fn action(&self, handle: xr::Action) -> CallResult<&Action> {
        let action = self.actions.get(&handle.into_raw()).filter(|action| !action.destroyed);
        action.ok_or_else(|| Fault::handle("action"))
    }

    /// Those of a set, destroyed ones too.
    fn actions_of(&self, set: xr::ActionSet) -> impl Iterator<Item = &Action> + Clone {
        self.actions.values().filter(move |action| action.set == set.into_raw())
    }

    /// Refuses an action that does not exist or has another type.
    pub(crate) fn check_type(&self, action: xr::Action, needed: xr::ActionType) -> CallResult<()> {
        let action = self.action(action)?;
        if action.ty == needed {
            return Ok(());
        }
        let message = format!("action {:?} is of type {:?}, not {needed:?}", action.name, action.ty);
        Err(Fault::application(xr::Result::ERROR_ACTION_TYPE_MISMATCH, message))
    }

    /// Whether an action had a source below a top-level path at the last `xrSyncActions`. It may be destroyed: a space asks for it.
    pub(crate) fn is_active(&self, action: xr::Action, user: &str) -> bool {
        let action = self.actions.get(&action.into_raw());
        action.is_some_and(|action| action.sources.iter().any(|source| source.starts_with(user)))
    }

    /// Refuses an action whose set is not attached to the session.
    fn check_attached(&self, action: xr::Action) -> CallResult<()> {
        let action = self.action(action)?;
        match self.sets.get(&action.set).is_some_and(|set| set.attached) {
            true => Ok(()),
            false => Err(not_attached(&format!("the set of action {:?}", action.name))),
        }
    }

    /// Refuses a path that was not given at the action's creation. None asks for all of them.
    pub(crate) fn check_subaction_path(&self, action: xr::Action, path: xr::Path) -> CallResult<()> {
        let action = self.action(action)?;
        if path == xr::Path::NULL || action.subaction_paths.contains(&path) {
            return Ok(());
        }
        let message = format!("action {:?} was created without this subaction path", action.name);
        Err(Fault::application(xr::Result::ERROR_PATH_UNSUPPORTED, message))
    }

    fn is_frozen(&self, action: xr::Action) -> CallResult<bool> {
        let action = self.action(action)?;
        Ok(self.sets.get(&action.set).is_some_and(|set| set.frozen))
    }

    /// Refuses to activate a set that is not attached, or for a path that none of its actions has.
    fn check_active(&self, paths: &Paths, asked: &xr::ActiveActionSet) -> CallResult<()> {
        if !self.set(asked.action_set)?.attached {
            return Err(not_attached("an active action set"));
        }
        let path = asked.subaction_path;
        if path == xr::Path::NULL {
            return Ok(());
        }
        let text = paths.text(path)?;
        if self.actions_of(asked.action_set).any(|action| action.subaction_paths.contains(&path)) {
            return Ok(());
        }
        let message = format!("no action of the active set was created with the subaction path {text}");
        Err(Fault::application(xr::Result::ERROR_PATH_UNSUPPORTED, message))
    }

    /// The highest priority at which each source is asked for.
    fn priorities(&self, profile: Option<KnownProfile>, asked: &Asked<'_>) -> HashMap<String, u32> {
        let mut highest = HashMap::new();
        for action in self.actions.values() {
            let priority = self.sets.get(&action.set).map_or(0, |set| set.priority);
            let bindings = action.bindings.iter();
            for binding in bindings.filter(|binding| binding.is_asked(action.set, profile, asked)) {
                let known = highest.entry(binding.source().to_owned()).or_insert(priority);
                *known = priority.max(*known);
            }
        }
        highest
    }

    /// The handles of a set and of its actions are gone.
    fn destroy_set(&mut self, handle: xr::ActionSet) -> CallResult<()> {
        self.set(handle)?;
        let raw = handle.into_raw();
        self.actions
            .values_mut()
            .filter(|action| action.set == raw)
            .for_each(|action| action.destroyed = true);
        if let Some(set) = self.sets.get_mut(&raw) {
            set.destroyed = true;
        }
        self.forget_destroyed();
        Ok(())
    }

    /// The session is gone, and with it its attachments and what its actions said.
    pub(crate) fn detach(&mut self) {
        for set in self.sets.values_mut() {
            set.attached = false;
        }
        for action in self.actions.values_mut() {
            action.readings.clear();
            action.sources.clear();
        }
        self.forget_destroyed();
    }

    /// Destroyed sets are kept, with their actions, for the spaces of the session that they are attached to.
    fn forget_destroyed(&mut self) {
        self.sets.retain(|_, set| set.attached || !set.destroyed);
        self.actions.retain(|_, action| self.sets.contains_key(&action.set));
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
) -> CallResult<()> {
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
        let in_use = actions.sets.values().filter(|set| !set.destroyed);
        check_names(&name, &localized_name, in_use.map(|set| (set.name.as_str(), set.localized_name.as_str())))?;
        let priority = create_info.priority;
        let set = ActionSet { name, localized_name, priority, attached: false, frozen: false, destroyed: false };
        actions.sets.insert(handle, set);
        *action_set = xr::ActionSet::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    destroy_action_set: DestroyActionSet = "xrDestroyActionSet"(action_set: value xr::ActionSet) {
        let mut runtime = runtime::lock();
        let instance = runtime.instance.as_mut().ok_or_else(|| Fault::handle("action set"))?;
        instance.core.actions.destroy_set(action_set).map(|()| xr::Result::SUCCESS)
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
        let siblings = core.actions.actions_of(action_set).filter(|action| !action.destroyed);
        check_names(&name, &localized_name, siblings.map(|a| (a.name.as_str(), a.localized_name.as_str())))?;
        core.actions.actions.insert(handle, Action {
            set: action_set.into_raw(),
            name,
            localized_name,
            ty: create_info.action_type,
            subaction_paths,
            bindings: Vec::new(),
            readings: HashMap::new(),
            sources: Vec::new(),
            destroyed: false,
        });
        *action = xr::Action::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

fn subaction_paths(core: &Core, info: &xr::ActionCreateInfo) -> CallResult<Vec<xr::Path>> {
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
        let known = instance.core.actions.actions.get_mut(&action.into_raw()).filter(|action| !action.destroyed);
        known.ok_or_else(|| Fault::handle("action"))?.destroyed = true;
        Ok(xr::Result::SUCCESS)
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
        let actions = &mut core.actions.actions;
        actions.values_mut().for_each(|action| action.bindings.retain(|binding| binding.profile != profile));
        for binding in bindings {
            let path = core.paths.text(binding.binding)?.to_owned();
            if let Some(action) = actions.get_mut(&binding.action.into_raw()) {
                let reads = profile.reads(&path, action.ty);
                action.bindings.push(Binding { profile, path, reads });
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
        active.iter().try_for_each(|asked| core.actions.check_active(&core.paths, asked))?;
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
    let profile = there.filter(|profile| bindings().any(|binding| binding.profile == *profile));
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
) -> CallResult<()> {
    let (time_ns, frame) = (core.now_ns(), core.timeline.next_frame.saturating_sub(1));
    let Core { actions, paths, config, .. } = core;
    let asked =
        active.iter().map(|asked| Ok((asked.action_set.into_raw(), user(paths, asked.subaction_path)?)));
    let asked = asked.collect::<CallResult<Vec<_>>>()?;
    let highest = actions.priorities(profile, &asked);
    let Actions { sets, actions } = actions;
    for action in actions.values_mut() {
        let Action { set, subaction_paths, bindings, readings, sources, .. } = action;
        let priority = sets.get(set).map(|set| set.priority);
        let has_it = |binding: &&Binding| {
            binding.is_asked(*set, profile, &asked) && highest.get(binding.source()).copied() == priority
        };
        let bindings: Vec<_> = bindings.iter().filter(has_it).collect();
        *sources = bindings.iter().map(|binding| binding.source().to_owned()).collect();
        for path in subaction_paths.iter().copied().chain([xr::Path::NULL]) {
            let user = user(paths, path)?;
            let below = bindings.iter().filter(|binding| binding.path.starts_with(user));
            let reads = below.filter_map(|binding| binding.reads.as_ref());
            let values = reads.map(|reads| value_of(&config.inputs, frame, reads));
            let reading = readings.entry(path).or_default();
            *reading = reading.next(strongest(values), time_ns);
        }
    }
    Ok(())
}

/// The beginning of the paths that a subaction path stands for: of all of them where there is none.
fn user(paths: &Paths, subaction_path: xr::Path) -> CallResult<&str> {
    if subaction_path == xr::Path::NULL { Ok("") } else { paths.text(subaction_path) }
}

entry! {
    get_current_interaction_profile: GetCurrentInteractionProfile = "xrGetCurrentInteractionProfile"(
        session: value xr::Session,
        top_level_user_path: value xr::Path,
        interaction_profile: output xr::InteractionProfileState,
    ) {
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session(session)?;
        let user = core.paths.text(top_level_user_path)?;
        if !session.action_sets_attached {
            return Err(not_attached("no action set"));
        }
        if !TOP_LEVEL_USER_PATHS.contains(&user) {
            let message = format!("{user} is not one of {}", TOP_LEVEL_USER_PATHS.join(", "));
            return Err(Fault::application(xr::Result::ERROR_PATH_UNSUPPORTED, message));
        }
        let profile = session.profile.filter(|profile| profile.has_user(user));
        let profile = profile.map(|profile| core.paths.intern(profile.path())).transpose()?;
        interaction_profile.interaction_profile = profile.unwrap_or(xr::Path::NULL);
        Ok(xr::Result::SUCCESS)
    }
}

/// What an action of this type says, if it may be asked.
fn reading(session: xr::Session, info: &xr::ActionStateGetInfo, ty: xr::ActionType) -> CallResult<Reading> {
    let mut runtime = runtime::lock();
    let (core, _) = runtime.session(session)?;
    check_use(core, info.action, ty, info.subaction_path)?;
    Ok(core.actions.action(info.action)?.readings.get(&info.subaction_path).copied().unwrap_or_default())
}

/// Checks that an action of a type can be asked or set off now, for a path or for all.
fn check_use(core: &Core, action: xr::Action, ty: xr::ActionType, path: xr::Path) -> CallResult<()> {
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
fn check_haptic(session: xr::Session, info: &xr::HapticActionInfo) -> CallResult {
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
        let is_bound = |binding: &&Binding| session.profile == Some(binding.profile) && binding.reads.is_some();
        let mut bound: Vec<xr::Path> = Vec::new();
        for binding in bindings.iter().filter(is_bound) {
            let path = paths.intern(&binding.path)?;
            // However often it was suggested.
            if !bound.contains(&path) {
                bound.push(path);
            }
        }
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
        if !profiles::is_source(source) {
            let message = format!("no profile has {source}; ask for what xrEnumerateBoundSourcesForAction gives");
            return Err(Fault::application(xr::Result::ERROR_PATH_UNSUPPORTED, message));
        }
        // The best name that there is of any path is the path.
        // SAFETY: count and buffer are the caller's, of the capacity it says.
        unsafe { ffi::enumerate_text((capacity, count, buffer), source) }
    }
}

//! The instance: the runtime's properties, the abilities of its one system (a headset), and the queue of events.

use std::ffi::c_char;
use std::path::PathBuf;

use openxr_sys as xr;
use xr::Handle as _;

use crate::config::{CONFIG_VARIABLE, ConfigError, MAX_EXTENT_PIXELS, MockConfig};
use crate::debug_utils::ObjectNames;
use crate::fault::{CallResult, Fault};
use crate::ffi::{self, entry};
use crate::head_path::HeadPath;
use crate::record::Recorder;
use crate::runtime::{self, Core, Event, Extensions, InstanceState, Resume, Runtime, Session};
use crate::space::pose_to_xr;
use crate::{names, session, time};

/// Name of the runtime and of its system.
const NAME: &str = "Shadecast mock runtime";

/// The one system.
const SYSTEM: u64 = 1;

/// Most layers in one frame (the least that the specification allows is 16).
pub(crate) const MAX_LAYERS: u32 = 16;

/// The one view configuration.
const STEREO: xr::ViewConfigurationType = xr::ViewConfigurationType::PRIMARY_STEREO;

const EXTENSIONS: [(&[u8], u32); 5] = [
    (xr::KHR_VULKAN_ENABLE2_EXTENSION_NAME, xr::KHR_vulkan_enable2_SPEC_VERSION),
    time::EXTENSION,
    (xr::FB_DISPLAY_REFRESH_RATE_EXTENSION_NAME, xr::FB_display_refresh_rate_SPEC_VERSION),
    (xr::EXT_PERFORMANCE_SETTINGS_EXTENSION_NAME, xr::EXT_performance_settings_SPEC_VERSION),
    (xr::EXT_DEBUG_UTILS_EXTENSION_NAME, xr::EXT_debug_utils_SPEC_VERSION),
];

/// Offered where the configuration says so.
const FOVEATION_EXTENSIONS: [(&[u8], u32); 4] = [
    (xr::FB_FOVEATION_EXTENSION_NAME, xr::FB_foveation_SPEC_VERSION),
    (xr::FB_FOVEATION_CONFIGURATION_EXTENSION_NAME, xr::FB_foveation_configuration_SPEC_VERSION),
    (xr::FB_SWAPCHAIN_UPDATE_STATE_EXTENSION_NAME, xr::FB_swapchain_update_state_SPEC_VERSION),
    (xr::FB_FOVEATION_VULKAN_EXTENSION_NAME, xr::FB_foveation_vulkan_SPEC_VERSION),
];

fn text_of(name: &'static [u8]) -> &'static str {
    std::str::from_utf8(name).unwrap_or_default().trim_end_matches('\0')
}

entry! {
    enumerate_api_layer_properties: EnumerateApiLayerProperties = "xrEnumerateApiLayerProperties"(
        capacity: value u32,
        count: raw_out u32,
        properties: raw_out xr::ApiLayerProperties,
    ) {
        // SAFETY: count and properties are the caller's, of the capacity it says.
        unsafe { ffi::enumerate((capacity, count, properties), &[(); 0], |_, ()| ()) }
    }
}

entry! {
    enumerate_instance_extension_properties:
    EnumerateInstanceExtensionProperties = "xrEnumerateInstanceExtensionProperties"(
        layer_name: raw_in c_char,
        capacity: value u32,
        count: raw_out u32,
        properties: raw_out xr::ExtensionProperties,
    ) {
        if !layer_name.is_null() {
            let message = "the runtime has no layers; ask with a null layer name";
            return Err(Fault::application(xr::Result::ERROR_API_LAYER_NOT_PRESENT, message));
        }
        let (offered, hidden) = extensions();
        let is_shown = |(name, _): &&(&'static [u8], u32)| !hidden.iter().any(|hidden| hidden == text_of(name));
        let shown: Vec<_> = offered.iter().filter(is_shown).collect();
        // SAFETY: count and properties are the caller's, of the capacity it says.
        unsafe {
            ffi::enumerate((capacity, count, properties), &shown, |slot, (name, version)| {
                ffi::place_text(&mut slot.extension_name, text_of(name));
                slot.extension_version = *version;
            })
        }
    }
}

entry! {
    create_instance: CreateInstance = "xrCreateInstance"(
        create_info: input xr::InstanceCreateInfo,
        instance: slot xr::Instance,
    ) {
        let extensions = enabled_extensions(create_info)?;
        check_application(&create_info.application_info)?;
        let mut runtime = runtime::lock();
        if runtime.instance.is_some() {
            let message = "an instance exists; destroy it before creating another";
            return Err(Fault::application(xr::Result::ERROR_LIMIT_REACHED, message));
        }
        let (config, head_path) = load_configuration().map_err(|error| {
            Fault::runtime(xr::Result::ERROR_INITIALIZATION_FAILED, error.to_string())
        })?;
        let core = new_core(&mut runtime, extensions, config, head_path)?;
        *instance = xr::Instance::from_raw(core.handle);
        runtime.instance = Some(InstanceState { core, session: None });
        Ok(xr::Result::SUCCESS)
    }
}

fn enabled_extensions(create_info: &xr::InstanceCreateInfo) -> CallResult<Extensions> {
    // SAFETY: the names are an array of the length that the application says.
    let names = unsafe {
        ffi::array(
            create_info.enabled_extension_names,
            create_info.enabled_extension_count,
            "enabledExtensionNames",
        )
    }?;
    let (offered, hidden) = extensions();
    let mut enabled = Extensions::default();
    for name in names {
        // SAFETY: each name is a zero-terminated string of the application's.
        let name = unsafe { ffi::text(*name, "an extension name") }?;
        match name {
            name if !offered.iter().any(|(offered, _)| text_of(offered) == name) => {
                let message = format!("the mock runtime has no extension {name}");
                return Err(Fault::application(xr::Result::ERROR_EXTENSION_NOT_PRESENT, message));
            }
            name if hidden.iter().any(|hidden| hidden == name) => {
                let message = format!("{name} is among hidden_extensions");
                return Err(Fault::application(xr::Result::ERROR_EXTENSION_NOT_PRESENT, message));
            }
            "XR_KHR_vulkan_enable2" => enabled.vulkan_enable2 = true,
            name if name == text_of(time::EXTENSION.0) => enabled.convert_time = true,
            "XR_FB_display_refresh_rate" => enabled.refresh_rate = true,
            "XR_EXT_performance_settings" => enabled.performance = true,
            "XR_EXT_debug_utils" => enabled.debug_utils = true,
            "XR_FB_foveation" => enabled.foveation = true,
            "XR_FB_foveation_configuration" => enabled.foveation_configuration = true,
            "XR_FB_swapchain_update_state" => enabled.swapchain_update_state = true,
            "XR_FB_foveation_vulkan" => enabled.foveation_vulkan = true,
            known => unreachable!("{known} is in one of the tables"),
        }
    }
    Ok(enabled)
}

fn check_application(info: &xr::ApplicationInfo) -> CallResult<()> {
    if ffi::fixed_text(&info.application_name, "applicationName")?.is_empty() {
        return Err(Fault::application(xr::Result::ERROR_NAME_INVALID, "applicationName is empty"));
    }
    let version = info.api_version;
    if (version.major(), version.minor()) != (1, 0) {
        let message = format!("the application asks for OpenXR {version}; the mock runtime has 1.0");
        return Err(Fault::application(xr::Result::ERROR_API_VERSION_UNSUPPORTED, message));
    }
    Ok(())
}

/// All extensions of this run, and those of them that are hidden. A configuration that cannot be read changes none:
/// `xrCreateInstance` says what is wrong with it.
fn extensions() -> (Vec<(&'static [u8], u32)>, Vec<String>) {
    let config = MockConfig::from_environment(std::env::var_os(CONFIG_VARIABLE)).unwrap_or_default();
    let foveation = if config.foveation { &FOVEATION_EXTENSIONS[..] } else { &[] };
    (EXTENSIONS.iter().chain(foveation).copied().collect(), config.hidden_extensions)
}

fn load_configuration() -> Result<(MockConfig, HeadPath), ConfigError> {
    let variable = std::env::var_os(CONFIG_VARIABLE);
    let path = PathBuf::from(variable.clone().unwrap_or_default());
    let config = MockConfig::from_environment(variable)?;
    let head_path = config.load_head_path(&path)?;
    Ok((config, head_path))
}

fn new_core(
    runtime: &mut Runtime,
    extensions: Extensions,
    config: MockConfig,
    head_path: HeadPath,
) -> CallResult<Core> {
    let resume = runtime.resume.take().filter(|resume| resume.config == config);
    let open = |dir: &PathBuf| {
        Recorder::open(dir, resume.is_some()).map_err(|error| {
            let message = format!(
                "cannot write into the capture folder {}: {error}; correct \"capture_dir\"",
                dir.display()
            );
            Fault::runtime(xr::Result::ERROR_INITIALIZATION_FAILED, message)
        })
    };
    let recorder = config.capture_dir.as_ref().map(open).transpose()?;
    let (timeline, tally) = resume.map(|resume| (resume.timeline, resume.tally)).unwrap_or_default();
    Ok(Core {
        handle: runtime.new_handle(),
        extensions,
        config,
        head_path,
        timeline,
        tally,
        recorder,
        events: Default::default(),
        path_from_stage: Vec::new(),
        paths: Default::default(),
        actions: Default::default(),
        messengers: Vec::new(),
        object_names: ObjectNames::default(),
        vulkan: None,
        requirements_asked: false,
        loss_time_ns: None,
        lost: false,
        lost_session: false,
    })
}

entry! {
    destroy_instance: DestroyInstance = "xrDestroyInstance"(instance: value xr::Instance) {
        let mut runtime = runtime::lock();
        runtime.instance_even_lost(instance)?;
        let Some(InstanceState { core, session }) = runtime.instance.take() else {
            return Err(Fault::handle("instance"));
        };
        let loses = core.loss_time_ns.is_some() || core.lost_session || session.as_ref().is_some_and(Session::loses);
        session::close(session);
        core.write_summary();
        if loses {
            runtime.resume = Some(Resume { config: core.config, timeline: core.timeline, tally: core.tally });
        }
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    get_instance_properties: GetInstanceProperties = "xrGetInstanceProperties"(
        instance: value xr::Instance,
        properties: output xr::InstanceProperties,
    ) {
        runtime::lock().core(instance)?;
        let [major, minor, patch] = ["MAJOR", "MINOR", "PATCH"].map(version_part);
        properties.runtime_version = xr::Version::new(major, minor, u32::from(patch));
        ffi::place_text(&mut properties.runtime_name, NAME);
        Ok(xr::Result::SUCCESS)
    }
}

/// A part of the crate's version.
fn version_part(part: &str) -> u16 {
    let text = match part {
        "MAJOR" => env!("CARGO_PKG_VERSION_MAJOR"),
        "MINOR" => env!("CARGO_PKG_VERSION_MINOR"),
        _ => env!("CARGO_PKG_VERSION_PATCH"),
    };
    text.parse().unwrap_or(0)
}

entry! {
    poll_event: PollEvent = "xrPollEvent"(
        instance: value xr::Instance,
        event_data: slot xr::EventDataBuffer,
    ) {
        let mut runtime = runtime::lock();
        runtime.core(instance)?;
        let InstanceState { core, session } = runtime.instance_even_lost(instance)?;
        if let (true, Some(session)) = (core.events.is_empty(), session) {
            session::rest(core, session);
        }
        let Some(event) = core.events.pop_front() else {
            return Ok(xr::Result::EVENT_UNAVAILABLE);
        };
        write_event(event_data, event);
        Ok(xr::Result::SUCCESS)
    }
}

fn write_event(buffer: &mut xr::EventDataBuffer, event: Event) {
    let buffer: *mut xr::EventDataBuffer = buffer;
    match event {
        Event::SessionState { session, state, time_ns } => {
            let data = xr::EventDataSessionStateChanged {
                ty: xr::EventDataSessionStateChanged::TYPE,
                next: std::ptr::null(),
                session: xr::Session::from_raw(session),
                state,
                time: xr::Time::from_nanos(time_ns),
            };
            // SAFETY: an event buffer is larger than any event, and aligned as all of them (OpenXR, XrEventDataBuffer).
            unsafe { buffer.cast::<xr::EventDataSessionStateChanged>().write(data) };
        }
        Event::InstanceLossPending { loss_time_ns } => {
            let data = xr::EventDataInstanceLossPending {
                ty: xr::EventDataInstanceLossPending::TYPE,
                next: std::ptr::null(),
                loss_time: xr::Time::from_nanos(loss_time_ns),
            };
            // SAFETY: as above.
            unsafe { buffer.cast::<xr::EventDataInstanceLossPending>().write(data) };
        }
        Event::RefreshRate { from_hz, to_hz } => {
            let data = xr::EventDataDisplayRefreshRateChangedFB {
                ty: xr::EventDataDisplayRefreshRateChangedFB::TYPE,
                next: std::ptr::null(),
                from_display_refresh_rate: from_hz,
                to_display_refresh_rate: to_hz,
            };
            // SAFETY: as above.
            unsafe { buffer.cast::<xr::EventDataDisplayRefreshRateChangedFB>().write(data) };
        }
        Event::InteractionProfile { session } => {
            let data = xr::EventDataInteractionProfileChanged {
                ty: xr::EventDataInteractionProfileChanged::TYPE,
                next: std::ptr::null(),
                session: xr::Session::from_raw(session),
            };
            // SAFETY: as above.
            unsafe { buffer.cast::<xr::EventDataInteractionProfileChanged>().write(data) };
        }
        Event::SpaceChange { session, space, change_time_ns, previous_from_new } => {
            let data = xr::EventDataReferenceSpaceChangePending {
                ty: xr::EventDataReferenceSpaceChangePending::TYPE,
                next: std::ptr::null(),
                session: xr::Session::from_raw(session),
                reference_space_type: space,
                change_time: xr::Time::from_nanos(change_time_ns),
                pose_valid: xr::TRUE,
                pose_in_previous_space: pose_to_xr(previous_from_new),
            };
            // SAFETY: as above.
            unsafe { buffer.cast::<xr::EventDataReferenceSpaceChangePending>().write(data) };
        }
    }
}

entry! {
    result_to_string: ResultToString = "xrResultToString"(
        instance: value xr::Instance,
        value: value xr::Result,
        buffer: raw_out c_char,
    ) {
        runtime::lock().core(instance)?;
        place_in_buffer(buffer, &names::result(value))
    }
}

entry! {
    structure_type_to_string: StructureTypeToString = "xrStructureTypeToString"(
        instance: value xr::Instance,
        value: value xr::StructureType,
        buffer: raw_out c_char,
    ) {
        runtime::lock().core(instance)?;
        place_in_buffer(buffer, &names::structure(value))
    }
}

/// Writes into one of the two buffers of 64 characters that a caller provides without saying their size.
fn place_in_buffer(buffer: *mut c_char, text: &str) -> CallResult {
    const { assert!(xr::MAX_RESULT_STRING_SIZE == 64 && xr::MAX_STRUCTURE_NAME_SIZE == 64) };
    // SAFETY: the specification makes the caller's buffer 64 characters long (XR_MAX_RESULT_STRING_SIZE).
    let buffer = unsafe { ffi::slot(buffer.cast::<[c_char; 64]>(), "buffer") }?;
    ffi::place_text(buffer, text);
    Ok(xr::Result::SUCCESS)
}

/// Refuses any system but the one.
pub(crate) fn check_system(system: xr::SystemId) -> CallResult<()> {
    match system.into_raw() {
        SYSTEM => Ok(()),
        other => {
            let message = format!("system {other} was not given by xrGetSystem");
            Err(Fault::application(xr::Result::ERROR_SYSTEM_INVALID, message))
        }
    }
}

/// Refuses any view configuration but stereo.
pub(crate) fn check_view_configuration(ty: xr::ViewConfigurationType) -> CallResult<()> {
    if ty == STEREO {
        return Ok(());
    }
    let message = format!("view configuration {ty:?} is not there; the mock runtime has PRIMARY_STEREO");
    Err(Fault::application(xr::Result::ERROR_VIEW_CONFIGURATION_TYPE_UNSUPPORTED, message))
}

entry! {
    get_system: GetSystem = "xrGetSystem"(
        instance: value xr::Instance,
        get_info: input xr::SystemGetInfo,
        system_id: slot xr::SystemId,
    ) {
        runtime::lock().core(instance)?;
        if get_info.form_factor != xr::FormFactor::HEAD_MOUNTED_DISPLAY {
            let message = format!("form factor {:?}: the mock runtime is a headset", get_info.form_factor);
            return Err(Fault::application(xr::Result::ERROR_FORM_FACTOR_UNSUPPORTED, message));
        }
        *system_id = xr::SystemId::from_raw(SYSTEM);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    get_system_properties: GetSystemProperties = "xrGetSystemProperties"(
        instance: value xr::Instance,
        system_id: value xr::SystemId,
        properties: output xr::SystemProperties,
    ) {
        runtime::lock().core(instance)?;
        check_system(system_id)?;
        properties.system_id = system_id;
        properties.vendor_id = 0;
        ffi::place_text(&mut properties.system_name, NAME);
        properties.graphics_properties = xr::SystemGraphicsProperties {
            max_swapchain_image_height: MAX_EXTENT_PIXELS,
            max_swapchain_image_width: MAX_EXTENT_PIXELS,
            max_layer_count: MAX_LAYERS,
        };
        properties.tracking_properties =
            xr::SystemTrackingProperties { orientation_tracking: xr::TRUE, position_tracking: xr::TRUE };
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    enumerate_view_configurations: EnumerateViewConfigurations = "xrEnumerateViewConfigurations"(
        instance: value xr::Instance,
        system_id: value xr::SystemId,
        capacity: value u32,
        count: raw_out u32,
        types: raw_out xr::ViewConfigurationType,
    ) {
        runtime::lock().core(instance)?;
        check_system(system_id)?;
        // SAFETY: count and types are the caller's, of the capacity it says.
        unsafe { ffi::enumerate((capacity, count, types), &[STEREO], |slot, ty| *slot = *ty) }
    }
}

entry! {
    enumerate_environment_blend_modes: EnumerateEnvironmentBlendModes = "xrEnumerateEnvironmentBlendModes"(
        instance: value xr::Instance,
        system_id: value xr::SystemId,
        view_configuration: value xr::ViewConfigurationType,
        capacity: value u32,
        count: raw_out u32,
        modes: raw_out xr::EnvironmentBlendMode,
    ) {
        runtime::lock().core(instance)?;
        check_system(system_id)?;
        check_view_configuration(view_configuration)?;
        let supported = [xr::EnvironmentBlendMode::OPAQUE];
        // SAFETY: count and modes are the caller's, of the capacity it says.
        unsafe { ffi::enumerate((capacity, count, modes), &supported, |slot, mode| *slot = *mode) }
    }
}

entry! {
    get_view_configuration_properties: GetViewConfigurationProperties = "xrGetViewConfigurationProperties"(
        instance: value xr::Instance,
        system_id: value xr::SystemId,
        view_configuration: value xr::ViewConfigurationType,
        properties: output xr::ViewConfigurationProperties,
    ) {
        runtime::lock().core(instance)?;
        check_system(system_id)?;
        check_view_configuration(view_configuration)?;
        properties.view_configuration_type = view_configuration;
        properties.fov_mutable = xr::FALSE;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    enumerate_view_configuration_views: EnumerateViewConfigurationViews = "xrEnumerateViewConfigurationViews"(
        instance: value xr::Instance,
        system_id: value xr::SystemId,
        view_configuration: value xr::ViewConfigurationType,
        capacity: value u32,
        count: raw_out u32,
        views: raw_out xr::ViewConfigurationView,
    ) {
        let extent = runtime::lock().core(instance)?.config.extent_pixels;
        check_system(system_id)?;
        check_view_configuration(view_configuration)?;
        // SAFETY: count and views are the caller's, of the capacity it says.
        unsafe {
            ffi::enumerate_structures((capacity, count, views), "views", &[extent; 2], |view, [width, height]| {
                view.recommended_image_rect_width = *width;
                view.recommended_image_rect_height = *height;
                view.max_image_rect_width = MAX_EXTENT_PIXELS;
                view.max_image_rect_height = MAX_EXTENT_PIXELS;
                view.recommended_swapchain_sample_count = 1;
                view.max_swapchain_sample_count = 1;
            })
        }
    }
}

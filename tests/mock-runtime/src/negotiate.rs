//! The loader's entry: the one exported symbol, and the table of functions behind it.

use std::ffi::c_char;

use openxr_sys as xr;
use xr::Handle as _;
use xr::pfn::VoidFunction;

use crate::fault::{Fault, guard};
use crate::ffi::entry;
use crate::runtime::{self, Extensions};
use crate::{
    actions, debug_utils, foveation, frame, instance, paths, performance, refresh_rate, session, space,
    swapchain, time, vulkan,
};

/// The loader-runtime interface that this runtime speaks.
const INTERFACE_VERSION: u32 = 1;

/// The API version that the runtime implements. Loader 1.0.20 refuses anything above 1.0.
const API_VERSION: xr::Version = xr::Version::new(1, 0, 34);

/// The one symbol that the library exports: the loader calls it to get `xrGetInstanceProcAddr`.
///
/// # Safety
/// Only for the OpenXR loader: both pointers are null or valid for the structures that their headers describe.
#[unsafe(no_mangle)]
pub unsafe extern "system" fn xrNegotiateLoaderRuntimeInterface(
    loader_info: *const xr::NegotiateLoaderInfo,
    runtime_request: *mut xr::NegotiateRuntimeRequest,
) -> xr::Result {
    guard("xrNegotiateLoaderRuntimeInterface", || {
        // SAFETY: by this function's own contract.
        let (info, request) = unsafe { (loader_info.as_ref(), runtime_request.as_mut()) };
        let (Some(info), Some(request)) = (info, request) else {
            return Err(Fault::runtime(xr::Result::ERROR_INITIALIZATION_FAILED, "the loader passed null"));
        };
        if !understood(info, request) {
            let message = format!(
                "the loader speaks interfaces {} to {} and OpenXR {} to {}; the mock runtime has interface \
                 {INTERFACE_VERSION} and OpenXR {API_VERSION}",
                info.min_interface_version,
                info.max_interface_version,
                info.min_api_version,
                info.max_api_version
            );
            return Err(Fault::runtime(xr::Result::ERROR_INITIALIZATION_FAILED, message));
        }
        stay_loaded();
        request.runtime_interface_version = INTERFACE_VERSION;
        request.runtime_api_version = API_VERSION;
        request.get_instance_proc_addr = Some(get_instance_proc_addr);
        Ok(xr::Result::SUCCESS)
    })
}

fn understood(info: &xr::NegotiateLoaderInfo, request: &xr::NegotiateRuntimeRequest) -> bool {
    let info_ok = info.struct_type == xr::NegotiateLoaderInfo::TYPE
        && info.struct_version == xr::NegotiateLoaderInfo::VERSION
        && info.struct_size == size_of::<xr::NegotiateLoaderInfo>();
    let request_ok = request.struct_type == xr::NegotiateRuntimeRequest::TYPE
        && request.struct_version == xr::NegotiateRuntimeRequest::VERSION
        && request.struct_size == size_of::<xr::NegotiateRuntimeRequest>();
    let api = |version: xr::Version| (version.major(), version.minor());
    let api_ok = (api(info.min_api_version)..=api(info.max_api_version)).contains(&api(API_VERSION));
    let interface_ok = (info.min_interface_version..=info.max_interface_version).contains(&INTERFACE_VERSION);
    info_ok && request_ok && api_ok && interface_ok
}

/// Keeps the library in the process: the loader closes it with each instance, but what outlives a lost instance lives
/// in its memory, and threads may still be on their way out of it.
#[cfg(unix)]
fn stay_loaded() {
    // SAFETY: Dl_info is a structure of pointers, for which zeroes are valid.
    let mut found: libc::Dl_info = unsafe { std::mem::zeroed() };
    let here: extern "C" fn() = anchor;
    // SAFETY: `here` is an address in this library, and `found` is valid for a write.
    let known = unsafe { libc::dladdr(here as *const std::ffi::c_void, &mut found) } != 0;
    if known && !found.dli_fname.is_null() {
        // SAFETY: dladdr gave a zero-terminated name. RTLD_NOLOAD opens nothing new, and NODELETE pins what is there.
        unsafe { libc::dlopen(found.dli_fname, libc::RTLD_NOW | libc::RTLD_NOLOAD | libc::RTLD_NODELETE) };
    }
}

/// The same.
#[cfg(windows)]
fn stay_loaded() {
    use windows_sys::Win32::System::LibraryLoader::{
        GET_MODULE_HANDLE_EX_FLAG_FROM_ADDRESS, GET_MODULE_HANDLE_EX_FLAG_PIN, GetModuleHandleExW,
    };
    let (here, mut module): (extern "C" fn(), _) = (anchor, std::ptr::null_mut());
    let flags = GET_MODULE_HANDLE_EX_FLAG_FROM_ADDRESS | GET_MODULE_HANDLE_EX_FLAG_PIN;
    // SAFETY: `here` is an address in this library, which is what the flag has the name be; `module` is valid for a write.
    unsafe { GetModuleHandleExW(flags, here as *const u16, &mut module) };
}

/// An address in this library.
extern "C" fn anchor() {}

entry! {
    get_instance_proc_addr: GetInstanceProcAddr = "xrGetInstanceProcAddr"(
        instance: value xr::Instance,
        name: text c_char,
        function: slot Option<VoidFunction>,
    ) {
        *function = None;
        let found = lookup(name);
        if instance == xr::Instance::NULL {
            let (needed, pointer) = found.unwrap_or((Needs::Instance, None));
            if needed != Needs::Nothing {
                // The loader and applications probe; that is not a mistake.
                return Err(Fault::quiet(xr::Result::ERROR_HANDLE_INVALID));
            }
            *function = pointer;
            return Ok(xr::Result::SUCCESS);
        }
        let extensions = runtime::lock().instance_even_lost(instance)?.core.extensions;
        match found.filter(|(needed, _)| needed.is_enabled(&extensions)) {
            Some((_, pointer)) => {
                *function = pointer;
                Ok(xr::Result::SUCCESS)
            }
            None => Err(Fault::quiet(xr::Result::ERROR_FUNCTION_UNSUPPORTED)),
        }
    }
}

/// What must be there for a function to be given out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Needs {
    Nothing,
    Instance,
    VulkanEnable2,
    ConvertTime,
    RefreshRate,
    Performance,
    DebugUtils,
    Foveation,
    SwapchainUpdateState,
}

impl Needs {
    fn is_enabled(self, extensions: &Extensions) -> bool {
        match self {
            Self::Nothing | Self::Instance => true,
            Self::VulkanEnable2 => extensions.vulkan_enable2,
            Self::ConvertTime => extensions.convert_time,
            Self::RefreshRate => extensions.refresh_rate,
            Self::Performance => extensions.performance,
            Self::DebugUtils => extensions.debug_utils,
            Self::Foveation => extensions.foveation,
            Self::SwapchainUpdateState => extensions.swapchain_update_state,
        }
    }
}

/// A row of the table: the function's name, what it needs, its address.
type Row = (&'static str, Needs, fn() -> VoidFunction);

/// Makes rows. Each function has the type that the registry gives to its name: `entry!` checks that.
macro_rules! table {
    ($($needs:ident { $($name:literal => $function:path: $pfn:ident),* $(,)? })*) => {
        &[$($(($name, Needs::$needs, || {
            let function: xr::pfn::$pfn = $function;
            // SAFETY: function pointers have one size, and the caller casts back to the type of the name.
            unsafe { std::mem::transmute::<xr::pfn::$pfn, VoidFunction>(function) }
        })),*),*]
    };
}

const TABLE: &[Row] = table! {
    Nothing {
        "xrCreateInstance" => instance::create_instance: CreateInstance,
        "xrEnumerateApiLayerProperties" => instance::enumerate_api_layer_properties: EnumerateApiLayerProperties,
        "xrEnumerateInstanceExtensionProperties" =>
            instance::enumerate_instance_extension_properties: EnumerateInstanceExtensionProperties,
        "xrGetInstanceProcAddr" => get_instance_proc_addr: GetInstanceProcAddr,
    }
    Instance {
        "xrAcquireSwapchainImage" => swapchain::acquire_swapchain_image: AcquireSwapchainImage,
        "xrApplyHapticFeedback" => actions::apply_haptic_feedback: ApplyHapticFeedback,
        "xrAttachSessionActionSets" => actions::attach_action_sets: AttachSessionActionSets,
        "xrBeginFrame" => frame::begin_frame: BeginFrame,
        "xrBeginSession" => session::begin_session: BeginSession,
        "xrCreateAction" => actions::create_action: CreateAction,
        "xrCreateActionSet" => actions::create_action_set: CreateActionSet,
        "xrCreateActionSpace" => space::create_action_space: CreateActionSpace,
        "xrCreateReferenceSpace" => space::create_reference_space: CreateReferenceSpace,
        "xrCreateSession" => session::create_session: CreateSession,
        "xrCreateSwapchain" => swapchain::create_swapchain: CreateSwapchain,
        "xrDestroyAction" => actions::destroy_action: DestroyAction,
        "xrDestroyActionSet" => actions::destroy_action_set: DestroyActionSet,
        "xrDestroyInstance" => instance::destroy_instance: DestroyInstance,
        "xrDestroySession" => session::destroy_session: DestroySession,
        "xrDestroySpace" => space::destroy_space: DestroySpace,
        "xrDestroySwapchain" => swapchain::destroy_swapchain: DestroySwapchain,
        "xrEndFrame" => frame::end_frame: EndFrame,
        "xrEndSession" => session::end_session: EndSession,
        "xrEnumerateBoundSourcesForAction" => actions::enumerate_bound_sources: EnumerateBoundSourcesForAction,
        "xrEnumerateEnvironmentBlendModes" =>
            instance::enumerate_environment_blend_modes: EnumerateEnvironmentBlendModes,
        "xrEnumerateReferenceSpaces" => space::enumerate_reference_spaces: EnumerateReferenceSpaces,
        "xrEnumerateSwapchainFormats" => swapchain::enumerate_swapchain_formats: EnumerateSwapchainFormats,
        "xrEnumerateSwapchainImages" => swapchain::enumerate_swapchain_images: EnumerateSwapchainImages,
        "xrEnumerateViewConfigurationViews" =>
            instance::enumerate_view_configuration_views: EnumerateViewConfigurationViews,
        "xrEnumerateViewConfigurations" => instance::enumerate_view_configurations: EnumerateViewConfigurations,
        "xrGetActionStateBoolean" => actions::get_action_state_boolean: GetActionStateBoolean,
        "xrGetActionStateFloat" => actions::get_action_state_float: GetActionStateFloat,
        "xrGetActionStatePose" => actions::get_action_state_pose: GetActionStatePose,
        "xrGetActionStateVector2f" => actions::get_action_state_vector2f: GetActionStateVector2f,
        "xrGetCurrentInteractionProfile" =>
            actions::get_current_interaction_profile: GetCurrentInteractionProfile,
        "xrGetInputSourceLocalizedName" => actions::get_input_source_localized_name: GetInputSourceLocalizedName,
        "xrGetInstanceProperties" => instance::get_instance_properties: GetInstanceProperties,
        "xrGetReferenceSpaceBoundsRect" => space::get_reference_space_bounds_rect: GetReferenceSpaceBoundsRect,
        "xrGetSystem" => instance::get_system: GetSystem,
        "xrGetSystemProperties" => instance::get_system_properties: GetSystemProperties,
        "xrGetViewConfigurationProperties" =>
            instance::get_view_configuration_properties: GetViewConfigurationProperties,
        "xrLocateSpace" => space::locate_space: LocateSpace,
        "xrLocateViews" => space::locate_views: LocateViews,
        "xrPathToString" => paths::path_to_string: PathToString,
        "xrPollEvent" => instance::poll_event: PollEvent,
        "xrReleaseSwapchainImage" => swapchain::release_swapchain_image: ReleaseSwapchainImage,
        "xrRequestExitSession" => session::request_exit_session: RequestExitSession,
        "xrResultToString" => instance::result_to_string: ResultToString,
        "xrStopHapticFeedback" => actions::stop_haptic_feedback: StopHapticFeedback,
        "xrStringToPath" => paths::string_to_path: StringToPath,
        "xrStructureTypeToString" => instance::structure_type_to_string: StructureTypeToString,
        "xrSuggestInteractionProfileBindings" => actions::suggest_bindings: SuggestInteractionProfileBindings,
        "xrSyncActions" => actions::sync_actions: SyncActions,
        "xrWaitFrame" => frame::wait_frame: WaitFrame,
        "xrWaitSwapchainImage" => swapchain::wait_swapchain_image: WaitSwapchainImage,
    }
    VulkanEnable2 {
        "xrCreateVulkanDeviceKHR" => vulkan::create_vulkan_device: CreateVulkanDeviceKHR,
        "xrCreateVulkanInstanceKHR" => vulkan::create_vulkan_instance: CreateVulkanInstanceKHR,
        "xrGetVulkanGraphicsDevice2KHR" => vulkan::get_graphics_device: GetVulkanGraphicsDevice2KHR,
        "xrGetVulkanGraphicsRequirements2KHR" => vulkan::get_requirements: GetVulkanGraphicsRequirementsKHR,
    }
    RefreshRate {
        "xrEnumerateDisplayRefreshRatesFB" => refresh_rate::enumerate_refresh_rates: EnumerateDisplayRefreshRatesFB,
        "xrGetDisplayRefreshRateFB" => refresh_rate::get_refresh_rate: GetDisplayRefreshRateFB,
        "xrRequestDisplayRefreshRateFB" => refresh_rate::request_refresh_rate: RequestDisplayRefreshRateFB,
    }
    Performance {
        "xrPerfSettingsSetPerformanceLevelEXT" =>
            performance::set_performance_level: PerfSettingsSetPerformanceLevelEXT,
    }
    DebugUtils {
        "xrCreateDebugUtilsMessengerEXT" => debug_utils::create_messenger: CreateDebugUtilsMessengerEXT,
        "xrDestroyDebugUtilsMessengerEXT" => debug_utils::destroy_messenger: DestroyDebugUtilsMessengerEXT,
        "xrSessionBeginDebugUtilsLabelRegionEXT" =>
            debug_utils::begin_label_region: SessionBeginDebugUtilsLabelRegionEXT,
        "xrSessionEndDebugUtilsLabelRegionEXT" => debug_utils::end_label_region: SessionEndDebugUtilsLabelRegionEXT,
        "xrSessionInsertDebugUtilsLabelEXT" => debug_utils::insert_label: SessionInsertDebugUtilsLabelEXT,
        "xrSetDebugUtilsObjectNameEXT" => debug_utils::set_object_name: SetDebugUtilsObjectNameEXT,
        "xrSubmitDebugUtilsMessageEXT" => debug_utils::submit_message: SubmitDebugUtilsMessageEXT,
    }
    Foveation {
        "xrCreateFoveationProfileFB" => foveation::create_profile: CreateFoveationProfileFB,
        "xrDestroyFoveationProfileFB" => foveation::destroy_profile: DestroyFoveationProfileFB,
    }
    SwapchainUpdateState {
        "xrGetSwapchainStateFB" => foveation::get_swapchain_state: GetSwapchainStateFB,
        "xrUpdateSwapchainFB" => foveation::update_swapchain: UpdateSwapchainFB,
    }
};

#[cfg(unix)]
const TIME_TABLE: &[Row] = table! {
    ConvertTime {
        "xrConvertTimeToTimespecTimeKHR" => time::convert_time_to_timespec_time: ConvertTimeToTimespecTimeKHR,
        "xrConvertTimespecTimeToTimeKHR" => time::convert_timespec_time_to_time: ConvertTimespecTimeToTimeKHR,
    }
};

#[cfg(windows)]
const TIME_TABLE: &[Row] = table! {
    ConvertTime {
        "xrConvertTimeToWin32PerformanceCounterKHR" =>
            time::convert_time_to_counter: ConvertTimeToWin32PerformanceCounterKHR,
        "xrConvertWin32PerformanceCounterToTimeKHR" =>
            time::convert_counter_to_time: ConvertWin32PerformanceCounterToTimeKHR,
    }
};

fn lookup(name: &str) -> Option<(Needs, Option<VoidFunction>)> {
    let row = TABLE.iter().chain(TIME_TABLE).find(|(known, ..)| *known == name)?;
    Some((row.1, Some(row.2())))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The functions of OpenXR 1.0's core, from its registry.
    const CORE: &str = "xrAcquireSwapchainImage xrApplyHapticFeedback xrAttachSessionActionSets xrBeginFrame \
        xrBeginSession xrCreateAction xrCreateActionSet xrCreateActionSpace xrCreateInstance xrCreateReferenceSpace \
        xrCreateSession xrCreateSwapchain xrDestroyAction xrDestroyActionSet xrDestroyInstance xrDestroySession \
        xrDestroySpace xrDestroySwapchain xrEndFrame xrEndSession xrEnumerateApiLayerProperties \
        xrEnumerateBoundSourcesForAction xrEnumerateEnvironmentBlendModes xrEnumerateInstanceExtensionProperties \
        xrEnumerateReferenceSpaces xrEnumerateSwapchainFormats xrEnumerateSwapchainImages \
        xrEnumerateViewConfigurationViews xrEnumerateViewConfigurations xrGetActionStateBoolean \
        xrGetActionStateFloat xrGetActionStatePose xrGetActionStateVector2f xrGetCurrentInteractionProfile \
        xrGetInputSourceLocalizedName xrGetInstanceProcAddr xrGetInstanceProperties xrGetReferenceSpaceBoundsRect \
        xrGetSystem xrGetSystemProperties xrGetViewConfigurationProperties xrLocateSpace xrLocateViews \
        xrPathToString xrPollEvent xrReleaseSwapchainImage xrRequestExitSession xrResultToString \
        xrStopHapticFeedback xrStringToPath xrStructureTypeToString xrSuggestInteractionProfileBindings \
        xrSyncActions xrWaitFrame xrWaitSwapchainImage";

    #[test]
    fn every_core_function_is_there_and_no_name_is_there_twice() {
        for name in CORE.split_whitespace() {
            assert_eq!(TABLE.iter().filter(|(known, ..)| *known == name).count(), 1, "{name}");
        }
        let core_rows =
            TABLE.iter().filter(|(_, needs, _)| matches!(needs, Needs::Nothing | Needs::Instance));
        assert_eq!(core_rows.count(), CORE.split_whitespace().count());
    }

    #[test]
    fn functions_of_extensions_need_their_extension() {
        let (needs, _) = lookup("xrCreateVulkanInstanceKHR").expect("known");
        assert!(!needs.is_enabled(&Extensions::default()));
        assert!(needs.is_enabled(&Extensions { vulkan_enable2: true, ..Extensions::default() }));
    }
}

//! Fixed foveation, if configured: `XR_FB_foveation`, `XR_FB_foveation_configuration`, `XR_FB_swapchain_update_state` and
//! `XR_FB_foveation_vulkan`. The application's requests are checked and recorded. Density maps are plain images without
//! content, so calls can be checked on devices without such maps; a pass cannot use them.

use crate::fault::{CallResult, Fault};
use crate::ffi::{self, entry};
use crate::runtime::{self, Extensions};
use crate::swapchain::swapchain_of;
use ash::vk;
use openxr_sys as xr;
use xr::Handle as _;

/// Pixels of an image across a texel of its density map: the most that Vulkan allows a device to want is 128.
const PIXELS_PER_TEXEL: u32 = 32;

/// Their format: the share of fragments across and along.
pub(crate) const FORMAT: vk::Format = vk::Format::R8G8_UNORM;

/// Width and height of the density map of an image.
pub(crate) fn map_extent(extent_pixels: [u32; 2]) -> [u32; 2] {
    extent_pixels.map(|side| side.div_ceil(PIXELS_PER_TEXEL))
}

const LEVELS: [xr::FoveationLevelFB; 4] = [
    xr::FoveationLevelFB::NONE,
    xr::FoveationLevelFB::LOW,
    xr::FoveationLevelFB::MEDIUM,
    xr::FoveationLevelFB::HIGH,
];

fn refused<T>(message: impl Into<String>) -> CallResult<T> {
    Err(Fault::application(xr::Result::ERROR_VALIDATION_FAILURE, message))
}

/// The level of a profile's creation; none without one, or without the extension that has levels.
fn level(info: &xr::FoveationProfileCreateInfoFB, extensions: Extensions) -> CallResult<i32> {
    // SAFETY: the chain is the application's, of valid structures.
    let level = unsafe { ffi::chained_input::<xr::FoveationLevelProfileCreateInfoFB>(info.next) };
    let Some(level) = level.filter(|_| extensions.foveation_configuration) else {
        return Ok(xr::FoveationLevelFB::NONE.into_raw());
    };
    if !LEVELS.contains(&level.level) {
        return refused(format!("there is no level {:?}", level.level));
    }
    let dynamic = [xr::FoveationDynamicFB::DISABLED, xr::FoveationDynamicFB::LEVEL_ENABLED];
    if !dynamic.contains(&level.dynamic) || !level.vertical_offset.is_finite() {
        return refused(format!("neither {:?} nor {} degrees", level.dynamic, level.vertical_offset));
    }
    Ok(level.level.into_raw())
}

entry! {
    create_profile: CreateFoveationProfileFB = "xrCreateFoveationProfileFB"(
        session: value xr::Session,
        create_info: input xr::FoveationProfileCreateInfoFB,
        profile: slot xr::FoveationProfileFB,
    ) {
        let mut runtime = runtime::lock();
        let handle = runtime.new_handle();
        let (core, session) = runtime.session(session)?;
        session.foveation_profiles.insert(handle, level(create_info, core.extensions)?);
        *profile = xr::FoveationProfileFB::from_raw(handle);
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    destroy_profile: DestroyFoveationProfileFB = "xrDestroyFoveationProfileFB"(profile: value xr::FoveationProfileFB) {
        let mut runtime = runtime::lock();
        let session = runtime.instance.as_mut().and_then(|instance| instance.session.as_mut());
        let session = session.ok_or_else(|| Fault::handle("foveation profile"))?;
        let removed = session.foveation_profiles.remove(&profile.into_raw());
        removed.map(|_| xr::Result::SUCCESS).ok_or_else(|| Fault::handle("foveation profile"))
    }
}

entry! {
    update_swapchain: UpdateSwapchainFB = "xrUpdateSwapchainFB"(
        swapchain: value xr::Swapchain,
        state: raw_in xr::SwapchainStateBaseHeaderFB,
    ) {
        // SAFETY: null or a structure that says what it is; of those that there are only this one is known here.
        let state = unsafe { ffi::input(state.cast::<xr::SwapchainStateFoveationFB>(), "state") }?;
        let mut runtime = runtime::lock();
        let (core, session) = runtime.session_of_swapchain(swapchain)?;
        let profile = state.profile.into_raw();
        let level = *session.foveation_profiles.get(&profile).ok_or_else(|| Fault::handle("foveation profile"))?;
        let swapchain = swapchain_of(session, swapchain)?.0;
        if !swapchain.has_density_maps() {
            return refused("the swapchain was not made with density maps (XrSwapchainCreateInfoFoveationFB)");
        }
        if state.flags != xr::SwapchainStateFoveationFlagsFB::EMPTY {
            return refused("flags must be 0");
        }
        swapchain.foveation_profile = profile;
        core.tally.foveation_level = level;
        Ok(xr::Result::SUCCESS)
    }
}

entry! {
    get_swapchain_state: GetSwapchainStateFB = "xrGetSwapchainStateFB"(
        swapchain: value xr::Swapchain,
        state: raw_out xr::SwapchainStateBaseHeaderFB,
    ) {
        // SAFETY: as for `update_swapchain`.
        let state = unsafe { ffi::output(state.cast::<xr::SwapchainStateFoveationFB>(), "state") }?;
        let mut runtime = runtime::lock();
        let (_, session) = runtime.session_of_swapchain(swapchain)?;
        state.flags = xr::SwapchainStateFoveationFlagsFB::EMPTY;
        let given = swapchain_of(session, swapchain)?.0.foveation_profile;
        // What the profile asked for goes on, and its handle is nobody's any more.
        let is_there = session.foveation_profiles.contains_key(&given);
        state.profile = xr::FoveationProfileFB::from_raw(if is_there { given } else { 0 });
        Ok(xr::Result::SUCCESS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_covers_its_image() {
        assert_eq!(map_extent([1832, 1920]), [58, 60]);
        assert_eq!(map_extent([1, 32]), [1, 1]);
    }
}

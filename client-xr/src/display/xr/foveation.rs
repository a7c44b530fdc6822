//! Fixed foveation: fewer fragments are shaded near the border of the lenses. The runtime makes density maps for the images of
//! both eyes (`XR_FB_foveation` and its companions); the device reads them (`VK_EXT_fragment_density_map`).

use super::error::{Doing, XrError};
use super::succeeded;
use ash::vk;
use ash::vk::Handle as _;
use openxr::sys;
use openxr::sys::Handle as _;
use std::ptr;

/// How much less is shaded towards the border.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Foveation {
    /// All is shaded.
    None,
    /// A little less: hardly seen.
    #[default]
    Low,
    /// Less.
    Medium,
    /// Much less: seen where a lens is sharp to its border.
    High,
}

impl Foveation {
    fn level(self) -> sys::FoveationLevelFB {
        match self {
            Self::None => sys::FoveationLevelFB::NONE,
            Self::Low => sys::FoveationLevelFB::LOW,
            Self::Medium => sys::FoveationLevelFB::MEDIUM,
            Self::High => sys::FoveationLevelFB::HIGH,
        }
    }
}

/// Density maps, one for each image of a swapchain.
pub(super) struct Maps {
    pub(super) images: Vec<vk::Image>,
    pub(super) extent_texels: [u32; 2],
}

/// Asks for what it takes, where a runtime has all of it. Whether it has.
pub(super) fn want(
    wanted: &mut openxr::ExtensionSet,
    available: &openxr::ExtensionSet,
    foveation: Foveation,
) -> bool {
    let has_all = available.fb_foveation
        && available.fb_foveation_configuration
        && available.fb_swapchain_update_state
        && available.fb_foveation_vulkan;
    let is_wanted = has_all && foveation != Foveation::None;
    wanted.fb_foveation |= is_wanted;
    wanted.fb_foveation_configuration |= is_wanted;
    wanted.fb_swapchain_update_state |= is_wanted;
    wanted.fb_foveation_vulkan |= is_wanted;
    is_wanted
}

/// A swapchain with density maps that the runtime fills for a level, its images, and the maps.
pub(super) fn open(
    session: &openxr::Session<openxr::Vulkan>,
    info: &openxr::SwapchainCreateInfo<openxr::Vulkan>,
    foveation: Foveation,
) -> Result<(openxr::Swapchain<openxr::Vulkan>, Vec<vk::Image>, Maps), XrError> {
    let swapchain = create_swapchain(session, info)?;
    let (images, maps) = images_and_maps(&swapchain)?;
    fill(session, &swapchain, foveation)?;
    tracing::info!("fixed foveation is on ({foveation:?})");
    Ok((swapchain, images, maps))
}

fn create_swapchain(
    session: &openxr::Session<openxr::Vulkan>,
    info: &openxr::SwapchainCreateInfo<openxr::Vulkan>,
) -> Result<openxr::Swapchain<openxr::Vulkan>, XrError> {
    const DOING: &str = "creating a swapchain with density maps";
    let mut foveation = sys::SwapchainCreateInfoFoveationFB {
        ty: sys::SwapchainCreateInfoFoveationFB::TYPE,
        next: ptr::null_mut(),
        flags: sys::SwapchainCreateFoveationFlagsFB::FRAGMENT_DENSITY_MAP,
    };
    let info = sys::SwapchainCreateInfo {
        ty: sys::SwapchainCreateInfo::TYPE,
        next: (&raw mut foveation).cast(),
        create_flags: info.create_flags,
        usage_flags: info.usage_flags,
        format: i64::from(info.format),
        sample_count: info.sample_count,
        width: info.width,
        height: info.height,
        face_count: info.face_count,
        array_size: info.array_size,
        mip_count: info.mip_count,
    };
    let mut made = sys::Swapchain::NULL;
    // SAFETY: the session is alive; the structs say what they are and live through the call.
    let result = unsafe { (session.instance().fp().create_swapchain)(session.as_raw(), &info, &mut made) };
    succeeded(result).doing(DOING)?;
    // SAFETY: the swapchain was just made in this session.
    Ok(unsafe { openxr::Swapchain::from_raw(session.clone(), made) })
}

fn images_and_maps(swapchain: &openxr::Swapchain<openxr::Vulkan>) -> Result<(Vec<vk::Image>, Maps), XrError> {
    const DOING: &str = "listing the swapchain's images and density maps";
    let enumerate = swapchain.instance().fp().enumerate_swapchain_images;
    let mut count = 0;
    // SAFETY: the swapchain is alive; with no room only the count is written.
    let result = unsafe { enumerate(swapchain.as_raw(), 0, &mut count, ptr::null_mut()) };
    succeeded(result).doing(DOING)?;
    let no_map = sys::SwapchainImageFoveationVulkanFB {
        ty: sys::SwapchainImageFoveationVulkanFB::TYPE,
        next: ptr::null_mut(),
        image: 0,
        width: 0,
        height: 0,
    };
    let mut maps = vec![no_map; count as usize];
    let with_map = |map: &mut sys::SwapchainImageFoveationVulkanFB| sys::SwapchainImageVulkanKHR {
        ty: sys::SwapchainImageVulkanKHR::TYPE,
        next: ptr::from_mut(map).cast(),
        image: 0,
    };
    let mut images: Vec<_> = maps.iter_mut().map(with_map).collect();
    // SAFETY: as many structs as are announced; each says what it is, and so does the one behind it.
    let result = unsafe { enumerate(swapchain.as_raw(), count, &mut count, images.as_mut_ptr().cast()) };
    succeeded(result).doing(DOING)?;
    let raw = |image: u64| vk::Image::from_raw(image);
    let images: Vec<_> = images.into_iter().map(|image| raw(image.image)).collect();
    let Some([width, height]) = maps.first().map(|map| [map.width, map.height]) else {
        return Err(XrError::NoDensityMaps("it lists no images"));
    };
    let is_good = |map: &sys::SwapchainImageFoveationVulkanFB| {
        map.image != 0 && [map.width, map.height] == [width, height] && width > 0 && height > 0
    };
    if images.len() != maps.len() || !maps.iter().all(is_good) {
        return Err(XrError::NoDensityMaps("some are missing, empty, or of different sizes"));
    }
    let maps = maps.into_iter().map(|map| raw(map.image)).collect();
    Ok((images, Maps { images: maps, extent_texels: [width, height] }))
}

fn fill(
    session: &openxr::Session<openxr::Vulkan>,
    swapchain: &openxr::Swapchain<openxr::Vulkan>,
    foveation: Foveation,
) -> Result<(), XrError> {
    const DOING: &str = "asking for fixed foveation";
    let level = openxr::FoveationLevelProfile {
        level: foveation.level(),
        vertical_offset: 0.0,
        dynamic: sys::FoveationDynamicFB::DISABLED,
    };
    let profile = session.create_foveation_profile(Some(level)).doing(DOING)?;
    let state = sys::SwapchainStateFoveationFB {
        ty: sys::SwapchainStateFoveationFB::TYPE,
        next: ptr::null_mut(),
        flags: sys::SwapchainStateFoveationFlagsFB::EMPTY,
        profile: profile.as_raw(),
    };
    let Some(update) = session.instance().exts().fb_swapchain_update_state else {
        return Err(sys::Result::ERROR_EXTENSION_NOT_PRESENT).doing(DOING);
    };
    // SAFETY: swapchain and profile are alive; the struct begins as every state of a swapchain does.
    let result = unsafe { (update.update_swapchain)(swapchain.as_raw(), ptr::from_ref(&state).cast()) };
    succeeded(result).doing(DOING)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::display::Display;
    use crate::display::xr::{Xr, XrOptions};
    use crate::platform::Platform;
    use shadecast_mock_runtime::config::MockConfig;
    use shadecast_mock_runtime::record::{Summary, read_summary};
    use shadecast_test_support::headset::Run;

    fn config() -> MockConfig {
        MockConfig { foveation: true, extent_pixels: [200, 100], ..MockConfig::default() }
    }

    /// Opens a headset, lets `look` have it, and gives the runtime's account of it.
    fn account(config: &MockConfig, foveation: Foveation, look: impl FnOnce(&Xr)) -> Summary {
        let run = Run::new(config);
        let options = XrOptions { validation: true, foveation, ..XrOptions::default() };
        let xr = Xr::open(&Platform, options).expect("it opens");
        look(&xr);
        let gpu = xr.gpu().clone();
        drop(xr);
        assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
        read_summary(&run.captures()).expect("an account")
    }

    #[test]
    fn a_runtime_makes_a_density_map_for_each_image() {
        for (foveation, level) in [(Foveation::Low, 1), (Foveation::Medium, 2), (Foveation::High, 3)] {
            let summary = account(&config(), foveation, |xr| {
                assert!(xr.headset.device.has_density_maps);
                let info = openxr::SwapchainCreateInfo {
                    create_flags: openxr::SwapchainCreateFlags::EMPTY,
                    usage_flags: openxr::SwapchainUsageFlags::COLOR_ATTACHMENT,
                    format: vk::Format::R8G8B8A8_SRGB.as_raw() as u32,
                    sample_count: 1,
                    width: 200,
                    height: 100,
                    face_count: 1,
                    array_size: 2,
                    mip_count: 1,
                };
                // Whether or not this device has passes for them.
                let (_, images, maps) = open(&xr.headset.session, &info, foveation).expect("it makes them");
                let all: std::collections::BTreeSet<u64> =
                    images.iter().chain(&maps.images).map(|image| image.as_raw()).collect();
                assert_eq!((images.len(), maps.images.len(), all.len()), (3, 3, 6));
                assert_eq!(maps.extent_texels, [7, 4]);
            });
            assert_eq!((summary.foveation_level, summary.errors), (level, 0));
        }
    }

    #[test]
    fn a_device_without_passes_for_maps_draws_all() {
        let summary = account(&config(), Foveation::High, |xr| {
            let takes_maps = xr.gpu().takes_density_maps();
            assert_eq!(xr.eye_images().density_maps.is_some(), takes_maps);
            assert!(
                !takes_maps || xr.gpu().device_name().contains("Adreno"),
                "the mock's maps are no such maps"
            );
        });
        assert_eq!((summary.foveation_level, summary.errors), (0, 0));
    }

    #[test]
    fn unwanted_or_incomplete_foveation_requests_nothing() {
        let hidden_extensions = vec!["XR_FB_swapchain_update_state".to_owned()];
        for (config, foveation) in [
            (config(), Foveation::None),
            (MockConfig { hidden_extensions, ..config() }, Foveation::High),
            (MockConfig { foveation: false, ..config() }, Foveation::High),
        ] {
            let summary = account(&config, foveation, |xr| {
                assert!(!xr.headset.device.has_density_maps && xr.swapchain.maps.is_none());
            });
            assert_eq!((summary.foveation_level, summary.errors), (0, 0));
        }
    }
}

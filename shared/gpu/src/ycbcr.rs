//! Multi-plane pictures that one lookup reads as a colour: the sampler with its conversion, and its images. Platform decoders
//! write such pictures, often in a format that only the driver knows.

use crate::memory::{Backing, Garbage, YcbcrView};
use crate::{Doing, Gpu, GpuError, Image, ImageDesc};
use ash::vk;
use std::sync::Arc;

/// What an image's texels are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum YcbcrFormat {
    /// One of Vulkan's own formats.
    Known(vk::Format),
    /// One of the platform's, by its number, and what may be done with it.
    External(u64, vk::FormatFeatureFlags),
}

impl YcbcrFormat {
    /// As Vulkan has it: none where it is a platform's.
    pub(crate) fn vulkan(self) -> vk::Format {
        match self {
            Self::Known(format) => format,
            Self::External(..) => vk::Format::UNDEFINED,
        }
    }
}

fn features_of(gpu: &Gpu, format: vk::Format) -> vk::FormatFeatureFlags {
    // SAFETY: the physical device belongs to the instance.
    let of_format =
        unsafe { gpu.instance().get_physical_device_format_properties(gpu.physical_device(), format) };
    of_format.optimal_tiling_features
}

/// A sampler that gives red, green and blue of BT.709 with full range, as the server encodes them, whatever the platform suggests;
/// with chroma in the middle of its four luma texels where the device can. It is fixed in the layout of each pipeline that uses it.
pub struct YcbcrSampler {
    gpu: Arc<Gpu>,
    format: YcbcrFormat,
    is_cosited: bool,
    conversion: vk::SamplerYcbcrConversion,
    pub(crate) handle: vk::Sampler,
}

impl YcbcrSampler {
    /// A sampler of images of `format`, in a straight line between texels where the device can.
    ///
    /// # Errors
    /// The device cannot sample such images.
    pub fn new(gpu: &Arc<Gpu>, format: YcbcrFormat) -> Result<Arc<Self>, GpuError> {
        let features = match format {
            YcbcrFormat::External(_, features) => features,
            YcbcrFormat::Known(known) => features_of(gpu, known),
        };
        if !features.contains(vk::FormatFeatureFlags::SAMPLED_IMAGE) {
            let name = gpu.device_name();
            return Err(GpuError::NoDevice(format!("{name} cannot sample pictures of format {format:?}")));
        }
        let is_cosited = !features.contains(vk::FormatFeatureFlags::MIDPOINT_CHROMA_SAMPLES);
        let location =
            if is_cosited { vk::ChromaLocation::COSITED_EVEN } else { vk::ChromaLocation::MIDPOINT };
        let is_linear =
            features.contains(vk::FormatFeatureFlags::SAMPLED_IMAGE_YCBCR_CONVERSION_LINEAR_FILTER);
        let filter = if is_linear { vk::Filter::LINEAR } else { vk::Filter::NEAREST };
        #[cfg_attr(not(target_os = "android"), allow(unused_mut, reason = "external formats are Android's"))]
        let mut info = vk::SamplerYcbcrConversionCreateInfo::default()
            .format(format.vulkan())
            .ycbcr_model(vk::SamplerYcbcrModelConversion::YCBCR_709)
            .ycbcr_range(vk::SamplerYcbcrRange::ITU_FULL)
            .x_chroma_offset(location)
            .y_chroma_offset(location)
            .chroma_filter(filter);
        #[cfg(target_os = "android")]
        let mut external = crate::hardware_buffer::external_format(format);
        #[cfg(target_os = "android")]
        {
            info = info.push_next(&mut external);
        }
        // SAFETY: the device is alive and has the feature, which its opener asked for; the sampler uses the conversion just made, and
        // filters as it does.
        unsafe {
            let conversion = gpu.device().create_sampler_ycbcr_conversion(&info, None);
            let conversion = conversion.doing("creating a conversion of colours")?;
            let mut used = vk::SamplerYcbcrConversionInfo::default().conversion(conversion);
            let edge = vk::SamplerAddressMode::CLAMP_TO_EDGE;
            let info = vk::SamplerCreateInfo::default()
                .mag_filter(filter)
                .min_filter(filter)
                .address_mode_u(edge)
                .address_mode_v(edge)
                .address_mode_w(edge)
                .push_next(&mut used);
            let made = gpu.device().create_sampler(&info, None).doing("creating a sampler of pictures");
            if made.is_err() {
                gpu.device().destroy_sampler_ycbcr_conversion(conversion, None);
            }
            Ok(Arc::new(Self { gpu: gpu.clone(), format, is_cosited, conversion, handle: made? }))
        }
    }

    /// What it samples.
    pub fn format(&self) -> YcbcrFormat {
        self.format
    }

    /// Whether the device takes each chroma texel for one of the first of its four luma texels, since it knows no other way: chroma is then
    /// to be looked up half a luma texel before.
    pub fn is_cosited(&self) -> bool {
        self.is_cosited
    }

    /// How an image must be looked at to be sampled so.
    fn view(&self) -> YcbcrView {
        YcbcrView(Some(self.conversion))
    }
}

impl Drop for YcbcrSampler {
    fn drop(&mut self) {
        self.gpu.retire(Garbage::YcbcrSampler(self.handle, self.conversion));
    }
}

/// A picture on the device, and how it is sampled.
pub struct YcbcrImage {
    /// The image.
    pub image: Image,
    /// What samples it.
    pub sampler: Arc<YcbcrSampler>,
}

impl YcbcrImage {
    /// An image of the sampler's format, in layout UNDEFINED, that copies can write.
    ///
    /// # Errors
    /// No memory for it.
    ///
    /// # Panics
    /// The format is a platform's: it must be imported.
    pub fn new(
        gpu: &Arc<Gpu>,
        sampler: &Arc<YcbcrSampler>,
        extent_texels: [u32; 2],
    ) -> Result<Self, GpuError> {
        let YcbcrFormat::Known(format) = sampler.format else { panic!("images of a platform are imported") };
        let usage = vk::ImageUsageFlags::SAMPLED | vk::ImageUsageFlags::TRANSFER_DST;
        let desc = ImageDesc::new("picture", extent_texels, format, usage);
        Ok(Self { image: Image::allocated(gpu, desc, sampler.view())?, sampler: sampler.clone() })
    }

    /// An image in memory of a platform's own.
    #[cfg_attr(
        not(target_os = "android"),
        expect(dead_code, reason = "only Android's pictures are imported")
    )]
    pub(crate) fn imported(
        gpu: &Arc<Gpu>,
        sampler: &Arc<YcbcrSampler>,
        extent_texels: [u32; 2],
        (handle, memory): (vk::Image, vk::DeviceMemory),
    ) -> Result<Self, GpuError> {
        let usage = vk::ImageUsageFlags::SAMPLED;
        let desc = ImageDesc::new("picture of the platform", extent_texels, sampler.format.vulkan(), usage);
        let image = Image::around(gpu, desc, handle, Backing::Own(memory), sampler.view())?;
        Ok(Self { image, sampler: sampler.clone() })
    }
}

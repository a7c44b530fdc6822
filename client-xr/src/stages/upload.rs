//! Decoded planes into images. Three sets exist, so that the one on display is never overwritten and no copy is waited for.

use crate::decode::Picture;
use crate::platform::requirements::REQUIRED;
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Image, ImageDesc, Memory, Recorder, vk};
use shadecast_protocol::atlas::AtlasExtent;
use std::sync::Arc;

/// Texels of chroma in the pictures that come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Chroma {
    /// Half as many as of luma, both ways: what codecs carry.
    #[default]
    Halved,
    /// As many as of luma, for measurements.
    Full,
}

impl Chroma {
    fn extent_texels(self, luma_texels: [u32; 2]) -> [u32; 2] {
        match self {
            Self::Halved => luma_texels.map(|side| side / 2),
            Self::Full => luma_texels,
        }
    }
}

/// One picture's planes on the GPU.
pub struct Planes {
    /// Luma, then blue and red difference: R8.
    pub images: [Image; 3],
    staging: Buffer,
    offsets: [usize; 3],
}

impl Planes {
    /// Planes for pictures of an atlas; `recorder` makes them readable.
    pub fn new(
        gpu: &Arc<Gpu>,
        recorder: &mut Recorder,
        extent: AtlasExtent,
        chroma: Chroma,
    ) -> Result<Self, GpuError> {
        let extent_texels = extent.texels();
        let of_chroma = chroma.extent_texels(extent_texels);
        let luma = (extent_texels[0] * extent_texels[1]) as usize;
        // Offsets of a copy are multiples of four.
        let chroma_bytes = ((of_chroma[0] * of_chroma[1]) as usize).next_multiple_of(4);
        let images =
            [plane(gpu, "luma", extent_texels)?, plane(gpu, "cb", of_chroma)?, plane(gpu, "cr", of_chroma)?];
        let staging = Buffer::new(gpu, "picture staging", (luma + 2 * chroma_bytes) as u64, Memory::Upload)?;
        for image in &images {
            let layouts = [vk::ImageLayout::UNDEFINED, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
            recorder.transition(image, layouts, Access::NONE, Access::FRAGMENT_READ);
        }
        Ok(Self { images, staging, offsets: [0, luma, luma + chroma_bytes] })
    }

    /// Copies `picture`, which has the extent these planes were made for. No submitted work reads the staging buffer.
    pub fn record(&mut self, recorder: &mut Recorder, picture: &Picture) {
        let planes = match picture {
            Picture::Planes(picture) => picture.planes(),
            Picture::FullChroma(picture) => picture.planes(),
        };
        for (index, plane) in planes.into_iter().enumerate() {
            let image = &self.images[index];
            let [width, height] = image.desc().extent;
            assert_eq!(
                plane.len(),
                (width * height) as usize,
                "a decoder gives pictures of the agreed extent"
            );
            self.staging.write(self.offsets[index], plane);
            let written = [vk::ImageLayout::UNDEFINED, vk::ImageLayout::TRANSFER_DST_OPTIMAL];
            recorder.transition(image, written, Access::FRAGMENT_READ, Access::COPY_WRITE);
            recorder.write_image(image, 0, &self.staging, self.offsets[index] as u64);
            let read = [vk::ImageLayout::TRANSFER_DST_OPTIMAL, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
            recorder.transition(image, read, Access::COPY_WRITE, Access::FRAGMENT_READ);
        }
    }
}

fn plane(gpu: &Arc<Gpu>, name: &'static str, extent: [u32; 2]) -> Result<Image, GpuError> {
    let desc = ImageDesc::new(
        name,
        extent,
        REQUIRED.plane_format,
        vk::ImageUsageFlags::SAMPLED | vk::ImageUsageFlags::TRANSFER_DST,
    );
    Image::new(gpu, desc)
}

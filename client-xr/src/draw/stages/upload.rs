//! Decoded planes into images. There are three sets, so the one on display is never overwritten and no copy is waited for. A
//! worker writes the staging buffers; the render thread submits the copies.

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
}

/// The same on their way there.
pub struct PlaneStaging {
    staging: Buffer,
    offsets: [usize; 3],
    /// Bytes of each plane.
    sizes: [usize; 3],
}

/// Texels of the three planes.
fn extents_texels(extent: AtlasExtent, chroma: Chroma) -> [[u32; 2]; 3] {
    let of_chroma = chroma.extent_texels(extent.texels());
    [extent.texels(), of_chroma, of_chroma]
}

impl PlaneStaging {
    /// For pictures of an atlas.
    pub fn new(gpu: &Arc<Gpu>, extent: AtlasExtent, chroma: Chroma) -> Result<Self, GpuError> {
        let sizes = extents_texels(extent, chroma).map(|[width, height]| (width * height) as usize);
        // Offsets of a copy are multiples of four.
        let [luma, cb, cr] = sizes.map(|size| size.next_multiple_of(4));
        let staging = Buffer::new(gpu, "picture staging", (luma + cb + cr) as u64, Memory::Upload)?;
        Ok(Self { staging, offsets: [0, luma, luma + cb], sizes })
    }

    /// Takes in `planes`, which have the extent this was made for. The GPU is done with what was here.
    pub fn write(&mut self, planes: [&[u8]; 3]) {
        for (index, plane) in planes.into_iter().enumerate() {
            assert_eq!(plane.len(), self.sizes[index], "a decoder gives pictures of the agreed extent");
            self.staging.write(self.offsets[index], plane);
        }
    }
}

impl Planes {
    /// Planes for pictures of an atlas; `recorder` makes them readable.
    pub fn new(
        gpu: &Arc<Gpu>,
        recorder: &mut Recorder,
        extent: AtlasExtent,
        chroma: Chroma,
    ) -> Result<Self, GpuError> {
        let [luma, cb, cr] = extents_texels(extent, chroma);
        let images = [plane(gpu, "luma", luma)?, plane(gpu, "cb", cb)?, plane(gpu, "cr", cr)?];
        for image in &images {
            let layouts = [vk::ImageLayout::UNDEFINED, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
            recorder.transition(image, layouts, Access::NONE, Access::PICTURE_READ);
        }
        Ok(Self { images })
    }

    /// Copies what was written to `staging`.
    pub fn record(&self, recorder: &mut Recorder, staging: &PlaneStaging) {
        for (image, offset) in self.images.iter().zip(staging.offsets) {
            let written = [vk::ImageLayout::UNDEFINED, vk::ImageLayout::TRANSFER_DST_OPTIMAL];
            recorder.transition(image, written, Access::PICTURE_READ, Access::COPY_WRITE);
            recorder.write_image(image, 0, &staging.staging, offset as u64);
            let read = [vk::ImageLayout::TRANSFER_DST_OPTIMAL, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
            recorder.transition(image, read, Access::COPY_WRITE, Access::PICTURE_READ);
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

//! A decoder that leaves its pictures in images of the device, as a headset's does: a few, used again and again, each lent until
//! it is given back. Later it changes what they are, as decoders may.

use super::toy_decoder;
use shadecast_client::decode::{DecodeError, Decoder, DevicePicture, Picture};
use shadecast_gpu::{Access, Buffer, Gpu, Memory, Recorder, YcbcrFormat, YcbcrImage, YcbcrSampler, vk};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::Codec;
use shadecast_protocol::picture::I420;
use std::sync::Arc;
use std::time::Duration;

/// Images: as many pictures as the client may have at once, and no more.
const IMAGES: usize = 8;
pub fn on_device_decoder(
    codec: Codec,
    extent: AtlasExtent,
    gpu: &Arc<Gpu>,
) -> Result<Box<dyn Decoder>, DecodeError> {
    OnDevice::boxed(toy_decoder(codec, extent, gpu)?, gpu, usize::MAX)
}

/// The same, which writes its pictures another way after each five.
pub fn changing_decoder(
    codec: Codec,
    extent: AtlasExtent,
    gpu: &Arc<Gpu>,
) -> Result<Box<dyn Decoder>, DecodeError> {
    OnDevice::boxed(toy_decoder(codec, extent, gpu)?, gpu, 5)
}

struct OnDevice {
    toy: Box<dyn Decoder>,
    gpu: Arc<Gpu>,
    given: usize,
    changes_after: usize,
    pool: Vec<Arc<YcbcrImage>>,
    staging: Option<Buffer>,
}

/// Its other end is with the client for as long as the picture is.
struct Lease(#[allow(dead_code, reason = "held, never read")] Arc<YcbcrImage>);

impl OnDevice {
    fn boxed(
        toy: Box<dyn Decoder>,
        gpu: &Arc<Gpu>,
        changes_after: usize,
    ) -> Result<Box<dyn Decoder>, DecodeError> {
        Ok(Box::new(Self { toy, gpu: gpu.clone(), given: 0, changes_after, pool: Vec::new(), staging: None }))
    }

    fn picture(&mut self, planes: &I420) -> DevicePicture {
        if self.given.is_multiple_of(self.changes_after) {
            let of_two = (self.given / self.changes_after) % 2 == 1;
            let format = match of_two {
                false => vk::Format::G8_B8_R8_3PLANE_420_UNORM,
                true => vk::Format::G8_B8R8_2PLANE_420_UNORM,
            };
            let sampler =
                YcbcrSampler::new(&self.gpu, YcbcrFormat::Known(format)).expect("it can be sampled");
            let image = || Arc::new(YcbcrImage::new(&self.gpu, &sampler, planes.extent_texels()).unwrap());
            self.pool = (0..IMAGES).map(|_| image()).collect();
        }
        self.given += 1;
        // The pool's own, and none with the client: neither as a picture nor as a lease.
        let free = self.pool.iter().find(|image| Arc::strong_count(image) == 1);
        let image = free.expect("pictures come back").clone();
        let mut recorder = self.gpu.record().unwrap();
        let bytes = planes.bytes().len() as u64;
        // Kept: what it was in is freed by the half that draws, which is to have nothing to do with it.
        let staging = self
            .staging
            .get_or_insert_with(|| Buffer::new(&self.gpu, "decoded", bytes, Memory::Upload).unwrap());
        record_copy(&mut recorder, staging, &image, planes);
        self.gpu.wait(recorder.submit().unwrap()).unwrap();
        DevicePicture { lease: Box::new(Lease(image.clone())), image, is_foreign: false }
    }
}

fn record_copy(recorder: &mut Recorder, staging: &mut Buffer, image: &YcbcrImage, planes: &I420) {
    let [luma, cb, cr] = planes.planes();
    let interleaved: Vec<u8> = cb.iter().zip(cr).flat_map(|(cb, cr)| [*cb, *cr]).collect();
    let is_of_two = image.sampler.format() == YcbcrFormat::Known(vk::Format::G8_B8R8_2PLANE_420_UNORM);
    let parts: Vec<&[u8]> = if is_of_two { vec![luma, &interleaved] } else { vec![luma, cb, cr] };
    let written = [vk::ImageLayout::UNDEFINED, vk::ImageLayout::TRANSFER_DST_OPTIMAL];
    recorder.transition(&image.image, written, Access::FRAGMENT_READ, Access::COPY_WRITE);
    let mut offset = 0;
    for (plane, part) in parts.iter().enumerate() {
        staging.write(offset, part);
        recorder.write_plane(image, plane as u32, staging, offset as u64);
        offset += part.len();
    }
    let read = [vk::ImageLayout::TRANSFER_DST_OPTIMAL, vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL];
    recorder.transition(&image.image, read, Access::COPY_WRITE, Access::FRAGMENT_READ);
}

impl Decoder for OnDevice {
    fn submit(&mut self, access_unit: &[u8]) {
        self.toy.submit(access_unit);
    }

    fn poll(&mut self, timeout: Duration) -> Option<Result<Picture, DecodeError>> {
        let decoded = self.toy.poll(timeout)?;
        Some(decoded.map(|picture| {
            let Picture::Planes(planes) = picture else { unreachable!("the toy gives planes") };
            Picture::OnDevice(self.picture(&planes))
        }))
    }

    fn recycle(&mut self, _: Picture) {}

    fn unit_lost(&mut self) {
        self.toy.unit_lost();
    }

    fn needs_refresh(&self) -> bool {
        self.toy.needs_refresh()
    }
}

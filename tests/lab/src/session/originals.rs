//! Atlases that arrive as they were made, though the link carries coded ones: what coding costs is all that is missing then.
//! Bytes on the way, and with them all times, are those of the coded pictures.

use shadecast_client::decode::raw::RawDecoder;
use shadecast_client::decode::{DecodeError, Decoder, Picture};
use shadecast_client::draw::stages::upload::Chroma;
use shadecast_client::platform::{self, MakeDecoder};
use shadecast_gpu::{Access, Buffer, Gpu, GpuError, Image, Memory, vk};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::ids::UpdateId;
use shadecast_protocol::message::Codec;
use shadecast_protocol::picture::I444;
use shadecast_protocol::session::{Out, picture_stream};
use shadecast_protocol::wire::{StreamMessage, parse_stream};
use shadecast_server::encode::Source;
use shadecast_server::update::{Shaded, ViewerUpdates};
use shadecast_shaders::color::full_chroma;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

/// Pictures kept for those that are on their way.
const MAX_KEPT: usize = 64;

/// What the client gets for a coded picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Arrival {
    /// What it is sent.
    #[default]
    Coded,
    /// The planes that were coded.
    Uncoded,
    /// The colours that those planes were made of, with chroma for each texel.
    FullChroma,
}

impl Arrival {
    /// What the client decodes by.
    pub fn decoder(self) -> MakeDecoder {
        match self {
            Self::Coded => platform::decoder,
            Self::Uncoded => raw,
            Self::FullChroma => full,
        }
    }

    /// What the client is to be ready for.
    pub fn chroma(self) -> Chroma {
        if self == Self::FullChroma { Chroma::Full } else { Chroma::Halved }
    }
}

fn raw(_: Codec, extent: AtlasExtent, _: &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError> {
    Ok(Box::new(RawDecoder::new(extent.texels())))
}

fn full(_: Codec, extent: AtlasExtent, _: &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError> {
    Ok(Box::new(FullChromaDecoder { extent_texels: extent.texels(), done: VecDeque::new() }))
}

/// Takes the bytes of three whole planes for an access unit.
struct FullChromaDecoder {
    extent_texels: [u32; 2],
    done: VecDeque<Result<Picture, DecodeError>>,
}

impl Decoder for FullChromaDecoder {
    fn submit(&mut self, access_unit: &[u8]) {
        let picture = I444::new(self.extent_texels, access_unit.to_vec()).map(Picture::FullChroma);
        self.done.push_back(picture.ok_or(DecodeError::NeedsRefresh));
    }

    fn poll(&mut self, _: Duration) -> Option<Result<Picture, DecodeError>> {
        self.done.pop_front()
    }

    fn recycle(&mut self, _: Picture) {}

    fn unit_lost(&mut self) {}

    fn needs_refresh(&self) -> bool {
        false
    }
}

/// The pictures of one viewer that are on their way.
#[derive(Default)]
pub struct Originals {
    arrival: Arrival,
    kept: VecDeque<(UpdateId, Vec<u8>)>,
}

impl Originals {
    /// For a viewer that gets this.
    pub fn new(arrival: Arrival) -> Self {
        Self { arrival, kept: VecDeque::new() }
    }

    /// Keeps the picture of an update that was just made by `updates`.
    ///
    /// # Errors
    /// The device.
    pub fn keep(&mut self, gpu: &Arc<Gpu>, updates: &ViewerUpdates, shaded: &Shaded) -> Result<(), GpuError> {
        let Source::Planes(planes) = &shaded.picture;
        let bytes = match self.arrival {
            Arrival::Coded => return Ok(()),
            Arrival::Uncoded => planes.bytes().to_vec(),
            Arrival::FullChroma => full_chroma(&read(gpu, updates.atlas())?),
        };
        self.kept.push_back((shaded.update, bytes));
        if self.kept.len() > MAX_KEPT {
            self.kept.pop_front();
        }
        Ok(())
    }

    /// What the client is to be given for a whole stream that has arrived; `None`: the stream.
    pub fn of_stream(&mut self, stream: &[u8]) -> Option<Vec<u8>> {
        let Ok(StreamMessage::Picture { header, .. }) = parse_stream(stream) else { return None };
        let place = self.kept.iter().position(|(update, _)| *update == header.update)?;
        let (_, bytes) = self.kept.remove(place)?;
        match picture_stream(header, &bytes) {
            Ok(Out::Stream { bytes, .. }) => Some(bytes),
            _ => None,
        }
    }
}

/// The texels of an image that shaders read, tight rows of four bytes. Waits for the device.
fn read(gpu: &Arc<Gpu>, image: &Image) -> Result<Vec<u8>, GpuError> {
    let [width, height] = image.desc().extent;
    let readback = Buffer::new(gpu, "atlas", u64::from(width) * u64::from(height) * 4, Memory::Readback)?;
    let (shown, copied) = (vk::ImageLayout::SHADER_READ_ONLY_OPTIMAL, vk::ImageLayout::TRANSFER_SRC_OPTIMAL);
    let mut recorder = gpu.record()?;
    recorder.transition(image, [shown, copied], Access::COMPUTE_READ, Access::COPY_READ);
    recorder.read_image(image, 0, &readback, 0);
    recorder.transition(image, [copied, shown], Access::COPY_READ, Access::COMPUTE_READ);
    recorder.barrier(Access::COPY_WRITE, Access::HOST_READ);
    gpu.wait(recorder.submit()?)?;
    Ok(readback.bytes().to_vec())
}

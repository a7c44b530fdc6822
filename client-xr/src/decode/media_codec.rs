//! Android's decoder: an asynchronous MediaCodec writes to the images of an `ImageReader`. The device reads their buffers in
//! place.
//!
//! This module only calls the platform. [`super::platform_decoder`] handles order and failures.

use super::DecodeError;
use super::platform_decoder::{
    CodecEvent, Headers, IMAGES, LentImage, PlatformCodec, PlatformDecoder, is_software,
};
use ndk::hardware_buffer::{HardwareBuffer, HardwareBufferRef, HardwareBufferUsage};
use ndk::media::image_reader::{AcquireResult, Image, ImageFormat, ImageReader};
use ndk::media::media_codec::{AsyncNotifyCallback, MediaCodec, MediaCodecDirection};
use ndk::media::media_format::MediaFormat;
use ndk::media_error::MediaError;
use shadecast_gpu::{Gpu, HardwareBufferKind, YcbcrImage, YcbcrSampler};
use shadecast_protocol::limits::MAX_ACCESS_UNIT_BYTES;
use std::mem::MaybeUninit;
use std::sync::Arc;
use std::sync::mpsc::Sender;

// Where the NDK has `AHardwareBuffer_*`; `ndk` declares them and names no library.
#[link(name = "nativewindow")]
unsafe extern "C" {}

/// H.264, by Android's name.
const MIME: &str = "video/avc";
/// Asked for: each picture as soon as it can be had, in the order of units. The first is Android's own key since its release 11, the
/// others are those of makers before and beside it; a codec that knows a key not ignores it.
const LOW_LATENCY: [&str; 4] = [
    "low-latency",
    "vendor.qti-ext-dec-low-latency.enable",
    "vendor.qti-ext-dec-picture-order.enable",
    "vendor.rtc-ext-dec-low-latency.enable",
];
/// Decoders of H.264 in the processors of headsets: Qualcomm's by both of Android's interfaces, Samsung's, MediaTek's.
const HARDWARE: [&str; 4] =
    ["c2.qti.avc.decoder", "OMX.qcom.video.decoder.avc", "c2.exynos.h264.decoder", "c2.mtk.avc.decoder"];
/// Android's numbers for what the server encodes: BT.709 with full range and the transfer of video; for "in real time"; and that no image
/// takes the place of one that was not taken yet, which windows otherwise do to catch up.
const DEMANDS: [(&str, i32); 5] = [
    ("color-standard", 1),
    ("color-range", 1),
    ("color-transfer", 3),
    ("priority", 0),
    ("allow-frame-drop", 0),
];

/// What goes from one thread to another here. Android's media objects lock themselves.
struct Sent<T>(T);

// SAFETY: `AMediaCodec`, `AImageReader` and `AImage` may be used and deleted on any thread: their functions lock what they share. A
// hardware buffer is a counted reference.
unsafe impl<T> Send for Sent<T> {}
// SAFETY: as above.
unsafe impl<T> Sync for Sent<T> {}

/// One codec with its images. Fields are dropped in this order: the codec lets go of the reader's window first.
pub struct AndroidCodec {
    codec: Sent<MediaCodec>,
    reader: Arc<Sent<ImageReader>>,
    gpu: Arc<Gpu>,
    extent_texels: [u32; 2],
    /// For the buffers as they are now.
    sampler: Option<Arc<YcbcrSampler>>,
    /// The reader's buffers, which come again and again.
    imports: Vec<(Sent<HardwareBufferRef>, Arc<YcbcrImage>)>,
}

/// An image that the client has; the reader lives as long.
struct Lease {
    _image: Sent<Image>,
    _reader: Arc<Sent<ImageReader>>,
}

trait Doing<T> {
    fn doing(self, doing: &'static str) -> Result<T, DecodeError>;
}

impl<T> Doing<T> for Result<T, MediaError> {
    fn doing(self, doing: &'static str) -> Result<T, DecodeError> {
        self.map_err(|error| DecodeError::Platform { doing, reason: error.to_string() })
    }
}

fn failed<T>(doing: &'static str, reason: String) -> Result<T, DecodeError> {
    Err(DecodeError::Platform { doing, reason })
}

/// A decoder for a stream of the agreed extent.
///
/// # Errors
/// The headset has no decoder of H.264 but one on its CPU, or the extent is none.
pub fn decoder(
    extent_texels: [u32; 2],
    gpu: &Arc<Gpu>,
) -> Result<PlatformDecoder<AndroidCodec>, DecodeError> {
    let name = choose()?.name().doing("asking for a decoder's name")?;
    tracing::info!("pictures are decoded by {name}");
    let gpu = gpu.clone();
    let begin = move |extent, headers: &Headers, says| AndroidCodec::begin(&gpu, extent, headers, says);
    PlatformDecoder::new(extent_texels, Box::new(begin))
}

/// The system lists those of the hardware first, as a rule; where it does not, those of the headsets' processors are asked for by name.
fn choose() -> Result<MediaCodec, DecodeError> {
    let doing = "choosing a decoder of H.264";
    let Some(codec) = MediaCodec::from_decoder_type(MIME) else {
        return failed(doing, "this headset has none".into());
    };
    let name = codec.name().doing(doing)?;
    if !is_software(&name) {
        return Ok(codec);
    }
    let named = HARDWARE.iter().find_map(|name| MediaCodec::from_codec_name(name));
    named.map_or_else(|| failed(doing, format!("this headset has only {name}, which runs on its CPU")), Ok)
}

impl AndroidCodec {
    fn begin(
        gpu: &Arc<Gpu>,
        extent_texels: [u32; 2],
        headers: &Headers,
        says: Sender<CodecEvent>,
    ) -> Result<Self, DecodeError> {
        let [width, height] = extent_texels.map(|side| side as i32);
        let usage = HardwareBufferUsage::GPU_SAMPLED_IMAGE;
        let reader = ImageReader::new_with_usage(width, height, ImageFormat::PRIVATE, usage, IMAGES as i32);
        let mut reader = reader.doing("making images for pictures")?;
        let written = says.clone();
        let listener = Box::new(move |_: &ImageReader| say(&written, CodecEvent::Image));
        reader.set_image_listener(listener).doing("listening for pictures")?;
        let mut codec = choose()?;
        codec.set_async_notify_callback(Some(callbacks(says))).doing("listening to the decoder")?;
        let window = reader.window().doing("connecting the decoder with its images")?;
        let format = format(extent_texels, headers);
        let direction = MediaCodecDirection::Decoder;
        codec.configure(&format, Some(&window), direction).doing("setting the decoder up")?;
        codec.start().doing("starting the decoder")?;
        Ok(Self {
            codec: Sent(codec),
            reader: Arc::new(Sent(reader)),
            gpu: gpu.clone(),
            extent_texels,
            sampler: None,
            imports: Vec::with_capacity(IMAGES),
        })
    }

    /// The device's image of a buffer, made when it comes for the first time. Where buffers are of another format than before, what was made
    /// of those is forgotten.
    fn import(&mut self, buffer: &HardwareBuffer) -> Result<Arc<YcbcrImage>, DecodeError> {
        if let Some((_, image)) = self.imports.iter().find(|(known, _)| known.0.as_ptr() == buffer.as_ptr()) {
            return Ok(image.clone());
        }
        let (desc, buffer) = (buffer.describe(), buffer.acquire());
        let extent = [desc.width, desc.height];
        if extent.iter().zip(self.extent_texels).any(|(has, wanted)| *has < wanted) {
            return failed("decoding", format!("its pictures are of {}x{} texels", extent[0], extent[1]));
        }
        // SAFETY: the buffer is held; the device was opened for pictures, as on Android it always is.
        let kind = unsafe { HardwareBufferKind::of(&self.gpu, buffer.as_ptr().cast()) }?;
        let sampler = match self.sampler.take_if(|sampler| sampler.format() == kind.format) {
            Some(sampler) => sampler,
            None => {
                tracing::info!("pictures are {:?} of {}x{} texels", kind.format, extent[0], extent[1]);
                self.imports.clear();
                YcbcrSampler::new(&self.gpu, kind.format)?
            }
        };
        if self.imports.len() >= 2 * IMAGES {
            // The reader has other buffers by now.
            self.imports.clear();
        }
        // SAFETY: as above; `kind` and extent are the buffer's own.
        let image =
            unsafe { YcbcrImage::import(&self.gpu, (buffer.as_ptr().cast(), kind), extent, &sampler) };
        self.sampler = Some(sampler);
        let image = Arc::new(image?);
        self.imports.push((Sent(buffer), image.clone()));
        Ok(image)
    }
}

/// What is asked of the codec.
fn format(extent_texels: [u32; 2], headers: &Headers) -> MediaFormat {
    let mut format = MediaFormat::new();
    format.set_str("mime", MIME);
    format.set_i32("width", extent_texels[0] as i32);
    format.set_i32("height", extent_texels[1] as i32);
    // No picture is longer than its bytes are without a codec.
    let bytes = (extent_texels[0] * extent_texels[1]) as usize * 3 / 2;
    format.set_i32("max-input-size", bytes.min(MAX_ACCESS_UNIT_BYTES) as i32);
    format.set_buffer("csd-0", &headers.sequence);
    format.set_buffer("csd-1", &headers.picture);
    LOW_LATENCY.iter().for_each(|key| format.set_i32(key, 1));
    DEMANDS.iter().for_each(|(key, value)| format.set_i32(key, *value));
    format
}

fn callbacks(says: Sender<CodecEvent>) -> AsyncNotifyCallback {
    let [of_input, of_output] = [says.clone(), says.clone()];
    AsyncNotifyCallback {
        on_input_available: Some(Box::new(move |index| say(&of_input, CodecEvent::Input(index)))),
        on_output_available: Some(Box::new(move |index, info| {
            let time_us = info.presentation_time_us().max(0) as u64;
            say(&of_output, CodecEvent::Output(index, time_us));
        })),
        on_format_changed: Some(Box::new(|format| tracing::debug!("the decoder gives {format}"))),
        on_error: Some(Box::new(move |error, action, detail| match action.is_transient() {
            true => tracing::debug!("the decoder: {error}, {detail:?}"),
            false => say(&says, CodecEvent::Failed(format!("{error}, {detail:?}"))),
        })),
    }
}

/// A decoder that was thrown away is not heard.
fn say(to: &Sender<CodecEvent>, event: CodecEvent) {
    let _ = to.send(event);
}

impl PlatformCodec for AndroidCodec {
    fn queue(&mut self, input: usize, unit: &[u8], time_us: u64) -> Result<(), DecodeError> {
        let doing = "handing over a unit";
        let Some(buffer) = self.codec.0.input_buffer(input) else {
            return failed(doing, format!("it has no input buffer {input}"));
        };
        let room = buffer.len();
        let Some(place) = buffer.get_mut(..unit.len()) else {
            return failed(doing, format!("{} bytes do not fit into its buffer of {room}", unit.len()));
        };
        place.iter_mut().zip(unit).for_each(|(to, byte)| *to = MaybeUninit::new(*byte));
        self.codec.0.queue_input_buffer_by_index(input, 0, unit.len(), time_us, 0).doing(doing)
    }

    fn release(&mut self, output: usize, is_shown: bool) -> Result<(), DecodeError> {
        self.codec.0.release_output_buffer_by_index(output, is_shown).doing("writing a picture")
    }

    fn take_image(&mut self) -> Result<Option<(u64, LentImage)>, DecodeError> {
        let image = match self.reader.0.acquire_next_image().doing("taking a picture")? {
            AcquireResult::Image(image) => image,
            AcquireResult::NoBufferAvailable => return Ok(None),
            AcquireResult::MaxImagesAcquired => {
                return failed("taking a picture", "all its images are lent".into());
            }
        };
        let time_us = image.timestamp().doing("asking for a picture's time")?.max(0) as u64 / 1000;
        let buffer = image.hardware_buffer().doing("asking for a picture's buffer")?;
        let imported = self.import(&buffer)?;
        let lease = Box::new(Lease { _image: Sent(image), _reader: self.reader.clone() });
        Ok(Some((time_us, LentImage { image: imported, lease })))
    }
}

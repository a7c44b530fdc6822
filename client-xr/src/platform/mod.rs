//! All differences between a desktop and a headset's system: the OpenXR loader, the decoder, the monotonic clock, the device
//! requirements.
//!
//! The agreed codec and extent enter. A decoder, times and [`requirements`] leave. Nothing here knows sessions, displays and
//! drawing.

#[cfg(any(test, all(target_os = "android", feature = "openh264")))]
mod fallback;
pub mod requirements;

use crate::decode::raw::RawDecoder;
use crate::decode::{DecodeError, Decoder};
use shadecast_gpu::Gpu;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::Codec;
use shadecast_protocol::time::ClientTime;
use std::sync::Arc;

/// The system that the client runs on.
#[cfg(not(target_os = "android"))]
#[derive(Clone, Copy, Debug, Default)]
pub struct Platform;

/// The system that the client runs on.
#[cfg(target_os = "android")]
pub struct Platform {
    /// The activity, as OpenXR must know it.
    pub activity: openxr::AndroidPlatformInfo,
}

#[cfg(not(target_os = "android"))]
impl Platform {
    /// What the OpenXR loader must be told: nothing.
    pub(crate) fn openxr_platform(&self) -> &() {
        &()
    }

    /// Extensions that OpenXR needs on this system only: none.
    pub(crate) fn add_extensions(&self, _: &mut openxr::ExtensionSet) {}
}

#[cfg(target_os = "android")]
impl Platform {
    pub(crate) fn openxr_platform(&self) -> &openxr::AndroidPlatformInfo {
        &self.activity
    }

    pub(crate) fn add_extensions(&self, wanted: &mut openxr::ExtensionSet) {
        wanted.khr_android_create_instance = true;
    }
}

/// Makes a decoder of a codec for pictures of an atlas; it may leave them in the device's memory.
pub type MakeDecoder = fn(Codec, AtlasExtent, &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError>;

/// The decoder of this system for pictures of an atlas.
pub fn decoder(codec: Codec, extent: AtlasExtent, gpu: &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError> {
    match codec {
        Codec::H264 => h264_decoder(extent, gpu),
        Codec::Raw => Ok(Box::new(RawDecoder::new(extent.texels()))),
    }
}

/// The platform's own; it writes to memory that the device reads.
#[cfg(all(target_os = "android", not(feature = "openh264")))]
fn h264_decoder(extent: AtlasExtent, gpu: &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError> {
    Ok(Box::new(crate::decode::media_codec::decoder(extent.texels(), gpu)?))
}

/// The same, and the one that is built in where that cannot be had.
#[cfg(all(target_os = "android", feature = "openh264"))]
fn h264_decoder(extent: AtlasExtent, gpu: &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError> {
    let texels = extent.texels();
    let own = crate::decode::media_codec::decoder(texels, gpu);
    let own = own.map(|decoder| Box::new(decoder) as Box<dyn Decoder>);
    fallback::decoder(own, Box::new(move || built_in(texels)))
}

#[cfg(all(feature = "openh264", not(target_os = "android")))]
fn h264_decoder(extent: AtlasExtent, _: &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError> {
    built_in(extent.texels())
}

#[cfg(not(any(feature = "openh264", target_os = "android")))]
fn h264_decoder(_: AtlasExtent, _: &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError> {
    let reason = "this client was built without one; build it with the feature `openh264`".to_owned();
    Err(DecodeError::Platform { doing: "choosing a decoder of H.264", reason })
}

#[cfg(feature = "openh264")]
fn built_in(extent_texels: [u32; 2]) -> Result<Box<dyn Decoder>, DecodeError> {
    Ok(Box::new(crate::decode::openh264::OpenH264Decoder::new(extent_texels)?))
}

/// The clock of this system's programs.
pub const CLOCK: fn() -> ClientTime = monotonic_now;

/// The monotonic clock that OpenXR's times are converted to.
pub fn monotonic_now() -> ClientTime {
    ClientTime(shadecast_system::monotonic_now_ns())
}

//! The embedded encoder: openh264, tuned for atlases.
//!
//! An atlas is not a film. Neighbouring blocks are unrelated, so deblocking only smears one into the next (off: -30 % time,
//! +1.1 dB chroma). Unchanged blocks must cost nothing and stay exact, so the quantiser is constant, and no rate control,
//! background or scene-change heuristic interferes. A refresh comes only on the client's request. CABAC saves 32 % of the bits
//! at the same time per picture. The safe `openh264` crate reaches none of these settings, hence this wrapper over
//! `openh264-sys2`.
//!
//! The library is built from source. Without `nasm` on the build machine it silently loses all its assembly and becomes several
//! times slower; the set-up installs `nasm`.

use std::collections::VecDeque;
use std::ffi::{c_int, c_void};
use std::ptr;
use std::time::Duration;

use openh264_sys2::{
    CAMERA_VIDEO_REAL_TIME, CM_BT709, CONSTANT_ID, CP_BT709, DEBLOCKING_IDC_0, DEBLOCKING_IDC_1,
    ENCODER_OPTION, ENCODER_OPTION_SVC_ENCODE_PARAM_EXT, ENCODER_OPTION_TRACE_LEVEL, ISVCEncoder,
    ISVCEncoderVtbl, LEVEL_5_2, MEDIUM_COMPLEXITY, PRO_HIGH, RC_OFF_MODE, SEncParamExt, SFrameBSInfo,
    SLayerBSInfo, SM_FIXEDSLCNUM_SLICE, SM_SINGLE_SLICE, SSourcePicture, SSpatialLayerConfig, TRC_BT709,
    VF_UNDEF, WELS_LOG_QUIET, source::APILoader, videoFormatI420, videoFrameTypeI, videoFrameTypeIDR,
    videoFrameTypeP,
};

use super::{AccessUnit, EncodeError, Encoded, Encoder, Source};
use crate::pacing::quality::DEFAULT_QP;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::limits::{MAX_ACCESS_UNIT_BYTES, MAX_PICTURE_EXTENT_TEXELS, MIN_PICTURE_SIDE_TEXELS};
use shadecast_protocol::picture::I420;

/// Pictures per second that a stream can declare.
const MAX_FPS: u32 = 60;

/// The most slices, and so threads, that openh264 works on at once.
const MAX_THREADS: u32 = 4;

/// Slices of a streamed picture. A fixed number, so that the same pictures give the same bytes on every machine; as many as
/// there are threads for, since slices cost few bits.
const STREAM_SLICES: u32 = MAX_THREADS;

/// The library's name for a function missing from its table, in the range of its own result codes.
const MISSING_FUNCTION: i32 = -1;

/// What an encoder is made for.
#[derive(Clone, Copy, Debug)]
pub struct EncoderSettings {
    /// Width and height of every picture in texels: even, at least 16, at most 4096x2304.
    pub extent_texels: [u32; 2],
    /// Quantisation parameter, 0 (finest) to 51 (coarsest), the same for every block and picture.
    pub qp: u8,
    /// Pictures per second, 1 to 60. Declared in the stream; with a constant quantiser nothing else depends on it.
    pub fps: u32,
    /// Slices that a picture is cut into, each coded by a thread of its own, 1 to 4. The stream depends on this
    /// number, but not on how many cores there are.
    pub threads: u32,
    /// Smooths over the borders of macroblocks: for pictures of a view. Of an atlas it would mix blocks that are no neighbours.
    pub loop_filter: bool,
}

impl EncoderSettings {
    /// Settings for pictures of this extent: default quantiser, 30 pictures per second, one thread.
    pub fn new(extent_texels: [u32; 2]) -> Self {
        Self { extent_texels, qp: DEFAULT_QP, fps: 30, threads: 1, loop_filter: false }
    }

    /// Settings of a stream that makes so many updates a second: the one place where they are decided, for the server and for
    /// whoever measures it.
    pub fn for_stream(extent: AtlasExtent, qp: u8, rate_hz: f64) -> Self {
        let fps = rate_hz.round().clamp(1.0, MAX_FPS.into()) as u32;
        Self { extent_texels: extent.texels(), qp, fps, threads: STREAM_SLICES, loop_filter: false }
    }

    /// # Errors
    /// Names the setting that is outside of its range.
    pub(super) fn check(&self) -> Result<(), EncodeError> {
        check_extent(self.extent_texels)?;
        check_qp(self.qp)?;
        check_setting("fps", self.fps, 1, MAX_FPS, "1..=60")?;
        check_setting("threads", self.threads, 1, MAX_THREADS, "1..=4")
    }

    /// Writes these settings over the library's defaults.
    fn apply_to(&self, params: &mut SEncParamExt) {
        let [width, height] = self.extent_texels.map(|texels| texels as c_int);
        params.iUsageType = CAMERA_VIDEO_REAL_TIME;
        params.iPicWidth = width;
        params.iPicHeight = height;
        params.fMaxFrameRate = self.fps as f32;
        params.iRCMode = RC_OFF_MODE;
        params.iTargetBitrate = 0;
        params.iMaxBitrate = 0;
        params.bEnableFrameSkip = false;
        params.iComplexityMode = MEDIUM_COMPLEXITY;
        params.uiIntraPeriod = 0;
        params.iNumRefFrame = 1;
        params.bEnableLongTermReference = false;
        params.eSpsPpsIdStrategy = CONSTANT_ID;
        params.bPrefixNalAddingCtrl = false;
        params.iEntropyCodingModeFlag = 1;
        params.iLoopFilterDisableIdc = if self.loop_filter { DEBLOCKING_IDC_0 } else { DEBLOCKING_IDC_1 };
        params.bEnableDenoise = false;
        params.bEnableBackgroundDetection = false;
        params.bEnableAdaptiveQuant = false;
        params.bEnableSceneChangeDetect = false;
        params.iMultipleThreadIdc = self.threads as u16;
        // Balancing moves slice borders by measured time: the stream would differ from run to run.
        params.bUseLoadBalancing = false;
        params.iTemporalLayerNum = 1;
        params.iSpatialLayerNum = 1;
        self.apply_to_layer(&mut params.sSpatialLayers[0]);
    }

    fn apply_to_layer(&self, layer: &mut SSpatialLayerConfig) {
        let [width, height] = self.extent_texels.map(|texels| texels as c_int);
        layer.iVideoWidth = width;
        layer.iVideoHeight = height;
        layer.fFrameRate = self.fps as f32;
        layer.iSpatialBitrate = 0;
        layer.iMaxSpatialBitrate = 0;
        layer.iDLayerQp = self.qp.into();
        // CABAC needs Main, and High costs nothing more. A constant quantiser has no upper bit rate: take the
        // highest level. Decoders still add no delay, since the stream says that nothing is reordered.
        layer.uiProfileIdc = PRO_HIGH;
        layer.uiLevelIdc = LEVEL_5_2;
        layer.sSliceArgument.uiSliceNum = self.threads;
        layer.sSliceArgument.uiSliceMode =
            if self.threads > 1 { SM_FIXEDSLCNUM_SLICE } else { SM_SINGLE_SLICE };
        layer.bVideoSignalTypePresent = true;
        layer.uiVideoFormat = VF_UNDEF as u8;
        layer.bFullRange = true;
        layer.bColorDescriptionPresent = true;
        layer.uiColorPrimaries = CP_BT709 as u8;
        layer.uiTransferCharacteristics = TRC_BT709 as u8;
        layer.uiColorMatrix = CM_BT709 as u8;
    }
}

fn check_extent(extent_texels: [u32; 2]) -> Result<(), EncodeError> {
    let fits = extent_texels
        .into_iter()
        .zip(MAX_PICTURE_EXTENT_TEXELS)
        .all(|(texels, most)| (MIN_PICTURE_SIDE_TEXELS..=most).contains(&texels) && texels % 2 == 0);
    if fits { Ok(()) } else { Err(EncodeError::Extent(extent_texels)) }
}

/// Whether a picture has the extent that its encoder was made for.
pub(super) fn check_picture_extent(want: [u32; 2], picture: &I420) -> Result<(), EncodeError> {
    let got = picture.extent_texels();
    if got == want { Ok(()) } else { Err(EncodeError::ExtentChanged { want, got }) }
}

pub(super) fn check_qp(qp: u8) -> Result<(), EncodeError> {
    check_setting("qp", qp.into(), 0, 51, "0..=51")
}

fn check_setting(
    name: &'static str,
    value: u32,
    least: u32,
    most: u32,
    range: &'static str,
) -> Result<(), EncodeError> {
    if (least..=most).contains(&value) { Ok(()) } else { Err(EncodeError::Setting { name, value, range }) }
}

/// An [`Encoder`] that runs openh264 on the CPU: while a picture is submitted, so that it can be polled at once.
pub struct OpenH264Encoder {
    settings: EncoderSettings,
    /// Gone after a failure, since the library may have torn itself down; made anew for the next picture.
    library: Option<Library>,
    done: VecDeque<Encoded>,
}

impl OpenH264Encoder {
    /// Makes an encoder for pictures of one extent.
    pub fn new(settings: EncoderSettings) -> Result<Self, EncodeError> {
        settings.check()?;
        Ok(Self { settings, library: Some(Library::new(&settings)?), done: VecDeque::new() })
    }

    fn library(&mut self) -> Result<Library, EncodeError> {
        match self.library.take() {
            Some(library) => Ok(library),
            None => Library::new(&self.settings),
        }
    }

    fn encode(
        &mut self,
        picture: &I420,
        timestamp_ns: i64,
        refresh: bool,
    ) -> Result<AccessUnit, EncodeError> {
        check_picture_extent(self.settings.extent_texels, picture)?;
        let mut library = self.library()?;
        if refresh {
            library.force_refresh()?;
        }
        let unit = library.encode(picture, timestamp_ns)?;
        let got = unit.bytes.len();
        if got > MAX_ACCESS_UNIT_BYTES {
            return Err(EncodeError::TooLong { got });
        }
        self.library = Some(library);
        Ok(unit)
    }
}

impl Encoder for OpenH264Encoder {
    fn submit(&mut self, source: Source, timestamp_ns: i64, refresh: bool) {
        let Source::Planes(picture) = &source;
        let result = self.encode(picture, timestamp_ns, refresh);
        self.done.push_back(Encoded { source, result });
    }

    fn poll(&mut self, _: Duration) -> Option<Encoded> {
        self.done.pop_front()
    }

    fn set_qp(&mut self, qp: u8) -> Result<(), EncodeError> {
        check_qp(qp)?;
        self.settings.qp = qp;
        let mut library = self.library()?;
        library.adjust(&self.settings)?;
        self.library = Some(library);
        Ok(())
    }
}

/// One initialised encoder of the library. Owns it: destroyed on drop.
struct Library {
    encoder: *mut ISVCEncoder,
    /// Where the library describes what it wrote: 6 KiB, so on the heap.
    written: Box<SFrameBSInfo>,
}

// SAFETY: the encoder is plain heap memory without thread-local state. What encoders share, a pool of worker threads,
// is behind a lock of the library. `Library` is not `Clone` and what changes it takes `&mut self`, so only one thread
// uses it at a time.
unsafe impl Send for Library {}

impl Library {
    fn new(settings: &EncoderSettings) -> Result<Self, EncodeError> {
        let mut encoder: *mut ISVCEncoder = ptr::null_mut();
        // SAFETY: `encoder` is a valid place for the pointer that the function writes.
        let code = unsafe { APILoader::WelsCreateSVCEncoder(&mut encoder) };
        if code != 0 || encoder.is_null() {
            return Err(EncodeError::Library { doing: "creating an encoder", code });
        }
        let mut library = Self { encoder, written: Box::default() };
        library.set_option(
            ENCODER_OPTION_TRACE_LEVEL,
            &mut { WELS_LOG_QUIET },
            "silencing the encoder's log",
        )?;
        library.initialise(settings)?;
        Ok(library)
    }

    fn initialise(&mut self, settings: &EncoderSettings) -> Result<(), EncodeError> {
        let doing = "initialising the encoder";
        let params = self.params(settings)?;
        let initialise = required(self.table().InitializeExt, doing)?;
        // SAFETY: `self.encoder` is alive (made in `new`, destroyed in `drop` only); the library copies `params`.
        check(unsafe { initialise(self.encoder, &params) }, doing)
    }

    /// The library's own parameters for these settings.
    fn params(&self, settings: &EncoderSettings) -> Result<SEncParamExt, EncodeError> {
        let doing = "reading the encoder's defaults";
        let mut params = SEncParamExt::default();
        let defaults = required(self.table().GetDefaultParams, doing)?;
        // SAFETY: the encoder is alive, and `params` a valid place for what the function writes.
        check(unsafe { defaults(self.encoder, &mut params) }, doing)?;
        settings.apply_to(&mut params);
        Ok(params)
    }

    fn table(&self) -> &ISVCEncoderVtbl {
        // SAFETY: a live encoder points to its static table of functions.
        unsafe { &**self.encoder }
    }

    fn set_option<T>(
        &mut self,
        option: ENCODER_OPTION,
        value: &mut T,
        doing: &'static str,
    ) -> Result<(), EncodeError> {
        let set = required(self.table().SetOption, doing)?;
        // SAFETY: the encoder is alive; the two callers pass the type that the option is documented to read.
        check(unsafe { set(self.encoder, option, ptr::from_mut(value).cast::<c_void>()) }, doing)
    }

    /// Takes over settings that differ in the quantiser only: the library then goes on without a refresh.
    fn adjust(&mut self, settings: &EncoderSettings) -> Result<(), EncodeError> {
        let mut params = self.params(settings)?;
        self.set_option(ENCODER_OPTION_SVC_ENCODE_PARAM_EXT, &mut params, "changing the quantiser")
    }

    fn force_refresh(&mut self) -> Result<(), EncodeError> {
        let doing = "asking for a refresh";
        let force = required(self.table().ForceIntraFrame, doing)?;
        // SAFETY: the encoder is alive and initialised.
        check(unsafe { force(self.encoder, true) }, doing)
    }

    fn encode(&mut self, picture: &I420, timestamp_ns: i64) -> Result<AccessUnit, EncodeError> {
        let doing = "encoding a picture";
        let source = source_picture(picture, timestamp_ns);
        let encode = required(self.table().EncodeFrame, doing)?;
        *self.written = SFrameBSInfo::default();
        // SAFETY: the encoder is alive and initialised for this extent, which was checked to be the picture's; its
        // planes hold all texels of it, outlive the call, and are only read; `written` is a valid place.
        check(unsafe { encode(self.encoder, &source, &mut *self.written) }, doing)?;
        self.collect()
    }

    /// Copies what the encoder wrote: it lies in the library's memory until the next call.
    fn collect(&self) -> Result<AccessUnit, EncodeError> {
        let info = &*self.written;
        let is_refresh = match info.eFrameType {
            t if t == videoFrameTypeIDR => true,
            t if t == videoFrameTypeI || t == videoFrameTypeP => false,
            code => return Err(EncodeError::Library { doing: "encoding: no picture came out", code }),
        };
        let layers = usize::try_from(info.iLayerNum).unwrap_or(0).min(info.sLayerInfo.len());
        let mut bytes = Vec::with_capacity(usize::try_from(info.iFrameSizeInBytes).unwrap_or(0));
        for layer in &info.sLayerInfo[..layers] {
            // SAFETY: `written` has just been filled by a successful call, and nothing was called since.
            bytes.extend_from_slice(unsafe { layer_bytes(layer) });
        }
        Ok(AccessUnit { bytes, is_refresh })
    }
}

impl Drop for Library {
    fn drop(&mut self) {
        // SAFETY: the pointer came from `WelsCreateSVCEncoder`, and this is the one place that destroys it. The
        // destructor releases what initialisation allocated.
        unsafe { APILoader::WelsDestroySVCEncoder(self.encoder) };
    }
}

/// The NAL units of one layer, which lie one behind the other.
///
/// # Safety
///
/// `layer` must come from a successful `EncodeFrame` whose encoder lives and has not been called since.
unsafe fn layer_bytes(layer: &SLayerBSInfo) -> &[u8] {
    let count = usize::try_from(layer.iNalCount).unwrap_or(0);
    if count == 0 || layer.pBsBuf.is_null() || layer.pNalLengthInByte.is_null() {
        return &[];
    }
    // SAFETY: the library promises `iNalCount` lengths, and as many bytes as they add up to, at these pointers.
    unsafe {
        let lengths = std::slice::from_raw_parts(layer.pNalLengthInByte, count);
        let total = lengths.iter().map(|&length| usize::try_from(length).unwrap_or(0)).sum();
        std::slice::from_raw_parts(layer.pBsBuf, total)
    }
}

fn source_picture(picture: &I420, timestamp_ns: i64) -> SSourcePicture {
    let [width, height] = picture.extent_texels().map(|texels| texels as c_int);
    let [y, cb, cr] = picture.planes().map(|plane| plane.as_ptr().cast_mut());
    SSourcePicture {
        iColorFormat: videoFormatI420,
        iStride: [width, width / 2, width / 2, 0],
        // The library takes mutable pointers, but only reads: it copies the picture before it works on it.
        pData: [y, cb, cr, ptr::null_mut()],
        iPicWidth: width,
        iPicHeight: height,
        uiTimeStamp: timestamp_ns / 1_000_000,
        ..SSourcePicture::default()
    }
}

fn required<F>(function: Option<F>, doing: &'static str) -> Result<F, EncodeError> {
    function.ok_or(EncodeError::Library { doing, code: MISSING_FUNCTION })
}

fn check(code: c_int, doing: &'static str) -> Result<(), EncodeError> {
    if code == 0 { Ok(()) } else { Err(EncodeError::Library { doing, code }) }
}

//! The desktop decoder: openh264, without concealment.
//!
//! The library accepts any bytes and may allocate by them, so every unit is checked first. A unit is split, unexpected kinds of
//! NAL units are refused, and sequence headers must have the agreed extent. After an error the next refresh gets a new decoder,
//! so no half-decoded state survives.
//!
//! The library holds a picture back in case an earlier one follows. Our streams have no such order. So each unit is flushed,
//! and its picture comes out at once.

use std::collections::VecDeque;
use std::ffi::{c_int, c_long, c_void};
use std::ptr;
use std::time::Duration;

use openh264_sys2::{
    DECODER_OPTION, DECODER_OPTION_TRACE_LEVEL, ERROR_CON_DISABLE, ISVCDecoder, ISVCDecoderVtbl, SBufferInfo,
    SDecodingParam, TagSysMemBuffer, VIDEO_BITSTREAM_AVC, WELS_LOG_QUIET, source::APILoader, videoFormatI420,
};

use super::inspect::{check_picture_extent, inspect};
use super::{DecodeError, Decoder, Picture, Spare};
use shadecast_protocol::picture::I420;

/// The library's name for a function missing from its table, in the range of its own result codes.
const MISSING_FUNCTION: c_long = -1;

/// Decoder state for a unit that decoded without complaint, but gave no picture.
const NO_PICTURE: i32 = 0;

/// A [`Decoder`] that runs openh264 on the CPU: while a unit is submitted, so that it can be polled at once.
pub struct OpenH264Decoder {
    extent_texels: [u32; 2],
    library: Library,
    state: State,
    done: VecDeque<Result<Picture, DecodeError>>,
    spare: Spare,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Nothing decoded yet: the first unit must be a refresh.
    Fresh,
    /// The last unit gave its picture.
    Clean,
    /// A unit was broken or lost. The next refresh gets a decoder of its own.
    Broken,
}

impl OpenH264Decoder {
    /// Makes a decoder for a stream of the agreed extent: even, at least 16 and at most 4096x2304 texels.
    pub fn new(extent_texels: [u32; 2]) -> Result<Self, DecodeError> {
        check_picture_extent(extent_texels)?;
        Ok(Self {
            extent_texels,
            library: Library::new()?,
            state: State::Fresh,
            done: VecDeque::new(),
            spare: Spare::default(),
        })
    }

    fn decode(&mut self, access_unit: &[u8], picture: &mut I420) -> Result<(), DecodeError> {
        let is_refresh = inspect(access_unit, self.extent_texels)?;
        if self.needs_refresh() && !is_refresh {
            return Err(DecodeError::NeedsRefresh);
        }
        if self.state == State::Broken {
            self.library = Library::new()?;
        }
        let decoded = self.library.decode(access_unit)?;
        decoded.copy_to(self.extent_texels, picture)
    }
}

impl Decoder for OpenH264Decoder {
    fn submit(&mut self, access_unit: &[u8]) {
        let mut picture = self.spare.take();
        let result = self.decode(access_unit, &mut picture);
        self.state = match &result {
            Ok(()) => State::Clean,
            Err(DecodeError::NeedsRefresh) => self.state,
            Err(_) => State::Broken,
        };
        self.done.push_back(match result {
            Ok(()) => Ok(Picture::Planes(picture)),
            Err(error) => {
                self.spare.give(picture);
                Err(error)
            }
        });
    }

    fn poll(&mut self, _: Duration) -> Option<Result<Picture, DecodeError>> {
        self.done.pop_front()
    }

    fn recycle(&mut self, picture: Picture) {
        let Picture::Planes(picture) = picture else { return };
        self.spare.give(picture);
    }

    fn unit_lost(&mut self) {
        self.state = State::Broken;
    }

    fn needs_refresh(&self) -> bool {
        self.state != State::Clean
    }
}

/// One initialised decoder of the library. Owns it: destroyed on drop.
struct Library {
    decoder: *mut ISVCDecoder,
}

// SAFETY: the decoder is plain heap memory without thread-local or global state, and has no threads of its own as long
// as none are asked for. `Library` is not `Clone` and every call takes `&mut self`, so only one thread uses it at a
// time.
unsafe impl Send for Library {}

impl Library {
    fn new() -> Result<Self, DecodeError> {
        let mut decoder: *mut ISVCDecoder = ptr::null_mut();
        // SAFETY: `decoder` is a valid place for the pointer that the function writes.
        let code = unsafe { APILoader::WelsCreateDecoder(&mut decoder) };
        if code != 0 || decoder.is_null() {
            return Err(DecodeError::Library { doing: "creating a decoder", code });
        }
        let mut library = Self { decoder };
        library.set_option(DECODER_OPTION_TRACE_LEVEL, WELS_LOG_QUIET, "silencing the decoder's log")?;
        library.initialise()?;
        Ok(library)
    }

    fn initialise(&mut self) -> Result<(), DecodeError> {
        let doing = "initialising the decoder";
        let mut params = SDecodingParam { eEcActiveIdc: ERROR_CON_DISABLE, ..SDecodingParam::default() };
        params.sVideoProperty.size = size_of_val(&params.sVideoProperty) as u32;
        params.sVideoProperty.eVideoBsType = VIDEO_BITSTREAM_AVC;
        let initialise = required(self.table().Initialize, doing)?;
        // SAFETY: `self.decoder` is alive (made in `new`, destroyed in `drop` only); the library copies `params`.
        check(unsafe { initialise(self.decoder, &params) }, doing)
    }

    fn table(&self) -> &ISVCDecoderVtbl {
        // SAFETY: a live decoder points to its static table of functions.
        unsafe { &**self.decoder }
    }

    fn set_option(
        &mut self,
        option: DECODER_OPTION,
        mut value: c_int,
        doing: &'static str,
    ) -> Result<(), DecodeError> {
        let set = required(self.table().SetOption, doing)?;
        // SAFETY: the decoder is alive; the options used here read one `int`.
        check(unsafe { set(self.decoder, option, ptr::from_mut(&mut value).cast::<c_void>()) }, doing)
    }

    /// Decodes one unit. The picture lies in the library's memory until the next call.
    fn decode(&mut self, access_unit: &[u8]) -> Result<Decoded<'_>, DecodeError> {
        let mut planes = [ptr::null_mut::<u8>(); 3];
        let mut info = SBufferInfo::default();
        let decode = required(self.table().DecodeFrameNoDelay, "decoding")?;
        // `inspect` has limited the length far below the range of `c_int`.
        let length = access_unit.len() as c_int;
        // SAFETY: the decoder is alive and initialised; the unit holds `length` bytes and is only read; the other
        // two are valid places for three pointers and one description.
        let state =
            unsafe { decode(self.decoder, access_unit.as_ptr(), length, planes.as_mut_ptr(), &mut info) };
        if state != 0 {
            return Err(DecodeError::Corrupt { state });
        }
        if info.iBufferStatus != 1 {
            self.flush(&mut planes, &mut info)?;
        }
        Decoded::new(planes, &info)
    }

    /// Takes out the picture that the library holds back.
    fn flush(&mut self, planes: &mut [*mut u8; 3], info: &mut SBufferInfo) -> Result<(), DecodeError> {
        let flush = required(self.table().FlushFrame, "flushing")?;
        // SAFETY: the decoder is alive and initialised; both places are valid for what is written.
        let state = unsafe { flush(self.decoder, planes.as_mut_ptr(), info) };
        if state == 0 { Ok(()) } else { Err(DecodeError::Corrupt { state }) }
    }
}

impl Drop for Library {
    fn drop(&mut self) {
        // SAFETY: the pointer came from `WelsCreateDecoder`, and this is the one place that destroys it. The
        // destructor releases what initialisation allocated.
        unsafe { APILoader::WelsDestroyDecoder(self.decoder) };
    }
}

/// A picture in the library's memory, borrowed until the next call.
struct Decoded<'a> {
    extent_texels: [u32; 2],
    planes: [&'a [u8]; 3],
    strides: [usize; 3],
}

impl Decoded<'_> {
    fn new(planes: [*mut u8; 3], info: &SBufferInfo) -> Result<Self, DecodeError> {
        // SAFETY: the union has this one member, and was zeroed before the library wrote it.
        let memory: TagSysMemBuffer = unsafe { info.UsrData.sSystemBuffer };
        let [width, height] = [memory.iWidth, memory.iHeight].map(|n| usize::try_from(n).unwrap_or(0));
        let [luma_stride, chroma_stride] = memory.iStride.map(|n| usize::try_from(n).unwrap_or(0));
        let complete = info.iBufferStatus == 1
            && memory.iFormat == videoFormatI420
            && planes.iter().all(|plane| !plane.is_null())
            && (2..=luma_stride).contains(&width)
            && width / 2 <= chroma_stride
            && height >= 2;
        if !complete {
            return Err(DecodeError::Corrupt { state: NO_PICTURE });
        }
        let [y, cb, cr] = planes;
        // SAFETY: the library says that a picture of this size lies there, with these strides: every row but the last
        // is followed by another one, and the last holds `width` samples. It stays until the library is called again,
        // which the lifetime of the mutable borrow in `Library::decode` rules out.
        let planes = unsafe {
            [
                std::slice::from_raw_parts(y, luma_stride * (height - 1) + width),
                std::slice::from_raw_parts(cb, chroma_stride * (height / 2 - 1) + width / 2),
                std::slice::from_raw_parts(cr, chroma_stride * (height / 2 - 1) + width / 2),
            ]
        };
        let extent_texels = [width as u32, height as u32];
        Ok(Self { extent_texels, planes, strides: [luma_stride, chroma_stride, chroma_stride] })
    }

    fn copy_to(&self, want: [u32; 2], picture: &mut I420) -> Result<(), DecodeError> {
        if self.extent_texels != want {
            return Err(DecodeError::ExtentMismatch { want, got: self.extent_texels });
        }
        let width = want[0] as usize;
        let packed = picture.refill(want, |bytes| {
            for (plane, width) in [width, width / 2, width / 2].into_iter().enumerate() {
                pack(bytes, self.planes[plane], self.strides[plane], width);
            }
        });
        packed.map_err(|_| DecodeError::Corrupt { state: NO_PICTURE })
    }
}

/// Appends rows of `width` bytes, `stride` apart, without what is between them.
fn pack(to: &mut Vec<u8>, from: &[u8], stride: usize, width: usize) {
    for row in from.chunks(stride) {
        to.extend_from_slice(&row[..width]);
    }
}

fn required<F>(function: Option<F>, doing: &'static str) -> Result<F, DecodeError> {
    function.ok_or(DecodeError::Library { doing, code: MISSING_FUNCTION })
}

fn check(code: c_long, doing: &'static str) -> Result<(), DecodeError> {
    if code == 0 { Ok(()) } else { Err(DecodeError::Library { doing, code }) }
}

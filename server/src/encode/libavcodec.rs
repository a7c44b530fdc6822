//! H.264 by FFmpeg's libavcodec: the encoders of graphics cards, and libx264. It is a separate feature (`libavcodec`): it needs
//! the system's libraries, and libx264 in them puts the whole under the GPL.
//!
//! The rules of [`super::openh264`] apply here too: no deblocking, a constant quantiser, a refresh only on request. Only
//! libx264 changes its quantiser while it is open. The others are reopened for it, which begins with a refresh, so small
//! changes are skipped. A picture comes out before the next goes in: encoders that look ahead are not used. Only libx264 was
//! run; the search, the trial and the skipping of the others were.

use super::openh264::{EncoderSettings, check_picture_extent, check_qp};
use super::{AccessUnit, EncodeError, Encoded, Encoder, Source, encode_one};
use ffmpeg_sys_next as av;
use shadecast_protocol::limits::MAX_ACCESS_UNIT_BYTES;
use shadecast_protocol::picture::I420;
use std::collections::VecDeque;
use std::ffi::{CStr, CString, c_int};
use std::ptr::{self, NonNull};
use std::time::Duration;

/// The quantiser of an encoder that has to be opened anew for another follows changes of at least so much.
const REOPENED_FOR_QP: u8 = 4;
/// Sides of the picture with which an encoder is tried, texels: graphics cards refuse small ones.
const TRIAL_EXTENT_TEXELS: [u32; 2] = [512, 256];
/// The pictures of a trial: which of them are asked for as refreshes.
const TRIAL: [bool; 3] = [true, false, true];
/// The library's unit of quality, in steps of the quantiser (`FF_QP2LAMBDA`).
const LAMBDA_OF_QP: u32 = av::FF_QP2LAMBDA as u32;
/// Kinds of NAL units: sequence and picture parameters, and a slice of a refresh.
const NALS_OF_A_REFRESH: [u8; 3] = [7, 8, 5];
/// A picture that is with the encoder is asked for so often.
const LOOK_UP: Duration = Duration::from_micros(200);

/// An encoder that the library may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Candidate {
    /// Its name in the library.
    pub name: &'static str,
    /// Its options, as the library writes them; `{qp}` is the quantiser, `{lambda}` the same in the library's units of quality,
    /// `{threads}` the number of slices and threads, `{no_deblock}` whether the loop filter is off.
    options: &'static [(&'static str, &'static str)],
    /// The option by which the quantiser changes while it is open.
    live_qp: Option<&'static CStr>,
    /// Planes of chroma in one, as graphics cards want them.
    is_nv12: bool,
    /// Where pictures must be brought to first.
    device: Option<(av::AVHWDeviceType, av::AVPixelFormat)>,
}

/// All that are tried, best first.
pub(crate) const CANDIDATES: [Candidate; 6] = [
    Candidate {
        name: "h264_nvenc",
        options: &[
            ("preset", "p2"),
            ("tune", "ull"),
            ("rc", "constqp"),
            ("qp", "{qp}"),
            ("zerolatency", "1"),
            ("delay", "0"),
            ("forced-idr", "1"),
        ],
        live_qp: None,
        is_nv12: true,
        device: None,
    },
    Candidate {
        name: "h264_vaapi",
        options: &[("rc_mode", "CQP"), ("qp", "{qp}"), ("idr_interval", "0"), ("async_depth", "1")],
        live_qp: None,
        is_nv12: true,
        device: Some((av::AVHWDeviceType::AV_HWDEVICE_TYPE_VAAPI, av::AVPixelFormat::AV_PIX_FMT_VAAPI)),
    },
    Candidate {
        name: "h264_qsv",
        options: &[
            ("preset", "veryfast"),
            ("async_depth", "1"),
            ("forced_idr", "1"),
            ("look_ahead", "0"),
            ("global_quality", "{lambda}"),
            ("flags", "+qscale"),
        ],
        live_qp: None,
        is_nv12: true,
        device: None,
    },
    Candidate {
        name: "h264_amf",
        options: &[
            ("usage", "ultralowlatency"),
            ("quality", "speed"),
            ("rc", "cqp"),
            ("qp_i", "{qp}"),
            ("qp_p", "{qp}"),
            ("header_insertion_mode", "idr"),
            ("forced_idr", "1"),
        ],
        live_qp: None,
        is_nv12: true,
        device: None,
    },
    Candidate {
        name: "h264_vulkan",
        options: &[("rc_mode", "cqp"), ("qp", "{qp}"), ("tune", "ull"), ("async_depth", "1")],
        live_qp: None,
        is_nv12: true,
        device: Some((av::AVHWDeviceType::AV_HWDEVICE_TYPE_VULKAN, av::AVPixelFormat::AV_PIX_FMT_VULKAN)),
    },
    LIBX264,
];

/// On the CPU. A constant rate factor, with all that bends it switched off, is a constant quantiser, and changes from picture to
/// picture. Its presets were compared on atlases: docs/encoders.md.
pub const LIBX264: Candidate = Candidate { options: &X264_SUPERFAST, ..X264 };

/// The same by other presets, for comparison.
pub const X264_PRESETS: [(&str, Candidate); 3] = [
    ("ultrafast", Candidate { options: &X264_ULTRAFAST, ..X264 }),
    ("superfast", LIBX264),
    ("veryfast", Candidate { options: &X264_VERYFAST, ..X264 }),
];

const X264: Candidate =
    Candidate { name: "libx264", options: &[], live_qp: Some(c"crf"), is_nv12: false, device: None };
const X264_PARAMS: &str = "no-deblock={no_deblock}:aq-mode=0:mbtree=0:qcomp=1:ipratio=1:scenecut=0:keyint=infinite:ref=1:\
                           bframes=0:rc-lookahead=0:sync-lookahead=0:sliced-threads=1:slices={threads}:\
                           repeat-headers=1:annexb=1:cabac=1:weightp=0";
const X264_ULTRAFAST: [(&str, &str); 5] = x264("ultrafast");
const X264_SUPERFAST: [(&str, &str); 5] = x264("superfast");
const X264_VERYFAST: [(&str, &str); 5] = x264("veryfast");

const fn x264(preset: &'static str) -> [(&'static str, &'static str); 5] {
    [
        ("preset", preset),
        ("tune", "zerolatency"),
        ("forced-idr", "1"),
        ("crf", "{qp}"),
        ("x264-params", X264_PARAMS),
    ]
}

/// An [`Encoder`] of the library.
pub struct LibavEncoder {
    candidate: Candidate,
    settings: EncoderSettings,
    /// Gone after a failure; made anew for the next picture.
    open: Option<Open>,
    waiting: VecDeque<Waiting>,
}

/// A picture that is not there by now does not come: half of what its session waits for it.
const STALLED_AFTER: Duration = Duration::from_secs(1);

/// A picture that was submitted.
struct Waiting {
    source: Source,
    /// How long it was waited for.
    waited: Duration,
    /// Why there will be nothing of it.
    failed: Option<EncodeError>,
}

/// An encoder of the library with the memory of one picture.
struct Open {
    context: NonNull<av::AVCodecContext>,
    /// In the CPU's memory.
    frame: NonNull<av::AVFrame>,
    packet: NonNull<av::AVPacket>,
    /// Where pictures are brought to first, if anywhere.
    frames: Option<NonNull<av::AVBufferRef>>,
    qp: u8,
}

// SAFETY: an encoder's context, its frame and its packet belong to nobody else, and what changes them takes `&mut self`: one
// thread uses them at a time. The library locks what its contexts share.
unsafe impl Send for Open {}

impl Candidate {
    fn codec(&self) -> Option<NonNull<av::AVCodec>> {
        let name = CString::new(self.name).ok()?;
        // SAFETY: the name is a string of C; what comes back lives as long as the library.
        NonNull::new(unsafe { av::avcodec_find_encoder_by_name(name.as_ptr()) }.cast_mut())
    }

    /// Encodes pictures with it: the first, one that refers to it, and one that a client asks for as a refresh.
    ///
    /// # Errors
    /// Why it is of no use on this machine.
    pub(crate) fn try_out(&self) -> Result<(), EncodeError> {
        let [width, height] = TRIAL_EXTENT_TEXELS;
        let luma = (0..width * height).map(|at| (at.wrapping_mul(2_654_435_761) >> 26) as u8);
        let grey = std::iter::repeat_n(128, (width * height / 2) as usize);
        let picture = I420::new(TRIAL_EXTENT_TEXELS, luma.chain(grey).collect())?;
        let mut encoder = LibavEncoder::new(*self, EncoderSettings::new(TRIAL_EXTENT_TEXELS))?;
        for (number, wants_refresh) in TRIAL.into_iter().enumerate() {
            let source = Source::Planes(picture.clone());
            let unit = encode_one(&mut encoder, source, number as i64 * 33_333_333, wants_refresh)?;
            if wants_refresh && !is_whole_refresh(&unit) {
                let reason =
                    format!("picture {} was asked for as a refresh and is none by itself", number + 1);
                return Err(self.failed("encoding a trial", reason));
            }
        }
        Ok(())
    }

    fn failed(&self, doing: &'static str, reason: String) -> EncodeError {
        EncodeError::Libavcodec { encoder: self.name, doing, reason }
    }

    fn check(&self, doing: &'static str, code: c_int) -> Result<c_int, EncodeError> {
        if code >= 0 { Ok(code) } else { Err(self.failed(doing, words(code))) }
    }
}

/// Whether a decoder can begin with it.
fn is_whole_refresh(unit: &AccessUnit) -> bool {
    unit.is_refresh && NALS_OF_A_REFRESH.iter().all(|kind| nal_types(&unit.bytes).any(|found| found == *kind))
}

/// Types of the NAL units of a byte stream.
fn nal_types(bytes: &[u8]) -> impl Iterator<Item = u8> + '_ {
    bytes.windows(4).filter(|window| window[..3] == [0, 0, 1]).map(|window| window[3] & 31)
}

/// What the library says of one of its codes.
fn words(code: c_int) -> String {
    let mut text = [0; av::AV_ERROR_MAX_STRING_SIZE];
    // SAFETY: the buffer has the length that is said, and the function ends what it writes with a zero.
    unsafe { av::av_strerror(code, text.as_mut_ptr(), text.len()) };
    // SAFETY: as above; it was all zeros before.
    unsafe { CStr::from_ptr(text.as_ptr()) }.to_string_lossy().into_owned()
}

impl LibavEncoder {
    /// Makes an encoder for pictures of one extent.
    ///
    /// # Errors
    /// The settings are outside of their ranges, or this machine has no such encoder.
    pub fn new(candidate: Candidate, settings: EncoderSettings) -> Result<Self, EncodeError> {
        settings.check()?;
        let open = Some(Open::new(&candidate, &settings)?);
        Ok(Self { candidate, settings, open, waiting: VecDeque::new() })
    }

    fn start(&mut self, source: &Source, timestamp_ns: i64, refresh: bool) -> Result<(), EncodeError> {
        let Source::Planes(picture) = source;
        check_picture_extent(self.settings.extent_texels, picture)?;
        let Self { candidate, settings, .. } = self;
        let is_changed = |open: &Open| match candidate.live_qp {
            Some(_) => false,
            None => open.qp.abs_diff(settings.qp) >= REOPENED_FOR_QP,
        };
        let mut open = match self.open.take().filter(|open| !is_changed(open)) {
            Some(open) => open,
            None => Open::new(candidate, settings)?,
        };
        if let Some(option) = candidate.live_qp {
            open.set_qp(candidate, option, settings.qp)?;
        }
        open.send(candidate, picture, timestamp_ns, refresh)?;
        self.open = Some(open);
        Ok(())
    }

    /// The coded form of the oldest picture; `None` while it is not there.
    fn receive(&mut self) -> Option<Result<AccessUnit, EncodeError>> {
        let open = self.open.as_mut()?;
        let received = open.receive(&self.candidate).transpose()?;
        let received = received.and_then(|unit| match unit.bytes.len() {
            got if got > MAX_ACCESS_UNIT_BYTES => Err(EncodeError::TooLong { got }),
            _ => Ok(unit),
        });
        if received.is_err() {
            self.open = None;
        }
        Some(received)
    }
}

impl Encoder for LibavEncoder {
    fn submit(&mut self, source: Source, timestamp_ns: i64, refresh: bool) {
        let failed = self.start(&source, timestamp_ns, refresh).err();
        self.waiting.push_back(Waiting { source, waited: Duration::ZERO, failed });
    }

    fn poll(&mut self, timeout: Duration) -> Option<Encoded> {
        let mut waited = Duration::ZERO;
        loop {
            if let Some(failed) = self.waiting.front_mut()?.failed.take() {
                return self
                    .waiting
                    .pop_front()
                    .map(|Waiting { source, .. }| Encoded { source, result: Err(failed) });
            }
            if self.open.is_none() {
                // It was with an encoder that has failed.
                self.waiting.front_mut()?.failed = Some(EncodeError::Stalled);
                continue;
            }
            if let Some(result) = self.receive() {
                return self.waiting.pop_front().map(|Waiting { source, .. }| Encoded { source, result });
            }
            let oldest = self.waiting.front_mut()?;
            if oldest.waited >= STALLED_AFTER {
                self.open = None;
                continue;
            }
            if waited >= timeout {
                return None;
            }
            std::thread::sleep(LOOK_UP);
            oldest.waited += LOOK_UP;
            waited += LOOK_UP;
        }
    }

    fn set_qp(&mut self, qp: u8) -> Result<(), EncodeError> {
        check_qp(qp)?;
        self.settings.qp = qp;
        Ok(())
    }
}

impl Open {
    fn new(candidate: &Candidate, settings: &EncoderSettings) -> Result<Self, EncodeError> {
        let missing = || {
            candidate.failed("looking for it", "the libavcodec of this machine has no such encoder".into())
        };
        let codec = candidate.codec().ok_or_else(missing)?;
        let doing = "taking memory";
        let none = || candidate.failed(doing, "there is none".into());
        // SAFETY: plain constructors; each gives a pointer of its own, or null.
        let (context, frame, packet) = unsafe {
            av::av_log_set_level(av::AV_LOG_FATAL);
            (av::avcodec_alloc_context3(codec.as_ptr()), av::av_frame_alloc(), av::av_packet_alloc())
        };
        let (Some(context), Some(frame), Some(packet)) =
            (NonNull::new(context), NonNull::new(frame), NonNull::new(packet))
        else {
            return Err(none());
        };
        let mut open = Self { context, frame, packet, frames: None, qp: settings.qp };
        open.describe(candidate, settings);
        open.prepare_device(candidate, settings)?;
        let mut options = options(candidate, settings);
        // SAFETY: the context is new, the codec its own, and the options a dictionary of the library.
        let opened = unsafe { av::avcodec_open2(context.as_ptr(), codec.as_ptr(), &mut options) };
        // SAFETY: what the encoder has not taken is left in the dictionary, which is ours.
        unsafe { av::av_dict_free(&mut options) };
        candidate.check("opening it", opened)?;
        open.take_frame(candidate, settings)?;
        Ok(open)
    }

    /// Extent, colours and rate, and that a picture comes out before the next.
    fn describe(&mut self, candidate: &Candidate, settings: &EncoderSettings) {
        let [width, height] = settings.extent_texels.map(|texels| texels as c_int);
        // SAFETY: nobody else has the context, which is not open.
        let context = unsafe { self.context.as_mut() };
        (context.width, context.height) = (width, height);
        context.pix_fmt = match candidate.device {
            Some((_, format)) => format,
            None => cpu_format(candidate),
        };
        context.time_base = av::AVRational { num: 1, den: 1_000_000 };
        context.framerate = av::AVRational { num: settings.fps as c_int, den: 1 };
        (context.gop_size, context.max_b_frames, context.refs) = (c_int::MAX, 0, 1);
        context.thread_count = settings.threads as c_int;
        context.slices = settings.threads as c_int;
        context.flags |= av::AV_CODEC_FLAG_LOW_DELAY as c_int;
        // Deblocking smears blocks into each other that have nothing to do with each other.
        context.flags &= !(av::AV_CODEC_FLAG_LOOP_FILTER as c_int);
        context.color_range = av::AVColorRange::AVCOL_RANGE_JPEG;
        context.color_primaries = av::AVColorPrimaries::AVCOL_PRI_BT709;
        context.color_trc = av::AVColorTransferCharacteristic::AVCOL_TRC_BT709;
        context.colorspace = av::AVColorSpace::AVCOL_SPC_BT709;
    }

    /// A device, and pictures on it, for an encoder that takes no others.
    fn prepare_device(
        &mut self,
        candidate: &Candidate,
        settings: &EncoderSettings,
    ) -> Result<(), EncodeError> {
        let Some((kind, format)) = candidate.device else { return Ok(()) };
        let mut device = ptr::null_mut();
        // SAFETY: a valid place for the reference that the function makes; no name and no options are given.
        let made = unsafe { av::av_hwdevice_ctx_create(&mut device, kind, ptr::null(), ptr::null_mut(), 0) };
        candidate.check("opening its device", made)?;
        // SAFETY: the device was made; its reference is given up once the frames hold one of their own.
        let frames = unsafe {
            let frames = av::av_hwframe_ctx_alloc(device);
            av::av_buffer_unref(&mut device);
            frames
        };
        let frames = NonNull::new(frames)
            .ok_or_else(|| candidate.failed("taking memory on its device", "there is none".into()))?;
        self.frames = Some(frames);
        let [width, height] = settings.extent_texels.map(|texels| texels as c_int);
        // SAFETY: the data of such a reference is a description of frames, which nobody uses before it is initialised; the
        // context takes a reference of its own.
        let initialised = unsafe {
            let description = &mut *(*frames.as_ptr()).data.cast::<av::AVHWFramesContext>();
            (description.format, description.sw_format) = (format, cpu_format(candidate));
            (description.width, description.height) = (width, height);
            description.initial_pool_size = 4;
            let initialised = av::av_hwframe_ctx_init(frames.as_ptr());
            self.context.as_mut().hw_frames_ctx = av::av_buffer_ref(frames.as_ptr());
            initialised
        };
        candidate.check("preparing pictures on its device", initialised).map(|_| ())
    }

    /// Memory for a picture.
    fn take_frame(&mut self, candidate: &Candidate, settings: &EncoderSettings) -> Result<(), EncodeError> {
        let [width, height] = settings.extent_texels.map(|texels| texels as c_int);
        // SAFETY: nobody else has the frame.
        let taken = unsafe {
            let frame = self.frame.as_mut();
            (frame.width, frame.height, frame.format) = (width, height, cpu_format(candidate) as c_int);
            av::av_frame_get_buffer(self.frame.as_ptr(), 0)
        };
        candidate.check("taking memory for a picture", taken).map(|_| ())
    }

    fn set_qp(&mut self, candidate: &Candidate, option: &CStr, qp: u8) -> Result<(), EncodeError> {
        if self.qp == qp {
            return Ok(());
        }
        // SAFETY: an open context has its encoder's own options behind this pointer.
        let set = unsafe {
            let own = self.context.as_ref().priv_data;
            av::av_opt_set_double(own, option.as_ptr(), qp.into(), 0)
        };
        candidate.check("changing the quantiser", set)?;
        self.qp = qp;
        Ok(())
    }

    fn send(
        &mut self,
        candidate: &Candidate,
        picture: &I420,
        timestamp_ns: i64,
        refresh: bool,
    ) -> Result<(), EncodeError> {
        // SAFETY: the frame is ours; where the encoder still reads it, the library copies it.
        let writable = unsafe { av::av_frame_make_writable(self.frame.as_ptr()) };
        candidate.check("taking memory for a picture", writable)?;
        self.copy_planes(candidate, picture);
        // SAFETY: nobody else has the frame.
        let frame = unsafe { self.frame.as_mut() };
        frame.pts = timestamp_ns / 1000;
        frame.pict_type = match refresh {
            true => av::AVPictureType::AV_PICTURE_TYPE_I,
            false => av::AVPictureType::AV_PICTURE_TYPE_NONE,
        };
        let Some(frames) = self.frames else { return self.send_frame(candidate, self.frame) };
        // SAFETY: as above; a null pointer means that there is no memory.
        let on_device = NonNull::new(unsafe { av::av_frame_alloc() })
            .ok_or_else(|| candidate.failed("taking memory for a picture", "there is none".into()))?;
        // SAFETY: both frames are alive, and the device's has the extent of the other.
        let brought = unsafe {
            let taken = av::av_hwframe_get_buffer(frames.as_ptr(), on_device.as_ptr(), 0);
            let brought = if taken < 0 {
                taken
            } else {
                av::av_hwframe_transfer_data(on_device.as_ptr(), self.frame.as_ptr(), 0)
            };
            av::av_frame_copy_props(on_device.as_ptr(), self.frame.as_ptr());
            brought
        };
        let sent = candidate.check("bringing a picture to its device", brought);
        let sent = sent.and_then(|_| self.send_frame(candidate, on_device));
        // SAFETY: ours; the encoder holds a reference where it needs one.
        unsafe { av::av_frame_free(&mut on_device.as_ptr()) };
        sent
    }

    fn send_frame(&mut self, candidate: &Candidate, frame: NonNull<av::AVFrame>) -> Result<(), EncodeError> {
        // SAFETY: the context is open, and the frame has its extent and format.
        let sent = unsafe { av::avcodec_send_frame(self.context.as_ptr(), frame.as_ptr()) };
        candidate.check("encoding a picture", sent).map(|_| ())
    }

    fn copy_planes(&mut self, candidate: &Candidate, picture: &I420) {
        let [width, height] = picture.extent_texels().map(|texels| texels as usize);
        let [luma, cb, cr] = picture.planes();
        self.rows(0, width, height)
            .zip(luma.chunks_exact(width))
            .for_each(|(row, from)| row.copy_from_slice(from));
        let half = width / 2;
        if candidate.is_nv12 {
            let both = cb.chunks_exact(half).zip(cr.chunks_exact(half));
            for (row, (cb, cr)) in self.rows(1, width, height / 2).zip(both) {
                for (pair, (cb, cr)) in row.chunks_exact_mut(2).zip(cb.iter().zip(cr)) {
                    pair.copy_from_slice(&[*cb, *cr]);
                }
            }
            return;
        }
        for (plane, from) in [(1, cb), (2, cr)] {
            let rows = self.rows(plane, half, height / 2);
            rows.zip(from.chunks_exact(half)).for_each(|(row, from)| row.copy_from_slice(from));
        }
    }

    /// The rows of a plane of the frame in the CPU's memory.
    fn rows(&mut self, plane: usize, bytes: usize, count: usize) -> impl Iterator<Item = &mut [u8]> {
        // SAFETY: nobody else has the frame.
        let frame = unsafe { self.frame.as_mut() };
        let (first, stride) = (frame.data[plane], frame.linesize[plane] as usize);
        // SAFETY: the library made the plane with so many rows, each of at least so many bytes, `stride` apart: they do not
        // overlap, and live as long as the frame, which is borrowed meanwhile.
        (0..count).map(move |row| unsafe { std::slice::from_raw_parts_mut(first.add(row * stride), bytes) })
    }

    fn receive(&mut self, candidate: &Candidate) -> Result<Option<AccessUnit>, EncodeError> {
        // SAFETY: the context is open; the packet is ours.
        let received = unsafe { av::avcodec_receive_packet(self.context.as_ptr(), self.packet.as_ptr()) };
        if received == av::AVERROR(av::EAGAIN) {
            return Ok(None);
        }
        candidate.check("taking a coded picture", received)?;
        // SAFETY: nobody else has the packet.
        let packet = unsafe { self.packet.as_mut() };
        // SAFETY: a packet that was received has so many bytes.
        let bytes = unsafe { std::slice::from_raw_parts(packet.data, packet.size as usize) }.to_vec();
        // SAFETY: ours; its bytes were copied.
        unsafe { av::av_packet_unref(self.packet.as_ptr()) };
        let is_refresh = nal_types(&bytes).any(|kind| kind == NALS_OF_A_REFRESH[2]);
        Ok(Some(AccessUnit { bytes, is_refresh }))
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        let Self { context, frame, packet, frames, .. } = self;
        // SAFETY: all are ours, and nobody uses them after this.
        unsafe {
            av::av_packet_free(&mut packet.as_ptr());
            av::av_frame_free(&mut frame.as_ptr());
            av::avcodec_free_context(&mut context.as_ptr());
            if let Some(frames) = frames {
                av::av_buffer_unref(&mut frames.as_ptr());
            }
        }
    }
}

fn cpu_format(candidate: &Candidate) -> av::AVPixelFormat {
    match candidate.is_nv12 {
        true => av::AVPixelFormat::AV_PIX_FMT_NV12,
        false => av::AVPixelFormat::AV_PIX_FMT_YUV420P,
    }
}

/// The candidate's options with what the settings say; an entry for which there is no memory is left out.
fn options(candidate: &Candidate, settings: &EncoderSettings) -> *mut av::AVDictionary {
    let mut options = ptr::null_mut();
    for (name, value) in candidate.options {
        let value = value
            .replace("{qp}", &settings.qp.to_string())
            .replace("{lambda}", &(u32::from(settings.qp) * LAMBDA_OF_QP).to_string())
            .replace("{threads}", &settings.threads.to_string())
            .replace("{no_deblock}", if settings.loop_filter { "0" } else { "1" });
        if let (Ok(name), Ok(value)) = (CString::new(*name), CString::new(value)) {
            // SAFETY: both are strings of C, which the dictionary copies.
            unsafe { av::av_dict_set(&mut options, name.as_ptr(), value.as_ptr(), 0) };
        }
    }
    options
}

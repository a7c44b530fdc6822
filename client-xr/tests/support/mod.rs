//! A client on the mock runtime in virtual time, behind the system's OpenXR loader, with validation on.

use shadecast_client::client::{Client, ClientOptions, FrameReport, Step};
use shadecast_client::decode::decoding::DecodeTiming;
use shadecast_client::decode::{self, DecodeError, Decoder};
use shadecast_client::display::xr::{Xr, XrOptions};
use shadecast_client::options::USUAL_MSAA;
use shadecast_client::platform::{MakeDecoder, Platform};
use shadecast_gpu::Gpu;
use shadecast_mock_runtime::config::{ClockKind, MockConfig};
use shadecast_mock_runtime::record::{Side, picture_path};
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::message::{Codec, MotionMemory};
use shadecast_protocol::picture::I420;
use shadecast_protocol::time::ClientTime;
use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

pub mod on_device;

/// Pixels of one eye, both ways; 90 degrees.
pub const SIDE: u32 = 256;
/// Pages of settled blocks that clients of tests offer.
const STORE_PAGES: u32 = 6;

/// A run of the runtime in virtual time, captured.
pub struct Run(shadecast_test_support::headset::Run);

impl Run {
    pub fn new(config: MockConfig) -> Self {
        Self::unseen(MockConfig { capture_every: 1, ..config })
    }

    /// The same without pictures, unless the configuration asks for some.
    pub fn unseen(config: MockConfig) -> Self {
        let config = MockConfig { extent_pixels: [SIDE; 2], clock: ClockKind::Virtual, ..config };
        Self(shadecast_test_support::headset::Run::new(&config))
    }

    pub fn captures(&self) -> PathBuf {
        self.0.captures()
    }

    pub fn client(&self) -> Client {
        self.client_with(toy_decoder)
    }

    /// The same with another decoder.
    pub fn client_with(&self, decoder: MakeDecoder) -> Client {
        self.client_of(XrOptions { validation: true, ..XrOptions::default() }, decoder)
    }

    /// The same with a display of another rate.
    pub fn client_at(&self, refresh_hz: f32) -> Client {
        let refresh_hz = Some(refresh_hz);
        self.client_of(XrOptions { validation: true, refresh_hz, ..XrOptions::default() }, toy_decoder)
    }

    /// A client whose decoder leaves pictures in the device's memory.
    pub fn client_on_device(&self, decoder: MakeDecoder) -> Client {
        let options = XrOptions { validation: true, pictures_on_device: true, ..XrOptions::default() };
        self.client_of(options, decoder)
    }

    /// The same that offers so many pages of settled blocks.
    pub fn client_of_pages(&self, store_pages: u32) -> Client {
        let options = XrOptions { validation: true, ..XrOptions::default() };
        self.client_keeping(options, toy_decoder, store_pages)
    }

    fn client_of(&self, options: XrOptions, decoder: MakeDecoder) -> Client {
        self.client_keeping(options, decoder, STORE_PAGES)
    }

    fn client_keeping(&self, options: XrOptions, decoder: MakeDecoder, store_pages: u32) -> Client {
        let xr = Xr::open(&Platform, options).expect("the mock headset opens");
        let options = ClientOptions {
            msaa: Some(USUAL_MSAA),
            decoding: DecodeTiming::Virtual { delay_ns: 6_000_000 },
            max_vertex_slots: 256,
            max_patch_slots: 64,
            max_triangles: 384,
            motion: MotionMemory::DEFAULT,
            decoder,
            store_pages: Some(store_pages),
            blends: Some(true),
            ..ClientOptions::default()
        };
        Client::new(Box::new(xr), options).expect("a client")
    }

    /// The picture of a frame: rows of red, green, blue.
    pub fn picture(&self, frame: u64, side: Side) -> Picture {
        let path = picture_path(&self.captures(), frame, side);
        let file = std::fs::File::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().expect("a PNG");
        let mut rgb = vec![0; reader.output_buffer_size().expect("a size")];
        reader.next_frame(&mut rgb).expect("pixels");
        if let Some(folder) = std::env::var_os("SHADECAST_KEEP_PICTURES") {
            let name = std::thread::current().name().unwrap_or("test").replace("::", "-");
            let kept = PathBuf::from(folder).join(format!("{name}-{frame:03}-{side:?}.png"));
            std::fs::copy(&path, kept).expect("keep the picture");
        }
        Picture { rgb }
    }
}

pub struct Picture {
    rgb: Vec<u8>,
}

impl Picture {
    pub fn at(&self, x: u32, y: u32) -> [u8; 3] {
        let at = ((y * SIDE + x) * 3) as usize;
        [self.rgb[at], self.rgb[at + 1], self.rgb[at + 2]]
    }

    pub fn pixels(&self) -> impl Iterator<Item = [u8; 3]> + '_ {
        self.rgb.chunks_exact(3).map(|pixel| [pixel[0], pixel[1], pixel[2]])
    }
}

/// Steps to the next display frame.
#[track_caller]
pub fn frame(client: &mut Client) -> FrameReport {
    for _ in 0..10 {
        match client.step().expect("a step") {
            Step::Frame(report) => return report,
            Step::Idle => {}
            Step::Exit => panic!("the session has ended"),
        }
    }
    panic!("the session does not begin");
}

/// Drops the client, and fails where Vulkan's validation layers or the runtime had something to say.
#[track_caller]
pub fn finish(run: &Run, client: Client) {
    let gpu: Arc<Gpu> = client.presenter.gpu().clone();
    drop(client);
    assert_eq!(gpu.validation_messages(), 0, "{:?}", gpu.validation_texts());
    let summary = shadecast_mock_runtime::record::read_summary(&run.captures()).expect("a summary");
    assert_eq!(summary.errors, 0, "calls that the runtime refused");
}

/// Where a point of the stage is seen by the left (-1) or right (1) eye of a standing head that looks ahead, in pixels.
pub fn pixel(point: [f32; 3], eye: f32) -> [f32; 2] {
    let (x, y, depth) = (point[0] - eye * 0.0315, point[1] - 1.6, -point[2]);
    let half = SIDE as f32 * 0.5;
    [half + x / depth * half, half - y / depth * half]
}

pub fn at(ns: i64) -> ClientTime {
    ClientTime(ns)
}

/// A decoder of what [`coded`] makes.
pub fn toy_decoder(_: Codec, extent: AtlasExtent, _: &Arc<Gpu>) -> Result<Box<dyn Decoder>, DecodeError> {
    let extent_texels = extent.texels();
    Ok(Box::new(ToyDecoder { extent_texels, has_reference: false, done: VecDeque::new() }))
}

/// Decodes what [`coded`] makes: planes as they are, behind a byte that says whether an earlier picture is needed.
struct ToyDecoder {
    extent_texels: [u32; 2],
    has_reference: bool,
    done: VecDeque<Result<decode::Picture, DecodeError>>,
}

/// A picture as the decoder takes it.
pub fn coded(picture: &I420, is_refresh: bool) -> Vec<u8> {
    [&[u8::from(is_refresh)][..], picture.bytes()].concat()
}

impl ToyDecoder {
    fn decode(&mut self, access_unit: &[u8]) -> Result<decode::Picture, DecodeError> {
        if access_unit[0] == 0 && !self.has_reference {
            return Err(DecodeError::NeedsRefresh);
        }
        self.has_reference = true;
        let picture = I420::new(self.extent_texels, access_unit[1..].to_vec());
        Ok(decode::Picture::Planes(picture.expect("a picture of the agreed extent")))
    }
}

impl Decoder for ToyDecoder {
    fn submit(&mut self, access_unit: &[u8]) {
        let result = self.decode(access_unit);
        self.done.push_back(result);
    }

    fn poll(&mut self, _: Duration) -> Option<Result<decode::Picture, DecodeError>> {
        self.done.pop_front()
    }

    fn recycle(&mut self, _: decode::Picture) {}

    fn unit_lost(&mut self) {
        self.has_reference = false;
    }

    fn needs_refresh(&self) -> bool {
        !self.has_reference
    }
}

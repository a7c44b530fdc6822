//! The state machine against a scripted codec.

use super::*;
use rand::rngs::SmallRng;
use rand::{Rng, SeedableRng};
use shadecast_gpu::{DesktopDevice, Gpu, GpuOptions, Needs, YcbcrFormat, YcbcrSampler, vk};
use std::sync::Mutex;

const EXTENT: [u32; 2] = [64, 32];
const AT_ONCE: Duration = Duration::ZERO;

/// What the codecs of a test were told, and what they will do.
#[derive(Default)]
struct Script {
    /// How each codec was begun, with its headers.
    begun: Vec<Headers>,
    /// The newest codec's voice.
    says: Option<Sender<CodecEvent>>,
    /// Input, length and time.
    queued: Vec<(usize, usize, u64)>,
    released: Vec<(usize, bool)>,
    /// Times of images that are written.
    written: VecDeque<u64>,
    given_back: usize,
    refuses_input: bool,
    refuses_to_begin: bool,
}

/// Each unit's picture is in the image of its number, over and over.
const DISTINCT: usize = 32;

struct Scripted {
    script: Arc<Mutex<Script>>,
    images: Arc<[Arc<YcbcrImage>]>,
}

struct Lease(Arc<Mutex<Script>>);

impl Drop for Lease {
    fn drop(&mut self) {
        self.0.lock().unwrap().given_back += 1;
    }
}

impl PlatformCodec for Scripted {
    fn queue(&mut self, input: usize, unit: &[u8], time_us: u64) -> Result<(), DecodeError> {
        let mut script = self.script.lock().unwrap();
        script.queued.push((input, unit.len(), time_us));
        if script.refuses_input { Err(failed("handing over a unit", "scripted")) } else { Ok(()) }
    }

    fn release(&mut self, output: usize, is_shown: bool) -> Result<(), DecodeError> {
        self.script.lock().unwrap().released.push((output, is_shown));
        Ok(())
    }

    fn take_image(&mut self) -> Result<Option<(u64, LentImage)>, DecodeError> {
        let time_us = self.script.lock().unwrap().written.pop_front();
        Ok(time_us.map(|time_us| {
            let image = self.images[(time_us / UNIT_US) as usize % DISTINCT].clone();
            (time_us, LentImage { image, lease: Box::new(Lease(self.script.clone())) })
        }))
    }
}

struct Bench {
    script: Arc<Mutex<Script>>,
    images: Arc<[Arc<YcbcrImage>]>,
    decoder: PlatformDecoder<Scripted>,
}

impl Bench {
    fn new() -> Self {
        let options = GpuOptions { needs: Needs::ClientOfPictures, validation: true, device_name: None };
        let gpu = Gpu::open(&options, &DesktopDevice).expect("a Vulkan device");
        let format = YcbcrFormat::Known(vk::Format::G8_B8R8_2PLANE_420_UNORM);
        let sampler = YcbcrSampler::new(&gpu, format).unwrap();
        let image = |_| Arc::new(YcbcrImage::new(&gpu, &sampler, EXTENT).unwrap());
        let images: Arc<[_]> = (0..DISTINCT).map(image).collect();
        let of_codec = images.clone();
        let script = Arc::<Mutex<Script>>::default();
        let of_codecs = script.clone();
        let make: MakeCodec<Scripted> = Box::new(move |extent, headers, says| {
            assert_eq!(extent, EXTENT);
            let mut script = of_codecs.lock().unwrap();
            if script.refuses_to_begin {
                return Err(failed("beginning", "scripted"));
            }
            script.begun.push(headers.clone());
            script.says = Some(says);
            Ok(Scripted { script: of_codecs.clone(), images: of_codec.clone() })
        });
        Self { script, images, decoder: PlatformDecoder::new(EXTENT, make).unwrap() }
    }

    fn script(&self) -> std::sync::MutexGuard<'_, Script> {
        self.script.lock().unwrap()
    }

    fn say(&self, event: CodecEvent) {
        // A codec that was thrown away is not heard.
        let _ = self.script().says.as_ref().expect("a codec").send(event);
    }

    /// The codec has decoded the unit of this number.
    fn decode(&mut self, output: usize, unit: u64) {
        self.say(CodecEvent::Output(output, unit * UNIT_US));
        self.decoder.pump();
    }

    /// And written its picture to an image.
    fn write(&mut self, unit: u64) {
        self.script().written.push_back(unit * UNIT_US);
        self.say(CodecEvent::Image);
    }

    fn poll(&mut self) -> Option<Result<Picture, DecodeError>> {
        self.decoder.poll(AT_ONCE)
    }

    fn picture(&mut self) -> Picture {
        self.poll().expect("it is done").expect("a picture")
    }
}

/// A sequence header of Baseline for pictures of an extent in whole macroblocks.
fn sequence_header(extent_texels: [u32; 2]) -> Vec<u8> {
    let mut bits = String::new();
    let number = |bits: &mut String, value: u32| {
        let code = format!("{:b}", value + 1);
        bits.extend(std::iter::repeat_n('0', code.len() - 1));
        bits.push_str(&code);
    };
    // Its number, the length of picture numbers, their order as they come, one reference, no gaps.
    [0, 0, 2, 1].into_iter().for_each(|value| number(&mut bits, value));
    bits.push('0');
    extent_texels.into_iter().for_each(|side| number(&mut bits, side / 16 - 1));
    // Whole frames, no cropping, nothing about colours, the end.
    bits.push_str("11001");
    let bytes = bits.as_bytes().chunks(8).map(|byte| {
        let text = std::str::from_utf8(byte).unwrap();
        u8::from_str_radix(&format!("{text:0<8}"), 2).unwrap()
    });
    [0x67, 66, 0, 30].into_iter().chain(bytes).collect()
}

fn unit(parts: &[&[u8]]) -> Vec<u8> {
    parts.iter().flat_map(|part| START_CODE.iter().chain(*part).copied()).collect()
}

fn refresh() -> Vec<u8> {
    unit(&[&sequence_header(EXTENT), &[0x68, 1, 2, 3], &[0x65, 4, 5, 6]])
}

fn later() -> Vec<u8> {
    unit(&[&[0x41, 7, 8]])
}

#[test]
fn a_unit_waits_for_an_input_buffer_and_its_picture_for_an_image() {
    let mut bench = Bench::new();
    assert!(bench.decoder.needs_refresh());
    bench.decoder.submit(&refresh());
    assert!(!bench.decoder.needs_refresh());
    let headers = Headers { sequence: unit(&[&sequence_header(EXTENT)]), picture: unit(&[&[0x68, 1, 2, 3]]) };
    assert_eq!(bench.script().begun, [headers]);
    assert!(bench.script().queued.is_empty() && bench.poll().is_none());
    bench.say(CodecEvent::Input(3));
    assert!(bench.poll().is_none());
    assert_eq!(bench.script().queued, [(3, refresh().len(), 0)]);
    bench.decoder.submit(&later());
    bench.say(CodecEvent::Input(1));
    assert!(bench.poll().is_none());
    assert_eq!(bench.script().queued[1..], [(1, later().len(), UNIT_US)]);
    bench.decode(7, 0);
    assert_eq!(bench.script().released, [(7, true)]);
    assert!(bench.poll().is_none(), "it is not written");
    bench.write(0);
    let Picture::OnDevice(picture) = bench.picture() else { panic!("in the device's memory") };
    assert!(picture.is_foreign && bench.poll().is_none());
    assert_eq!(bench.script().given_back, 0);
    drop(picture);
    assert_eq!(bench.script().given_back, 1);
}

#[test]
fn a_picture_that_is_ready_ends_the_wait_for_it() {
    let mut bench = Bench::new();
    bench.decoder.submit(&refresh());
    bench.say(CodecEvent::Input(0));
    bench.decode(0, 0);
    let script = bench.script.clone();
    let writes = std::thread::spawn(move || {
        let mut script = script.lock().unwrap();
        script.written.push_back(0);
        script.says.as_ref().unwrap().send(CodecEvent::Image).unwrap();
    });
    let picture = bench.decoder.poll(Duration::from_secs(60)).expect("before a minute is over");
    assert!(picture.is_ok());
    writes.join().unwrap();
}

#[test]
fn a_picture_is_written_only_where_the_one_before_was_taken() {
    let mut bench = Bench::new();
    for number in 0..3 {
        bench.decoder.submit(&if number == 0 { refresh() } else { later() });
        bench.say(CodecEvent::Input(number));
    }
    assert!(bench.poll().is_none());
    (0..3).for_each(|number| bench.decode(number, number as u64));
    for number in 0..3 {
        assert!(bench.poll().is_none());
        let released: Vec<_> = (0..=number).map(|output| (output, true)).collect();
        assert_eq!(bench.script().released, released, "what is written over is lost");
        bench.write(number as u64);
        drop(bench.picture());
    }
}

#[test]
fn images_are_limited_and_reused() {
    let mut bench = Bench::new();
    let mut held = Vec::new();
    for number in 0..MAX_LENT as u64 + 3 {
        bench.decoder.submit(&if number == 0 { refresh() } else { later() });
        bench.say(CodecEvent::Input(number as usize));
        assert!(bench.poll().is_none());
        bench.decode(number as usize, number);
        if number < MAX_LENT as u64 {
            bench.write(number);
            held.push(bench.picture());
        }
    }
    assert_eq!(bench.script().released.len(), MAX_LENT);
    // The client, not the codec, is slow: nobody gives up.
    for _ in 0..3 {
        assert!(bench.decoder.poll(PATIENCE / 1000).is_none());
        bench.decoder.waited = Duration::ZERO;
    }
    for number in MAX_LENT as u64..MAX_LENT as u64 + 3 {
        drop(held.remove(0));
        assert!(bench.poll().is_none());
        assert_eq!(bench.script().released.len(), number as usize + 1);
        bench.write(number);
        held.push(bench.picture());
    }
    drop(held);
    assert_eq!(bench.script().given_back, MAX_LENT + 3);
    assert_eq!(bench.decoder.lent.load(Ordering::Acquire), 0);
}

#[test]
fn before_a_refresh_nothing_reaches_a_codec() {
    let mut bench = Bench::new();
    bench.decoder.submit(&later());
    assert!(matches!(bench.poll(), Some(Err(DecodeError::NeedsRefresh))));
    bench.decoder.submit(&unit(&[&sequence_header([128, 32]), &[0x65, 1]]));
    assert!(matches!(bench.poll(), Some(Err(DecodeError::ExtentMismatch { .. }))));
    bench.decoder.submit(&unit(&[&[0x78, 1]]));
    assert!(matches!(bench.poll(), Some(Err(DecodeError::UnexpectedUnit { nal_type: 24 }))));
    bench.decoder.submit(&[]);
    assert!(matches!(bench.poll(), Some(Err(DecodeError::NeedsRefresh))));
    assert!(bench.script().begun.is_empty());
    assert!(matches!(
        PlatformDecoder::<Scripted>::new([15, 16], Box::new(|_, _, _| unreachable!())),
        Err(DecodeError::Extent(_))
    ));
}

#[test]
fn after_a_lost_unit_the_same_codec_goes_on_with_a_refresh() {
    let mut bench = Bench::new();
    bench.decoder.submit(&refresh());
    bench.decoder.unit_lost();
    bench.decoder.submit(&later());
    bench.decoder.submit(&refresh());
    (0..2).for_each(|input| bench.say(CodecEvent::Input(input)));
    assert!(bench.poll().is_none());
    bench.decode(0, 0);
    bench.write(0);
    assert!(matches!(bench.poll(), Some(Ok(Picture::OnDevice(_)))));
    assert!(matches!(bench.poll(), Some(Err(DecodeError::NeedsRefresh))));
    bench.decode(1, 2);
    bench.write(2);
    assert!(matches!(bench.poll(), Some(Ok(Picture::OnDevice(_)))));
    assert_eq!(bench.script().begun.len(), 1);
}

#[test]
fn the_next_refresh_replaces_a_failed_codec() {
    let mut bench = Bench::new();
    bench.decoder.submit(&refresh());
    bench.decoder.submit(&later());
    bench.say(CodecEvent::Input(0));
    assert!(bench.poll().is_none());
    bench.say(CodecEvent::Failed("the hardware is gone".into()));
    let Some(Err(error)) = bench.poll() else { panic!("an error") };
    let text = "the platform's decoder failed while decoding: the hardware is gone";
    assert_eq!(error.to_string(), text);
    assert!(matches!(bench.poll(), Some(Err(DecodeError::NeedsRefresh))));
    bench.decoder.submit(&later());
    assert!(matches!(bench.poll(), Some(Err(DecodeError::NeedsRefresh))));
    bench.decoder.submit(&refresh());
    assert_eq!(bench.script().begun.len(), 2);
    bench.say(CodecEvent::Input(0));
    assert!(bench.poll().is_none());
    bench.decode(0, 3);
    bench.write(3);
    assert!(matches!(bench.poll(), Some(Ok(Picture::OnDevice(_)))));
}

#[test]
fn a_codec_that_cannot_begin_is_an_error() {
    let mut bench = Bench::new();
    bench.script().refuses_to_begin = true;
    bench.decoder.submit(&refresh());
    assert!(matches!(bench.poll(), Some(Err(DecodeError::Platform { doing: "beginning", .. }))));
    assert!(bench.decoder.needs_refresh());
    bench.script().refuses_to_begin = false;
    bench.script().refuses_input = true;
    bench.decoder.submit(&refresh());
    bench.say(CodecEvent::Input(0));
    assert!(matches!(bench.poll(), Some(Err(DecodeError::Platform { doing: "handing over a unit", .. }))));
    bench.script().refuses_input = false;
    bench.decoder.submit(&refresh());
    bench.say(CodecEvent::Input(0));
    assert!(bench.poll().is_none());
    bench.decode(0, 2);
    bench.write(2);
    assert!(matches!(bench.poll(), Some(Ok(Picture::OnDevice(_)))));
}

#[test]
fn a_skipped_picture_costs_its_dependents_but_no_refresh() {
    let mut bench = Bench::new();
    for number in 0..3 {
        bench.decoder.submit(&if number == 0 { refresh() } else { later() });
        bench.say(CodecEvent::Input(number));
    }
    assert!(bench.poll().is_none());
    bench.decode(0, 0);
    bench.write(0);
    assert!(matches!(bench.poll(), Some(Ok(_))));
    // The second never comes.
    bench.decode(1, 2);
    bench.write(2);
    assert!(matches!(bench.poll(), Some(Err(DecodeError::Platform { .. }))));
    assert!(matches!(bench.poll(), Some(Err(DecodeError::NeedsRefresh))));
    assert!(bench.decoder.needs_refresh());
    // Of a refresh the same is harmless.
    let mut bench = Bench::new();
    bench.decoder.submit(&refresh());
    bench.decoder.submit(&refresh());
    (0..2).for_each(|input| bench.say(CodecEvent::Input(input)));
    assert!(bench.poll().is_none());
    bench.decode(0, 1);
    bench.write(1);
    assert!(matches!(bench.poll(), Some(Err(DecodeError::Platform { .. }))));
    assert!(matches!(bench.poll(), Some(Ok(_))));
    assert!(!bench.decoder.needs_refresh() && bench.script().begun.len() == 1);
}

#[test]
fn unrequested_outputs_and_images_are_released() {
    let mut bench = Bench::new();
    bench.decoder.submit(&refresh());
    bench.say(CodecEvent::Input(0));
    assert!(bench.poll().is_none());
    bench.say(CodecEvent::Output(5, 123));
    bench.decode(6, 0);
    assert_eq!(bench.script().released, [(5, false), (6, true)]);
    // Rounded by the codec, say.
    bench.script().written.push_back(777);
    bench.say(CodecEvent::Image);
    assert!(bench.poll().is_none());
    assert_eq!(bench.script().given_back, 1);
    assert_eq!(bench.decoder.lent.load(Ordering::Acquire), 0);
}

#[test]
fn a_codec_that_gives_nothing_for_a_second_is_given_up() {
    let mut bench = Bench::new();
    bench.decoder.submit(&refresh());
    bench.decoder.waited = PATIENCE;
    let Some(Err(error)) = bench.decoder.poll(Duration::from_millis(1)) else { panic!("it is given up") };
    assert!(error.to_string().ends_with("nothing came of it for 1s"), "{error}");
    assert!(bench.decoder.needs_refresh() && bench.poll().is_none());
}

#[test]
fn decoders_on_the_cpu_are_known_by_their_names() {
    for name in ["OMX.google.h264.decoder", "c2.android.avc.decoder", "c2.google.avc.decoder"] {
        assert!(is_software(name), "{name}");
    }
    for name in ["OMX.qcom.video.decoder.avc", "c2.qti.avc.decoder", "c2.exynos.h264.decoder"] {
        assert!(!is_software(name), "{name}");
    }
}

/// A codec that does anything that a codec may do, at random, and what came out of it.
struct Chance {
    bench: Bench,
    dice: SmallRng,
    /// Of each unit whether it is a refresh, and whether another before it was lost.
    units: Vec<(bool, bool)>,
    is_lost: bool,
    /// How many came out, and whether the last one had its picture.
    came_out: usize,
    was_shown: bool,
    shown: usize,
    held: VecDeque<Picture>,
    /// With the newest codec: inputs that it offers, units that it has, those that are decoded, those that are to be written.
    begun: usize,
    inputs: Vec<usize>,
    decoded: Vec<(usize, u64)>,
}

impl Chance {
    fn new(seed: u64) -> Self {
        Self {
            bench: Bench::new(),
            dice: SmallRng::seed_from_u64(seed),
            units: Vec::new(),
            is_lost: false,
            came_out: 0,
            was_shown: false,
            shown: 0,
            held: VecDeque::new(),
            begun: 0,
            inputs: Vec::new(),
            decoded: Vec::new(),
        }
    }

    fn submit(&mut self, is_refresh: bool) {
        self.units.push((is_refresh, std::mem::take(&mut self.is_lost)));
        self.bench.decoder.submit(&if is_refresh { refresh() } else { later() });
    }

    /// The codec takes a step. A new one has nothing of the one before.
    fn run_codec(&mut self, leaves_out: bool) {
        let begun = self.bench.script().begun.len();
        if begun == 0 {
            return;
        }
        if begun != std::mem::replace(&mut self.begun, begun) {
            self.inputs = (0..3).collect();
            self.decoded.clear();
            let mut script = self.bench.script();
            script.queued.clear();
            script.released.clear();
            script.written.clear();
        }
        if let Some(input) = self.inputs.pop() {
            self.bench.say(CodecEvent::Input(input));
        }
        let queued: Vec<_> = self.bench.script().queued.drain(..).collect();
        for (input, _, time_us) in queued {
            self.inputs.push(input);
            if !leaves_out {
                self.decoded.push((input, time_us));
                self.bench.say(CodecEvent::Output(input, time_us));
            }
        }
        let released: Vec<_> = self.bench.script().released.drain(..).collect();
        for (output, is_shown) in released {
            let at = self.decoded.iter().position(|(index, _)| *index == output).expect("an output");
            let (_, time_us) = self.decoded.remove(at);
            if is_shown {
                self.bench.script().written.push_back(time_us);
                self.bench.say(CodecEvent::Image);
            }
        }
        assert!(self.bench.decoder.lent.load(Ordering::Acquire) <= MAX_LENT);
    }

    /// Each unit comes out once, in order, with its own picture or an error, and with none that another one is missing for.
    fn poll(&mut self) {
        while let Some(result) = self.bench.decoder.poll(AT_ONCE) {
            let number = self.came_out;
            let (is_refresh, is_after_loss) = self.units[number];
            self.came_out += 1;
            let before = std::mem::replace(&mut self.was_shown, result.is_ok());
            if let Ok(picture) = result {
                assert!(
                    is_refresh || (before && !is_after_loss),
                    "unit {number} refers to one that is missing"
                );
                let Picture::OnDevice(on_device) = &picture else { panic!("in the device's memory") };
                assert!(
                    Arc::ptr_eq(&on_device.image, &self.bench.images[number % DISTINCT]),
                    "unit {number}"
                );
                self.held.push_back(picture);
                self.shown += 1;
            }
        }
    }

    fn step(&mut self) {
        match self.dice.random_range(0..100) {
            0..30 => {
                let is_refresh = self.bench.decoder.needs_refresh() || self.dice.random_bool(0.05);
                // Now and then nobody has heard that a refresh is needed.
                let is_heard = self.dice.random_bool(0.9);
                self.submit(is_refresh && is_heard);
            }
            30..70 => {
                let leaves_out = self.dice.random_bool(0.02);
                self.run_codec(leaves_out);
            }
            70..71 => {
                self.bench.decoder.unit_lost();
                self.is_lost = true;
            }
            71..72 if self.begun > 0 => self.bench.say(CodecEvent::Failed("chance".into())),
            72..86 => drop(self.held.pop_front()),
            _ => self.poll(),
        }
    }
}

#[test]
fn each_unit_comes_out_once_in_order_whatever_the_codec_does() {
    for seed in 0..12 {
        let mut chance = Chance::new(seed);
        (0..4000).for_each(|_| chance.step());
        // A codec that does as it should, and a client that gives everything back.
        chance.submit(true);
        for _ in 0..200 {
            chance.held.clear();
            chance.run_codec(false);
            chance.poll();
        }
        if chance.came_out < chance.units.len() {
            // Left out by the codec, and no picture came after it.
            chance.bench.decoder.waited = PATIENCE + PATIENCE;
            let given_up = chance.bench.decoder.poll(Duration::from_millis(1));
            assert!(matches!(given_up, Some(Err(_))), "seed {seed}: {given_up:?}");
            chance.came_out += 1;
            chance.poll();
        }
        assert_eq!(chance.came_out, chance.units.len(), "seed {seed}");
        assert!(chance.shown > 200, "seed {seed}: {} pictures of {}", chance.shown, chance.units.len());
        chance.held.clear();
        assert_eq!(chance.bench.decoder.lent.load(Ordering::Acquire), 0);
    }
}

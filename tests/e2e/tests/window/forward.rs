//! The forward renderer's window on its own display (Xvfb), and its videos.

use crate::display::{Display, colours};
use crate::x11::{self, Connection};
use shadecast_client::decode::openh264::OpenH264Decoder;
use shadecast_client::decode::{Decoder, Picture};
use shadecast_lab::image::Rgb8Image;
use shadecast_protocol::picture::I420;
use shadecast_server::encode::picture::rgb_of;
use shadecast_server::truth::video::Video;
use shadecast_test_support::programs::{Program, Voice, output_of, program, wait_until};
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

const SIZE: &str = "160x120";
const SCREEN: [u32; 2] = [320, 240];

fn server() -> Command {
    let mut command = Command::new(program("shadecast-server"));
    command.args(["forward", "dragon", "--size", SIZE, "--start", "0.4", "--fps", "10", "--validation"]);
    command.env_remove("WAYLAND_DISPLAY").env_remove("WAYLAND_SOCKET").env_remove("DISPLAY");
    command
}

#[track_caller]
fn succeeds(output: &Output) {
    assert!(output.status.success(), "{}: {}", output.status, String::from_utf8_lossy(&output.stderr));
}

fn image(path: PathBuf) -> Rgb8Image {
    Rgb8Image::read_png(&path).unwrap()
}

#[test]
fn window_shows_what_the_headless_renderer_renders() {
    let (display, folder) = (Display::start(SCREEN), tempfile::tempdir().unwrap());
    let shot = folder.path().join("window.png");
    let mut window = server();
    window.args(["--window", "--frames", "3", "--no-figures", "--screenshot"]).arg(&shot);
    succeeds(&output_of(window.env("DISPLAY", display.name())));
    succeeds(&output_of(server().args(["--frames", "3", "--out"]).arg(folder.path())));
    let (window, headless) = (image(shot), image(folder.path().join("forward-000002.png")));
    assert_eq!((window.width, window.height), (headless.width, headless.height));
    let worst = window.data.iter().zip(&headless.data).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(worst <= Some(2), "{worst:?}: the same camera and time, through the window's format");
    let earlier = image(folder.path().join("forward-000000.png"));
    assert!(earlier.data != headless.data, "time passes from frame to frame");
}

#[test]
fn the_picture_fills_the_window_and_escape_ends_the_program() {
    let display = Display::start(SCREEN);
    let before = display.screen();
    let mut window = server();
    window.args(["--window", "--seconds", "300"]).env("DISPLAY", display.name());
    let window = Program::start(window.stdout(Stdio::null()), Voice::Errors);
    assert!(colours(&before) < 10, "there is something on the screen before the window");
    wait_until("the window shows a picture", || colours(&display.screen()) >= 500);
    let mut user = Connection::open(display.number()).unwrap();
    for extent in [[300, 200], [120, 90], [310, 220]] {
        user.resize(extent).unwrap();
    }
    let corner = (210 * SCREEN[0] + 300) as usize * 4;
    let is_drawn = || display.screen()[corner..][..3] != before[corner..][..3];
    wait_until("what the larger window has won is drawn", is_drawn);
    user.focus().unwrap();
    user.press(x11::KEY_F).unwrap();
    user.press(x11::KEY_ESCAPE).unwrap();
    window.ends_well();
}

#[test]
fn without_a_display_the_error_says_what_to_do() {
    let output = output_of(server().arg("--window"));
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success());
    for part in ["no window can be opened here", "DISPLAY", "--out FOLDER", ".mp4"] {
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn y4m_on_standard_output_is_the_headless_pictures_in_planes() {
    let folder = tempfile::tempdir().unwrap();
    let piped = output_of(server().args(["--frames", "2", "--out", "-"]));
    succeeds(&piped);
    succeeds(&output_of(server().args(["--frames", "2", "--out"]).arg(folder.path())));
    let header = piped.stdout.iter().position(|byte| *byte == b'\n').unwrap() + 1;
    let frames: Vec<&[u8]> = piped.stdout[header..].chunks(6 + 160 * 120 * 3 / 2).collect();
    assert_eq!(frames.len(), 2);
    for (n, frame) in frames.into_iter().enumerate() {
        assert!(frame.starts_with(b"FRAME\n"));
        let still = image(folder.path().join(format!("forward-{n:06}.png")));
        let picture = I420::new([160, 120], frame[6..].to_vec()).unwrap();
        assert_close(&rgb_of(&picture), &still.data, 32.0);
    }
}

#[test]
fn mp4_decodes_to_the_pictures_that_went_in() {
    const EXTENT: [u32; 2] = [160, 96];
    let path = tempfile::tempdir().unwrap().keep().join("clip.mp4");
    let mut video = Video::create(&path, EXTENT, 25.0, 18).unwrap();
    let pictures: Vec<Vec<u8>> = (0..4).map(|n| moving_picture(EXTENT, n)).collect();
    pictures.iter().for_each(|rgb8| video.add(rgb8).unwrap());
    video.finish().unwrap();
    let size = std::fs::metadata(&path).unwrap().len();
    let mut reader = mp4::Mp4Reader::read_header(std::fs::File::open(&path).unwrap(), size).unwrap();
    let track = &reader.tracks()[&1];
    assert_eq!((track.width(), track.height(), track.sample_count()), (160, 96, 4));
    assert!((track.frame_rate() - 25.0).abs() < 0.1, "{}", track.frame_rate());
    let sets = [track.sequence_parameter_set().unwrap(), track.picture_parameter_set().unwrap()];
    let mut stream: Vec<u8> = sets.iter().flat_map(|set| annex_b(set)).collect();
    let mut decoder = OpenH264Decoder::new(EXTENT).unwrap();
    for (n, expected) in pictures.iter().enumerate() {
        let sample = reader.read_sample(1, n as u32 + 1).unwrap().unwrap();
        assert_eq!(sample.is_sync, n == 0);
        stream.extend(units(&sample.bytes).flat_map(annex_b));
        decoder.submit(&stream);
        let Picture::Planes(picture) = decoder.poll(Duration::ZERO).unwrap().unwrap() else { panic!() };
        assert_close(&rgb_of(&picture), expected, 34.0);
        stream.clear();
    }
    std::fs::remove_dir_all(path.parent().unwrap()).unwrap();
}

fn moving_picture([width, height]: [u32; 2], n: u32) -> Vec<u8> {
    let pixel = |i: u32| {
        let (x, y) = (i % width, i / width);
        [(x + n * 4) as u8, (y * 2) as u8, 128]
    };
    (0..width * height).flat_map(pixel).collect()
}

fn annex_b(unit: &[u8]) -> Vec<u8> {
    [&[0, 0, 0, 1], unit].concat()
}

/// Units behind their lengths.
fn units(mut sample: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let (length, rest) = sample.split_first_chunk::<4>()?;
        let (unit, rest) = rest.split_at(u32::from_be_bytes(*length) as usize);
        sample = rest;
        Some(unit)
    })
}

/// The peak signal-to-noise ratio of two pictures is at least so many decibels.
#[track_caller]
fn assert_close(found: &[u8], expected: &[u8], least_db: f64) {
    assert_eq!(found.len(), expected.len());
    let square = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b)).powi(2);
    let mean = found.iter().zip(expected).map(square).sum::<f64>() / found.len() as f64;
    let db = 10.0 * (255.0f64.powi(2) / mean.max(1e-9)).log10();
    assert!(db >= least_db, "{db:.1} dB");
}

//! What a run in virtual time is made with.

use shadecast_protocol::atlas::AtlasExtent;
use shadecast_scene::load::SceneSource;
use shadecast_server::scene_gpu::SceneOptions;
use shadecast_transport::{LinkProfile, LinkSchedule};
use std::path::PathBuf;
use std::str::FromStr;

/// Which of the three renderers makes the pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Renderer {
    /// The ground truth, compared with itself: a check of the measurement.
    Forward,
    /// The atlas pipeline, handed over in memory.
    Local,
    /// The atlas pipeline over codec, encryption and the simulated link.
    Stream,
}

impl Renderer {
    /// As in `stats.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward",
            Self::Local => "local",
            Self::Stream => "stream",
        }
    }
}

/// How long stages take in virtual time, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StageMs {
    /// From an update's start to its delta's departure.
    pub server: f64,
    /// From there to the picture's departure.
    pub encode: f64,
    /// From a picture's arrival to its use.
    pub decode: f64,
}

impl Default for StageMs {
    fn default() -> Self {
        Self { server: 12.0, encode: 8.0, decode: 6.0 }
    }
}

impl StageMs {
    /// Milliseconds as nanoseconds.
    pub fn ns(self, ms: f64) -> i64 {
        (ms * 1e6) as i64
    }
}

impl FromStr for StageMs {
    type Err = String;

    /// `server=12,encode=8,decode=6`; each is optional.
    fn from_str(text: &str) -> Result<Self, String> {
        let mut stages = Self::default();
        for part in text.split(',') {
            let (key, value) =
                part.split_once('=').ok_or_else(|| format!("\"{part}\" is not stage=milliseconds"))?;
            let value: f64 =
                value.parse().map_err(|_| format!("\"{value}\" is not a number of milliseconds"))?;
            if !(0.0..=1000.0).contains(&value) {
                return Err(format!("{key}={value}: must lie between 0 and 1000 ms"));
            }
            match key {
                "server" => stages.server = value,
                "encode" => stages.encode = value,
                "decode" => stages.decode = value,
                _ => return Err(format!("\"{key}\" is no stage; there are server, encode and decode")),
            }
        }
        Ok(stages)
    }
}

/// Where the head goes in a run.
#[derive(Clone, Debug, Default)]
pub enum Head {
    /// A few steps.
    #[default]
    Walk,
    /// A CSV file, as the mock runtime reads it.
    File(PathBuf),
    /// A head path of the scene by its name; its time 0 is the first display frame.
    Named(String),
}

/// A run.
#[derive(Clone, Debug)]
pub struct RunOptions {
    /// What is shown.
    pub scene: SceneSource,
    /// How.
    pub renderer: Renderer,
    /// The simulated network.
    pub link: LinkSchedule,
    /// Where the head goes.
    pub head: Head,
    /// Virtual seconds.
    pub seconds: f64,
    /// Pixels per eye.
    pub extent_pixels: [u32; 2],
    /// Field of view, degrees from side to side and from top to bottom.
    pub fov_degrees: f32,
    /// Seed of link and connection.
    pub seed: u64,
    /// Folder for what comes out.
    pub out: PathBuf,
    /// Every so many display frames pictures of client and truth are kept; 0: none.
    pub dump_every: u32,
    /// Every so many display frames client and truth are compared.
    pub compare_every: u32,
    /// Durations of stages.
    pub stages: StageMs,
    /// Validation layers on both sides.
    pub validation: bool,
    /// Part of the server's device's name.
    pub device: Option<String>,
    /// Quantisation of the atlas.
    pub qp: u8,
    /// Atlas width and height in texels.
    pub atlas_extent_texels: AtlasExtent,
    /// Updates per second.
    pub rate_hz: f64,
    /// Display frames per second.
    pub refresh_hz: f64,
    /// Sampling and skinning.
    pub scene_options: SceneOptions,
    /// Follows animated vertices at every display frame and compares them with the source curves.
    pub motion: bool,
    /// Prints a progress bar and a summary.
    pub verbose: bool,
}

impl RunOptions {
    /// What the acceptance runs use: 512x512 per eye, 20 +- 5 ms, 100 Mbit/s, 30 and 72 Hz.
    pub fn new(scene: SceneSource, out: PathBuf) -> Self {
        let link = LinkProfile {
            latency_ns: 20_000_000,
            jitter_ns: 5_000_000,
            rate_bit_per_s: Some(100_000_000),
            ..LinkProfile::default()
        };
        Self {
            scene,
            renderer: Renderer::Stream,
            link: link.into(),
            head: Head::Walk,
            seconds: 5.0,
            extent_pixels: [512, 512],
            fov_degrees: 90.0,
            seed: 1,
            out,
            dump_every: 0,
            compare_every: 12,
            stages: StageMs::default(),
            validation: false,
            device: None,
            qp: shadecast_server::encode::openh264::DEFAULT_QP,
            atlas_extent_texels: AtlasExtent::DEFAULT,
            rate_hz: 30.0,
            refresh_hz: 72.0,
            scene_options: SceneOptions::default(),
            motion: false,
            verbose: false,
        }
    }
}

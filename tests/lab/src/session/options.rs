//! What a run in virtual time is made with.

use super::originals::Arrival;
use serde::{Deserialize, Serialize};
use shadecast_client::draw::stages::atlas_draw::Reconstruction;
use shadecast_client::options::USUAL_STORE_PAGES;
use shadecast_protocol::atlas::AtlasExtent;
use shadecast_protocol::limits::{
    DEFAULT_PATCH_SLOTS, DEFAULT_TRIANGLES, DEFAULT_VERTEX_SLOTS, MAX_PATCH_SLOTS, MAX_TRIANGLES,
    MAX_VERTEX_SLOTS,
};
use shadecast_protocol::message::Codec;
use shadecast_scene::load::SceneSource;
use shadecast_server::encode::choice::OPENH264;
use shadecast_server::pacing::quality::QualityOptions;
use shadecast_server::pacing::room::Room;
use shadecast_server::scene::SceneOptions;
use shadecast_server::serve::scheduler::simulated::StepsNs;
use shadecast_server::update::policy::UpdatePolicy;
use shadecast_server::visibility::detail::DEFAULT_DETAIL_PIXELS;
use shadecast_transport::{LinkError, LinkProfile, LinkSchedule};
use std::path::PathBuf;
use std::str::FromStr;

/// Which renderer makes the pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Renderer {
    /// The ground truth: its pictures, with nothing to compare.
    Forward,
    /// The atlas pipeline over a link that carries anything at once, and without a codec.
    Local,
    /// The atlas pipeline over codec and simulated link.
    Stream,
    /// A video of both eyes over the same link, turned to where the head looks.
    Video,
}

impl Renderer {
    /// As in `stats.json`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Forward => "forward",
            Self::Local => "local",
            Self::Stream => "stream",
            Self::Video => "video",
        }
    }
}

/// How long stages take in virtual time, milliseconds.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageMs {
    /// From an update's start to its delta's departure: the sum of its steps, where those have times of their own.
    pub server: f64,
    /// From there to the picture's departure.
    pub encode: f64,
    /// From a picture's arrival to its use.
    pub decode: f64,
    /// Times of an update's own steps, which may overlap with those of the next; `None`: one update at a time.
    #[serde(flatten, default, skip_serializing_if = "Option::is_none")]
    pub steps: Option<StepMs>,
}

/// How long the steps of an update take, milliseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StepMs {
    /// What the device needs to see.
    pub visibility: f64,
    /// What the CPU needs to place that.
    pub placement: f64,
    /// What the device needs to shade it.
    pub shading: f64,
}

impl StepMs {
    fn sum(self) -> f64 {
        self.visibility + self.placement + self.shading
    }
}

impl Default for StageMs {
    fn default() -> Self {
        Self { server: 12.0, encode: 8.0, decode: 6.0, steps: None }
    }
}

impl StageMs {
    /// Encodes of 2048x2048 texels as they were measured on common machines: 13 to 65 ms.
    pub const MEASURED: Self = Self { server: 12.0, encode: 25.0, decode: 10.0, steps: None };

    /// Milliseconds as nanoseconds.
    pub fn ns(self, ms: f64) -> i64 {
        (ms * 1e6) as i64
    }

    /// Durations of an update's steps. An update whose steps have none of their own is on the device for all of its time.
    pub fn steps_ns(self) -> StepsNs {
        let whole = StepMs { shading: self.server, ..StepMs::default() };
        let StepMs { visibility, placement, shading } = self.steps.unwrap_or(whole);
        StepsNs { visibility: self.ns(visibility), placement: self.ns(placement), shading: self.ns(shading) }
    }
}

impl FromStr for StageMs {
    type Err = String;

    /// `server=12,encode=8,decode=6`; each is optional. `visibility=`, `placement=` and `shading=` take the place of `server=`.
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
                "visibility" => stages.steps.get_or_insert_default().visibility = value,
                "placement" => stages.steps.get_or_insert_default().placement = value,
                "shading" => stages.steps.get_or_insert_default().shading = value,
                _ => {
                    let stages = "server, encode, decode, visibility, placement and shading";
                    return Err(format!("\"{key}\" is no stage; there are {stages}"));
                }
            }
        }
        stages.server = stages.steps.map_or(stages.server, StepMs::sum);
        Ok(stages)
    }
}

/// A way that is as good as none, nanoseconds. At a round trip of exactly zero, pictures that are not coded made virtual time
/// stand still in the transport.
const SHORT_WAY_NS: i64 = 100_000;

/// What an update passes through from the server to the client that ships.
#[derive(Clone, Debug)]
pub struct Medium {
    /// What both sides can code pictures by.
    pub codecs: &'static [Codec],
    /// The simulated network.
    pub link: LinkSchedule,
    /// Durations of stages.
    pub stages: StageMs,
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

/// One of several viewers of one world.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewerOptions {
    /// Its network.
    pub link: LinkSchedule,
    /// Its head path, a CSV file; `None`: a short walk.
    pub head: Option<PathBuf>,
}

impl FromStr for ViewerOptions {
    type Err = String;

    /// `link=LINK,head=PATH`; each is optional, and what is neither is a part of the link.
    fn from_str(text: &str) -> Result<Self, String> {
        let (mut link, mut head) = (Vec::new(), None);
        for part in text.split(',') {
            match part.split_once('=') {
                Some(("head", path)) => head = Some(PathBuf::from(path)),
                Some(("link", first)) => link.push(first),
                _ => link.push(part),
            }
        }
        let link = if link.is_empty() { USUAL_LINK.to_owned() } else { link.join(",") };
        let link = link.parse().map_err(|error: LinkError| error.to_string())?;
        Ok(Self { link, head })
    }
}

/// Display frames from one that is compared to the next. Twelve frames at 72 Hz are five updates at 30 Hz: every twelfth frame shows each
/// update at the same moment of its time on display, and moving shadows look 4 dB better or worse by that moment. Eleven frames reach
/// every moment.
pub const COMPARE_EVERY: u32 = 11;
/// What a video shows beyond each side of an eye's field of view unless told otherwise, degrees.
pub const USUAL_VIDEO_MARGIN_DEGREES: f32 = 10.0;

/// The network of runs that name none.
pub const USUAL_LINK: &str = "latency=20ms,jitter=5ms,rate=100mbit";

/// As much as a client offers that is asked for nothing else.
pub const USUAL_ROOM: Room =
    Room { patches: DEFAULT_PATCH_SLOTS, vertices: DEFAULT_VERTEX_SLOTS, triangles: DEFAULT_TRIANGLES };
/// As much as any client may offer.
pub const MOST_ROOM: Room =
    Room { patches: MAX_PATCH_SLOTS, vertices: MAX_VERTEX_SLOTS, triangles: MAX_TRIANGLES };
/// What a run is spared, so that it can be said what each cause of error costs. By default nothing.
#[derive(Clone, Debug, Default)]
pub struct Spared {
    /// What arrives for a coded atlas.
    pub arrival: Arrival,
    /// What the server's updates are spared.
    pub policy: UpdatePolicy,
    /// Outlines are taken for true: see [`crate::measure::metrics::with_true_outlines`].
    pub outlines: bool,
}

/// A run.
#[derive(Clone, Debug)]
pub struct RunOptions {
    /// What is shown.
    pub scene: SceneSource,
    /// The clip that animated instances play, instead of the scene's own choice.
    pub clip: Option<String>,
    /// How.
    pub renderer: Renderer,
    /// The simulated network.
    pub link: LinkSchedule,
    /// Where the head goes.
    pub head: Head,
    /// Who looks at the same world meanwhile: as busy as the one that is measured, but nothing is drawn for them.
    pub others: Vec<ViewerOptions>,
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
    /// Each of them is followed by the next frame, which tells how much errors change.
    pub compare_pairs: bool,
    /// No earlier than this display frame.
    pub compare_from: u64,
    /// Places a side of a pixel for which the truth has a colour; the pixel has their mean.
    pub truth_places: u32,
    /// The H.264 encoder of atlas and video, as the server's `--encoder` names it.
    pub encoder: String,
    /// Display frames before the first picture are compared too: all that they should show is missing.
    pub compare_waiting: bool,
    /// How the client finds colours between the atlas's texels.
    pub reconstruction: Reconstruction,
    /// For the table of causes.
    pub spared: Spared,
    /// Durations of stages.
    pub stages: StageMs,
    /// Validation layers on both sides.
    pub validation: bool,
    /// Part of the server's device's name.
    pub device: Option<String>,
    /// How finely pictures are quantised.
    pub quality: QualityOptions,
    /// Atlas width and height in texels.
    pub atlas_extent_texels: AtlasExtent,
    /// Writes there what happens when, for Perfetto.
    pub trace: Option<PathBuf>,
    /// Pixels of the display that a level of detail may err by where bits and time suffice; 0: everything has full detail.
    pub detail_pixels: f32,
    /// Part of the client's slots and of the atlas for what an abrupt head could see; 0: none.
    pub surround: f32,
    /// What the clients offer to keep and to draw.
    pub room: Room,
    /// Pages that the clients offer to keep for blocks that do not change; 0: none.
    pub store_pages: u32,
    /// The client blends from one picture to the next.
    pub blends: bool,
    /// What a video shows beyond each side of an eye's field of view, degrees.
    pub video_margin_degrees: f32,
    /// A video's pictures have depth, by which they are shown to a head that moved.
    pub video_has_depth: bool,
    /// Texels that an update may shade again; all where it is `None`.
    pub shade_texels: Option<u64>,
    /// Updates per second.
    pub rate_hz: f64,
    /// Display frames per second.
    pub refresh_hz: f64,
    /// Sampling and skinning.
    pub scene_options: SceneOptions,
    /// A client whose connection ends connects again, as the one in real time does; otherwise the run ends with it.
    pub reconnects: bool,
    /// Follows animated vertices at every display frame and compares them with the source curves.
    pub motion: bool,
    /// Prints a progress bar and a summary.
    pub verbose: bool,
}

impl RunOptions {
    /// What the acceptance runs use: 512x512 per eye, 20 +- 5 ms, 100 Mbit/s, 30 and 72 Hz.
    pub fn new(scene: SceneSource, out: PathBuf) -> Self {
        Self {
            scene,
            clip: None,
            renderer: Renderer::Stream,
            link: USUAL_LINK.parse().expect("the usual link is one"),
            head: Head::Walk,
            others: Vec::new(),
            seconds: 5.0,
            extent_pixels: [512, 512],
            fov_degrees: 90.0,
            seed: 1,
            out,
            dump_every: 0,
            compare_every: COMPARE_EVERY,
            compare_pairs: false,
            compare_from: 0,
            truth_places: 1,
            encoder: OPENH264.to_owned(),
            compare_waiting: false,
            reconstruction: Reconstruction::default(),
            spared: Spared::default(),
            stages: StageMs::default(),
            validation: false,
            device: None,
            quality: QualityOptions::default(),
            atlas_extent_texels: AtlasExtent::DEFAULT,
            trace: None,
            detail_pixels: DEFAULT_DETAIL_PIXELS,
            surround: 0.0, // what is around costs tests time, and few look there
            room: USUAL_ROOM,
            store_pages: USUAL_STORE_PAGES,
            blends: true,
            video_margin_degrees: USUAL_VIDEO_MARGIN_DEGREES,
            video_has_depth: false,
            shade_texels: None,
            rate_hz: 30.0,
            refresh_hz: 72.0,
            scene_options: SceneOptions::default(),
            reconnects: false,
            motion: false,
            verbose: false,
        }
    }

    /// What updates pass through: as the options say, unless the renderer leaves codec and link out.
    pub fn medium(&self) -> Medium {
        match self.renderer {
            Renderer::Local => Medium {
                codecs: &[Codec::Raw],
                link: LinkProfile { latency_ns: SHORT_WAY_NS, ..LinkProfile::default() }.into(),
                stages: StageMs { encode: 0.0, decode: 0.0, ..self.stages },
            },
            Renderer::Forward | Renderer::Stream | Renderer::Video => {
                Medium { codecs: &[Codec::H264], link: self.link.clone(), stages: self.stages }
            }
        }
    }

    /// Whether a display frame is compared with the truth.
    pub fn compares(&self, frame: u64) -> bool {
        let every = u64::from(if self.dump_every > 0 { self.dump_every } else { self.compare_every });
        let place = frame % every;
        frame >= self.compare_from && (place == 0 || self.compare_pairs && place == 1)
    }

    /// The command that repeats the run, with what differs from a run's defaults; `scene` is the scene as a person calls it.
    pub fn command_line(&self, scene: &str) -> String {
        let usual = Self::new(self.scene.clone(), self.out.clone());
        let mut line = format!("shadecast-lab run {scene} --renderer {} --out out/run", self.renderer.name());
        let [width, height] = self.extent_pixels;
        let StageMs { server, encode, decode, steps } = self.stages;
        line += &format!(
            " --seconds {} --size {width}x{height} --compare-every {}",
            self.seconds, self.compare_every
        );
        let of_update = match steps {
            Some(StepMs { visibility, placement, shading }) => {
                format!("visibility={visibility},placement={placement},shading={shading}")
            }
            None => format!("server={server}"),
        };
        line += &format!(" --stage-ms {of_update},encode={encode},decode={decode}");
        if let Some(clip) = &self.clip {
            line += &format!(" --clip {clip}");
        }
        if self.compare_pairs {
            line += " --compare-pairs";
        }
        if self.compare_from > 0 {
            line += &format!(" --compare-from {}", self.compare_from);
        }
        if self.encoder != usual.encoder {
            line += &format!(" --encoder {}", self.encoder);
        }
        if self.truth_places != usual.truth_places {
            line += &format!(" --truth-places {}", self.truth_places);
        }
        if let Head::Named(name) = &self.head {
            line += &format!(" --head-path {name}");
        }
        if self.atlas_extent_texels != usual.atlas_extent_texels {
            line += &format!(" --atlas {}", self.atlas_extent_texels);
        }
        if self.quality != usual.quality {
            line += &format!(" {}", self.quality);
        }
        if self.detail_pixels != usual.detail_pixels {
            line += &format!(" --detail {}", self.detail_pixels);
        }
        line += &format!(" --surround {}", self.surround);
        if !self.blends {
            line += " --no-blend";
        }
        if self.renderer == Renderer::Video {
            line += &format!(" --rate {} --video-margin {}", self.rate_hz, self.video_margin_degrees);
            line += if self.video_has_depth { " --video-depth" } else { "" };
        }
        if self.store_pages != usual.store_pages {
            line += &format!(" --store-pages {}", self.store_pages);
        }
        if self.room != usual.room {
            let Room { patches, vertices, triangles } = self.room;
            line += &format!(" --room patches={patches},vertices={vertices},triangles={triangles}");
        }
        let SceneOptions { sampling, skinning, motion, .. } = self.scene_options;
        if sampling != usual.scene_options.sampling {
            line += &format!(" --sampling {sampling}");
        }
        if skinning != usual.scene_options.skinning {
            line += &format!(" --skinning {skinning}");
        }
        if motion != usual.scene_options.motion {
            line += &format!(" --motion {motion}");
        }
        if self.reconstruction == Reconstruction::Bicubic {
            line += " --reconstruction bicubic";
        }
        if self.seed != usual.seed {
            line += &format!(" --seed {}", self.seed);
        }
        if let Some(texels) = self.shade_texels {
            line += &format!(" --shade-texels {texels}");
        }
        let flags = [
            (" --measure-motion", self.motion),
            (" --validation", self.validation),
            (" --no-reuse", !self.spared.policy.reuse),
            (" --no-prediction", !self.spared.policy.predicts),
        ];
        for (flag, is_on) in flags {
            line += if is_on { flag } else { "" };
        }
        if scene == "robot.glb" {
            line = format!("shadecast-lab robot --out robot.glb && {line}");
        }
        line
    }
}

/// What a client offers to keep and to draw: `patches=N,vertices=N,triangles=N`; each is optional.
///
/// # Errors
/// What is none of these, or more than any client may offer.
pub fn parse_room(text: &str) -> Result<Room, String> {
    let mut room = USUAL_ROOM;
    for part in text.split(',') {
        let (key, value) = part.split_once('=').ok_or_else(|| format!("\"{part}\" is not patches=NUMBER"))?;
        let (place, most) = match key {
            "patches" => (&mut room.patches, MAX_PATCH_SLOTS),
            "vertices" => (&mut room.vertices, MAX_VERTEX_SLOTS),
            "triangles" => (&mut room.triangles, MAX_TRIANGLES),
            _ => return Err(format!("\"{key}\" is not patches, vertices or triangles")),
        };
        let number = value.parse().ok().filter(|number| (1..=most).contains(number));
        *place = number.ok_or_else(|| format!("{key} must be a number from 1 to {most}"))?;
    }
    Ok(room)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_room_is_what_is_said_of_it_and_the_most_of_the_rest() {
        let room = parse_room("triangles=900,patches=30").expect("good");
        assert_eq!(room, Room { patches: 30, triangles: 900, ..USUAL_ROOM });
        for text in ["", "patches", "patches=0", "patches=x", "vertices=999999999", "slots=3"] {
            assert!(parse_room(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_viewer_is_a_link_and_a_head_path_in_any_order() {
        let of = |text: &str| text.parse::<ViewerOptions>();
        let link: LinkSchedule = "latency=5ms,jitter=1ms".parse().expect("a link");
        let head = Some(PathBuf::from("walk.csv"));
        for text in ["link=latency=5ms,jitter=1ms,head=walk.csv", "head=walk.csv,link=latency=5ms,jitter=1ms"]
        {
            assert_eq!(of(text), Ok(ViewerOptions { link: link.clone(), head: head.clone() }), "{text}");
        }
        assert_eq!(of("link=none").expect("good").head, None);
        assert!(of("head=walk.csv").is_ok() && of("link=fast").is_err() && of("").is_err());
    }
}

//! Configuration of the mock headset for one run: read once per `xrCreateInstance` from the JSON file that the environment
//! variable [`CONFIG_VARIABLE`] names. The lab and the demo write that file with [`MockConfig::write`].

use std::ffi::OsString;
use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shadecast_protocol::pose::Fov;

use crate::head_path::{HeadPath, HeadPathError};
use crate::profiles::KnownProfile;

/// Environment variable that names the configuration file; unset means all defaults.
pub const CONFIG_VARIABLE: &str = "SHADECAST_MOCK_CONFIG";

/// Largest width or height of a swapchain image, pixels.
pub const MAX_EXTENT_PIXELS: u32 = 8192;

/// From the wish to recentre to the change, nanoseconds.
pub const RECENTRE_NOTICE_NS: i64 = 100_000_000;

/// Configuration of one run. Every field has a default, and an unknown field is an error.
/// Relative paths are relative to the folder of the configuration file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MockConfig {
    /// Recommended width and height of one eye's image, pixels, 1 to [`MAX_EXTENT_PIXELS`].
    pub extent_pixels: [u32; 2],
    /// Field of view of the left eye; the right eye's is its mirror image.
    pub fov_degrees: FovDegrees,
    /// Distance between the eyes, metres, 0 to 0.2.
    pub ipd_m: f32,
    /// Display rate, 1 to 1000 Hz.
    pub refresh_hz: f64,
    /// Other rates that the display has, each as [`Self::refresh_hz`].
    pub other_rates_hz: Vec<f64>,
    /// What paces the frames.
    pub clock: ClockKind,
    /// `XrTime` of the first `xrWaitFrame` on the virtual clock, nanoseconds, above 0. Unused on the real clock.
    pub virtual_start_ns: i64,
    /// Head path (CSV, see [`crate::head_path`]); its time 0 is the `XrTime` of the first `xrWaitFrame`.
    /// None: standing still, 1.6 m above the floor.
    pub head_path: Option<PathBuf>,
    /// Time after the first `xrWaitFrame` at which the session is asked to stop, seconds; 0: never.
    pub seconds: f64,
    /// Folder for `frames.jsonl`, `summary.json` and pictures; made where missing. None: nothing is written.
    pub capture_dir: Option<PathBuf>,
    /// Pictures of both eyes are written for every frame whose index is a multiple of this; 0: no pictures.
    pub capture_every: u32,
    /// What happens at which frame.
    pub events: Vec<ScriptedEvent>,
    /// Part of the name of the Vulkan device to use, in any case. None: the first of the fastest kind.
    pub vulkan_device: Option<String>,
    /// Extensions of the runtime that it does not have in this run, by their whole names.
    pub hidden_extensions: Vec<String>,
    /// Fixed foveation is offered (`XR_FB_foveation` and those that go with it); density maps are plain images.
    pub foveation: bool,
    /// The interaction profile of the controllers in both hands, by its path. None: there are no controllers.
    pub controllers: Option<String>,
    /// What their inputs are from which frame on; 0 before.
    pub inputs: Vec<ScriptedInput>,
    /// Where they are held from which frame on; nobody knows where before.
    pub hands: Vec<ScriptedHand>,
}

/// Angles from straight ahead to the four sides of the left eye's view, degrees, each above -89 and below 89;
/// positive is outward, so that `left` of 45 is 45 degrees to the left.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FovDegrees {
    /// To the left.
    pub left: f32,
    /// To the right.
    pub right: f32,
    /// Upward.
    pub up: f32,
    /// Downward.
    pub down: f32,
}

/// What paces the frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClockKind {
    /// Each `xrWaitFrame` advances time by one display period and returns at once.
    Virtual,
    /// `XrTime` is `CLOCK_MONOTONIC`, and `xrWaitFrame` sleeps.
    Real,
}

/// Something that happens to the session at a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScriptedEvent {
    /// Index of the frame (number of `xrWaitFrame` calls before it) during whose `xrWaitFrame` it happens.
    pub frame: u64,
    /// What happens.
    pub kind: EventKind,
}

/// What an input of a controller is from a frame on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScriptedInput {
    /// Index of the frame (number of `xrWaitFrame` calls before it) from which on it is so.
    pub frame: u64,
    /// The input with its component, such as `/user/hand/left/input/thumbstick/x`.
    pub path: String,
    /// -1 to 1; a click is 1.
    pub value: f32,
}

/// Where a controller is held from a frame on: its grip, and its aim too.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScriptedHand {
    /// Index of the frame (number of `xrWaitFrame` calls before it) from which on it is so.
    pub frame: u64,
    /// `/user/hand/left` or `/user/hand/right`.
    pub hand: String,
    /// In the frame of the head path, metres. None: it is not tracked.
    pub position_m: Option<[f32; 3]>,
    /// Turns about y, then x, then z, degrees.
    #[serde(default)]
    pub yaw_pitch_roll_degrees: [f32; 3],
}

/// What can happen to a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventKind {
    /// FOCUSED to VISIBLE: the session goes on without input.
    FocusLoss,
    /// VISIBLE to FOCUSED.
    FocusGain,
    /// Something else is shown: SYNCHRONIZED, frames go on and are not to be rendered.
    Hide,
    /// The end of [`EventKind::Hide`]: VISIBLE again, and FOCUSED unless the focus is lost.
    Show,
    /// The session is asked to stop; once the application has ended it, it is IDLE for so long, and then READY again.
    Pause {
        /// Milliseconds from its end to READY. On the virtual clock each `xrPollEvent` that finds nothing meanwhile lets one
        /// display period pass.
        ms: u32,
    },
    /// The user recentres: [`RECENTRE_NOTICE_NS`] later STAGE and LOCAL have their origin at this place of the
    /// STAGE before.
    Recentre {
        /// To the right, millimetres.
        x_mm: i32,
        /// Backward, millimetres.
        z_mm: i32,
        /// Turned to the left, degrees.
        yaw_degrees: i32,
    },
    /// The system gives the display another rate.
    RefreshRate {
        /// One of those that it has, rounded down.
        hz: u32,
    },
    /// The session is asked to stop, and exits once the application has ended it.
    Stop,
    /// The instance will be lost in one second: the application must destroy it and may create another.
    InstanceLoss,
    /// The session will be lost in one second: the application must destroy it and may create another, which goes on with the frame
    /// numbers, the clock and the script. Nothing where the session is asked to stop already.
    SessionLoss,
    /// The session is lost, and nobody has said so before: the calls after this frame's `xrWaitFrame` do.
    SuddenSessionLoss,
}

/// Why a configuration was refused: what was being done, on which file, what is wrong, what to do.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The configuration file cannot be read.
    #[error(
        "cannot read the mock runtime's configuration {path}: {source}; \
         correct {CONFIG_VARIABLE} or unset it to get the defaults",
        path = path.display()
    )]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The configuration file is not valid JSON, or has a field that does not exist.
    #[error("{path}:{line}: {source}; see MockConfig for the fields", path = path.display(), line = source.line())]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What serde said.
        source: serde_json::Error,
    },
    /// A value is out of its range.
    #[error("{path}: {field} is {value}; it must be {range}", path = path.display())]
    Range {
        /// The file.
        path: PathBuf,
        /// Name of the field.
        field: &'static str,
        /// Its value.
        value: String,
        /// What it must be.
        range: &'static str,
    },
    /// The head path cannot be read.
    #[error(
        "cannot read the head path {head_path} that {config} names: {source}; correct \"head_path\"",
        head_path = head_path.display(), config = config.display()
    )]
    ReadHeadPath {
        /// The configuration file.
        config: PathBuf,
        /// The head path's file.
        head_path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The head path is not valid.
    #[error(transparent)]
    HeadPath(#[from] HeadPathError),
}

impl Default for MockConfig {
    fn default() -> Self {
        Self {
            extent_pixels: [1024, 1024],
            fov_degrees: FovDegrees::default(),
            ipd_m: 0.063,
            refresh_hz: 72.0,
            other_rates_hz: Vec::new(),
            clock: ClockKind::Real,
            virtual_start_ns: 1_000_000_000,
            head_path: None,
            seconds: 0.0,
            capture_dir: None,
            capture_every: 0,
            events: Vec::new(),
            vulkan_device: None,
            hidden_extensions: Vec::new(),
            foveation: false,
            controllers: None,
            inputs: Vec::new(),
            hands: Vec::new(),
        }
    }
}

impl Default for FovDegrees {
    fn default() -> Self {
        Self { left: 45.0, right: 45.0, up: 45.0, down: 45.0 }
    }
}

impl FovDegrees {
    /// Frustum of the left eye.
    pub fn left_eye(self) -> Fov {
        Fov {
            left: -self.left.to_radians(),
            right: self.right.to_radians(),
            up: self.up.to_radians(),
            down: -self.down.to_radians(),
        }
    }

    /// Frustum of the right eye, the left one's mirror image.
    pub fn right_eye(self) -> Fov {
        Self { left: self.right, right: self.left, ..self }.left_eye()
    }
}

impl MockConfig {
    /// Reads and checks the file that [`CONFIG_VARIABLE`] names; the defaults where it is unset.
    pub fn from_environment(variable: Option<OsString>) -> Result<Self, ConfigError> {
        variable.map_or_else(|| Ok(Self::default()), |path| Self::load(Path::new(&path)))
    }

    /// Reads and checks a configuration file; relative paths in it become relative to its folder.
    pub fn load(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
        let mut config: Self = serde_json::from_str(&text)
            .map_err(|source| ConfigError::Syntax { path: path.to_owned(), source })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        for file in [&mut config.head_path, &mut config.capture_dir].into_iter().flatten() {
            *file = folder.join(&*file);
        }
        config.check(path)?;
        Ok(config)
    }

    /// Writes the configuration as JSON to `path`, for a later [`MockConfig::load`].
    pub fn write(&self, path: &Path) -> io::Result<()> {
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        std::fs::write(path, text)
    }

    /// All rates that the display has, ascending.
    pub(crate) fn rates_hz(&self) -> Vec<f64> {
        let mut rates: Vec<f64> = self.other_rates_hz.iter().copied().chain([self.refresh_hz]).collect();
        rates.sort_by(f64::total_cmp);
        rates.dedup();
        rates
    }

    /// The head path that the configuration names; standing still where it names none.
    /// `config` is the configuration's file, for error messages.
    pub fn load_head_path(&self, config: &Path) -> Result<HeadPath, ConfigError> {
        let Some(path) = &self.head_path else { return Ok(HeadPath::standing()) };
        let text = std::fs::read_to_string(path).map_err(|source| ConfigError::ReadHeadPath {
            config: config.to_owned(),
            head_path: path.clone(),
            source,
        })?;
        Ok(HeadPath::parse(&text, &path.display().to_string())?)
    }

    fn check(&self, path: &Path) -> Result<(), ConfigError> {
        let extent_ok = self.extent_pixels.iter().all(|side| (1..=MAX_EXTENT_PIXELS).contains(side));
        let fov_ok = self.fov_degrees.left_eye().is_valid();
        let rules = [
            (
                extent_ok,
                "extent_pixels",
                format!("{:?}", self.extent_pixels),
                "[width, height], each 1 to 8192",
            ),
            (
                fov_ok,
                "fov_degrees",
                format!("{:?}", self.fov_degrees),
                "four angles under 89 degrees that open a view (left + right > 0, up + down > 0)",
            ),
            ((0.0..=0.2).contains(&self.ipd_m), "ipd_m", self.ipd_m.to_string(), "0 to 0.2 metres"),
            (
                (1.0..=1000.0).contains(&self.refresh_hz),
                "refresh_hz",
                self.refresh_hz.to_string(),
                "1 to 1000 Hz",
            ),
            (
                self.other_rates_hz.iter().all(|hz| (1.0..=1000.0).contains(hz)),
                "other_rates_hz",
                format!("{:?}", self.other_rates_hz),
                "rates of 1 to 1000 Hz",
            ),
            (
                (1..1 << 62).contains(&self.virtual_start_ns),
                "virtual_start_ns",
                self.virtual_start_ns.to_string(),
                "above 0 and below 2^62, because XrTime has no zero",
            ),
            (
                (0.0..=1e9).contains(&self.seconds),
                "seconds",
                self.seconds.to_string(),
                "0 (never stop) or a time in seconds",
            ),
        ];
        let refused =
            |field, value, range| Err(ConfigError::Range { path: path.to_owned(), field, value, range });
        if let Some((_, field, value, range)) = rules.into_iter().find(|(ok, ..)| !ok) {
            return refused(field, value, range);
        }
        let profile = self.controllers.as_deref().map(KnownProfile::named).transpose();
        let Ok(profile) = profile else {
            let named = self.controllers.clone().unwrap_or_default();
            return refused("controllers", named, "an interaction profile of OpenXR 1.0");
        };
        let is_input = |input: &ScriptedInput| {
            (-1.0..=1.0).contains(&input.value)
                && profile.is_some_and(|profile| profile.has_component(&input.path))
        };
        if let Some(ScriptedInput { path, value, .. }) = self.inputs.iter().find(|input| !is_input(input)) {
            let range = "-1 to 1, of an input that the controllers have";
            return refused("inputs", format!("{value} at {path}"), range);
        }
        let is_hand = |hand: &ScriptedHand| {
            let numbers = hand.position_m.unwrap_or_default().into_iter().chain(hand.yaw_pitch_roll_degrees);
            let has_grip =
                profile.is_some_and(|p| p.has_component(&format!("{}/input/grip/pose", hand.hand)));
            has_grip && numbers.into_iter().all(|number| number.abs() <= 1000.0)
        };
        match self.hands.iter().find(|hand| !is_hand(hand)) {
            Some(hand) => refused(
                "hands",
                format!("{hand:?}"),
                "/user/hand/left or right of controllers, within 1000 m",
            ),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn loaded(text: &str) -> Result<MockConfig, ConfigError> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("mock.json");
        std::fs::write(&path, text).expect("write the configuration");
        MockConfig::load(&path)
    }

    #[test]
    fn an_unset_variable_gives_the_defaults() {
        assert_eq!(MockConfig::from_environment(None).expect("defaults"), MockConfig::default());
    }

    const DOCS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs");

    #[test]
    fn the_documented_example_has_every_key_and_event() {
        let example = MockConfig::load(&Path::new(DOCS).join("mock.example.json")).expect("the example");
        assert!(!example.events.is_empty() && !example.inputs.is_empty());
        let page = std::fs::read_to_string(Path::new(DOCS).join("mock.md")).expect("the page");
        let all = serde_json::to_value(MockConfig::default()).expect("a value");
        let keys = all.as_object().expect("an object").keys();
        let absent: Vec<_> = keys.filter(|key| !page.contains(&format!("`{key}`"))).collect();
        assert!(absent.is_empty(), "{absent:?}");
        let refused =
            loaded(r#"{"events": [{"frame": 1, "kind": "none"}]}"#).expect_err("no such kind").to_string();
        let kinds: Vec<_> = refused.split('`').skip(3).step_by(2).collect();
        let absent: Vec<_> = kinds.iter().filter(|kind| !page.contains(&format!("`{kind}`"))).collect();
        assert!(kinds.contains(&"session_loss") && absent.is_empty(), "{absent:?} of {kinds:?}");
    }

    #[test]
    fn a_written_configuration_reads_back_the_same() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("mock.json");
        let config = MockConfig {
            clock: ClockKind::Virtual,
            capture_dir: Some(folder.path().join("out")),
            capture_every: 3,
            events: vec![ScriptedEvent { frame: 9, kind: EventKind::FocusLoss }],
            ..MockConfig::default()
        };
        config.write(&path).expect("write");
        assert_eq!(MockConfig::load(&path).expect("read back"), config);
    }

    #[test]
    fn relative_paths_start_at_the_configurations_folder() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("mock.json");
        std::fs::write(&path, r#"{"head_path": "walk.csv"}"#).expect("write");
        let config = MockConfig::load(&path).expect("valid");
        assert_eq!(config.head_path, Some(folder.path().join("walk.csv")));
        let error = config.load_head_path(&path).expect_err("no such file").to_string();
        assert!(error.contains("walk.csv") && error.contains("mock.json"), "{error}");
    }

    #[test]
    fn a_misspelt_field_names_the_file_and_the_line() {
        let error = loaded("{\n  \"refresh\": 90\n}").expect_err("unknown field").to_string();
        assert!(error.contains("mock.json:2: unknown field `refresh`, expected one of"), "{error}");
    }

    #[test]
    fn values_out_of_range_name_the_field_and_the_range() {
        for (text, field) in [
            (r#"{"extent_pixels": [0, 512]}"#, "extent_pixels is [0, 512]; it must be"),
            (r#"{"refresh_hz": 0}"#, "refresh_hz is 0; it must be 1 to 1000 Hz"),
            (r#"{"virtual_start_ns": 0}"#, "virtual_start_ns is 0"),
            (r#"{"seconds": -1}"#, "seconds is -1"),
            (
                r#"{"controllers": "/interaction_profiles/acme/glove"}"#,
                "controllers is /interaction_profiles/acme/glove",
            ),
            (
                r#"{"inputs": [{"frame": 1, "path": "/user/hand/left/input/menu/click", "value": 1}]}"#,
                "inputs is 1 at /user",
            ),
            (r#"{"fov_degrees": {"left": -50, "right": 45, "up": 45, "down": 45}}"#, "fov_degrees"),
        ] {
            let error = loaded(text).expect_err(text).to_string();
            assert!(error.contains(field), "{error}");
        }
    }

    #[test]
    fn the_right_eyes_view_mirrors_the_left_eyes() {
        let degrees = FovDegrees { left: 50.0, right: 40.0, up: 45.0, down: 42.0 };
        let (left, right) = (degrees.left_eye(), degrees.right_eye());
        assert_eq!((left.left, left.right), (-right.right, -right.left));
        assert_eq!((left.up, left.down), (right.up, right.down));
    }
}

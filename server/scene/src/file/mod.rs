//! The scene file: TOML to a [`SceneFile`], with the line of everything. Later faults (a missing model, an unknown clip) can
//! still be shown at their line.
//!
//! The reader does not use serde, whose errors name the key, but not the likely intention. A scene file belongs to its user: it
//! names models anywhere on this machine. Its assets may be a stranger's, and may name files of their own folder only
//! (`references`). `docs/scene.example.toml` shows every key.

mod event;
mod fields;
mod light;
mod path;
mod placement;
mod transform;
mod view;

#[cfg(test)]
mod tests;

pub use light::default_light;
pub use path::{MAX_PATH_DURATION_S, MAX_PATH_KEYS};
pub use placement::{MAX_PLACED, cells, spread};
pub use view::{DEFAULT_FOV_DEG, FOV_RANGE_DEG};

use crate::timeline::Change;
use crate::{Camera, Environment, HeadPath, Path, PlacedLight, Repetition, SceneError, Sun, ground};
use fields::{Fields, Source};
use glam::Affine3A;
use placement::Named;
use shadecast_dragon::BuiltIn;
use shadecast_model::pose::Pose;
use shadecast_model::text::printable;
use shadecast_model::time::WorldTime;
use std::path::PathBuf;
use toml::de::DeTable;

/// A scene file, read and checked in itself; no other file has been opened yet.
#[derive(Clone, Debug)]
pub struct SceneFile {
    /// In the order of the file; names are unique.
    pub models: Vec<ModelEntry>,
    /// In the order of the file, cells of grids last; at least one, at most [`MAX_PLACED`].
    pub instances: Vec<InstanceEntry>,
    /// What changes as time goes by, in order of time; of one instance, none amid the fade of another.
    pub events: Vec<EventEntry>,
    /// The light that casts shadows.
    pub sun: Sun,
    /// Other lights, at most [`MAX_LIGHTS`](shadecast_model::limits::MAX_LIGHTS).
    pub lights: Vec<PlacedLight>,
    /// The sky.
    pub environment: Environment,
    /// Side of the ground in metres, `None` for no ground.
    pub ground_size_m: Option<f32>,
    /// Where the stage starts.
    pub world_from_stage: Pose,
    /// In the order of the file; names are unique.
    pub cameras: Vec<Camera>,
    /// In the order of the file, then those of [`built_in_head_paths`] whose names are still free.
    pub head_paths: Vec<HeadPath>,
}

/// A `[[model]]`.
#[derive(Clone, Debug)]
pub struct ModelEntry {
    /// What instances call it.
    pub name: String,
    /// Where it comes from.
    pub file: ModelFile,
    /// Line of the file name, from 1.
    pub line: usize,
}

/// Where a model comes from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ModelFile {
    /// A generated one.
    BuiltIn(BuiltIn),
    /// A path to anywhere, relative to the scene file.
    Path(PathBuf),
}

/// An `[[instance]]`, or a cell of a `[[grid]]`.
#[derive(Clone, Debug)]
pub struct InstanceEntry {
    /// Given, or made from the model's name.
    pub name: String,
    /// Index into [`SceneFile::models`].
    pub model: usize,
    /// Placement.
    pub world_from_model: Affine3A,
    /// Moves the placed instance.
    pub path: Option<Path>,
    /// Added to the scene's time.
    pub time_shift: TimeShift,
    /// Factor on time.
    pub speed: f32,
    /// What the clip does outside its duration.
    pub repetition: Repetition,
    /// Which clip plays, and the line that says so.
    pub clip: ClipChoice,
    /// Whether the sun casts its shadow.
    pub casts_shadow: bool,
    /// Whether an application may change what it plays, and pose it.
    pub live: bool,
}

/// An `[[event]]`.
#[derive(Clone, Debug)]
pub struct EventEntry {
    /// When.
    pub at: WorldTime,
    /// Index into [`SceneFile::instances`].
    pub instance: usize,
    /// The clip from then on; `None` where it says nothing of that.
    pub clip: Option<ClipChoice>,
    /// What else changes.
    pub change: Change,
}

/// A shift of time, part of it in units of a clip that is not known yet.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TimeShift {
    /// Seconds.
    pub seconds: f32,
    /// Parts of what the clip takes to play once.
    pub of_clip: f32,
}

impl TimeShift {
    fn after(self, other: Self) -> Self {
        Self { seconds: self.seconds + other.seconds, of_clip: self.of_clip + other.of_clip }
    }

    /// In seconds, for a clip of this duration played at this speed.
    pub fn in_seconds(self, duration_s: f32, speed: f32) -> f32 {
        let once_s = if speed == 0.0 { 0.0 } else { duration_s / speed.abs() };
        self.seconds + self.of_clip * once_s
    }
}

/// Which clip of its model an instance plays.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ClipChoice {
    /// Nothing was said: the first that moves anything.
    First,
    /// `clip = ""`: the rest pose.
    Rest,
    /// The named one, on this line.
    Named(String, usize),
}

impl ClipChoice {
    /// What a table's "clip" says; `None` where it says nothing.
    fn read(fields: &Fields) -> Result<Option<Self>, SceneError> {
        let choice = |(name, line): (String, usize)| match name.is_empty() {
            true => Self::Rest,
            false => Self::Named(name, line),
        };
        Ok(fields.string("clip")?.map(choice))
    }
}

/// Reads the text of a scene file. `file` is its name, for messages.
pub fn parse(text: &str, file: &str) -> Result<SceneFile, SceneError> {
    let source = Source::new(text, file);
    let document = read_toml(&source)?;
    let root = Fields::new(&source, "a scene", &document, 1, &ROOT_KEYS)?;
    let models = read_models(&root)?;
    let paths = path::read_paths(&root)?;
    let instances = placement::read_instances(&root, &Named { models: &models, paths: &paths })?;
    let events = event::read_events(&root, &instances)?;
    Ok(SceneFile {
        models,
        instances,
        events,
        sun: light::read_sun(&root)?,
        lights: light::read_lights(&root)?,
        environment: light::read_environment(&root)?,
        ground_size_m: read_ground(&root)?,
        world_from_stage: view::read_stage(&root)?,
        cameras: view::read_cameras(&root)?,
        head_paths: with_built_in(view::read_head_paths(&root)?),
    })
}

const ROOT_KEYS: [&str; 13] = [
    "model",
    "instance",
    "grid",
    "event",
    "path",
    "sun",
    "light",
    "sky",
    "environment",
    "ground",
    "stage",
    "camera",
    "head_path",
];

fn read_toml<'a>(source: &Source<'a>) -> Result<DeTable<'a>, SceneError> {
    let document = DeTable::parse(source.text).map_err(|error| {
        let at = error.span().map_or(0, |span| span.start);
        source.error(source.line(at), printable(&error.message().trim().replace('\n', "; ")))
    })?;
    Ok(document.into_inner())
}

/// The head paths that every scene has: standing still, turning, walking a few steps, a stride that turns, sitting, peeking, and an
/// abrupt start.
pub fn built_in_head_paths() -> Vec<HeadPath> {
    let source = Source::new(include_str!("head_paths.toml"), "built-in head paths");
    let read = || view::read_head_paths(&Fields::new(&source, "", &read_toml(&source)?, 1, &["head_path"])?);
    read().expect("the built-in head paths are valid")
}

fn with_built_in(mut head_paths: Vec<HeadPath>) -> Vec<HeadPath> {
    for built_in in built_in_head_paths() {
        if head_paths.iter().all(|own| own.name != built_in.name) {
            head_paths.push(built_in);
        }
    }
    head_paths
}

fn read_models(root: &Fields) -> Result<Vec<ModelEntry>, SceneError> {
    let mut models: Vec<ModelEntry> = Vec::new();
    for fields in root.tables("model", &["name", "file"])? {
        let name = fields.unique_name("models", models.iter().map(|model| model.name.as_str()))?;
        let (file, line) = fields.required_string("file")?;
        let built_in = BuiltIn::named(&file).map(ModelFile::BuiltIn);
        let file = built_in.unwrap_or_else(|| ModelFile::Path(PathBuf::from(file)));
        models.push(ModelEntry { name, file, line });
    }
    Ok(models)
}

fn read_ground(root: &Fields) -> Result<Option<f32>, SceneError> {
    let Some(fields) = root.table("ground", &["enabled", "size_m"])? else {
        return Ok(Some(ground::DEFAULT_SIZE_M));
    };
    let size_m = fields.number_within("size_m", 1.0..=ground::MAX_SIZE_M, "metres")?;
    let size_m = size_m.unwrap_or(ground::DEFAULT_SIZE_M);
    Ok(fields.flag("enabled")?.unwrap_or(true).then_some(size_m))
}

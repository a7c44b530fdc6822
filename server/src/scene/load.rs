//! From the SCENE argument to a complete [`Scene`]: a scene file, an asset with a sensible scene around it, or the
//! built-in dragons.

use super::error::SceneError;
use super::file::{self, ClipChoice, ModelEntry, ModelFile, SceneFile};
use super::split::{MAX_EDGE_M, split_long_edges};
use super::suggest::did_you_mean;
use super::{Instance, Model, Scene, gltf, ground};
use crate::animation::clip::track_varies;
use crate::animation::pose;
use glam::{Affine3A, Quat, Vec3};
use shadecast_protocol::pose::Pose;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Most built-in dragons in one scene.
pub const MAX_DRAGONS: u32 = 1024;

/// What the user asked to see.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SceneSource {
    /// So many built-in dragons.
    Dragons(u32),
    /// A `.glb` or `.gltf` asset, or a `.toml` scene.
    File(PathBuf),
}

impl Default for SceneSource {
    /// Three dragons.
    fn default() -> Self {
        Self::Dragons(3)
    }
}

impl FromStr for SceneSource {
    type Err = SceneError;

    /// `dragon`, `dragons:N`, or a path.
    fn from_str(argument: &str) -> Result<Self, SceneError> {
        let fault = |problem: String| SceneError::Argument { argument: argument.to_owned(), problem };
        match argument.split_once(':') {
            Some(("dragons" | "dragon", count)) => {
                let count = count.parse().ok().filter(|count| (1..=MAX_DRAGONS).contains(count));
                count.map(Self::Dragons).ok_or_else(|| fault(format!("the number must be from 1 to {MAX_DRAGONS}")))
            }
            _ if argument == "dragon" => Ok(Self::Dragons(1)),
            _ if argument == "dragons" => Ok(Self::default()),
            _ if argument.is_empty() => Err(fault("is empty; give dragons:N or a .glb, .gltf or .toml file".into())),
            _ => Ok(Self::File(argument.into())),
        }
    }
}

impl fmt::Display for SceneSource {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Dragons(1) => write!(out, "dragon"),
            Self::Dragons(count) => write!(out, "dragons:{count}"),
            Self::File(path) => write!(out, "{}", path.display()),
        }
    }
}

/// Loads everything that a scene needs. Edges are split so that none is longer than [`MAX_EDGE_M`] in the world,
/// except the diagonals of the ground's cells.
pub fn load_scene(source: &SceneSource) -> Result<Scene, SceneError> {
    match source {
        SceneSource::Dragons(count) => dragons(*count),
        SceneSource::File(path) => match extension(path).as_str() {
            "toml" => scene_file(path),
            "glb" | "gltf" => asset(path),
            other => Err(unknown_kind(path, other)),
        },
    }
}

fn extension(path: &Path) -> String {
    path.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

fn unknown_kind(path: &Path, extension: &str) -> SceneError {
    let name = path.display().to_string();
    let hint = did_you_mean(&name, ["dragon", "dragons"]);
    let problem = match extension {
        "" => format!("is neither a built-in scene nor a .glb, .gltf or .toml file{hint}"),
        other => format!("files of kind .{other} are not known; give a .glb, .gltf or .toml file"),
    };
    SceneError::Argument { argument: name, problem }
}

fn built_in_dragon() -> Result<Model, SceneError> {
    gltf::from_slice(&crate::generate::dragon(), "built-in dragon")
}

/// The first clip that moves anything.
fn first_moving_clip(model: &Model) -> Option<usize> {
    model.clips.iter().position(|clip| clip.tracks.iter().any(track_varies))
}

/// A scene with default light, ground and stage.
fn around(models: Vec<Model>, instances: Vec<Instance>) -> Scene {
    let (sun, environment) = file::default_light();
    let scene = Scene { models, instances, sun, environment, world_from_stage: Pose::IDENTITY };
    finished(scene, Some(ground::DEFAULT_SIZE_M))
}

/// Splits long edges, then adds the ground, which needs no splitting: its cells are half a metre, and their diagonals
/// do not make its patches larger.
fn finished(mut scene: Scene, ground_size_m: Option<f32>) -> Scene {
    split_models(&mut scene);
    if let Some(size_m) = ground_size_m {
        add_ground(&mut scene, size_m);
    }
    scene
}

fn add_ground(scene: &mut Scene, size_m: f32) {
    scene.instances.push(Instance {
        name: "ground".into(),
        model: scene.models.len(),
        world_from_model: Affine3A::IDENTITY,
        clip: None,
        time_shift_s: 0.0,
        speed: 1.0,
    });
    scene.models.push(ground::ground(size_m));
}

// ---- an asset ----

/// Distance from the user to the middle of an asset, metres.
const ASSET_DISTANCE_M: f32 = 2.5;
/// An asset's largest extent, metres, may be in this range; others are scaled to the third number.
const ASSET_EXTENT_M: (f32, f32, f32) = (0.9, 2.0, 1.6);

fn asset(path: &Path) -> Result<Scene, SceneError> {
    let model = gltf::load(path)?;
    let clip = first_moving_clip(&model);
    let world_from_model = place_asset(&model, clip)
        .map_err(|problem| SceneError::Asset { file: path.display().to_string(), element: "scene".into(), problem })?;
    let name = model.name.clone();
    let instance = Instance { name, model: 0, world_from_model, clip, time_shift_s: 0.0, speed: 1.0 };
    Ok(around(vec![model], vec![instance]))
}

/// Stands the model on the ground in front of the user, facing them: glTF's front is +z, the user looks along -z.
fn place_asset(model: &Model, clip: Option<usize>) -> Result<Affine3A, String> {
    let (low, high) = finite_bounds(model, clip)?;
    let extent = (high - low).max_element();
    let (least, most, otherwise) = ASSET_EXTENT_M;
    let scale = if (least..=most).contains(&extent) { 1.0 } else { otherwise / extent };
    let middle = (low + high) * 0.5;
    let foot = Vec3::new(middle.x, low.y, middle.z);
    let translation = Vec3::new(0.0, 0.0, -ASSET_DISTANCE_M) - foot * scale;
    Ok(Affine3A::from_scale_rotation_translation(Vec3::splat(scale), Quat::IDENTITY, translation))
}

/// Bounds over the clip, of a size that can be worked with.
fn finite_bounds(model: &Model, clip: Option<usize>) -> Result<(Vec3, Vec3), String> {
    let (low, high) = pose::bounds(model, clip, 16).ok_or("has no triangles to show")?;
    let extent = (high - low).max_element();
    if !(low.is_finite() && high.is_finite() && extent > 1e-6 && extent < 1e7) {
        return Err(format!("its extent of {extent} m cannot be shown (bones may blow it up or shrink it to nothing)"));
    }
    Ok((low, high))
}

// ---- dragons ----

/// Distance from the user to the middle of the group, metres, for few dragons.
const GROUP_DISTANCE_M: f32 = 3.3;

fn dragons(count: u32) -> Result<Scene, SceneError> {
    let model = built_in_dragon()?;
    let clip = first_moving_clip(&model);
    let fault = |problem| SceneError::Asset { file: "built-in dragon".into(), element: "scene".into(), problem };
    let (low, high) = finite_bounds(&model, clip).map_err(fault)?;
    let duration_s = clip.map_or(0.0, |clip| model.clips[clip].duration_s);
    let instance = |index: u32| Instance {
        name: format!("dragon {index}"),
        model: 0,
        world_from_model: dragon_place(index, count, low, high),
        clip,
        // Golden-ratio steps: any number of dragons is spread evenly over the loop, and neighbours differ.
        time_shift_s: (index as f32 * 0.618_034).fract() * duration_s,
        speed: 1.0,
    };
    let instances = (0..count).map(instance).collect();
    Ok(around(vec![model], instances))
}

/// Rows of at most ceil(sqrt(count)) side by side (all of up to three in one row), later rows further back, each
/// dragon turned halfway towards the user, the outer ones of a row nearer than the inner ones.
fn dragon_place(index: u32, count: u32, low: Vec3, high: Vec3) -> Affine3A {
    let columns = if count <= 3 { count } else { (f64::from(count).sqrt().ceil()) as u32 };
    let rows = count.div_ceil(columns);
    let (row, column) = (index / columns, index % columns);
    let in_row = columns.min(count - row * columns);
    // Wings of neighbours may overlap in x a little, since neighbours also differ in depth.
    let spacing = Vec3::new((high.x - low.x) * 0.85, 0.0, (high.z - low.z) * 0.9 + 0.4).max(Vec3::splat(0.5));
    let side = column as f32 - (in_row - 1) as f32 * 0.5;
    let nearest = GROUP_DISTANCE_M.max(GROUP_DISTANCE_M + (rows as f32 - 1.0) * 0.25);
    let stagger = 0.35 * (side.abs().min(2.0) - 0.5);
    let at = Vec3::new(side * spacing.x, 0.0, -(nearest + row as f32 * spacing.z) + stagger);
    let yaw = -0.5 * (at.x / -at.z).atan();
    let middle = (low + high) * 0.5;
    let model_from_foot = Affine3A::from_translation(-Vec3::new(middle.x, low.y, middle.z));
    Affine3A::from_rotation_translation(Quat::from_rotation_y(yaw), at) * model_from_foot
}

// ---- a scene file ----

fn scene_file(path: &Path) -> Result<Scene, SceneError> {
    let name = path.display().to_string();
    let text = std::fs::read_to_string(path).map_err(|source| SceneError::Read { file: name.clone(), source })?;
    scene_from_text(&text, &name, path.parent().unwrap_or(Path::new("")))
}

/// The scene that a file of this text in this folder describes.
pub fn scene_from_text(text: &str, name: &str, folder: &Path) -> Result<Scene, SceneError> {
    let file = file::parse(text, name)?;
    let models = file.models.iter().map(|entry| load_model(entry, name, folder)).collect::<Result<Vec<_>, _>>()?;
    let instances = instances(&file, &models, name)?;
    let SceneFile { sun, environment, ground_size_m, world_from_stage, .. } = file;
    Ok(finished(Scene { models, instances, sun, environment, world_from_stage }, ground_size_m))
}

fn load_model(entry: &ModelEntry, name: &str, folder: &Path) -> Result<Model, SceneError> {
    let fault = |problem: String| SceneError::SceneFile { file: name.to_owned(), line: entry.line, problem };
    let mut model = match &entry.file {
        ModelFile::BuiltInDragon => built_in_dragon()?,
        ModelFile::Path(path) if matches!(extension(path).as_str(), "glb" | "gltf") => {
            // The reason in the scene's terms: the line that names the file.
            gltf::load(&folder.join(path)).map_err(|error| fault(format!("model \"{}\": {error}", entry.name)))?
        }
        ModelFile::Path(path) => {
            let hint = did_you_mean(&path.to_string_lossy(), [file::BUILT_IN_DRAGON]);
            return Err(fault(format!("\"{}\" is not a .glb or .gltf file{hint}", path.display())));
        }
    };
    model.name.clone_from(&entry.name);
    Ok(model)
}

fn instances(file: &SceneFile, models: &[Model], name: &str) -> Result<Vec<Instance>, SceneError> {
    let convert = |entry: &file::InstanceEntry| {
        Ok(Instance {
            name: entry.name.clone(),
            model: entry.model,
            world_from_model: entry.world_from_model,
            clip: choose_clip(&entry.clip, &models[entry.model], name)?,
            time_shift_s: entry.time_shift_s,
            speed: entry.speed,
        })
    };
    file.instances.iter().map(convert).collect()
}

fn choose_clip(choice: &ClipChoice, model: &Model, name: &str) -> Result<Option<usize>, SceneError> {
    let (wanted, line) = match choice {
        ClipChoice::First => return Ok(first_moving_clip(model)),
        ClipChoice::Rest => return Ok(None),
        ClipChoice::Named(wanted, line) => (wanted, *line),
    };
    let names = || model.clips.iter().map(|clip| clip.name.as_str());
    let found = names().position(|clip| clip == wanted);
    found.map(Some).ok_or_else(|| {
        let mut hint = did_you_mean(wanted, names());
        if hint.is_empty() {
            hint = format!("; it has {}", quoted_list(names()));
        }
        let problem = format!("model \"{}\" has no clip \"{wanted}\"{hint}", model.name);
        SceneError::SceneFile { file: name.to_owned(), line, problem }
    })
}

fn quoted_list<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let list: Vec<String> = names.map(|name| format!("\"{name}\"")).collect();
    if list.is_empty() { "none".into() } else { list.join(", ") }
}

// ---- long edges ----

fn split_models(scene: &mut Scene) {
    for index in 0..scene.models.len() {
        let placed = scene.instances.iter().filter(|instance| instance.model == index);
        let scale = placed.map(|instance| largest_scale(instance.world_from_model)).fold(0.0, f32::max);
        let model = &mut scene.models[index];
        let limit = MAX_EDGE_M / (scale * rest_scale(model));
        if !(limit.is_finite() && limit > 0.0) {
            continue;
        }
        let stats = split_long_edges(model, limit);
        if !stats.complete {
            tracing::warn!("{}: edges stay longer than {MAX_EDGE_M} m; split it in a modelling tool", model.name);
        }
    }
}

/// Largest stretch from mesh to model space among the palette's entries in the rest pose.
fn rest_scale(model: &Model) -> f32 {
    pose::source_palette(model, None, 0.0).into_iter().map(largest_scale).fold(0.0, f32::max)
}

/// Longest image of an axis.
fn largest_scale(transform: Affine3A) -> f32 {
    let axes = transform.matrix3;
    axes.x_axis.length().max(axes.y_axis.length()).max(axes.z_axis.length())
}

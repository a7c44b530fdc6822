//! From the SCENE argument to a complete [`Scene`]: a scene file, an asset with a sensible scene around it, or the
//! built-in dragons and courtyard.

use super::error::SceneError;
use super::file::{self, ClipChoice, EventEntry, ModelEntry, ModelFile, SceneFile};
use super::split::MAX_EDGE_M;
use super::suggest::{did_you_mean, did_you_mean_or_list};
use crate::animation::clip::{morph_track_varies, track_varies};
use crate::animation::pose;
use crate::limits::read_limited;
use crate::process::{self, Loading};
use crate::timeline::{Change, Event};
use crate::views::find_head_path;
use crate::{Cancelled, Clip, HeadPath, Instance, Model, Scene, fbx, gltf, ground, import};
use glam::{Affine3A, Quat, Vec2, Vec3};
use shadecast_dragon::BuiltIn;
use shadecast_model::pose::Pose;
use shadecast_model::text::printable;
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Most built-in dragons in one scene.
pub const MAX_DRAGONS: u32 = 1024;

/// What the user writes for the courtyard, its scene file, and the file's name for messages.
const COURTYARD: &str = "courtyard";
const COURTYARD_FILE: &str = include_str!("load/courtyard.toml");
const COURTYARD_NAME: &str = "built-in courtyard";

/// What the user asked to see.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SceneSource {
    /// So many built-in dragons.
    Dragons(u32),
    /// Built-in dragons in a grid: so many side by side, above each other, behind each other.
    DragonGrid([u32; 3]),
    /// The built-in courtyard at evening.
    Courtyard,
    /// A `.glb`, `.gltf` or `.fbx` asset, or a `.toml` scene.
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

    /// `courtyard`, `dragon`, `dragons:N`, `dragons:NxMxK`, or a path.
    fn from_str(argument: &str) -> Result<Self, SceneError> {
        let fault = |problem: String| SceneError::Argument { argument: argument.to_owned(), problem };
        match argument.split_once(':') {
            Some(("dragons" | "dragon", count)) => parse_dragons(count).ok_or_else(|| {
                fault(format!(
                    "the number must be from 1 to {MAX_DRAGONS}, or three of that product, such as 3x1x3"
                ))
            }),
            _ if argument == COURTYARD => Ok(Self::Courtyard),
            _ if argument == "dragon" => Ok(Self::Dragons(1)),
            _ if argument == "dragons" => Ok(Self::default()),
            _ if argument.is_empty() => {
                Err(fault("is empty; give courtyard, dragons:N or a .glb, .gltf, .fbx or .toml file".into()))
            }
            _ => Ok(Self::File(argument.into())),
        }
    }
}

/// `N` or `NxMxK`, at most [`MAX_DRAGONS`] in all.
fn parse_dragons(count: &str) -> Option<SceneSource> {
    let numbers: Option<Vec<u32>> = count.split('x').map(|number| number.parse().ok()).collect();
    let numbers = numbers?;
    let product = numbers.iter().try_fold(1u32, |product, number| product.checked_mul(*number))?;
    match numbers[..] {
        _ if !(1..=MAX_DRAGONS).contains(&product) => None,
        [count] => Some(SceneSource::Dragons(count)),
        [across, up, deep] => Some(SceneSource::DragonGrid([across, up, deep])),
        _ => None,
    }
}

impl fmt::Display for SceneSource {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Dragons(1) => write!(out, "dragon"),
            Self::Dragons(count) => write!(out, "dragons:{count}"),
            Self::DragonGrid([across, up, deep]) => write!(out, "dragons:{across}x{up}x{deep}"),
            Self::Courtyard => write!(out, "{COURTYARD}"),
            Self::File(path) => write!(out, "{}", path.display()),
        }
    }
}

/// Loads a scene [plainly](Loading::plain): nothing is kept, and no coarser levels are made.
pub fn load_scene(source: &SceneSource) -> Result<Scene, SceneError> {
    load_scene_with(source, &Loading::plain())
}

/// Loads everything that a scene needs. Edges are split so that none is longer than [`MAX_EDGE_M`] in the world,
/// except the diagonals of the ground's cells.
pub fn load_scene_with(source: &SceneSource, loading: &Loading) -> Result<Scene, SceneError> {
    match source {
        SceneSource::Dragons(count) => dragons(*count, loading),
        SceneSource::DragonGrid(count) => dragon_grid(*count, loading),
        SceneSource::Courtyard => read_scene(COURTYARD_FILE, COURTYARD_NAME, Path::new(""), loading),
        SceneSource::File(path) => match extension(path).as_str() {
            "toml" => scene_file(path, loading),
            _ if is_asset(path) => asset(path, loading),
            other => Err(unknown_kind(path, other)),
        },
    }
}

fn extension(path: &Path) -> String {
    path.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase()).unwrap_or_default()
}

fn unknown_kind(path: &Path, extension: &str) -> SceneError {
    let name = path.display().to_string();
    let hint = did_you_mean(&name, ["dragon", "dragons", COURTYARD]);
    let problem = match extension {
        "" => format!("is neither a built-in scene nor a .glb, .gltf, .fbx or .toml file{hint}"),
        other => format!("files of type .{other} are not supported; give a .glb, .gltf, .fbx or .toml file"),
    };
    SceneError::Argument { argument: name, problem }
}

/// Whether the file's name is that of an asset that can be imported.
fn is_asset(path: &Path) -> bool {
    matches!(extension(path).as_str(), "glb" | "gltf" | "fbx")
}

/// The one way by which models come into a scene.
fn load_model(file: &ModelFile, loading: &Loading) -> Result<Model, SceneError> {
    match file {
        ModelFile::BuiltIn(model) => process::built_in(*model, loading),
        ModelFile::Path(path) => {
            let importer = if extension(path) == "fbx" { fbx::import } else { gltf::import };
            process::import(&loading.cache, path, |path| import::read(path, importer, &loading.cancel))
        }
    }
}

/// The first clip that moves anything.
fn first_moving_clip(model: &Model) -> Option<usize> {
    let moves = |clip: &Clip| {
        clip.tracks.iter().any(track_varies) || clip.morph_tracks.iter().any(morph_track_varies)
    };
    model.clips.iter().position(moves)
}

/// A scene with default light, ground and stage around models that an importer, or an application itself, has made.
///
/// # Errors
/// Somebody asked to end.
pub fn around(models: Vec<Model>, instances: Vec<Instance>, loading: &Loading) -> Result<Scene, SceneError> {
    let (sun, environment) = file::default_light();
    let scene = Scene {
        models,
        instances,
        events: Vec::new(),
        sun,
        lights: Vec::new(),
        environment,
        world_from_stage: Pose::IDENTITY,
        cameras: Vec::new(),
        head_paths: file::built_in_head_paths(),
    };
    finished(scene, Some(ground::DEFAULT_SIZE_M), loading)
}

/// Refines the models, then adds the ground, which needs no splitting: its cells are half a metre, and their diagonals
/// do not make its patches larger.
fn finished(mut scene: Scene, ground_size_m: Option<f32>, loading: &Loading) -> Result<Scene, SceneError> {
    refine_models(&mut scene, loading)?;
    if let Some(size_m) = ground_size_m {
        add_ground(&mut scene, size_m);
        process::refine(scene.models.last_mut().expect("the ground"), None, loading)?;
    }
    Ok(scene)
}

fn add_ground(scene: &mut Scene, size_m: f32) {
    // Nothing lies below it that its shadow could reach.
    scene.instances.push(Instance { casts_shadow: false, ..Instance::new("ground", scene.models.len()) });
    scene.models.push(ground::ground(size_m));
}

// ---- an asset ----

/// The part of a picture's height that an asset takes at the start of the walk, 90 degrees from bottom to top: as much as
/// leaves room for its surroundings, and so much that it counts.
const ASSET_PART_OF_HEIGHT: f32 = 1.0 / 3.0;
/// The part of the way from a picture's middle to its sides, top and bottom within which an asset stays at the start: the
/// head turns and goes to the sides.
const ASSET_PART_OF_SIDES: f32 = 0.8;
/// Distances from the user to the middle of an asset, metres: no nearer, since the walk goes forward, and no farther.
const ASSET_DISTANCE_M: std::ops::RangeInclusive<f32> = 1.0..=6.0;
/// Room for the head between the user and the nearest part of an asset, metres.
const ASSET_ROOM_M: f32 = 0.8;
/// Moments of a clip at which an asset is looked at.
const FRAMING_MOMENTS: u32 = 16;
/// An asset's largest extent, metres, may be in this range; others are scaled to the third number.
const ASSET_EXTENT_M: (f32, f32, f32) = (0.9, 2.0, 1.6);

fn asset(path: &Path, loading: &Loading) -> Result<Scene, SceneError> {
    let model = load_model(&ModelFile::Path(path.to_owned()), loading)?;
    let clip = first_moving_clip(&model);
    let placement = place_asset(&model, clip).map_err(|problem| SceneError::Asset {
        file: path.display().to_string(),
        element: "scene".into(),
        problem,
    })?;
    let name = model.name.clone();
    let instance = Instance { placement, clip, ..Instance::new(name, 0) };
    around(vec![model], vec![instance], loading)
}

/// Stands the model on the ground in front of the user, facing them: glTF's front is +z, the user looks along -z. So far away
/// that it takes [`ASSET_PART_OF_HEIGHT`] of the picture, or farther, where it would leave the picture.
fn place_asset(model: &Model, clip: Option<usize>) -> Result<Affine3A, String> {
    let (low, high) = finite_bounds(model, clip)?;
    let extent = (high - low).max_element();
    let (least, most, otherwise) = ASSET_EXTENT_M;
    let scale = if (least..=most).contains(&extent) { 1.0 } else { otherwise / extent };
    let middle = (low + high) * 0.5;
    let foot = Vec3::new(middle.x, low.y, middle.z);
    let at_origin =
        Affine3A::from_scale_rotation_translation(Vec3::splat(scale), Quat::IDENTITY, -foot * scale);
    let distance_m = framing_distance_m(&places_over_time(model, clip, at_origin));
    Ok(Affine3A::from_translation(Vec3::new(0.0, 0.0, -distance_m)) * at_origin)
}

/// Where the vertices are over a clip.
fn places_over_time(model: &Model, clip: Option<usize>, placement: Affine3A) -> Vec<Vec3> {
    let moment = |moment: u32| {
        let t_s = f64::from(model.duration_s(clip)) * f64::from(moment) / f64::from(FRAMING_MOMENTS);
        pose::source_skin(model, clip, t_s, placement).into_iter().map(|vertex| vertex.position)
    };
    (0..FRAMING_MOMENTS).flat_map(moment).collect()
}

/// The nearest distance at which places about the origin are framed; the farthest one where none of them does.
fn framing_distance_m(places: &[Vec3]) -> f32 {
    let (mut near, mut far) = ASSET_DISTANCE_M.into_inner();
    if is_framed(places, near) {
        return near;
    }
    // What is farther away is smaller: halve until it is right to a millimetre or two.
    for _ in 0..12 {
        let middle = 0.5 * (near + far);
        if is_framed(places, middle) { far = middle } else { near = middle }
    }
    far
}

fn is_framed(places: &[Vec3], distance_m: f32) -> bool {
    let Some((low, high, nearest_m)) = seen_at_start(places, distance_m) else { return false };
    let sides = low.abs().max(high.abs()).max_element();
    nearest_m >= ASSET_ROOM_M
        && sides <= ASSET_PART_OF_SIDES
        && (high.y - low.y) * 0.5 <= ASSET_PART_OF_HEIGHT
}

/// Where places, moved away by so much, lie in the picture at the start of the walk (-1 to 1 over 90 degrees), and the least
/// distance of one along the floor; `None` where one lies behind the eyes.
fn seen_at_start(places: &[Vec3], distance_m: f32) -> Option<(Vec2, Vec2, f32)> {
    let start = file::built_in_head_paths();
    let head = find_head_path(&start, "walk").map_or(Pose::IDENTITY, |path| path.stage_from_head(0.0));
    let eye_from_stage = head.inverse().affine();
    let (mut low, mut high, mut nearest_m) = (Vec2::INFINITY, Vec2::NEG_INFINITY, f32::INFINITY);
    for place in places {
        let away = *place - Vec3::Z * distance_m;
        let seen = eye_from_stage.transform_point3(away);
        if seen.z >= -1e-3 {
            return None;
        }
        let at = seen.truncate() / -seen.z;
        (low, high, nearest_m) = (low.min(at), high.max(at), nearest_m.min(-away.z));
    }
    Some((low, high, nearest_m))
}

/// Bounds over the clip, of a size that can be worked with.
fn finite_bounds(model: &Model, clip: Option<usize>) -> Result<(Vec3, Vec3), String> {
    let (low, high) = pose::bounds(model, clip, 16).ok_or("has no triangles to show")?;
    let extent = (high - low).max_element();
    if !(low.is_finite() && high.is_finite() && extent > 1e-6 && extent < 1e7) {
        return Err(format!("its extent of {extent} m is out of range; check the scales of its bones"));
    }
    Ok((low, high))
}

// ---- dragons ----

/// Distance from the user to the middle of the group, metres, for few dragons.
const GROUP_DISTANCE_M: f32 = 3.3;

fn dragons(count: u32, loading: &Loading) -> Result<Scene, SceneError> {
    let place = |index, low, high| dragon_place(index, count, low, high);
    placed_dragons((0..count).map(|index| format!("dragon {index}")).collect(), place, loading)
}

/// The paper's arrangement: a three-dimensional grid, the lowest layer on the ground, x before y before z.
fn dragon_grid(count: [u32; 3], loading: &Loading) -> Result<Scene, SceneError> {
    let cells: Vec<[u32; 3]> = file::cells(count).collect();
    let names = cells.iter().map(|[x, y, z]| format!("dragon {x},{y},{z}")).collect();
    placed_dragons(names, |index, low, high| grid_place(cells[index as usize], count, low, high), loading)
}

/// Dragons of these names, each where `place` puts the one of its number, given the bounds of its flight.
fn placed_dragons(
    names: Vec<String>,
    place: impl Fn(u32, Vec3, Vec3) -> Affine3A,
    loading: &Loading,
) -> Result<Scene, SceneError> {
    let model = load_model(&ModelFile::BuiltIn(BuiltIn::Dragon), loading)?;
    let clip = first_moving_clip(&model);
    let fault =
        |problem| SceneError::Asset { file: "built-in dragon".into(), element: "scene".into(), problem };
    let (low, high) = finite_bounds(&model, clip).map_err(fault)?;
    let duration_s = model.duration_s(clip);
    let instance = |(index, name): (u32, String)| Instance {
        placement: place(index, low, high),
        clip,
        time_shift_s: file::spread(index) * duration_s,
        ..Instance::new(name, 0)
    };
    let instances = (0..).zip(names).map(instance).collect();
    around(vec![model], instances, loading)
}

/// Distance of neighbours in a grid of dragons, in parts of a dragon's extent.
const GRID_SPACING: f32 = 1.15;

/// Columns side by side about the user's line of sight, rows further back, layers upwards.
fn grid_place([x, y, z]: [u32; 3], [across, _, _]: [u32; 3], low: Vec3, high: Vec3) -> Affine3A {
    let step = (high - low) * GRID_SPACING;
    let side = x as f32 - (across - 1) as f32 * 0.5;
    let at = Vec3::new(side * step.x, y as f32 * step.y, -(GROUP_DISTANCE_M + z as f32 * step.z));
    Affine3A::from_translation(at) * model_from_foot(low, high)
}

/// Takes the middle of a model's foot to its origin.
fn model_from_foot(low: Vec3, high: Vec3) -> Affine3A {
    let middle = (low + high) * 0.5;
    Affine3A::from_translation(-Vec3::new(middle.x, low.y, middle.z))
}

/// Rows of at most ceil(sqrt(count)) side by side (all of up to three in one row), later rows further back and
/// shifted by half a place, each dragon turned towards the user, the outer ones of a row nearer than the inner ones.
fn dragon_place(index: u32, count: u32, low: Vec3, high: Vec3) -> Affine3A {
    let columns = if count <= 3 { count } else { (f64::from(count).sqrt().ceil()) as u32 };
    let (row, column) = (index / columns, index % columns);
    let in_row = columns.min(count - row * columns);
    // Wings of neighbours may overlap in x a little, since neighbours also differ in depth.
    let spacing = Vec3::new((high.x - low.x) * 0.85, 0.0, (high.z - low.z) * 0.7).max(Vec3::splat(0.85));
    let shift = if count > columns { 0.5 * (row % 2) as f32 - 0.25 } else { 0.0 };
    let side = column as f32 - (in_row - 1) as f32 * 0.5 + shift;
    let stagger = if in_row > 1 { 0.35 * (side.abs().min(2.0) - 0.5) } else { 0.0 };
    let at = Vec3::new(side * spacing.x, 0.0, -(GROUP_DISTANCE_M + row as f32 * spacing.z) + stagger);
    let yaw = -(at.x / -at.z).atan();
    Affine3A::from_rotation_translation(Quat::from_rotation_y(yaw), at) * model_from_foot(low, high)
}

// ---- a scene file ----

fn scene_file(path: &Path, loading: &Loading) -> Result<Scene, SceneError> {
    let (name, text) = read_scene_file(path)?;
    read_scene(&text, &name, path.parent().unwrap_or(Path::new("")), loading)
}

/// Name, for messages, and text.
fn read_scene_file(path: &Path) -> Result<(String, String), SceneError> {
    let name = path.display().to_string();
    let text = read_limited(path)
        .and_then(|bytes| String::from_utf8(bytes).map_err(|_| std::io::Error::other("not UTF-8 text")));
    match text {
        Ok(text) => Ok((name, text)),
        Err(reason) => Err(SceneError::Read { file: name, reason }),
    }
}

/// A head path of a scene by its name, without loading the scene's models.
///
/// # Errors
/// The scene file cannot be read or has a fault, or no head path has that name.
pub fn load_head_path(source: &SceneSource, name: &str) -> Result<HeadPath, SceneError> {
    let head_paths = match source {
        SceneSource::File(path) if extension(path) == "toml" => {
            let (file, text) = read_scene_file(path)?;
            file::parse(&text, &file)?.head_paths
        }
        SceneSource::Courtyard => file::parse(COURTYARD_FILE, COURTYARD_NAME)?.head_paths,
        _ => file::built_in_head_paths(),
    };
    find_head_path(&head_paths, name).cloned()
}

/// The scene that a file of this text in this folder describes, loaded [plainly](Loading::plain).
pub fn scene_from_text(text: &str, name: &str, folder: &Path) -> Result<Scene, SceneError> {
    read_scene(text, name, folder, &Loading::plain())
}

fn read_scene(text: &str, name: &str, folder: &Path, loading: &Loading) -> Result<Scene, SceneError> {
    let file = file::parse(text, name)?;
    let models = file
        .models
        .iter()
        .map(|entry| named_model(entry, name, folder, loading))
        .collect::<Result<Vec<_>, _>>()?;
    let instances = instances(&file, &models, name)?;
    let events = events(&file, &models, name)?;
    let SceneFile { sun, lights, environment, ground_size_m, world_from_stage, cameras, head_paths, .. } =
        file;
    let scene =
        Scene { models, instances, events, sun, lights, environment, world_from_stage, cameras, head_paths };
    finished(scene, ground_size_m, loading)
}

fn named_model(
    entry: &ModelEntry,
    name: &str,
    folder: &Path,
    loading: &Loading,
) -> Result<Model, SceneError> {
    let fault = |problem: String| SceneError::SceneFile { file: name.to_owned(), line: entry.line, problem };
    let mut model = match &entry.file {
        ModelFile::BuiltIn(_) => load_model(&entry.file, loading)?,
        ModelFile::Path(path) if is_asset(path) => {
            // The reason in the scene's terms: the line that names the file.
            load_model(&ModelFile::Path(folder.join(path)), loading).map_err(|error| match error {
                SceneError::Cancelled(_) => error,
                _ => fault(format!("model \"{}\": {error}", printable(&entry.name))),
            })?
        }
        ModelFile::Path(path) => {
            let hint = did_you_mean(&path.to_string_lossy(), BuiltIn::ALL.map(BuiltIn::name));
            return Err(fault(format!("\"{}\" is not a .glb, .gltf or .fbx file{hint}", path.display())));
        }
    };
    model.name.clone_from(&entry.name);
    Ok(model)
}

fn instances(file: &SceneFile, models: &[Model], name: &str) -> Result<Vec<Instance>, SceneError> {
    let convert = |entry: &file::InstanceEntry| {
        let model = &models[entry.model];
        let clip = choose_clip(&entry.clip, model, name)?;
        Ok(Instance {
            name: entry.name.clone(),
            model: entry.model,
            placement: entry.world_from_model,
            path: entry.path.clone(),
            clip,
            time_shift_s: entry.time_shift.in_seconds(model.duration_s(clip), entry.speed),
            speed: entry.speed,
            repetition: entry.repetition,
            casts_shadow: entry.casts_shadow,
            live: entry.live,
        })
    };
    file.instances.iter().map(convert).collect()
}

fn events(file: &SceneFile, models: &[Model], name: &str) -> Result<Vec<Event>, SceneError> {
    let convert = |entry: &EventEntry| {
        let model = &models[file.instances[entry.instance].model];
        let clip = entry.clip.as_ref().map(|choice| choose_clip(choice, model, name)).transpose()?;
        let EventEntry { at, instance, change, .. } = *entry;
        Ok(Event { at, instance, change: Change { clip, ..change } })
    };
    file.events.iter().map(convert).collect()
}

fn choose_clip(choice: &ClipChoice, model: &Model, name: &str) -> Result<Option<usize>, SceneError> {
    let (wanted, line) = match choice {
        ClipChoice::First => return Ok(first_moving_clip(model)),
        ClipChoice::Rest => return Ok(None),
        ClipChoice::Named(wanted, line) => (wanted, *line),
    };
    let names = || model.clips.iter().map(|clip| clip.name.as_str());
    // Importers keep names as they can be shown.
    let found = names().position(|clip| clip == wanted || clip == printable(wanted));
    found.map(Some).ok_or_else(|| {
        let hint = did_you_mean_or_list(wanted, names(), "it has");
        let problem =
            format!("model \"{}\" has no clip \"{}\"{hint}", printable(&model.name), printable(wanted));
        SceneError::SceneFile { file: name.to_owned(), line, problem }
    })
}

// ---- long edges ----

fn refine_models(scene: &mut Scene, loading: &Loading) -> Result<(), Cancelled> {
    for index in 0..scene.models.len() {
        let placed = scene.instances.iter().filter(|instance| instance.model == index);
        let scale = placed.map(largest_world_scale).fold(0.0, f32::max);
        let model = &mut scene.models[index];
        let limit = MAX_EDGE_M / (scale * rest_scale(model));
        let limit = Some(limit).filter(|limit| limit.is_finite() && *limit > 0.0);
        let split = process::refine(model, limit, loading)?;
        if split.is_some_and(|stats| !stats.complete) {
            tracing::warn!(
                "{}: edges stay longer than {MAX_EDGE_M} m; split it in a modelling tool",
                printable(&model.name)
            );
        }
    }
    Ok(())
}

/// Largest stretch from mesh to model space among the palette's entries in the rest pose.
fn rest_scale(model: &Model) -> f32 {
    pose::source_palette(model, None, 0.0).into_iter().map(largest_scale).fold(0.0, f32::max)
}

/// Largest stretch from model to world at any time; a bound where path and placement stretch different axes.
fn largest_world_scale(instance: &Instance) -> f32 {
    let path = instance.path.as_ref().map_or(1.0, |path| path.scale_range().1);
    path * largest_scale(instance.placement)
}

/// Longest image of an axis.
fn largest_scale(transform: Affine3A) -> f32 {
    let axes = transform.matrix3;
    axes.x_axis.length().max(axes.y_axis.length()).max(axes.z_axis.length())
}

#[cfg(test)]
mod tests;

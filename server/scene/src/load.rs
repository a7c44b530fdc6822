//! From the SCENE argument to a complete [`Scene`]: a scene file, an asset with a sensible scene around it, or the
//! built-in dragons.

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
use shadecast_model::pose::Pose;
use shadecast_model::text::printable;
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
    /// Built-in dragons in a grid: so many side by side, above each other, behind each other.
    DragonGrid([u32; 3]),
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

    /// `dragon`, `dragons:N`, `dragons:NxMxK`, or a path.
    fn from_str(argument: &str) -> Result<Self, SceneError> {
        let fault = |problem: String| SceneError::Argument { argument: argument.to_owned(), problem };
        match argument.split_once(':') {
            Some(("dragons" | "dragon", count)) => parse_dragons(count).ok_or_else(|| {
                fault(format!(
                    "the number must be from 1 to {MAX_DRAGONS}, or three of that product, such as 3x1x3"
                ))
            }),
            _ if argument == "dragon" => Ok(Self::Dragons(1)),
            _ if argument == "dragons" => Ok(Self::default()),
            _ if argument.is_empty() => {
                Err(fault("is empty; give dragons:N or a .glb, .gltf, .fbx or .toml file".into()))
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
    let hint = did_you_mean(&name, ["dragon", "dragons"]);
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
        ModelFile::BuiltInDragon => process::built_in_dragon(loading),
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
    let model = load_model(&ModelFile::BuiltInDragon, loading)?;
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
        ModelFile::BuiltInDragon => load_model(&ModelFile::BuiltInDragon, loading)?,
        ModelFile::Path(path) if is_asset(path) => {
            // The reason in the scene's terms: the line that names the file.
            load_model(&ModelFile::Path(folder.join(path)), loading).map_err(|error| match error {
                SceneError::Cancelled(_) => error,
                _ => fault(format!("model \"{}\": {error}", printable(&entry.name))),
            })?
        }
        ModelFile::Path(path) => {
            let hint = did_you_mean(&path.to_string_lossy(), [file::BUILT_IN_DRAGON]);
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
mod tests {
    use super::*;
    use crate::split::{SplitStats, split_long_edges};

    fn shared_asset(name: &str) -> Option<PathBuf> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/assets").join(name);
        if path.is_file() {
            return Some(path);
        }
        eprintln!("SKIPPED: {} does not exist", path.display());
        None
    }

    /// Bounds of an instance in the world over its clip.
    fn world_bounds(scene: &Scene, index: usize) -> (Vec3, Vec3) {
        let instance = &scene.instances[index];
        let model = &scene.models[instance.model];
        let duration_s = model.duration_s(instance.clip);
        let mut found = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        for moment in 0..16 {
            let t_s = f64::from(duration_s) * f64::from(moment) / 16.0;
            for vertex in pose::source_skin(model, instance.clip, t_s, instance.world_from_model(0.0)) {
                found = (found.0.min(vertex.position), found.1.max(vertex.position));
            }
        }
        found
    }

    fn longest_edge_m(scene: &Scene, index: usize) -> f32 {
        let instance = &scene.instances[index];
        let model = &scene.models[instance.model];
        let skinned = pose::source_skin(model, None, 0.0, instance.world_from_model(0.0));
        let edges = model.indices.chunks_exact(3).flat_map(|triangle| {
            let [a, b, c] = [0, 1, 2].map(|corner| skinned[triangle[corner] as usize].position);
            [a.distance(b), b.distance(c), c.distance(a)]
        });
        edges.fold(0.0, f32::max)
    }

    #[test]
    fn scene_arguments_are_understood() {
        let parse = |argument: &str| argument.parse::<SceneSource>();
        assert_eq!(parse("dragon").expect("good"), SceneSource::Dragons(1));
        assert_eq!(parse("dragons:9").expect("good"), SceneSource::Dragons(9));
        assert_eq!(parse("dragons").expect("good"), SceneSource::default());
        assert_eq!(parse("dragons:3x1x2").expect("good"), SceneSource::DragonGrid([3, 1, 2]));
        assert_eq!(parse("a/b.glb").expect("good"), SceneSource::File("a/b.glb".into()));
        for bad in
            ["dragons:0", "dragons:x", "dragons:4000", "dragons:3x3", "dragons:0x1x1", "dragons:99x99x99", ""]
        {
            assert!(parse(bad).is_err(), "{bad}");
        }
        for source in ["dragon", "dragons:9", "dragons:13x1x13", "a/b.glb"] {
            assert_eq!(parse(source).expect("good").to_string(), source);
        }
    }

    #[test]
    fn a_clip_of_an_event_is_one_of_its_instances_model() {
        let text = |clip: &str| {
            format!(
                "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\n\
                 [[event]]\nat = 1\ninstance = \"d 0\"\nclip = \"{clip}\"\n"
            )
        };
        let own = scene_from_text(&text("fly"), "s.toml", Path::new("")).expect("a clip of the dragon");
        assert_eq!(own.events[0].change.clip, Some(Some(0)));
        let error = scene_from_text(&text("fyl"), "s.toml", Path::new("")).expect_err("no such clip");
        assert_eq!(error.to_string(), "s.toml:9: model \"d\" has no clip \"fyl\"; did you mean \"fly\"?");
    }

    #[test]
    fn unknown_files_are_refused_with_advice() {
        let message = |path: &str| load_scene(&SceneSource::File(path.into())).expect_err(path).to_string();
        assert!(message("x.obj").contains("files of type .obj are not supported"), "{}", message("x.obj"));
        assert!(message("dragn").contains("did you mean \"dragon\"?"), "{}", message("dragn"));
        assert!(
            message("nowhere.glb").starts_with("nowhere.glb: cannot be read"),
            "{}",
            message("nowhere.glb")
        );
        assert!(
            message("nowhere.toml").starts_with("nowhere.toml: cannot be read"),
            "{}",
            message("nowhere.toml")
        );
    }

    #[test]
    fn real_assets_stand_in_front_of_the_user_at_a_sensible_size() {
        for name in
            ["CesiumMan.glb", "Fox.glb", "DamagedHelmet.glb", "RiggedSimple.glb", "MorphStressTest.gltf"]
        {
            let Some(path) = shared_asset(name) else { return };
            let scene = load_scene(&SceneSource::File(path)).expect(name);
            let (low, high) = world_bounds(&scene, 0);
            let extent = (high - low).max_element();
            eprintln!("{name}: from {low:.2} to {high:.2}, clip {:?}", scene.instances[0].clip);
            assert!((0.85..=2.05).contains(&extent), "{name}: {extent} m");
            assert!(low.y.abs() < 0.02, "{name}: stands at {}", low.y);
            let middle = (low + high) * 0.5;
            assert!(middle.x.abs() < 0.05 && ASSET_DISTANCE_M.contains(&-middle.z), "{name}: {middle}");
            assert!(longest_edge_m(&scene, 0) <= MAX_EDGE_M * 1.01, "{name}");
            assert_eq!(scene.instances[1].name, "ground");
            assert_eq!(scene.instances[0].clip.is_some(), name != "DamagedHelmet.glb", "{name} moves");
        }
    }

    #[test]
    fn assets_take_a_third_of_the_picture() {
        for name in
            ["CesiumMan.glb", "Fox.glb", "maya_kenney_character_7700_binary.fbx", "MorphStressTest.gltf"]
        {
            let Some(path) = shared_asset(name) else { return };
            let scene = load_scene(&SceneSource::File(path)).expect(name);
            let instance = &scene.instances[0];
            let model = &scene.models[0];
            let places = places_over_time(model, instance.clip, instance.placement);
            let (low, high, _) = seen_at_start(&places, 0.0).expect("in front");
            let part = (high.y - low.y) * 0.5;
            let widest = low.abs().max(high.abs()).max_element();
            eprintln!("{name}: {part:.3} of the height, {low} to {high}, {}", instance.placement.translation);
            assert!(part <= ASSET_PART_OF_HEIGHT + 0.005, "{name}: {part}");
            // What does not take a third would leave the picture if it did.
            assert!(
                part > ASSET_PART_OF_HEIGHT - 0.01 || widest > ASSET_PART_OF_SIDES - 0.02,
                "{name}: {part}"
            );
            let walk = scene.head_path("walk").expect("every scene has it");
            for step in 0..20 {
                let eye_from_stage = walk.stage_from_head(f64::from(step) * 0.25).inverse().affine();
                let is_seen = |place: &&Vec3| {
                    let at = eye_from_stage.transform_point3(**place);
                    at.z < -0.1 && (at.truncate() / -at.z).abs().max_element() <= 1.0
                };
                let seen = places.iter().filter(is_seen).count();
                assert!(seen * 10 >= places.len() * 9, "{name}, step {step}: {seen} of {}", places.len());
            }
        }
    }

    #[test]
    fn a_pole_is_framed_by_its_height_and_a_beam_by_its_width() {
        let pole = [Vec3::ZERO, Vec3::Y * 1.5];
        let distance_m = framing_distance_m(&pole);
        let (low, high, _) = seen_at_start(&pole, distance_m).expect("in front");
        assert!(((high.y - low.y) * 0.5 - ASSET_PART_OF_HEIGHT).abs() < 0.003, "{low} to {high}");
        let beam = [Vec3::new(-1.5, 1.2, 0.0), Vec3::new(1.5, 1.3, 0.0)];
        let distance_m = framing_distance_m(&beam);
        let (low, high, _) = seen_at_start(&beam, distance_m).expect("in front");
        assert!(
            (high.x - ASSET_PART_OF_SIDES).abs() < 0.003 && (low.x + high.x).abs() < 0.01,
            "{low} to {high}"
        );
        assert_eq!(framing_distance_m(&[Vec3::new(0.0, 1.3, 0.0)]), *ASSET_DISTANCE_M.start());
    }

    #[test]
    fn dragons_stand_apart_in_front_of_the_user() {
        for count in [1, 2, 3, 5, 9, 25] {
            let scene = load_scene(&SceneSource::Dragons(count)).expect("dragons");
            assert_eq!(scene.instances.len(), count as usize + 1);
            assert_eq!(scene.models.len(), 2, "one dragon however many are shown, and the ground");
            let places: Vec<Vec3> = (0..count as usize)
                .map(|index| {
                    let (low, high) = world_bounds(&scene, index);
                    assert!(low.y.abs() < 0.05, "dragon {index} of {count} stands at {}", low.y);
                    assert!(high.z < -0.6, "dragon {index} of {count} touches the user: {high}");
                    (low + high) * 0.5
                })
                .collect();
            for (a, first) in places.iter().enumerate() {
                assert!(
                    places[a + 1..].iter().all(|other| first.distance(*other) > 0.8),
                    "{count}: {places:?}"
                );
            }
            if count <= 3 {
                let group = places.iter().sum::<Vec3>() / count as f32;
                assert!((3.0..=3.6).contains(&-group.z) && group.x.abs() < 0.3, "{count}: centre {group}");
            }
            let mut shifts: Vec<f32> =
                scene.instances[..count as usize].iter().map(|i| i.time_shift_s).collect();
            shifts.sort_by(f32::total_cmp);
            assert!(shifts.windows(2).all(|pair| pair[1] - pair[0] > 0.01), "{shifts:?}");
        }
    }

    #[test]
    fn grid_of_dragons_fills_rows_columns_and_layers_without_touching() {
        let scene = load_scene(&SceneSource::DragonGrid([3, 2, 2])).expect("dragons");
        assert_eq!((scene.instances.len(), scene.models.len()), (13, 2));
        let (low, high) = world_bounds(&scene, 0);
        let moved = |instance: &Instance| {
            assert_eq!(instance.placement.matrix3, scene.instances[0].placement.matrix3);
            let by = Vec3::from(instance.placement.translation - scene.instances[0].placement.translation);
            (low + by, high + by)
        };
        let bounds: Vec<(Vec3, Vec3)> = scene.instances[..12].iter().map(moved).collect();
        for (a, (low, high)) in bounds.iter().enumerate() {
            assert!(high.z < -0.6, "dragon {a} touches the user: {high}");
            for (b, other) in bounds.iter().enumerate().skip(a + 1) {
                let apart = low.cmpgt(other.1) | other.0.cmpgt(*high);
                assert!(apart.any(), "dragons {a} and {b} overlap");
            }
        }
        assert!(bounds[0].0.y.abs() < 0.05 && bounds[3].0.y > bounds[0].1.y, "layers stand on each other");
        let middle_x = bounds.iter().map(|(low, high)| low.x + high.x).sum::<f32>() / 24.0;
        assert!(middle_x.abs() < 0.05, "{middle_x}");
    }

    #[test]
    fn example_in_the_documentation_loads() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/scene.example.toml");
        let source = SceneSource::File(path);
        let scene = load_scene(&source).expect("the example");
        let names: Vec<&str> = scene.instances.iter().map(|i| i.name.as_str()).collect();
        assert_eq!(names[..4], ["the near one", "dragon 1", "the moving one", "flock 0,0,0"]);
        assert_eq!((names.len(), names[9]), (10, "ground"));
        assert!(scene.instances[0].clip.is_some() && scene.instances[2].path.is_some());
        assert_eq!((scene.lights.len(), scene.cameras.len()), (2, 2));
        let aside = scene.head_path("step aside").expect("defined").stage_from_head(1.0);
        let alone = load_head_path(&source, "step aside").expect("defined");
        assert_eq!(alone.stage_from_head(1.0), aside);
        let (low, high) = world_bounds(&scene, 2);
        assert!(low.y > -0.05 && high.y < 2.0, "the moving one flies low: {low} to {high}");
    }

    #[test]
    fn unknown_clip_is_shown_with_its_line() {
        let text = "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\nclip = \"swim across the lake\"\n";
        let message = scene_from_text(text, "s.toml", Path::new("")).expect_err("no such clip").to_string();
        assert!(
            message.starts_with("s.toml:6: model \"d\" has no clip \"swim across the lake\"; it has \""),
            "{message}"
        );
        let rest = scene_from_text(&text.replace("swim across the lake", ""), "s.toml", Path::new(""))
            .expect("rest pose");
        assert_eq!(rest.instances[0].clip, None);
    }

    #[test]
    fn missing_model_file_is_shown_with_its_line() {
        let text = "[[model]]\nname = \"d\"\nfile = \"gone.glb\"\n[[instance]]\nmodel = \"d\"\n";
        let message =
            |text: &str| scene_from_text(text, "s.toml", Path::new("x")).expect_err("fault").to_string();
        assert!(
            message(text).starts_with("s.toml:3: model \"d\": x/gone.glb: cannot be read"),
            "{}",
            message(text)
        );
        let typo = message(&text.replace("gone.glb", "dragno"));
        assert_eq!(typo, "s.toml:3: \"dragno\" is not a .glb, .gltf or .fbx file; did you mean \"dragon\"?");
    }

    #[test]
    fn edges_are_split_by_their_length_in_the_world() {
        let mut small = ground::ground(4.0);
        small.name = "sheet".into();
        let instance = |scale: f32| Instance {
            placement: Affine3A::from_scale(Vec3::splat(scale)),
            ..Instance::new("i", 0)
        };
        let split = |scale: f32| {
            let scene =
                around(vec![small.clone()], vec![instance(0.1), instance(scale)], &Loading::plain()).unwrap();
            (scene.models[0].indices.len() / 3, longest_edge_m(&scene, 1))
        };
        let SplitStats { triangles_before, .. } = split_long_edges(&mut small.clone(), 100.0);
        assert_eq!(split(0.5).0, triangles_before, "diagonals of 0.35 m stay");
        let keys = "{ time_s = 0, scale = 1 }, { time_s = 1, scale = 4 }";
        let text = format!(
            "[[model]]\nname = \"d\"\nfile = \"dragon\"\n[[instance]]\nmodel = \"d\"\npath = {{ key = [{keys}] }}\n"
        );
        let growing = scene_from_text(&text, "s.toml", Path::new("")).expect("good").instances.remove(0);
        let scene =
            around(vec![small.clone()], vec![Instance { model: 0, ..growing }], &Loading::plain()).unwrap();
        assert!(scene.models[0].indices.len() / 3 > triangles_before, "a path that grows it counts");
        let (triangles, longest_m) = split(4.0);
        assert!(
            triangles > triangles_before && longest_m <= MAX_EDGE_M,
            "{triangles} triangles, {longest_m} m"
        );
    }
}

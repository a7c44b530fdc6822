//! Placement of models in a scene file: single instances, and grids of them.

use super::fields::Fields;
use super::path::{CURVE_KEYS, REPETITIONS, read_transform_path};
use super::transform::{read_scale, rotation_of};
use super::{ClipChoice, InstanceEntry, ModelEntry, TimeShift};
use crate::suggest::did_you_mean_or_list;
use crate::{Path, SceneError};
use glam::{Affine3A, Mat4, Quat, Vec3};
use shadecast_model::limits::MAX_INSTANCES;
use shadecast_model::text::printable;

/// Most placed models of a scene file: one number of an instance is left for the ground.
pub const MAX_PLACED: u32 = MAX_INSTANCES - 1;

/// What instances and grids both have.
const SHARED_KEYS: [&str; 12] = [
    "name",
    "model",
    "rotation_euler_deg",
    "scale",
    "time_shift_s",
    "speed",
    "repetition",
    "clip",
    "path",
    "path_time_shift_s",
    "casts_shadow",
    "live",
];
const INSTANCE_KEYS: [&str; 2] = ["translation", "matrix"];
const GRID_KEYS: [&str; 9] = [
    "count",
    "spacing",
    "origin",
    "center",
    "yaw_jitter_deg",
    "time_shift_step_s",
    "time_shifts_s",
    "time_shift_spread",
    "path_time_shift_step_s",
];

/// What instances refer to.
pub(super) struct Named<'a> {
    pub(super) models: &'a [ModelEntry],
    pub(super) paths: &'a [(String, Path)],
}

/// All `[[instance]]`, then the cells of all `[[grid]]`.
pub(super) fn read_instances(root: &Fields, named: &Named) -> Result<Vec<InstanceEntry>, SceneError> {
    let mut instances = Vec::new();
    for fields in root.tables("instance", &[&SHARED_KEYS[..], &INSTANCE_KEYS].concat())? {
        let world_from_model = read_placement(&fields)?;
        let shared = read_shared(&fields, named, instances.len())?;
        check_count(&fields, instances.len(), 1)?;
        instances.push(InstanceEntry { world_from_model, ..shared });
    }
    for fields in root.tables("grid", &[&SHARED_KEYS[..], &GRID_KEYS].concat())? {
        let grid = read_grid(&fields)?;
        check_count(&fields, instances.len(), grid.count.map(u64::from).iter().product())?;
        let shared = read_shared(&fields, named, instances.len())?;
        let scale = read_scale(&fields)?;
        let rotation = rotation_of(fields.numbers("rotation_euler_deg")?.unwrap_or_default());
        let upright = Affine3A::from_scale_rotation_translation(scale, rotation, Vec3::ZERO);
        check_not_flat(&fields, upright, "scale")?;
        instances.extend(cells(grid.count).map(|cell| grid.place(&shared, upright, cell)));
    }
    if instances.is_empty() {
        let problem = "the scene has no [[instance]] and no [[grid]]; add one";
        return Err(root.source.error(root.source.last_line(), problem));
    }
    Ok(instances)
}

fn check_count(fields: &Fields, before: usize, more: u64) -> Result<(), SceneError> {
    let total = before as u64 + more;
    if total <= u64::from(MAX_PLACED) {
        return Ok(());
    }
    let key = if fields.has("count") { "count" } else { "model" };
    Err(fields.error(key, format!("this makes {total} instances; a scene can have {MAX_PLACED}")))
}

/// Everything but the place.
fn read_shared(fields: &Fields, named: &Named, index: usize) -> Result<InstanceEntry, SceneError> {
    let (model_name, line) = fields.required_string("model")?;
    let names = named.models.iter().map(|model| model.name.as_str());
    let model = position_of(fields, "model", (&model_name, line), names)?;
    let clip = ClipChoice::read(fields)?.unwrap_or(ClipChoice::First);
    let name = fields.string("name")?.map(|(name, _)| name);
    let seconds = fields.number("time_shift_s")?.unwrap_or(0.0);
    Ok(InstanceEntry {
        name: name.unwrap_or_else(|| format!("{model_name} {index}")),
        model,
        world_from_model: Affine3A::IDENTITY,
        path: read_instance_path(fields, named)?,
        time_shift: TimeShift { seconds, of_clip: 0.0 },
        speed: fields.number("speed")?.unwrap_or(1.0),
        repetition: fields.choice("repetition", &REPETITIONS)?.unwrap_or_default(),
        clip,
        casts_shadow: fields.flag("casts_shadow")?.unwrap_or(true),
        live: fields.flag("live")?.unwrap_or(false),
    })
}

/// Index of a name that something else in the file defines.
fn position_of<'n>(
    fields: &Fields,
    what: &str,
    (wanted, line): (&str, usize),
    mut names: impl Iterator<Item = &'n str> + Clone,
) -> Result<usize, SceneError> {
    let all = names.clone();
    names.position(|name| name == wanted).ok_or_else(|| {
        let hint = did_you_mean_or_list(wanted, all, "there is");
        fields.source.error(line, format!("{what} \"{}\" is not defined{hint}", printable(wanted)))
    })
}

/// The name of a `[[path]]`, or a path of the instance's own.
fn read_instance_path(fields: &Fields, named: &Named) -> Result<Option<Path>, SceneError> {
    let path = match fields.get("path") {
        Some(value) if value.is_table() => {
            fields.table("path", &CURVE_KEYS)?.map(|path| read_transform_path(&path, "path")).transpose()?
        }
        _ => match fields.string("path")? {
            None => None,
            Some((name, line)) => {
                let names = named.paths.iter().map(|(name, _)| name.as_str());
                Some(named.paths[position_of(fields, "path", (&name, line), names)?].1.clone())
            }
        },
    };
    let shift_s = fields.number("path_time_shift_s")?;
    if let (None, Some(key)) = (&path, fields.first_of(&["path_time_shift_s", "path_time_shift_step_s"])) {
        return Err(fields.error(key, format!("\"{key}\" needs a \"path\" to shift")));
    }
    Ok(path.map(|path| Path { time_shift_s: path.time_shift_s + shift_s.unwrap_or(0.0), ..path }))
}

fn read_placement(fields: &Fields) -> Result<Affine3A, SceneError> {
    const PARTS: [&str; 3] = ["translation", "rotation_euler_deg", "scale"];
    let placement = match fields.numbers::<16>("matrix")? {
        Some(_) if fields.first_of(&PARTS).is_some() => {
            let problem = "\"matrix\" cannot be combined with translation, rotation_euler_deg or scale";
            return Err(fields.error("matrix", problem));
        }
        Some(matrix) => affine_of(&Mat4::from_cols_array(&matrix)).ok_or_else(|| {
            let problem =
                "the last row of \"matrix\" (numbers 4, 8, 12, 16) must be 0, 0, 0, 1: columns come first";
            fields.error("matrix", problem)
        })?,
        None => {
            let rotation = rotation_of(fields.numbers("rotation_euler_deg")?.unwrap_or_default());
            let translation = fields.vector_m("translation")?.unwrap_or_default();
            Affine3A::from_scale_rotation_translation(read_scale(fields)?, rotation, translation)
        }
    };
    check_not_flat(fields, placement, if fields.has("matrix") { "matrix" } else { "scale" })?;
    Ok(placement)
}

/// Refuses a placement that mirrors, which would turn the front of every triangle to the back, or flattens.
fn check_not_flat(fields: &Fields, placement: Affine3A, key: &str) -> Result<(), SceneError> {
    let determinant = placement.matrix3.determinant();
    if determinant.is_finite() && determinant > 0.0 {
        return Ok(());
    }
    let problem = if determinant < 0.0 {
        "mirrors the model; mirror the asset instead"
    } else {
        "scales the model to 0 or beyond the range of numbers"
    };
    Err(fields.error(key, format!("\"{key}\" {problem}")))
}

fn affine_of(matrix: &Mat4) -> Option<Affine3A> {
    (matrix.row(3) == glam::Vec4::W).then(|| Affine3A::from_mat4(*matrix))
}

// ---- grids ----

/// A `[[grid]]`: what differs from cell to cell.
struct Grid {
    count: [u32; 3],
    spacing_m: Vec3,
    first_m: Vec3,
    yaw_jitter_rad: f32,
    shifts: Shifts,
    path_step_s: f32,
}

/// How time shifts differ.
enum Shifts {
    /// By so many seconds from cell to cell; 0: not at all.
    Step(f32),
    /// By these seconds, again from the first when they end.
    List(Vec<f32>),
    /// Evenly over the clip, neighbours far apart.
    Spread,
}

/// The places of a grid, x first, then y, then z.
pub fn cells(count: [u32; 3]) -> impl Iterator<Item = [u32; 3]> {
    let [across, up, deep] = count;
    (0..deep).flat_map(move |z| (0..up).flat_map(move |y| (0..across).map(move |x| [x, y, z])))
}

/// Part of a clip, 0 to 1, by which to shift the cell of this number: golden-ratio steps, so that any number of cells
/// is spread evenly over the loop, and neighbours differ.
pub fn spread(index: u32) -> f32 {
    (f64::from(index) * 0.618_033_988_749_895).fract() as f32
}

fn read_grid(fields: &Fields) -> Result<Grid, SceneError> {
    fields.only_one_of(&["origin", "center"])?;
    let count = read_counts(fields)?;
    let spacing_m = fields.required("spacing", fields.vector_m("spacing")?)?;
    let piled = (0..3).find(|axis| count[*axis] > 1 && spacing_m[*axis] == 0.0);
    if let Some(axis) = piled {
        let axis = ["x", "y", "z"][axis];
        return Err(
            fields.error("spacing", format!("\"spacing\" is 0 along {axis}: instances would coincide"))
        );
    }
    let extent_m = spacing_m * (Vec3::from_array(count.map(|count| count as f32)) - 1.0);
    let first_m = match fields.vector_m("center")? {
        Some(center_m) => center_m - extent_m * 0.5,
        None => fields.vector_m("origin")?.unwrap_or_default(),
    };
    Ok(Grid {
        count,
        spacing_m,
        first_m,
        yaw_jitter_rad: fields
            .number_within("yaw_jitter_deg", 0.0..=180.0, "degrees")?
            .unwrap_or(0.0)
            .to_radians(),
        shifts: read_shifts(fields)?,
        path_step_s: fields.number("path_time_shift_step_s")?.unwrap_or(0.0),
    })
}

fn read_counts(fields: &Fields) -> Result<[u32; 3], SceneError> {
    let count = fields.required("count", fields.numbers::<3>("count")?)?;
    let whole = |count: &f32| count.fract() == 0.0 && (1.0..=MAX_PLACED as f32).contains(count);
    if !count.iter().all(whole) {
        let problem = format!("\"count\" must be three whole numbers from 1 to {MAX_PLACED}");
        return Err(fields.error("count", problem));
    }
    Ok(count.map(|count| count as u32))
}

fn read_shifts(fields: &Fields) -> Result<Shifts, SceneError> {
    fields.only_one_of(&["time_shift_step_s", "time_shifts_s", "time_shift_spread"])?;
    if fields.flag("time_shift_spread")? == Some(true) {
        return Ok(Shifts::Spread);
    }
    match fields.number_list("time_shifts_s")? {
        Some(list) if list.is_empty() => {
            Err(fields.error("time_shifts_s", "\"time_shifts_s\" is empty; give at least one number"))
        }
        Some(list) => Ok(Shifts::List(list)),
        None => Ok(Shifts::Step(fields.number("time_shift_step_s")?.unwrap_or(0.0))),
    }
}

impl Grid {
    fn place(&self, shared: &InstanceEntry, upright: Affine3A, cell: [u32; 3]) -> InstanceEntry {
        let [x, y, z] = cell;
        let index = x + self.count[0] * (y + self.count[1] * z);
        let at = self.first_m + self.spacing_m * Vec3::new(x as f32, y as f32, z as f32);
        let yaw = Quat::from_rotation_y(self.yaw_jitter_rad * jitter(index));
        let mut path = shared.path.clone();
        path.iter_mut().for_each(|path| path.time_shift_s += self.path_step_s * index as f32);
        InstanceEntry {
            name: format!("{} {x},{y},{z}", shared.name),
            world_from_model: Affine3A::from_rotation_translation(yaw, at) * upright,
            path,
            time_shift: self.shifts.of(index).after(shared.time_shift),
            ..shared.clone()
        }
    }
}

impl Shifts {
    fn of(&self, index: u32) -> TimeShift {
        match self {
            Self::Step(step_s) => TimeShift { seconds: step_s * index as f32, of_clip: 0.0 },
            Self::List(list) => TimeShift { seconds: list[index as usize % list.len()], of_clip: 0.0 },
            Self::Spread => TimeShift { seconds: 0.0, of_clip: spread(index) },
        }
    }
}

/// From -1 to 1, the same for the same number: splitmix64's finaliser, by Vigna.
fn jitter(index: u32) -> f32 {
    let mut z = (u64::from(index) + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 40) as f32 / (1u32 << 23) as f32 - 1.0
}
